"""Formulas: arithmetic of named quantities, from text or a symbolic expression.

Text is read as arithmetic and nothing else. A symbolic expression is read by what it offers, its
function and arguments, so that SymPy is not needed.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

from rankone.discretization.coordinates import name_of
from rankone.estimation.duals import FUNCTIONS
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.wording import quote

_BINARY: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_UNARY: dict[type, Callable[[Any], Any]] = {ast.USub: operator.neg, ast.UAdd: operator.pos}
_CONSTANTS = {"pi": math.pi}
# Names of functions of SymPy that have another name here
_SYMBOLIC_NAMES = {"Abs": "abs"}
_NESTED = math.inf  # The degree of what is no polynomial


@dataclass(frozen=True)
class Formula:
    """An expression of named quantities; ``text`` is what the user wrote."""

    text: str
    body: ast.expr

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities, each once, in the order in which they occur."""
        called = {id(node.func) for node in ast.walk(self.body) if isinstance(node, ast.Call)}
        nodes = (node for node in ast.walk(self.body) if isinstance(node, ast.Name))
        names = dict.fromkeys(node.id for node in nodes if id(node) not in called)
        return tuple(name for name in names if name not in _CONSTANTS)

    @property
    def is_name(self) -> bool:
        """Whether it is one quantity and no more."""
        return isinstance(self.body, ast.Name)

    def __call__(self, at: Mapping[str, Any]) -> Any:
        """The value for numbers, arrays or duals by name."""
        return _evaluated(self.body, at)

    def degree(self, names: Collection[str]) -> float:
        """The degree as a polynomial of some names together; infinite for other functions."""
        return _degree(self.body, names)


def formula_of(given: object, time: str | None = None) -> Formula:
    """A formula from text or a symbolic expression; an OptionError if it is neither."""
    if isinstance(given, str):
        try:
            body = ast.parse(given.strip().replace("^", "**"), mode="eval").body
        except (SyntaxError, ValueError):
            raise OptionError(f"{quote(given)} is not an expression", term=given) from None
        _check(body, given)
        return Formula(given.strip(), body)
    if hasattr(given, "func") and hasattr(given, "args") and hasattr(given, "free_symbols"):
        body = _from_symbols(given, time, given)
        return Formula(str(given), body)
    raise OptionError(
        f"{quote(given)} is not an expression",
        term=given,
        remedy="give text, or an expression of SymPy",
    )


def _refused(whole: object, part: str) -> OptionError:
    return OptionError(
        f"{quote(whole)}: {quote(part)} is not understood",
        term=whole,
        remedy=f"use + - * / **, numbers, names and {', '.join(FUNCTIONS)}",
    )


def _check(node: ast.expr, text: str) -> None:
    """Raise an OptionError for anything but arithmetic."""
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return None
        case ast.Name():
            return None
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            _check(left, text)
            return _check(right, text)
        case ast.UnaryOp(op=op, operand=inner) if type(op) in _UNARY:
            return _check(inner, text)
        case ast.Call(func=ast.Name(id=name), args=[inner], keywords=[]) if name in FUNCTIONS:
            return _check(inner, text)
    raise _refused(text, ast.unparse(node))


def _evaluated(node: ast.expr, at: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(value=number):
            return float(number)  # type: ignore[arg-type]
        case ast.Name(id=name):
            return _CONSTANTS[name] if name in _CONSTANTS and name not in at else at[name]
        case ast.BinOp(left=left, op=op, right=right):
            return _BINARY[type(op)](_evaluated(left, at), _evaluated(right, at))
        case ast.UnaryOp(op=op, operand=inner):
            return _UNARY[type(op)](_evaluated(inner, at))
        case ast.Call(func=ast.Name(id=name), args=[inner]):
            return FUNCTIONS[name](_evaluated(inner, at))
    raise AssertionError(ast.dump(node))


def _degree(node: ast.expr, names: Collection[str]) -> float:
    match node:
        case ast.Name(id=name):
            return float(name in names)
        case ast.BinOp(left=left, op=op, right=right):
            degrees = _degree(left, names), _degree(right, names)
            if isinstance(op, ast.Mult):
                return sum(degrees)
            if isinstance(op, ast.Add | ast.Sub):
                return max(degrees)
            inside = degrees[1] if isinstance(op, ast.Div) else max(degrees)
            return _NESTED if inside else degrees[0]
        case ast.UnaryOp(operand=inner):
            return _degree(inner, names)
        case ast.Call(args=[inner]):
            return _NESTED if _degree(inner, names) else 0.0
    return 0.0


# --- symbolic expressions ------------------------------------------------------------------------


def _from_symbols(expression: Any, time: str | None, whole: object) -> ast.expr:
    """The syntax tree of a symbolic expression."""
    kind = expression.func.__name__
    if not expression.free_symbols and getattr(expression, "is_real", False):
        return _number(float(expression))
    if kind in ("Add", "Mul", "Pow"):
        operands = [_from_symbols(each, time, whole) for each in expression.args]
        join: Any = {"Add": ast.Add, "Mul": ast.Mult, "Pow": ast.Pow}[kind]
        return reduce(lambda a, b: ast.BinOp(a, join(), b), operands)
    name = _SYMBOLIC_NAMES.get(kind, kind)
    if name in FUNCTIONS and len(expression.args) == 1:
        inner = _from_symbols(expression.args[0], time, whole)
        return ast.Call(ast.Name(name, ast.Load()), [inner], [])
    try:
        return ast.Name(name_of(expression, time), ast.Load())
    except EvaluationError:
        raise _refused(whole, str(expression)) from None


def _number(value: float) -> ast.expr:
    return ast.Constant(value) if value >= 0.0 else ast.UnaryOp(ast.USub(), ast.Constant(-value))


def linear_names(formulas: Iterable[Formula], names: Iterable[str]) -> tuple[str, ...]:
    """As many of the names as enter all formulas linearly together, in their order."""
    listed, linear = list(formulas), list[str]()
    for name in names:
        if all(formula.degree({*linear, name}) <= 1.0 for formula in listed):
            linear.append(name)
    return tuple(linear)
