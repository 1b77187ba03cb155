"""What evaluators over clock time share: every evaluation is one of curves."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np

from rankone.support.arrays import Array
from rankone.tensors.evaluator import Rows

# Times and points at once, with what decides which slabs hold there: few bytes beside the values
_AT_ONCE = 1 << 18
Part = tuple[slice, slice, slice]
"""Some of the values (rows, T, N)."""


class ClockEvaluator(ABC):
    """States at clock times, with the methods of :class:`TrainEvaluator`."""

    @property
    @abstractmethod
    def numbers_each(self) -> int:
        """Numbers that decide at a point of the parameters which slabs hold."""

    @abstractmethod
    def count(self, rows: Rows) -> int:
        """How many states some rows are."""

    @abstractmethod
    def curves(self, times: Array, points: Array, rows: Rows) -> Array:
        """States at several times for each point of the parameters: shape (rows, T, N).

        ``times`` (T, N) belong to the ``points`` (d, N), or of the shape (T, 1) to all.
        """

    def parts(self, times: Array, points: Array) -> Iterator[tuple[Part, Array, Array]]:
        """Parts of the values (rows, T, N) that are evaluated at once, with times and points."""
        several, count = len(times), points.shape[1]
        columns = max(_AT_ONCE // (min(several, _AT_ONCE) + self.numbers_each), 1)
        for first in range(0, several, _AT_ONCE):
            for begin in range(0, count, columns):
                when, here = slice(first, first + _AT_ONCE), slice(begin, begin + columns)
                at = times[when] if times.shape[1] == 1 else times[when, here]
                yield (slice(None), when, here), at, points[:, here]

    def one(self, point: Sequence[float], rows: Rows) -> Array:
        """States at one point, 1 + d numbers: shape (rows,)."""
        return self.many(np.array(point, dtype=float)[:, None], rows)[:, 0]

    def many(self, points: Array, rows: Rows) -> Array:
        """States at paired points (1 + d, N): shape (rows, N)."""
        return self.curves(points[:1], points[1:], rows)[:, 0]

    def grid(self, axes: Sequence[Array], rows: Rows) -> Array:
        """States on a tensor grid of 1 + d axes: (rows, *sizes of the axes)."""
        times, sizes = np.asarray(axes[0])[:, None], [axis.size for axis in axes]
        states = np.empty((self.count(rows), sizes[0], math.prod(sizes[1:])))
        columns = max(_AT_ONCE // max(sizes[0], 1), 1)
        for begin in range(0, states.shape[2], columns):
            here = slice(begin, min(begin + columns, states.shape[2]))
            places = np.unravel_index(np.arange(here.start, here.stop), sizes[1:] or 1)
            points = np.empty((len(sizes) - 1, here.stop - begin))
            for row, axis, place in zip(points, axes[1:], places, strict=False):
                row[:] = axis[place]
            states[:, :, here] = self.curves(times, points, rows)
        return states.reshape(len(states), *sizes)
