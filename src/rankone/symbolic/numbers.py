"""Exact arithmetic: a decimal number means what it says, so that 0.1 + 0.2 - 0.3 is zero."""

from __future__ import annotations

import math

import sympy as sp

from rankone.errors import ProblemError

__all__ = ["exact"]

_DIGITS = 15
"""Significant digits that every floating-point number holds."""
_ROUNDING = 2
"""Units in the last place by which sums of a few decimal numbers miss the decimal result."""


def exact(expression: sp.Expr) -> sp.Expr:
    """Replace floating-point numbers by the decimal fractions they stand for.

    That is the shortest decimal that rounds to the number, or one of 15 digits that the number
    misses by no more than rounding: 0.6 - 0.9 is -0.3, not -0.30000000000000004.
    """
    if expression.is_Rational or expression.is_Symbol:
        return expression
    if expression.is_Float:
        value = float(expression)
        if not math.isfinite(value):
            raise ProblemError(
                f"the number {expression} is too large", term=expression, remedy="change the units"
            )
        rounded = f"{value:.{_DIGITS}g}"
        near = abs(float(rounded) - value) <= _ROUNDING * math.ulp(value)
        return sp.Rational(rounded if near else repr(value))
    floats = sorted(expression.atoms(sp.Float))
    return expression.xreplace({f: exact(f) for f in floats}) if floats else expression
