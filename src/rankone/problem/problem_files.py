"""Problems from files: Python files with a variable ``problem``, and TOML files."""

from __future__ import annotations

import os
import runpy
import sys
import tomllib
import traceback
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from rankone.problem.toml_layout import SHOWN, text_arguments
from rankone.support.errors import ProblemError, RankoneError
from rankone.support.files import as_path
from rankone.support.wording import listing

if TYPE_CHECKING:
    from rankone.problem.problem import Problem


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
