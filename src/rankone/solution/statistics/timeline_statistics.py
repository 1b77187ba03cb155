"""Statistics of solutions with events: by lines that are divided where the solution jumps.

At one clock time parameters lie in different stretches and branches, and the states as functions of
the parameters may jump from one to the next: there are no integrals of products. Averages are over
closed lines through the box instead, more and more of them until they settle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from warnings import catch_warnings

import numpy as np

from rankone.solution.statistics.lines import MOMENTS, LineAverages, Weighted
from rankone.solution.statistics.solution_statistics import (
    Effect,
    Statistics,
    VarianceParts,
    warn_of_ends,
    when,
)
from rankone.support.arrays import Array
from rankone.support.progress import StepReport
from rankone.tensors.bases.joint_distribution import (
    SEED,
    SETS,
    JointDistribution,
    even_shares,
    half_width,
)
from rankone.tensors.evaluators.branch_evaluator import BranchEvaluator, PieceEvaluator
from rankone.tensors.evaluators.timeline_evaluator import TimelineEvaluator

_LEAST_SPREAD = 1e-12  # Of a mean, below which nothing but rounding varies
_SIZE_POINTS = 2**10  # Points that tell the sizes of states
# Evaluations that parts of the variance take, about 5 s, and those that begin a point at no time
_EVALUATIONS, _EVALUATIONS_TO_BEGIN = 2**23, 20
_FEWEST_EACH, _MOST_EACH = 2**5, 2**10  # Points of a set for them
_FEWEST_OF_FACE = 2**3  # Points of a set where one parameter has a value
_HELD = 2**22  # Numbers of states that are held together for them
_TIMES_AT_ONCE = 32  # Times, and points, at which states are held together
_POINTS_AT_ONCE = 1024


class TimelineStatistics(Statistics):
    """Statistics of states ``rows`` over clock time; at each one of those still running.

    A warning gives their share where trajectories have ended, and the accuracy of statistics that
    do not settle.
    """

    def __init__(
        self,
        evaluator: TimelineEvaluator | BranchEvaluator | PieceEvaluator,
        rows: Sequence[int],
        parameters: JointDistribution,
    ) -> None:
        self.evaluator, self.rows, self.parameters = evaluator, list(rows), parameters

    def mean(self, times: Array) -> Array:
        """Means, (states, times)."""

        def mean(states: Array, weights: Array) -> tuple[Array, Array]:
            return states @ weights, _spread(states, weights)

        return self._over_box(times, mean)

    def covariance(self, times: Array) -> Array:
        """Covariances, (states, states, times)."""

        def covariance(states: Array, weights: Array) -> tuple[Array, Array]:
            apart, spread = _apart(states, weights), _spread(states, weights)
            return (apart * weights) @ apart.T, np.outer(spread, spread)

        return self._over_box(times, covariance)

    def variance(self, times: Array) -> Array:
        """Variances, (states, times)."""

        def variance(states: Array, weights: Array) -> tuple[Array, Array]:
            variances = _spread(states, weights) ** 2
            return variances, variances

        return self._over_box(times, variance)

    def root_mean_squares(self, times: Array) -> Array:
        """Sizes of the states, (states, times), from few points: to two digits."""
        points = self.parameters.even_points(_SIZE_POINTS)
        table = np.full((len(self.rows), times.size), np.nan)
        for k, states in self._at_all(times, points, self.rows):
            runs = np.isfinite(states).all(axis=0)
            if runs.any():
                table[:, k] = np.sqrt(np.mean(states[:, runs] ** 2, axis=1))
        return table

    def variance_parts(self, times: Array, count: int | None, report: StepReport) -> VarianceParts:
        """The variance and its parts, from points in pairs that share some parameters.

        NaN where some trajectory has ended: the parameters of the others are not independent.
        Without a ``count`` there are as many points as about 2^23 evaluations allow.
        """
        d, n = len(self.parameters.measures), len(self.rows)
        if count is None:
            each = _EVALUATIONS // (SETS * (2 * d + 2) * (times.size + _EVALUATIONS_TO_BEGIN))
            each = 2 ** int(math.log2(min(max(each, _FEWEST_EACH), _MOST_EACH)))
        else:
            each = -(-count // SETS)
        of_sets = np.empty((SETS, n, 1 + d * (d + 2), times.size))
        at_once = max(_HELD // (n * (2 * d + 2) * each), 1)
        for k in range(SETS):
            shares = _sharing_pairs(even_shares(each, 2 * d, (SEED, k)))
            for begin in range(0, times.size, at_once):
                block = slice(begin, begin + at_once)
                states = self._at_even(times[block], shares)
                of_sets[k, ..., block] = _parts(states.reshape(*states.shape[:2], -1, each))
            report(k + 1, SETS)
        mean = of_sets.mean(axis=0)
        with np.errstate(all="ignore"):
            ratios = np.nan_to_num(mean / mean[:, :1])
        widths = half_width(of_sets - ratios * of_sets[:, :, :1])

        def split(table: Array) -> tuple[Array, Array, Array]:
            first, total = table[:, 1 : d + 1], table[:, d + 1 : 2 * d + 1]
            return first, total, table[:, 2 * d + 1 :].reshape(n, d, d, -1)

        first, total, second = split(mean)
        parts = np.maximum(first, 0.0), total, np.maximum(second, 0.0)
        ended = times[np.isnan(mean[:, 0]).any(axis=0)]
        doubts = (
            [f"there are no Sobol indices{when(ended)}, where some trajectories have ended"]
            if ended.size
            else []
        )
        return VarianceParts(mean[:, 0], parts, split(widths), tuple(doubts))

    def main_effect(self, times: Array, j: int, points: Array) -> Array:
        """Means given one parameter, (states, points, times)."""
        return self.effect(times, j, points).means

    def effect(self, times: Array, j: int, points: Array) -> Effect:
        """Means given one parameter, from sets of points of the others that all values share."""
        d = len(self.parameters.measures)
        faces = max(d * points.size, 1)
        each = _EVALUATIONS // (SETS * faces * (times.size + _EVALUATIONS_TO_BEGIN))
        each = 2 ** int(math.log2(min(max(each, _FEWEST_OF_FACE), _MOST_EACH)))
        others = np.hstack([even_shares(each, d - 1, (SEED, k)) for k in range(SETS)])
        shape = len(self.rows), points.size, times.size
        means, widths, squares = np.empty(shape), np.empty(shape), np.zeros((2, *shape[::2]))
        running = np.ones(times.size)
        for p, place in enumerate(points.tolist()):
            at = self.parameters.points_given(j, place, others)
            for k, states in self._at_all(times, at, self.rows):
                with np.errstate(all="ignore"), catch_warnings(action="ignore"):
                    of_sets = np.nanmean(states.reshape(len(self.rows), SETS, -1), axis=2)
                    means[:, p, k] = of_sets.mean(axis=1)
                    widths[:, p, k] = half_width(of_sets, 1)
                    squares[:, :, k] += np.nanmean(states, 1), np.nanmean(states**2, 1)
                running[k] = min(running[k], np.isfinite(states).all(axis=0).mean())
        mean, square = squares / points.size
        spread = np.sqrt(np.maximum(square - mean**2, 0.0))[:, None]
        varies = spread > _LEAST_SPREAD * np.abs(mean)[:, None]
        relative = np.divide(widths, spread, out=np.zeros(shape), where=varies)
        largest = float(np.nanmax(relative, initial=0.0))
        return Effect(means, widths, largest, float(running.min(initial=1.0)))

    def higher(self, times: Array, central: bool, tolerance: float) -> Array:
        """Root mean squares, and third and fourth moments over their powers, (3, states, times).

        NaN where nothing varies; the tolerance is that of the lines.
        """

        def moments(states: Array, weights: Array) -> tuple[Array, Array]:
            apart = _apart(states, weights) if central else states
            size = np.sqrt(apart**2 @ weights)
            still = size <= 1e-14 * np.abs(states).max(axis=1)
            scaled = apart / np.where(still, np.nan, size)[:, None]
            shape = np.stack([size, scaled**3 @ weights, scaled**4 @ weights])
            return shape, np.stack([size, np.ones_like(size), shape[2]])

        return self._over_box(times, moments)

    def over_points(
        self,
        times: Array,
        points: Array,
        of: Callable[[Array], Array],
        rows: Sequence[int] | None = None,
    ) -> Array:
        """A function of values (states, points) of arrays of numbers, (..., times).

        Values are NaN at points that have ended; where all have it is not called, but NaN.
        """
        rows = self.rows if rows is None else list(rows)
        shape = of(np.zeros((len(rows), points.shape[1]))).shape
        table, share = np.full((*shape, times.size), np.nan), np.ones(times.size)
        for k, states in self._at_all(times, points, rows):
            runs = np.isfinite(states).all(axis=0)
            share[k] = runs.mean()
            if runs.any():
                table[..., k] = of(np.where(runs, states, np.nan))
        warn_of_ends(float(share.min(initial=1.0)))
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

    # --- averages over lines -------------------------------------------------------------------

    @property
    def _averages(self) -> LineAverages:
        return LineAverages(self.evaluator, np.array(self.rows, dtype=np.intp), self.report)

    def _over_box(self, times: Array, of: Weighted) -> Array:
        """A statistic over the box, (..., times)."""
        points, count = self.parameters.points, len(self.parameters.measures)
        table, share = self._averages(times, count, points, of, MOMENTS)
        warn_of_ends(float(share.min(initial=1.0)))
        return table

    def _at_even(self, times: Array, shares: Array) -> Array:
        """States (rows, times, M) at points of the unit cube (d, M)."""
        points = self.parameters.points(shares)
        return np.stack([states for _, states in self._at_all(times, points, self.rows)], axis=1)


def _sharing_pairs(shares: Array) -> Array:
    """Points (d, (2 d + 2) M) from shares (2 d, M): A, B, A with each row of B, B with those of A.

    Saltelli, "Making best use of model evaluations to compute sensitivity indices", Computer
    Physics Communications 145, 2002.
    """
    a, b = np.split(shares, 2)
    blocks = [a, b]
    for one, other in ((a, b), (b, a)):
        for i in range(len(a)):
            mixed = one.copy()
            mixed[i] = other[i]
            blocks.append(mixed)
    return np.hstack(blocks)


def _parts(states: Array) -> Array:
    """The variance and its parts of first order, total and second, (rows, 1 + d (d + 2), times).

    States (rows, times, 2 d + 2, M) are at the points of :func:`_sharing_pairs`. The variance less
    half the mean square of a difference is the covariance (Jansen, "Analysis of variance designs
    for model output", Computer Physics Communications 117, 1999).
    """
    d = states.shape[2] // 2 - 1
    a, b = states[:, :, :1], states[:, :, 1:2]
    from_b, from_a = states[:, :, 2 : 2 + d], states[:, :, 2 + d :]

    def apart(x: Array, y: Array) -> Array:
        return np.asarray(0.5 * np.mean((x - y) ** 2, axis=-1))

    variance = states[:, :, :2].reshape(*states.shape[:2], -1).var(axis=2)[..., None]
    first = variance - 0.5 * (apart(b, from_b) + apart(a, from_a))
    total = 0.5 * (apart(a, from_b) + apart(b, from_a))
    second = np.zeros((*states.shape[:2], d, d))
    for i, j in combinations(range(d), 2):
        pairs = (from_a[:, :, i], from_b[:, :, j]), (from_a[:, :, j], from_b[:, :, i])
        both = variance[..., 0] - 0.5 * sum(apart(x, y) for x, y in pairs)
        second[:, :, i, j] = second[:, :, j, i] = both - first[:, :, i] - first[:, :, j]
    every = [variance, first, total, second.reshape(*states.shape[:2], -1)]
    return np.concatenate(every, axis=2).swapaxes(1, 2)


def _apart(states: Array, weights: Array) -> Array:
    """States (rows, M) less their means."""
    return states - (states @ weights)[:, None]


def _spread(states: Array, weights: Array) -> Array:
    """Standard deviations (rows,) of states (rows, M)."""
    return np.asarray(np.sqrt(_apart(states, weights) ** 2 @ weights))
