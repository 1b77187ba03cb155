"""How fast small changes of the states grow and decay, by the Jacobian.

Of many states one eigenvalue is computed, at an end of the spectrum and to a few per cent, by
Arnoldi's method (ARPACK; Lehoucq, Sorensen & Yang, 1998). Where that does not converge, all of them
are computed, or of very many states the bound of Gershgorin's circles stands in, which is never too
small. Along chains and in diffusion that bound says already that nothing grows.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import ArpackError, eigs

from rankone.ir.jacobian import PatternJacobian
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import eigenvalues, in_pieces
from rankone.trajectories.integrator import JACOBIAN_ENTRY, jacobians
from rankone.trajectories.stacks.newton import entries_at, sparse_pattern

Matrix: TypeAlias = Array | scipy.sparse.csr_array
_TOLERANCE = 0.03  # Relative error of an eigenvalue of a sparse matrix
_MOST_RESTARTS = 30  # Of Arnoldi's method
_SPARSE_COST = 20.0  # Operations of a restart for each entry and for each state
_MOST_DENSE = 600  # States up to which all eigenvalues are computed where one does not converge
_MOST_EXAMINED = 3  # Sparse matrices of a stack whose fastest decay is computed


def growth_rate(matrix: Matrix, harmless: float = -math.inf) -> float:
    """The fastest rate at which small states grow, by the Jacobian (n, n).

    Or a bound of it, by Gershgorin's circles, where that is no more than a ``harmless`` rate.
    """
    if isinstance(matrix, np.ndarray):
        return float(np.linalg.eigvals(matrix).real.max())
    bound = min(_circles(matrix), _circles(matrix.T))
    if bound <= harmless:
        return bound
    charge(_MOST_RESTARTS * _SPARSE_COST * (matrix.nnz + matrix.shape[0]))
    try:
        start = np.random.default_rng(20149).random(matrix.shape[0])
        options = {"which": "LR", "v0": start, "tol": _TOLERANCE, "maxiter": _MOST_RESTARTS}
        fastest = eigs(matrix, k=1, return_eigenvectors=False, **options)
        return float(fastest.real.max())
    except ArpackError:
        if matrix.shape[0] <= _MOST_DENSE:  # of what swings, the bound says that it grows
            charge(eigenvalues(matrix.shape[0]))
            return float(np.linalg.eigvals(matrix.toarray()).real.max())
        return bound


def _circles(matrix: scipy.sparse.csr_array) -> float:
    """A rate that no eigenvalue exceeds, by the rows of a matrix."""
    diagonal = matrix.diagonal()
    return float((diagonal + abs(matrix).sum(axis=1) - np.abs(diagonal)).max())


def logarithmic_norm(matrix: Matrix, sizes: Array) -> float:
    """A bound of how fast an error grows, by the Jacobian (n, n), in the maximum norm.

    Each state is relative to its size, (n,). Eigenvalues say less where they are far from normal.
    """
    diagonal = matrix.diagonal()
    others = abs(matrix) @ sizes / sizes - np.abs(diagonal)
    return float((diagonal + others).max())


def first_jacobian(system: System, points: Array, time: float, states: Array) -> Matrix | None:
    """The Jacobian of the first trajectory, states (n, m); None where it is not finite."""
    pattern, n = sparse_pattern(system), system.n_differential
    if pattern is None:
        block = jacobians(system, points, time, states)[0]
        return block if np.isfinite(block).all() else None
    entries = entries_at(system, pattern, points[:1], time, states[:, :1])[:, 0]
    return scipy.sparse.csr_array((entries, (pattern.rows, pattern.columns)), shape=(n, n))


def jacobian_blocks(
    system: System, points: Array, time: float, states: Array, rows: NDArray[np.intp]
) -> Array:
    """The Jacobians of some states (r,) in themselves, of a stack: (m, r, r)."""
    pattern = sparse_pattern(system)
    if pattern is None:
        return jacobians(system, points, time, states)[:, rows[:, None], rows]
    own, places, entries = _own_entries(system, pattern, points, time, states, rows)
    blocks = np.zeros((len(points), rows.size, rows.size))
    blocks[:, places[pattern.rows[own]], places[pattern.columns[own]]] = entries.T
    return blocks


def growth_bounds(
    system: System, points: Array, time: float, states: Array, rows: NDArray[np.intp]
) -> Array:
    """For each trajectory of a stack a rate that no eigenvalue of such a block exceeds: (m,).

    By the circles of its rows and of its columns; infinite for few states, whose eigenvalues cost
    as little.
    """
    pattern = sparse_pattern(system)
    if pattern is None:
        return np.full(len(points), np.inf)
    own, places, entries = _own_entries(system, pattern, points, time, states, rows)
    lines, columns = places[pattern.rows[own]], places[pattern.columns[own]]
    radii = np.where((lines == columns)[:, None], entries, np.abs(entries))
    shape, numbers = (rows.size, own.size), np.arange(own.size)
    bounds = [
        (scipy.sparse.csr_array((np.ones(own.size), (ends, numbers)), shape) @ radii).max(axis=0)
        for ends in (lines, columns)
    ]
    return np.asarray(np.minimum(*bounds))


def _own_entries(
    system: System,
    pattern: PatternJacobian,
    points: Array,
    time: float,
    states: Array,
    rows: NDArray[np.intp],
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Numbers of the entries that some states have in themselves, their places, and values."""
    places = np.full(system.n_differential, -1)
    places[rows] = np.arange(rows.size)
    own = np.flatnonzero((places[pattern.rows] >= 0) & (places[pattern.columns] >= 0))
    return own, places, entries_at(system, pattern, points, time, states)[own]


def decays_faster(system: System, points: Array, time: float, states: Array, rate: float) -> bool:
    """Whether some Jacobian of a stack has an eigenvalue with a real part below ``-rate``."""
    pattern = sparse_pattern(system)
    if pattern is None:
        blocks = jacobians(system, points, time, states)
        return bool(np.isfinite(blocks).all()) and _dense_decays_faster(blocks, rate)
    n, entries = system.n_differential, entries_at(system, pattern, points, time, states)
    stack = scipy.sparse.csr_array(
        (np.ones(pattern.rows.size), (pattern.rows, np.arange(pattern.rows.size))),
        shape=(n, pattern.rows.size),
    )
    bounds = (stack @ np.abs(entries)).max(axis=0)  # no eigenvalue is larger
    largest = np.argsort(-bounds, kind="stable")[:_MOST_EXAMINED]
    for k in largest[bounds[largest] > rate].tolist():
        own = -entries[:, k], (pattern.rows, pattern.columns)
        if growth_rate(scipy.sparse.csr_array(own, shape=(n, n)), rate) > rate:
            return True
    return False


def _dense_decays_faster(blocks: Array, rate: float) -> bool:
    """The same for matrices (m, n, n)."""
    cost = eigenvalues(blocks.shape[-1])
    for matrices in in_pieces(blocks, cost):
        charge(JACOBIAN_ENTRY * matrices.size)
        bounds = np.abs(matrices).sum(axis=2).max(axis=1)  # no eigenvalue is larger
        suspicious = matrices[bounds > rate]
        charge(cost * len(suspicious))
        if -np.linalg.eigvals(suspicious).real.min(initial=0.0) > rate:
            return True
    return False
