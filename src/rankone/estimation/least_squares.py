"""Least squares in a unit cube, for many starts at once.

The method of Levenberg and Marquardt, with the step by the singular values of the Jacobian, so that
directions which the data do not see are left alone (Nocedal & Wright, Numerical Optimization,
ch. 10.3; bounds by an active set, Kelley, Iterative Methods for Optimization, ch. 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.estimation.free import Free
from rankone.estimation.model import TrainModel
from rankone.estimation.observations import Observations
from rankone.support.arrays import Array

__all__ = ["LeastSquares", "Minima"]

_ITERATIONS = 80
_SETTLED = 1e-13
"""Share of the sum of squares that a step may still promise at the end."""
_ROUNDING = 1e-9
"""Promised share below which a step that does not keep its promise means the end."""
_UNSEEN = 1e-2
"""Change of the residuals across the cube, in units of their mean, that counts as none."""
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-14, 1e10


@dataclass(frozen=True)
class Minima:
    """Local minima.

    Attributes
    ----------
    z : ndarray (K, n)
    cost : ndarray (K,)
        Sums of squares.
    residuals : ndarray (K, m)
    jacobian : ndarray (K, m, n)
    converged : ndarray of bool (K,)
    """

    z: Array
    cost: Array
    residuals: Array
    jacobian: Array
    converged: NDArray[np.bool_]


@dataclass(frozen=True)
class LeastSquares:
    """Scaled residuals as functions of z in the unit cube."""

    model: TrainModel
    observations: Observations
    free: Free

    def residuals(self, z: Array) -> Array:
        """Residuals (K, m) at z (K, n): model minus data over sigma."""
        values = self.model.values(self.free.points(z))
        return (values - self.observations.values) * self.observations.scale

    def both(self, z: Array) -> tuple[Array, Array]:
        """Residuals (K, m) and their derivatives (K, m, n) with respect to z."""
        values, slopes = self.model.both(self.free.points(z), self.free.positions)
        scale = self.observations.scale
        residuals = (values - self.observations.values) * scale
        return residuals, slopes * scale[:, None] * self.free.width

    def minima(self, starts: Array, held: NDArray[np.bool_] | None = None) -> Minima:
        """Go down from starts (K, n); coordinates that are held (K, n) stay where they are."""
        z = np.clip(starts, 0.0, 1.0)
        kept = np.zeros(z.shape, dtype=bool) if held is None else held
        residuals, jacobian = self.both(z)
        cost = _squares(residuals)
        damping = np.full(len(z), _DAMPING)
        converged = np.zeros(len(z), dtype=bool)
        going = np.arange(len(z))
        for _ in range(_ITERATIONS):
            step, promised = _step(
                z[going], residuals[going], jacobian[going], kept[going], damping[going]
            )
            trial = np.clip(z[going] + step, 0.0, 1.0)
            there, slopes = self.both(trial)
            new, old = _squares(there), cost[going]
            better = new < old
            small = np.abs(trial - z[going]).max(axis=1) <= 1e-14
            ended = (promised <= _SETTLED * old) | small
            ended |= ~better & ((promised <= _ROUNDING * old) | (damping[going] > _MOST_DAMPING))
            at = going[better]
            z[at], cost[at] = trial[better], new[better]
            residuals[at], jacobian[at] = there[better], slopes[better]
            down = np.maximum(damping[going] * 0.1, _LEAST_DAMPING)
            damping[going] = np.where(better, down, np.maximum(damping[going], 1e-6) * 8.0)
            converged[going[ended]] = True
            going = going[~ended]
            if not going.size:
                break
        return Minima(z, cost, residuals, jacobian, converged)


def _squares(residuals: Array) -> Array:
    return np.asarray(np.einsum("km,km->k", residuals, residuals))


def _step(
    z: Array, residuals: Array, jacobian: Array, held: NDArray[np.bool_], damping: Array
) -> tuple[Array, Array]:
    """Damped steps (K, n), and the decrease (K,) that undamped ones promise."""
    slope = np.einsum("kmn,km->kn", jacobian, residuals)
    stays = held | ((z <= 0.0) & (slope > 0.0)) | ((z >= 1.0) & (slope < 0.0))
    moving = np.where(stays[:, None, :], 0.0, jacobian)
    left, singular, right = np.linalg.svd(moving, full_matrices=False)
    along = np.einsum("kmi,km->ki", left, residuals)
    largest = singular[:, :1]
    mean = np.sqrt(np.mean(residuals**2, axis=1, keepdims=True))
    seen = singular > np.maximum(1e-10 * largest, _UNSEEN * mean)
    along = np.where(seen, along, 0.0)
    below = np.where(seen, singular**2 + damping[:, None] * largest**2, 1.0)
    step = -np.einsum("kin,ki->kn", right, along * singular / below)
    return step, np.sum(along**2, axis=1)
