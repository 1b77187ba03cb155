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
        """Evaluate at paired times (M,) and parameter points (d, M): shape (states, M).

        The plain way, without any preparation; :class:`~rankone.tensors.evaluator.TrainEvaluator`
        serves many calls.
        """
        carry = np.ones((1, times.size))
        for basis, core, values in zip(
            reversed(self.bases), reversed(self.cores[1:]), reversed(points), strict=True
        ):
            carry = _contract(core, basis.modal_values(values), carry)
        first = self.cores[0]
        xi = (2.0 * times - (self.start + self.end)) / (self.end - self.start)
        return _contract(first, legendre_values(xi, first.shape[1]), carry)


def _contract(core: Array, modes: Array, carry: Array) -> Array:
    """Multiply a core (r, n, s) with modes (M, n) and carry (s, M): shape (r, M).

    The products of modes and carry are formed first, so that one matrix product does the rest.
    """
    products = np.multiply(modes.T[:, None], carry).reshape(-1, carry.shape[1])
    return np.asarray(core.reshape(len(core), -1) @ products)
