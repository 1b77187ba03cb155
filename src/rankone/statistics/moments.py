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

from rankone.arrays import Array
from rankone.discretization import Basis1D
from rankone.statistics.measures import Measure

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
        self.count = len(cores)
        self.means: list[Array] = []
        self.whole: list[Array] = []
        self.fluctuations: list[Array] = []
        for core, basis, measure in zip(cores, bases, measures, strict=True):
            mean, gram = measure.integrals(basis)
            one = basis.to_modal @ np.sqrt(basis.weights)  # the constant one
            average = np.tensordot(core, mean, (1, 0))
            root = _root(gram)
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

    def mean(self) -> Array:
        """The vector m with the mean ``a(t) m``."""
        return self.after[0]

    def covariance(self) -> Array:
        """The matrix of the variance."""
        found = np.zeros((1, 1))
        for j in reversed(range(self.count)):
            own = self.fluctuations[j] @ self.after[j + 1]
            found = _sandwich(self.whole[j], found) + own @ own.T
        return found

    def first(self, j: int) -> Array:
        """The matrix of the variance of the mean given parameter j."""
        own = self._before(j) @ (self.fluctuations[j] @ self.after[j + 1])
        return np.asarray(own @ own.T)

    def total(self, j: int) -> Array:
        """The matrix of the mean of the variance over parameter j, all others given."""
        found = _sandwich(self.fluctuations[j], self._squares[j + 1])
        for core in reversed(self.whole[:j]):
            found = _sandwich(core, found)
        return found

    def second(self, i: int, j: int) -> Array:
        """The matrix of the interaction of two parameters, i < j, beyond their first orders."""
        own = self.fluctuations[j] @ self.after[j + 1]
        for mean in reversed(self.means[i + 1 : j]):
            own = mean @ own
        both = np.tensordot(self.fluctuations[i], own, (2, 0))
        both = self._before(i) @ both.reshape(len(both), -1)
        return np.asarray(both @ both.T)

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


def _root(gram: Array) -> Array:
    """R with R R^T = gram, of a matrix that may be singular."""
    values, vectors = np.linalg.eigh(gram)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
