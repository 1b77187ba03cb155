"""Ranges of values, bounds of functions over them, and zeros that quotients share.

Where curves through the samples have their zeros a distance apart, a pole is left whose strength is
that distance times the quotient; beside it, down to rounding, are its logarithms.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.trajectories.integrators.integrator import TO_POWERS

_NEWTON_STEPS = 8  # To a zero of the curve through samples
_SHARED = 1e-3  # Distance of two zeros, in lengths of a piece, below which they may be one
_LOGARITHM = 40.0  # Of a piece over rounding


def has_single_zero(values: Array) -> NDArray[np.bool_]:
    """Whether samples (K, N) rise or fall through zero, for each piece: (N,)."""
    slopes = np.diff(values, axis=0)
    rises = (slopes > 0.0).all(axis=0) | (slopes < 0.0).all(axis=0)
    return np.asarray(rises & (values[0] * values[-1] < 0.0))


def doubt_beside_zero(above: Array, below: Array, quotient: Array) -> Array:
    """The doubt (N,) about a quotient at the single zeros of its denominator.

    All are samples (K, N). The doubt is infinite where the numerator has no zero close by.
    """
    upper, lower = (TO_POWERS @ values for values in (above, below))
    slope = np.arange(1, len(lower))[:, None] * lower[1:]
    zero = np.zeros(below.shape[1])
    for _ in range(_NEWTON_STEPS):
        zero = np.clip(zero - _curve(zero, lower) / _curve(zero, slope), -1.0, 1.0)
    distance = np.abs(_curve(zero, upper)) / np.abs(above).max(axis=0)
    missed = _LOGARITHM * distance * np.abs(quotient).max(axis=0)
    return np.where(distance < _SHARED, missed, np.inf)


def _curve(places: Array, coefficients: Array) -> Array:
    """Polynomials at one place (N,) each, from their coefficients (K, N)."""
    return np.asarray(polyval(places, coefficients, tensor=False))


# -----------------------------------------------------------------------------
# Ranges of values, bounds of functions over them, and whether samples resolve a function there.
#
# Ranges are two arrays, their lower and upper ends. They are computed without outward rounding.


Bounds: TypeAlias = "Callable[[Array, Array], tuple[Array, Array]]"
Resolved: TypeAlias = "Callable[[Array, Array], NDArray[np.bool_]]"
Function: TypeAlias = Callable[..., Any]

BETWEEN = 0.15  # How far values go beyond samples of a smooth function, in ranges of the samples
NEAR = 4.0  # Ratio of an argument's ends that a singularity at zero leaves resolved
SCALE = 2.0  # Half a range of exponentials and waves that samples resolve
_STEEPEST = 8.0  # Largest slope of a function within its scale, over its mean slope, about
_FAR = 1e9  # Longest argument of a sine of which the extrema are told


def without_nan(low: Array, high: Array) -> tuple[Array, Array]:
    """A range, endless where it is not known."""
    return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)


def around(values: Array, beyond: float) -> tuple[Array, Array]:
    """Bounds of a smooth function that goes beyond its samples (K, N) by a part of their range."""
    low, high = values.min(axis=0), values.max(axis=0)
    margin = beyond * (high - low)
    return low - margin, high + margin


def width_of(low: Array, high: Array) -> Array:
    """The width of ranges, infinite where it is not known."""
    width = high - low
    return np.where(np.isnan(width), np.where(low == high, 0.0, np.inf), width)


def known(doubt: Array) -> Array:
    """A doubt, infinite where it is not a number."""
    return np.where(np.isnan(doubt), np.inf, doubt)


def times(a: Array, b: Array) -> Array:
    """A product in which zero times infinity is zero."""
    product = a * b
    return np.where(np.isnan(product), 0.0, product)


def share_in_doubt(doubt: Array, low: Array, high: Array) -> Array:
    """The share of a function's range that is in doubt if its argument, in a range, is."""
    share = known(_STEEPEST * doubt / np.where(high > low, high - low, 1.0))
    return np.minimum(share, 1.0)


# --- whether samples resolve a function over a range of its argument ------------------------------


def within(scale: float) -> Resolved:
    """Whether ranges are no longer than twice a scale."""
    return lambda low, high: high - low <= 2.0 * scale


def away_from(singularity: float, ratio: float = NEAR) -> Resolved:
    """Whether a singularity is outside of ranges, and not close to either end."""

    def resolved(low: Array, high: Array) -> NDArray[np.bool_]:
        a, b = low - singularity, high - singularity
        return ((a > 0.0) & (b <= ratio * a)) | ((b < 0.0) & (a >= ratio * b))

    return resolved


def inside(border: float) -> Resolved:
    """Whether ranges are between minus and plus a border."""
    return lambda low, high: (low > -border) & (high < border)


def one_sided(low: Array, high: Array) -> NDArray[np.bool_]:
    """Whether ranges have one sign."""
    return (low >= 0.0) | (high <= 0.0)


# --- bounds of functions over a range of their argument -------------------------------------------


def rising_bounds(function: Function, domain: tuple[float, float] = (-np.inf, np.inf)) -> Bounds:
    """Bounds of a function that rises on its domain."""

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        return function(np.clip(low, *domain)), function(np.clip(high, *domain))

    return bounds


def falling_bounds(function: Function, domain: tuple[float, float] = (-np.inf, np.inf)) -> Bounds:
    """Bounds of a function that falls on its domain."""

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        return function(np.clip(high, *domain)), function(np.clip(low, *domain))

    return bounds


def even_bounds(function: Function) -> Bounds:
    """Bounds of an even function that rises from zero on."""

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        at_low, at_high = np.asarray(function(low)), np.asarray(function(high))
        least = np.where((low <= 0.0) & (high >= 0.0), function(0.0), np.minimum(at_low, at_high))
        return np.asarray(least), np.maximum(at_low, at_high)

    return bounds


def wave_bounds(shift: float, at_top: float = 1.0) -> Bounds:
    """Bounds of ``sin(x + shift)`` plus one number less than ``at_top``."""

    def passes(low: Array, high: Array, place: float) -> NDArray[np.bool_]:
        first = np.ceil((low - place) / (2.0 * np.pi))
        return np.asarray((2.0 * np.pi * first + place <= high) | ~(high - low < _FAR))

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        low, high = low + shift, high + shift
        a, b = np.sin(low), np.sin(high)
        least = np.where(passes(low, high, -0.5 * np.pi), -1.0, np.minimum(a, b))
        most = np.where(passes(low, high, 0.5 * np.pi), 1.0, np.maximum(a, b))
        return least + (at_top - 1.0), most + (at_top - 1.0)

    return bounds


def tan_bounds(low: Array, high: Array) -> tuple[Array, Array]:
    """Bounds of a tangent: endless across a pole."""
    pole = np.floor(high / np.pi + 0.5) > np.floor(low / np.pi + 0.5)
    return np.where(pole, -np.inf, np.tan(low)), np.where(pole, np.inf, np.tan(high))


def tan_resolved(low: Array, high: Array) -> NDArray[np.bool_]:
    """Whether ranges are no longer than their distance from a pole of the tangent, about."""
    middle = (0.5 * (low + high) + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    return np.asarray(0.5 * (high - low) <= 0.8 * (0.5 * np.pi - np.abs(middle)))


def reciprocal_bounds(low: Array, high: Array) -> tuple[Array, Array]:
    """Bounds of ``1/x``: endless across zero."""
    across = (low < 0.0) & (high > 0.0)
    below = np.where(high == 0.0, -np.inf, 1.0 / high)
    above = np.where(low == 0.0, np.inf, 1.0 / low)
    return np.where(across, -np.inf, below), np.where(across, np.inf, above)


def sinc_bounds(low: Array, high: Array) -> tuple[Array, Array]:
    """Bounds of ``sin(pi x)/(pi x)``: it is below one over ``pi x``."""
    nearest = np.pi * np.where(one_sided(low, high), np.minimum(np.abs(low), np.abs(high)), 0.0)
    height = np.where(nearest > 1.0, 1.0 / np.maximum(nearest, 1.0), 1.0)
    return -np.minimum(height, 0.22), height
