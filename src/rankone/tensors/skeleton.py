"""Skeletons: columns of a matrix from which all others are interpolated with small coefficients.

They are the pivots of a QR decomposition of a few random combinations of the rows, whose remainder
is the error of the interpolation (Voronin & Martinsson, Efficient algorithms for CUR and
interpolative matrix decompositions, Advances in Computational Mathematics 43 (2017), 495).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dgeqp3, dtrtrs

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import product, qr
from rankone.tensors.train import Integers

# Combinations of rows over the expected rank, and how many more: pivots fit them, too
_ROWS_RATIO, _MORE_ROWS = 1.25, 8
_LEAST_SPARE_ROWS = 6  # Fewest of them beyond the rank that tell the remainder
_DIRECT_RATIO = 1.5  # Rows over combinations up to which the rows themselves are taken
_QR_BLOCK = 32  # Columns that a QR decomposition takes together
_RANDOM_COST = 1.0  # Operations of a random sign
_MAX_EXCHANGES = 100  # Most exchanges of columns; Goreinov et al. need a few per rank
_VOLUME_GAIN = 1.1  # Factor on the volume of a skeleton that is worth an exchange
_EXCHANGE_COST = 3.0  # Operations of an exchange for each coefficient


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
        found = _pivoted(sketch, tolerance, max_rank, combined=not direct)
        if found is not None:
            return _of_larger_volume(found)
        count *= 2


def _combined(matrices: Sequence[Array], count: int) -> Array:
    """So many random combinations of the rows of all matrices, of about the same norm."""
    generator, combined = np.random.default_rng(count), np.zeros((count, matrices[0].shape[1]))
    for matrix in matrices:
        m, n = matrix.shape
        charge(product(count, m, n) + _RANDOM_COST * count * m)
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
        remainder = remainder[: m - _LEAST_SPARE_ROWS]
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
    for _ in range(_MAX_EXCHANGES):
        i, j = np.unravel_index(np.argmax(np.abs(coefficients)), coefficients.shape)
        if abs(coefficients[i, j]) < _VOLUME_GAIN:
            break
        charge(_EXCHANGE_COST * coefficients.size)
        change = coefficients[:, j].copy()
        change[i] -= 1.0
        coefficients -= np.outer(change / coefficients[i, j], coefficients[i])
        columns[i] = j
    return Skeleton(columns, coefficients)
