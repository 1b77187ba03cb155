"""The rates of fields from their equations, and what rates may have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.box import Time
from rankone.problem.equations import (
    Symbols,
    check_equations,
    listed_equations,
)
from rankone.problem.expressions.conditions import rate_of
from rankone.problem.expressions.notation import expression_of
from rankone.problem.fields import (
    Apply,
    Field,
    FieldDerivative,
    Vector,
    size_of,
)
from rankone.problem.functions import DataFunction
from rankone.problem.shorthand import Shorthand
from rankone.support.errors import ProblemError, count, listing, quote, shown
from rankone.tensors.coordinates import name_of

State: TypeAlias = "sp.Expr"
"""A field, or a scalar unknown ``x(t)``."""
_HIGHEST_ORDER = 2
_NOT_SMOOTH = (
    sp.Piecewise,
    sp.Heaviside,
    sp.sign,
    sp.Abs,
    sp.Min,
    sp.Max,
    sp.floor,
    sp.ceiling,
    sp.frac,
    sp.Mod,
    sp.DiracDelta,
)


def field_equations(equations: object, time: sp.Symbol) -> tuple[sp.Eq, ...]:
    """The equations; rates by unknown as equations, too."""
    if not isinstance(equations, Mapping):
        listed = listed_equations(equations)
        return tuple(
            e if isinstance(e, sp.Eq) or not isinstance(e, sp.Expr) else sp.Eq(e, 0, evaluate=False)
            for e in listed
        )
    written = []
    for unknown, rate in equations.items():
        left = unknown.diff(time) if isinstance(unknown, Field) else None
        if isinstance(unknown, AppliedUndef):
            left = rate_of(unknown, time)
        if left is None:
            raise ProblemError(
                f"{shown(unknown)} is given a rate, but is neither a field nor a function of time",
                term=unknown,
                remedy='use what rankone.field("u", n) gives, or sympy.Function("x")(t), as keys',
            )
        expression = expression_of(rate)
        if expression is None:
            raise ProblemError(
                f"the rate of {quote(unknown)} is {shown(rate)}, not an expression",
                term=rate,
                remedy="give an expression of fields, parameters and time; arrays enter by "
                "rankone.apply(array, 1), or rankone.apply(array, u) for a product",
            )
        written.append(sp.Eq(left, expression, evaluate=False))
    return tuple(written)


def solved_rates(
    equations: Sequence[sp.Basic], time: Time, shorthand: Shorthand
) -> tuple[dict[State, sp.Expr], tuple[sp.Expr, ...]]:
    """The rate of each state, and the unknowns in the order of their equations."""
    residuals = check_equations(equations, time[0], shorthand)
    derivatives = [_derivatives(residual, i, time[0]) for i, residual in enumerate(residuals, 1)]
    orders: dict[sp.Expr, int] = {}
    for each in derivatives:
        for derivative in each:
            order = derivative.derivative_count
            orders[derivative.expr] = max(order, orders.get(derivative.expr, 0))
    for unknown, order in orders.items():
        _check_order(unknown, order)
    lower = {
        unknown.diff(time[0]): Field(f"{unknown.name}_t", unknown.size)
        for unknown, order in orders.items()
        if order > 1
    }
    given: dict[sp.Expr, sp.Expr] = {}
    for i, (residual, each) in enumerate(zip(residuals, derivatives, strict=True), 1):
        highest = [d for d in each if d.derivative_count == orders[d.expr]]
        if len(highest) != 1:
            raise ProblemError(
                f"it has {count(len(highest), 'highest derivative')}"
                + (f", {listing(highest)}" if highest else ""),
                equation=i,
                term=equations[i - 1],
                remedy="give one equation du/dt = ... for each unknown; equations of fields are "
                "not algebraic, and mass matrices are given by mass={u: M}",
            )
        unknown = highest[0].expr
        if unknown in given:
            raise ProblemError(
                f"{quote(unknown)} is given a rate twice",
                equation=i,
                term=highest[0],
                remedy="give one equation for each unknown",
            )
        given[unknown] = _solved(residual, highest[0], i).xreplace(lower)
    rates: dict[State, sp.Expr] = {}
    velocities: dict[State, sp.Expr] = {}
    for unknown, rate in given.items():
        if orders[unknown] > 1:
            velocity = lower[unknown.diff(time[0])]
            rates[unknown], velocities[velocity] = velocity, rate
        else:
            rates[unknown] = rate
    return {**rates, **velocities}, tuple(given)


def _derivatives(residual: sp.Expr, equation: int, time: sp.Symbol) -> list[sp.Expr]:
    """The derivatives in an equation, in a fixed order."""
    present = residual.atoms(FieldDerivative) | residual.atoms(sp.Derivative)
    ordered = sorted(present, key=lambda d: (name_of(d), sp.default_sort_key(d)))
    for derivative in ordered:
        if {*derivative.variables} != {time}:
            raise ProblemError(
                f"{quote(derivative)} is not a derivative in the time {quote(time)}",
                equation=equation,
                term=derivative,
                remedy=f"differentiate fields by {time} alone, and products by hand",
            )
    return ordered


def _check_order(unknown: sp.Expr, order: int) -> None:
    most = _HIGHEST_ORDER if isinstance(unknown, Field) else 1
    if order > most:
        noun = "fields" if isinstance(unknown, Field) else "scalar unknowns beside fields"
        raise ProblemError(
            f"{quote(unknown)} has a derivative of order {order}; {noun} have derivatives up to "
            f"order {most}",
            term=unknown,
            remedy="name a derivative, as an unknown with an equation of its own",
        )


def _solved(residual: sp.Expr, derivative: sp.Expr, equation: int) -> sp.Expr:
    """The derivative from an equation in which it has a factor without unknowns."""
    terms = sp.Add.make_args(residual)
    if not all(_is_multiple(term, derivative) for term in terms if term.has(derivative)):
        terms = sp.Add.make_args(sp.expand(residual))
    with_it = [term for term in terms if term.has(derivative)]
    factor = sp.Add(*(term / derivative for term in with_it))
    fault = None
    if not all(_is_multiple(term, derivative) for term in with_it):
        fault = f"{quote(derivative)} is inside of a function or a matrix"
    elif factor.atoms(Field, AppliedUndef, Apply):
        fault = f"the factor {quote(factor)} of {quote(derivative)} has unknowns"
    if fault is not None:
        raise ProblemError(
            fault,
            equation=equation,
            term=derivative,
            remedy="divide by the factor: write du/dt = ...; mass matrices are given by "
            "mass={u: M}",
        )
    rest = sp.Add(*(term for term in terms if not term.has(derivative)))
    return -rest if factor == 1 else rest if factor == -1 else -rest / factor


def _is_multiple(term: sp.Expr, derivative: sp.Expr) -> bool:
    return not (term / derivative).has(derivative)


def check_rates(rates: Mapping[State, sp.Expr], symbols: Symbols, equations: int) -> None:
    """Raise unless rates have the sizes of the states, and known symbols and functions alone."""
    order = [s for s in rates if not (isinstance(s, Field) and isinstance(rates[s], Field))]
    numbers = {state: i for i, state in enumerate(order, 1)}
    for state, rate in rates.items():
        number = min(numbers.get(state, equations), equations)
        try:
            size = size_of(rate)
        except ProblemError as error:
            raise ProblemError(
                error.message, equation=number, term=error.term, remedy=error.remedy
            ) from None
        if size not in (1, size_of(state)):
            raise ProblemError(
                f"the rate of {quote(state)}, which has {count(size_of(state), 'entry', 'entries')}"
                f", has {size}",
                equation=number,
                term=rate,
                remedy="bring it to the right size by `apply`",
            )
        check_symbols(rate, symbols, number)
        check_smooth(rate, symbols, number)


def check_symbols(rate: sp.Expr, symbols: Symbols, equation: int | None) -> None:
    """Raise if a rate has an unknown without an equation, or a symbol that nothing declares."""
    states = {*symbols.states}
    named = {name_of(state): state for state in states}
    for unknown in sorted(rate.atoms(Field, AppliedUndef) - states, key=str):
        if isinstance(unknown, DataFunction):
            continue
        twin = named.get(name_of(unknown))
        twin_size = f" with {size_of(twin)} entries" if twin is not None else ""
        raise ProblemError(
            f"{quote(unknown)} has no equation"
            + (f": it is not the {quote(twin)}{twin_size} that has one" if twin else ""),
            equation=equation,
            term=unknown,
            remedy=f"give its rate, {{{name_of(unknown)}: ...}}, or use one object everywhere",
        )
    declared = [symbols.time[0], *symbols.parameters]
    allowed = {*declared, *states}
    unknown_symbols = [
        s for s in rate.free_symbols if s not in allowed and not isinstance(s, Field | Vector)
    ]
    for symbol in sorted(unknown_symbols, key=sp.default_sort_key):
        if symbol.name in named:
            raise ProblemError(
                f"symbol {quote(symbol)} is not the unknown of that name",
                equation=equation,
                term=symbol,
                remedy=f'use what rankone.field("{symbol.name}", n) gave',
            )
        message, remedy = symbols.explained(symbol, declared)
        raise ProblemError(message, equation=equation, term=symbol, remedy=remedy)


def check_smooth(rate: sp.Expr, symbols: Symbols, equation: int | None) -> None:
    """Raise for functions that jump or have kinks, and for users' functions."""
    moving = {symbols.time[0], *(s for s in symbols.states if isinstance(s, Field))}
    for node in sorted(rate.atoms(*_NOT_SMOOTH), key=sp.default_sort_key):
        if node.free_symbols & moving or node.atoms(AppliedUndef, Vector):
            time = symbols.time[0]
            of_time = node.atoms(sp.Symbol, AppliedUndef) <= {time, *symbols.parameters}
            step = f"1/(1 + exp(-({time if of_time else 'x'} - 1)/0.01))"
            transition = f"write a smooth transition, such as {step} for a step"
            if of_time:
                remedy = (
                    f"{transition} at {time} = 1, with the width that it really has; or end the "
                    "horizon at that time, and begin a second problem there; or multiply by a "
                    "scalar unknown s(t) with the rate 0 that an event resets: "
                    f"rankone.Event({time} - 1, then={{s: 1}})"
                )
            else:
                remedy = (
                    f"{transition} at x = 1; where it depends on place alone, give its values as "
                    "an array"
                )
            raise ProblemError(
                f"{quote(node)} is not smooth, as rates and events of fields are",
                equation=equation,
                term=node,
                remedy=remedy,
            )
    for applied in sorted(rate.atoms(DataFunction), key=sp.default_sort_key):
        raise ProblemError(
            f"{quote(applied)} is a table or a function of the user, which fields do not take",
            equation=equation,
            term=applied,
            remedy="write it as a formula",
        )
