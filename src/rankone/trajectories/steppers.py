"""SciPy's integrators for stacked trajectories, each step of which suits every one of them.

Steps are made again, and shorter, where their interpolant is wrong between the stages, which the
estimate of the error does not see.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.integrate
import scipy.sparse

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, in_pieces, inverse
from rankone.trajectories.defects import DefectControl

__all__ = ["StackedDOP853", "StackedRadau"]

_STATE = ("t", "y", "f", "h_abs", "h_abs_old", "error_norm_old", "sol", "Z", "J", "current_jac")
"""What a step changes, of both methods, beside the factorisations of Radau."""
_BETWEEN = (0.4, 0.85)
"""Where between the nodes of Radau, in steps, its interpolant is looked at."""
_INTERPOLATED = 10.0
"""Largest error of the interpolant, in units of the tolerance."""
_ENTRIES = 0.5
"""Operations for each entry of a matrix that a vector is multiplied by."""
_SHORTER = 0.2
"""Length of a step that is made again because something was overlooked."""


class _Stepper(scipy.integrate.OdeSolver):  # type: ignore[misc]
    """What both methods share: steps that can be made again.

    Parameters
    ----------
    states : int
        States of one trajectory; the stacked vector is in the order (state, trajectory).
    watch : DefectControl, optional
        Looks for what the stages of a step do not see.

    Attributes
    ----------
    refusals : int
        Steps that were made again since :meth:`longest_tried` was last asked for.
    """

    def __init__(
        self, *arguments: Any, states: int, watch: DefectControl | None = None, **options: Any
    ) -> None:
        self._states, self._watch = states, watch
        self.refusals, self._refused = 0, 0.0
        super().__init__(*arguments, **options)

    def longest_tried(self) -> float:
        """The longest of the last step and of those refused since this was last asked for."""
        longest = max(self.step_size, self._refused)
        self.refusals, self._refused = 0, 0.0
        return float(longest)

    def _step_impl(self) -> tuple[bool, str | None]:
        """A step as SciPy's, made again and shorter while something in it was overlooked."""
        before = {name: getattr(self, name) for name in _STATE if hasattr(self, name)}
        while True:
            done, message = super()._step_impl()
            if not done:
                return done, message
            h, self.t_old = self.t - before["t"], before["t"]
            shorter = self._shorter(before["y"])
            if shorter >= 1.0 or h <= 1e3 * np.spacing(max(abs(self.t), abs(before["t"]))):
                return done, message
            self.refusals, self._refused = self.refusals + 1, max(self._refused, h)
            for name, value in before.items():
                setattr(self, name, value)
            self._restart(h * shorter)

    def _shorter(self, y_before: Array) -> float:
        """By what factor the step is to be shorter; one if it is good."""
        missed = self._watch is not None and self._watch.missed(self, y_before)
        return _SHORTER if missed else 1.0

    def _restart(self, h: float) -> None:
        """Begin the step again with another length."""
        self.h_abs = h


class StackedDOP853(_Stepper, scipy.integrate.DOP853):  # type: ignore[misc]
    """Steps that suit every trajectory: the error is the largest of all, not their mean."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._weights = np.stack([self.E5, self.E3])
        self._dense: Any = None
        super().__init__(*arguments, **options)

    def _estimate_error_norm(self, K: Array, h: float, scale: Array) -> float:
        """As SciPy's (Hairer, Nørsett & Wanner, II.10), for each trajectory."""
        errors = np.square(self._weights @ K / scale)
        fifth, third = errors.reshape(2, self._states, -1).sum(axis=1)
        below = np.sqrt((fifth + 0.01 * third) * self._states)
        return float(abs(h) * np.max(fifth / np.where(below > 0.0, below, 1.0)))

    def _dense_output_impl(self) -> Any:
        """As SciPy's, once for each step."""
        if self._dense is None or self._dense.t != self.t or self._dense.t_old != self.t_old:
            self._dense = super()._dense_output_impl()
        return self._dense

    def error_of(self, defect: Array, columns: Array) -> Array:
        """What a defect (n, c), times the step, of some trajectories comes to."""
        return defect

    def interpolant(self, columns: Array) -> Callable[..., Any]:
        """Of some trajectories states (n, c) at shares (c,) of the step, and slopes if asked for.

        Slopes are derivatives over the share.
        """
        dense = self._dense_output_impl()
        parts = dense.F.reshape(len(dense.F), self._states, -1)[:, :, columns]
        start = dense.y_old.reshape(self._states, -1)[:, columns]

        def evaluate(x: Array, slopes: bool = False) -> Any:
            y, slope, rest = np.zeros_like(start), np.zeros_like(start), 1.0 - x
            for i, part in enumerate(parts[::-1]):
                y += part
                if slopes:
                    slope *= rest if i % 2 else x
                    slope += -y if i % 2 else y
                y *= rest if i % 2 else x
            y += start
            return (y, slope) if slopes else y

        return evaluate


class StackedRadau(_Stepper, scipy.integrate.Radau):  # type: ignore[misc]
    """Radau IIA with a Jacobian of one block for each trajectory, inverted all at once.

    With h far above a stiff time scale the estimate of the error sees the nodes only. The defect of
    the interpolant, divided by the matrix of the Newton iteration, is its error in between.

    Parameters
    ----------
    blocks : callable
        Jacobians (m, n, n) at a time and a stacked state.
    looks_between : bool
        Whether the interpolant is looked at between the nodes.
    """

    def __init__(
        self,
        *arguments: Any,
        blocks: Callable[[float, Array], Array],
        looks_between: bool = True,
        **options: Any,
    ) -> None:
        self._blocks, self._places = blocks, _BETWEEN if looks_between else ()
        self._newton: Any = None
        super().__init__(*arguments, **options)
        self.J = blocks(self.t, self.y)
        self.I = np.eye(self.J.shape[1])
        self.lu, self.solve_lu = self._inverted, self._solve

    def _inverted(self, matrix: Any) -> Any:
        """Inverses; those of the real matrix of the Newton iteration are kept for the check."""
        real = np.isrealobj(matrix)
        cost = inverse(matrix.shape[-1], real)
        inverses = np.empty_like(matrix)
        first = 0
        for some in in_pieces(matrix, cost):
            charge(cost * len(some))
            inverses[first : first + len(some)] = np.linalg.inv(some)
            first += len(some)
        if real:
            self._newton = inverses
        return inverses

    def _validate_jac(self, *_: Any) -> Any:
        """The Jacobian as a function; what stands in for its first value is not used."""
        return lambda t, y, f=None: self._blocks(t, y), scipy.sparse.csc_matrix((self.n, self.n))

    def _shorter(self, y_before: Array) -> float:
        error = max(map(self._interpolation_error, self._places), default=0.0)
        if error > _INTERPOLATED:
            return float(max(0.1, 0.8 * (_INTERPOLATED / error) ** 0.25))
        return super()._shorter(y_before)

    def _restart(self, h: float) -> None:
        self.h_abs, self.LU_real, self.LU_complex = h, None, None

    def _interpolation_error(self, share: float) -> float:
        """Largest error of a trajectory at a share of the step, in units of the tolerance."""
        interpolant = self.sol
        powers = share ** np.arange(interpolant.order + 1)
        state = interpolant.y_old + interpolant.Q @ (share * powers)
        slope = interpolant.Q @ (powers * np.arange(1, powers.size + 1)) / interpolant.h
        defect = slope - self.fun(interpolant.t_old + share * interpolant.h, state)
        error = self._solve(self._newton, defect) / (self.atol + np.abs(state) * self.rtol)
        square = np.square(error).reshape(self._states, -1).mean(axis=0).max()
        return math.sqrt(square) if math.isfinite(square) else math.inf

    def error_of(self, defect: Array, columns: Array) -> Array:
        """What a defect (n, c), times the step, of some trajectories comes to."""
        right = defect.T[:, :, None] / self.sol.h
        return np.asarray(np.matmul(self._newton[columns], right)[:, :, 0].T)

    def interpolant(self, columns: Array) -> Callable[..., Any]:
        """Of some trajectories states (n, c) at shares (c,) of the step, and slopes if asked for.

        Slopes are derivatives over the share.
        """
        n, order = self._states, self.sol.order
        parts = self.sol.Q.reshape(n, -1, order + 1)[:, columns]
        start = self.sol.y_old.reshape(n, -1)[:, columns]
        numbers = np.arange(order + 1)

        def evaluate(x: Array, slopes: bool = False) -> Any:
            powers = x[:, None] ** numbers
            y = start + (parts * (x[:, None] * powers)).sum(axis=2)
            return (y, (parts * (powers * (numbers + 1))).sum(axis=2)) if slopes else y

        return evaluate

    @staticmethod
    def _solve(inverses: Array, right: Array) -> Array:
        m, n, _ = inverses.shape
        charge(5.0 * CALL + m * (_ENTRIES * n * n + 40.0))
        solved = np.matmul(inverses, right.reshape(n, m).T[:, :, None])[:, :, 0]
        return np.ascontiguousarray(solved.T).ravel()
