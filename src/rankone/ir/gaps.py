"""Trajectories that come to where a piecewise function has no branch."""

from __future__ import annotations

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError

__all__ = ["refuse_gap"]

_AHEAD = (0.0, 1e-12, 1e-9, 1e-6, 1e-4)
"""Relative changes of states and of time after which gaps are looked for."""
_REMEDY = "add a branch (value, True) for everything else, or let its conditions cover this too"


def refuse_gap(system: System, time: float, state: Array, point: Array) -> None:
    """Raise a ProblemError if a trajectory, state (n,) at a point (d,), enters a gap.

    ``state`` is where it got to, before what is reset at that time.
    """
    p = np.ascontiguousarray(point[:, None])
    with np.errstate(all="ignore"):
        if hasattr(system, "JUMP_GAPS") and any(time == at for at, _ in system.JUMPS):
            inside = system.jump_gaps(time, state[:, None], p)
            _refuse(system, system.JUMP_GAPS, inside, time, state, point)
        if not hasattr(system, "GAPS"):
            return
        rates = np.nan_to_num(system.rhs(time, state[:, None], p)[:, 0])
        for step in _AHEAD:
            later = state + step * np.abs(state) * np.sign(rates)
            ahead = time + step * abs(system.TIME[1] - system.TIME[0])
            inside = system.gaps(ahead, later[:, None], p)
            _refuse(system, system.GAPS, inside, ahead, later, point)


def _refuse(
    system: System,
    texts: tuple[str, ...],
    inside: Array,
    time: float,
    state: Array,
    point: Array,
) -> None:
    """Raise a ProblemError for the first gap, of those inside (gaps, 1), that is entered."""
    entered = np.flatnonzero(np.broadcast_to(inside, (len(texts), 1))[:, 0])
    if not entered.size:
        return
    text = texts[entered[0]]
    states = system.STATES[: system.N_DIFFERENTIAL]
    named = zip((*states, *system.PARAMETERS), (*state, *point), strict=True)
    values = ", ".join(f"{name} = {value:.6g}" for name, value in named)
    raise ProblemError(f"{text}: entered at t = {time:.6g}, where {values}", remedy=_REMEDY)
