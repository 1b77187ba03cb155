"""Trajectories one by one with their derivatives with respect to parameters, for searches.

LSODA integrates each trajectory on its own steps, and its sensitivities follow along these, with
few stages and without further halving: they point a search downhill, and cost little more than
the trajectory.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.trajectories.integrator import Spans, Tolerances
from rankone.trajectories.paths import Path
from rankone.trajectories.sensitivities import Forcing, sensitivities
from rankone.trajectories.single import SingleIntegrator

# Radau nodes of a step of the sensitivities: order five, and three where tolerances are loose
_STAGES, _FEW_STAGES = 3, 2
_LOOSE = 1e-3  # Relative tolerance from which on fewer nodes are enough
# Steps of central differences with respect to parameters, relative: the cube root of rounding
_STEP = 6e-6
_COLUMNS_AT_ONCE = 20_000  # Columns of rates that are evaluated together, to bound memory
_COINCIDENT = 1e-13  # Times that are closer, relative to the horizon, are the same

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


def sensitive_path(
    system: System,
    point: Array,
    edges: Sequence[float],
    tolerances: Tolerances,
    times: Array,
    start: Start,
    rate_slopes: RateSlopes,
    after_jump: Callable[[float, Start], Start] | None = None,
) -> Sensitive:
    """States and derivatives at ascending times (T,); NaN from where the trajectory ends.

    Rates are smooth between ``edges``, from the first to the last of which it goes. At an edge
    ``after_jump`` says what becomes of a state and its derivatives. No derivatives are followed
    where ``start`` has none.
    """
    (n, w), count = start.slopes.shape, times.size
    at = Sensitive(np.full((count, n), np.nan), np.full((count, n, w), np.nan))
    stages = _FEW_STAGES if tolerances.relative >= _LOOSE else _STAGES
    variation = _Variation(system, point, rate_slopes, stages)
    for a, b in itertools.pairwise(edges):
        if after_jump is not None:
            start = after_jump(a, start)
        here = (times >= a) & (times <= b)
        at.states[times == a], at.slopes[times == a] = start
        span = Spans(np.array([a]), start.state[:, None], np.array([b]))
        (path,) = SingleIntegrator().paths(system, point[None], span, tolerances)
        here &= (times > a) & (times <= path.end)
        if path.steps:
            at.states[here] = path(times[here]).T
        if path.steps and w:
            ends = np.append(times[here], path.end)
            slopes = variation.slopes(path, start.slopes, ends)
            at.slopes[here], start = slopes[:-1], Start(path.state, slopes[-1])
        if path.end < b:
            break
        start = start._replace(state=path.state)
    return at


@dataclass(frozen=True)
class _Variation:
    """What derivatives along a trajectory depend on beside the trajectory."""

    system: System
    point: Array
    rate_slopes: RateSlopes
    stages: int

    def slopes(self, path: Path, start: Array, times: Array) -> Array:
        """Derivatives (T, n, w) at times of a path, which has those of the start (n, w) there."""

        def rates(clock: Array, states: Array, _: NDArray[np.intp]) -> Array:
            return self.rate_slopes(clock, states)

        def states(clock: Array) -> Array:
            return path(clock)[:, None]

        forcing = Forcing(rates, start[..., None])
        steps, point = _with_times(path.breaks, times).tolist(), self.point[None]
        slopes = sensitivities(
            self.system, point, states, steps, forcing, times, stages=self.stages, halves=False
        )
        return np.moveaxis(slopes[:, :, 0], 2, 0)


def _with_times(breaks: Array, times: Array) -> Array:
    """Breaks (S + 1,), and those of the times that are not among them."""
    near = _COINCIDENT * (breaks[-1] - breaks[0])
    place = np.clip(np.searchsorted(breaks, times), 1, breaks.size - 1)
    distance = np.minimum(np.abs(times - breaks[place - 1]), np.abs(breaks[place] - times))
    return np.union1d(breaks, times[distance > near])


# --- derivatives with respect to parameters, by differences of the rates ----------------------


class ByParameters:
    """Derivatives of a system at a point (d,) with respect to some of its parameters."""

    def __init__(self, system: System, point: Array, free: Sequence[int]) -> None:
        self.system, self.point, self.free = system, point, list(free)
        steps: Array = _STEP * np.where(point == 0.0, 1.0, np.abs(point))[self.free]
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
        most = max(_COLUMNS_AT_ONCE // max(2 * k, 1), 1)
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
    return sensitive_path(
        system, point, edges, tolerances, times, by.start(), by.rate_slopes, by.after_jump
    )
