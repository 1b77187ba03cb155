"""On which sides of its events' surfaces a trajectory is, and where it crosses them.

The surface of an event is where its ``when`` vanishes. A trajectory has a side of each: 1 or -1, or
0 as long as it is on the surface and nothing tells where it goes. Rounding never changes a side.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np
import scipy

from rankone.problem.numeric import NumericEvents
from rankone.support.arrays import EPSILON, ROUNDING, Array

SHARES = np.linspace(0.125, 1.0, 8)
"""Shares of a step at which it is looked on which side of a surface it is."""
_ROOT_ACCURACY = 4.0 * EPSILON  # Relative accuracy of times: a few roundings
_HALVINGS = 60  # Of a sample's distance from the start of a step, in search of a short excursion


def first_change(
    cells: Callable[[float], tuple[float, ...]], start: float, end: float
) -> float | None:
    """When what is constant between jumps first differs from the start of a step; None if never.

    The time is right behind the jump.
    """
    first, before = cells(start), start
    for behind in (start + (end - start) * SHARES).tolist():
        if cells(behind) != first:
            break
        before = behind
    else:
        return None
    middle = 0.5 * (before + behind)
    while before < middle < behind:
        before, behind = (middle, behind) if cells(middle) == first else (before, middle)
        middle = 0.5 * (before + behind)
    return float(behind)


class Crossing(NamedTuple):
    """When a trajectory crosses the surface of an event, by its index, and to which side.

    It is ``unresolved`` if the trajectory came from that surface, was never seen beside it, and
    still moves away from it, by its rates: the flight is below the tolerance of the steps.
    """

    time: float
    event: int
    side: int
    unresolved: bool = False


class Sides:
    """The sides of one trajectory with parameters (d,)."""

    def __init__(self, events: NumericEvents, point: Array) -> None:
        self.events, self.point = events, point
        self.sides = np.zeros(len(events), dtype=int)
        self._before = np.zeros(len(events), dtype=int)  # sides before the last return to a surface
        self._expected = np.zeros(len(events), dtype=bool)  # sides that only rates have told
        self._sightings: list[tuple[float, int, int]] = []  # times, events and sides of a step

    def settle(
        self,
        time: float,
        state: Array,
        rates: Array,
        unmoved: Collection[int] = (),
        moving: Collection[int] = (),
    ) -> list[int]:
        """Take the sides after the start or a reset; return the events that it sets off.

        A trajectory that is on a surface goes to the side that its rates tell, and that is no
        crossing. ``unmoved`` are events whose surface it is on, whatever rounding says. Where it
        was ``moving`` before a reset, and is at rest now, it is on the side that it came from.
        """
        slopes = self.events.slopes(time, rates, state, self.point)
        sides = self.beside(time, state, rates)
        crossed = []
        for k, slope in enumerate(slopes):
            side = 0 if k in unmoved else int(sides[k])
            if side == 0 and self.sides[k] == 0:
                at_rest = slope == 0.0 and k in moving
                self.sides[k] = self._before[k] if at_rest else np.sign(np.nan_to_num(slope))
                self._expected[k] = True
            elif side != 0:
                if self.sides[k] == -side and self.events.counts(k, side):
                    crossed.append(k)
                self.sides[k], self._expected[k] = side, False
        return crossed

    def beside(self, time: float, state: Array, rates: Array) -> Array:
        """The sides of surfaces that a state is on (events,), 0 for those that it is on itself."""
        heights = self.events.when(time, state, self.point)
        slopes = self.events.slopes(time, rates, state, self.point)
        noise = self.events.noise(time, state, self.point, np.abs(state))
        definite = np.abs(heights) > noise + ROUNDING * np.abs(np.nan_to_num(slopes) * time)
        return np.where(definite, np.sign(heights), 0.0)

    def crossings(
        self,
        path: Callable[[Array], Array],
        start: float,
        end: float,
        rates: Callable[[float, Array], Array],
    ) -> list[Crossing]:
        """All crossings of a step, in order; :meth:`pass_until` takes the sides after them."""

        def leaves(time: float, event: int, side: int) -> bool:
            state = path(np.array([time]))[:, 0]
            slopes = self.events.slopes(time, rates(time, state), state, self.point)
            return float(slopes[event]) * side > 0.0

        times = start + (end - start) * SHARES
        states = path(times)
        heights = np.array(
            [self.events.when(at, y, self.point) for at, y in zip(times, states.T, strict=True)]
        )
        largest = np.abs(states).max(axis=1)
        noise = self.events.noise(end, states[:, -1], self.point, largest)
        crossings: list[Crossing] = []
        self._sightings = []
        for k, side in enumerate(self.sides.tolist()):
            left, expected = start, bool(self._expected[k])
            for at, height in zip(times.tolist(), heights[:, k].tolist(), strict=True):
                if not abs(height) > noise[k]:
                    continue
                if height * side < 0.0:
                    root = self._root(path, k, side, left, at)
                    unresolved = expected and (root == start or leaves(root, k, side))
                    crossings.append(Crossing(root, k, -side, unresolved))
                side, left, expected = int(np.sign(height)), at, False
                self._sightings.append((at, k, side))
        self._sightings += [
            (crossing.time, crossing.event, crossing.side) for crossing in crossings
        ]
        return sorted(crossings)

    def pass_until(self, time: float) -> None:
        """Take the sides that a trajectory has at a time of the last step."""
        for at, k, side in sorted(self._sightings):
            if at <= time:
                self.sides[k], self._expected[k] = side, False

    def ahead(self, time: float, state: Array, rates: Array) -> dict[int, float]:
        """The interrupting events that a straight path crosses, and how long that takes."""
        heights = self.events.when(time, state, self.point)
        slopes = self.events.slopes(time, rates, state, self.point)
        return {
            k: max(-float(height / slope), 0.0)
            for k, (height, slope) in enumerate(zip(heights, slopes, strict=True))
            if self.sides[k] * slope < 0.0
            and self.events.interrupts(k)
            and self.events.counts(k, -int(self.sides[k]))
        }

    def return_to(self, events: Collection[int]) -> None:
        """The trajectory is on the surfaces of events."""
        self._before = self.sides.copy()
        self.sides[list(events)] = 0

    def _root(
        self, path: Callable[[Array], Array], event: int, side: int, left: float, right: float
    ) -> float:
        """Where a surface is crossed from a side to the other one, which the right end is on."""

        def height(time: float) -> float:
            state = path(np.array([time]))[:, 0]
            return float(self.events.when(time, state, self.point)[event])

        # the left end may be on the surface itself
        distances = (right - left) * 0.5 ** np.arange(_HALVINGS)
        for at in (left, *(left + distances[1:]).tolist()):
            if height(at) * side > 0.0:
                size = _ROOT_ACCURACY * max(abs(at), abs(right), right - left)
                root = scipy.optimize.brentq(height, at, right, xtol=size, rtol=_ROOT_ACCURACY)
                return float(root)
        return left
