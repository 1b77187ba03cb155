"""A solved time slab: one tensor train of polynomial coefficients over time and parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.discretization import Basis1D, legendre_values

__all__ = ["SlabTrain"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SlabTrain:
    """States on one time slab for every parameter of the box, as a tensor train.

    Attributes
    ----------
    start, end : float
        The time slab.
    cores : tuple of ndarray
        Core 0 has the shape (states, time modes, r_1): coefficients of the Legendre polynomials
        orthonormal on [start, end]. Core j >= 1 has the shape (r_j, modes, r_{j+1}): coefficients
        of the modes of ``bases[j - 1]``. The last rank is 1.
    bases : tuple of Basis1D
        One per parameter.
    """

    start: float
    end: float
    cores: tuple[Array, ...]
    bases: tuple[Basis1D, ...]

    @property
    def ranks(self) -> tuple[int, ...]:
        """The ranks r_1, ..., r_d between the cores."""
        return tuple(core.shape[0] for core in self.cores[1:])

    def __call__(self, times: Array, points: Array) -> Array:
        """Evaluate at paired times (M,) and parameter points (d, M): shape (states, M)."""
        carry = np.ones((times.size, 1))
        for basis, core, values in zip(
            reversed(self.bases), reversed(self.cores[1:]), reversed(points), strict=True
        ):
            left, size, right = core.shape
            modes = basis.modal_values(values)
            if right == 1:
                carry = modes @ core[:, :, 0].T
                continue
            spread = (carry @ core.reshape(left * size, right).T).reshape(-1, left, size)
            carry = np.matmul(spread, modes[:, :, None])[:, :, 0]
        first = self.cores[0]
        states, count, rank = first.shape
        xi = (2.0 * times - (self.start + self.end)) / (self.end - self.start)
        modes = legendre_values(xi, count)
        spread = (carry @ first.reshape(states * count, rank).T).reshape(-1, states, count)
        return np.matmul(spread, modes[:, :, None])[:, :, 0].T
