"""Statistics of solutions that were joined of pieces: sums over pieces, with their probabilities.

Nothing is sampled where the parameters are independent and no piece has events. A mean given some
parameters is a sum over the pieces that hold them; its mean square is a sum over pairs of pieces,
each a product of one-dimensional integrals over what their boxes share. The mean is subtracted
first, as a further rank, so that nothing cancels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.solution.statistics.solution_statistics import ROUNDING_ERROR, Statistics
from rankone.solution.statistics.timeline_statistics import TimelineStatistics
from rankone.support.arrays import Array
from rankone.support.budget import check_time
from rankone.tensors.bases import Basis1D
from rankone.tensors.bases.coordinates import round_off
from rankone.tensors.bases.distributions import Measure
from rankone.tensors.bases.joint_distribution import JointDistribution
from rankone.tensors.evaluators.branch_evaluator import PieceEvaluator
from rankone.tensors.trains.slab import SlabTrain, sharing, slab_positions

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
        still = size <= ROUNDING_ERROR * np.abs(mean).max(axis=1, initial=0.0)[:, None]
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
