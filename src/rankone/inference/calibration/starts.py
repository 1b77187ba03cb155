"""Many starts in the unit cube of the bounds, and which of them go on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext

import numpy as np

from rankone.inference.calibration.descent import (
    FIRST_RADIUS,
    Descent,
    Expandable,
    Expansion,
    bounded_step,
)
from rankone.support.arrays import Array
from rankone.support.budget import limited
from rankone.support.tasks import ExecutorLike, Shared, open_pool

MOST_STARTS = 10_000
"""Most random starts."""
# Starts that go on, the best of those before, and for how many iterations more at most
_LEGS = ((MOST_STARTS, 40), (5, 60), (3, 200))
_REPLACEMENTS = 20  # Points that are tried for each start whose trajectories do not reach the data
_SAME_COST = 0.2  # Difference of -2 log L below which starts ended at the same optimum
_AGREEING_SHARE = 0.5  # Share of the starts at the same optimum from which it is believed
_HOPS = 2  # Hops in vain after which they end, for each start
_MOST_WORK = 5e10  # Operations of all hops
_HOP_ITERATIONS = 40
_HOP_GAIN = 0.01  # Decrease of -2 log L from which a hop is worth while
_DRAWN = 4  # Places of which a hop takes the best
_PASSED_SHARES = (0.25, 0.5, 0.75)  # Shares of the coordinates that another end passes on
_DRAWN_COORDINATES = (0.0, 1.0, 3.0)  # Coordinates that are drawn anew, beside one
_MOST_ENDS = 10  # Ends that are crossed
_LEAST_PROMISE = 1.0  # Decrease of -2 log L below which a start is on a plateau
_MORE = 3  # Ways that begin, for each that goes on where points are screened
_FIRST_LEG = 8  # Their iterations


def random_starts(count: int, n: int, seed: int) -> Array:
    """A latin hypercube of points (count, n) of the unit cube, in the coordinates of the search."""
    generator = np.random.default_rng(seed)
    cells = np.stack([generator.permutation(count) for _ in range(n)], axis=1)
    return np.asarray((cells + generator.random((count, n))) / count)


def descents(
    problem: Expandable,
    count: int,
    seed: int,
    screened: int = 1,
    executor: ExecutorLike | None = None,
) -> list[Descent]:
    """Descents from random starts, the best of them first.

    Of so many ``screened`` points for each, the best that are apart go a short way, and the best of
    these are the starts; where none are screened, one without trajectories is replaced by another
    random point. All go on for some iterations, the best for more. Unless half of them end at the
    same optimum, the best end then hops: it takes some coordinates of other ends, a few are drawn
    anew, and where the way down from there leads lower, it stays. Points and ways are shared out to
    the workers of an executor; hops, each of which begins where the one before led, are not.
    """
    generator = np.random.default_rng(seed)
    points = random_starts(count * screened, len(problem.names), seed)
    replacements = _REPLACEMENTS if screened == 1 else 0
    with nullcontext() if executor is None else open_pool(executor) as pool:
        shared = Shared("what is calibrated", problem, pool)
        first = shared.map(_expanded, [(z,) for z in points])
        tried = [_usable(problem, at, generator, replacements) for at in first]
        if screened > 1:
            ways = _promising(shared, problem, tried, count)
        else:
            ways = [_way(at) for at in tried]
        _go_on(shared, ways)
        agree = sum(way.at.cost <= ways[0].at.cost + _SAME_COST for way in ways)
        if np.isfinite(ways[0].at.cost) and agree < _AGREEING_SHARE * count:
            _hop(problem, ways, generator, _HOPS * count)
            _go_on(shared, ways)
    return ways


def _expanded(problem: Expandable, z: Array) -> Expansion:
    return problem.expanded(z)


def _after(problem: Expandable, way: Descent, iterations: int) -> Descent:
    """A way after some iterations more, also where it came from another process."""
    way.go(problem, iterations)
    return way


def _way(at: Expansion) -> Descent:
    """A way down from a point; there is none without trajectories."""
    return Descent(at, at.z, arrived=not np.isfinite(at.cost))


def _promising(
    shared: Shared[Expandable], problem: Expandable, tried: Sequence[Expansion], count: int
) -> list[Descent]:
    """So many ways that led lowest in a few iterations, of more that began apart."""
    ways = [_way(at) for at in _apart(problem, tried)[: _MORE * count]]
    ways = shared.map(_after, [(way, _FIRST_LEG) for way in ways])
    ways.sort(key=lambda way: way.at.cost)
    costs = np.array([way.at.cost for way in ways])
    above = np.concatenate([[np.inf], np.diff(np.nan_to_num(costs, posinf=1e300))])
    again = (above < _SAME_COST) & (costs > costs[0] + _SAME_COST)
    ended = [bool(same and way.arrived) for same, way in zip(again, ways, strict=True)]
    order = sorted(range(len(ways)), key=lambda k: ended[k])
    return [ways[k] for k in order[:count]]


def _apart(problem: Expandable, tried: Sequence[Expansion]) -> list[Expansion]:
    """Points by their rank; last those near a better one, which lead to the same place.

    Near are those in a ball that holds log N of N points on average (multi-level single linkage:
    Rinnooy Kan & Timmer, Mathematical Programming 39, 1987).
    """
    points, count = sorted(tried, key=_rank(problem)), len(tried)
    searched = np.array([at.z for at in points])[:, ~problem.nested]
    n = searched.shape[1]
    share = math.log(max(count, 2)) / count
    radius = math.exp((math.log(share) + math.lgamma(0.5 * n + 1.0)) / max(n, 1)) / math.sqrt(
        math.pi
    )
    distances = np.linalg.norm(searched[:, None] - searched, axis=2)
    near = [bool((distances[k, :k] < radius).any()) for k in range(count)]
    return [points[k] for k in sorted(range(count), key=lambda k: near[k])]


def _rank(problem: Expandable) -> Callable[[Expansion], tuple[bool, float]]:
    """Points by their costs; those last from which nothing promises a better likelihood."""

    def rank(at: Expansion) -> tuple[bool, float]:
        radius = np.where(problem.nested, 1.0, FIRST_RADIUS)
        flat = not np.isfinite(at.cost) or bounded_step(at, radius)[1] < _LEAST_PROMISE
        return flat, at.cost

    return rank


def _go_on(shared: Shared[Expandable], ways: list[Descent]) -> None:
    """All go on for some iterations, the best for more; they are sorted in place."""
    for many, iterations in _LEGS:
        going = [k for k, way in enumerate(ways[:many]) if not way.arrived]
        further = shared.map(_after, [(ways[k], iterations) for k in going])
        for k, way in zip(going, further, strict=True):
            ways[k] = way
        ways.sort(key=lambda way: way.at.cost)


def _hop(
    problem: Expandable, ways: list[Descent], generator: np.random.Generator, most: int
) -> None:
    """Take the best way to other places until ``most`` of them in a row led nowhere.

    A place has some coordinates of the best end, others of another end, and a few at random, as in
    evolution: what fits part of the data is passed on. The ends are those of the ways, and of hops.
    """
    best, ends = ways[0], [way.at for way in ways if np.isfinite(way.at.cost)]
    with limited() as account:
        in_vain, last = 0, account.done + _MOST_WORK
        while in_vain < most and account.done < last:
            drawn = [_crossed(best.at, ends, generator) for _ in range(_DRAWN)]
            other = _way(min(map(problem.expanded, drawn), key=_rank(problem)))
            other.go(problem, _HOP_ITERATIONS)
            best.iterations += other.iterations + 1
            gain = best.at.cost - other.at.cost
            in_vain = 0 if gain > _SAME_COST else in_vain + 1
            if gain > _HOP_GAIN:
                best.continue_from(other)
            if np.isfinite(other.at.cost):
                ends = _different([*ends, other.at])


def _crossed(best: Expansion, ends: Sequence[Expansion], generator: np.random.Generator) -> Array:
    """A place (n,) between the best end and another one."""
    z, n = best.z.copy(), best.z.size
    passed = generator.random(n) < generator.choice(_PASSED_SHARES)
    z[passed] = ends[int(generator.integers(len(ends)))].z[passed]
    drawn = generator.random(n) < generator.choice(_DRAWN_COORDINATES) / n
    drawn[generator.integers(n)] = True
    z[drawn] = generator.random(int(drawn.sum()))
    return z


def _different(ends: Sequence[Expansion]) -> list[Expansion]:
    """The best ends, one of each cost."""
    kept = list[Expansion]()
    for at in sorted(ends, key=lambda at: at.cost):
        if not kept or at.cost > kept[-1].cost + _SAME_COST:
            kept.append(at)
    return kept[:_MOST_ENDS]


def _usable(
    problem: Expandable, at: Expansion, generator: np.random.Generator, replacements: int
) -> Expansion:
    """The expansion at a start, or at the first random point that has trajectories."""
    for _ in range(replacements):
        if np.isfinite(at.cost):
            return at
        at = problem.expanded(generator.random(at.z.size))
    return at
