"""Long sums of numbers times states, which are evaluated as states of their own."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import sympy as sp

_LEAST_STATES = 16  # Shorter sums are evaluated term by term

Sums = dict[sp.Dummy, dict[sp.Symbol, float]]
"""For the symbol of each sum its states, and the numbers before them."""


def long_sums(
    expressions: Sequence[sp.Expr], states: Collection[sp.Symbol]
) -> tuple[list[sp.Expr], Sums]:
    """Expressions with symbols for sums of many states, and what these symbols stand for."""
    sums: Sums = {}
    shorter: dict[sp.Expr, sp.Expr] = {}
    for expression in expressions:
        walk = sp.preorder_traversal(expression)
        for node in walk:
            if not isinstance(node, sp.Add) or len(node.args) < _LEAST_STATES:
                continue
            if node not in shorter:
                weights, others = _weights(node, states)
                if len(weights) < _LEAST_STATES:
                    continue
                symbol = sp.Dummy(f"sum{len(sums)}")
                sums[symbol], shorter[node] = weights, sp.Add(symbol, *others)
            walk.skip()
    return [expression.xreplace(shorter) for expression in expressions], sums


def _weights(
    terms: sp.Add, states: Collection[sp.Symbol]
) -> tuple[dict[sp.Symbol, float], list[sp.Expr]]:
    """The numbers before states in a sum, and its other terms."""
    weights: dict[sp.Symbol, float] = {}
    others: list[sp.Expr] = []
    for term in terms.args:
        weight, rest = term.as_coeff_Mul()
        if rest in states:
            weights[rest] = float(weight)
        else:
            others.append(term)
    return weights, others
