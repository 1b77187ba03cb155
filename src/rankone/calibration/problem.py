"""Calibration problems: what users hold."""

from __future__ import annotations

import html
import math
import numbers
from collections.abc import Mapping, Sequence
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from rankone.calibration.conditioned import Free
from rankone.calibration.conditions import Settings
from rankone.calibration.dynamics import Dynamics
from rankone.calibration.from_files import calibrated
from rankone.calibration.likelihood import Evaluation, terms
from rankone.calibration.of_files import OfFiles
from rankone.calibration.outputs import Outputs
from rankone.calibration.parameters import Parameter, parameter_rows
from rankone.calibration.petab_files import open_petab, records_of
from rankone.calibration.records import Records
from rankone.calibration.result import Calibration
from rankone.calibration.simulation import Simulation
from rankone.calibration.solutions import CalibrationSolutions
from rankone.calibration.solving import free_of, problem_of, solved
from rankone.estimation.posterior import Posterior
from rankone.frontend.problem import Problem
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.options import checked_number
from rankone.support.wording import count, did_you_mean, html_table, quote, shown, text_table

if TYPE_CHECKING:
    import pandas as pd

Box: TypeAlias = "Mapping[str, tuple[float | str, ...]] | Sequence[str] | None"
"""Free parameters by their intervals, or names alone."""
_SPREAD = 1.5  # Factor by which boxes around values go beyond them
_ACCURACY = 1e-9  # Relative tolerance of trajectories
_HEADER = ("parameter", "scale", "lower", "upper", "nominal", "estimated")
_LABELS = 2  # Columns on the left


class CalibrationProblem:
    """A model, experiments, measurements and parameters to estimate, as read from files.

    Made by :func:`rankone.read_petab`. The model is compiled when a number is first asked for, once
    for all conditions.

    Attributes
    ----------
    name : str
        The name of the file.
    parameters : mapping of str to Parameter
        By name, each with ``.scale``, ``.lower``, ``.upper``, ``.nominal``, ``.estimated``.
    conditions, observables, measurements : DataFrame
        The tables, as the package ``petab`` reads them.
    """

    def __init__(self, records: Records, tables: Mapping[str, pd.DataFrame]) -> None:
        self._records, self._tables = records, dict(tables)
        self.name = records.name
        self.parameters: dict[str, Parameter] = {p.name: p for p in records.parameters}
        self._settings = Settings(records)

    @property
    def conditions(self) -> pd.DataFrame:
        """The condition table."""
        return self._tables["conditions"].copy()

    @property
    def observables(self) -> pd.DataFrame:
        """The observable table."""
        return self._tables["observables"].copy()

    @property
    def measurements(self) -> pd.DataFrame:
        """The measurement table."""
        return self._tables["measurements"].copy()

    @property
    def estimated(self) -> tuple[str, ...]:
        """Names of the parameters to estimate, in the order of the table."""
        return tuple(name for name, p in self.parameters.items() if p.estimated)

    def objective(
        self, values: Mapping[str, float] | None = None, *, rtol: float = _ACCURACY
    ) -> float:
        """Minus the logarithm of the likelihood of the measurements, and of the priors.

        It is what PEtab defines, with all constants: of each measurement y with prediction f and
        noise s, after the transformation of its observable, log(2 pi s^2)/2 + ((f - y)/s)^2/2 for
        normal noise and log(2 s) + abs(f - y)/s for Laplace's, plus log(y) for the transformation
        ``log`` and log(y log 10) for ``log10``. Of each estimated parameter that has an
        ``objectivePriorType`` it adds minus the logarithm of that density, in the coordinate that
        the type names, not cut at the bounds.

        Parameters
        ----------
        values : mapping of str to float, optional
            Values of parameters, not on their scales; others are nominal.
        rtol : float
            Relative tolerance of the trajectories.

        Raises
        ------
        OptionError
            If there is no such parameter, or one has no value.
        BlowUpError, ConvergenceError
            If a trajectory does not reach the last measurement, or no steady state.
        ProblemError
            If noise is not positive.
        EvaluationError
            If an observable has no value, or no logarithm where that is compared.
        """
        return self._evaluated(values, (), rtol).objective

    def evaluate(
        self, values: Mapping[str, float] | None = None, *, rtol: float = _ACCURACY
    ) -> Evaluation:
        """The objective with its gradient, residuals and their Jacobian.

        Derivatives are forward sensitivities of the trajectories, by the coordinates of the
        estimated parameters: by their logarithms where the table says so.

        Parameters and errors are those of :meth:`objective`.
        """
        return self._evaluated(values, self.estimated, rtol)

    def fit(self, starts: int = 10, seed: int = 0) -> Calibration:
        """Estimate the parameters from random starts within their bounds.

        Nominal values of estimated parameters are not used. Each start of a latin hypercube, on
        the scales of the parameters, goes down by least squares on trajectories and their
        derivatives; then the best ends are moved at random and go down again. The log-likelihoods
        that are reported are those of :meth:`objective`.

        Parameters
        ----------
        starts : int
            Number of random starts.
        seed : int
            Of the random numbers.

        Returns
        -------
        Calibration
            With ``x``, ``log_likelihood``, ``starts``, ``not_identified`` and ``message``.

        Raises
        ------
        OptionError
            If nothing is estimated, or a parameter has no finite bounds on its scale.
        ProblemError
            If rates jump with the states, or where an estimated parameter says.
        """
        self._simulation.check_smooth(self.estimated)
        estimated = [self.parameters[name] for name in self.estimated]

        def quick(values: Mapping[str, float], rtol: float) -> Evaluation:
            return self._evaluated(values, self.estimated, rtol, quick=True)

        return calibrated(self._records, OfFiles.of(estimated, quick, self.objective), starts, seed)

    def problem(
        self,
        experiment: str | None = None,
        box: Box = None,
        *,
        values: Mapping[str, float] | None = None,
        spread: float = _SPREAD,
    ) -> Problem:
        """The problem of one experiment, which is solved as any other.

        Parameters
        ----------
        experiment : str, optional
            ``"condition"``, or ``"before -> condition"`` where it starts at a steady state.
        box, values, spread
            As for :meth:`solve`.
        """
        free = self._free(box, values, spread)
        return problem_of(self._records, self._settings, experiment, free)

    def solve(
        self,
        rtol: float = 1e-4,
        box: Box = None,
        *,
        values: Mapping[str, float] | None = None,
        spread: float = _SPREAD,
        **options: Any,
    ) -> CalibrationSolutions:
        """Solve all experiments over a box of parameters that the states depend on.

        Each experiment has a solution of its own, unless one for all of them is cheaper: if they
        differ in c numbers of the model, and there are more than 4**c of them, these numbers become
        further parameters. Experiments that start at steady states are always solved apart.

        Parameters
        ----------
        rtol : float
            As for :func:`rankone.solve`.
        box : mapping of str to interval, or list of str, optional
            Free parameters with their intervals, in the scale of the table; or names alone, whose
            intervals go from the value ÷ ``spread`` to × ``spread``. By default all estimated
            parameters that states depend on. The others have their values. Parameters that only
            observables and noise have are always free.
        values : mapping of str to float, optional
            Values of parameters; others are nominal.
        spread : float
            The factor for names, larger than 1.
        **options
            Those of :func:`rankone.solve`.

        Returns
        -------
        CalibrationSolutions
            With ``.solutions`` by experiment, ``.fit()`` and ``.posterior()``.

        Raises
        ------
        OptionError
            If a name is not that of a parameter that states depend on.
        ProblemError
            If something of the files has no counterpart in solutions: Laplace's noise, or
            measurements at steady states.
        """
        free = self._free(box, values, spread)
        return solved(self._records, self._settings, free, rtol, options)

    def posterior(
        self,
        rtol: float = 1e-4,
        box: Box = None,
        *,
        values: Mapping[str, float] | None = None,
        spread: float = _SPREAD,
        **options: Any,
    ) -> Posterior:
        """The distribution of the parameters in a box after the data are known.

        Parameters are those of :meth:`solve`; options are those of
        :meth:`CalibrationSolutions.posterior`. Priors are those of the table, and uniform on the
        scale of a parameter where it has none.
        """
        solutions = self.solve(rtol, box, values=values, spread=spread)
        return solutions.posterior(**options)

    def _free(self, box: Box, values: Mapping[str, float] | None, spread: float) -> Free:
        active = self._settings.active
        return free_of(self._records, active, self.point(values), box, spread)

    def point(self, values: Mapping[str, float] | None = None) -> dict[str, float]:
        """Values of all parameters: those given, and nominal ones."""
        point = {name: p.nominal for name, p in self.parameters.items()}
        given: Mapping[Any, Any] = {} if values is None else values
        if not isinstance(given, Mapping):
            raise OptionError(
                f"values are {shown(values)}, not a mapping",
                term=values,
                remedy='write {"k1": 0.1}',
            )
        for name, value in given.items():
            if name not in point:
                raise OptionError(
                    f"there is no parameter {quote(name)}{did_you_mean(str(name), point)}",
                    term=name,
                )
            if not isinstance(value, numbers.Real) or not math.isfinite(value):
                raise OptionError(
                    f"{quote(name)} is {shown(value)}, not a finite number", term=value
                )
            point[name] = float(value)
        for name, number in point.items():
            if math.isnan(number):
                raise OptionError(
                    f"{quote(name)} has no nominal value", term=name, remedy="give its value"
                )
        return point

    def __getstate__(self) -> dict[str, Any]:
        """All but what is compiled, which is made again."""
        compiled = ("_dynamics", "_simulation", "_outputs")
        return {name: own for name, own in vars(self).items() if name not in compiled}

    # -- evaluation -------------------------------------------------------------------------------

    @cached_property
    def _dynamics(self) -> Dynamics:
        return Dynamics(self._records, self._settings)

    @cached_property
    def _simulation(self) -> Simulation:
        return Simulation(self._records, self._settings, self._dynamics)

    @cached_property
    def _outputs(self) -> Outputs:
        return Outputs(self._records, self._settings, self._dynamics.system.states)

    def _evaluated(
        self,
        values: Mapping[str, float] | None,
        by: tuple[str, ...],
        rtol: object,
        *,
        quick: bool = False,
    ) -> Evaluation:
        point = self.point(values)
        accuracy = checked_number("rtol", rtol, 1e-12, 0.1, float)
        active = [name for name in self._settings.active if name in by]
        columns = [by.index(name) for name in active]
        each = self._simulation.states(point, active, accuracy, quick=quick)
        total, residuals, jacobians = 0.0, list[Array](), list[Array]()
        standardised, at_rows, noises = np.empty((3, len(self._tables["measurements"])))
        for series, states in zip(self._records.series, each, strict=True):
            wide = np.zeros((*states.states.shape, len(by)))
            wide[..., columns] = states.slopes
            full = type(states)(states.states, wide)
            predicted, noise = self._outputs.predicted(series, full, point, by)
            self._outputs.check_noise(series, noise.value)
            observable = series.observable
            added = terms(observable.distribution, observable.transformation,
                          series.measurements, predicted, noise)  # fmt: skip
            total += float(added.costs.sum())
            residuals.append(added.residuals)
            jacobians.append(added.jacobian)
            rows = list(series.rows)
            standardised[rows], at_rows[rows] = added.standardised, predicted.value
            noises[rows] = noise.value
        slopes = np.array([self.parameters[name].slope(point[name]) for name in by])
        jacobian = np.concatenate(jacobians) * slopes
        residual = np.concatenate(residuals)
        gradient = jacobian.T @ residual
        for name in self.estimated:
            if (prior := self.parameters[name].prior) is not None:
                cost, slope = prior.cost(point[name])
                total += cost
                if name in by:
                    gradient[by.index(name)] += slope * slopes[by.index(name)]
        return Evaluation(by, total, gradient, residual, jacobian, standardised, at_rows, noises)

    # -- text -------------------------------------------------------------------------------------

    @property
    def _summary(self) -> str:
        records = self._records
        return (
            f"CalibrationProblem {self.name}: {count(len(records.experiments), 'experiment')}, "
            f"{count(len(self._tables['measurements']), 'measurement')} of "
            f"{count(len(records.series), 'observable')}, "
            f"{len(self.estimated)} of {count(len(self.parameters), 'parameter')} to estimate"
        )

    def __repr__(self) -> str:
        rows = parameter_rows(self._records.parameters)
        lines = text_table(self._summary, _HEADER, rows, right=_HEADER[_LABELS:]).splitlines()
        return "\n".join([lines[0], *(f"  {line}" for line in lines[1:])])

    def _repr_html_(self) -> str:
        return html_table(
            html.escape(self._summary), _HEADER, parameter_rows(self._records.parameters)
        )


def read_petab(path: str | PathLike[str]) -> CalibrationProblem:
    """Read a calibration problem from the YAML file of a PEtab problem.

    Version 1 of the format is read, with a model in SBML, by the package ``petab``, whose linter
    checks all tables. The model is followed from time 0; where the measurement table names a
    ``preequilibrationConditionId``, from the steady state under that condition.

    Parameters
    ----------
    path : path
        The YAML file, which names the tables and the model.

    Returns
    -------
    CalibrationProblem

    Raises
    ------
    ProblemError
        If ``petab`` is not installed, a file cannot be read or is not valid, or something is not
        supported; the message names the table and the row.
    """
    problem = open_petab(path)
    records = records_of(problem, path)
    tables = {
        "conditions": problem.condition_df,
        "observables": problem.observable_df,
        "measurements": problem.measurement_df,
    }
    return CalibrationProblem(records, tables)
