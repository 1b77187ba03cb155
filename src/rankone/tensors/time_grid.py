"""Functions of time on consecutive slabs, and Radau collocation on one of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial import legendre as npl
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from rankone.support.arrays import COINCIDENT, NEGLIGIBLE, TINY, Array, bisected
from rankone.tensors.basis import legendre_derivative, legendre_values

_SHORTEST_OF_HORIZON = 1e-18
"""Shortest slab, relative to the horizon: a layer at t = 0 may be that thin."""
_PROBES = np.array([-0.999999, -0.97, -0.31, 0.42, 0.98, 0.999999])
"""Where interpolation in time is tried, on [-1, 1]: beside the ends, where it may jump."""
_DENSE_RATIO = 4
"""Points of a slab where extremes and crossings are looked for, over its nodes."""
_NEWTON_STEPS = 8
"""Newton steps from the largest of these points to a maximum; convergence is quadratic."""


@lru_cache
def _nodes(count: int) -> tuple[Array, Array]:
    """Gauss-Legendre nodes on [-1, 1], and the matrix from values there to coefficients."""
    xi, _ = leggauss(count)
    return xi, np.asarray(np.linalg.inv(legendre_values(xi, count)))


@dataclass(frozen=True)
class TimeGrid:
    """``count`` Gauss-Legendre nodes on each of the slabs between ascending ``breaks``."""

    breaks: tuple[float, ...]
    count: int

    @property
    def slabs(self) -> int:
        """Number of slabs."""
        return len(self.breaks) - 1

    @cached_property
    def times(self) -> Array:
        """Nodes of all slabs, ascending, shape (T,)."""
        xi = 0.5 * (_nodes(self.count)[0] + 1.0)
        return np.concatenate([a + (b - a) * xi for a, b in itertools.pairwise(self.breaks)])

    @property
    def to_modal(self) -> Array:
        """From values at the nodes of a slab to coefficients of its modes, (count, count)."""
        return _nodes(self.count)[1]

    def highest_modes(self, values: Array) -> Array:
        """Largest of the last two Legendre modes of values (n, T, m) on each slab: (slabs,)."""
        local = values.reshape(len(values), self.slabs, self.count, -1)
        return np.asarray(np.abs(self.to_modal[-2:] @ local).max(axis=(0, 2, 3), initial=0.0))


def resolving_breaks(
    values: Callable[[Array], Array],
    edges: Sequence[float],
    count: int,
    tolerance: float,
    most: int,
    held: int,
) -> tuple[float, ...] | None:
    """Ends of at most ``most`` slabs on which ``count`` nodes resolve functions of time, or None.

    The functions (..., T) are in units of their sizes, and read at so many times as are ``held`` at
    once, or at those of one slab. No slab crosses one of the ``edges``. Slabs are halved until the
    polynomial through the nodes is close at the ends and in between.
    """
    xi, to_modal = _nodes(count)
    at_probes = legendre_values(_PROBES, count) @ to_modal
    inside = 0.5 * (np.concatenate([xi, _PROBES]) + 1.0)
    waiting = list(itertools.pairwise(edges))
    done: list[tuple[float, float]] = []
    horizon = edges[-1] - edges[0]
    while waiting:
        if len(waiting) + len(done) > most:
            return None
        errors, together = list[float](), max(held // inside.size, 1)
        for first in range(0, len(waiting), together):
            some = waiting[first : first + together]
            times = np.concatenate([a + (b - a) * inside for a, b in some])
            sampled = values(times).reshape(-1, len(some), inside.size)
            missed = np.abs(sampled[..., count:] - sampled[..., :count] @ at_probes.T)
            errors += missed.max(axis=(0, 2)).tolist()
        halves = []
        for (a, b), error in zip(waiting, errors, strict=True):
            shortest = max(COINCIDENT * max(abs(a), abs(b)), _SHORTEST_OF_HORIZON * horizon)
            if error <= tolerance or b - a < shortest:
                done.append((a, b))
            else:
                halves += [(a, 0.5 * (a + b)), (0.5 * (a + b), b)]
        waiting = halves
    return (*(a for a, _ in sorted(done)), edges[-1])


class Polynomials:
    """Functions of time, by their values (T, m) at the nodes of a grid."""

    def __init__(self, grid: TimeGrid, values: Array) -> None:
        local = values.reshape(grid.slabs, grid.count, -1)
        at_nodes = legendre_values(_nodes(grid.count)[0], grid.count)
        self.grid, self.modes = grid, np.asarray(np.linalg.solve(at_nodes, local))
        self.breaks = np.array(grid.breaks)
        self.half = 0.5 * np.diff(self.breaks)

    def integral(self, start: float, end: float) -> Array:
        """Integral from one break of the grid to another, (m,)."""
        inside = (self.breaks[:-1] >= start) & (self.breaks[1:] <= end)
        return np.asarray(2.0 * self.half[inside] @ self.modes[inside, 0])

    def until(self, ends: Array) -> Array:
        """Integrals from the first break to ends (m,) of their own, (m,)."""
        slab = np.clip(np.searchsorted(self.breaks, ends, side="right") - 1, 0, self.half.size - 1)
        columns = np.arange(ends.size)
        whole = 2.0 * self.half[:, None] * self.modes[:, 0]
        before = np.concatenate([np.zeros((1, ends.size)), np.cumsum(whole, axis=0)])
        xi = (ends - self.breaks[slab]) / self.half[slab] - 1.0
        inside = _from_start(xi, self.grid.count) * self.modes[slab, :, columns]
        return np.asarray(before[slab, columns] + self.half[slab] * inside.sum(axis=1))

    def running(self, start: float) -> Array:
        """Integrals from a break of the grid to all nodes, (T, m)."""
        whole = 2.0 * self.half[:, None] * self.modes[:, 0]
        before = np.concatenate([np.zeros((1, whole.shape[1])), np.cumsum(whole, axis=0)])
        before -= before[int(np.searchsorted(self.breaks, start))]
        inside = (
            _from_start(_nodes(self.grid.count)[0], self.grid.count)
            @ self.modes
            * self.half[:, None, None]
        )
        return np.asarray((before[:-1, None] + inside).reshape(-1, whole.shape[1]))

    def maximum(self) -> Array:
        """Largest values, (m,): of points of every slab, and from the best by Newton steps."""
        points = _dense_points(self.grid.count)
        dense = legendre_values(points, self.grid.count) @ self.modes
        best = dense.argmax(axis=1)
        lower = points[np.maximum(best - 1, 0)]
        upper = points[np.minimum(best + 1, points.size - 1)]
        slope = legendre_derivative(self.grid.count)
        first = slope @ self.modes
        second = slope @ first
        at = points[best]
        for _ in range(_NEWTON_STEPS):
            bend = _sum(second, at)
            step = np.where(bend < 0.0, _sum(first, at) / np.where(bend < 0.0, bend, 1.0), 0.0)
            at = np.clip(at - step, lower, upper)
        largest = np.maximum(_sum(self.modes, at), dense.max(axis=1))
        return np.asarray(largest.max(axis=0))

    def first_crossing(self, direction: int, negligible: float) -> Array:
        """First times of a change of sign, (m,); NaN where there is none.

        Values below ``negligible`` times the largest have no sign: a function may begin at zero.
        """
        times, dense = self._dense()
        signs = np.sign(dense)
        signs[np.abs(dense) <= negligible * np.abs(dense).max(axis=0)] = 0.0
        places = np.where(signs != 0.0, np.arange(times.size)[:, None], -1)
        last = np.maximum.accumulate(places, axis=0)[:-1]
        before = np.where(last >= 0, np.take_along_axis(signs, np.maximum(last, 0), axis=0), 0.0)
        change = signs[1:] * before < 0.0
        if direction:
            change &= signs[1:] == direction
        crossed = change.any(axis=0)
        interval = np.argmax(change, axis=0)
        columns = np.arange(interval.size)
        left, right = times[np.maximum(last[interval, columns], 0)], times[interval + 1]
        crossings = self._root(left, right, signs[interval + 1, columns], columns)
        return np.where(crossed, crossings, np.nan)

    def gap_of_maxima(self) -> Array:
        """Distance of the two largest local maxima, relative to the largest absolute value: (m,).

        Infinite where there are fewer than two.
        """
        _, dense = self._dense()
        two = np.sort(np.where(_tops(dense), dense, -np.inf), axis=0)[-2:]
        gap = np.where(np.isfinite(two[0]), two[1] - two[0], np.inf)
        return np.asarray(gap / _sizes(dense))

    def distance_from_tangency(self) -> Array:
        """Least absolute value of a local extreme, relative to the largest one: (m,).

        Crossings come and go where an extreme is zero. Infinite where there is no extreme.
        """
        _, dense = self._dense()
        extremes = np.where(_tops(dense) | _tops(-dense), np.abs(dense), np.inf)
        return np.asarray(extremes.min(axis=0) / _sizes(dense))

    def duration(self) -> Array:
        """For how long values are positive, (m,)."""
        times, dense = self._dense()
        positive = dense > 0.0
        whole = np.diff(times) @ (positive[1:] & positive[:-1])
        interval, columns = np.nonzero(positive[1:] != positive[:-1])
        left, right = times[interval], times[interval + 1]
        rises = positive[interval + 1, columns]
        root = self._root(left, right, np.where(rises, 1.0, -1.0), columns)
        np.add.at(whole, columns, np.where(rises, right - root, root - left))
        return np.asarray(whole)

    def zeros(self, most: int) -> tuple[Array, NDArray[np.intp]]:
        """Times of the first changes of sign and of which functions: (N,) each, N <= most m."""
        times, dense = self._dense()
        change = np.signbit(dense[1:]) != np.signbit(dense[:-1])
        change &= np.cumsum(change, axis=0) <= most
        interval, columns = np.nonzero(change)
        left, right = times[interval], times[interval + 1]
        sign = np.sign(dense[interval + 1, columns])
        return self._root(left, right, sign, columns), columns

    def at(self, times: Array, columns: NDArray[np.intp]) -> Array:
        """Values of some of the functions, each at a time of its own: (N,) each."""
        slab = np.clip(np.searchsorted(self.breaks, times, side="right") - 1, 0, self.half.size - 1)
        xi = (times - self.breaks[slab]) / self.half[slab] - 1.0
        return _sum(self.modes[slab, :, columns].T, xi)

    def _dense(self) -> tuple[Array, Array]:
        """Times (N,), ascending, and values there, (N, m)."""
        points = _dense_points(self.grid.count)
        times = (self.breaks[:-1, None] + self.half[:, None] * (points + 1.0)).ravel()
        dense = legendre_values(points, self.grid.count) @ self.modes
        return times, dense.reshape(times.size, -1)

    def _root(self, left: Array, right: Array, sign: Array, columns: NDArray[np.intp]) -> Array:
        """Where some of the functions take the sign that they have at the right ends, (N,)."""

        def on_left(times: Array) -> NDArray[np.bool_]:
            return np.asarray(~(self.at(times, columns) * sign > 0.0))

        left, right = bisected(left, right, on_left)
        return np.asarray(0.5 * (left + right))


def _from_start(xi: Array, count: int) -> Array:
    """Integrals of the Legendre polynomials from -1 to points (N,): (N, count).

    ``(2 n + 1) P_n`` is the derivative of ``P_{n+1} - P_{n-1}`` (DLMF 18.9.21).
    """
    plain = legendre_values(xi, count + 1) / np.sqrt(2.0 * np.arange(count + 1) + 1.0)
    degrees = np.arange(1, count)
    integrals = np.empty((xi.size, count))
    integrals[:, 0] = xi + 1.0
    integrals[:, 1:] = (plain[:, 2:] - plain[:, :-2]) / np.sqrt(2.0 * degrees + 1.0)
    return integrals


def _dense_points(count: int) -> Array:
    """Points of [-1, 1] with its ends, denser there."""
    return np.asarray(-np.cos(np.pi * np.arange(_DENSE_RATIO * count + 1) / (_DENSE_RATIO * count)))


def _sum(modes: Array, xi: Array) -> Array:
    """Sums of Legendre polynomials with coefficients (..., count, m) at points (..., m)."""
    count = modes.shape[-2]
    at_points = legendre_values(xi.ravel(), count).T.reshape(count, *xi.shape)
    return np.asarray((np.moveaxis(modes, -2, 0) * at_points).sum(axis=0))


def _tops(dense: Array) -> NDArray[np.bool_]:
    """Where columns (N, m) have a local maximum; the ends count."""
    padded = np.pad(dense, ((1, 1), (0, 0)), constant_values=-np.inf)
    return np.asarray((dense >= padded[:-2]) & (dense > padded[2:]))


def _sizes(dense: Array) -> Array:
    """Largest absolute value of each column, not zero."""
    return np.asarray(np.abs(dense).max(axis=0) + TINY)


def times_within(start: float, end: float, shares: Array) -> Array:
    """Times at shares of a slab; at its end, where states may jump, the last number before it."""
    return np.asarray(np.minimum(start + (end - start) * shares, np.nextafter(end, start)))


# -----------------------------------------------------------------------------
# Right Radau collocation on one time slab.


_INSET_SPACINGS = 8.0
"""The same in spacings of floating-point numbers, at least."""


def inset(start: float, end: float) -> float:
    """How far times stay inside a slab or segment: factors may jump at its ends."""
    return float(insets(np.asarray(start), np.asarray(end)))


def insets(starts: Array, ends: Array) -> Array:
    """The insets of several slabs or segments."""
    lengths = ends - starts
    rounding = _INSET_SPACINGS * np.spacing(np.maximum(np.abs(starts), np.abs(ends)))
    return np.asarray(np.minimum(np.maximum(NEGLIGIBLE * lengths, rounding), 0.25 * lengths))


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
