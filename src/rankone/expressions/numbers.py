"""Exact arithmetic: a decimal number means what it says, so that 0.1 + 0.2 - 0.3 is zero.

The front end makes every number exact; from there to the printer no floating-point number enters
an expression, because SymPy evaluates those at once: ``exp(2.5*x - 750.0)`` becomes a number too
small for any computer times ``exp(2.5*x)``.
"""

from __future__ import annotations

import math

import mpmath
import sympy as sp

from rankone.support.errors import ProblemError
from rankone.support.wording import quote

_DIGITS = 15  # Significant decimal digits that every floating-point number holds
# Numbers beyond, or below its reciprocal, go back into the exponential they came from
_EXTREME_RATIO = 1e30
# Decimal logarithm of the largest scale s in powers (x/s)**n: units rarely differ by more
_LARGEST_SCALE_DIGITS = 6
# Units in the last place by which sums of a few decimal numbers miss their decimal result
_SUM_ERROR_ULPS = 2
# Logarithm beyond which a function of numbers is not evaluated: floats end near 710
_LARGEST_LOGARITHM = 1e5
_GROWING = (sp.exp, sp.cosh, sp.sinh)
_FACTORIALS = (sp.gamma, sp.factorial, sp.loggamma)


def exact(expression: sp.Expr) -> sp.Expr:
    """Replace floating-point numbers by the decimal fractions they stand for.

    That is the shortest decimal that rounds to the number, or one of 15 digits that the number
    misses by no more than rounding: 0.6 - 0.9 is -0.3, not -0.30000000000000004. Numbers that SymPy
    took out of exponentials go back in first: ``exp(1000.0*a - 1000.0)`` becomes
    ``5.07e-435*exp(1000.0*a)`` when it is written. A number out of the range of floating-point
    numbers is a ProblemError.
    """
    if expression.is_Rational or expression.is_Symbol:
        return expression
    if expression.is_Float:
        return _decimal(expression)
    check_size(expression)
    floats = sorted(expression.atoms(sp.Float))
    if any(map(_is_extreme, floats)):
        expression = expression.replace(lambda e: e.is_Mul and _is_extreme(e.args[0]), _joined)
        floats = sorted(expression.atoms(sp.Float))
    return expression.xreplace({f: _decimal(f) for f in floats}) if floats else expression


def _decimal(number: sp.Float) -> sp.Rational:
    nearest = float(number)
    if not math.isfinite(nearest) or (nearest == 0.0 and not number.is_zero):
        raise _out_of_range(number)
    rounded = f"{nearest:.{_DIGITS}g}"
    is_near = abs(float(rounded) - nearest) <= _SUM_ERROR_ULPS * math.ulp(nearest)
    return sp.Rational(rounded if is_near else repr(nearest))


def _is_extreme(number: sp.Expr) -> bool:
    """Whether a number may have been taken out of an exponential."""
    size = abs(number) if number.is_Float else 0
    return bool(size and not 1 / _EXTREME_RATIO < size < _EXTREME_RATIO)


def _joined(product: sp.Mul) -> sp.Expr:
    """A product whose number is again in the exponential, if it has one."""
    scale, *factors = product.args
    powers = [factor.exp for factor in factors if factor.is_Pow and factor.exp.is_number]
    highest = max(map(abs, powers), default=1)
    from_power = abs(sp.log(abs(scale), 10)) < _LARGEST_SCALE_DIGITS * highest
    for i, factor in enumerate(factors):
        if isinstance(factor, sp.exp) and not from_power:
            shift = sp.Rational(str(sp.N(sp.log(abs(scale)), 20)))
            remaining = factors[:i] + factors[i + 1 :]
            return sp.Mul(sp.sign(scale), sp.exp(exact(factor.exp) + shift), *remaining)
    if powers:  # the printer puts it there: (x/310.15)**125
        return sp.Mul(sp.Rational(str(sp.N(scale, _DIGITS + 2))), *factors)
    if not 0.0 < abs(float(scale)) < math.inf:
        raise _out_of_range(scale)
    return product


def _out_of_range(number: sp.Expr) -> ProblemError:
    size = "large" if abs(number) > 1 else "small"
    return ProblemError(
        f"the number {number} is too {size}", term=number, remedy="change the units"
    )


def check_size(expression: sp.Basic) -> mpmath.mpf | None:
    """The value of an expression without symbols; None if it has some.

    A number so large that SymPy would never finish, ``exp(exp(exp(100)))``, is a ProblemError.
    """
    if expression.is_Rational:
        return mpmath.mpf(int(expression.p)) / int(expression.q)
    if isinstance(expression, sp.Float | sp.NumberSymbol):
        return mpmath.mpf(str(sp.N(expression, _DIGITS)))
    if not isinstance(expression, sp.Expr):
        return None
    arguments = [check_size(argument) for argument in expression.args]
    if not arguments or any(argument is None for argument in arguments):
        return None
    if _logarithm(expression, arguments) > _LARGEST_LOGARITHM:
        raise ProblemError(
            f"{quote(expression)} is out of the range of floating-point numbers",
            term=expression,
            remedy="change the units",
        )
    decimal = sp.N(expression, _DIGITS)
    return mpmath.mpf(str(decimal)) if decimal.is_Float or decimal.is_Rational else None


def _logarithm(expression: sp.Basic, arguments: list[mpmath.mpf]) -> float:
    """An upper bound of the logarithm of a function of numbers."""
    first = abs(arguments[0])
    if isinstance(expression, _GROWING):
        return float(first)
    if expression.is_Pow:
        return float(abs(arguments[1] * mpmath.log(first))) if first else 0.0
    if isinstance(expression, _FACTORIALS):
        return float(first * mpmath.log(first + 2))
    return 0.0
