"""Moments of one train, and variance-based sensitivities.

A state is ``a(t) c_1(p_1) ... c_d(p_d)`` with a row a(t) and matrices c_j. With independent
parameters the mean of the product is the product of the means, and every part of the variance is
``a(t) P a(t)^T`` with a matrix P that is the same for all times and states. Parts are sums of
squares of fluctuations ``c_j - E c_j``, so that nothing cancels (ANOVA decomposition: Sobol,
"Global sensitivity indices for nonlinear mathematical models", 2001; in tensor trains:
Ballester-Ripoll, Paredes & Pajarola, "Sobol tensor trains for global sensitivity analysis", 2019).

Given the parameters that are correlated, the others are independent: means are products again.
The correlated ones take a quadrature, refined until mean and covariance settle. The variance is the
variance of the mean given them plus the mean of the variance given them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import AT_ONCE, MINOR, NEGLIGIBLE, SAME, Array
from rankone.support.budget import check_time
from rankone.support.errors import warn
from rankone.tensors.joint_distribution import Copula, JointDistribution
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train

_WARNED_CHANGE = 1e-4  # Relative change above which a user is warned: it shows in four digits


class TrainMoments:
    """What statistics need of the cores of all parameters, for one slab."""

    def __init__(self, slab: SlabTrain, parameters: JointDistribution) -> None:
        self.cores, self.bases, self.parameters = slab.cores[1:], slab.bases, parameters
        self.count = len(self.cores)
        self.means: list[Array] = []
        self.whole: list[Array] = []
        self.fluctuations: list[Array] = []
        for core, basis, measure in zip(self.cores, self.bases, parameters.measures, strict=True):
            mean, root = measure.integrals(basis)
            one = basis.to_modal @ np.sqrt(basis.weights)  # modes of the constant function one
            average = np.tensordot(core, mean, (1, 0))
            self.means.append(average)
            self.whole.append(np.einsum("rms,mk->rks", core, root, optimize=True))
            centred = core - average[:, None, :] * one[:, None]
            self.fluctuations.append(np.einsum("rms,mk->rks", centred, root, optimize=True))

    @cached_property
    def after(self) -> list[Array]:
        """Mean of the product of the matrices from each on: vectors (r_j,), the last is one."""
        vectors = [np.ones(1)]
        for mean in reversed(self.means):
            vectors.append(mean @ vectors[-1])
        return vectors[::-1]

    @cached_property
    def _squares(self) -> list[Array]:
        """Mean of the product from each on, times itself: (r_j, r_j)."""
        squares = [np.ones((1, 1))]
        for core in reversed(self.whole):
            squares.append(_sandwich(core, squares[-1]))
        return squares[::-1]

    @cached_property
    def mean(self) -> Array:
        """The vector m with the mean ``a(t) m``."""
        return self.after[0]

    @cached_property
    def covariance(self) -> Array:
        """The matrix of the variance, (1, r_1, r_1)."""
        covariance = np.zeros((1, 1))
        for j in reversed(range(self.count)):
            local = self._fluctuations_of_mean[j]
            covariance = _sandwich(self.whole[j], covariance) + local @ local.T
        return covariance[None]

    @cached_property
    def first(self) -> Array:
        """For each parameter the matrix of the variance of the mean given it, (d, r_1, r_1)."""
        roots = [self._before(j) @ local for j, local in enumerate(self._fluctuations_of_mean)]
        return self._stacked([root @ root.T for root in roots])

    @cached_property
    def total(self) -> Array:
        """For each parameter the matrix of the mean, over the others, of the variance over it."""
        matrices = []
        for j in range(self.count):
            matrix = _sandwich(self.fluctuations[j], self._squares[j + 1])
            for core in reversed(self.whole[:j]):
                matrix = _sandwich(core, matrix)
            matrices.append(matrix)
        return self._stacked(matrices)

    @cached_property
    def second(self) -> Array:
        """For pairs i < j the matrix of the variance of their interaction, by i, then by j."""
        matrices = []
        for i, fluctuation in enumerate(self.fluctuations[:-1]):
            between, before = np.eye(fluctuation.shape[2]), self._before(i)
            later = zip(self._fluctuations_of_mean[i + 1 :], self.means[i + 1 :], strict=True)
            for local, mean in later:
                both = np.tensordot(fluctuation, between @ local, (2, 0))
                both = before @ both.reshape(len(both), -1)
                matrices.append(both @ both.T)
                between = between @ mean
        return self._stacked(matrices)

    def main_effect(self, j: int, points: Array) -> Array:
        """The vectors m with the mean ``a(t) m`` given one parameter, (r_1, points)."""
        core = self._before(j) @ (self.cores[j] @ self.after[j + 1]).swapaxes(0, 1)[..., None]
        return np.asarray(core[..., 0].T @ self.bases[j].modal_values(points).T)

    def _stacked(self, matrices: Sequence[Array]) -> Array:
        """Matrices (k, r_1, r_1); there may be none."""
        rank = len(self.after[0])
        return np.stack(matrices) if matrices else np.zeros((0, rank, rank))

    @cached_property
    def _fluctuations_of_mean(self) -> list[Array]:
        """Fluctuations times the mean of what comes after them: (r_j, modes)."""
        return [f @ v for f, v in zip(self.fluctuations, self.after[1:], strict=True)]

    def _before(self, j: int) -> Array:
        """Mean of the product of the matrices before: (r_1, r_j)."""
        product = np.eye(len(self.after[0]))
        for mean in self.means[:j]:
            product = product @ mean
        return product


class ConditionalMoments(TrainMoments):
    """Mean, covariance and main effects where some parameters are correlated."""

    @property
    def copula(self) -> Copula:
        """The copula of the correlated parameters."""
        assert self.parameters.copula is not None
        return self.parameters.copula

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
        coarser, change = None, 0.0
        for shares, weights in self.copula.rules():
            self._rule = self._points(shares), weights
            mean, covariance = self._over(*self._rule)
            if coarser is not None:
                size = np.linalg.norm(covariance)
                change = max(
                    float(np.linalg.norm(mean - coarser[0]) / np.sqrt(size or 1.0)),
                    float(np.linalg.norm(covariance - coarser[1]) / (size or 1.0)),
                )
                if change <= SAME:
                    break
            coarser = mean, covariance
        if change > _WARNED_CHANGE:
            warn(
                f"the quadrature over correlated parameters has settled to {change:.1e} only, "
                "relative to the standard deviation"
            )
        return mean, covariance

    def main_effect(self, j: int, points: Array) -> Array:
        """The vectors m with the mean ``a(t) m`` given one parameter, (r_1, points)."""
        if j in self.copula.positions:
            return np.stack([self._mean_given(j, point) for point in points], axis=1)
        self._both  # noqa: B018 - finds the rule
        nodes, weights = self._rule
        before, _, after = self.cores[j].shape
        rank = self.cores[0].shape[0]
        around = np.zeros((rank, before, after))
        for block in _blocks(weights.size, max(self._largest, rank * before)):
            fixed = dict(zip(self.copula.positions, nodes[:, block], strict=True))
            left = np.eye(rank)[None]
            for i in range(j):
                left = left @ (self.matrices(i, fixed[i]) if i in fixed else self.means[i])
            right = self._means_of_product(fixed, weights[block].size, j + 1)
            left = np.broadcast_to(left, (weights[block].size, rank, before))
            around += np.einsum("qab,q,cq->abc", left, weights[block], right, optimize=True)
        at = np.einsum("pm,rms->prs", self.bases[j].modal_values(points), self.cores[j])
        return np.asarray(np.einsum("abc,pbc->ap", around, at))

    def _mean_given(self, j: int, point: float) -> Array:
        """The mean given one value of a correlated parameter, (r_1,)."""
        place = self.copula.positions.index(j)
        coarser = None
        for shares, weights in self.copula.given(place, self.parameters.measures[j].normal(point)):
            nodes = self._points(shares)
            nodes[place] = point
            fixed = dict(zip(self.copula.positions, nodes, strict=True))
            mean = self._means_of_product(fixed, weights.size, 0) @ weights
            if coarser is not None:
                change = np.linalg.norm(mean - coarser)
                if change <= SAME * np.linalg.norm(mean):
                    break
            coarser = mean
        return np.asarray(mean)

    def _means_of_product(self, fixed: dict[int, Array], count: int, first: int) -> Array:
        """Means of the product from one parameter on, the correlated ones fixed, (r, Q)."""
        check_time()
        mean = np.ones((1, count))
        for j in reversed(range(first, self.count)):
            if j in fixed:
                mean = np.einsum("qrs,sq->rq", self.matrices(j, fixed[j]), mean)
            else:
                mean = self.means[j] @ mean
        return mean

    def _points(self, shares: Array) -> Array:
        """Values of the correlated parameters at shares of their probabilities, (k, Q)."""
        pairs = zip(self.copula.positions, shares, strict=True)
        return np.array([self.parameters.measures[j].sample(row) for j, row in pairs])

    def _over(self, nodes: Array, weights: Array) -> tuple[Array, Array]:
        """Mean and covariance of the product of all matrices by one rule."""
        tails, inner = [], np.zeros((1, 1))
        for block in _blocks(weights.size, self._largest):
            tail, within, places = self._given(nodes[:, block])
            tails.append(tail[:, places])
            shares = np.bincount(places, weights[block])
            inner = inner + np.tensordot(shares, within, 1)
        tail = np.hstack(tails)
        mean = tail @ weights
        spread = (tail - mean[:, None]) * np.sqrt(weights)
        covariance = spread @ spread.T + inner
        for j in reversed(range(self.copula.positions[0])):
            mean, covariance = self._free(j, mean[:, None], covariance[None])
            mean, covariance = mean[:, 0], covariance[0]
        return mean, covariance

    def _given(self, nodes: Array) -> tuple[Array, Array, NDArray[np.intp]]:
        """Means (r, U) and covariances (U, r, r) of the product from the first correlated parameter
        on, for the correlated ones fixed at nodes (k, Q), and which of the U is of each node (Q,).

        Nodes that share the values of the last parameters share their products.
        """
        positions = self.copula.positions
        mean, covariance = np.ones((1, 1)), np.zeros((1, 1, 1))
        places: NDArray[np.intp] = np.zeros(nodes.shape[1], dtype=np.intp)
        for j in reversed(range(positions[0], self.count)):
            check_time()
            if j not in positions:
                mean, covariance = self._free(j, mean, covariance)
                continue
            tails = nodes[positions.index(j) :]
            _, firsts, owners = np.unique(tails, axis=1, return_index=True, return_inverse=True)
            matrices = self.matrices(j, tails[0, firsts])
            mean = np.einsum("qrs,sq->rq", matrices, mean[:, places[firsts]])
            covariance = matrices @ covariance[places[firsts]] @ matrices.swapaxes(1, 2)
            places = owners.ravel()
        return mean, covariance, places

    def _free(self, j: int, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Means (r, U) and covariances (U, r, r) with one more parameter that is independent."""
        local = np.tensordot(self.fluctuations[j], mean, (2, 0)).transpose(2, 0, 1)
        whole = self.whole[j]
        left = whole.reshape(-1, whole.shape[2]) @ covariance
        left = left.reshape(len(local), len(whole), -1)
        inner = left @ whole.reshape(len(whole), -1).T
        return self.means[j] @ mean, inner + local @ local.swapaxes(1, 2)

    def matrices(self, j: int, points: Array) -> Array:
        """The matrices of one parameter at values of it, (Q, r_j, r_{j+1})."""
        modes = self.bases[j].modal_values(points)
        return np.asarray(np.einsum("qm,rms->qrs", modes, self.cores[j], optimize=True))

    @property
    def _largest(self) -> int:
        """Numbers for each point."""
        return max(core.size for core in self.whole)


def _blocks(count: int, size: int) -> Iterator[slice]:
    """Slices of points whose numbers, ``size`` for each point, fit in memory together."""
    step = max(AT_ONCE // max(size, 1), 1)
    return (slice(start, start + step) for start in range(0, count, step))


def _sandwich(core: Array, inner: Array) -> Array:
    """Sum over modes of ``c_m inner c_m^T``."""
    left = np.tensordot(core, inner, (2, 0))
    return np.asarray(np.tensordot(left, core, ((1, 2), (1, 2))))


# -----------------------------------------------------------------------------
# Third and fourth moments of a train: inner products of its square.
#
# A state minus its mean is a train y of its own. Its matrices are written so that nothing is
# subtracted at the end, and it is truncated in the mean square under the measures. With the square
# v = y^2, of rank r (r + 1)/2, the moments are E[y^3] = <v, y> and E[y^4] = <v, v>.


# Tolerance above which a user is warned, unless it was asked for: it shows in five digits
_WARNED_TOLERANCE = 1e-5
# Largest rank of a train that is squared. The square has the rank 528, and each point of a
# quadrature takes 4 times its cube.
_LARGEST_RANK = 32
# Largest rank of a train that serves several times; above it each time has a train alone
_LARGEST_COMMON_RANK = 20


class HigherMoments:
    """Third and fourth moments of one slab for independent parameters, ``central`` or not.

    ``tolerance`` of the truncation is relative to the root mean square of y, and larger where ranks
    are high.
    """

    def __init__(
        self, slab: SlabTrain, parameters: JointDistribution, central: bool, tolerance: float
    ) -> None:
        self.central, self.tolerance = central, max(tolerance, NEGLIGIBLE)
        self.weights: list[Array] = []
        nodal = []
        triples = zip(slab.cores[1:], slab.bases, parameters.measures, strict=True)
        for core, basis, measure in triples:
            points, weights = measure.rule(basis, 4)
            self.weights.append(weights)
            nodal.append(np.einsum("rms,pm->rps", core, basis.modal_values(points)))
        means = [np.tensordot(c, w, (1, 0)) for c, w in zip(nodal, self.weights, strict=True)]
        self.mean = np.ones(1)
        after = [self.mean]
        for mean in reversed(means):
            self.mean = mean @ self.mean
            after.append(self.mean)
        if central:
            nodal = _centred(nodal, means, after[-2::-1])
        weighted = zip(nodal, self.weights, strict=True)
        scaled = [core * np.sqrt(weight)[:, None] for core, weight in weighted]
        if scaled:
            train = Train((np.eye(len(scaled[0])), *scaled))
            self.root, *self.cores = train.right_orthonormal().cores
        else:
            self.root, self.cores = np.array([[0.0], [0.0]] if central else [[1.0]]), []

    def __call__(self, rows: Array) -> Array:
        """Root mean squares of y for rows (T, r_1) of the first core, and E[y^3], E[y^4] of y over
        them: (3, T). Where y is zero they are not defined (NaN)."""
        rows = self._rotated(rows)
        norms = np.linalg.norm(rows, axis=1)
        moments = np.full((3, len(rows)), np.nan)
        moments[0] = norms
        some = norms > 0.0
        if some.any():
            moments[1:, some] = self._normed(rows[some] / norms[some, None])
        return moments

    def sizes(self, first: Array) -> Array:
        """Root mean squares of the states over the box and a slab, y or not, (n,).

        ``first`` is the core (n, K, r_1) of the slab.
        """
        spreads, means = np.linalg.norm(self._rotated(first), axis=(1, 2)), first @ self.mean
        return np.asarray(np.hypot(spreads, np.linalg.norm(means, axis=1)))

    def _rotated(self, rows: Array) -> Array:
        """Rows (..., r_1) for the cores that are orthonormal."""
        if self.central:
            rows = np.concatenate([rows, np.zeros((*rows.shape[:-1], 1))], axis=-1)
        return np.asarray(rows @ self.root)

    def _normed(self, rows: Array) -> Array:
        """Third and fourth moments for rows of norm one, (2, T), computed together while their
        common ranks allow it."""
        check_time()
        if not self.cores:
            return np.stack([rows[:, 0] ** 3, rows[:, 0] ** 4])
        tolerance = self.tolerance
        train, _ = Train((rows, *self.cores)).truncated(tolerance)
        if len(rows) > 1 and max(train.ranks) > _LARGEST_COMMON_RANK:
            half = len(rows) // 2
            return np.hstack([self._normed(rows[:half]), self._normed(rows[half:])])
        while max(train.ranks) > _LARGEST_RANK and tolerance < MINOR:  # one digit is left
            tolerance *= 3.0
            train, _ = Train((rows, *self.cores)).truncated(tolerance)
        if tolerance > max(_WARNED_TOLERANCE, self.tolerance):
            warn(
                f"the train minus its mean is truncated to {tolerance:.0e} of its standard "
                "deviation, since its ranks are high; third and fourth moments are good to a few "
                "times that",
                remedy="fix some parameters first, or take moments of samples",
            )
        first, *cores = train.cores
        third, fourth = self._contracted(cores)
        i, j = np.triu_indices(first.shape[1])  # each pair of entries once, with its number
        pairs = first[:, i] * first[:, j] * np.where(i == j, 1.0, 2.0)
        return np.stack(
            [
                np.einsum("tr,rs,ts->t", pairs, third, first, optimize=True),
                np.einsum("tr,rs,ts->t", pairs, fourth, pairs, optimize=True),
            ]
        )

    def _contracted(self, cores: Sequence[Array]) -> tuple[Array, Array]:
        """Means of square times train, and of square times square, from the first parameter on."""
        third = fourth = np.ones((1, 1))
        for core, weights in zip(reversed(cores), reversed(self.weights), strict=True):
            nodal = core / np.sqrt(weights)[:, None]
            cubes, fourth_powers = np.zeros((2, 1, 1))
            for matrix, square, weight in zip(*_squares(nodal), weights, strict=True):
                cubes = cubes + weight * (square @ third @ matrix.T)
                fourth_powers = fourth_powers + weight * (square @ fourth @ square.T)
            third, fourth = cubes, fourth_powers
        return third, fourth


def _centred(cores: Sequence[Array], means: Sequence[Array], after: Sequence[Array]) -> list[Array]:
    """The train minus its mean, ``sum_j C_1 ... C_{j-1} (C_j - E C_j) E[C_{j+1} ... C_d]``.

    Its matrices are [C_j, (C_j - E C_j) E[C_{j+1} ...]; 0, 1], the last one its last column.
    """
    blocks = []
    for core, mean, mean_after in zip(cores, means, after, strict=True):
        left, count, right = core.shape
        block = np.zeros((left + 1, count, right + 1))
        block[:left, :, :right] = core
        block[:left, :, right] = (core - mean[:, None, :]) @ mean_after
        block[left, :, right] = 1.0
        blocks.append(block)
    return [*blocks[:-1], *(block[:, :, -1:] for block in blocks[-1:])]


def _squares(core: Array) -> tuple[Iterator[Array], Iterator[Array]]:
    """Matrices of a core (r, points, s) at each point, and those on products of pairs i <= j."""
    i, j = np.triu_indices(core.shape[0])
    k, m = np.triu_indices(core.shape[2])

    def squared() -> Iterator[Array]:
        for matrix in np.moveaxis(core, 1, 0):
            a, b = matrix[i], matrix[j]
            yield np.where(k == m, 0.5, 1.0) * (a[:, k] * b[:, m] + a[:, m] * b[:, k])

    return iter(np.moveaxis(core, 1, 0)), squared()
