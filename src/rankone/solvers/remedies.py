"""What to do about a solve that is refused: a remedy is tried before it is offered.

The same solve is tried at a looser tolerance, on smaller boxes, and up to earlier ends, each with
a part of what is left. A box that is predicted, and not tried for lack of work, comes last.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.ir.measures import Interval, on_scale
from rankone.ir.outcome import Outcome
from rankone.ir.request import SolveRequest
from rankone.ir.verdict import NarrowBox, Note, NothingInterpolated, Remedy, Status, SteepParameter
from rankone.solvers.one_order import inside, narrowing_text
from rankone.support.budget import budget_left, limited
from rankone.support.errors import ConvergenceError
from rankone.trajectories.events.event_order import OrderError, TrajectoryEndError

_WORST = 0.02  # Largest error of a solution that is offered
_MARGIN = 1.5  # A looser tolerance over the error that was measured, at least
_LOOSER = 1e-2  # Tolerance that is tried where no attempt meets a tighter one
_HALF = 0.5  # Part of what is left that goes into one kind of remedy if others follow
_EACH = 0.25  # Part of that which one box may take
_FIRST_ENDS = (1 / 64, 1 / 512)  # Parts of the horizon, in turn up to a success
_LATER_ENDS = (2.0, 4.0, 8.0, 16.0, 32.0, 48.0)  # Times this part, in turn up to a failure
_DIGITS = 3  # Significant digits of an end
_SMALLER = (1.0, 0.5, 0.25)  # Parts of predicted intervals, around their middles
_BESIDE = (0.35, 0.65)  # Distances from a front, over the interval beside it
_AROUND = 0.15  # Distance from a front's other parameters, over their intervals, if it moves
_NO_REMEDY = (
    Status.CONVERGED,
    Status.UNCHECKED,
    Status.NARROW,
    Status.TIME_LIMIT,
    *(s for s in Status if s.ends_early),
)

# Limits that a user may raise as well
_RAISED = (
    Status.WORK_LIMIT,
    Status.MEMORY_LIMIT,
    Status.RANK_LIMIT,
    Status.NODE_LIMIT,
    Status.SLAB_LIMIT,
    Status.TRAJECTORY_LIMIT,
)

TriedSolve = Callable[[SolveRequest], Outcome | None]
"""The outcome of another request; None if that ends in an error."""
Intervals = Mapping[int, Interval]


def remedied(outcome: Outcome, request: SolveRequest, trials: Trials) -> Outcome:
    """The outcome of a request with a remedy that holds, if one is found.

    With the slabs of a looser solve that succeeds where no attempt came as close. A box that is
    predicted stays unless the solve fails there too.
    """
    if outcome.status in _NO_REMEDY:
        return outcome
    for rtol in _looser_ones(outcome, request.rtol):
        if (solved := trials.looser(rtol)) is None:
            continue
        advice = f"try rtol={rtol:.0e}: it was solved to {solved.error:.1e}"
        if outcome.slabs and outcome.error <= solved.error:
            return _with_notes(outcome, Remedy(advice))
        outcome = _with_notes(outcome, Remedy(advice), NothingInterpolated)
        return replace(
            outcome,
            slabs=solved.slabs,
            measured=solved.measured,
            timeline=solved.timeline,
            observed=solved.observed,
        )
    box, fails = trials.smaller(outcome)
    if box is not None:
        return _with_notes(outcome, box, NarrowBox)
    outcome = _without_notes(outcome, NarrowBox) if fails else outcome
    end = trials.end()
    return outcome if end is None else _with_notes(outcome, Remedy(_end_text(end)))


def remedied_error(error: ConvergenceError, trials: Trials) -> ConvergenceError:
    """An error that was raised in place of an outcome, with a remedy that holds if one is found."""
    if isinstance(error, OrderError) and not isinstance(error, TrajectoryEndError):
        domain, whole = trials.request.domain, error.part is None
        # the middle of a whole box has fewer orders, if not one alone
        intervals = dict(enumerate(error.part or domain.box))
        box, _ = trials.first_box(trials.shrunk(intervals, _SMALLER[whole:]))
        if box is not None:
            error.part = tuple(box.get(j, ends) for j, ends in enumerate(domain.box))
            narrowed = narrowing_text(trials.names, domain.bounds, error.part)
            error.remedy = f"narrow {narrowed}: it was solved there"
            return error
    if (end := trials.end()) is not None:
        error.remedy = _end_text(end)
    return error


@dataclass(frozen=True)
class Trials:
    """Solves of a request with changes; ``trial`` makes them, ``names`` are of the parameters."""

    request: SolveRequest
    names: Sequence[str]
    trial: TriedSolve

    def looser(self, rtol: float) -> Outcome | None:
        """The outcome at a looser tolerance; None without success."""
        with limited(_HALF * budget_left()):
            outcome = self.trial(replace(self.request, rtol=rtol))
        return outcome if _succeeds(outcome) else None

    def smaller(self, outcome: Outcome) -> tuple[NarrowBox | None, bool]:
        """A smaller box: beside a front, or a part of the one that is predicted.

        Without success whether it fails in the first one, and not for lack of work.
        """
        cause, predicted = outcome.cause, outcome.verdict.narrower
        boxes: Iterator[Intervals] = iter(())
        if isinstance(cause, SteepParameter):
            boxes = self._beside(cause)
        elif predicted:
            boxes = self.shrunk({self.names.index(name): predicted[name] for name in predicted})
        with limited(_HALF * budget_left()):
            box, fails = self.first_box(boxes)
        if box is None:
            return None, fails
        intervals = tuple((self.names[j], *ends) for j, ends in sorted(box.items()))
        return NarrowBox(intervals, tried=True), False

    def first_box(self, boxes: Iterator[Intervals]) -> tuple[Intervals | None, bool]:
        """The first box with a success; or whether the first one fails, not for lack of work."""
        most, fails = _EACH * budget_left(), list[bool]()
        for box in boxes:
            with limited(most):
                outcome = self.trial(self.request.on_box(box, 1.0))
            if _succeeds(outcome):
                return box, False
            fails.append(outcome is not None and outcome.status is not Status.WORK_LIMIT)
        return None, any(fails[:1])

    def end(self) -> float | None:
        """The latest end of the horizon with a success, of some."""
        start, end = self.request.domain.horizon
        length = end - start

        def solved(share: float) -> float | None:
            digits = _DIGITS - 1 - math.floor(math.log10(max(abs(start), share * length)))
            earlier = round(start + share * length, digits)
            domain = replace(self.request.domain, horizon=(start, earlier))
            later = (earlier > start and self.trial(replace(self.request, domain=domain))) or None
            return earlier if _succeeds(later) else None

        for first in _FIRST_ENDS:
            with limited(_HALF * budget_left()):
                latest = solved(first)
            if latest is None:
                continue
            for times in _LATER_ENDS:
                later = solved(times * first)
                if later is None:
                    break
                latest = later
            return latest
        return None

    def shrunk(
        self, intervals: Intervals, parts: Sequence[float] = _SMALLER
    ) -> Iterator[Intervals]:
        """Intervals, and parts around their middles."""
        for part in parts:
            shares = 0.5 + np.array([-0.5, 0.5]) * part
            yield {j: self._part(j, ends, shares) for j, ends in intervals.items()}

    def _beside(self, front: SteepParameter) -> Iterator[Intervals]:
        """Intervals on both sides of a front, also where it moves with other parameters."""
        j = self.names.index(front.parameter)
        whole = self.request.domain.box[j]
        below, above = (whole[0], front.lower), (front.upper, whole[1])
        others: dict[int, Interval] = {}
        for name, value in front.others:
            i = self.names.index(name)
            lower, upper = self.request.domain.box[i]
            width = _AROUND * (upper - lower)
            around = max(lower, value - width), min(upper, value + width)
            others[i] = self._part(i, around, np.array([0.0, 1.0]))
        for distance in _BESIDE:
            for beside in (dict[int, Interval](), others) if others else ({},):
                sides = (below, (0.0, 1.0 - distance)), (above, (distance, 1.0))
                for ends, shares in sorted(sides, key=lambda side: side[0][0] - side[0][1]):
                    if ends[0] < ends[1]:
                        yield {j: self._part(j, ends, np.array(shares)), **beside}

    def _part(self, j: int, ends: Interval, shares: np.ndarray) -> Interval:
        """A part of an interval of a parameter with ends of few digits, which are those told."""
        scale, whole = self.request.domain.first_coordinates[j], self.request.domain.box[j]
        lower, upper = on_scale(scale, ends, shares).tolist()
        low, high = inside((lower, upper))
        return (lower if lower == whole[0] else low), (upper if upper == whole[1] else high)


def _succeeds(outcome: Outcome | None) -> bool:
    return outcome is not None and outcome.status is Status.CONVERGED


def _looser_ones(outcome: Outcome, rtol: float) -> list[float]:
    """Looser tolerances to try: of one digit that the measured error meets with some margin."""
    front, error = outcome.cause, outcome.error
    tolerances = [_LOOSER] if rtol < _LOOSER and not isinstance(front, SteepParameter) else []
    jumps = isinstance(front, SteepParameter) and front.jump
    if jumps or not outcome.slabs or not 0.0 < error <= _WORST:
        return tolerances
    unit = 10.0 ** math.floor(math.log10(_MARGIN * error))
    met = float(f"{math.ceil(_MARGIN * error / unit) * unit:.0e}")
    return [met, *(each for each in tolerances if each > met)] if met > rtol else tolerances


def _end_text(end: float) -> str:
    return f"end the horizon before t = {end:g}: it was solved up to there"


def _with_notes(outcome: Outcome, told: Note, *instead: type[Note]) -> Outcome:
    """The outcome with a remedy in place of others, and of those that say less than it."""
    vague = () if outcome.status in _RAISED else (Remedy,)
    kept = _without_notes(outcome, *vague, *instead).notes
    predicted = tuple(note for note in kept if isinstance(note, NarrowBox))
    others = tuple(note for note in kept if not isinstance(note, NarrowBox))
    return replace(outcome, notes=(*others, told, *predicted))


def _without_notes(outcome: Outcome, *kinds: type[Note]) -> Outcome:
    """The outcome without notes of some kinds."""
    return replace(outcome, notes=tuple(n for n in outcome.notes if not isinstance(n, kinds)))
