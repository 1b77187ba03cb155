"""Lowering: products of more than two states become products of two.

``x**3`` is written ``w*x`` with the auxiliary state ``w = x*x``, ``x**4`` is ``w*w``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from rankone.codegen.pairs import Pair, extract_pairs
from rankone.ir.forms import Role, State, Term

__all__ = ["auxiliary_states", "lower"]


def lower(f: Sequence[Term], n_states: int) -> tuple[tuple[Pair, ...], tuple[Term, ...]]:
    """Rewrite the right-hand side of ``u' = f`` with products of at most two states.

    Returns
    -------
    products : tuple of (int, int)
        Auxiliary state ``n_states + k`` is the product of the states ``products[k]``; none if the
        system is quadratic already.
    terms : tuple of Term
        f, of degree at most two, then ``s_a s_b - w`` of every product.
    """
    high = list(dict.fromkeys(term.monomial for term in f if len(term.monomial) > 2))
    products, lowered = extract_pairs(high, n_states, degree=2)
    rewritten = dict(zip(high, lowered, strict=True))
    terms = [replace(term, monomial=rewritten.get(term.monomial, term.monomial)) for term in f]
    for k, pair in enumerate(products, start=n_states):
        one = (0,) * len(f[0].factors)
        terms += [Term(k, Fraction(1), one, pair), Term(k, Fraction(-1), one, (k,))]
    return tuple(products), tuple(terms)


def auxiliary_states(states: Sequence[State], products: Sequence[Pair]) -> tuple[State, ...]:
    """The products as states, with names that no other state has: ``w0``, ``w1``, ..."""
    prefix = "w"
    while any(s.name.startswith(prefix) and s.name[len(prefix) :].isdigit() for s in states):
        prefix += "_"
    found = list(states)
    for k, (a, b) in enumerate(products):
        expression = found[a].expression * found[b].expression
        found.append(State(f"{prefix}{k}", expression, Role.AUXILIARY))
    return tuple(found[len(states) :])
