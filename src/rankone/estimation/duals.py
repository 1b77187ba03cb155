"""Arrays with their derivatives: what turns the slopes of states into those of expressions of them.

Forward differentiation (Griewank & Walther, Evaluating Derivatives, 2008, ch. 3): each operation
passes on its value and, by the chain rule, the derivatives along w directions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import special

from rankone.support.arrays import Array


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
