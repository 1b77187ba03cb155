"""Formulas as numbers: the syntax tree of a text evaluated with arrays in place of names."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping

import numpy as np
import scipy.special

from rankone.support.arrays import Array

Value = Array | np.float64
_OPERATORS: dict[type[ast.operator], Callable[[Value, Value], Value]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_AS_IN_NUMPY = ("sin", "cos", "tan", "exp", "sinh", "cosh", "tanh", "sqrt", "log", "arctan")
_FUNCTIONS: dict[str, Callable[[Value], Value]] = {
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
        case ast.Call(func=ast.Name(id=name), args=[argument]) if name in _FUNCTIONS:
            return _FUNCTIONS[name](value_of(argument, values))
    return _NO_VALUE
