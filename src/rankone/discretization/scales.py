"""Scales of a parameter: the coordinate s = g(x) in which its modes are polynomials.

Every scale ascends, so that intervals, elements and nodes keep their order. A parameter over
decades is smooth in its logarithm, and one that divides in its reciprocal.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rankone.support.arrays import Array

__all__ = [
    "IDENTITY",
    "SCALES",
    "Identity",
    "Logarithm",
    "Reciprocal",
    "Scale",
    "first_scale",
]

# Ratio of the ends of an interval above which its decades are all looked at: its logarithm is the
# first coordinate, and another one has to be better
_DECADES_RATIO = 10.0

_MOST_SLOPE_MODES = 200  # Modes looked at for the slope of a scale: it is analytic on an interval
_SLOPE_TOLERANCE = 1e-15  # Size of the modes of a slope that are left out, relative to the largest
_NOISE_MODES = 20  # Highest modes, which show the rounding errors of the others
_NOISE_FACTOR = 8.0  # Size of the modes that are left out, over these rounding errors


@dataclass(frozen=True)
class Scale(ABC):
    """A smooth, ascending coordinate s = g(x) of a parameter x."""

    kind: ClassVar[str]

    @abstractmethod
    def to_scale(self, x: Array) -> Array:
        """The coordinate s = g(x), of the shape of x."""

    @abstractmethod
    def from_scale(self, s: Array) -> Array:
        """The parameter x at coordinates s, of their shape."""

    @abstractmethod
    def slope(self, x: Array) -> Array:
        """The derivative ds/dx at x, positive, of the shape of x."""

    def allows(self, lower: float, upper: float) -> bool:
        """Whether the coordinate is finite on the whole interval."""
        return lower < upper

    @property
    def is_identity(self) -> bool:
        return False

    def slope_modes(self, lower: float, upper: float, inverse: bool = False) -> int:
        """Number of modes in s on an interval that the slope ds/dx needs, to rounding.

        ``inverse`` stands for dx/ds, the density of x over s.
        """
        if self.is_identity:
            return 1
        start, end = self.to_scale(np.array([lower, upper]))
        angles = np.pi * (np.arange(_MOST_SLOPE_MODES) + 0.5) / _MOST_SLOPE_MODES
        slopes = self.slope(self.from_scale(start + 0.5 * (end - start) * (1.0 + np.cos(angles))))
        modes = np.cos(np.arange(_MOST_SLOPE_MODES)[:, None] * angles)
        spectrum = np.abs(modes @ (1.0 / slopes if inverse else slopes))
        noise = _NOISE_FACTOR * spectrum[-_NOISE_MODES:].max()
        significant = spectrum > max(_SLOPE_TOLERANCE * spectrum.max(), noise)
        return int(np.flatnonzero(significant)[-1]) + 1


@dataclass(frozen=True)
class Identity(Scale):
    """The parameter itself."""

    kind = "linear"

    def to_scale(self, x: Array) -> Array:
        return x

    def from_scale(self, s: Array) -> Array:
        return s

    def slope(self, x: Array) -> Array:
        return np.ones_like(x)

    @property
    def is_identity(self) -> bool:
        return True


@dataclass(frozen=True)
class Logarithm(Scale):
    """The natural logarithm of a positive parameter."""

    kind = "log"

    def to_scale(self, x: Array) -> Array:
        return np.asarray(np.log(x))

    def from_scale(self, s: Array) -> Array:
        return np.asarray(np.exp(s))

    def slope(self, x: Array) -> Array:
        return 1.0 / x

    def allows(self, lower: float, upper: float) -> bool:
        return 0.0 < lower < upper


@dataclass(frozen=True)
class Reciprocal(Scale):
    """Minus one over a parameter that does not change its sign: the minus makes it ascend."""

    kind = "reciprocal"

    def to_scale(self, x: Array) -> Array:
        return -1.0 / x

    def from_scale(self, s: Array) -> Array:
        return -1.0 / s

    def slope(self, x: Array) -> Array:
        return 1.0 / (x * x)

    def allows(self, lower: float, upper: float) -> bool:
        return 0.0 < lower < upper or lower < upper < 0.0


IDENTITY = Identity()
SCALES: dict[str, Scale] = {each.kind: each for each in (IDENTITY, Logarithm(), Reciprocal())}
"""The scales by the words that users write."""


def first_scale(lower: float, upper: float) -> Scale:
    """The coordinate in which a parameter is looked at before anything else is known of it."""
    decades = lower > 0.0 and upper > _DECADES_RATIO * lower
    return Logarithm() if decades else IDENTITY
