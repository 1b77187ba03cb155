"""What conditions make of a model, and problems of single experiments."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import sympy as sp

from rankone.inference.calibration.calibrated_parameters import (
    Assigned,
    Condition,
    Records,
    SimulatedExperiment,
)
from rankone.problem.models.model import Model
from rankone.problem.problem import Problem
from rankone.problem.steady_start import SteadyState
from rankone.support.errors import ProblemError, RankoneWarning
from rankone.support.wording import did_you_mean, quote


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
