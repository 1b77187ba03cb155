"""SciPy's integrators for stacked trajectories, with steps that suit every trajectory.

Steps are made again, and shorter, where their interpolant is wrong between the stages, which the
estimate of the error does not see. Where it runs through something narrow in between, its slope
differs from the rates there: the defect. Defects are looked at between the nodes of Radau, where
trajectories cross state surfaces, and at random places.

SciPy has no public way to take the largest error of all trajectories, or a Jacobian of blocks:
``_estimate_error_norm`` and ``_validate_jac`` are overridden for that alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import scipy.integrate
import scipy.sparse
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, Cost, in_pieces, inverse
from rankone.trajectories.defects import SHORTENING, DefectControl, Interpolant
from rankone.trajectories.integrator import Tolerances

# What only a step of Radau changes, except its factorisations
_RADAU_STATE = ("h_abs_old", "error_norm_old", "sol", "Z", "J", "current_jac")
# What a step changes, and a refused one changes back
_STEP_STATE = ("t", "t_old", "y", "f", "h_abs", "status", *_RADAU_STATE)
_BETWEEN_NODES = (0.4, 0.85)  # Shares of a step of Radau at which its interpolant is checked
_MOST_INTERPOLATION_ERROR = 10.0  # Accepted error of Radau's interpolant, in tolerances
_NESTED_ROWS = 7  # Rows of a step of DOP853
_EXPONENTS = np.arange(1, 4)  # Powers of the rows of a step of Radau
_PRODUCT_COST = Cost(40.0, 0.5)  # Operations of a matrix times a vector: once, and for each entry

# Stacked rates (n m,) at a time and a stacked state
Rates: TypeAlias = Callable[[float, Array], Array]


class Piece(scipy.integrate.DenseOutput):  # type: ignore[misc]
    """A step as a function of time: its start, and ``rows`` (k, n m) weighted by polynomials."""

    def __init__(self, t_old: float, t: float, y_old: Array, rows: Array) -> None:
        super().__init__(t_old, t)
        self.h, self.y_old, self.rows = t - t_old, y_old, rows

    @staticmethod
    def weights(shares: Array) -> Array:
        """Weights (T, k) of the rows at shares (T,) of a step."""
        raise NotImplementedError

    def at(self, times: Array) -> Array:
        """States at times (T,), stacked: (T, n m)."""
        states = np.matmul(self.weights((times - self.t_old) / self.h), self.rows)
        states += self.y_old
        return np.asarray(states)

    def _call_impl(self, t: Array) -> Array:
        return self.at(np.atleast_1d(t)).T.reshape(-1, *t.shape)


class NestedPiece(Piece):
    """A step of DOP853: a nested polynomial of the share and what is left of it."""

    @staticmethod
    def weights(shares: Array) -> Array:
        factors = np.empty((shares.size, _NESTED_ROWS))
        factors[:, ::2], factors[:, 1::2] = shares[:, None], 1.0 - shares[:, None]
        return factors.cumprod(axis=1)


class PowerPiece(Piece):
    """A step of Radau: powers of the share."""

    @staticmethod
    def weights(shares: Array) -> Array:
        return shares[:, None] ** _EXPONENTS


class Stepper(scipy.integrate.OdeSolver):  # type: ignore[misc]
    """Steps that are made again where they missed something.

    The stacked state is in the order (state, trajectory); ``states`` (n, m) are those at the start.
    ``refusals`` counts the steps made again since the last call of :meth:`longest_tried`.
    """

    def __init__(
        self,
        rates: Rates,
        start: float,
        states: Array,
        end: float,
        tolerances: Tolerances,
        control: DefectControl | None = None,
    ) -> None:
        self.trajectory_states, self.control = len(states), control
        self.refusals, self._longest_refused = 0, 0.0
        absolute = np.broadcast_to(tolerances.absolute, states.shape).ravel()
        steps = {"rtol": tolerances.relative, "max_step": tolerances.longest_step}
        super().__init__(rates, start, states.ravel(), end, atol=absolute, **steps)
        self.fun = rates  # without SciPy's checks and counts in between

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:
        """The trajectories of some columns within the last step."""
        raise NotImplementedError

    def error_of(self, defect: Array, columns: NDArray[np.intp]) -> Array:
        """The error that a defect (n, c), times the step, of some trajectories amounts to."""
        return defect

    def longest_tried(self) -> float:
        """The longest of the last step and of those refused since the last call."""
        longest = max(self.step_size, self._longest_refused)
        self.refusals, self._longest_refused = 0, 0.0
        return float(longest)

    def step(self) -> str | None:
        """Make a step as SciPy does, again and shorter while it misses something."""
        members = self.__dict__
        before = {name: members[name] for name in _STEP_STATE if name in members}
        while True:
            message: str | None = super().step()
            if self.status == "failed":
                return message
            h = self.t - before["t"]
            shortening = self._shortening(before["y"])
            if shortening >= 1.0 or h <= 1e3 * np.spacing(max(abs(self.t), abs(before["t"]))):
                return message
            self.refusals, self._longest_refused = self.refusals + 1, max(self._longest_refused, h)
            self.__dict__.update(before)
            self._restart(h * shortening)

    def _shortening(self, y_before: Array) -> float:
        """Part of the step to try next; one if the step is good."""
        missed = self.control is not None and self.control.missed(self, y_before).any()
        return SHORTENING if missed else 1.0

    def _restart(self, h: float) -> None:
        self.h_abs = h


class StackedDOP853(Stepper, scipy.integrate.DOP853):  # type: ignore[misc]
    """Steps that suit every trajectory: the error is the largest of all, not their mean."""

    _dense: NestedPiece | None = None
    _weights = np.stack([scipy.integrate.DOP853.E5, scipy.integrate.DOP853.E3])

    def _estimate_error_norm(self, K: Array, h: float, scale: Array) -> float:
        """SciPy's norm (Hairer, Nørsett & Wanner, II.10) of each trajectory, the largest of all."""
        errors = np.square(self._weights @ K / scale)
        fifth, third = errors.reshape(2, self.trajectory_states, -1).sum(axis=1)
        below = np.sqrt((fifth + 0.01 * third) * self.trajectory_states)
        return float(abs(h) * np.max(fifth / np.where(below > 0.0, below, 1.0)))

    def dense_output(self) -> NestedPiece:
        """SciPy's dense output, made once for each step."""
        if self._dense is None or self._dense.t != self.t or self._dense.t_old != self.t_old:
            dense = super().dense_output()
            self._dense = NestedPiece(dense.t_old, dense.t, dense.y_old, dense.F)
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
        self.J = blocks(self.t, self.y)
        self.I = np.eye(self.J.shape[1])
        self.lu, self.solve_lu = self._inverses, self._solve

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
        return lambda t, y, f=None: self._blocks(t, y), scipy.sparse.csc_matrix((self.n, self.n))

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
