"""Cross interpolation: a tensor train over [(state, time)] | p_1 | ... | p_d from samples.

At bond b the trajectories at (left points) x (nodes of p_b) x (right points) are a matrix with the
rows (left point, state, time) and the columns (node, right point). Its row space, truncated, gives
the core b as an interpolation from a skeleton of its columns, which are the right points of the
next bond. Since each left point brings a whole trajectory, a few of them serve ranks far higher.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
import scipy.linalg

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import product, qr
from rankone.tensors.train import Integers, Train, truncated_svd

__all__ = ["Nodes", "interpolate", "left_points", "with_points"]

_FULL_GRID_NODES = 1600
"""Grids of at most so many nodes are sampled completely: adapting would save nothing."""
_CORNER_RATIO = 0.45
"""Corners among the left points, over the random ones."""
_CORNER_WEIGHT = 0.5
"""Weight of corners in what a row space may miss: an error there alone may be larger."""
_EXTRA_RANK = 16
"""The rank of a bond is expected to be at most twice that of the next one plus this."""
_MAX_EXCHANGES = 100
"""Most exchanges of columns of a skeleton; Goreinov et al. report a few per rank."""
_VOLUME_GAIN = 1.1
"""Factor on the volume of a skeleton that is worth an exchange."""
_EXCHANGE_COST = 3.0
"""Operations of an exchange for each coefficient."""
_SEED = 20140
"""Seed of the random directions of a sweep."""


class Nodes(Protocol):
    """The nodes of a basis and their weights."""

    @property
    def size(self) -> int:
        """Number of nodes."""

    @property
    def weights(self) -> Array:
        """Weights of the nodes."""


def left_points(sizes: Sequence[int], count: int, seed: int) -> list[Integers]:
    """For each bond the left points: node indices of the parameters before it, (m, b).

    Random ones, ``count`` of them, and corners of their grid, or all where the whole grid is small.
    In the corners products of many parameters are largest, which random points hardly see.
    """
    generator = np.random.default_rng(seed)
    points = [np.zeros((1, 0), dtype=np.int64)]
    full = math.prod(sizes) <= _FULL_GRID_NODES
    for b in range(1, len(sizes)):
        total = math.prod(sizes[:b])
        if full or total <= count:
            columns = list(np.unravel_index(np.arange(total), tuple(sizes[:b])))
        else:
            corners = _corners(b, round(_CORNER_RATIO * count), generator)
            columns = [
                np.concatenate([generator.integers(0, size, count), (size - 1) * corner])
                for size, corner in zip(sizes[:b], corners.T, strict=True)
            ]
        points.append(np.stack(columns, axis=1).astype(np.int64))
    return points


def with_points(left: Sequence[Integers], nodes: Sequence[Array], points: Array) -> list[Integers]:
    """Left points, and for each bond the nodes that are nearest to further points (m, d)."""
    nearest = np.stack(
        [np.abs(x[None, :] - points[:, [j]]).argmin(axis=1) for j, x in enumerate(nodes)], axis=1
    )
    return [
        np.unique(np.concatenate([indices, nearest[:, : indices.shape[1]]]), axis=0)
        for indices in left
    ]


def _corners(dimensions: int, count: int, generator: np.random.Generator) -> Integers:
    """Corners of a unit cube, (m, dimensions): the ends of the diagonal and random ones, or all."""
    if 2**dimensions <= count:
        return np.stack(np.unravel_index(np.arange(2**dimensions), (2,) * dimensions), axis=1)
    ends = np.repeat([[0], [1]], dimensions, axis=1)
    return np.concatenate([ends, generator.integers(0, 2, (count - 2, dimensions))])


def _weights(left: Integers, sizes: Sequence[int]) -> Array:
    """Weights of left points in what a row space may miss: less for corners of their grid."""
    if len(left) == math.prod(sizes):
        return np.ones(len(left))
    at_ends = ((left == 0) | (left == np.array(sizes) - 1)).all(axis=1)
    return np.where(at_ends, _CORNER_WEIGHT, 1.0)


def interpolate(
    samples: Callable[[Integers], Array],
    bases: Sequence[Nodes],
    left: Sequence[Integers],
    tolerance: float,
    max_rank: int,
    begun: Callable[[int, int, int], None] | None = None,
) -> tuple[Train, bool]:
    """Cross interpolation in one sweep from the last parameter to the first.

    Parameters
    ----------
    samples : callable
        Columns of values at node indices (m, d), such as :class:`Samples`.
    bases : sequence of Basis1D
        Or what has their sizes and weights.
    left : sequence of ndarray
        Left points of each bond, see :func:`left_points`.
    tolerance : float
        Root mean square of what a row space may miss, over the trajectories of its bond.
    max_rank : int
    begun : callable, optional
        Called when a bond is begun: how many were done, of how many, and the rank.

    Returns
    -------
    train : Train
        Core 0 holds sampled columns (rows, r_1); cores j >= 1 are scaled by the roots of the
        weights.
    limited : bool
        Whether a rank was cut.
    """
    generator = np.random.default_rng(_SEED)
    right = np.zeros((1, 0), dtype=np.int64)
    cores: list[Array] = []
    limited = False
    for b in range(len(bases) - 1, -1, -1):
        if begun is not None:
            begun(len(bases) - 1 - b, len(bases), len(right))
        size = bases[b].size
        columns = _product(np.arange(size)[:, None], right)
        block = samples(_product(left[b], columns)).reshape(-1, len(left[b]), len(columns))
        weights = _weights(left[b], [basis.size for basis in bases[:b]])
        matrix = (block * weights[:, None]).reshape(-1, len(columns))
        allowed = tolerance * math.sqrt(np.sum(weights**2) * len(columns))
        guess = generator.standard_normal((2 * len(right) + _EXTRA_RANK, len(columns)))
        charge(20.0 * guess.size + 4.0 * matrix.size)
        _, weights, rows = truncated_svd(matrix, allowed, max_rank, guess)
        limited |= weights.size == max_rank
        skeleton, core = _skeleton(rows)
        cores.insert(0, core.reshape(len(rows), size, len(right)))
        right = columns[skeleton]
    roots = [np.sqrt(basis.weights)[:, None] for basis in bases]
    scaled = (core * root for core, root in zip(cores, roots, strict=True))
    return Train((samples(right), *scaled)), limited


def _skeleton(rows: Array) -> tuple[Integers, Array]:
    """Columns from which all others are interpolated with small coefficients, and these.

    Columns are exchanged as long as that enlarges the volume of the skeleton by a tenth
    (Goreinov et al., How to find a good submatrix, 2010).

    Parameters
    ----------
    rows : ndarray (r, N)
        Orthonormal.

    Returns
    -------
    skeleton : ndarray (r,)
    coefficients : ndarray (r, N)
        ``rows = rows[:, skeleton] @ coefficients``.
    """
    rank = len(rows)
    charge(3.0 * qr(*rows.shape) + product(rank, rank, rows.shape[1]))
    _, _, pivots = scipy.linalg.qr(rows, mode="economic", pivoting=True, check_finite=False)
    skeleton = pivots[:rank].astype(np.int64)
    coefficients = np.asarray(np.linalg.solve(rows[:, skeleton], rows))
    for _ in range(_MAX_EXCHANGES):
        i, j = np.unravel_index(np.argmax(np.abs(coefficients)), coefficients.shape)
        if abs(coefficients[i, j]) < _VOLUME_GAIN:
            break
        charge(_EXCHANGE_COST * coefficients.size)
        change = coefficients[:, j].copy()
        change[i] -= 1.0
        coefficients -= np.outer(change / coefficients[i, j], coefficients[i])
        skeleton[i] = j
    return skeleton, coefficients


def _product(left: Integers, right: Integers) -> Integers:
    """All pairs of rows, side by side; the right ones run fastest."""
    return np.concatenate(
        [np.repeat(left, len(right), axis=0), np.tile(right, (len(left), 1))], axis=1
    )
