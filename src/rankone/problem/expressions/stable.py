"""Expressions written so that floating-point numbers neither overflow nor cancel.

What people write in kelvin, pascal or years is well conditioned, but not as it stands:
``1/(1 + exp((T - 310.15)/0.43))`` overflows inside, SymPy turns ``(T/310.15)**125`` into a number
below all floating-point numbers times ``T**125``, and ``exp(x) - 1`` loses all digits of a small
``x``. :func:`stable` writes them with functions that do not: the logistic function, ``log1p``,
``expm1`` and their kin (Higham, Accuracy and Stability of Numerical Algorithms, SIAM 2002,
section 1.14), which are differentiated as such.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import sympy as sp
from scipy import special

from rankone.support.arrays import EXACT_DIGITS

# Numbers up to this, and down to its reciprocal, stand as they are: ten such may be multiplied
_ORDINARY_RATIO = sp.Integer(10) ** 30
HIGH_POWER = 8  # From this power on a quotient of powers is written as the power of a quotient
_MOST_DENOMINATOR_TERMS = 20  # Terms of a denominator up to which it is compared with the numerator
# Numerators and denominators up to this stay exact; larger ones are rounded to EXACT_DIGITS
_LARGEST_INTEGER = 10**EXACT_DIGITS
# Integers beyond it are objects, of which NumPy takes no functions
_LARGEST_OF_NUMPY = int(np.iinfo(np.int64).max)
_SAME_RATIO = sp.Rational(1, 10**15)  # Coefficients this close are one number except for rounding


class _Real(sp.Function):  # type: ignore[misc]
    """A function of real numbers that SymPy lacks, or evaluates too eagerly."""

    is_real = True
    slopes: tuple[Callable[..., sp.Expr], ...]
    """The derivatives with respect to the arguments."""

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        return self.slopes[argindex - 1](*self.args)


class expit(_Real):
    """The logistic function 1/(1 + exp(-z)); in its slope expit*(1 - expit) would cancel."""

    nargs = 1
    slopes = (lambda z: expit(z) * expit(-z),)


class expm1(_Real):
    """exp(z) - 1; SymPy evaluates its own for some arguments."""

    nargs = 1
    slopes = (sp.exp,)


class log1p(_Real):
    """log(1 + z)."""

    nargs = 1
    slopes = (lambda z: 1 / (1 + z),)


class cosm1(_Real):
    """cos(z) - 1."""

    nargs = 1
    slopes = (lambda z: -sp.sin(z),)


class logaddexp(_Real):
    """log(exp(a) + exp(b))."""

    nargs = 2
    slopes = (lambda a, b: expit(a - b), lambda a, b: expit(b - a))


class scaled_power(_Real):
    """A power whose base keeps its number: SymPy takes that out of ``(x/310.15)**125``.

    Exponents are numbers.
    """

    nargs = 2
    slopes = (lambda base, exponent: exponent * scaled_power(base, exponent - 1),)


class fraction(_Real):
    """a/(a + b), whose derivatives have one term each: the quotient rule cancels."""

    nargs = 2
    slopes = (lambda a, b: b / (a + b) ** 2, lambda a, b: -a / (a + b) ** 2)


NUMPY: dict[str, Callable[..., object]] = {
    "cosm1": special.cosm1,
    "expit": special.expit,
    "expm1": np.expm1,
    "fraction": lambda a, b: a / (a + b),
    "log1p": np.log1p,
    "logaddexp": np.logaddexp,
    "scaled_power": np.power,
}
"""The functions that SymPy does not have, or does not write for NumPy."""


def in_floats(expression: sp.Basic) -> sp.Basic:
    """An expression with floating-point numbers for integers that NumPy takes for objects."""
    large = [n for n in expression.atoms(sp.Integer) if abs(n) > _LARGEST_OF_NUMPY]
    return expression.xreplace({n: sp.Float(n, EXACT_DIGITS) for n in large})


def stable(expression: sp.Expr) -> sp.Expr:
    """An expression of the same value that is computed without overflow and cancellation.

    >>> x = sp.Symbol("x", real=True)
    >>> stable(1 / (1 + sp.exp((x - 310) / 2)))
    expit(155 - x/2)
    >>> stable(sp.exp(-x) - 1), stable(sp.log(1 + x)), stable(1 - sp.tanh(x))
    (expm1(-x), log1p(x), 2*expit(-2*x))
    """
    return _Rewriting()(expression)


class _Rewriting:
    """Rewrites from the leaves to the root, each subexpression once."""

    def __init__(self) -> None:
        self._written: dict[sp.Basic, sp.Basic] = {}

    def __call__(self, expression: sp.Basic) -> sp.Basic:
        if not expression.args or not isinstance(expression, sp.Expr | sp.Tuple):
            return expression  # conditions stay as they are
        if expression not in self._written:
            args = [self(arg) for arg in expression.args]
            unchanged = all(a is b for a, b in zip(args, expression.args, strict=True))
            rebuilt = expression if unchanged else expression.func(*args)
            self._written[expression] = self._rewritten(rebuilt)
        return self._written[expression]

    def _rewritten(self, expression: sp.Basic) -> sp.Basic:
        if expression.is_Add:
            return _in_range_sum(_without_cancellation(expression))
        if expression.is_Pow:
            return _power(expression)
        if expression.is_Mul:
            return _product(expression)
        if isinstance(expression, sp.log):
            return _logarithm(expression)
        return expression


def _complement(function: sp.Expr) -> tuple[sp.Expr | None, sp.Expr | None]:
    """1 + f and 1 - f without cancellation; None where nothing cancels."""
    if not function.args:
        return None, None
    argument = function.args[0]
    if isinstance(function, sp.exp):
        return None, -expm1(argument)
    if isinstance(function, sp.cos):
        return None, -cosm1(argument)
    if isinstance(function, sp.tanh):
        return 2 * expit(2 * argument), 2 * expit(-2 * argument)
    if isinstance(function, sp.erf):
        return sp.erfc(-argument), sp.erfc(argument)
    if isinstance(function, sp.cosh):
        return None, -2 * sp.sinh(argument / 2) ** 2
    if isinstance(function, expit):
        return None, expit(-argument)
    if function.is_Pow and function.exp.is_Rational and sp.S.One in function.base.args:
        return None, -_power_less_one(function.base - 1, function.exp)
    return None, None


def _power_less_one(x: sp.Expr, exponent: sp.Rational) -> sp.Expr:
    """(1 + x)**exponent - 1, of whole exponents for all x."""
    if not exponent.is_Integer:
        return expm1(exponent * log1p(x))
    if exponent < 0:
        return -_power_less_one(x, -exponent) / (1 + x) ** -exponent
    if exponent == 1:
        return x
    half = exponent // 2
    even = _power_less_one(x, half) * ((1 + x) ** half + 1)
    return even if exponent % 2 == 0 else x + (1 + x) * even


_COMPLEMENTED = (sp.exp, sp.cos, sp.cosh, sp.tanh, sp.erf, expit, sp.Pow)


def _without_cancellation(total: sp.Expr) -> sp.Expr:
    """A sum in which pairs of terms such as ``k - k*exp(z)`` are one term."""
    if not any(isinstance(f, _COMPLEMENTED) for a in total.args for f in sp.Mul.make_args(a)):
        return total
    terms = set(total.args)
    for term in total.args:
        for function in sp.Mul.make_args(term):
            if not isinstance(function, _COMPLEMENTED):
                continue
            factor = sp.Mul(*(f for f in sp.Mul.make_args(term) if f is not function))
            for sign, merged in zip((1, -1), _complement(function), strict=True):
                if merged is not None and sign * factor in terms:
                    remaining = (a for a in total.args if a not in (term, sign * factor))
                    shorter = sp.Add(*remaining, sign * factor * merged)
                    return _without_cancellation(shorter) if shorter.is_Add else shorter
    return total


def _in_range_sum(total: sp.Expr) -> sp.Expr:
    """A sum with its largest number taken out, if that is not an ordinary number."""
    if not total.is_Add:
        return total
    numbers = [abs(term.as_coeff_Mul()[0]) for term in total.args]
    largest = max((n for n in numbers if n.is_Rational), default=sp.S.One)
    if largest <= _ORDINARY_RATIO:
        return total
    scaled = sp.Add(*(_product(term / largest) for term in total.args))
    return sp.Mul(largest, scaled, evaluate=False)


def _power(power: sp.Expr) -> sp.Expr:
    """A power of 1 + exp(z) as a power of the logistic function."""
    base, exponent = power.base, power.exp
    if not (base.is_Add and len(base.args) == 2 and exponent.could_extract_minus_sign()):
        return power
    first, second = (_exponential(term) for term in base.args)
    if first is None or second is None or not (first[1].free_symbols or second[1].free_symbols):
        return power
    if second[1].is_number:
        first, second = second, first
    shift = second[1] - first[1] + _rational(sp.log(second[0] / first[0]))
    outside = first[0] ** exponent * sp.exp(exponent * first[1])
    return _product(outside * expit(-shift) ** -exponent)


def _exponential(term: sp.Expr) -> tuple[sp.Expr, sp.Expr] | None:
    """(c, z) of a term c*exp(z) with a positive number c; None of any other term."""
    coefficient, exponential = term.as_coeff_Mul()
    if not (coefficient.is_Rational and coefficient > 0):
        return None
    if exponential is sp.S.One:
        return coefficient, sp.S.Zero
    return (coefficient, exponential.exp) if isinstance(exponential, sp.exp) else None


def _product(product: sp.Expr) -> sp.Expr:
    """A product whose factors overflow no earlier than the product."""
    if not product.is_Mul:
        return product
    return _with_fractions(_in_range_product(_with_quotients(_with_logistic(product))))


def _with_logistic(product: sp.Expr) -> sp.Expr:
    """``exp(z)*expit(-z)`` is ``expit(z)``, also where the exponential is infinite."""
    exponentials = [f for f in product.args if isinstance(f, sp.exp)]
    logistic = [f for f in product.args if isinstance(f.as_base_exp()[0], expit)]
    for exponential, power in itertools.product(exponentials, logistic):
        base, count = power.as_base_exp()
        if not count.is_Integer or not 1 <= count <= HIGH_POWER:
            continue
        for turned in range(1, int(count) + 1):
            exponent = _without(exponential.exp, -turned * base.args[0])
            if exponent is not None:
                powers = expit(-base.args[0]) ** turned * base ** (count - turned)
                remaining = (f for f in product.args if f not in (exponential, power))
                return sp.Mul(sp.exp(exponent), powers, *remaining)
    return product


def _without(total: sp.Expr, summand: sp.Expr) -> sp.Expr | None:
    """A sum minus some of its terms, except for rounding; None if it does not have these terms."""
    difference = total - summand
    sizes, left = total.as_coefficients_dict(), difference.as_coefficients_dict()
    for term in summand.as_coefficients_dict():
        if term != 1 and abs(left[term]) > _SAME_RATIO * abs(sizes[term]):
            return None
        difference -= left[term] * term if term != 1 else 0
    return difference


def _with_quotients(product: sp.Expr) -> sp.Expr:
    """High powers of quotients: ``x**60/y**60`` becomes ``(x/y)**60``."""
    if not product.is_Mul:
        return product
    high: dict[sp.Expr, list[sp.Expr]] = {}
    for factor in product.args:
        if factor.is_Pow and factor.exp.is_Integer and abs(factor.exp) >= HIGH_POWER:
            high.setdefault(abs(factor.exp), []).append(factor)
    for exponent, powers in high.items():
        above = [p.base for p in powers if p.exp > 0]
        below = [p.base for p in powers if p.exp < 0]
        if above and below:
            quotient = scaled_power(sp.Mul(*above) / sp.Mul(*below), exponent)
            product = sp.Mul(quotient, *(f for f in product.args if f not in powers))
    return product


def _in_range_product(product: sp.Expr) -> sp.Expr:
    """A product whose number, if it is extreme, is in the base of its highest power."""
    if not product.is_Mul:
        return product
    scale = sp.Mul(*(f for f in product.args if f.is_number))
    size = _size(scale)
    if size is None or 1 / _ORDINARY_RATIO <= size <= _ORDINARY_RATIO:
        return product
    factors = [f for f in product.args if not f.is_number]
    matched = _scaled_as_elsewhere(product, scale, factors)
    if matched is not None:
        return matched
    powers = [(*_base_and_exponent(f), f) for f in factors]
    powers = [p for p in powers if p[1].is_Rational and abs(p[1]) > 1]
    if not powers:
        return product
    base, exponent, factor = max(powers, key=lambda p: abs(p[1]))
    factors.remove(factor)
    power = scaled_power(_rational(size ** (1 / exponent)) * base, abs(exponent)) ** sp.sign(
        exponent
    )
    return sp.Mul(sp.sign(scale), power, *factors)


def _scaled_as_elsewhere(
    product: sp.Expr, number: sp.Expr, factors: Sequence[sp.Expr]
) -> sp.Expr | None:
    """A product with the power of a variable scaled in the same way as in a denominator."""
    for power in sorted(product.atoms(scaled_power), key=sp.default_sort_key):
        for factor in factors:
            base, exponent = _base_and_exponent(factor)
            scale, times = power.args[0] / base, exponent / power.args[1]
            if not times.is_Integer or factor == power or not scale.is_Rational:
                continue
            left = sp.N(number, EXACT_DIGITS) / sp.N(scale, EXACT_DIGITS) ** exponent
            if 1 / _ORDINARY_RATIO <= abs(left) <= _ORDINARY_RATIO:
                remaining = (f for f in factors if f is not factor)
                return sp.Mul(_rational(left), power**times, *remaining)
    return None


def _with_fractions(product: sp.Expr) -> sp.Expr:
    """A factor that is also a term of the denominator, as in ``v*x/(K + x)``, in a fraction."""
    if not product.is_Mul:
        return product
    for power in product.args:
        total, exponent = power.as_base_exp()
        if not (total.is_Add and exponent.is_Integer and exponent < 0):
            continue
        above = _powers(f for f in product.args if f is not power)
        for term in total.args if len(total.args) <= _MOST_DENOMINATOR_TERMS else ():
            coefficient, monomial = term.as_coeff_Mul()
            below = _powers(sp.Mul.make_args(monomial)) if monomial.free_symbols else {}
            ratios = [above.get(b, sp.S.Zero) / e for b, e in below.items()]
            if not below or not all(r.is_Rational and r >= -exponent for r in ratios):
                continue
            left = {**above, **{b: above[b] + exponent * e for b, e in below.items()}}
            remaining = sp.Mul(coefficient**exponent, *(b**e for b, e in left.items()))
            return _with_fractions(remaining * fraction(term, total - term) ** -exponent)
    return product


def _powers(factors: Iterable[sp.Expr]) -> dict[sp.Expr, sp.Expr]:
    """The exponents of factors by base."""
    powers: dict[sp.Expr, sp.Expr] = {}
    for factor in factors:
        base, exponent = factor.as_base_exp()
        powers[base] = powers.get(base, sp.S.Zero) + exponent
    return powers


def _base_and_exponent(factor: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    base, exponent = factor.as_base_exp() if factor.is_Pow else (factor, sp.S.One)
    if isinstance(base, scaled_power):
        return base.args[0], base.args[1] * exponent
    return base, exponent


def _size(number: sp.Expr) -> sp.Rational | None:
    """The absolute value of a number as a fraction."""
    if number.is_Rational:
        return abs(number)
    decimal = sp.N(abs(number), EXACT_DIGITS)
    return sp.Rational(str(decimal)) if decimal.is_Float else None


def _rational(number: sp.Expr) -> sp.Expr:
    """A number as a fraction of limited length."""
    if number.is_Rational and max(abs(number.p), number.q) <= _LARGEST_INTEGER:
        return number
    return sp.Rational(str(sp.N(number, EXACT_DIGITS)))


def _logarithm(logarithm: sp.Expr) -> sp.Expr:
    """log(1 + x) and log(1 + exp(z))."""
    argument = logarithm.args[0]
    if not argument.is_Add:
        return logarithm
    if len(argument.args) == 2:
        first, second = (_exponential(term) for term in argument.args)
        if first is not None and second is not None:
            return logaddexp(*(z + _rational(sp.log(c)) for c, z in (first, second)))
    return log1p(argument - 1) if sp.S.One in argument.args else logarithm
