"""Observables and their noise at the measurements, with derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.calibration.conditions import Settings
from rankone.calibration.records import Assigned, Records, Series
from rankone.calibration.simulation import States
from rankone.estimation.duals import Dual, Operand, with_shape
from rankone.estimation.formulas import Formula
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
