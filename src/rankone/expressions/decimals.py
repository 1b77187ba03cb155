"""Expressions as people read them: numbers are exact fractions, and shown as the decimals they are.

``Rational(3, 2)*x`` is ``1.5*x``; a third stays ``1/3``. Nothing is evaluated for that.
"""

from __future__ import annotations

from typing import Any

import sympy as sp
from sympy.printing.latex import LatexPrinter
from sympy.printing.printer import Printer
from sympy.printing.str import StrPrinter

from rankone.support.wording import written

__all__ = ["latex_text", "plain_text"]

_DIGITS = 17
"""Digits that tell all floating-point numbers apart."""
_LONG = 10**6
"""Denominators, and integers a billion times as large, from which on numbers are decimal."""


def _decimal(number: sp.Expr) -> sp.Float | None:
    """A number as a decimal: terminating ones, and those of too many digits for a fraction."""
    if not isinstance(number, sp.Rational):
        return None
    if number.q == 1:
        return sp.Float(number, _DIGITS) if abs(number.p) > _LONG * 10**9 else None
    rest = int(number.q)
    for prime in (2, 5):
        while rest % prime == 0:
            rest //= prime
    return sp.Float(number, _DIGITS) if rest == 1 or number.q >= _LONG else None


class _Decimals(Printer):  # type: ignore[misc]
    """What both printers do."""

    def _print_Rational(self, expr: Any) -> str:
        decimal = _decimal(expr)
        return str(super()._print_Rational(expr) if decimal is None else self._print(decimal))

    _print_Half = _print_Rational

    def _print_Integer(self, expr: Any) -> str:
        decimal = _decimal(expr)
        return str(expr) if decimal is None else str(self._print(decimal))

    def _print_Mul(self, expr: Any) -> str:
        number, rest = expr.as_coeff_Mul()
        decimal = _decimal(abs(number))
        half = abs(number) == sp.S.Half  # c/2, not 0.5*c
        if decimal is None or half or rest is sp.S.One:
            return str(super()._print_Mul(expr))
        product = sp.Mul(decimal, *sp.Mul.make_args(rest), evaluate=False)
        text = str(super()._print_Mul(product))
        return f"-{text}" if number < 0 else text


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
    except NotImplementedError:  # what SymPy itself prints
        return str(expression)


def latex_text(expression: sp.Basic, **settings: Any) -> str:
    """LaTeX of an expression; settings are those of :func:`sympy.latex`."""
    return str(_Latex(settings).doprint(expression))


written.register(sp.Basic, plain_text)
