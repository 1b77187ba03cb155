"""Sparse factors of matrices that share a pattern: in bands, or by SuperLU.

The order of the states is chosen once for the pattern. Where they can be numbered so that all
entries are close to the diagonal (Cuthill & McKee, Proc. 24th ACM National Conference, 1969), as
along a chain or a bar, LAPACK factors the band, of all matrices in one call; else SuperLU does
(Demmel et al., SIAM J. Matrix Anal. Appl. 20 (1999), 720).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, TypeAlias

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU, splu

from rankone.ir.jacobian import PatternJacobian
from rankone.support.arrays import Array
from rankone.support.costs import SPARSE_FACTORS, SPARSE_SOLUTION

Places: TypeAlias = NDArray[np.intp]
Solver: TypeAlias = Callable[[Array, Places], Array]
"""Solutions (c, n) of matrices at places (c,) for right-hand sides, in the order of elimination.

A place may come several times.
"""
_KEPT = 8  # Eliminations that are kept: as many as one session works with at a time
_ORDERS = ("MMD_AT_PLUS_A", "COLAMD")  # Orders of SuperLU that are tried
_PIVOT_THRESHOLD = 0.1  # A diagonal entry of this share of the largest of its column is the pivot
# Operations of factors and of a solution in bands: for each state, entry of the factors, product
_BAND_FACTORS, _BAND_SOLUTION = (35.0, 5.0, 0.1), (25.0, 2.0, 0.0)


class Elimination(Protocol):
    """How matrices (n, n) of a pattern are stored and factored.

    Of the ``stored`` numbers of a matrix the entries of the pattern are at ``places`` (k,), those
    of the diagonal at ``diagonal`` (n,). ``columns`` are the states in the order of elimination.
    The costs are operations.
    """

    @property
    def stored(self) -> int: ...
    @property
    def places(self) -> Places: ...
    @property
    def diagonal(self) -> Places: ...
    @property
    def columns(self) -> Places: ...
    @property
    def factor_cost(self) -> float: ...
    @property
    def solution_cost(self) -> float: ...

    def factored(self, numbers: Array) -> Solver:
        """What solves with matrices of numbers (m, stored), which may be overwritten."""


@lru_cache(_KEPT)
def elimination_of(pattern: PatternJacobian) -> Elimination:
    """The cheapest way for matrices of a pattern with a diagonal."""
    band, sparse = BandElimination.of(pattern), SparseElimination.of(pattern)
    return band if band.factor_cost < sparse.factor_cost else sparse


@dataclass(frozen=True)
class BandElimination:
    """Matrices in bands, ``lower`` and ``upper`` entries beside the diagonal."""

    lower: int
    upper: int
    places: Places
    diagonal: Places
    columns: Places

    @staticmethod
    def of(pattern: PatternJacobian) -> BandElimination:
        """States in the order of Cuthill and McKee, or as they are if the band is no wider."""
        n, entries = pattern.size, np.ones(pattern.rows.size)
        graph = scipy.sparse.csr_array((entries, (pattern.rows, pattern.columns)), shape=(n, n))
        order = np.asarray(reverse_cuthill_mckee(graph + graph.T, symmetric_mode=True), np.intp)

        def width(rank: Places) -> int:
            return int(np.abs(rank[pattern.rows] - rank[pattern.columns]).max(initial=0))

        columns = min(np.arange(n), order, key=lambda some: width(np.argsort(some)))
        rank = np.argsort(columns)  # new places of the states
        rows, over = rank[pattern.rows], rank[pattern.columns]
        lower, upper = (max(int(d.max(initial=0)), 0) for d in (rows - over, over - rows))
        height = 2 * lower + upper + 1
        places = over * height + lower + upper + rows - over
        return BandElimination(
            lower, upper, places, rank * height + lower + upper, np.asarray(columns)
        )

    @property
    def _height(self) -> int:
        return 2 * self.lower + self.upper + 1

    @property
    def stored(self) -> int:
        return self._height * self.columns.size

    @property
    def factor_cost(self) -> float:
        return self._cost(*_BAND_FACTORS)

    @property
    def solution_cost(self) -> float:
        return self._cost(*_BAND_SOLUTION)

    def _cost(self, state: float, entry: float, product: float) -> float:
        products = self.lower * (1 + self.lower + self.upper)
        return self.columns.size * (state + entry * self._height + product * products)

    def factored(self, numbers: Array) -> Solver:
        matrix = numbers.reshape(-1, self._height).T  # of all: they are blocks of one band
        kind = "z" if np.iscomplexobj(numbers) else "d"
        factor, solve = getattr(lapack, f"{kind}gbtrf"), getattr(lapack, f"{kind}gbtrs")
        factors, pivots, _ = factor(matrix, self.lower, self.upper, overwrite_ab=True)
        shape, every = (len(numbers), self.columns.size), np.arange(len(numbers))

        def solver(right: Array, some: Places) -> Array:
            if np.array_equal(some, every):
                solution, _ = solve(factors, self.lower, self.upper, right.ravel(), pivots)
                return np.asarray(solution.reshape(shape))
            turns = _turns(some)  # one right-hand side of each matrix is solved at a time
            whole = np.zeros((int(turns.max(initial=0)) + 1, *shape), dtype=right.dtype)
            whole[turns, some] = right
            together = whole.reshape(len(whole), -1).T
            solution, _ = solve(factors, self.lower, self.upper, together, pivots)
            return np.asarray(solution.T.reshape(whole.shape)[turns, some])

        return solver


@dataclass(frozen=True)
class SparseElimination:
    """Matrices in compressed columns; the factors have about ``filled`` entries."""

    indices: NDArray[np.intc]
    pointers: NDArray[np.intc]
    filled: int
    places: Places
    diagonal: Places
    columns: Places

    @staticmethod
    def of(pattern: PatternJacobian) -> SparseElimination:
        """The best order that SuperLU has for a matrix with a large diagonal."""
        n, off = pattern.size, pattern.rows != pattern.columns
        rows = np.concatenate([pattern.rows[off], np.arange(n)])
        columns = np.concatenate([pattern.columns[off], np.arange(n)])
        entries = np.concatenate([np.full(rows.size - n, -1.0), np.full(n, 2.0 * n)])
        matrix = scipy.sparse.csc_matrix((entries, (rows, columns)), (n, n))
        best = min((_factors(matrix, order) for order in _ORDERS), key=lambda f: int(f.nnz))
        rank = np.asarray(best.perm_c, dtype=np.intp)  # new places of the states
        numbered = scipy.sparse.csc_matrix(
            (np.arange(1.0, rows.size + 1.0), (rank[rows], rank[columns])), (n, n)
        )
        numbered.sort_indices()
        compressed = np.empty(rows.size, dtype=np.intp)
        compressed[numbered.data.astype(np.intp) - 1] = np.arange(rows.size)
        diagonal = compressed[rows.size - n :]
        places = np.empty(pattern.rows.size, dtype=np.intp)
        places[off] = compressed[: rows.size - n]
        places[~off] = diagonal[pattern.rows[~off]]
        return SparseElimination(
            numbered.indices, numbered.indptr, int(best.nnz), places, diagonal, np.argsort(rank)
        )

    @property
    def stored(self) -> int:
        return self.indices.size

    @property
    def factor_cost(self) -> float:
        return SPARSE_FACTORS(self.filled)

    @property
    def solution_cost(self) -> float:
        return SPARSE_SOLUTION(self.filled)

    def factored(self, numbers: Array) -> Solver:
        n = self.columns.size
        matrices = (
            scipy.sparse.csc_matrix((own, self.indices, self.pointers), (n, n)) for own in numbers
        )
        factors = [_factors(matrix, "NATURAL") for matrix in matrices]

        def solver(right: Array, some: Places) -> Array:
            pairs = zip(some.tolist(), right, strict=True)
            return np.stack([factors[k].solve(vector) for k, vector in pairs])

        return solver


def _turns(places: Places) -> Places:
    """How often each of the places came before: (c,)."""
    order = np.argsort(places, kind="stable")
    ascending = places[order]
    turns = np.empty_like(places)
    turns[order] = np.arange(places.size) - np.searchsorted(ascending, ascending)
    return turns


def _factors(matrix: scipy.sparse.csc_matrix, order: str) -> SuperLU:
    return splu(matrix, permc_spec=order, diag_pivot_thresh=_PIVOT_THRESHOLD)
