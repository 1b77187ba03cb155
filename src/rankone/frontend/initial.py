"""The initial values of a problem: one expression of the parameters for every state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.expressions.numbers import exact
from rankone.frontend.box import Time
from rankone.frontend.equations import as_expression, explain_symbol
from rankone.support.errors import ProblemError
from rankone.support.wording import did_you_mean, listing, quote

__all__ = ["check_initial"]


def check_initial(
    initial: Mapping[Any, Any],
    states: Iterable[sp.Expr],
    unknowns: Iterable[sp.Expr],
    parameters: Iterable[sp.Symbol],
    time: Time,
) -> dict[sp.Expr, sp.Expr]:
    """Return the initial value of every state, in the order of the states.

    Keys of ``initial`` are unknowns ``x(t)`` and, for higher order, their derivatives
    ``x(t).diff(t)``; also understood are both at the initial time: ``x(0)``,
    ``x(t).diff(t).subs(t, 0)``. ``states`` need an initial value.

    Raises
    ------
    ProblemError
        If a value is missing, belongs to no state or is not an expression of the parameters.
    """
    states, unknowns, parameters = list(states), list(unknowns), list(parameters)
    known = set(states)
    given: dict[sp.Expr, sp.Expr] = {}
    for key, value in initial.items():
        state = _state(key, unknowns, time)
        if state not in known:
            raise ProblemError(*_superfluous(key, state, states), term=key)
        if state in given:
            raise ProblemError(f"{quote(state)} has two initial values", term=key)
        given[state] = exact(_value(state, value, unknowns, parameters, time[0]))
    missing = [state for state in states if state not in given]
    if missing:
        raise ProblemError(
            f"no initial value for {listing(missing)}",
            term=missing[0],
            remedy=f"add it to `initial`, for example {{{missing[0]}: 0}}",
        )
    return {state: given[state] for state in states}


def _state(key: Any, unknowns: list[sp.Expr], time: Time) -> sp.Expr:
    """Translate a key of ``initial`` into the unknown or derivative it stands for."""
    symbol, t0, _ = time
    named = {unknown.func.__name__: unknown for unknown in unknowns}
    if isinstance(key, sp.Subs) and len(key.variables) == 1:
        _check_instant(key, key.point[0], t0)
        return key.expr.xreplace({key.variables[0]: symbol})
    if isinstance(key, AppliedUndef) and len(key.args) == 1 and key.args[0].is_number:
        _check_instant(key, key.args[0], t0)
        return key.func(symbol)
    if isinstance(key, AppliedUndef | sp.Derivative):
        return key
    name = key if isinstance(key, str) else getattr(key, "name", getattr(key, "__name__", str(key)))
    wanted = named.get(name)
    hint = f" (did you mean {quote(wanted)}?)" if wanted is not None else did_you_mean(name, named)
    kind = "text" if isinstance(key, str) else "not an unknown"
    raise ProblemError(
        f"the key {key!r} of `initial` is {kind}{hint}",
        term=key,
        remedy=f"use the unknowns themselves as keys: {listing(unknowns)}",
    )


def _check_instant(key: sp.Expr, instant: sp.Expr, t0: float) -> None:
    if not instant.is_number or float(instant) != t0:
        raise ProblemError(
            f"the key {quote(key)} of `initial` is not at the initial time {t0:g}",
            term=key,
            remedy="give the values at the start of time",
        )


def _superfluous(key: Any, state: sp.Expr, states: list[sp.Expr]) -> tuple[str, ...]:
    applied = state.expr if isinstance(state, sp.Derivative) else state
    if applied in states:
        return (
            f"the initial value of {quote(key)} is not needed: "
            "the equations determine this derivative; remedy: remove it",
        )
    return (
        f"`initial` has a value for {quote(key)}, which no equation determines"
        f"{did_you_mean(str(applied), map(str, states))}; remedy: remove it, or add its equation",
    )


def _value(
    state: sp.Expr,
    value: Any,
    unknowns: list[sp.Expr],
    parameters: list[sp.Symbol],
    time: sp.Symbol,
) -> sp.Expr:
    """Return the initial value of a state as an expression of the parameters alone."""
    what = f"the initial value of {quote(state)}"
    remedy = "give a number or an expression of the parameters"
    expression = as_expression(value, what, remedy)
    what = f"{what}, {quote(expression)},"
    for applied in sorted(expression.atoms(AppliedUndef), key=sp.default_sort_key):
        raise ProblemError(f"{what} names the unknown {quote(applied)}", term=value, remedy=remedy)
    if time in expression.free_symbols:
        raise ProblemError(f"{what} names the time {quote(time)}", term=value, remedy=remedy)
    for symbol in sorted(expression.free_symbols - set(parameters), key=sp.default_sort_key):
        message, declare = explain_symbol(symbol, unknowns, parameters)
        raise ProblemError(f"{what} has a problem: {message}", term=value, remedy=declare)
    if expression.has(sp.I, sp.oo, -sp.oo, sp.zoo, sp.nan):
        raise ProblemError(f"{what} is not a finite real number", term=value, remedy=remedy)
    return expression
