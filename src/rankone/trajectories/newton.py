"""Newton's matrices of stacked implicit steps: dense inverses, or sparse factors of many states.

Small matrices of a stack are inverted all at once. From some tens of states on each trajectory has
sparse LU factors of its own (SuperLU: Demmel et al., SIAM J. Matrix Anal. Appl. 20 (1999), 720);
the order of elimination is chosen once, for the pattern that all of them share.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

from rankone.ir.jacobian import PatternJacobian, pattern_of
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, Cost, function_cost, in_pieces, inverse
from rankone.trajectories.integrator import finite_blocks, jacobians

SPARSE_STATES = 64
"""States from which on sparse factors pay."""
_MOST_FILLED = 0.15  # Share of the entries of a Jacobian above which it is taken for dense
_ORDERS = ("MMD_AT_PLUS_A", "COLAMD")  # Orders of elimination that are tried
_PIVOT_THRESHOLD = 0.1  # A diagonal entry of this share of the largest of its column is the pivot
_PRODUCT_COST = Cost(40.0, 0.5)  # Operations of a matrix times a vector: once, and for each entry
_FACTOR_COST = Cost(50e3, 60.0)  # Operations of sparse factors: once, and for each of their entries
_SOLUTION_COST = Cost(12e3, 3.0)  # Operations of a solution with them


class NewtonMatrices(Protocol):
    """Inverses of matrices (n, n), one for each trajectory of a stack."""

    def solve(self, right: Array) -> Array:
        """Inverses times stacked vectors (n m,)."""

    def solve_some(self, columns: NDArray[np.intp], right: Array) -> Array:
        """Inverses of some trajectories times their vectors (n, c)."""


class Jacobians(Protocol):
    """Jacobians (n, n) of m trajectories."""

    def newton(self, shift: complex) -> NewtonMatrices:
        """Inverses of ``shift`` minus the Jacobians; the budget is checked in between."""


def jacobians_for(system: System, points: Array) -> Callable[[float, Array], Jacobians]:
    """What maps a time and a stacked state to the Jacobians at points (m, d).

    They are zero where they are not finite. The derivative of a root at zero is infinite, and
    Newton's corrections vanish however wrong the state is. Without a Jacobian they converge in
    short steps.
    """
    pattern = sparse_pattern(system)
    if pattern is None:
        return lambda t, y: DenseJacobians(finite_blocks(jacobians(system, points, t, y)))
    elimination = Elimination.of(pattern)
    return lambda t, y: SparseJacobians(elimination, entries_at(system, pattern, points, t, y))


def sparse_pattern(system: System) -> PatternJacobian | None:
    """The pattern of the Jacobian where sparse factors pay, by the number of states and entries."""
    pattern, n = pattern_of(system.jacobian), system.n_differential
    if pattern is None or n < SPARSE_STATES or pattern.rows.size > _MOST_FILLED * n * n:
        return None
    return pattern


def entries_at(
    system: System, pattern: PatternJacobian, points: Array, t: float, y: Array
) -> Array:
    """Entries (k, m) of the Jacobians at points (m, d) and states (n, m) or (n m,)."""
    m, n = len(points), system.n_differential
    charge(function_cost(pattern.entries, system.user_functions)(m))
    entries = pattern.entries(t, y.reshape(n, m), points.T)
    entries = np.broadcast_to(entries, (pattern.rows.size, m))
    finite = np.isfinite(entries).all(axis=0)
    return entries if finite.all() else np.where(finite, entries, 0.0)


@dataclass(frozen=True)
class DenseJacobians:
    """All entries (m, n, n)."""

    blocks: Array

    def newton(self, shift: complex) -> NewtonMatrices:
        size = self.blocks.shape[-1]
        cost, diagonal = inverse(size, isinstance(shift, float)), shift * np.eye(size)
        inverses = np.empty(self.blocks.shape, dtype=type(shift))
        first = 0
        for some in in_pieces(self.blocks, cost):
            charge(cost * len(some))
            inverses[first : first + len(some)] = np.linalg.inv(diagonal - some)
            first += len(some)
        return Inverses(inverses)


@dataclass(frozen=True)
class Inverses:
    """Dense inverses (m, n, n)."""

    inverses: Array

    def solve(self, right: Array) -> Array:
        m, n, _ = self.inverses.shape
        charge(5.0 * CALL + m * _PRODUCT_COST(n * n))
        vectors = np.ascontiguousarray(right.reshape(n, m).T)  # BLAS takes no strided ones
        return np.asarray(np.matmul(self.inverses, vectors[:, :, None])[:, :, 0].T.ravel())

    def solve_some(self, columns: NDArray[np.intp], right: Array) -> Array:
        return np.asarray(np.matmul(self.inverses[columns], right.T[:, :, None])[:, :, 0].T)


@dataclass(frozen=True)
class Elimination:
    """The pattern of shifted Jacobians in compressed columns, in an order with few new entries.

    ``columns`` are the states in the order of elimination, and entry k of the pattern is at
    ``places[k]`` of the compressed entries, the diagonal at ``diagonal``.
    """

    size: int
    columns: NDArray[np.intp]
    indices: NDArray[np.intc]
    pointers: NDArray[np.intc]
    places: NDArray[np.intp]
    diagonal: NDArray[np.intp]

    @staticmethod
    def of(pattern: PatternJacobian) -> Elimination:
        """The best order that SuperLU has for a matrix with a large diagonal."""
        n = pattern.size
        off = pattern.rows != pattern.columns
        rows = np.concatenate([pattern.rows[off], np.arange(n)])
        columns = np.concatenate([pattern.columns[off], np.arange(n)])
        entries = np.concatenate([np.full(int(off.sum()), -1.0), np.full(n, 2.0 * n)])
        matrix = scipy.sparse.csc_matrix((entries, (rows, columns)), (n, n))
        trials = [_factors(matrix, order) for order in _ORDERS]
        rank = min(trials, key=lambda factors: factors.nnz).perm_c  # new places of the states
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
        return Elimination(n, np.argsort(rank), numbered.indices, numbered.indptr, places, diagonal)


def _factors(matrix: scipy.sparse.csc_matrix, order: str) -> SuperLU:
    return splu(matrix, permc_spec=order, diag_pivot_thresh=_PIVOT_THRESHOLD)


@dataclass(frozen=True)
class SparseJacobians:
    """The entries (k, m) of a pattern."""

    elimination: Elimination
    entries: Array

    def newton(self, shift: complex) -> NewtonMatrices:
        kept, n = self.elimination, self.elimination.size
        numbers = np.zeros((self.entries.shape[1], kept.indices.size), dtype=type(shift))
        numbers[:, kept.places] -= self.entries.T
        numbers[:, kept.diagonal] += shift
        factors = list[SuperLU]()
        for own in numbers:
            matrix = scipy.sparse.csc_matrix((own, kept.indices, kept.pointers), (n, n))
            factors.append(_factors(matrix, "NATURAL"))
            charge(_FACTOR_COST(factors[-1].nnz))
        return SparseFactors(kept.columns, tuple(factors), numbers.dtype)


@dataclass(frozen=True)
class SparseFactors:
    """Sparse factors of each matrix; ``columns`` are the states in the order of elimination."""

    columns: NDArray[np.intp]
    factors: tuple[SuperLU, ...]
    dtype: np.dtype[np.generic]

    @cached_property
    def _cost(self) -> float:
        return float(np.mean([_SOLUTION_COST(each.nnz) for each in self.factors]))

    def solve(self, right: Array) -> Array:
        n = self.columns.size
        everything = np.arange(len(self.factors))
        return self.solve_some(everything, right.reshape(n, -1)).ravel()

    def solve_some(self, columns: NDArray[np.intp], right: Array) -> Array:
        charge(len(columns) * self._cost)
        ordered = np.ascontiguousarray(right[self.columns].T, dtype=self.dtype)
        solved = np.empty_like(ordered)
        for k, column in enumerate(columns.tolist()):
            solved[k] = self.factors[column].solve(ordered[k])
        solution = np.empty(right.shape, dtype=self.dtype)
        solution[self.columns] = solved.T
        return solution
