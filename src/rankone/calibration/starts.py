"""Many starts: where they are, and which of them go on."""

from __future__ import annotations

import numpy as np

from rankone.calibration.descent import Descent, Expandable, Expansion
from rankone.support.arrays import Array

_FIRST_ITERATIONS = 40  # Iterations of every start
_FURTHER_ITERATIONS = 200  # Iterations of the best starts after these
_KEPT = 3  # Starts that go on
_REPLACEMENTS = 20  # Points that are tried for each start whose trajectories do not reach the data


def random_starts(count: int, n: int, seed: int) -> Array:
    """A latin hypercube of points (count, n) of the unit cube, in the coordinates of the search."""
    generator = np.random.default_rng(seed)
    cells = np.stack([generator.permutation(count) for _ in range(n)], axis=1)
    return np.asarray((cells + generator.random((count, n))) / count)


def descents(problem: Expandable, count: int, seed: int) -> list[Descent]:
    """Descents from random starts, the best of them first.

    A start without trajectories is replaced by another random point. All go on for some
    iterations, the best for more.
    """
    n = len(problem.names)
    further = np.random.default_rng(seed)
    ways = []
    for z in random_starts(count, n, seed):
        at = _usable(problem, z, further)
        way = Descent(at, at.z)
        if np.isfinite(way.at.cost):
            way.go(problem, _FIRST_ITERATIONS)
        else:
            way.arrived = True
        ways.append(way)
    ways.sort(key=lambda way: way.at.cost)
    for way in ways[:_KEPT]:
        way.go(problem, _FURTHER_ITERATIONS)
    return sorted(ways, key=lambda way: way.at.cost)


def _usable(problem: Expandable, z: Array, generator: np.random.Generator) -> Expansion:
    """The expansion at a start, or at the first random point that has one."""
    at = problem.expanded(z)
    for _ in range(_REPLACEMENTS):
        if np.isfinite(at.cost):
            return at
        at = problem.expanded(generator.random(z.size))
    return at
