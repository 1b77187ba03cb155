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
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

from rankone.ir.measures import split
from rankone.support.errors import ProblemError, RankoneError
from rankone.support.files import as_path
from rankone.support.wording import did_you_mean, listing, shown

if TYPE_CHECKING:
    from rankone.frontend.problem import Problem

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

# [[events]]               # where an expression crosses zero; may be left out
# when = "y - 9"
# direction = "rising"     # or "falling", or "both"
# then = { y = "y/2" }     # the values right after it
# terminal = false         # whether time ends there
# name = "harvest"
# delay = "1/4"            # from the crossing to the reset
# priority = 1             # the highest one is first at one instant
# persistent = true        # whether it happens though `when` turns back

[units]                    # texts for t, parameters and unknowns; may be left out
t = "years"

# [constants]              # numbers, or formulas of numbers; may be left out
# c = 1.5

# [definitions]            # formulas by name, in any order; may be left out
# eaten = "c*x*y"

# [atol]                   # errors of unknowns that are or become zero; may be left out
# y = 1e-6

[parameters]               # the box; may be left out; or a distribution: "norm(1, 0.1)"
x0 = [8, 12]
y0 = [4, 6]                # over decades with a scale: [1e-3, 10, "log"]
"""

_REQUIRED = ("time", "rhs", "initial")
_OPTIONAL = ("parameters", "name", "jumps", "units", "events", "constants", "definitions", "atol")
_SHOWN = "`rankone solve --help` shows the layout"


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
    from rankone.frontend.problem import Problem

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
    keys = (*_REQUIRED, *_OPTIONAL)
    for key in content:
        if key not in keys:
            raise ProblemError(
                f"`{file}` has the unknown key `{key}`{did_you_mean(key, keys)}; "
                f"known are {listing(keys)}",
                term=key,
            )
    missing = [key for key in _REQUIRED if key not in content]
    if missing:
        misplaced = [
            f"; `{key}` in [{name}] belongs above the first table"
            for key in missing
            for name, table in content.items()
            if isinstance(table, Mapping) and key in table
        ]
        raise ProblemError(
            f"`{file}` lacks {listing(missing)}{''.join(misplaced)}", term=missing, remedy=_SHOWN
        )
    return Problem.from_strings(
        rhs={n: str(_formula("rhs", n, f)) for n, f in _table(content, "rhs").items()},
        initial=_formulas(content, "initial"),
        constants=_formulas(content, "constants"),
        definitions=_formulas(content, "definitions"),
        atol=dict(_table(content, "atol")),
        parameters={
            name: ends if isinstance(ends, str) else _scaled(name, ends)
            for name, ends in _table(content, "parameters").items()
        },
        time=_horizon(content["time"]),
        name=content.get("name"),
        jumps=_jumps(content.get("jumps", [])),
        units=dict(_table(content, "units")),
        events=_events(content.get("events", [])),
    )


def _events(tables: object) -> list[dict[str, Any]]:
    """The tables [[events]], with formulas that are text or finite numbers."""
    remedy = f"write [[events]], and below it `when` and perhaps `then`; {_SHOWN}"
    events = []
    for table in _tables("events", tables, remedy):
        event = {**table}
        for key in ("when", "delay", "priority"):
            if key in event:
                event[key] = _formula("events", key, event[key])
        if "then" in event:
            then = _table(event, "then", remedy='write then = { x = "0" }')
            event["then"] = {name: _formula("events", name, f) for name, f in then.items()}
        events.append(event)
    return events


def _tables(key: str, tables: object, remedy: str) -> list[Mapping[str, Any]]:
    """A list of tables."""
    if isinstance(tables, list) and all(isinstance(table, Mapping) for table in tables):
        return tables
    message = f"`{key}` is {shown(tables)}, not a list of tables"
    raise ProblemError(message, term=tables, remedy=remedy)


def _jumps(tables: object) -> dict[tuple[float, ...], dict[str, str | float]]:
    """The tables [[jumps]]: for their times the values after them."""
    remedy = f"write [[jumps]], and below it the times and the values; {_SHOWN}"
    jumps: dict[tuple[float, ...], dict[str, str | float]] = {}
    for table in _tables("jumps", tables, remedy):
        keys = [key for key in ("time", "times") if key in table]
        after = {n: _formula("jumps", n, f) for n, f in table.items() if n not in keys}
        times = table[keys[0]] if keys else None
        at = tuple(times) if isinstance(times, list) else (times,)
        if len(keys) != 1 or not at or not all(map(_is_number, at)):
            fault = f"`{keys[0]}` = {shown(times)}" if keys else f"no times, but {listing(table)}"
            raise ProblemError(
                f"[[jumps]] has {fault}",
                term=table,
                remedy="write time = 8, or times = [8, 16], once",
            )
        earlier = [time for times_of_table in jumps for time in times_of_table]
        if len({*earlier, *at}) < len(earlier) + len(at):
            raise ProblemError(
                f"[[jumps]] has a time twice, among {listing(map(str, at))}",
                term=table,
                remedy="give all that is reset at a time in one table",
            )
        if not after:
            raise ProblemError(
                f"[[jumps]] at {listing(map(str, at))} resets nothing",
                term=table,
                remedy='write the values after it, for example x = "x + 1"',
            )
        jumps[at] = after
    return jumps


def _table(content: Mapping[str, Any], key: str, remedy: str | None = None) -> Mapping[str, Any]:
    """A table of the file; an empty one if it is left out."""
    table = content.get(key, {})
    if not isinstance(table, Mapping):
        raise ProblemError(
            f"`{key}` is {shown(table)}, not a table",
            term=table,
            remedy=remedy or f"write a line [{key}], and below it one for each name; {_SHOWN}",
        )
    return table


def _formulas(content: Mapping[str, Any], key: str) -> dict[str, str | float]:
    """A table of formulas and numbers."""
    return {name: _formula(key, name, f) for name, f in _table(content, key).items()}


def _formula(table: str, name: str, formula: object) -> str | float:
    """A formula as text, or a number."""
    if isinstance(formula, str) or (_is_number(formula) and abs(formula) <= sys.float_info.max):
        return formula
    raise ProblemError(
        f"`{name}` in [{table}] is {shown(formula)}, neither text nor a finite number",
        term=formula,
        remedy=f'write the formula in quotes, for example {name} = "2*a + 1"',
    )


def _horizon(time: object) -> tuple[float, float]:
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


def _scaled(name: str, ends: object) -> tuple[object, ...]:
    """An interval, perhaps with its scale; :class:`Problem` checks the word."""
    bounds, word = split(ends)
    pair = _pair(f"`{name}` in [parameters]", name, bounds)
    return pair if word is None else (*pair, word)


def _pair(subject: str, name: str, bounds: object) -> tuple[float, float]:
    """A list of two numbers; :class:`Problem` checks them."""
    if isinstance(bounds, list) and len(bounds) == 2 and all(map(_is_number, bounds)):
        return bounds[0], bounds[1]
    raise ProblemError(
        f"{subject} is {shown(bounds)}, not a list of two numbers",
        term=bounds,
        remedy=f"write it like {name} = [0.5, 1.5]",
    )


def _is_number(scalar: object) -> TypeGuard[float]:
    return isinstance(scalar, int | float) and not isinstance(scalar, bool)
