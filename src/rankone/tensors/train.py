"""Tensor trains, their truncated decompositions, and skeletons of matrices.

They are the pivots of a QR decomposition of a few random combinations of the rows, whose remainder
is the error of the interpolation (Voronin & Martinsson, Efficient algorithms for CUR and
interpolative matrix decompositions, Advances in Computational Mathematics 43 (2017), 495).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.linalg.lapack import dgeqp3, dtrtrs

from rankone.support.arrays import ACCUMULATED, MOST_ROUNDS, Array
from rankone.support.budget import charge
from rankone.support.costs import COPY, product, qr, svd

# Combinations of rows over the expected rank, and how many more: pivots fit them, too
_ROWS_RATIO, _MORE_ROWS = 1.25, 8
_DIRECT_RATIO = 1.5  # Rows over combinations up to which the rows themselves are taken
_QR_BLOCK = 32  # Columns that a QR decomposition takes together
_VOLUME_GAIN = 1.1  # Factor on the volume of a skeleton that is worth an exchange


@dataclass(frozen=True)
class Skeleton:
    """``columns`` (r,) of a matrix (m, N), and the ``coefficients`` (r, N) that give all others."""

    columns: Integers
    coefficients: Array

    @property
    def rank(self) -> int:
        return len(self.columns)

    def missed(self, matrix: Array) -> float:
        """The norm of what the skeleton misses of a matrix (m, N)."""
        charge(2.0 * product(len(matrix), self.rank, matrix.shape[1]))
        return float(np.linalg.norm(matrix[:, self.columns] @ self.coefficients - matrix))

    def rows_of(self, matrices: Sequence[Array]) -> Array:
        """Rows (r, N) that stand for all those of matrices (m, N): their products are the same."""
        chosen = np.concatenate([matrix[:, self.columns] for matrix in matrices])
        charge(qr(*chosen.shape) + product(self.rank, self.rank, self.coefficients.shape[1]))
        return np.asarray(np.linalg.qr(chosen, mode="r") @ self.coefficients)


def skeleton_of(
    matrices: Sequence[Array], tolerance: float, max_rank: int, expected: int
) -> Skeleton:
    """The skeleton of matrices (m, N) below each other, which misses a tolerance of them.

    A Frobenius norm. ``expected`` is about the rank; at most ``max_rank`` columns are taken.
    """
    rows = sum(map(len, matrices))
    count = math.ceil(_ROWS_RATIO * expected) + _MORE_ROWS
    while True:
        direct = rows <= _DIRECT_RATIO * count
        sketch = np.concatenate(matrices) if direct else _combined(matrices, count)
        skeleton = _pivoted(sketch, tolerance, max_rank, combined=not direct)
        if skeleton is not None:
            return _of_larger_volume(skeleton)
        count *= 2


def _combined(matrices: Sequence[Array], count: int) -> Array:
    """So many random combinations of the rows of all matrices, of about the same norm."""
    generator, combined = np.random.default_rng(count), np.zeros((count, matrices[0].shape[1]))
    for matrix in matrices:
        m, n = matrix.shape
        charge(product(count, m, n) + count * m)
        bits = np.frombuffer(generator.bytes(-(-count * m // 8)), dtype=np.uint8)
        signs = 2.0 * np.unpackbits(bits, count=count * m).reshape(count, m) - 1.0
        combined += signs @ matrix
    return np.asarray(combined / math.sqrt(count))


def _pivoted(rows: Array, tolerance: float, max_rank: int, combined: bool) -> Skeleton | None:
    """The pivots whose remainder is below a tolerance; None if ``combined`` rows are too few.

    Pivots fit combinations better than the rows that these are made of: r of them leave too little
    of m combinations by (m - r) / m, as in generalised cross-validation (Golub, Heath & Wahba,
    1979).
    """
    m, n = rows.shape
    charge(qr(m, n))
    packed, pivots, *_ = dgeqp3(rows, lwork=_QR_BLOCK * (n + 1) + 2 * n)
    factor, pivots = np.triu(packed[: min(m, n)]), pivots - 1
    squares = np.square(factor).sum(axis=1)
    remainder = np.sqrt(np.append(np.cumsum(squares[::-1])[::-1], 0.0))
    if combined:
        remainder = remainder[: m - _RANDOM_DIRECTIONS // 2]
        remainder *= m / (m - np.arange(remainder.size))
    enough = remainder <= tolerance
    rank = int(np.argmax(enough)) if enough.any() else remainder.size
    most = min(max_rank, n, m)
    if not enough.any() and remainder.size < most:
        return None
    rank = max(min(rank, most, int(np.count_nonzero(np.diag(factor)))), 1)
    charge(product(rank, rank, n))
    columns = pivots[:rank].astype(np.int64)
    coefficients = np.zeros((rank, n))
    coefficients[:, columns] = np.eye(rank)
    if factor[0, 0]:
        coefficients[:, pivots[rank:]], _ = dtrtrs(factor[:rank, :rank], factor[:rank, rank:])
    return Skeleton(columns, coefficients)


def _of_larger_volume(skeleton: Skeleton) -> Skeleton:
    """Columns exchanged as long as that enlarges the volume of the skeleton by a tenth.

    Goreinov et al., How to find a good submatrix, 2010.
    """
    columns, coefficients = skeleton.columns.copy(), skeleton.coefficients.copy()
    for _ in range(MOST_ROUNDS):
        i, j = np.unravel_index(np.argmax(np.abs(coefficients)), coefficients.shape)
        if abs(coefficients[i, j]) < _VOLUME_GAIN:
            break
        charge(COPY * coefficients.size)
        change = coefficients[:, j].copy()
        change[i] -= 1.0
        coefficients -= np.outer(change / coefficients[i, j], coefficients[i])
        columns[i] = j
    return Skeleton(columns, coefficients)


# -----------------------------------------------------------------------------
# Tensor trains, and the truncated decompositions of matrices that they are made with.
#
# U[..., i_1, ..., i_d] = C_0[..., :] C_1[:, i_1, :] ... C_d[:, i_d, :]


Integers = NDArray[np.int64]

# Random directions added to the expected row space, as Halko et al. advise (5 to 10, or more).
_RANDOM_DIRECTIONS = 12
# The same for directions that only widen a frame: they need not be kept to the last digit
_NEGLIGIBLE_PROBE = 1e-6


@dataclass(frozen=True, eq=False)
class Train:
    """Cores of shape (..., r_1), of any dimension, and (r_j, n_j, r_{j+1}); the last rank is 1."""

    cores: tuple[Array, ...]

    @property
    def first(self) -> Array:
        return self.cores[0]

    @property
    def ranks(self) -> tuple[int, ...]:
        """The ranks r_1, ..., r_d between the cores."""
        return tuple(core.shape[0] for core in self.cores[1:])

    def with_first(self, first: Array) -> Train:
        """The same train with another core 0."""
        return Train((first, *self.cores[1:]))

    def apply_to_modes(self, matrices: Sequence[Array]) -> Train:
        """Apply one matrix to the middle index of each core j >= 1; core 0 is kept."""
        pairs = zip(matrices, self.cores[1:], strict=True)
        return Train((self.cores[0], *(np.matmul(matrix, core) for matrix, core in pairs)))

    def unscaled(self, weights: Sequence[Array]) -> Train:
        """Values at nodes from values scaled by the roots of the weights of each parameter."""
        pairs = zip(self.cores[1:], weights, strict=True)
        return Train((self.first, *(core / np.sqrt(weight)[:, None] for core, weight in pairs)))

    def at_indices(self, indices: Integers) -> Array:
        """Product of the cores j >= 1 at indices (m, d) of their modes: (r_1, m)."""
        columns = np.ones((1, len(indices)))
        for core, index in zip(self.cores[:0:-1], indices.T[::-1], strict=True):
            columns = np.einsum("rms,sm->rm", core[:, index], columns)
        return columns

    def mode_norms(self) -> list[Array]:
        """Norms of the modes of each core j >= 1; right-orthonormal trains with core 0 (n, r_1)."""
        weight = np.asarray(np.linalg.qr(self.cores[0], mode="r"))
        norms = []
        for core in self.cores[1:]:
            weighted = np.tensordot(weight, core, 1)
            norms.append(np.sqrt(np.sum(weighted**2, axis=(0, 2))))
            weight = np.asarray(np.linalg.qr(weighted.reshape(-1, core.shape[2]), mode="r"))
        return norms

    def right_orthonormal(self, negligible: float = ACCUMULATED) -> Train:
        """Cores 1, ..., d of orthonormal rows; core 0 takes the factors.

        Rows that add no direction above ``negligible``, relative to the largest, are left out.
        """
        cores = list(self.cores)
        for j in range(len(cores) - 1, 0, -1):
            q, r = independent(cores[j].reshape(len(cores[j]), -1).T, negligible)
            cores[j] = np.ascontiguousarray(q.T).reshape(-1, *cores[j].shape[1:])
            cores[j - 1] = cores[j - 1] @ r.T
        return Train(tuple(cores))

    def truncated(self, tolerance: float) -> tuple[Train, float]:
        """Truncate a right-orthonormal train within a tolerance; also the norm of the change.

        All cores but the last are left-orthonormal afterwards.
        """
        cores = list(self.cores)
        share = tolerance / math.sqrt(max(len(cores) - 1, 1))
        change = 0.0
        for j in range(len(cores) - 1):
            shape = cores[j].shape
            charge(svd(cores[j].size / shape[-1], shape[-1]))
            unfolded = cores[j].reshape(-1, shape[-1])
            u, s, vt = scipy.linalg.svd(unfolded, full_matrices=False, check_finite=False)
            tails = np.sqrt(np.cumsum(s[::-1] ** 2))[::-1]
            rank = max(int(np.count_nonzero(tails > share)), 1)
            change = math.hypot(change, *tails[rank : rank + 1])
            cores[j] = u[:, :rank].reshape(*shape[:-1], rank)
            cores[j + 1] = np.tensordot(s[:rank, None] * vt[:rank], cores[j + 1], 1)
        return Train(tuple(cores)), change

    def rounded(self, tolerance: float) -> Train:
        """The train with the ranks that a tolerance needs, right-orthonormal."""
        return self.right_orthonormal().truncated(tolerance)[0].right_orthonormal()

    def rounded_with_norms(self, tolerance: float) -> tuple[Train, list[Array]]:
        """The same in one sweep less, and the norms of the modes of each core j >= 1.

        What is tiny in core 0 is not left out, but mixed with the rest. Each core is seen in the
        norm of those before it, which takes the factors R of their QR decompositions alone.
        """
        cores, weighted = list(self.cores), list[Array]()
        for core in self.cores[1:]:
            rows = weighted[-1] if weighted else self.first
            factor = np.asarray(np.linalg.qr(rows.reshape(-1, len(core)), mode="r"))
            charge(
                0.5 * qr(rows.size / len(core), len(core))
                + product(len(factor), len(core), core[0].size)
            )
            weighted.append(np.tensordot(factor, core, 1))
        norms, share = list[Array](), tolerance / math.sqrt(max(len(cores) - 1, 1))
        turn = np.eye(1)
        for j in range(len(cores) - 1, 0, -1):
            core, weighed = np.tensordot(cores[j], turn, 1), np.tensordot(weighted[j - 1], turn, 1)
            norms.insert(0, np.linalg.norm(weighed, axis=(0, 2)))
            _, weights, right = _svd(weighed.reshape(len(weighed), -1))
            tails = np.sqrt(np.cumsum(weights[::-1] ** 2))[::-1]
            right = right[: max(int(np.count_nonzero(tails > share)), 1)]
            turn = core.reshape(len(core), -1) @ right.T
            cores[j] = right.reshape(len(right), *core.shape[1:])
        cores[0] = cores[0] @ turn
        return Train(tuple(cores)), norms

    def thinned(self, tolerance: float) -> Train:
        """The train with zeros for all entries that do not matter.

        Both sides of a core are made orthonormal and turned to their singular vectors. An entry,
        times the singular value on its left, is then its share in the norm of the train, and the
        shares fall along both ranks and, for smooth functions, with the degree: the remaining
        entries are few and stand together. No rank grows. The tolerance limits the norm of the
        change: a root mean square, not a largest value.
        """
        cores = list(self.right_orthonormal().cores)
        weights = np.ones(len(cores[0]))
        for j, core in enumerate(cores):
            shares = weights[:, None, None] * core
            if j + 1 < len(cores):
                rows = shares.reshape(-1, core.shape[2])
                _, weights, turn = np.linalg.svd(rows, full_matrices=False)
                core, shares = core @ turn.T, shares @ turn.T
                cores[j + 1] = np.tensordot(turn, cores[j + 1], 1)
            squares = np.sort(shares**2, axis=None)
            dropped = np.count_nonzero(np.cumsum(squares[:-1]) <= (tolerance / len(cores)) ** 2)
            cores[j] = np.where(shares**2 < squares[dropped], 0.0, core)
        return Train(tuple(cores))

    def widened(self, probes: Sequence[Array]) -> Train:
        """The same train in a frame that also holds the span of a second train.

        ``probes`` are cores 1, ..., d of the second train, (k, n_j, k), the last (k, n_d, 1). From
        each core on its rows have norms below one, so that they come after the rows of this train.
        Ranks grow up to r_j + k; cores j >= 1 have orthonormal rows.
        """
        first, count = self.cores[0], probes[0].shape[0]
        cores = [np.concatenate([first, np.zeros((*first.shape[:-1], count))], axis=-1)]
        cores += map(block_diagonal, self.cores[1:-1], probes[:-1])
        cores.append(np.concatenate([self.cores[-1], probes[-1]]))
        return Train(tuple(cores)).right_orthonormal(_NEGLIGIBLE_PROBE)


def block_diagonal(a: Array, b: Array) -> Array:
    """The core (r, n, s) whose matrices hold the matrices of two cores on their diagonals."""
    block = np.zeros((len(a) + len(b), a.shape[1], a.shape[2] + b.shape[2]))
    block[: len(a), :, : a.shape[2]] = a
    block[len(a) :, :, a.shape[2] :] = b
    return block


def independent(columns: Array, negligible: float) -> tuple[Array, Array]:
    """Orthonormal basis q of columns (m, n), and r: the columns are q r up to ``negligible``.

    A column that adds no direction larger than ``negligible``, relative to the largest, gives
    none: it would be one of rounding, and no two machines round alike. With ``negligible`` zero
    all are kept.
    """
    charge(qr(*columns.shape))
    if not negligible:
        return np.linalg.qr(columns)
    q, r, order = scipy.linalg.qr(columns, mode="economic", pivoting=True, check_finite=False)
    sizes = np.abs(np.diag(r))
    rank = max(int(np.count_nonzero(sizes > negligible * sizes[0])), 1)
    return np.ascontiguousarray(q[:, :rank]), r[:rank, np.argsort(order)]


def truncated_svd(
    matrix: Array, tolerance: float, max_rank: int, rows: Array | None = None
) -> tuple[Array, Array, Array]:
    """Left vectors (m, r), singular values (r,) and right vectors (r, n) of a matrix.

    As many as the tolerance needs, a Frobenius norm, but at least one and at most ``max_rank``.
    A large matrix of small numerical rank is first projected on a range found from ``rows``, which
    are expected to span most of the row space, and a few random directions (Halko, Martinsson &
    Tropp, SIAM Review 53 (2011), algorithm 4.2); the projection is accepted only if its error is
    measured to be below half the tolerance.
    """
    missed = 0.0
    basis = None
    if rows is not None and min(matrix.shape) > max(
        4 * _RANDOM_DIRECTIONS, 2 * (len(rows) + _RANDOM_DIRECTIONS)
    ):
        basis, reduced, missed = _range(matrix, rows, 0.5 * tolerance)
    left, weights, right = _svd(matrix if basis is None else reduced)
    tails = np.sqrt(np.cumsum(weights[::-1] ** 2)[::-1] + missed**2)
    rank = min(max(int(np.count_nonzero(tails > tolerance)), 1), max_rank, weights.size)
    left = left[:, :rank] if basis is None else basis @ left[:, :rank]
    return left, weights[:rank], right[:rank]


def _range(matrix: Array, rows: Array, tolerance: float) -> tuple[Array | None, Array, float]:
    """Orthonormal basis of a small numerical range or None, the projected matrix and its error."""
    generator = np.random.default_rng(matrix.shape[1])
    basis = np.zeros((len(matrix), 0))
    directions = generator.standard_normal((matrix.shape[1], _RANDOM_DIRECTIONS))
    sample = matrix @ np.hstack([rows.T, directions])
    while True:
        width = sample.shape[1]
        charge(4.0 * product(len(matrix), matrix.shape[1], width) + 2.0 * qr(len(matrix), width))
        for _ in range(2 if basis.size else 1):  # once more against cancellation
            sample, _ = np.linalg.qr(sample - basis @ (basis.T @ sample))
        basis = np.hstack([basis, sample])
        reduced = basis.T @ matrix
        remainder = matrix - basis @ reduced
        missed = float(np.linalg.norm(remainder))
        if missed <= tolerance:
            return basis, reduced, missed
        grow = max(2 * _RANDOM_DIRECTIONS, basis.shape[1] // 4)
        if 2 * (basis.shape[1] + grow) > min(matrix.shape):
            return None, reduced, 0.0
        sample = remainder @ generator.standard_normal((matrix.shape[1], grow))


def _svd(matrix: Array) -> tuple[Array, Array, Array]:
    """Thin SVD; a QR first where the matrix is far from square."""
    m, n = matrix.shape
    if n > 2 * m:
        charge(qr(n, m))
        q, r = np.linalg.qr(matrix.T)
        left, weights, right = _svd(r.T)
        return left, weights, right @ q.T
    if m > 2 * n:
        charge(qr(m, n))
        q, r = np.linalg.qr(matrix)
        left, weights, right = _svd(r)
        return q @ left, weights, right
    charge(svd(m, n))
    decompose = partial(scipy.linalg.svd, matrix, full_matrices=False, check_finite=False)
    try:
        left, weights, right = decompose(lapack_driver="gesdd")
    except np.linalg.LinAlgError:
        left, weights, right = decompose(lapack_driver="gesvd")
    return left, weights, right
