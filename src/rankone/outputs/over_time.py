"""Integrals, extremes and crossings of functions of time that are polynomials on slabs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rankone.discretization import legendre_derivative, legendre_values
from rankone.outputs.quantities import Kind
from rankone.solvers.cross.time_grid import TimeGrid
from rankone.support.arrays import Array

__all__ = ["Polynomials"]

_DENSE = 4
"""Points of a slab where extremes and crossings are looked for, over its nodes."""
_NEWTON, _BISECTIONS = 8, 60


class Polynomials:
    """Functions of time, by their values at the nodes of a grid.

    Parameters
    ----------
    grid : TimeGrid
    values : ndarray (T, m)
        At the nodes of the grid.
    """

    def __init__(self, grid: TimeGrid, values: Array) -> None:
        local = values.reshape(grid.slabs, grid.count, -1)
        self.grid, self.modes = grid, np.asarray(np.linalg.solve(_at_nodes(grid.count), local))
        self.breaks = np.array(grid.breaks)
        self.half = 0.5 * np.diff(self.breaks)

    def integral(self, start: float, end: float) -> Array:
        """Integral from one break of the grid to another, (m,)."""
        inside = (self.breaks[:-1] >= start) & (self.breaks[1:] <= end)
        return np.asarray(2.0 * self.half[inside] @ self.modes[inside, 0])

    def running(self, start: float) -> Array:
        """Integrals from a break of the grid to all nodes, (T, m)."""
        whole = 2.0 * self.half[:, None] * self.modes[:, 0]
        before = np.concatenate([np.zeros((1, whole.shape[1])), np.cumsum(whole, axis=0)])
        before -= before[int(np.searchsorted(self.breaks, start))]
        inside = _from_start(self.grid.count) @ self.modes * self.half[:, None, None]
        return np.asarray((before[:-1, None] + inside).reshape(-1, whole.shape[1]))

    def maximum(self) -> Array:
        """Largest values, (m,): of points of every slab, and from the best by Newton steps."""
        points = _dense_points(self.grid.count)
        dense = legendre_values(points, self.grid.count) @ self.modes
        best = dense.argmax(axis=1)
        lower, upper = (
            points[np.maximum(best - 1, 0)],
            points[np.minimum(best + 1, points.size - 1)],
        )
        slope = legendre_derivative(self.grid.count)
        first = slope @ self.modes
        second = slope @ first
        at = points[best]
        for _ in range(_NEWTON):
            bend = _sum(second, at)
            step = np.where(bend < 0.0, _sum(first, at) / np.where(bend < 0.0, bend, 1.0), 0.0)
            at = np.clip(at - step, lower, upper)
        found = np.maximum(_sum(self.modes, at), dense.max(axis=1))
        return np.asarray(found.max(axis=0))

    def first_crossing(self, direction: int, nothing: float) -> Array:
        """First times of a change of sign, (m,); NaN where there is none.

        Values below ``nothing`` times the largest one have no sign: a function may begin at zero.
        """
        times, dense = self._dense()
        signs = np.sign(dense)
        signs[np.abs(dense) <= nothing * np.abs(dense).max(axis=0)] = 0.0
        places = np.where(signs != 0.0, np.arange(times.size)[:, None], -1)
        last = np.maximum.accumulate(places, axis=0)[:-1]
        before = np.where(last >= 0, np.take_along_axis(signs, np.maximum(last, 0), axis=0), 0.0)
        change = signs[1:] * before < 0.0
        if direction:
            change &= signs[1:] == direction
        crossed = change.any(axis=0)
        where = np.argmax(change, axis=0)
        columns = np.arange(where.size)
        left, right = times[np.maximum(last[where, columns], 0)], times[where + 1]
        found = self._root(left, right, signs[where + 1, columns], columns)
        return np.where(crossed, found, np.nan)

    def margins(self, kind: Kind) -> Array:
        """How far functions are from a change of what is reduced, over their sizes: (m,).

        For extremes the distance of the two largest, at different times; else the distance of an
        extreme from zero, where crossings come and go.
        """
        _, dense = self._dense()
        dense = -dense if kind is Kind.MINIMUM else dense
        size = np.abs(dense).max(axis=0) + 1e-300
        inner = np.pad(dense, ((1, 1), (0, 0)), constant_values=-np.inf)
        tops = (inner[1:-1] >= inner[:-2]) & (inner[1:-1] > inner[2:])
        if kind in (Kind.MAXIMUM, Kind.MINIMUM):
            two = np.sort(np.where(tops, dense, -np.inf), axis=0)[-2:]
            found = np.where(np.isfinite(two[0]), two[1] - two[0], np.inf)
        else:
            inner = np.pad(dense, ((1, 1), (0, 0)), constant_values=np.inf)
            tops |= (inner[1:-1] <= inner[:-2]) & (inner[1:-1] < inner[2:])
            found = np.where(tops, np.abs(dense), np.inf).min(axis=0)
        return np.asarray(found / size)

    def duration(self) -> Array:
        """For how long values are positive, (m,)."""
        times, dense = self._dense()
        positive = dense > 0.0
        whole = np.diff(times) @ (positive[1:] & positive[:-1])
        where, columns = np.nonzero(positive[1:] != positive[:-1])
        left, right, rises = times[where], times[where + 1], positive[where + 1, columns]
        root = self._root(left, right, np.where(rises, 1.0, -1.0), columns)
        np.add.at(whole, columns, np.where(rises, right - root, root - left))
        return np.asarray(whole)

    def zeros(self, most: int) -> tuple[Array, NDArray[np.intp]]:
        """Times of the first changes of sign and of which functions: (N,) each, N <= most m."""
        times, dense = self._dense()
        change = np.signbit(dense[1:]) != np.signbit(dense[:-1])
        change &= np.cumsum(change, axis=0) <= most
        where, columns = np.nonzero(change)
        left, right, sign = times[where], times[where + 1], np.sign(dense[where + 1, columns])
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
        for _ in range(_BISECTIONS):
            middle = 0.5 * (left + right)
            over = self.at(middle, columns) * sign > 0.0
            left, right = np.where(over, left, middle), np.where(over, middle, right)
        return np.asarray(0.5 * (left + right))


def _at_nodes(count: int) -> Array:
    """Values of the Legendre polynomials at the nodes of a slab."""
    return legendre_values(np.polynomial.legendre.leggauss(count)[0], count)


def _from_start(count: int) -> Array:
    """Integrals of the Legendre polynomials from -1 to the nodes: (nodes, count).

    ``(2 n + 1) P_n`` is the derivative of ``P_{n+1} - P_{n-1}`` (DLMF 18.9.21).
    """
    xi = np.polynomial.legendre.leggauss(count)[0]
    plain = legendre_values(xi, count + 1) / np.sqrt(2.0 * np.arange(count + 1) + 1.0)
    degrees = np.arange(1, count)
    found = np.empty((count, count))
    found[:, 0] = xi + 1.0
    found[:, 1:] = (plain[:, 2:] - plain[:, :-2]) / np.sqrt(2.0 * degrees + 1.0)
    return found


def _dense_points(count: int) -> Array:
    """Points of [-1, 1] with its ends, denser there."""
    return np.asarray(-np.cos(np.pi * np.arange(_DENSE * count + 1) / (_DENSE * count)))


def _sum(modes: Array, xi: Array) -> Array:
    """Sums of Legendre polynomials with coefficients (..., count, m) at points (..., m)."""
    count = modes.shape[-2]
    values = legendre_values(xi.ravel(), count).T.reshape(count, *xi.shape)
    return np.asarray((np.moveaxis(modes, -2, 0) * values).sum(axis=0))
