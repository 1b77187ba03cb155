"""Equations, in SymPy or as text, read straight into a table of terms where they have one.

Each equation ``Eq(x.diff(t), f)`` is taken apart once. Whatever else equations are, or have, leaves
the problem to the general way, and so does what is wrong with them.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import partial

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.box import Box
from rankone.problem.expressions.notation import exact
from rankone.problem.expressions.parsing import parse_expression, syntax_trees
from rankone.problem.tables.rate_forms import FUNCTIONS, TermSum
from rankone.problem.tables.term_sums import NotTabulated, TermSums, added, without_zeros
from rankone.problem.tables.term_table import (
    FEWEST_TABULATED,
    TabulatedEquations,
    TermTable,
    is_smooth,
)
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
    reader = _ExpressionReader({state: i for i, state in enumerate(rates)}, {time, *box})
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


class _ExpressionReader:
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


# -----------------------------------------------------------------------------
# Right-hand sides as text, read straight into a table of terms where they have one.
#
# An expression of SymPy for each of a thousand right-hand sides takes seconds to build and to take
# apart again. Sums of numbers times functions of time and parameters times products of unknowns
# need none, nor do rate laws of a few forms; whatever else a text has leaves the problem to the
# general way.


_MOST_TERMS = 2000  # Terms of one right-hand side; longer ones are for the general way to judge
_OTHER_NAMES = {"arctan": "atan", "ln": "log"}


def table_of_texts(
    rhs: Mapping[str, object], states: Mapping[str, sp.Expr], coordinates: Mapping[str, sp.Symbol]
) -> TermTable | None:
    """The table of right-hand sides of states; None where the general way has to read them.

    ``coordinates`` are time and the parameters by name.
    """
    reader = _TextReader({name: i for i, name in enumerate(states)}, coordinates)
    texts = tuple(rate for rate in rhs.values() if isinstance(rate, str))
    if len(texts) < len(rhs):
        return None
    try:
        sums = [reader.terms(text) for text in texts]
        return reader.sums.table(tuple(states.values()), sums, texts=texts)
    except (NotTabulated, ProblemError, SyntaxError, ValueError, RecursionError, MemoryError):
        return None


class _TextReader(ast.NodeVisitor):
    """Evaluates texts in sums of products."""

    def __init__(self, places: Mapping[str, int], coordinates: Mapping[str, sp.Symbol]) -> None:
        self.places, self.coordinates = places, coordinates
        self.sums = TermSums(len(places))
        self._source = ""

    def terms(self, text: str) -> TermSum:
        """The terms of a text."""
        check_time()
        total: TermSum = {}
        for self._source, tree in syntax_trees(text):
            added(total, self.visit(tree))
        if len(total) > _MOST_TERMS:
            raise NotTabulated
        return without_zeros(total)

    def generic_visit(self, node: ast.AST) -> TermSum:
        raise NotTabulated

    def visit_Constant(self, node: ast.Constant) -> TermSum:
        if type(node.value) is int:
            return {(0, ()): Fraction(node.value)}
        if type(node.value) is float and self._source.isascii():
            digits = self._source[node.col_offset : node.end_col_offset]
            if abs(node.value) < 1e100 and "e" not in digits.lower():
                return {(0, ()): Fraction(digits.replace("_", ""))}
        return self._read(node)

    def visit_Name(self, node: ast.Name) -> TermSum:
        if node.id in self.places:
            return {(0, (self.places[node.id],)): Fraction(1)}
        if node.id in self.coordinates:
            return self.sums.function(self.coordinates[node.id])
        return self._read(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> TermSum:
        operand: TermSum = self.visit(node.operand)
        if isinstance(node.op, ast.USub):
            return {product: -coefficient for product, coefficient in operand.items()}
        if isinstance(node.op, ast.UAdd):
            return operand
        raise NotTabulated

    def visit_BinOp(self, node: ast.BinOp) -> TermSum:
        if isinstance(node.op, ast.Pow) and not self._has_unknowns(node):
            return self._read(node)
        left, right = self.visit(node.left), self.visit(node.right)
        match node.op:
            case ast.Add():
                return added(left, right)
            case ast.Sub():
                return added(left, right, -1)
            case ast.Mult():
                return self.sums.product(left, right)
            case ast.Div():
                return self.sums.quotient(left, right)
            case ast.Pow():
                return self.sums.power(left, right)
        raise NotTabulated

    def visit_Call(self, node: ast.Call) -> TermSum:
        if not self._has_unknowns(node):
            return self._read(node)
        match node:
            case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]):
                if name not in self.places and name not in self.coordinates:
                    return self.sums.called(_OTHER_NAMES.get(name, name), self.visit(argument))
        raise NotTabulated

    def _has_unknowns(self, node: ast.expr) -> bool:
        return any(isinstance(n, ast.Name) and n.id in self.places for n in ast.walk(node))

    def _read(self, node: ast.expr) -> TermSum:
        """A part of a text as a function of time and parameters."""
        text = ast.get_source_segment(self._source, node) or ast.unparse(node)
        expression = parse_expression(text, self.coordinates, where="formula")
        if not is_smooth(expression):
            raise NotTabulated
        return self.sums.function(expression)
