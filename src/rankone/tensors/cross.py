"""Cross interpolation: a tensor train over [(state, time)] | p_1 | ... | p_d from samples.

At bond b the trajectories at (left points) x (nodes of p_b) x (right points) are a matrix with the
rows (left point, state, time) and the columns (node, right point). Its row space, truncated, gives
the core b as an interpolation from a skeleton of its columns, which are the right points of the
next bond. Since each left point brings a whole trajectory, a few of them serve ranks far higher.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import product, qr, svd
from rankone.tensors.samples import Integers
from rankone.tensors.train import right_orthonormal
from rankone.tensors.truncation import truncated_svd

__all__ = ["Interpolation", "interpolate", "left_points", "with_points"]

_FULL_GRID = 1600
"""Number of nodes of the grid up to which all of them are sampled."""
_EXCHANGES, _VOLUME = 100, 1.1
"""Most exchanges of columns of a skeleton, and the factor on its volume that is worth one."""
_EXCHANGE = 3.0
"""Operations of an exchange for each coefficient."""
_CORNERS = 0.45
"""Corners among the left points, over the random ones."""
_CORNER_WEIGHT = 0.5
"""Their weight: what is missed there alone may be larger."""
_EXTRA = 16
"""Expected rank of a bond: twice that of the next one, and so many more."""


class Nodes(Protocol):
    """What counts of a basis here."""

    @property
    def size(self) -> int:
        """Number of nodes."""

    @property
    def weights(self) -> Array:
        """Weights of the nodes."""


@dataclass(frozen=True)
class Interpolation:
    """A train whose first core is in the basis of the trajectories.

    Attributes
    ----------
    cores : list of ndarray
        Core 0 (basis, r_1); cores j (r_j, n_j, r_{j+1}), scaled by the roots of the weights and
        right-orthonormal.
    limited : bool
        Whether a rank was cut.
    """

    cores: list[Array]
    limited: bool


def left_points(sizes: Sequence[int], count: int, seed: int) -> list[Integers]:
    """For each bond the left points: node indices of the parameters before it, (m, b).

    Random ones, ``count`` of them, and corners of their grid, or all where the whole grid is small.
    In the corners products of many parameters are largest, which random points hardly see.
    """
    generator = np.random.default_rng(seed)
    points = [np.zeros((1, 0), dtype=np.int64)]
    full = math.prod(sizes) <= _FULL_GRID
    for b in range(1, len(sizes)):
        total = math.prod(sizes[:b])
        if full or total <= count:
            columns = list(np.unravel_index(np.arange(total), tuple(sizes[:b])))
        else:
            corners = _corners(b, round(_CORNERS * count), generator)
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
        np.unique(np.concatenate([known, nearest[:, : known.shape[1]]]), axis=0) for known in left
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
) -> Interpolation:
    """One sweep from the last parameter to the first.

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
    """
    generator = np.random.default_rng(20140)
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
        guess = generator.standard_normal((2 * len(right) + _EXTRA, len(columns)))
        charge(20.0 * guess.size + 4.0 * matrix.size)
        _, values, rows = truncated_svd(matrix, allowed, max_rank, guess)
        limited |= values.size == max_rank
        skeleton, core = _skeleton(rows)
        cores.insert(0, core.reshape(len(rows), size, len(right)))
        right = columns[skeleton]
    return Interpolation([samples(right), *_scaled(cores, bases)], limited)


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
    for _ in range(_EXCHANGES):
        i, j = np.unravel_index(np.argmax(np.abs(coefficients)), coefficients.shape)
        if abs(coefficients[i, j]) < _VOLUME:
            break
        charge(_EXCHANGE * coefficients.size)
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


def _scaled(cores: Sequence[Array], bases: Sequence[Nodes]) -> list[Array]:
    """Values at the nodes times the roots of the weights."""
    pairs = zip(cores, bases, strict=True)
    return [core * np.sqrt(basis.weights)[:, None] for core, basis in pairs]


def rounded(cores: Sequence[Array], tolerance: float) -> list[Array]:
    """The same train with the ranks that a tolerance needs, right-orthonormal."""
    result = right_orthonormal(cores)
    share = tolerance / math.sqrt(max(len(result) - 1, 1))
    for j in range(len(result) - 1):
        core = result[j]
        charge(svd(core.size / core.shape[-1], core.shape[-1]))
        left, values, right = scipy.linalg.svd(
            core.reshape(-1, core.shape[-1]), full_matrices=False, check_finite=False
        )
        tails = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1])
        keep = max(int(np.count_nonzero(tails > share)), 1)
        result[j] = left[:, :keep].reshape(*core.shape[:-1], keep)
        carry = values[:keep, None] * right[:keep]
        result[j + 1] = np.tensordot(carry, result[j + 1], 1)
    return right_orthonormal(result)
