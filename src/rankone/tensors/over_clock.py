"""What evaluators over clock time share: every evaluation is one of curves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from rankone.support.arrays import Array
from rankone.tensors.evaluator import Rows


class ClockEvaluator(ABC):
    """States at clock times, with the methods of :class:`TrainEvaluator`."""

    @abstractmethod
    def curves(self, times: Array, points: Array, rows: Rows) -> Array:
        """States at several times for each point of the parameters: shape (rows, T, N).

        ``times`` (T, N) belong to the ``points`` (d, N), or of the shape (T, 1) to all.
        """

    def one(self, point: Sequence[float], rows: Rows) -> Array:
        """States at one point, 1 + d numbers: shape (rows,)."""
        return self.many(np.array(point, dtype=float)[:, None], rows)[:, 0]

    def many(self, points: Array, rows: Rows) -> Array:
        """States at paired points (1 + d, N): shape (rows, N)."""
        return self.curves(points[:1], points[1:], rows)[:, 0]

    def grid(self, axes: Sequence[Array], rows: Rows) -> Array:
        """States on a tensor grid of 1 + d axes: (rows, *sizes of the axes)."""
        sizes = [axis.size for axis in axes]
        mesh = np.meshgrid(*axes[1:], indexing="ij")
        points = np.stack([each.ravel() for each in mesh]) if mesh else np.empty((0, 1))
        states = self.curves(np.asarray(axes[0])[:, None], points, rows)
        return states.reshape(len(states), *sizes)
