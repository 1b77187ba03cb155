"""One pass over the horizon, slab after slab, and how errors grow that are made on the way.

By cross interpolation, as the cross engine does it with whole trajectories.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
import scipy.sparse

from rankone.solvers.outcome import SlabRecord
from rankone.solvers.tuning import CHECK, SOLVE
from rankone.solvers.verification.reference import Reference
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.arrays import AT_ONCE, COINCIDENT, Array
from rankone.support.budget import COPIES, OutOfBudgetError, ProgressEvent, Report, reserve
from rankone.support.costs import SparseFactors
from rankone.tensors.cross import Nodes, interpolate, left_points
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Integers, Train
from rankone.trajectories.system.system import PatternJacobian, System, pattern_of
from rankone.trajectories.system.verdict import MemoryNeeded, Status

logger = logging.getLogger("rankone")

REJECTED_FACTOR = 0.5  # Factor on the length of a slab that was rejected
SLOW_FACTOR = 0.7  # Factor on the length of the next slab after many iterations
FAST_FACTOR = 1.5  # Factor on the length of the next slab after few iterations
# Change or residual, in units of the states' sizes, above which an iteration has diverged
DIVERGED = 1e3
# Up to this many parameters, known functions are resolved and kept to rounding level
FEW_PARAMETERS = 2


@dataclass(frozen=True)
class PlainNodes:
    """Nodes of weight one."""

    size: int

    @property
    def weights(self) -> Array:
        """The weights, (size,)."""
        return np.ones(self.size)


def interpolated(
    function: Callable[[Integers], Array], nodes: Sequence[Nodes], tolerance: float
) -> Train:
    """A train through the values of a function at nodes of each parameter.

    ``function`` takes indices (m, d) of nodes and returns (n, m); ``tolerance`` is the largest
    error, in sizes of these values. Core 0 is (n, r_1), core j (r_j, N_j, r_{j+1}), scaled by the
    roots of the weights and right-orthonormal.
    """
    if not nodes:
        return Train((function(np.zeros((1, 0), dtype=np.int64)),))
    generator = np.random.default_rng(20140)
    trial = np.stack([generator.integers(0, x.size, SOLVE.trial_nodes) for x in nodes], axis=1)
    exact = function(trial)
    sizes = np.abs(exact).max(axis=1, keepdims=True)
    sizes[sizes == 0.0] = 1.0
    counts = [x.size for x in nodes]
    left = left_points(counts, SOLVE.first_left_points, 20140)

    def scaled(indices: Integers) -> Array:
        return np.asarray(function(indices) / sizes)

    for attempt in range(1, SOLVE.initial_attempts + 1):
        batches = [[points] for points in left]
        train, _ = interpolate(scaled, nodes, batches, tolerance, SOLVE.initial_rank)
        unscaled = train.unscaled([x.weights for x in nodes])
        errors = np.abs(train.first @ unscaled.at_indices(trial) - exact / sizes).max(axis=0)
        full = math.prod(counts[:-1]) <= len(left[-1])
        if full or errors.max() <= SOLVE.trial_factor * tolerance:
            break
        worst = trial[np.argsort(-errors)[: SOLVE.worst_trial_nodes]]
        left = [
            np.unique(np.concatenate([points, worst[:, : points.shape[1]]]), axis=0)
            for points in left_points(counts, SOLVE.first_left_points * 2**attempt, 20140 + attempt)
        ]
    logger.info("interpolated over the parameters: ranks %s, error %.1e", train.ranks, errors.max())
    return train.with_first(train.first * sizes)


def interpolated_initial(system: System, nodes: Sequence[Array]) -> Train:
    """Initial values at the nodes (N_j,) of each parameter, to rounding, as a train.

    Core 0 has the shape (n, r_1), core j the shape (r_j, N_j, r_{j+1}).
    """

    if not nodes:
        return Train((system.initial(np.empty((0, 1))),))

    def at_nodes(indices: Integers) -> Array:
        return system.initial(np.stack([x[indices[:, j]] for j, x in enumerate(nodes)]))

    return interpolated(at_nodes, [PlainNodes(x.size) for x in nodes], SOLVE.initial_tolerance)


# -----------------------------------------------------------------------------
# One pass over the horizon, slab after slab.
#
# A controller says how long the next slab is, a slab solver solves it, and the controller learns
# how that went.


@dataclass(frozen=True)
class Span:
    """The interval of a slab; ``end`` is ``start + length``, or exactly the end of the horizon."""

    start: float
    length: float
    end: float


@dataclass(frozen=True)
class SlabTrial:
    """A slab that was tried, solved if ``record.accepted``, and the limits that it met.

    If one of them was the memory, ``memory_needed`` says how much it needs.
    """

    record: SlabRecord
    limits: set[Status]
    memory_needed: MemoryNeeded | None = field(default=None, kw_only=True)


SomeSpan = TypeVar("SomeSpan", bound=Span)
SomeTrial = TypeVar("SomeTrial", bound=SlabTrial)
AcceptedSpan = TypeVar("AcceptedSpan", bound=Span, contravariant=True)
AcceptedTrial = TypeVar("AcceptedTrial", bound=SlabTrial, contravariant=True)


class Lengths(Protocol[SomeSpan, AcceptedTrial]):
    """A controller of the lengths of slabs."""

    def propose(self, start: float) -> SomeSpan | Status:
        """The next slab, or why there is none."""

    def adapt(self, span: SomeSpan, trial: AcceptedTrial) -> bool:
        """Choose the next length after a trial; whether to keep the slab."""


class SlabSolver(Protocol[AcceptedSpan, SomeTrial]):
    """Solves slabs, each from the end of the last one that was accepted."""

    def solve(self, span: AcceptedSpan) -> SomeTrial:
        """Solve one slab."""

    def accept(self, span: AcceptedSpan, trial: SomeTrial) -> list[SlabTrain]:
        """Move on to the end of the slab; it may be made of several elements."""


@dataclass
class MarchResult:
    """Slabs solved so far, records of all trials, and the limits met on the way.

    ``stopped`` says why the march ended early; with ``whole`` the slabs reach the end all the same.
    ``points`` (m, d) are further parameter points at which the error is measured, ``doubtful``
    (k, d) those at which the residual suggests an error above the tolerance. ``sampled`` operations
    went into trajectories. ``memory_needed`` is the memory that was needed last beyond the limit.
    """

    slabs: list[SlabTrain] = field(default_factory=list)
    records: list[SlabRecord] = field(default_factory=list)
    limits: set[Status] = field(default_factory=set)
    stopped: Status | None = None
    points: Array | None = None
    doubtful: Array | None = None
    whole: bool = False
    sampled: float = 0.0
    memory_needed: MemoryNeeded | None = None

    def stop(self, out: OutOfBudgetError) -> None:
        """End the march at a limit."""
        self.stopped = Status.of_limit(out)
        self.memory_needed = MemoryNeeded.of(out) or self.memory_needed


@dataclass(frozen=True)
class March(Generic[SomeSpan, SomeTrial]):
    """A march with a controller and a slab solver, of at most ``max_trials`` slabs."""

    lengths: Lengths[SomeSpan, SomeTrial]
    solver: SlabSolver[SomeSpan, SomeTrial]
    max_trials: int

    def run(self, start: float, end: float, attempt: int, report: Report) -> MarchResult:
        """March from start to end; ``report`` is called after each slab that is kept."""
        result = MarchResult()
        time = start
        while end - time > COINCIDENT * (end - start):
            span = self.lengths.propose(time)
            if isinstance(span, Status) or len(result.records) >= self.max_trials:
                result.stopped = span if isinstance(span, Status) else Status.SLAB_LIMIT
                break
            try:
                trial = self.solver.solve(span)
                kept = self.lengths.adapt(span, trial)
                trains = self.solver.accept(span, trial) if kept else []
            except OutOfBudgetError as out:
                result.stop(out)
                break
            result.records.append(replace(trial.record, accepted=kept))
            result.limits |= trial.limits
            result.memory_needed = trial.memory_needed or result.memory_needed
            if kept:
                result.slabs += trains
                time = span.end
                place = time, (time - start) / (end - start), attempt, len(result.slabs)
                report(ProgressEvent(*place, max((r for s in trains for r in s.ranks), default=1)))
        return result


# -----------------------------------------------------------------------------
# How much errors grow that are made on the way.


def amplification(reference_set: ReferenceSet) -> Callable[[float], float]:
    """Largest later growth of an error made at time t, along a few trajectories.

    The variational equation ``w' = J(t) w`` is stepped on a uniform grid with the Cayley transform
    of the scaled Jacobian, which is stable for stiff systems. The amplification, at least 1, is the
    largest Frobenius norm, divided by sqrt(n), of the propagator from t to any later time. Of many
    states it is estimated from random columns of the propagator.
    """
    start = reference_set.reference.start
    pattern = pattern_of(reference_set.system.jacobian)
    if pattern is None:
        largest = _of_propagators(reference_set)
    else:
        largest = _of_columns(reference_set, pattern)
    grid = np.linspace(start, reference_set.end, CHECK.growth_steps + 1)
    return lambda t: float(np.interp(t, grid, largest))


def _of_propagators(reference_set: ReferenceSet) -> Array:
    """The amplification at the steps (steps + 1,), from whole propagators."""
    n, start = reference_set.system.n_differential, reference_set.reference.start
    width = (reference_set.end - start) / CHECK.growth_steps
    reference = reference_set.reference
    count = min(CHECK.growth_trajectories, len(reference.points))
    together = max(AT_ONCE // (n * n * CHECK.growth_steps), 1)
    largest = np.ones(CHECK.growth_steps + 1)
    for first in range(0, count, together):
        some = reference.of(slice(first, min(first + together, count)))
        reserve(8 * COPIES * n * n * CHECK.growth_steps * len(some.points))
        step = _cayley_steps(reference_set, some, width)
        propagator = step
        for gap in range(1, CHECK.growth_steps + 1):
            norms = np.sqrt(np.einsum("kmij,kmij->km", propagator, propagator).max(axis=1) / n)
            np.maximum(largest[: norms.size], norms, out=largest[: norms.size])
            if gap < CHECK.growth_steps:
                propagator = np.matmul(step[gap:], propagator[:-1])
    return largest


def _of_columns(reference_set: ReferenceSet, pattern: PatternJacobian) -> Array:
    """The same from random columns, stepped with sparse factors (Hutchinson's estimate, 1990)."""
    n, reference = reference_set.system.n_differential, reference_set.reference
    width = (reference_set.end - reference.start) / CHECK.growth_steps
    middle = np.asarray(
        reference.start + width * (np.arange(CHECK.growth_steps) + 0.5), dtype=float
    )
    sizes = reference_set.states
    scale = 0.5 * width * sizes[pattern.columns] / sizes[pattern.rows]
    places, eye = (pattern.rows, pattern.columns), scipy.sparse.identity(n, format="csc")
    first = np.random.default_rng(0).standard_normal((n, CHECK.growth_columns)) / np.sqrt(
        n * CHECK.growth_columns
    )
    largest = np.ones(CHECK.growth_steps + 1)
    reserve(8 * COPIES * n * CHECK.growth_columns * CHECK.growth_steps)
    for point in range(min(CHECK.growth_trajectories, len(reference.points))):
        some = reference.of(slice(point, point + 1))
        entries = pattern.entries(middle, some(middle)[:, 0], some.points[0][:, None])
        entries = np.broadcast_to(entries, (pattern.rows.size, CHECK.growth_steps))
        columns = np.empty((n, 0))
        for step in range(CHECK.growth_steps):
            half = scipy.sparse.csc_matrix((scale * entries[:, step], places), (n, n))
            columns = np.concatenate([columns, first], axis=1)  # errors made here
            try:
                columns = SparseFactors(eye - half).solve(columns + half @ columns)
            except RuntimeError:  # a growth rate at a pole of the transform
                half = CHECK.beside_pole * half
                columns = SparseFactors(eye - half).solve(columns + half @ columns)
            norms = np.linalg.norm(columns.reshape(n, -1, CHECK.growth_columns), axis=(0, 2))
            np.maximum(largest[: norms.size], norms, out=largest[: norms.size])
    return largest


def _cayley_steps(reference_set: ReferenceSet, reference: Reference, width: float) -> Array:
    """Propagators (steps, m, n, n) of steps of a width along trajectories, in units of sizes."""
    system, n = reference_set.system, reference_set.system.n_differential
    middle = np.asarray(
        reference.start + width * (np.arange(CHECK.growth_steps) + 0.5), dtype=float
    )
    states, points = reference(middle), reference.points
    jacobian = system.jacobian(middle, states, points.T[:, :, None])
    jacobian = np.broadcast_to(jacobian, (n, n, len(points), CHECK.growth_steps))
    scale = reference_set.states[None, :] / reference_set.states[:, None]
    half, eye = 0.5 * width * jacobian.transpose(3, 2, 0, 1) * scale, np.eye(n)
    try:
        steps = np.linalg.solve(eye - half, eye + half)
    except np.linalg.LinAlgError:  # a growth rate at a pole of the transform
        steps = np.linalg.solve(eye - CHECK.beside_pole * half, eye + CHECK.beside_pole * half)
    return np.asarray(steps, dtype=float)
