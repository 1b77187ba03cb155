"""Initial values that couple parameters, interpolated in a tensor train."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.arrays import Array
from rankone.solvers.cross.sweep import interpolate, left_points
from rankone.solvers.integration import initial_values
from rankone.system import System

__all__ = ["interpolated_initial"]

_LEFT_AT_START, _RANK_AT_START = 9, 200
_LOST_AT_START = 1e-13
"""Largest error, in sizes: far below that of any solve."""


@dataclass(frozen=True)
class _Plain:
    """Nodes without weights."""

    size: int
    weights: Array


def interpolated_initial(system: System, nodes: Sequence[Array]) -> list[Array]:
    """Initial values at the nodes (N_j,) of each parameter, to rounding, as a train.

    By cross interpolation, as the cross engine does it with whole trajectories. Core 0 has the
    shape (n, r_1), core j the shape (r_j, N_j, r_{j+1}).
    """

    def values(indices: NDArray[np.int64]) -> Array:
        return initial_values(system, np.stack([x[indices[:, j]] for j, x in enumerate(nodes)]))

    left = left_points([x.size for x in nodes], _LEFT_AT_START, 20140)
    sizes = np.abs(values(_some(nodes))).max(axis=1, keepdims=True)
    sizes[sizes == 0.0] = 1.0
    plain = [_Plain(x.size, np.ones(x.size)) for x in nodes]
    given = plain, left, _LOST_AT_START, _RANK_AT_START
    found = interpolate(lambda indices: values(indices) / sizes, *given)
    first, *cores = found.cores
    return [first * sizes, *cores]


def _some(nodes: Sequence[Array]) -> NDArray[np.int64]:
    """Random nodes, (m, d)."""
    generator = np.random.default_rng(20140)
    return np.stack([generator.integers(0, x.size, 64) for x in nodes], axis=1)
