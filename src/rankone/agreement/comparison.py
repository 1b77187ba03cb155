"""Residuals of expressions at fifty digits, and whether they are more than rounding."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import sympy as sp
from mpmath.libmp import fzero, mpf_abs, mpf_add, mpf_neg, mpf_sub, to_float

from rankone.agreement.precise import NoValueError, Number, Program

__all__ = ["Comparison", "sides"]

_PRECISION = 169
_TOLERANCE = 1e-10
"""Residuals up to this part of the terms are rounding, and a rounding of all intermediate results
by that much is what a larger one is compared with."""
_RUNS, _SEED, _FACTOR = 4, 1914, 10.0
"""Runs with disturbed intermediate results, and how often their spread a residual may be."""
_TINY, _UNDERFLOW = 1e-120, 1e-280
"""Residuals that come from an underflow: beside the largest terms at other points, and at all."""


def sides(equation: sp.Basic) -> tuple[sp.Expr, sp.Expr]:
    """Both sides of an equation; of an expression that vanishes the right one is zero."""
    return tuple(equation.args) if isinstance(equation, sp.Eq) else (equation, sp.S.Zero)


class Comparison:
    """The difference of two expressions where leaves have values.

    Parameters
    ----------
    left, right : Expr
    leaves : sequence of Expr
        What has values: symbols, functions of time, derivatives.
    """

    def __init__(self, left: sp.Expr, right: sp.Expr, leaves: Sequence[sp.Expr]) -> None:
        terms = sp.Add.make_args(left)
        self._left = len(terms)
        self._program = Program([*terms, *sp.Add.make_args(right)], leaves)

    @property
    def operations(self) -> int:
        """How many operations an evaluation takes."""
        return self._program.operations

    def residual(self, values: Sequence[Number]) -> tuple[float, float]:
        """The difference, and the sum of the absolute values of all terms."""
        residual, size = self._sums(self._program(values))
        return to_float(residual), to_float(size)

    def difference(self, first: Sequence[Number], second: Sequence[Number]) -> Number:
        """By how much the residual changes between two points, exact to fifty digits."""
        before, after = (self._sums(self._program(values))[0] for values in (first, second))
        change: Number = mpf_sub(after, before, _PRECISION, "n")
        return change

    def beyond_rounding(self, points: Iterable[Sequence[Number]]) -> tuple[int, float] | None:
        """The first point at which the residual is larger than rounding explains, and it.

        Where the expressions have no value nothing is said.
        """
        sums = [(k, values, self._sums_at(values)) for k, values in enumerate(points)]
        known = [(k, values, *found) for k, values, found in sums if found is not None]
        floor = _TINY * max((to_float(size) for *_, size in known), default=0.0)
        for k, values, exact, size in known:
            residual = to_float(exact)
            if abs(residual) > max(_TOLERANCE * to_float(size), floor, _UNDERFLOW):
                spread = self._spread(values, exact)
                if spread is not None and abs(residual) > _FACTOR * spread:
                    return k, residual
        return None

    def _spread(self, values: Sequence[Number], exact: Number) -> float | None:
        """How far rounding moves the residual; None if that cannot be told."""
        rng = np.random.default_rng(_SEED)
        spread = 0.0
        for _ in range(_RUNS):
            sums = self._sums_at(values, rng)
            if sums is None:
                return None
            spread = max(spread, abs(to_float(mpf_sub(sums[0], exact, _PRECISION, "n"))))
        return spread

    def _sums_at(
        self, values: Sequence[Number], noise: np.random.Generator | None = None
    ) -> tuple[Number, Number] | None:
        """Residual and size of the terms; None where there is no value."""
        try:
            sums = self._sums(self._program(values, noise, _TOLERANCE))
            for value in sums:
                to_float(value)
        except (NoValueError, OverflowError):
            return None
        return sums

    def _sums(self, terms: Sequence[Number]) -> tuple[Number, Number]:
        residual, size = fzero, fzero
        for i, term in enumerate(terms):
            signed = term if i < self._left else mpf_neg(term)
            residual = mpf_add(residual, signed, _PRECISION, "n")
            size = mpf_add(size, mpf_abs(term), _PRECISION, "n")
        return residual, size
