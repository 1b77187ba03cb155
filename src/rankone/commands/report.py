"""``rankone report FILE``: summary, statistics and plots of a solution."""

from __future__ import annotations

import argparse
import importlib
import io
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rankone.commands.inputs import SOLVED_HELP, complain, solution_of, status_of

if TYPE_CHECKING:
    from rankone.solution import Solution

__all__ = ["register", "run"]

_BAND = (0.025, 0.975)
_PLOTS = {"bands": "plot_bands", "sobol": "plot_sobol", "main_effects": "plot_main_effects"}
"""Plots of each unknown: for the beginning of the file's name the function."""
_OVER_TIME, _AT_ONE_TIME = ("bands",), ("main_effects",)
"""Those that need time, and those of one time."""


def register(commands: Any) -> None:
    """Add the parser."""
    parser = commands.add_parser(
        "report",
        help="print what a solution is, its statistics and sensitivities",
        description="Print the summary of a solution, and means, spreads, 95 % bands and Sobol "
        "indices of its unknowns at the end of the horizon, for parameters spread over the box.",
    )
    parser.add_argument("file", metavar="FILE", type=Path, help=SOLVED_HELP)
    parser.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        type=Path,
        help="write report.txt, report.json and plots (with matplotlib) into a directory",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    parser.add_argument(
        "--rtol", type=float, help="relative tolerance for a problem file (default: 1e-6)"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print, and write files if a directory is given."""
    from rankone.errors import StorageError
    from rankone.files import Content, write_files

    texts = {}
    if arguments.output is not None:  # find out before the solve, not after it
        texts = _places(arguments.output, arguments.overwrite)
    solution = solution_of(arguments.file, arguments.rtol)
    data = {"file": str(arguments.file), **_data(solution)}
    text, as_json = _text(solution, data), json.dumps(data, indent=2, allow_nan=False)
    if texts:
        files: dict[Path, Content] = {texts["txt"]: text + "\n", texts["json"]: as_json + "\n"}
        files |= {arguments.output / name: content for name, content in _plots(solution)}
        write_files(files, arguments.overwrite, StorageError)
    print(as_json if arguments.json else text)
    sys.stdout.flush()
    return status_of(solution)


def _places(folder: Path, overwrite: bool) -> dict[str, Path]:
    """Where the texts go; the directory is made."""
    from rankone.errors import StorageError
    from rankone.files import free_target

    try:
        folder.mkdir(exist_ok=True)
    except (OSError, ValueError) as error:
        raise StorageError(f"the directory `{folder}` cannot be made: {error}") from error
    return {
        kind: free_target(folder / f"report.{kind}", overwrite, StorageError)
        for kind in ("txt", "json")
    }


# --- numbers -----------------------------------------------------------------------------------


def _data(solution: Solution) -> dict[str, Any]:
    """The summary and the statistics at the end of what was solved, in plain data."""
    from rankone.commands.summary import number, summary

    data = {**summary(solution), "ranks": [list(ranks) for ranks in solution.ranks]}
    data["bytes"] = solution.nbytes
    if not solution.outcome.slabs:
        return data
    at = () if solution.metadata.timeless else (solution.time[1],)
    low, high = solution.quantile(_BAND, *at)
    columns = {
        "mean": solution.mean(*at),
        "std": solution.std(*at),
        "quantile_0.025": low,
        "quantile_0.975": high,
    }
    data["statistics"] = {
        "time": at[0] if at else None,
        **{
            name: dict(zip(solution.unknowns, map(number, values), strict=True))
            for name, values in columns.items()
        },
    }
    if solution.parameters:
        indices = solution.sobol(*at)
        for name, shares in (("first", indices.first), ("total", indices.total)):
            data["statistics"][f"sobol_{name}"] = {
                unknown: dict(
                    zip(solution.parameters, map(number, row.reshape(len(row))), strict=True)
                )
                for unknown, row in zip(solution.unknowns, shares, strict=True)
            }
    return data


def _text(solution: Solution, data: dict[str, Any]) -> str:
    """The summary and the statistics as tables."""
    found = data.get("statistics")
    if found is None:
        return repr(solution)
    units = dict(solution.metadata.units)
    names = [f"{name} [{units[name]}]" if name in units else name for name in solution.unknowns]
    time = solution.metadata.time
    clock = "" if found["time"] is None else f" at {time} = {found['time']:g}"
    clock += f" {units[time]}" if clock and time in units else ""
    heads = {"mean": "mean", "std": "std", "quantile_0.025": "2.5 %", "quantile_0.975": "97.5 %"}
    rows = [
        [name, *(_shown(found[key][unknown]) for key in heads)]
        for name, unknown in zip(names, solution.unknowns, strict=True)
    ]
    parts = [repr(solution), f"Over the box{clock}:", _table(["", *heads.values()], rows)]
    if solution.parameters:
        rows = [
            [name, kind, *map(_shown, found[f"sobol_{kind}"][name].values())]
            for name in solution.unknowns
            for kind in ("first", "total")
        ]
        parts += [f"Sobol indices{clock}:", _table(["", "", *solution.parameters], rows)]
    return "\n".join(parts)


def _shown(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.5g}"


def _table(head: list[str], rows: list[list[str]]) -> str:
    """Aligned columns, indented."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    return "\n".join(
        "  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in [head, *rows]
    )


# --- plots -------------------------------------------------------------------------------------


def _plots(solution: Solution) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the plots that can be made; what cannot is said."""
    from rankone.errors import RankoneError

    try:
        figures: Any = importlib.import_module("matplotlib.figure")
        plotting: Any = importlib.import_module("rankone.plotting")
    except (ImportError, RankoneError):
        complain("warning: no plots without matplotlib; remedy: pip install matplotlib")
        return
    if not (solution.outcome.slabs and solution.parameters):
        return
    for kind, name in _PLOTS.items():
        if not hasattr(plotting, name) or (kind in _OVER_TIME and solution.metadata.timeless):
            continue
        at_end = kind in _AT_ONE_TIME and not solution.metadata.timeless
        at = {"t": solution.time[1]} if at_end else {}
        for number, unknown in enumerate(solution.unknowns):
            figure = figures.Figure(layout="constrained")
            try:
                getattr(plotting, name)(solution, unknown, ax=figure.subplots(), **at)
            except RankoneError as error:
                complain(f"warning: no plot of {kind}: {error}")
                break
            content = io.BytesIO()
            figure.savefig(content, format="png", dpi=150)
            file = re.sub(r"\W", "_", unknown) if unknown.isidentifier() else str(number)
            yield f"{kind}_{file}.png", content.getvalue()
