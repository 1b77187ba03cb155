"""The rates of a lifted system compared with those that it stands for."""

from __future__ import annotations

import numpy as np

from rankone.agreement.points import Points
from rankone.ir.system import System

__all__ = ["disagreeing_rate"]

_POINTS = 20
_TOLERANCE = 1e-6
"""Differences beyond, relative to the largest rate of a state, are not those of rounding."""


def disagreeing_rate(lifted: System, system: System) -> int | None:
    """The first state whose rate the lifted system has wrong; None where there is none.

    Numbers of a system that is multiplied out may overflow where those of the system as it is
    written do not.
    """
    with np.errstate(all="ignore"):
        points = Points.of(system, _POINTS)
        t, p, u = points.time, points.parameters, points.states
        count = getattr(lifted, "LIFTED", 0)
        states = np.concatenate([u, np.ones((count, t.size))])
        for _ in range(count):  # some stand for functions of others
            states[len(u) :] = lifted.meanings(t, states, p)
        finite = np.isfinite(points.rates).all(axis=0) & np.isfinite(states).all(axis=0)
        rates = np.asarray(lifted.rhs(t, states, p), dtype=float)[: len(u)]
        size = np.abs(points.rates[:, finite]).max(axis=1, initial=0.0)
        off = np.abs(rates - points.rates)[:, finite]
        wrong = ~(off <= _TOLERANCE * size[:, None]).all(axis=1)
    return int(np.argmax(wrong)) if wrong.any() else None
