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

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, Cost, function_cost, in_pieces, inverse
from rankone.trajectories.integrator import Tolerances

# What only a step of Radau changes, except its factorisations
_RADAU_STATE = ("h_abs_old", "error_norm_old", "sol", "Z", "J", "current_jac")
# What a step changes, and a refused one changes back
_STEP_STATE = ("t", "t_old", "y", "f", "h_abs", "status", *_RADAU_STATE)
_BETWEEN_NODES = (0.4, 0.85)  # Shares of a step of Radau at which its interpolant is checked
_MOST_INTERPOLATION_ERROR = 10.0  # Accepted error of Radau's interpolant, in tolerances
_SHORTENING = 0.2  # Part of a step tried next after a large defect: stops before what was missed
_MOST_CROSSING_DEFECT = 100.0  # At crossings, times the step, in tolerances; smooth: to 40
_MOST_RANDOM_DEFECT = 300.0  # The same at random places: the largest of many is larger
_DIFFERENT_RATES = 0.5  # Defect over the rates from which a step missed something
_MOST_ROOT_ITERATIONS = 30  # Most iterations for the time of a crossing; about ten suffice
_ROOT_ACCURACY = 1e-14  # Accuracy of that time, in steps: a few roundings
_LEAST_PLACES = 2  # Fewest random places on each trajectory in every step
_PLACES = 512  # Random places on all trajectories: one evaluation of the rates takes them well
_PRODUCT_COST = Cost(40.0, 0.5)  # Operations of a matrix times a vector: once, and for each entry
_LOOK_COST = Cost(50e3, 15.0)  # Operations of evaluating an interpolant: once, and for each state

# Stacked rates (n m,) at a time and a stacked state
Rates: TypeAlias = Callable[[float, Array], Array]
# Maps shares (c,) of a step, and whether slopes are needed, to the states (n, c) of c trajectories
# and their slopes over the share
Interpolant: TypeAlias = "Callable[[Array, bool], tuple[Array, Array]]"


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
        missed = self.control is not None and self.control.missed(self, y_before)
        return _SHORTENING if missed else 1.0

    def _restart(self, h: float) -> None:
        self.h_abs = h


class StackedDOP853(Stepper, scipy.integrate.DOP853):  # type: ignore[misc]
    """Steps that suit every trajectory: the error is the largest of all, not their mean."""

    _dense: scipy.integrate.DenseOutput | None = None
    _weights = np.stack([scipy.integrate.DOP853.E5, scipy.integrate.DOP853.E3])

    def _estimate_error_norm(self, K: Array, h: float, scale: Array) -> float:
        """SciPy's norm (Hairer, Nørsett & Wanner, II.10) of each trajectory, the largest of all."""
        errors = np.square(self._weights @ K / scale)
        fifth, third = errors.reshape(2, self.trajectory_states, -1).sum(axis=1)
        below = np.sqrt((fifth + 0.01 * third) * self.trajectory_states)
        return float(abs(h) * np.max(fifth / np.where(below > 0.0, below, 1.0)))

    def dense_output(self) -> scipy.integrate.DenseOutput:
        """SciPy's dense output, made once for each step."""
        if self._dense is None or self._dense.t != self.t or self._dense.t_old != self.t_old:
            self._dense = super().dense_output()
        return self._dense

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:  # a nested polynomial
        n, dense = self.trajectory_states, self.dense_output()
        coefficients = dense.F.reshape(len(dense.F), n, -1)[:, :, columns]
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
        interpolant = self.sol
        powers = share ** np.arange(interpolant.order + 1)
        state = interpolant.y_old + interpolant.Q @ (share * powers)
        slope = interpolant.Q @ (powers * np.arange(1, powers.size + 1)) / interpolant.h
        defect = slope - self.fun(interpolant.t_old + share * interpolant.h, state)
        error = self._solve(self._newton, defect) / (self.atol + np.abs(state) * self.rtol)
        square = np.square(error).reshape(self.trajectory_states, -1).mean(axis=0).max()
        return math.sqrt(square) if math.isfinite(square) else math.inf

    def error_of(self, defect: Array, columns: NDArray[np.intp]) -> Array:
        """The defect divided by the Newton matrices."""
        right = defect.T[:, :, None] / self.sol.h
        return np.asarray(np.matmul(self._newton[columns], right)[:, :, 0].T)

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:  # powers of the share
        n, exponents = self.trajectory_states, np.arange(self.sol.order + 1)
        coefficients = self.sol.Q.reshape(n, -1, exponents.size)[:, columns]
        start = self.sol.y_old.reshape(n, -1)[:, columns]

        def evaluate(shares: Array, slopes: bool) -> tuple[Array, Array]:
            powers = shares[:, None] ** exponents
            y = start + (coefficients * (shares[:, None] * powers)).sum(axis=2)
            return y, (coefficients * (powers * (exponents + 1))).sum(axis=2) if slopes else y

        return evaluate

    @staticmethod
    def _solve(inverses: Array, right: Array) -> Array:
        m, n, _ = inverses.shape
        charge(5.0 * CALL + m * _PRODUCT_COST(n * n))
        solved = np.matmul(inverses, right.reshape(n, m).T[:, :, None])[:, :, 0]
        return np.ascontiguousarray(solved.T).ravel()


class DefectControl:
    """Looks for peaks and pulses of the rates over the states between the stages of a step.

    It looks where trajectories cross state surfaces and, with ``anywhere``, at random places too.
    """

    def __init__(self, system: System, points: Array, anywhere: bool) -> None:
        self.rates, self.features = system.rhs, system.features
        self.parameters = np.ascontiguousarray(points.T)
        self.places = max(_LEAST_PLACES, _PLACES // len(points)) if anywhere else 0
        self.generator = np.random.default_rng(20142)
        users = system.user_functions
        self.rates_cost = function_cost(system.rhs, users)
        self.surfaces_cost = function_cost(system.features.state_surfaces, users)

    def missed(self, solver: Stepper, y_before: Array) -> bool:
        """Whether the last step of a solver missed something; ``y_before`` (n m,) is its start."""
        surfaces = self.features.n_state_surfaces
        if surfaces and self._at_crossings(solver, y_before) > _MOST_CROSSING_DEFECT:
            return True
        return self.places > 0 and self._at_random(solver) > _MOST_RANDOM_DEFECT

    def _at_random(self, solver: Stepper) -> float:
        """Largest error that a defect at random places amounts to, in tolerances."""
        m, h = self.parameters.shape[1], solver.t - solver.t_old
        columns = np.tile(np.arange(m), self.places)
        charge(self.rates_cost(columns.size) + _LOOK_COST(solver.y.size // m * columns.size))
        shares = self.generator.random(columns.size)
        states, slopes = solver.interpolant(columns)(shares, True)
        rates = self.rates(solver.t_old + h * shares, states, self.parameters[:, columns])
        error = np.abs(solver.error_of(slopes - h * rates, columns))
        return _largest(error / _tolerated(solver, states))

    def _at_crossings(self, solver: Stepper, y_before: Array) -> float:
        """Largest defect at the crossings of state surfaces, times the step, in tolerances.

        The defect midway between two crossings counts too. Trajectories may stay in a peak or pulse
        longer than the step says: there a defect as large as the rates counts times all the time
        that is left. The error estimate sees a kink, unless it belongs to a peak: there a smaller
        defect does not count.
        """
        m, before, h = self.parameters.shape[1], solver.t_old, solver.t - solver.t_old
        surfaces, n_peaks = self.features.state_surfaces, self.features.n_peaks
        charge(2.0 * self.surfaces_cost(m))
        start = surfaces(before, y_before.reshape(-1, m), self.parameters)
        end = surfaces(solver.t, solver.y.reshape(-1, m), self.parameters)
        columns, which = np.nonzero((start * end < 0.0).T)
        if not columns.size:
            return 0.0
        interpolant, p = solver.interpolant(columns), self.parameters[:, columns]
        tolerated = _tolerated(solver, solver.y.reshape(-1, m))
        look = _LOOK_COST(len(tolerated) * columns.size)

        def distance(shares: Array) -> Array:
            charge(self.surfaces_cost(columns.size) + look)
            heights = surfaces(before + h * shares, interpolant(shares, False)[0], p)
            return np.asarray(heights[which, np.arange(columns.size)])

        def largest(shares: Array, narrow: NDArray[np.bool_], kink: NDArray[np.bool_]) -> float:
            charge(self.rates_cost(columns.size) + 2.0 * look)
            states, slopes = interpolant(shares, True)
            rates = h * self.rates(before + h * shares, states, p)
            defect = np.abs(rates - slopes)
            unknown = defect > _DIFFERENT_RATES * np.maximum(np.abs(rates), np.abs(slopes))
            defect[kink & ~unknown] = 0.0
            defect = np.where(narrow & unknown, (solver.t_bound - before) / h * defect, defect)
            return _largest(defect / tolerated)

        shares = roots(distance, start[which, columns], end[which, columns])
        narrow = which < n_peaks + self.features.n_kinks
        worst = largest(shares, narrow, narrow & (which >= n_peaks))
        again = np.diff(columns, prepend=-1) == 0
        if again.any():
            shares = shares[np.lexsort((shares, columns))]
            between = np.where(again, 0.5 * (shares + np.roll(shares, 1)), shares)
            worst = max(worst, largest(between, again, np.zeros_like(again)))
        return worst


def _tolerated(solver: Stepper, states: Array) -> Array:
    """The tolerance for the largest of the absolute values (n, c) of each state, (n, 1)."""
    absolute = solver.atol.reshape(len(states), -1).max(axis=1)
    return np.asarray(absolute + solver.rtol * np.abs(states).max(axis=1))[:, None]


def _largest(errors: Array) -> float:
    return float(np.nan_to_num(errors, nan=np.inf).max())


def roots(function: Callable[[Array], Array], start: Array, end: Array) -> Array:
    """Roots in [0, 1] of functions that change sign from ``start`` to ``end`` (Illinois method)."""
    a, b, x = np.zeros_like(start), np.ones_like(end), np.full_like(start, np.nan)
    side: NDArray[np.bool_] | None = None
    for _ in range(_MOST_ROOT_ITERATIONS):
        before, x = x, np.clip((a * end - b * start) / (end - start), a, b)
        if np.all(np.abs(x - before) <= _ROOT_ACCURACY):
            break
        height = function(x)
        left = height * start > 0.0
        weight = 1.0 if side is None else np.where(left == side, 0.5, 1.0)
        side = left
        a, b, old_start, old_end = np.where(left, x, a), np.where(left, b, x), start, end
        start = np.where(left, height, weight * old_start)
        end = np.where(left, weight * old_end, height)
        exact = height == 0.0
        if exact.any():
            a, b = np.where(exact, x, a), np.where(exact, x, b)
            start, end = np.where(exact, -1.0, start), np.where(exact, 1.0, end)
    return np.asarray(np.clip((a * end - b * start) / (end - start), a, b))
