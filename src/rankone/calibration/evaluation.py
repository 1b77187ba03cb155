"""The objective of a calibration problem, in two steps: states, and what is observed of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rankone.calibration.conditions import Settings
from rankone.calibration.dynamics import Dynamics
from rankone.calibration.likelihood import Evaluation, Terms, terms
from rankone.calibration.outputs import Outputs
from rankone.calibration.records import Records, Series
from rankone.calibration.simulation import Simulation, States
from rankone.support.arrays import Array

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
