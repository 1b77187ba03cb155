"""``rankone fit FILE data.csv``: parameters from measured data."""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rankone.commands.common import (
    FAILURE,
    SOLVED_HELP,
    SUCCESS,
    Commands,
    add_command,
    add_solve_rtol,
    finite_or_none,
    solution_of,
)
from rankone.support.budget import effort_of
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote

if TYPE_CHECKING:
    from rankone.estimation.fit import Fit
    from rankone.interface.solution import Solution

_SIGMA_HELP = "standard deviation of the noise, one or by unknown; by default it is estimated"
_EFFORT_HELP = "low, normal (default), high or a factor on the budget of the solve and the starts"
_EXIT_HELP = """\
data: a table with commas; the first line names the columns: time (by the name it has in the
problem) and the unknowns that were measured. Empty cells are missing values.

exit status:
  0  nothing speaks against the fit
  1  something does; it is printed all the same
  2  bad input
"""


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "fit",
        _fit,
        usage="rankone fit FILE DATA [options]",
        help="fit parameters to measured data",
        description="Fit parameters of a solution, or of a problem that is solved first, to data.",
        epilog=_EXIT_HELP,
    )
    add = parser.add_argument
    add("file", metavar="FILE", type=Path, help=SOLVED_HELP)
    add("data", metavar="DATA", type=Path, help="a .csv file (see below)")
    add("--observe", metavar="NAME", nargs="+", help="columns to use; by default all unknowns")
    add("--sigma", metavar="S|NAME=S", nargs="+", help=_SIGMA_HELP)
    for option, meaning in (("fixed", "parameters that are known"), ("start", "where to start")):
        add(f"--{option}", metavar="NAME=VALUE", nargs="+", action="extend", help=meaning)
    add("--level", type=float, default=0.95, help="level of intervals (default: %(default)g)")
    add_solve_rtol(parser)
    add("--effort", metavar="E", type=effort_of, default="normal", help=_EFFORT_HELP)
    add("--json", action="store_true", help="print the result as JSON")


def _fit(arguments: argparse.Namespace) -> int:
    from rankone.export.program import pairs_of

    solution = solution_of(arguments.file, arguments.rtol, effort=arguments.effort)
    times, measurements = _table(arguments.data, solution, arguments.observe)
    fit = solution.fit(
        times,
        measurements,
        sigma=_sigma(arguments.sigma),
        fixed=pairs_of("--fixed", arguments.fixed, float),
        start=pairs_of("--start", arguments.start, float) or None,
        level=arguments.level,
        effort=arguments.effort,
    )
    print(json.dumps(_plain(fit), indent=2, allow_nan=False) if arguments.json else fit)
    return SUCCESS if fit.success else FAILURE


def _table(
    file: Path, solution: Solution, observe: Sequence[str] | None
) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Times and measurements of each unknown that was measured."""
    header, rows = _read(file)
    time = solution.metadata.time
    if solution.metadata.timeless:
        raise OptionError("values that do not depend on time are fitted from Python alone")
    if len(header) == 1 and ";" in header[0]:
        raise OptionError(
            f"{quote(file)} has semicolons between its columns", remedy="write commas"
        )
    if time not in header:
        raise OptionError(
            f"{quote(file)} has no column {quote(time)} for time{did_you_mean(time, header)}",
            term=header,
            remedy=f"its columns are {listing(header)}",
        )
    names = list(observe or [name for name in header if name in solution.states])
    if len({*names}) < len(names):
        raise OptionError(f"--observe names an unknown twice: {listing(names)}", term=names)
    for name in names:
        if name not in header:
            raise OptionError(
                f"{quote(file)} has no column {quote(name)}{did_you_mean(name, header)}",
                term=name,
                remedy=f"its columns are {listing(header)}",
            )
    if not names:
        raise OptionError(
            f"{quote(file)} has no column of an unknown",
            term=header,
            remedy=f"name columns as one of {listing(solution.states)}",
        )
    clock = header.index(time)
    times: dict[str, list[float]] = {name: [] for name in names}
    measurements: dict[str, list[float]] = {name: [] for name in names}
    for line, row in rows:
        for name in names:
            cell = row[header.index(name)].strip()
            if cell:
                times[name].append(_cell(file, line, time, row[clock]))
                measurements[name].append(_cell(file, line, name, cell))
    return times, measurements


def _read(file: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The names of the columns, and the rows with their lines."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            lines = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except (OSError, ValueError, csv.Error) as reason:
        raise OptionError(f"{quote(file)} cannot be read: {reason}", term=str(file)) from None
    if not lines:
        raise OptionError(f"{quote(file)} is empty", term=str(file))
    header = [name.strip() for name in lines[0][1]]
    if len(set(header)) < len(header):
        raise OptionError(f"{quote(file)} names a column twice: {listing(header)}", term=header)
    for line, row in lines[1:]:
        if len(row) != len(header):
            raise OptionError(
                f"{quote(file)}, line {line}: {len(row)} cells for {len(header)} columns", term=row
            )
    return header, lines[1:]


def _cell(file: Path, line: int, name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise OptionError(
            f"{quote(file)}, line {line}: {quote(name)} is {text!r}, not a number", term=text
        ) from None


def _sigma(texts: Sequence[str] | None) -> float | dict[str, float] | None:
    """The noise: a number, numbers by name, or nothing."""
    from rankone.export.program import pairs_of

    if texts is None:
        return None
    if len(texts) > 1 or "=" in texts[0]:
        return pairs_of("--sigma", texts, float)
    try:
        return float(texts[0])
    except ValueError:
        raise OptionError(f"--sigma: {quote(texts[0])} is not a number", term=texts[0]) from None


def _plain(fit: Fit) -> dict[str, object]:
    """The fit for JSON; numbers that are not finite are null."""
    return {
        "success": fit.success,
        "message": fit.message,
        "x": fit.x,
        "interval": {name: [*map(finite_or_none, ends)] for name, ends in fit.interval().items()},
        "level": fit.level,
        "std": {name: finite_or_none(deviation) for name, deviation in fit.std.items()},
        "identifiable": fit.identifiable,
        "combinations": {
            text: {
                "value": fit.value_of(text),
                "interval": [*map(finite_or_none, fit.interval_of(text))],
            }
            for text in fit.combinations
        },
        "fixed": fit.fixed,
        "observed": list(fit.observations.names),
        "data": fit.observations.size,
        "dof": fit.dof,
        "chi2": fit.chi2,
        "sigma": finite_or_none(fit.sigma),
        "p_value": finite_or_none(fit.p_value),
    }
