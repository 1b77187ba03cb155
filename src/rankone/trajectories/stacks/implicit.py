"""Implicit steps of stacked trajectories: Radau IIA, with a Jacobian for each trajectory.

The method, its test of convergence and its estimate of the error are SciPy's (Hairer & Wanner,
Solving Ordinary Differential Equations II, IV.8). Newton's iterations are made here: the rates at
all nodes are one call for all trajectories, and the Newton matrices serve several steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.integrate
import scipy.sparse
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.tensors.time_grid import RadauCollocation
from rankone.trajectories.integrators.defects import DefectControl, Interpolant
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.stacks import explicit
from rankone.trajectories.stacks.newton import Jacobians, NewtonMatrices, PairedMatrices

_BETWEEN_NODES = (0.4, 0.85)  # Shares of a step at which its interpolant is checked
_MOST_INTERPOLATION_ERROR = 10.0  # Accepted error of the interpolant, in tolerances
_MOST_ITERATIONS = 6  # Newton's iterations of a step of three stages before it is halved
_LENGTH_RATIO = 1.3  # Ratio of the lengths of steps that share Newton matrices
_KEPT_FACTOR = 3.0  # Growth of the step below which its length stays while its matrices serve


@dataclass(frozen=True)
class _Scheme:
    """Radau IIA of some stages, an odd number, in modes that Newton's matrices do not couple.

    ``to_nodes`` takes modes to nodes and ``to_modes`` back, and ``of_modes`` is the derivative of
    modes. The first mode has the ``real`` eigenvalue, each two others are the real and the
    imaginary part of one with a complex eigenvalue, of the ``paired``. ``to_powers`` takes states
    at the nodes to powers of the share, and ``to_start`` to minus the slope at the start that
    slopes at the nodes extrapolate to.
    """

    nodes: Array
    to_nodes: Array
    of_modes: Array
    to_modes: Array
    real: float
    paired: tuple[complex, ...]
    to_powers: Array
    to_start: Array

    @staticmethod
    @cache
    def of(stages: int) -> _Scheme:
        """The scheme, made once."""
        collocation = RadauCollocation.of(stages)
        nodes, derivative = collocation.nodes, collocation.derivative
        eigenvalues, vectors = np.linalg.eig(derivative)
        real = int(np.argmin(np.abs(eigenvalues.imag)))
        columns = [(vectors[:, real] / vectors[-1, real]).real]
        for paired in np.argsort(eigenvalues.imag, kind="stable")[: stages // 2]:
            vector = vectors[:, paired] / vectors[-1, paired]
            columns += [vector.real, -vector.imag]
        to_nodes = np.stack(columns, axis=1)
        of_modes = np.linalg.solve(to_nodes, derivative @ to_nodes)
        pairs = range(1, stages, 2)
        start = np.linalg.solve(np.vander(nodes, increasing=True).T, np.eye(stages)[0])
        return _Scheme(
            nodes,
            to_nodes,
            of_modes,
            np.linalg.inv(to_nodes),
            float(of_modes[0, 0]),
            tuple(complex(of_modes[k, k], of_modes[k + 1, k]) for k in pairs),
            np.asarray(np.linalg.inv(nodes[:, None] ** _exponents(stages)), dtype=float),
            np.asarray(-start @ derivative),
        )

    @property
    def stages(self) -> int:
        return self.nodes.size

    @property
    def most_iterations(self) -> int:
        """Newton's iterations of a step before it is halved."""
        return _MOST_ITERATIONS + 2 * (self.stages - 3)

    @property
    def power(self) -> float:
        """The power of the length of a step that its error is proportional to, inverted."""
        return 1.0 / (self.stages + 1)


def _exponents(stages: int) -> NDArray[np.intp]:
    """Powers of the rows of a step."""
    return np.arange(1, stages + 1)


class PowerPiece(explicit.Piece):
    """A step of Radau: powers of the share."""

    method = "Radau"

    def weights(self, shares: Array) -> Array:
        return explicit.powers_of(shares, len(self.rows))

    @property
    def exponents(self) -> NDArray[np.intp]:
        """Powers of the rows."""
        return _exponents(len(self.rows))


@dataclass
class _Newton:
    """Newton's matrices of a step: those of the real and of the paired modes.

    Later steps of a similar length take them as well. They are made at the time ``t`` for steps of
    the length ``h``; ``fresh`` counts the iterations of the first step, and ``excess`` those that
    later ones needed beyond, and those of the further steps that their length makes necessary.
    """

    t: float
    h: float
    jacobians: Jacobians
    real: NewtonMatrices
    paired: PairedMatrices
    fresh: int = 0
    excess: float = 0.0

    @staticmethod
    def of(t: float, h: float, jacobians: Jacobians, scheme: _Scheme) -> _Newton:
        real = jacobians.newton(scheme.real / h)
        paired = jacobians.paired([mode / h for mode in scheme.paired])
        return _Newton(t, h, jacobians, real, paired)

    def serves(self, h: float) -> bool:
        """Whether to try them for a step of this length."""
        similar = 1.0 / _LENGTH_RATIO <= h / self.h <= _LENGTH_RATIO
        return similar and self.excess < self.jacobians.iterations

    def count(self, iterations: int) -> None:
        """Count the iterations of a step that converged."""
        self.fresh = self.fresh or iterations
        self.excess += max(iterations - self.fresh, 0)

    def keep(self, h: float, iterations: int, factor: float) -> bool:
        """Whether to stay with a length that may grow by a factor; count what that costs."""
        self.excess += iterations * (1.0 - 1.0 / factor)
        return self.serves(h)

    def error(self, h: float, defect: Array) -> Array:
        """The error of a step of length h that a defect amounts to.

        Of matrices for a shorter step the errors of slow modes are too small.
        """
        return max(1.0, h / self.h) * self.real.solve(defect)


def _mean(scaled: Array) -> float:
    """The root of the mean square."""
    flat = scaled.ravel()
    return math.sqrt(float(np.dot(flat, flat)) / flat.size)


@dataclass(frozen=True)
class Collocation:
    """How a step of Radau is taken: the Jacobians of its Newton matrices, and its stages."""

    blocks: Callable[[float, Array], Jacobians]
    looks_between: bool = True
    stages: int = 3


class StackedRadau(explicit.Stepper, scipy.integrate.Radau):  # type: ignore[misc]
    """Radau IIA with a Jacobian of one block for each trajectory.

    If h is far above a stiff time scale, the error estimate sees the nodes only. The defect of the
    interpolant, divided by the Newton matrix, is its error in between: ``looks_between`` says
    whether to check it. With more ``stages`` steps are longer, most of all at tight tolerances, and
    each takes a further Newton matrix for two of them. ``blocks`` maps a time and a stacked state
    to Jacobians.
    """

    t: float
    y: Array
    h_abs_old: float | None
    error_norm_old: float | None

    def __init__(
        self,
        rates: explicit.Rates,
        span: tuple[float, float],
        states: Array,
        tolerances: Tolerances,
        control: DefectControl | None,
        collocation: Collocation,
    ) -> None:
        self._scheme = _Scheme.of(collocation.stages)
        self._blocks = collocation.blocks
        self._shares = _BETWEEN_NODES if collocation.looks_between else ()
        super().__init__(rates, span, states, tolerances, control)
        start, end = span
        h = min(self.h_abs, self.max_step, end - start)
        self._newton = _Newton.of(start, h, self._blocks(start, self.y), self._scheme)

    def _validate_jac(self, jac: object, sparsity: object) -> tuple[None, object]:
        """No Jacobian, and an empty matrix that SciPy needs and nothing uses."""
        return None, scipy.sparse.csc_matrix((self.n, self.n))

    def _step_impl(self) -> tuple[bool, str | None]:
        """A step whose error is within the tolerance, shorter than the last one if it must be."""
        t, y, shortest = self.t, self.y, explicit.LEAST_STEP * float(np.spacing(abs(self.t)))
        h, before = self.h_abs, (self.h_abs_old, self.error_norm_old)
        if not shortest <= h <= self.max_step:
            h, before = min(max(h, shortest), self.max_step), (None, None)
        refused = again = False
        while h >= shortest:
            end = min(t + h, self.t_bound)
            h = end - t
            if (solved := self._collocated(h)) is None:
                h, again = 0.5 * h, True
                continue
            states, iterations = solved
            error = self._error(h, states, refused)
            most = self._scheme.most_iterations
            safety = explicit.SAFETY * (2 * most + 1) / (2 * most + iterations)
            factor = safety * _predicted_factor(self._scheme.power, h, error, *before)
            factor = max(explicit.LEAST_FACTOR, factor)  # the least if not a number
            factor = min(factor, explicit.MOST_FACTOR)
            if not error <= 1.0:
                h *= factor
                refused = again = True
                continue
            if again:  # a longer one would have to be tried again as well
                factor = min(factor, 1.0)
            elif 1.0 <= factor < _KEPT_FACTOR and self._newton.keep(h, iterations, factor):
                factor = 1.0
            self.h_abs_old, self.error_norm_old, self.h_abs = h, error, h * factor
            self.t_old, self.t, self.y = t, end, y + states[-1]
            self.sol = PowerPiece((t, end), (y, self.y), self._scheme.to_powers @ states)
            self.f = self.fun(end, self.y)
            return True, None
        return False, self.TOO_SMALL_STEP

    def _collocated(self, h: float) -> tuple[Array, int] | None:
        """Changes of the states to the nodes (stages, n m), and iterations.

        None without convergence. Matrices of earlier steps are tried first.
        """
        newton = self._newton
        if newton.serves(h):
            changes = self._iterated(h, newton)
            if changes is not None or (newton.t, newton.h) == (self.t, h):
                return changes
        current = newton.t == self.t
        jacobians = newton.jacobians if current else self._blocks(self.t, self.y)
        self._newton = _Newton.of(self.t, h, jacobians, self._scheme)
        return self._iterated(h, self._newton)

    def _iterated(self, h: float, newton: _Newton) -> tuple[Array, int] | None:
        """What Newton's iterations with some matrices converge to; see :meth:`_collocated`.

        The corrections of slow modes are too long with matrices for longer steps, and too short
        with those for shorter ones; those of fast modes are not. The relaxation is in the middle.
        """
        scheme, most = self._scheme, self._scheme.most_iterations
        y, times, relaxation = self.y, self.t + h * scheme.nodes, 2.0 / (1.0 + newton.h / h)
        to_right = relaxation * np.hstack([scheme.to_modes, scheme.of_modes / -h])
        scale = self.atol + np.abs(y) * self.rtol
        slopes, modes = both = np.empty((2, scheme.stages, self.n))
        modes[:] = self._predicted(times)
        states = np.dot(scheme.to_nodes, modes)
        corrections, before, rate = np.empty_like(modes), 0.0, 0.0
        for iteration in range(1, most + 1):
            slopes[:] = self.fun.at(times, y + states)
            right = np.dot(to_right, both.reshape(-1, self.n))
            corrections[0] = newton.real.solve(right[0])
            corrections[1:] = newton.paired.solve(right[1:])
            size = _mean(corrections / scale)
            if not math.isfinite(size):
                return None
            if iteration > 1:
                rate = size / before
                left = most + 1 - iteration
                if rate >= 1.0 or rate**left / (1.0 - rate) * size > self.newton_tol:
                    return None
            modes += corrections
            states = np.dot(scheme.to_nodes, modes)
            if not size or (iteration > 1 and rate / (1.0 - rate) * size < self.newton_tol):
                newton.count(iteration)
                return states, iteration
            before = size
        return None

    def _predicted(self, times: Array) -> Array:
        """The modes (stages, n m) that the last step continued to the nodes has there."""
        if self.sol is None:
            return np.zeros((self._scheme.stages, self.n))
        weights = self.sol.weights((times - self.sol.t_old) / self.sol.h)
        return np.asarray((self._scheme.to_modes @ (weights - 1.0)) @ self.sol.rows)

    def _error(self, h: float, states: Array, refused: bool) -> float:
        """The error of a step in tolerances, estimated more closely after a refusal.

        It is that of the slope at the start, seen from the changes to the nodes.
        """
        after = np.abs(self.y + states[-1])
        scale = self.atol + np.maximum(np.abs(self.y), after) * self.rtol
        slope = self._scheme.to_start / h @ states
        error = self._newton.error(h, self.f + slope)
        size = _mean(error / scale)
        if refused and size > 1.0:
            error = self._newton.error(h, self.fun(self.t, self.y + error) + slope)
            size = _mean(error / scale)
        return size

    def _shortening(self, y_before: Array) -> float:
        error = max(map(self._interpolation_error, self._shares), default=0.0)
        if error > _MOST_INTERPOLATION_ERROR:
            factor = (_MOST_INTERPOLATION_ERROR / error) ** self._scheme.power
            return float(max(explicit.LEAST_FACTOR, explicit.SAFETY * factor))
        return super()._shortening(y_before)

    def _interpolation_error(self, share: float) -> float:
        """Largest error of a trajectory at a share of the step, in units of the tolerance."""
        piece: PowerPiece = self.sol
        exponents = piece.exponents
        state = piece.y_old + share**exponents @ piece.rows
        slope = (exponents * share ** (exponents - 1)) @ piece.rows / piece.h
        defect = slope - self.fun(piece.t_old + share * piece.h, state)
        error = self._newton.error(piece.h, defect) / (self.atol + np.abs(state) * self.rtol)
        square = np.square(error).reshape(self.trajectory_states, -1).mean(axis=0).max()
        return math.sqrt(square) if math.isfinite(square) else math.inf

    def error_of(self, defect: Array, columns: NDArray[np.intp]) -> Array:
        """The defect divided by the Newton matrices."""
        return self._newton.real.solve_some(columns, defect / min(self.sol.h, self._newton.h))

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:  # powers of the share
        n, exponents = self.trajectory_states, self.sol.exponents
        coefficients = self.sol.rows.reshape(exponents.size, n, -1)[:, :, columns]
        start = self.sol.y_old.reshape(n, -1)[:, columns]

        def evaluate(shares: Array, slopes: bool) -> tuple[Array, Array]:
            powers = shares ** (exponents - 1).reshape(-1, *(1,) * shares.ndim)
            y = np.einsum("k...c,knc->n...c", shares * powers, coefficients)
            y += start.reshape(n, *(1,) * (shares.ndim - 1), -1)
            if not slopes:
                return y, y
            return y, np.einsum("k,k...c,knc->n...c", exponents, powers, coefficients)

        return evaluate


def _predicted_factor(
    power: float, h: float, error: float, h_old: float | None, error_old: float | None
) -> float:
    """The change of the step that brings the error to the tolerance (Gustafsson).

    The trend from the last step to this one counts if the error grows.
    """
    if not error:
        return math.inf
    trend = h / h_old * (error_old / error) ** power if h_old and error_old else 1.0
    return float(min(1.0, trend) * error**-power)
