"""Explicit steps of stacked trajectories: DOP853, for stacks in one array.

The method, its coefficients and its control of the step are SciPy's (Hairer, Nørsett & Wanner,
Solving Ordinary Differential Equations I, II.5 and II.10). A stack of small systems spends its time
in calls of NumPy, so that the stages are made here, with as few of them as there can be.
"""

from __future__ import annotations

import numpy as np
import scipy.integrate
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.trajectories.defects import Interpolant
from rankone.trajectories.stacks.steppers import Piece, Stepper

_NESTED_ROWS = 7  # Rows of a step
_SAFETY = 0.9  # Part of the step that the estimate of the error allows
_LEAST_FACTOR, _MOST_FACTOR = 0.2, 10.0  # Change of the step from one to the next
_LEAST_STEP = 10.0  # Shortest step, in floating-point numbers


class NestedPiece(Piece):
    """A step of DOP853: a nested polynomial of the share and what is left of it."""

    method = "DOP853"

    def weights(self, shares: Array) -> Array:
        factors = np.empty((shares.size, _NESTED_ROWS))
        factors[:, ::2], factors[:, 1::2] = shares[:, None], 1.0 - shares[:, None]
        return factors.cumprod(axis=1)


class StackedDOP853(Stepper, scipy.integrate.DOP853):  # type: ignore[misc]
    """Steps that suit every trajectory: the error is the largest of all, not their mean."""

    t: float
    y: Array
    _dense: NestedPiece | None = None
    _weights = np.stack([scipy.integrate.DOP853.E5, scipy.integrate.DOP853.E3])

    def _step_impl(self) -> tuple[bool, str | None]:
        """A step whose error is within the tolerance, shorter than the last one if it must be."""
        t, y, shortest = self.t, self.y, _LEAST_STEP * float(np.spacing(abs(self.t)))
        h, refused = min(max(self.h_abs, shortest), self.max_step), False
        while h >= shortest:
            end = min(t + h, self.t_bound)
            h = end - t
            y_new, f_new = self._stages(h)
            error = h * self._error(self.atol + np.maximum(np.abs(y), np.abs(y_new)) * self.rtol)
            factor = _SAFETY * error**self.error_exponent if error else _MOST_FACTOR
            if error < 1.0:
                self.h_abs = h * min(factor, 1.0 if refused else _MOST_FACTOR)
                self.h_previous, self.y_old = h, y
                self.t, self.y, self.f = end, y_new, f_new
                return True, None
            h *= max(_LEAST_FACTOR, factor)  # the least one where the error is not a number
            refused = True
        return False, self.TOO_SMALL_STEP

    def _stages(self, h: float) -> tuple[Array, Array]:
        """The state after a step and its rates; the rates at all stages are in ``K``."""
        rates, t, y, slopes = self.fun, self.t, self.y, self.K
        weights, argument = h * self.A, np.empty_like(y)
        slopes[0] = self.f
        for stage, share in enumerate(self.C[1:].tolist(), start=1):
            np.dot(weights[stage, :stage], slopes[:stage], out=argument)
            argument += y
            slopes[stage] = rates(t + share * h, argument)
        y_new = np.asarray(y + np.dot(h * self.B, slopes[:-1]))
        f_new = slopes[-1] = rates(t + h, y_new)
        return y_new, f_new

    def _error(self, scale: Array) -> float:
        """The error of a step over its length, in units of ``scale``: the largest of all."""
        errors = np.square(self._weights @ self.K / scale)
        fifth, third = errors.reshape(2, self.trajectory_states, -1).sum(axis=1)
        below = np.sqrt((fifth + 0.01 * third) * self.trajectory_states)
        return float(np.max(fifth / np.where(below > 0.0, below, 1.0)))

    def dense_output(self) -> NestedPiece:
        """The last step as a function of time, made once for each step."""
        if self._dense is None or self._dense.t != self.t or self._dense.t_old != self.t_old:
            rows = np.empty((_NESTED_ROWS, self.n))
            h, slopes, before = self.h_previous, self.K_extended, self.y_old
            weights, argument = h * self.A_EXTRA, np.empty(self.n)
            for extra, share in enumerate(self.C_EXTRA.tolist()):
                stage = self.n_stages + 1 + extra
                np.dot(weights[extra, :stage], slopes[:stage], out=argument)
                argument += before
                slopes[stage] = self.fun(self.t_old + share * h, argument)
            np.subtract(self.y, before, out=rows[0])
            np.subtract(h * slopes[0], rows[0], out=rows[1])
            rows[2] = 2.0 * rows[0] - h * (self.f + slopes[0])
            np.dot(h * self.D, slopes, out=rows[3:])
            self._dense = NestedPiece(self.t_old, self.t, before, rows)
        return self._dense

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:  # a nested polynomial
        n, dense = self.trajectory_states, self.dense_output()
        coefficients = dense.rows.reshape(len(dense.rows), n, -1)[:, :, columns]
        start = dense.y_old.reshape(n, -1)[:, columns]

        def evaluate(shares: Array, slopes: bool) -> tuple[Array, Array]:
            y, left = np.zeros_like(start), 1.0 - shares
            slope = np.zeros_like(start) if slopes else y
            for i, coefficient in enumerate(coefficients[::-1]):
                y += coefficient
                if slopes:
                    slope *= left if i % 2 else shares
                    slope += -y if i % 2 else y
                y *= left if i % 2 else shares
            y += start
            return y, slope

        return evaluate
