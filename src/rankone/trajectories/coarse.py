"""Coarse trajectories: what they reach, before the rates are known to be smooth.

Their steps are even and few, so that they end whatever the rates do: these may jump, and push
trajectories back to where they jump. Steps are linearly implicit, u' = (I - h J)⁻¹ f(t + h, u), the
Rosenbrock method of first order (Hairer & Wanner, Solving Ordinary Differential Equations II, 1996,
section IV.7), which stiff rates do not drive away.
"""

from __future__ import annotations

import itertools

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.trajectories.integrator import finite_blocks, jacobians


def coarse_states(system: System, points: Array, count: int) -> tuple[Array, Array]:
    """Times (count + 1,), and the states there of trajectories at points (m, d): (n, m, count + 1).

    Events do not reset them. States that are not finite are NaN, and so are all behind them.
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
            rates = np.broadcast_to(system.rhs(end, u, p), u.shape)
            matrices = identity - step * finite_blocks(jacobians(system, points, end, u))
            further = u + step * np.linalg.solve(matrices, rates.T[:, :, None])[:, :, 0].T
            states.append(np.where(np.isfinite(further), further, np.nan))
    return times, np.stack(states, axis=2)
