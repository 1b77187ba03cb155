"""Expressions as people read them: u for u(t), du/dt for its derivative, decimals for fractions.

``Rational(3, 2)*x`` is ``1.5*x``; a third stays ``1/3``. Nothing is evaluated for that.
"""

from __future__ import annotations

from collections.abc import Iterable

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.printing.latex import LatexPrinter
from sympy.printing.printer import Printer
from sympy.printing.str import StrPrinter

from rankone.support.wording import clip, written

_DIGITS = 17  # Decimal digits that tell all floating-point numbers apart
# From this denominator on a fraction is written as a decimal: nobody reads it as a fraction
_LARGEST_DENOMINATOR = 10**6
# Above this an integer is written as a decimal: a floating-point number holds no more digits
_LARGEST_INTEGER = 10**15
_LONGEST_SIDE = 400  # Characters of one side of an equation; longer ones are cut in the middle
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def _decimal(number: sp.Expr) -> sp.Float | None:
    """A number as a decimal: terminating ones, and those of too many digits for a fraction."""
    if not isinstance(number, sp.Rational):
        return None
    if number.q == 1:
        return sp.Float(number, _DIGITS) if abs(number.p) > _LARGEST_INTEGER else None
    cofactor = int(number.q)
    for prime in (2, 5):
        while cofactor % prime == 0:
            cofactor //= prime
    is_decimal = cofactor == 1 or number.q >= _LARGEST_DENOMINATOR
    return sp.Float(number, _DIGITS) if is_decimal else None


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


def initial_texts(names: Iterable[str], start: float, values: Iterable[sp.Expr]) -> list[str]:
    """Initial values as text: ``u(0) = 1``."""
    return [f"{u}({start:g}) = {text_of(v)}" for u, v in zip(names, values, strict=True)]


def initial_latex(states: Iterable[sp.Expr], start: float, values: Iterable[sp.Expr]) -> list[str]:
    """The same as LaTeX, with ``&=``."""
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
