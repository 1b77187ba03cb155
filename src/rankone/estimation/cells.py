"""Densities of up to three parameters on cells that are halved where they vary.

Each cell has a tensor grid of Gauss-Legendre nodes. It is halved, in the direction in which the
density varies most, until its integral is that of its halves.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial.legendre import leggauss, legint, legval, legvander

from rankone.support.arrays import Array

__all__ = ["Cells", "adapted"]

Density = Callable[[Array], Array]

_NODES = {1: 10, 2: 7, 3: 5}
_TOLERANCE = {1: 1e-8, 2: 1e-5, 3: 3e-4}
"""Sum of the errors of the integrals over all cells, in shares of the whole."""
_LEAST_SHARES = 50
"""A cell may have this share of the tolerance, or that of all cells if they are more."""
_MOST_POINTS = 2_000_000
_ROUNDS = 60
_FIRST = {1: 16, 2: 8, 3: 4}
"""Cells in each direction to begin with."""
_NARROW = {1: 2.0, 2: 2.0, 3: 4.0}
"""Widest cells where the density is thought to be, in its standard deviations."""
_BISECTIONS = 60


@dataclass(frozen=True)
class Cells:
    """A density of total mass one on the unit cube, known on cells.

    Attributes
    ----------
    lower, width : ndarray (c, n)
    values : ndarray (c, *nodes)
        The density at the nodes of each cell.
    error : float
        Estimated error of integrals, relative.
    points : int
        Number of points at which the density was evaluated.
    """

    lower: Array
    width: Array
    values: Array
    error: float
    points: int

    @cached_property
    def nodes(self) -> Array:
        """All nodes (c * nodes, n)."""
        return _nodes(self.lower, self.width).reshape(-1, self.lower.shape[1])

    @cached_property
    def masses(self) -> Array:
        """Probability at each of the nodes (c * nodes,)."""
        return (self.values.reshape(len(self.values), -1) * _weights(self.width)).ravel()

    def marginal(self, j: int, z: Array) -> Array:
        """Marginal density of coordinate j at z (k,)."""
        return self._marginal(j, z, whole=False)

    def cumulative(self, j: int, z: Array) -> Array:
        """Probability that coordinate j is below z (k,)."""
        return self._marginal(j, z, whole=True)

    def quantile(self, j: int, shares: Array) -> Array:
        """Values of coordinate j below which there are shares (k,) of the probability."""
        low, high = np.zeros(shares.shape), np.ones(shares.shape)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            below = self.cumulative(j, middle) < shares
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray(0.5 * (low + high))

    def sample(self, count: int, density: Density, generator: np.random.Generator) -> Array:
        """Points (count, n), by rejection on cells.

        ``density`` is that of which the cells know the values, in the same unit.
        """
        flat = self.values.reshape(len(self.values), -1)
        ceiling = 1.3 * flat.max(axis=1)
        share = ceiling * np.prod(self.width, axis=1)
        share = share / share.sum()
        found: list[Array] = []
        wanted = count
        while wanted > 0:
            chosen = generator.choice(share.size, 2 * wanted + 16, p=share)
            inside = generator.random((chosen.size, self.lower.shape[1]))
            points = self.lower[chosen] + self.width[chosen] * inside
            kept = points[generator.random(chosen.size) * ceiling[chosen] < density(points)]
            found.append(kept[:wanted])
            wanted -= len(found[-1])
        return np.concatenate(found) if found else np.zeros((0, self.lower.shape[1]))

    def _marginal(self, j: int, z: Array, whole: bool) -> Array:
        lower, width = self.lower[:, j], self.width[:, j]
        coefficients, masses = self._polynomials[j]
        found = np.zeros(z.shape)
        for at, value in enumerate(z.ravel()):
            if whole:
                past = lower + width <= value
                found.ravel()[at] = masses[past].sum()
                here = np.flatnonzero(~past & (lower < value))
            else:
                end = lower + width
                here = np.flatnonzero((lower <= value) & ((value < end) | (end >= 1.0)))
            xi = 2.0 * (value - lower[here]) / width[here] - 1.0
            parts = coefficients[here].T
            if whole:
                mass = legval(xi, legint(parts, lbnd=-1), tensor=False) * 0.5 * width[here]
                found.ravel()[at] += mass.sum()
            else:
                found.ravel()[at] = legval(xi, parts, tensor=False).sum()
        return found

    @cached_property
    def _polynomials(self) -> list[tuple[Array, Array]]:
        """For each coordinate the marginal density on each cell, in Legendre polynomials."""
        n = self.lower.shape[1]
        xi, weights = leggauss(_NODES[n])
        degrees = np.arange(xi.size)
        to_modes = (legvander(xi, xi.size - 1) * weights[:, None]).T * (degrees[:, None] + 0.5)
        found = []
        for j in range(n):
            density = np.moveaxis(self.values, 1 + j, 1)
            others = np.delete(self.width, j, axis=1)
            for k in range(n - 1):
                density = density @ (0.5 * weights)
                density = density * others[:, k].reshape(-1, *[1] * (density.ndim - 1))
            coefficients = density @ to_modes.T
            found.append((coefficients, coefficients[:, 0] * self.width[:, j]))
        return found


def adapted(log_density: Density, likely: Array, spread: Array) -> tuple[Cells, float]:
    """The cells of a density, and the logarithm of its integral.

    Parameters
    ----------
    log_density : callable
        Logarithm of the density, up to a summand, at points (N, n) of the unit cube: shape (N,).
    likely : ndarray (k, n)
        Where the density is large: cells there begin small.
    spread : ndarray (n,)
        How far the density extends there in each direction, the others held.
    """
    lower, width = _first(likely, spread)
    logs = _evaluated(log_density, lower, width)
    points, whole, error = logs.size, 0.0, 0.0
    top = float(max(logs.max(), np.max(log_density(likely))))
    done: list[tuple[Array, Array, Array]] = []
    for turn in range(_ROUNDS):
        halves = _halved(lower, width, np.exp(logs - top))
        finer = _evaluated(log_density, *halves)
        points += finer.size
        higher = max(top, float(finer.max()))
        whole, error = whole * np.exp(top - higher), error * np.exp(top - higher)
        top = higher
        fine = _integrals(halves[1], finer, top).reshape(2, -1).sum(axis=0)
        errors = np.abs(_integrals(width, logs, top) - fine)
        bound = (
            _TOLERANCE[lower.shape[1]]
            * (whole + float(fine.sum()))
            / max(len(errors), _LEAST_SHARES)
        )
        good = errors <= bound
        if points > _MOST_POINTS or turn == _ROUNDS - 1:
            good[:] = True
        whole, error = whole + float(fine[good].sum()), error + float(errors[good].sum())
        both = np.tile(good, 2)
        done.append((halves[0][both], halves[1][both], finer[both]))
        lower, width, logs = halves[0][~both], halves[1][~both], finer[~both]
        if not len(lower):
            break
    lower, width, logs = (np.concatenate(part) for part in zip(*done, strict=True))
    values = np.exp(logs - top) / whole
    return Cells(lower, width, values, error / whole, points), top + float(np.log(whole))


def _integrals(width: Array, logs: Array, top: float) -> Array:
    """Integrals over cells (c,) of densities given by logarithms."""
    values = np.exp(logs - top).reshape(len(logs), -1)
    return np.asarray(np.sum(values * _weights(width), axis=1))


def _first(likely: Array, spread: Array) -> tuple[Array, Array]:
    """Cells to begin with: small where the density is likely to be large."""
    n = likely.shape[1]
    count = _FIRST[n]
    corners = np.array(list(itertools.product(range(count), repeat=n))) / count
    lower, width = corners, np.full(corners.shape, 1.0 / count)
    narrow = np.maximum(_NARROW[n] * spread, 1e-12)
    for _ in range(200):
        wide = width > narrow
        inside = np.zeros(len(lower), dtype=bool)
        candidates = np.flatnonzero(wide.any(axis=1))
        for k in candidates:
            between = (likely >= lower[k]) & (likely <= lower[k] + width[k])
            inside[k] = bool(between.all(axis=1).any())
        if not inside.any() or len(lower) > 4000:
            break
        ratio = width[inside] / narrow
        cut_lower, cut_width = _cut(lower[inside], width[inside], np.argmax(ratio, axis=1))
        lower = np.concatenate([lower[~inside], cut_lower])
        width = np.concatenate([width[~inside], cut_width])
    return lower, width


def _halved(lower: Array, width: Array, values: Array) -> tuple[Array, Array]:
    """Both halves of each cell, first all lower ones, cut where the density varies most."""
    n = lower.shape[1]
    rough = np.empty(lower.shape)
    for j in range(n):
        along = np.moveaxis(values, 1 + j, -1)
        change = np.abs(np.diff(along, n=2, axis=-1))
        rough[:, j] = change.reshape(len(values), -1).sum(axis=1)
    axis = np.where(rough.max(axis=1) > 0.0, rough.argmax(axis=1), width.argmax(axis=1))
    return _cut(lower, width, axis)


def _cut(lower: Array, width: Array, axis: Array) -> tuple[Array, Array]:
    rows = np.arange(len(lower))
    half = width.copy()
    half[rows, axis] *= 0.5
    upper = lower.copy()
    upper[rows, axis] += half[rows, axis]
    return np.concatenate([lower, upper]), np.concatenate([half, half])


def _nodes(lower: Array, width: Array) -> Array:
    """Nodes of cells, (c, nodes, n)."""
    n = lower.shape[1]
    xi, _ = leggauss(_NODES[n])
    grid = np.stack(np.meshgrid(*[0.5 * (xi + 1.0)] * n, indexing="ij"), axis=-1).reshape(-1, n)
    return np.asarray(lower[:, None, :] + width[:, None, :] * grid)


def _weights(width: Array) -> Array:
    """Weights of the nodes of cells, (c, nodes)."""
    n = width.shape[1]
    _, weights = leggauss(_NODES[n])
    product = np.ones(1)
    for _ in range(n):
        product = np.multiply.outer(product, 0.5 * weights).ravel()
    return np.asarray(np.prod(width, axis=1)[:, None] * product)


def _evaluated(log_density: Density, lower: Array, width: Array) -> Array:
    """Logarithms at the nodes of cells, (c, *nodes)."""
    n = lower.shape[1]
    points = _nodes(lower, width).reshape(-1, n)
    found = np.concatenate(
        [log_density(part) for part in np.array_split(points, len(points) // 65536 + 1)]
    )
    return found.reshape(len(lower), *[_NODES[n]] * n)
