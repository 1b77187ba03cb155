"""Moments and variance-based sensitivities of one train: sums of small matrices.

A state is ``a(t) c_1(p_1) ... c_d(p_d)`` with a row a(t) and matrices c_j. With independent
parameters the mean of the product is the product of the means, and every part of the variance is
``a(t) P a(t)^T`` with a matrix P that is the same for all times and states. Parts are sums of
squares of fluctuations ``c_j - E c_j``, so that nothing cancels (ANOVA decomposition: Sobol,
"Global sensitivity indices for nonlinear mathematical models", 2001; in tensor trains:
Ballester-Ripoll, Paredes & Pajarola, "Sobol tensor trains for global sensitivity analysis", 2019).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from rankone.discretization import Basis1D
from rankone.statistics.measures import Measure
from rankone.support.arrays import Array

__all__ = ["TrainMoments"]


class TrainMoments:
    """What statistics need of the cores of all parameters.

    Parameters
    ----------
    cores : sequence of ndarray (r_j, modes, r_{j+1})
    bases : sequence of Basis1D
    measures : sequence of Measure
        One for each parameter.
    """

    def __init__(
        self, cores: Sequence[Array], bases: Sequence[Basis1D], measures: Sequence[Measure]
    ) -> None:
        self.count, self.cores, self.bases = len(cores), cores, bases
        self.means: list[Array] = []
        self.whole: list[Array] = []
        self.fluctuations: list[Array] = []
        for core, basis, measure in zip(cores, bases, measures, strict=True):
            mean, root = measure.integrals(basis)
            one = basis.to_modal @ np.sqrt(basis.weights)  # the constant one
            average = np.tensordot(core, mean, (1, 0))
            self.means.append(average)
            self.whole.append(np.einsum("rms,mk->rks", core, root, optimize=True))
            centred = core - average[:, None, :] * one[:, None]
            self.fluctuations.append(np.einsum("rms,mk->rks", centred, root, optimize=True))

    @cached_property
    def after(self) -> list[Array]:
        """Mean of the product of the matrices from each on: vectors (r_j,), the last is one."""
        found = [np.ones(1)]
        for mean in reversed(self.means):
            found.append(mean @ found[-1])
        return found[::-1]

    @cached_property
    def _squares(self) -> list[Array]:
        """Mean of the product from each on, times itself: (r_j, r_j)."""
        found = [np.ones((1, 1))]
        for core in reversed(self.whole):
            found.append(_sandwich(core, found[-1]))
        return found[::-1]

    @cached_property
    def mean(self) -> Array:
        """The vector m with the mean ``a(t) m``."""
        return self.after[0]

    @cached_property
    def covariance(self) -> Array:
        """The matrix of the variance, (1, r_1, r_1)."""
        found = np.zeros((1, 1))
        for j in reversed(range(self.count)):
            found = _sandwich(self.whole[j], found) + self._own[j] @ self._own[j].T
        return found[None]

    @cached_property
    def first(self) -> Array:
        """For each parameter the matrix of the variance of the mean given it, (d, r_1, r_1)."""
        parts = [self._before(j) @ own for j, own in enumerate(self._own)]
        return self._stacked([part @ part.T for part in parts])

    @cached_property
    def total(self) -> Array:
        """For each parameter that of the mean of the variance over it, the others given."""
        parts = []
        for j in range(self.count):
            found = _sandwich(self.fluctuations[j], self._squares[j + 1])
            for core in reversed(self.whole[:j]):
                found = _sandwich(core, found)
            parts.append(found)
        return self._stacked(parts)

    @cached_property
    def second(self) -> Array:
        """For pairs i < j that of their interaction beyond their first orders, by i, then by j."""
        parts = []
        for i, fluctuation in enumerate(self.fluctuations[:-1]):
            between, before = np.eye(fluctuation.shape[2]), self._before(i)
            for own, mean in zip(self._own[i + 1 :], self.means[i + 1 :], strict=True):
                both = np.tensordot(fluctuation, between @ own, (2, 0))
                both = before @ both.reshape(len(both), -1)
                parts.append(both @ both.T)
                between = between @ mean
        return self._stacked(parts)

    def main_effect(self, j: int, points: Array) -> Array:
        """The vectors m with the mean ``a(t) m`` given one parameter, (r_1, points)."""
        core = self._before(j) @ (self.cores[j] @ self.after[j + 1]).swapaxes(0, 1)[..., None]
        return np.asarray(core[..., 0].T @ self.bases[j].modal_values(points).T)

    def _stacked(self, matrices: Sequence[Array]) -> Array:
        """Matrices (k, r_1, r_1); there may be none."""
        rank = len(self.after[0])
        return np.stack(matrices) if matrices else np.zeros((0, rank, rank))

    @cached_property
    def _own(self) -> list[Array]:
        """Fluctuations times the mean of what comes after them: (r_j, modes)."""
        return [f @ v for f, v in zip(self.fluctuations, self.after[1:], strict=True)]

    def _before(self, j: int) -> Array:
        """Mean of the product of the matrices before: (r_1, r_j)."""
        found = np.eye(len(self.after[0]))
        for mean in self.means[:j]:
            found = found @ mean
        return found


def _sandwich(core: Array, inner: Array) -> Array:
    """Sum over modes of ``c_m inner c_m^T``."""
    left = np.tensordot(core, inner, (2, 0))
    return np.asarray(np.tensordot(left, core, ((1, 2), (1, 2))))
