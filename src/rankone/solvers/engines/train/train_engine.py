"""The tensor-train engine: march, check against SciPy, tighten until the measured error fits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

from rankone.solvers.attempts import Attempt, Marcher, Progress
from rankone.solvers.engines.train.iteration import SlabIteration
from rankone.solvers.engines.train.length import (
    Accuracy,
    Guess,
    ParameterNodes,
    SlabLengths,
    first_bases,
)
from rankone.solvers.engines.train.train_options import (
    CORNERS_TOLERANCE_SHARE,
    INTERIOR_TOLERANCE_SHARE,
    TrainOptions,
)
from rankone.solvers.march import March, MarchResult
from rankone.solvers.outcome import SlabRecord
from rankone.solvers.request import SolveRequest
from rankone.solvers.verification.growth import amplification
from rankone.solvers.verification.points import candidate_points
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.solvers.ways import Engine
from rankone.support.progress import Report
from rankone.tensors.bases import RadauCollocation
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.system.verdict import Status


class TrainMarcher(Marcher):
    """Marches with inner tolerances that become tighter."""

    remedies: ClassVar[Mapping[Status, str]] = {
        Status.RANK_LIMIT: "raise max_rank, narrow the box or loosen rtol",
        Status.NODE_LIMIT: "raise max_nodes, narrow the box or loosen rtol",
        Status.SLAB_LIMIT: "raise max_slabs or shorten the horizon",
        Status.MEMORY_LIMIT: "raise max_memory, narrow the box or loosen rtol",
        Status.NO_CONVERGENCE: "narrow the box or shorten the horizon",
        Status.TOLERANCE: "loosen rtol, narrow the box or shorten the horizon",
    }

    def __init__(
        self, request: SolveRequest, reference_set: ReferenceSet, workers: Workers
    ) -> None:
        self.rtol, self.options = request.rtol, request.options_of(TrainOptions)
        self.reference_set = reference_set
        system, domain = reference_set.system, reference_set.domain
        self.growth = amplification(reference_set)
        self.collocation = RadauCollocation.of(self.options.nodes_in_time(self.rtol))
        self.bases, self.floors = first_bases(system, domain, self.rtol, self.options)
        self.inner = self.rtol * (
            CORNERS_TOLERANCE_SHARE if reference_set.whole_box else INTERIOR_TOLERANCE_SHARE
        )
        self.guesses: Sequence[Guess] = ()
        self.longest = math.inf

    def march(self, index: int, report: Report) -> MarchResult:
        """March with the present inner tolerance, from the slabs of the attempt before."""
        reference_set, collocation = self.reference_set, self.collocation
        accuracy = Accuracy(self.inner, self.growth)
        nodes = ParameterNodes(reference_set.system, self.bases, self.floors, self.options)
        lengths = SlabLengths(reference_set, collocation, accuracy, self.guesses, self.longest)
        iteration = SlabIteration(reference_set, collocation, accuracy, nodes, index)
        march = March(lengths, iteration, self.options.max_slabs)
        run = march.run(reference_set.reference.start, reference_set.end, index, report)
        if run.stopped is None:
            run.points = candidate_points(run.slabs, reference_set.states, index, self.rtol)
        self.guesses = iteration.guesses
        return run

    def refine(self, attempt: Attempt, progress: Progress) -> bool:
        """Tighten the inner tolerance, unless a limit was met or two attempts have stalled.

        After one, slabs are halved as well: they may be too long for what is not smooth in time,
        such as a spline, although the highest modes are small.
        """
        stalls = progress.stalls
        if attempt.result.limits or (stalls >= 2 and not progress.pays):
            return False
        most = 0.03 if stalls else 0.4
        self.inner *= min(max(0.4 * self.rtol / attempt.error, 1e-3), most)
        self.bases = self.guesses[0].bases
        if stalls:
            self.longest = 0.5 * max(guess.length for guess in self.guesses)
            self.guesses = ()
        return True


ENGINE = Engine("train", TrainOptions, SlabRecord, TrainMarcher)
