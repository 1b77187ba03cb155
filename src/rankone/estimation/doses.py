"""Doses of subjects at times of their own, and the curves that follow from the curve of one dose.

A solution has the curve of a dose at its start. Where it is proportional to the amount and the
effects of doses add up, the curve of a subject is the sum over its doses of that curve, counted
from the time of each dose and multiplied by its amount.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.estimation.formulas import Formula
from rankone.estimation.noise import Noise
from rankone.solution.core import SolutionCore
from rankone.statistics.joint_distribution import by_name
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import quote

AFTER_ALL = np.iinfo(np.intp).max  # The row of what comes after every dose at its time


class Response(NamedTuple):
    """What n records take of the curve of one dose, at M times for each of K doses: (n, M, K).

    ``times`` are those since the dose, on the clock of the solution. ``weights`` are amounts in
    that of the solution, zero for doses that come later.
    """

    times: Array
    weights: Array


@dataclass(frozen=True)
class Doses:
    """Doses of n records: times, multiples of the solution's dose, and table rows, all (n, K).

    The solution goes from ``start`` to ``end``. Records with fewer doses have some of amount zero.
    ``parameter`` is the amount, unless they are the solution's own.
    """

    start: float
    end: float
    times: Array
    amounts: Array
    rows: NDArray[np.intp]
    parameter: str | None = None

    @classmethod
    def at_start(cls, solution: SolutionCore, count: int) -> Doses:
        """One dose for each record: the solution's own, at its start."""
        start, end = solution.time
        shape = count, 1
        return cls(start, end, np.full(shape, start), np.ones(shape), np.full(shape, -1))

    def response(self, times: Array, rows: NDArray[np.intp] | int = AFTER_ALL) -> Response:
        """What records take at times (n, M) of data, in some rows of the table (n, M).

        Of a dose and a datum at the same time, the one whose row is first comes first.
        """
        since = times[..., None] - self.times[:, None]
        behind = np.asarray(rows)[..., None] > self.rows[:, None]
        acting = (since > 0.0) | ((since == 0.0) & behind)
        clock = np.clip(self.start + since, self.start, self.end)
        return Response(clock, np.where(acting, self.amounts[:, None], 0.0))

    def selected(self, records: NDArray[np.intp]) -> Doses:
        """Those of some of the records."""
        times, amounts = self.times[records], self.amounts[records]
        return replace(self, times=times, amounts=amounts, rows=self.rows[records])


class Dose(NamedTuple):
    """A dose of a subject: its row in the table, counted from 0, its time and amount."""

    row: int
    time: float
    amount: float


@dataclass(frozen=True)
class DosesBySubject:
    """The doses of each subject; the solution is evaluated at ``reference`` of the parameter.

    ``column`` tells subjects apart in the table; without it all rows are those of one.
    """

    parameter: str
    reference: float
    doses: Mapping[str, Sequence[Dose]]
    column: str | None

    def with_reference(self, solution: SolutionCore, fixed: Mapping[Any, Any]) -> dict[Any, Any]:
        """The fixed parameters, and with them the amount of the dose that the solution is of."""
        own = {key: entry for key, entry in fixed.items() if not isinstance(entry, Mapping)}
        if self.parameter in by_name("fixed", own, tuple(solution.parameters)):
            raise OptionError(
                f"fixed: {quote(self.parameter)} is the amount of doses", remedy="leave it out"
            )
        return {**fixed, self.parameter: self.reference}

    def check_observables(self, observed: Iterable[tuple[str, Formula, Noise]]) -> None:
        """Raise an OptionError for observables in which the amount of a dose stands."""
        for name, formula, noise in observed:
            formulas = [formula, *([noise.formula] if noise.formula else [])]
            if any(self.parameter in each.names for each in formulas):
                amount = quote(self.parameter)
                raise OptionError(
                    f"{quote(name)} depends on {amount} itself, which differs between doses",
                    remedy="leave it out of what is observed and of its noise",
                )

    def of_records(self, solution: SolutionCore, owners: Sequence[str]) -> Doses:
        """The doses of records, from the names of their subjects, which have one record each."""
        for k, owner in enumerate(owners):
            whose = f"{self.column} {quote(owner)}" if self.column else "the table"
            if owner in owners[:k]:
                raise OptionError(
                    f"{whose} is under several conditions, and `doses` does not say "
                    "under which of them its doses are",
                    term=owner,
                    remedy="give the conditions subjects of their own, or the dose as a parameter "
                    "with a column of its own",
                )
            if owner not in self.doses:
                raise OptionError(
                    f"{whose} has data and no dose",
                    term=owner,
                    remedy="add a row with its dose" + (", or leave it out" if self.column else ""),
                )
        start, end = solution.time
        shape = len(owners), max(len(self.doses[owner]) for owner in owners)
        times, amounts, rows = np.full(shape, start), np.zeros(shape), np.full(shape, -1)
        for i, owner in enumerate(owners):
            for k, dose in enumerate(self.doses[owner]):
                times[i, k], amounts[i, k] = dose.time, dose.amount / self.reference
                rows[i, k] = dose.row
        return Doses(start, end, times, amounts, rows, self.parameter)
