"""``rankone export`` and ``rankone explore``: a standalone solver, a solved model, or a page."""

from __future__ import annotations

import argparse
from pathlib import Path

from rankone.share.commands.common import (
    FAILURE,
    SOLVED_HELP,
    SUCCESS,
    Commands,
    add_command,
    add_model_arguments,
    add_states,
    is_saved,
    may_be_written,
    problem_of,
    solution_of,
    toml_help,
)

_OUTPUT_HELP = "a .py file; for models the suffix says what is written"
_PAGE_HELP = "the page (default: the name of FILE with .html, in the present directory)"
_FOR_MODELS = ("rtol", "allow_failed", "model_rtol", "states", "fmi")  # Options of models alone


def register(commands: Commands) -> None:
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
    from rankone.share.export.explorer import page_target

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
