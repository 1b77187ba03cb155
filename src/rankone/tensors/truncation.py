"""Truncated singular value decomposition with an absolute Frobenius tolerance."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

__all__ = ["truncated_svd"]

Array = NDArray[np.float64]


def truncated_svd(
    matrix: Array, tolerance: float, max_rank: int, hint: Array | None = None
) -> tuple[Array, Array, Array]:
    """Left vectors, singular values and right vectors, the tail of norm <= tolerance dropped.

    Parameters
    ----------
    matrix : ndarray (m, n)
    tolerance : float
        Largest Frobenius norm of what is dropped.
    max_rank : int
        Largest number of singular values kept, whatever the tolerance.

    Returns
    -------
    left (m, r), values (r,), right (r, n)
        At least one singular value is kept.
    """
    left, values, right = scipy.linalg.svd(
        matrix, full_matrices=False, check_finite=False, lapack_driver="gesdd"
    )
    tails = np.sqrt(np.cumsum(values[::-1] ** 2))[::-1]
    rank = int(np.count_nonzero(tails > tolerance))
    rank = min(max(rank, 1), max_rank)
    return left[:, :rank], values[:rank], right[:rank]
