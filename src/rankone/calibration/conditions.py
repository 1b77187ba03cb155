"""What conditions make of the numbers of a model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from rankone.calibration.records import Assigned, Condition, Records
from rankone.support.errors import ProblemError
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
