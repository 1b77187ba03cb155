"""Sparse factors of the matrices of implicit steps, all of one pattern.

SuperLU factors them (Demmel et al., SIAM J. Matrix Anal. Appl. 20 (1999), 720) in an order of
elimination that is chosen once. Positions, whose rates are velocities, are eliminated beforehand:
what is left has half the size, and pivots on its diagonal.

Where factors would fill, as those of many cells in space and of graphs do, there is an iteration
with the diagonal in place of factors (van der Vorst, SIAM J. Sci. Stat. Comput. 13 (1992), 631).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as ss
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import LinearOperator, SuperLU, bicgstab, splu

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.trajectories.fields.field_system import FieldSystem

FACTOR_ENTRY = 4.0  # Operations for each entry of factors
_MANY = 2_000  # Unknowns from which on factors may fill
_RESIDUAL = 1e-9  # Of a solution by iteration, over the right side
_MOST_ITERATIONS = 200
_PIVOT = 0.01  # A diagonal entry of this share of the largest of its column is the pivot


class Factors(Protocol):
    """What solves with a matrix."""

    def solve(self, right: Array) -> Array:
        """The solution for a right side (n,)."""


@dataclass(frozen=True, eq=False)
class _OrderedFactors:
    """Factors of a matrix whose rows and columns were put in another order."""

    factors: SuperLU
    order: NDArray[np.intp]

    def solve(self, right: Array) -> Array:
        charge(FACTOR_ENTRY * self.factors.nnz)
        solution = np.empty_like(right)
        solution[self.order] = self.factors.solve(right[self.order])
        return solution


class _DiagonalFactors:
    """Solves by iteration; exact factors are made as soon as it does not converge."""

    def __init__(self, matrix: ss.csc_array, factorisation: Factorisation) -> None:
        self._matrix, self._factorisation = ss.csr_array(matrix), factorisation
        self._exact: Factors | None = None
        diagonal = matrix.diagonal()
        inverse = 1.0 / np.where(diagonal == 0.0, 1.0, diagonal)
        self._inverse = LinearOperator(matrix.shape, lambda right: inverse * right)

    def solve(self, right: Array) -> Array:
        if self._exact is None:
            size = float(np.linalg.norm(right)) or 1.0
            solution, failed = bicgstab(
                self._matrix,
                right / size,  # small numbers would be taken for a breakdown
                rtol=_RESIDUAL,
                maxiter=_MOST_ITERATIONS,
                M=self._inverse,
                callback=lambda _: charge(2.0 * FACTOR_ENTRY * self._matrix.nnz),
            )
            if not failed:
                return np.asarray(size * solution)
            self._exact = self._factorisation.exact(ss.csc_array(self._matrix))
        return self._exact.solve(right)


class Factorisation:
    """Factors of matrices of one pattern; the order of elimination is that of the first one."""

    def __init__(self) -> None:
        self._order: NDArray[np.intp] | None = None
        self._fills: bool | None = None

    def of(self, matrix: ss.csc_array) -> Factors:
        """Factors of a matrix."""
        if self._fills is None:
            self._fills = matrix.shape[0] > _MANY and _fills(matrix)
        return _DiagonalFactors(matrix, self) if self._fills else self.exact(matrix)

    def exact(self, matrix: ss.csc_array) -> Factors:
        """Factors of a matrix that leave nothing out; others of the pattern are like these."""
        self._fills = False
        symmetric = {"SymmetricMode": True}
        if self._order is None:
            first = splu(
                ss.csc_array(matrix),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=_PIVOT,
                options=symmetric,
            )
            self._order = np.argsort(first.perm_c)
        ordered = ss.csc_array(ss.csc_array(matrix)[self._order][:, self._order])
        factors = splu(ordered, permc_spec="NATURAL", diag_pivot_thresh=_PIVOT, options=symmetric)
        charge(FACTOR_ENTRY * 10.0 * factors.nnz)
        return _OrderedFactors(factors, self._order)


def _fills(matrix: ss.csc_array) -> bool:
    """Whether factors of a matrix would have far more entries than it has.

    Unknowns that are equally far from one of them separate the others. Factors hold a dense block
    of about as many rows and columns: less than there are unknowns on a surface, more in space.
    """
    graph = ss.csc_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), matrix.shape)
    distances = dijkstra(graph, directed=False, unweighted=True, indices=0)
    levels = float(distances[np.isfinite(distances)].max()) + 1.0
    return bool((matrix.shape[0] / levels) ** 2 > matrix.shape[0])


@dataclass(frozen=True, eq=False)
class _EliminatedFactors:
    """Solves for what is left, and then for the positions x = b_x - A_xr r, as A_xx is one."""

    factors: Factors
    positions: NDArray[np.intp]
    rest: NDArray[np.intp]
    of_positions: ss.csr_array
    by_positions: ss.csr_array

    def solve(self, right: Array) -> Array:
        solution, of_positions = np.empty_like(right), right[self.positions]
        rest = self.factors.solve(right[self.rest] - self.by_positions @ of_positions)
        solution[self.rest] = rest
        solution[self.positions] = of_positions - self.of_positions @ rest
        return solution


class EliminatedFactorisation:
    """Factors of matrices M - c J of a system some of whose entries are positions."""

    def __init__(self, system: FieldSystem) -> None:
        entries = np.arange(system.size)
        positions = [entries[system.unknowns[k].rows] for k in system.velocities]
        self._positions = np.concatenate(positions)
        self._rest = np.setdiff1d(entries, self._positions)
        self._factorisation = Factorisation()

    def of(self, matrix: ss.csc_array) -> Factors:
        """Factors of a matrix."""
        rows = ss.csr_array(matrix)
        upper, lower = rows[self._positions], rows[self._rest]
        of_positions = ss.csr_array(upper[:, self._rest])
        by_positions = ss.csr_array(lower[:, self._positions])
        rest = ss.csc_array(lower[:, self._rest] - by_positions @ of_positions)
        factors = self._factorisation.of(rest)
        return _EliminatedFactors(factors, self._positions, self._rest, of_positions, by_positions)


def factorisation_of(system: FieldSystem) -> Factorisation | EliminatedFactorisation:
    """What factors the matrices of implicit steps of a system."""
    return EliminatedFactorisation(system) if system.velocities else Factorisation()
