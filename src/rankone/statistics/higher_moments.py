"""Third and fourth moments of a train: inner products of its square.

A state minus its mean is a train y of its own. Its matrices are written so that nothing is
subtracted at the end, and it is truncated in the mean square under the measures. With the square
v = y^2, of rank r (r + 1)/2, the moments are E[y^3] = <v, y> and E[y^4] = <v, v>.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rankone.statistics.joint_distribution import JointDistribution
from rankone.support.arrays import Array
from rankone.support.budget import check_time
from rankone.support.errors import warn
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train

# Least tolerance of the truncation, relative to the root mean square of y: above rounding
_LEAST_TOLERANCE = 1e-9
_LARGEST_TOLERANCE = 0.1  # Largest tolerance of the truncation: one digit of the moments is left
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
        self.central, self.tolerance = central, max(tolerance, _LEAST_TOLERANCE)
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
        while max(train.ranks) > _LARGEST_RANK and tolerance < _LARGEST_TOLERANCE:
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
