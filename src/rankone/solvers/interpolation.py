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

_LEFT_POINTS = 9  # Random left points of the first attempt; each further attempt doubles them
_HIGHEST_RANK = 200  # Largest rank: initial values and states after jumps are smooth functions
_INITIAL_TOLERANCE = 1e-13  # Error of initial values, in their sizes: far below that of any solve
_TRIAL_NODES = 256  # Random nodes at which the interpolation is compared with exact values
_TRIAL_FACTOR = 30.0  # An error at a trial node above this many tolerances needs more left points
_WORST_NODES = 16  # Trial nodes with the largest errors that become left points
_ATTEMPTS = 5  # Most attempts: the last one has 144 random left points


@dataclass(frozen=True)
class PlainNodes:
    """Nodes of weight one."""

    size: int

    @property
    def weights(self) -> Array:
        """The weights, (size,)."""
        return np.ones(self.size)


def interpolated(
    function: Callable[[Integers], Array], nodes: Sequence[Nodes], tolerance: float
) -> Train:
    """A train through the values of a function at nodes of each parameter.

    ``function`` takes indices (m, d) of nodes and returns (n, m); ``tolerance`` is the largest
    error, in sizes of these values. Core 0 is (n, r_1), core j (r_j, N_j, r_{j+1}), scaled by the
    roots of the weights and right-orthonormal.
    """
    if not nodes:
        return Train((function(np.zeros((1, 0), dtype=np.int64)),))
    generator = np.random.default_rng(20140)
    trial = np.stack([generator.integers(0, x.size, _TRIAL_NODES) for x in nodes], axis=1)
    exact = function(trial)
    sizes = np.abs(exact).max(axis=1, keepdims=True)
    sizes[sizes == 0.0] = 1.0
    counts = [x.size for x in nodes]
    left = left_points(counts, _LEFT_POINTS, 20140)

    def scaled(indices: Integers) -> Array:
        return np.asarray(function(indices) / sizes)

    for attempt in range(1, _ATTEMPTS + 1):
        batches = [[points] for points in left]
        train, _ = interpolate(scaled, nodes, batches, tolerance, _HIGHEST_RANK)
        unscaled = train.unscaled([x.weights for x in nodes])
        errors = np.abs(train.first @ unscaled.at_indices(trial) - exact / sizes).max(axis=0)
        full = math.prod(counts[:-1]) <= len(left[-1])
        if full or errors.max() <= _TRIAL_FACTOR * tolerance:
            break
        worst = trial[np.argsort(-errors)[:_WORST_NODES]]
        left = [
            np.unique(np.concatenate([points, worst[:, : points.shape[1]]]), axis=0)
            for points in left_points(counts, _LEFT_POINTS * 2**attempt, 20140 + attempt)
        ]
    logger.info("interpolated over the parameters: ranks %s, error %.1e", train.ranks, errors.max())
    return train.with_first(train.first * sizes)


def interpolated_initial(system: System, nodes: Sequence[Array]) -> Train:
    """Initial values at the nodes (N_j,) of each parameter, to rounding, as a train.

    Core 0 has the shape (n, r_1), core j the shape (r_j, N_j, r_{j+1}).
    """

    if not nodes:
        return Train((system.initial(np.empty((0, 1))),))

    def at_nodes(indices: Integers) -> Array:
        return system.initial(np.stack([x[indices[:, j]] for j, x in enumerate(nodes)]))

    return interpolated(at_nodes, [PlainNodes(x.size) for x in nodes], _INITIAL_TOLERANCE)
