"""Expressions and formulas as numbers: their trees evaluated with arrays."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from functools import reduce

import numpy as np
import scipy.special
import sympy as sp

from rankone.support.arrays import Array

_NAMES = ("sin", "cos", "tan", "exp", "sinh", "cosh", "tanh", "log")
_OF_SYMPY = {
    **{getattr(sp, name): getattr(np, name) for name in _NAMES},
    sp.atan: np.arctan,
    sp.erf: scipy.special.erf,
}


class ArrayProgram:
    """Evaluates expressions of leaves with known values, each subexpression once.

    The value is not a number where there are other functions than smooth ones.
    """

    def __init__(self, leaves: Mapping[sp.Basic, Array]) -> None:
        self._values: dict[sp.Basic, Array | float] = dict(leaves)

    def __call__(self, expression: sp.Expr) -> Array | float:
        """The value of an expression."""
        if expression not in self._values:
            self._values[expression] = self._value(expression)
        return self._values[expression]

    def _value(self, expression: sp.Expr) -> Array | float:
        if expression.is_number:
            return float(expression)
        arguments = [self(argument) for argument in expression.args]
        if expression.is_Add:
            return reduce(operator.add, arguments)
        if expression.is_Mul:
            return reduce(operator.mul, arguments)
        if isinstance(expression, sp.exp):
            return np.exp(arguments[0])
        if expression.is_Pow:
            base, exponent = arguments
            return base**exponent
        function = _OF_SYMPY.get(type(expression))
        return math.nan if function is None else function(*arguments)


# -----------------------------------------------------------------------------
# Formulas as numbers: the syntax tree of a text evaluated with arrays in place of names.


Value = Array | np.float64
_OPERATORS: dict[type[ast.operator], Callable[[Value, Value], Value]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_AS_IN_NUMPY = ("sin", "cos", "tan", "exp", "sinh", "cosh", "tanh", "sqrt", "log", "arctan")
_OF_TEXT: dict[str, Callable[[Value], Value]] = {
    **{name: getattr(np, name) for name in _AS_IN_NUMPY},
    "atan": np.arctan,
    "erf": scipy.special.erf,
    "ln": np.log,
}
_PI, _NO_VALUE = np.float64(np.pi), np.float64(np.nan)


def value_of(tree: ast.expr, values: Mapping[str, Array]) -> Value:
    """The value of arithmetic of names and smooth functions; not a number for all else."""
    match tree:
        case ast.Constant(value=int() | float() as number):
            return np.float64(number)
        case ast.Name(id=name):
            return values.get(name, _PI if name == "pi" else _NO_VALUE)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -value_of(operand, values)
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return value_of(operand, values)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](value_of(left, values), value_of(right, values))
        case ast.Call(func=ast.Name(id=name), args=[argument]) if name in _OF_TEXT:
            return _OF_TEXT[name](value_of(argument, values))
    return _NO_VALUE
