"""The separated form: frozen data between the symbolic front end and code generation.

A parametric system ``u' = f(t, p, u)`` is held as the residual ``u' - f`` in separated terms

    coefficient x  a_0(t) a_1(p_1) ... a_d(p_d)  x  monomial in the states  x  test function,

so that every integral of the weak form over the (d + 1)-dimensional box is a product of
one-dimensional integrals. No algorithms live here, and SymPy is only named for the types.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import sympy as sp

__all__ = ["Coordinate", "Factor", "SeparatedForm", "State", "Term"]


@dataclass(frozen=True, slots=True)
class Coordinate:
    """One dimension of the box: time (always the first) or a parameter."""

    name: str
    symbol: sp.Symbol
    lower: float
    upper: float


@dataclass(frozen=True, slots=True)
class State:
    """One scalar function of time in the first-order system.

    ``name`` is the unknown's name, with ``_t`` appended once per time derivative;
    ``expression`` is the applied function or its derivative as the user would write it;
    ``unknown`` is the position of the unknown it belongs to and ``order`` its derivative order.
    """

    name: str
    expression: sp.Expr
    unknown: int
    order: int = 0


@dataclass(frozen=True, slots=True)
class Factor:
    """A function of one coordinate; factor 0 of every dimension is the constant one."""

    dimension: int
    expression: sp.Expr


@dataclass(frozen=True, slots=True)
class Term:
    """One separated term of the residual, or of an initial condition.

    Attributes
    ----------
    equation : int
        Index of the state whose equation (or initial value) the term belongs to.
    coefficient : float
        Number in front.
    factors : tuple of int
        For each dimension the index into ``SeparatedForm.factors[dimension]``; 0 is "one".
    monomial : tuple of int
        Indices of the states multiplied, ascending, repeated for powers; empty for a constant.
    derivative : int
        Order of d/dt on the monomial: 1 for the terms u', 0 for all others.
    """

    equation: int
    coefficient: float
    factors: tuple[int, ...]
    monomial: tuple[int, ...] = ()
    derivative: int = 0


@dataclass(frozen=True, slots=True, repr=False)
class SeparatedForm:
    """A parametric first-order system as a sum of separated terms.

    Attributes
    ----------
    coordinates : tuple of Coordinate
        Time first, then the parameters in the order the user gave.
    states : tuple of State
        The unknowns in the user's order, then the derivatives that became states.
    factors : tuple of tuple of Factor
        For each dimension its distinct factors; the first of each is the constant one.
    terms : tuple of Term
        The residual u' - f = 0, all equations.
    initial : tuple of Term
        The initial values: ``equation`` is the state, ``monomial`` is empty, the time factor one.
    """

    coordinates: tuple[Coordinate, ...]
    states: tuple[State, ...]
    factors: tuple[tuple[Factor, ...], ...]
    terms: tuple[Term, ...]
    initial: tuple[Term, ...]

    def __str__(self) -> str:
        from rankone.display import text_table

        return text_table(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        from rankone.display import html_table

        return html_table(self)

    def _repr_latex_(self) -> str:
        from rankone.display import latex_sums

        return latex_sums(self)
