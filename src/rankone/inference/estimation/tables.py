"""Tables of measurements: columns by name, cut into the experiments that they hold.

A row is a time with what was measured then. Columns named like parameters hold values of them;
rows that differ in these, in ``condition`` or in ``subject`` belong to different experiments.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.observations import observables
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.wording import did_you_mean, listing, quote, shown
from rankone.tensors.bases.coordinates import name_of

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


def is_table(data: object) -> bool:
    """Whether an object has columns by name, like a pandas DataFrame."""
    return hasattr(data, "columns") and hasattr(data, "__getitem__")


def columns_of(table: Any) -> dict[str, Any]:
    """The columns of a table, or of a mapping, by name."""
    keys = list(table.columns) if is_table(table) else list(table)
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


def blocks_of(solution: SolutionCore, table: Any, observe: object = None) -> list[Block]:
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
