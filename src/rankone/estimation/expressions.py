"""Quantities of parameters: functions of a dictionary, text, or symbolic expressions.

Text is read as arithmetic and nothing else; symbolic expressions are evaluated by what they offer.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote

__all__ = ["Quantity", "gradient", "quantity"]

Quantity = Callable[[Mapping[str, float]], float]

_BINARY: dict[type, Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_UNARY: dict[type, Callable[[float], float]] = {ast.USub: operator.neg, ast.UAdd: operator.pos}
_FUNCTIONS: dict[str, Callable[[float], float]] = {
    name: getattr(math, name)
    for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh", "atan")
}
_STEP = 1e-5
"""Of differences, relative to the interval of a parameter."""


def quantity(given: Any, names: Sequence[str]) -> Quantity:
    """A function of the parameters by name, from a function, text or an expression.

    Raises
    ------
    OptionError
        If it is none of these, or has names that are no parameters.
    """
    symbols = getattr(given, "free_symbols", None)
    if isinstance(given, str):
        return _from_text(given, names)
    if symbols is not None and hasattr(given, "evalf"):
        _check({symbol.name for symbol in symbols}, names, given)

        def evaluated(values: Mapping[str, float]) -> float:
            subs = {symbol: values[symbol.name] for symbol in symbols}
            return float(given.evalf(subs=subs))

        return evaluated
    if callable(given):
        return lambda values: float(given(dict(values)))
    raise OptionError(
        f"{given!r} is not a quantity of the parameters",
        term=given,
        remedy="give text, an expression of the parameters, or a function of a dictionary",
    )


def gradient(function: Quantity, values: Mapping[str, float], steps: Mapping[str, float]) -> Array:
    """Derivatives with respect to the names in ``steps``, by central differences of fourth order.

    ``steps`` are widths of intervals.
    """
    found = []
    for name, width in steps.items():
        h = _STEP * width

        def at(shift: float, name: str = name) -> float:
            return function({**values, name: values[name] + shift})

        near, far = at(h) - at(-h), at(2.0 * h) - at(-2.0 * h)
        found.append((8.0 * near - far) / (12.0 * h))
    return np.array(found)


def _from_text(text: str, names: Sequence[str]) -> Quantity:
    """Arithmetic in a text as a function."""
    try:
        body = ast.parse(text.replace("^", "**"), mode="eval").body
    except (SyntaxError, ValueError):
        raise OptionError(f"{quote(text)} is not an expression", term=text) from None
    used = {node.id for node in ast.walk(body) if isinstance(node, ast.Name)}
    _check(used - _FUNCTIONS.keys(), names, text)
    _value(body, dict.fromkeys(names, 1.0), text, dry=True)
    return lambda values: float(_value(body, values, text))


def _value(node: ast.expr, values: Mapping[str, float], text: str, dry: bool = False) -> float:
    """The value of a part; without arithmetic where only its form is checked."""
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return float(node.value)  # type: ignore[arg-type]
    if isinstance(node, ast.Name) and node.id in values:
        return values[node.id]
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        left, right = (_value(side, values, text, dry) for side in (node.left, node.right))
        return 1.0 if dry else _BINARY[type(node.op)](left, right)
    if isinstance(node, ast.UnaryOp) and type(node.op) in _UNARY:
        return _UNARY[type(node.op)](_value(node.operand, values, text, dry))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) == 1:
        function = _FUNCTIONS.get(node.func.id)
        if function is not None and not node.keywords:
            inner = _value(node.args[0], values, text, dry)
            return 1.0 if dry else function(inner)
    raise OptionError(
        f"{quote(text)}: {quote(ast.unparse(node))} is not understood",
        term=text,
        remedy=f"use + - * / **, numbers, parameters and {', '.join(_FUNCTIONS)}, or a function",
    )


def _check(used: set[str], names: Sequence[str], given: Any) -> None:
    for name in sorted(used):
        if name not in names:
            raise OptionError(
                f"{quote(given)}: there is no parameter {quote(name)}{did_you_mean(name, names)}",
                term=given,
                remedy=f"known are {listing(names)}",
            )
