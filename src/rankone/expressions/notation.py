"""Expressions as people read them: u for u(t), du/dt for its derivative, decimals for fractions.

``Rational(3, 2)*x`` is ``1.5*x``; a third stays ``1/3``. Nothing is evaluated for that.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.printing.latex import LatexPrinter
from sympy.printing.printer import Printer
from sympy.printing.str import StrPrinter

from rankone.support.wording import clip, written

__all__ = [
    "initial_latex",
    "initial_texts",
    "latex_of",
    "latex_text",
    "plain_text",
    "text_of",
]


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


_LONGEST_SIDE = 400
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


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
    parts = expression.atoms(sp.Derivative) | expression.atoms(AppliedUndef)
    for part in sorted(parts, key=sp.default_sort_key):
        if isinstance(part, sp.Derivative):
            name = part.expr.func.__name__
            order = int(part.derivative_count)
            power = "" if order == 1 else str(order)
            t = part.variables[0]
            symbol = sp.Symbol(
                f"d{power.translate(_SUPERSCRIPTS)}{name}/d{t}{power.translate(_SUPERSCRIPTS)}"
            )
            raised = f"^{{{power}}}" if power else ""
            names[symbol] = (
                rf"\frac{{d{raised} {sp.latex(sp.Symbol(name))}}}{{d {sp.latex(t)}{raised}}}"
            )
        else:
            symbol = sp.Symbol(part.func.__name__)
        replacement[part] = symbol
    # Without evaluation the two sides of an equation stay as they were written.
    if isinstance(expression, sp.Eq):
        sides = [side.xreplace(replacement) for side in expression.args]
        return sp.Eq(*sides, evaluate=False), names
    return expression.xreplace(replacement), names
