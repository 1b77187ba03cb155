"""One attempt after the other: reference, march, check, tighten, until the measured error fits."""

from __future__ import annotations

import itertools
import math
import time as clock
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from rankone.solvers.march import MarchResult
from rankone.solvers.outcome import Measured, Outcome, SafeInterval, SlabRecord
from rankone.solvers.remedies import Resolution, narrowed_box, spectra_of
from rankone.solvers.request import SolveRequest
from rankone.solvers.tuning import SOLVE
from rankone.solvers.verification.measure import measure
from rankone.solvers.verification.reference import safe_intervals
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.solvers.verification.worst_points import confirmed, worst_points
from rankone.support.arrays import TINY, Array
from rankone.support.budget import (
    OutOfBudgetError,
    Report,
    budget_left,
    keeping_back,
    persisting,
    seconds_left,
    waiting,
    work_done,
    work_left,
)
from rankone.support.options import Options
from rankone.tensors import Basis1D
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import (
    AccurateUnknowns,
    Budget,
    Cause,
    HiddenRate,
    MeasuredError,
    MemoryNeeded,
    Note,
    NothingInterpolated,
    ReferenceLimit,
    Remedy,
    Status,
    SteepParameter,
    StoppedAt,
    TinyUnknowns,
)

EXPLANATION_OPERATIONS = 1.5e9
"""Most operations kept back, and spent, to explain a failure: to find the steep parameter."""
EXPLANATION_SECONDS = 5.0
"""Most seconds of a time limit kept back for the same: about what those operations take."""
EXPLANATION_SHARE = 0.15
"""Largest share of a budget kept back for it, so that small budgets still go into the solve."""
STALLED_RATIO = 0.7
"""An attempt has stalled if its error is above this fraction of the best error before it."""
PAYING_FACTOR = 1.5
"""Factor by which a recent attempt must have lowered the error to go on in any case."""
CLOSE_ERROR_RATIO = 5.0
"""An error of less than this many rtol is close to the goal."""
RECENT_ATTEMPTS = 3
"""Attempts that count as recent: two that fail in a row may be followed by one that succeeds."""
LEAST_COST_RATIO = 0.9
"""Work of an attempt over that of the one before it, at least: each is finer, and may only spare
what calibrations took."""
# Endings after which a narrower box may help
_NARROWED = (Status.TOLERANCE, Status.NODE_LIMIT, Status.WORK_LIMIT, Status.TIME_LIMIT)
# Limits in the order in which they explain a failure
_CAUSES = (Status.NO_CONVERGENCE, *(s for s in Status if s is not Status.NO_CONVERGENCE))
_REMEDIES = {
    Status.WORK_LIMIT: "raise effort",
    Status.TIME_LIMIT: "give more time by max_seconds",
    Status.MEMORY_LIMIT: "raise max_memory, narrow the box or loosen rtol",
}
# Limits that a later attempt may meet, although an earlier one is the best
_LIMITS_OF_THE_SOLVE = (
    Status.WORK_LIMIT,
    Status.TIME_LIMIT,
    Status.TRAJECTORY_LIMIT,
    Status.MEMORY_LIMIT,
)


@dataclass(frozen=True)
class Attempt:
    """One pass over the horizon, its measured error, and the work of its march.

    ``hidden`` says where no reference is right that it could be measured against.
    """

    result: MarchResult
    measured: Measured | None
    work: float = 0.0
    hidden: HiddenRate | None = None

    @property
    def error(self) -> float:
        """Largest measured error; infinite if there is none."""
        return math.inf if self.measured is None else self.measured.error

    def measured_by(self, reference_set: ReferenceSet) -> Attempt:
        """The same, measured against another reference set."""
        return replace(self, measured=measure(reference_set, self.result.slabs))

    def better_than(self, best: Attempt | None) -> bool:
        """Whether to keep this attempt: it got further, or as far with a smaller error."""
        if best is None:
            return True
        if (self.result.stopped is None) != (best.result.stopped is None):
            return self.result.stopped is None
        return self.error < best.error

    def status(self, reference_set: ReferenceSet, rtol: float) -> Status:
        """How the solve ended if this attempt is the best."""
        limits = [status for status in _CAUSES if status in self.result.limits]
        stopped = self.result.stopped
        reference = reference_set.reference
        if reference.blown is not None:
            if reference.switching is not None:
                return Status.SWITCHES
            if reference.large:
                return Status.BLOW_UP
            return Status.STALLS if reference.regular else Status.LEAVES
        if self.hidden is not None:
            return Status.NARROW
        if stopped is not None:
            return limits[0] if stopped is Status.NO_CONVERGENCE and limits else stopped
        if not reference_set.checked:
            return Status.UNCHECKED
        if self.error <= rtol:
            return Status.CONVERGED
        return limits[0] if limits else Status.TOLERANCE


@dataclass
class Progress:
    """How the error fell from attempt to attempt; the last ``stalls`` of them hardly lowered it."""

    stalls: int = 0
    _recent: tuple[bool, ...] = ()
    _least: tuple[float, ...] = ()

    def add(self, error: float, best: float) -> None:
        """Record an attempt; ``best`` is the least error before it."""
        self._least = (*self._least, min(error, best))[-RECENT_ATTEMPTS:]
        self.stalls = self.stalls + 1 if error > STALLED_RATIO * best else 0
        lowered = best < math.inf and PAYING_FACTOR * error <= best
        self._recent = (*self._recent, lowered)[-RECENT_ATTEMPTS:]

    @property
    def pays(self) -> bool:
        """Whether another attempt is worth its work in any case."""
        return any(self._recent)

    def going_on(self, work: float, rtol: float) -> AbstractContextManager[None]:
        """What another attempt of so much work runs in, after one that took as much.

        It may take all of the budget where the error is close to the tolerance, or this is reached
        within the budget if the error goes on to fall as it did.
        """
        first, last = (self._least or (math.inf,))[0], min(self._least, default=math.inf)
        if rtol < last <= CLOSE_ERROR_RATIO * rtol and not self.stalls:
            return persisting()
        if not self.pays or not rtol < last < first < math.inf:
            return nullcontext()
        fall = math.log(first / last) / (len(self._least) - 1)
        further = math.ceil(math.log(last / rtol) / fall)
        return persisting() if further * work <= budget_left() else nullcontext()


class Stages:
    """Seconds and operations by stage."""

    def __init__(self) -> None:
        self.timings = {"reference": 0.0, "march": 0.0, "check": 0.0}
        self.work = dict.fromkeys(self.timings, 0.0)
        self.budget, self.sampled = work_left(), 0.0

    @property
    def named(self) -> dict[str, float]:
        """Operations by stage; a march of samples and ranks counts as two stages."""
        if not self.sampled:
            return self.work
        ranks = self.work["march"] - self.sampled
        work = {"reference": self.work["reference"], "samples": self.sampled, "ranks": ranks}
        return {**work, "check": self.work["check"]}

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Add the seconds and operations spent inside to a stage."""
        began, done = clock.perf_counter(), work_done()
        try:
            yield
        finally:
            self.timings[stage] += clock.perf_counter() - began
            self.work[stage] += work_done() - done

    @contextmanager
    def if_it_fails(self, stage: str) -> Iterator[None]:
        """Add what was spent inside to a stage if it ends in an error: no outcome tells of it."""
        inside = Stages()
        try:
            with inside.of(stage):
                yield
        except Exception:
            self.add(inside.timings, inside.work)
            raise

    def add(self, timings: Mapping[str, float], work: Mapping[str, float]) -> None:
        """Add seconds and operations by stage."""
        for stage in self.timings:
            self.timings[stage] += timings[stage]
            self.work[stage] += work[stage]


class Marcher(Protocol):
    """The part of an engine: marches over the horizon, each finer than the one before."""

    reference_set: ReferenceSet
    """The reference trajectories; further points may join them between two marches."""
    remedies: ClassVar[Mapping[Status, str]]
    """What to do, by status."""

    def march(self, index: int, report: Report) -> MarchResult:
        """Solve the horizon; ``index`` counts the attempts from 0."""

    def refine(self, attempt: Attempt, progress: Progress) -> bool:
        """Make the next march more accurate; False when there is nothing left to try."""

    def explained(self, status: Status, attempt: Attempt) -> tuple[Status, Cause | None]:
        """The status, or a more precise one, and the cause."""
        return status, None

    def modes_on_lines(self) -> list[tuple[Basis1D, Array]]:
        """Bases, and the sizes of their modes on some lines, where no attempt came to an end."""
        return []


def solve_in_attempts(
    marcher_of: Callable[[], Marcher],
    options: Options,
    system: System,
    request: SolveRequest,
    report: Report,
) -> Outcome:
    """Integrate the reference, then march and check until the measured error fits.

    ``marcher_of`` integrates it and makes the engine's marcher, ``options`` are those of the
    engine. A part of the budget is kept back to explain a failure.
    """
    stages, kept_back = Stages(), min(EXPLANATION_OPERATIONS, EXPLANATION_SHARE * budget_left())
    seconds = min(EXPLANATION_SECONDS, EXPLANATION_SHARE * seconds_left())
    with keeping_back(kept_back, seconds):
        try:
            with stages.of("reference"):
                marcher = marcher_of()
        except OutOfBudgetError as out:
            return out_at_reference(out, system, stages, request.check.states)
        with waiting(SOLVE.paid_reference_share * stages.work["reference"]):
            attempted = _attempts(marcher, request.rtol, options, report, stages)
    reference_set, best = marcher.reference_set, attempted.best
    status = best.status(reference_set, request.rtol)
    if attempted.limit is not None and status is not Status.CONVERGED:
        status = attempted.limit
    narrower: list[Note] = []
    with stages.of("check"), persisting(kept_back):
        with suppress(OutOfBudgetError):
            narrower = _narrowed(marcher, status, best, request, stages)
        try:
            status, cause = marcher.explained(status, best)
        except OutOfBudgetError:
            cause = None
        if status is Status.NARROW:
            cause = best.hidden
    remedy = {**_REMEDIES, **marcher.remedies}.get(status)
    remedy = cause.remedy if isinstance(cause, HiddenRate) else remedy
    notes: list[Note] = []
    if status is not Status.NARROW:
        notes += error_notes(request.rtol, best.measured, reference_set.names)
    if status is not Status.CONVERGED:
        if best.result.stopped is None:
            notes += unknowns_notes(request.rtol, best.measured, reference_set.names)
        elif best.result.whole:
            notes.append(NothingInterpolated())
        elif system.clock is None:
            end = float(best.result.slabs[-1].end) if best.result.slabs else None
            notes.append(StoppedAt(end))
    if status is Status.MEMORY_LIMIT and attempted.memory_needed is not None:
        notes.append(attempted.memory_needed)
    with suppress(OutOfBudgetError):
        if status in (Status.MEMORY_LIMIT, Status.WORK_LIMIT):
            notes += TinyUnknowns.of(system, reference_set.largest, reference_set.asked)
        notes += reference_set.shared
    notes += reference_set.zeros
    if status is not Status.CONVERGED:
        notes += () if status is Status.NARROW else Budget.of(stages.named, stages.budget)
        if not (isinstance(cause, SteepParameter) and cause.jump):
            notes += narrower
        notes += [] if remedy is None else [Remedy(remedy)]
    safe: tuple[SafeInterval, ...] = ()
    blow_up, switching = reference_set.blow_up, reference_set.reference.switching
    if blow_up is not None and switching is None:
        with stages.of("reference"):
            safe = safe_intervals(system, request.domain, reference_set.cuts, np.array(blow_up[1]))
    return Outcome(
        slabs=tuple(best.result.slabs),
        status=status,
        measured=best.measured,
        history=tuple(_with_integrator(attempted.records, reference_set, stages)),
        timings=stages.timings,
        work=stages.work,
        blow_up=blow_up,
        safe=safe,
        switching=switching,
        cause=cause,
        notes=tuple(notes),
        observed=reference_set.observed is not None,
    )


def _with_integrator(
    records: Sequence[SlabRecord], reference_set: ReferenceSet, stages: Stages
) -> Sequence[SlabRecord]:
    """The records with the integrator of the reference, where no trajectories were sampled."""
    if stages.sampled:
        return records
    return [replace(record, integrator=reference_set.reference.integrator) for record in records]


def _narrowed(
    marcher: Marcher, status: Status, best: Attempt, request: SolveRequest, stages: Stages
) -> list[Note]:
    """The parameters to narrow, where that is predicted to help."""
    reference_set, result = marcher.reference_set, best.result
    if status not in _NARROWED or not reference_set.domain.box:
        return []
    work, missed = SOLVE.unfinished_work_share * stages.work["march"], 1.0
    if result.stopped is None and result.slabs:
        work = best.work
        bases, spectra = result.slabs[-1].bases, spectra_of(result.slabs, reference_set.states)
        tails = [basis.tail(s) for basis, s in zip(bases, spectra, strict=True)]
        missed = max(best.error / max(max(tails), TINY), 1.0)
        modes = list(zip(bases, spectra, strict=True))
    else:
        modes = marcher.modes_on_lines()
    if not modes or not missed < SOLVE.unexplained_error:
        return []
    resolutions = [Resolution.of(basis, missed * s, request.rtol) for basis, s in modes]
    names = reference_set.system.parameters
    box = narrowed_box(names, resolutions, work, stages.budget)
    return [] if box is None else [box]


def out_at_reference(
    out: OutOfBudgetError,
    system: System,
    stages: Stages,
    asked: Collection[int] | None = None,
) -> Outcome:
    """The outcome when a limit is met by the reference; all states are ``asked`` for if None."""
    status, switching = Status.of_limit(out), None
    cause: Cause | None = ReferenceLimit()
    if out.reached is not None:
        switching = out.reached.chattering
        name = None if switching is None else system.states[switching]
        cause = ReferenceLimit(float(out.reached.time), out.reached.steps, name)
    begun = out.reached is None or out.reached.steps > 0
    notes: list[Note] = [*Budget.of(stages.work, stages.budget)] if begun else []
    if (memory_needed := MemoryNeeded.of(out)) is not None:
        cause, notes = None, [memory_needed]
    if out.sizes is not None:
        notes += TinyUnknowns.of(system, out.sizes, asked)
    if switching is None:
        notes.append(Remedy(_REMEDIES[status]))
    ended = Outcome((), status, None, (), stages.timings, stages.work, switching=switching)
    return replace(ended, cause=cause, notes=tuple(notes))


def error_notes(rtol: float, measured: Measured | None, states: Sequence[str]) -> list[Note]:
    """The measured error, if there is one."""
    if measured is None:
        return []
    worst = states[measured.worst_first[0]] if len(measured.worst_first) > 1 else None
    corners = measured.corner_error
    counts = corners <= max(rtol, measured.error)
    return [MeasuredError(measured.error, rtol, worst, None if counts else corners)]


def unknowns_notes(rtol: float, measured: Measured | None, states: Sequence[str]) -> list[Note]:
    """Which unknowns are accurate enough, if others are not."""
    if measured is None:
        return []
    errors, order = measured.interior, measured.worst_first
    accurate = tuple(states[i] for i in sorted(order) if errors[i] <= rtol)
    inaccurate = tuple(states[i] for i in order if errors[i] > rtol)
    return [AccurateUnknowns(accurate, inaccurate)] if accurate and inaccurate else []


@dataclass(frozen=True)
class _Attempts:
    """The best of several attempts, and the records of all.

    They ended at a ``limit`` of the solve, if there is one. The last one met the limit on memory if
    it has a ``memory_needed``.
    """

    best: Attempt
    records: Sequence[SlabRecord]
    limit: Status | None
    memory_needed: MemoryNeeded | None


def _attempts(
    marcher: Marcher, rtol: float, options: Options, report: Report, stages: Stages
) -> _Attempts:
    """March and check until the measured error fits, or there is nothing left to try."""
    records: list[SlabRecord] = []
    best: Attempt | None = None
    progress, limit, work = Progress(), None, 0.0
    for index in itertools.count():
        marched = stages.work["march"]
        with stages.of("march"), progress.going_on(work, rtol):
            try:
                result = marcher.march(index, report)
            except MemoryError:
                result = MarchResult(stopped=Status.MEMORY_LIMIT)
            except OutOfBudgetError as out:
                result = MarchResult()
                result.stop(out)
        if marcher.reference_set.system.clock is not None and result.stopped and not result.whole:
            result.slabs = []  # without all stretches there is no clock time
        records += result.records
        stages.sampled += result.sampled
        before = marcher.reference_set
        with stages.of("check"), persisting():
            work = stages.work["march"] - marched
            attempt = Attempt(result, measure(before, result.slabs), work)
            try:
                further = _further_points(before, attempt, rtol, index)
                if further is not None:
                    marcher.reference_set = before.with_points(further)
            except OutOfBudgetError as out:  # the attempt was not measured at all points
                result.stop(out)
            if marcher.reference_set is not before:
                attempt = attempt.measured_by(marcher.reference_set)
            attempt = _confirmed(marcher, attempt, rtol)
            if marcher.reference_set is not before:
                best = best and best.measured_by(marcher.reference_set)
        if marcher.reference_set.end < before.end:  # a trajectory ends earlier than was known
            best = None
            continue
        progress.add(attempt.error, best.error if best else math.inf)
        best = attempt if attempt.hidden or attempt.better_than(best) else best
        limit = result.stopped if result.stopped in _LIMITS_OF_THE_SOLVE else None
        done = result.stopped or attempt.hidden or not before.checked or attempt.error <= rtol
        most = options.max_attempts
        if most is None and not progress.pays:
            most = options.usual_attempts
        if done or (most is not None and index + 1 >= most):
            break
        with progress.going_on(work, rtol):
            if not marcher.refine(attempt, progress):
                break
            if LEAST_COST_RATIO * work > work_left():
                limit = Status.WORK_LIMIT  # the next attempt would not come to its end
                break
    if best is None:
        best = Attempt(MarchResult(stopped=Status.NO_CONVERGENCE), None)
    with persisting(EXPLANATION_SHARE * budget_left()):
        best = _restated(best, marcher.reference_set, rtol)
    return _Attempts(best, records, limit, result.memory_needed)


def _restated(best: Attempt, reference_set: ReferenceSet, rtol: float) -> Attempt:
    """A failed attempt, measured again where its error is likely to be worst."""
    if not best.result.slabs or not rtol < best.error < math.inf:
        return best
    try:
        doubtful = worst_points(reference_set, best.result.slabs, best.error / rtol, rtol, -1)
        stricter = reference_set if doubtful is None else reference_set.with_points(doubtful)
    except OutOfBudgetError:
        return best
    if stricter is reference_set or stricter.end < reference_set.end:
        return best
    return best.measured_by(stricter)


def _confirmed(marcher: Marcher, attempt: Attempt, rtol: float) -> Attempt:
    """A good attempt, measured against finer trajectories where these leave the reference."""
    if attempt.result.stopped or attempt.error > rtol:
        return attempt
    try:
        reference_set, hidden = confirmed(marcher.reference_set)
    except OutOfBudgetError as out:  # whether the reference is right is not known
        attempt.result.stop(out)
        return attempt
    if reference_set is marcher.reference_set:
        return attempt
    marcher.reference_set = reference_set
    return replace(attempt.measured_by(reference_set), hidden=hidden)


def _further_points(
    reference_set: ReferenceSet, attempt: Attempt, rtol: float, number: int
) -> Array | None:
    """Further points at which to measure an attempt; None while its error is too large."""
    result = attempt.result
    if not result.stopped and attempt.error > rtol:
        return None
    further = [] if result.points is None else [result.points]
    if not result.stopped:
        share = attempt.error / rtol
        result.doubtful = worst_points(reference_set, result.slabs, share, rtol, number)
        further += [] if result.doubtful is None else [result.doubtful]
    return np.concatenate(further) if further else None
