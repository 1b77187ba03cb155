"""Statistics of solutions with events, from evenly spread points.

At one clock time parameters lie in different stretches, and the states as functions of the
parameters may jump from one to the next: there are no integrals of products.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np

from rankone.statistics.joint_distribution import JointDistribution
from rankone.statistics.solution_statistics import Statistics
from rankone.support.arrays import Array
from rankone.support.errors import warn
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.timeline import TimelineEvaluator

POINTS = 2**15
"""Evenly spread points of a statistic: means and spreads are good to 2e-3 of the spread."""
_SOBOL_POINTS = 2**13  # Random points of each sample of Sobol indices: good to 2e-2
_EFFECT_POINTS = 2**11  # Points over the other parameters for each value of one parameter
_TIMES_AT_ONCE = 32  # Times, and points, at which states are held together
_POINTS_AT_ONCE = 1024
_SEED = 20142


class TimelineStatistics(Statistics):
    """Statistics of states ``rows`` over clock time; at each one of those still running.

    A warning gives their share where trajectories have ended.
    """

    _latest: tuple[Array, tuple[Array, Array]] | None = None  # variances, and their times

    def __init__(
        self,
        evaluator: TimelineEvaluator | BranchEvaluator,
        rows: Sequence[int],
        parameters: JointDistribution,
    ) -> None:
        self.evaluator, self.rows, self.parameters = evaluator, list(rows), parameters

    def mean(self, times: Array) -> Array:
        """Means, (states, times)."""
        return self._over_even_points(times, lambda states: states.mean(axis=1))

    def covariance(self, times: Array) -> Array:
        """Covariances, (states, states, times)."""

        def covariance(states: Array) -> Array:
            apart = states - states.mean(axis=1, keepdims=True)
            return np.asarray(apart @ apart.T / states.shape[1])

        return self._over_even_points(times, covariance)

    def variance(self, times: Array) -> Array:
        """Variances, (states, times)."""
        return self._over_even_points(times, lambda states: states.var(axis=1))

    def first(self, times: Array) -> Array:
        """Variances of the means given one parameter, (states, parameters, times)."""
        return self._pick_freeze(times)[0]

    def total(self, times: Array) -> Array:
        """Means of the variance over one parameter, (states, parameters, times)."""
        return self._pick_freeze(times)[1]

    def second(self, times: Array) -> Array:
        """Variances of interactions, (states, parameters, parameters, times)."""
        a, b = self._samples()
        count = len(a)
        first = self.first(times)
        variances = np.zeros((len(self.rows), count, count, times.size))
        for begin in range(0, times.size, _TIMES_AT_ONCE):
            here = slice(begin, begin + _TIMES_AT_ONCE)
            at_b = self._states(times[here], b)
            for i, j in combinations(range(count), 2):
                mixed = a.copy()
                mixed[[i, j]] = b[[i, j]]
                closed = _of_pairs(at_b, self._states(times[here], mixed), _covariance)
                both = closed - first[:, i, here] - first[:, j, here]
                variances[:, i, j, here] = variances[:, j, i, here] = np.maximum(both, 0.0)
        return variances

    def main_effect(self, times: Array, j: int, points: Array) -> Array:
        """Means given one parameter, (states, points, times)."""
        table = np.empty((len(self.rows), points.size, times.size))
        spread = self.parameters.even_points(_EFFECT_POINTS)
        for k, place in enumerate(points):
            on_face = spread.copy()
            on_face[j] = place
            table[:, k] = self.over_points(times, on_face, lambda states: states.mean(axis=1))
        return table

    def higher(self, times: Array, central: bool, tolerance: float) -> Array:
        """Root mean squares, and third and fourth moments over their powers, (3, states, times).

        NaN where nothing varies; the tolerance is that of the points.
        """

        def moments(states: Array) -> Array:
            apart = states - states.mean(axis=1, keepdims=True) if central else states
            size = np.sqrt(np.mean(apart**2, axis=1))
            still = size <= 1e-14 * np.abs(states).max(axis=1)
            scaled = apart / np.where(still, np.nan, size)[:, None]
            return np.stack([size, np.mean(scaled**3, axis=1), np.mean(scaled**4, axis=1)])

        return self._over_even_points(times, moments)

    def at_points(self, time: float, points: Array, row: int) -> Array:
        """One state at one time and points (d, N), where they are still running."""
        states = self._states(np.array([time]), points, [row])[0][0]
        runs = np.isfinite(states)
        _warn_of_ends(float(runs.mean()))
        return np.asarray(states[runs])

    def over_points(
        self,
        times: Array,
        points: Array,
        of: Callable[[Array], Array],
        rows: Sequence[int] | None = None,
    ) -> Array:
        """A function of values (states, points) of arrays of numbers, (..., times).

        It gets the points that are still running; where there are none it is NaN.
        """
        rows = self.rows if rows is None else list(rows)
        shape = of(np.zeros((len(rows), points.shape[1]))).shape
        table, share = np.full((*shape, times.size), np.nan), 1.0
        for k, states in self._at_all(times, points, rows):
            runs = np.isfinite(states).all(axis=0)
            share = min(share, float(runs.mean()))
            if runs.any():
                table[..., k] = of(states[:, runs])
        _warn_of_ends(share)
        return table

    def _at_all(
        self, times: Array, points: Array, rows: Sequence[int]
    ) -> Iterator[tuple[int, Array]]:
        """The position of each time, and the states (rows, N) there."""
        at = np.array(rows, dtype=np.intp)
        for begin in range(0, times.size, _TIMES_AT_ONCE):
            block = times[begin : begin + _TIMES_AT_ONCE, None]
            states = np.empty((at.size, block.size, points.shape[1]))
            for start in range(0, points.shape[1], _POINTS_AT_ONCE):
                here = slice(start, start + _POINTS_AT_ONCE)
                states[:, :, here] = self.evaluator.curves(block, points[:, here], at)
            yield from enumerate(states.swapaxes(0, 1), begin)

    def _over_even_points(self, times: Array, of: Callable[[Array], Array]) -> Array:
        return self.over_points(times, self.parameters.even_points(POINTS), of)

    def _samples(self) -> tuple[Array, Array]:
        """Two independent samples of the parameters (d, N)."""
        rng = np.random.default_rng(_SEED)
        count = len(self.parameters.measures)
        shares = rng.random((2, count, _SOBOL_POINTS))
        return self.parameters.points(shares[0]), self.parameters.points(shares[1])

    def _pick_freeze(self, times: Array) -> tuple[Array, Array]:
        """Variances of first order and total ones, (states, parameters, times) each.

        Estimators of Jansen, "Analysis of variance designs for model output", Computer Physics
        Communications 117, 1999, and of Saltelli et al., the same 181, 2010. They are kept for the
        next call.
        """
        latest = self._latest
        if latest is not None and np.array_equal(latest[0], times):
            return latest[1]
        a, b = self._samples()
        shape = len(self.rows), len(a), times.size
        first, total = np.empty(shape), np.empty(shape)
        for begin in range(0, times.size, _TIMES_AT_ONCE):
            here = slice(begin, begin + _TIMES_AT_ONCE)
            at_a, at_b = self._states(times[here], a), self._states(times[here], b)
            for i in range(len(a)):
                mixed = a.copy()
                mixed[i] = b[i]
                at_mixed = self._states(times[here], mixed)
                first[:, i, here] = _of_pairs(at_b, at_mixed, _covariance)
                total[:, i, here] = 0.5 * _of_pairs(at_a, at_mixed, _mean_square)
        self._latest = times.copy(), (np.maximum(first, 0.0), total)
        return self._latest[1]

    def _states(
        self, times: Array, points: Array, rows: Sequence[int] | None = None
    ) -> list[Array]:
        """States (rows, N) at each of a few times."""
        return [states for _, states in self._at_all(times, points, rows or self.rows)]


def _warn_of_ends(share: float) -> None:
    """Warn if a share of the trajectories alone still runs at the latest time."""
    if share < 1.0:
        warn(
            f"statistics are over the trajectories that are still running: {100 * share:.3g} % "
            "of the box at the latest time",
            remedy="ask for earlier times, or for what is left by `end`",
        )


def _covariance(x: Array, y: Array) -> float:
    return float(np.mean((x - np.mean(x)) * (y - np.mean(y))))


def _mean_square(x: Array, y: Array) -> float:
    return float(np.mean((x - y) ** 2))


def _of_pairs(
    one: Sequence[Array], other: Sequence[Array], of: Callable[[Array, Array], float]
) -> Array:
    """A number of each state at two samples of points, (states, times).

    NaN where some trajectory has ended: the parameters of the others are not independent.
    """
    table = np.full((len(one[0]), len(one)), np.nan)
    for k, (x, y) in enumerate(zip(one, other, strict=True)):
        if np.isfinite(x).all() and np.isfinite(y).all():
            table[:, k] = [of(p, q) for p, q in zip(x, y, strict=True)]
    return table
