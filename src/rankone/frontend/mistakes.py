"""What is often written in place of an unknown at the time t, and what to write instead."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.support.errors import ProblemError
from rankone.support.wording import quote

Fault = tuple[str, sp.Expr, str]
"""A message, the term and the remedy."""
_NO_DELAY = (
    "nothing without a delay is the same; a chain of n further unknowns, "
    "z1' = n*({x} - z1)/tau, ..., zn' = n*(z(n-1) - zn)/tau, is {x} after a delay that is spread "
    "around tau"
)
_AT_TIME = "equations may have unknowns at the time {t} alone"


def wrong_argument(applied: sp.Expr, time: sp.Symbol) -> Fault:
    """Say what is wrong with x(s), x(t - 1), x(2*t), x(0) or x(t, k)."""
    name = applied.func.__name__
    fault = f"is not a function of the time {quote(time)} alone"
    remedy = f"write {name}({time}); parameters are symbols of their own"
    if len(applied.args) == 1:
        argument = applied.args[0]
        if isinstance(argument, sp.Symbol) and argument.name == time.name:
            remedy = "use one symbol for the time everywhere"
            fault = f"uses another symbol {quote(argument)} than the time, with other assumptions"
        elif time in argument.free_symbols:
            fault, remedy = _at_another_time(argument, name, time)
    return f"{quote(applied)} {fault}", applied, remedy


def unsupported(term: sp.Expr, time: sp.Symbol) -> Fault:
    """Say what is wrong with an integral, or with a derivative at another time."""
    if isinstance(term, sp.Subs) and term.point and time in term.point[0].free_symbols:
        unknown = next(iter(term.expr.atoms(AppliedUndef)), term.expr)
        fault, remedy = _at_another_time(term.point[0], unknown.func.__name__, time)
        return f"{quote(term)} {fault}", term, remedy
    message = f"{quote(term)} is not supported in an equation"
    return message, term, "integrals can be written as unknowns with equations of their own"


def _at_another_time(argument: sp.Expr, name: str, time: sp.Symbol) -> tuple[str, str]:
    """What is wrong with an unknown at the time of an argument, and what to do."""
    if time in (argument - time).free_symbols:
        fault = f"takes the unknown at another time than {quote(time)}"
        return fault, _AT_TIME.format(t=time)
    fault = f"takes the unknown at another time than {quote(time)}: delays are not supported"
    return fault, _NO_DELAY.format(x=name)


def check_symbols_as_unknowns(
    equations: Sequence[sp.Basic], declared: Iterable[sp.Expr], initial: object, time: sp.Symbol
) -> None:
    """Raise for a symbol in place of an unknown: SymPy takes its derivative as zero."""
    symbols = {time, *declared}
    starts = [*initial] if isinstance(initial, Mapping) else []
    for symbol in (key for key in starts if isinstance(key, sp.Symbol)):
        involved = [i for i, e in enumerate(equations, 1) if symbol in _free_symbols(e)]
        if involved and symbol not in symbols:
            raise ProblemError(
                f"{quote(symbol)} has an initial value but is a symbol, whose derivative is zero",
                equation=involved[0],
                term=symbol,
                remedy=f'make it a function of time: {symbol} = sympy.Function("{symbol}")({time})',
            )
    for i, equation in enumerate(equations, 1):
        if isinstance(equation, sp.Eq) and equation.lhs.is_Symbol and equation.lhs not in symbols:
            symbol = equation.lhs
            raise ProblemError(
                f"{quote(symbol)} is given by an equation, but is a symbol",
                equation=i,
                term=symbol,
                remedy=f"put it into `definitions`, {{{symbol}: {equation.rhs}}}, or make it a "
                f'function of time, {symbol} = sympy.Function("{symbol}")({time})',
            )


def _free_symbols(equation: object) -> set[sp.Basic]:
    return equation.free_symbols if isinstance(equation, sp.Basic) else set()
