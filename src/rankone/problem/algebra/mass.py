"""The mass matrix, and elimination of quantities from equations that are linear in them.

A problem is held as ``M(t, p, u) v + r(t, p, u) = 0``, v the highest derivatives of its unknowns.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.polys.matrices import DomainMatrix

from rankone.problem.equations import highest_orders
from rankone.problem.expressions.admissible import zero
from rankone.problem.expressions.conditions import rate_of
from rankone.problem.expressions.notation import exact
from rankone.problem.forms import Coordinate
from rankone.support.arrays import EXACT_DIGITS, SEED
from rankone.support.errors import ProblemError, listing, quote

Row = dict[int, sp.Expr]
"""The entries of a row of the mass matrix that are not zero, by column."""


@dataclass(frozen=True)
class MassForm:
    """Equations linear in the highest derivatives, in the user's order.

    ``leading`` has the highest derivative of each unknown. Each equation has a row of the mass
    matrix, by the position in ``leading``, and a remainder: its terms without those derivatives.
    ``origins`` are the numbers of the user's equations, where the rows are not those themselves.
    """

    leading: tuple[sp.Expr, ...]
    rows: tuple[Row, ...]
    remainders: tuple[list[sp.Expr], ...]
    origins: tuple[int | None, ...] | None = None

    @cached_property
    def places(self) -> dict[int, int] | None:
        """For each unknown the equation that has its derivative alone; None if any has several."""
        places = {next(iter(row)): equation for equation, row in enumerate(self.rows)}
        diagonal = len(places) == len(self.rows) and all(len(row) == 1 for row in self.rows)
        return places if diagonal else None

    @cached_property
    def matrix(self) -> DomainMatrix:
        """The mass matrix over the field of its entries, which cancels common factors."""
        n = len(self.rows)
        entries = sp.Matrix(n, n, lambda i, j: exact(self.rows[i].get(j, sp.S.Zero)))
        return DomainMatrix.from_Matrix(entries).to_field()

    def solved(self) -> tuple[list[sp.Expr], list[int | None]]:
        """Solve M v + r = 0 for v; return also which equation gave which component.

        Equations are counted from 1; where several were solved together there is None.
        """
        unknowns = range(len(self.leading))
        if self.places is not None:
            order = [self.places[i] for i in unknowns]
            quotients = [
                [_divide(-term, self.rows[e][i]) for term in self.remainders[e]]
                for i, e in enumerate(order)
            ]
            origins = self.origins or range(1, 1 + len(order))
            return [sp.Add(*terms) for terms in quotients], [origins[e] for e in order]
        inverse = self.matrix.inv().to_Matrix()
        solved = []
        for i in unknowns:
            pairs = zip(inverse.row(i), self.remainders, strict=True)
            solved.append(sp.Add(*[sp.Mul(-a, term) for a, r in pairs if a != 0 for term in r]))
        return solved, [None for _ in unknowns]

    def rates_of(
        self, states: Iterable[sp.Expr], time: sp.Symbol
    ) -> tuple[list[sp.Expr], list[int | None]]:
        """The rates that the equations give to states, zero for the others, and their equations."""
        highest = dict(zip(self.leading, zip(*self.solved(), strict=True), strict=True))
        pairs = [highest.get(rate_of(state, time), (sp.S.Zero, None)) for state in states]
        return [rate for rate, _ in pairs], [origin for _, origin in pairs]


def _divide(term: sp.Expr, mass: sp.Expr) -> sp.Expr:
    if mass is sp.S.One:
        return term
    return exact(term) / exact(mass) if mass.is_number else term / mass


def check_mass(
    residuals: Sequence[sp.Expr], unknowns: Sequence[sp.Expr], coordinates: Sequence[Coordinate]
) -> MassForm:
    """Split the residuals, one for each unknown, into mass matrix and remainder.

    Equations have to be linear in the highest derivatives with a regular matrix; a single mass must
    not vanish on the interval of its coordinate.
    """
    leading = leading_derivatives(residuals, unknowns, coordinates[0].symbol)
    places = {v: i for i, v in enumerate(leading)}
    rows, remainders = [], []
    for i, residual in enumerate(residuals, 1):
        row, remainder = linear_in(places, residual, i)
        _check_row(row, leading, coordinates, i)
        rows.append(row)
        remainders.append(remainder)
    form = MassForm(leading, tuple(rows), tuple(remainders))
    if form.places is None and form.matrix.rank() < len(rows):
        matrix = form.matrix.to_Matrix()
        raise ProblemError(
            f"the mass matrix of {listing(leading)} is singular: {matrix.tolist()}",
            term=matrix,
            remedy="the equations determine these derivatives only in some combination; "
            "give one independent equation for each",
        )
    return form


def leading_derivatives(
    residuals: Sequence[sp.Expr], unknowns: Sequence[sp.Expr], time: sp.Symbol
) -> tuple[sp.Expr, ...]:
    """The highest derivative of each unknown; itself where it has none."""
    highest = highest_orders(residuals)
    return tuple(rate_of(u, time, highest[u]) if u in highest else u for u in unknowns)


def linear_in(
    places: Mapping[sp.Expr, int], residual: sp.Expr, equation: int | None
) -> tuple[Row, list[sp.Expr]]:
    """Split a residual into a row of the mass matrix and the remaining terms.

    ``places`` are those of the highest derivatives in a row.
    """
    applied = residual.atoms(sp.Derivative, AppliedUndef)
    leading = {places[v]: v for v in applied if v in places}
    symbol_of = {i: sp.Symbol(f"v_{i}") for i in sorted(leading)}
    stand_in = {leading[i]: symbol for i, symbol in symbol_of.items()}
    absent = dict.fromkeys(symbol_of.values(), sp.S.Zero)
    row: Row = {}
    remainder: list[sp.Expr] = []
    for term in sp.Add.make_args(residual):
        replaced = term.xreplace(stand_in)
        symbols = replaced.free_symbols
        present = [i for i, symbol in symbol_of.items() if symbol in symbols]
        if not present:
            remainder.append(term)
            continue
        for i in present:
            slope = sp.diff(replaced, symbol_of[i])
            if not slope.free_symbols.isdisjoint(absent):
                slope = sp.expand(slope)
            if not slope.free_symbols.isdisjoint(absent):
                raise ProblemError(
                    f"term {quote(term)} is not linear in {listing(leading[j] for j in present)}",
                    equation=equation,
                    term=term,
                    remedy="solve the equation for the derivative by hand",
                )
            row[i] = row.get(i, sp.S.Zero) + slope
        constant = replaced.xreplace(absent)
        remainder.extend(a for a in sp.Add.make_args(constant) if a != 0)
    return {i: entry for i, entry in sorted(row.items()) if entry != 0}, remainder


def _check_row(
    row: Row, leading: Sequence[sp.Expr], coordinates: Sequence[Coordinate], equation: int
) -> None:
    """Raise if a row of the mass matrix is empty, or its one entry vanishes somewhere."""
    if not row:
        raise ProblemError(
            "the mass matrix is singular: this equation has no highest derivative "
            f"(of {listing(leading)})",
            equation=equation,
            remedy="give one independent equation for each unknown",
        )
    for i, entry in row.items():
        if entry.has(sp.DiracDelta):
            raise ProblemError(
                f"an impulse, {quote(entry)}, is in front of {quote(leading[i])}",
                equation=equation,
                term=entry,
                remedy="an impulse adds to a rate: Eq(x.diff(t), f + dose*DiracDelta(t - 8))",
            )
    if len(row) > 1:
        return
    ((i, mass),) = row.items()
    for c in coordinates:
        if mass.free_symbols == {c.symbol} and not mass.has(AppliedUndef):
            point = zero(mass, c)
            if point is not None:
                raise ProblemError(
                    f"the mass matrix is singular: the coefficient {quote(mass)} of "
                    f"{quote(leading[i])} vanishes at {c.name} = {point:.6g}, "
                    f"inside [{c.lower:g}, {c.upper:g}]",
                    equation=equation,
                    term=mass,
                    remedy="change the interval so that the coefficient keeps its sign",
                )


# -----------------------------------------------------------------------------
# Elimination of quantities from equations that are linear in them, with what is left over.
#
# Pivots that cannot vanish in the box are taken first. What remains, such as the coefficients of
# the multipliers of a mechanism, is inverted as a whole. A row without any of the quantities is
# left over where the equations do not determine them all: a constraint on what they depend on.


_VANISHING = 10.0 ** (2 - EXACT_DIGITS)  # Relative size of a value that counts as zero
_TRIALS = 2  # Points at which an expression that vanishes has to be zero
_LARGEST_ADJUGATE = 3  # Rows of a matrix that is inverted by cofactors, as people do


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
    generator = random.Random(SEED + trial)
    intervals = {c.symbol: (sp.Rational(c.lower), sp.Rational(c.upper)) for c in coordinates}
    drawn: dict[sp.Expr, sp.Expr] = {}

    def at(expression: sp.Expr) -> sp.Expr:
        leaves = expression.atoms(sp.Symbol, sp.Derivative, AppliedUndef) - {*drawn}
        for leaf in sorted(leaves, key=sp.default_sort_key):
            share = sp.Rational(generator.randint(1, 999), 1000)
            lower, upper = intervals.get(leaf, (sp.Rational(1, 2), sp.Rational(3, 2)))
            drawn[leaf] = lower + share * (upper - lower)
        return sp.N(expression.xreplace(drawn), EXACT_DIGITS + 10)

    return at


def _inverse(matrix: sp.Matrix) -> Callable[[sp.Matrix], Sequence[sp.Expr]]:
    """What multiplies a column with the inverse of a regular matrix."""
    if matrix.rows <= _LARGEST_ADJUGATE:
        cofactors, determinant = matrix.adjugate(), matrix.det(method="berkowitz")
        return lambda column: [entry / determinant for entry in cofactors * column]
    inverse = DomainMatrix.from_Matrix(matrix).to_field().inv().to_Matrix()
    return lambda column: list(inverse * column)
