"""Many starts: where they are, and which of them go on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rankone.calibration.descent import (
    FIRST_RADIUS,
    Descent,
    Expandable,
    Expansion,
    bounded_step,
)
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
_FEWER = 3  # Ratio of the points that are screened for a start and for a hop
_LEAST_PROMISE = 1.0  # Decrease of -2 log L below which a start is on a plateau
_MOVED_SHARE = 0.5  # Share of the coordinates that a hop draws anew


def random_starts(count: int, n: int, seed: int) -> Array:
    """A latin hypercube of points (count, n) of the unit cube, in the coordinates of the search."""
    generator = np.random.default_rng(seed)
    cells = np.stack([generator.permutation(count) for _ in range(n)], axis=1)
    return np.asarray((cells + generator.random((count, n))) / count)


def descents(problem: Expandable, count: int, seed: int, screened: int = 1) -> list[Descent]:
    """Descents from random starts, the best of them first.

    Of so many ``screened`` points for each, the best are the starts; where none are screened, one
    without trajectories is replaced by another random point. All go on for some iterations, the
    best for more. Unless half of them end at the same optimum, the best end then hops: some of its
    coordinates are drawn anew, and where the way down from there leads lower, it stays.
    """
    generator = np.random.default_rng(seed)
    points = random_starts(count * screened, len(problem.names), seed)
    replacements = _REPLACEMENTS if screened == 1 else 0
    tried = (_usable(problem, z, generator, replacements) for z in points)
    best = sorted(tried, key=_rank(problem))[:count]
    ways = [Descent(at, at.z, arrived=not np.isfinite(at.cost)) for at in best]
    _go_on(problem, ways)
    agree = sum(way.at.cost <= ways[0].at.cost + _SAME_COST for way in ways)
    if np.isfinite(ways[0].at.cost) and agree < _AGREEING_SHARE * count:
        for _ in range(_HOPS * count):
            _hop(problem, ways[0], generator, screened)
        _go_on(problem, ways)
    return ways


def _rank(problem: Expandable) -> Callable[[Expansion], tuple[bool, float]]:
    """Points by their costs; those last from which nothing promises a better likelihood."""

    def rank(at: Expansion) -> tuple[bool, float]:
        radius = np.where(problem.nested, 1.0, FIRST_RADIUS)
        flat = not np.isfinite(at.cost) or bounded_step(at, radius)[1] < _LEAST_PROMISE
        return flat, at.cost

    return rank


def _go_on(problem: Expandable, ways: list[Descent]) -> None:
    """All go on for some iterations, the best for more; they are sorted in place."""
    for many, iterations in _LEGS:
        for way in ways[:many]:
            way.go(problem, iterations)
        ways.sort(key=lambda way: way.at.cost)


def _hop(problem: Expandable, way: Descent, generator: np.random.Generator, screened: int) -> None:
    """Draw some coordinates of the end of a way anew, and stay where that leads lower."""
    drawn = []
    for _ in range(1 + screened // _FEWER):
        z = way.at.z.copy()
        moved = generator.random(z.size) < _MOVED_SHARE
        z[moved] = generator.random(int(moved.sum()))
        drawn.append(problem.expanded(z))
    at = min(drawn, key=_rank(problem))
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


def _usable(
    problem: Expandable, z: Array, generator: np.random.Generator, replacements: int
) -> Expansion:
    """The expansion at a start, or at the first random point that has one."""
    at = problem.expanded(z)
    for _ in range(replacements):
        if np.isfinite(at.cost):
            return at
        at = problem.expanded(generator.random(z.size))
    return at
