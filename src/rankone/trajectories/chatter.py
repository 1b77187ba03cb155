"""Rates that switch to and fro: a jump of the rates that pushes a trajectory back where it was."""

from __future__ import annotations

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array

__all__ = ["switching_state"]

_AHEAD = (1e-13, 1e-11, 1e-9, 1e-7, 1e-5)
"""Lengths of steps, in horizons, over which a jump of the rates is looked for."""


def switching_state(
    system: System, time: float, states: Array, points: Array, horizon: float
) -> tuple[int, int] | None:
    """The state whose rate jumps most where a trajectory is pushed back, and the trajectory.

    A trajectory chatters if a short step takes it across the zero of an event function, and a step
    with the rates found there takes it back.

    Parameters
    ----------
    states : ndarray (n, m)
        At the parameter points (m, d).
    """
    if not system.features.n_state_surfaces:
        return None
    events = system.features.state_surfaces
    parameters = np.ascontiguousarray(points.T)
    with np.errstate(all="ignore"):
        rates = system.rhs(time, states, parameters)
        before = events(time, states, parameters)
        for step in _AHEAD:
            ahead = states + step * horizon * rates
            across = events(time, ahead, parameters)
            back = system.rhs(time, ahead, parameters)
            after = events(time, ahead + step * horizon * back, parameters)
            crossed = (before * across <= 0.0) & (across != before)
            returns = (crossed & ((after - across) * (across - before) < 0.0)).any(axis=0)
            if returns.any():
                column = int(np.argmax(returns))
                jump = np.abs(back - rates)[:, column]
                return int(np.argmax(jump)), column
    return None
