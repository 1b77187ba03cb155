"""Operations on tensor trains held as lists of cores."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rankone.support.arrays import Array
from rankone.tensors.truncation import independent

__all__ = [
    "apply_to_modes",
    "block_diagonal",
    "mode_norms",
    "right_orthonormal",
    "thinned",
    "truncated",
    "widened",
]


def right_orthonormal(cores: Sequence[Array], negligible: float = 1e-13) -> list[Array]:
    """Equivalent train whose cores 1, ..., d have orthonormal rows; core 0 takes the rest.

    Parameters
    ----------
    cores : sequence of ndarray
        Core 0 has any shape (..., r_1); core j >= 1 has the shape (r_j, n_j, r_{j+1}).
    negligible : float
        Rows in which no more is new, relative to the largest, are left out.
    """
    result = list(cores)
    for j in range(len(result) - 1, 0, -1):
        q, r = independent(result[j].reshape(len(result[j]), -1).T, negligible)
        result[j] = np.ascontiguousarray(q.T).reshape(-1, *result[j].shape[1:])
        result[j - 1] = result[j - 1] @ r.T
    return result


def apply_to_modes(cores: Sequence[Array], matrices: Sequence[Array]) -> list[Array]:
    """Apply one matrix to the middle index of each core j >= 1; core 0 is kept."""
    changed = [np.matmul(matrix, core) for matrix, core in zip(matrices, cores[1:], strict=True)]
    return [cores[0], *changed]


def mode_norms(cores: Sequence[Array]) -> list[Array]:
    """For each parameter the norms of the modes of its core, weighted by what is to its left.

    Cores j >= 1 (r_j, modes, r_{j+1}) have orthonormal rows.
    """
    weight = np.asarray(np.linalg.qr(cores[0], mode="r"))
    norms = []
    for core in cores[1:]:
        weighted = np.tensordot(weight, core, 1)
        norms.append(np.sqrt(np.sum(weighted**2, axis=(0, 2))))
        weight = np.asarray(np.linalg.qr(weighted.reshape(-1, core.shape[2]), mode="r"))
    return norms


def widened(cores: Sequence[Array], extra: Sequence[Array]) -> list[Array]:
    """The same train in a larger frame: the span of its cores and of those of another train.

    Parameters
    ----------
    cores : sequence of ndarray
        Core 0 (..., r_1), cores j >= 1 (r_j, n_j, r_{j+1}) with orthonormal rows.
    extra : sequence of ndarray
        Cores 1, ..., d of the other train, (k, n_j, k), the last (k, n_d, 1). From each core on
        its rows have norms below one, so that they come after those that are there.

    Returns
    -------
    list of ndarray
        Ranks up to r_j + k, cores j >= 1 with orthonormal rows.
    """
    first, count = cores[0], extra[0].shape[0]
    result = [np.concatenate([first, np.zeros((*first.shape[:-1], count))], axis=-1)]
    for j, (core, other) in enumerate(zip(cores[1:], extra, strict=True)):
        last = j == len(extra) - 1
        result.append(np.concatenate([core, other]) if last else block_diagonal(core, other))
    return right_orthonormal(result, 1e-6)


def block_diagonal(a: Array, b: Array) -> Array:
    """The core (r, n, s) whose matrices have those of two cores on their diagonals."""
    block = np.zeros((len(a) + len(b), a.shape[1], a.shape[2] + b.shape[2]))
    block[: len(a), :, : a.shape[2]] = a
    block[len(a) :, :, a.shape[2] :] = b
    return block


def truncated(cores: Sequence[Array], tolerance: float) -> tuple[list[Array], float]:
    """Truncate a right-orthonormal train within a tolerance; also returns the norm of the change.

    Core 0 may have any shape (..., r_1). Afterwards all cores but the last are orthonormal the
    other way.
    """
    result = list(cores)
    share = tolerance / math.sqrt(max(len(result) - 1, 1))
    lost = 0.0
    for j in range(len(result) - 1):
        shape = result[j].shape
        u, s, vt = np.linalg.svd(result[j].reshape(-1, shape[-1]), full_matrices=False)
        tails = np.sqrt(np.cumsum(s[::-1] ** 2))[::-1]
        keep = max(int(np.count_nonzero(tails > share)), 1)
        lost = math.hypot(lost, *tails[keep : keep + 1])
        result[j] = u[:, :keep].reshape(*shape[:-1], keep)
        result[j + 1] = np.tensordot(s[:keep, None] * vt[:keep], result[j + 1], 1)
    return result, lost


def thinned(cores: Sequence[Array], tolerance: float) -> list[Array]:
    """The same train within a tolerance, with zeros for all entries that do not matter.

    Both sides of a core are made orthonormal and turned to their singular vectors. An entry, times
    the singular value on its left, is then its share in the norm of the train, and the shares
    fall along both ranks and, for smooth functions, with the degree: the entries left are few and
    stand together.

    Parameters
    ----------
    cores : sequence of ndarray
        Core 0 (n, K, r_1), cores j >= 1 (r_j, n_j, r_{j+1}).
    tolerance : float
        Largest norm of the change: a root mean square, not a largest value.

    Returns
    -------
    list of ndarray
        The ranks are not larger.
    """
    result = right_orthonormal(cores)
    weights = np.ones(len(result[0]))
    for j, core in enumerate(result):
        shares = weights[:, None, None] * core
        if j + 1 < len(result):
            rows = shares.reshape(-1, core.shape[2])
            _, weights, turn = np.linalg.svd(rows, full_matrices=False)
            core, shares = core @ turn.T, shares @ turn.T
            result[j + 1] = np.tensordot(turn, result[j + 1], 1)
        squares = np.sort(shares**2, axis=None)
        dropped = np.count_nonzero(np.cumsum(squares[:-1]) <= (tolerance / len(result)) ** 2)
        result[j] = np.where(shares**2 < squares[dropped], 0.0, core)
    return result
