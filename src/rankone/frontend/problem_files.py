"""Problems from files: Python files with a variable ``problem``, and TOML files.

A TOML file has the fields of :meth:`rankone.Problem.from_strings` in the layout of
:data:`TOML_LAYOUT`, and may have a ``name``.
Instead of ``time = [0, 6]`` there may be a table ``[time]`` with ``start`` and ``end``.
"""

from __future__ import annotations

import os
import runpy
import sys
import tomllib
import traceback
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

from rankone.support.errors import ProblemError, RankoneError
from rankone.support.files import as_path
from rankone.support.wording import did_you_mean, listing, shown

if TYPE_CHECKING:
    from rankone.frontend.problem import Problem

__all__ = ["TOML_LAYOUT", "load_problem"]

TOML_LAYOUT = """\
time = [0, 6]

[rhs]                      # right-hand side of each derivative; t is time
x = "x*(1.5 - y)"
y = "-y*(3 - x)"

[initial]                  # numbers or formulas of the parameters
x = "x0"
y = "y0"

[[jumps]]                  # resets at known times, such as doses; may be left out
times = [2, 4]             # or a single time = 2
x = "x + 1"                # the value right after it

[units]                    # texts for t, parameters and unknowns; may be left out
t = "years"

[parameters]               # the box; may be left out; or a distribution: "norm(1, 0.1)"
x0 = [8, 12]
y0 = [4, 6]
"""

_LARGEST = sys.float_info.max
_REQUIRED = ("time", "rhs", "initial")
_OPTIONAL = ("parameters", "name", "jumps", "units")
_SHOWN = "`rankone solve --help` shows the layout"


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
    file = as_path(path, ProblemError)
    if file.suffix not in (".py", ".toml"):
        raise ProblemError(
            f"`{file}` is neither a .py nor a .toml file",
            term=file,
            remedy="give a Python file with a variable `problem`, or a TOML file",
        )
    try:
        there = file.is_file()
    except (OSError, ValueError) as error:  # too long, no permission, a null character
        raise ProblemError(f"`{file}` cannot be read: {error}", term=file) from None
    if not there:
        raise ProblemError(f"there is no file `{file}`", term=file)
    return _from_python(file) if file.suffix == ".py" else _from_toml(file)


def _from_python(file: Path) -> Problem:
    from rankone.frontend.problem import Problem

    before, folder = [*sys.path], os.getcwd()
    sys.path.insert(0, str(file.resolve().parent))
    try:
        names = runpy.run_path(str(file), run_name="<rankone>")
    except (RankoneError, KeyboardInterrupt):
        raise
    except BaseException as error:
        where = f"`{file}`{_line(error, file)}"
        raise ProblemError(f"{where} failed: {type(error).__name__}: {error}", term=file) from error
    finally:
        sys.path[:] = before
        os.chdir(folder)
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
    from rankone.frontend.problem import Problem

    try:
        with file.open("rb") as stream:
            content = tomllib.load(stream)
    except tomllib.TOMLDecodeError as error:
        raise ProblemError(
            f"`{file}` is not readable TOML: {error}",
            term=file,
            remedy=f"{_SHOWN}, with formulas in quotes",
        ) from error
    except (UnicodeDecodeError, OSError, ValueError, RecursionError) as error:
        raise ProblemError(f"`{file}` is not readable TOML: {error}", term=file) from None
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
            f"`{file}` lacks {listing(missing)}{_misplaced(content, missing)}",
            term=missing,
            remedy=_SHOWN,
        )
    return Problem.from_strings(
        rhs={n: str(_formula("rhs", n, f)) for n, f in _table(content, "rhs").items()},
        initial={n: _formula("initial", n, f) for n, f in _table(content, "initial").items()},
        parameters={n: _parameter(n, given) for n, given in _table(content, "parameters").items()},
        time=_horizon(content["time"]),
        name=content.get("name"),
        jumps=_jumps(content.get("jumps", [])),
        units=dict(_table(content, "units")),
    )


def _jumps(tables: Any) -> dict[Any, dict[str, str | float]]:
    """The tables [[jumps]]: for their times the values after them."""
    if not isinstance(tables, list) or not all(isinstance(table, Mapping) for table in tables):
        raise ProblemError(
            f"`jumps` is {shown(tables)}, not a list of tables",
            term=tables,
            remedy=f"write [[jumps]], and below it the times and the values; {_SHOWN}",
        )
    found: dict[Any, dict[str, str | float]] = {}
    for table in tables:
        given = [key for key in ("time", "times") if key in table]
        values = {n: _formula("jumps", n, f) for n, f in table.items() if n not in given}
        times = table[given[0]] if given else None
        at = tuple(times) if isinstance(times, list) else (times,)
        if len(given) != 1 or not at or not all(map(_is_number, at)):
            raise ProblemError(
                f"[[jumps]] has {f'`{given[0]}` = {shown(times)}' if given else 'no times'}"
                + ("" if given else f", but {listing(table)}"),
                term=table,
                remedy="write time = 8, or times = [8, 16], once",
            )
        known = [time for key in found for time in key]
        if len({*known, *at}) < len(known) + len(at):
            raise ProblemError(
                f"[[jumps]] has a time twice, among {listing(map(str, at))}",
                term=table,
                remedy="give all that is reset at a time in one table",
            )
        if not values:
            raise ProblemError(
                f"[[jumps]] at {listing(map(str, at))} resets nothing",
                term=table,
                remedy='write the values after it, for example x = "x + 1"',
            )
        found[at] = values
    return found


def _misplaced(content: Mapping[str, Any], missing: Sequence[str]) -> str:
    """In which tables keys stand that belong above the first one."""
    found = [
        f"; `{key}` in [{name}] belongs above the first table"
        for key in missing
        for name, table in content.items()
        if isinstance(table, Mapping) and key in table
    ]
    return "".join(found)


def _table(content: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """A table of the file, empty if it is left out."""
    table = content.get(key, {})
    if not isinstance(table, Mapping):
        raise ProblemError(
            f"`{key}` is {shown(table)}, not a table",
            term=table,
            remedy=f"write a line [{key}], and below it one for each name; {_SHOWN}",
        )
    return table


def _formula(table: str, name: str, value: Any) -> str | float:
    """A formula as text, or a number."""
    if isinstance(value, str) or (_is_number(value) and abs(value) <= _LARGEST):
        return value
    raise ProblemError(
        f"`{name}` in [{table}] is {shown(value)}, neither text nor a finite number",
        term=value,
        remedy=f'write the formula in quotes, for example {name} = "2*a + 1"',
    )


def _horizon(time: Any) -> tuple[float, float]:
    """Start and end, from a list or from a table."""
    if not isinstance(time, Mapping):
        return _pair("`time`", "time", time)
    if set(time) != {"start", "end"}:
        raise ProblemError(
            f"the table [time] has {listing(time) or 'nothing'}",
            term=time,
            remedy="give `start` and `end`, or write time = [start, end]",
        )
    return _pair("what [time] holds", "time", [time["start"], time["end"]])


def _parameter(name: str, value: Any) -> str | tuple[float, float]:
    """A list of two numbers, or a text that names a distribution."""
    return value if isinstance(value, str) else _pair(f"`{name}` in [parameters]", name, value)


def _pair(what: str, name: str, value: Any) -> tuple[float, float]:
    """A list of two numbers; which ones are possible is checked with the problem."""
    if isinstance(value, list) and len(value) == 2 and all(map(_is_number, value)):
        return value[0], value[1]
    raise ProblemError(
        f"{what} is {shown(value)}, not a list of two numbers",
        term=value,
        remedy=f"write it like {name} = [0.5, 1.5]",
    )


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
