"""Functions of the parameters, interpolated in a tensor train: initial values, states after jumps.

By cross interpolation, as the cross engine does it with whole trajectories.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.arrays import Array
from rankone.solvers.cross.sweep import Nodes, interpolate, left_points
from rankone.solvers.integration import initial_values
from rankone.system import System

logger = logging.getLogger("rankone")

__all__ = ["Integers", "PlainNodes", "interpolated", "interpolated_initial"]

Integers = NDArray[np.int64]

_LEFT, _HIGHEST_RANK = 9, 200
_LOST_AT_START = 1e-13
"""Largest error, in sizes: far below that of any solve."""
_SIZED = 64
"""Random nodes at which the sizes of values are looked at."""


@dataclass(frozen=True)
class PlainNodes:
    """Nodes without weights."""

    size: int
    weights: Array

    @classmethod
    def of(cls, count: int) -> PlainNodes:
        """So many nodes."""
        return cls(count, np.ones(count))


def interpolated(
    values: Callable[[Integers], Array], nodes: Sequence[Nodes], tolerance: float
) -> list[Array]:
    """A train through values at nodes of each parameter.

    Parameters
    ----------
    values : callable
        Values at indices (m, d) of nodes: shape (n, m).
    nodes : sequence of Nodes
    tolerance : float
        What may be lost, in sizes of the values.

    Returns
    -------
    list of ndarray
        Core 0 (n, r_1), core j (r_j, N_j, r_{j+1}), scaled by the roots of the weights and
        right-orthonormal.
    """
    if not nodes:
        return [values(np.zeros((1, 0), dtype=np.int64))]
    generator = np.random.default_rng(20140)
    some = np.stack([generator.integers(0, x.size, _SIZED) for x in nodes], axis=1)
    sizes = np.abs(values(some)).max(axis=1, keepdims=True)
    sizes[sizes == 0.0] = 1.0
    left = left_points([x.size for x in nodes], _LEFT, 20140)
    found = interpolate(lambda i: values(i) / sizes, nodes, left, tolerance, _HIGHEST_RANK)
    first, *cores = found.cores
    if logger.isEnabledFor(logging.INFO):
        exact, points = values(some), np.ones((1, _SIZED))
        for core, basis, column in zip(reversed(cores), nodes[::-1], some.T[::-1], strict=True):
            at = core[:, column] / np.sqrt(basis.weights[column])[:, None]
            points = np.einsum("rms,sm->rm", at, points)
        error = float((np.abs(first * sizes @ points - exact) / sizes).max())
        ranks = tuple(len(core) for core in cores)
        logger.info("interpolated over the parameters: ranks %s, error %.1e", ranks, error)
    return [first * sizes, *cores]


def interpolated_initial(system: System, nodes: Sequence[Array]) -> list[Array]:
    """Initial values at the nodes (N_j,) of each parameter, to rounding, as a train.

    Core 0 has the shape (n, r_1), core j the shape (r_j, N_j, r_{j+1}).
    """

    def values(indices: Integers) -> Array:
        return initial_values(system, np.stack([x[indices[:, j]] for j, x in enumerate(nodes)]))

    return interpolated(values, [PlainNodes.of(x.size) for x in nodes], _LOST_AT_START)
