"""The tables of a TOML file: problems read from them and written to them.

A file has the arguments in the layout of :data:`TOML_LAYOUT`, and may have a ``name``. Instead of
``time = [0, 6]`` there may be a table ``[time]`` with ``start`` and ``end``.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, TypeGuard

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.checked import ProblemContent
from rankone.problem.equations import listed_equations
from rankone.problem.expressions.notation import exact, plain_text
from rankone.problem.expressions.parsing import parse_expression
from rankone.problem.jumps import instants_of
from rankone.problem.steady_start import SteadyState
from rankone.problem.user_events import Event
from rankone.support.errors import ProblemError, did_you_mean, listing, quote, shown
from rankone.support.files import as_path, write_files
from rankone.tensors.coordinates import name_of, split

TOML_LAYOUT = """\
time = [0, 6]

[rhs]                      # right-hand side of each derivative; t is time
x = "x*(1.5 - y)"
y = "-y*(3 - x)"

# equations = ["m*y_tt = -k*y"]  # above the tables: where no right-hand side gives a derivative,
# unknowns = ["z"]               # as in "0 = z**3 + z - x"; further unknowns without initial values

[initial]                  # numbers or formulas of the parameters
x = "x0"
y = "y0"

# [steady_state]           # start at rest under other conditions; may be left out. Trajectories
# conditions = { c = 0 }   # under them start from [initial], where what is left out is zero
# settle = 600             # the longest time that they may take

[[jumps]]                  # resets at known times, such as doses; may be left out
times = [2, 4]             # or a single time = 2, or time = "lag"
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
# overlapping = true       # whether `when` may cross again before the delay is over

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

_REQUIRED = ("time", "rhs", "initial")  # "equations" may stand for "rhs"
_OPTIONAL = (
    "steady_state",
    *("parameters", "name", "jumps", "units", "events", "constants", "definitions", "atol"),
    *("equations", "unknowns", "tail", "correlation"),
)
_WRITTEN = {name: f"[{name}]" for name in ("rhs", "initial", "steady_state", "parameters", "units")}
_WRITTEN |= {name: f"[{name}]" for name in ("constants", "definitions", "atol")}
_WRITTEN |= {name: f"[[{name}]]" for name in ("jumps", "events")}  # How tables are written
_AS_THEY_ARE = ("name", "tail", "equations", "unknowns")  # Taken over without a check
SHOWN = "`rankone solve --help` shows the layout"


def text_arguments(content: Mapping[str, Any], file: str) -> dict[str, Any]:
    """Arguments of ``Problem.from_strings`` in the tables of a file, whose name is for messages.

    A ProblemError says which table or key is not as it should be.
    """
    _check_keys(content, file)
    return {
        "rhs": {n: str(_formula("rhs", n, f)) for n, f in _read_table(content, "rhs").items()},
        "initial": _start(content, _formulas(content, "initial")),
        "constants": _formulas(content, "constants"),
        "definitions": _formulas(content, "definitions"),
        "atol": dict(_read_table(content, "atol")),
        "parameters": {
            name: ends if isinstance(ends, str) else _scaled(name, ends)
            for name, ends in _read_table(content, "parameters").items()
        },
        "time": _horizon(content["time"]),
        "jumps": _jumps(content.get("jumps", [])),
        "units": dict(_read_table(content, "units")),
        "events": _events(content.get("events", [])),
        "correlation": _correlation(content.get("correlation", [])),
        **{key: content[key] for key in _AS_THEY_ARE if key in content},
    }


def _check_keys(content: Mapping[str, Any], file: str) -> None:
    """Raise if a file has an unknown key, or lacks one."""
    _check_known(f"`{file}`", content, (*_REQUIRED, *_OPTIONAL))
    present = {*content, *(["rhs"] if "equations" in content else [])}
    present |= {"initial"} if "steady_state" in content else set()
    missing = [key for key in _REQUIRED if key not in present]
    if missing:
        misplaced = [
            f"; `{key}` in [{name}] belongs above the first table"
            for key in missing
            for name, table in content.items()
            if isinstance(table, Mapping) and key in table
        ]
        raise ProblemError(
            f"`{file}` lacks {listing(missing)}{''.join(misplaced)}", term=missing, remedy=SHOWN
        )


def _check_known(
    where: str, content: Mapping[str, Any], keys: Sequence[str], elsewhere: str = ""
) -> None:
    """Raise for a key that is none of those that a file, or a table of it, may have."""
    for key in content:
        if key not in keys:
            written = [_WRITTEN.get(each, f"`{each}`") for each in keys]
            raise ProblemError(
                f"{where} has the unknown key `{key}`{did_you_mean(key, keys)}",
                term=key,
                remedy=f"it may have {', '.join(written[:-1])} and {written[-1]}{elsewhere}",
            )


def _start(content: Mapping[str, Any], initial: dict[str, str | float]) -> Mapping[str, Any]:
    """Initial values; or the steady state that is reached from them, if there is its table."""
    if "steady_state" not in content:
        return initial
    table = _read_table(content, "steady_state")
    elsewhere = "; initial values are in [initial]"
    _check_known("[steady_state]", table, ("conditions", "settle"), elsewhere)
    return SteadyState(_formulas(table, "conditions"), start=initial, settle=table.get("settle"))


def _correlation(triples: object) -> dict[tuple[str, str], float]:
    """``[["k", "c", 0.6]]`` as correlations of pairs."""
    remedy = 'write it like correlation = [["k", "c", 0.6]]'
    correlation: dict[tuple[str, str], float] = {}
    for triple in triples if isinstance(triples, list) else [triples]:
        match triple:
            case [str(a), str(b), int() | float() as number]:
                correlation[a, b] = number
            case _:
                message = f"`correlation` has {shown(triple)}, not two names and a number"
                raise ProblemError(message, term=triple, remedy=remedy)
    return correlation


def _events(tables: object) -> list[dict[str, Any]]:
    """The tables [[events]], with formulas that are text or finite numbers."""
    remedy = f"write [[events]], and below it `when` and perhaps `then`; {SHOWN}"
    events = []
    for table in _tables("events", tables, remedy):
        event = {**table}
        for key in ("when", "delay", "priority"):
            if key in event:
                event[key] = _formula("events", key, event[key])
        if "then" in event:
            then = _read_table(event, "then", remedy='write then = { x = "0" }')
            event["then"] = {name: _formula("events", name, f) for name, f in then.items()}
        events.append(event)
    return events


def _tables(key: str, tables: object, remedy: str) -> list[Mapping[str, Any]]:
    """A list of tables."""
    if isinstance(tables, list) and all(isinstance(table, Mapping) for table in tables):
        return tables
    message = f"`{key}` is {shown(tables)}, not a list of tables"
    raise ProblemError(message, term=tables, remedy=remedy)


def _jumps(tables: object) -> dict[tuple[float, ...] | str, dict[str, str | float]]:
    """The tables [[jumps]]: for their times, or a formula of one, the values after them."""
    remedy = f"write [[jumps]], and below it the times and the values; {SHOWN}"
    jumps: dict[tuple[float, ...] | str, dict[str, str | float]] = {}
    for table in _tables("jumps", tables, remedy):
        keys = [key for key in ("time", "times") if key in table]
        after = {n: _formula("jumps", n, f) for n, f in table.items() if n not in keys}
        times = table[keys[0]] if keys else None
        if keys == ["time"] and isinstance(times, str) and after and times not in jumps:
            jumps[times] = after
            continue
        at = tuple(times) if isinstance(times, list) else (times,)
        if len(keys) != 1 or not at or not all(map(_is_number, at)):
            fault = f"`{keys[0]}` = {shown(times)}" if keys else f"no times, but {listing(table)}"
            raise ProblemError(
                f"[[jumps]] has {fault}",
                term=table,
                remedy="write time = 8, or times = [8, 16], once",
            )
        earlier = [time for key in jumps if isinstance(key, tuple) for time in key]
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


def _read_table(
    content: Mapping[str, Any], key: str, remedy: str | None = None
) -> Mapping[str, Any]:
    """A table of the file; an empty one if it is left out."""
    table = content.get(key, {})
    if not isinstance(table, Mapping):
        raise ProblemError(
            f"`{key}` is {shown(table)}, not a table",
            term=table,
            remedy=remedy or f"write a line [{key}], and below it one for each name; {SHOWN}",
        )
    return table


def _formulas(content: Mapping[str, Any], key: str) -> dict[str, str | float]:
    """A table of formulas and numbers."""
    return {name: _formula(key, name, f) for name, f in _read_table(content, key).items()}


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


# -----------------------------------------------------------------------------
# Problems as TOML text, in the layout of :data:`rankone.problem.toml_layout.TOML_LAYOUT`.


_IN_PYTHON = "keep it in a Python file with a variable `problem`"
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
Lines = Iterator[str]


def save_problem(
    problem: ProblemContent,
    path: str | PathLike[str],
    read: Callable[[dict[str, Any]], ProblemContent],
    *,
    overwrite: bool,
) -> Path:
    """Write a problem to a TOML file; ``read`` makes one of the arguments that are read back.

    See :meth:`rankone.Problem.save`.
    """
    place, time = as_path(path, ProblemError), problem.time[0]
    if place.suffix != ".toml":
        message = f"`{place}` is no .toml file"
        raise ProblemError(message, term=path, remedy="give a name that ends in .toml")
    if time.name != "t":
        message = f"the time is called {quote(time)}, which is `t` in files"
        raise ProblemError(message, term=time, remedy="call it t")
    written = {**problem.written, "equations": listed_equations(problem.written["equations"])}
    parameters = {symbol.name: ends for symbol, ends in problem.written_parameters().items()}
    text = toml_text(written, parameters, problem.unknowns)
    again = read(text_arguments(tomllib.loads(text), str(place)))
    if problem.content(plain=True) != again.content(plain=True):
        message = "the problem does not read back from text as it is"
        raise ProblemError(message, term=problem.name, remedy=_IN_PYTHON)
    write_files({place: lambda stream: stream.write(text.encode())}, overwrite, ProblemError)
    return place


def toml_text(
    written: Mapping[str, Any], parameters: Mapping[str, Any], unknowns: Sequence[sp.Expr]
) -> str:
    """The text of a file for the arguments of a problem, and the intervals of its parameters.

    ``unknowns`` are all of them; they are listed where equations do not tell.
    """
    return "\n".join(_Writer(written).lines(parameters, unknowns)) + "\n"


class _Writer:
    """Writes the arguments of one problem."""

    def __init__(self, written: Mapping[str, Any]) -> None:
        self.written = written
        self.time: sp.Symbol = written["time"][0]

    def lines(self, parameters: Mapping[str, Any], unknowns: Sequence[sp.Expr]) -> Lines:
        written = self.written
        rates = self._rates()
        if written["name"] is not None:
            yield f"name = {_literal(written['name'])}"
        yield f"time = {_literal([float(end) for end in written['time'][1:]])}"
        if written["tail"] != 1e-6:
            yield f"tail = {_literal(written['tail'])}"
        pairs = (written["correlation"] or {}).items()
        if pairs:
            yield f"correlation = {_literal([[name_of(a), name_of(b), r] for (a, b), r in pairs])}"
        if rates is None:
            yield f"unknowns = {_literal([name_of(unknown) for unknown in unknowns])}"
            yield "equations = ["
            yield from (f"    {_literal(self._equation(e))}," for e in written["equations"])
            yield "]"
        yield from _written_table("rhs", rates or {})
        yield from _written_table("initial", self._values(written["initial"]))
        yield from self._steady_state()
        for key in ("constants", "definitions"):
            yield from _written_table(key, self._values(written[key] or {}))
        yield from _written_table("units", self._named(written["units"] or {}))
        yield from _written_table("atol", self._named(written["atol"] or {}))
        yield from self._jumps()
        yield from self._events()
        yield from _written_table("parameters", parameters)

    def _steady_state(self) -> Lines:
        start = self.written["initial"]
        if isinstance(start, SteadyState):
            yield from ("", "[steady_state]")
            if start.settle is not None:
                yield f"settle = {_literal(start.settle)}"
            yield f"conditions = {{ {', '.join(_pairs(self._values(start.conditions)))} }}"

    def _rates(self) -> dict[str, str | float] | None:
        """Right-hand sides by unknown; None where an equation gives no single derivative."""
        rates: dict[str, str | float] = {}
        for equation in self.written["equations"]:
            left, right = equation.args if isinstance(equation, sp.Eq) else (equation, sp.S.Zero)
            if not isinstance(left, sp.Derivative) or right.has(sp.Derivative):
                return None
            if not isinstance(left.expr, AppliedUndef) or left.derivative_count != 1:
                return None
            rates[name_of(left.expr)] = self._text(right)
        return rates

    def _equation(self, equation: sp.Basic) -> str:
        sides = equation.args if isinstance(equation, sp.Eq) else (equation, sp.S.Zero)
        return " = ".join(str(self._text(side)) for side in sides)

    def _values(self, mapping: Mapping[Any, Any]) -> dict[str, str | float]:
        """Formulas by the names of states or symbols."""
        return {self._name(key): self._text(sp.sympify(value)) for key, value in mapping.items()}

    def _named(self, mapping: Mapping[Any, Any]) -> dict[str, Any]:
        return {self._name(key): value for key, value in mapping.items()}

    def _name(self, key: sp.Basic) -> str:
        if isinstance(key, sp.Subs):
            key = key.expr.xreplace({key.variables[0]: self.time})
        return name_of(key)

    def _text(self, expression: sp.Basic | float) -> str | float:
        """A formula of states by name: a number, or a text that reads back as it is."""
        plain = exact(self._by_name(sp.sympify(expression)))
        if plain.is_Rational and exact(sp.Float(float(plain))) == plain:
            return int(plain) if plain.is_Integer else float(plain)
        names = {symbol.name: symbol for symbol in plain.free_symbols}
        for text in (plain_text(plain), sp.sstr(plain)):
            try:
                if parse_expression(text, names, where="formula") == plain:
                    return text
            except ProblemError:
                continue
        raise ProblemError(
            f"{quote(expression)} cannot be written as text that reads back",
            term=expression,
            remedy="keep the problem in a Python file: tables, functions of yours, and names that "
            "are no identifiers, are not text",
        )

    def _by_name(self, expression: sp.Expr) -> sp.Expr:
        """The expression with plain symbols for states, definitions, symbols and time."""
        functions = expression.atoms(sp.Derivative) | expression.atoms(AppliedUndef)
        plain: dict[sp.Basic, sp.Symbol] = {f: sp.Symbol(name_of(f)) for f in functions}
        plain |= {s: sp.Symbol(s.name) for s in expression.free_symbols if s != self.time}
        plain[self.time] = sp.Symbol("t")
        by_name: sp.Expr = expression.xreplace(plain)
        return by_name

    def _jumps(self) -> Lines:
        for key, reset in (self.written["jumps"] or {}).items():
            times = [self._text(at) for at in instants_of(key)]
            for at in [times] if all(not isinstance(at, str) for at in times) else times:
                yield from ("", "[[jumps]]")
                yield f"{'times' if isinstance(at, list) else 'time'} = {_literal(at)}"
                yield from _pairs(self._values(reset))

    def _events(self) -> Lines:
        events: Iterable[Event] = self.written["events"] or ()
        for event in events:
            yield from ("", "[[events]]")
            for key in ("when", "delay", "priority"):
                if (expression := getattr(event, key)) is not None:
                    yield f"{key} = {_literal(self._text(expression))}"
            if event.then is not None:
                yield f"then = {{ {', '.join(_pairs(self._values(event.then)))} }}"
            for key, usual in (("name", None), ("direction", "both"), ("terminal", False)):
                if (value := getattr(event, key)) != usual:
                    yield f"{key} = {_literal(value)}"
            for key in ("persistent", "overlapping"):
                if not getattr(event, key):
                    yield f"{key} = false"


def _written_table(key: str, entries: Mapping[str, Any]) -> Lines:
    """A table with its header after an empty line; nothing if it is empty."""
    if entries:
        yield from ("", f"[{key}]", *_pairs(entries))


def _pairs(entries: Mapping[str, Any]) -> Lines:
    for key, value in entries.items():
        yield f"{key if _BARE_KEY.fullmatch(key) else _literal(key)} = {_literal(value)}"


def _literal(value: object) -> str:
    """A text, number, truth value or list as TOML writes it; JSON is a part of that."""
    return json.dumps(value, ensure_ascii=False, default=float)
