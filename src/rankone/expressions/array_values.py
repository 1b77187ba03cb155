"""Expressions as numbers: their trees evaluated with arrays in place of symbols and unknowns."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from functools import reduce

import numpy as np
import scipy.special
import sympy as sp

from rankone.support.arrays import Array

_NAMES = ("sin", "cos", "tan", "exp", "sinh", "cosh", "tanh", "log")
_FUNCTIONS = {
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
        function = _FUNCTIONS.get(type(expression))
        return math.nan if function is None else function(*arguments)
