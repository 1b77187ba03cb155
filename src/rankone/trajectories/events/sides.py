"""Whether trajectories stay on the sides of switches that their stretches hold."""

from __future__ import annotations

import numpy as np

from rankone.ir.system import Clock
from rankone.support.arrays import Array
from rankone.trajectories.events.event_order import OrderError, at_point, at_time

_SHARES = np.array([0.02, 0.2, 0.5, 0.8, 0.98])  # Of a stretch, where its sides are checked
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
