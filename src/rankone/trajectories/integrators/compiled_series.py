"""Trajectories by compiled Taylor series: heyoka, a batch of trajectories at a time.

Each trajectory has its own steps. A step is as long as its series converges fast, relative to the
largest state; the order of the series is the accuracy. So the states are scaled by their absolute
tolerances, and dense trajectories are checked afterwards, state by state and between the ends of
steps. Where heyoka is of no use, another integrator takes over.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, Reached, charge, hold, memory_left, work_left
from rankone.support.costs import CALL, Cost, function_cost
from rankone.trajectories.integrators.integrator import (
    EARLY_STEPS,
    DenseTrajectories,
    Path,
    SampledTrajectories,
    SpanIntegrator,
    Spans,
    Tolerances,
)
from rankone.trajectories.integrators.series import (
    Taylor,
    compilation_cost,
    order_of,
    taylor_integrator,
)
from rankone.trajectories.stacks.stack import has_smooth_rates
from rankone.trajectories.system.system import System

_MOST_STEPS = 20_000  # Steps from which a trajectory is stiff, or ends: implicit steps are cheaper
_MOST_DENSE_STEPS = 3000  # The same where all steps are kept, which takes ten times longer
_MOST_COEFFICIENTS = 3e7  # Coefficients of dense trajectories that fit into memory: 240 MB
_COPIES = 3  # Copies of them: as they are made, of each trajectory, and of all
_BATCH_COST = 10.0 * CALL  # Operations of one batch, besides its steps
_LANE_STEP = Cost(60.0, 0.13)  # Operations of a step: once, and for each product of coefficients
_GRID_STATE = Cost(45.0, 0.7)  # Operations of a time of the grid: once, and for each coefficient
_DENSE_STEP = 20.0 * CALL  # Operations of a step of a batch whose coefficients are kept
_CHECK_COST = 15.0  # Operations of evaluating a state of dense trajectories
_USUAL_BATCH = 4  # Trajectories in a batch, where costs are predicted
_STEPS_RATIO, _SAME_ACCURACY = 1.2, 3e-9  # Steps of series over those of DOP853 at an accuracy
_DOP853_POWER = 0.125  # Steps of DOP853 fall with this power of the tolerance; those of series stay
_TRUNCATED = math.exp(-2.0)  # Size of the first term that a series leaves out, over the last one
_MOST_ERROR = 10.0  # Largest such term, in tolerances of its state
_PLACES = 2  # Random places in each step at which the defect is looked at
_MOST_DEFECT = 300.0  # Largest defect there, times the step, in tolerances


def steps_ratio(accuracy: float) -> float:
    """Steps of series over those of DOP853 at an accuracy, a relative tolerance."""
    return float(_STEPS_RATIO * (accuracy / _SAME_ACCURACY) ** _DOP853_POWER)


def sampling_cost(system: System, accuracy: float, dop853_steps: float, times: int) -> Cost:
    """Operations of sampling at some times: once for the compilation, and for each trajectory.

    The trajectories take DOP853 so many steps at the ``accuracy``, a relative tolerance.
    """
    order, steps = order_of(accuracy), steps_ratio(accuracy) * dop853_steps
    on_grid = times * _GRID_STATE(system.n_differential * (order + 1))
    each = steps * _step_cost(system, order) + on_grid + _BATCH_COST / _USUAL_BATCH
    return Cost(compilation_cost(system, order), each)


def _step_cost(system: System, order: int) -> float:
    """Operations of a step of one trajectory."""
    return _LANE_STEP(function_cost(system.rhs).each * (order + 1.0) ** 2)


class _Series(NamedTuple):
    """Steps: their starts and lengths, and the coefficients of their powers of time.

    A step of a batch of B trajectories has shapes (B,), (B,) and (n, order + 1, B).
    """

    starts: Array
    lengths: Array
    coefficients: Array

    def of_lane(self, lane: int) -> _Series:
        """The steps of one trajectory of those of a batch, but for those of length zero."""
        some = self.lengths[:, lane] > 0.0
        return _Series(*(steps[some, ..., lane] for steps in self))


class _Fails(Exception):
    """The series are of no use: a trajectory ends, is stiff, or is not resolved."""


@dataclass(frozen=True)
class CompiledIntegrator:
    """An :class:`Integrator` of a system that :func:`has_series`.

    ``accuracy`` is the finest relative tolerance of a solve: one integrator serves all. What is not
    integrated in this way is left to the integrator ``otherwise``, from the start.
    """

    otherwise: SpanIntegrator
    accuracy: float

    def run(
        self, system: System, points: Array, edges: Sequence[float], tolerances: Tolerances
    ) -> DenseTrajectories:
        """Trajectories at all times; see :meth:`Integrator.run`."""
        batches = _Batches(system, points, edges, tolerances, self.accuracy)
        try:
            with np.errstate(all="ignore"):
                dense = batches.dense()
                if not batches.resolved(dense):
                    raise _Fails
                hold(dense, dense.coefficients.nbytes)
                return dense
        except _Fails:
            return self.otherwise.run(system, points, edges, tolerances)
        except OutOfBudgetError as out:  # one trajectory after the other: no time has all of them
            raise out.at(Reached(edges[0], 0, None)) from out

    def sample(
        self,
        system: System,
        points: Array,
        edges: Sequence[float],
        tolerances: Tolerances,
        times: Array,
    ) -> SampledTrajectories:
        """Trajectories at ascending times; see :meth:`Integrator.sample`."""
        batches = _Batches(system, points, edges, tolerances, self.accuracy)
        try:
            with np.errstate(all="ignore"):
                return batches.sampled(times)
        except _Fails:
            return self.otherwise.sample(system, points, edges, tolerances, times)

    def paths(
        self, system: System, points: Array, spans: Spans, tolerances: Tolerances
    ) -> Sequence[Path]:
        """Paths, which are not compiled; see :meth:`SpanIntegrator.paths`."""
        return self.otherwise.paths(system, points, spans, tolerances)


@dataclass(frozen=True)
class TaylorTrajectories:
    """Dense trajectories by their series; fulfils :class:`DenseTrajectories`.

    The steps of one trajectory follow those of the other, the ``first`` (m + 1,) of each. A step
    has its ``starts`` (S,), its ``lengths`` (S,) and ``coefficients`` (order + 1, S, n) of the
    powers of the time since.
    """

    first: NDArray[np.intp]
    starts: Array
    lengths: Array
    coefficients: Array
    start: float
    end: float
    state: Array
    avoided: float = 0.0
    integrator: str = "compiled"
    method: str = "Taylor"

    @property
    def steps(self) -> int:
        return int(np.diff(self.first).max())

    @property
    def has_begun(self) -> bool:
        return self.end > self.start

    @cached_property
    def last(self) -> Array:
        return np.asarray(self(np.array([self.end]))[:, :, 0])

    @cached_property
    def _sizes(self) -> Array:
        """Absolute values at the ends of steps, (S, n)."""
        return np.asarray(np.abs(self.within(np.arange(self.starts.size), self.lengths)))

    @property
    def largest(self) -> Array:
        return np.asarray(np.maximum.reduceat(self._sizes, self.first[:-1]).T)

    @property
    def early(self) -> Array:
        numbers = np.arange(self.starts.size) - np.repeat(self.first[:-1], np.diff(self.first))
        sizes = np.where(numbers[:, None] < EARLY_STEPS, self._sizes, 0.0)
        return np.asarray(np.maximum.reduceat(sizes, self.first[:-1]).T)

    def within(self, steps: NDArray[np.intp], times: Array) -> Array:
        """States at times (S,) since the starts of steps (S,), (S, n)."""
        states: Array = self.coefficients[-1, steps]
        for coefficients in self.coefficients[-2::-1]:
            states = states * times[:, None] + coefficients[steps]
        return states

    def slopes(self, times: Array) -> Array:
        """Slopes at a time since the start of each step, (S, n)."""
        order = len(self.coefficients) - 1
        slopes: Array = order * self.coefficients[-1]
        for k in range(order - 1, 0, -1):
            slopes = slopes * times[:, None] + k * self.coefficients[k]
        return slopes

    def __call__(self, times: Array) -> Array:
        """States at times (T,), after a jump at its time: shape (n, m, T)."""
        steps = np.concatenate(
            [
                a + np.maximum(np.searchsorted(self.starts[a:b], times, side="right") - 1, 0)
                for a, b in itertools.pairwise(self.first)
            ]
        )
        since = np.tile(times, len(self.first) - 1) - self.starts[steps]
        states = self.within(steps, since).T
        return np.asarray(states.reshape(-1, len(self.first) - 1, times.size))

    def of(self, trajectories: slice) -> TaylorTrajectories:
        """Some of the trajectories; see :meth:`DenseTrajectories.of`."""
        a, b, _ = trajectories.indices(len(self.first) - 1)
        steps = slice(self.first[a], self.first[b])
        return replace(
            self,
            first=self.first[a : b + 1] - self.first[a],
            starts=self.starts[steps],
            lengths=self.lengths[steps],
            coefficients=self.coefficients[:, steps],
            state=self.state[:, trajectories],
        )

    def samples(self, count: int) -> list[tuple[float, Array]]:
        """Ends of steps of the trajectory that has most, with the states of all there."""
        longest = int(np.argmax(np.diff(self.first)))
        steps = slice(self.first[longest], self.first[longest + 1], max(1, self.steps // count))
        ends = np.minimum(self.starts[steps] + self.lengths[steps], self.end)
        return list(zip(ends.tolist(), np.moveaxis(self(ends), 2, 0), strict=True))


@dataclass(frozen=True)
class _Batches:
    """One integration of a system at points (m, d), batch by batch."""

    system: System
    points: Array
    edges: Sequence[float]
    tolerances: Tolerances
    accuracy: float

    @cached_property
    def parameters(self) -> Array:
        return np.ascontiguousarray(self.points.T)

    @cached_property
    def initial(self) -> Array:
        return self.system.initial(self.parameters)

    @cached_property
    def order(self) -> int:
        return order_of(min(self.accuracy, self.tolerances.relative))

    @cached_property
    def scales(self) -> Array:
        """The scales of states, (n, 1): the largest initial value in units of its own is one."""
        absolute = np.broadcast_to(self.tolerances.absolute, (len(self.initial), 1))
        if not (absolute > 0.0).all():
            raise _Fails
        largest = float((np.abs(self.initial) / absolute).max(initial=0.0))
        return absolute * largest if 0.0 < largest < np.inf else absolute / absolute.max()

    @cached_property
    def step_cost(self) -> float:
        return _step_cost(self.system, self.order)

    def begin(self) -> Taylor:
        """The integrator, with room for the scales."""
        if not np.isfinite(self.initial).all():
            raise _Fails
        return taylor_integrator(self.system, self.order)

    def begun(self, a: float, state: Array) -> Array:
        """The states (n, m) after the jump at the begin of a segment, if there is one."""
        kind = self.system.jumps.kind_at(a)
        return state if kind is None else self.system.jumps.jumped(kind, state, self.parameters)

    def batched(self, rows: Array, lanes: int) -> Array:
        """Rows (r, m) as batches (b, r, lanes); the last trajectory fills the last batch."""
        count = rows.shape[1]
        missing, batches = -count % lanes, -(-count // lanes)
        padded = np.concatenate([rows, np.repeat(rows[:, -1:], missing, axis=1)], axis=1)
        return np.ascontiguousarray(padded.reshape(len(rows), batches, lanes).swapaxes(0, 1))

    def unbatched(self, batches: Array) -> Array:
        """Batches (b, ..., lanes) as (..., m)."""
        joined = np.moveaxis(batches, 0, -2)
        return joined.reshape(*joined.shape[:-2], -1)[..., : len(self.points)]

    def starts(self, taylor: Taylor, time: float, state: Array) -> Iterator[int]:
        """The number of each batch, when the integrator is at its start."""
        lanes = taylor.batch_size
        scales = self.scales + np.zeros((1, len(self.points)))
        parameters = np.concatenate([self.parameters, scales])[: len(taylor.pars)]
        scaled = self.batched(state / self.scales, lanes)
        states, pars = taylor.state, taylor.pars
        for k, batch in enumerate(self.batched(parameters, lanes)):
            charge(_BATCH_COST)
            taylor.set_time(time)
            states[:], pars[:] = scaled[k], batch
            yield k

    def allowed_steps(self) -> int:
        """The steps of a trajectory that the budget has left, at most."""
        return max(1, int(min(_MOST_STEPS, work_left() / self.step_cost)))

    def sampled(self, times: Array) -> SampledTrajectories:
        """Trajectories at times (T,)."""
        taylor = self.begin()
        states = np.empty((times.size, *self.initial.shape))
        states[times <= self.edges[0]] = self.initial
        state, lanes = self.initial, taylor.batch_size
        n, m = state.shape
        longest = self.tolerances.longest_step
        for a, b in itertools.pairwise(self.edges):
            state = self.begun(a, state)
            first, last = np.searchsorted(times, (a, b), side="right")
            grid = np.unique([a, *times[first:last], b])
            repeated = np.repeat(grid[:, None], lanes, axis=1)
            cost = lanes * grid.size * _GRID_STATE(n * (self.order + 1))
            ends = np.empty((n, m))
            for k in self.starts(taylor, a, state):
                charge(cost)
                allowed = self.allowed_steps()
                columns = slice(k * lanes, min((k + 1) * lanes, m))
                passed = taylor.propagate_grid(repeated, max_steps=allowed, max_delta_t=longest)[1]
                passed = passed[:, :, : columns.stop - columns.start]
                steps = [steps for *_, steps in taylor.propagate_res]
                charge(self.step_cost * sum(steps))
                if max(steps) >= allowed < _MOST_STEPS and not np.isfinite(passed).all():
                    charge(self.step_cost * allowed)  # the budget ends here, not the series
                states[first:last, :, columns] = passed[1 : 1 + last - first]
                ends[:, columns] = passed[-1]
            states[first:last] *= self.scales
            state = ends * self.scales
            if not np.isfinite(state).all():
                raise _Fails
        return SampledTrajectories(states, times.size, self.edges[-1], state, "compiled")

    def dense(self) -> TaylorTrajectories:
        """Trajectories by the series of all their steps."""
        taylor = self.begin()
        n, count = self.initial.shape
        lanes = taylor.batch_size
        kept: list[list[_Series]] = [[] for _ in range(count)]
        state, coefficients = self.initial, 0
        for a, b in itertools.pairwise(self.edges):
            state, ends = self.begun(a, state), []
            for k in self.starts(taylor, a, state):
                steps = self.stepped(taylor, a, b)
                coefficients += len(steps) * n * (self.order + 1) * lanes
                if coefficients > min(_MOST_COEFFICIENTS, memory_left() / (8.0 * _COPIES)):
                    raise _Fails
                stacked = _Series(*map(np.array, zip(*steps, strict=True)))
                for lane, trajectory in enumerate(kept[k * lanes : (k + 1) * lanes]):
                    trajectory.append(stacked.of_lane(lane))
                ends.append(taylor.state.copy())
            state = self.unbatched(np.array(ends)) * self.scales
        pieces = [piece for trajectory in kept for piece in trajectory]
        counts = [sum(piece.starts.size for piece in trajectory) for trajectory in kept]
        series = _Series(*map(np.concatenate, zip(*pieces, strict=True)))
        return TaylorTrajectories(
            first=np.cumsum([0, *counts]),
            starts=series.starts,
            lengths=series.lengths,
            coefficients=np.moveaxis(series.coefficients, 2, 0) * self.scales[:, 0],
            start=self.edges[0],
            end=self.edges[-1],
            state=state,
        )

    def stepped(self, taylor: Taylor, a: float, b: float) -> list[_Series]:
        """Steps of a batch over a segment.

        A trajectory that is at the end makes steps of length zero.
        """
        time, series, cost = (
            taylor.time,
            taylor.tc,
            _DENSE_STEP + taylor.batch_size * self.step_cost,
        )
        steps: list[_Series] = []
        while (left := b - time).any():
            if len(steps) >= _MOST_DENSE_STEPS:
                raise _Fails
            charge(cost)
            if self.tolerances.longest_step < math.inf:
                left = np.minimum(left, self.tolerances.longest_step)
            start = time.copy()
            try:
                taylor.step(left, True)
            except ValueError:  # the state is not finite, and so no time is left
                raise _Fails from None
            steps.append(_Series(start, time - start, series.copy()))
        if not np.isfinite(taylor.state).all():
            raise _Fails
        return steps

    def resolved(self, dense: TaylorTrajectories) -> bool:
        """Whether all steps are as accurate as they should be.

        Each state counts, by the term that its series leave out. Between the ends of steps
        something narrow may be hidden, unless the rates are smooth: there the series satisfy the
        equations at random places.
        """
        count, n = dense.starts.size, len(self.scales)
        charge(_CHECK_COST * (self.order + 1) * n * count)
        steps = np.arange(count)
        ends = dense.within(steps, dense.lengths)
        absolute = np.broadcast_to(self.tolerances.absolute, (n, 1))[:, 0]
        sizes = np.maximum(np.abs(dense.coefficients[0]), np.abs(ends))
        tolerated = absolute + self.tolerances.relative * sizes
        last = np.abs(dense.coefficients[-1]) * dense.lengths[:, None] ** self.order
        if not (_TRUNCATED * last <= _MOST_ERROR * tolerated).all():
            return False
        if has_smooth_rates(self.system, self.edges[0]):
            return True
        rates, generator = self.system.rhs, np.random.default_rng(20144)
        parameters = np.repeat(self.parameters, np.diff(dense.first), axis=1)
        for _ in range(_PLACES):
            times = generator.random(count) * dense.lengths
            charge(function_cost(rates)(count) + 2.0 * _CHECK_COST * (self.order + 1) * n * count)
            states, slopes = dense.within(steps, times), dense.slopes(times)
            defects = slopes - rates(dense.starts + times, states.T, parameters).T
            errors = np.abs(defects) * dense.lengths[:, None]
            if not (errors <= _MOST_DEFECT * tolerated).all():
                return False
        return True
