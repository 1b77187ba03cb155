"""The mass matrix: equations are linear in the highest derivatives, and determine them.

A problem is held as ``M(t, p, u) v + r(t, p, u) = 0``, v the highest derivatives of its unknowns.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.polys.matrices import DomainMatrix

from rankone.problem.equations import highest_orders
from rankone.problem.expressions.admissible import zero
from rankone.problem.expressions.derivatives import rate_of
from rankone.problem.expressions.notation import exact
from rankone.problem.forms import Coordinate
from rankone.support.errors import ProblemError
from rankone.support.wording import listing, quote

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
