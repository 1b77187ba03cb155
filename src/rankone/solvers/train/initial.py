"""Initial values that couple parameters, interpolated in the tensor train."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rankone.arrays import Array
from rankone.discretization import Basis1D
from rankone.solvers.cross.sweep import interpolate, left_points
from rankone.solvers.integration import initial_values
from rankone.system import System

__all__ = ["interpolated_initial"]

_LEFT, _TOLERANCE, _MAX_RANK = 9, 1e-13, 200


def interpolated_initial(system: System, bases: Sequence[Basis1D], scale: Array) -> list[Array]:
    """Initial values in units of ``scale`` at the nodes, to rounding: core 0 (n, r).

    By cross interpolation, as the cross engine does it with whole trajectories.
    """
    nodes = [basis.nodes for basis in bases]

    def samples(indices: NDArray[np.int64]) -> Array:
        points = np.stack([x[indices[:, j]] for j, x in enumerate(nodes)])
        return initial_values(system, points) / scale[: system.N_DIFFERENTIAL, None]

    left = left_points([basis.size for basis in bases], _LEFT, 20140)
    return interpolate(samples, bases, left, _TOLERANCE, _MAX_RANK).cores
