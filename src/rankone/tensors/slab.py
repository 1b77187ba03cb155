"""A solved time slab: one tensor train of polynomial coefficients over time and parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.discretization import Basis1D, legendre_derivative, legendre_values
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, Cost, product

__all__ = ["SlabTrain", "sharing"]

_CORE, _MODE = Cost(10.0 * CALL, 0.1), 15.0
"""Operations for each core, for each of its numbers at a point, and for the value of a mode."""


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
        values = self._time_values(times)
        products = np.multiply(values.T[:, None], self.over_parameters(points))
        core = self.cores[0]
        return np.asarray(core.reshape(len(core), -1) @ products.reshape(-1, times.size))

    def over_parameters(self, points: Array) -> Array:
        """Product of the cores of the parameters at points (d, M): shape (r_1, M)."""
        charge(sum(_CORE(points.shape[1] * core.size) for core in self.cores[1:]))
        charge(_MODE * points.shape[1] * sum(core.shape[1] for core in self.cores[1:]))
        modes = [basis.modal_values(row) for basis, row in zip(self.bases, points, strict=True)]
        carry = np.ones((1, points.shape[1]))
        for core, values in zip(reversed(self.cores[1:]), reversed(modes), strict=True):
            products = np.multiply(values.T[:, None], carry).reshape(-1, points.shape[1])
            carry = core.reshape(len(core), -1) @ products
        return carry

    def on_grid(self, times: Array, carry: Array) -> Array:
        """Evaluate at all times (T,) for columns of :meth:`over_parameters`: (states, M, T)."""
        states, rank = len(self.cores[0]), len(carry)
        charge(50.0 * CALL + product(states * times.size, rank, carry.shape[1]))
        return np.asarray(np.einsum("ntr,rm->nmt", self.in_time(times), carry, optimize=True))

    def in_time(self, times: Array) -> Array:
        """The first core at times (T,): (states, T, r_1)."""
        return np.asarray(np.matmul(self._time_values(times), self.cores[0]))

    def first_states(self, count: int) -> SlabTrain:
        """The first states alone."""
        return replace(self, cores=(self.cores[0][:count], *self.cores[1:]))

    def derivative(self) -> SlabTrain:
        """The derivatives of the states with respect to time."""
        first, count = self.cores[0], self.cores[0].shape[1]
        slopes = legendre_derivative(count) * (2.0 / (self.end - self.start))
        return replace(self, cores=(slopes @ first, *self.cores[1:]))

    def shares_parameters(self, other: SlabTrain) -> bool:
        """Whether all but the first core are those of another slab."""
        pairs = zip(self.cores[1:], other.cores[1:], strict=True)
        return self.bases == other.bases and all(one is two for one, two in pairs)

    def _time_values(self, times: Array) -> Array:
        xi = (2.0 * times - (self.start + self.end)) / (self.end - self.start)
        return legendre_values(xi, self.cores[0].shape[1])


def sharing(slabs: Sequence[SlabTrain]) -> Iterator[list[SlabTrain]]:
    """Slabs after each other that share the cores of their parameters, or hold equal ones."""
    run = [slabs[0]]
    for slab in slabs[1:]:
        pairs = zip(slab.cores[1:], run[0].cores[1:], strict=True)
        same = all(a is b or np.array_equal(a, b) for a, b in pairs)
        if slab.bases != run[0].bases or not same:
            yield run
            run = []
        run.append(slab)
    yield run
