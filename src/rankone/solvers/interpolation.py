"""Functions of the parameters, interpolated in a tensor train: initial values, states after jumps.

By cross interpolation, as the cross engine does it with whole trajectories.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.tensors.cross import Nodes, interpolate, left_points
from rankone.tensors.train import Integers, Train

logger = logging.getLogger("rankone")

__all__ = ["PlainNodes", "interpolated", "interpolated_initial"]

_LEFT, _HIGHEST_RANK = 9, 200
_LOST_AT_START = 1e-13
"""Largest error, in sizes: far below that of any solve."""
_NODES_TRIED, _LOST_THERE, _WORST_TAKEN = 256, 30.0, 16
"""Random nodes at which the interpolation is tried, the error there over what may be lost from
which there are more left points, and how many of the worst are among them."""
_ATTEMPTS = 5


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
) -> Train:
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
    Train
        Core 0 (n, r_1), core j (r_j, N_j, r_{j+1}), scaled by the roots of the weights and
        right-orthonormal.
    """
    if not nodes:
        return Train((values(np.zeros((1, 0), dtype=np.int64)),))
    generator = np.random.default_rng(20140)
    some = np.stack([generator.integers(0, x.size, _NODES_TRIED) for x in nodes], axis=1)
    exact = values(some)
    sizes = np.abs(exact).max(axis=1, keepdims=True)
    sizes[sizes == 0.0] = 1.0
    counts = [x.size for x in nodes]
    left = left_points(counts, _LEFT, 20140)
    for number in range(1, _ATTEMPTS + 1):
        train, _ = interpolate(lambda i: values(i) / sizes, nodes, left, tolerance, _HIGHEST_RANK)
        unscaled = train.unscaled([x.weights for x in nodes])
        missed = np.abs(train.first @ unscaled.at_indices(some) - exact / sizes).max(axis=0)
        full = math.prod(counts[:-1]) <= len(left[-1])
        if full or missed.max() <= _LOST_THERE * tolerance:
            break
        worst = some[np.argsort(-missed)[:_WORST_TAKEN]]
        more = left_points(counts, _LEFT * 2**number, 20140 + number)
        left = [
            np.unique(np.concatenate([points, worst[:, : points.shape[1]]]), axis=0)
            for points in more
        ]
    logger.info("interpolated over the parameters: ranks %s, error %.1e", train.ranks, missed.max())
    return train.with_first(train.first * sizes)


def interpolated_initial(system: System, nodes: Sequence[Array]) -> Train:
    """Initial values at the nodes (N_j,) of each parameter, to rounding, as a train.

    Core 0 has the shape (n, r_1), core j the shape (r_j, N_j, r_{j+1}).
    """

    def values(indices: Integers) -> Array:
        return system.initial(np.stack([x[indices[:, j]] for j, x in enumerate(nodes)]))

    return interpolated(values, [PlainNodes.of(x.size) for x in nodes], _LOST_AT_START)
