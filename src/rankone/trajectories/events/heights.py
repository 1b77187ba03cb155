"""What crosses zero at an event, and how much of it is rounding."""

from __future__ import annotations

import numpy as np

from rankone.ir.events import SystemEvent
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL

LOOK_COST = 10.0
"""Operations of an event function for each number that it reads."""
_ROUNDINGS = 64.0 * np.finfo(float).eps  # Of numbers that a height is made of, relative to them
_CHANGES = 3  # Random changes by as much, which tell what becomes of them


def heights_of(event: SystemEvent, times: Array, states: Array, parameters: Array) -> Array:
    """What crosses zero at an event, (N,), at times (N,), states (n, N) and parameters (d, N)."""
    charge(CALL + LOOK_COST * states.size)
    with np.errstate(all="ignore"):
        heights = np.asarray(event.when(times, states, parameters), dtype=float)
    return np.broadcast_to(heights, times.shape).copy()


def roundings_of(
    event: SystemEvent,
    times: Array,
    states: Array,
    parameters: Array,
    sizes: Array,
    heights: Array,
) -> Array:
    """By how much heights (N,) change if what they are made of is rounded.

    States are rounded relative to their ``sizes`` (n, N) nearby: next to zero they are no more
    accurate than where they came from. Whatever is on a surface to within that is on it.
    """
    random, largest = np.random.default_rng(3061), np.zeros(times.size)
    for _ in range(_CHANGES):
        factors = [random.uniform(0.5, 1.0, k) for k in (1, len(sizes), len(parameters))]
        time, state, parameter = (
            (_ROUNDINGS * factor * random.choice([-1.0, 1.0], factor.size))[:, None]
            for factor in factors
        )
        changed = heights_of(
            event, times * (1.0 + time[0]), states + state * sizes, parameters * (1.0 + parameter)
        )
        with np.errstate(all="ignore"):
            largest = np.fmax(largest, np.abs(changed - heights))
    return largest


def sides_of_surface(
    event: SystemEvent, times: Array, states: Array, parameters: Array, sizes: Array
) -> Array:
    """The sides of its surface that states are on, (N,): 0 on it, NaN where it is no number."""
    heights = heights_of(event, times, states, parameters)
    roundings = roundings_of(event, times, states, parameters, sizes, heights)
    return np.where(np.abs(heights) <= roundings, 0.0, np.sign(heights))
