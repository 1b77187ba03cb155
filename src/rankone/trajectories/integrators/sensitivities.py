"""Trajectories one by one with their derivatives with respect to parameters, for searches.

Along a trajectory u of u' = f(t, u, p) they obey the linear equation S' = f_u S + f_p P, with the
directions in the columns of P (Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I,
I.14). LSODA integrates each trajectory on its own steps, and its derivatives follow along these by
Radau collocation, with few stages: they point a search downhill, and cost little more than the
trajectory. What a step does to S does not depend on S, so that all steps are solved together, and
then follow each other.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.support.precision import AT_ONCE, COINCIDENT, DIFFERENCE
from rankone.tensors.bases.time_grid import RadauCollocation, insets
from rankone.trajectories.integrators.integrator import Path, Spans, Tolerances
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.system.system import System

# Radau nodes of a step: order five, and three where tolerances are loose
_STAGES, _FEW_STAGES = 3, 2
_LOOSE = 1e-3  # Relative tolerance from which on fewer nodes are enough

RateSlopes = Callable[[Array, Array], Array]
"""Derivatives (n, w, N) of rates along w directions, at times (N,) and states (n, N)."""


class Sensitive(NamedTuple):
    """One trajectory at T times: states (T, n) and their derivatives (T, n, w)."""

    states: Array
    slopes: Array


class Start(NamedTuple):
    """Where a trajectory starts: its state (n,), with derivatives (n, w) along directions."""

    state: Array
    slopes: Array


class Variation(NamedTuple):
    """What moves a trajectory: its rates, and what becomes of it and its derivatives at an edge."""

    rates: RateSlopes
    after_jump: Callable[[float, Start], Start] | None = None


def sensitive_path(
    system: System,
    point: Array,
    edges: Sequence[float],
    tolerances: Tolerances,
    times: Array,
    start: Start,
    variation: Variation,
) -> Sensitive:
    """States and derivatives at ascending times (T,); NaN from where the trajectory ends.

    Rates are smooth between ``edges``, from the first to the last of which it goes. No derivatives
    are followed where ``start`` has none.
    """
    (n, w), count = start.slopes.shape, times.size
    at = Sensitive(np.full((count, n), np.nan), np.full((count, n, w), np.nan))
    stages = _FEW_STAGES if tolerances.relative >= _LOOSE else _STAGES
    along = _Along(system, point, variation.rates, stages)
    for a, b in itertools.pairwise(edges):
        if variation.after_jump is not None:
            start = variation.after_jump(a, start)
        here = (times >= a) & (times <= b)
        at.states[times == a], at.slopes[times == a] = start
        span = Spans(np.array([a]), start.state[:, None], np.array([b]))
        (path,) = SingleIntegrator().paths(system, point[None], span, tolerances)
        here &= (times > a) & (times <= path.end)
        if path.steps:
            at.states[here] = path(times[here]).T
        if path.steps and w:
            slopes = along.slopes(path, start.slopes, np.append(times[here], path.end))
            at.slopes[here], start = slopes[:-1], Start(path.state, slopes[-1])
        if path.end < b:
            break
        start = start._replace(state=path.state)
    return at


@dataclass(frozen=True)
class _Along:
    """What derivatives along a trajectory depend on beside the trajectory."""

    system: System
    point: Array
    rate_slopes: RateSlopes
    stages: int

    def slopes(self, path: Path, start: Array, times: Array) -> Array:
        """Derivatives (T, n, w) at times of a path, which has those of the start (n, w) there."""
        breaks = path.breaks
        away = np.abs(times - breaks[_nearest(breaks, times)])
        ends = np.union1d(breaks, times[away > COINCIDENT * (breaks[-1] - breaks[0])])
        (n, w), stages, steps = start.shape, self.stages, ends.size - 1
        at_ends = np.empty((ends.size, n, w))
        at_ends[0] = start
        many = max(1, AT_ONCE // (stages * n * (stages * n + n + w)))
        for first in range(0, steps, many):
            maps = self._maps(path, ends[first : first + many + 1], w)
            for k, (carried, driven) in enumerate(zip(*maps, strict=True), first):
                at_ends[k + 1] = carried @ at_ends[k] + driven
        return at_ends[_nearest(ends, times)]

    def _maps(self, path: Path, ends: Array, w: int) -> tuple[Array, Array]:
        """What K steps do to S: they multiply it by (K, n, n), and add (K, n, w)."""
        scheme, lengths = RadauCollocation.of(self.stages), np.diff(ends)
        n, steps, stages = self.system.n_differential, lengths.size, self.stages
        near = insets(ends[:-1], ends[1:])
        times = (ends[:-1] + near)[:, None] + (lengths - 2.0 * near)[:, None] * scheme.nodes
        states, count = path(times.ravel()), times.size
        point = np.repeat(self.point[:, None], count, axis=1)
        jacobian = self.system.jacobian(times.ravel(), states, point)
        jacobian = np.broadcast_to(jacobian, (n, n, count)).reshape(n, n, steps, stages)
        slopes = np.broadcast_to(self.rate_slopes(times.ravel(), states), (n, w, count))
        h, node = lengths[:, None, None, None], np.arange(stages)
        matrix = np.zeros((steps, stages, n, stages, n))
        diagonal = np.arange(n)
        matrix[:, :, diagonal, :, diagonal] = scheme.derivative
        matrix[:, node, :, node, :] -= np.moveaxis(h * jacobian.transpose(2, 3, 0, 1), 1, 0)
        right = np.empty((steps, stages, n, n + w))
        right[..., :n] = scheme.start[:, None, None] * np.eye(n)
        right[..., n:] = h * slopes.reshape(n, w, steps, stages).transpose(2, 3, 0, 1)
        size = stages * n
        shaped = matrix.reshape(steps, size, size), right.reshape(steps, size, n + w)
        at_end = np.asarray(np.linalg.solve(*shaped), dtype=float)[:, -n:]
        return at_end[..., :n], at_end[..., n:]


def _nearest(ends: Array, times: Array) -> NDArray[np.intp]:
    """The places of the ascending ``ends`` that are nearest to times."""
    behind = np.clip(np.searchsorted(ends, times), 1, ends.size - 1)
    return np.asarray(behind - (times - ends[behind - 1] < ends[behind] - times))


# --- derivatives with respect to parameters, by differences of the rates ----------------------


class ByParameters:
    """Derivatives of a system at a point (d,) with respect to some of its parameters."""

    def __init__(self, system: System, point: Array, free: Sequence[int]) -> None:
        self.system, self.point, self.free = system, point, list(free)
        steps: Array = DIFFERENCE * np.where(point == 0.0, 1.0, np.abs(point))[self.free]
        moved = np.repeat(point[:, None], 2 * len(free), axis=1)
        moved[self.free, np.arange(len(free))] += steps
        moved[self.free, len(free) + np.arange(len(free))] -= steps
        self._steps, self._moved = steps, moved

    def start(self) -> Start:
        """The initial state and its derivatives."""
        state = self.system.initial(self.point[:, None])[:, 0]
        return Start(state, self._central(self.system.initial(self._moved)))

    def rate_slopes(self, times: Array, states: Array) -> Array:
        """Derivatives (n, k, N) of the rates at times (N,) and states (n, N)."""
        (n, count), k = states.shape, len(self.free)
        slopes = np.empty((n, k, count))
        most = max(AT_ONCE // max(2 * k * n, 1), 1)
        cost = function_cost(self.system.rhs, self.system.user_functions)
        for first in range(0, count, most):
            some = slice(first, first + most)
            clock, u = np.tile(times[some], 2 * k), np.tile(states[:, some], 2 * k)
            charge(cost(clock.size))
            p = np.repeat(self._moved, times[some].size, axis=1)
            with np.errstate(all="ignore"):
                rates = np.broadcast_to(self.system.rhs(clock, u, p), (n, clock.size))
            up, down = np.moveaxis(rates.reshape(n, 2, k, -1), 1, 0)
            slopes[:, :, some] = (up - down) / (2.0 * self._steps[:, None])
        return np.where(np.isfinite(slopes), slopes, 0.0)

    def after_jump(self, time: float, start: Start) -> Start:
        """A state and its derivatives after what resets it at a time."""
        jumps = self.system.jumps
        if (kind := jumps.kind_at(time)) is None:
            return start
        moved = start.slopes * self._steps
        columns = start.state[:, None]
        states = np.concatenate([columns + moved, columns - moved], axis=1)
        after = jumps.jumped(kind, columns, self.point[:, None])[:, 0]
        return Start(after, self._central(jumps.jumped(kind, states, self._moved)))

    def _central(self, values: Array) -> Array:
        """Central differences (n, k) of values (n, 2 k) at the moved points."""
        up, down = np.split(values, 2, axis=1)
        return np.asarray((up - down) / (2.0 * self._steps))


def sensitive_to_parameters(
    system: System,
    point: Array,
    edges: Sequence[float],
    tolerances: Tolerances,
    times: Array,
    free: Sequence[int],
) -> Sensitive:
    """The trajectory at a point (d,), with derivatives by some parameters; see above."""
    by = ByParameters(system, point, free)
    variation = Variation(by.rate_slopes, by.after_jump)
    return sensitive_path(system, point, edges, tolerances, times, by.start(), variation)
