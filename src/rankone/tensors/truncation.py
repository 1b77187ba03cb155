"""Truncated decompositions of matrices: QR without columns of rounding, and SVD."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import product, qr, svd

__all__ = ["independent", "truncated_svd"]

_DIRECT = 48
"""Smaller sides than this are decomposed directly."""
_EXTRA = 12
"""Random directions added to the expected row space."""


def independent(columns: Array, negligible: float) -> tuple[Array, Array]:
    """Orthonormal basis q of columns (m, n), and r: they are q r but for what is left out.

    A column in which nothing is new beyond ``negligible``, relative to the largest, gives no
    direction: it would be one of rounding, and no two machines round alike. With ``negligible``
    zero all are kept.
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
    """Left vectors, singular values and right vectors; the part dropped has norm <= tolerance.

    A large matrix of small numerical rank is first projected on a range found from ``rows`` and
    a few random directions (Halko, Martinsson & Tropp, SIAM Review 53 (2011), algorithm 4.2); the
    projection is accepted only if what it misses is measured to be below half the tolerance.

    Parameters
    ----------
    matrix : ndarray (m, n)
    tolerance : float
        Largest Frobenius norm of what is dropped.
    max_rank : int
        Largest number of singular values kept, whatever the tolerance.
    rows : ndarray (k, n), optional
        Vectors expected to span most of the row space.

    Returns
    -------
    left (m, r), values (r,), right (r, n)
        Orthonormal columns and rows; at least one singular value is kept.
    """
    missed = 0.0
    basis = None
    smaller = min(matrix.shape)
    if rows is not None and smaller > _DIRECT and 2 * (rows.shape[0] + _EXTRA) < smaller:
        basis, reduced, missed = _range(matrix, rows, 0.5 * tolerance)
    if basis is None:
        left, values, right = _svd(matrix)
    else:
        left, values, right = _svd(reduced)
    tails = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1] + missed**2)
    rank = int(np.count_nonzero(tails > tolerance))
    rank = min(max(rank, 1), max_rank, values.size)
    left = left[:, :rank] if basis is None else basis @ left[:, :rank]
    return left, values[:rank], right[:rank]


def _range(matrix: Array, rows: Array, tolerance: float) -> tuple[Array | None, Array, float]:
    """Orthonormal basis of the numerical range, the projected matrix and what it misses.

    The basis is None when the range is not small.
    """
    generator = np.random.default_rng(matrix.shape[1])
    basis = np.zeros((len(matrix), 0))
    extra = generator.standard_normal((matrix.shape[1], _EXTRA))
    sample = matrix @ np.hstack([rows.T, extra])
    while True:
        width = sample.shape[1]
        charge(4.0 * product(len(matrix), matrix.shape[1], width) + 2.0 * qr(len(matrix), width))
        for _ in range(2 if basis.size else 1):  # once more against cancellation
            sample, _ = np.linalg.qr(sample - basis @ (basis.T @ sample))
        basis = np.hstack([basis, sample])
        reduced = basis.T @ matrix
        rest = matrix - basis @ reduced
        missed = float(np.linalg.norm(rest))
        if missed <= tolerance:
            return basis, reduced, missed
        grow = max(2 * _EXTRA, basis.shape[1] // 4)
        if 2 * (basis.shape[1] + grow) > min(matrix.shape):
            return None, reduced, 0.0
        sample = rest @ generator.standard_normal((matrix.shape[1], grow))


def _svd(matrix: Array) -> tuple[Array, Array, Array]:
    """Thin SVD; a QR first where the matrix is far from square."""
    m, n = matrix.shape
    if n > 2 * m:
        charge(qr(n, m))
        q, r = np.linalg.qr(matrix.T)
        left, values, right = _svd(r.T)
        return left, values, right @ q.T
    if m > 2 * n:
        charge(qr(m, n))
        q, r = np.linalg.qr(matrix)
        left, values, right = _svd(r)
        return q @ left, values, right
    charge(svd(m, n))
    try:
        left, values, right = scipy.linalg.svd(
            matrix, full_matrices=False, check_finite=False, lapack_driver="gesdd"
        )
    except np.linalg.LinAlgError:
        left, values, right = scipy.linalg.svd(
            matrix, full_matrices=False, check_finite=False, lapack_driver="gesvd"
        )
    return left, values, right
