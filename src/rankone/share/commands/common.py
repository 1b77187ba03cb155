"""Shared by all commands: parsers, problem files and saved solutions, summaries, exit status."""

from __future__ import annotations

import argparse
import math
import os
import runpy
import sys
import tomllib
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from rankone.problem.toml_layout import SHOWN, text_arguments
from rankone.support.errors import ProblemError, RankoneError, listing
from rankone.support.files import as_path
from rankone.support.options import RTOL

if TYPE_CHECKING:
    from rankone.problem.problem import Problem
    from rankone.solution.solution import Solution


def load_problem(path: str | PathLike[str]) -> Problem:
    """Read a problem from a ``.toml`` file, or from a ``.py`` file, which is *executed*.

    A ProblemError says that there is no such file, that it cannot be run or read, or that the
    problem is not well posed.
    """
    file = as_path(path, ProblemError)
    if file.suffix not in (".py", ".toml"):
        raise ProblemError(
            f"`{file}` is neither a .py nor a .toml file",
            term=file,
            remedy="give a Python file with a variable `problem`, or a TOML file",
        )
    try:
        exists = file.is_file()
    except (OSError, ValueError) as error:  # too long, no permission, a null character
        raise ProblemError(f"`{file}` cannot be read: {error}", term=file) from None
    if not exists:
        raise ProblemError(f"there is no file `{file}`", term=file)
    return _from_python(file) if file.suffix == ".py" else _from_toml(file)


def _from_python(file: Path) -> Problem:
    from rankone.problem.problem import Problem

    search_path, folder = [*sys.path], os.getcwd()
    sys.path.insert(0, str(file.resolve().parent))
    try:
        names = runpy.run_path(str(file), run_name="<rankone>")
    except (RankoneError, KeyboardInterrupt):
        raise
    except BaseException as error:
        message = f"`{file}`{_line(error, file)} failed: {type(error).__name__}: {error}"
        raise ProblemError(message, term=file) from error
    finally:
        sys.path[:] = search_path
        os.chdir(folder)
    problem = names.get("problem")
    if isinstance(problem, Problem):
        return problem
    message = f"`{file}` has no variable `problem`"
    if "problem" in names:
        kind = type(problem).__name__
        message = f"the variable `problem` of `{file}` is a {kind}, not a Problem"
    problems = [name for name, variable in names.items() if isinstance(variable, Problem)]
    if problems:
        message += f"; it has {listing(problems)}"
    raise ProblemError(message, term=file, remedy="write problem = rankone.Problem(...)")


def _line(error: BaseException, file: Path) -> str:
    """The line of the file that raised the error."""
    if isinstance(error, SyntaxError) and error.lineno is not None:
        return f", line {error.lineno},"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(file)]
    return f", line {lines[-1]}," if lines else ""


def _from_toml(file: Path) -> Problem:
    from rankone.problem.problem import Problem

    try:
        with file.open("rb") as stream:
            content = tomllib.load(stream)
    except tomllib.TOMLDecodeError as error:
        raise ProblemError(
            f"`{file}` is not readable TOML: {error}",
            term=file,
            remedy=f"{SHOWN}, with formulas in quotes",
        ) from error
    except (UnicodeDecodeError, OSError, ValueError, RecursionError) as error:
        raise ProblemError(f"`{file}` is not readable TOML: {error}", term=file) from None
    return Problem.from_strings(**text_arguments(content, str(file)))


# -----------------------------------------------------------------------------
# Shared by all commands: parsers, problem files and saved solutions, summaries, exit status.


# Exit status: the measured error is within the tolerance; it is not, or is not known; an argument
# or a file is wrong
SUCCESS, FAILURE, BAD_INPUT = range(3)
PROBLEM_HELP = "a Python file (executed) with a variable `problem`, or a TOML file (see below)"
MODEL_HELP = f"{PROBLEM_HELP}, or a model: SBML (.xml, .sbml) or Antimony (.ant)"
SOLVED_HELP = "a saved solution (.npz or .nc), or a problem file (.py or .toml), solved first"

PAIRS: dict[str, Any] = {"nargs": "+", "action": "extend"}
"""An option with several values, ``NAME=VALUE``, that may be given again."""

spelled: ContextVar[Callable[[str], str]] = ContextVar("spelled", default=str)
"""How messages of the running command are written."""

Commands: TypeAlias = "argparse._SubParsersAction[Any]"


def add_command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], int],
    *,
    usage: str | None = None,
    help: str,
    description: str,
    epilog: str | None = None,
) -> argparse.ArgumentParser:
    """Add the parser of a command; ``run`` gets its arguments and returns the exit status."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        usage=usage,
        help=help,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter if epilog else argparse.HelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def add_solve_arguments(parser: argparse.ArgumentParser) -> None:
    """What a problem file is solved with."""
    help_text = "relative tolerance for a problem file (default: 1e-6)"
    parser.add_argument("--rtol", type=float, help=help_text)
    add_set(parser)


def add_set(parser: argparse.ArgumentParser) -> None:
    help_text = "other numbers of constants of a problem file; a parameter is fixed at its number"
    parser.add_argument("--set", metavar="NAME=VALUE", **PAIRS, help=help_text)


def add_states(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--states",
        choices=("unknowns", "all"),
        help="all: derivatives that are states (x_t) as well (default: unknowns)",
    )


def add_model_arguments(parser: argparse.ArgumentParser) -> None:
    add_solve_arguments(parser)
    parser.add_argument("--method", help="the engine (default: auto)")
    parser.add_argument(
        "--model-rtol",
        metavar="RTOL",
        type=float,
        help="by how much the model may differ from the solution, to be smaller (default: not)",
    )
    parser.add_argument(
        "--allow-failed",
        action="store_true",
        help="write it also if the error is not within the tolerance (status 1)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")


def toml_help() -> str:
    """The layout of a TOML file, for the help."""
    from rankone.problem.toml_layout import TOML_LAYOUT

    return "layout of a TOML file:\n" + "".join(
        f"  {line}\n" if line else "\n" for line in TOML_LAYOUT.splitlines()
    )


def is_saved(path: Path) -> bool:
    return path.suffix in (".npz", ".nc")


def problem_of(path: Path, numbers: Sequence[str] | None) -> Problem:
    """The problem of a file, with other numbers of constants, ``m=2.5``."""

    return with_numbers(load_problem(path), numbers)


def with_numbers(problem: Problem, numbers: Sequence[str] | None) -> Problem:
    """A problem with the numbers of ``--set``."""
    from rankone.share.export.program import pairs_of

    return problem.set(pairs_of("--set", numbers, float)) if numbers else problem


def solution_of(
    arguments: argparse.Namespace, method: str | None = None, effort: str | float = "normal"
) -> Solution:
    """Load a saved solution, which takes no tolerance and no method, or solve a problem file."""
    import rankone
    from rankone.problem.models.sbml_formulas import is_model_file
    from rankone.solution.solution import load
    from rankone.support.budget import preparing
    from rankone.support.errors import OptionError, ProblemError

    path, rtol, numbers = arguments.file, arguments.rtol, arguments.set
    if is_saved(path):
        for option, argument in (("--rtol", rtol), ("--method", method), ("--set", numbers)):
            if argument is not None:
                raise OptionError(
                    f"{option} is for problem files; `{path}` is solved already",
                    remedy=f"leave {option} out, or solve again",
                )
        return load(path)
    if path.suffix not in (".py", ".toml"):
        solved_first = f"rankone solve {path} --t-final 10 --save {path.stem}.npz"
        raise ProblemError(
            f"`{path}` is neither a saved solution nor a problem file",
            term=path,
            remedy=f"solve the model first: {solved_first}"
            if is_model_file(path)
            else "give an .npz, .nc, .py or .toml file",
        )
    with preparing(None):
        compiled = rankone.compile(problem_of(path, numbers))
    rtol = RTOL if rtol is None else rtol
    engine = "auto" if method is None else method
    return compiled.solve(rtol=rtol, method=engine, effort=effort)  # type: ignore[arg-type]


def model_problem(path: Path, box: Mapping[str, Any], t_final: float | None) -> Problem:
    """The problem of a model file: its box and the end of its horizon, which starts at 0."""
    from rankone.problem.models.sbml import read_sbml
    from rankone.support.errors import OptionError

    model = read_sbml(path)
    if t_final is None:
        raise OptionError(
            f"`{path}` is a model, which has no horizon", remedy="give its end: --t-final 10"
        )
    intervals = {name: tuple(interval) for name, interval in box.items()}
    return model.problem(intervals, time=(0.0, t_final))


def may_be_written(solution: Solution, arguments: argparse.Namespace) -> bool:
    """Whether to write a model of a solution; if not, say so on the standard error stream."""
    if solution.success or arguments.allow_failed:
        return True
    from rankone.support.errors import with_remedy

    again = "solve again" if is_saved(arguments.file) else "another --rtol"
    message = f"error: nothing was written: {solution.message}"
    complain(with_remedy(message, f"{again}, or --allow-failed to write it as it is"))
    return False


def status_of(solution: Solution) -> int:
    """The exit status; a failure is reported on the standard error stream."""
    if solution.success:
        return SUCCESS
    complain(f"warning: the error is not within the tolerance: {solution.message}")
    return FAILURE


def complain(text: str) -> None:
    print(f"rankone: {spelled.get()(text)}", file=sys.stderr)


def display(result: object) -> None:
    """Print a summary, in the words of the command line."""
    print(spelled.get()(str(result)))


def summary(solution: Solution) -> dict[str, object]:
    """How good a solution is and how it was computed, as JSON; unknown numbers are null."""
    measured = solution.outcome.measured
    return {
        "success": solution.success,
        "status": solution.status.name.lower(),
        "message": spelled.get()(solution.message),
        "method": solution.method,
        "rtol": solution.rtol,
        "error": finite_or_none(solution.error),
        "errors": {name: finite_or_none(error) for name, error in solution.errors.items()},
        "corner_error": finite_or_none(solution.corner_error),
        "undecided": solution.outcome.verdict.undecided,
        "checked": measured
        and {
            "trajectories": measured.points,
            "cover": measured.cover,
            "unknowns": [
                solution.states[i] for i in measured.counted or range(len(solution.states))
            ],
            "quantile95": measured.quantile,
            "worst": dict(zip(solution.parameters, measured.worst, strict=False)),
            "integrator": measured.integrator,
            "integration_method": measured.method,
        },
        "unknowns": list(solution.unknowns),
        "time": None if solution.metadata.timeless else list(solution.time),
        "parameters": {name: list(interval) for name, interval in solution.parameters.items()},
        "slabs": len(solution.ranks),
        "rank": solution.rank,
        "nodes": list(solution.nodes),
        "timings": solution.timings,
        "version": solution.metadata.version,
        "units": dict(solution.metadata.units),
        "narrower": solution.outcome.verdict.narrower,
    }


def finite_or_none(x: float) -> float | None:
    """A number that JSON can hold, or None."""
    return float(x) if math.isfinite(x) else None
