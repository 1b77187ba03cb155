"""Where searches for a minimum over a cube begin: basins of a sample, then of its descendants."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import qmc

from rankone.support.arrays import Array

__all__ = ["basins", "evolved", "screened"]

_SEED = 7
_MOST_CORNERS = 64
_POPULATION = 32
_APART = 1e-2
"""Distance in the cube from which points are in different basins."""
_SCALES, _CROSSED = (0.4, 0.9), 0.6
"""Range of the factors of differences, and share of the coordinates that are exchanged."""


def screened(count: int, d: int) -> Array:
    """Points (N, d) of the unit cube: centre, corners, and ``count`` of a shifted Sobol points."""
    corners = itertools.islice(itertools.product((0.0, 1.0), repeat=d), _MOST_CORNERS)
    sequence = qmc.Sobol(d, scramble=False).random_base2(max(count - 1, 1).bit_length())
    spread = (sequence[:count] + np.random.default_rng(_SEED).random(d)) % 1.0
    return np.concatenate([np.full((1, d), 0.5), np.array(list(corners)), spread])


def basins(points: Array, merits: Array) -> NDArray[np.intp]:
    """Points (N, d) that are no worse than the nearest ones around them: indices, the best first.

    They are the minima of the graph that joins each point to its 2 d + 1 nearest neighbours.
    """
    neighbours = min(2 * points.shape[1] + 2, len(points))
    _, nearest = cKDTree(points).query(points, k=neighbours)
    around = merits[nearest.reshape(len(points), -1)].min(axis=1)
    lowest = np.flatnonzero((merits <= around) & np.isfinite(merits))
    return lowest[np.argsort(merits[lowest], kind="stable")]


def evolved(
    merit: Callable[[Array], Array], points: Array, merits: Array, generations: int
) -> list[Array]:
    """Points (d,) in different basins after differential evolution of the best (Storn, Price 1997).

    Parameters
    ----------
    merit : callable
        Merits (m,) of points (m, d).
    points : ndarray (N, d)
        The best of them are the first generation.
    merits : ndarray (N,)
    """
    generator = np.random.default_rng(_SEED)
    chosen = np.argsort(merits, kind="stable")[:_POPULATION]
    population, values = points[chosen], merits[chosen]
    m, d = population.shape
    for _ in range(generations):
        base, plus, minus = (population[generator.permutation(m)] for _ in range(3))
        trial = base + generator.uniform(*_SCALES, (m, 1)) * (plus - minus)
        crossed = generator.random((m, d)) < _CROSSED
        crossed[np.arange(m), generator.integers(0, d, m)] = True
        outside = (trial < 0.0) | (trial > 1.0)
        trial = np.where(outside, generator.random((m, d)), trial)
        trial = np.where(crossed, trial, population)
        there = merit(trial)
        better = there < values
        population = np.where(better[:, None], trial, population)
        values = np.where(better, there, values)
    apart: list[Array] = []
    for point in population[np.argsort(values, kind="stable")]:
        if all(np.abs(point - other).max() > _APART for other in apart):
            apart.append(point)
    return apart
