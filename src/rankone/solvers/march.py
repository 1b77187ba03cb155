"""One pass over the horizon, slab after slab.

A march only leads: a controller says how long the next slab is, a slab solver solves it, and the
controller takes notice of how that went.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from rankone.ir.outcome import SlabRecord
from rankone.ir.verdict import Status
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError
from rankone.support.progress import ProgressEvent, Report
from rankone.tensors.slab import SlabTrain

__all__ = ["Lengths", "March", "MarchResult", "SlabSolver", "Span", "Trial"]

_REST = 1e-12
"""What is left of the horizon is nothing below this part of it."""


@dataclass(frozen=True)
class Span:
    """Where a slab lies; ``end`` is ``start + length``, or the very border that it reaches."""

    start: float
    length: float
    end: float


@dataclass(frozen=True)
class Trial:
    """What the solve of one slab came to, and the limits that it met.

    ``record.accepted`` says whether the slab is solved.
    """

    record: SlabRecord
    limits: set[Status]


class Lengths(Protocol):
    """A controller of the lengths of slabs."""

    def propose(self, start: float) -> Span | Status:
        """The next slab, or why there is none."""

    def adapt(self, span: Any, trial: Any) -> bool:
        """Choose the next length after a trial; whether the slab is to be kept."""


class SlabSolver(Protocol):
    """Solves slabs, each from the end of the last one that was accepted."""

    def solve(self, span: Any) -> Trial:
        """Solve one slab."""

    def accept(self, span: Any, trial: Any) -> list[SlabTrain]:
        """Move on to the end of the slab; it may be made of several elements."""


@dataclass
class MarchResult:
    """Slabs solved so far, records of all trials, and the limits met on the way.

    ``stopped`` says why the march ended early; None if it reached the end. ``points`` (m, d) are
    parameter points at which the error must be within the tolerance too if it is at those that are
    always taken, or at which the march met its end; ``doubtful`` (k, d) are those at which the
    residual says that it is not. ``whole`` says that the slabs reach the end
    although it was stopped. ``sampled`` are operations that went into trajectories.
    """

    slabs: list[SlabTrain] = field(default_factory=list)
    records: list[SlabRecord] = field(default_factory=list)
    limits: set[Status] = field(default_factory=set)
    stopped: Status | None = None
    points: Array | None = None
    doubtful: Array | None = None
    whole: bool = False
    sampled: float = 0.0


@dataclass(frozen=True)
class March:
    """A march with a controller and a slab solver, of at most so many trials."""

    lengths: Lengths
    solver: SlabSolver
    most: int

    def run(self, start: float, end: float, attempt: int, report: Report) -> MarchResult:
        """March from start to end; ``report`` is called after each slab that is kept."""
        result = MarchResult()
        time = start
        while end - time > _REST * (end - start):
            span = self.lengths.propose(time)
            if isinstance(span, Span) and len(result.records) >= self.most:
                span = Status.SLAB_LIMIT
            if isinstance(span, Status):
                result.stopped = span
                break
            try:
                trial = self.solver.solve(span)
                kept = self.lengths.adapt(span, trial)
                trains = self.solver.accept(span, trial) if kept else []
            except OutOfBudgetError as out:
                result.stopped = Status.of_limit(out)
                break
            result.records.append(replace(trial.record, accepted=kept))
            result.limits |= trial.limits
            if kept:
                result.slabs += trains
                time = span.end
                place = time, (time - start) / (end - start), attempt, len(result.slabs)
                report(ProgressEvent(*place, max((r for s in trains for r in s.ranks), default=1)))
        return result
