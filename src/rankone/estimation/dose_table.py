"""Tables with rows of doses among those of data, as NONMEM, Monolix and nlmixr2 read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rankone.estimation.doses import Dose, DosesBySubject
from rankone.estimation.tables import GROUPS, label_of, measured_columns, numbers_of, time_column
from rankone.solution.core import SolutionCore
from rankone.statistics.joint_distribution import by_name
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote

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
