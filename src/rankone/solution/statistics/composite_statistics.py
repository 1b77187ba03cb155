"""Statistics of solutions with events, and of those that were joined of pieces.

At one clock time parameters lie in different stretches and branches, and the states as functions of
the parameters may jump from one to the next: there are no integrals of products. Averages are over
closed lines through the box instead, more and more of them until they settle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from warnings import catch_warnings

import numpy as np
from numpy.typing import NDArray

from rankone.solution.statistics.lines import MOMENTS, LineAverages, Weighted
from rankone.solution.statistics.solution_statistics import (
    Effect,
    Statistics,
    VarianceParts,
    warn_of_ends,
    when,
)
from rankone.support.arrays import ACCUMULATED, AT_ONCE, COINCIDENT, ROUNDING, SEED, Array
from rankone.support.budget import StepReport, check_time
from rankone.support.errors import EvaluationError
from rankone.tensors import Basis1D
from rankone.tensors.branch_evaluator import BranchEvaluator, PieceEvaluator
from rankone.tensors.coordinates import round_off
from rankone.tensors.distributions import Measure
from rankone.tensors.joint_distribution import SETS, JointDistribution, even_shares, half_width
from rankone.tensors.slab import SlabTrain, sharing, slab_positions
from rankone.tensors.timeline_evaluator import TimelineEvaluator

_SIZE_POINTS = 2**10  # Points that tell the sizes of states
# Evaluations that parts of the variance take, about 5 s, and those that begin a point at no time
_EVALUATIONS, _EVALUATIONS_TO_BEGIN = 2**23, 20
_FEWEST_EACH, _MOST_EACH = 2**5, 2**10  # Points of a set for them
_FEWEST_OF_FACE = 2**3  # Points of a set where one parameter has a value


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
        # each block of times contracts the cores for all points again, so that it is large
        at_once = max(8 * AT_ONCE // (n * (2 * d + 2) * each), 1)
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
        effects = np.maximum(first, 0.0), total, np.maximum(second, 0.0)
        ended = times[np.isnan(mean[:, 0]).any(axis=0)]
        doubts = (
            [f"there are no Sobol indices{when(ended)}, where some trajectories have ended"]
            if ended.size
            else []
        )
        return VarianceParts(mean[:, 0], effects, split(widths), tuple(doubts))

    def first_covariances(self, times: Array) -> Array:
        """Refused: they are not products of one-dimensional integrals."""
        raise EvaluationError(
            "Sobol indices of fields are not computed over solutions with events or joined pieces",
            remedy="ask for them of outputs: solution.output({...}).sobol(t)",
        )

    total_covariances = first_covariances

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
        varies = spread > COINCIDENT * np.abs(mean)[:, None]
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
            still = size <= ROUNDING * np.abs(states).max(axis=1)
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
        step = max(8 * AT_ONCE // max(at.size * points.shape[1], 1), 1)
        for begin in range(0, times.size, step):
            states = self.evaluator.curves(times[begin : begin + step, None], points, at)
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


# -----------------------------------------------------------------------------
# Statistics of solutions that were joined of pieces: sums over pieces, with their probabilities.
#
# Nothing is sampled where the parameters are independent and no piece has events. A mean given some
# parameters is a sum over the pieces that hold them; its mean square is a sum over pairs of pieces,
# each a product of one-dimensional integrals over what their boxes share. The mean is subtracted
# first, as a further rank, so that nothing cancels.


# Nodes beyond both degrees for products of polynomials in different coordinates
_MORE_NODES = 16


class PieceStatistics(TimelineStatistics):
    """Statistics of states ``rows`` of pieces without events, of independent parameters.

    ``slabs`` are those of each piece of the evaluator. What takes evenly spread points, such as
    quantiles, goes through the evaluator.
    """

    def __init__(
        self,
        slabs: Sequence[Sequence[SlabTrain]],
        evaluator: PieceEvaluator,
        rows: Sequence[int],
        parameters: JointDistribution,
    ) -> None:
        super().__init__(evaluator, rows, parameters)
        self._count = len(parameters.measures)
        self._tiling = evaluator.tiling
        pieces = (
            _Piece.of(position, own, self.rows, parameters.measures)
            for position, own in enumerate(slabs)
        )
        self._pieces = [piece for piece in pieces if piece is not None]

    def mean(self, times: Array) -> Array:
        """Means, (states, times)."""
        return self._sum(lambda piece: piece.statistics.mean(times))

    def covariance(self, times: Array) -> Array:
        """Covariances, (states, states, times)."""
        mean = self.mean(times)

        def about_mean(piece: _Piece) -> Array:
            apart = piece.statistics.mean(times) - mean
            return piece.statistics.covariance(times) + apart[:, None] * apart[None, :]

        return self._sum(about_mean)

    def variance(self, times: Array) -> Array:
        """Variances, (states, times)."""
        mean = self.mean(times)

        def about_mean(piece: _Piece) -> Array:
            return piece.statistics.variance(times) + (piece.statistics.mean(times) - mean) ** 2

        return self._sum(about_mean)

    def root_mean_squares(self, times: Array) -> Array:
        """Sizes of the states, (states, times)."""
        return np.hypot(self.mean(times), np.sqrt(self.variance(times)))

    def higher(self, times: Array, central: bool, tolerance: float) -> Array:
        """Root mean squares, and third and fourth moments over their powers, (3, states, times)."""
        mean = self.mean(times)
        centre = mean if central else np.zeros_like(mean)

        def powers(piece: _Piece) -> Array:
            """Means of the second to the fourth power of the distance from the centre."""
            size, *shares = piece.statistics.higher(times, True, tolerance)
            third, fourth = (np.nan_to_num(share) for share in shares)
            apart = piece.statistics.mean(times) - centre
            square, cube = size**2, size**3 * third
            return np.stack(
                [
                    square + apart**2,
                    cube + 3.0 * square * apart + apart**3,
                    size**4 * fourth + 4.0 * cube * apart + 6.0 * square * apart**2 + apart**4,
                ]
            )

        square, cube, fourth = self._sum(powers)
        size = np.sqrt(square)
        still = size <= ACCUMULATED * np.abs(mean).max(axis=1, initial=0.0)[:, None]
        divisor = np.where(still, np.nan, size)
        return np.stack([size, cube / divisor**3, fourth / divisor**4])

    variance_parts = Statistics.variance_parts

    def main_effect(self, times: Array, j: int, points: Array) -> Array:
        """Means given one parameter, (states, points, times)."""
        line = self._tiling.edges[j]
        cells = np.searchsorted(line[1:-1], points, side="right")
        table = np.zeros((len(self.rows), points.size, times.size))
        for piece in self._pieces:
            here = np.flatnonzero(np.isin(cells, self._tiling.cells_of(piece.position)[j]))
            if here.size:
                effect = piece.statistics.main_effect(times, j, points[here])
                table[:, here] += piece.share_without(j) * effect
        return table

    def first(self, times: Array) -> Array:
        """Variances of the means given one parameter, (states, parameters, times)."""
        return np.stack([self._given(times, (j,)) for j in range(self._count)], axis=1)

    def total(self, times: Array) -> Array:
        """Means of the variance over one parameter, (states, parameters, times)."""
        variance = self.variance(times)
        others = (tuple(i for i in range(self._count) if i != j) for j in range(self._count))
        rest = [np.maximum(variance - self._given(times, other), 0.0) for other in others]
        return np.stack(rest, axis=1)

    def second(self, times: Array) -> Array:
        """Variances of interactions, (states, parameters, parameters, times)."""
        first = self.first(times)
        variances = np.zeros((len(self.rows), self._count, self._count, times.size))
        for i, j in itertools.combinations(range(self._count), 2):
            both = self._given(times, (i, j)) - first[:, i] - first[:, j]
            variances[:, i, j] = variances[:, j, i] = np.maximum(both, 0.0)
        return variances

    def _sum(self, of: Callable[[_Piece], Array]) -> Array:
        """A sum over the pieces, with their probabilities."""
        return np.asarray(sum(math.prod(piece.shares) * of(piece) for piece in self._pieces))

    def _given(self, times: Array, kept: tuple[int, ...]) -> Array:
        """Variances of the means given some parameters, (states, times)."""
        variances = np.zeros((len(self.rows), times.size))
        if not kept:
            return variances
        mean = self.mean(times)
        for here, runs in _by_runs(self._pieces, times):
            firsts = [piece.about(times[here], mean[:, here], self.rows) for piece in self._pieces]
            for one, other in itertools.combinations_with_replacement(range(len(firsts)), 2):
                check_time()
                pair = self._pieces[one].trains[runs[one]], self._pieces[other].trains[runs[other]]
                product = self._mean_product(*pair, kept)
                if product is not None:
                    square = np.einsum("ntr,rs,nts->nt", firsts[one], product, firsts[other])
                    variances[:, here] += square if one == other else 2.0 * square
        return np.maximum(variances, 0.0)

    def _mean_product(self, one: _Train, other: _Train, kept: tuple[int, ...]) -> Array | None:
        """The mean, over some parameters, of the product of two means over all others.

        A matrix (r, s) between the first cores; None if the boxes share nothing.
        """
        for j in kept:
            if not _shared(one.bases[j], other.bases[j]):
                return None
        product = np.ones((1, 1))
        for j in reversed(range(self._count)):
            if j not in kept:
                product = one.means[j] @ product @ other.means[j].T
                continue
            points, weights = _rule(self.parameters.measures[j], one.bases[j], other.bases[j])
            ahead = (weights[:, None, None] * one.at(j, points)) @ product
            product = np.tensordot(ahead, other.at(j, points), ((0, 2), (0, 2)))
        return product


class _Train:
    """The product of the cores of the parameters of a piece, with a row for the constant one.

    ``means`` has for each parameter the integral of its core over the interval of the piece.
    """

    def __init__(self, slab: SlabTrain, measures: Sequence[Measure], shares: Sequence[float]):
        self.bases = slab.bases
        last = len(slab.bases) - 1
        self.cores, self.means = [], []
        for j, (core, basis) in enumerate(zip(slab.cores[1:], slab.bases, strict=True)):
            one = basis.to_modal @ np.sqrt(basis.weights)  # modes of the constant function one
            before, modes, after = core.shape
            widened = np.zeros((before + 1, modes, after + (j < last)))
            widened[:before, :, :after] = core
            widened[before, :, -1] = one
            self.cores.append(widened)
            modes_mean, _ = measures[j].integrals(basis)
            self.means.append(shares[j] * np.tensordot(widened, modes_mean, (1, 0)))

    def at(self, j: int, points: Array) -> Array:
        """The matrices of one parameter at points, (points, r, s)."""
        modes = self.bases[j].modal_values(points)
        return np.asarray(np.einsum("qm,rms->qrs", modes, self.cores[j]))


@dataclass(frozen=True)
class _Piece:
    """A piece with its probability: ``shares`` has one factor for the interval of each parameter.

    ``runs`` has for each slab the position of its train among ``trains``.
    """

    position: int
    slabs: tuple[SlabTrain, ...]
    shares: tuple[float, ...]
    statistics: Statistics
    trains: tuple[_Train, ...]
    runs: NDArray[np.intp]

    @classmethod
    def of(
        cls,
        position: int,
        slabs: Sequence[SlabTrain],
        rows: Sequence[int],
        whole: Sequence[Measure],
    ) -> _Piece | None:
        """A piece with the measures of the whole box; None where these have no probability."""
        ends = [(basis.lower, basis.upper) for basis in slabs[0].bases]
        shares = tuple(m.share(*interval) for m, interval in zip(whole, ends, strict=True))
        if not all(shares):
            return None
        pairs = zip(whole, ends, strict=True)
        cut = tuple(measure.cut(*interval) for measure, interval in pairs)
        runs = list(sharing(slabs))
        return cls(
            position,
            tuple(slabs),
            shares,
            Statistics(slabs, rows, JointDistribution(cut)),
            tuple(_Train(run[0], cut, shares) for run in runs),
            np.repeat(np.arange(len(runs)), [len(run) for run in runs]),
        )

    def share_without(self, j: int) -> float:
        """The probability of the intervals of all parameters but one."""
        return math.prod(share for i, share in enumerate(self.shares) if i != j)

    def about(self, times: Array, mean: Array, rows: Sequence[int]) -> Array:
        """First cores of states minus their mean (states, T) at times: (states, T, r + 1)."""
        owner = slab_positions(self.slabs, times)
        first = np.empty((len(rows), times.size, self.slabs[owner[0]].cores[0].shape[2] + 1))
        first[:, :, -1] = -mean
        for k in np.unique(owner):
            here = owner == k
            first[:, here, :-1] = self.slabs[k].in_time(times[here])[rows]
        return first


def _by_runs(
    pieces: Sequence[_Piece], times: Array
) -> Iterator[tuple[NDArray[np.intp], tuple[int, ...]]]:
    """Which times have the same trains in all pieces, and the positions of these."""
    table = np.array([piece.runs[slab_positions(piece.slabs, times)] for piece in pieces])
    for runs in np.unique(table, axis=1).T:
        here = np.flatnonzero((table == runs[:, None]).all(axis=0))
        yield here, tuple(runs.tolist())


def _shared(one: Basis1D, other: Basis1D) -> bool:
    """Whether the intervals of two bases have more than an end in common, beyond rounding."""
    lower, upper = max(one.lower, other.lower), min(one.upper, other.upper)
    return upper - lower > round_off(one.lower, one.upper)


def _rule(measure: Measure, one: Basis1D, other: Basis1D) -> tuple[Array, Array]:
    """Points and weights that integrate products of modes of two bases where both are."""
    lower, upper = max(one.lower, other.lower), min(one.upper, other.upper)
    share = measure.share(lower, upper)
    if not share:
        return np.array([lower]), np.zeros(1)
    bases = [basis.restricted(lower, upper) for basis in (one, other)]
    apart = round_off(lower, upper)
    breaks = np.unique([edge for basis in bases for edge in basis.breaks])
    breaks = breaks[np.diff(breaks, prepend=-np.inf) > apart]
    degree = max(one.degree, other.degree)
    if one.scale != other.scale:  # neither is a polynomial in the coordinate of the other
        degree = one.degree + other.degree + _MORE_NODES
    finest = replace(
        bases[0], degree=degree, breaks=tuple(breaks.tolist()), elements=breaks.size + 1
    )
    points, weights = measure.cut(lower, upper).quadrature(finest)
    return points, share * weights
