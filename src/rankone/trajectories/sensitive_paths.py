"""Trajectories with their derivatives with respect to parameters (forward sensitivities).

LSODA integrates the trajectory alone. Its sensitivities S solve a linear equation along it,
``S' = J S + df/dp``, which Radau collocation on the steps of LSODA turns into one small linear
system for each step. All of these are independent of each other and are solved together; what is
left in sequence is a product of matrices for each step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rankone.discretization.radau import RadauCollocation, insets
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.trajectories.integrator import Tolerances, finite_blocks, jacobians
from rankone.trajectories.paths import Path
from rankone.trajectories.single import SingleIntegrator

_STAGES = 3  # Radau nodes of a step of the sensitivities: order five
# Steps of central differences with respect to parameters, relative: the cube root of rounding
_STEP = 6e-6
_COLUMNS_AT_ONCE = 20_000  # Columns of rates that are evaluated together, to bound memory
_COINCIDENT = 1e-13  # Times that are closer, relative to the horizon, are the same


class Sensitive(NamedTuple):
    """One trajectory at T times: states (T, n) and their derivatives (T, n, k)."""

    states: Array
    slopes: Array


def sensitivities(
    system: System,
    point: Array,
    edges: Sequence[float],
    tolerances: Tolerances,
    times: Array,
    free: Sequence[int],
) -> Sensitive:
    """States and derivatives at ascending times (T,) with respect to k of the parameters.

    The ``edges`` are those of :class:`~rankone.trajectories.integrator.Integrator`. Both are NaN
    from where the trajectory ends.

    Parameters
    ----------
    point : ndarray (d,)
        All parameters.
    free : sequence of int
        Positions of the k parameters.
    """
    states = np.full((times.size, system.n_differential), np.nan)
    slopes = np.full((*states.shape, len(free)), np.nan)
    if not free:
        sampled = SingleIntegrator().sample(system, point[None], edges, tolerances, times)
        states[: sampled.reached] = sampled.states[: sampled.reached, :, 0]
        return Sensitive(states, slopes)
    path = SingleIntegrator().run(system, point[None], edges, tolerances).paths[0]
    last = int(np.searchsorted(times, path.end, side="right"))
    if not path.steps:
        return Sensitive(states, slopes)
    passed = times[:last]
    breaks = _with_times(path.breaks, passed)
    at_breaks = _slopes(system, point, edges, path, breaks, free)
    places = np.searchsorted(breaks, passed - _COINCIDENT * (breaks[-1] - breaks[0]))
    states[:last], slopes[:last] = path(passed).T, at_breaks[places]
    return Sensitive(states, slopes)


def _with_times(breaks: Array, times: Array) -> Array:
    """Breaks (S + 1,), and those of the times that are not among them."""
    near = _COINCIDENT * (breaks[-1] - breaks[0])
    place = np.clip(np.searchsorted(breaks, times), 1, breaks.size - 1)
    distance = np.minimum(np.abs(times - breaks[place - 1]), np.abs(breaks[place] - times))
    return np.union1d(breaks, times[distance > near])


def _slopes(
    system: System,
    point: Array,
    edges: Sequence[float],
    path: Path,
    breaks: Array,
    free: Sequence[int],
) -> Array:
    """Derivatives (S + 1, n, k) at breaks, after a jump there."""
    over, added = _propagators(system, point, path, breaks, free)
    n, k = system.n_differential, len(free)
    slopes = np.empty((breaks.size, n, k))
    slopes[0] = _initial_slopes(system, point, free)
    before = system.initial(point[:, None])[:, 0]
    for step, time in enumerate(breaks):
        if step:
            slopes[step] = over[step - 1] @ slopes[step - 1] + added[step - 1]
        if time in edges and (jump := system.jumps.kind_at(float(time))) is not None:
            if step:
                before = path.nodal[np.searchsorted(path.breaks, time) - 1, -1]
            slopes[step] = _slopes_after(system, jump, point, before, slopes[step], free)
    return slopes


def _propagators(
    system: System, point: Array, path: Path, breaks: Array, free: Sequence[int]
) -> tuple[Array, Array]:
    """For each step the matrices (S, n, n) and (S, n, k): slopes are ``over @ slopes + added``."""
    scheme, n, k = RadauCollocation.of(_STAGES), system.n_differential, len(free)
    starts, lengths = breaks[:-1], np.diff(breaks)
    near = insets(starts, breaks[1:])
    times = (starts + near)[:, None] + (lengths - 2.0 * near)[:, None] * scheme.nodes
    clock = times.ravel()
    states = path(clock)
    points = np.repeat(point[None], clock.size, axis=0)
    with np.errstate(all="ignore"):
        matrices = finite_blocks(jacobians(system, points, clock, states))
        forces = _parameter_slopes(system, point, clock, states, free)
    steps = lengths.size
    matrices = matrices.reshape(steps, _STAGES, n, n)
    left = np.zeros((steps, _STAGES, n, _STAGES, n))
    diagonal = np.arange(n)
    left[:, :, diagonal, :, diagonal] = scheme.derivative
    for stage in range(_STAGES):
        left[:, stage, :, stage, :] -= lengths[:, None, None] * matrices[:, stage]
    right = np.empty((steps, _STAGES, n, n + k))
    right[..., :n] = scheme.start[:, None, None] * np.eye(n)
    right[..., n:] = lengths[:, None, None, None] * forces.reshape(steps, _STAGES, n, k)
    size = _STAGES * n
    charge(2.0 * steps * size**2 * (size / 3.0 + n + k))
    flat = right.reshape(steps, size, n + k)
    solved = np.asarray(np.linalg.solve(left.reshape(steps, size, size), flat), dtype=float)
    return solved[:, -n:, :n], solved[:, -n:, n:]


def _parameter_slopes(
    system: System, point: Array, times: Array, states: Array, free: Sequence[int]
) -> Array:
    """Derivatives df/dp (N, n, k) of the rates at times (N,) and states (n, N)."""
    n, k = system.n_differential, len(free)
    slopes = np.empty((times.size, n, k))
    most = max(_COLUMNS_AT_ONCE // max(2 * k, 1), 1)
    cost = function_cost(system.rhs, system.user_functions)
    points, steps = _moved(point, free)
    for first in range(0, times.size, most):
        clock, u = times[first : first + most], states[:, first : first + most]
        count = clock.size
        charge(cost(2 * k * count))
        shape = (n, 2 * k * count)
        columns = np.tile(clock, 2 * k), np.tile(u, 2 * k), np.repeat(points, count, axis=1)
        rates = np.broadcast_to(system.rhs(*columns), shape).reshape(n, 2, k, count)
        central = (rates[:, 0] - rates[:, 1]) / (2.0 * steps[:, None])
        slopes[first : first + count] = central.transpose(2, 0, 1)
    return np.where(np.isfinite(slopes), slopes, 0.0)


def _moved(point: Array, free: Sequence[int]) -> tuple[Array, Array]:
    """Points (d, 2 k), each parameter moved up and then each down, and by how much (k,)."""
    k = len(free)
    steps: Array = _STEP * np.where(point == 0.0, 1.0, np.abs(point))[list(free)]
    points = np.repeat(point[:, None], 2 * k, axis=1)
    points[list(free), np.arange(k)] += steps
    points[list(free), k + np.arange(k)] -= steps
    return points, steps


def _initial_slopes(system: System, point: Array, free: Sequence[int]) -> Array:
    """Derivatives (n, k) of the initial values."""
    points, steps = _moved(point, free)
    up, down = np.split(system.initial(points), 2, axis=1)
    return np.asarray((up - down) / (2.0 * steps))


def _slopes_after(
    system: System, jump: int, point: Array, state: Array, slopes: Array, free: Sequence[int]
) -> Array:
    """Derivatives (n, k) after a jump, of those before it."""
    points, steps = _moved(point, free)
    moved = slopes * steps
    states = np.concatenate([state[:, None] + moved, state[:, None] - moved], axis=1)
    up, down = np.split(system.jumps.jumped(jump, states, points), 2, axis=1)
    return np.asarray((up - down) / (2.0 * steps))
