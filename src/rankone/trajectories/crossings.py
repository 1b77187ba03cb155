"""Where paths cross the roots of functions: all of a stack at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rankone.ir.events import BOTH, SystemEvent
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, function_cost
from rankone.trajectories.defects import roots
from rankone.trajectories.paths import NODES, Path, step_coefficients

_SLOPE_STEP = 1e-7  # Step of a difference in time, relative to times and steps
_CROSSING = 1e-3  # Slope where a path begins, over the mean one, from which it crosses a surface
_LOOK_COST = 10.0  # Operations of an event function for each number that it reads


class Crossings:
    """The crossings of events on paths, each at its own point (d,) of points (m, d).

    Every path has made a step. ``fired`` are for each of them the events at its very start, and
    ``first`` says whether they were the first ones there.
    """

    def __init__(
        self,
        system: System,
        paths: Sequence[Path],
        points: Array,
        fired: Sequence[frozenset[int]],
        first: NDArray[np.bool_],
    ) -> None:
        self.system, self.paths, self.points = system, paths, points
        self.fired, self.first = fired, first
        times = [path.breaks[:-1, None] + np.diff(path.breaks)[:, None] * NODES for path in paths]
        counts = np.array([each.size for each in times])
        self.times = np.concatenate([each.ravel() for each in times])
        nodal = np.concatenate([path.nodal for path in paths])
        self.states = nodal.reshape(self.times.size, -1).T
        self.nodal = nodal
        self.owner = np.repeat(np.arange(len(paths)), counts)
        self.firsts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        self.parameters = np.ascontiguousarray(points.T)[:, self.owner]

    def of(self, k: int, event: SystemEvent) -> list[Array]:
        """For each path the times of event ``k``, in order; the first alone if it interrupts.

        A trajectory that begins at the event is on its surface except for rounding. It is there
        again at once if it was reset, goes on to the same side as before, and does not cross the
        surface on its way: a ball that comes to rest falls again.
        """
        heights = _heights(event, self.times, self.states, self.parameters)
        none = self.times[:0]
        found = [none] * len(self.paths)
        began = self.firsts[[k in fired for fired in self.fired]]
        if began.size:
            heights[began] = heights[began + 1]
            back = began[np.sign(heights[began]) == event.direction]
            if event.then is not None and back.size:
                through = self.first[self.owner[back]] & self._crosses(event, back)
                for start in back[~through]:
                    found[self.owner[start]] = self.times[start : start + 1]
        before, after = np.sign(heights[:-1]), np.sign(heights[1:])
        # not a number is no side
        crossed = (before != after) & (before != 0.0) & np.isfinite(before) & np.isfinite(after)
        crossed &= self.owner[:-1] == self.owner[1:]
        if event.direction != BOTH:
            crossed &= before == -event.direction
        places = np.flatnonzero(crossed)
        owners = self.owner[places]
        if event.interrupts:
            owners, chosen = np.unique(owners, return_index=True)
            places = places[chosen]
        again = np.array([found[owner].size > 0 for owner in owners], dtype=bool)
        places, owners = places[~again], owners[~again]
        if not places.size:
            return found
        times = self._roots(event, places, heights)
        for owner in np.unique(owners):
            found[owner] = times[owners == owner]
        return found

    def _crosses(self, event: SystemEvent, starts: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether paths cross the surface in the direction of the event where they begin."""
        t, u, p = self.times[starts], self.states[:, starts], self.parameters[:, starts]
        with np.errstate(all="ignore"):
            rates = np.broadcast_to(self.system.rhs(t, u, p), u.shape)
        charge(function_cost(self.system.rhs, self.system.user_functions)(starts.size))
        length = self.times[starts + 1] - t
        step = _SLOPE_STEP * np.maximum(length, np.abs(t))
        slope = (_heights(event, t + step, u + step * rates, p) - _heights(event, t, u, p)) / step
        mean = _heights(event, self.times[starts + 1], self.states[:, starts + 1], p) / length
        return np.asarray(event.direction * slope > _CROSSING * np.abs(mean))

    def _roots(self, event: SystemEvent, places: NDArray[np.intp], heights: Array) -> Array:
        """The roots between nodes and the next ones."""
        steps = places // NODES.size
        a, width = self.times[places], self.times[places + 1] - self.times[places]
        ends = NODES.size * steps
        begin, length = self.times[ends], self.times[ends + NODES.size - 1] - self.times[ends]
        coefficients = step_coefficients(self.nodal[steps])
        parameters = self.parameters[:, places]

        def height(shares: Array) -> Array:
            times = a + width * shares
            x = (2.0 * (times - begin) / length - 1.0)[:, None]
            states = coefficients[-1]
            for coefficient in coefficients[-2::-1]:
                states = states * x + coefficient
            return _heights(event, times, states.T, parameters)

        return np.asarray(a + width * roots(height, heights[places], heights[places + 1]))


def _heights(event: SystemEvent, times: Array, states: Array, parameters: Array) -> Array:
    charge(CALL + _LOOK_COST * states.size)
    with np.errstate(all="ignore"):
        heights = np.asarray(event.when(times, states, parameters), dtype=float)
    return np.broadcast_to(heights, times.shape).copy()
