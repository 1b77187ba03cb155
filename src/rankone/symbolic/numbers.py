"""Exact arithmetic: a decimal number means what it says, so that 0.1 + 0.2 - 0.3 is zero."""

from __future__ import annotations

import math

import sympy as sp

from rankone.errors import ProblemError

__all__ = ["exact"]


def exact(expression: sp.Expr) -> sp.Expr:
    """Replace floating-point numbers by the shortest decimal fractions that round to them."""
    if expression.is_Rational or expression.is_Symbol:
        return expression
    if expression.is_Float:
        value = float(expression)
        if not math.isfinite(value):
            raise ProblemError(
                f"the number {expression} is too large", term=expression, remedy="change the units"
            )
        return sp.Rational(repr(value))
    floats = sorted(expression.atoms(sp.Float))
    return expression.xreplace({f: exact(f) for f in floats}) if floats else expression
