"""Values at fixed times for many points of the box, and their exact derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import right_orthonormal, truncated

__all__ = ["TrainModel"]

_CHUNK = 1024
"""Points that are evaluated together."""


class TrainModel:
    """Data of a solution: states at times that stay, as functions of the parameters.

    The first core of the train is evaluated at the times once. What is left for a point of the
    box is a product of small matrices, and for a derivative the same with one of them replaced.

    Parameters
    ----------
    slabs : sequence of SlabTrain
    rows : ndarray of int (m,)
        The state of each datum.
    times : ndarray (m,)
        The time of each datum, inside of the horizon.
    """

    def __init__(self, slabs: Sequence[SlabTrain], rows: NDArray[np.intp], times: Array) -> None:
        self.size = times.size
        owner = np.searchsorted([slab.start for slab in slabs[1:]], times, side="right")
        self._parts: list[tuple[SlabTrain, list[tuple[NDArray[np.intp], Array]]]] = []
        for k in np.unique(owner):
            here = np.flatnonzero(owner == k)
            in_time = slabs[k].in_time(times[here])[rows[here], np.arange(here.size)]
            same = (group for slab, group in self._parts if slab.shares_parameters(slabs[k]))
            group = next(same, None)
            if group is None:
                self._parts.append((slabs[k], group := []))
            group.append((here, in_time))

    def thinned(self, scale: Array, tolerance: float) -> TrainModel:
        """The same with smaller ranks, within a tolerance of the data times ``scale`` (m,).

        The tolerance is of the root mean square over the box of the norm over all data.
        """
        made = copy(self)
        made._parts = []
        for slab, group in self._parts:
            places = np.concatenate([here for here, _ in group])
            first = np.concatenate([in_time for _, in_time in group]) * scale[places, None]
            cores = right_orthonormal([first, *slab.cores[1:]])
            cores, _ = truncated(cores, tolerance / np.sqrt(len(self._parts)))
            smaller = replace(slab, cores=(slab.cores[0], *cores[1:]))
            made._parts.append((smaller, [(places, cores[0] / scale[places, None])]))
        return made

    def values(self, points: Array) -> Array:
        """Values at points (d, N) of all parameters: shape (N, m)."""
        found = np.empty((points.shape[1], self.size))
        for begin in range(0, points.shape[1], _CHUNK):
            piece = slice(begin, begin + _CHUNK)
            for slab, group in self._parts:
                carry = slab.over_parameters(points[:, piece])
                for here, in_time in group:
                    found[piece, here] = (in_time @ carry).T
        return found

    def both(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """Values (N, m), and derivatives (N, m, k) with respect to some parameters.

        ``free`` are the positions of k parameters, ascending.
        """
        count, kinds = points.shape[1], 1 + len(free)
        found = np.empty((self.size, count, kinds))
        for slab, group in self._parts:
            carry = _with_slopes(slab, points, free)
            for here, in_time in group:
                found[here] = (in_time @ carry).reshape(here.size, count, kinds)
        moved = found.transpose(1, 0, 2)
        return moved[:, :, 0], moved[:, :, :0:-1]


def _with_slopes(slab: SlabTrain, points: Array, free: Sequence[int]) -> Array:
    """Product of the cores of the parameters and its derivatives, (r_1, N * (1 + k)).

    For each point the value, then the derivatives in the order in which they are met, from the
    last parameter to the first.
    """
    count = points.shape[1]
    carry = np.ones((1, count, 1))
    for j in reversed(range(len(slab.bases))):
        core, basis = slab.cores[j + 1], slab.bases[j]
        modes = basis.modal_values(points[j])
        matrix = core.reshape(len(core), -1)
        parts = modes.T[:, None, :, None] * carry
        if j in free:
            slopes = (modes @ basis.derivative).T[:, None, :, None] * carry[:, :, :1]
            parts = np.concatenate([parts, slopes], axis=3)
        kinds = parts.shape[3]
        carry = (matrix @ parts.reshape(matrix.shape[1], -1)).reshape(-1, count, kinds)
    return carry.reshape(len(carry), -1)
