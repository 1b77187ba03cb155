"""Observables and their noise at the measurements, with derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rankone.calibration.conditions import Settings
from rankone.calibration.records import Assigned, Records, Series
from rankone.calibration.simulation import States
from rankone.estimation.duals import Dual, Operand, with_shape
from rankone.estimation.formulas import Formula
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, ProblemError
from rankone.support.wording import did_you_mean, quote


class Outputs:
    """Evaluates the formulas of a calibration problem."""

    def __init__(self, records: Records, settings: Settings, states: Sequence[str]) -> None:
        self.records, self.settings, self.states = records, settings, tuple(states)
        self._parameters = {parameter.name for parameter in records.parameters}
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

        def assigned(numbers: Sequence[Assigned]) -> Operand:
            array = np.array([values[a] if isinstance(a, str) else a for a in numbers], dtype=float)
            slope = np.array([[float(a == name) for name in by] for a in numbers])
            return Dual(array, slope.reshape(m, w))

        def operand(name: str) -> Operand:
            if name in series.placeholders:
                return assigned(series.placeholders[name])
            if name in self.states:
                k = self.states.index(name)
                return Dual(states.states[k], states.slopes[k])
            if name == "time":
                return series.times
            if name in self.records.model.parameters:
                experiments = self.records.experiments
                return assigned(
                    [
                        self.settings.at[experiments[int(e)].condition.name][name]
                        for e in series.experiments
                    ]
                )
            return assigned([name] * m)

        with np.errstate(all="ignore"):
            observable, noise = (
                with_shape(formula({name: operand(name) for name in formula.names}), (m,), w)
                for formula in (series.observable.formula, series.observable.noise)
            )
        self._check_prediction(series, observable.value)
        return observable, noise

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
