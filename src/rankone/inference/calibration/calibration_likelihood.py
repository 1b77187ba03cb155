"""The objective of a calibration problem: states, observables, likelihood."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.calibration.calibrated_parameters import Assigned, Records, Series
from rankone.inference.calibration.dynamics import Dynamics
from rankone.inference.calibration.experiment_conditions import Settings
from rankone.inference.calibration.simulation import Simulation, States
from rankone.inference.estimation.formulas import FUNCTIONS, Dual, Formula, Operand, with_shape
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, ProblemError
from rankone.support.wording import did_you_mean, quote


@dataclass(frozen=True, eq=False)
class _Column:
    """What m measurements take for a name: numbers (m,), or a parameter in the rows (m,) of it."""

    numbers: Array
    parameters: Mapping[str, NDArray[np.bool_]]

    @classmethod
    def of(cls, assigned: Sequence[Assigned]) -> _Column:
        numbers = np.array([np.nan if isinstance(a, str) else a for a in assigned], dtype=float)
        names = dict.fromkeys(a for a in assigned if isinstance(a, str))
        return cls(numbers, {name: np.array([a == name for a in assigned]) for name in names})

    def operand(self, values: Mapping[str, float], by: Sequence[str]) -> Operand:
        """The numbers, with derivatives (m, w) by parameters if there are some."""
        numbers = self.numbers.copy()
        for name, rows in self.parameters.items():
            numbers[rows] = values[name]
        moving = [name for name in self.parameters if name in by]
        if not moving:
            return numbers
        slope = np.zeros((numbers.size, len(by)))
        for name in moving:
            slope[self.parameters[name], by.index(name)] = 1.0
        return Dual(numbers, slope)


class Outputs:
    """Evaluates the formulas of a calibration problem."""

    def __init__(self, records: Records, settings: Settings, states: Sequence[str]) -> None:
        self.records, self.settings, self.states = records, settings, tuple(states)
        self._parameters = {parameter.name for parameter in records.parameters}
        self._columns: dict[tuple[str, str], _Column] = {}
        for series in records.series:
            for column, formula in (
                ("observable", series.observable.formula),
                ("noise", series.observable.noise),
            ):
                self._check(series, column, formula)

    def _check(self, series: Series, column: str, formula: Formula) -> None:
        names = {*self.states, *self._parameters, *self.records.model.parameters, "time"}
        for name in formula.names:
            if name not in names and name not in series.placeholders:
                raise ProblemError(
                    f"the observable table, row {quote(series.observable.name)}, {column} formula: "
                    f"{quote(name)} has no value{did_you_mean(name, names)}",
                    term=name,
                    remedy="give it in the measurement or the parameter table",
                )
        for name, column_of in series.placeholders.items():
            for row, assigned in zip(series.rows, column_of, strict=True):
                if isinstance(assigned, str) and assigned not in self._parameters:
                    raise ProblemError(
                        f"the measurement table, row {row + 1}, gives {quote(name)} the value of "
                        f"{quote(assigned)}, which is no parameter"
                        f"{did_you_mean(assigned, self._parameters)}",
                        term=assigned,
                    )

    def predicted(
        self, series: Series, states: States, values: Mapping[str, float], by: Sequence[str]
    ) -> tuple[Dual, Dual]:
        """The observable and its noise (m,) at the measurements of a series."""
        m, w = series.times.size, len(by)

        def operand(name: str) -> Operand:
            if name in self.states:
                k = self.states.index(name)
                return Dual(states.states[k], states.slopes[k]) if w else states.states[k]
            return self._column(series, name).operand(values, by)

        with np.errstate(all="ignore"):
            observable, noise = (
                with_shape(formula({name: operand(name) for name in formula.names}), (m,), w)
                for formula in (series.observable.formula, series.observable.noise)
            )
        self._check_prediction(series, observable.value)
        return observable, noise

    def parameters_of(self, series: Series, formula: Formula) -> dict[str, tuple[str, ...]]:
        """For each name of a formula that is no state the parameters of the table behind it."""
        return {
            name: tuple(self._column(series, name).parameters)
            for name in formula.names
            if name not in self.states
        }

    def _column(self, series: Series, name: str) -> _Column:
        """What the measurements of a series take for a name that is no state."""
        key = series.observable.name, name
        if key not in self._columns:
            self._columns[key] = _Column.of(self._assigned(series, name))
        return self._columns[key]

    def _assigned(self, series: Series, name: str) -> Sequence[Assigned]:
        if name in series.placeholders:
            return series.placeholders[name]
        if name == "time":
            return [float(at) for at in series.times]
        if name not in self.records.model.parameters:
            return [name] * series.times.size
        experiments = [self.records.experiments[int(e)] for e in series.experiments]
        return [self.settings.at[each.condition.name][name] for each in experiments]

    def _check_prediction(self, series: Series, predicted: Array) -> None:
        """Raise if an observable has no value, or no logarithm where that is compared."""
        positive = series.observable.transformation != "lin"
        wrong = np.flatnonzero(~np.isfinite(predicted) | (positive & ~(predicted > 0.0)))
        if wrong.size:
            row, value = series.rows[int(wrong[0])] + 1, predicted[wrong[0]]
            what = ", which has no logarithm," if np.isfinite(value) else ""
            raise EvaluationError(
                f"the observable {quote(series.observable.name)} is {value:.6g}{what} at row "
                f"{row} of the measurement table",
                term=series.observable.name,
                remedy="the parameters are probably far from those of the data",
            )

    def check_noise(self, series: Series, noise: Array) -> None:
        """Raise if a standard deviation is not positive."""
        wrong = np.flatnonzero(~(noise > 0.0))
        if wrong.size:
            row = series.rows[int(wrong[0])] + 1
            raise ProblemError(
                f"the noise of {quote(series.observable.name)} is {noise[wrong[0]]:.6g} at row "
                f"{row} of the measurement table",
                term=series.observable.name,
                remedy="noise has to be positive; change the formula or its parameters",
            )


# -----------------------------------------------------------------------------
# The objective of a calibration problem, in two steps: states, and what is observed of them.


ACCURACY = 1e-9
"""Relative tolerance of the trajectories of an objective, unless another one is asked for."""


class Simulated(NamedTuple):
    """States at the measurements of each series, with derivatives by the parameters ``by``."""

    by: tuple[str, ...]
    states: tuple[States, ...]

    def widened(self, k: int, by: Sequence[str]) -> States:
        """Those of one series, with derivatives by more parameters, on which no state depends."""
        own = self.states[k]
        slopes = np.zeros((*own.states.shape, len(by)))
        columns = [(by.index(name), j) for j, name in enumerate(self.by) if name in by]
        for to, of in columns:
            slopes[..., to] = own.slopes[..., of]
        return States(own.states, slopes)


class Evaluator:
    """Evaluates the objective; the model is compiled when a number is first asked for."""

    def __init__(self, records: Records, settings: Settings) -> None:
        self.records, self.settings = records, settings
        self.parameters = {parameter.name: parameter for parameter in records.parameters}

    @cached_property
    def simulation(self) -> Simulation:
        """What follows the states."""
        return Simulation(self.records, self.settings, Dynamics(self.records, self.settings))

    @cached_property
    def outputs(self) -> Outputs:
        """What observes them."""
        states = self.simulation.dynamics.system.states
        return Outputs(self.records, self.settings, states)

    def simulated(
        self,
        values: Mapping[str, float],
        by: Sequence[str],
        accuracy: float,
        *,
        quick: bool = False,
    ) -> Simulated:
        """States at values of all parameters; see :meth:`Simulation.states`."""
        active = tuple(name for name in self.settings.active if name in by)
        with np.errstate(all="ignore"):  # what overflows ends a trajectory, which is said
            states = self.simulation.states(values, active, accuracy, quick=quick)
        return Simulated(active, tuple(states))

    def terms(
        self, series: Series, states: States, values: Mapping[str, float], by: Sequence[str]
    ) -> tuple[Terms, Array, Array]:
        """What a series adds to the objective, its predictions (m,) and their noise (m,)."""
        predicted, noise = self.outputs.predicted(series, states, values, by)
        self.outputs.check_noise(series, noise.value)
        of = series.observable
        added = terms(of.distribution, of.transformation, series.measurements, predicted, noise)
        return added, predicted.value, noise.value

    def evaluated(
        self, simulated: Simulated, values: Mapping[str, float], by: tuple[str, ...]
    ) -> Evaluation:
        """The objective at simulated states, with derivatives by some parameters."""
        count = sum(series.times.size for series in self.records.series)
        total, residuals, jacobians = 0.0, list[Array](), list[Array]()
        standardised, at_rows, noises = np.empty((3, count))
        for k, series in enumerate(self.records.series):
            added, predicted, noise = self.terms(series, simulated.widened(k, by), values, by)
            total += float(added.costs.sum())
            residuals.append(added.residuals)
            jacobians.append(added.jacobian)
            rows = list(series.rows)
            standardised[rows], at_rows[rows], noises[rows] = added.standardised, predicted, noise
        slopes = np.array([self.parameters[name].slope(values[name]) for name in by])
        jacobian, residual = np.concatenate(jacobians) * slopes, np.concatenate(residuals)
        gradient = jacobian.T @ residual
        for name, parameter in self.parameters.items():
            prior = parameter.prior_terms(values[name])
            total += prior.cost
            if name in by:
                gradient[by.index(name)] += prior.residual * prior.slope
        return Evaluation(by, total, gradient, residual, jacobian, standardised, at_rows, noises)


# -----------------------------------------------------------------------------
# The objective of a calibration problem: minus the logarithm of the likelihood, and of priors.
#
# Beside it there are pseudo-residuals rho and their Jacobian J such that J^T rho is the gradient of
# the likelihood's part and J^T J the Fisher information, also where parameters move the noise
# (Seber & Wild, Nonlinear Regression, 1989, ch. 2.8 and 14). Laplace's density has both as well,
# though its gradient jumps where a residual vanishes.


_ROOT_OF_TWO = math.sqrt(2.0)


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


class Terms(NamedTuple):
    """What m measurements add: minus log L (m,), pseudo-residuals (2 m,), their Jacobian (2 m, w).

    ``standardised`` (m,) are deviations over the noise.
    """

    costs: Array
    residuals: Array
    jacobian: Array
    standardised: Array


def terms(
    distribution: str, transformation: str, measured: Array, predicted: Dual, noise: Dual
) -> Terms:
    """What measurements (m,) of an observable add to the objective."""
    constant = np.zeros(measured.size)
    if transformation != "lin":
        name = transformation
        constant = np.log(measured) + (math.log(math.log(10.0)) if name == "log10" else 0.0)
        measured = np.log(measured) if name == "log" else np.log10(measured)
        predicted = FUNCTIONS[name](predicted)  # type: ignore[assignment]
    s = noise.value
    r = (predicted.value - measured) / s
    by_value, by_noise = predicted.slope / s[:, None], noise.slope / s[:, None]
    if distribution == "normal":
        costs = 0.5 * r**2 + np.log(s) + 0.5 * math.log(2.0 * math.pi)
        pseudo = r, (1.0 - r**2) / _ROOT_OF_TWO
        by_noise = _ROOT_OF_TWO * by_noise
    else:
        costs = np.abs(r) + np.log(2.0 * s)
        pseudo = np.sign(r), 1.0 - np.abs(r)
    return Terms(costs + constant, np.concatenate(pseudo), np.concatenate([by_value, by_noise]), r)
