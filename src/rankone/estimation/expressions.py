"""Quantities of parameters: functions of a dictionary, text, or symbolic expressions.

Text is read as arithmetic and nothing else; symbolic expressions are evaluated by what they offer.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote

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
# Step of differences, in shares of the interval of a parameter: truncation near rounding
_STEP_SHARE = 1e-5


@runtime_checkable
class _Expression(Protocol):
    """A symbolic expression that evaluates itself, such as one of SymPy."""

    free_symbols: set[Any]

    def evalf(self, *, subs: Mapping[Any, float]) -> float: ...


def quantity(given: object, names: Sequence[str]) -> Quantity:
    """A function of the parameters by name, from a function, text or an expression."""
    if isinstance(given, str):
        return _from_text(given, names)
    if isinstance(given, _Expression):
        expression, symbols = given, given.free_symbols
        _check({symbol.name for symbol in symbols}, names, given)
        return lambda at: float(expression.evalf(subs={s: at[s.name] for s in symbols}))
    if callable(given):
        function = given
        return lambda at: float(function(dict(at)))
    raise OptionError(
        f"{given!r} is not a quantity of the parameters",
        term=given,
        remedy="give text, an expression of the parameters, or a function of a dictionary",
    )


def gradient(function: Quantity, point: Mapping[str, float], widths: Mapping[str, float]) -> Array:
    """Derivatives at a point, by central differences of fourth order.

    ``widths`` are the lengths of the intervals, of the parameters to vary.
    """
    slopes = []
    for name, width in widths.items():
        h = _STEP_SHARE * width

        def at(shift: float, name: str = name) -> float:
            return function({**point, name: point[name] + shift})

        near, far = at(h) - at(-h), at(2.0 * h) - at(-2.0 * h)
        slopes.append((8.0 * near - far) / (12.0 * h))
    return np.array(slopes)


def _from_text(text: str, names: Sequence[str]) -> Quantity:
    try:
        body = ast.parse(text.replace("^", "**"), mode="eval").body
    except (SyntaxError, ValueError):
        raise OptionError(f"{quote(text)} is not an expression", term=text) from None
    used = {node.id for node in ast.walk(body) if isinstance(node, ast.Name)}
    _check(used - _FUNCTIONS.keys(), names, text)
    _evaluated(body, dict.fromkeys(names, 1.0), text, dry=True)
    return lambda at: float(_evaluated(body, at, text))


def _evaluated(node: ast.expr, at: Mapping[str, float], text: str, dry: bool = False) -> float:
    """The value of an expression; ``dry`` checks its form without arithmetic."""
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return float(node.value)  # type: ignore[arg-type]
    if isinstance(node, ast.Name) and node.id in at:
        return at[node.id]
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        left, right = (_evaluated(side, at, text, dry) for side in (node.left, node.right))
        return 1.0 if dry else _BINARY[type(node.op)](left, right)
    if isinstance(node, ast.UnaryOp) and type(node.op) in _UNARY:
        return _UNARY[type(node.op)](_evaluated(node.operand, at, text, dry))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) == 1:
        function = _FUNCTIONS.get(node.func.id)
        if function is not None and not node.keywords:
            inner = _evaluated(node.args[0], at, text, dry)
            return 1.0 if dry else function(inner)
    raise OptionError(
        f"{quote(text)}: {quote(ast.unparse(node))} is not understood",
        term=text,
        remedy=f"use + - * / **, numbers, parameters and {', '.join(_FUNCTIONS)}, or a function",
    )


def _check(used: set[str], names: Sequence[str], given: object) -> None:
    for name in sorted(used):
        if name not in names:
            raise OptionError(
                f"{quote(given)}: there is no parameter {quote(name)}{did_you_mean(name, names)}",
                term=given,
                remedy=f"known are {listing(names)}",
            )
