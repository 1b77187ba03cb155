"""The separated form: every term a product of functions of one coordinate."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial

import sympy as sp

from rankone.compiler.passes.first_order import FirstOrderSystem, WeakForm, first_order, weak_form
from rankone.compiler.passes.splitting import (
    AS_IT_IS,
    FURTHER_UNKNOWN,
    Indivisible,
    Monomial,
    MonomialSum,
    Splitter,
)
from rankone.compiler.passes.well_posed import check_gaps, check_known, check_tables
from rankone.problem.algebra.term_table import Entry, TermTable
from rankone.problem.expressions.admissible import known_functions, located_defect
from rankone.problem.expressions.notation import NamedConstant, exact
from rankone.problem.expressions.stable import HIGH_POWER
from rankone.problem.forms import Coordinate, Factor, GeneralTerm, SeparatedForm, Term
from rankone.problem.problem import Problem
from rankone.support.arrays import Deferred
from rankone.support.budget import timed
from rankone.support.errors import ProblemError, check_kind, listing, quote

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


# -----------------------------------------------------------------------------
# The separated form: every term of a weak form a product of functions of one coordinate.
#
# Applied functions and derivatives are replaced by plain symbols, every residual is split once
# (:mod:`~rankone.compiler.passes.splitting`), like terms merge, and terms and factors are put in
# an order that depends on nothing but the mathematics.


# Largest coefficient of a separated term, and with its reciprocal the smallest: the product of two
# is still a floating-point number
_LARGEST_COEFFICIENT = sp.Integer(10) ** 150


def separate(form: WeakForm | Problem) -> SeparatedForm:
    """Separate a weak form: every integral becomes a product of one-dimensional ones.

    Parameters
    ----------
    form : WeakForm or Problem
        Of a problem the weak form is taken first.

    Returns
    -------
    SeparatedForm
        The residual u' - f and the initial values. Terms are ordered by equation, then the
        derivative, then by degree, monomial and factors; factors as SymPy orders expressions.
        Terms that do not factor, or are not polynomial in the unknowns, are listed in ``general``.

    Raises
    ------
    ProblemError
        If a factor is not finite and real everywhere on its interval.
    OptionError
        If the form is neither.
    """
    weak = weak_form(form) if isinstance(form, Problem) else form
    remedy = "give a problem or weak_form(problem); what is compiled has `.separated`"
    check_kind("separate", weak, WeakForm, Problem, remedy=remedy)
    return _Separation(weak).form()


def symbolic_forms(
    problem: Problem, timings: dict[str, float]
) -> tuple[FirstOrderSystem, WeakForm, SeparatedForm]:
    """Every symbolic pass over a problem, checked and timed.

    A ProblemError says what is not finite and real on the domain, or has no branch somewhere.
    """
    with timed(timings, "first order"):
        system = first_order(problem)
        check_tables(system, system.coordinates)
        check_gaps(system.piecewise(), system.coordinates)
    with timed(timings, "weak form"):
        weak = weak_form(system)
    with timed(timings, "separation"):
        tabulated = problem.table and tabulated_form(problem.table, weak)
        if tabulated is None and problem.table is not None and problem.table.forms:
            system = replace(system, rhs=tuple(system.rhs))  # checks look at them
        separated = tabulated or separate(weak)
    if separated.general:
        check_known(system, system.coordinates)
    return system, weak, separated


def _named_in_time(terms: MonomialSum) -> MonomialSum:
    """The terms with named constants in the factors of time, not in coefficients.

    They are functions of time that do not change, so that coefficients are numbers.
    """
    moved = []
    for monomial, coefficient in terms.items():
        scalar, constants = coefficient.as_coeff_Mul()
        if coefficient.atoms(NamedConstant):
            first, *others = monomial.factors
            factors = (constants * first, *others)
            monomial, coefficient = Monomial(factors, monomial.powers), scalar
        moved.append((monomial, coefficient))
    return MonomialSum.of(moved)


class _Separation:
    """The working state of one separation."""

    def __init__(self, weak: WeakForm) -> None:
        self.weak = weak
        self.coordinates = weak.coordinates
        t = weak.coordinates[0].symbol
        states = [sp.Symbol(state.name) for state in weak.states]
        rates = [sp.Dummy(f"d{state.name}") for state in weak.states]
        self.plain = {sp.Derivative(u, t): r for u, r in zip(weak.functions, rates, strict=True)}
        self.plain |= dict(zip(weak.functions, states, strict=True))
        pairs = zip(states, weak.states, strict=True)
        self.written = {symbol: state.expression for symbol, state in pairs}
        self.splitter = Splitter(self.coordinates, [*states, *rates])
        self.general: list[GeneralTerm] = []

    def form(self) -> SeparatedForm:
        residuals = [self._split(i, r, initial=False) for i, r in enumerate(self.weak.residuals)]
        initial = [self._split(i, v, initial=True) for i, v in enumerate(self.weak.initial)]
        factors = self._factors([*residuals, *initial])
        self._check_factors(factors, residuals)
        index = [{f: i for i, f in enumerate(distinct)} for distinct in factors]
        pairs = enumerate(factors)
        return SeparatedForm(
            coordinates=self.coordinates,
            states=self.weak.states,
            factors=tuple(tuple(Factor(j, f) for f in distinct) for j, distinct in pairs),
            terms=self._terms(residuals, index),
            initial=self._terms(initial, index),
            general=tuple(self.general),
            jumps=self.weak.jumps,
        )

    def _split(self, state: int, expression: sp.Expr, *, initial: bool) -> MonomialSum:
        """Split one residual or initial value; keep and explain what cannot be split."""
        sums = []
        for term in sp.Add.make_args(expression.xreplace(self.plain)):
            try:
                split = self.splitter.split(term)
                for monomial, coefficient in split.items():
                    self._check(term, monomial, coefficient)
            except Indivisible as reason:
                signed = term if initial else -term  # the sign it has in f
                self.general.append(self._explained(reason, signed, state, initial=initial))
                continue
            sums.append(split)
        return _named_in_time(MonomialSum.total(sums))

    def _check(self, term: sp.Expr, monomial: Monomial, coefficient: sp.Expr) -> None:
        """Refuse negative powers, and (x/1e6)**60: no floating-point number is 1e-360."""
        for state, power in monomial.powers:
            if power < 0:
                raise Indivisible(list(self.written)[state] ** power, "not polynomial")
        largest = _LARGEST_COEFFICIENT
        if not coefficient.is_comparable or 1 / largest < abs(coefficient) < largest:
            return
        powers = (p.exp for f in monomial.factors for p in f.atoms(sp.Pow) if p.exp.is_Integer)
        if max((sum(power for _, power in monomial.powers), *map(abs, powers))) >= HIGH_POWER:
            raise Indivisible(term, "out of range")

    def _explained(
        self, reason: Indivisible, term: sp.Expr, state: int, *, initial: bool
    ) -> GeneralTerm:
        """The term with the reason why it does not split; an error if it is not real."""
        culprit = reason.expression.xreplace(self.written)
        written = term.xreplace(self.written)
        within = "" if culprit == written else f" in the term {quote(written)}"
        where = f"initial value of {quote(self.weak.states[state].expression)}: "
        message = f"{where if initial else ''}{'' if within else 'term '}{quote(culprit)}{within} "
        equation = None if initial else self.weak.origins[state]
        among = [c for c in self.coordinates if c.symbol in reason.expression.free_symbols]
        if reason.reason == "not real":
            boxes = [f"{c.name} in [{c.lower:g}, {c.upper:g}]" for c in among]
            raise ProblemError(
                f"{message}is not real for all {', '.join(boxes)}",
                equation=equation,
                term=written,
                remedy="change the box",
            ) from None
        fault, way_out = self._fault(reason, among)
        return GeneralTerm(
            state, written, initial, f"{message}{fault}", f"{AS_IT_IS} {way_out}", equation
        )

    def _fault(self, reason: Indivisible, among: Sequence[Coordinate]) -> tuple[str, str]:
        """What keeps a term of some coordinates from splitting, and a remedy."""
        if reason.reason == "not polynomial":
            states = [e for s, e in self.written.items() if s in reason.expression.free_symbols]
            return f"is not polynomial in {listing(states)}", FURTHER_UNKNOWN
        if reason.reason == "out of range":
            fault = "has a number that floating point does not hold when it is multiplied out"
            return fault, "change the units"
        if reason.reason == "too many terms":
            fault = "has too many terms when it is multiplied out"
            return fault, "take the sum in it as a further unknown with an equation of its own"
        way_out = "write it as a sum of products of functions of one coordinate each, or " + (
            "take it as a further unknown with an equation of its own, such as z' = -k*z, "
            "z(0) = 1 for exp(-k*t)"
            if self.coordinates[0] in among
            else "take the combination as a parameter of its own"
        )
        return f"couples {listing(c.symbol for c in among)} and does not factor", way_out

    def _factors(self, sums: Sequence[MonomialSum]) -> list[list[sp.Expr]]:
        """For each dimension its distinct factors: one, then the others in SymPy's order."""
        products = [monomial.factors for terms in sums for monomial in terms]
        distinct = [dict.fromkeys(p[j] for p in products) for j in range(len(self.coordinates))]
        return [
            [sp.S.One, *sorted((f for f in factors if f is not sp.S.One), key=sp.default_sort_key)]
            for factors in distinct
        ]

    def _check_factors(
        self, factors: Sequence[Sequence[sp.Expr]], residuals: Sequence[MonomialSum]
    ) -> None:
        for j, (coordinate, distinct) in enumerate(zip(self.coordinates, factors, strict=True)):
            for factor in distinct:
                defect = located_defect(factor, coordinate, j)
                if defect is None:
                    continue
                users = (
                    i for i, r in enumerate(residuals) if any(m.factors[j] == factor for m in r)
                )
                user = next(users, None)
                origin = None if user is None else self.weak.origins[user]
                where = "in an initial value, " if user is None else ""
                if user is not None and origin is None:
                    where = "after solving for the derivatives, "
                raise ProblemError(
                    where + defect,
                    equation=origin,
                    term=factor,
                    remedy="change the interval so that the factor is finite and real on it",
                )

    def _terms(
        self, sums: Sequence[MonomialSum], index: Sequence[Mapping[sp.Expr, int]]
    ) -> tuple[Term, ...]:
        """The terms of all equations, in order."""
        n = len(self.weak.states)  # the states after the last are the rates
        terms = [
            Term(
                equation=equation,
                coefficient=self._number(coefficient, equation),
                factors=tuple(i[f] for i, f in zip(index, monomial.factors, strict=True)),
                monomial=tuple(s % n for s, power in monomial.powers for _ in range(power)),
                derivative=sum(power for s, power in monomial.powers if s >= n),
            )
            for equation, monomials in enumerate(sums)
            for monomial, coefficient in monomials.items()
        ]
        terms.sort(
            key=lambda t: (t.equation, -t.derivative, len(t.monomial), t.monomial, t.factors)
        )
        return tuple(terms)

    def _number(self, number: sp.Expr, state: int) -> Fraction | float:
        """A coefficient; exact if it is rational."""
        try:
            nearest = float(number)
        except (TypeError, OverflowError):
            nearest = math.nan
        lost = abs(nearest) < sys.float_info.min and number != 0
        if lost or not math.isfinite(nearest):
            fault = "too small for a floating-point number" if lost else "not a finite real number"
            raise ProblemError(
                f"coefficient {quote(number)} is {fault}",
                equation=self.weak.origins[state],
                term=number,
                remedy="rescale the equations or change the coefficients",
            )
        return Fraction(int(number.p), int(number.q)) if number.is_Rational else nearest
