"""Models at the times of data, solved or integrated, with derivatives.

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
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from rankone.inference.estimation.tables import Response
from rankone.solution.evaluation.core import SolutionCore, timeline_evaluator
from rankone.solvers.branches import branch_evaluator
from rankone.solvers.outcome import Outcome, SolutionMetadata
from rankone.support.arrays import AT_ONCE, COARSE, COINCIDENT, DIFFERENCE, Array
from rankone.support.budget import WAITING, OutOfBudgetError, charge, limited
from rankone.support.costs import function_cost
from rankone.support.errors import OptionError
from rankone.tensors.branch_evaluator import BranchEvaluator, Tiling
from rankone.tensors.slab import SlabTrain, slab_positions
from rankone.tensors.time_grid import RadauCollocation, insets
from rankone.tensors.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.integrators.integrator import Path, Spans, Tolerances
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.system.system import System
from rankone.trajectories.system.timeline import BranchedTimeline
from rankone.trajectories.system.verdict import Status

# Radau nodes of a step: order five, and three where tolerances are loose
_STAGES, _FEW_STAGES = 3, 2

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
    stages = _FEW_STAGES if tolerances.relative >= COARSE else _STAGES
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


# -----------------------------------------------------------------------------
# Solutions, or integrated problems, at the times of data, with derivatives.


_ABSOLUTE = 1e-6  # Absolute tolerance, in sizes of each state: those of the initial values or data


class IntegratedSolution(SolutionCore):
    """A problem as a fit reads a solution: its values come from trajectories, point by point.

    Parameters
    ----------
    system : System
        What is integrated; events that depend on the states are not differentiated.
    metadata : SolutionMetadata
        The problem; its box may be as wide as one likes.
    rtol : float
        Relative tolerance of the trajectories.
    """

    def __init__(self, system: System, metadata: SolutionMetadata, rtol: float = 1e-5) -> None:
        if system.events:
            raise OptionError(
                "trajectories with events have no sensitivities here",
                remedy="solve the problem on a box and fit in it: solution.fit(...)",
            )
        self.system, self.tolerance = system, rtol
        outcome = Outcome((), Status.UNCHECKED, None, ())
        super().__init__(outcome, metadata)

    @property
    def time(self) -> tuple[float, float]:
        """Start and end of the horizon."""
        return self.metadata.horizon

    failures: tuple[type[BaseException], ...] = (OutOfBudgetError, np.linalg.LinAlgError)
    """Of a trajectory that has no values then."""
    most_work = WAITING
    """Operations of one trajectory."""

    def edges(self, point: Array, end: float) -> list[float]:
        """The start, times at which the system jumps or switches at a point (d,), and an end."""
        start, features = self.metadata.horizon[0], self.system.features
        times = [*features.cuts[0], *self.system.jumps.inside(*self.metadata.horizon)]
        for at, period in features.periodic_cuts[0]:
            first, last = -((at - start) // period), (end - at) // period
            times += (at + period * np.arange(first, last + 1)).tolist()
        if features.n_moving_cuts:
            times += np.ravel(features.moving_cuts(point[:, None])).tolist()
        return [start, *sorted({time for time in times if start < time < end}), end]

    def sensitive(self, point: Array, times: Array, free: Sequence[int]) -> Sensitive:
        """The trajectory at a point (d,) and ascending times, with derivatives by parameters."""
        edges, tolerances = self.edges(point, self.metadata.horizon[1]), self.tolerances(point)
        return sensitive_to_parameters(self.system, point, edges, tolerances, times, free)

    def tolerances(self, point: Array) -> Tolerances:
        """Those at a point (d,); a state that starts at zero has the largest initial value."""
        start = np.abs(self.system.initial(point[:, None])[:, 0])
        sizes = np.where(start > 0.0, start, start.max(initial=0.0) or 1.0)
        return Tolerances(self.tolerance, _ABSOLUTE * sizes[:, None])

    def __reduce__(self) -> tuple[object, ...]:
        specification = self.system.specification  # the functions of a module do not pickle
        assert specification is not None
        return specification.call, (type(self), self.metadata, self.tolerance)

    @cached_property
    def _evaluator(self) -> None:  # type: ignore[override]
        return None


class TrajectoryModel:
    """A :class:`~rankone.inference.estimation.fitted_models.Model` whose values are trajectories.

    Values are NaN where a trajectory ends before the last of the data, or takes too much work.
    """

    def __init__(self, solution: IntegratedSolution, rows: NDArray[np.intp], times: Array) -> None:
        self.solution, self.rows = solution, rows
        self.times, self.places = np.unique(times, return_inverse=True)

    def thinned(self, scale: Array, tolerance: float) -> TrajectoryModel:
        """The same: there is nothing to be made smaller."""
        return self

    def values(self, points: Array) -> Array:
        """Values (N, m); see :meth:`Model.values`."""
        return self.linearised(points, ())[0]

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """Values (N, m) and derivatives (N, m, k); see :meth:`Model.linearised`."""
        count = points.shape[1]
        values = np.full((count, self.rows.size), np.nan)
        slopes = np.full((count, self.rows.size, len(free)), np.nan)
        for j, point in enumerate(points.T):
            with suppress(*self.solution.failures), limited(self.solution.most_work):
                at = self.solution.sensitive(point, self.times, free)
                values[j] = at.states[self.places, self.rows]
                slopes[j] = at.slopes[self.places, self.rows]
        return values, slopes


# -----------------------------------------------------------------------------
# Solutions at the times of data, as functions of the parameters, with derivatives.


_POINTS_AT_ONCE = 1024  # Points that are evaluated together, to bound memory


class Model(Protocol):
    """Values of m data as functions of the parameters."""

    def thinned(self, scale: Array, tolerance: float) -> Model:
        """The model with smaller ranks, within a tolerance of the data times ``scale`` (m,).

        The tolerance is of the root mean square over the box of the norm over all data.
        """

    def values(self, points: Array) -> Array:
        """Values at points (d, N) of all parameters: shape (N, m)."""

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """Values (N, m), and derivatives (N, m, k) with respect to some parameters.

        ``free`` are the positions of k parameters, ascending.
        """


def model_of(
    solution: SolutionCore,
    rows: NDArray[np.intp],
    times: Array,
    response: Response | None = None,
) -> Model:
    """The model of states ``rows`` at times, one each; with doses, where they take their curve."""
    if response is not None:
        return DosedModel(solution, rows, response)
    if isinstance(solution, IntegratedSolution):
        return TrajectoryModel(solution, rows, times)
    return _model_of(solution.outcome, rows, times)


def _model_of(outcome: Outcome, rows: NDArray[np.intp], times: Array) -> Model:
    """The model of what an engine returned."""
    timeline = outcome.timeline
    if outcome.pieces:
        pieces = [_model_of(piece.outcome, rows, times) for piece in outcome.pieces]
        boxes = [piece.metadata.box for piece in outcome.pieces]
        tiling = Tiling.of(boxes, outcome.pieces[0].metadata.parameters)
        return PieceModel(pieces, tiling, times.size)
    if isinstance(timeline, BranchedTimeline):
        branches = branch_evaluator(outcome.slabs, timeline).likeliest()
        return TimelineModel(branches, rows, times)
    if timeline is not None:
        return TimelineModel(timeline_evaluator(outcome.slabs, timeline), rows, times)
    return TrainModel(outcome.slabs, rows, times)


class DosedModel:
    """A :class:`Model` of sums over doses of the curve of one dose."""

    def __init__(self, solution: SolutionCore, rows: NDArray[np.intp], response: Response) -> None:
        acting = np.nonzero(response.weights)
        owner, weights = acting[0], response.weights[acting]
        self._one = model_of(solution, rows[owner], response.times[acting])
        shape = rows.size, owner.size
        self._sum = csr_array((weights, (owner, np.arange(owner.size))), shape=shape)

    def thinned(self, scale: Array, tolerance: float) -> DosedModel:
        """The model with smaller ranks; see :meth:`Model.thinned`."""
        counts = np.diff(self._sum.indptr)  # of doses: the square of their sum is at most this
        each = self._sum.data * np.repeat(scale * np.sqrt(counts), counts)
        fewer = copy(self)
        fewer._one = self._one.thinned(each, tolerance)
        return fewer

    def values(self, points: Array) -> Array:
        """Values (N, m); see :meth:`Model.values`."""
        return np.asarray((self._sum @ self._one.values(points).T).T)

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """Values (N, m) and derivatives (N, m, k); see :meth:`Model.linearised`."""
        values, slopes = self._one.linearised(points, free)
        count, pairs, k = slopes.shape
        moved = self._sum @ slopes.transpose(1, 0, 2).reshape(pairs, count * k)
        return (self._sum @ values.T).T, moved.reshape(-1, count, k).transpose(1, 0, 2)


class TimelineModel:
    """A :class:`Model` of a solution over stretches between events."""

    def __init__(
        self, evaluator: TimelineEvaluator | BranchEvaluator, rows: NDArray[np.intp], times: Array
    ) -> None:
        self.evaluator, self.rows, self.times = evaluator, rows, times

    def thinned(self, scale: Array, tolerance: float) -> TimelineModel:
        """The same: times of events need all digits."""
        return self

    def values(self, points: Array) -> Array:
        """Values (N, m); see :meth:`Model.values`."""
        table = np.empty((points.shape[1], self.times.size))
        for row in np.unique(self.rows):
            here = np.flatnonzero(self.rows == row)
            at = self.times[here][:, None]
            for begin in range(0, points.shape[1], _POINTS_AT_ONCE):
                block = slice(begin, begin + _POINTS_AT_ONCE)
                states = self.evaluator.curves(at, points[:, block], np.array([row]))
                table[block, here] = states[0].T
        return table

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """Values (N, m) and derivatives (N, m, k); see :meth:`Model.linearised`."""
        count = points.shape[1]
        values = np.empty((count, self.times.size))
        slopes = np.empty((count, self.times.size, len(free)))
        for row in np.unique(self.rows):
            here = np.flatnonzero(self.rows == row)
            at = np.broadcast_to(self.times[here][:, None], (here.size, count))
            states, moved = self.evaluator.linearised(at, points, np.array([row]), free)
            values[:, here], slopes[:, here] = states[0].T, moved[0].swapaxes(0, 1)
        return values, slopes


class TrainModel:
    """States ``rows`` of a solution at fixed times, one each, as functions of the parameters.

    The first core of the train is evaluated at the times once. Each point of the box then takes a
    product of small matrices, and each derivative the same product with one matrix replaced.
    """

    def __init__(self, slabs: Sequence[SlabTrain], rows: NDArray[np.intp], times: Array) -> None:
        self.size = times.size
        owner = slab_positions(slabs, times)
        self._groups: list[tuple[SlabTrain, list[tuple[NDArray[np.intp], Array]]]] = []
        for k in np.unique(owner):
            here = np.flatnonzero(owner == k)
            in_time = slabs[k].in_time(times[here])[rows[here], np.arange(here.size)]
            same = (group for slab, group in self._groups if slab.shares_parameters(slabs[k]))
            group = next(same, None)
            if group is None:
                self._groups.append((slabs[k], group := []))
            group.append((here, in_time))

    def thinned(self, scale: Array, tolerance: float) -> TrainModel:
        """The model with smaller ranks, within a tolerance of the data times ``scale`` (m,).

        The tolerance is of the root mean square over the box of the norm over all data.
        """
        thinned = copy(self)
        thinned._groups = []
        for slab, group in self._groups:
            places = np.concatenate([here for here, _ in group])
            first = np.concatenate([in_time for _, in_time in group]) * scale[places, None]
            train = slab.train.with_first(first).right_orthonormal()
            train, _ = train.truncated(tolerance / np.sqrt(len(self._groups)))
            smaller = replace(slab, train=train.with_first(slab.cores[0]))
            thinned._groups.append((smaller, [(places, train.first / scale[places, None])]))
        return thinned

    def values(self, points: Array) -> Array:
        """Values at points (d, N) of all parameters: shape (N, m)."""
        table = np.empty((points.shape[1], self.size))
        for begin in range(0, points.shape[1], _POINTS_AT_ONCE):
            block = slice(begin, begin + _POINTS_AT_ONCE)
            for slab, group in self._groups:
                products = slab.over_parameters(points[:, block])
                for here, in_time in group:
                    table[block, here] = (in_time @ products).T
        return table

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """Values (N, m), and derivatives (N, m, k) with respect to some parameters.

        ``free`` are the positions of k parameters, ascending.
        """
        count, columns = points.shape[1], 1 + len(free)
        table = np.empty((self.size, count, columns))
        for slab, group in self._groups:
            products = slab.with_slopes(points, free)
            for here, in_time in group:
                table[here] = (in_time @ products).reshape(here.size, count, columns)
        moved = table.transpose(1, 0, 2)
        return moved[:, :, 0], moved[:, :, :0:-1]


class PieceModel:
    """A :class:`Model` of pieces that tile a box."""

    def __init__(self, pieces: Sequence[Model], tiling: Tiling, size: int) -> None:
        self.pieces, self.tiling, self.size = tuple(pieces), tiling, size

    def thinned(self, scale: Array, tolerance: float) -> PieceModel:
        """The model with smaller ranks; see :meth:`Model.thinned`."""
        pieces = [piece.thinned(scale, tolerance) for piece in self.pieces]
        return PieceModel(pieces, self.tiling, self.size)

    def values(self, points: Array) -> Array:
        """Values (N, m); see :meth:`Model.values`."""
        table = np.empty((points.shape[1], self.size))
        for position, here in self.tiling.groups(points):
            table[here] = self.pieces[position].values(points[:, here])
        return table

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """Values (N, m) and derivatives (N, m, k); see :meth:`Model.linearised`."""
        values = np.empty((points.shape[1], self.size))
        slopes = np.empty((*values.shape, len(free)))
        for position, here in self.tiling.groups(points):
            own = self.pieces[position].linearised(points[:, here], free)
            values[here], slopes[here] = own
        return values, slopes
