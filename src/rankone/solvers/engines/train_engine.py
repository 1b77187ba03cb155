"""Attempts of the tensor-train engine, and the sweeps that solve one slab."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from rankone.solvers.attempts import Attempt, Marcher, Progress
from rankone.solvers.engines.engine_options import TRAIN, TrainOptions
from rankone.solvers.engines.train_length import (
    Accuracy,
    Guess,
    ParameterNodes,
    SlabLengths,
    TrainSpan,
    TrainTrial,
    after_jump,
    first_bases,
)
from rankone.solvers.engines.train_operators import SlabJacobian, SlabOperator, term_groups
from rankone.solvers.engines.train_sweep import Sweeper
from rankone.solvers.march import DIVERGED, FEW_PARAMETERS, March, MarchResult, amplification
from rankone.solvers.outcome import SlabRecord
from rankone.solvers.request import SolveRequest
from rankone.solvers.verification.points import candidate_points
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.solvers.ways import Engine
from rankone.support.arrays import COARSE, MINOR, Array
from rankone.support.budget import OutOfMemoryError, Report, reserve
from rankone.tensors import RadauCollocation
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.system.verdict import MemoryNeeded, Status


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
            TRAIN.corners_tolerance_share
            if reference_set.whole_box
            else TRAIN.interior_tolerance_share
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
        self.inner *= min(max(0.4 * self.rtol / attempt.error, COARSE), most)
        self.bases = self.guesses[0].bases
        if stalls:
            self.longest = 0.5 * max(guess.length for guess in self.guesses)
            self.guesses = ()
        return True


ENGINE = Engine("train", TrainOptions, SlabRecord, TrainMarcher)


# -----------------------------------------------------------------------------
# The solve of one slab: sweeps until the residual is small, on as many nodes as needed.


@dataclass
class Convergence:
    """How fine the next sweep truncates, whether the slab is solved, whether it is hopeless.

    The residual of a sweep is the largest change of a pair of cores, in units of the states'
    sizes. The error left after a sweep is about the residual times the contraction: the ratio of
    the last two residuals, 0.1 before it is known. Sweeps aim at ``tolerance``; the first, which
    need not be fine, at ``coarse``.
    """

    tolerance: float
    coarse: float
    residuals: list[float] = field(default_factory=list)
    contraction: float = MINOR
    _since_restart: int = 0

    @property
    def next_tolerance(self) -> float:
        """Truncation tolerance of the next sweep."""
        return self.tolerance if self._since_restart else max(self.tolerance, self.coarse)

    def add(self, residual: float) -> None:
        """Record a sweep."""
        if self._since_restart:
            last = self.residuals[-1]
            self.contraction = residual / last if last > 0.0 else 0.0
        self._final = self.next_tolerance == self.tolerance
        self.residuals.append(residual)
        self._since_restart += 1

    def restart(self) -> None:
        """Count the sweeps anew after parameter nodes were added."""
        self._since_restart = min(self._since_restart, 1)
        self.contraction = MINOR

    def solved(self, limited: bool) -> bool:
        """Whether the slab is accurate enough, or as accurate as the rank limit allows."""
        if limited and self._since_restart >= 3 and self.contraction > TRAIN.stagnant_contraction:
            return True
        reliable = self._since_restart > 1 and self.contraction < TRAIN.reliable_contraction
        ahead = self.residuals[-1] * (
            max(self.contraction, TRAIN.least_contraction) if reliable else 1.0
        )
        return self._final and ahead <= self.tolerance

    def hopeless(self, limited: bool) -> bool:
        """Whether the sweeps diverge or converge too slowly."""
        residual = self.residuals[-1]
        if not math.isfinite(residual) or residual > DIVERGED:
            return True
        return (
            self._since_restart >= 4
            and self.contraction > TRAIN.reliable_contraction
            and not limited
        )


def _memory_needed(count: float) -> MemoryNeeded | None:
    """What is needed if so many bytes do not fit."""
    try:
        reserve(count)
    except OutOfMemoryError as out:
        return MemoryNeeded.of(out)
    return None


@dataclass
class SlabIteration:
    """The slab solver of one attempt; the slabs accepted are ``guesses`` for the next attempt.

    The Jacobian of a slab is taken along the reference at the centre of the box.
    """

    reference_set: ReferenceSet
    collocation: RadauCollocation
    accuracy: Accuracy
    nodes: ParameterNodes
    attempt: int = 0

    def __post_init__(self) -> None:
        self.options, self.scale = self.nodes.options, self.reference_set.sizes
        self.guesses: list[Guess] = []
        self._groups = term_groups(self.reference_set.system)
        self._source = self.nodes.initial(self.scale)
        self._second_residual = 1e-2
        self._trials = 0
        self._memory_needed: MemoryNeeded | None = None

    def solve(self, span: TrainSpan) -> TrainTrial:
        """Sweep on one slab, from an earlier attempt or from its initial values."""
        tolerance = self.accuracy.tolerance(span.start)
        sweeper = self._started(span)
        limits: set[Status] = set()
        self._memory_needed = None
        spectra: list[Array] = []
        if self.nodes.bases:
            coarse = min(MINOR * self._second_residual, TRAIN.first_sweep_factor * tolerance)
            convergence = Convergence(tolerance, coarse)
            sweeper, spectra, solved = self._swept(sweeper, convergence, limits)
        else:
            convergence = Convergence(tolerance, tolerance)
            convergence.add(sweeper.settle(tolerance, 40))
            solved = convergence.solved(limited=False)
        residuals = tuple(convergence.residuals)
        if solved:
            self._second_residual = residuals[min(1, len(residuals) - 1)]
        self._trials += 1
        place = self.attempt, span.start, span.end, solved, tolerance
        sizes = tuple(basis.size for basis in self.nodes.bases)
        record = SlabRecord(*place, residuals, sweeper.ranks, sizes)
        return TrainTrial(record, limits, sweeper, spectra, memory_needed=self._memory_needed)

    def accept(self, span: TrainSpan, trial: TrainTrial) -> list[SlabTrain]:
        """The slab as polynomial coefficients; the next begins at its end."""
        sweeper, bases = trial.sweeper, self.nodes.bases
        train = sweeper.train.with_first(trial.time_modes)
        train = train.apply_to_modes([basis.to_modal for basis in bases])
        if len(bases) > FEW_PARAMETERS:
            train = train.thinned(TRAIN.thinning_share * self.accuracy.resolution)
        units = self.scale[: len(train.first)]
        self.guesses.append(Guess(span.start, span.length, sweeper.train, bases))
        self._source = self._at_end(trial)
        kind = self.reference_set.system.jumps.kind_at(span.end)
        if kind is not None and span.end < self.reference_set.end:
            tolerance = TRAIN.loss_share * trial.record.tolerance
            self._source = after_jump(kind, self.nodes, self._source, units, tolerance)
        train = train.with_first(train.first * units[:, None, None])
        return [SlabTrain(span.start, span.end, train, bases)]

    def _started(self, span: TrainSpan) -> Sweeper:
        """A sweeper with a first guess in a widened frame."""
        operator, guess, bases = self._operator(span), span.guess, self.nodes.bases
        if guess is None:
            train = self._source.with_first(operator.initial(self._source.first))
        else:
            maps = [b.transfer(basis) for b, basis in zip(guess.bases, bases, strict=True)]
            train = guess.train.apply_to_modes(maps).right_orthonormal()
        if bases:
            count = min(self.scale.size, TRAIN.max_probes)
            train = train.widened(self.nodes.probe(count, seed=self._trials))
        return self._sweeper(operator, train)

    def _operator(self, span: TrainSpan) -> SlabOperator:
        """The operator with the Jacobian along the trajectory at the centre of the box."""
        system, reference = self.reference_set.system, self.reference_set.reference
        times = self.collocation.times(span.start, span.length)
        states = system.with_products(reference(times)[:, 0])
        point = reference.points[0][:, None]
        jacobian = SlabJacobian.along(system.quadratic_jacobian, times, states, point)
        place = span.start, span.length
        return SlabOperator(system, self.collocation, *place, self.scale, jacobian)

    def _sweeper(self, operator: SlabOperator, train: Train) -> Sweeper:
        groups, operators, cores = self._groups, self.nodes.operators, list(train.cores)
        return Sweeper(operator, groups, operators, cores, self._source, self.options.max_rank)

    def _swept(
        self, sweeper: Sweeper, convergence: Convergence, limits: set[Status]
    ) -> tuple[Sweeper, list[Array], bool]:
        """Sweep until the slab is solved or hopeless; the last item says whether it is solved."""
        tolerance = convergence.tolerance
        spectra: list[Array] = []
        sweeper.settle(max(tolerance, COARSE), 8)
        while len(convergence.residuals) < self.options.max_sweeps:
            current = convergence.next_tolerance
            try:
                residual, spectra = sweeper.iterate(current / np.sqrt(sweeper.dimensions))
            except OutOfMemoryError as out:
                limits.add(Status.MEMORY_LIMIT)
                self._memory_needed = MemoryNeeded.of(out)
                break
            convergence.add(residual)
            limited = max(sweeper.ranks) >= self.options.max_rank
            if limited:
                limits.add(Status.RANK_LIMIT)
            if convergence.hopeless(limited):
                break
            self._memory_needed = _memory_needed(sweeper.memory)
            if self._memory_needed is not None:
                limits.add(Status.MEMORY_LIMIT)
                break
            sweeper.settle(0.2 * tolerance, 12)
            level = max(current, residual if limited else 0.0)
            bases, too_few = self.nodes.refined(spectra, level)
            if too_few:
                limits.add(Status.NODE_LIMIT)
            if bases != self.nodes.bases:
                maps = self.nodes.take(bases)  # the start of the slab moves along
                self._source = self._source.apply_to_modes(maps).right_orthonormal()
                train = sweeper.train.apply_to_modes(maps).right_orthonormal()
                sweeper = self._sweeper(sweeper.operator, train)
                convergence.restart()
            elif convergence.solved(limited):
                return sweeper, spectra, True
        return sweeper, spectra, False

    def _at_end(self, trial: TrainTrial) -> Train:
        """The train at the end of the slab, on no more parameter nodes than it needs."""
        last = trial.sweeper.cores[0][: self.reference_set.system.n_differential, -1]
        source = trial.sweeper.train.with_first(last * np.sqrt(self.collocation.count))
        bases = self.nodes.coarsened(trial.spectra, TRAIN.loss_share * trial.record.tolerance)
        if bases is self.nodes.bases:
            return source
        return source.apply_to_modes(self.nodes.take(bases)).right_orthonormal()
