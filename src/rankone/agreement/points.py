"""Points over the horizon, the box and plausible states at which generated code is looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.trajectories.integration import initial_values

__all__ = ["STILL", "Points"]

_DRIFTS = (0.0, 1e-3, 0.03, 0.3)
"""Parts of the horizon over which states have moved from the start, at their first rate."""
_NOISE = (1e-9, 1e-5, 0.01, 0.3)
"""Relative distances of states from there. Zero states move too, except at still points."""
_LARGEST_DRIFT = 10.0
"""In units of the largest initial value of a state."""
STILL = len(_DRIFTS)
"""One point in so many is still: its states are those at the start, apart from the noise."""
_SEED = 1937


@dataclass(frozen=True)
class Points:
    """Where a problem is looked at: times (m,), parameters (d, m), states and rates (n, m).

    ``sizes`` (n,) are how large states are, as far as the start and the first rates tell.
    """

    time: Array
    parameters: Array
    states: Array
    rates: Array
    sizes: Array

    @classmethod
    def of(cls, system: System, count: int) -> Points:
        """Points over the horizon, the box and plausible states; the same for the same system."""
        rng = np.random.default_rng(_SEED)
        start, end = system.TIME
        box = np.asarray(system.BOX, dtype=float).reshape(-1, 2)
        time = start + (end - start) * rng.random(count)
        p = box[:, :1] + (box[:, 1:] - box[:, :1]) * rng.random((len(box), count))
        initial = np.asarray(initial_values(system, p), dtype=float)
        first = np.nan_to_num(np.asarray(system.rhs(start, initial, p), dtype=float))
        drift = first * (time - start) * np.resize(_DRIFTS, count)
        size = np.abs(initial).max(axis=1, keepdims=True)
        longest = np.where(size > 0.0, _LARGEST_DRIFT * size, np.inf)
        moved = initial + np.clip(drift, -longest, longest)
        noise = np.repeat(_NOISE, -(-count // len(_NOISE)))[:count]
        states = moved * (1.0 + noise * rng.uniform(-1.0, 1.0, moved.shape))
        reach = np.abs(first).max(axis=1, keepdims=True) * (end - start)
        away = noise * np.where(reach > 0.0, reach, 1.0) * (np.resize(_DRIFTS, count) > 0.0)
        states = np.where(moved == 0.0, away, states)
        states = np.where(np.isfinite(states), states, initial)
        rates = np.asarray(system.rhs(time, states, p), dtype=float)
        return cls(time, p, states, rates, np.abs(moved).max(axis=1))
