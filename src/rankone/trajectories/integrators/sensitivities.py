"""Derivatives of trajectories with respect to parameters: stacked, or one by one.

Along a trajectory u of u' = f(t, u, p) they obey the linear equation S' = f_u S + f_p P, with the
directions in the columns of P (Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I,
I.14). It is solved by Radau collocation on steps of the trajectory. What a step does to S does not
depend on S, so that the steps of all trajectories are solved together, and then follow each other.
Steps in which S is not resolved are halved.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.support.errors import ConvergenceError
from rankone.support.precision import AT_ONCE, COINCIDENT, DIFFERENCE
from rankone.tensors.bases.time_grid import RadauCollocation, insets
from rankone.trajectories.integrators.integrator import Path, Spans, Tolerances
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.system.system import System


@dataclass(frozen=True)
class _Resolution:
    """How finely sensitivities are resolved."""

    fine_stages: int
    most_rounds: int
    most_steps: int
    unresolved: float
    small: float


_RESOLUTION = _Resolution(
    fine_stages=5,  # Of the collocation, unless fewer are asked for: order 9 at the ends of steps
    most_rounds=12,  # Rounds in which steps are halved
    most_steps=20_000,
    unresolved=1e-5,  # Last coefficient of S in a step, over its size, above which it is halved
    small=1e-2,  # Share of a state's size that sensitivities are resolved beside, at least
)

Slopes: TypeAlias = Callable[[Array, Array, NDArray[np.intp]], Array]
"""Derivatives (n, w, N) of rates, at times (N,), states (n, N) and the trajectories (N,)."""


@dataclass(frozen=True)
class Forcing:
    """What moves m trajectories: derivatives along w directions of each.

    ``rates`` maps times (N,), states (n, N) and the numbers of trajectories (N,) to the derivatives
    (n, w, N) of the rates, at constant states; ``start`` (n, w, m) are those of the states at the
    start.
    """

    rates: Slopes
    start: Array


def sensitivities(
    system: System,
    points: Array,
    path: Callable[[Array], Array],
    steps: Sequence[float],
    forcing: Forcing,
    times: Array,
    *,
    stages: int = _RESOLUTION.fine_stages,
    halves: bool = True,
) -> Array:
    """Derivatives (n, w, m, T) of trajectories at points (m, d), at times (T,).

    ``path`` gives the states (n, m, T) at times; ``steps`` ascend from the start to the end, and
    rates are smooth in between. Unless it ``halves`` steps, the times should be ends of steps: with
    few ``stages`` derivatives are less accurate in between.

    Raises
    ------
    ConvergenceError
        If they are not resolved by a reasonable number of steps.
    """
    ends = np.array(steps)
    sizes = np.abs(path(ends)).max(axis=2)
    for _ in range(_RESOLUTION.most_rounds):
        collocated = _collocated(system, points, path, ends, forcing, stages)
        coarse = _unresolved(collocated, sizes) if halves else np.zeros(1, dtype=bool)
        if not coarse.any():
            return _at(collocated, ends, times)
        if ends.size > _RESOLUTION.most_steps:
            break
        middles = 0.5 * (ends[:-1] + ends[1:])[coarse]
        ends = np.sort(np.concatenate([ends, middles]))
    raise ConvergenceError(
        "the derivatives of a trajectory with respect to parameters are not resolved by "
        f"{ends.size} steps",
        remedy="the rates may jump where the equations do not say so; ask for values alone",
    )


def _collocated(
    system: System,
    points: Array,
    path: Callable[[Array], Array],
    ends: Array,
    forcing: Forcing,
    stages: int,
) -> Array:
    """Derivatives (K, 1 + stages, n, w, m) at the start and the nodes of each step."""
    n, w, m = forcing.start.shape
    steps = ends.size - 1
    values = np.empty((steps, m, 1 + stages, n, w))
    many = max(1, AT_ONCE // (m * stages * n * (stages * n + n + w)))
    current = np.moveaxis(forcing.start, 2, 0)  # (m, n, w)
    for first in range(0, steps, many):
        some = slice(first, min(first + many, steps))
        ends_of = ends[some.start : some.stop + 1]
        carried, driven = _maps(system, points, path, ends_of, forcing, stages)
        for k in range(some.start, some.stop):
            values[k, :, 0] = current
            current = carried[k - first, :, -1] @ current + driven[k - first, :, -1]
        values[some, :, 1:] = carried @ values[some, :, :1] + driven
    return values.transpose(0, 2, 3, 4, 1)


def _maps(
    system: System,
    points: Array,
    path: Callable[[Array], Array],
    ends: Array,
    forcing: Forcing,
    stages: int,
) -> tuple[Array, Array]:
    """What steps do: (K, m, stages, n, n) times S at the start, and (K, m, stages, n, w) added."""
    scheme = RadauCollocation.of(stages)
    (n, w, m), steps = forcing.start.shape, ends.size - 1
    lengths = np.diff(ends)
    near = insets(ends[:-1], ends[1:])
    times = (ends[:-1] + near)[:, None] + (lengths - 2.0 * near)[:, None] * scheme.nodes
    count = steps * stages
    flat = np.tile(times.ravel(), m)
    states = path(times.ravel()).reshape(n, m * count)
    which = np.repeat(np.arange(m), count)
    jacobian = np.broadcast_to(
        system.jacobian(flat, states, np.ascontiguousarray(points[which].T)), (n, n, m * count)
    )
    slopes = np.broadcast_to(forcing.rates(flat, states, which), (n, w, m * count))
    h = lengths[:, None, None, None, None]
    blocks = h * jacobian.reshape(n, n, m, steps, stages).transpose(3, 2, 4, 0, 1)
    pushes = h * slopes.reshape(n, w, m, steps, stages).transpose(3, 2, 4, 0, 1)
    matrix = np.zeros((steps, m, stages, n, stages, n))
    diagonal = np.arange(n)
    matrix[:, :, :, diagonal, :, diagonal] = scheme.derivative
    node = np.arange(stages)
    matrix[:, :, node, :, node, :] -= np.moveaxis(blocks, 2, 0)
    right = np.empty((steps, m, stages, n, n + w))
    right[..., :n] = scheme.start[:, None, None] * np.eye(n)
    right[..., n:] = pushes
    size = stages * n
    left, sides = matrix.reshape(steps, m, size, size), right.reshape(steps, m, size, n + w)
    solved = np.asarray(np.linalg.solve(left, sides), dtype=float).reshape(right.shape)
    return solved[..., :n], solved[..., n:]


def _unresolved(collocated: Array, sizes: Array) -> Array:
    """The steps (K,) whose last coefficient is too large; ``sizes`` (n, m) are those of states."""
    modal = RadauCollocation.of(collocated.shape[1] - 1).to_modal[-1]
    last = np.abs(np.einsum("s,ksnwm->knwm", modal, collocated))
    largest = np.abs(collocated).max(axis=(0, 1))
    allowed = _RESOLUTION.unresolved * np.maximum(largest, _RESOLUTION.small * sizes[:, None])
    with np.errstate(invalid="ignore"):
        return np.asarray((last > allowed).any(axis=(1, 2, 3)))


def _at(collocated: Array, ends: Array, times: Array) -> Array:
    """Values (n, w, m, T) of the polynomials at times."""
    points = RadauCollocation.of(collocated.shape[1] - 1).points
    step = np.clip(np.searchsorted(ends, times, side="left") - 1, 0, ends.size - 2)
    shares = (times - ends[step]) / (ends[step + 1] - ends[step])
    weights = np.linalg.solve(
        np.vander(points, increasing=True).T, np.vander(shares, points.size, increasing=True).T
    )
    return np.asarray(np.einsum("st,tsnwm->nwmt", weights, collocated[step]))


# -----------------------------------------------------------------------------
# Trajectories one by one with their derivatives with respect to parameters, for searches.
#
# LSODA integrates each trajectory on its own steps, and its sensitivities follow along these, with
# few stages and without further halving: they point a search downhill, and cost little more than
# the trajectory.


# Radau nodes of a step of the sensitivities: order five, and three where tolerances are loose
_STAGES, _FEW_STAGES = 3, 2
_LOOSE = 1e-3  # Relative tolerance from which on fewer nodes are enough
_COLUMNS_AT_ONCE = 20_000  # Columns of rates that are evaluated together, to bound memory

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
    near = COINCIDENT * (breaks[-1] - breaks[0])
    place = np.clip(np.searchsorted(breaks, times), 1, breaks.size - 1)
    distance = np.minimum(np.abs(times - breaks[place - 1]), np.abs(breaks[place] - times))
    return np.union1d(breaks, times[distance > near])


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
