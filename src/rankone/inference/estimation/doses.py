"""Doses of subjects at times of their own, from tables and as curves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.formulas import Formula
from rankone.inference.estimation.noise import Noise
from rankone.inference.estimation.tables import (
    GROUPS,
    label_of,
    measured_columns,
    numbers_of,
    time_column,
)
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote
from rankone.tensors.bases.joint_distribution import by_name

_MEASUREMENT, _DOSE, _OTHER = 0.0, 1.0, 2.0  # What `evid` says of a row
_AS_EQUATION = "write the input into the equations, such as dose/T*Heaviside(T - t)"
# Columns of such tables that are not supported unless they are empty, and what to do instead
_REFUSED = {
    "ss": "write the doses before as rows, or with addl and ii",
    "rate": _AS_EQUATION,
    "dur": _AS_EQUATION,
}
_READ = ("evid", "mdv", "addl", "ii")
_MOST_DOSES = 10_000  # Of a row: more is a mistake


def doses_in(
    solution: SolutionCore, columns: Mapping[str, Any], doses: object, observe: object
) -> tuple[DosesBySubject, dict[str, Any]]:
    """The doses of a table, and its other columns, in which the rows of doses hold no data.

    ``doses`` names the parameter of the solution that is an amount, and the column of amounts. An
    OptionError if doses do not add up, or a row is not understood.
    """
    parameter, name = _named(solution, columns, doses)
    amounts = numbers_of(name, columns[name])
    aside = {key.lower(): key for key in columns if key.lower() in (*_READ, *_REFUSED)}
    cells = {word: np.nan_to_num(numbers_of(key, columns[key])) for word, key in aside.items()}
    for word in _REFUSED.keys() & cells.keys():
        if cells[word].any():
            raise OptionError(
                f"doses: the column {quote(aside[word])} is not supported", remedy=_REFUSED[word]
            )
    rest = {key: column for key, column in columns.items() if key not in (name, *aside.values())}
    measured = measured_columns(solution, rest, time_column(solution, rest), observe)
    data = [numbers_of(each, rest[each]) for each in measured]
    here = _rows_of_doses(name, amounts, np.nan_to_num(np.array(data)), cells)
    owner = next((name for name in reversed(GROUPS) if name in rest), None)
    by_subject = _by_subject(solution, rest, owner, amounts, here, cells)
    hidden = here | (cells.get("evid", 0.0) == _OTHER) | (cells.get("mdv", 0.0) == 1.0)
    for each, column in zip(measured, data, strict=True):
        rest[each] = np.where(hidden, np.nan, column)
    return DosesBySubject(parameter, solution.parameters[parameter][1], by_subject, owner), rest


def _named(solution: SolutionCore, columns: Mapping[str, Any], doses: object) -> tuple[str, str]:
    """The parameter that is the amount of a dose, and the column of amounts."""
    named: dict[str, object] = by_name("doses", doses, tuple(solution.parameters))  # type: ignore[arg-type]
    if len(named) != 1:
        raise OptionError(
            f"doses names {listing(named) if named else 'no parameter'}",
            term=doses,
            remedy='name one, the amount, and the column that has it: doses={"dose": "amt"}',
        )
    ((parameter, column),) = named.items()
    if column not in columns:
        raise OptionError(
            f"doses: the table has no column {quote(column)}{did_you_mean(str(column), columns)}",
            term=column,
            remedy=f"its columns are {listing(columns)}",
        )
    if parameter not in solution.metadata.additive:
        raise OptionError(
            f"doses: the effects of several doses {quote(parameter)} do not add up. They do if "
            "rates are linear in the unknowns, with coefficients that do not depend on time, and "
            "all else is proportional to the dose",
            term=parameter,
            remedy="give each dose an amount and a time as parameters of the problem, and as "
            "columns: jumps={t1: {A: A + dose1}, t2: {A: A + dose2}}",
        )
    return parameter, str(column)


def _rows_of_doses(
    name: str, amounts: Array, data: Array, cells: Mapping[str, Array]
) -> NDArray[np.bool_]:
    """Which rows are doses: those whose `evid` is 1, or without it those that have an amount.

    ``data`` (observables, rows) are zero where they are empty.
    """
    positive = amounts > 0.0
    if "evid" not in cells:
        for row in np.flatnonzero(positive & (data != 0.0).any(axis=0))[:1]:
            raise OptionError(
                f"row {row + 1} of the table has a dose and data",
                remedy="write two rows, in their order; or add a column evid, 1 for rows of doses "
                "and 0 for rows of data",
            )
        return positive
    evid = cells["evid"]
    for row in np.flatnonzero(~np.isin(evid, (_MEASUREMENT, _DOSE, _OTHER)))[:1]:
        raise OptionError(
            f"row {row + 1} of the table: evid is {evid[row]:g}",
            remedy="only 0 (data), 1 (a dose) and 2 (neither) are supported",
        )
    for row in np.flatnonzero((evid == _DOSE) != positive)[:1]:
        raise OptionError(
            f"row {row + 1} of the table: evid is {evid[row]:g}, and {quote(name)} is "
            f"{np.nan_to_num(amounts[row]):g}",
            remedy="rows of doses have evid = 1 and an amount, other rows have neither",
        )
    return np.asarray(evid == _DOSE)


def _by_subject(
    solution: SolutionCore,
    columns: Mapping[str, Any],
    column: str | None,
    amounts: Array,
    here: NDArray[np.bool_],
    cells: Mapping[str, Array],
) -> dict[str, Sequence[Dose]]:
    """The doses of each subject, those that are repeated one by one."""
    time = time_column(solution, columns)
    clock = numbers_of(time, columns[time])
    none = np.zeros(here.size)
    more, interval = cells.get("addl", none), cells.get("ii", none)
    doses: dict[str, list[Dose]] = {}
    owners = [label_of(each) for each in columns[column]] if column else [""] * here.size
    for row, subject in enumerate(owners):
        place = f"row {row + 1} of the table"
        if column:
            place += f", {column} {quote(subject)}"
        if amounts[row] < 0.0:
            raise OptionError(f"{place}: the dose {amounts[row]:g} is negative")
        if not here[row]:
            continue
        if not clock[row] >= solution.time[0]:
            when = "has no time" if np.isnan(clock[row]) else f"is at {clock[row]:g}"
            raise OptionError(
                f"{place}: the dose {when}, and the solution starts at {solution.time[0]:g}",
                remedy="count times from the first dose",
            )
        times = more[row], interval[row]
        _check_repeated(place, *times)
        repeats = clock[row] + interval[row] * np.arange(int(more[row]) + 1)
        own = doses.setdefault(subject, [])
        own += [Dose(row, float(at), float(amounts[row])) for at in repeats]
    return {subject: tuple(own) for subject, own in doses.items()}


def _check_repeated(place: str, more: float, interval: float) -> None:
    """Raise an OptionError unless repeats of a dose are a whole number, with time between them."""
    whole = float(more).is_integer() and 0.0 <= more <= _MOST_DOSES
    if not whole or (more > 0.0 and not interval > 0.0):
        raise OptionError(
            f"{place}: the dose is repeated {more:g} times (addl) every {interval:g} (ii)",
            remedy="give a whole number, and the time between two doses",
        )


# -----------------------------------------------------------------------------
# Doses of subjects at times of their own, and the curves that follow from the curve of one dose.
#
# A solution has the curve of a dose at its start. Where it is proportional to the amount and the
# effects of doses add up, the curve of a subject is the sum over its doses of that curve, counted
# from the time of each dose and multiplied by its amount.


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
