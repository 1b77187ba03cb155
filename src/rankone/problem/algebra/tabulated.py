"""Equations and reactions that are read straight into a table of terms where they have one.

Each equation ``Eq(x.diff(t), f)`` is taken apart once. Whatever else equations are, or have, leaves
the problem to the general way, and so does what is wrong with them.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.algebra.matrices import Matrix, array_of, named_unknowns, numbers_of
from rankone.problem.algebra.term_sums import NotTabulated, TermSums, added, without_zeros
from rankone.problem.algebra.term_table import (
    FEWEST_TABULATED,
    FUNCTIONS,
    Entry,
    TabulatedEquations,
    TermSum,
    TermTable,
    fraction_of,
    is_smooth,
    written_rates,
)
from rankone.problem.box import Box
from rankone.problem.equations import MOST_TERMS
from rankone.problem.expressions.notation import exact, expression_of
from rankone.problem.expressions.parsing import parse_expression, syntax_trees
from rankone.support.budget import check_time
from rankone.support.errors import ProblemError, count, quote, shown

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
        if len(total) > MOST_TERMS:
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


# -----------------------------------------------------------------------------
# Networks of reactions: a stoichiometric matrix, and the rate of each reaction.


Powers = tuple[tuple[int, Fraction], ...]
"""Species and their powers."""
_REACTANTS = "reactants"


@dataclass(frozen=True)
class Network:
    """Species that change by reactions: ``x' = stoichiometry @ rates``.

    The rate of a reaction is its law times powers of species, ``orders``, of mass action.
    """

    unknowns: tuple[sp.Expr, ...]
    time: sp.Symbol
    changes: tuple[tuple[int, int, Fraction], ...]
    """Species, reaction and the change of the one by the other."""
    laws: tuple[sp.Expr, ...]
    orders: tuple[Powers, ...]

    @classmethod
    def of(
        cls,
        stoichiometry: object,
        laws: object,
        orders: object,
        time: sp.Symbol,
        names: str | Sequence[str],
    ) -> Network:
        """The network of a matrix and laws; a ProblemError if they do not fit."""
        matrix = _matrix(stoichiometry, "the stoichiometric matrix")
        species, reactions = matrix.shape
        if not species or not reactions:
            raise ProblemError(
                f"the stoichiometric matrix is {species} x {reactions}",
                term=stoichiometry,
                remedy="give a row for each species and a column for each reaction",
            )
        changes = tuple((i, j, fraction_of(entry)) for (i, j), entry in numbers_of(matrix))
        return cls(
            named_unknowns(names, species, time),
            time,
            changes,
            _laws(laws, reactions),
            _orders(orders, matrix),
        )

    @property
    def equations(self) -> Sequence[sp.Basic]:
        """One for each species; of many they are written out when they are read."""
        table, n = self._table(), len(self.unknowns)
        if table is None:
            return self._written()
        if n < FEWEST_TABULATED:
            return written_rates(table, self.time, n)
        return TabulatedEquations(n, partial(written_rates, table, self.time, n), table)

    def _table(self) -> TermTable | None:
        """The terms of all rates; None if laws name species, or powers are no whole numbers."""
        powers = [power for each in self.orders for _, power in each]
        if any(law.atoms(AppliedUndef) for law in self.laws):
            return None
        if not all(power.denominator == 1 and power > 0 for power in powers):
            return None
        functions: dict[sp.Expr, int] = {}
        split = [_number_and_function(law) for law in self.laws]
        places = [functions.setdefault(f, len(functions)) for _, f in split]
        multiplied = [
            tuple(i for i, power in each for _ in range(int(power))) for each in self.orders
        ]
        terms: list[Entry] = [
            (change * split[j][0], i, places[j], multiplied[j])
            for i, j, change in self.changes
            if split[j][0]
        ]
        return TermTable(self.unknowns, tuple(functions), tuple(terms))

    def _written(self) -> list[sp.Eq]:
        """The equations of any laws."""
        rates = [
            sp.Mul(law, *(self.unknowns[i] ** _rational(power) for i, power in each))
            for law, each in zip(self.laws, self.orders, strict=True)
        ]
        terms: list[list[sp.Expr]] = [[] for _ in self.unknowns]
        for i, j, change in self.changes:
            terms[i].append(_rational(change) * rates[j])
        pairs = zip(self.unknowns, terms, strict=True)
        return [sp.Eq(u.diff(self.time), sp.Add(*own), evaluate=False) for u, own in pairs]


def _matrix(written: object, subject: str) -> Matrix:
    """A matrix of numbers, dense or sparse."""
    array = array_of(written, subject)
    if isinstance(array, sp.MatrixBase):
        if array.free_symbols or array.atoms(AppliedUndef):
            raise ProblemError(
                f"{subject} has entries that are no numbers",
                term=written,
                remedy="give numbers, and what depends on parameters in the laws",
            )
        array = np.array(array, dtype=float)
    if len(array.shape) != 2:
        raise ProblemError(
            f"{subject} has the shape {array.shape}",
            term=written,
            remedy="give a row for each species and a column for each reaction",
        )
    return array


def _laws(written: object, reactions: int) -> tuple[sp.Expr, ...]:
    """The law of each reaction as an expression."""
    remedy = f"give {count(reactions, 'law')}, numbers or expressions, one for each reaction"
    if isinstance(written, str | Mapping) or not hasattr(written, "__iter__"):
        raise ProblemError(f"the laws are {shown(written)}", term=written, remedy=remedy)
    laws = [_law(law) for law in written]
    if len(laws) != reactions:
        raise ProblemError(
            f"there are {count(len(laws), 'law')} for {count(reactions, 'reaction')}",
            term=written,
            remedy=remedy,
        )
    return tuple(laws)


def _law(written: object) -> sp.Expr:
    law = expression_of(written)
    if law is None:
        raise ProblemError(
            f"the law {quote(written)} is no number or expression",
            term=written,
            remedy="give an expression of SymPy, such as k*x",
        )
    return exact(law)


def _orders(written: object, matrix: Matrix) -> tuple[Powers, ...]:
    """For each reaction the species that multiply its law, and their powers."""
    species, reactions = matrix.shape
    if written is None:
        return tuple(() for _ in range(reactions))
    remedy = 'give orders="reactants", or a matrix of the shape of the stoichiometric one'
    if isinstance(written, str):
        if written != _REACTANTS:
            raise ProblemError(f"orders are {shown(written)}", term=written, remedy=remedy)
        powers: Any = -scipy.sparse.csr_matrix(matrix)
        powers = powers.maximum(0)
    else:
        powers = _matrix(written, "the matrix of orders")
        if powers.shape != (species, reactions):
            shape = " x ".join(map(str, powers.shape))
            message = f"the matrix of orders is {shape}, not {species} x {reactions}"
            raise ProblemError(message, term=written, remedy=remedy)
    listed: list[list[tuple[int, Fraction]]] = [[] for _ in range(reactions)]
    for (i, j), power in sorted(numbers_of(powers)):
        listed[j].append((i, fraction_of(power)))
    return tuple(map(tuple, listed))


def _number_and_function(law: sp.Expr) -> tuple[Fraction, sp.Expr]:
    """A law as a rational number times a function."""
    coefficient, function = law.as_coeff_Mul()
    if not coefficient.is_Rational:
        return Fraction(1), law
    return Fraction(int(coefficient.p), int(coefficient.q)), function


def _rational(number: Fraction) -> sp.Rational:
    return sp.Rational(number.numerator, number.denominator)
