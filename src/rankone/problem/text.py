"""Problems as text: formulas by name, turned into the expressions that the checks take."""

from __future__ import annotations

import dataclasses
import numbers
import re
import unicodedata
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, TypeGuard, TypeVar

import sympy as sp

from rankone.problem.algebra.tabulated import table_of_texts
from rankone.problem.algebra.term_table import FEWEST_TABULATED, TabulatedEquations
from rankone.problem.equations import check_names
from rankone.problem.expressions.conditions import rate_of, unknown_of
from rankone.problem.expressions.parsing import parse_expression
from rankone.problem.fields import Field, FieldDerivative, Operator, Vector, apply, constant_of
from rankone.problem.steady_start import SteadyState
from rankone.problem.user_events import Event, event_name
from rankone.support.errors import ProblemError, did_you_mean, listing, quote, shown

Entry = TypeVar("Entry")
Names = Mapping[str, sp.Expr]
_NAMED = ("constants", "definitions")  # Names besides unknowns and parameters
_DEFINE = "a constant is a number; give a formula of others in `definitions`"
_HIGHEST_ORDER = 4  # Of derivatives in equations, ``x_tttt``
_DERIVATIVE = re.compile("_t{1,4}$")
_EVENT_KEYS = tuple(field.name for field in dataclasses.fields(Event))


def problem_arguments(written: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of :class:`Problem` from those of :meth:`Problem.from_strings`."""
    t, time = sp.Symbol("t"), written["time"]
    if not isinstance(time, tuple | list) or len(time) != 2:
        raise ProblemError(f"time is {quote(time)}", term=time, remedy="give (start, end)")
    tables = {
        key: normalised(key, written[key] or {})
        for key in ("rhs", "initial", "parameters", "constants", "definitions")
    }
    rhs, initial, constants, definitions = (
        tables[key] for key in ("rhs", "initial", "constants", "definitions")
    )
    check_keys(rhs)
    symbols = {
        name: sp.Symbol(name)
        for key in ("parameters", "constants", "definitions")
        for name in tables[key]
    }
    equations = listed_texts("equations", written["equations"])
    unknowns = _unknowns(rhs, initial, listed_texts("unknowns", written["unknowns"]), equations)
    functions = _functions(unknowns, written["fields"], t)
    matrices = {
        name: constant_of(array, f"the matrix {quote(name)}", name)
        for name, array in normalised("matrices", written["matrices"] or {}).items()
    }
    owners = [(name, f"{key[:-1]} {quote(name)}") for key in _NAMED for name in tables[key]]
    owners += [(name, f"matrix {quote(name)}") for name in matrices]
    parameters = [symbols[name] for name in tables["parameters"]]
    check_names(list(functions.items()), parameters, t, owners)
    states: dict[str, sp.Expr] = {**functions}
    if equations:
        states |= {
            f"{name}_{'t' * order}": _rate(function, t, order)
            for name, function in functions.items()
            for order in range(1, _HIGHEST_ORDER + 1)
        }
    names = {**states, "t": t, **symbols, **matrices, **functions}
    units = written["units"]
    plain = not any(written[key] for key in ("jumps", "events", "fields", *_NAMED))
    return {
        "equations": _equations(rhs, equations, functions, names, plain),
        "time": (t, *time),
        "parameters": {symbols[name]: ends for name, ends in tables["parameters"].items()},
        "initial": _start(
            written["initial"],
            {
                states[state]: _initial_value(state, start, states, names)
                for state, start in initial.items()
            },
            symbols,
        ),
        "jumps": jumps_of_text(written["jumps"], names, states),
        "units": normalised("units", units) if has_names(units) else units,
        "events": events_of_text(written["events"], names, states),
        "constants": {
            symbols[name]: formula(value, {}, f"constant {quote(name)}", None, _DEFINE)
            for name, value in constants.items()
        },
        "definitions": {
            symbols[name]: formula(text, names, f"definition of {quote(name)}", None)
            for name, text in definitions.items()
        },
        **{key: written[key] for key in ("name", "tail", "correlation", "atol", "mass")},
    }


def _functions(
    unknowns: Sequence[str], fields: Mapping[str, int] | None, time: sp.Symbol
) -> dict[str, sp.Expr]:
    """The unknowns by name: fields where sizes are given, else functions of time."""
    sizes: dict[str, int] = normalised("fields", fields or {})
    for name in sizes:
        if name not in unknowns:
            raise ProblemError(
                f"the field {quote(name)} has no equation{did_you_mean(name, unknowns)}",
                term=name,
                remedy="give its rate in `rhs`",
            )
    return {
        name: Field(name, sizes[name]) if name in sizes else unknown_of(name, time)
        for name in unknowns
    }


def _rate(unknown: sp.Expr, time: sp.Symbol, order: int = 1) -> sp.Expr:
    """A derivative of an unknown."""
    return (
        unknown.diff(time, order) if isinstance(unknown, Field) else rate_of(unknown, time, order)
    )


def _initial_value(state: str, start: object, states: Names, names: Names) -> object:
    """A formula or number as an expression; arrays are for fields."""
    of_field = isinstance(states[state], Field | FieldDerivative)
    if of_field and not isinstance(start, str | numbers.Real | sp.Basic):
        return start
    return formula(start, names, f"initial value of {quote(state)}", None)


def _equations(
    rhs: Mapping[str, Any], equations: Sequence[str], functions: Names, names: Names, plain: bool
) -> Sequence[sp.Basic]:
    """The equations; of many right-hand sides a table of their terms, if they have one.

    ``plain`` says that the problem consists of right-hand sides and initial values alone.
    """
    written = partial(_written, rhs, equations, functions, names)
    if not plain or equations or not FEWEST_TABULATED <= len(rhs) == len(functions):
        return written()
    coordinates = {name: symbol for name, symbol in names.items() if name not in functions}
    table = table_of_texts(rhs, functions, coordinates)
    return written() if table is None else TabulatedEquations(len(rhs), written, table)


def _written(
    rhs: Mapping[str, Any], equations: Sequence[str], functions: Names, names: Names
) -> list[sp.Basic]:
    """Right-hand sides and further equations as expressions."""
    rates = (
        (
            _rate(functions[state], names["t"]),
            formula(text, names, f"right-hand side of {quote(state)}", i),
        )
        for i, (state, text) in enumerate(rhs.items(), 1)
    )
    further = (_equation(text, names, i) for i, text in enumerate(equations, 1 + len(rhs)))
    return [*(sp.Eq(*sides, evaluate=False) for sides in rates), *further]


def _start(
    written: object, initial: dict[sp.Expr, sp.Expr], symbols: dict[str, sp.Symbol]
) -> Mapping[sp.Expr, sp.Expr]:
    """Initial values; or a steady state that is reached from them."""
    if not isinstance(written, SteadyState):
        return initial
    conditions = {
        symbols.get(name, name): formula(value, symbols, f"condition of {quote(name)}", None)
        for name, value in normalised("conditions", written.conditions).items()
    }
    return SteadyState(conditions, start=initial, settle=written.settle)


def listed_texts(argument: str, texts: object) -> list[str]:
    """A list of texts."""
    if isinstance(texts, list | tuple) and all(isinstance(text, str) for text in texts):
        return [*texts]
    raise ProblemError(
        f"{argument} are {shown(texts)}, not a list of texts",
        term=texts,
        remedy='give for example ["m*x_tt + k*x = 0"]' if argument == "equations" else None,
    )


def _unknowns(
    rhs: Mapping[str, Any],
    initial: Mapping[str, Any],
    unknowns: Sequence[str],
    equations: Sequence[str],
) -> list[str]:
    """Names of unknowns: with a right-hand side, listed, or with initial values."""
    named = dict.fromkeys([*rhs, *unknowns])
    for state in initial:
        if equations:
            named.setdefault(_DERIVATIVE.sub("", state))
        elif state not in rhs:
            raise ProblemError(
                f"`initial` has a value for {quote(state)}, which has no equation"
                f"{did_you_mean(state, rhs)}",
                term=state,
                remedy="remove it, or give its derivative in `rhs`",
            )
    return [*named]


def _equation(text: str, names: Names, index: int) -> sp.Eq:
    """``m*x_tt + k*x = F``; without ``=`` it vanishes."""
    left, equals, right = text.partition("=")
    where = f"equation {quote(text)}"
    sides = [formula(side, names, where, index) for side in (left, right if equals else "0")]
    return sp.Eq(*sides, evaluate=False)


def check_keys(rhs: Mapping[str, Any]) -> None:
    """Raise for a key that is written as the derivative of an unknown, ``x'`` or ``dx/dt``."""
    for key in rhs:
        written = re.fullmatch(r"\s*(?:(\w+)\s*'|d\s*(\w+)\s*/\s*dt)\s*", key)
        if written is not None:
            raise ProblemError(
                f"`rhs` has the key {quote(key)}, a derivative",
                term=key,
                remedy=f"write the name of the unknown, {quote(written[1] or written[2])}",
            )


def jumps_of_text(jumps: object, names: Names, unknowns: Names) -> Any:
    """Jumps with formulas in place of texts; the checks refuse whatever is not a mapping."""
    if not isinstance(jumps, Mapping):
        return jumps
    return {
        (
            formula(time, names, "time of a jump", None) if isinstance(time, str) else time
        ): _reset_of_text(reset, f"the jump at {shown(time)}", names, unknowns)
        for time, reset in jumps.items()
    }


def events_of_text(events: object, names: Names, unknowns: Names) -> Any:
    """Events of mappings with formulas; the checks refuse whatever is not a list of them."""
    if not isinstance(events, list | tuple):
        return events
    return [_event_of_text(event, k, names, unknowns) for k, event in enumerate(events)]


def _event_of_text(event: object, position: int, names: Names, unknowns: Names) -> object:
    """One event; what is neither a mapping nor an event, the checks refuse."""
    if not isinstance(event, Mapping):
        return event
    subject = f"event {quote(event_name(event.get('name'), position))}"
    for key in event:
        if key not in _EVENT_KEYS:
            raise ProblemError(
                f"{subject} has the unknown key {quote(key)}{did_you_mean(str(key), _EVENT_KEYS)}",
                term=key,
                remedy=f"it may have {listing(_EVENT_KEYS)}",
            )
    if "when" not in event:
        raise ProblemError(
            f"{subject} has no `when`",
            term=event,
            remedy='give what crosses zero, for example "when": "x - 1"',
        )
    formulas = {
        key: formula(event[key], names, f"`{key}` of {subject}", None)
        for key in ("when", "delay", "priority")
        if key == "when" or event.get(key) is not None
    }
    then = _reset_of_text(event.get("then"), subject, names, unknowns)
    return Event(**{**event, **formulas, "then": then})


def _reset_of_text(reset: object, subject: str, names: Names, unknowns: Names) -> Any:
    """What is reset with formulas in place of texts."""
    if not has_names(reset):
        return reset
    reset = normalised(subject, reset)
    for name in reset:
        if name not in unknowns:
            raise ProblemError(
                f"{subject} resets {quote(name)}, which has no equation"
                f"{did_you_mean(name, unknowns)}",
                term=name,
                remedy=f"it may reset {listing(unknowns)}",
            )
    return {
        unknowns[name]: formula(text, names, f"value of {quote(name)} after {subject}", None)
        for name, text in reset.items()
    }


def has_names(mapping: object) -> TypeGuard[Mapping[str, Any]]:
    """Whether this is a mapping whose keys are texts."""
    return isinstance(mapping, Mapping) and all(isinstance(key, str) for key in mapping)


def formula(
    text: object,
    names: Mapping[str, sp.Expr],
    where: str,
    equation: int | None,
    unknown_name_remedy: str = "declare it in `parameters`, or give it in `rhs` or `unknowns`",
) -> sp.Expr:
    """Parse a text; let numbers pass."""
    if isinstance(text, str):
        remedy = unknown_name_remedy
        return parse_expression(
            text,
            names,
            where=where,
            equation=equation,
            further={"apply": _applied},
            unknown_name_remedy=remedy,
        )
    if isinstance(text, numbers.Real | sp.Number) and not isinstance(text, bool):
        return sp.sympify(text)
    raise ProblemError(
        f"the {where} is {text!r}, neither text nor a number", equation=equation, term=text
    )


def _applied(matrix: sp.Expr, expression: sp.Expr) -> sp.Expr:
    """``apply(L, u)`` in a formula."""
    if isinstance(matrix, Operator | Vector):
        return apply(matrix, expression)
    raise ProblemError(
        f"{quote(f'apply({matrix}, {expression})')} has no matrix as its first argument",
        term=matrix,
        remedy="give the matrix in `matrices`, and write its name",
    )


def normalised(argument: str, mapping: Mapping[str, Entry]) -> dict[str, Entry]:
    """The mapping with names as Python reads them: NFKC turns a micro sign into a Greek mu."""
    if not has_names(mapping):
        raise ProblemError(
            f"{argument} is {quote(mapping)}, not a mapping from names",
            term=mapping,
            remedy="use names (text) as keys",
        )
    normal: dict[str, Entry] = {}
    for name in mapping:
        read = unicodedata.normalize("NFKC", name)
        if read in normal:
            raise ProblemError(
                f"{argument} has two names that Python reads as {quote(read)}",
                term=name,
                remedy="rename one of them",
            )
        normal[read] = mapping[name]
    return normal
