"""Right Radau collocation on one time slab."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre as npl

from rankone.support.arrays import Array
from rankone.tensors.bases.basis import legendre_values

__all__ = ["RadauCollocation", "inset", "insets"]

_INSET = 1e-9
"""Distance of times from the ends of a slab or segment, relative to its length."""
_INSET_SPACINGS = 8.0
"""The same in spacings of floating-point numbers, at least."""


def inset(start: float, end: float) -> float:
    """How far times stay inside a slab or segment: factors may jump at its ends."""
    return float(insets(np.asarray(start), np.asarray(end)))


def insets(starts: Array, ends: Array) -> Array:
    """The insets of several slabs or segments."""
    lengths = ends - starts
    rounding = _INSET_SPACINGS * np.spacing(np.maximum(np.abs(starts), np.abs(ends)))
    return np.asarray(np.minimum(np.maximum(_INSET * lengths, rounding), 0.25 * lengths))


class RadauCollocation:
    """Collocation at the K right Radau points of the unit slab (0, 1].

    The polynomial of degree K through the start value ``u_0`` and the K node values has, at the
    nodes, the derivative ``derivative @ u - start * u_0``. The end of the slab is the last node;
    the scheme is the K-stage Radau IIA method, of order 2 K - 1 there
    (Hairer & Wanner, Solving Ordinary Differential Equations II, IV.5). ``points`` are 0 and the
    nodes; ``to_modal`` takes values there to coefficients of orthonormal Legendre polynomials.
    """

    def __init__(self, count: int) -> None:
        self.count, self.nodes = count, _radau_points(count)
        self.points = np.concatenate([[0.0], self.nodes])
        full = _differentiation(self.points)[1:]
        self.derivative = full[:, 1:]
        self.start = -full[:, 0]
        self.to_modal = np.linalg.inv(legendre_values(2.0 * self.points - 1.0, count + 1))

    def times(self, start: float, length: float) -> Array:
        """The nodes of the slab [start, start + length], a little inside of it."""
        near = inset(start, start + length)
        return np.asarray(start + near + (length - 2.0 * near) * self.nodes)

    @staticmethod
    @lru_cache(maxsize=32)
    def of(count: int) -> RadauCollocation:
        """A shared instance with ``count`` nodes."""
        return RadauCollocation(count)


def _radau_points(count: int) -> Array:
    """Zeros of P_{K-1} - P_K on (0, 1], polished by Newton steps."""
    series = np.zeros(count + 1)
    series[count - 1], series[count] = 1.0, -1.0
    inner = np.sort(npl.legroots(series).real)[:-1]
    slope = npl.legder(series)
    for _ in range(3):
        inner -= npl.legval(inner, series) / npl.legval(inner, slope)
    return np.concatenate([0.5 * (inner + 1.0), [1.0]])


def _differentiation(points: Array) -> Array:
    """Differentiation matrix on distinct points, by barycentric weights."""
    gaps = points[:, None] - points[None, :]
    np.fill_diagonal(gaps, 1.0)
    weights = 1.0 / np.prod(gaps, axis=1)
    matrix = (weights[None, :] / weights[:, None]) / gaps
    np.fill_diagonal(matrix, 0.0)
    np.fill_diagonal(matrix, -matrix.sum(axis=1))
    return np.asarray(matrix)
