"""Trajectories at many parameter points, integrated together as one stacked system by SciPy.

By Taylor series where the rates are polynomials in the states, else by DOP853, with the generated
pointwise right-hand side; by Radau where a trajectory is stiff.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import DOP853

from rankone.support.arrays import NEGLIGIBLE, SAMPLES, Array
from rankone.support.budget import OutOfBudgetError, Reached, charge, foresee, hold, work_done
from rankone.support.costs import CALL, READ, Cost, function_cost
from rankone.tensors.time_grid import inset
from rankone.trajectories.integrators.defects import DefectControl
from rankone.trajectories.integrators.diagnosis import decays_faster, switching_state
from rankone.trajectories.integrators.integrator import (
    EARLY_STEPS,
    LAST_GAP,
    NODES,
    Path,
    SampledTrajectories,
    Spans,
    Tolerances,
    paths_over_shares,
)
from rankone.trajectories.stacks.explicit import Piece, Rates, StackedDOP853, Stepper
from rankone.trajectories.stacks.implicit import Collocation, StackedRadau
from rankone.trajectories.stacks.kinks import Kinks
from rankone.trajectories.stacks.newton import implicit_step_cost, jacobians_for, stages_for
from rankone.trajectories.stacks.taylor import StackedTaylor, TaylorSeries, TaylorTerms
from rankone.trajectories.system.features import OfStates
from rankone.trajectories.system.system import System


@dataclass(frozen=True)
class _Probes:
    """When a stack looks whether stability limits its steps, and when it gives up."""

    first: tuple[int, ...]
    early: int
    lasting: float
    pointless_steps: float
    interval: int
    refusals: int
    most_tiny_steps: int
    telling_steps: int
    telling_share: float
    implicit_steps: int


_PROBES = _Probes(
    first=(10, 15, 20, 30),  # Explicit steps before stability is probed
    # Explicit steps before it is probed whether a decay that has lasted for some of its times, and
    # would limit so many steps if it goes on, makes more of them pointless
    early=5,
    lasting=5.0,
    pointless_steps=3000.0,
    interval=100,  # Steps between later probes: each costs a Jacobian and its eigenvalues
    refusals=10,  # Refused steps after which stability is probed as well
    most_tiny_steps=1000,  # Tiny steps in a row that end a trajectory
    telling_steps=100,  # Steps that tell how many are left: those of a transient are fewer
    telling_share=0.01,  # Part of the horizon after which fewer do
    implicit_steps=20,  # Implicit steps at least, whatever the time that is left
)
_RADAU_TOLERANCE = 4.0  # Factor on tolerances of Radau, whose error estimate is cautious
_SMOOTH_DEGREE = 4  # Degree of polynomial rates up to which nothing is narrow over the states
# Rates of a step of DOP853 and of what reads it
_DOP853_STAGES: int = DOP853.n_stages + len(DOP853.A_EXTRA)
_STAGE_COST = Cost(8 * CALL, 5)  # Operations besides the rates: once, and for each number
_STEP_COST = Cost(40 * CALL, 5)  # Operations of a step besides its stages

# Starts an integration of rates from a time and states to an end
_Method: TypeAlias = Callable[[Rates, tuple[float, float], Array], Stepper]
_Record: TypeAlias = "_DenseRecord | _SampleRecord"  # Keeps something of each step


@dataclass(frozen=True)
class StackedIntegrator:
    """An :class:`Integrator` whose steps suit all trajectories at once.

    It begins with Radau if ``stiff``; otherwise Radau takes over where explicit steps, of a Taylor
    series or of DOP853, meet stiffness. So many ``bearable_steps`` are cheaper than those of Radau
    although stability limits them, and less accurate in between. With ``looks_anywhere`` steps are
    checked at random places too, and not only at state surfaces. Systems that separate are never
    checked: polynomials in the states are not narrow over them. ``watch`` is called with the time
    after each step, and may end the integration by an exception.
    """

    stiff: bool = False
    bearable_steps: int = 0
    looks_anywhere: bool = False
    watch: Callable[[float], None] | None = None

    def run(
        self, system: System, points: Array, edges: Sequence[float], tolerances: Tolerances
    ) -> StackedTrajectories:
        """Trajectories at all times; see :meth:`Integrator.run`."""
        stack = _Stack(system, points, edges, tolerances, self)
        record = _DenseRecord((edges[0], edges[-1]), stack.shape)
        try:
            state, avoided = stack.integrate(record)
        except OutOfBudgetError as out:
            raise out.at(record.reached(system, points)) from out
        return record.trajectories(state, avoided)

    def sample(
        self,
        system: System,
        points: Array,
        edges: Sequence[float],
        tolerances: Tolerances,
        times: Array,
    ) -> SampledTrajectories:
        """Trajectories at ascending times; see :meth:`Integrator.sample`."""
        stack = _Stack(system, points, edges, tolerances, self)
        record = _SampleRecord(times, stack.shape)
        state, _ = stack.integrate(record)
        return SampledTrajectories(record.states, record.reached, record.end, state, "stack")

    def paths(
        self, system: System, points: Array, spans: Spans, tolerances: Tolerances
    ) -> Sequence[Path]:
        """Trajectories of spans of their own; see :meth:`SpanIntegrator.paths`."""
        return paths_over_shares(self.run, system, points, spans, tolerances)


def sampling_cost(system: System, tolerance: float, steps: float, m: int, times: int) -> float:
    """Operations of sampling m trajectories at some times, which take DOP853 so many steps.

    By its rates, or by its Taylor series where those cost less.
    """
    n = system.n_differential
    step = _dop853_step_cost(n * m, function_cost(system.rhs)(m))
    if has_smooth_rates(system, system.horizon[0]):
        step = min(step, TaylorTerms.of(system).cost(tolerance, m))
    return steps * (step + READ.once) + times * n * m * READ.each


def _dop853_step_cost(size: int, rates: float) -> float:
    """Operations of a step of DOP853 of a stack of so many numbers, at those of its rates."""
    return _DOP853_STAGES * (rates + _STAGE_COST(size)) + _STEP_COST(size)


def has_smooth_rates(system: System, start: float) -> bool:
    """Whether rates are polynomials of low degree in the states, with no functions of time.

    Then nothing is so narrow that it hides between the stages of a step. Others may say so.
    """
    if system.longest_step is not None:
        return True
    if not system.separated or len(system.time_factors(np.array([start]))) > 1:
        return False
    degrees = [len(states) for *_, states in system.terms]
    return bool(degrees) and max(degrees) <= _SMOOTH_DEGREE


@dataclass(frozen=True)
class StackedTrajectories:
    """Dense trajectories of common ``pieces``: steps from one of the ``times`` to the next.

    Fulfils :class:`DenseTrajectories`.
    """

    times: tuple[float, ...]
    pieces: tuple[Piece, ...]
    state: Array
    largest: Array
    early: Array
    avoided: float
    integrator: str = "stack"

    @property
    def start(self) -> float:
        return self.times[0]

    @property
    def end(self) -> float:
        return self.times[-1]

    @property
    def steps(self) -> int:
        return len(self.pieces)

    @property
    def has_begun(self) -> bool:
        return bool(self.pieces)

    @property
    def last(self) -> Array:
        if not self.pieces:
            return self.state
        return np.asarray(self.pieces[-1](self.end).reshape(self.state.shape))

    @property
    def method(self) -> str:
        return self.pieces[-1].method if self.pieces else "DOP853"

    def __call__(self, times: Array) -> Array:
        """States at times (T,), after a jump at its time: shape (n, m, T)."""
        descends = bool((times[1:] < times[:-1]).any())
        order = np.argsort(times, kind="stable") if descends else None
        ascending = times if order is None else times[order]
        stacked = np.empty((times.size, self.state.size))
        ends = np.searchsorted(ascending, self.times[1:-1])
        borders = np.concatenate([[0], ends, [times.size]])
        for alike in self._alike:
            alike.read(
                ascending, borders[alike.first : alike.first + len(alike.pieces) + 1], stacked
            )
        if order is not None:
            stacked[order] = stacked.copy()
        return stacked.T.reshape(*self.state.shape, -1)

    @cached_property
    def _alike(self) -> list[_AlikePieces]:
        """The pieces, those in a row together whose rows have the same weights."""
        kinds, first, alike = [(piece.method, len(piece.rows)) for piece in self.pieces], 0, []
        for _, group in itertools.groupby(kinds):
            last = first + len(list(group))
            alike.append(_AlikePieces.of(first, self.pieces[first:last]))
            first = last
        return alike

    def of(self, trajectories: slice) -> StackedTrajectories:
        """Some of the trajectories; see :meth:`DenseTrajectories.of`."""
        pieces = tuple(piece.of(trajectories, len(self.state)) for piece in self.pieces)
        state, largest = self.state[:, trajectories], self.largest[:, trajectories]
        early = self.early[:, trajectories]
        return replace(self, pieces=pieces, state=state, largest=largest, early=early)

    @cached_property
    def paths(self) -> tuple[Path, ...]:
        ends = [piece.ends for piece in self.pieces]
        breaks = np.concatenate([self.times[:1], *ends])
        within = breaks[:-1, None] + np.diff(breaks)[:, None] * NODES
        (n, m), (steps, nodes) = self.state.shape, within.shape
        nodal, first = np.empty((m, steps, nodes, n)), 0
        for piece, parts in zip(self.pieces, map(len, ends), strict=True):
            here = slice(first, first + parts)
            states = piece.at(within[here].ravel()).reshape(parts, nodes, n, m)
            nodal[:, here] = states.transpose(3, 0, 1, 2)
            first += parts
        nodal[:, :-1, -1] = nodal[:, 1:, 0]  # after a jump, and the same to the last bit
        return tuple(Path(breaks, *each) for each in zip(nodal, self.state.T, strict=True))

    def samples(self, count: int) -> Iterator[tuple[float, Array]]:
        """Ends of steps with the states there; see :meth:`DenseTrajectories.samples`."""
        ends = [
            (i, part, end)
            for i, piece in enumerate(self.pieces)
            for part, end in enumerate(piece.ends.tolist())
        ]
        chosen = ends[:: max(1, len(ends) // count)]
        for i, part, end in chosen:
            yield end, self.pieces[i].at_ends[part].reshape(self.state.shape)


@dataclass(frozen=True)
class _AlikePieces:
    """Pieces in a row, from the ``first``, whose rows have the same weights at the same shares.

    The pieces begin at ``starts`` (k,), and their shares are in ``units`` (k,).
    """

    first: int
    pieces: tuple[Piece, ...]
    starts: Array
    units: Array

    @classmethod
    def of(cls, first: int, pieces: tuple[Piece, ...]) -> _AlikePieces:
        starts, units = zip(*((piece.t_old, piece.h) for piece in pieces), strict=True)
        return cls(first, pieces, np.array(starts), np.array(units))

    def read(self, times: Array, borders: NDArray[np.intp], stacked: Array) -> None:
        """Read states (T, n m) at ascending times (T,), which each piece has between borders."""
        counts, own = np.diff(borders), times[borders[0] : borders[-1]]
        shares = (own - np.repeat(self.starts, counts)) / np.repeat(self.units, counts)
        weights = self.pieces[0].weights(shares)
        places = (borders - borders[0]).tolist()
        states = stacked[borders[0] : borders[-1]]
        for piece, (a, b) in zip(self.pieces, itertools.pairwise(places), strict=True):
            if a < b:
                piece.weighted(weights[a:b], states[a:b])


class _DenseRecord:
    """Keeps all steps over a horizon with their dense output.

    It takes no steps that are divided at kinks: paths have one polynomial in each. Samples alone
    begin with long ones.
    """

    is_sampled = False

    def __init__(self, horizon: tuple[float, float], shape: tuple[int, int]) -> None:
        self.horizon, self.shape = horizon, shape
        self.begin(horizon[0])

    def begin(self, start: float) -> None:
        self.times, self.steps, self.parts = [start], list[Piece](), 0
        self.work_before = work_done()
        self.largest = self.early = np.zeros(self.shape)

    def add(self, solver: Stepper) -> None:
        piece = solver.dense_output().kept()
        left = self._steps_left(solver)
        hold(piece, piece.nbytes, left * piece.nbytes)
        foresee(left * (work_done() - self.work_before) / (len(self.steps) + 1))
        self.times.append(solver.t)
        self.steps.append(piece)
        sizes = np.abs(piece.at_ends).max(axis=0).reshape(self.shape)
        self.largest, self.parts = np.maximum(self.largest, sizes), self.parts + piece.parts
        if self.parts <= EARLY_STEPS:
            self.early = self.largest

    def _steps_left(self, solver: Stepper) -> float:
        """Steps up to the end, if their length grows with a power of the time; 0 in a transient.

        Steps in a transient grow, others keep their length. Of a step ``h t**(1 - p)`` the power
        ``p`` is the mean length so far over the last one. A last one that is short, as after a
        cut, tells less than the mean.
        """
        start, end = self.horizon
        done, steps = float(solver.t - start), len(self.steps) + 1
        if steps < _PROBES.telling_steps and done < _PROBES.telling_share * (end - start):
            return 0.0
        mean = done / steps
        last = max(float(solver.step_size), mean)
        power = mean / last
        return done / last * math.expm1(power * math.log((end - start) / done)) / power

    def trajectories(self, state: Array, avoided: float) -> StackedTrajectories:
        steps = tuple(self.times), tuple(self.steps)
        return StackedTrajectories(*steps, state, self.largest, self.early, avoided)

    def reached(self, system: System, points: Array) -> Reached:
        end, switch = self.times[-1], None
        if self.steps:
            states = self.steps[-1](end).reshape(self.shape)
            length = self.horizon[1] - self.horizon[0]
            switch = switching_state(system, end, states, points, length)
        return Reached(end, len(self.steps), None if switch is None else switch[0])


class _SampleRecord:
    """Keeps the states at given times."""

    is_sampled = True

    def __init__(self, times: Array, shape: tuple[int, int]) -> None:
        self.times, self.states = times, np.empty((times.size, *shape))
        self.reached, self.end = 0, 0.0

    def begin(self, start: float) -> None:
        self.reached, self.end = 0, start

    def add(self, solver: Stepper) -> None:
        """Keep the states at the times that a step passes."""
        self.end = solver.t
        last = int(np.searchsorted(self.times, solver.t, side="right"))
        if last > self.reached:
            charge(READ((last - self.reached) * self.states[0].size))
            passed = slice(self.reached, last)
            out = self.states[passed].reshape(last - self.reached, -1)
            solver.dense_output().at(self.times[passed], out)
            self.reached = last


@dataclass(frozen=True)
class _SegmentRates:
    """Stacked rates at times from ``first`` to ``last``; parameters have shape (d, m)."""

    rhs: OfStates
    parameters: Array
    first: float
    last: float
    cost: Cost

    def __call__(self, t: float, y: Array) -> Array:
        m = self.parameters.shape[1]
        charge(self.cost(m) + _STAGE_COST(y.size))
        time = min(max(t, self.first), self.last)
        return self.rhs(time, y.reshape(-1, m), self.parameters).ravel()

    def at(self, times: Array, states: Array) -> Array:
        k, m = len(times), self.parameters.shape[1]
        charge(self.cost(k * m) + _STAGE_COST(states.size))
        within = np.minimum(np.maximum(times, self.first), self.last)
        columns = states.reshape(k, -1, m).swapaxes(0, 1)
        rates = self.rhs(within[:, None], columns, self.parameters[:, None])
        return rates.swapaxes(0, 1).reshape(k, -1)

    def of(self, columns: NDArray[np.intp]) -> Callable[[Array, Array], Array]:
        """Rates (n, c) of some trajectories, at times (c,) and states (n, c)."""
        p = self.parameters[:, columns]

        def rates(times: Array, states: Array) -> Array:
            charge(self.cost(columns.size) + _STAGE_COST(states.size))
            return self.rhs(np.clip(times, self.first, self.last), states, p)

        return rates


@dataclass(frozen=True)
class _Stack:
    """One integration of a system at points (m, d)."""

    system: System
    points: Array
    edges: Sequence[float]
    tolerances: Tolerances
    options: StackedIntegrator

    @property
    def shape(self) -> tuple[int, int]:
        return self.system.n_differential, len(self.points)

    @cached_property
    def parameters(self) -> Array:
        return np.ascontiguousarray(self.points.T)

    def integrate(self, record: _Record) -> tuple[Array, float]:
        """The last state (n, m), and the explicit steps left when they were given up."""
        control = None
        if not self.system.separated:
            control = DefectControl(self.system, self.points, self.options.looks_anywhere)
        avoided = np.inf
        with np.errstate(all="ignore"):
            if not self.options.stiff:
                kinks = Kinks.of(self.system, self.parameters) if record.is_sampled else None
                explicit = partial(
                    StackedDOP853,
                    tolerances=self.tolerances,
                    control=control,
                    kinks=kinks,
                    smooth=record.is_sampled and has_smooth_rates(self.system, self.edges[0]),
                )
                if (series := self._series()) is not None:
                    explicit = partial(StackedTaylor, tolerances=self.tolerances, series=series)
                state, avoided = self._steps(explicit, record, self._explicit_steps_left)
                if not avoided:
                    return state, avoided
            implicit = partial(
                StackedRadau,
                tolerances=self.tolerances.times(_RADAU_TOLERANCE),
                control=control,
                collocation=Collocation(
                    jacobians_for(self.system, self.points),
                    looks_between=not has_smooth_rates(self.system, self.edges[0]),
                    stages=stages_for(self.system, self.tolerances.relative),
                ),
            )
            state, _ = self._steps(implicit, record, lambda solver, count: 0.0)
        return state, avoided

    def _series(self) -> TaylorSeries | None:
        """The Taylor series of the rates, where it costs less than DOP853."""
        system, p, start = self.system, self.parameters, self.edges[0]
        if not has_smooth_rates(system, start):
            return None
        terms, tolerance = TaylorTerms.of(system), self.tolerances.relative
        n, m = self.shape
        rates = function_cost(system.rhs, system.user_functions)(m)
        if terms.cost(tolerance, m) > _dop853_step_cost(n * m, rates):
            return None
        some = p[:, :: max(m // SAMPLES, 1)]
        state = system.initial(some)
        if not terms.at(system, some).agrees(state, system.rhs(start, state, some)):
            return None
        return terms.at(system, p)

    def _steps(
        self, method: _Method, record: _Record, steps_left: Callable[[Stepper, int], float]
    ) -> tuple[Array, float]:
        """Step over all segments: the last state, and the steps left if the method is given up."""
        state = self.system.initial(self.parameters)
        record.begin(self.edges[0])
        count = tiny = 0
        tiny_step = NEGLIGIBLE * (self.edges[-1] - self.edges[0])
        for a, b in itertools.pairwise(self.edges):
            kind = self.system.jumps.kind_at(a)
            if kind is not None:
                state = self.system.jumps.jumped(kind, state, self.parameters)
                if a != self.edges[0]:
                    rates = self.system.rhs(a, state, self.parameters)
                    if not (np.isfinite(state).all() and np.isfinite(rates).all()):
                        return state, 0.0
            solver = method(self._rates(a, b), (a, b), state)
            while solver.status == "running":
                charge(_STEP_COST(state.size))
                solver.step()
                if solver.status == "failed":
                    if b - solver.t <= LAST_GAP * np.spacing(abs(b)):
                        break
                    return state, 0.0
                record.add(solver)
                if self.options.watch is not None:
                    self.options.watch(solver.t)
                state, count = solver.y.reshape(self.shape), count + 1
                tiny = tiny + 1 if solver.step_size < tiny_step else 0
                if tiny == _PROBES.most_tiny_steps:
                    return state, 0.0
                left = steps_left(solver, count)
                if left:
                    return state, left
        return state, 0.0

    def _rates(self, a: float, b: float) -> _SegmentRates:
        """The stacked right-hand side on a segment; factors are never taken at its very ends."""
        near = inset(a, b) if len(self.edges) > 2 else 0.0
        cost = function_cost(self.system.rhs, self.system.user_functions)
        return _SegmentRates(self.system.rhs, self.parameters, a + near, b - near, cost)

    @cached_property
    def _cheaper_steps(self) -> float:
        """Explicit steps that cost less than the implicit ones of a system of many states."""
        implicit = implicit_step_cost(self.system)
        if implicit is None:
            return 0.0
        n, rates = self.shape[0], function_cost(self.system.rhs, self.system.user_functions)
        explicit = _DOP853_STAGES * (rates.each + _STAGE_COST(n) - _STAGE_COST(0.0))
        return _PROBES.implicit_steps * implicit / explicit

    def _explicit_steps_left(self, solver: Stepper, count: int) -> float:
        """The explicit steps left, if stability limits them and they are not bearable; else 0.

        Stability limits a step by the fastest rate of decay at the present state. The error
        estimate lets unstable steps pass while what they amplify is small; defect control refuses
        them, and a fifth of their length is stable. So the length that was refused counts. At the
        first probe stability need not limit a step yet, if it would limit very many.
        """
        probes = count in (_PROBES.early, *_PROBES.first) or count % _PROBES.interval == 0
        if not probes and solver.refusals < _PROBES.refusals:
            return 0.0
        longest, ahead = solver.longest_tried(), self.edges[-1] - solver.t
        left = float(ahead / solver.step_size)
        bearable = max(self.options.bearable_steps, self._cheaper_steps, solver.steps_kept)
        early = count == _PROBES.early
        if left <= (max(bearable, _PROBES.pointless_steps) if early else bearable):
            return 0.0
        rate, states = solver.stiff_product / longest, solver.y.reshape(self.shape)
        if early:
            pointless = solver.stiff_product * max(bearable, _PROBES.pointless_steps) / ahead
            rate = max(pointless, _PROBES.lasting / (solver.t - self.edges[0]))
        stiff = decays_faster(self.system, self.points, solver.t, states, rate)
        return left if stiff else 0.0
