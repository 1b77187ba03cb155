"""The Jacobian of one slab and S = (D M / h - A)^{-1}, as one matrix or by sparse factors.

Rows and columns are pairs of state and time node, the nodes of a state side by side. Of many pairs
the sparse matrix is factored instead, and no array has the square of their number as its size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

from rankone.discretization import RadauCollocation
from rankone.ir.features import OfStates
from rankone.ir.jacobian import pattern_of
from rankone.support.arrays import Array
from rankone.support.budget import reserve
from rankone.support.costs import product
from rankone.support.sparse import SparseFactors

MOST_DENSE = 640
"""Pairs of state and time node up to which S is one matrix."""
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
    small = jacobian.size * collocation.count <= MOST_DENSE
    kind = DenseInverse if small else SparseInverse
    return kind(jacobian, mass, collocation)


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
