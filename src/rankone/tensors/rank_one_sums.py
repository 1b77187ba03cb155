"""Arithmetic of sums of products: tensors held as one factor matrix for each dimension.

    X[n_0, ..., n_d] = sum_r F_0[n_0, r] F_1[n_1, r] ... F_d[n_d, r]

Addition joins columns, a pointwise product pairs them; both raise the rank, and the classic method
lowers it again by solving with the identity.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import product, qr

__all__ = ["RankOneSum"]

_STABLE = 120
"""Largest rank whose norm is found by orthogonalisation if there are more than two dimensions."""
_BLOCK = 4_000_000
"""Inner products of products that are formed at once."""
_ROUNDING = 1e-15
"""Relative size of what cancels in squared norms."""


@dataclass(frozen=True)
class RankOneSum:
    """A sum of R products of one vector for each dimension.

    Attributes
    ----------
    factors : tuple of ndarray (N_j, R)
        One matrix for each dimension; amplitudes are part of the columns.
    """

    factors: tuple[Array, ...]

    @property
    def rank(self) -> int:
        """Number of products R."""
        return int(self.factors[0].shape[1])

    def __add__(self, other: RankOneSum) -> RankOneSum:
        pairs = zip(self.factors, other.factors, strict=True)
        return RankOneSum(tuple(np.concatenate(pair, axis=1) for pair in pairs))

    def __neg__(self) -> RankOneSum:
        return self.scaled(-1.0)

    def __sub__(self, other: RankOneSum) -> RankOneSum:
        return self + -other

    def scaled(self, amplitudes: float | Array) -> RankOneSum:
        """Multiply by a number, or every product by its own."""
        return RankOneSum((self.factors[0] * amplitudes, *self.factors[1:]))

    def times(self, other: RankOneSum) -> RankOneSum:
        """The pointwise product; a square keeps each pair of products once."""
        if other is self:
            i, j = np.triu_indices(self.rank)
            square = RankOneSum(tuple(f[:, i] * f[:, j] for f in self.factors))
            return square.scaled(np.where(i == j, 1.0, 2.0))
        pairs = zip(self.factors, other.factors, strict=True)
        return RankOneSum(
            tuple((a[:, :, None] * b[:, None, :]).reshape(len(a), -1) for a, b in pairs)
        )

    def weighted(self, rows: Sequence[Array | None]) -> RankOneSum:
        """Multiply pointwise by a function of each coordinate; None is one."""
        pairs = zip(self.factors, rows, strict=True)
        return RankOneSum(tuple(f if row is None else f * row[:, None] for f, row in pairs))

    def applied(self, matrices: Sequence[Array]) -> RankOneSum:
        """Apply one matrix to each dimension."""
        pairs = zip(matrices, self.factors, strict=True)
        return RankOneSum(tuple(matrix @ f for matrix, f in pairs))

    def inner(self, other: RankOneSum) -> float:
        """Euclidean inner product."""
        return sum(float(gram.sum()) for gram in self._grams(other))

    def distance(self, other: RankOneSum, square: float | None = None) -> float:
        """Euclidean norm of the difference, as careful as :meth:`norm`.

        ``square`` is the squared norm of this tensor, if it is known.
        """
        if self.rank + other.rank <= _STABLE or len(self.factors) <= 2:
            return (self - other).norm()
        square = self.inner(self) if square is None else square
        rest = square - 2.0 * self.inner(other) + other.inner(other)
        return math.sqrt(max(rest, _ROUNDING * square))

    def _grams(self, other: RankOneSum) -> Iterator[Array]:
        """Inner products of the products, (R, R of the other), a block of columns at a time."""
        step = max(_BLOCK // max(self.rank, 1), 1)
        for first in range(0, other.rank, step):
            width = min(step, other.rank - first)
            charge(sum(product(self.rank, len(factor), width) for factor in self.factors))
            gram = np.ones((self.rank, min(step, other.rank - first)))
            for a, b in zip(self.factors, other.factors, strict=True):
                gram *= a.T @ b[:, first : first + step]
            yield gram

    def norm(self) -> float:
        """Euclidean norm.

        Of a difference all digits are kept up to rank 120, and in one and two dimensions at any
        rank; otherwise the result is at least what rounding may have cancelled.
        """
        if self.rank == 0:
            return 0.0
        if self.rank > _STABLE and len(self.factors) > 2:
            square = size = 0.0
            for gram in self._grams(self):
                square, size = square + float(gram.sum()), size + float(np.abs(gram).sum())
            return math.sqrt(max(square, _ROUNDING * size))
        carry = np.ones((1, self.rank))
        for factor in self.factors[:-1]:
            block = (carry[:, None, :] * factor).reshape(-1, self.rank)
            charge(qr(*block.shape))
            if len(block) > self.rank:
                block = np.asarray(np.linalg.qr(block, mode="r"))
            carry = block
        return float(np.linalg.norm(carry @ self.factors[-1].T))

    def at(self, indices: NDArray[np.int64]) -> Array:
        """Entries of a tensor with one row in its first dimension, at indices (m, d): (m,)."""
        products = np.broadcast_to(self.factors[0], (len(indices), self.rank))
        for factor, rows in zip(self.factors[1:], indices.T, strict=True):
            products = products * factor[rows]
        return np.asarray(products.sum(axis=1))

    @classmethod
    def of_train(cls, row: Array, cores: Sequence[Array]) -> RankOneSum:
        """The products of a train: a row (r_1,) of its first core, then (r_j, N_j, r_{j+1})."""
        factors = [np.tensordot(row, cores[0], 1)]  # (N_1, products)
        for core in cores[1:]:
            products, size, rank = core.shape
            repeated = factors[-1].shape[1] // products
            factors = [np.repeat(factor, rank, axis=1) for factor in factors]
            columns = np.moveaxis(core, 1, 0).reshape(size, -1)
            factors.append(np.tile(columns, (1, repeated)))
        return cls(tuple(factors))

    def merged(self) -> RankOneSum:
        """The same tensor without repeated work: one column if there is one dimension only."""
        if len(self.factors) > 1:
            return self
        return RankOneSum((self.factors[0].sum(axis=1, keepdims=True),))

    @staticmethod
    def zero(sizes: Sequence[int]) -> RankOneSum:
        """The empty sum."""
        return RankOneSum(tuple(np.zeros((size, 0)) for size in sizes))

    @staticmethod
    def joined(tensors: Sequence[RankOneSum], sizes: Sequence[int]) -> RankOneSum:
        """The sum of any number of tensors of the given sizes."""
        if not tensors:
            return RankOneSum.zero(sizes)
        columns = zip(*(tensor.factors for tensor in tensors), strict=True)
        return RankOneSum(tuple(np.concatenate(parts, axis=1) for parts in columns))
