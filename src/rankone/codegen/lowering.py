"""Lowering: products of more than two states become products of two.

``x**3`` is written ``w*x`` with the auxiliary state ``w = x*x``, ``x**4`` is ``w*w``. The same pair
extraction finds common subexpressions, see :mod:`rankone.codegen.sums`.
"""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

from rankone.errors import SeparationError
from rankone.ir import SeparatedForm, Term

__all__ = ["LoweredSystem", "extract_pairs", "lower", "right_hand_side", "state_names"]

Monomial = tuple[int, ...]
Pair = tuple[int, int]


@dataclass(frozen=True, slots=True)
class LoweredSystem:
    """A quadratic system equivalent to a polynomial one.

    Attributes
    ----------
    n_differential : int
        Number of differential states.
    products : tuple of (int, int)
        Auxiliary state ``n_differential + k`` is the product of states ``products[k]``.
    terms : tuple of Term
        Right-hand sides of degree at most two: f of every differential state, then
        ``s_a s_b - w`` of every product.
    """

    n_differential: int
    products: tuple[Pair, ...]
    terms: tuple[Term, ...]

    @property
    def n_states(self) -> int:
        """Number of differential and auxiliary states."""
        return self.n_differential + len(self.products)


def right_hand_side(form: SeparatedForm) -> tuple[Term, ...]:
    """Terms of f in ``u' = f``, like terms merged, in the order of the form.

    Raises
    ------
    SeparationError
        If the derivative terms of the form are anything but one ``u'`` for each state.
    """
    merged: dict[tuple[int, tuple[int, ...], Monomial], float] = {}
    derivatives = []
    for term in form.terms:
        if term.derivative:
            derivatives.append((term.derivative, term.equation, term.monomial))
            if term.coefficient != 1.0 or any(term.factors):
                raise SeparationError(
                    f"the derivative of {form.states[term.equation].name} has a factor",
                    equation=term.equation + 1,
                    term=term,
                    remedy="divide the equation by the factor of the derivative",
                )
        else:
            key = (term.equation, term.factors, tuple(sorted(term.monomial)))
            merged[key] = merged.get(key, 0.0) - float(term.coefficient)
    if sorted(derivatives) != [(1, c, (c,)) for c in range(len(form.states))]:
        raise SeparationError(
            "the derivative terms are not one u' for each state",
            remedy="solve the equations for the derivatives",
        )
    return tuple(Term(c, value, factors, m) for (c, factors, m), value in merged.items() if value)


def lower(f: Sequence[Term], n_states: int) -> LoweredSystem:
    """Rewrite the right-hand side of ``u' = f`` with products of at most two states.

    Parameters
    ----------
    f : sequence of Term
        Terms of any degree, see :func:`right_hand_side`.
    n_states : int
        Number of differential states.

    Returns
    -------
    LoweredSystem
        Without products when the system is quadratic already.
    """
    high = list(dict.fromkeys(term.monomial for term in f if len(term.monomial) > 2))
    products, lowered = extract_pairs(high, n_states, degree=2)
    rewritten = dict(zip(high, lowered, strict=True))
    terms = [replace(term, monomial=rewritten.get(term.monomial, term.monomial)) for term in f]
    for k, pair in enumerate(products, start=n_states):
        one = (0,) * len(f[0].factors)
        terms += [Term(k, 1.0, one, pair), Term(k, -1.0, one, (k,))]
    return LoweredSystem(n_states, tuple(products), tuple(terms))


def state_names(form: SeparatedForm, lowered: LoweredSystem) -> list[str]:
    """Names of the differential states and of the products, all distinct."""
    names = [state.name for state in form.states]
    prefix = "w"
    while any(name.startswith(prefix) and name[len(prefix) :].isdigit() for name in names):
        prefix += "_"
    return [*names, *(f"{prefix}{k}" for k in range(len(lowered.products)))]


def extract_pairs(
    monomials: Sequence[Monomial], n_symbols: int, *, degree: int, repeats: int = 1
) -> tuple[list[Pair], list[Monomial]]:
    """Replace pairs of symbols by new symbols, the most frequent pair first.

    Parameters
    ----------
    monomials : sequence of tuple of int
        Symbols multiplied, repeated for powers.
    n_symbols : int
        The new symbol of pair k is ``n_symbols + k``.
    degree : int
        Monomials of this degree or less are left alone.
    repeats : int
        Pairs that occur less often than this are left alone.

    Returns
    -------
    pairs : list of (int, int)
        The symbols multiplied, possibly earlier pairs; equally frequent pairs in ascending order.
    monomials : list of tuple of int
        The rewritten monomials, each ascending.
    """
    bags = [Counter(monomial) for monomial in monomials]
    where: defaultdict[Pair, dict[int, int]] = defaultdict(dict)  # pair -> {monomial: how often}

    def record(i: int, symbols: Sequence[int]) -> None:
        """Update the occurrences in monomial i of all pairs that contain one of the symbols."""
        bag = bags[i]
        active = bag.total() > degree
        for a in symbols:
            for b in bag:
                pair = (min(a, b), max(a, b))
                often = (bag[a] // 2 if a == b else min(bag[a], bag[b])) if active else 0
                if often:
                    where[pair][i] = often
                else:
                    where[pair].pop(i, None)

    for i, bag in enumerate(bags):
        record(i, tuple(bag))
    queue = [(-sum(found.values()), pair) for pair, found in where.items()]
    heapq.heapify(queue)
    pairs: list[Pair] = []
    while queue:
        often, pair = heapq.heappop(queue)
        found = where[pair]
        if (now := sum(found.values())) != -often:  # counts only ever fall: requeue and go on
            heapq.heappush(queue, (-now, pair))
            continue
        if now < repeats or now == 0:
            break
        new = n_symbols + len(pairs)
        pairs.append(pair)
        partners: set[Pair] = set()
        for i, times in sorted(found.items()):
            bags[i].subtract({pair[0]: times})
            bags[i].subtract({pair[1]: times})
            bags[i][new] = times
            record(i, tuple(bags[i]))
            bags[i] = +bags[i]
            partners.update((symbol, new) for symbol in bags[i])
        for other in sorted(partners):
            heapq.heappush(queue, (-sum(where[other].values()), other))
    return pairs, [tuple(sorted(bag.elements())) for bag in bags]
