"""Sampled functions of the parameters: columns at nodes of a grid, held in a growing basis."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rankone.discretization import Basis1D
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import product, qr, svd
from rankone.tensors.train import Integers

__all__ = ["GrowingBasis", "Samples"]

_LOOKUP_COST = 250.0
"""Operations of looking a node up."""
_COPY_COST = 3.0
"""Operations of copying a coefficient of a node."""
_GRAM_RESOLUTION = 1e-6
"""Singular values, over the largest, that a Gram matrix tells from rounding."""
_LOST_SHARE = 0.3
"""Singular values left out of the basis, relative to the tolerance: several errors add up."""


class Samples:
    """A table of columns by the indices of their nodes; each column is computed once.

    Parameters
    ----------
    sampled : callable
        Coefficients (rank, m) of columns at points (m, d), such as Trajectories; the rank grows.
    bases : sequence of Basis1D
        One for each parameter.
    """

    def __init__(self, sampled: Callable[[Array], Array], bases: Sequence[Basis1D]) -> None:
        self.sampled, self.nodes = sampled, [basis.nodes for basis in bases]
        self._sizes = np.array([basis.size for basis in bases], dtype=np.int64)
        self._strides = np.cumprod(np.concatenate([[1], self._sizes[:-1]])).astype(np.int64)
        self._codes = np.zeros(0, dtype=np.int64)  # ascending, of the columns in _places
        self._places = np.zeros(0, dtype=np.int64)
        self._table = np.zeros((0, 0))

    def __call__(self, indices: Integers) -> Array:
        """Coefficients of the columns at nodes (m, d): shape (rank of the basis, m)."""
        charge(_LOOKUP_COST * len(indices) + 0.5 * self._table.size)
        codes, inverse = np.unique(indices @ self._strides, return_inverse=True)
        missing = np.setdiff1d(codes, self._codes, assume_unique=True)
        if missing.size:
            self._add(missing)
        columns = self._places[np.searchsorted(self._codes, codes)]
        charge(_COPY_COST * len(self._table) * len(indices))
        return self._table[:, columns[inverse]]

    def _add(self, codes: Integers) -> None:
        indices = (codes[:, None] // self._strides) % self._sizes
        points = np.stack([x[indices[:, j]] for j, x in enumerate(self.nodes)], axis=1)
        coefficients = self.sampled(points)
        rank, count = self._table.shape
        table = np.zeros((len(coefficients), count + codes.size))
        table[:rank, :count], table[:, count:] = self._table, coefficients
        self._table = table
        self._codes = np.concatenate([self._codes, codes])
        self._places = np.concatenate([self._places, count + np.arange(codes.size)])
        order = np.argsort(self._codes)
        self._codes, self._places = self._codes[order], self._places[order]


class GrowingBasis:
    """An orthonormal basis of columns of a given length, which grows by what it misses.

    Attributes
    ----------
    vectors : ndarray (length, rank)
    """

    def __init__(self, length: int) -> None:
        self.vectors = np.zeros((length, 0))

    def coefficients(self, columns: Array, tolerance: float) -> Array:
        """Coefficients (rank, m) of columns (length, m), each missed by no more than a tolerance.

        The basis grows where it misses more.
        """
        length, rank = self.vectors.shape
        charge(2.0 * product(length, rank, columns.shape[1]) + 4.0 * columns.size)
        coefficients = self.vectors.T @ columns
        if rank == length:
            return coefficients
        remainder = columns - self.vectors @ coefficients
        sizes = np.linalg.norm(remainder, axis=0)
        if sizes.max(initial=0.0) <= tolerance and rank:
            return coefficients
        large = sizes > _LOST_SHARE * tolerance
        if not large.any():  # so far all are negligible
            large = sizes == sizes.max(initial=0.0)
        added = _span(remainder[:, large], _LOST_SHARE * tolerance)
        charge(2.0 * product(length, added.shape[1], rank) + qr(*added.shape) + self.vectors.size)
        added, _ = np.linalg.qr(added - self.vectors @ (self.vectors.T @ added))
        self.vectors = np.concatenate([self.vectors, added], axis=1)
        return np.concatenate([coefficients, added.T @ remainder])

    def columns(self, coefficients: Array) -> Array:
        """Columns (length, m) from coefficients (rank, m) that may be older than the basis."""
        return np.asarray(self.vectors[:, : len(coefficients)] @ coefficients)


def _span(columns: Array, tolerance: float) -> Array:
    """Orthonormal columns in whose span most of the columns lie up to the tolerance.

    By eigenvectors of Gram matrices, several times faster than singular vectors: each gives the
    directions that stand out of its rounding errors, and the next is one of what is left.
    """
    span = np.zeros((len(columns), 0))
    while True:
        smaller, larger = sorted(columns.shape)
        charge(2.0 * product(smaller, larger, smaller) + svd(smaller, smaller) + columns.size)
        wide = columns.shape[1] > columns.shape[0]
        squares, vectors = np.linalg.eigh(columns @ columns.T if wide else columns.T @ columns)
        weights, vectors = np.sqrt(np.maximum(squares[::-1], 0.0)), vectors[:, ::-1]
        threshold = max(tolerance, _GRAM_RESOLUTION * weights[0])
        rank = max(int(np.count_nonzero(weights > threshold)), 1)
        directions = (
            vectors[:, :rank]
            if wide
            else columns @ (vectors[:, :rank] / np.maximum(weights[:rank], 1e-300))
        )
        charge(2.0 * product(len(span), rank, span.shape[1]) + qr(*directions.shape))
        directions, _ = np.linalg.qr(directions - span @ (span.T @ directions))
        span = np.concatenate([span, directions], axis=1)
        if threshold == tolerance or span.shape[1] >= len(span):
            return span
        columns = columns - directions @ (directions.T @ columns)
