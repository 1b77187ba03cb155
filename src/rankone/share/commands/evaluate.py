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
from typing import TYPE_CHECKING

from rankone.share.commands.common import (
    SOLVED_HELP,
    Commands,
    add_command,
    add_solve_arguments,
    add_states,
    finite_or_none,
    solution_of,
    status_of,
)

if TYPE_CHECKING:
    from rankone.solution.solution import Solution
    from rankone.support.arrays import Array

_AT_HELP = "a value of time, parameters"
_GRID_HELP = "several: LOWER:UPPER:COUNT evenly, or VALUE,VALUE,..."
_AXIS_FORM = "NAME=LOWER:UPPER:COUNT or NAME=VALUE,VALUE"
_LARGEST_GRID = 20_000_000  # Most numbers on a grid: 160 megabytes, and far more as a table


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "eval",
        _evaluate,
        usage="rankone eval FILE [--at NAME=VALUE ...] [--grid NAME=LOWER:UPPER:COUNT ...] "
        "[options]",
        help="evaluate a saved solution, or a problem that is solved first",
        description="Print the unknowns at a point, or on a grid as a table in CSV.",
    )
    add = parser.add_argument
    add("file", metavar="FILE", type=Path, help=SOLVED_HELP)
    add("--at", metavar="NAME=VALUE", nargs="+", action="extend", help=_AT_HELP)
    add("--grid", metavar="NAME=VALUES", nargs="+", action="extend", help=_GRID_HELP)
    add_states(parser)
    add("--json", action="store_true", help="print JSON")
    add("--csv", metavar="PATH", nargs="?", const="-", help="a table, printed or written to PATH")
    add("--overwrite", action="store_true", help="let --csv replace a file")
    add_solve_arguments(parser)


def _evaluate(arguments: argparse.Namespace) -> int:
    from rankone.share.export.program import pairs_of
    from rankone.support.errors import OptionError, StorageError
    from rankone.support.files import free_target, write_files

    at = pairs_of("--at", arguments.at, float)
    grid = pairs_of("--grid", arguments.grid, _axis, _AXIS_FORM)
    for name in (name for name in at if name in grid):
        raise OptionError(f"{name!r} is given in --at and in --grid", remedy="give it once")
    to_file = arguments.csv not in (None, "-")
    if arguments.json and arguments.csv == "-":
        raise OptionError("--json and --csv are both to be printed", remedy="choose one")
    if to_file:  # find out before the solve, not after it
        free_target(arguments.csv, arguments.overwrite, StorageError)

    solution = solution_of(arguments)
    names = solution.states if arguments.states == "all" else solution.unknowns
    axes = {name: [coordinate] for name, coordinate in at.items()} | grid
    states = _states(solution, names, axes)
    axes = {name: axes[name] for name in solution.metadata.coordinates}
    if to_file:
        write_files({Path(arguments.csv): _table(axes, states)}, arguments.overwrite, StorageError)
    if arguments.json:
        print(json.dumps(_plain(solution, at, axes, states), allow_nan=False))
    elif grid or arguments.csv == "-":
        if not to_file:
            print(_table(axes, states), end="")
    elif not to_file:
        units = dict(solution.metadata.units)
        for name, array in states.items():
            unit = f" {units[name]}" if name in units else ""
            print(f"{name} = {array.item()!r}{unit}")
    sys.stdout.flush()
    return status_of(solution)


def _axis(text: str) -> list[float]:
    """The points of an axis; a ValueError if the text does not read as one."""
    import numpy as np

    if ":" not in text:
        return [float(point) for point in text.split(",")]
    lower, upper, count = text.split(":")
    if not 1 <= int(count) <= _LARGEST_GRID or (int(count) == 1 and float(lower) != float(upper)):
        raise ValueError
    return [float(point) for point in np.linspace(float(lower), float(upper), int(count))]


def _states(
    solution: Solution, names: tuple[str, ...], axes: Mapping[str, list[float]]
) -> dict[str, Array]:
    """The states on the grid of all combinations, an axis for each coordinate."""
    import numpy as np

    from rankone.support.errors import OptionError

    size = math.prod(map(len, axes.values())) * len(names)
    if size > _LARGEST_GRID:
        raise OptionError(
            f"the grid has {size:,} values", remedy=f"ask for at most {_LARGEST_GRID:,}"
        )
    if all(len(axis) == 1 for axis in axes.values()):  # to the last bit as a call
        at = {name: axis[0] for name, axis in axes.items()}
        shape = (1,) * len(axes)
        return {name: np.reshape(solution[name](at), shape) for name in names}
    return {name: solution[name].grid(axes) for name in names}


def _plain(
    solution: Solution,
    at: Mapping[str, float],
    axes: Mapping[str, list[float]],
    states: Mapping[str, Array],
) -> dict[str, object]:
    """Coordinates and states for JSON: numbers where one point was given, else nested lists."""
    single = tuple(position for position, name in enumerate(axes) if name in at)
    return {
        "success": solution.success,
        "error": finite_or_none(solution.error),
        "coordinates": {name: at.get(name, axis) for name, axis in axes.items()},
        "values": {name: array.squeeze(single).tolist() for name, array in states.items()},
    }


def _table(axes: Mapping[str, list[float]], states: Mapping[str, Array]) -> str:
    """A line of names and one for each point; the digits give the numbers back exactly."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*axes, *states])
    columns = (array.ravel().tolist() for array in states.values())
    points = itertools.product(*axes.values())
    for point, row in zip(points, zip(*columns, strict=True), strict=True):
        writer.writerow([*point, *row])
    return text.getvalue()
