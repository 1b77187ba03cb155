"""Profile likelihoods: how the least cost grows as one parameter is held away from its best value.

See Venzon & Moolgavkar, "A method for computing profile-likelihood-based confidence intervals"
(1988), and for what they say of parameters that data do not identify Raue et al., "Structural and
practical identifiability analysis" (2009). All held values are searched at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from rankone.estimation.least_squares import LeastSquares
from rankone.support.arrays import Array

__all__ = ["Best", "End", "Profile", "Stop", "profiles"]

_SHARES = np.array([0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0])
"""Where to look, in shares of the way to the bound."""
_SPREADS = np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0])
"""The same in standard deviations."""
_REFINEMENTS = 12
"""Most refinements of an end."""
CLOSE = 1e-4
"""How close an end comes to the limit, in shares of its root."""
_AT_BOUND = 1e-9


class Stop(Enum):
    """What ends an interval."""

    DATA = "the data"
    BOUND = "the bound of the parameter"
    OTHER = "the bound of another parameter"


@dataclass(frozen=True)
class End:
    """One end of an interval: its place in z, and what it is there for."""

    z: float
    stop: Stop


@dataclass(frozen=True)
class Best:
    """The best point: z (n,), its cost, and standard deviations (n,) to start with."""

    z: Array
    cost: float
    spread: Array


@dataclass(frozen=True)
class Profile:
    """The profile of one parameter.

    Attributes
    ----------
    index : int
    path : ndarray (k, n)
        Best points for values of the parameter, ascending.
    rise : ndarray (k,)
        How far their costs are above the least.
    lower, upper : End
        Where the rise reaches the limit, or where the box ends.
    """

    index: int
    path: Array
    rise: Array
    lower: End
    upper: End

    @property
    def width(self) -> float:
        """Length of the interval in z."""
        return self.upper.z - self.lower.z

    @property
    def bounded_by_box(self) -> bool:
        """Whether no end is there because of the data."""
        return Stop.DATA not in (self.lower.stop, self.upper.stop)


def profiles(
    problem: LeastSquares,
    best: Best,
    limit: float,
    indices: Sequence[int],
    close: float = CLOSE,
) -> list[Profile]:
    """The profiles of some parameters up to a rise of the cost by ``limit``.

    ``close`` is the share by which the root of the rise at an end may be off.
    """
    wanted = [(index, sign) for index in indices for sign in (-1.0, 1.0)]
    held = [_places(best, index, sign) for index, sign in wanted]
    rows = np.concatenate([np.full(len(z), k) for k, z in enumerate(held)])
    columns = np.array([wanted[k][0] for k in rows])
    points, costs = _along(problem, best, columns, np.concatenate(held))
    ways = []
    for k, (index, _) in enumerate(wanted):
        here = rows == k
        path = np.vstack([best.z, points[here]])
        rise = np.concatenate([[0.0], np.maximum(costs[here] - best.cost, 0.0)])
        ways.append(_Way(index, path, rise))
    _refine(problem, best, limit, ways, close)
    found = []
    for low, high in zip(ways[::2], ways[1::2], strict=True):
        path = np.vstack([low.path[:0:-1], high.path])
        rise = np.concatenate([low.rise[:0:-1], high.rise])
        found.append(Profile(low.index, path, rise, low.end(limit), high.end(limit)))
    return found


@dataclass
class _Way:
    """From the best point in one direction: best points (k, n) in order, and rises (k,)."""

    index: int
    path: Array
    rise: Array

    def above(self, limit: float) -> int:
        """The first point above the limit; the number of points if there is none."""
        higher = np.flatnonzero(self.rise > limit)
        return int(higher[0]) if higher.size else len(self.rise)

    def insert(self, at: int, point: Array, rise: float) -> None:
        self.path = np.insert(self.path, at, point, axis=0)
        self.rise = np.insert(self.rise, at, rise)

    def settled(self, limit: float, close: float) -> bool:
        k = self.above(limit)
        if k == len(self.rise):
            return True
        near = abs(np.sqrt(self.rise[[k - 1, k]] / limit) - 1.0).min() <= close
        z = self.path[[k - 1, k], self.index]
        return bool(near or abs(z[1] - z[0]) <= 1e-12)

    def between(self, limit: float, turn: int) -> float:
        """A value between the points below and above: by the secant of the root, or halfway."""
        k = self.above(limit)
        (a, b), (f, g) = self.path[[k - 1, k], self.index], np.sqrt(self.rise[[k - 1, k]])
        share = (np.sqrt(limit) - f) / (g - f) if g > f else 0.5
        share = 0.5 if turn % 4 == 3 else min(max(share, 0.02), 0.98)
        return float(a + share * (b - a))

    def end(self, limit: float) -> End:
        k = self.above(limit)
        if k == len(self.rise):
            return End(float(self.path[-1, self.index]), Stop.BOUND)
        pair = np.sqrt(self.rise[[k - 1, k]])
        share = float((np.sqrt(limit) - pair[0]) / (pair[1] - pair[0]))
        z = self.path[k - 1] + share * (self.path[k] - self.path[k - 1])
        others = np.delete(self.path[k], self.index)
        at_bound = (others <= _AT_BOUND) | (others >= 1.0 - _AT_BOUND)
        return End(float(z[self.index]), Stop.OTHER if at_bound.any() else Stop.DATA)


def _refine(
    problem: LeastSquares, best: Best, limit: float, ways: list[_Way], close: float
) -> None:
    """Close in on where the rise reaches the limit, on all ways at once."""
    for turn in range(_REFINEMENTS):
        waiting = [way for way in ways if not way.settled(limit, close)]
        if not waiting:
            return
        values = np.array([way.between(limit, turn) for way in waiting])
        columns = np.array([way.index for way in waiting])
        near = np.array([way.path[way.above(limit) - 1] for way in waiting])
        points, costs = _along(problem, best, columns, values, near)
        for way, point, cost in zip(waiting, points, costs, strict=True):
            way.insert(way.above(limit), point, max(float(cost) - best.cost, 0.0))


def _places(best: Best, index: int, sign: float) -> Array:
    """Values to hold a parameter at, from the best one outwards to its bound."""
    z = best.z[index]
    way = z if sign < 0.0 else 1.0 - z
    steps = np.concatenate([_SHARES * way, _SPREADS * best.spread[index]])
    steps = np.unique(steps[(steps > 1e-12) & (steps <= way)])
    return np.asarray(np.clip(z + sign * steps, 0.0, 1.0))


def _along(
    problem: LeastSquares, best: Best, columns: Array, values: Array, near: Array | None = None
) -> tuple[Array, Array]:
    """Best points (K, n) and costs (K,) with one coordinate of each held at a value."""
    starts = np.tile(best.z, (len(values), 1)) if near is None else near.copy()
    rows = np.arange(len(values))
    starts[rows, columns] = values
    held = np.zeros(starts.shape, dtype=bool)
    held[rows, columns] = True
    minima = problem.minima(starts, held)
    return minima.z, minima.cost
