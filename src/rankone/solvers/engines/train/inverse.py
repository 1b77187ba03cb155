"""The Jacobian of one slab and S = (D M / h - A)^{-1}, as one matrix or by sparse factors.

Rows and columns are pairs of state and time node, the nodes of a state side by side. Of many pairs
sparse matrices are factored instead, and no array has the square of their number as its size. Where
the Jacobian hardly changes over the slab, they are of the states alone, one for each pair of rows
of the Schur form of D (Bickart, SIAM J. Numer. Anal. 14 (1977), 1022, of its Jordan form); else
one matrix over all pairs is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import reserve
from rankone.support.costs import SparseFactors, product
from rankone.tensors.bases import RadauCollocation
from rankone.trajectories.system.features import OfStates
from rankone.trajectories.system.system import pattern_of

MOST_DENSE = 640
"""Pairs of state and time node up to which S is one matrix."""
# Change of the Jacobian over the slab, times its length, that S may leave out: it costs no sweeps
_LARGEST_CHANGE = 3.0
_COPIES = 5  # Matrices over these pairs while S is set up
_ENTRY_BYTES = 16.0  # An entry of a sparse matrix, with its row


@dataclass(frozen=True, eq=False)
class SlabJacobian:
    """Jacobians (n, n) of a system at the K nodes of a slab.

    ``entries`` (k, K) are at ``rows`` and ``columns``, each (k,); all others are zero.
    """

    size: int
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    entries: Array

    @staticmethod
    def along(jacobian: OfStates, times: Array, states: Array, point: Array) -> SlabJacobian:
        """The Jacobian along states (n, K) at times (K,), for one parameter point (d, 1)."""
        n, pattern = len(states), pattern_of(jacobian)
        if pattern is None:
            values = jacobian(times, states, point)
            return SlabJacobian.of(np.broadcast_to(values, (n, n, times.size)))
        entries = pattern.entries(times, states, point)
        entries = np.broadcast_to(entries, (pattern.rows.size, times.size))
        return SlabJacobian(n, pattern.rows, pattern.columns, entries)

    @staticmethod
    def of(dense: Array) -> SlabJacobian:
        """From arrays (n, n, K) with all zeros."""
        rows, columns = np.nonzero(np.any(dense != 0.0, axis=2))
        return SlabJacobian(len(dense), rows, columns, dense[rows, columns])

    def scaled(self, scale: Array) -> SlabJacobian:
        """The same for states divided by ``scale`` (n,)."""
        ratios = scale[self.columns] / scale[self.rows]
        return SlabJacobian(self.size, self.rows, self.columns, self.entries * ratios[:, None])

    @property
    def middle(self) -> Array:
        """The entries (k,) at the node in the middle."""
        return np.asarray(self.entries[:, self.entries.shape[1] // 2])

    @property
    def change(self) -> float:
        """Largest sum of the changes of a row from the middle to another node."""
        changes = np.abs(self.entries - self.middle[:, None]).max(axis=1, initial=0.0)
        return float(np.bincount(self.rows, changes, self.size).max(initial=0.0))

    def dense(self) -> Array:
        """With all zeros: (K, n, n)."""
        full = np.zeros((self.entries.shape[1], self.size, self.size))
        full[:, self.rows, self.columns] = self.entries.T
        return full


class SlabInverse(Protocol):
    """Products with the Jacobian A, with S and with its transpose; x is (n * K, m)."""

    def jacobian(self, x: Array) -> Array:
        """A x."""

    def solve(self, x: Array) -> Array:
        """S x."""

    def adjoint(self, x: Array) -> Array:
        """S^T x."""

    def cost(self, columns: int) -> float:
        """Operations of a product with A and one with S, as far as these do not count their own."""


def inverse_of(jacobian: SlabJacobian, mass: Array, collocation: RadauCollocation) -> SlabInverse:
    """The inverse for the masses (n,) of the states, divided by the length of the slab."""
    if jacobian.size * collocation.count <= MOST_DENSE:
        return DenseInverse(jacobian, mass, collocation)
    if jacobian.change <= _LARGEST_CHANGE * mass.max():
        return SchurInverse(jacobian, mass, collocation)
    return SparseInverse(jacobian, mass, collocation)


class DenseInverse:
    """S as one matrix."""

    def __init__(self, jacobian: SlabJacobian, mass: Array, collocation: RadauCollocation) -> None:
        n, count = self._shape = jacobian.size, collocation.count
        reserve(8.0 * _COPIES * (n * count) ** 2)
        self._jacobian = jacobian.dense()
        matrix = np.zeros((n, count, n, count))
        index, nodes = np.arange(n), np.arange(count)
        matrix[index, :, index, :] = mass[:, None, None] * collocation.derivative
        matrix[:, nodes, :, nodes] -= self._jacobian
        factors = scipy.linalg.lu_factor(matrix.reshape(n * count, n * count), check_finite=False)
        self._matrix = scipy.linalg.lu_solve(factors, np.eye(n * count), check_finite=False)

    def jacobian(self, x: Array) -> Array:
        n, count = self._shape
        blocks = np.moveaxis(x.reshape(n, count, -1), 1, 0)
        return np.asarray(np.moveaxis(np.matmul(self._jacobian, blocks), 0, 1).reshape(x.shape))

    def solve(self, x: Array) -> Array:
        return np.asarray(self._matrix @ x)

    def adjoint(self, x: Array) -> Array:
        return np.asarray(self._matrix.T @ x)

    def cost(self, columns: int) -> float:
        pairs = len(self._matrix)
        return 2.0 * product(pairs, pairs, columns)


class SparseInverse:
    """S by sparse factors."""

    def __init__(self, jacobian: SlabJacobian, mass: Array, collocation: RadauCollocation) -> None:
        n, count = jacobian.size, collocation.count
        reserve(_ENTRY_BYTES * count * (n * count + 2.0 * jacobian.rows.size))
        nodes, shape = np.arange(count), (n * count, n * count)
        rows = (jacobian.rows[:, None] * count + nodes).ravel()
        columns = (jacobian.columns[:, None] * count + nodes).ravel()
        self._jacobian = scipy.sparse.csr_matrix((jacobian.entries.ravel(), (rows, columns)), shape)
        derivative = scipy.sparse.kron(scipy.sparse.diags(mass), collocation.derivative)
        matrix = (derivative - self._jacobian).tocsc()
        self._factors = SparseFactors(matrix)

    def solve(self, x: Array) -> Array:
        return self._factors.solve(x)

    def adjoint(self, x: Array) -> Array:
        return self._factors.adjoint(x)

    def jacobian(self, x: Array) -> Array:
        return np.asarray(self._jacobian @ x)

    def cost(self, columns: int) -> float:
        return 2.0 * columns * float(self._jacobian.nnz)


class SchurInverse:
    """S of the Jacobian in the middle of the slab, by sparse factors for the Schur form of D.

    With D = Q T Q^T and T of diagonal blocks of one or two rows, from the last block to the first
    ``(T_kk M / h - A) y_k`` is known. A block ``[[a, b], [c, a]]`` with the eigenvalues a ± i w is
    a complex matrix of the states: ``((a + i w) M / h - A) (y_1 + i w y_2 / c)``.
    """

    def __init__(self, jacobian: SlabJacobian, mass: Array, collocation: RadauCollocation) -> None:
        n, self._mass = jacobian.size, mass
        self._shape = n, collocation.count
        place = jacobian.rows, jacobian.columns
        self._jacobian = scipy.sparse.csr_matrix((jacobian.middle, place), (n, n))
        self._triangular, self._vectors = scipy.linalg.schur(collocation.derivative)
        self._blocks = [
            _Block.of(self._triangular, rows, self._jacobian, mass)
            for rows in _diagonal_blocks(self._triangular)
        ]

    def jacobian(self, x: Array) -> Array:
        return np.asarray((self._jacobian @ x.reshape(self._shape[0], -1)).reshape(x.shape))

    def solve(self, x: Array) -> Array:
        return self._substituted(x, self._triangular, self._blocks[::-1], adjoint=False)

    def adjoint(self, x: Array) -> Array:
        return self._substituted(x, self._triangular.T, self._blocks, adjoint=True)

    def _substituted(
        self, x: Array, triangular: Array, blocks: Sequence[_Block], adjoint: bool
    ) -> Array:
        """Solutions for right-hand sides (n * K, m), block after block."""
        n, count = self._shape
        transformed = np.tensordot(self._vectors.T, x.reshape(n, count, -1), (1, 1))  # (K, n, m)
        solutions = np.zeros_like(transformed)
        mass = self._mass[:, None]
        done: list[int] = []
        for block in blocks:
            right = transformed[block.rows]
            if done:
                right = right - mass * np.tensordot(
                    triangular[np.ix_(block.rows, done)], solutions[done], 1
                )
            solutions[block.rows] = block.solve(right, adjoint)
            done += block.rows
        return np.asarray(np.tensordot(self._vectors, solutions, 1).swapaxes(0, 1).reshape(x.shape))

    def cost(self, columns: int) -> float:
        n, count = self._shape
        return 2.0 * columns * (count * float(self._jacobian.nnz) + 3.0 * n * count**2)


@dataclass(frozen=True, eq=False)
class _Block:
    """A diagonal block of the Schur form: its rows, and the factors for them.

    Of two rows the second solution is the imaginary part over ``ratio``.
    """

    rows: list[int]
    factors: SparseFactors
    ratio: float = 0.0

    @staticmethod
    def of(
        triangular: Array, rows: list[int], jacobian: scipy.sparse.csr_matrix, mass: Array
    ) -> _Block:
        shift, ratio = float(triangular[rows[0], rows[0]]), 0.0
        if len(rows) == 1:
            matrix = scipy.sparse.diags(shift * mass) - jacobian
            return _Block(rows, SparseFactors(matrix.tocsc()))
        above, below = (float(triangular[i, j]) for i, j in (rows, rows[::-1]))
        frequency = np.sqrt(-above * below)
        ratio = frequency / below
        matrix = scipy.sparse.diags((shift + 1j * frequency) * mass) - jacobian
        return _Block(rows, SparseFactors(matrix.tocsc()), ratio)

    def solve(self, right: Array, adjoint: bool) -> Array:
        """Solutions (rows, n, m) for right-hand sides, or those of the transposed matrices."""
        solve = self.factors.adjoint if adjoint else self.factors.solve
        if len(self.rows) == 1:
            return solve(right[0])[None]
        ratio = -1.0 / self.ratio if adjoint else self.ratio
        both = solve(right[0] + 1j * ratio * right[1])
        return np.stack([both.real, both.imag / ratio])


def _diagonal_blocks(triangular: Array) -> list[list[int]]:
    """The rows of each diagonal block of a real Schur form, one or two."""
    count, blocks, k = len(triangular), list[list[int]](), 0
    while k < count:
        pair = k + 1 < count and triangular[k + 1, k] != 0.0
        blocks.append([k, k + 1] if pair else [k])
        k += len(blocks[-1])
    return blocks
