"""Arithmetic of named quantities with derivatives, from text or symbols.

Forward differentiation (Griewank & Walther, Evaluating Derivatives, 2008, ch. 3): each operation
passes on its value and, by the chain rule, the derivatives along w directions.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, Protocol

import numpy as np
from scipy import special

from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError, did_you_mean, listing, quote
from rankone.tensors.coordinates import name_of


@dataclass(frozen=True, eq=False)
class Dual:
    """An array (...) and its derivatives (..., w)."""

    value: Array
    slope: Array

    # NumPy leaves `array * dual` to the methods below
    __array_ufunc__ = None

    def _mapped(self, value: Array, factor: Array) -> Dual:
        return Dual(value, self.slope * factor[..., None])

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.slope)

    def __add__(self, other: Operand) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value + other.value, self.slope + other.slope)
        return Dual(self.value + other, self.slope + np.zeros(np.shape(other))[..., None])

    def __sub__(self, other: Operand) -> Dual:
        return self + (-other)

    def __rsub__(self, other: Operand) -> Dual:
        return -self + other

    def __mul__(self, other: Operand) -> Dual:
        if isinstance(other, Dual):
            slope = self.slope * other.value[..., None] + other.slope * self.value[..., None]
            return Dual(self.value * other.value, slope)
        return self._mapped(self.value * other, np.asarray(other, dtype=float))

    def __truediv__(self, other: Operand) -> Dual:
        return self * other**-1.0

    def __rtruediv__(self, other: Operand) -> Dual:
        return self**-1.0 * other

    def __pow__(self, power: Operand) -> Dual:
        if isinstance(power, Dual):
            return FUNCTIONS["exp"](FUNCTIONS["log"](self) * power)  # type: ignore[return-value]
        exponent = np.asarray(power, dtype=float)
        # x**0 is constant, also where x is zero
        factor = np.where(exponent == 0.0, 0.0, exponent * self.value ** (exponent - 1.0))
        return self._mapped(self.value**exponent, factor)

    def __rpow__(self, base: Array | float) -> Dual:
        array = np.asarray(base, dtype=float)
        power = array**self.value
        return self._mapped(power, power * np.log(array))

    __radd__, __rmul__ = __add__, __mul__


Operand = Dual | Array | float
"""What an operation takes: numbers, arrays, or arrays with derivatives."""


def _function(
    of: Callable[[Array], Array], derivative: Callable[[Array], Array]
) -> Callable[[Operand], Operand]:
    def applied(x: Operand) -> Operand:
        if isinstance(x, Dual):
            return x._mapped(of(x.value), derivative(x.value))
        return of(np.asarray(x, dtype=float))

    return applied


FUNCTIONS: dict[str, Callable[[Operand], Operand]] = {
    "sqrt": _function(np.sqrt, lambda x: 0.5 / np.sqrt(x)),
    "exp": _function(np.exp, np.exp),
    "log": _function(np.log, lambda x: 1.0 / x),
    "log10": _function(np.log10, lambda x: 1.0 / (np.log(10.0) * x)),
    "log2": _function(np.log2, lambda x: 1.0 / (np.log(2.0) * x)),
    "sin": _function(np.sin, np.cos),
    "cos": _function(np.cos, lambda x: -np.sin(x)),
    "tan": _function(np.tan, lambda x: 1.0 + np.tan(x) ** 2),
    "sinh": _function(np.sinh, np.cosh),
    "cosh": _function(np.cosh, np.sinh),
    "tanh": _function(np.tanh, lambda x: 1.0 - np.tanh(x) ** 2),
    "atan": _function(np.arctan, lambda x: 1.0 / (1.0 + x**2)),
    "erf": _function(special.erf, lambda x: 2.0 / np.sqrt(np.pi) * np.exp(-(x**2))),
    "abs": _function(np.abs, np.sign),
}
"""The functions of one argument that expressions may have, by name."""


def coordinate(values: Array, column: int, width: int) -> Dual:
    """Values (K,) of a coordinate as a dual (K, 1) whose derivative is one in its own column."""
    slope = np.zeros((1, 1, width))
    slope[..., column] = 1.0
    return Dual(values[:, None], slope)


def value_of(x: Operand) -> Array:
    """The array alone."""
    return x.value if isinstance(x, Dual) else np.asarray(x, dtype=float)


def slope_of(x: Operand, width: int) -> Array:
    """The derivatives (..., w): zero for what has none."""
    return x.slope if isinstance(x, Dual) else np.zeros((*np.shape(x), width))


def with_shape(x: Operand, shape: tuple[int, ...], width: int) -> Dual:
    """An operand as a dual with every axis in full."""
    value = np.broadcast_to(value_of(x), shape)
    return Dual(value, np.broadcast_to(slope_of(x, width), (*shape, width)))


# -----------------------------------------------------------------------------
# Quantities of parameters, with derivatives: functions of a dictionary, text, or symbols.


# Step of differences, in shares of the interval of a parameter: truncation near rounding
_STEP_SHARE = 1e-5


class Quantity(Protocol):
    """A number that depends on parameters."""

    def value(self, point: Mapping[str, float]) -> float:
        """The number at a point."""

    def gradient(self, point: Mapping[str, float], widths: Mapping[str, float]) -> Array:
        """Derivatives (n,) with respect to the parameters of ``widths``.

        ``widths`` are the lengths of their intervals.
        """


class _OfFormula:
    def __init__(self, formula: Formula) -> None:
        self.formula = formula

    def value(self, point: Mapping[str, float]) -> float:
        with np.errstate(all="ignore"):
            return float(self.formula({name: np.float64(x) for name, x in point.items()}))

    def gradient(self, point: Mapping[str, float], widths: Mapping[str, float]) -> Array:
        seeds = dict(zip(widths, np.eye(len(widths)), strict=True))
        at = {
            name: Dual(np.array(x), seeds[name]) if name in seeds else x
            for name, x in point.items()
        }
        with np.errstate(all="ignore"):
            return slope_of(self.formula(at), len(widths))


class _OfFunction:
    def __init__(self, function: Callable[[dict[str, float]], float]) -> None:
        self.function = function

    def value(self, point: Mapping[str, float]) -> float:
        return float(self.function(dict(point)))

    def gradient(self, point: Mapping[str, float], widths: Mapping[str, float]) -> Array:
        """By central differences of fourth order."""
        slopes = []
        for name, width in widths.items():
            h = _STEP_SHARE * width

            def at(shift: float, name: str = name) -> float:
                return self.value({**point, name: point[name] + shift})

            near, far = at(h) - at(-h), at(2.0 * h) - at(-2.0 * h)
            slopes.append((8.0 * near - far) / (12.0 * h))
        return np.array(slopes)


def quantity(given: object, names: Sequence[str]) -> Quantity:
    """A quantity of the parameters by name, from a function, text or an expression."""
    symbolic = hasattr(given, "free_symbols")
    if isinstance(given, str) or symbolic:
        formula = formula_of(given)
        for name in sorted(formula.names):
            if name not in names:
                raise OptionError(
                    f"{quote(given)}: there is no parameter {quote(name)}"
                    f"{did_you_mean(name, names)}",
                    term=given,
                    remedy=f"known are {listing(names)}",
                )
        return _OfFormula(formula)
    if callable(given):
        return _OfFunction(given)
    raise OptionError(
        f"{given!r} is not a quantity of the parameters",
        term=given,
        remedy="give text, an expression of the parameters, or a function of a dictionary",
    )


# -----------------------------------------------------------------------------
# Formulas: arithmetic of named quantities, from text or a symbolic expression.
#
# Text is read as arithmetic and nothing else. A symbolic expression is read by what it offers, its
# function and arguments, so that SymPy is not needed.


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
