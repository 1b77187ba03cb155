"""Elimination of quantities from equations that are linear in them, with what is left over.

Pivots that cannot vanish in the box are taken first. What remains, such as the coefficients of the
multipliers of a mechanism, is inverted as a whole. A row without any of the quantities is left over
where the equations do not determine them all: it is a constraint on what they depend on.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.polys.matrices import DomainMatrix

from rankone.problem.algebra.mass import Row
from rankone.problem.expressions.admissible import zero
from rankone.problem.forms import Coordinate

_DIGITS = 30  # Of the values that tell whether an expression vanishes
_VANISHING = 1e-18  # Relative size of a value that counts as zero
_TRIALS = 2  # Points at which an expression that vanishes has to be zero
_LARGEST_ADJUGATE = 3  # Rows of a matrix that is inverted by cofactors, as people do
_SEED = 1988  # Of those points: the same equations are always judged alike


@dataclass(frozen=True)
class LinearRow:
    """``sum(entries[k] * quantity_k) + rest = 0``."""

    entries: Row
    rest: sp.Expr


@dataclass(frozen=True)
class Eliminated:
    """The quantities solved for, or the rows that are left over.

    ``solutions`` has an expression for each quantity, empty where there are ``constraints``: rows
    by their positions, and what has to vanish in their place. ``alone`` are the positions of rows
    that gave a quantity by themselves, by quantity.
    """

    solutions: tuple[sp.Expr, ...]
    constraints: Mapping[int, sp.Expr]
    alone: Mapping[int, int]


class Elimination:
    """Solves rows that are linear in as many quantities, over the box of some coordinates."""

    def __init__(self, coordinates: Sequence[Coordinate]) -> None:
        self.coordinates = {c.symbol: c for c in coordinates}

    def __call__(self, rows: Sequence[LinearRow]) -> Eliminated:
        """Eliminate all quantities, as many as there are rows."""
        n = len(rows)
        entries, rests = [dict(row.entries) for row in rows], [row.rest for row in rows]
        pivots: list[tuple[int, int]] = []
        waiting, columns = [*range(n)], [*range(n)]
        while (pivot := self._pivot(entries, waiting, columns)) is not None:
            p, c = pivot
            pivots.append(pivot)
            waiting.remove(p)
            columns.remove(c)
            for r in waiting:
                if c in entries[r]:
                    share = _without_nesting(entries[r].pop(c) / entries[p][c])
                    entries[r] = self._reduced(entries[r], entries[p], share, columns)
                    rests[r] = rests[r] - share * rests[p]
        constraints = {r: rests[r] for r in waiting if not set(entries[r]) & set(columns)}
        core = [[entries[r].get(k, sp.S.Zero) for k in columns] for r in waiting]
        if not constraints and core:
            constraints = self._combinations(core, waiting, rests)
        if constraints:
            return Eliminated((), constraints, {})
        solved: dict[int, sp.Expr] = {}
        if core:
            inverse = _inverse(sp.Matrix(core))
            column = sp.Matrix([-rests[r] for r in waiting])
            solved |= dict(zip(columns, inverse(column), strict=True))
        alone = {c: p for p, c in pivots if rows[p].entries.keys() == {c}}
        for p, c in reversed(pivots):
            others = [entries[p][k] * solved[k] for k in entries[p] if k != c and k in solved]
            solved[c] = sp.Add(*(-term / entries[p][c] for term in (rests[p], *others)))
        return Eliminated(tuple(solved[c] for c in range(n)), {}, alone)

    def _reduced(self, row: Row, pivot: Row, share: sp.Expr, columns: Sequence[int]) -> Row:
        """A row minus a share of the pivot's, without entries that vanish."""
        reduced = dict(row)
        for k in columns:
            if k in pivot:
                reduced[k] = reduced.get(k, sp.S.Zero) - share * pivot[k]
        return {k: _without_nesting(e) for k, e in reduced.items() if not self.vanishes(e)}

    def _pivot(
        self, entries: Sequence[Row], waiting: Sequence[int], columns: Sequence[int]
    ) -> tuple[int, int] | None:
        """The entry that cannot vanish and fills in the least, as (row, column)."""
        best, least = None, 0
        counts = {c: sum(c in entries[r] for r in waiting) for c in columns}
        for r in waiting:
            present = [c for c in columns if c in entries[r]]
            for c in present:
                filled = (len(present) - 1) * (counts[c] - 1)
                if (best is None or filled < least) and self.sign(entries[r][c]) is not None:
                    best, least = (r, c), filled
        return best

    def sign(self, expression: sp.Expr) -> int | None:
        """The sign of an expression all over the box; None if it may vanish."""
        if expression.is_number:
            sign = sp.sign(expression)
            return int(sign) if sign in (-1, 1) else None
        if expression.is_Symbol:
            coordinate = self.coordinates[expression]
            return 1 if coordinate.lower > 0 else -1 if coordinate.upper < 0 else None
        if isinstance(expression, sp.exp | sp.cosh):
            return 1
        signs = [self.sign(arg) for arg in expression.args if not expression.is_Pow]
        if expression.is_Pow:
            sign = self.sign(expression.base)
            if sign == -1 and expression.exp.is_Integer:
                return 1 if expression.exp % 2 == 0 else -1
            return 1 if sign == 1 else None
        if expression.is_Mul and None not in signs:
            return int(np.prod([sign for sign in signs if sign is not None]))
        if expression.is_Add and len(set(signs)) == 1 and signs[0] is not None:
            return signs[0]
        free = expression.free_symbols
        if len(free) != 1 or expression.has(AppliedUndef):
            return None
        coordinate = self.coordinates[next(iter(free))]
        if zero(expression, coordinate) is not None:
            return None
        middle = sp.Rational(coordinate.lower + coordinate.upper) / 2
        sign = sp.sign(sp.N(expression.xreplace({coordinate.symbol: middle})))
        return int(sign) if sign in (-1, 1) else None

    def vanishes(self, expression: sp.Expr) -> bool:
        """Whether an expression is zero everywhere, judged by its values at random points."""
        if expression.is_number:
            return bool(expression == 0)
        if not expression.is_Add:
            return False
        for trial in range(_TRIALS):
            at = evaluation([*self.coordinates.values()], trial)
            terms = [at(term) for term in expression.args]
            if not all(term.is_number for term in terms):
                return False
            if abs(sp.Add(*terms)) > _VANISHING * max(map(abs, terms)):
                return False
        return True

    def _combinations(
        self, core: list[list[sp.Expr]], waiting: Sequence[int], rests: Sequence[sp.Expr]
    ) -> dict[int, sp.Expr]:
        """The constraints hidden in a singular matrix: combinations of its rows that vanish."""
        at = evaluation([*self.coordinates.values()], 0)
        numbers = [[at(entry) for entry in row] for row in core]
        if not all(entry.is_number for row in numbers for entry in row):
            return {}
        matrix = np.array(numbers, dtype=complex)
        size = np.abs(matrix).max(axis=1, keepdims=True)
        if np.linalg.matrix_rank(matrix / np.where(size > 0.0, size, 1.0), tol=1e-10) == len(core):
            return {}
        field = DomainMatrix.from_Matrix(sp.Matrix(core)).to_field()
        combinations = field.transpose().nullspace().to_Matrix()
        constraints: dict[int, sp.Expr] = {}
        for i in range(combinations.rows):
            row = dict(zip(waiting, combinations.row(i), strict=True))
            last = max(r for r, weight in row.items() if weight != 0 and r not in constraints)
            terms = (weight / row[last] * rests[r] for r, weight in row.items())
            constraints[last] = sp.Add(*terms)
        return constraints


def _without_nesting(entry: sp.Expr) -> sp.Expr:
    """An entry of parameters alone as one fraction: fractions of fractions would pile up."""
    if entry.has(AppliedUndef) or not entry.free_symbols:
        return entry
    return sp.cancel(entry) if entry.is_rational_function(*entry.free_symbols) else entry


def evaluation(coordinates: Sequence[Coordinate], trial: int) -> Callable[[sp.Expr], sp.Expr]:
    """What gives the value of expressions at a point of the box and of the states.

    Each trial has a point of its own; a value is not a number where a function has none.
    """
    generator = random.Random(_SEED + trial)
    intervals = {c.symbol: (sp.Rational(c.lower), sp.Rational(c.upper)) for c in coordinates}
    drawn: dict[sp.Expr, sp.Expr] = {}

    def at(expression: sp.Expr) -> sp.Expr:
        leaves = expression.atoms(sp.Symbol, sp.Derivative, AppliedUndef) - {*drawn}
        for leaf in sorted(leaves, key=sp.default_sort_key):
            share = sp.Rational(generator.randint(1, 999), 1000)
            lower, upper = intervals.get(leaf, (sp.Rational(1, 2), sp.Rational(3, 2)))
            drawn[leaf] = lower + share * (upper - lower)
        return sp.N(expression.xreplace(drawn), _DIGITS)

    return at


def _inverse(matrix: sp.Matrix) -> Callable[[sp.Matrix], Sequence[sp.Expr]]:
    """What multiplies a column with the inverse of a regular matrix."""
    if matrix.rows <= _LARGEST_ADJUGATE:
        cofactors, determinant = matrix.adjugate(), matrix.det(method="berkowitz")
        return lambda column: [entry / determinant for entry in cofactors * column]
    inverse = DomainMatrix.from_Matrix(matrix).to_field().inv().to_Matrix()
    return lambda column: list(inverse * column)
