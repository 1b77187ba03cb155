"""Coarse trajectories: what they reach, before the rates are known to be smooth.

Their steps are even and few, so that they end whatever the rates do: these may jump, and push
trajectories back to where they jump. Steps are those of ROS2, a linearly implicit method of second
order that stiff rates do not drive away (Verwer, Spee, Blom & Hundsdorfer, SIAM J. Sci. Comput. 20,
1999, 1456-1480): with A = I - γ h J and γ = 1 - 1/√2,

    A k₁ = f(t, u),   A k₂ = f(t + h, u + h k₁) - 2 k₁,   u + h (3 k₁ + k₂)/2.
"""

from __future__ import annotations

import itertools

import numpy as np

from rankone.support.arrays import Array
from rankone.trajectories.integrators.integrator import finite_blocks, jacobians
from rankone.trajectories.system.events import FALLING, RISING
from rankone.trajectories.system.system import System

_GAMMA = 1.0 - 0.5**0.5


def coarse_states(system: System, points: Array, count: int) -> tuple[Array, Array]:
    """Times (count + 1,), and the states there of trajectories at points (m, d): (n, m, count + 1).

    Events reset them at the end of the step in which they come, once in each. States that are not
    finite are NaN, and so are all behind them.
    """
    times = np.linspace(*system.horizon, count + 1)
    jumps = dict(zip(system.jumps.times, system.jumps.kinds, strict=True))
    p = np.ascontiguousarray(points.T)
    states = [np.broadcast_to(system.initial(p), (system.n_differential, len(points)))]
    identity, step = np.eye(system.n_differential), times[1] - times[0]
    with np.errstate(all="ignore"):
        for begin, end in itertools.pairwise(times):
            u = states[-1]
            for time in (time for time in jumps if begin <= time < end):
                u = np.broadcast_to(system.jumps.jumped(jumps[time], u, p), u.shape)
            jacobian = finite_blocks(jacobians(system, points, begin, u))
            inverse = np.linalg.inv(identity - _GAMMA * step * jacobian)
            first = _applied(inverse, np.broadcast_to(system.rhs(begin, u, p), u.shape))
            rates = np.broadcast_to(system.rhs(end, u + step * first, p), u.shape)
            second = _applied(inverse, rates - 2.0 * first)
            further = _reset(system, (begin, end), u, u + 0.5 * step * (3.0 * first + second), p)
            states.append(np.where(np.isfinite(further), further, np.nan))
    return times, np.stack(states, axis=2)


def _reset(system: System, span: tuple[float, float], u: Array, further: Array, p: Array) -> Array:
    """States (n, m) at the end of a step, after the events in it."""
    begin, end = (np.full(u.shape[1], time) for time in span)
    for event in system.events:
        if event.then is None:
            continue
        before, after = event.when(begin, u, p), event.when(end, further, p)
        rises, falls = (before < 0.0) & (after >= 0.0), (before > 0.0) & (after <= 0.0)
        comes = {RISING: rises, FALLING: falls}.get(event.direction, rises | falls)
        further = np.where(comes, event.then(end, further, p), further)
    return further


def _applied(matrices: Array, vectors: Array) -> Array:
    """Products of matrices (m, n, n) with vectors (n, m): shape (n, m)."""
    return np.asarray((matrices @ vectors.T[:, :, None])[:, :, 0].T)
