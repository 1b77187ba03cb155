"""``rankone export FILE -o PATH``: a standalone solver, or a solved model."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rankone.commands.inputs import (
    FAILURE,
    MODEL_RTOL,
    SUCCESS,
    is_saved,
    layout,
    may_be_written,
    solution_of,
)

__all__ = ["register", "run"]

_FMI = ("2.0", "3.0")


def register(commands: Any) -> None:
    """Add the parser."""
    parser = commands.add_parser(
        "export",
        help="write a standalone solver or a solved model",
        description="Write a problem and its engine to one Python file, which needs only NumPy "
        "and SciPy and is both a module and a program. Of a saved solution, with --model, or with "
        "another suffix than .py, write a solved model, for evaluation only.",
        epilog=layout(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "file",
        metavar="FILE",
        type=Path,
        help="a problem file (.py, .toml) or a saved solution (.npz, .nc)",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="PATH",
        type=Path,
        required=True,
        help="a .py file; for models the suffix says what is written",
    )
    parser.add_argument(
        "--model", action="store_true", help="solve and write a model, also with the suffix .py"
    )
    parser.add_argument("--rtol", type=float, help="tolerance of a model (default: 1e-6)")
    parser.add_argument("--method", help="the engine (default: auto)")
    parser.add_argument("--model-rtol", **MODEL_RTOL)
    parser.add_argument(
        "--states",
        choices=("unknowns", "all"),
        help="whether a model evaluates derivatives that are states as well (default: unknowns)",
    )
    parser.add_argument("--fmi", choices=_FMI, help="version of an FMU (default: 2.0)")
    parser.add_argument(
        "--allow-failed",
        action="store_true",
        help="write a model also if its error is not within the tolerance (status 1)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write what was asked for."""
    is_model = arguments.model or is_saved(arguments.file) or arguments.output.suffix != ".py"
    return _write_model(arguments) if is_model else _write_solver(arguments)


def _write_solver(arguments: argparse.Namespace) -> int:
    """Write a standalone solver."""
    import rankone
    from rankone.export import solver_target
    from rankone.frontend.problem_files import load_problem
    from rankone.support.errors import OptionError

    for name in ("rtol", "allow_failed", "model_rtol", "states", "fmi"):
        if getattr(arguments, name):
            raise OptionError(
                f"--{name.replace('_', '-')} is for models; a standalone solver is told when it "
                "solves",
                remedy="add --model, or leave it out",
            )
    solver_target(arguments.output, arguments.overwrite)
    compiled = rankone.compile(load_problem(arguments.file))
    method = arguments.method or "auto"
    compiled.export(arguments.output, method=method, overwrite=arguments.overwrite)
    return SUCCESS


def _write_model(arguments: argparse.Namespace) -> int:
    """Load or solve, and write a solved model."""
    from rankone.export import check_options, model_target

    # before the solve, not after it
    target = model_target(arguments.output, arguments.overwrite)
    check_options(target, rtol=arguments.model_rtol, fmi=arguments.fmi)
    solution = solution_of(arguments.file, arguments.rtol, arguments.method)
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
