"""Constants that are run-time values, and other problems from one by other numbers.

A problem keeps the arguments that it was made of; each function here returns those of another one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.equations import algebraic_unknowns, highest_orders
from rankone.problem.expressions.notation import named_constants, written_in
from rankone.problem.jumps import instants_of
from rankone.problem.shorthand import Shorthand
from rankone.problem.user_events import Event
from rankone.support.errors import EvaluationError, ProblemError
from rankone.support.wording import did_you_mean, listing, quote, shown
from rankone.tensors.bases.coordinates import name_of

Arguments = Mapping[str, Any]
"""The arguments of a problem by name."""
Changes = Iterable[tuple[Any, Any]]
"""Pairs of a constant or parameter, or its name, and what it becomes."""


def changes_of(mapping: object, named: Mapping[str, Any]) -> Changes:
    """Changes that were given as a mapping and by keyword."""
    if mapping is not None and not isinstance(mapping, Mapping):
        raise ProblemError(
            f"{shown(mapping)} is not a mapping",
            term=mapping,
            remedy="give {symbol: ...}, or names as keywords, for example m=2.5",
        )
    return [*(mapping or {}).items(), *named.items()]


def with_constants(written: Arguments, numbers: Changes, states: Iterable[str]) -> Arguments:
    """The arguments with these numbers of constants and parameters; ``states`` are for messages."""
    parameters, constants = dict(written["parameters"]), dict(written["constants"] or {})
    correlated = {*map(name_of, itertools.chain(*(written["correlation"] or {})))}
    for symbol, value in changed_symbols(written, numbers, states):
        if symbol in parameters and symbol.name in correlated:
            raise ProblemError(
                f"{quote(symbol)} is correlated with another parameter: fixed, it changes the "
                "distribution of that one",
                term=symbol,
                remedy="build a problem without the correlation",
            )
        parameters.pop(symbol, None)
        constants[symbol] = value
    return {**written, "parameters": parameters, "constants": constants}


def with_parameters(written: Arguments, intervals: Changes, states: Iterable[str]) -> Arguments:
    """The arguments with these intervals of constants and parameters."""
    parameters, constants = dict(written["parameters"]), dict(written["constants"] or {})
    for symbol, interval in changed_symbols(written, intervals, states):
        constants.pop(symbol, None)
        parameters[symbol] = interval
    return {**written, "parameters": parameters, "constants": constants}


def changed_symbols(
    written: Arguments, changes: Changes, states: Iterable[str]
) -> Iterator[tuple[sp.Symbol, Any]]:
    """The changes by symbol; an error if the problem lacks a name, or one comes twice."""
    symbols = (*written["parameters"], *(written["constants"] or {}))
    declared = {symbol.name: symbol for symbol in symbols}
    elsewhere = dict.fromkeys(_defined(written), ("definition", "change what it is made of"))
    elsewhere |= dict.fromkeys(states, ("state", "give another value in `initial`"))
    changed: set[str] = set()
    for key, change in changes:
        try:
            name = name_of(key)
        except EvaluationError as error:
            raise ProblemError(error.message, term=key, remedy=error.remedy) from None
        if name in elsewhere:
            noun, remedy = elsewhere[name]
            message = f"{quote(name)} is a {noun}, neither a constant nor a parameter"
            raise ProblemError(message, term=key, remedy=remedy)
        if name not in declared:
            raise ProblemError(
                f"there is no constant or parameter {quote(name)}{did_you_mean(name, declared)}",
                term=key,
                remedy=f"choose from {listing(declared)}" if declared else None,
            )
        if name in changed:
            raise ProblemError(f"{quote(name)} is given twice", term=key, remedy="give it once")
        changed.add(name)
        yield declared[name], change


def _defined(written: Arguments) -> Iterator[str]:
    return map(name_of, written["definitions"] or {})


# -----------------------------------------------------------------------------
# Which constants of a problem are run-time values, and which are written in.


_LARGEST = 1e150  # Of run-time constants, and with its reciprocal the smallest


def with_decisive(
    shorthand: Shorthand, written: Mapping[str, Any], coupled: Set[str] = frozenset()
) -> Shorthand:
    """The shorthand with its decisive constants, on which the generated code depends.

    A constant that is zero is one: terms vanish. So are those whose squares are no floating-point
    numbers, those in expressions that are not finite, so that the error names them, and those with
    the names ``coupled``.
    """
    constants = frozenset(shorthand.constants)
    numbers = shorthand.constants.items()
    decisive = {symbol for symbol, at in numbers if _is_extreme(at) or symbol.name in coupled}
    for expression in _smooth(written):
        for term in _terms(shorthand.expanded(expression)):
            involved = term.free_symbols & constants
            if involved - decisive:
                decisive |= written_in(term, constants)
                if term.xreplace(dict(numbers)).has(sp.zoo, sp.nan, sp.oo, -sp.oo):
                    decisive |= involved
    for expression in _deciding(written):
        expression = shorthand.expanded(expression)
        if not _of_states(expression):
            decisive |= expression.free_symbols & constants
    return replace(shorthand, decisive=frozenset(decisive))


def _is_extreme(number: sp.Expr) -> bool:
    """Whether a number is zero, or so small or large that products may be lost."""
    return not 1.0 / _LARGEST <= abs(float(number)) <= _LARGEST


def coupled_by(residuals: Sequence[sp.Expr]) -> set[str]:
    """The named constants in a mass matrix that is inverted: its inverse would be long.

    With algebraic equations those are all, since they decide what is solved for what.
    """
    highest = highest_orders(residuals)
    everywhere = {constant.name for constant in named_constants(residuals)}
    if algebraic_unknowns(residuals):
        return everywhere
    names: set[str] = set()
    for residual in residuals:
        orders = {d for d in residual.atoms(sp.Derivative) if d.derivative_count == highest[d.expr]}
        if not orders:
            return everywhere
        if len(orders) > 1:
            terms = (term for term in sp.Add.make_args(residual) if term.has(*orders))
            names |= {constant.name for constant in named_constants(terms)}
    return names


def _terms(expression: sp.Basic) -> Iterator[sp.Basic]:
    """The addends of an expression, or of both sides of an equation."""
    for side in expression.args if isinstance(expression, sp.Eq) else (expression,):
        yield from sp.Add.make_args(side)


def _of_states(expression: sp.Basic) -> bool:
    return bool(expression.atoms(AppliedUndef))


def _smooth(written: Mapping[str, Any]) -> Iterator[sp.Basic]:
    """Equations, initial values, and values after jumps and events."""
    resets = [*_values(written["jumps"]), *(event.then for event in _events(written))]
    listed = [
        *_values(written["initial"]),
        *(value for reset in resets for value in _values(reset)),
    ]
    listed += written["equations"]
    listed += [event.when for event in _events(written)]
    yield from (e for e in listed if isinstance(e, sp.Basic))


def _deciding(written: Mapping[str, Any]) -> Iterator[sp.Basic]:
    """Times of jumps and events, delays and priorities."""
    jumps = written["jumps"]
    listed = [at for key in jumps for at in instants_of(key)] if isinstance(jumps, Mapping) else []
    for event in _events(written):
        listed += [event.when, event.delay, event.priority]
    yield from (e for e in listed if isinstance(e, sp.Basic))


def _events(written: Mapping[str, Any]) -> list[Event]:
    events = written["events"]
    return [e for e in events if isinstance(e, Event)] if isinstance(events, Sequence) else []


def _values(mapping: object) -> list[Any]:
    return [*mapping.values()] if isinstance(mapping, Mapping) else []
