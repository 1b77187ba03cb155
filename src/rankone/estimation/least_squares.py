"""Least squares of a solution in a unit cube, for many starts at once.

The method of Levenberg and Marquardt, with steps by the singular values of the Jacobian: parameters
do not move along directions that the data do not see (Nocedal & Wright, Numerical Optimization,
ch. 10.3; bounds by an active set, Kelley, Iterative Methods for Optimization, ch. 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.estimation.free_parameters import FreeParameters
from rankone.estimation.models import Model
from rankone.estimation.observations import Observations
from rankone.support.arrays import Array

_MOST_ITERATIONS = 80  # Most iterations of a search: a bound on the work where it does not settle
# Promised decrease, in shares of the sum of squares, below which a search ends: rounding
_SETTLED_SHARE = 1e-13
# Promised share below which a search also ends if the step did not decrease the cost
_ROUNDING_SHARE = 1e-9
# Change of the residuals across the cube, in units of their mean, that counts as zero
_UNSEEN_CHANGE = 1e-2
# Damping at the start, in squares of the largest singular value: close to a Newton step
_FIRST_DAMPING = 1e-3
_LEAST_DAMPING = 1e-14  # Least damping: below it nothing is damped, by rounding
_LARGEST_DAMPING = 1e10  # Damping above which a search ends: its steps are rounding


@dataclass(frozen=True)
class Minima:
    """K local minima: z (K, n), sums of squares (K,), residuals (K, m), Jacobian (K, m, n)."""

    z: Array
    cost: Array
    residuals: Array
    jacobian: Array
    converged: NDArray[np.bool_]


@dataclass(frozen=True)
class LeastSquares:
    """Scaled residuals as functions of z in the unit cube."""

    model: Model
    observations: Observations
    free: FreeParameters

    def residuals(self, z: Array) -> Array:
        """Residuals (K, m) at z (K, n): model minus data over sigma."""
        model = self.model.values(self.free.points(z))
        return (model - self.observations.values) * self.observations.scale

    def linearised(self, z: Array) -> tuple[Array, Array]:
        """Residuals (K, m) and their derivatives (K, m, n) with respect to z."""
        model, slopes = self.model.linearised(self.free.points(z), self.free.positions)
        scale = self.observations.scale
        residuals = (model - self.observations.values) * scale
        return residuals, slopes * scale[:, None] * self.free.width

    def minima(self, starts: Array, held: NDArray[np.bool_] | None = None) -> Minima:
        """Minima from starts (K, n); held coordinates (K, n) stay at their start.

        The cost is infinite at a start at which the solution has ended before some of the data.
        """
        z = np.clip(starts, 0.0, 1.0)
        kept = np.zeros(z.shape, dtype=bool) if held is None else held
        residuals, jacobian = self.linearised(z)
        cost = squares_of(residuals)
        damping = np.full(len(z), _FIRST_DAMPING)
        converged = np.zeros(len(z), dtype=bool)
        going = np.flatnonzero(np.isfinite(cost))
        for _ in range(_MOST_ITERATIONS if going.size else 0):
            step, promised = _step(
                z[going], residuals[going], jacobian[going], kept[going], damping[going]
            )
            trial = np.clip(z[going] + step, 0.0, 1.0)
            trial_residuals, slopes = self.linearised(trial)
            trial_cost, last_cost = squares_of(trial_residuals), cost[going]
            better = trial_cost < last_cost
            small = np.abs(trial - z[going]).max(axis=1) <= 1e-14
            ended = (promised <= _SETTLED_SHARE * last_cost) | small
            rounding = promised <= _ROUNDING_SHARE * last_cost
            ended |= ~better & (rounding | (damping[going] > _LARGEST_DAMPING))
            at = going[better]
            z[at], cost[at] = trial[better], trial_cost[better]
            residuals[at], jacobian[at] = trial_residuals[better], slopes[better]
            down = np.maximum(damping[going] * 0.1, _LEAST_DAMPING)
            damping[going] = np.where(better, down, np.maximum(damping[going], 1e-6) * 8.0)
            converged[going[ended]] = True
            going = going[~ended]
            if not going.size:
                break
        return Minima(z, cost, residuals, jacobian, converged)


def squares_of(residuals: Array) -> Array:
    """Sums of squares (K,), infinite where the solution has ended before some of the data."""
    squares = np.einsum("km,km->k", residuals, residuals)
    return np.where(np.isnan(squares), np.inf, squares)


def _step(
    z: Array, residuals: Array, jacobian: Array, held: NDArray[np.bool_], damping: Array
) -> tuple[Array, Array]:
    """Damped steps (K, n), and the decrease (K,) that undamped steps promise."""
    slope = np.einsum("kmn,km->kn", jacobian, residuals)
    stays = held | ((z <= 0.0) & (slope > 0.0)) | ((z >= 1.0) & (slope < 0.0))
    moving = np.where(stays[:, None, :], 0.0, jacobian)
    left, singular, right = np.linalg.svd(moving, full_matrices=False)
    along = np.einsum("kmi,km->ki", left, residuals)
    largest = singular[:, :1]
    mean = np.sqrt(np.mean(residuals**2, axis=1, keepdims=True))
    visible = singular > np.maximum(1e-10 * largest, _UNSEEN_CHANGE * mean)
    along = np.where(visible, along, 0.0)
    below = np.where(visible, singular**2 + damping[:, None] * largest**2, 1.0)
    step = -np.einsum("kin,ki->kn", right, along * singular / below)
    return step, np.sum(along**2, axis=1)
