"""Many starts: where they are, and which of them go on."""

from __future__ import annotations

import numpy as np

from rankone.calibration.descent import Descent, Expandable, Expansion
from rankone.support.arrays import Array

MOST_STARTS = 10_000
"""Most random starts."""
# Starts that go on, the best of those before, and for how many iterations more at most
_LEGS = ((MOST_STARTS, 40), (5, 60), (3, 200))
_REPLACEMENTS = 20  # Points that are tried for each start whose trajectories do not reach the data
_SAME_COST = 0.2  # Difference of -2 log L below which starts ended at the same optimum
_AGREEING_SHARE = 0.5  # Share of the starts at the same optimum from which it is believed
_HOPS = 2  # Hops from the best ends, for each start
_HOP_ITERATIONS = 40
_HOP_GAIN = 0.01  # Decrease of -2 log L from which a hop is worth while
_MOVED_SHARE = 0.5  # Share of the coordinates that a hop draws anew


def random_starts(count: int, n: int, seed: int) -> Array:
    """A latin hypercube of points (count, n) of the unit cube, in the coordinates of the search."""
    generator = np.random.default_rng(seed)
    cells = np.stack([generator.permutation(count) for _ in range(n)], axis=1)
    return np.asarray((cells + generator.random((count, n))) / count)


def descents(problem: Expandable, count: int, seed: int) -> list[Descent]:
    """Descents from random starts, the best of them first.

    A start without trajectories is replaced by another random point. All go on for some
    iterations, the best for more. Unless half of them end at the same optimum, the best end then
    hops: some of its coordinates are drawn anew, and where the way down from there leads lower, it
    stays.
    """
    generator = np.random.default_rng(seed)
    ways = []
    for z in random_starts(count, len(problem.names), seed):
        at = _usable(problem, z, generator)
        ways.append(Descent(at, at.z, arrived=not np.isfinite(at.cost)))
    _go_on(problem, ways)
    agree = sum(way.at.cost <= ways[0].at.cost + _SAME_COST for way in ways)
    if np.isfinite(ways[0].at.cost) and agree < _AGREEING_SHARE * count:
        for _ in range(_HOPS * count):
            _hop(problem, ways[0], generator)
        _go_on(problem, ways)
    return ways


def _go_on(problem: Expandable, ways: list[Descent]) -> None:
    """All go on for some iterations, the best for more; they are sorted in place."""
    for many, iterations in _LEGS:
        for way in ways[:many]:
            way.go(problem, iterations)
        ways.sort(key=lambda way: way.at.cost)


def _hop(problem: Expandable, way: Descent, generator: np.random.Generator) -> None:
    """Draw some coordinates of the end of a way anew, and stay where that leads lower."""
    z = way.at.z.copy()
    moved = generator.random(z.size) < _MOVED_SHARE
    z[moved] = generator.random(int(moved.sum()))
    at = problem.expanded(z)
    other = Descent(at, way.start)
    if np.isfinite(at.cost):
        other.go(problem, _HOP_ITERATIONS)
    way.iterations += other.iterations + 1
    if other.at.cost < way.at.cost - _HOP_GAIN:
        way.at, way.radius, way.arrived, way.costs = (
            other.at,
            other.radius,
            other.arrived,
            other.costs,
        )


def _usable(problem: Expandable, z: Array, generator: np.random.Generator) -> Expansion:
    """The expansion at a start, or at the first random point that has one."""
    at = problem.expanded(z)
    for _ in range(_REPLACEMENTS):
        if np.isfinite(at.cost):
            return at
        at = problem.expanded(generator.random(z.size))
    return at
