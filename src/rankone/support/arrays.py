"""The array type of the numeric modules, points of a cube, and bisection."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers."""

_ITERATIONS = 40  # Fixed-point iterations for the root of φ^(d + 1) = φ + 1
_MOST_OF_SEQUENCE = 2  # Coordinates up to which a sequence is even in every direction


def sequence(count: int, d: int, generator: np.random.Generator) -> Array:
    """Points (count, d) of the unit cube of which the first few are even as well.

    Shifted multiples of powers of 1/φ, the real root of φ^(d + 1) = φ + 1 (additive recurrence;
    M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018). In more than two
    coordinates they are on few hyperplanes in some direction.
    """
    phi = 2.0
    for _ in range(_ITERATIONS):
        phi = (1.0 + phi) ** (1.0 / (d + 1))
    steps = phi ** -np.arange(1.0, d + 1.0)
    return np.asarray((generator.random(d) + np.outer(np.arange(1, count + 1), steps)) % 1.0)


def spread(count: int, d: int, generator: np.random.Generator) -> Array:
    """Points (count, d) of the unit cube, more even than random ones in every direction.

    Those of :func:`sequence` in one and two coordinates, where no direction is bad; else a Latin
    hypercube: each coordinate has one point in each of ``count`` intervals, in an order of its own
    (McKay, Beckman & Conover, "A comparison of three methods for selecting values of input
    variables", Technometrics 21, 1979). ``docs/decisions/check-points.md`` has figures.
    """
    if d <= _MOST_OF_SEQUENCE:
        return sequence(count, d, generator)
    order = np.tile(np.arange(count, dtype=float), (d, 1))
    return np.asarray((generator.permuted(order, axis=1).T + generator.random((count, d))) / count)


def corners(d: int, most: int, generator: np.random.Generator) -> Array:
    """Corners of the unit cube, (m, d): all, or ``most`` of them: two opposite and random ones."""
    if 2**d <= most:
        return np.array(list(itertools.product((0.0, 1.0), repeat=d))).reshape(2**d, d)
    drawn = generator.integers(0, 2, (most, d)).astype(float)
    drawn[0], drawn[1] = 0.0, 1.0
    return drawn


def bisected(
    a: Array, b: Array, like_a: Callable[[Array], NDArray[np.bool_]], halvings: int
) -> tuple[Array, Array]:
    """The ends of segments [a, b] after halvings around a border between ``a`` and ``b``.

    ``like_a`` tells for points, one on each segment, whether they are on the side of ``a``. Its
    answer broadcasts with the points: (m,) for points (m,), but (m, 1) for points (m, d).
    """
    for _ in range(halvings):
        middle = 0.5 * (a + b)
        near_a = like_a(middle)
        a, b = np.where(near_a, middle, a), np.where(near_a, b, middle)
    return a, b
