"""Short steps over a step of a reference that has surprised: whether they change the trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import solve_ivp

from rankone.ir.system import System
from rankone.ir.verdict import HiddenRate
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import Cost
from rankone.verification.steps import CHANGED, Pieces, Place, Steps

_DIFFERENCE = 0.3  # Difference to a trajectory by short steps, over the tolerance, that matters
_SHORT_STEPS = 4  # Steps over each part of a step, at least
_ACCURACY = 1e-2  # Tolerance of short steps over that of the solve
_MOST_EVALUATIONS = 20_000  # Of the rates by short steps over a step
_TWICE = 2.0  # How long a state is followed that may stay behind, over what it takes to tell


class _TooManyError(Exception):
    """Short steps take too many evaluations."""


@dataclass
class _ShortTrajectory:
    """A trajectory by short steps: its state (n,), and the evaluations that it took."""

    system: System
    cost: Cost
    parameters: Array
    tolerances: tuple[float, Array]
    state: Array
    evaluations: int = 0

    def goes_on(self, start: float, length: float, part: float) -> bool:
        """Whether it goes on from a time over a length, by several steps over each such part."""
        relative, absolute = self.tolerances
        try:
            solved = solve_ivp(
                lambda since, y: self.rates(start + since, y),
                (0.0, length),
                self.state,
                "LSODA",
                rtol=relative,
                atol=absolute,
                max_step=part / _SHORT_STEPS,
            )
        except _TooManyError:
            return False
        self.state = solved.y[:, -1]
        return bool(solved.success)

    def rates(self, time: float, state: Array) -> Array:
        """The rates (n,) of a state."""
        self.evaluations += 1
        if self.evaluations > _MOST_EVALUATIONS:
            raise _TooManyError
        charge(self.cost(1))
        return np.asarray(self.system.rhs(time, state[:, None], self.parameters))[:, 0]


@dataclass(frozen=True)
class ShortSteps:
    """Tries whether short steps follow a trajectory over a step that has surprised."""

    system: System
    cost: Cost
    steps: Steps
    tolerated: Array
    rtol: float

    def change(self, place: Place, parts: Array) -> tuple[Place | None, int]:
        """Where they leave it, or do not go on; and how many evaluations that took.

        They begin anew where ``parts``, between shares of the step, become longer or shorter, and
        where rates surprised, at the very state that did: what is narrow there may be thinner than
        the parts, and than the difference to a trajectory by short steps.
        """
        begins, longest = self._begins(place, parts)
        ends = np.append(begins[1:], 1.0)
        start, length = self.steps.starts[place.step], self.steps.lengths[place.step]
        whole = Pieces(np.full(begins.size, place.step), begins, ends - begins)
        states = self.steps.at(whole)[1]
        short = self._begun(place.step, states[:, 0, 0])
        for k, (a, b) in enumerate(zip(begins, ends, strict=True)):
            span = float(start + length * a), float(length * (b - a)), float(longest[k] * length)
            at_surprise = replace(short, state=states[:, 0, k]) if a == place.share else short
            if at_surprise.goes_on(*span):
                short = at_surprise
            elif at_surprise is short or not short.goes_on(*span):  # it may not begin in a peak
                return place, short.evaluations
            row = self._left(short.state, states[:, -1, k])
            if row is not None:
                share, part = float(a), float(b - a)
                left = Place(place.step, share, part, share + 0.5 * part, row)
                return left, short.evaluations
        return self._change_behind(place, short), short.evaluations

    def _begun(self, step: int, state: Array) -> _ShortTrajectory:
        """A trajectory that begins at a state (n,) of a step."""
        relative = max(_ACCURACY * self.rtol, 1e-12)
        absolute = np.maximum(_ACCURACY * relative * self.tolerated / self.rtol, 1e-300)
        p = self.steps.parameters[:, step : step + 1]
        return _ShortTrajectory(self.system, self.cost, p, (relative, absolute), state)

    def _left(self, state: Array, expected: Array) -> int | None:
        """The state that differs most from what is expected, (n,) both, if that matters."""
        change = np.abs(state - expected) / self.tolerated
        if (change <= _DIFFERENCE).all():
            return None
        return int(np.nan_to_num(change, nan=np.inf).argmax())

    def _change_behind(self, place: Place, short: _ShortTrajectory) -> Place | None:
        """Where short steps leave the trajectory behind a step at whose end rates differ.

        Steps may be so short that a state has not stayed behind by much so far.
        """
        step = place.step
        end = self.steps.time(step, 1.0)
        until = end + self._needed(step, short)
        following = self._following(step)
        while end < until and following is not None:
            start, length = self.steps.starts[following], self.steps.lengths[following]
            if not short.goes_on(float(start), float(length), float(length)):
                return place
            row = self._left(short.state, self.steps.nodal[following, -1])
            if row is not None:
                return Place(following, 0.0, 1.0, 0.5, row)
            end = self.steps.time(following, 1.0)
            following = self._following(following)
        return None

    def _following(self, step: int) -> int | None:
        """The step that goes on where one ends, without a jump of the states."""
        following = self.steps.following(step)
        if following is None:
            return None
        jump = np.abs(self.steps.nodal[following, 0] - self.steps.nodal[step, -1])
        return following if (jump <= _ACCURACY * self.tolerated).all() else None

    def _needed(self, step: int, short: _ShortTrajectory) -> float:
        """How long it takes to tell whether a state goes on otherwise at the end of a step."""
        end, left = self.steps.time(step, 1.0), self.steps.left[step] - self.steps.lengths[step]
        rates = short.rates(end, self.steps.nodal[step, -1])
        apart = np.abs(short.rates(end, short.state) - rates)
        apart = np.where(apart > CHANGED * np.abs(rates), apart, 0.0)
        times = _TWICE * _DIFFERENCE * self.tolerated / apart
        return float(times[times < left].max(initial=0.0))

    @staticmethod
    def _begins(place: Place, parts: Array) -> tuple[Array, Array]:
        """Shares of the step where short steps begin anew, and the parts that they are within."""
        lengths = np.diff(parts)
        firsts = np.flatnonzero(np.append(True, np.abs(np.diff(lengths)) > 0.1 * lengths[1:]))
        begins, longest = parts[firsts], lengths[firsts]
        before = int(np.searchsorted(begins, place.share, side="right")) - 1
        if begins[before] == place.share or place.share >= 1.0:
            return begins, longest
        begins = np.insert(begins, before + 1, place.share)
        return begins, np.insert(longest, before + 1, longest[before])

    def hidden(self, place: Place) -> HiddenRate:
        """What to say of a place."""
        parameters = self.steps.parameters[:, place.step].tolist()
        at = zip(self.system.parameters, parameters, strict=True)
        time = self.steps.time(place.step, place.share)
        return HiddenRate(self.system.states[place.row], time, tuple(at))
