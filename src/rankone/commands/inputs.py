"""What commands take and how they end: problem files, saved solutions, exit status."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import argparse

    from rankone.interface.solution import Solution

__all__ = [
    "BAD_INPUT",
    "FAILURE",
    "MODEL_RTOL",
    "PROBLEM_HELP",
    "SOLVED_HELP",
    "SUCCESS",
    "complain",
    "is_saved",
    "layout",
    "may_be_written",
    "solution_of",
    "status_of",
]

SUCCESS, FAILURE, BAD_INPUT = 0, 1, 2
PROBLEM_HELP = "a Python file (executed) with a variable `problem`, or a TOML file (see below)"
SOLVED_HELP = "a saved solution (.npz or .nc), or a problem file (.py or .toml), solved first"
MODEL_RTOL: dict[str, Any] = {
    "metavar": "RTOL",
    "type": float,
    "help": "by how much the model may differ from the solution, to be smaller (default: not)",
}
"""The option of commands that write a model."""
_DEFAULT_RTOL = 1e-6


def layout() -> str:
    """The layout of a TOML file, for the help."""
    from rankone.frontend.problem_files import TOML_LAYOUT

    return "layout of a TOML file:\n" + "".join(
        f"  {line}\n" if line else "\n" for line in TOML_LAYOUT.splitlines()
    )


def is_saved(path: Path) -> bool:
    """Whether a name is that of a saved solution."""
    return path.suffix in (".npz", ".nc")


def solution_of(
    path: Path, rtol: float | None, method: str | None = None, effort: str | float = "normal"
) -> Solution:
    """Load a saved solution, or solve a problem file.

    Raises
    ------
    OptionError
        If a tolerance or a method is given for what is solved already.
    StorageError, ProblemError
        If there is no such file, or it holds something else.
    """
    import rankone
    from rankone.frontend.problem_files import load_problem
    from rankone.support.budget import preparing
    from rankone.support.errors import OptionError, ProblemError

    if is_saved(path):
        given = {"--rtol": rtol, "--method": method}
        for option in (option for option, value in given.items() if value is not None):
            raise OptionError(
                f"{option} is for problem files; `{path}` is solved already",
                remedy=f"leave {option} out, or solve again",
            )
        return rankone.load(path)
    if path.suffix not in (".py", ".toml"):
        raise ProblemError(
            f"`{path}` is neither a saved solution nor a problem file",
            term=path,
            remedy="give an .npz, .nc, .py or .toml file",
        )
    with preparing(None):
        compiled = rankone.compile(load_problem(path))
    rtol = _DEFAULT_RTOL if rtol is None else rtol
    chosen = "auto" if method is None else method
    return compiled.solve(rtol=rtol, method=chosen, effort=effort)  # type: ignore[arg-type]


def may_be_written(solution: Solution, arguments: argparse.Namespace) -> bool:
    """Whether to write a model of a solution; a word on the standard error stream if not."""
    if solution.success or arguments.allow_failed:
        return True
    again = "solve again" if is_saved(arguments.file) else "another --rtol"
    complain(
        f"error: nothing was written: {solution.message}; remedy: {again}, or --allow-failed to "
        "write it as it is"
    )
    return False


def status_of(solution: Solution) -> int:
    """The exit status; a word on the standard error stream if it is no success."""
    if solution.success:
        return SUCCESS
    complain(f"warning: the error is not within the tolerance: {solution.message}")
    return FAILURE


def complain(text: str) -> None:
    """Print one line on the standard error stream."""
    print(f"rankone: {text}", file=sys.stderr)
