"""Exact arithmetic: a decimal number means what it says, so that 0.1 + 0.2 - 0.3 is zero."""

from __future__ import annotations

import math

import sympy as sp

from rankone.errors import ProblemError

__all__ = ["exact", "rejoined"]

_DIGITS = 15
"""Significant digits that every floating-point number holds."""
_TAKEN_OUT = 1e30
"""Numbers beyond, or below its reciprocal, go back into the exponential they came from."""
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
        if not math.isfinite(value) or (value == 0.0 and not expression.is_zero):
            raise _out_of_range(expression)
        rounded = f"{value:.{_DIGITS}g}"
        near = abs(float(rounded) - value) <= _ROUNDING * math.ulp(value)
        return sp.Rational(rounded if near else repr(value))
    floats = sorted(expression.atoms(sp.Float))
    return expression.xreplace({f: exact(f) for f in floats}) if floats else expression


def rejoined(expression: sp.Expr) -> sp.Expr:
    """Put numbers that SymPy took out of exponentials back in.

    ``exp(1000.0*a - 1000.0)`` becomes ``5.07e-435*exp(1000.0*a)`` when it is written, and no
    floating-point number is so small.

    Raises
    ------
    ProblemError
        If a number is too large or too small and stands beside no exponential.
    """
    if not any(_beyond(number) for number in expression.atoms(sp.Float)):
        return expression
    return expression.replace(lambda part: part.is_Mul and _beyond(part.args[0]), _joined)


def _beyond(number: sp.Expr) -> bool:
    """Whether a number may have been taken out of an exponential."""
    size = abs(number)
    return bool(number.is_Float and not number.is_zero and not 1 / _TAKEN_OUT < size < _TAKEN_OUT)


def _joined(product: sp.Mul) -> sp.Expr:
    number, *factors = product.args
    for i, factor in enumerate(factors):
        if isinstance(factor, sp.exp):
            shift = sp.Rational(str(sp.N(sp.log(abs(number)), 20)))
            others = factors[:i] + factors[i + 1 :]
            return sp.Mul(sp.sign(number), sp.exp(exact(factor.exp) + shift), *others)
    if not 0.0 < abs(float(number)) < math.inf:
        raise _out_of_range(number)
    return product


def _out_of_range(number: sp.Expr) -> ProblemError:
    size = "large" if abs(number) > 1 else "small"
    return ProblemError(
        f"the number {number} is too {size}", term=number, remedy="change the units"
    )
