"""One attempt after the other: reference, march, check, tighten, until the measured error fits."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
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
from rankone.system import Recipe, System

__all__ = ["Attempt", "Marcher", "solve_in_attempts"]

_LONGEST = 20.0
"""Seconds after which the reference is given up, and the attempts together, if no time limit was
asked for; as long may the reference at further points take."""
_SLOW = 10.0
"""They are longer by this where functions of the user are called, which may be slow."""
_STALLED = 0.7
"""An attempt that leaves more of the error of the best one before has stalled."""
_CAUSES = (Status.NO_CONVERGENCE, *(s for s in Status if s is not Status.NO_CONVERGENCE))
"""Limits in the order in which they explain a failure."""


@dataclass(frozen=True)
class Attempt:
    """What one pass over the horizon came to."""

    result: MarchResult
    measured: Measured | None

    @property
    def error(self) -> float:
        """Largest measured error; infinite if there is none."""
        if self.measured is None:
            return math.inf
        return max(self.measured.interior, default=0.0)

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
            figures = f"{self.error:.1e} of {rtol:.1e}"
            if status is not Status.CONVERGED:
                figures = f"measured error {self.error:.1e}, asked {rtol:.1e}"
            text += f": {figures}"
            corner = max(self.measured.corners, default=0.0)
            if corner > max(rtol, self.error):
                text += f" (up to {corner:.1e} at the corners of the box)"
        if self.result.stopped is not None:
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

    ``prepared`` makes the marcher from the request and its yardstick.
    """
    timings = {"reference": 0.0, "march": 0.0, "check": 0.0}
    records: list[SlabRecord] = []
    best: Attempt | None = None
    stalls, out_of_time = 0, False
    recipe: Recipe | None = getattr(system, "RECIPE", None)
    slow = _SLOW if recipe is not None and recipe.namespace else 1.0
    began = clock.perf_counter()
    try:
        with _timed(timings, "reference"), _unless_asked(slow * _LONGEST):
            yardstick = Yardstick.of(system, domain, request.rtol, request.points)
            marcher = prepared(request, yardstick)
            marcher.yardstick = yardstick
    except OutOfTimeError as out:
        message = f"{Status.TIME_LIMIT.value} by the reference trajectories"
        if out.args:
            message += ", at t = {:.6g} after {} steps".format(*out.args)
        message += "; raise max_seconds, or smooth what switches back and forth"
        return Outcome((), Status.TIME_LIMIT, message, None, (), timings)
    for index in range(request.options.max_attempts):
        left = slow * _LONGEST - (clock.perf_counter() - began)
        with _timed(timings, "march"), _unless_asked(left):
            result = marcher.march(index, report)
        before = marcher.yardstick
        with _timed(timings, "check"):
            attempt = Attempt(result, before.measured(result.slabs))
            points = _further_points(before, attempt, request.rtol, index)
            if points is not None:
                try:
                    with _unless_asked(slow * _LONGEST):
                        marcher.yardstick = before.with_points(points)
                except OutOfTimeError:  # not measured where it must be
                    result.stopped = Status.TIME_LIMIT
                attempt = Attempt(result, marcher.yardstick.measured(result.slabs))
                if best is not None:
                    best = Attempt(best.result, marcher.yardstick.measured(best.result.slabs))
        records += result.records
        if marcher.yardstick.end < before.end:  # a trajectory ends earlier than was known
            best = None
            continue
        stalls = stalls + 1 if best and attempt.error > _STALLED * best.error else 0
        best = attempt if attempt.better_than(best) else best
        out_of_time = result.stopped is Status.TIME_LIMIT
        done = result.stopped or not before.checked or attempt.error <= request.rtol
        if done or not marcher.refine(attempt, stalls):
            break
        if clock.perf_counter() - began > slow * _LONGEST and math.isinf(seconds_left()):
            out_of_time = True
            break
    yardstick = marcher.yardstick
    if best is None:
        best = Attempt(MarchResult(stopped=Status.NO_CONVERGENCE), None)
    status = best.status(yardstick, request.rtol)
    if out_of_time and status is not Status.CONVERGED:
        status = Status.TIME_LIMIT
    status, cause = marcher.explained(status, best)
    message = best.message(status, request.rtol, cause)
    remedies = {Status.TIME_LIMIT: "raise max_seconds", **marcher.remedies}
    if status in remedies:
        message += f"; {remedies[status]}"
    slabs, blow_up = tuple(best.result.slabs), yardstick.blow_up
    return Outcome(slabs, status, message, best.measured, tuple(records), timings, blow_up)


def _further_points(
    yardstick: Yardstick, attempt: Attempt, rtol: float, number: int
) -> Array | None:
    """Points at which an attempt is to be measured too; None while it is not good enough."""
    result = attempt.result
    if not result.stopped and attempt.error > rtol:
        return None
    given = [] if result.points is None else [result.points]
    if not result.stopped:
        doubtful = doubtful_points(yardstick, result.slabs, attempt.error / rtol, rtol, number)
        given += [] if doubtful is None else [doubtful]
    return np.concatenate(given) if given else None


def _unless_asked(seconds: float) -> AbstractContextManager[None]:
    """A time limit that holds only if there is no other."""
    return time_limit(seconds if math.isinf(seconds_left()) else None)


@contextmanager
def _timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    began = clock.perf_counter()
    yield
    timings[stage] += clock.perf_counter() - began
