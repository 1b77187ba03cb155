"""Exact numbers inside, decimals for people, and numbers with a name.

A constant of a problem that enters smoothly keeps its name up to the generated module, which reads
its number from a table. So another number needs no new module, only another table.

Where the number decides what is generated it is written in instead: exponents, conditions,
thresholds and times of switches, centres and widths of peaks, logarithms and roots of sums.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Container, Iterable
from typing import Any

import mpmath
import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.printing.latex import LatexPrinter
from sympy.printing.printer import Printer
from sympy.printing.str import StrPrinter

from rankone.problem.expressions.boundaries import peaks, steps
from rankone.problem.functions import nodes_of
from rankone.support.errors import ProblemError, clip, quote, written

# Functions without thresholds: they are smooth wherever they are finite
_SMOOTH = (sp.sin, sp.cos, sp.tan, sp.exp, sp.sinh)
_STEPS = (sp.tanh, sp.atan, sp.erf, sp.erfc, sp.cosh, sp.sech)


class NamedConstant(sp.NumberSymbol):  # type: ignore[misc]
    """A real number with a name; two are equal if both agree.

    >>> m = NamedConstant("m", sp.Integer(3))
    >>> 2 * m, float(2 * m), (2 * m).free_symbols
    (2*m, 6.0, set())
    """

    __slots__ = ("name", "value")
    is_real = True

    name: str
    value: sp.Expr

    def __new__(cls, name: str, value: sp.Expr) -> NamedConstant:
        constant: NamedConstant = sp.AtomicExpr.__new__(cls)
        constant.name, constant.value = name, value
        return constant

    def __getnewargs__(self) -> tuple[str, sp.Expr]:
        return self.name, self.value

    def _hashable_content(self) -> tuple[str, sp.Expr]:
        return self.name, self.value

    def __eq__(self, other: object) -> bool:
        same = isinstance(other, NamedConstant)
        return same and self._hashable_content() == other._hashable_content()  # type: ignore[attr-defined]

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return int(super().__hash__())

    def _as_mpf_val(self, prec: int) -> Any:
        return self.value._eval_evalf(prec)._as_mpf_val(prec)

    def approximation_interval(self, number_cls: type) -> None:
        """SymPy has intervals of numbers that it cannot compute."""

    def _sympystr(self, printer: object) -> str:
        return self.name

    def _latex(self, printer: object) -> str:
        return str(sp.latex(sp.Symbol(self.name)))

    def _decimal(self, printer: object) -> str:
        return repr(float(self.value))

    _numpycode = _pythoncode = _lambdacode = _mpmathcode = _decimal


def named_constants(expressions: Iterable[sp.Basic]) -> list[NamedConstant]:
    """The named constants in expressions, by name."""
    return sorted(nodes_of(expressions, NamedConstant), key=lambda constant: constant.name)


def written_in(expression: sp.Basic, constants: frozenset[sp.Symbol]) -> set[sp.Symbol]:
    """The symbols of constants whose numbers decide what is generated of an expression."""
    decisive: set[sp.Symbol] = set()
    waiting = [expression]
    while waiting:
        node = waiting.pop()
        inside = node.free_symbols & constants
        if not inside - decisive:
            continue
        if isinstance(node, sp.Add | sp.Mul | sp.Eq | sp.Derivative | sp.MatrixBase):
            waiting += node.args
        elif node.is_Symbol:
            continue
        elif not _is_smooth(node, constants):
            decisive |= inside
        else:
            waiting += node.args
    return decisive


def _is_smooth(node: sp.Basic, constants: frozenset[sp.Symbol]) -> bool:
    """Whether what is generated of a function or power is the same for all numbers in it."""
    if isinstance(node, sp.Pow) and not isinstance(node, sp.exp):
        if node.exp.is_Integer:
            return node.exp > 0 or not (node.base.is_Add and _has_thresholds(node, constants))
        if not node.free_symbols - constants and not node.atoms(AppliedUndef):
            return not node.atoms(sp.Add)  # such as sqrt(k/m): SymPy asks for the signs alone
        return node.exp.is_number and node.base.is_Mul and not node.base.atoms(sp.Add)
    if isinstance(node, _SMOOTH):
        return not isinstance(node, sp.exp) or not _has_thresholds(node, constants)
    return isinstance(node, _STEPS) and bool(node.atoms(AppliedUndef))


def _has_thresholds(node: sp.Expr, constants: frozenset[sp.Symbol]) -> bool:
    """Whether a number tells where a function has a peak or a step.

    Over the unknowns these are functions that vanish there, and are generated with the name, unless
    they are logarithms of ratios.
    """

    def variables(expression: sp.Basic) -> set[sp.Expr]:
        return {*(expression.free_symbols - constants), *expression.atoms(AppliedUndef)}

    return any(
        not surface.atoms(AppliedUndef)
        or any(ratio.free_symbols & constants for ratio in surface.atoms(sp.Abs))
        for _, surface in (*peaks([node], variables), *steps([node], variables))
    )


# -----------------------------------------------------------------------------
# Exact numbers inside, decimals for people: ``0.1`` is 1/10, and 3/2 is shown as ``1.5``.
#
# The front end makes every number exact, so that 0.1 + 0.2 - 0.3 is zero; from there to the printer
# no floating-point number enters an expression, because SymPy evaluates those at once:
# ``exp(2.5*x - 750.0)`` becomes a number too small for any computer times ``exp(2.5*x)``. People
# read expressions with u for u(t), du/dt for its derivative and decimals for fractions; a third
# stays ``1/3``. Nothing is evaluated for that.


_SAFE_DIGITS = sys.float_info.dig  # Decimal digits that every floating-point number holds
_EXTREME_RATIO = 1e30  # Numbers beyond it, or its reciprocal, go back into their exponential
_LARGEST_SCALE_DIGITS = 6  # Decimal digits of the scale s in (x/s)**n: units rarely differ by more
LARGEST_SCALE_BITS = 100_000
"""Bits of a number before a variable, such as that of the power ``(x/310.15)**125``."""
_SUM_ERROR_ULPS = 2  # Last places by which sums of a few decimal numbers miss their decimal result
_LARGEST_LOGARITHM = 1e5  # Of a function of numbers that is evaluated: floats end near 710
_GROWING = (sp.exp, sp.cosh, sp.sinh)
_FACTORIALS = (sp.gamma, sp.factorial, sp.loggamma)
_DIGITS = sys.float_info.dig + 2  # Decimal digits that tell all floating-point numbers apart
_LARGEST_DENOMINATOR = 10**6  # Fractions with larger ones become decimals: nobody reads them
# Larger ones are written as decimals: a float holds no more digits
_LARGEST_INTEGER = 10**_SAFE_DIGITS
_LONGEST_SIDE = 400  # Characters of one side of an equation; longer ones are cut in the middle
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def expression_of(value: object) -> sp.Expr | None:
    """A number or SymPy expression as the latter; None for text, matrices and anything else."""
    try:
        expression = sp.sympify(value, strict=True)
    except (sp.SympifyError, TypeError):
        return None
    return expression if isinstance(expression, sp.Expr) else None


def exact(expression: sp.Expr) -> sp.Expr:
    """Replace floating-point numbers by the decimal fractions they stand for.

    That is the shortest decimal that rounds to the number, or one of 15 digits that the number
    misses by no more than rounding: 0.6 - 0.9 is -0.3, not -0.30000000000000004. Numbers that SymPy
    took out of exponentials go back in first: ``exp(1000.0*a - 1000.0)`` becomes
    ``5.07e-435*exp(1000.0*a)`` when it is written. A number out of the range of floating-point
    numbers is a ProblemError.
    """
    if expression.is_Symbol:
        return expression
    if expression.is_Float:
        return _fraction(expression)
    numbers = expression.atoms(sp.Number)
    for number in numbers:
        if number.is_Rational and max(abs(number.p), number.q).bit_length() > LARGEST_SCALE_BITS:
            size = "large" if abs(number) > 1 else "small"
            raise ProblemError(
                f"{quote(number)} in {quote(expression)} is too {size} a number",
                term=expression,
                remedy="change the units; SymPy takes numbers out of powers such as (4*x)**1000",
            )
    if expression.is_Rational:
        return expression
    check_size(expression)
    floats = sorted(x for x in numbers if x.is_Float)
    if any(map(_is_extreme, floats)):
        expression = expression.replace(lambda e: e.is_Mul and _is_extreme(e.args[0]), _joined)
        floats = sorted(expression.atoms(sp.Float))
    return expression.xreplace({f: _fraction(f) for f in floats}) if floats else expression


def _fraction(number: sp.Float) -> sp.Rational:
    nearest = float(number)
    if not math.isfinite(nearest) or (nearest == 0.0 and not number.is_zero):
        raise _out_of_range(number)
    rounded = f"{nearest:.{_SAFE_DIGITS}g}"
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
        return sp.Mul(sp.Rational(str(sp.N(scale, _SAFE_DIGITS + 2))), *factors)
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
        return mpmath.mpf(str(sp.N(expression, _SAFE_DIGITS)))
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
    decimal = sp.N(expression, _SAFE_DIGITS)
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


def _decimal(number: sp.Expr) -> sp.Float | None:
    """A number as a decimal: terminating ones, and those of too many digits for a fraction."""
    if not isinstance(number, sp.Rational):
        return None
    if number.q == 1:
        # not from text: Python writes no integers of more than 4,300 digits
        return number.evalf(_DIGITS) if abs(number.p) > _LARGEST_INTEGER else None
    if number.q >= _LARGEST_DENOMINATOR or _terminates(int(number.q)):
        return number.evalf(_DIGITS)
    return None


def _terminates(denominator: int) -> bool:
    """Whether a fraction with a denominator is a decimal that ends."""
    for prime in (2, 5):
        while denominator % prime == 0:
            denominator //= prime
    return denominator == 1


class _Decimals(Printer):  # type: ignore[misc]
    """A printer of numbers as decimals."""

    def _print_Rational(self, expr: sp.Rational) -> str:
        decimal = _decimal(expr)
        return str(super()._print_Rational(expr) if decimal is None else self._print(decimal))

    _print_Half = _print_Rational

    def _print_Integer(self, expr: sp.Integer) -> str:
        decimal = _decimal(expr)
        return str(expr) if decimal is None else str(self._print(decimal))

    def _print_Mul(self, expr: sp.Mul) -> str:
        scale, cofactor = expr.as_coeff_Mul()
        decimal = _decimal(abs(scale))
        is_half = abs(scale) == sp.S.Half  # c/2, not 0.5*c
        if decimal is None or is_half or cofactor is sp.S.One:
            return str(super()._print_Mul(expr))
        product = sp.Mul(decimal, *sp.Mul.make_args(cofactor), evaluate=False)
        text = str(super()._print_Mul(product))
        return f"-{text}" if scale < 0 else text


class _Text(_Decimals, StrPrinter):  # type: ignore[misc]
    """Plain text."""


class _Latex(_Decimals, LatexPrinter):  # type: ignore[misc]
    """LaTeX."""


def plain_text(expression: sp.Basic) -> str:
    """Text of an expression.

    >>> x = sp.Symbol("x")
    >>> plain_text(sp.Rational(3, 2) * x**2 - sp.sqrt(x) / 3)
    '-sqrt(x)/3 + 1.5*x**2'
    """
    try:
        return str(_Text({"full_prec": False}).doprint(expression))
    except NotImplementedError:  # SymPy has a text of its own for it
        return str(expression)


def latex_text(expression: sp.Basic, **settings: object) -> str:
    """LaTeX of an expression; settings are those of :func:`sympy.latex`."""
    return str(_Latex(settings).doprint(expression))


written.register(sp.Basic, plain_text)


def text_of(expression: sp.Basic) -> str:
    """Return plain text such as ``k*(du/dt + 1) = 10``, cut in the middle when it is long."""
    short, _ = _abbreviate(expression)
    sides = short.args if isinstance(short, sp.Eq) else [short]
    return " = ".join(clip(plain_text(side), _LONGEST_SIDE) for side in sides)


def latex_of(expression: sp.Basic) -> str:
    r"""Return LaTeX such as ``k \left(\frac{d u}{d t} + 1\right) &= 10``."""
    short, names = _abbreviate(expression)
    sides = short.args if isinstance(short, sp.Eq) else [short]
    return " &= ".join(latex_text(side, symbol_names=names) for side in sides)


def initial_texts(
    names: Iterable[str],
    start: float,
    values: Iterable[sp.Expr],
    guessed: Container[int] = (),
) -> list[str]:
    """Initial values as text: ``u(0) = 1``; ``u(0) near 1`` at the positions that are guesses."""
    return [
        f"{u}({start:g}) {'near' if i in guessed else '='} {text_of(v)}"
        for i, (u, v) in enumerate(zip(names, values, strict=True))
    ]


def initial_latex(states: Iterable[sp.Expr], start: float, values: Iterable[sp.Expr]) -> list[str]:
    """Initial values as LaTeX, with ``&=``."""
    pairs = zip(states, values, strict=True)
    return [f"{latex_of(u)}({start:g}) &= {latex_text(v)}" for u, v in pairs]


def _abbreviate(expression: sp.Basic) -> tuple[sp.Basic, dict[sp.Symbol, str]]:
    """Replace applied functions and derivatives by symbols; return the LaTeX of the symbols too."""
    replacement: dict[sp.Basic, sp.Symbol] = {}
    names: dict[sp.Symbol, str] = {}
    applied = expression.atoms(sp.Derivative) | expression.atoms(AppliedUndef)
    for function in sorted(applied, key=sp.default_sort_key):
        if isinstance(function, sp.Derivative):
            name = function.expr.func.__name__
            order = int(function.derivative_count)
            power = "" if order == 1 else str(order)
            t = function.variables[0]
            symbol = sp.Symbol(
                f"d{power.translate(_SUPERSCRIPTS)}{name}/d{t}{power.translate(_SUPERSCRIPTS)}"
            )
            raised = f"^{{{power}}}" if power else ""
            names[symbol] = (
                rf"\frac{{d{raised} {sp.latex(sp.Symbol(name))}}}{{d {sp.latex(t)}{raised}}}"
            )
        else:
            symbol = sp.Symbol(function.func.__name__)
        replacement[function] = symbol
    # Without evaluation the two sides of an equation stay as they were written.
    if isinstance(expression, sp.Eq):
        sides = [side.xreplace(replacement) for side in expression.args]
        return sp.Eq(*sides, evaluate=False), names
    return expression.xreplace(replacement), names
