"""Tables of measurements and of doses: columns by name, cut into the experiments that they hold.

A row is a time with what was measured then. Columns named like parameters hold values of them;
rows that differ in these, in ``condition`` or in ``subject`` belong to different experiments.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, TypeGuard

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.formulas import Formula
from rankone.inference.estimation.noise import Noise
from rankone.inference.estimation.observations import observables
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError, did_you_mean, listing, quote, shown
from rankone.tensors.coordinates import name_of
from rankone.tensors.joint_distribution import by_name

GROUPS = ("condition", "subject")
"""Columns that tell experiments apart."""
SIGMA = "sigma"
"""The column of standard deviations; ``sigma_x`` is that of x alone."""
_DOSES = ("amt", "evid")  # Columns that only tables with rows of doses have
_EMPTY = ("", ".", "None", "<NA>")  # Cells without a number, as text
_TIME = "time"  # The column of time, if it has not the name of the problem's


@dataclass(frozen=True)
class Block:
    """The rows of one experiment: times, data and perhaps sigma by observable, and parameters.

    ``labels`` are those of its columns ``condition`` and ``subject``, as far as the table has them;
    ``rows`` are the positions in the table of the data of each observable.
    """

    name: str
    labels: tuple[str, ...]
    times: dict[str, Array]
    data: dict[str, Array]
    sigma: dict[str, Array] | None
    fixed: dict[str, float]
    rows: dict[str, NDArray[np.intp]]


class Tabular(Protocol):
    """Columns by name, as a pandas DataFrame has them."""

    @property
    def columns(self) -> Iterable[Any]: ...
    def __getitem__(self, key: Any, /) -> Any: ...


def is_table(data: object) -> TypeGuard[Tabular]:
    """Whether an object has columns by name, like a pandas DataFrame."""
    return hasattr(data, "columns") and hasattr(data, "__getitem__")


def columns_of(table: Tabular | Mapping[Any, Any]) -> dict[str, Any]:
    """The columns of a table, or of a mapping, by name."""
    keys = list(table) if isinstance(table, Mapping) else list(table.columns)
    columns = {}
    for key in keys:
        try:
            name = name_of(key)
        except EvaluationError:
            name = str(key)
        if name in columns:
            raise OptionError(f"the table names the column {quote(name)} twice", term=name)
        columns[name] = np.asarray(table[key])
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        texts = [f"{quote(name)} has {length}" for name, length in lengths.items()]
        raise OptionError(f"the columns of the table differ in length: {', '.join(texts)}")
    return columns


def blocks_of(
    solution: SolutionCore, table: Tabular | Mapping[Any, Any], observe: object = None
) -> list[Block]:
    """The experiments of a table.

    Empty cells (NaN or None) are left out, and so are rows without anything measured. A table with
    columns of all parameters, such as one that a page saved, holds none of them. An OptionError if
    the columns do not say what they are.
    """
    columns = columns_of(table)
    time = time_column(solution, columns)
    measured = measured_columns(solution, columns, time, observe)
    numbers = {name: numbers_of(name, columns[name]) for name in measured}
    clock = numbers_of(time, columns[time])
    held = {
        name: numbers_of(name, columns[name]) for name in solution.parameters if name in columns
    }
    if len(held) == len(solution.parameters):
        held = {}  # a table that a page saved says everything
    spreads = {
        name: numbers_of(name, columns[name]) for name in columns if _is_sigma(name, measured)
    }
    labels = _labels(columns, held, len(clock))
    blocks = []
    for group in dict.fromkeys(labels):
        rows = np.array([each == group for each in labels])
        blocks.append(_block(group, rows, clock, numbers, held, spreads, time))
    blocks = [block for block in blocks if any(row.size for row in block.data.values())]
    if not blocks:
        raise OptionError("the table has no measurements", remedy="fill its cells")
    return blocks


Group = tuple[tuple[str, ...], str, tuple[float, ...]]


def _block(
    group: Group,
    rows: NDArray[np.bool_],
    clock: Array,
    numbers: Mapping[str, Array],
    held: Mapping[str, Array],
    spreads: Mapping[str, Array],
    time: str,
) -> Block:
    labels, name, fixed = group
    times, data, sigma, positions = {}, {}, {}, {}
    for observable, column in numbers.items():
        here = rows & ~np.isnan(column)
        if np.isnan(clock[here]).any():
            raise OptionError(
                f"{quote(observable)} is measured where {quote(time)} is empty", term=time
            )
        if not here.any():
            continue
        times[observable], data[observable] = clock[here], column[here]
        positions[observable] = np.flatnonzero(here)
        spread = spreads.get(f"{SIGMA}_{observable}", spreads.get(SIGMA))
        if spread is not None:
            _check_complete(observable, here & np.isnan(spread))
            sigma[observable] = spread[here]
    if sigma and len(sigma) < len(data):
        missing = [observable for observable in data if observable not in sigma]
        raise OptionError(
            f"the table has no sigma of {listing(missing)}",
            remedy=f"add columns {listing(f'{SIGMA}_{each}' for each in missing)}, or one `sigma`",
        )
    parameters = dict(zip(held, fixed, strict=True))
    return Block(name, labels, times, data, sigma or None, parameters, positions)


def _check_complete(observable: str, empty: NDArray[np.bool_]) -> None:
    """Raise an OptionError where sigma is empty beside a measurement."""
    if empty.any():
        raise OptionError(
            f"row {int(np.argmax(empty)) + 1} of the table: sigma of {quote(observable)} is empty",
            term=observable,
            remedy="fill it, or drop the column of sigma: it is estimated then",
        )


def _labels(columns: Mapping[str, Any], held: Mapping[str, Array], rows: int) -> list[Group]:
    """For each row its labels, the name of its experiment, and its parameters."""
    groups = {
        name: [label_of(entry) for entry in columns[name]] for name in GROUPS if name in columns
    }
    labels: list[Group] = []
    for i in range(rows):
        own = tuple(each[i] for each in groups.values())
        values = tuple(float(column[i]) for column in held.values())
        for name, value in zip(held, values, strict=True):
            if np.isnan(value):
                raise OptionError(
                    f"row {i + 1} of the table: the parameter {quote(name)} is empty",
                    term=name,
                    remedy="fill it, or drop the column and fit the parameter",
                )
        texts = own or [f"{name}={value:g}" for name, value in zip(held, values, strict=True)]
        labels.append((own, ", ".join(texts), values))
    return labels


def label_of(entry: object) -> str:
    whole = isinstance(entry, float) and float(entry).is_integer()
    return str(int(entry)) if whole else str(entry)  # type: ignore[call-overload]


def time_column(solution: SolutionCore, columns: Mapping[str, Any]) -> str:
    """The name of the column of time."""
    time = solution.metadata.time
    if solution.metadata.timeless:
        raise OptionError("values that do not depend on time are not fitted from tables")
    for name in (time, _TIME):
        if name in columns:
            return name
    near = did_you_mean(time, columns) or did_you_mean(_TIME, columns)
    raise OptionError(
        f"the table has no column {quote(time)} for time{near}",
        term=list(columns),
        remedy=f"name it {quote(time)} or {quote(_TIME)}; the columns are {listing(columns)}",
    )


def measured_columns(
    solution: SolutionCore, columns: Mapping[str, Any], time: str, observe: object
) -> tuple[str, ...]:
    """Names of the observables among the columns."""
    if observe is not None:
        names = tuple(observables(solution, observe, None))
    else:
        names = tuple(name for name in columns if name in solution.states)
    for name in names:
        if name not in columns:
            raise OptionError(
                f"the table has no column {quote(name)}{did_you_mean(name, columns)}",
                term=name,
                remedy=f"its columns are {listing(columns)}",
            )
    if not names:
        raise OptionError(
            "the table has no column of an unknown",
            term=list(columns),
            remedy=f"name columns as one of {listing(solution.states)}, or say what they are with "
            "observe={column: expression}",
        )
    _check_doses(solution, columns, names)
    vocabulary = {*names, *GROUPS, *solution.states, *solution.parameters, time}
    for name in columns:
        if name in vocabulary or _is_sigma(name, names):
            continue
        near = solution.metadata.hint(name, *solution.parameters, *GROUPS)
        if near:
            raise OptionError(
                f"the column {quote(name)} of the table is unknown{near}",
                term=name,
                remedy="rename or drop it, or name what was measured: observe=[...]",
            )
    return names


def _check_doses(
    solution: SolutionCore, columns: Mapping[str, Any], measured: Sequence[str]
) -> None:
    """Raise an OptionError if a column has doses, which nothing says how to take."""
    own = {*solution.states, *solution.parameters, *measured}
    amounts = next((name for name in columns if name.lower() == "amt"), "amt")
    for name in columns:
        if name.lower() not in _DOSES or name in own:
            continue
        if np.nan_to_num(numbers_of(name, columns[name])).any():
            amount = next(iter(solution.metadata.additive), "dose")
            raise OptionError(
                f"the column {quote(name)} of the table has doses, and `doses` does not say which "
                "parameter is their amount",
                term=name,
                remedy=f'name both, doses={{"{amount}": "{amounts}"}}, or drop the column',
            )


def _is_sigma(name: str, measured: Sequence[str]) -> bool:
    return name == SIGMA or name in [f"{SIGMA}_{each}" for each in measured]


def numbers_of(name: str, column: NDArray[Any]) -> Array:
    """A column of numbers, NaN where a cell is empty."""
    cells = [np.nan if str(cell).strip() in _EMPTY else cell for cell in column.tolist()]
    try:
        numbers = np.array([float(cell) for cell in cells])
    except (TypeError, ValueError):
        row = next(i for i, cell in enumerate(cells) if not _is_number(cell))
        raise OptionError(
            f"row {row + 1} of the table: {quote(name)} is {shown(cells[row])}, not a number",
            term=cells[row],
        ) from None
    if np.isinf(numbers).any():
        raise OptionError(f"the column {quote(name)} has infinite values", remedy="leave them out")
    return numbers


def is_empty(cell: object) -> bool:
    """Whether a cell of a table holds nothing: no object, no text, or no number."""
    nothing = cell is None or (isinstance(cell, float) and math.isnan(cell))
    return nothing or str(cell).strip() in ("", "<NA>")


def _is_number(cell: object) -> bool:
    try:
        float(cell)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
    return True


# -----------------------------------------------------------------------------
# Doses of subjects at times of their own, from tables and as curves.


_MEASUREMENT, _DOSE, _OTHER = range(3)  # What `evid` says of a row
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
