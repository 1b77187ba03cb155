"""Symbols that stand for expressions of others: their order, their expansion, their rates."""

from __future__ import annotations

import graphlib
import itertools
from collections.abc import Callable, Mapping

import sympy as sp

from rankone.support.errors import ProblemError
from rankone.support.wording import quote

Definitions = Mapping[sp.Symbol, sp.Expr]


def ordered(definitions: Definitions) -> dict[sp.Symbol, sp.Expr]:
    """The same, each behind those that it refers to; a ProblemError names a circle."""
    needs = {symbol: sorted(e.free_symbols, key=str) for symbol, e in definitions.items()}
    try:
        order = graphlib.TopologicalSorter(needs).static_order()
        return {symbol: definitions[symbol] for symbol in order if symbol in definitions}
    except graphlib.CycleError as error:
        circle = error.args[1][::-1]
        steps = (f"{quote(a)} needs {quote(b)}" for a, b in itertools.pairwise(circle))
        raise ProblemError(
            f"rules and rates of reactions go in a circle: {', '.join(steps)}",
            term=circle[0],
            remedy="let them determine one after the other",
        ) from None


def expanded(definitions: Definitions) -> dict[sp.Symbol, sp.Expr]:
    """Definitions in order, each with the earlier ones put in."""
    full: dict[sp.Symbol, sp.Expr] = {}
    for symbol, expression in definitions.items():
        full[symbol] = expression.xreplace(full)
    return full


def reached(expressions: list[sp.Basic], definitions: Definitions) -> dict[sp.Symbol, sp.Expr]:
    """The definitions, in order, that expressions refer to, directly or not."""
    needed: set[sp.Basic] = set().union(*(e.free_symbols for e in expressions))
    for symbol, expression in reversed(list(definitions.items())):
        if symbol in needed:
            needed |= expression.free_symbols
    return {symbol: e for symbol, e in definitions.items() if symbol in needed}


def rate_of(expression: sp.Expr, time: sp.Symbol, rate: Callable[[sp.Symbol], sp.Expr]) -> sp.Expr:
    """The rate of change of an expression of time and symbols, whose rates are given."""
    terms = [
        expression.diff(symbol) * (sp.S.One if symbol == time else rate(symbol))
        for symbol in sorted(expression.free_symbols, key=str)
    ]
    return sp.Add(*terms)
