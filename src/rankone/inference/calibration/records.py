"""Records of a calibration problem, and the problems and experiments that follow from them."""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy
import sympy as sp
from numpy.typing import NDArray

from rankone.inference.estimation.experiments import Experiment
from rankone.inference.estimation.formulas import Formula
from rankone.problem.models.model import Model
from rankone.problem.problem import Problem
from rankone.problem.steady_start import SteadyState
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError, RankoneWarning, did_you_mean, quote


@dataclass(frozen=True, eq=False)
class Settings:
    """The numbers of the model under each condition of a calibration problem.

    A number is that of the file, unless the table of parameters has a parameter of its name, or the
    condition gives it another one.
    """

    records: Records

    @cached_property
    def conditions(self) -> tuple[Condition, ...]:
        """All that are simulated or come before."""
        listed = (
            condition
            for experiment in self.records.experiments
            for condition in (experiment.before, experiment.condition)
            if condition is not None
        )
        return tuple({condition.name: condition for condition in listed}.values())

    @cached_property
    def at(self) -> Mapping[str, Mapping[str, Assigned]]:
        """For each condition the number, or the parameter, of each parameter of the model."""
        return {condition.name: self._numbers(condition) for condition in self.conditions}

    @cached_property
    def varying(self) -> tuple[str, ...]:
        """The parameters of the model that rates or initial values need and that may vary."""
        model = self.records.model

        def varies(name: str) -> bool:
            assigned = {numbers[name] for numbers in self.at.values()}
            return len(assigned) > 1 or isinstance(next(iter(assigned)), str)

        return tuple(n for n in model.parameters if n in model.used and varies(n))

    @cached_property
    def active(self) -> tuple[str, ...]:
        """The parameters of the table that states depend on, in its order."""
        named = {numbers[name] for numbers in self.at.values() for name in self.varying}
        return tuple(p.name for p in self.records.parameters if p.name in named)

    @cached_property
    def constant(self) -> dict[str, float]:
        """The numbers of those that do not vary, where they are not those of the file."""
        model = self.records.model
        numbers = next(iter(self.at.values()))
        return {
            name: float(numbers[name])
            for name, own in model.parameters.items()
            if name in model.used and name not in self.varying and numbers[name] != own
        }

    def _numbers(self, condition: Condition) -> dict[str, Assigned]:
        records = self.records
        numbers: dict[str, Assigned] = dict(records.model.parameters)
        for parameter in records.parameters:
            if parameter.name in records.starts:
                numbers[records.starts[parameter.name]] = parameter.name
        own = dict(numbers)
        for column, assigned in condition.assigned.items():
            if assigned is not None:
                numbers[records.starts[column]] = self._resolved(condition, column, assigned, own)
        kept = self._kept(condition)
        for name in records.model.used:
            value = numbers[name]
            if name in kept:
                numbers[name] = 0.0
                continue
            if isinstance(value, float) and math.isnan(value):
                raise ProblemError(
                    f"condition {quote(condition.name)} has no value for {quote(name)}, and "
                    "neither the table of parameters nor the model has a number for it",
                    term=name,
                    remedy="fill the cell of the condition table",
                )
        return numbers

    def _kept(self, condition: Condition) -> set[str]:
        """Starts of species that keep their steady states whenever the condition is simulated."""
        experiments = self.records.experiments
        begins = any(
            each.before is condition or (each.before is None and each.condition is condition)
            for each in experiments
        )
        empty = {column for column, assigned in condition.assigned.items() if assigned is None}
        states = {symbol.name for symbol in self.records.model.rates}
        return set() if begins else {self.records.starts[name] for name in empty & states}

    def _resolved(
        self, condition: Condition, column: str, assigned: Assigned, own: Mapping[str, Assigned]
    ) -> Assigned:
        """A number, or a parameter of the table; a cell may also name one of the model."""
        names = {parameter.name for parameter in self.records.parameters}
        if not isinstance(assigned, str) or assigned in names:
            return assigned
        if assigned in own:
            return own[assigned]
        raise ProblemError(
            f"the condition table, row {quote(condition.name)}, gives {quote(column)} the value of "
            f"{quote(assigned)}, which is no parameter{did_you_mean(assigned, names)}",
            term=assigned,
            remedy="add it to the table of parameters",
        )


# -----------------------------------------------------------------------------
# Problems of single experiments: parameters of the table in a box, and numbers for all others.


Interval = tuple[float | str, ...]
"""Lower and upper end of an interval, perhaps with the scale ``"log"``."""


@dataclass(frozen=True, eq=False)
class Free:
    """What is free: parameters of the table that are in the ``box``, by their intervals.

    Beside them the ``outer`` parameters are, which only observables and noise have. ``values`` are
    those of all parameters. ``inputs`` are parameters of the model that become parameters of one
    problem for several experiments.
    """

    box: Mapping[str, Interval]
    outer: frozenset[str]
    values: Mapping[str, float]
    inputs: Mapping[str, Interval] = field(default_factory=dict)

    def number(self, assigned: Assigned) -> Assigned:
        """A number, or the name of a free parameter."""
        if isinstance(assigned, str) and assigned not in self.box and assigned not in self.outer:
            return self.values[assigned]
        return assigned

    def held(self, assigned: Assigned) -> float:
        """The number alone, also for a free parameter."""
        return self.values[assigned] if isinstance(assigned, str) else assigned


def problem_for(
    records: Records, settings: Settings, experiment: SimulatedExperiment, free: Free, end: float
) -> Problem:
    """The problem of an experiment, up to a time."""
    acting = _acting(records, settings, experiment, free)
    numbers: dict[str, Assigned] = {}
    for name, assigned in settings.at[experiment.condition.name].items():
        if name in records.model.used and name not in free.inputs:
            numbers[name] = free.number(assigned) if name in acting else free.held(assigned)
    names = {name: a for name, a in numbers.items() if isinstance(a, str)}
    constants = {name: a for name, a in numbers.items() if isinstance(a, float)}
    model = _renamed(records.model.with_numbers(constants), names)
    used = {a: free.box[a] for a in names.values()}
    box = {**used, **free.inputs}
    if experiment.before is None:
        return model.problem(box, time=(0.0, end))
    with warnings.catch_warnings():  # Some parameters may act before the start alone
        warnings.simplefilter("ignore", RankoneWarning)
        problem = model.problem(box, time=(0.0, end))
    return _rested(problem, experiment, settings, free, names)


def _acting(
    records: Records, settings: Settings, experiment: SimulatedExperiment, free: Free
) -> frozenset[str]:
    """Parameters of the model that rates or initial values depend on in an experiment.

    A factor that is zero in all of its conditions makes others vanish.
    """
    model, acting = records.model, frozenset[str]()
    for condition in filter(None, (experiment.condition, experiment.before)):
        at = settings.at[condition.name]
        held = (name for name in at if name in model.used and name not in free.inputs)
        numbers = {name: free.number(at[name]) for name in held}
        acting |= model.depends_on({n: a for n, a in numbers.items() if isinstance(a, float)})
    return acting


def _renamed(model: Model, names: Mapping[str, str]) -> Model:
    """The model with other names of some parameters, two of which may become one."""
    symbols = {sp.Symbol(old): sp.Symbol(new) for old, new in names.items() if old != new}
    if not symbols:
        return model

    def written(table: Mapping[sp.Symbol, sp.Expr]) -> dict[sp.Symbol, sp.Expr]:
        return {symbol: expression.xreplace(symbols) for symbol, expression in table.items()}

    return replace(
        model,
        rates=written(model.rates),
        initial=written(model.initial),
        definitions=written(model.definitions),
        constraints=written(model.constraints),
        numbers={symbols.get(symbol, symbol): value for symbol, value in model.numbers.items()},
    )


def _rested(
    problem: Problem,
    experiment: SimulatedExperiment,
    settings: Settings,
    free: Free,
    names: Mapping[str, str],
) -> Problem:
    """The same, which starts at the steady state under the condition before."""
    assert experiment.before is not None
    here, before = (settings.at[c.name] for c in (experiment.condition, experiment.before))
    conditions: dict[sp.Symbol, Any] = {}
    for name in sorted(settings.records.model.used):
        if free.number(before[name]) == free.number(here[name]):
            continue
        if name in names or name in free.inputs:
            raise ProblemError(
                f"{quote(name)} is free in {quote(experiment.condition.name)}, and not the same in "
                f"{quote(experiment.before.name)}, which a solution may not have",
                term=name,
                remedy="leave the parameter out of the box",
            )
        value = free.number(before[name])
        conditions[sp.Symbol(name)] = sp.Symbol(value) if isinstance(value, str) else value
    jumps = {
        unknown: sp.Symbol(names.get(start, start))
        for unknown in problem.unknowns
        if experiment.condition.assigned.get(str(unknown.func)) is not None
        for start in [settings.records.starts[str(unknown.func)]]
    }
    rest = SteadyState(conditions=conditions, start=problem.written["initial"])
    written = {**problem.written, "initial": rest, "jumps": {0.0: jumps} if jumps else None}
    return Problem(**written)


def joined(
    settings: Settings, experiments: Sequence[SimulatedExperiment], free: Free
) -> Free | None:
    """What is free in one problem for all experiments; None where separate ones are cheaper.

    A further parameter makes a solution about as expensive as four without it. Experiments that
    start at steady states are apart, and so are those whose conditions name different parameters.
    """
    inputs: dict[str, Interval] = {}
    if len(experiments) < 2 or any(each.before is not None for each in experiments):
        return None
    at = [settings.at[each.condition.name] for each in experiments]
    for name in sorted(settings.records.model.used):
        values = {free.number(each[name]) for each in at}
        if len(values) > 1:
            if any(isinstance(value, str) for value in values):
                return None
            ends = [float(value) for value in values]
            inputs[name] = min(ends), max(ends)
    if len(experiments) <= _WORTH_A_PARAMETER ** len(inputs):
        return None
    return replace(free, inputs=inputs)


_WORTH_A_PARAMETER = 4  # Solutions that cost as much as one with a further parameter


# -----------------------------------------------------------------------------
# Parameters of a calibration problem, and the checked records of its tables.


Assigned: TypeAlias = "float | str"
"""A number, or the name of a parameter."""


@dataclass(frozen=True)
class Condition:
    """What a condition gives ids of the model; None where it leaves them as they are."""

    name: str
    assigned: Mapping[str, Assigned | None]


@dataclass(frozen=True)
class SimulatedExperiment:
    """A condition that is simulated, and the one whose steady state it starts at, if there is one.

    What was measured is in :class:`Series`.
    """

    condition: Condition
    before: Condition | None

    @property
    def name(self) -> str:
        """``before -> condition``, or the condition alone."""
        name = self.condition.name
        return name if self.before is None else f"{self.before.name} -> {name}"


@dataclass(frozen=True)
class Observable:
    """An observable: its formula, and the distribution of its noise.

    ``transformation`` is that of the measurements whose noise is normal or of Laplace's
    distribution; the noise formula gives the standard deviation or the scale of it.
    """

    name: str
    formula: Formula
    noise: Formula
    transformation: str
    distribution: str


@dataclass(frozen=True, eq=False)
class Series:
    """The m measurements of one observable, over all experiments.

    ``rows`` are their places in the table, ``experiments`` (m,) the positions of their experiments,
    ``times`` (m,) may be infinite. ``placeholders`` give m numbers or parameters by name.
    """

    observable: Observable
    rows: Sequence[int]
    experiments: Array
    times: Array
    measurements: Array
    placeholders: Mapping[str, Sequence[Assigned]]


@dataclass(frozen=True, eq=False)
class Records:
    """A calibration problem as its files have it.

    ``starts`` has the parameter of the model by which each id is set that conditions or the table
    of parameters may set.
    """

    name: str
    model: Model
    starts: Mapping[str, str]
    parameters: tuple[Parameter, ...]
    experiments: tuple[SimulatedExperiment, ...]
    series: tuple[Series, ...]

    @property
    def last_time(self) -> float:
        """The last finite time of a measurement; 0 without any."""
        times = np.concatenate([series.times for series in self.series])
        return float(np.max(times[np.isfinite(times)], initial=0.0))


# -----------------------------------------------------------------------------
# Parameters of a calibration problem: their scales, bounds and priors.


_LOG10 = math.log(10.0)
SCALES = ("lin", "log", "log10")
"""The coordinates in which a parameter may be estimated."""


@dataclass(frozen=True)
class Prior:
    """A prior density of a parameter, in one coordinate of it.

    Attributes
    ----------
    shape : {"uniform", "normal", "laplace"}
    scale : {"lin", "log", "log10"}
        The coordinate z in which the density has this shape.
    location, width : float
        Mean and standard deviation of a normal density, centre and scale of a Laplace density,
        both ends of a uniform one.
    of_value : bool
        Whether it is a density of the value, as a log-normal one is, and not of z.
    """

    shape: str
    scale: str
    location: float
    width: float
    of_value: bool

    def distribution(self) -> Any:
        """The prior as a frozen distribution of scipy.stats over the value."""
        unit = {"lin": 0.0, "log": 1.0, "log10": _LOG10}[self.scale]
        first, second = unit * self.location, unit * self.width
        match self.shape, unit:
            case "uniform", 0.0:
                return scipy.stats.uniform(self.location, self.width - self.location)
            case "normal", 0.0:
                return scipy.stats.norm(self.location, self.width)
            case "laplace", 0.0:
                return scipy.stats.laplace(self.location, self.width)
            case "uniform", _:
                return scipy.stats.loguniform(math.exp(first), math.exp(second))
            case "normal", _:
                return scipy.stats.lognorm(second, scale=math.exp(first))
        return scipy.stats.loglaplace(1.0 / second, scale=math.exp(first))

    def penalty(self) -> Any:
        """A distribution over the value whose density is what the objective has, up to a factor.

        It is that of :meth:`distribution` where the prior is one of the value. Where it is one of
        the logarithm z, its density is a function of z: a log-normal density with a mean of z that
        is larger by the variance is proportional to it. None if there is no such distribution.
        """
        if self.of_value or self.scale == "lin":
            return self.distribution()
        unit = 1.0 if self.scale == "log" else _LOG10
        first, second = unit * self.location, unit * self.width
        if self.shape == "uniform":
            lower, upper = math.exp(first), math.exp(second)
            return scipy.stats.uniform(lower, upper - lower)
        if self.shape == "normal":
            return scipy.stats.lognorm(second, scale=math.exp(first + second**2))
        return None

    def logpdf(self, values: Array) -> Array:
        """What the objective subtracts at values (...)."""
        costs = [self.cost(value)[0] for value in values.ravel().tolist()]
        return -np.reshape(costs, values.shape)

    def cost(self, value: float) -> tuple[float, float]:
        """Minus the logarithm of the density at a value, and its derivative by the value."""
        z = scaled(value, self.scale)
        if not math.isfinite(z):
            return math.inf, 0.0
        slope = 1.0 / slope_of_scale(value, self.scale)
        if self.shape == "uniform":
            inside = self.location <= z <= self.width
            return (math.log(self.width - self.location) if inside else math.inf), 0.0
        away = (z - self.location) / self.width
        if self.shape == "normal":
            cost = 0.5 * away**2 + math.log(self.width * math.sqrt(2.0 * math.pi))
            gradient = away / self.width * slope
        else:
            cost = abs(away) + math.log(2.0 * self.width)
            gradient = math.copysign(1.0, away) / self.width * slope
        if self.of_value and self.scale != "lin":
            cost, gradient = cost - math.log(slope), gradient + 1.0 / value
        return cost, gradient


@dataclass(frozen=True)
class Parameter:
    """A parameter of a calibration problem; all numbers are values, and not on its scale.

    Attributes
    ----------
    name : str
    scale : {"lin", "log", "log10"}
        The coordinate in which it is estimated.
    lower, upper : float
        Bounds; NaN where a parameter that is not estimated has none.
    nominal : float
        The value of the file; NaN if it has none.
    estimated : bool
    prior : Prior or None
        What the objective adds for it.
    """

    name: str
    scale: str
    lower: float
    upper: float
    nominal: float
    estimated: bool
    prior: Prior | None = None

    def scaled(self, value: float) -> float:
        """The coordinate of a value: itself, its logarithm, or that to base 10."""
        return scaled(value, self.scale)

    def value(self, coordinate: float) -> float:
        """The value at a coordinate."""
        if self.scale == "lin":
            return coordinate
        return math.exp(coordinate) if self.scale == "log" else 10.0**coordinate

    def slope(self, value: float) -> float:
        """The derivative of the value by its coordinate."""
        return slope_of_scale(value, self.scale)

    @property
    def width(self) -> float:
        """Width of the bounds in the coordinate."""
        return self.scaled(self.upper) - self.scaled(self.lower)

    @property
    def distribution(self) -> Prior | None:
        """Its prior, unless that is the same everywhere; see :class:`~.likelihood.Prior`."""
        return None if self.prior is None or self.prior.shape == "uniform" else self.prior


def scaled(value: float, scale: str) -> float:
    """The coordinate of a value on a scale; minus infinity or NaN where it has none."""
    if scale == "lin":
        return value
    if value <= 0.0:
        return -math.inf if value == 0.0 else math.nan
    return math.log(value) if scale == "log" else math.log10(value)


def slope_of_scale(value: float, scale: str) -> float:
    """The derivative of a value by its coordinate on a scale."""
    return {"lin": 1.0, "log": value, "log10": value * _LOG10}[scale]


def parameter_rows(parameters: Sequence[Parameter]) -> list[list[str]]:
    """Cells of a table: name, scale, bounds, nominal value, and whether it is estimated."""
    return [
        [p.name, p.scale, f"{p.lower:g}", f"{p.upper:g}", f"{p.nominal:.6g}",
         "yes" if p.estimated else "no"]
        for p in parameters
    ]  # fmt: skip


# -----------------------------------------------------------------------------
# Measurements of a calibration problem as experiments that solutions are fitted to.


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
