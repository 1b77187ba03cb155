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

from rankone.inference.calibration import experiment_objective
from rankone.inference.calibration.calibrate import box_around
from rankone.inference.calibration.petab_files import open_petab, records_of
from rankone.inference.calibration.records import Free, Parameter, Records, Settings, parameter_rows
from rankone.inference.calibration.result import Calibration, linear_reaches
from rankone.inference.calibration.solutions import (
    CalibrationSolutions,
    box_of,
    free_of,
    problem_of,
    solved,
)
from rankone.inference.calibration.trajectory_likelihood import OfFiles
from rankone.inference.estimation.least_squares import Starts, descents
from rankone.inference.estimation.posterior import Posterior
from rankone.problem.problem import Problem
from rankone.support.errors import (
    OptionError,
    check_kind,
    count,
    did_you_mean,
    html_table,
    quote,
    shown,
    text_table,
)
from rankone.support.options import STEP_RTOLS, checked_number, of_keywords, takes_options_of

if TYPE_CHECKING:
    import pandas as pd

Box: TypeAlias = "Mapping[str, tuple[float | str, ...]] | Sequence[str] | None"
"""Free parameters by their intervals, or names alone."""
_SCREENED = 10  # Random points, the best of which is a start
_SPREAD = 1.5  # Factor by which boxes around values go beyond them
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
        self,
        values: Mapping[str, float] | None = None,
        *,
        rtol: float = experiment_objective.ACCURACY,
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
        self,
        values: Mapping[str, float] | None = None,
        *,
        rtol: float = experiment_objective.ACCURACY,
    ) -> experiment_objective.Evaluation:
        """The objective with its gradient, residuals and their Jacobian.

        Derivatives are forward sensitivities of the trajectories, by the coordinates of the
        estimated parameters: by their logarithms where the table says so.

        Parameters and errors are those of :meth:`objective`.
        """
        return self._evaluated(values, self.estimated, rtol)

    @takes_options_of(Starts)
    def fit(self, **options: Any) -> Calibration:
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
        executor : int, concurrent.futures.Executor, distributed.Client or str, optional
            Where starts go down, as for :func:`rankone.solve_many`; the calibration is the same to
            the bit.

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
        begin = of_keywords(Starts, "fit", options).checked()
        values = self.point(dict.fromkeys(self.estimated, 0.0))
        likelihood = OfFiles.of_problem(self._objective, values)
        ways = descents(likelihood, begin, _SCREENED)
        at = ways[0].at
        reaches = linear_reaches(likelihood.names, at, 1.0) if np.isfinite(at.cost) else {}
        return Calibration.of(likelihood, ways, reaches, comparisons=likelihood.comparisons(at))

    def problem(
        self,
        experiment: str | None = None,
        *,
        box: Box = None,
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
        *,
        box: Box = None,
        values: Mapping[str, float] | None = None,
        spread: float = _SPREAD,
        around: Calibration | None = None,
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
        around : Calibration, optional
            Where :meth:`fit` ended: all parameters have its values. Without a ``box`` at most four
            parameters are free, those that the data tell best and tell apart; intervals of names
            are four standard deviations to each side, at most a factor of three.
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
        if around is not None:
            box, values = self._around(around, box, values)
        free = self._free(box, values, spread)
        return solved(self._records, self._settings, free, rtol, options)

    def posterior(
        self,
        rtol: float = 1e-4,
        *,
        box: Box = None,
        values: Mapping[str, float] | None = None,
        spread: float = _SPREAD,
        around: Calibration | None = None,
        **options: Any,
    ) -> Posterior:
        """The distribution of the parameters in a box after the data are known.

        Parameters are those of :meth:`solve`; options are those of
        :meth:`CalibrationSolutions.posterior`. Priors are those of the table, and uniform on the
        scale of a parameter where it has none.
        """
        solutions = self.solve(rtol, box=box, values=values, spread=spread, around=around)
        return solutions.posterior(**options)

    def _free(self, box: Box, values: Mapping[str, float] | None, spread: float) -> Free:
        active = self._settings.active
        return free_of(self._records, active, self.point(values), box, spread)

    def _around(
        self, around: Calibration, box: Box, values: Mapping[str, float] | None
    ) -> tuple[Box, Mapping[str, float]]:
        """The box and the values where a fit ended."""
        check_kind("solve(around=...)", around, Calibration, remedy="give what fit() returned")
        if values is not None:
            raise OptionError("values and around both say where", remedy="leave out one of them")
        if set(around.x) != set(self.estimated):
            raise OptionError("around is the calibration of another problem", term=around)
        if isinstance(box, Mapping):
            return box, around.x
        active, estimated = self._settings.active, [self.parameters[n] for n in self.estimated]
        experiment_objective.check_bounds(estimated)
        if box is not None:
            box_of(self.parameters, active, around.x, box, _SPREAD)  # raises for what is no name
        jacobian = self.evaluate(around.x).jacobian * [p.width for p in estimated]
        free, values = (
            experiment_objective.coordinates_of(estimated, self.point(around.x)),
            self.point(around.x),
        )
        return box_around(free, jacobian, values, active, box), around.x

    def point(self, values: Mapping[str, float] | None = None) -> dict[str, float]:
        """Values of all parameters: those given, and nominal ones."""
        point = {name: p.nominal for name, p in self.parameters.items()}
        changes: Mapping[Any, Any] = {} if values is None else values
        if not isinstance(changes, Mapping):
            raise OptionError(
                f"values are {shown(values)}, not a mapping",
                term=values,
                remedy='write {"k1": 0.1}',
            )
        for name, value in changes.items():
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
        for name, value in point.items():
            if math.isnan(value):
                raise OptionError(
                    f"{quote(name)} has no nominal value", term=name, remedy="give its value"
                )
        return point

    def __getstate__(self) -> dict[str, Any]:
        """All but what is compiled, which is made again."""
        return {name: own for name, own in vars(self).items() if name != "_objective"}

    # -- evaluation -------------------------------------------------------------------------------

    @cached_property
    def _objective(self) -> experiment_objective.Objective:
        return experiment_objective.Objective(self._records, self._settings)

    def _evaluated(
        self, values: Mapping[str, float] | None, by: tuple[str, ...], rtol: object
    ) -> experiment_objective.Evaluation:
        point = self.point(values)
        accuracy = checked_number("rtol", rtol, *STEP_RTOLS, float)
        return self._objective.evaluated(point, by, accuracy)

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
