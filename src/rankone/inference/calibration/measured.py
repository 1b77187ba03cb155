"""Measurements of a calibration problem as experiments that solutions are fitted to."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.calibration.calibrated_parameters import Assigned, Records, Series
from rankone.inference.calibration.experiment_conditions import Free, Settings
from rankone.inference.estimation.experiments import Experiment
from rankone.inference.estimation.formulas import Formula
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.support.wording import quote

_LOG_10 = repr(math.log(10.0))


class Measured(NamedTuple):
    """What was measured in an experiment, and by label the series and the rows in it."""

    experiment: Experiment
    rows: dict[str, tuple[Series, NDArray[np.intp]]]


def measured(records: Records, settings: Settings, position: int, free: Free) -> Measured:
    """What was measured in one experiment, for solutions with what is free."""
    experiment = records.experiments[position]
    numbers = settings.at[experiment.condition.name]
    times: dict[str, Array] = {}
    data: dict[str, Array] = {}
    observe: dict[str, str] = {}
    sigma: dict[str, str] = {}
    noise: dict[str, str] = {}
    places: dict[str, tuple[Series, NDArray[np.intp]]] = {}
    for series in records.series:
        for label, rows, placeholders in _groups(series, position, free):
            places[label] = series, rows
            names = {**{n: free.number(a) for n, a in numbers.items() if n not in free.inputs},
                     **placeholders, "time": records.model.time.name}  # fmt: skip
            deviation = _text(series.observable.noise, names, free)
            if series.observable.transformation == "log10":
                deviation = f"{_LOG_10} * ({deviation})"
            if series.observable.transformation != "lin":
                noise[label] = "log-normal"
            times[label], data[label] = series.times[rows], series.measurements[rows]
            observe[label] = _text(series.observable.formula, names, free)
            sigma[label] = deviation
    fixed = {name: float(numbers[name]) for name in free.inputs}
    own = Experiment(
        data,
        times,
        fixed=fixed,
        observe=observe,
        sigma=sigma,
        noise=noise or None,
        name=experiment.name,
    )
    return Measured(own, places)


def _groups(
    series: Series, position: int, free: Free
) -> Iterator[tuple[str, NDArray[np.intp], dict[str, Assigned]]]:
    """The measurements of an experiment that have the same placeholders, with a label for each."""
    here = np.flatnonzero(series.experiments == position)
    groups: dict[tuple[Assigned, ...], list[int]] = {}
    for row in here.tolist():
        key = tuple(free.number(column[row]) for column in series.placeholders.values())
        groups.setdefault(key, []).append(row)
    for i, (key, rows) in enumerate(groups.items(), 1):
        name = series.observable.name
        label = name if len(groups) == 1 else f"{name}_{i}"
        yield label, np.array(rows), dict(zip(series.placeholders, key, strict=True))


def check_solvable(records: Records) -> None:
    """Raise for what solutions over time cannot be fitted to."""
    remedy = "use the objective, which is computed from trajectories"
    for name in (
        s.observable.name for s in records.series if s.observable.distribution != "normal"
    ):
        raise ProblemError(
            f"the noise of {quote(name)} is Laplace's, which fits of solutions do not have",
            term=name,
            remedy=remedy,
        )
    for series in records.series:
        name = series.observable.name
        endless = series.experiments[~np.isfinite(series.times)]
        if endless.size:
            experiment = records.experiments[int(endless[0])]
            raise ProblemError(
                f"{quote(name)} is measured at the steady state in {quote(experiment.name)}, which "
                "solutions over time do not reach",
                term=name,
                remedy=remedy,
            )


def _text(formula: Formula, names: Mapping[str, Assigned], free: Free) -> str:
    """A formula with numbers and other names put in."""

    class Written(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.expr:
            assigned = names.get(node.id, node.id)
            if isinstance(assigned, str) and assigned in free.values:
                assigned = free.number(assigned)
            if isinstance(assigned, str):
                return ast.Name(assigned, ast.Load())
            return _number(assigned)

        def visit_Call(self, node: ast.Call) -> ast.expr:
            return ast.Call(node.func, [self.visit(each) for each in node.args], [])

    return ast.unparse(Written().visit(ast.parse(ast.unparse(formula.body), mode="eval").body))


def _number(number: float) -> ast.expr:
    constant = ast.Constant(abs(number))
    return constant if number >= 0.0 else ast.UnaryOp(ast.USub(), constant)
