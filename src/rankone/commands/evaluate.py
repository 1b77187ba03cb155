"""``rankone eval FILE``: values at a point or on a grid."""

from __future__ import annotations

import argparse
import csv
import io
import itertools
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rankone.commands.inputs import SOLVED_HELP, solution_of, status_of

if TYPE_CHECKING:
    from rankone.interface.solution import Solution
    from rankone.support.arrays import Array

__all__ = ["register", "run"]

_AXIS = "NAME=LOWER:UPPER:COUNT or NAME=VALUE,VALUE"
_LARGEST_GRID = 20_000_000
"""Largest number of values on a grid."""


def register(commands: Any) -> None:
    """Add the parser."""
    parser = commands.add_parser(
        "eval",
        usage="rankone eval FILE [--at NAME=VALUE ...] [--grid NAME=LOWER:UPPER:COUNT ...] "
        "[options]",
        help="evaluate a saved solution, or a problem that is solved first",
        description="Print the unknowns at a point, or on a grid as a table in CSV.",
    )
    parser.add_argument("file", metavar="FILE", type=Path, help=SOLVED_HELP)
    parser.add_argument(
        "--at", metavar="NAME=VALUE", nargs="+", action="extend", help="a value of time, parameters"
    )
    parser.add_argument(
        "--grid",
        metavar="NAME=VALUES",
        nargs="+",
        action="extend",
        help="several: LOWER:UPPER:COUNT evenly, or VALUE,VALUE,...",
    )
    parser.add_argument(
        "--states",
        choices=("unknowns", "all"),
        default="unknowns",
        help="all: derivatives that are states (x_t) as well",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--csv", metavar="PATH", nargs="?", const="-", help="a table, printed or written to PATH"
    )
    parser.add_argument("--overwrite", action="store_true", help="let --csv replace a file")
    parser.add_argument(
        "--rtol", type=float, help="relative tolerance for a problem file (default: 1e-6)"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate and print or write the values."""
    from rankone.export.program import pairs_of
    from rankone.support.errors import OptionError, StorageError
    from rankone.support.files import free_target, write_files

    at = pairs_of("--at", arguments.at, float)
    grid = pairs_of("--grid", arguments.grid, _axis, _AXIS)
    for name in (name for name in at if name in grid):
        raise OptionError(f"{name!r} is given in --at and in --grid", remedy="give it once")
    to_file = arguments.csv not in (None, "-")
    if arguments.json and arguments.csv == "-":
        raise OptionError("--json and --csv are both to be printed", remedy="choose one")
    if to_file:  # find out before the solve, not after it
        free_target(arguments.csv, arguments.overwrite, StorageError)

    solution = solution_of(arguments.file, arguments.rtol)
    names = solution.states if arguments.states == "all" else solution.unknowns
    given = {name: [value] for name, value in at.items()} | grid
    values = _values(solution, names, given)
    points = {name: given[name] for name in solution.metadata.coordinates}
    if to_file:
        path, text = Path(arguments.csv), _table(points, values)
        write_files({path: text}, arguments.overwrite, StorageError)
    if arguments.json:
        print(json.dumps(_plain(solution, at, points, values), allow_nan=False))
    elif grid or arguments.csv == "-":
        if not to_file:
            print(_table(points, values), end="")
    elif not to_file:
        units = dict(solution.metadata.units)
        for name, value in values.items():
            unit = f" {units[name]}" if name in units else ""
            print(f"{name} = {value.item()!r}{unit}")
    sys.stdout.flush()
    return status_of(solution)


def _axis(text: str) -> list[float]:
    """Values of a coordinate; a ValueError if it is no such text."""
    import numpy as np

    if ":" not in text:
        return [float(value) for value in text.split(",")]
    lower, upper, number = text.split(":")
    count = int(number)
    if not 1 <= count <= _LARGEST_GRID or (count == 1 and float(lower) != float(upper)):
        raise ValueError
    return [float(value) for value in np.linspace(float(lower), float(upper), count)]


def _values(
    solution: Solution, names: tuple[str, ...], given: Mapping[str, list[float]]
) -> dict[str, Array]:
    """For each state the values of all combinations, an axis for each coordinate."""
    import numpy as np

    from rankone.support.errors import OptionError

    size = math.prod(map(len, given.values())) * len(names)
    if size > _LARGEST_GRID:
        raise OptionError(
            f"the grid has {size:,} values", remedy=f"ask for at most {_LARGEST_GRID:,}"
        )
    if all(len(axis) == 1 for axis in given.values()):  # to the last bit as a call
        at = {name: axis[0] for name, axis in given.items()}
        shape = (1,) * len(given)
        return {name: np.reshape(solution[name](at), shape) for name in names}
    return {name: solution[name].grid(given) for name in names}


def _plain(
    solution: Solution,
    at: Mapping[str, float],
    points: Mapping[str, list[float]],
    values: Mapping[str, Array],
) -> dict[str, Any]:
    """Coordinates and values: numbers where one was given, else nested lists."""
    from rankone.commands.summary import number

    numbers = tuple(axis for axis, name in enumerate(points) if name in at)
    return {
        "success": solution.success,
        "error": number(solution.error),
        "coordinates": {name: at.get(name, axis) for name, axis in points.items()},
        "values": {name: array.squeeze(numbers).tolist() for name, array in values.items()},
    }


def _table(points: Mapping[str, list[float]], values: Mapping[str, Array]) -> str:
    """A line of names and one for each point; the digits give the numbers back exactly."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*points, *values])
    columns = (array.ravel().tolist() for array in values.values())
    for point, row in zip(
        itertools.product(*points.values()), zip(*columns, strict=True), strict=True
    ):
        writer.writerow([*point, *row])
    return text.getvalue()
