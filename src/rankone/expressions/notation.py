"""Equations as on paper: u for u(t), du/dt for its derivative."""

from __future__ import annotations

from collections.abc import Iterable

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.expressions.decimals import latex_text, plain_text
from rankone.support.wording import clip

__all__ = ["initial_latex", "initial_texts", "latex_of", "text_of"]

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
