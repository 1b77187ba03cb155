"""Rates of fields as sums of terms: linear ones, sources, and functions taken entry by entry.

Each term has a scalar coefficient of time and parameters. What a matrix is applied to is multiplied
out, so that every linear term is one sparse matrix, whatever it was nested in.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import TypeAlias

import numpy as np
import scipy.sparse as ss
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.constant_arrays import array_digest
from rankone.problem.expressions.stable import NUMPY, in_floats, stable
from rankone.problem.fields import Apply, Field, Vector
from rankone.support.arrays import MOST_NUMBERS, Array
from rankone.support.errors import SeparationError, quote

Matrix: TypeAlias = "ss.csr_array"
_MOST_PRODUCTS = 64  # Terms of a product of sums that is multiplied out
_HIGHEST_POWER = 3  # Of a sum that is multiplied out
_STATES = (Field, AppliedUndef)


@dataclass(frozen=True, eq=False)
class Linear:
    """A coefficient times a matrix (n, N) times all states."""

    coefficient: sp.Expr
    matrix: Matrix


@dataclass(frozen=True, eq=False)
class Source:
    """A coefficient times a vector (n,)."""

    coefficient: sp.Expr
    vector: Array


@dataclass(frozen=True, eq=False)
class Pointwise:
    """A coefficient times a matrix (n, m) times a function of arguments with m entries."""

    coefficient: sp.Expr
    after: Matrix
    function: sp.Expr


Term = Linear | Source | Pointwise


class FieldTerms:
    """What splits expressions of some states into terms.

    Attributes
    ----------
    arguments : dict of Symbol to matrix or array
        What the symbols in functions stand for: matrices (n, N) times all states, or vectors (n,).
    """

    def __init__(self, places: Mapping[sp.Expr, slice]) -> None:
        self._places = dict(places)
        self._size = sum(rows.stop - rows.start for rows in places.values())
        self.arguments: dict[sp.Symbol, Matrix | Array] = {}
        self._symbols: dict[object, sp.Symbol] = {}
        self._identities: dict[int, Matrix] = {}
        self._products: dict[tuple[int, int], tuple[Matrix, Matrix, Matrix]] = {}
        self._sums: dict[tuple[Apply, int], sp.Expr] = {}

    def of_rate(self, state: sp.Expr, rate: sp.Expr) -> list[Term]:
        """The terms of the rate of a state, with rows for all states."""
        rows = self._places[state]
        n = rows.stop - rows.start
        entries = np.ones(n), (np.arange(rows.start, rows.stop), np.arange(n))
        embedding = ss.csr_array(entries, shape=(self._size, n))
        return [self._mapped(term, embedding) for term in self.of(rate, n)]

    def of(self, expression: sp.Expr, size: int) -> list[Term]:
        """The terms of an expression, which stands for that many entries."""
        terms: list[Term] = []
        for term in sp.Add.make_args(expression):
            products = _products(term)
            split = [each for factors in products for each in self._of_product(factors, size)]
            if len(products) > 1 and self._is_one_function(split, size):
                split = self._of_product(sp.Mul.make_args(term), size)
            terms += split
        return terms

    def function_of(self, expression: sp.Expr) -> sp.Expr:
        """A number of states as a function of arguments: rows times all states."""
        return self._with_arguments(expression, 1)

    def _of_product(self, factors: Sequence[sp.Expr], size: int) -> list[Term]:
        """The terms of a product none of whose factors is a sum that is multiplied out."""
        scalars = [f for f in factors if not f.atoms(*_STATES, Vector, Apply)]
        fixed = [f for f in factors if f not in scalars and _is_fixed(f)]
        moving = [f for f in factors if f not in scalars and f not in fixed]
        number, coefficient = _split_number(sp.Mul(*scalars))
        shape = _numbers(sp.Mul(*fixed)) if fixed else np.ones(1)
        if not moving:
            return [Source(coefficient, np.broadcast_to(float(number) * shape, (size,)))]
        diagonal = self._diagonal(shape, size)
        if len(moving) == 1 and isinstance(moving[0], Field | AppliedUndef | Apply):
            scaled = (
                replace(term, coefficient=number * coefficient * term.coefficient)
                for term in self._of_factor(moving[0], size)
            )
            return [self._mapped(term, diagonal) for term in scaled]
        function = self._with_arguments(sp.Mul(*moving), size)
        return [Pointwise(coefficient, diagonal, number * function)]

    def _of_factor(self, factor: sp.Expr, size: int) -> list[Term]:
        """The terms of a state, or of a matrix times an expression."""
        if not isinstance(factor, Apply):
            return [Linear(sp.S.One, self._selection(factor, size))]
        matrix = _broadcast(factor.operator.matrix, size)
        return [self._mapped(term, matrix) for term in self.of(factor.operand, matrix.shape[1])]

    def _mapped(self, term: Term, factor: Matrix) -> Term:
        """A matrix times a term."""
        if isinstance(term, Linear):
            return replace(term, matrix=self._product(factor, term.matrix))
        if isinstance(term, Pointwise):
            return replace(term, after=self._product(factor, term.after))
        return replace(term, vector=factor @ term.vector)

    def _product(self, left: Matrix, right: Matrix) -> Matrix:
        """The product of two matrices, computed once: a stress enters many terms."""
        if left is self._identities.get(right.shape[0]):
            return right
        if right is self._identities.get(left.shape[1]):
            return left
        key = id(left), id(right)
        if key not in self._products:
            self._products[key] = left, right, ss.csr_array(left @ right)
        return self._products[key][2]

    def _diagonal(self, entries: Array, size: int) -> Matrix:
        """A diagonal matrix; one identity for each size."""
        if size not in self._identities:
            self._identities[size] = ss.csr_array(ss.eye_array(size))
        if (entries == 1.0).all():
            return self._identities[size]
        return ss.csr_array(ss.diags_array(np.broadcast_to(entries, (size,))))

    def _is_one_function(self, terms: Sequence[Term], size: int) -> bool:
        """Whether multiplying out has separated nothing."""
        first = terms[0].coefficient
        return all(
            isinstance(term, Pointwise)
            and term.coefficient == first
            and term.after is self._identities[size]
            for term in terms
        )

    def _selection(self, state: sp.Expr, size: int) -> Matrix:
        """The entries of a state among all, one row for each; those of a scalar are all equal."""
        rows = self._places[state]
        columns = np.arange(rows.start, rows.stop)
        columns = np.broadcast_to(columns, (size,)) if len(columns) == 1 else columns
        entries = np.ones(size), (np.arange(size), columns)
        return ss.csr_array(entries, shape=(size, self._size))

    def _with_arguments(self, expression: sp.Expr, size: int) -> sp.Expr:
        """An expression with symbols for states, for vectors, and for matrices times states."""
        if isinstance(expression, _STATES):
            return self._argument(("state", expression, size), self._selection(expression, size))
        if isinstance(expression, Vector):
            array = np.broadcast_to(expression.array, (size,))
            return self._argument(("vector", expression, size), np.array(array))
        if isinstance(expression, Apply):
            return self._applied(expression, size)
        if not expression.args:
            return expression
        return expression.func(*(self._with_arguments(arg, size) for arg in expression.args))

    def _applied(self, applied: Apply, size: int) -> sp.Expr:
        """A matrix times a linear expression, as a sum of arguments of a function."""
        if (applied, size) in self._sums:
            return self._sums[applied, size]
        total = []
        for term in _merged_linear(self._of_factor(applied, size)):
            if isinstance(term, Pointwise):
                raise SeparationError(
                    f"{quote(applied)} is inside of a function or a product of fields, and what "
                    "the matrix is applied to is not linear",
                    term=applied,
                    remedy="apply matrices inside of functions and products to linear expressions "
                    "alone, or make it an unknown with a rate of its own",
                )
            array = term.matrix if isinstance(term, Linear) else term.vector
            total.append(term.coefficient * self._argument(array_digest(array), array))
        self._sums[applied, size] = sp.Add(*total)
        return self._sums[applied, size]

    def _argument(self, key: object, array: Matrix | Array) -> sp.Symbol:
        """The symbol of a matrix or vector."""
        if key not in self._symbols:
            symbol = sp.Dummy(f"a{len(self._symbols)}", real=True)
            self._symbols[key], self.arguments[symbol] = symbol, array
        return self._symbols[key]


def merged(terms: Iterable[Term]) -> list[Term]:
    """The terms with one of each coefficient, and functions as few as they can be.

    Functions with one coefficient that are multiplied by the same matrix are added. A sum of them
    that enters several times, up to a number, is computed once.
    """
    listed = [_with_plain_coefficient(term) for term in terms]
    digests: dict[int, str] = {}
    by_matrix: dict[object, list[Pointwise]] = {}
    for term in listed:
        if isinstance(term, Pointwise):
            if id(term.after) not in digests:
                digests[id(term.after)] = array_digest(term.after)
            key = term.coefficient, digests[id(term.after)]
            by_matrix.setdefault(key, []).append(term)
    by_function: dict[object, list[Pointwise]] = {}
    for alike in by_matrix.values():
        number, function = _primitive(sp.Add(*(term.function for term in alike)))
        term = Pointwise(alike[0].coefficient, alike[0].after * float(number), function)
        if function != 0:
            same = term.coefficient, function, term.after.shape[1]
            by_function.setdefault(same, []).append(term)
    pointwise = [
        replace(alike[0], after=reduce(operator.add, (term.after for term in alike)))
        for alike in by_function.values()
    ]
    return [*_merged_linear(t for t in listed if not isinstance(t, Pointwise)), *pointwise]


def _primitive(function: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """A number and a function whose product this is; of opposite functions they are the same."""
    number, function = function.primitive()
    if function.could_extract_minus_sign():
        return -number, -function
    return number, function


def _merged_linear(terms: Iterable[Term]) -> list[Term]:
    """Linear terms and sources added where coefficients agree; functions are left alone."""
    sums: dict[tuple[type, sp.Expr], Term] = {}
    rest: list[Term] = []
    for term in terms:
        key = type(term), term.coefficient
        known = sums.get(key)
        if isinstance(term, Pointwise):
            rest.append(term)
        elif isinstance(known, Linear) and isinstance(term, Linear):
            sums[key] = replace(known, matrix=ss.csr_array(known.matrix + term.matrix))
        elif isinstance(known, Source) and isinstance(term, Source):
            sums[key] = replace(known, vector=known.vector + term.vector)
        else:
            sums[key] = term
    return [*(term for term in sums.values() if not _vanishes(term)), *rest]


def _vanishes(term: Term) -> bool:
    if isinstance(term, Pointwise):
        return False
    return not np.any(term.matrix.data if isinstance(term, Linear) else term.vector)


def _with_plain_coefficient(term: Term) -> Term:
    """A term whose coefficient has no number before it."""
    number, coefficient = _split_number(term.coefficient)
    if number == 1:
        return term
    if isinstance(term, Linear):
        return Linear(coefficient, term.matrix * float(number))
    if isinstance(term, Source):
        return Source(coefficient, term.vector * float(number))
    return Pointwise(coefficient, term.after, number * term.function)


def _split_number(coefficient: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """The number before a coefficient, and the rest of it."""
    factors = sp.Mul.make_args(coefficient)
    numbers = [factor for factor in factors if factor.is_number]
    return sp.Mul(*numbers), sp.Mul(*(factor for factor in factors if not factor.is_number))


def _products(expression: sp.Expr) -> list[Sequence[sp.Expr]]:
    """An expression as a sum of products, as far as sums of states are factors in it."""
    if expression.is_Add:
        return [product for term in expression.args for product in _products(term)]
    if not expression.is_Mul and not expression.is_Pow:
        return [(expression,)]
    choices: list[list[Sequence[sp.Expr]]] = []
    for factor in sp.Mul.make_args(expression):
        base, power = factor.as_base_exp()
        if not (base.is_Add and base.atoms(*_STATES, Vector, Apply)):
            choices.append([(factor,)])
        elif power.is_Integer and 1 <= power <= _HIGHEST_POWER:
            choices += [_products(base)] * int(power)
        else:
            choices.append([(factor,)])
    if math.prod(map(len, choices)) > _MOST_PRODUCTS:
        return [sp.Mul.make_args(expression)]
    if all(len(choice) == 1 for choice in choices):
        return [sp.Mul.make_args(expression)]
    products = (sp.Mul(*itertools.chain(*each)) for each in itertools.product(*choices))
    return [sp.Mul.make_args(product) for product in products]


def _is_fixed(factor: sp.Expr) -> bool:
    """Whether a factor has vectors and numbers alone."""
    return all(isinstance(symbol, Vector) for symbol in factor.free_symbols) and not factor.atoms(
        AppliedUndef
    )


def _broadcast(matrix: Matrix, size: int) -> Matrix:
    """A matrix, of one row as many equal rows as asked for."""
    if matrix.shape[0] == size:
        return matrix
    if matrix.nnz * size > MOST_NUMBERS:
        raise SeparationError(
            f"a sum over {matrix.nnz} entries enters each of {size} entries",
            term=matrix,
            remedy="make the sum a scalar unknown that follows it, x' = (sum - x)/tau with a short "
            "time tau, and write x in its place",
        )
    return ss.csr_array(ss.csr_array(np.ones((size, 1))) @ matrix)


def _numbers(expression: sp.Expr) -> Array:
    """The value (n,) of an expression of vectors and numbers."""
    arrays: dict[sp.Symbol, Array] = {}

    def symbol_of(array: Array) -> sp.Symbol:
        symbol = sp.Dummy(real=True)
        arrays[symbol] = array
        return symbol

    def plain(node: sp.Basic) -> sp.Basic:
        if isinstance(node, Vector):
            return symbol_of(node.array)
        if isinstance(node, Apply):
            columns = np.broadcast_to(_numbers(node.operand), (node.operator.shape[1],))
            return symbol_of(node.operator.matrix @ columns)
        return node.func(*map(plain, node.args)) if node.args else node

    formula = in_floats(stable(plain(expression)))
    compiled = sp.lambdify(list(arrays), formula, [NUMPY, "numpy", "scipy"], cse=True)
    return np.asarray(compiled(*arrays.values()), dtype=float)
