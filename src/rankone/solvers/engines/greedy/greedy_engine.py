"""``method="greedy"``: march, check against SciPy, more nodes or a tighter tolerance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rankone.solvers.attempts import Attempt, Marcher, Progress
from rankone.solvers.engines.greedy.greedy_options import (
    TUNING,
    GreedyOptions,
)
from rankone.solvers.engines.greedy.operators import first_nodes
from rankone.solvers.engines.greedy.slabs import (
    Coupling,
    GreedySlabRecord,
    GreedyTrial,
    LaggedSlabs,
)
from rankone.solvers.march import (
    FAST_FACTOR,
    REJECTED_FACTOR,
    SLOW_FACTOR,
    March,
    MarchResult,
    Span,
)
from rankone.solvers.request import SolveRequest
from rankone.solvers.verification.growth import amplification
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.solvers.ways import Engine
from rankone.support.budget import COPIES, memory_left, reserve
from rankone.support.precision import ACCUMULATED, AT_ONCE, NEGLIGIBLE, TINY
from rankone.support.progress import Report
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.system.verdict import Cause, Status, UnsettledTerms


@dataclass
class SlabLengths:
    """The controller of the lengths of slabs; none crosses a cut (ascending times).

    If the lengths adapt, the first slab is no longer than ``longest``.
    """

    start: float
    end: float
    options: GreedyOptions
    longest: float = math.inf
    cuts: Sequence[float] = ()

    def __post_init__(self) -> None:
        self.horizon, count = self.end - self.start, self.options.time_slabs
        self.adaptive = count is None
        self.length = self.horizon / count if count else min(self.horizon, self.longest)
        self._hopeless = False

    def propose(self, start: float) -> Span | Status:
        """The next of equal slabs that fill what remains up to the end, or to the next cut."""
        if self._hopeless:
            return Status.NO_CONVERGENCE
        border = next((cut for cut in self.cuts if start < cut < self.end), self.end)
        remaining = border - start
        length = remaining / max(math.ceil(remaining / self.length - NEGLIGIBLE), 1)
        if border == self.end:
            self.length = length
        end = border if remaining < 1.01 * length else start + length
        return Span(start, length, end)

    def adapt(self, span: Span, trial: GreedyTrial) -> bool:
        """Halve after a rejection, lengthen where few iterations were needed."""
        if not trial.record.accepted:
            self.length = REJECTED_FACTOR * span.length
            self._hopeless = not self.adaptive or self.length <= NEGLIGIBLE * self.horizon
        elif self.adaptive:
            iterations = len(trial.record.residuals)
            factor = (
                FAST_FACTOR
                if iterations <= TUNING.few_iterations
                else SLOW_FACTOR
                if iterations > TUNING.many_iterations
                else 1.0
            )
            longer = span.length * (
                REJECTED_FACTOR if Status.RANK_LIMIT in trial.limits else factor
            )
            self.length = max(longer, self.length) if span.end in self.cuts else longer
        return trial.record.accepted


class GreedyMarcher(Marcher):
    """Marches with more nodes, then with tighter tolerances."""

    remedies: ClassVar[Mapping[Status, str]] = {
        Status.RANK_LIMIT: "raise max_modes, loosen rtol or use method='train'",
        Status.SLAB_LIMIT: "raise max_slabs, shorten the horizon or use method='train'",
        Status.NO_CONVERGENCE: "use more time_slabs, formulation='volterra', update='all' or "
        "method='train'",
        Status.TOLERANCE: "use more nodes, elements='legendre', or method='train'",
    }

    def __init__(
        self, request: SolveRequest, reference_set: ReferenceSet, workers: Workers
    ) -> None:
        self.rtol, self.options = request.rtol, request.options_of(GreedyOptions)
        self.reference_set = reference_set
        system, domain, sizes = reference_set.system, reference_set.domain, reference_set.states
        self.growth = amplification(reference_set)
        self.coupling = Coupling(system, sizes, self.options)
        lagged = any(map(self.coupling.lagged, self.coupling.blocks))
        self.longest = (
            TUNING.first_slab_contraction / max(_stiffness(reference_set), TINY)
            if lagged
            else math.inf
        )
        self.nodes = first_nodes(system, domain, self.rtol, self.options)
        self.tails = np.zeros(1 + len(domain.box))
        self.share = TUNING.tolerance_share

    def tolerance(self, time: float) -> float:
        """Tolerance of a slab, in units of the sizes."""
        return self.options.tolerance or max(
            self.share * self.rtol / self.growth(time), ACCUMULATED
        )

    def march(self, index: int, report: Report) -> MarchResult:
        """March with the present nodes and tolerance."""
        start, end = self.reference_set.reference.start, self.reference_set.end
        lengths = SlabLengths(start, end, self.options, self.longest, self.reference_set.cuts)
        domain = self.reference_set.domain
        slabs = LaggedSlabs(self.coupling, domain, self.nodes, self.tolerance, index)
        march = March(lengths, slabs, self.options.max_slabs).run(start, end, index, report)
        self.tails = slabs.tails
        return march

    def refine(self, attempt: Attempt, progress: Progress) -> bool:
        """More nodes where the highest modes are not small, else a tighter tolerance."""
        nodes, limits = self.nodes, attempt.result.limits
        stalls = 0 if progress.pays else progress.stalls
        self.nodes = nodes.finer(self.tails > TUNING.tail_share * self.rtol, self.options)
        same = self.nodes == nodes
        stuck = stalls or limits or self.options.tolerance is not None
        if (stalls and limits) or (same and stuck):
            return False
        if same:
            self.share *= min(max(0.5 * self.rtol / attempt.error, 0.05), 0.5)
        return True

    def explained(self, status: Status, attempt: Attempt) -> tuple[Status, Cause | None]:
        """Say where the lagged terms settled least, if the iteration did not converge."""
        if status is not Status.NO_CONVERGENCE:
            return status, None
        worst = max(attempt.result.records, key=lambda record: record.residuals[-1])
        residuals = worst.residuals
        return status, UnsettledTerms(len(residuals), worst.start, worst.end, residuals[-1])


def _stiffness(reference_set: ReferenceSet) -> float:
    """Largest row sum norm of the Jacobian over the check points, in units of the sizes."""
    system, reference, sizes = reference_set.system, reference_set.reference, reference_set.states
    times = np.linspace(reference.start, reference_set.end, TUNING.stiffness_samples)
    n, m = system.n_differential, len(reference.points)
    held = min(AT_ONCE, memory_left() / (8 * COPIES))
    together, largest = max(int(held // (n * n * m)), 1), 0.0
    reserve(8 * COPIES * n * n * m * together)
    for first in range(0, times.size, together):
        some = times[first : first + together]
        jacobian = system.jacobian(some, reference(some), reference.points.T[:, :, None])
        jacobian = np.broadcast_to(jacobian, (n, n, m, some.size))
        scaled = np.abs(jacobian) * (sizes[None, :] / sizes[:, None])[:, :, None, None]
        largest = max(largest, float(scaled.sum(axis=1).max()))
    return largest


ENGINE = Engine("greedy", GreedyOptions, GreedySlabRecord, GreedyMarcher)
