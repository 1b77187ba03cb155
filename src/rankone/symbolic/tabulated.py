"""The separated form of a table of terms: functions are split, and nothing is multiplied out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import partial

import sympy as sp

from rankone.expressions.admissible import known_functions, located_defect
from rankone.expressions.notation import exact
from rankone.frontend.term_table import Entry, TermTable
from rankone.ir.forms import Factor, GeneralTerm, SeparatedForm, Term
from rankone.support.deferred import Deferred
from rankone.support.wording import listing, quote
from rankone.symbolic.first_order import WeakForm
from rankone.symbolic.splitting import AS_IT_IS, FURTHER_UNKNOWN, Indivisible, Splitter

_LARGEST = 1e100  # Coefficients up to this, and down to its reciprocal, need no closer look
_Key = tuple[int, int, tuple[int, ...]]
"""Equation, number of the product of factors, states multiplied."""
_Sums = dict[_Key, Fraction | float]
_Product = tuple[sp.Expr, ...]
"""A factor of each coordinate."""
_Numbered = list[tuple[Fraction | float, int]]
"""Weights, and the numbers of the products that they multiply."""


def tabulated_form(table: TermTable, weak: WeakForm) -> SeparatedForm | None:
    """The separated form of a table; None where the way over expressions has more to say.

    That is where a function does not separate, or a factor or coefficient is not finite. Terms with
    rate laws do not separate, and are listed when they are read.
    """
    if table.forms and not _is_known(table, weak):
        return None
    splitter = Splitter(weak.coordinates, [])
    functions = [_split(splitter, f) for f in table.functions]
    starts = [start for e in weak.initial if (start := _split(splitter, e)) is not None]
    if len(starts) < len(weak.initial) or (None in functions and not table.forms):
        return None
    one = (sp.S.One,) * len(weak.coordinates)
    products: dict[_Product, int] = {one: 0}
    numbered = [None if f is None else _numbered(f, products) for f in functions]
    residual, general = _residual(table, numbered, len(weak.states))
    pairs = ((i, pair) for i, start in enumerate(starts) for pair in _numbered(start, products))
    initial: _Sums = {(i, product, ()): weight for i, (weight, product) in pairs}
    if not all(map(_is_ordinary, {*residual.values(), *initial.values()})):
        return None
    distinct = _distinct(products)
    for j, (coordinate, each) in enumerate(zip(weak.coordinates, distinct, strict=True)):
        if any(located_defect(factor, coordinate, j) is not None for factor in each):
            return None
    places = [
        tuple(each.index(f) for each, f in zip(distinct, product, strict=True))
        for product in products
    ]
    zero = (0,) * len(distinct)
    derivatives = [Term(i, Fraction(1), zero, (i,), 1) for i in range(len(weak.states))]
    return SeparatedForm(
        coordinates=weak.coordinates,
        states=weak.states,
        factors=tuple(tuple(Factor(j, f) for f in each) for j, each in enumerate(distinct)),
        terms=_ordered([*derivatives, *_terms(residual, places)]),
        initial=_ordered(_terms(initial, places)),
        general=_listed(general, table, weak),
    )


def _residual(
    table: TermTable, functions: Sequence[_Numbered | None], states: int
) -> tuple[_Sums, list[Entry]]:
    """The residual over separated ``functions``, and the terms that do not separate."""
    residual: _Sums = {}
    general: list[Entry] = []
    for entry in table.terms:
        coefficient, rate, function, factors = entry
        separate = functions[function]
        if rate >= states:  # of a sum inside a law
            continue
        if separate is None or any(s >= states for s in factors):
            general.append(entry)
            continue
        for weight, product in separate:
            key = rate, product, factors
            residual[key] = residual.get(key, 0) - coefficient * weight
    return residual, general


def _listed(entries: list[Entry], table: TermTable, weak: WeakForm) -> Sequence[GeneralTerm]:
    """Terms with rate laws; they are written when they are read."""
    if not entries:
        return ()
    return Deferred(len(entries), partial(_written_terms, entries, table, weak))


def _is_known(table: TermTable, weak: WeakForm) -> bool:
    """Whether all functions of one coordinate are finite, those inside of forms too."""
    by_coordinate = known_functions(weak.coordinates, [*table.expressions, *weak.initial])
    pairs = enumerate(zip(weak.coordinates, by_coordinate, strict=True))
    return not any(located_defect(f, c, j) is not None for j, (c, fs) in pairs for f in fs)


def _written_terms(entries: list[Entry], table: TermTable, weak: WeakForm) -> list[GeneralTerm]:
    return [_general(entry, table, weak) for entry in entries]


def _general(entry: Entry, table: TermTable, weak: WeakForm) -> GeneralTerm:
    """A term that does not separate, and why."""
    _, rate, function, symbols = entry
    term = table.product(entry)
    law = table.functions[function]
    reason, further = "does not factor", "take it as a further unknown with an equation of its own"
    if any(symbol >= len(weak.states) for symbol in symbols):
        law = table.written(max(symbols))
        unknowns = [state for state in table.states if law.has(state)]
        reason, further = f"is not polynomial in {listing(unknowns)}", FURTHER_UNKNOWN
    within = "" if law == term else f" in the term {quote(term)}"
    message, remedy = f"{quote(law)}{within} {reason}", f"{AS_IT_IS} {further}"
    return GeneralTerm(rate, term, False, message, remedy, weak.origins[rate])


def _split(splitter: Splitter, function: sp.Expr) -> list[tuple[Fraction | float, _Product]] | None:
    """A function as numbers times products of factors; None if it does not separate."""
    if function.is_Rational:
        (monomial,) = splitter.split(sp.S.One)
        return [(_fraction(function), monomial.factors)] if function else []
    try:
        return [(_fraction(c), m.factors) for m, c in splitter.split(exact(function)).items()]
    except Indivisible:
        return None


def _fraction(number: sp.Expr) -> Fraction | float:
    return Fraction(int(number.p), int(number.q)) if number.is_Rational else float(number)


def _is_ordinary(number: Fraction | float) -> bool:
    inside = -_LARGEST < number < _LARGEST
    return number == 0 or (inside and abs(float(number)) > 1.0 / _LARGEST)


def _numbered(
    terms: Iterable[tuple[Fraction | float, _Product]], products: dict[_Product, int]
) -> _Numbered:
    """Numbers times products of factors, these by their numbers; new ones are added."""
    return [(weight, products.setdefault(p, len(products))) for weight, p in terms]


def _distinct(products: Iterable[_Product]) -> list[list[sp.Expr]]:
    """For each dimension its distinct factors: one, then the others in SymPy's order."""
    return [
        [sp.S.One, *sorted((f for f in dict.fromkeys(each) if f != 1), key=sp.default_sort_key)]
        for each in zip(*products, strict=True)
    ]


def _terms(sums: _Sums, places: Sequence[tuple[int, ...]]) -> list[Term]:
    """The terms of sums; ``places`` has for each product the factors."""
    return [
        Term(equation, Fraction(weight) if isinstance(weight, int) else weight, places[p], states)
        for (equation, p, states), weight in sums.items()
        if weight
    ]


def _ordered(terms: list[Term]) -> tuple[Term, ...]:
    """Terms by equation, derivatives first, then by degree, monomial and factors."""

    def key(t: Term) -> tuple[object, ...]:
        return t.equation, -t.derivative, len(t.monomial), t.monomial, t.factors

    return tuple(sorted(terms, key=key))
