"""Moments of a train some of whose parameters are correlated.

Given the correlated ones, the others are independent: means are products, as in
:mod:`rankone.statistics.moments`. Over the correlated ones there is a quadrature, finer and finer
until nothing changes. The variance is that of the mean given them and the mean of that given them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.discretization import Basis1D
from rankone.statistics.copula import Copula
from rankone.statistics.measures import Measure
from rankone.statistics.moments import TrainMoments
from rankone.support.arrays import Array
from rankone.support.budget import check_time
from rankone.support.errors import warn

__all__ = ["ConditionalMoments"]

_SETTLED, _SAID = 1e-6, 1e-4
"""Relative change from rule to rule with which one is content, and from which on it is said. For
smooth functions the error of the finer rule is far below it, with kinks it is about as large."""
_BLOCK = 8_000_000
"""Numbers that are formed at once."""


class ConditionalMoments(TrainMoments):
    """Mean and covariance as :class:`~rankone.statistics.moments.TrainMoments` has them.

    Parameters
    ----------
    cores, bases, measures
        As there.
    copula : Copula
    """

    def __init__(
        self,
        cores: Sequence[Array],
        bases: Sequence[Basis1D],
        measures: Sequence[Measure],
        copula: Copula,
    ) -> None:
        super().__init__(cores, bases, measures)
        self.measures, self.copula = measures, copula

    @property
    def mean(self) -> Array:
        """The vector m with the mean ``a(t) m``."""
        return self._both[0]

    @property
    def covariance(self) -> Array:
        """The matrix of the variance, (1, r_1, r_1)."""
        return self._both[1][None]

    @cached_property
    def _both(self) -> tuple[Array, Array]:
        """Mean and covariance, by the first rule that settles."""
        found, change = None, 0.0
        for shares, weights in self.copula.rules():
            self._rule = self._values(shares), weights
            mean, covariance = self._over(*self._rule)
            if found is not None:
                size = np.linalg.norm(covariance)
                change = max(
                    float(np.linalg.norm(mean - found[0]) / np.sqrt(size or 1.0)),
                    float(np.linalg.norm(covariance - found[1]) / (size or 1.0)),
                )
            settled = found is not None and change <= _SETTLED
            found = mean, covariance
            if settled:
                break
        assert found is not None
        if change > _SAID:
            warn(
                f"the quadrature over correlated parameters has settled to {change:.1e} only, "
                "relative to the standard deviation"
            )
        return found

    def main_effect(self, j: int, points: Array) -> Array:
        """The vectors m with the mean ``a(t) m`` given one parameter, (r_1, points)."""
        if j in self.copula.positions:
            return np.stack([self._mean_given(j, point) for point in points], axis=1)
        self._both  # noqa: B018 - finds the rule
        values, weights = self._rule
        before, _, after = self.cores[j].shape
        rank = self.cores[0].shape[0]
        found = np.zeros((rank, before, after))
        for here in _blocks(weights.size, max(self._largest, rank * before)):
            known = dict(zip(self.copula.positions, values[:, here], strict=True))
            left = np.eye(rank)[None]
            for i in range(j):
                left = left @ (self.matrices(i, known[i]) if i in known else self.means[i])
            right = self._means_of_product(known, weights[here].size, j + 1)
            left = np.broadcast_to(left, (weights[here].size, rank, before))
            found += np.einsum("qab,q,cq->abc", left, weights[here], right, optimize=True)
        at = np.einsum("pm,rms->prs", self.bases[j].modal_values(points), self.cores[j])
        return np.asarray(np.einsum("abc,pbc->ap", found, at))

    def _mean_given(self, j: int, point: float) -> Array:
        """The same for one value of a correlated parameter, (r_1,)."""
        place = self.copula.positions.index(j)
        found = None
        for shares, weights in self.copula.given(place, self.measures[j].normal(point)):
            values = self._values(shares)
            values[place] = point
            known = dict(zip(self.copula.positions, values, strict=True))
            mean = self._means_of_product(known, weights.size, 0) @ weights
            if found is not None and np.linalg.norm(mean - found) <= _SETTLED * np.linalg.norm(
                mean
            ):
                return np.asarray(mean)
            found = mean
        return np.asarray(found)

    def _means_of_product(self, known: dict[int, Array], count: int, first: int) -> Array:
        """Means of the product from one parameter on, the correlated ones given, (r, Q)."""
        check_time()
        mean = np.ones((1, count))
        for j in reversed(range(first, self.count)):
            if j in known:
                mean = np.einsum("qrs,sq->rq", self.matrices(j, known[j]), mean)
            else:
                mean = self.means[j] @ mean
        return mean

    def _values(self, shares: Array) -> Array:
        """Values of the correlated parameters at shares of their probabilities, (k, Q)."""
        pairs = zip(self.copula.positions, shares, strict=True)
        return np.array([self.measures[j].sample(row) for j, row in pairs])

    def _over(self, values: Array, weights: Array) -> tuple[Array, Array]:
        """Mean and covariance of the product of all matrices by one rule."""
        tails, inner = [], np.zeros((1, 1))
        for here in _blocks(weights.size, self._largest):
            tail, within, places = self._given(values[:, here])
            tails.append(tail[:, places])
            shares = np.bincount(places, weights[here])
            inner = inner + np.tensordot(shares, within, 1)
        tail = np.hstack(tails)
        mean = tail @ weights
        spread = (tail - mean[:, None]) * np.sqrt(weights)
        covariance = spread @ spread.T + inner
        for j in reversed(range(self.copula.positions[0])):
            mean, covariance = self._free(j, mean[:, None], covariance[None])
            mean, covariance = mean[:, 0], covariance[0]
        return mean, covariance

    def _given(self, values: Array) -> tuple[Array, Array, NDArray[np.intp]]:
        """Means (r, U) and covariances (U, r, r) of the product of the matrices from the first
        correlated parameter on, the correlated ones given (k, Q), and which of them it is (Q,).

        A value of the last parameters that occurs in several points is looked at once.
        """
        positions = self.copula.positions
        mean, covariance = np.ones((1, 1)), np.zeros((1, 1, 1))
        places: NDArray[np.intp] = np.zeros(values.shape[1], dtype=np.intp)
        for j in reversed(range(positions[0], self.count)):
            check_time()
            if j not in positions:
                mean, covariance = self._free(j, mean, covariance)
                continue
            rest = values[positions.index(j) :]
            _, which, now = np.unique(rest, axis=1, return_index=True, return_inverse=True)
            matrices = self.matrices(j, rest[0, which])
            mean = np.einsum("qrs,sq->rq", matrices, mean[:, places[which]])
            covariance = matrices @ covariance[places[which]] @ matrices.swapaxes(1, 2)
            places = now.ravel()
        return mean, covariance, places

    def _free(self, j: int, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Means (r, U) and covariances (U, r, r) with one more parameter that is independent."""
        own = np.tensordot(self.fluctuations[j], mean, (2, 0)).transpose(2, 0, 1)
        whole = self.whole[j]
        left = whole.reshape(-1, whole.shape[2]) @ covariance
        left = left.reshape(len(own), len(whole), -1)
        inner = left @ whole.reshape(len(whole), -1).T
        return self.means[j] @ mean, inner + own @ own.swapaxes(1, 2)

    def matrices(self, j: int, values: Array) -> Array:
        """The matrices of one parameter at values of it, (Q, r_j, r_{j+1})."""
        modes = self.bases[j].modal_values(values)
        return np.asarray(np.einsum("qm,rms->qrs", modes, self.cores[j], optimize=True))

    @property
    def _largest(self) -> int:
        """Numbers for each point."""
        return max(core.size for core in self.whole)


def _blocks(count: int, size: int) -> Iterator[slice]:
    """Parts of so many points, each of a size that fits in memory."""
    step = max(_BLOCK // max(size, 1), 1)
    return (slice(start, start + step) for start in range(0, count, step))
