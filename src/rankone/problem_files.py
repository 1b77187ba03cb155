"""Problems from files: Python files with a variable ``problem``, and TOML files.

A TOML file has the fields of :meth:`rankone.Problem.from_strings` in the layout of
:data:`TOML_LAYOUT`, and may have a ``name``.
Instead of ``time = [0, 6]`` there may be a table ``[time]`` with ``start`` and ``end``.
"""

from __future__ import annotations

import runpy
import sys
import tomllib
import traceback
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rankone.errors import ProblemError, RankoneError
from rankone.wording import did_you_mean, listing

if TYPE_CHECKING:
    from rankone.symbolic import Problem

__all__ = ["TOML_LAYOUT", "load_problem"]

TOML_LAYOUT = """\
time = [0, 6]

[rhs]                      # right-hand side of each derivative; t is time
x = "x*(1.5 - y)"
y = "-y*(3 - x)"

[initial]                  # numbers or formulas of the parameters
x = "x0"
y = "y0"

[parameters]               # the box; may be left out
x0 = [8, 12]
y0 = [4, 6]
"""

_REQUIRED = ("time", "rhs", "initial")
_OPTIONAL = ("parameters", "name")


def load_problem(path: str | PathLike[str]) -> Problem:
    """Read a problem from a file.

    Parameters
    ----------
    path : path-like
        A ``.py`` file, which is *executed* and leaves a variable ``problem``, or a ``.toml`` file.

    Raises
    ------
    ProblemError
        If there is no such file, it cannot be run or read, or the problem is not well posed.
    """
    file = Path(path)
    if file.suffix not in (".py", ".toml"):
        raise ProblemError(
            f"`{file}` is neither a .py nor a .toml file",
            term=file,
            remedy="give a Python file with a variable `problem`, or a TOML file",
        )
    if not file.is_file():
        raise ProblemError(f"there is no file `{file}`", term=file)
    return _from_python(file) if file.suffix == ".py" else _from_toml(file)


def _from_python(file: Path) -> Problem:
    from rankone.symbolic import Problem

    sys.path.insert(0, str(file.resolve().parent))
    try:
        names = runpy.run_path(str(file), run_name="<rankone>")
    except (RankoneError, KeyboardInterrupt):
        raise
    except BaseException as error:
        where = f"`{file}`{_line(error, file)}"
        raise ProblemError(f"{where} failed: {type(error).__name__}: {error}", term=file) from error
    finally:
        sys.path.remove(str(file.resolve().parent))
    problem = names.get("problem")
    if isinstance(problem, Problem):
        return problem
    others = [name for name, value in names.items() if isinstance(value, Problem)]
    found = f"; it has {listing(others)}" if others else ""
    wrong = (
        f"the variable `problem` of `{file}` is a {type(problem).__name__}, not a Problem"
        if "problem" in names
        else f"`{file}` has no variable `problem`"
    )
    raise ProblemError(f"{wrong}{found}", term=file, remedy="write problem = rankone.Problem(...)")


def _line(error: BaseException, file: Path) -> str:
    """The line of the file at which the error came up."""
    if isinstance(error, SyntaxError) and error.lineno is not None:
        return f", line {error.lineno},"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(file)]
    return f", line {lines[-1]}," if lines else ""


def _from_toml(file: Path) -> Problem:
    from rankone.symbolic import Problem

    try:
        with file.open("rb") as stream:
            content = tomllib.load(stream)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise ProblemError(f"`{file}` is not readable TOML: {error}", term=file) from error
    known = (*_REQUIRED, *_OPTIONAL)
    for key in content:
        if key not in known:
            raise ProblemError(
                f"`{file}` has the unknown key `{key}`{did_you_mean(key, known)}; "
                f"known are {listing(known)}",
                term=key,
            )
    missing = [key for key in _REQUIRED if key not in content]
    if missing:
        raise ProblemError(
            f"`{file}` lacks {listing(missing)}",
            term=missing,
            remedy="`rankone solve --help` shows the layout",
        )
    return Problem.from_strings(
        rhs=_texts(content["rhs"]),
        initial=content["initial"],
        parameters=content.get("parameters", {}),
        time=_horizon(content["time"]),
        name=content.get("name"),
    )


def _texts(table: Any) -> Any:
    """Right-hand sides as text: TOML numbers are welcome as well."""
    if not isinstance(table, Mapping):
        return table
    return {key: value if isinstance(value, str) else repr(value) for key, value in table.items()}


def _horizon(time: Any) -> Any:
    """Start and end, from a pair or from a table."""
    if not isinstance(time, Mapping):
        return time
    if set(time) != {"start", "end"}:
        raise ProblemError(
            f"the table [time] has {listing(time) or 'nothing'}",
            term=time,
            remedy="give `start` and `end`, or write time = [start, end]",
        )
    return time["start"], time["end"]
