"""Implicit steps of stacked trajectories: Radau IIA, with a Jacobian for each trajectory.

SciPy's Radau has no public way to take a Jacobian of blocks: ``_validate_jac`` is overridden for
that alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy.integrate
import scipy.sparse
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, Cost, in_pieces, inverse
from rankone.trajectories.defects import DefectControl, Interpolant
from rankone.trajectories.integrator import Tolerances, finite_blocks
from rankone.trajectories.steppers import Piece, Rates, Stepper

_BETWEEN_NODES = (0.4, 0.85)  # Shares of a step at which its interpolant is checked
_MOST_INTERPOLATION_ERROR = 10.0  # Accepted error of the interpolant, in tolerances
_EXPONENTS = np.arange(1, 4)  # Powers of the rows of a step
_PRODUCT_COST = Cost(40.0, 0.5)  # Operations of a matrix times a vector: once, and for each entry


class PowerPiece(Piece):
    """A step of Radau: powers of the share."""

    @staticmethod
    def weights(shares: Array) -> Array:
        return shares[:, None] ** _EXPONENTS


class StackedRadau(Stepper, scipy.integrate.Radau):  # type: ignore[misc]
    """Radau IIA with a Jacobian of one block for each trajectory, inverted all at once.

    If h is far above a stiff time scale, the error estimate sees the nodes only. The defect of the
    interpolant, divided by the Newton matrix, is its error in between: ``looks_between`` says
    whether to check it. ``blocks`` maps a time and a stacked state to Jacobians (m, n, n).
    """

    def __init__(
        self,
        rates: Rates,
        start: float,
        states: Array,
        end: float,
        tolerances: Tolerances,
        control: DefectControl | None,
        blocks: Callable[[float, Array], Array],
        looks_between: bool = True,
    ) -> None:
        self._blocks, self._shares = blocks, _BETWEEN_NODES if looks_between else ()
        super().__init__(rates, start, states, end, tolerances, control)
        self.J = self._jacobians(self.t, self.y)
        self.I = np.eye(self.J.shape[1])
        self.lu, self.solve_lu = self._inverses, self._solve

    def _jacobians(self, t: float, y: Array) -> Array:
        """Jacobians, zero where they are not finite.

        The derivative of a root at zero is infinite, and Newton's corrections vanish however wrong
        the state is. Without a Jacobian they converge in short steps.
        """
        return finite_blocks(self._blocks(t, y))

    def _inverses(self, matrices: Array) -> Array:
        """Inverses; keeps those of the real Newton matrices for the check of the interpolant."""
        real = np.isrealobj(matrices)
        cost = inverse(matrices.shape[-1], real)
        inverses = np.empty_like(matrices)
        first = 0
        for some in in_pieces(matrices, cost):
            charge(cost * len(some))
            inverses[first : first + len(some)] = np.linalg.inv(some)
            first += len(some)
        if real:
            self._newton = inverses
        return inverses

    def _compute_dense_output(self) -> PowerPiece:
        dense = super()._compute_dense_output()
        return PowerPiece(dense.t_old, dense.t, dense.y_old, dense.Q.T)

    def _validate_jac(self, jac: object, sparsity: object) -> tuple[object, object]:
        """The Jacobian as a function, and an empty matrix that SciPy needs and nothing uses."""
        return lambda t, y, f=None: self._jacobians(t, y), scipy.sparse.csc_matrix((self.n, self.n))

    def _shortening(self, y_before: Array) -> float:
        error = max(map(self._interpolation_error, self._shares), default=0.0)
        if error > _MOST_INTERPOLATION_ERROR:
            factor = 0.8 * (_MOST_INTERPOLATION_ERROR / error) ** 0.25
            return float(max(0.1, factor))
        return super()._shortening(y_before)

    def _restart(self, h: float) -> None:
        self.h_abs, self.LU_real, self.LU_complex = h, None, None

    def _interpolation_error(self, share: float) -> float:
        """Largest error of a trajectory at a share of the step, in units of the tolerance."""
        piece: PowerPiece = self.sol
        state = piece.y_old + share**_EXPONENTS @ piece.rows
        slope = (_EXPONENTS * share ** (_EXPONENTS - 1)) @ piece.rows / piece.h
        defect = slope - self.fun(piece.t_old + share * piece.h, state)
        error = self._solve(self._newton, defect) / (self.atol + np.abs(state) * self.rtol)
        square = np.square(error).reshape(self.trajectory_states, -1).mean(axis=0).max()
        return math.sqrt(square) if math.isfinite(square) else math.inf

    def error_of(self, defect: Array, columns: NDArray[np.intp]) -> Array:
        """The defect divided by the Newton matrices."""
        right = defect.T[:, :, None] / self.sol.h
        return np.asarray(np.matmul(self._newton[columns], right)[:, :, 0].T)

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:  # powers of the share
        n = self.trajectory_states
        coefficients = self.sol.rows.T.reshape(n, -1, _EXPONENTS.size)[:, columns]
        start = self.sol.y_old.reshape(n, -1)[:, columns]

        def evaluate(shares: Array, slopes: bool) -> tuple[Array, Array]:
            powers = shares[:, None] ** (_EXPONENTS - 1)
            y = start + (coefficients * (shares[:, None] * powers)).sum(axis=2)
            return y, (coefficients * (powers * _EXPONENTS)).sum(axis=2) if slopes else y

        return evaluate

    @staticmethod
    def _solve(inverses: Array, right: Array) -> Array:
        m, n, _ = inverses.shape
        charge(5.0 * CALL + m * _PRODUCT_COST(n * n))
        solved = np.matmul(inverses, right.reshape(n, m).T[:, :, None])[:, :, 0]
        return np.ascontiguousarray(solved.T).ravel()
