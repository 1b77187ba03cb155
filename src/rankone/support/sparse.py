"""Factors of one sparse matrix, counted as work and memory.

SuperLU factors it (Demmel et al., SIAM J. Matrix Anal. Appl. 20 (1999), 720).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import splu

from rankone.support.arrays import Array
from rankone.support.budget import charge, reserve
from rankone.support.costs import SPARSE_FACTORS, SPARSE_SOLUTION

_ROW_BYTES = 8.0  # The row of an entry of the factors, beside the entry
_COMPLEX = 2.0  # Operations of complex numbers over those of real ones
_MULTIPLICATION = 0.1  # One of about filled^2 / n of the factorisation, measured


class SparseFactors:
    """Factors of a square matrix: a RuntimeError if it is singular."""

    def __init__(self, matrix: scipy.sparse.csc_matrix) -> None:
        self._factors = splu(matrix, permc_spec="MMD_AT_PLUS_A")
        self.filled = int(self._factors.nnz)
        self._weight = _COMPLEX if np.iscomplexobj(matrix) else 1.0
        reserve((8.0 * self._weight + _ROW_BYTES) * self.filled)
        multiplications = _MULTIPLICATION * self.filled**2 / matrix.shape[0]
        charge(self._weight * (SPARSE_FACTORS(self.filled) + multiplications))

    def solve(self, x: Array) -> Array:
        """Solutions for right-hand sides (n, m)."""
        charge(SPARSE_SOLUTION(self._weight * self.filled * x.shape[1]))
        return np.asarray(self._factors.solve(x))

    def adjoint(self, x: Array) -> Array:
        """Solutions with the transpose."""
        charge(SPARSE_SOLUTION(self._weight * self.filled * x.shape[1]))
        return np.asarray(self._factors.solve(x, "T"))
