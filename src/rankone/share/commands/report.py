"""``rankone report FILE``: summary, statistics and plots of a solution."""

from __future__ import annotations

import argparse
import io
import json
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rankone.share.commands.common import (
    SOLVED_HELP,
    Commands,
    add_command,
    add_solve_arguments,
    complain,
    finite_or_none,
    solution_of,
    status_of,
    summary,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.solution.solution import Solution

_FOLDER_HELP = (
    "the directory of report.txt, report.json and the plots (default: NAME_report for NAME.nc, in "
    "the working directory)"
)
_NO_PLOTS_HELP = "no plots, and no files unless -o is given"
_TEXTS = ("report.txt", "report.json")
_PLOT_RESOLUTION = 150  # Dots per inch of a plot


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "report",
        _report,
        help="print what a solution is, its statistics and sensitivities",
        description="Print the summary of a solution, and means, spreads, 95 % bands and Sobol "
        "indices of its unknowns at the end of the horizon, for parameters spread over the box; "
        "write the same and plots (with matplotlib) into a directory.",
    )
    add = parser.add_argument
    add("file", metavar="FILE", type=Path, help=SOLVED_HELP)
    add("-o", "--output", metavar="DIR", type=Path, help=_FOLDER_HELP)
    add("--no-plots", dest="plots", action="store_false", help=_NO_PLOTS_HELP)
    add("--json", action="store_true", help="print JSON")
    add("--overwrite", action="store_true", help="replace existing files")
    add_solve_arguments(parser)


def _report(arguments: argparse.Namespace) -> int:
    """Print, and write files if there are plots or a directory is given."""
    from rankone.support.errors import StorageError
    from rankone.support.files import Content, write_files

    plots = arguments.plots and _can_plot()
    folder: Path | None = arguments.output
    if folder is None and plots:
        folder = Path(f"{arguments.file.stem}_report")
    if folder is not None:  # find out before the solve, not after it
        _check_place(folder, arguments.overwrite)
    solution = solution_of(arguments)
    statistics = _statistics(solution)
    answer: dict[str, object] = {"file": str(arguments.file), **summary(solution)}
    answer |= {"ranks": [list(ranks) for ranks in solution.ranks], "bytes": solution.nbytes}
    if statistics:
        sobol = {f"sobol_{order}": shares for order, shares in statistics.indices.items()}
        answer["statistics"] = {"time": statistics.time, **statistics.moments, **sobol}
    text, as_json = _text(solution, statistics), json.dumps(answer, indent=2, allow_nan=False)
    if folder is not None:
        files: dict[Path, Content] = {
            folder / name: content + "\n"
            for name, content in zip(_TEXTS, (text, as_json), strict=True)
        }
        if plots:
            files |= {folder / name: content for name, content in _plots(solution)}
        try:
            folder.mkdir(exist_ok=True)
        except (OSError, ValueError) as error:
            raise StorageError(f"the directory `{folder}` cannot be made: {error}") from error
        write_files(files, arguments.overwrite, StorageError)
    print(as_json if arguments.json else text)
    if folder is not None and arguments.output is None:
        complain(f"written to the directory `{folder}`")
    sys.stdout.flush()
    return status_of(solution)


def _check_place(folder: Path, overwrite: bool) -> None:
    """Raise a StorageError if the directory cannot be made, or holds a report to be kept."""
    from rankone.support.errors import StorageError
    from rankone.support.files import free_target

    try:
        exists, is_folder = folder.exists(), folder.is_dir()
    except (OSError, ValueError) as error:  # too long, no permission, a null character
        raise StorageError(f"`{folder}` cannot be made: {error}", term=folder) from None
    if is_folder:
        for path in (folder / name for name in _TEXTS):
            free_target(path, overwrite, StorageError)
    elif exists:
        raise StorageError(
            f"`{folder}` is not a directory", term=folder, remedy="give another: -o DIR"
        )
    else:
        free_target(folder, overwrite, StorageError)


@dataclass(frozen=True)
class _Statistics:
    """Moments by column and unknown, Sobol indices by order, unknown and parameter, at a time."""

    time: float | None
    moments: dict[str, dict[str, float | None]]
    indices: dict[str, dict[str, dict[str, float | None]]]


def _statistics(solution: Solution) -> _Statistics | None:
    """The statistics at the end of what was solved; None if nothing was."""
    if not solution.outcome.slabs or solution.outcome.timeline is not None:
        return None
    from rankone.solution.statistics.over_box import CENTRAL

    at = () if solution.metadata.timeless else (solution.time[1],)
    low, high = solution.quantile(CENTRAL, *at)
    columns = {
        "mean": solution.mean(*at),
        "std": solution.std(*at),
        "quantile_0.025": low,
        "quantile_0.975": high,
    }
    moments = {
        column: dict(zip(solution.unknowns, map(finite_or_none, moment), strict=True))
        for column, moment in columns.items()
    }
    indices: dict[str, dict[str, dict[str, float | None]]] = {}
    if _has_indices(solution):
        sobol = solution.sobol(*at)
        for order, shares in (("first", sobol.first), ("total", sobol.total)):
            indices[order] = {
                unknown: dict(
                    zip(solution.parameters, map(finite_or_none, share.ravel()), strict=True)
                )
                for unknown, share in zip(solution.unknowns, shares, strict=True)
            }
    return _Statistics(at[0] if at else None, moments, indices)


def _text(solution: Solution, statistics: _Statistics | None) -> str:
    if statistics is None:
        return repr(solution)
    units = dict(solution.metadata.units)
    names = [f"{name} [{units[name]}]" if name in units else name for name in solution.unknowns]
    time = solution.metadata.time
    clock = "" if statistics.time is None else f" at {time} = {statistics.time:g}"
    clock += f" {units[time]}" if clock and time in units else ""
    heads = {"mean": "mean", "std": "std", "quantile_0.025": "2.5 %", "quantile_0.975": "97.5 %"}
    rows = [
        [name, *(_shown(statistics.moments[column][unknown]) for column in heads)]
        for name, unknown in zip(names, solution.unknowns, strict=True)
    ]
    lines = [repr(solution), f"Over the box{clock}:", _table(["", *heads.values()], rows)]
    if statistics.indices:
        rows = [
            [unknown, order, *map(_shown, shares[unknown].values())]
            for unknown in solution.unknowns
            for order, shares in statistics.indices.items()
        ]
        lines += [f"Sobol indices{clock}:", _table(["", "", *solution.parameters], rows)]
    elif solution.parameters:
        lines.append("No Sobol indices: the parameters are correlated")
    return "\n".join(lines)


def _has_indices(solution: Solution) -> bool:
    """Whether Sobol indices are defined: there are parameters, and they are independent."""
    return bool(solution.parameters) and not solution.metadata.correlations


def _shown(statistic: float | None) -> str:
    return "undefined" if statistic is None else f"{statistic:.5g}"


def _table(head: list[str], rows: list[list[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    return "\n".join(
        "  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in [head, *rows]
    )


def _plots(solution: Solution) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the plots that can be made; a warning for others."""
    from matplotlib.figure import Figure

    from rankone.share.plotting.style import FIGURE_SIZE
    from rankone.support.errors import RankoneError

    if not solution.outcome.slabs:
        return
    for kind, draw in _standard(solution).items():
        for position, unknown in enumerate(solution.unknowns):
            figure = Figure(figsize=FIGURE_SIZE, layout="constrained")
            try:
                draw(unknown, figure.subplots())
            except RankoneError as error:
                complain(f"warning: no plot of {kind} of `{unknown}`: {error}")
                continue
            content = io.BytesIO()
            figure.savefig(content, format="png", dpi=_PLOT_RESOLUTION)
            file = re.sub(r"\W", "_", unknown) if unknown.isidentifier() else str(position)
            yield f"{kind}_{file}.png", content.getvalue()


def _standard(solution: Solution) -> dict[str, Callable[[str, Axes], object]]:
    """Functions that draw the plots that apply, by the first word of their file names."""
    from rankone.share import plotting

    plots: dict[str, Callable[[str, Axes], object]] = {}
    timeless = solution.metadata.timeless
    end = None if timeless else solution.time[1]
    centre = {name: 0.5 * (low + high) for name, (low, high) in solution.parameters.items()}
    if not timeless:
        title = "at the centre of the box" if centre else ""
        plots["trajectories"] = lambda unknown, ax: plotting.plot_trajectories(
            solution, centre, unknowns=unknown, ax=ax
        ).set_title(title, fontsize="medium", loc="left")
    if solution.parameters and not timeless:
        plots["bands"] = lambda unknown, ax: plotting.plot_bands(solution, unknown, ax=ax)
    if _has_indices(solution):
        plots["sobol"] = lambda unknown, ax: plotting.plot_sobol(solution, unknown, ax=ax)
    if solution.parameters:
        plots["main_effects"] = lambda unknown, ax: plotting.plot_main_effects(
            solution, unknown, end, ax=ax
        )
    return plots


def _can_plot() -> bool:
    """Whether Matplotlib is installed; if not, say what to install."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        from rankone.support.errors import with_remedy

        complain(with_remedy("warning: no plots without matplotlib", "pip install matplotlib"))
        return False
    return True
