"""The arithmetic of tables of terms: sums of products, and operations on them.

What adds and multiplies is multiplied out. Quotients by unknowns, powers and functions of them are
symbols of their own, written once by :class:`~rankone.problem.algebra.term_table.RateLaws`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from fractions import Fraction

import sympy as sp

from rankone.problem.algebra.term_table import (
    FUNCTIONS,
    Entry,
    RateForm,
    RateLaws,
    TermSum,
    TermTable,
    Value,
    rational,
)
from rankone.problem.expressions.stable import HIGH_POWER
from rankone.support.arrays import EXACT_DIGITS, FEW

# Forms that are printed at most, in shares of the states: each takes SymPy as long as an equation
_MOST_FORMS = Fraction(1, 4)


class NotTabulated(Exception):
    """Something has no place in a table of terms, or is better not multiplied out."""


class TermSums:
    """Sums of products of unknowns, which have the numbers from 0 to ``states``."""

    def __init__(self, states: int) -> None:
        self.states = states
        self.functions: list[sp.Expr] = [sp.S.One]
        self._numbers: dict[sp.Expr, int] = {sp.S.One: 0}
        self._products: dict[tuple[int, int], int] = {}
        self._fractions: dict[int, Fraction] = {}
        self._laws = RateLaws(states)

    def function(self, expression: sp.Expr) -> TermSum:
        """A function of time and parameters, with its number in front."""
        coefficient, function = expression.as_coeff_Mul()
        if not coefficient.is_Rational:
            coefficient, function = sp.S.One, expression
        return {(self._place(function), ()): Fraction(int(coefficient.p), int(coefficient.q))}

    def expression(self, functions: TermSum) -> sp.Expr:
        """A sum without unknowns as an expression."""
        if any(symbols for _, symbols in functions):
            raise NotTabulated
        return sp.Add(*(rational(x) * self.functions[f] for (f, _), x in functions.items()))

    def product(self, left: TermSum, right: TermSum) -> TermSum:
        """A product; of two sums of several products of unknowns as it is written.

        ``(x - 310)*(y - 310)`` multiplied out is a difference of large numbers.
        """
        if len(left) > 1 and len(right) > 1:
            if any(symbols for _, symbols in right):
                left, right = right, left
            if any(symbols for _, symbols in right):
                return self._applied("product", left, right)
            right = self.function(self.expression(right))
        if len(left) == 1:
            left, right = right, left
        total: TermSum = {}
        for (f, symbols), coefficient in left.items():
            for (g, others), factor in right.items():
                both = tuple(sorted(symbols + others)) if others else symbols
                product = self._multiplied(f, g), both
                total[product] = total.get(product, 0) + coefficient * factor
        return total

    def quotient(self, above: TermSum, below: TermSum) -> TermSum:
        """A quotient, in which as many unknowns as possible are in a fraction a/(a + b)."""
        below = without_zeros(below)
        if not any(symbols for _, symbols in below):
            divisor = self.expression(below)
            if divisor.is_zero:
                raise NotTabulated
            return self.product(above, self.function(1 / divisor))
        above = without_zeros(above)
        if len(above) > 1:
            return self._applied("quotient", above, below)
        if not above:
            return above
        (((f, symbols), coefficient),) = above.items()
        if len(below) == 1:
            (((g, others), divisor),) = below.items()
            common = Counter(symbols) & Counter(others)
            above = {(f, _without(symbols, common)): coefficient / divisor}
            above = self.product(above, self.function(1 / self.functions[g]))
            below = {(0, _without(others, common)): Fraction(1)}
            return above if (0, ()) in below else self._divided(above, below)
        inside = [
            (g, others)
            for g, others in below
            if g in (0, f) and others and not Counter(others) - Counter(symbols)
        ]
        if not inside:
            return self._divided(above, below)
        g, others = max(inside, key=lambda product: (len(product[1]), product))
        first = {(g, others): below[g, others]}
        rest = {product: x for product, x in below.items() if product != (g, others)}
        outside = 0 if g else f, _without(symbols, Counter(others))
        fraction = self._applied("fraction", first, rest)
        return self.product({outside: coefficient / below[g, others]}, fraction)

    def _divided(self, above: TermSum, below: TermSum) -> TermSum:
        """One product times a reciprocal."""
        return self.product(above, self._applied("reciprocal", below))

    def power(self, base: TermSum, exponent: TermSum) -> TermSum:
        """A power of unknowns; the exponent has none."""
        degree = self.expression(exponent)
        if degree.is_number and not (degree.is_Rational and abs(degree) <= HIGH_POWER):
            raise NotTabulated
        if degree.is_Integer and degree < 0:
            positive: TermSum = {(0, ()): Fraction(int(-degree))}
            return self.quotient({(0, ()): Fraction(1)}, self.power(base, positive))
        if degree.is_Integer and len(base) == 1:
            result: TermSum = {(0, ()): Fraction(1)}
            for _ in range(int(degree)):
                result = self.product(base, result)
            return result
        if degree == sp.Rational(1, 2):
            return self._applied("sqrt", base)
        return self._applied("power", base, exponent)

    def called(self, name: str, argument: TermSum) -> TermSum:
        """A function of unknowns."""
        if name not in FUNCTIONS:
            raise NotTabulated
        return self._applied(name, argument)

    def table(
        self,
        states: Sequence[sp.Expr],
        sums: Iterable[TermSum],
        *,
        texts: tuple[str, ...] = (),
        rates: tuple[sp.Expr, ...] = (),
    ) -> TermTable:
        """The table of some states, whose rates are sums that came as texts or expressions."""
        sums = [self._without_cancellation(without_zeros(rate)) for rate in sums]
        used = {s for rate in sums for _, symbols in rate for s in symbols}
        forms, values, inner = self._laws.tabulated(used, self.functions)
        if len(forms) > _MOST_FORMS * self.states:
            raise NotTabulated
        if values and all(form.expression.is_polynomial(*form.symbols) for form in forms):
            raise NotTabulated  # the general way multiplies out as long as that loses no digits
        targets = dict(enumerate(sums)) | inner
        table = _table(states, self.functions, forms, values, targets)
        return replace(table, texts=texts, rates=rates)

    def _applied(self, operation: str, *arguments: TermSum) -> TermSum:
        """The symbol of an operation as a sum."""
        cleaned = [without_zeros(self._with_fractions(argument)) for argument in arguments]
        cleaned = [self._without_cancellation(a) if len(a) >= FEW else a for a in cleaned]
        return {(0, (self._laws.symbol(operation, *cleaned),)): Fraction(1)}

    def _with_fractions(self, total: TermSum) -> TermSum:
        """A sum with ``0.7**2.5`` and ``sqrt(2)`` as fractions, which stand in slots as numbers."""
        changed: TermSum = {}
        for (f, symbols), coefficient in total.items():
            function = self.functions[f]
            if f and function.is_number:
                if f not in self._fractions:
                    self._fractions[f] = Fraction(str(sp.N(function, EXACT_DIGITS)))
                f, coefficient = 0, coefficient * self._fractions[f]
            changed[f, symbols] = changed.get((f, symbols), 0) + coefficient
        return changed

    def _without_cancellation(self, total: TermSum) -> TermSum:
        """The sum with ``k*x - k*x*exp(z)`` as one product of ``1 - exp(z)``, written by itself.

        See :func:`rankone.problem.expressions.stable.stable`, which then writes it without
        cancellation.
        """
        for (f, symbols), coefficient in list(total.items()):
            for symbol in symbols:
                if symbol < self.states:
                    continue
                factor = _without(symbols, Counter([symbol]))
                sign = total.get((f, factor), Fraction(0)) / coefficient
                if sign in (1, -1) and (f, symbols) in total:
                    del total[f, symbols], total[f, factor]
                    pair = {(0, ()): sign, (0, (symbol,)): Fraction(1)}
                    (((_, (both,)), _),) = self._applied("total", pair).items()
                    product = f, tuple(sorted((*factor, both)))
                    total[product] = total.get(product, 0) + coefficient
                    break
        return without_zeros(total)

    def _multiplied(self, f: int, g: int) -> int:
        """The number of the product of two functions."""
        if not f or not g:
            return f or g
        if (f, g) not in self._products:
            coefficient, function = (self.functions[f] * self.functions[g]).as_coeff_Mul()
            if coefficient != 1:
                raise NotTabulated
            self._products[f, g] = self._place(function)
        return self._products[f, g]

    def _place(self, function: sp.Expr) -> int:
        """The number of a function."""
        place = self._numbers.setdefault(function, len(self.functions))
        if place == len(self.functions):
            self.functions.append(function)
        return place


def added(left: TermSum, right: TermSum, sign: int = 1) -> TermSum:
    """The first sum with the second added to it."""
    for product, coefficient in right.items():
        left[product] = left.get(product, 0) + sign * coefficient
    return left


def without_zeros(total: TermSum) -> TermSum:
    """A sum without the products that cancel."""
    return {product: coefficient for product, coefficient in total.items() if coefficient}


def _without(symbols: Iterable[int], fewer: Counter[int]) -> tuple[int, ...]:
    """Symbols without some of them."""
    return tuple(sorted((Counter(symbols) - fewer).elements()))


def _table(
    states: Sequence[sp.Expr],
    functions: Sequence[sp.Expr],
    forms: Sequence[RateForm],
    values: Sequence[Value],
    targets: dict[int, TermSum],
) -> TermTable:
    """The table with symbols numbered one by one, and without functions that only forms have."""
    n = len(states)
    further = sorted([*(v.symbol for v in values), *(s for s in targets if s >= n)])
    place = {i: i for i in range(n)} | {symbol: n + k for k, symbol in enumerate(further)}
    kept = [*range(len(functions))]
    if forms:
        kept = sorted({0} | {f for total in targets.values() for f, _ in total})
    row = {f: k for k, f in enumerate(kept)}

    def numbered(symbols: Iterable[int]) -> tuple[int, ...]:
        return tuple(place[s] for s in symbols)

    terms: list[Entry] = [
        (coefficient, place[target], row[f], numbered(symbols))
        for target, total in targets.items()
        for (f, symbols), coefficient in total.items()
    ]
    renumbered = (Value(place[v.symbol], v.form, numbered(v.symbols), v.numbers) for v in values)
    chosen = tuple(functions[f] for f in kept)
    return TermTable(
        tuple(states), chosen, tuple(terms), forms=tuple(forms), values=tuple(renumbered)
    )
