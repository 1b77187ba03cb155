"""The sides of switches that stretches hold, and whether trajectories stay on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from rankone.support.arrays import Array
from rankone.support.costs import Cost, function_cost
from rankone.trajectories.events.event_order import OrderError, at_point, at_time
from rankone.trajectories.integrators.known_states import of_known_states
from rankone.trajectories.system.events import OfTrajectory, Row, SystemEvent
from rankone.trajectories.system.features import OfStates, VectorLike
from rankone.trajectories.system.system import Clock, System

# Of a stretch, where its sides are checked, also next to its ends: something narrow may be there
_SHARES = np.array([1e-9, 0.02, 0.2, 0.5, 0.8, 0.98, 1.0 - 1e-9])
_ROUNDING = 1e-12  # Distance from it, over the way that it holds trajectories back from
_BESIDE = 1e-5  # Distance beyond a surface, over the largest one, that is rounding and tolerance


def check_sides(clock: Clock, states: Array, times: Array, points: Array) -> None:
    """Raise an OrderError if a trajectory is not on the sides that its rates are of.

    So the rates are those of the system as it was written, almost everywhere.

    Parameters
    ----------
    clock : Clock
        Of the trajectories.
    states : ndarray (n, m, stretches, shares)
        Of the system, with its sides, at m points.
    times : ndarray (m, stretches, shares)
        Clock times.
    points : ndarray (m, d)
    """
    system = clock.system
    first = len(states) - system.n_sides
    p = np.broadcast_to(points.T[:, :, None, None], (points.shape[1], *times.shape))
    lengths = np.ptp(times, axis=2, keepdims=True)
    long = np.broadcast_to(lengths > _BESIDE * clock.length, times.shape).ravel()
    flat = states.reshape(len(states), -1), times.ravel(), p.reshape(points.shape[1], times.size)
    crossings = (event for event in system.events if event.switch and event.then is not None)
    for k, event in enumerate(crossings, first):
        sides = np.rint(flat[0][k])
        above = flat[0].copy()
        above[k] = 1.0
        with np.errstate(all="ignore"):
            heights = np.broadcast_to(event.when(flat[1], above, flat[2]), sides.shape)
            stays = np.broadcast_to(event.when(flat[1], flat[0], flat[2]), sides.shape)
        slides = sides == 0.0
        beyond = np.where(slides, np.abs(heights), -sides * heights)
        held_back = np.sqrt(np.abs(stays[slides]).max(initial=0.0)) * clock.length
        wrong = beyond > _BESIDE * np.abs(heights).max() + _ROUNDING * held_back
        wrong |= slides & (stays < -_BESIDE * np.abs(stays).max())
        wrong &= long
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            point = np.unravel_index(at, times.shape)[0]
            raise OrderError(
                f"{event.name} is not on the side that it is held on"
                f"{at_time(clock, flat[1][at])}{at_point(clock, points[point])}",
                remedy="narrow the box, or smooth the switch",
            )


def times_to_check(borders: Array) -> Array:
    """Clock times (m, stretches, shares) to check sides at, of borders (m, stretches + 1)."""
    lengths = np.diff(borders, axis=1)
    return np.asarray(borders[:, :-1, None] + lengths[:, :, None] * _SHARES)


@dataclass(frozen=True, eq=False)
class _OnSides:
    """A ``function`` of states and of sides, as one of states alone, and ``rows`` of it."""

    function: Callable[..., Array]
    sides: Array
    rows: tuple[slice, ...]
    cost: Cost

    def __call__(self, t: float | Array, u: VectorLike, p: VectorLike) -> Array:
        return np.asarray(self.function(t, [*u, *self.sides], p))[self.rows]


@lru_cache(64)
def on_sides(system: System, sides: tuple[int, ...]) -> System:
    """The system of trajectories that all stay on some sides: these are no states of it."""
    if not sides:
        return system
    n, known = system.n_differential - len(sides), tuple(map(float, sides))

    def alone(function: Callable[..., Array], *rows: slice) -> OfStates:
        cost = function_cost(function, system.user_functions)
        return _OnSides(function, np.array(known), rows, cost)

    def when(event: SystemEvent) -> OfTrajectory:
        if isinstance(event.when, Row):
            row = event.when.row
            function = of_known_states(event.when.function, known, (row,))
            if function is not None:
                return Row(function, row)
        return alone(event.when)

    rhs = of_known_states(system.rhs, known, tuple(range(n))) or alone(system.rhs, slice(n))
    return replace(
        system,
        states=system.states[:n],
        n_differential=n,
        n_sides=0,
        events=tuple(replace(event, when=when(event)) for event in system.events),
        rhs=rhs,
        jacobian=alone(system.jacobian, slice(n), slice(n)),
        features=replace(system.features, state_surfaces=alone(system.features.state_surfaces)),
    )
