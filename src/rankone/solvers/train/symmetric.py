"""Contractions of a symmetric bilinear environment with two copies of a core.

The result is symmetric in the two copies, so only the pairs i <= j are formed and stored
("packed", in the order of ``np.triu_indices``). The work is a few large matrix products; rows are
taken in blocks, so that most of the pairs i > j are never computed.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import product

__all__ = ["left_products", "multiplicity", "right_products", "unpack"]

_WORK = 5e9
"""Multiplications between two looks at the budget."""
_BLOCKS = 4


@lru_cache(maxsize=512)
def _indices(rank: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the packed pairs."""
    return np.triu_indices(rank)


@lru_cache(maxsize=512)
def multiplicity(rank: int) -> Array:
    """How often a packed pair stands in the full square: 1 on the diagonal, else 2."""
    i, j = _indices(rank)
    return np.where(i == j, 1.0, 2.0)


def unpack(packed: Array, rank: int) -> Array:
    """Symmetric squares (..., rank, rank) from packed pairs (..., rank (rank + 1) / 2)."""
    i, j = _indices(rank)
    full = np.empty((*packed.shape[:-1], rank, rank))
    full[..., i, j] = packed
    full[..., j, i] = packed
    return full


def _blocks(rank: int, work: float) -> list[tuple[int, int]]:
    """Rows that are treated together, where one row takes so many multiplications."""
    step = -(-rank // _BLOCKS) if rank > 2 * _BLOCKS else rank
    step = max(min(step, int(_WORK / max(work, 1.0))), 1)
    return [(first, min(first + step, rank)) for first in range(0, rank, step)]


def right_products(env: Array, core: Array, vector: Array) -> Array:
    """Two trial cores against an environment on their right.

    Parameters
    ----------
    env : ndarray (s, s, s)
        Fully symmetric: test index, two trial indices.
    core : ndarray (r, size, s)
    vector : ndarray (size,)
        Diagonal operator of the parameter.

    Returns
    -------
    ndarray (packed pairs of r, size * s)
        ``sum_ab vector[n] core[i, n, a] core[j, n, b] env[c, a, b]`` at (ij, (n, c)).
    """
    r, size, s = core.shape
    nodes = np.ascontiguousarray(core.transpose(1, 0, 2))
    weighted = nodes * vector[:, None, None]
    square = env.reshape(s, s * s)
    packed = np.empty((r * (r + 1) // 2, size, s))
    row = 0
    for first, last in _blocks(r, size * s**3):
        charge(product((last - first) * size, s, s * s))
        charge(size * product((last - first) * s, s, r - first))
        block = np.ascontiguousarray(weighted[:, first:last]).reshape(-1, s)
        once = (block @ square).reshape(size, (last - first) * s, s)
        twice = np.matmul(once, nodes[:, first:].swapaxes(1, 2))
        twice = twice.reshape(size, last - first, s, r - first)
        for i in range(last - first):
            count = r - first - i
            packed[row : row + count] = twice[:, i, :, i:].transpose(2, 0, 1)
            row += count
    return packed.reshape(-1, size * s)


def left_products(env: Array, core: Array, vector: Array) -> Array:
    """Two trial cores against an environment on their left.

    Parameters
    ----------
    env : ndarray (tests, r, r)
        Symmetric in the two trial indices.
    core : ndarray (r, size, s)
    vector : ndarray (size,)
        Diagonal operator of the parameter.

    Returns
    -------
    ndarray (tests * size, packed pairs of s)
        ``sum_ab vector[n] env[c, a, b] core[a, n, i] core[b, n, j]`` at ((c, n), ij), times the
        multiplicity of the pair.
    """
    tests = env.shape[0]
    r, size, s = core.shape
    nodes = np.ascontiguousarray(core.transpose(1, 0, 2))
    charge(product(tests * r, r, size * s))
    once = (env.reshape(tests * r, r) @ core.reshape(r, size * s)).reshape(tests, r, size, s)
    once = once * vector[:, None]
    packed = np.empty((s * (s + 1) // 2, tests, size))
    row = 0
    for first, last in _blocks(s, size * tests * r**2):
        width = last - first
        charge(size * product(tests * width, r, s - first))
        rows = np.ascontiguousarray(once[..., first:last].transpose(2, 0, 3, 1))
        twice = np.matmul(rows.reshape(size, tests * width, r), nodes[:, :, first:])
        twice = twice.reshape(size, tests, width, s - first)
        for i in range(width):
            count = s - first - i
            packed[row : row + count] = twice[:, :, i, i:].transpose(2, 1, 0)
            row += count
    packed *= multiplicity(s)[:, None, None]
    return np.ascontiguousarray(packed.reshape(row, tests * size).T)
