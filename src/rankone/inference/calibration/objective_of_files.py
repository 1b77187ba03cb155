"""The objective of a calibration problem: the likelihood of its experiments, and of its priors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.inference.calibration.calibrated_parameters import Parameter, Records, Series
from rankone.inference.calibration.experiment_conditions import Free, Settings
from rankone.inference.calibration.experiment_solutions import (
    COARSE,
    CompiledModel,
    ExperimentSolution,
)
from rankone.inference.calibration.measured import Measured, measured
from rankone.inference.estimation.experiments import Trial, trials_of
from rankone.inference.estimation.formulas import value_of
from rankone.inference.estimation.free_parameters import FreeParameters
from rankone.inference.estimation.likelihood import Likelihood
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError, ProblemError
from rankone.support.wording import listing, quote

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
            raise EvaluationError(
                f"the observable {quote(name)} is {value:.6g}{what} at row "
                f"{self.rows[wrong[0]] + 1} of the measurement table",
                term=name,
                remedy="the parameters are probably far from those of the data",
            )
        wrong = np.flatnonzero(~(noise > 0.0))
        if wrong.size:
            raise ProblemError(
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

    def likelihood(self, values: Mapping[str, float], *, rtol: float = COARSE) -> Likelihood:
        """As a function of the estimated parameters, as searches take it; others have values."""
        estimated = [p for p in self.records.parameters if p.estimated]
        check_bounds(estimated)
        self.model.check_smooth([p.name for p in estimated])
        priors = tuple(p for p in estimated if p.distribution is not None)
        return Likelihood(self.trials(rtol, False), coordinates_of(estimated, values), priors)

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
        raise OptionError("no parameter of the table is estimated", remedy="set estimate to 1")
    endless = [
        p.name
        for p in parameters
        if not (math.isfinite(p.scaled(p.lower)) and math.isfinite(p.scaled(p.upper)))
    ]
    if endless:
        raise OptionError(
            f"{listing(endless)} have no finite bounds on their scale",
            term=endless[0],
            remedy="give positive bounds, or the scale `lin`",
        )
