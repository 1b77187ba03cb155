"""The objective of a calibration problem: experiments on trajectories, and priors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sympy.core.function import AppliedUndef

from rankone.inference.calibration.records import (
    Condition,
    Free,
    Measured,
    Parameter,
    Records,
    Series,
    Settings,
    SimulatedExperiment,
    measured,
)
from rankone.inference.estimation import fitted_models as sensitivities
from rankone.inference.estimation.experiments import Trial, trials_of
from rankone.inference.estimation.fitted_models import IntegratedSolution, Sensitive, Start
from rankone.inference.estimation.formulas import value_of
from rankone.inference.estimation.free_parameters import FreeParameters
from rankone.inference.estimation.likelihood import Likelihood
from rankone.problem.expressions.boundaries import DISCONTINUOUS, boundaries
from rankone.solution.compiled import CompiledProblem, compile_problem
from rankone.support import errors
from rankone.support.arrays import COARSE, NEGLIGIBLE, SAMPLES, Array
from rankone.support.budget import WAITING
from rankone.support.errors import listing, quote
from rankone.tensors.coordinates import Coordinates
from rankone.trajectories.integrators.integrator import Spans, Tolerances
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.rest import SteadyStates, from_states
from rankone.trajectories.system.system import System

ACCURACY = 1e-9
"""Relative tolerance of the trajectories of an objective, unless another one is asked for."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The objective at a point, with derivatives by the coordinates of k estimated parameters.

    Attributes
    ----------
    parameters : tuple of str
        The k parameters, in the order of the table.
    objective : float
        Minus the logarithm of the likelihood and of the priors that the table has.
    gradient : ndarray (k,)
        By the coordinates on the scales of the parameters.
    residuals : ndarray (r,)
        Pseudo-residuals: two for each measurement, of its value and of its noise.
    jacobian : ndarray (r, k)
        Their derivatives: ``jacobian.T @ residuals`` is the gradient without priors, and
        ``jacobian.T @ jacobian`` the Fisher information.
    standardised : ndarray (m,)
        For each row of the measurement table prediction minus measurement over its noise.
    predicted, noise : ndarray (m,)
        For each row the prediction, and the standard deviation or the scale of its noise.
    """

    parameters: tuple[str, ...]
    objective: float
    gradient: Array
    residuals: Array
    jacobian: Array
    standardised: Array
    predicted: Array
    noise: Array


@dataclass(frozen=True, eq=False)
class _Block:
    """An observable of a trial: its series, and the rows of the table that its data have."""

    series: Series
    rows: NDArray[np.intp]

    @property
    def unit(self) -> float:
        """The standard deviation of the data, or of their logarithms, over the noise formula."""
        laplace = math.sqrt(2.0) if self.series.observable.distribution == "laplace" else 1.0
        logarithm = math.log(10.0) if self.series.observable.transformation == "log10" else 1.0
        return laplace * logarithm

    def check(self, predicted: Array, noise: Array) -> None:
        """Raise if the observable has no value, or no logarithm where that is compared.

        Or if its noise is not positive.
        """
        name = self.series.observable.name
        positive = self.series.observable.transformation != "lin"
        wrong = np.flatnonzero(~np.isfinite(predicted) | (positive & ~(predicted > 0.0)))
        if wrong.size:
            value = predicted[wrong[0]]
            what = ", which has no logarithm," if np.isfinite(value) else ""
            raise errors.EvaluationError(
                f"the observable {quote(name)} is {value:.6g}{what} at row "
                f"{self.rows[wrong[0]] + 1} of the measurement table",
                term=name,
                remedy="the parameters are probably far from those of the data",
            )
        wrong = np.flatnonzero(~(noise > 0.0))
        if wrong.size:
            raise errors.ProblemError(
                f"the noise of {quote(name)} is {noise[wrong[0]] / self.unit:.6g} at row "
                f"{self.rows[wrong[0]] + 1} of the measurement table",
                term=name,
                remedy="noise has to be positive; change the formula or its parameters",
            )


class Objective:
    """Experiments of a calibration problem on trajectories of its model, which is compiled once."""

    def __init__(self, records: Records, settings: Settings) -> None:
        self.records, self.settings = records, settings

    @cached_property
    def model(self) -> CompiledModel:
        """What follows the states; compiled when a number is first asked for."""
        return CompiledModel(self.records, self.settings)

    @cached_property
    def _experiments(self) -> list[Measured]:
        """What was measured in each, with all parameters of the table by name."""
        names = frozenset(parameter.name for parameter in self.records.parameters)
        free = Free({}, names, dict.fromkeys(names, math.nan))
        return [
            measured(self.records, self.settings, k, free)
            for k in range(len(self.records.experiments))
        ]

    @cached_property
    def _blocks(self) -> list[_Block]:
        """Those of all trials, in the order of :attr:`.Likelihood.blocks`."""
        return [
            _Block(series, np.asarray(series.rows)[rows])
            for each in self._experiments
            for series, rows in each.rows.values()
        ]

    def trials(self, rtol: float, exact: bool) -> tuple[Trial, ...]:
        """The experiments at a tolerance of the trajectories."""
        pairs = [
            (ExperimentSolution(self.model, own, rtol, exact), each.experiment)
            for own, each in zip(self.records.experiments, self._experiments, strict=True)
        ]
        return tuple(map(_with_tails, trials_of(pairs), self._experiments))

    def likelihood(self, values: Mapping[str, float]) -> Likelihood:
        """As a function of the estimated parameters, as searches take it; others have values."""
        estimated = [p for p in self.records.parameters if p.estimated]
        check_bounds(estimated)
        self.model.check_smooth([p.name for p in estimated])
        priors = tuple(p for p in estimated if p.distribution is not None)
        return Likelihood(self.trials(COARSE, False), coordinates_of(estimated, values), priors)

    def evaluated(
        self, values: Mapping[str, float], by: tuple[str, ...], rtol: float = ACCURACY
    ) -> Evaluation:
        """The objective at values of all parameters, with derivatives by some."""
        self.model.check_smooth(by)
        parameters = {parameter.name: parameter for parameter in self.records.parameters}
        problem = Likelihood(
            self.trials(rtol, True), coordinates_of([parameters[name] for name in by], values)
        )
        at = np.array([[values[name] for name in by]])
        states, slopes = problem.followed(at)
        each = problem.terms(at, states, slopes)
        predicted, noise, standardised = np.empty(
            (3, sum(s.times.size for s in self.records.series))
        )
        of_value, of_noise = np.empty((2, predicted.size, 1 + len(by)))
        every = [one for trial in problem.predictions(at, states) for one in trial]
        for block, one, terms in zip(self._blocks, every, each, strict=True):
            size, rows = block.rows.size, block.rows
            own, sigma = (np.broadcast_to(value_of(x), (1, size))[0] for x in one)
            block.check(own, sigma)
            predicted[rows], noise[rows] = own, sigma / block.unit
            tails = math.sqrt(2.0) if block.series.observable.distribution == "laplace" else 1.0
            standardised[rows] = tails * terms.standardised[0]
            both = np.concatenate([terms.residuals[0][:, None], terms.jacobian[0]], axis=1)
            of_value[rows], of_noise[rows] = both[:size], both[size:]
        whole = np.concatenate(
            [part[list(s.rows)] for s in self.records.series for part in (of_value, of_noise)]
        )
        scales = np.array([parameters[name].slope(values[name]) for name in by])
        residuals, jacobian = whole[:, 0], whole[:, 1:] * scales
        objective = -problem.log_likelihood(at[0], states)
        gradient = jacobian.T @ residuals
        for name, parameter in parameters.items():
            if parameter.prior is not None:
                cost, slope = parameter.prior.cost(values[name])
                objective += cost
                if name in by:
                    gradient[by.index(name)] += slope * parameter.slope(values[name])
        return Evaluation(
            by, objective, gradient, residuals, jacobian, standardised, predicted, noise
        )


def _with_tails(trial: Trial, own: Measured) -> Trial:
    """A trial with Laplace's noise where the table has it; its scale is that of the formula."""
    noises = []
    for name, noise in zip(trial.observations.names, trial.observations.noises, strict=True):
        if own.rows[name][0].observable.distribution == "laplace":
            kind = "log-laplace" if noise.logarithmic else "laplace"
            noise = replace(noise, distribution=kind, spread=math.sqrt(2.0) * noise.spread)
        noises.append(noise)
    return replace(trial, observations=replace(trial.observations, noises=tuple(noises)))


def coordinates_of(parameters: Sequence[Parameter], values: Mapping[str, float]) -> FreeParameters:
    """Some parameters of the table as coordinates between their bounds; others have values."""
    names = tuple(p.name for p in parameters)
    return FreeParameters(
        names=names,
        positions=tuple(range(len(names))),
        lower=np.array([p.lower for p in parameters]),
        upper=np.array([p.upper for p in parameters]),
        fixed={name: x for name, x in values.items() if name not in names},
        order=tuple(values),
        start=None,
        logarithmic=tuple(p.scale != "lin" for p in parameters),
    )


def check_bounds(parameters: Sequence[Parameter]) -> None:
    """Raise an OptionError if there is none, or bounds are not finite on their scale."""
    if not parameters:
        raise errors.OptionError(
            "no parameter of the table is estimated", remedy="set estimate to 1"
        )
    endless = [
        p.name
        for p in parameters
        if not (math.isfinite(p.scaled(p.lower)) and math.isfinite(p.scaled(p.upper)))
    ]
    if endless:
        raise errors.OptionError(
            f"{listing(endless)} have no finite bounds on their scale",
            term=endless[0],
            remedy="give positive bounds, or the scale `lin`",
        )


# -----------------------------------------------------------------------------
# Experiments of a calibration problem as fits read solutions: values are trajectories.
#
# The model is compiled once, for all experiments. What varies between conditions, and all
# parameters of the table that states depend on, are its parameters; a condition is a point. An
# experiment has the parameters of the table instead.


_SPREAD = 2.0  # Around a nominal value, of the box that the problem is compiled over
_SETTLE = 1e8  # Longest time to a steady state, in horizons
_LATER = (1.0, 1e3)  # Horizons after which rates at rest have to be the same


class CompiledModel:
    """The model of a calibration problem, compiled for all of its experiments."""

    def __init__(self, records: Records, settings: Settings) -> None:
        self.records, self.settings = records, settings
        self.inputs = settings.varying
        self.end = records.last_time or 1.0
        box = {name: _interval(records, settings, name) for name in self.inputs}
        problem = records.model.with_numbers(settings.constant).problem(box, time=(0.0, self.end))
        self.compiled: CompiledProblem = compile_problem(problem)
        self._rested: dict[str, tuple[object, Start]] = {}

    @property
    def system(self) -> System:
        """The generated module."""
        return self.compiled.system

    def check_smooth(self, by: Sequence[str]) -> None:
        """Raise if a parameter of the table that derivatives are asked for decides on jumps."""
        if by and jumps_with_states(self.compiled):
            raise errors.ProblemError(
                "rates jump with the states, and cannot be differentiated yet",
                remedy="ask for the objective alone",
            )
        decisive = deciding_jumps(self.compiled)
        for condition in self.settings.conditions:
            numbers = self.settings.at[condition.name]
            for name in sorted(decisive):
                if numbers[name] in by:
                    raise errors.ProblemError(
                        f"rates jump where {quote(name)} says, and it is estimated: nothing can be "
                        "differentiated by it yet",
                        term=numbers[name],
                        remedy="fix it (estimate 0 in the parameter table)",
                    )

    def at(self, condition: Condition, values: Mapping[str, float], by: Sequence[str]) -> _Point:
        """A condition at values of parameters of the table, with derivatives by some of them."""
        assigned = [self.settings.at[condition.name][name] for name in self.inputs]
        inputs = np.array([values[a] if isinstance(a, str) else a for a in assigned], dtype=float)
        directions = np.array([[float(a == name) for name in by] for a in assigned])
        return _Point(self.system, inputs, directions.reshape(inputs.size, len(by)))

    def rested(self, condition: Condition, values: Mapping[str, float], by: Sequence[str]) -> Start:
        """The steady state under a condition; the last one of each is kept for others."""
        point = self.at(condition, values, by)
        key = point.inputs.tobytes(), point.directions.tobytes()
        if self._rested.get(condition.name, (None,))[0] != key:
            self._rested[condition.name] = key, point.rest(point.start())
        return self._rested[condition.name][1]

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_rested": {}}


class ExperimentSolution(IntegratedSolution):
    """One experiment of a calibration problem.

    Times may be infinite: what is measured at the steady state. Where it is ``exact``, states are
    accurate relative to their sizes, and trajectories that fail raise an error.
    """

    def __init__(
        self,
        model: CompiledModel,
        experiment: SimulatedExperiment,
        rtol: float,
        exact: bool = False,
    ) -> None:
        self.model, self.experiment, self.exact = model, experiment, exact
        conditions = filter(None, (experiment.condition, experiment.before))
        at = [model.settings.at[condition.name] for condition in conditions]
        used = {numbers[name] for numbers in at for name in model.inputs}
        names = tuple(name for name in model.settings.active if name in used)
        box = ((-np.inf, np.inf),) * len(names)
        metadata = replace(model.compiled.metadata(), parameters=names, box=box)
        super().__init__(model.system, metadata, rtol)
        self._coordinates = Coordinates((metadata.time, *names), ((0.0, np.inf), *box))
        count = len(model.records.experiments)
        self.most_work = np.inf if exact else WAITING / count
        self.failures = () if exact else (*IntegratedSolution.failures, errors.RankoneError)

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.model, self.experiment, self.tolerance, self.exact)

    def sensitive(self, point: Array, times: Array, free: Sequence[int]) -> Sensitive:
        """States and derivatives at ascending times, infinite ones at rest."""
        names = self.metadata.parameters
        values, by = dict(zip(names, point.tolist(), strict=True)), [names[j] for j in free]
        with np.errstate(all="ignore"):  # what overflows ends a trajectory, which is said
            here = self.model.at(self.experiment.condition, values, by)
            start = self._begun(here.start(), values, by)
            finite = np.isfinite(times)
            at = Sensitive(
                np.tile(start.state, (times.size, 1)), np.tile(start.slopes, (times.size, 1, 1))
            )
            last = float(times[finite].max(initial=0.0))
            if last > 0.0:
                followed = self._followed(here, start, times[finite], last)
                at.states[finite], at.slopes[finite] = followed
            if not finite.all():
                at.states[~finite], at.slopes[~finite] = here.rest(start)
        return at

    def _begun(self, start: Start, values: Mapping[str, float], by: Sequence[str]) -> Start:
        """The start, or the steady state before, but for what the condition sets."""
        if self.experiment.before is None:
            return start
        rest = self.model.rested(self.experiment.before, values, by)
        assigned = self.experiment.condition.assigned
        kept = np.array([assigned.get(name) is None for name in self.system.states])
        return Start(
            np.where(kept, rest.state, start.state),
            np.where(kept[:, None], rest.slopes, start.slopes),
        )

    def _followed(self, here: _Point, start: Start, times: Array, last: float) -> Sensitive:
        edges = self.edges(here.inputs, last)
        tolerances = _relative_to(start.state, self.tolerance)
        if self.exact:
            looks = np.linspace(0.0, last, SAMPLES)
            still = Start(start.state, np.empty((start.state.size, 0)))
            coarse = here.path(edges, _relative_to(start.state, COARSE), looks, still)
            sizes = np.nanmax(np.abs(coarse.states), axis=0)
            tolerances = Tolerances.down_to(self.tolerance, COARSE * sizes[:, None])
        followed = here.path(edges, tolerances, times, start)
        reached = np.isfinite(followed.states).all(axis=1)
        if not reached.all():
            time = float(times[reached].max(initial=0.0))
            raise errors.BlowUpError(
                f"the trajectory of {quote(self.experiment.name)} cannot be continued beyond "
                f"t = {time:.6g}",
                time=time,
                parameters=dict(zip(self.model.inputs, here.inputs.tolist(), strict=True)),
                remedy="the parameters are probably far from those of the data",
            )
        return followed


@dataclass(frozen=True)
class _Point:
    """The model at ``inputs`` (d,), with derivatives along ``directions`` (d, w) of them."""

    system: System
    inputs: Array
    directions: Array

    @cached_property
    def _moving(self) -> NDArray[np.intp]:
        return np.flatnonzero(self.directions.any(axis=1))

    @cached_property
    def _by(self) -> sensitivities.ByParameters:
        return sensitivities.ByParameters(self.system, self.inputs, self._moving.tolist())

    def start(self) -> Start:
        """The initial values with their derivatives."""
        start = self._by.start()
        return Start(start.state, start.slopes @ self.directions[self._moving])

    def rate_slopes(self, times: Array, states: Array) -> Array:
        """Derivatives (n, w, N) of the rates."""
        along = self.directions[self._moving]
        if not self._moving.size:
            return np.zeros((len(states), along.shape[1], times.size))
        return np.asarray(np.einsum("nkm,kw->nwm", self._by.rate_slopes(times, states), along))

    def path(
        self, edges: Sequence[float], tolerances: Tolerances, times: Array, start: Start
    ) -> Sensitive:
        """States and derivatives at times, from a start on."""
        variation = sensitivities.Variation(self.rate_slopes)
        return sensitivities.sensitive_path(
            self.system, self.inputs, edges, tolerances, times, start, variation
        )

    def rest(self, start: Start) -> Start:
        """The steady state that is reached from a start."""
        horizon = self.system.horizon[1]
        moved = np.concatenate([self.inputs, start.state])
        whole = from_states(self.system, (0.0, _SETTLE * horizon))
        names = (*whole.parameters, *(f"{name}(0)" for name in whole.states))
        box = tuple((float(x), float(x)) for x in moved)
        system = replace(whole, parameters=names, box=box)
        steady = SteadyStates(system, horizon, _SETTLE * horizon, follow=self._ends)
        self._check_rest(start.state)
        try:
            state = steady(moved[:, None])[:, 0]
        except (errors.ConvergenceError, errors.BlowUpError) as error:
            raise errors.ConvergenceError(
                f"no steady state is reached: {error.message}",
                remedy="the parameters are probably far from those of the data",
            ) from None
        self._check_rest(state)
        kept = steady.conserved(moved[:, None])[:, :, 0]
        return Start(state, self._slopes_at_rest(state, kept, start.slopes))

    def _ends(self, states: Array, points: Array, start: float, end: float) -> tuple[Array, Array]:
        """States at the end of trajectories, one by one; see :class:`SteadyStates`."""
        ends, largest = states.copy(), np.abs(states)
        for k, point in enumerate(points[:, : self.inputs.size]):
            span = Spans(np.array([start]), states[:, [k]], np.array([end]))
            tolerances = _relative_to(states[:, k], COARSE)
            (path,) = SingleIntegrator().paths(self.system, point[None], span, tolerances)
            if path.end < end:
                raise errors.BlowUpError(
                    f"a trajectory blows up at t = {path.end:.6g}", time=path.end
                )
            ends[:, k], largest[:, k] = path.state, path.largest()
        return ends, largest

    def _check_rest(self, state: Array) -> None:
        """Raise if rates at rest depend on the time."""
        horizon, columns = self.system.horizon[1], (state[:, None], self.inputs[:, None])
        rates = [self.system.rhs(at, *columns) for at in (0.0, *(f * horizon for f in _LATER))]
        sizes = np.abs(state).max(initial=0.0) / horizon
        if np.abs(np.diff(np.stack(rates), axis=0)).max(initial=0.0) > NEGLIGIBLE * sizes:
            raise errors.ProblemError(
                "rates at a steady state depend on the time",
                remedy="give a condition before the start in which nothing depends on the time",
            )

    def _slopes_at_rest(self, state: Array, kept: Array, slopes: Array) -> Array:
        """Derivatives (n, w) of a steady state: rates vanish and sums are ``kept`` (c, n)."""
        if not slopes.shape[1]:
            return slopes
        n, columns = state.size, (state[:, None], self.inputs[:, None])
        jacobian = np.broadcast_to(self.system.jacobian(0.0, *columns), (n, n, 1))[:, :, 0]
        forced = self.rate_slopes(np.zeros(1), state[:, None])[:, :, 0]
        left = np.concatenate([jacobian, kept])
        rows = np.abs(left).max(axis=1, keepdims=True)
        rows = np.where(rows > 0.0, rows, 1.0)
        right = np.concatenate([-forced, kept @ slopes])
        return np.asarray(np.linalg.lstsq(left / rows, right / rows, rcond=None)[0])


def jumps_with_states(compiled: CompiledProblem) -> bool:
    """Whether rates jump where states cross a threshold: derivatives of trajectories jump there."""
    surfaces = (surface for surface, _ in boundaries(compiled.first_order.rhs, DISCONTINUOUS))
    return any(surface.atoms(AppliedUndef) for surface in surfaces)


def deciding_jumps(compiled: CompiledProblem) -> frozenset[str]:
    """The parameters that decide where rates or initial values jump."""
    form = compiled.first_order
    surfaces = [s for s, _ in boundaries([*form.rhs, *form.initial], DISCONTINUOUS)]
    symbols = {symbol.name for surface in surfaces for symbol in surface.free_symbols}
    return frozenset(symbols & {each.symbol.name for each in form.coordinates[1:]})


def _relative_to(state: Array, accuracy: float) -> Tolerances:
    """Relative to each state's size, to the largest one for those that are zero."""
    sizes = np.abs(state)
    sizes = np.where(sizes > 0.0, sizes, sizes.max(initial=0.0) or 1.0)
    return Tolerances.down_to(accuracy, COARSE * sizes[:, None])


def _interval(records: Records, settings: Settings, name: str) -> tuple[float, ...]:
    """The interval of an input in the box that the problem is compiled over.

    Nothing that is computed depends on it but whether the problem is accepted.
    """
    parameters = {parameter.name: parameter for parameter in records.parameters}
    assigned = {numbers[name] for numbers in settings.at.values()}
    usual = [_usual(parameters[a]) if isinstance(a, str) else a for a in assigned]
    lower, upper = min(usual), max(usual)
    if lower == upper:
        ends = (lower / _SPREAD, lower * _SPREAD) if lower else (0.0, 1.0)
        lower, upper = min(ends), max(ends)
    return lower, upper


def _usual(parameter: Parameter) -> float:
    """The nominal value, or else the middle of the bounds on the scale of the parameter."""
    if np.isfinite(parameter.nominal):
        return parameter.nominal
    ends = parameter.scaled(parameter.lower), parameter.scaled(parameter.upper)
    middle = parameter.value(0.5 * sum(ends))
    if not np.isfinite(middle):
        raise errors.ProblemError(
            f"parameter {quote(parameter.name)} has neither a nominal value nor finite bounds",
            term=parameter.name,
        )
    return middle
