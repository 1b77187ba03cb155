"""Zeros that the numerator and the denominator of a quotient share, as in x/(exp(x) - 1).

Where curves through the samples have their zeros a distance apart, a pole is left whose strength is
that distance times the quotient; beside it, down to rounding, are its logarithms.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.trajectories.paths import TO_POWERS

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
