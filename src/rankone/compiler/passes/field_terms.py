"""Rates of fields as sums of terms: linear ones, sources, and functions taken entry by entry.

Each term has a scalar coefficient of time and parameters. What a matrix is applied to is multiplied
out, so that every linear term is one sparse matrix, whatever it was nested in.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import TypeAlias

import numpy as np
import scipy.sparse as ss
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.expressions.stable import NUMPY, in_floats, stable
from rankone.problem.fields import Apply, Field, Vector, array_digest
from rankone.support.arrays import Array
from rankone.support.errors import SeparationError, quote

Matrix: TypeAlias = "ss.csr_array"
_MOST_PRODUCTS = 64  # Terms of a product of sums that is multiplied out
_HIGHEST_POWER = 3  # Of a sum that is multiplied out
_MOST_REPEATED = 20_000_000  # Numbers of equal rows: 240 MB
_STATES = (Field, AppliedUndef)


@dataclass(frozen=True, eq=False)
class Linear:
    """A coefficient times a matrix (n, N) times all states."""

    coefficient: sp.Expr
    matrix: Matrix

    def mapped(self, factor: Matrix) -> Linear:
        """A matrix times the term."""
        return replace(self, matrix=ss.csr_array(factor @ self.matrix))


@dataclass(frozen=True, eq=False)
class Source:
    """A coefficient times a vector (n,)."""

    coefficient: sp.Expr
    vector: Array

    def mapped(self, factor: Matrix) -> Source:
        """A matrix times the term."""
        return replace(self, vector=factor @ self.vector)


@dataclass(frozen=True, eq=False)
class Pointwise:
    """A coefficient times a matrix (n, m) times a function of arguments with m entries."""

    coefficient: sp.Expr
    after: Matrix
    function: sp.Expr

    def mapped(self, factor: Matrix) -> Pointwise:
        """A matrix times the term."""
        return replace(self, after=ss.csr_array(factor @ self.after))


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

    def of(self, expression: sp.Expr, size: int) -> list[Term]:
        """The terms of an expression, which stands for that many entries."""
        terms: list[Term] = []
        for term in sp.Add.make_args(expression):
            products = _products(term)
            split = [each for factors in products for each in self._of_product(factors, size)]
            if len(products) > 1 and _is_one_function(split):
                split = self._of_product(sp.Mul.make_args(term), size)
            terms += split
        return terms

    def _of_product(self, factors: Sequence[sp.Expr], size: int) -> list[Term]:
        """The terms of a product none of whose factors is a sum that is multiplied out."""
        scalars = [f for f in factors if not f.atoms(*_STATES, Vector, Apply)]
        fixed = [f for f in factors if f not in scalars and _is_fixed(f)]
        moving = [f for f in factors if f not in scalars and f not in fixed]
        number, coefficient = sp.Mul(*scalars).as_coeff_Mul()
        scale = float(number) * (_numbers(sp.Mul(*fixed)) if fixed else 1.0)
        weights = np.broadcast_to(scale, (size,))
        diagonal = ss.csr_array(ss.diags_array(weights))
        if not moving:
            return [Source(coefficient, np.array(weights, dtype=float))]
        if len(moving) == 1 and isinstance(moving[0], Field | AppliedUndef | Apply):
            return [
                replace(term, coefficient=coefficient * term.coefficient).mapped(diagonal)
                for term in self._of_factor(moving[0], size)
            ]
        function = self._with_arguments(sp.Mul(*moving), size)
        more, function = function.as_coeff_Mul()
        return [Pointwise(coefficient, diagonal * float(more), function)]

    def _of_factor(self, factor: sp.Expr, size: int) -> list[Term]:
        """The terms of a state, or of a matrix times an expression."""
        if not isinstance(factor, Apply):
            return [Linear(sp.S.One, self._selection(factor, size))]
        matrix = _broadcast(factor.operator.matrix, size)
        return [term.mapped(matrix) for term in self.of(factor.operand, matrix.shape[1])]

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
        return sp.Add(*total)

    def _argument(self, key: object, array: Matrix | Array) -> sp.Symbol:
        """The symbol of a matrix or vector."""
        if key not in self._symbols:
            symbol = sp.Dummy(f"a{len(self._symbols)}", real=True)
            self._symbols[key], self.arguments[symbol] = symbol, array
        return self._symbols[key]


def merged(terms: Iterable[Term]) -> list[Term]:
    """The terms with one of each coefficient, and functions as few as they can be.

    A function that enters several fields is computed once, and functions with one coefficient that
    are multiplied by the same matrix are added.
    """
    listed = [_with_plain_coefficient(term) for term in terms]
    functions: dict[object, list[Pointwise]] = {}
    for term in listed:
        if isinstance(term, Pointwise):
            key = term.coefficient, term.function, term.after.shape[1]
            functions.setdefault(key, []).append(term)
    matrices: dict[object, list[Pointwise]] = {}
    for alike in functions.values():
        after = reduce(lambda one, other: one + other, (term.after for term in alike))
        after = ss.csr_array(after)
        after.eliminate_zeros()
        if after.nnz:
            scale = float(after.data[0])
            after = after / scale
            term = Pointwise(alike[0].coefficient, after, _number(scale) * alike[0].function)
            matrices.setdefault((term.coefficient, array_digest(after)), []).append(term)
    pointwise = [
        replace(alike[0], function=sp.Add(*(term.function for term in alike)))
        for alike in matrices.values()
    ]
    return [*_merged_linear(t for t in listed if not isinstance(t, Pointwise)), *pointwise]


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
    number, coefficient = term.coefficient.as_coeff_Mul()
    if number == 1:
        return term
    if isinstance(term, Linear):
        return Linear(coefficient, term.matrix * float(number))
    if isinstance(term, Source):
        return Source(coefficient, term.vector * float(number))
    return Pointwise(coefficient, term.after * float(number), term.function)


def _number(scale: float) -> sp.Expr:
    """A number as an exact fraction, as the printer needs it."""
    return sp.Integer(int(scale)) if scale.is_integer() else sp.Rational(repr(scale))


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


def _is_one_function(terms: Sequence[Term]) -> bool:
    """Whether multiplying out has separated nothing."""
    first = terms[0].coefficient
    return all(isinstance(t, Pointwise) and t.coefficient == first for t in terms)


def _is_fixed(factor: sp.Expr) -> bool:
    """Whether a factor has vectors and numbers alone."""
    return all(isinstance(symbol, Vector) for symbol in factor.free_symbols) and not factor.atoms(
        AppliedUndef
    )


def _broadcast(matrix: Matrix, size: int) -> Matrix:
    """A matrix, of one row as many equal rows as asked for."""
    if matrix.shape[0] == size:
        return matrix
    if matrix.nnz * size > _MOST_REPEATED:
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
