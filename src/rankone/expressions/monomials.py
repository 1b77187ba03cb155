"""Sums of monomials: products of one function for each coordinate and powers of states."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import sympy as sp

__all__ = ["Monomial", "MonomialSum", "Powers"]

Powers = tuple[tuple[int, int], ...]
"""(state, exponent), ascending; negative exponents may occur on the way."""


class Monomial(NamedTuple):
    """A product of one function for each coordinate and a monomial in the states."""

    factors: tuple[sp.Expr, ...]
    """For each dimension a function of its coordinate; one where there is none."""
    powers: Powers


class MonomialSum(dict[Monomial, sp.Expr]):
    """Monomials with their coefficients: exact numbers, none of them zero.

    Like monomials merge; their order is that in which they came first.
    """

    @classmethod
    def of(cls, terms: Iterable[tuple[Monomial, sp.Expr]]) -> MonomialSum:
        """Add up coefficients times monomials."""
        total: dict[Monomial, sp.Expr] = {}
        for monomial, number in terms:
            total[monomial] = total[monomial] + number if monomial in total else number
        return cls((monomial, number) for monomial, number in total.items() if number != 0)

    @classmethod
    def total(cls, sums: Iterable[MonomialSum]) -> MonomialSum:
        """Add sums."""
        return cls.of(term for terms in sums for term in terms.items())

    def times(
        self, other: MonomialSum, product: Callable[[sp.Expr, sp.Expr], tuple[sp.Expr, sp.Expr]]
    ) -> MonomialSum:
        """Multiply out; ``product`` gives that of two factors as (number, factor)."""
        result = []
        for a, a_number in self.items():
            for b, b_number in other.items():
                number = a_number * b_number
                factors = []
                for f, g in zip(a.factors, b.factors, strict=True):
                    scale, factor = product(f, g)
                    number *= scale
                    factors.append(factor)
                result.append((Monomial(tuple(factors), _times(a.powers, b.powers)), number))
        return MonomialSum.of(result)


def _times(a: Powers, b: Powers) -> Powers:
    """Multiply two monomials in the states."""
    if not a or not b:
        return a or b
    powers = dict(a)
    for state, exponent in b:
        powers[state] = powers.get(state, 0) + exponent
    return tuple(sorted((state, exponent) for state, exponent in powers.items() if exponent))
