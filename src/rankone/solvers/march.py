"""One pass over the horizon, slab after slab.

A controller says how long the next slab is, a slab solver solves it, and the controller learns how
that went.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

from rankone.ir.outcome import SlabRecord
from rankone.ir.verdict import MemoryNeeded, Status
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError
from rankone.support.progress import ProgressEvent, Report
from rankone.tensors.slab import SlabTrain

_HORIZON_ROUNDING = 1e-12  # Fraction of the horizon that rounding may leave over at its end


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
        while end - time > _HORIZON_ROUNDING * (end - start):
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
