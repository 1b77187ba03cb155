"""Explicit steps of stacked trajectories: DOP853, for stacks in one array.

The method, its coefficients and its control of the step are SciPy's (Hairer, Nørsett & Wanner,
Solving Ordinary Differential Equations I, II.5 and II.10). A stack of small systems spends its time
in calls of NumPy, so that the stages are made here, with as few of them as there can be.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.integrate
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.trajectories.defects import DefectControl, Interpolant
from rankone.trajectories.integrator import Tolerances
from rankone.trajectories.stacks.kinks import (
    DividedInterpolant,
    DividedSteps,
    Kinks,
    crossed_once,
    divided_steps,
    nested,
)
from rankone.trajectories.stacks.steppers import Piece, Rates, Stepper

_NESTED_ROWS = 7  # Rows of a step
_SAFETY = 0.9  # Part of the step that the estimate of the error allows
_LEAST_FACTOR, _MOST_FACTOR = 0.2, 10.0  # Change of the step from one to the next
_FIRST_FACTOR = 3.5  # The first step, at most, over SciPy's, whose error is far below the tolerance
# Error, in tolerances, from which a step is divided at a kink: below, kinks are not its reason
_DIVIDED_ERROR = 0.2
_LEAST_STEP = 10.0  # Shortest step, in floating-point numbers


class NestedPiece(Piece):
    """A step of DOP853: a nested polynomial of the share and what is left of it."""

    method = "DOP853"

    def weights(self, shares: Array) -> Array:
        factors = np.empty((shares.size, _NESTED_ROWS))
        factors[:, ::2], factors[:, 1::2] = shares[:, None], 1.0 - shares[:, None]
        return factors.cumprod(axis=1)


class DividedPiece(NestedPiece):
    """A step of DOP853 that some trajectories divide at a kink."""

    def __init__(self, piece: NestedPiece, divided: DividedInterpolant) -> None:
        super().__init__((piece.t_old, piece.t), (piece.y_old, piece.y), piece.rows)
        self.divided = divided

    def at(self, times: Array, out: Array | None = None) -> Array:
        states = super().at(times, out)
        columns, shares = self.divided.columns, (times - self.t_old) / self.h
        places = np.tile(np.arange(columns.size), times.size)
        there, _ = self.divided(places, np.repeat(shares, columns.size), slopes=False)
        n = len(there)
        each = there.reshape(n, times.size, columns.size).swapaxes(0, 1)
        states.reshape(times.size, n, -1)[:, :, columns] = each
        return states


class StackedDOP853(Stepper, scipy.integrate.DOP853):  # type: ignore[misc]
    """Steps that suit every trajectory: the error is the largest of all, not their mean.

    Of ``smooth`` rates the first step is longer than SciPy's: nothing hides between its stages.
    """

    t: float
    y: Array
    _dense: NestedPiece | None = None
    _divided: DividedSteps | None = None
    _weights = np.stack([scipy.integrate.DOP853.E5, scipy.integrate.DOP853.E3])

    def __init__(
        self,
        rates: Rates,
        start: float,
        states: Array,
        end: float,
        tolerances: Tolerances,
        control: DefectControl | None = None,
        kinks: Kinks | None = None,
        smooth: bool = False,
    ) -> None:
        self.kinks = kinks
        super().__init__(rates, start, states, end, tolerances, control)
        if smooth:
            steps = math.ceil((end - start) / min(_FIRST_FACTOR * self.h_abs, self.max_step))
            self.h_abs = (end - start) / steps

    def _step_impl(self) -> tuple[bool, str | None]:
        """A step whose error is within the tolerance, shorter than the last one if it must be."""
        t, y, shortest = self.t, self.y, _LEAST_STEP * float(np.spacing(abs(self.t)))
        h, refused = min(max(self.h_abs, shortest), self.max_step), False
        while h >= shortest:
            end = min(t + h, self.t_bound)
            h = end - t
            y_new, f_new = self._stages(h)
            scale = self.atol + np.maximum(np.abs(y), np.abs(y_new)) * self.rtol
            errors = h * self._errors(scale)
            divided = None if self.kinks is None else self._divided_steps(h, y_new, errors)
            if divided is not None:
                y_new, f_new = divided.into(y_new, f_new)
                errors[divided.columns] = divided.errors
            error = float(errors.max())
            factor = _SAFETY * error**self.error_exponent if error else _MOST_FACTOR
            if error < 1.0:
                self.h_abs = h * min(factor, 1.0 if refused else _MOST_FACTOR)
                self.h_previous, self.y_old = h, y
                self.t, self.y, self.f = end, y_new, f_new
                self._divided = divided
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

    def _errors(self, scale: Array) -> Array:
        """The errors of a step over its length, in units of ``scale``, of each trajectory (m,)."""
        errors = np.square(self._weights @ self.K / scale)
        fifth, third = errors.reshape(2, self.trajectory_states, -1).sum(axis=1)
        below = np.sqrt((fifth + 0.01 * third) * self.trajectory_states)
        return np.asarray(fifth / np.where(below > 0.0, below, 1.0))

    def _divided_steps(self, h: float, y_new: Array, errors: Array) -> DividedSteps | None:
        """The steps of trajectories whose errors a kink makes large, divided there.

        None where others are as large, or the kinks were not found.
        """
        rough = np.flatnonzero(~(errors <= _DIVIDED_ERROR))
        if not rough.size or self.kinks is None:
            return None
        shape = self.trajectory_states, -1
        heights, step = self.kinks.heights(rough), np.full(rough.size, self.t)
        old, new = self.y.reshape(shape), y_new.reshape(shape)
        last = heights(step + h, new[:, rough])
        crossed, which = crossed_once(heights(step, old[:, rough]), last)
        columns = rough[crossed]
        others = np.delete(errors, columns)
        if not columns.size or not np.all(others < 1.0):
            return None
        heights, each = self.kinks.heights(columns), np.arange(columns.size)
        return divided_steps(
            columns,
            self.fun.of(columns),
            lambda times, states: heights(times, states)[which, each],
            (self.t, h, old[:, columns], self.f.reshape(shape)[:, columns]),
            last[which, crossed],
            (self.rtol, self.atol.reshape(shape)[:, columns]),
        )

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
            piece = NestedPiece((self.t_old, self.t), (before, self.y), rows)
            divided = None if self._divided is None else self._divided.interpolant()
            self._dense = piece if divided is None else DividedPiece(piece, divided)
        return self._dense

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:  # a nested polynomial
        n, dense = self.trajectory_states, self.dense_output()
        coefficients = dense.rows.reshape(len(dense.rows), n, -1)[:, :, columns]
        start = dense.y_old.reshape(n, -1)[:, columns]

        def evaluate(shares: Array, slopes: bool) -> tuple[Array, Array]:
            return nested(coefficients, start, shares, slopes)

        divided = dense.divided if isinstance(dense, DividedPiece) else None
        return evaluate if divided is None else divided.into(evaluate, columns)
