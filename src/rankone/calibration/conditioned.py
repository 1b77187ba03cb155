"""Problems of single experiments: parameters of the table in a box, and numbers for all others."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import sympy as sp

from rankone.calibration.conditions import Settings
from rankone.calibration.records import Assigned, Experiment, Records
from rankone.frontend.problem import Problem
from rankone.frontend.steady_start import SteadyState
from rankone.models.model import Model
from rankone.support.errors import ProblemError, RankoneWarning
from rankone.support.wording import quote

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
    records: Records, settings: Settings, experiment: Experiment, free: Free, end: float
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
    records: Records, settings: Settings, experiment: Experiment, free: Free
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
    experiment: Experiment,
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


def joined(settings: Settings, experiments: Sequence[Experiment], free: Free) -> Free | None:
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
