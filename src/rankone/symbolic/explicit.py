"""From the equations as written to an explicit first-order system u' = f(t, p, u).

Derivatives below the highest of each unknown become states; the equations, linear in the highest
derivatives, are solved for them exactly, without simplification.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.polys.matrices import DomainMatrix
from sympy.polys.matrices.exceptions import DMNonInvertibleMatrixError

from rankone.errors import ProblemError
from rankone.ir import Coordinate, State
from rankone.symbolic.admissible import zero
from rankone.symbolic.equations import highest_orders
from rankone.symbolic.numbers import exact
from rankone.wording import listing, quote

__all__ = ["FirstOrderSystem", "first_order_states", "first_order_system"]

_Row = dict[int, sp.Expr]


@dataclass(frozen=True, slots=True)
class FirstOrderSystem:
    """An explicit first-order system.

    Attributes
    ----------
    states : tuple of State
        The unknowns, then the derivatives that became states.
    rhs : tuple of Expr
        For each state the right-hand side of its derivative, in the states' ``expression``.
    equations : tuple of (int or None)
        For each state the number, from 1, of the user's equation that was solved for its
        derivative; None if several equations were solved together.
    """

    states: tuple[State, ...]
    rhs: tuple[sp.Expr, ...]
    equations: tuple[int | None, ...]


def first_order_states(
    residuals: Sequence[sp.Expr], unknowns: Sequence[sp.Expr], time: sp.Symbol
) -> tuple[State, ...]:
    """Return the unknowns as states, then their derivatives below the highest, by order."""
    highest = highest_orders(residuals)
    return tuple(
        State(
            name=unknown.func.__name__ + ("_" + "t" * order if order else ""),
            expression=unknown.diff(time, order) if order else unknown,
            unknown=i,
            order=order,
        )
        for order in range(max(highest.values()))
        for i, unknown in enumerate(unknowns)
        if order < highest[unknown]
    )


def first_order_system(
    residuals: Sequence[sp.Expr], unknowns: Sequence[sp.Expr], coordinates: Sequence[Coordinate]
) -> FirstOrderSystem:
    """Solve the equations for the highest derivatives.

    Parameters
    ----------
    residuals : sequence of Expr
        One for each unknown, linear in the highest derivatives: M(t, p, u) v + rest = 0.
    unknowns : sequence of Expr
        Applied functions of time, in the order of the result.
    coordinates : sequence of Coordinate
        Time and the parameters; a mass that vanishes on its interval is an error.

    Raises
    ------
    ProblemError
        If an equation is not linear in the highest derivatives, or their matrix M is singular.
    """
    time = coordinates[0].symbol
    highest = highest_orders(residuals)
    leading = [unknown.diff(time, highest[unknown]) for unknown in unknowns]
    rows, rests = [], []
    for number, residual in enumerate(residuals, 1):
        row, rest = _linear_in(leading, residual, number)
        _check_mass(row, leading, coordinates, number)
        rows.append(row)
        rests.append(rest)
    solved, origins = _solve(rows, rests, leading)
    states = first_order_states(residuals, unknowns, time)
    rhs = tuple(
        solved[state.unknown]
        if state.order + 1 == highest[unknowns[state.unknown]]
        else state.expression.diff(time)
        for state in states
    )
    return FirstOrderSystem(states, rhs, tuple(origins[state.unknown] for state in states))


def _linear_in(
    leading: Sequence[sp.Expr], residual: sp.Expr, number: int
) -> tuple[_Row, list[sp.Expr]]:
    """Split a residual into a row of the mass matrix and the terms of the rest."""
    stand_in = {v: sp.Symbol(f"v_{i}") for i, v in enumerate(leading)}
    absent = dict.fromkeys(stand_in.values(), sp.S.Zero)
    back = {symbol: v for v, symbol in stand_in.items()}
    row: _Row = {}
    rest: list[sp.Expr] = []
    for term in sp.Add.make_args(residual):
        replaced = term.xreplace(stand_in)
        symbols = replaced.free_symbols
        present = [i for i, v in enumerate(leading) if stand_in[v] in symbols]
        if not present:
            rest.append(term)
            continue
        for i in present:
            slope = sp.diff(replaced, stand_in[leading[i]])
            if not slope.free_symbols.isdisjoint(back):
                slope = sp.expand(slope)
            if not slope.free_symbols.isdisjoint(back):
                raise ProblemError(
                    f"term {quote(term)} is not linear in {listing(leading[j] for j in present)}",
                    equation=number,
                    term=term,
                    remedy="solve the equation for the derivative by hand",
                )
            row[i] = row.get(i, sp.S.Zero) + slope
        constant = replaced.xreplace(absent)
        rest.extend(a for a in sp.Add.make_args(constant) if a != 0)
    return {i: entry for i, entry in sorted(row.items()) if entry != 0}, rest


def _check_mass(
    row: _Row, leading: Sequence[sp.Expr], coordinates: Sequence[Coordinate], number: int
) -> None:
    """Raise if a row of the mass matrix is empty, or its one entry vanishes somewhere."""
    if not row:
        raise ProblemError(
            "the mass matrix is singular: this equation has no highest derivative "
            f"(of {listing(leading)})",
            equation=number,
            remedy="differential-algebraic systems are not supported; eliminate the unknown",
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
                    equation=number,
                    term=mass,
                    remedy="change the interval so that the coefficient keeps its sign",
                )


def _solve(
    rows: Sequence[_Row], rests: Sequence[list[sp.Expr]], leading: Sequence[sp.Expr]
) -> tuple[list[sp.Expr], list[int | None]]:
    """Solve M v + rest = 0 for v; return also which equation gave which component."""
    place = {next(iter(row)): number for number, row in enumerate(rows)}
    if len(place) == len(rows) and all(len(row) == 1 for row in rows):
        order = [place[i] for i in range(len(leading))]
        quotients = [[_divide(-term, rows[e][i]) for term in rests[e]] for i, e in enumerate(order)]
        return [sp.Add(*terms) for terms in quotients], [e + 1 for e in order]
    inverse = _inverse(rows, leading)
    solved = [
        sp.Add(
            *[
                sp.Mul(-entry, term)
                for entry, rest in zip(inverse.row(i), rests, strict=True)
                if entry != 0
                for term in rest
            ]
        )
        for i in range(len(leading))
    ]
    return solved, [None] * len(leading)


def _divide(term: sp.Expr, mass: sp.Expr) -> sp.Expr:
    if mass is sp.S.One:
        return term
    return exact(term) / exact(mass) if mass.is_number else term / mass


def _inverse(rows: Sequence[_Row], leading: Sequence[sp.Expr]) -> sp.Matrix:
    """Invert the mass matrix in the field of its entries, which cancels common factors."""
    n = len(rows)
    matrix = sp.Matrix(n, n, lambda i, j: exact(rows[i].get(j, sp.S.Zero)))
    try:
        return DomainMatrix.from_Matrix(matrix).to_field().inv().to_Matrix()
    except DMNonInvertibleMatrixError:
        raise ProblemError(
            f"the mass matrix of {listing(leading)} is singular: {matrix.tolist()}",
            term=matrix,
            remedy="the equations determine these derivatives only in some combination; "
            "give one independent equation for each",
        ) from None
