"""Solutions, or integrated problems, at the times of data, with derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from rankone.inference.estimation.tables import Response
from rankone.solution.evaluation.core import SolutionCore, timeline_evaluator
from rankone.solvers.branches import branch_evaluator
from rankone.solvers.outcome import Outcome, SolutionMetadata
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, limited
from rankone.support.errors import OptionError
from rankone.tensors.evaluators.branch_evaluator import BranchEvaluator, Tiling
from rankone.tensors.evaluators.timeline_evaluator import TimelineEvaluator
from rankone.tensors.trains.slab import SlabTrain, slab_positions
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.sensitivities import Sensitive, sensitive_to_parameters
from rankone.trajectories.system.system import System
from rankone.trajectories.system.timeline import BranchedTimeline
from rankone.trajectories.system.verdict import Status

_ABSOLUTE = 1e-6  # Absolute tolerance, in sizes of each state: those of the initial values or data
_MOST_WORK = 2e9  # Operations of one trajectory: two seconds, a hundred times what one costs


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
    most_work = _MOST_WORK
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
