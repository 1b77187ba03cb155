"""Arithmetic of sums of products: tensors held as one factor matrix for each dimension.

    X[n_0, ..., n_d] = sum_r F_0[n_0, r] F_1[n_1, r] ... F_d[n_d, r]

Addition joins columns, a pointwise product pairs them; both raise the rank, and the classic method
lowers it again by solving with the identity. A solved sum becomes tensor trains, which solutions
evaluate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rankone.support.arrays import Array
from rankone.support.budget import COPIES, charge, reserve
from rankone.support.costs import product, qr
from rankone.support.precision import AT_ONCE, EPSILON
from rankone.tensors.bases.basis import LagrangeElements
from rankone.tensors.trains.slab import SlabTrain
from rankone.tensors.trains.train import Integers, Train

# Largest rank whose norm in three dimensions or more is found by orthogonalisation, in cubic time
_ORTHOGONALISED_RANK = 120


@dataclass(frozen=True)
class RankOneSum:
    """A sum of R products, by a matrix (N_j, R) for each dimension that holds amplitudes too."""

    factors: tuple[Array, ...]

    @property
    def rank(self) -> int:
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
        return sum(float(gram.sum()) for gram in self._grams(other))

    def distance(self, other: RankOneSum, square: float | None = None) -> float:
        """Euclidean norm of the difference, as careful as :meth:`norm`.

        ``square`` is the squared norm of this tensor, if it is known.
        """
        if self.rank + other.rank <= _ORTHOGONALISED_RANK or len(self.factors) <= 2:
            return (self - other).norm()
        square = self.inner(self) if square is None else square
        difference = square - 2.0 * self.inner(other) + other.inner(other)
        return math.sqrt(max(difference, 4.0 * EPSILON * square))

    def _grams(self, other: RankOneSum) -> Iterator[Array]:
        """Inner products of the products, (R, R of the other), a block of columns at a time."""
        step = max(AT_ONCE // max(self.rank, 1), 1)
        for first in range(0, other.rank, step):
            gram = np.ones((self.rank, min(step, other.rank - first)))
            charge(sum(product(len(gram), len(f), gram.shape[1]) for f in self.factors))
            for a, b in zip(self.factors, other.factors, strict=True):
                gram *= a.T @ b[:, first : first + step]
            yield gram

    def norm(self) -> float:
        """Euclidean norm.

        The norm of a difference keeps all digits up to rank 120, and in one and two dimensions at
        any rank; otherwise it is at least what rounding may have cancelled.
        """
        if self.rank == 0:
            return 0.0
        if self.rank > _ORTHOGONALISED_RANK and len(self.factors) > 2:
            square = size = 0.0
            for gram in self._grams(self):
                square, size = square + float(gram.sum()), size + float(np.abs(gram).sum())
            return math.sqrt(max(square, 4.0 * EPSILON * size))
        products = np.ones((1, self.rank))
        for factor in self.factors[:-1]:
            block = (products[:, None, :] * factor).reshape(-1, self.rank)
            charge(qr(*block.shape))
            if len(block) > self.rank:
                block = np.asarray(np.linalg.qr(block, mode="r"))
            products = block
        return float(np.linalg.norm(products @ self.factors[-1].T))

    def at(self, indices: Integers) -> Array:
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
        return RankOneSum(tuple(np.zeros((size, 0)) for size in sizes))

    @staticmethod
    def joined(tensors: Sequence[RankOneSum], sizes: Sequence[int]) -> RankOneSum:
        """The sum of any number of tensors of the given sizes."""
        if not tensors:
            return RankOneSum.zero(sizes)
        columns = zip(*(tensor.factors for tensor in tensors), strict=True)
        return RankOneSum(tuple(np.concatenate(factors, axis=1) for factors in columns))


def element_trains(
    bases: Sequence[LagrangeElements],
    start: Sequence[RankOneSum],
    modes: Sequence[RankOneSum],
    tolerance: Array,
) -> tuple[list[SlabTrain], Array]:
    """One train for each element in time, all states together, and their highest modes.

    For each state ``start`` is its value at the start, nodal in the parameters, with one row of
    time, and ``modes`` the change from it, nodal, without the first node in time. The products of
    all states form a train with diagonal cores. It is orthogonalised once for the slab; on one
    element in time the polynomials span few directions, and singular values below the tolerance,
    the root mean square error (n,) of each state, are left out. The second array (n, 1 + d) is the
    root mean square of the two highest modes.
    """
    time, *parameters = bases
    sums = [
        RankOneSum((np.repeat(initial.factors[0], time.size, axis=0), *initial.factors[1:]))
        + RankOneSum((np.vstack([np.zeros((1, mode.rank)), mode.factors[0]]), *mode.factors[1:]))
        for initial, mode in zip(start, modes, strict=True)
    ]
    if not any(total.rank for total in sums):
        sums[0] = RankOneSum(tuple(np.zeros((len(factor), 1)) for factor in sums[0].factors))
    n, rank = len(sums), sum(total.rank for total in sums)
    entries = n * time.size + rank * sum(basis.size for basis in parameters)
    reserve(8 * COPIES * rank * entries)
    first = np.zeros((n, time.elements, time.order + 1, rank))
    begin = 0
    for state, total in enumerate(sums):
        first[state, :, :, begin : begin + total.rank] = time.to_modes(total.factors[0])
        begin += total.rank
    first /= tolerance[:, None, None, None]
    cores: list[Array] = [first.reshape(-1, rank)]
    diagonal = np.arange(rank)
    for j, basis in enumerate(parameters, start=1):
        nodal = np.concatenate([total.factors[j] for total in sums], axis=1)
        coefficients = basis.to_modes(nodal).reshape(-1, rank) / np.sqrt(basis.elements)
        core = np.zeros((rank, len(coefficients), rank))
        core[diagonal, :, diagonal] = coefficients.T
        cores.append(core)
    if parameters:
        cores[-1] = cores[-1].sum(axis=2, keepdims=True)
    else:
        cores = [cores[0].sum(axis=1, keepdims=True)]
    train = Train(tuple(cores)).rounded(1.0)
    first = train.first.reshape(n, time.elements, time.order + 1, -1)
    tails = _tails(first, train.cores[1:], bases) * tolerance[:, None]
    trains, parameter_bases = [], tuple(basis.modes for basis in parameters)
    for e in range(time.elements):
        local = first[:, e].reshape(n * (time.order + 1), -1)
        following = train.cores[1:]
        if following and local.shape[1] > len(local):
            # no more directions than coefficients in time: rotate them into the next core
            q, r = np.linalg.qr(local.T)
            local = r.T
            following = (np.tensordot(q.T, following[0], 1), *following[1:])
        block = local.reshape(n, time.order + 1, -1) * tolerance[:, None, None]
        lower = time.lower + e * time.width
        upper = time.upper if e == time.elements - 1 else time.lower + (e + 1) * time.width
        trains.append(SlabTrain(lower, upper, Train((block, *following)), parameter_bases))
    return trains, tails


def _tails(first: Array, cores: Sequence[Array], bases: Sequence[LagrangeElements]) -> Array:
    """Norms of the two highest modes of each element, by state and dimension.

    ``first`` is (n, elements, order + 1, r) and the other cores are right-orthonormal.
    """
    n, elements = first.shape[:2]
    tails = np.zeros((n, len(bases)))
    tails[:, 0] = np.sqrt(np.sum(first[:, :, -2:] ** 2, axis=(1, 2, 3)) / elements)
    gram = np.einsum("nepr,neps->nrs", first, first, optimize=True) / elements
    for j, (core, basis) in enumerate(zip(cores, bases[1:], strict=True), start=1):
        split = core.reshape(len(core), basis.elements, basis.order + 1, -1)
        flat = split[:, :, -2:].reshape(len(core), -1)
        tails[:, j] = np.sqrt(np.maximum(np.einsum("nrs,rs->n", gram, flat @ flat.T), 0.0))
        gram = np.stack([_carried(g, core) for g in gram])
    return tails


def _carried(gram: Array, core: Array) -> Array:
    r, size, s = core.shape
    half = (gram @ core.reshape(r, size * s)).reshape(r * size, s)
    return half.T @ core.reshape(r * size, s)
