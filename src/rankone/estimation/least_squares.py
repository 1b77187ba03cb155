"""Least squares of a solution in a unit cube, for many starts at once.

The method of Levenberg and Marquardt, with steps by the singular values of the Jacobian: parameters
do not move along directions that the data do not see (Nocedal & Wright, Numerical Optimization,
ch. 10.3; bounds by an active set, Kelley, Iterative Methods for Optimization, ch. 5.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.estimation.free_parameters import FreeParameters
from rankone.estimation.observations import Observations
from rankone.support.arrays import Array
from rankone.tensors.slab import SlabTrain, slab_positions

_POINTS_AT_ONCE = 1024  # Points that are evaluated together, to bound memory
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


class TrainModel:
    """States ``rows`` of a solution at fixed times, one each, as functions of the parameters.

    The first core of the train is evaluated at the times once. Each point of the box then takes a
    product of small matrices, and each derivative the same product with one matrix replaced.
    """

    def __init__(self, slabs: Sequence[SlabTrain], rows: NDArray[np.intp], times: Array) -> None:
        self.size = times.size
        owner = slab_positions(slabs, times)
        self._groups: list[tuple[SlabTrain, list[tuple[NDArray[np.intp], Array]]]] = []
        for k in np.unique(owner):
            here = np.flatnonzero(owner == k)
            in_time = slabs[k].in_time(times[here])[rows[here], np.arange(here.size)]
            same = (group for slab, group in self._groups if slab.shares_parameters(slabs[k]))
            group = next(same, None)
            if group is None:
                self._groups.append((slabs[k], group := []))
            group.append((here, in_time))

    def thinned(self, scale: Array, tolerance: float) -> TrainModel:
        """The same with smaller ranks, within a tolerance of the data times ``scale`` (m,).

        The tolerance is of the root mean square over the box of the norm over all data.
        """
        thinned = copy(self)
        thinned._groups = []
        for slab, group in self._groups:
            places = np.concatenate([here for here, _ in group])
            first = np.concatenate([in_time for _, in_time in group]) * scale[places, None]
            train = slab.train.with_first(first).right_orthonormal()
            train, _ = train.truncated(tolerance / np.sqrt(len(self._groups)))
            smaller = replace(slab, train=train.with_first(slab.cores[0]))
            thinned._groups.append((smaller, [(places, train.first / scale[places, None])]))
        return thinned

    def values(self, points: Array) -> Array:
        """Values at points (d, N) of all parameters: shape (N, m)."""
        table = np.empty((points.shape[1], self.size))
        for begin in range(0, points.shape[1], _POINTS_AT_ONCE):
            block = slice(begin, begin + _POINTS_AT_ONCE)
            for slab, group in self._groups:
                products = slab.over_parameters(points[:, block])
                for here, in_time in group:
                    table[block, here] = (in_time @ products).T
        return table

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """Values (N, m), and derivatives (N, m, k) with respect to some parameters.

        ``free`` are the positions of k parameters, ascending.
        """
        count, columns = points.shape[1], 1 + len(free)
        table = np.empty((self.size, count, columns))
        for slab, group in self._groups:
            products = _with_slopes(slab, points, free)
            for here, in_time in group:
                table[here] = (in_time @ products).reshape(here.size, count, columns)
        moved = table.transpose(1, 0, 2)
        return moved[:, :, 0], moved[:, :, :0:-1]


def _with_slopes(slab: SlabTrain, points: Array, free: Sequence[int]) -> Array:
    """Product of the cores of the parameters and its derivatives, (r_1, N * (1 + k)).

    For each point the value, then the derivatives from the last parameter to the first.
    """
    count = points.shape[1]
    products = np.ones((1, count, 1))
    for j in reversed(range(len(slab.bases))):
        core, basis = slab.cores[j + 1], slab.bases[j]
        modes = basis.modal_values(points[j])
        matrix = core.reshape(len(core), -1)
        columns = modes.T[:, None, :, None] * products
        if j in free:
            slopes = basis.modal_slopes(points[j]).T[:, None, :, None] * products[:, :, :1]
            columns = np.concatenate([columns, slopes], axis=3)
        width = columns.shape[3]
        products = (matrix @ columns.reshape(matrix.shape[1], -1)).reshape(-1, count, width)
    return products.reshape(len(products), -1)


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

    model: TrainModel
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
        """Minima from starts (K, n); held coordinates (K, n) stay at their start."""
        z = np.clip(starts, 0.0, 1.0)
        kept = np.zeros(z.shape, dtype=bool) if held is None else held
        residuals, jacobian = self.linearised(z)
        cost = _squares(residuals)
        damping = np.full(len(z), _FIRST_DAMPING)
        converged = np.zeros(len(z), dtype=bool)
        going = np.arange(len(z))
        for _ in range(_MOST_ITERATIONS):
            step, promised = _step(
                z[going], residuals[going], jacobian[going], kept[going], damping[going]
            )
            trial = np.clip(z[going] + step, 0.0, 1.0)
            trial_residuals, slopes = self.linearised(trial)
            trial_cost, last_cost = _squares(trial_residuals), cost[going]
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


def _squares(residuals: Array) -> Array:
    return np.asarray(np.einsum("km,km->k", residuals, residuals))


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
