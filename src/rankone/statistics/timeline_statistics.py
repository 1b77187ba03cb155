"""Statistics of solutions with events: by lines that are divided where the solution jumps.

At one clock time parameters lie in different stretches and branches, and the states as functions of
the parameters may jump from one to the next: there are no integrals of products. Averages are over
closed lines through the box instead, more and more of them until they settle.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np
import scipy

from rankone.statistics.joint_distribution import JointDistribution
from rankone.statistics.line_averages import (
    EFFECTS,
    LASTING,
    MOMENTS,
    SENSITIVITIES,
    LineAverages,
    Weighted,
    relative_change,
    warn_of_changes,
)
from rankone.statistics.solution_statistics import Statistics
from rankone.support.arrays import Array
from rankone.support.budget import check_time
from rankone.support.errors import warn
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.pieces import PieceEvaluator
from rankone.tensors.timeline import TimelineEvaluator

_SIZE_POINTS = 2**10  # Points that tell the sizes of states
_PAIRS = 13  # Power of two of the pairs of points that tell parts of the variance to two digits
_MOST_PAIRS = 17  # The same where they tell them as well as they can
_HELD = 2**25  # Numbers of states at pairs of points that are held together
_MOST_DIMENSIONS = 4  # Of pairs of points on lines: in more, few lines miss how surfaces meet
_TIMES_AT_ONCE = 32  # Times, and points, at which states are held together
_POINTS_AT_ONCE = 1024


class TimelineStatistics(Statistics):
    """Statistics of states ``rows`` over clock time; at each one of those still running.

    A warning gives their share where trajectories have ended, and the accuracy of statistics that
    do not settle.
    """

    _latest: tuple[Array, tuple[Array, Array]] | None = None  # variances, and their times

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
        return self.over_points(times, points, lambda x: np.sqrt(np.mean(x**2, axis=1)))

    def first(self, times: Array) -> Array:
        """Variances of the means given one parameter, (states, parameters, times)."""
        return self._sensitivities(times)[0]

    def total(self, times: Array) -> Array:
        """Means of the variance over one parameter, (states, parameters, times)."""
        return self._sensitivities(times)[1]

    def second(self, times: Array) -> Array:
        """Variances of interactions, (states, parameters, parameters, times)."""
        count = len(self.parameters.measures)
        first = self.first(times)
        variances = np.zeros((len(self.rows), count, count, times.size))
        for i, j in combinations(range(count), 2):
            both = self._variance_given([i, j], times) - first[:, i] - first[:, j]
            variances[:, i, j] = variances[:, j, i] = np.maximum(both, 0.0)
        return variances

    def main_effect(self, times: Array, j: int, points: Array) -> Array:
        """Means given one parameter, (states, points, times)."""
        table = np.empty((len(self.rows), points.size, times.size))
        spread = np.sqrt(self.variance(times)).max(axis=1, initial=0.0)
        on_hyperplane = self.parameters.points_given

        def mean(states: Array, weights: Array) -> tuple[Array, Array]:
            return states @ weights, spread

        others = len(self.parameters.measures) - 1
        for k, place in enumerate(points.tolist()):

            def on_face(shares: Array, place: float = place) -> list[Array]:
                return [on_hyperplane(j, place, shares)]

            table[:, k], share = self._averages(times, others, on_face, mean, EFFECTS)
            _warn_of_ends(share)
        return table

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

    def at_points(self, time: float, points: Array, row: int) -> Array:
        """One state at one time and points (d, N), where they are still running."""
        [(_, (states,))] = self._at_all(np.array([time]), points, [row])
        runs = np.isfinite(states)
        _warn_of_ends(runs.mean(keepdims=True))
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
        table, share = np.full((*shape, times.size), np.nan), np.ones(times.size)
        for k, states in self._at_all(times, points, rows):
            runs = np.isfinite(states).all(axis=0)
            share[k] = runs.mean()
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

    # --- averages over lines -------------------------------------------------------------------

    @property
    def _averages(self) -> LineAverages:
        return LineAverages(self.evaluator, np.array(self.rows, dtype=np.intp))

    def _over_box(self, times: Array, of: Weighted) -> Array:
        """A statistic over the box, (..., times)."""
        points, count = self.parameters.points, len(self.parameters.measures)
        table, share = self._averages(times, count, lambda p: [points(p)], of, MOMENTS)
        _warn_of_ends(share)
        return table

    def _sensitivities(self, times: Array) -> tuple[Array, Array]:
        """Variances of first order and total ones, (states, parameters, times) each.

        They are kept for the next call.
        """
        latest = self._latest
        if latest is not None and np.array_equal(latest[0], times):
            return latest[1]
        count = len(self.parameters.measures)
        shape = len(self.rows), count, times.size
        first, total = np.empty(shape), np.empty(shape)
        for i in range(count):
            first[:, i] = self._variance_given([i], times)
            others = [j for j in range(count) if j != i]
            total[:, i] = self._of_pairs(others, times, _half_mean_square)
        self._latest = times.copy(), (np.maximum(first, 0.0), total)
        return self._latest[1]

    def shares_at_points(self, times: Array) -> tuple[Array, Array, Array]:
        """Variances, and those of first order and total ones, from few points.

        Shares of the variance were off by up to 0.02 in what was measured.

        (states, times), and (states, parameters, times) each, as :meth:`first` and :meth:`total`.
        NaN where some trajectory has ended.
        """
        count = len(self.parameters.measures)
        sequence = scipy.stats.qmc.Sobol(2 * count, scramble=False).random_base2(_PAIRS)
        shares = (sequence.T + np.random.default_rng(20145).random((2 * count, 1))) % 1.0
        here, there = (self._at_even(times, half) for half in np.split(shares, 2))
        first, total = np.empty((2, len(self.rows), count, times.size))
        for i in range(count):
            mixed = shares[:count].copy()
            mixed[i] = shares[count + i]
            between = self._at_even(times, mixed)
            first[:, i] = 0.5 * np.square(there - between).mean(axis=2)
            total[:, i] = 0.5 * np.square(here - between).mean(axis=2)
        variance = 0.5 * (here.var(axis=2) + there.var(axis=2))
        return variance, np.maximum(variance[:, None] - first, 0.0), total

    def _at_even(self, times: Array, shares: Array) -> Array:
        """States (rows, times, M) at points of the unit cube (d, M)."""
        points = self.parameters.points(shares)
        return np.stack([states for _, states in self._at_all(times, points, self.rows)], axis=1)

    def _variance_given(self, fixed: Sequence[int], times: Array) -> Array:
        """Variances of the means given some parameters, (states, times)."""
        return self._of_pairs(fixed, times, _covariance)

    def _of_pairs(
        self, same: Sequence[int], times: Array, of: Callable[[Array, Array, Array], Array]
    ) -> Array:
        """A part of the variance of each state, by pairs of points that share some parameters.

        Estimators of Jansen, "Analysis of variance designs for model output", Computer Physics
        Communications 117, 1999, and of Saltelli et al., the same 181, 2010. (states, times), NaN
        where some trajectory has ended: the parameters of the others are not independent.
        """
        count, rows = len(self.parameters.measures), len(self.rows)
        other = [j for j in range(count) if j not in same]

        def halves(shares: Array) -> list[Array]:
            second = shares[:count].copy()
            second[other] = shares[count:]
            return [shares[:count], second]

        def pairs(shares: Array) -> list[Array]:
            return [self.parameters.points(half) for half in halves(shares)]

        def of_pairs(states: Array, weights: Array) -> tuple[Array, Array]:
            x, y = states[:rows], states[rows:]
            return of(x, y, weights), _spread(x, weights) ** 2

        dimensions = count + len(other)
        if dimensions > _MOST_DIMENSIONS:
            return self._of_even_pairs(times, dimensions, halves, of)
        table, share = self._averages(times, dimensions, pairs, of_pairs, SENSITIVITIES)
        table[:, share < 1.0] = np.nan
        return table

    def _of_even_pairs(
        self,
        times: Array,
        dimensions: int,
        halves: Callable[[Array], Sequence[Array]],
        of: Callable[[Array, Array, Array], Array],
    ) -> Array:
        """The same at evenly spread pairs of points, twice as many of them until it settles."""
        table = np.full((len(self.rows), times.size), np.inf)
        latest, expected = np.full((2, times.size), np.inf)  # changes
        at_once = max(_HELD // (len(self.rows) << _MOST_PAIRS + 1), 1)
        for begin in range(0, times.size, at_once):
            left = np.arange(begin, min(begin + at_once, times.size))
            states = np.empty((2, len(self.rows), left.size, 0))
            for points in _even_points(dimensions):
                check_time()
                further = [self._at_even(times[left], half) for half in halves(points)]
                states = np.concatenate([states, further], axis=3)
                weights = np.full(states.shape[3], 1.0 / states.shape[3])
                for k, (x, y) in zip(left, states.transpose(2, 0, 1, 3), strict=True):
                    parts, variances = of(x, y, weights), _spread(x, weights) ** 2
                    expected[k] = LASTING * latest[k]
                    latest[k] = relative_change(parts, table[:, k], variances)
                    table[:, k] = parts
                going = np.maximum(latest, expected)[left] > SENSITIVITIES.settled
                left, states = left[going], states[:, :, going]
                if not left.size:
                    break
        warn_of_changes(float(latest.max(initial=0.0)), SENSITIVITIES.warned)
        return table


def _even_points(dimensions: int) -> Iterator[Array]:
    """Points (D, M) of the unit cube, as many as before each time, evenly spread with these."""
    sequence = scipy.stats.qmc.Sobol(dimensions, scramble=False)
    shift = np.random.default_rng(20145).random((dimensions, 1))
    for power in (_PAIRS - 1, *range(_PAIRS - 1, _MOST_PAIRS)):
        yield (sequence.random(2**power).T + shift) % 1.0


def _warn_of_ends(share: Array) -> None:
    """Warn if some trajectories alone still run at some time."""
    least = float(share.min(initial=1.0))
    if least < 1.0:
        warn(
            f"statistics are over the trajectories that are still running: {100 * least:.3g} % "
            "of the box at the latest time",
            remedy="ask for earlier times, or for what is left by `end`",
        )


def _apart(states: Array, weights: Array) -> Array:
    """States (rows, M) less their means."""
    return states - (states @ weights)[:, None]


def _spread(states: Array, weights: Array) -> Array:
    """Standard deviations (rows,) of states (rows, M)."""
    return np.asarray(np.sqrt(_apart(states, weights) ** 2 @ weights))


def _covariance(x: Array, y: Array, weights: Array) -> Array:
    """Covariances (rows,) of states (rows, M) at two sets of points with the same distribution."""
    middle = (0.5 * ((x + y) @ weights))[:, None]
    return np.asarray(((x - middle) * (y - middle)) @ weights)


def _half_mean_square(x: Array, y: Array, weights: Array) -> Array:
    return np.asarray(0.5 * ((x - y) ** 2 @ weights))
