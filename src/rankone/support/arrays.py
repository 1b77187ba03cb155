"""Arrays: their types, points of a cube, bisection, and tuples that are made when first read."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TypeVar, overload

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers."""

HALVINGS = 60
"""Bisections of an interval to the last digit."""
_MOST_OF_SEQUENCE = 2  # Coordinates up to which a sequence is even in every direction


def sequence(count: int, d: int, generator: np.random.Generator) -> Array:
    """Points (count, d) of the unit cube of which the first few are even as well.

    Shifted multiples of powers of 1/φ, the real root of φ^(d + 1) = φ + 1 (additive recurrence;
    M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018). In more than two
    coordinates they are on few hyperplanes in some direction.
    """
    phi = 2.0
    for _ in range(HALVINGS):
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
    a: Array, b: Array, like_a: Callable[[Array], NDArray[np.bool_]], halvings: int = HALVINGS
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


# -----------------------------------------------------------------------------
# Tuples that are made when they are first read.


Item = TypeVar("Item", covariant=True)


class Deferred(Sequence[Item]):
    """A tuple of a known length that is made when it is first read.

    A thousand equations take seconds to write as expressions, and most of what is done with a
    system of many states never looks at them. ``make`` can be pickled, and is what a pickle has.
    """

    def __init__(self, length: int, make: Callable[[], Sequence[Item]]) -> None:
        self._length, self._make = length, make

    @cached_property
    def _items(self) -> tuple[Item, ...]:
        return tuple(self._make())

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, index: int) -> Item: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Item, ...]: ...
    def __getitem__(self, index: int | slice) -> Item | tuple[Item, ...]:
        return self._items[index]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and self._items == tuple(other)

    def __hash__(self) -> int:
        return hash(self._items)

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self._length, self._make)
