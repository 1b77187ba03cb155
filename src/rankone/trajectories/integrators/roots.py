"""Roots of functions that change sign: many at once, however steep the functions are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rankone.support.arrays import Array

_MOST_ITERATIONS = 120  # About ten suffice, and about sixty where a function jumps
_ACCURACY = 1e-14  # Of a root: a few roundings
_JUMP = 1e-3  # Value at a root, over those at the ends, from which the function jumps there


def roots(function: Callable[[Array], Array], start: Array, end: Array) -> Array:
    """Roots in [0, 1] of functions that change sign from ``start`` to ``end``."""
    return _around(function, start, end).nearest


def roots_or_jumps(function: Callable[[Array], Array], start: Array, end: Array) -> Array:
    """The same; where the function jumps to the other sign, the place is behind the jump."""
    around = _around(function, start, end)
    jumps = around.height > _JUMP * np.minimum(np.abs(start), np.abs(end))
    return np.where(jumps, np.maximum(around.a, around.b), around.nearest)


@dataclass(frozen=True)
class _Interval:
    """Ends of intervals around roots, and the values of functions there."""

    a: Array
    b: Array
    at_a: Array
    at_b: Array

    @property
    def nearest(self) -> Array:
        """The ends with the smaller values."""
        return np.where(np.abs(self.at_a) < np.abs(self.at_b), self.a, self.b)

    @property
    def height(self) -> Array:
        """Absolute values there."""
        return np.minimum(np.abs(self.at_a), np.abs(self.at_b))


def _around(function: Callable[[Array], Array], start: Array, end: Array) -> _Interval:
    """Intervals around roots in [0, 1], about as short as rounding.

    After a secant by inverse quadratic interpolation, or halving where values are far from that
    (T. R. Chandrupatla, Adv. Eng. Software 28 (1997), 145).
    """
    around = _Interval(np.zeros_like(start), np.ones_like(end), start, end)
    share = end / (end - start)
    for _ in range(_MOST_ITERATIONS):
        a, b, at_a, at_b = around.a, around.b, around.at_a, around.at_b
        width = np.abs(a - b)
        done = (width <= _ACCURACY) | (around.height == 0.0)
        if done.all():
            break
        least = 0.5 * _ACCURACY / np.where(done, 1.0, width)
        x = np.where(done, b, b + np.clip(share, least, 1.0 - least) * (a - b))
        height = np.where(done, at_b, function(x))
        same = np.sign(height) == np.sign(at_b)
        c, at_c = np.where(same, b, a), np.where(same, at_b, at_a)
        around = _Interval(np.where(same, a, b), x, np.where(same, at_a, at_b), height)
        share = _interpolated(around, c, at_c)
    return around


def _interpolated(around: _Interval, c: Array, at_c: Array) -> Array:
    """Where roots are expected, as shares of the way from the last ends to the others."""
    a, b, at_a, at_b = around.a, around.b, around.at_a, around.at_b
    with np.errstate(all="ignore"):
        place, height = (b - a) / (c - a), (at_b - at_a) / (at_c - at_a)
        share = at_b / (at_a - at_b) * at_c / (at_a - at_c)
        share += (c - b) / (a - b) * at_b / (at_c - at_b) * at_a / (at_c - at_a)
    inside = (height**2 < place) & ((1.0 - height) ** 2 < 1.0 - place)
    return np.where(inside, share, 0.5)
