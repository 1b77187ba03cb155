"""Equations of SymPy, read into a table of terms where they have one.

Each equation ``Eq(x.diff(t), f)`` is taken apart once. Whatever else equations are, or have, leaves
the problem to the general way, and so does what is wrong with them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import partial

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.expressions.notation import exact
from rankone.frontend.box import Box
from rankone.frontend.rate_forms import FUNCTIONS, TermSum
from rankone.frontend.term_sums import NotTabulated, TermSums, added
from rankone.frontend.term_table import FEWEST_TABULATED, TabulatedEquations, is_smooth
from rankone.support.budget import check_time
from rankone.support.errors import ProblemError

_NOT_REAL = (sp.I, sp.oo, -sp.oo, sp.zoo, sp.nan)


def tabulated_equations(equations: object, time: sp.Symbol, box: Box) -> object:
    """Equations with a table of their terms, or as they were given if no table holds them."""
    if not isinstance(equations, tuple) or len(equations) < FEWEST_TABULATED:
        return equations
    rates = _rates(equations, time)
    if rates is None:
        return equations
    reader = _Reader({state: i for i, state in enumerate(rates)}, {time, *box})
    try:
        sums = [reader.terms(rate) for rate in rates.values()]
        table = reader.sums.table(tuple(rates), sums, rates=tuple(rates.values()))
    except (NotTabulated, ProblemError, ValueError, RecursionError):  # no real number
        return equations
    return TabulatedEquations(len(equations), partial(tuple, equations), table)


def _rates(equations: Sequence[object], time: sp.Symbol) -> dict[sp.Expr, sp.Expr] | None:
    """The right-hand side by unknown, if each equation gives the rate of another one."""
    rates: dict[sp.Expr, sp.Expr] = {}
    for equation in equations:
        if not isinstance(equation, sp.Eq) or not isinstance(equation.lhs, sp.Derivative):
            return None
        unknown = equation.lhs.expr
        first = isinstance(unknown, AppliedUndef) and equation.lhs == unknown.diff(time)
        if not first or unknown.args != (time,) or unknown in rates:
            return None
        if not isinstance(equation.rhs, sp.Expr):
            return None
        rates[unknown] = equation.rhs
    return rates


class _Reader:
    """Takes expressions apart into sums of products."""

    def __init__(self, places: Mapping[sp.Expr, int], coordinates: set[sp.Basic]) -> None:
        self.places, self.coordinates = places, coordinates
        self.sums = TermSums(len(places))
        self._functions: dict[sp.Expr, sp.Expr] = {}

    def terms(self, expression: sp.Expr) -> TermSum:
        """The terms of an expression."""
        check_time()
        if expression.is_Rational:
            return {(0, ()): Fraction(int(expression.p), int(expression.q))}
        if expression in self.places:
            return {(0, (self.places[expression],)): Fraction(1)}
        if not expression.has(AppliedUndef):
            return self._function(expression)
        if expression.is_Add:
            total: TermSum = {}
            for argument in expression.args:
                added(total, self.terms(argument))
            return total
        if expression.is_Mul:
            return self._product(expression.args)
        if isinstance(expression, sp.exp):
            return self.sums.called("exp", self.terms(expression.exp))
        if expression.is_Pow:
            return self.sums.power(self.terms(expression.base), self.terms(expression.exp))
        name = type(expression).__name__
        if FUNCTIONS.get(name) is type(expression):  # a function of the user may have this name
            return self.sums.called(name, self.terms(expression.args[0]))
        raise NotTabulated

    def _product(self, factors: Sequence[sp.Expr]) -> TermSum:
        """A product, with what is divided by as one divisor."""
        functions = [factor for factor in factors if not factor.has(AppliedUndef)]
        above, below = self.terms(sp.Mul(*functions)), []
        for factor in (factor for factor in factors if factor.has(AppliedUndef)):
            if factor.is_Pow and factor.exp.is_Rational and factor.exp < 0:
                below.append(factor.base**-factor.exp)
            else:
                above = self.sums.product(above, self.terms(factor))
        for divisor in below:
            above = self.sums.quotient(above, self.terms(divisor))
        return above

    def _function(self, expression: sp.Expr) -> TermSum:
        """A function of time and parameters."""
        if expression not in self._functions:
            function = exact(expression)
            real = not function.has(*_NOT_REAL) and function.free_symbols <= self.coordinates
            if not real or not is_smooth(function):
                raise NotTabulated
            self._functions[expression] = function
        return self.sums.function(self._functions[expression])
