"""Problems as TOML text, in the layout of :data:`rankone.frontend.toml_tables.TOML_LAYOUT`."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.discretization.coordinates import name_of
from rankone.expressions.notation import exact, plain_text
from rankone.expressions.parsing import parse_expression
from rankone.frontend.content import ProblemContent
from rankone.frontend.equations import listed_equations
from rankone.frontend.events import Event
from rankone.frontend.jumps import instants_of
from rankone.frontend.steady_start import SteadyState
from rankone.frontend.toml_tables import text_arguments
from rankone.support.errors import ProblemError
from rankone.support.files import as_path, write_files
from rankone.support.wording import quote

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
        yield from _table("rhs", rates or {})
        yield from _table("initial", self._values(written["initial"]))
        yield from self._steady_state()
        for key in ("constants", "definitions"):
            yield from _table(key, self._values(written[key] or {}))
        yield from _table("units", self._named(written["units"] or {}))
        yield from _table("atol", self._named(written["atol"] or {}))
        yield from self._jumps()
        yield from self._events()
        yield from _table("parameters", parameters)

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

    def _name(self, key: Any) -> str:
        if isinstance(key, sp.Subs):
            key = key.expr.xreplace({key.variables[0]: self.time})
        return name_of(key)

    def _text(self, expression: Any) -> str | float:
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


def _table(key: str, entries: Mapping[str, Any]) -> Lines:
    """A table with its header after an empty line; nothing if it is empty."""
    if entries:
        yield from ("", f"[{key}]", *_pairs(entries))


def _pairs(entries: Mapping[str, Any]) -> Lines:
    for key, value in entries.items():
        yield f"{key if _BARE_KEY.fullmatch(key) else _literal(key)} = {_literal(value)}"


def _literal(value: Any) -> str:
    """A text, number, truth value or list as TOML writes it; JSON is a part of that."""
    return json.dumps(value, ensure_ascii=False, default=float)
