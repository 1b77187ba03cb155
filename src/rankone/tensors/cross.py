"""Cross interpolation: a tensor train over [column] | p_1 | ... | p_d from sampled columns.

A column holds the states at all times, or other numbers, at one point of the parameters, as
coefficients in a basis that grows. At bond b the columns at (left points) x (nodes of p_b) x
(right points) are a matrix with the rows (left point, coefficient) and one column for each node
and right point. Core b interpolates all columns from a skeleton of them, which are the right points
of the next bond. Each left point brings many rows, so that a
few of them serve ranks far higher.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg.lapack import dpstrf

from rankone.support.arrays import ACCUMULATED, COINCIDENT, Array, sequence
from rankone.support.budget import COPIES, charge, reserve
from rankone.support.costs import CALL, COPY, product, qr
from rankone.tensors import Basis1D
from rankone.tensors.train import Integers, Skeleton, Train, skeleton_of

# Grids up to this many nodes are sampled completely: adapting would save nothing
FULL_GRID_NODES = 1600
# Parameters from which on, and nodes of two of them up to which, the last two are sampled together
_LEAST_JOINED, _JOINED_NODES = 3, 64
_CORNER_SHARE = 0.8  # Part of the left points that are corners of their grid
_CORNER_WEIGHT = 0.5  # Weight of corners in the error of a skeleton: it may be larger there
# Largest ratio of the rank of a bond to that of the next one that is expected: ranks grow ever
# less, and by as much less as from the bond before
_MOST_GROWTH = 2.0
_EXTRA_RANK = 16  # Added to the expected rank of a bond
# Error of a skeleton at left points that it was not made for, over the tolerance, that shows that
# the points it was made for suffice; tests/benchmarks/attempts.py shows what it costs
_SPANNED = 5.0
_LOOKUP_COST = 250  # Operations of looking a node up
# Columns for which a basis grows at a time: those between them hardly add to what these span
_MOST_SPANNED = 400
# Remainders that add nothing to the basis, and the norm that it misses of all others together, over
# the tolerance: columns to come are missed by more
_LOST_SHARE = 0.3

Columns = Callable[[Array], Array]
"""Coefficients (rank, m) of columns at points (m, d) of the box; the rank may grow."""


class Nodes(Protocol):
    """The nodes of a basis and their weights."""

    @property
    def size(self) -> int: ...

    @property
    def weights(self) -> Array: ...


def left_points(sizes: Sequence[int], count: int, seed: int) -> list[Integers]:
    """For each bond the left points: node indices of the parameters before it, (m, b).

    There are ``count`` of them, or all where the whole grid is small. At first, most are corners of
    their grid: products of many parameters are largest there, which points inside hardly see. The
    others are evenly spread, however many of them are taken: a front that moves with a parameter is
    seen by few of them.
    """
    generator = np.random.default_rng(seed)
    points = [np.zeros((1, 0), dtype=np.int64)]
    full = math.prod(sizes) <= FULL_GRID_NODES
    for b in range(1, len(sizes)):
        total = math.prod(sizes[:b])
        if full or total <= count:
            order = np.argsort(np.argsort(sequence(total, 1, generator)[:, 0]))
            points.append(np.stack(np.unravel_index(order, tuple(sizes[:b])), axis=1))
            continue
        grid = np.array(sizes[:b])
        at_corners = (grid - 1) * _corners(b, round(_CORNER_SHARE * count), generator)
        inside = (grid * sequence(count - len(at_corners), b, generator)).astype(np.int64)
        shares = (_CORNER_SHARE, at_corners), (1.0 - _CORNER_SHARE, inside)
        places = [np.arange(0.5, len(each)) / share for share, each in shares]
        order = np.argsort(np.concatenate(places), kind="stable")
        points.append(np.concatenate([at_corners, inside])[order])
    return points


def batched(left: Sequence[Integers], *ends: int) -> list[list[Integers]]:
    """Left points in batches, which end after so many of them."""
    return [np.split(points, [end for end in ends if end < len(points)]) for points in left]


def with_last_joined(
    left: Sequence[list[Integers]], sizes: Sequence[int]
) -> Sequence[list[Integers]]:
    """Batches of left points of which those of the last bond are those before it, at all nodes.

    Few nodes of the last two parameters are sampled together: a call costs more than they do.
    """
    if len(sizes) < _LEAST_JOINED or sizes[-2] * sizes[-1] > _JOINED_NODES:
        return left
    nodes = np.arange(sizes[-2])[:, None]
    return [*left[:-1], [_product(points, nodes) for points in left[-2]]]


def with_points(left: Sequence[Integers], nodes: Sequence[Array], points: Array) -> list[Integers]:
    """The nodes of each bond that are nearest to points (m, d), and left points behind them."""
    nearest = np.stack(
        [np.abs(x[None, :] - points[:, [j]]).argmin(axis=1) for j, x in enumerate(nodes)], axis=1
    )
    return [
        _distinct(np.concatenate([nearest[:, : indices.shape[1]], indices])) for indices in left
    ]


def _distinct(points: Integers) -> Integers:
    """Rows (m, b) without those that come a second time."""
    _, first = np.unique(points, axis=0, return_index=True)
    return points[np.sort(first)]


def _corners(dimensions: int, count: int, generator: np.random.Generator) -> Integers:
    """Corners of a unit cube, (m, dimensions): the ends of the diagonal, and random ones or all."""
    ends = np.repeat([[0], [1]], dimensions, axis=1)
    if 2**dimensions <= count:
        every = np.stack(np.unravel_index(np.arange(2**dimensions), (2,) * dimensions), axis=1)
        return np.concatenate([ends, generator.permutation(every[1:-1])])
    return np.concatenate([ends, generator.integers(0, 2, (count - 2, dimensions))])


def _weights(left: Integers, sizes: Sequence[int]) -> Array:
    """Weights of left points in the error of a skeleton: less for corners of their grid."""
    if len(left) == math.prod(sizes):
        return np.ones(len(left))
    at_ends = ((left == 0) | (left == np.array(sizes) - 1)).all(axis=1)
    return np.where(at_ends, _CORNER_WEIGHT, 1.0)


def interpolate(
    samples: Callable[[Integers], Array],
    bases: Sequence[Nodes],
    left: Sequence[Sequence[Integers]],
    tolerance: float,
    max_rank: int,
    begun: Callable[[int, int, int], None] | None = None,
) -> tuple[Train, bool]:
    """Cross interpolation in one sweep from the last parameter to the first.

    ``samples``, such as :class:`Samples`, gives columns at node indices (m, d); ``left`` holds
    batches of the :func:`left_points` of each bond, of which the later ones are taken until one
    adds nothing; the tolerance is the root mean square error of the columns of a bond that are
    interpolated from its skeleton. ``begun`` is called when a bond is begun: how many were done, of
    how many, and the rank. Core 0 of the train holds sampled columns (rows, r_1); cores j >= 1 are
    scaled by the roots of the weights. Also returns whether a rank was cut.
    """
    right = np.zeros((1, 0), dtype=np.int64)
    cores: list[Array] = []
    limited, growth, slowing = False, _MOST_GROWTH, 1.0
    for b in range(len(bases) - 1, -1, -1):
        if begun is not None:
            begun(len(bases) - 1 - b, len(bases), len(right))
        size = bases[b].size
        columns = _product(np.arange(size)[:, None], right)
        expected = math.ceil(slowing * growth * len(right)) + _EXTRA_RANK
        block = _Block(samples, left[b], [basis.size for basis in bases[:b]], columns)
        skeleton = block.skeleton(tolerance, max_rank, expected)
        limited |= skeleton.rank == max_rank
        before, growth = growth, min(skeleton.rank / len(right), _MOST_GROWTH)
        slowing = min(growth / before, 1.0)
        cores.insert(0, skeleton.coefficients.reshape(skeleton.rank, size, len(right)))
        right = columns[skeleton.columns]
    roots = [np.sqrt(basis.weights)[:, None] for basis in bases]
    scaled = (core * root for core, root in zip(cores, roots, strict=True))
    return Train((samples(right), *scaled)), limited


@dataclass(frozen=True)
class _Block:
    """The columns of a bond at batches of left points: its rows are (left point, coefficient)."""

    samples: Callable[[Integers], Array]
    batches: Sequence[Integers]
    sizes: Sequence[int]
    columns: Integers

    def skeleton(self, tolerance: float, max_rank: int, expected: int) -> Skeleton:
        """Columns from which all others are interpolated up to the tolerance.

        At the first batch, and at further ones until one is interpolated as well from the columns
        that were found before.
        """
        matrices, squares, skeleton = list[Array](), 0.0, None
        for matrix, weights in self._matrices():
            square = tolerance**2 * float(np.sum(weights**2)) * len(self.columns)
            missed, allowed = math.inf, math.sqrt(square)
            if skeleton is not None:
                missed = skeleton.missed(matrix)
                if missed <= allowed:
                    break
                matrices, expected = [skeleton.rows_of(matrices)], skeleton.rank + _EXTRA_RANK
            matrices, squares = [*matrices, matrix], squares + square
            skeleton = skeleton_of(matrices, math.sqrt(squares), max_rank, expected)
            if missed <= _SPANNED * allowed or skeleton.rank >= min(max_rank, len(self.columns)):
                break
        assert skeleton is not None
        return skeleton

    def _matrices(self) -> Iterator[tuple[Array, Array]]:
        """The matrix (left points x coefficients, columns) of each batch, and the weights.

        The first two are sampled in one call: they are needed in any case.
        """
        yield from self._sampled(self.batches[:2])
        for batch in self.batches[2:]:
            yield from self._sampled([batch])

    def _sampled(self, batches: Sequence[Integers]) -> Iterator[tuple[Array, Array]]:
        """The same for some batches."""
        left, count = np.concatenate(batches), len(self.columns)
        samples = self.samples(_pairs(left, self.columns))
        reserve(COPIES * samples.nbytes)
        charge(4.0 * samples.size)
        rows = samples.T.reshape(count, len(left), -1)
        weights, first = _weights(left, self.sizes), 0
        for batch in batches:
            some = slice(first, first + len(batch))
            first += len(batch)
            weighted = rows[:, some] * weights[some, None]
            yield weighted.reshape(count, -1).T, weights[some]


def _pairs(left: Integers, right: Integers) -> Integers:
    """All pairs of rows, side by side; the left ones run fastest."""
    return np.concatenate(
        [np.tile(left, (len(right), 1)), np.repeat(right, len(left), axis=0)], axis=1
    )


def _product(left: Integers, right: Integers) -> Integers:
    """All pairs of rows, side by side; the right ones run fastest."""
    return np.concatenate(
        [np.repeat(left, len(right), axis=0), np.tile(right, (len(left), 1))], axis=1
    )


class Samples:
    """A table of columns by the indices of their nodes; each column is computed once."""

    def __init__(self, columns: Columns, bases: Sequence[Basis1D]) -> None:
        self.columns, self.nodes = columns, [basis.nodes for basis in bases]
        self._sizes = np.array([basis.size for basis in bases], dtype=np.int64)
        self._strides = np.cumprod(np.concatenate([[1], self._sizes[:-1]])).astype(np.int64)
        self._codes = np.zeros(0, dtype=np.int64)  # ascending, of the columns in _places
        self._places = np.zeros(0, dtype=np.int64)
        self._table = np.zeros((0, 0))

    def __call__(self, indices: Integers) -> Array:
        """Coefficients of the columns at nodes (m, d): shape (rank of the basis, m)."""
        charge(_LOOKUP_COST * len(indices) + 0.5 * self._table.size)
        codes = indices @ self._strides
        places = self._found(codes)
        missing = places < 0
        if missing.any():
            self._add(np.unique(codes[missing]))
            places = self._found(codes)
        charge(COPY * self._table.shape[1] * len(indices))
        return self._table.take(places, axis=0).T

    def _found(self, codes: Integers) -> Integers:
        """The places of columns in the table (m,), negative for those that are not there."""
        if not self._codes.size:
            return np.full(codes.size, -1)
        near = np.minimum(np.searchsorted(self._codes, codes), self._codes.size - 1)
        return np.where(self._codes[near] == codes, self._places[near], -1)

    def _add(self, codes: Integers) -> None:
        indices = (codes[:, None] // self._strides) % self._sizes
        points = np.stack([x[indices[:, j]] for j, x in enumerate(self.nodes)], axis=1)
        coefficients = self.columns(points)
        count, rank = self._table.shape
        reserve(8 * COPIES * len(coefficients) * (count + codes.size))
        table = np.zeros((count + codes.size, len(coefficients)))
        table[:count, :rank], table[count:] = self._table, coefficients.T
        self._table = table
        self._codes = np.concatenate([self._codes, codes])
        self._places = np.concatenate([self._places, count + np.arange(codes.size)])
        order = np.argsort(self._codes)
        self._codes, self._places = self._codes[order], self._places[order]


class GrowingBasis:
    """An orthonormal basis (length, rank) of columns, which grows where it misses columns."""

    def __init__(self, length: int) -> None:
        self.length, self.vectors = length, np.zeros((length, 0))

    def coefficients(self, columns: Array, tolerance: float) -> Array:
        """Coefficients (rank, m) of columns (length, m), each missed by a tolerance at most."""
        length, rank = self.vectors.shape
        charge(2.0 * product(length, rank, columns.shape[1]) + 4.0 * columns.size)
        coefficients = (columns.T @ self.vectors).T  # column by column, as they are read
        if rank == length:
            return coefficients
        squares = _squares(columns)
        missed = squares - _squares(coefficients) + ACCUMULATED * squares
        if rank and missed.max(initial=0.0) <= tolerance**2:
            return coefficients
        remainder = columns - self.vectors @ coefficients
        for most in (_MOST_SPANNED, columns.shape[1]):
            sizes = np.sqrt(_squares(remainder))
            held = self.vectors.shape[1]
            if held == length or (held and sizes.max(initial=0.0) <= tolerance):
                break
            large = np.flatnonzero(sizes > _LOST_SHARE * tolerance)
            if not large.size:  # so far all are negligible
                large = np.flatnonzero(sizes == sizes.max(initial=0.0))
            some = remainder[:, large[:: max(-(-large.size // most), 1)]]
            added = self._added(some, _LOST_SHARE * tolerance)
            further = added.T @ remainder
            coefficients = np.concatenate([coefficients, further])
            if large.size <= most:
                break
            charge(3.0 * product(length, added.shape[1], columns.shape[1]))
            remainder -= added @ further
        return coefficients

    def _added(self, remainders: Array, tolerance: float) -> Array:
        """Vectors (length, k) that the basis grows by, for remainders of columns."""
        length, rank = self.vectors.shape
        while True:
            directions, missed = _directions(remainders, tolerance)
            held, size = self.vectors, directions.shape[1]
            charge(2.0 * product(length, size, held.shape[1]) + qr(length, size) + held.size)
            added, _ = np.linalg.qr(directions - held @ (held.T @ directions))
            self.vectors = np.concatenate([held, added], axis=1)
            if missed <= tolerance or self.vectors.shape[1] >= length:
                return self.vectors[:, rank:]
            remainders = remainders - added @ (added.T @ remainders)
            if np.linalg.norm(remainders) <= tolerance:  # rounding has no direction of its own
                return self.vectors[:, rank:]

    def columns(self, coefficients: Array) -> Array:
        """Columns (length, m) from coefficients (rank, m) that may be older than the basis."""
        return np.asarray(self.vectors[:, : len(coefficients)] @ coefficients)


def _squares(columns: Array) -> Array:
    """The square of the norm of each column, (m,)."""
    return np.asarray(np.einsum("ij,ij->j", columns, columns))


def _directions(columns: Array, tolerance: float) -> tuple[Array, float]:
    """Directions (length, k), at least one, that span columns (length, m) up to a missed norm.

    That is a tolerance, or more where rounding errors of the Gram matrix hide smaller directions.
    They are the pivots of its Cholesky decomposition: far cheaper than its eigenvectors, and hardly
    more of them.
    """
    smaller, larger = sorted(columns.shape)
    charge(2.0 * product(smaller, larger, smaller) + CALL)
    wide = larger > len(columns)
    gram = columns @ columns.T if wide else columns.T @ columns
    total = float(np.trace(gram))
    missed = max(tolerance, math.sqrt(COINCIDENT) * math.sqrt(total))
    factor, order, resolved, _ = dpstrf(gram, tol=missed**2 / smaller, lower=1)
    rank = max(resolved, 1)
    charge(product(smaller, rank, rank))
    factor, pivots = np.tril(factor)[:, :rank], order - 1
    left = total - np.square(factor).sum(axis=0).cumsum()
    count = min(int(np.count_nonzero(left > missed**2)) + 1, rank)
    if not wide:
        return columns[:, pivots[:count]], missed
    directions = np.empty((smaller, count))
    directions[pivots] = factor[:, :count]
    return directions, missed
