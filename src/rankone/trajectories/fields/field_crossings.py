"""Events along trajectories of fields: where numbers of them cross zero, and what is reset.

They have the meaning of events of other systems: a start on a surface is no crossing, nor is going
on from it; a reset that jumps across a surface sets off its event; events of one instant happen in
the order of the list.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import scipy.sparse as ss

from rankone.support.arrays import COINCIDENT, EPSILON, MOST_ROUNDS, ROUNDING, TINY, Array
from rankone.support.budget import charge
from rankone.trajectories.fields.field_system import FieldSystem, Matrix
from rankone.trajectories.system.features import BOTH

_PLACES = 16  # Of a step, at which it is looked for crossings
_ROOM = 4.0  # Heights at a root that count as zero, over the one that it has
_FRESH = 3  # Steps after an event that tell nothing of the next one: they may pass over it
_AHEAD = 1e-6  # Change of the state over which it is looked where rates lead
_SHARES = np.linspace(0.0, 1.0, _PLACES + 1)[1:]


@dataclass(frozen=True)
class Occurred:
    """An event of a trajectory: its number, and when it was."""

    event: int
    time: float


class UnresolvedEventError(Exception):
    """Steps pass over what happens next to an event."""


class FieldCrossings:
    """The events of one trajectory at a point (d,), on the way.

    ``rates`` are those of the fields (N,) at a time and a state.
    """

    def __init__(
        self, system: FieldSystem, point: Array, rates: Callable[[float, Array], Array]
    ) -> None:
        self._system, self._point, self._events = system, point, system.events
        self._rates = rates
        start, end = system.horizon
        self._instant = COINCIDENT * (end - start)
        self._ahead = np.full(len(self._events), math.inf)
        if any(event.known is not None for event in self._events):
            times = system.known_times(point)
            for k, event in enumerate(self._events):
                if event.known is not None and times[event.known] >= start - self._instant:
                    self._ahead[k] = max(float(times[event.known]), start)
        self._watched = [k for k, event in enumerate(self._events) if event.known is None]
        self._rows, self._places = self._stacked()
        self._absolute = abs(self._rows)
        self._sides = np.zeros(len(self._events))
        self._leaving = np.zeros(len(self._events))  # The side to which a reset turned the rates
        self._fired, self._steps = set[int](), 0  # The last events, and steps since then
        self._left_over = np.zeros(len(self._events))  # Roundings of where it leaves a surface
        self._roundings = np.zeros(len(self._events))  # What is that close to zero is on it

    @property
    def looks(self) -> bool:
        """Whether there are events whose times the trajectory tells."""
        return bool(self._watched)

    def _stacked(self) -> tuple[Matrix, list[slice]]:
        """The rows of all arguments, and which ones belong to each event."""
        rows, places, first = list[Matrix](), list[slice](), 0
        for event in self._events:
            own = event.arguments if event.known is None else ()
            places.append(slice(first, first + len(own)))
            rows += own
            first += len(own)
        n = self._system.size
        return (ss.csr_array(ss.vstack(rows)) if rows else ss.csr_array((0, n))), places

    # --- known times ---------------------------------------------------------------------------

    def next_known(self, time: float, end: float) -> float:
        """The first known time after this one, or the end."""
        return float(min(self._ahead[self._ahead > time].min(initial=math.inf), end))

    def known_at(self, time: float) -> list[int]:
        """The events that happen at a time that was known."""
        return np.flatnonzero(np.abs(self._ahead - time) <= self._instant).tolist()

    # --- crossings -----------------------------------------------------------------------------

    def begin(self, time: float, state: Array) -> list[int]:
        """Take note of the sides at the start; the events at that time."""
        self._sides = self._sides_of(time, state)
        return self.known_at(time)

    def along(
        self, path: scipy.integrate.DenseOutput, before: float, until: float
    ) -> tuple[list[Occurred], float, list[int]]:
        """The crossings on a step: those that mark, the first that interrupts, and its events.

        Without one that interrupts the time is the end of the step, and there are no events.
        """
        times = np.concatenate([[before], before + (until - before) * _SHARES])
        times[-1] = until
        arguments = self._arguments_along(path, times)
        crossed: list[tuple[float, int, float]] = []
        self._steps += 1
        sizes = self._absolute @ np.abs(path(np.array([before, until]))).max(axis=1)
        for k in self._watched:
            heights, own = self._heights(k, times, arguments), self._places[k]
            _, rounding = self._rounded(k, until, arguments[own, -1], sizes[own])
            self._roundings[k] = max(rounding, self._left_over[k])
            roots = self._roots(k, path, times, heights)
            if roots and k in self._fired and self._steps <= _FRESH:
                raise UnresolvedEventError
            crossed += [(root, k, side) for root, side in roots]
        crossed.sort()
        first = min((t for t, k, _ in crossed if self._events[k].jumps), default=math.inf)
        marks = [Occurred(k, t) for t, k, _ in crossed if t < first - self._instant]
        if first == math.inf:
            self._sides = self._sides_after(path, until)
            return marks, until, []
        self._sides = self._sides_after(path, first)
        fired = {k: side for t, k, side in crossed if abs(t - first) <= self._instant}
        at = np.array([first])
        arguments = self._arguments_along(path, at)
        for k, side in fired.items():
            self._sides[k] = side
            left = abs(float(self._heights(k, at, arguments)[0]))  # a root is to rounding of time
            self._roundings[k] = max(self._roundings[k], _ROOM * left)
        return marks, first, sorted(fired)

    def _roots(
        self, k: int, path: scipy.integrate.DenseOutput, times: Array, heights: Array
    ) -> list[tuple[float, float]]:
        """The crossings of an event on a step, in its direction: when, and from which side."""
        side, direction = float(self._sides[k]), self._events[k].direction
        roots, last = list[tuple[float, float]](), 0
        for j in range(1, times.size):
            here = self._side(k, heights[j])
            if here == 0.0:
                continue
            if side == 0.0 and here * self._leaving[k] < 0.0:
                raise UnresolvedEventError
            self._leaving[k] = self._left_over[k] = 0.0
            if side * here < 0.0 and direction in (BOTH, here):
                root = self._root(k, path, float(times[last]), float(times[j]))
                roots.append((root, side))
            side, last = here, j
        return roots

    def _root(self, k: int, path: scipy.integrate.DenseOutput, a: float, b: float) -> float:
        """The root of an event between two times at which it has other signs, to rounding."""

        def height(t: float) -> float:
            at = np.array([t])
            return float(self._heights(k, at, self._arguments_along(path, at))[0])

        low, high = height(a), height(b)
        if low * high >= 0.0:  # it leaves its surface, from which side its history tells
            return a
        return float(scipy.optimize.brentq(height, a, b, xtol=EPSILON * abs(b), rtol=4 * EPSILON))

    # --- resets --------------------------------------------------------------------------------

    def apply(
        self, time: float, state: Array, fired: Sequence[int]
    ) -> tuple[list[Occurred], Array, bool]:
        """What happens at an instant: the events, the state after them, and whether it ends."""
        happened: list[Occurred] = []
        sides, now, before = self._sides.copy(), list(fired), state
        for _ in range(MOST_ROUNDS):
            for k in now:
                happened.append(Occurred(k, time))
                self._ahead[k] = math.inf
                after = self._events[k].after
                if after is not None:
                    state = self._system.mapped(after, time, state, self._point)
            if any(self._events[k].terminal for k in now):
                return happened, state, True
            came, on = sides, self._sides_of(time, state, near=True)
            came[now] = 0.0
            sides = np.where(on == 0.0, came, on)
            now = [
                k
                for k in self._watched
                if came[k] * on[k] < 0.0 and self._events[k].direction in (BOTH, on[k])
            ]
            if not now:
                self._sides, self._steps = sides, 0
                self._fired = {each.event for each in happened}
                self._leaving = np.zeros(len(self._events))
                self._left_over = np.where(on == 0.0, self._roundings, 0.0)
                if any(on[k] == 0.0 for k in self._watched):
                    slopes = self._slopes(time, before), self._slopes(time, state)
                    turned = (on == 0.0) & (slopes[0] * slopes[1] < 0.0)
                    self._leaving[turned] = slopes[1][turned]
                return happened, state, False
        raise UnresolvedEventError

    def _slopes(self, time: float, state: Array) -> Array:
        """The signs of the rates of what crosses zero at a state (N,), for each event."""
        slopes = np.zeros(len(self._events))
        if not self._watched:
            return slopes
        start, end = self._system.horizon
        rates = self._rates(time, state)
        largest = np.abs(rates).max(initial=0.0)
        ahead = _AHEAD * min(end - start, np.abs(state).max(initial=0.0) / max(largest, TINY))
        at = np.array([time, time + ahead])
        arguments = self._rows @ np.stack([state, state + ahead * rates], axis=1)
        for k in self._watched:
            before, after = self._heights(k, at, arguments)
            if abs(after - before) > self._roundings[k]:
                slopes[k] = np.sign(after - before)
        return slopes

    # --- sides ---------------------------------------------------------------------------------

    def _side(self, k: int, height: float) -> float:
        """The side of the surface of an event; 0 on it."""
        return 0.0 if abs(height) <= self._roundings[k] else float(np.sign(height))

    def _sides_of(self, time: float, state: Array, near: bool = False) -> Array:
        """The sides (events,) that a state is on; 0 for events at known times.

        One ``near`` to where a step led is as accurate as the step.
        """
        sides = np.zeros(len(self._events))
        if not self._watched:
            return sides
        arguments, sizes = self._rows @ state, self._absolute @ np.abs(state)
        for k in self._watched:
            own = self._places[k]
            height, rounding = self._rounded(k, time, arguments[own], sizes[own])
            self._roundings[k] = max(self._roundings[k], rounding) if near else rounding
            sides[k] = self._side(k, height)
        return sides

    def _rounded(self, k: int, time: float, arguments: Array, sizes: Array) -> tuple[float, float]:
        """What crosses zero, and by how much it changes if what it is made of is rounded."""
        numbers = np.concatenate([[time], arguments, self._point])
        changes = ROUNDING * np.concatenate([[abs(time)], sizes, np.abs(self._point)])
        columns = numbers[:, None] + np.diag(changes)
        columns = np.concatenate([numbers[:, None], columns], axis=1)
        own = list(columns[1 : 1 + len(arguments)])
        heights = self._system.height(
            self._events[k], columns[0], own, columns[1 + len(arguments) :]
        )
        return float(heights[0]), float(np.abs(heights[1:] - heights[0]).sum())

    def _sides_after(self, path: scipy.integrate.DenseOutput, time: float) -> Array:
        """The sides at a time of a step; where it is on a surface, those before."""
        at = np.array([time])
        arguments = self._arguments_along(path, at)
        sides = self._sides.copy()
        for k in self._watched:
            here = self._side(k, float(self._heights(k, at, arguments)[0]))
            sides[k] = here or sides[k]
        return sides

    def _heights(self, k: int, times: Array, arguments: Array) -> Array:
        """What crosses zero at an event, at times (m,) and arguments (rows, m)."""
        points = np.repeat(self._point[:, None], times.size, axis=1)
        own = list(arguments[self._places[k]])
        return self._system.height(self._events[k], times, own, points)

    def _arguments_along(self, path: scipy.integrate.DenseOutput, times: Array) -> Array:
        """The arguments (rows, m) of all events at times (m,) of a step.

        The path is a sum of differences times polynomials, and rows of it are that of rows.
        """
        differences = self._rows @ path.D.T
        charge(2.0 * self._rows.nnz * len(path.D))
        factors = np.cumprod((times - path.t_shift[:, None]) / path.denom[:, None], axis=0)
        return np.asarray(differences[:, 1:] @ factors + differences[:, :1])
