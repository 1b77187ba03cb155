"""One pass over the horizon, slab after slab, and functions of the parameters alone.

By cross interpolation, as the cross engine does it with whole trajectories.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from rankone.solvers.outcome import SlabRecord
from rankone.solvers.solve_tuning import SOLVE
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError
from rankone.support.precision import COINCIDENT
from rankone.support.progress import ProgressEvent, Report
from rankone.tensors.trains.cross import Nodes, interpolate, left_points
from rankone.tensors.trains.slab import SlabTrain
from rankone.tensors.trains.train import Integers, Train
from rankone.trajectories.system.system import System
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
