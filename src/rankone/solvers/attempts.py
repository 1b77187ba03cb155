"""One attempt after the other: reference, march, check, tighten, until the measured error fits."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from rankone.arrays import Array
from rankone.deadline import OutOfTimeError, seconds_left, time_limit
from rankone.domain import Domain
from rankone.progress import Report
from rankone.solvers.engine import Request
from rankone.solvers.march import MarchResult
from rankone.solvers.outcome import Measured, Outcome, SlabRecord, Status
from rankone.solvers.residual import doubtful_points
from rankone.solvers.verification import Yardstick
from rankone.system import System

__all__ = ["Attempt", "Marcher", "solve_in_attempts"]

_EXPLAINING, _SHARE = 5.0, 0.15
"""Seconds kept for saying why a solve failed, and their largest share of all."""
_LESS = "narrow the box, loosen rtol or take another method"
_MORE_TIME = "give more time by max_seconds"
_STALLED = 0.7
"""An attempt that leaves more of the error of the best one before has stalled."""
_CAUSES = (Status.NO_CONVERGENCE, *(s for s in Status if s is not Status.NO_CONVERGENCE))
"""Limits in the order in which they explain a failure."""
_OF_ALL = (Status.TIME_LIMIT, Status.TRAJECTORY_LIMIT, Status.MEMORY_LIMIT)
"""Limits that a later attempt may meet, although an earlier one is the best."""


@dataclass(frozen=True)
class Attempt:
    """What one pass over the horizon came to."""

    result: MarchResult
    measured: Measured | None

    @property
    def error(self) -> float:
        """Largest measured error; infinite if there is none."""
        return math.inf if self.measured is None else self.measured.error

    def better_than(self, other: Attempt | None) -> bool:
        """Whether to keep this attempt: it got further, or as far with a smaller error."""
        if other is None:
            return True
        if (self.result.stopped is None) != (other.result.stopped is None):
            return self.result.stopped is None
        return self.error < other.error

    def status(self, yardstick: Yardstick, rtol: float) -> Status:
        """How the solve ended, if this attempt is what it came to."""
        limits = [status for status in _CAUSES if status in self.result.limits]
        stopped = self.result.stopped
        if yardstick.reference.blown is not None:
            return Status.BLOW_UP if yardstick.reference.large else Status.LEAVES
        if stopped is not None:
            return limits[0] if stopped is Status.NO_CONVERGENCE and limits else stopped
        if not yardstick.checked:
            return Status.UNCHECKED
        if self.error <= rtol:
            return Status.CONVERGED
        return limits[0] if limits else Status.TOLERANCE

    def message(self, status: Status, rtol: float, cause: str) -> str:
        """The sentence a user reads: how it ended, the figures, and how far it came."""
        text, slabs = cause, self.result.slabs
        if self.measured is not None:
            corner = self.measured.corner_error
            worse = corner > max(rtol, self.error)
            if worse and status is Status.CONVERGED:
                text += " in the interior of the box"
            figures = f"{self.error:.1e} of {rtol:.1e}"
            if status is not Status.CONVERGED:
                figures = f"measured error {self.error:.1e}, asked {rtol:.1e}"
            text += f": {figures}"
            if worse:
                text += f" (up to {corner:.1e} at the corners, which cover='box' asks for too)"
        if self.result.stopped is not None and not self.result.whole:
            reached = f"at t = {slabs[-1].end:.6g}" if slabs else "before the first slab"
            text += f"; stopped {reached}"
        return text


class Marcher(Protocol):
    """What an engine supplies: marches over the horizon, each finer than the one before."""

    yardstick: Yardstick
    """Its end and its sizes; it may become stricter between two marches."""
    remedies: ClassVar[Mapping[Status, str]]
    """What to do, by how it ended."""

    def march(self, index: int, report: Report) -> MarchResult:
        """Solve the horizon; ``index`` counts the attempts from 0."""

    def refine(self, attempt: Attempt, stalls: int) -> bool:
        """Ask more of the next march; False when there is nothing left to try.

        ``stalls`` is the number of attempts in a row that hardly lowered the error.
        """

    def explained(self, status: Status, attempt: Attempt) -> tuple[Status, str]:
        """The status, or one that says more, and why it ended so."""
        return status, status.value


def solve_in_attempts(
    prepared: Callable[[Request[Any], Yardstick], Marcher],
    system: System,
    domain: Domain,
    request: Request[Any],
    report: Report,
) -> Outcome:
    """Integrate the reference, then march and check until the measured error fits.

    ``prepared`` makes the marcher from the request and its yardstick. A part of the time is kept
    for saying why it failed.
    """
    timings = {"reference": 0.0, "march": 0.0, "check": 0.0}
    left = seconds_left()
    with time_limit(left - min(_EXPLAINING, _SHARE * left)):
        try:
            with _timed(timings, "reference"):
                asked = request.rtol, request.points, request.cover, request.counted
                yardstick = Yardstick.of(system, domain, *asked)
                marcher = prepared(request, yardstick)
                marcher.yardstick = yardstick
        except OutOfTimeError as out:
            message = f"{Status.TIME_LIMIT.value} by the reference trajectories"
            if out.args:
                message += ", at t = {:.6g} after {} steps".format(*out.args)
            return Outcome((), Status.TIME_LIMIT, f"{message}; {_MORE_TIME}", None, (), timings)
        best, records, met = _attempts(marcher, request, report, timings)
    yardstick = marcher.yardstick
    status = best.status(yardstick, request.rtol)
    if met is not None and status is not Status.CONVERGED:
        status = met
    with _timed(timings, "check"):
        status, cause = marcher.explained(status, best)
    message = best.message(status, request.rtol, cause) + yardstick.zeros
    remedies = {Status.TIME_LIMIT: _MORE_TIME, Status.MEMORY_LIMIT: _LESS, **marcher.remedies}
    if status in remedies:
        message += f"; {remedies[status]}"
    slabs, blow_up = tuple(best.result.slabs), yardstick.blow_up
    return Outcome(slabs, status, message, best.measured, tuple(records), timings, blow_up)


def _attempts(
    marcher: Marcher, request: Request[Any], report: Report, timings: dict[str, float]
) -> tuple[Attempt, list[SlabRecord], Status | None]:
    """The best attempt, the records of all, and the limit of the whole solve that ended them."""
    records: list[SlabRecord] = []
    best: Attempt | None = None
    stalls, met = 0, None
    for index in range(request.options.max_attempts):
        with _timed(timings, "march"):
            try:
                result = marcher.march(index, report)
            except MemoryError:
                result = MarchResult(stopped=Status.MEMORY_LIMIT)
        records += result.records
        before = marcher.yardstick
        with _timed(timings, "check"):
            attempt = Attempt(result, before.measured(result.slabs))
            further = _further_points(before, attempt, request.rtol, index)
            if further is not None:
                try:
                    marcher.yardstick = before.with_points(further)
                except OutOfTimeError:  # not measured where it must be
                    result.stopped = Status.TIME_LIMIT
                attempt = Attempt(result, marcher.yardstick.measured(result.slabs))
                if best is not None:
                    best = Attempt(best.result, marcher.yardstick.measured(best.result.slabs))
        if marcher.yardstick.end < before.end:  # a trajectory ends earlier than was known
            best = None
            continue
        stalls = stalls + 1 if best and attempt.error > _STALLED * best.error else 0
        best = attempt if attempt.better_than(best) else best
        met = result.stopped if result.stopped in _OF_ALL else None
        done = result.stopped or not before.checked or attempt.error <= request.rtol
        if done or not marcher.refine(attempt, stalls):
            break
    if best is None:
        best = Attempt(MarchResult(stopped=Status.NO_CONVERGENCE), None)
    return _restated(best, marcher.yardstick, request.rtol), records, met


def _restated(best: Attempt, yardstick: Yardstick, rtol: float) -> Attempt:
    """A failure with the error that it has where it is worst, as far as that is easily found."""
    if not best.result.slabs or not rtol < best.error < math.inf:
        return best
    doubtful = doubtful_points(yardstick, best.result.slabs, best.error / rtol, rtol, -1)
    if doubtful is None:
        return best
    try:
        stricter = yardstick.with_points(doubtful)
    except OutOfTimeError:
        return best
    if stricter.end < yardstick.end:
        return best
    return Attempt(best.result, stricter.measured(best.result.slabs))


def _further_points(
    yardstick: Yardstick, attempt: Attempt, rtol: float, number: int
) -> Array | None:
    """Points at which an attempt is to be measured too; None while it is not good enough."""
    result = attempt.result
    if not result.stopped and attempt.error > rtol:
        return None
    given = [] if result.points is None else [result.points]
    if not result.stopped:
        share = attempt.error / rtol
        result.doubtful = doubtful_points(yardstick, result.slabs, share, rtol, number)
        given += [] if result.doubtful is None else [result.doubtful]
    return np.concatenate(given) if given else None


@contextmanager
def _timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    began = clock.perf_counter()
    yield
    timings[stage] += clock.perf_counter() - began
