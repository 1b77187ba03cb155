"""Residuals of expressions at fifty digits, and whether they are more than rounding."""

from __future__ import annotations

from collections.abc import Sequence

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
_TINY = 1e-280
"""Residuals that are an underflow."""


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

    def beyond_rounding(self, values: Sequence[Number]) -> float | None:
        """The residual if it is larger than rounding explains, else None.

        Where the expressions have no value nothing is said.
        """
        try:
            exact, scale = self._sums(self._program(values))
            residual, size = to_float(exact), to_float(scale)
            if not abs(residual) > _TOLERANCE * size + _TINY:
                return None
            rng = np.random.default_rng(_SEED)
            spread = 0.0
            for _ in range(_RUNS):
                disturbed, _size = self._sums(self._program(values, rng, _TOLERANCE))
                spread = max(spread, abs(to_float(mpf_sub(disturbed, exact, _PRECISION, "n"))))
        except (NoValueError, OverflowError):
            return None
        return residual if abs(residual) > _FACTOR * spread else None

    def _sums(self, terms: Sequence[Number]) -> tuple[Number, Number]:
        residual, size = fzero, fzero
        for i, term in enumerate(terms):
            signed = term if i < self._left else mpf_neg(term)
            residual = mpf_add(residual, signed, _PRECISION, "n")
            size = mpf_add(size, mpf_abs(term), _PRECISION, "n")
        return residual, size
