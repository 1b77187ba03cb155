"""Columns held as coefficients in an orthonormal basis that grows by what it misses."""

from __future__ import annotations

import numpy as np

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import product, qr, svd

__all__ = ["GrowingBasis"]

_SEEN = 1e-6
"""Singular values, over the largest, that can be told from a Gram matrix."""
_LOST = 0.3
"""Singular values left out of the basis, relative to the tolerance."""


class GrowingBasis:
    """An orthonormal basis of columns of a given length.

    Attributes
    ----------
    vectors : ndarray (length, rank)
    """

    def __init__(self, length: int) -> None:
        self.vectors = np.zeros((length, 0))

    def coefficients(self, columns: Array, lost: float) -> Array:
        """Coefficients (rank, m) of columns (length, m), of which no more than ``lost`` is missed.

        The basis grows where it misses more.
        """
        length, rank = self.vectors.shape
        charge(2.0 * product(length, rank, columns.shape[1]) + 4.0 * columns.size)
        found = self.vectors.T @ columns
        if self.vectors.shape[1] == len(self.vectors):
            return found
        rest = columns - self.vectors @ found
        sizes = np.linalg.norm(rest, axis=0)
        if sizes.max(initial=0.0) <= lost and self.vectors.shape[1]:
            return found
        large = sizes > _LOST * lost
        if not large.any():  # so far all are negligible
            large = sizes == sizes.max(initial=0.0)
        new = _span(rest[:, large], _LOST * lost)
        charge(2.0 * product(len(new), new.shape[1], rank) + qr(*new.shape) + self.vectors.size)
        new, _ = np.linalg.qr(new - self.vectors @ (self.vectors.T @ new))
        self.vectors = np.concatenate([self.vectors, new], axis=1)
        return np.concatenate([found, new.T @ rest])

    def columns(self, coefficients: Array) -> Array:
        """Columns (length, m) from coefficients (rank, m) that may be older than the basis."""
        return np.asarray(self.vectors[:, : len(coefficients)] @ coefficients)


def _span(columns: Array, tolerance: float) -> Array:
    """Orthonormal columns in whose span most of the columns lie up to the tolerance.

    By eigenvectors of Gram matrices, several times faster than singular vectors: each gives the
    directions that are not lost in its rounding errors, and the next is one of what is left.
    """
    found = np.zeros((len(columns), 0))
    while True:
        smaller, larger = sorted(columns.shape)
        charge(2.0 * product(smaller, larger, smaller) + svd(smaller, smaller) + columns.size)
        wide = columns.shape[1] > columns.shape[0]
        values, vectors = np.linalg.eigh(columns @ columns.T if wide else columns.T @ columns)
        values, vectors = np.sqrt(np.maximum(values[::-1], 0.0)), vectors[:, ::-1]
        seen = max(tolerance, _SEEN * values[0])
        keep = max(int(np.count_nonzero(values > seen)), 1)
        new = (
            vectors[:, :keep]
            if wide
            else columns @ (vectors[:, :keep] / np.maximum(values[:keep], 1e-300))
        )
        charge(2.0 * product(len(new), new.shape[1], found.shape[1]) + qr(*new.shape))
        new, _ = np.linalg.qr(new - found @ (found.T @ new))
        found = np.concatenate([found, new], axis=1)
        if seen == tolerance or found.shape[1] >= len(found):
            return found
        columns = columns - new @ (new.T @ columns)
