"""``rankone eval``, ``export``, ``explore`` and ``report``: what is done with a solution."""

from __future__ import annotations

import argparse
import csv
import io
import itertools
import json
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rankone.share.commands.common import (
    FAILURE,
    PAIRS,
    SOLVED_HELP,
    SUCCESS,
    Commands,
    add_command,
    add_model_arguments,
    add_solve_arguments,
    add_states,
    complain,
    finite_or_none,
    is_saved,
    may_be_written,
    problem_of,
    solution_of,
    status_of,
    summary,
    toml_help,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.solution.solution import Solution
    from rankone.support.arrays import Array


_FOLDER_HELP = (
    "the directory of report.txt, report.json and the plots (default: NAME_report for NAME.nc, in "
    "the working directory)"
)
_NO_PLOTS_HELP = "no plots, and no files unless -o is given"
_TEXTS = ("report.txt", "report.json")
_PLOT_RESOLUTION = 150  # Dots per inch of a plot


def register_report(commands: Commands) -> None:
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
    lines = [repr(solution), f"Over the box{clock}:", _report_table(["", *heads.values()], rows)]
    if statistics.indices:
        rows = [
            [unknown, order, *map(_shown, shares[unknown].values())]
            for unknown in solution.unknowns
            for order, shares in statistics.indices.items()
        ]
        lines += [f"Sobol indices{clock}:", _report_table(["", "", *solution.parameters], rows)]
    elif solution.parameters:
        lines.append("No Sobol indices: the parameters are correlated")
    return "\n".join(lines)


def _has_indices(solution: Solution) -> bool:
    """Whether Sobol indices are defined: there are parameters, and they are independent."""
    return bool(solution.parameters) and not solution.metadata.correlations


def _shown(statistic: float | None) -> str:
    return "undefined" if statistic is None else f"{statistic:.5g}"


def _report_table(head: list[str], rows: list[list[str]]) -> str:
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


# -----------------------------------------------------------------------------
# ``rankone eval``, ``export`` and ``explore``: what is done with a solution.


_AT_HELP = "a value of time, parameters"
_GRID_HELP = "several: LOWER:UPPER:COUNT evenly, or VALUE,VALUE,..."
_AXIS_FORM = "NAME=LOWER:UPPER:COUNT or NAME=VALUE,VALUE"


def register_evaluation(commands: Commands) -> None:
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
    add("--at", metavar="NAME=VALUE", **PAIRS, help=_AT_HELP)
    add("--grid", metavar="NAME=VALUES", **PAIRS, help=_GRID_HELP)
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

    from rankone.support.arrays import MOST_NUMBERS

    if ":" not in text:
        return [float(point) for point in text.split(",")]
    lower, upper, count = text.split(":")
    if not 1 <= int(count) <= MOST_NUMBERS or (int(count) == 1 and float(lower) != float(upper)):
        raise ValueError
    return [float(point) for point in np.linspace(float(lower), float(upper), int(count))]


def _states(
    solution: Solution, names: tuple[str, ...], axes: Mapping[str, list[float]]
) -> dict[str, Array]:
    """The states on the grid of all combinations, an axis for each coordinate."""
    import numpy as np

    from rankone.support.arrays import MOST_NUMBERS
    from rankone.support.errors import OptionError

    size = math.prod(map(len, axes.values())) * len(names)
    if size > MOST_NUMBERS:
        raise OptionError(
            f"the grid has {size:,} values", remedy=f"ask for at most {MOST_NUMBERS:,}"
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


# -----------------------------------------------------------------------------
# ``rankone export`` and ``rankone explore``: a standalone solver, a solved model, or a page.


_OUTPUT_HELP = "a .py file; for models the suffix says what is written"
_PAGE_HELP = "the page (default: the name of FILE with .html, in the present directory)"
_FOR_MODELS = ("rtol", "allow_failed", "model_rtol", "states", "fmi")  # Options of models alone


def register_exports(commands: Commands) -> None:
    export = add_command(
        commands,
        "export",
        _export,
        help="write a standalone solver or a solved model",
        description="Write a problem and its engine to one Python file, which needs only NumPy "
        "and SciPy and is both a module and a program. Of a saved solution, with --model, or with "
        "another suffix than .py, write a solved model, for evaluation only.",
        epilog=toml_help(),
    )
    add = export.add_argument
    add("file", metavar="FILE", type=Path, help=SOLVED_HELP)
    add("-o", "--output", metavar="PATH", type=Path, required=True, help=_OUTPUT_HELP)
    add("--model", action="store_true", help="solve and write a model, also with the suffix .py")
    add_model_arguments(export)
    add_states(export)
    add("--fmi", choices=("2.0", "3.0"), help="version of an FMU (default: 2.0)")

    explore = add_command(
        commands,
        "explore",
        _explore,
        help="write a page with sliders and curves",
        description="Write one HTML file that works offline: a slider for each parameter, curves "
        "that follow at once, bands over the box, a phase plot, Sobol indices over time.",
        epilog=toml_help(),
    )
    add = explore.add_argument
    add("file", metavar="FILE", type=Path, help=SOLVED_HELP)
    add("-o", "--output", metavar="PATH", type=Path, help=_PAGE_HELP)
    add("--title", help="title of the page (default: the name of the problem, or of the page)")
    add_model_arguments(explore)


def _export(arguments: argparse.Namespace) -> int:
    is_model = arguments.model or is_saved(arguments.file) or arguments.output.suffix != ".py"
    return _write_model(arguments) if is_model else _write_solver(arguments)


def _write_solver(arguments: argparse.Namespace) -> int:
    import rankone
    from rankone.share.export import solver_target
    from rankone.support.errors import OptionError

    for name in _FOR_MODELS:
        if vars(arguments)[name]:
            raise OptionError(
                f"--{name.replace('_', '-')} is for models; a standalone solver is told when it "
                "solves",
                remedy="add --model, or leave it out",
            )
    solver_target(arguments.output, arguments.overwrite)
    compiled = rankone.compile(problem_of(arguments.file, arguments.set))
    method = arguments.method or "auto"
    compiled.export(arguments.output, method=method, overwrite=arguments.overwrite)
    return SUCCESS


def _write_model(arguments: argparse.Namespace) -> int:
    from rankone.share.export import check_options, model_target

    # before the solve, not after it
    target = model_target(arguments.output, arguments.overwrite)
    check_options(target, rtol=arguments.model_rtol, fmi=arguments.fmi)
    solution = solution_of(arguments, arguments.method)
    if not may_be_written(solution, arguments):
        return FAILURE
    solution.export(
        target,
        states=arguments.states or "unknowns",
        rtol=arguments.model_rtol,
        fmi=arguments.fmi,
        overwrite=arguments.overwrite,
        allow_failed=arguments.allow_failed,
    )
    return SUCCESS if solution.success else FAILURE


def _explore(arguments: argparse.Namespace) -> int:
    from rankone.share.export import check_options
    from rankone.share.export.pages import page_target

    target = arguments.output or Path(f"{arguments.file.stem}.html")
    # before the solve, not after it
    page_target(target, arguments.overwrite)
    check_options(target, rtol=arguments.model_rtol)
    solution = solution_of(arguments, arguments.method)
    if not may_be_written(solution, arguments):
        return FAILURE
    path = solution.explore(
        target,
        title=arguments.title,
        rtol=arguments.model_rtol,
        overwrite=arguments.overwrite,
        allow_failed=arguments.allow_failed,
    )
    print(path)
    return SUCCESS if solution.success else FAILURE
