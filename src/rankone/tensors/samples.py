"""Columns at nodes of the parameter grid, such as trajectories, each computed once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from rankone.discretization import Basis1D
from rankone.support.arrays import Array
from rankone.support.budget import charge

__all__ = ["Samples"]

Integers = NDArray[np.int64]
_LOOKUP, _TAKEN = 250.0, 3.0
"""Operations to look a node up, and to take one of its coefficients."""


class Samples:
    """A table of columns by the indices of their nodes.

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
        self._values = np.zeros((0, 0))

    def __call__(self, indices: Integers) -> Array:
        """Coefficients of the columns at nodes (m, d): shape (rank of the basis, m)."""
        charge(_LOOKUP * len(indices) + 0.5 * self._values.size)
        codes, inverse = np.unique(indices @ self._strides, return_inverse=True)
        new = np.setdiff1d(codes, self._codes, assume_unique=True)
        if new.size:
            self._add(new)
        columns = self._places[np.searchsorted(self._codes, codes)]
        charge(_TAKEN * len(self._values) * len(indices))
        return self._values[:, columns[inverse]]

    def _add(self, codes: Integers) -> None:
        where = (codes[:, None] // self._strides) % self._sizes
        points = np.stack([x[where[:, j]] for j, x in enumerate(self.nodes)], axis=1)
        found = self.sampled(points)
        rank, known = self._values.shape
        values = np.zeros((len(found), known + codes.size))
        values[:rank, :known], values[:, known:] = self._values, found
        self._values = values
        self._codes = np.concatenate([self._codes, codes])
        self._places = np.concatenate([self._places, known + np.arange(codes.size)])
        order = np.argsort(self._codes)
        self._codes, self._places = self._codes[order], self._places[order]
