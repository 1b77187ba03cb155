"""Trajectories at many parameter points, integrated together as one stacked system by SciPy.

DOP853, or Radau where a trajectory is stiff, with the generated pointwise right-hand side.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
import scipy.integrate
import scipy.sparse

from rankone.arrays import Array
from rankone.deadline import check_time
from rankone.discretization.radau import inset
from rankone.system import System

__all__ = ["Recorder", "Stack", "initial_values", "quickest"]

_FIRST_PROBES, _PROBE_STEPS = (10, 15, 20, 30), 100
"""DOP853 steps after which it is asked whether stability limits the step, first and then."""
_AHEAD = (0.0, 1e-12, 1e-9, 1e-6, 1e-4)
"""Relative changes of the states after which rates are asked for, to find those not finite."""
_STUCK, _LEAST = 1000, 1e-9
"""So many steps one after the other below this part of the horizon are the end of a trajectory."""
_STIFF_PRODUCT = 3.0
"""Step times decay rate above which it does (stability ends at about 6)."""

_STATE = ("t", "y", "f", "h_abs", "h_abs_old", "error_norm_old", "sol", "Z", "J", "current_jac")
"""What a step of Radau changes beside its factorisations."""
_BETWEEN = (0.4, 0.85)
"""Where between the nodes of Radau, in steps, its interpolant is looked at."""
_INTERPOLATED = 10.0
"""Largest error of the interpolant, in units of the tolerance."""
_IMPLICIT = 1.7
"""Tolerance of Radau over that of DOP853 for about the same error: its estimate is cautious."""
_LOW_DEGREE = 4
"""Degree of rates, in the unknowns, up to which nothing is narrower than the unknowns change."""


class Recorder(Protocol):
    """Takes notice of the steps of an integration."""

    def begin(self, start: float) -> None:
        """An integration begins, perhaps anew with another method."""

    def add(self, solver: Any) -> None:
        """A step was made."""


class StackedDOP853(scipy.integrate.DOP853):  # type: ignore[misc]
    """Steps that suit every trajectory: the error is the largest of all, not their mean.

    Parameters
    ----------
    states : int
        States of one trajectory; the stacked vector is in the order (state, trajectory).
    """

    def __init__(self, *arguments: Any, states: int, **options: Any) -> None:
        self._states, self._weights = states, np.stack([self.E5, self.E3])
        super().__init__(*arguments, **options)

    def _estimate_error_norm(self, K: Array, h: float, scale: Array) -> float:
        """As SciPy's (Hairer, Nørsett & Wanner, II.10), for each trajectory."""
        errors = np.square(self._weights @ K / scale)
        fifth, third = errors.reshape(2, self._states, -1).sum(axis=1)
        below = np.sqrt((fifth + 0.01 * third) * self._states)
        return float(abs(h) * np.max(fifth / np.where(below > 0.0, below, 1.0)))


class StackedRadau(scipy.integrate.Radau):  # type: ignore[misc]
    """Radau IIA with a Jacobian of one block for each trajectory, inverted all at once.

    Parameters
    ----------
    blocks : callable
        Jacobians (m, n, n) at a time and a stacked state.
    between : sequence of float
        Shares of a step at which the interpolant is looked at.
    """

    def __init__(
        self,
        *arguments: Any,
        blocks: Callable[[float, Array], Array],
        between: Sequence[float] = _BETWEEN,
        **options: Any,
    ) -> None:
        self._blocks, self._between = blocks, between
        self._newton: Any = None
        super().__init__(*arguments, **options)
        self.J = blocks(self.t, self.y)
        self.I = np.eye(self.J.shape[1])
        self.lu, self.solve_lu = self._inverted, self._solve

    def _inverted(self, matrix: Any) -> Any:
        """Inverses; those of the real matrix of the Newton iteration are kept for the check."""
        inverse = np.asarray(np.linalg.inv(matrix))
        if np.isrealobj(inverse):
            self._newton = inverse
        return inverse

    def _validate_jac(self, *_: Any) -> Any:
        """The Jacobian as a function; what stands in for its first value is not used."""
        return lambda t, y, f=None: self._blocks(t, y), scipy.sparse.csc_matrix((self.n, self.n))

    def _step_impl(self) -> tuple[bool, str | None]:
        """A step as SciPy's, made again and shorter while its interpolant is off between nodes.

        With h far above a stiff time scale the estimate of the error sees the nodes only. The
        defect of the interpolant, divided by the matrix of the Newton iteration, is its error.
        """
        if not self._between:
            return super()._step_impl()  # type: ignore[no-any-return]
        before = {name: getattr(self, name) for name in _STATE}
        while True:
            done, message = super()._step_impl()
            if not done:
                return done, message
            h = self.t - before["t"]
            error = max(self._interpolation_error(share) for share in self._between)
            if error <= _INTERPOLATED or h <= 1e3 * np.spacing(max(abs(self.t), abs(before["t"]))):
                return done, message
            check_time()
            wanted = h * max(0.1, 0.8 * (_INTERPOLATED / error) ** 0.25)
            for name, value in before.items():
                setattr(self, name, value)
            self.h_abs, self.LU_real, self.LU_complex = wanted, None, None

    def _interpolation_error(self, share: float) -> float:
        """Largest error of a trajectory at a share of the step, in units of the tolerance."""
        interpolant = self.sol
        h = interpolant.h
        t = interpolant.t_old + share * h
        powers = share ** np.arange(interpolant.order + 1)
        state = interpolant.y_old + interpolant.Q @ (share * powers)
        defect = interpolant.Q @ (powers * np.arange(1, powers.size + 1)) / h - self.fun(t, state)
        scaled = self._solve(self._newton, defect) / (self.atol + np.abs(state) * self.rtol)
        square = np.square(scaled).reshape(len(self.I), -1).mean(axis=0).max()
        return math.sqrt(square) if math.isfinite(square) else math.inf

    @staticmethod
    def _solve(inverses: Array, right: Array) -> Array:
        m, n, _ = inverses.shape
        solved = np.matmul(inverses, right.reshape(n, m).T[:, :, None])[:, :, 0]
        return np.ascontiguousarray(solved.T).ravel()


@dataclass(frozen=True)
class Stack:
    """The system at several parameter points.

    Attributes
    ----------
    system : System
    points : ndarray (m, d)
    edges : sequence of float
        Start, times at which the integration is begun anew, end.
    """

    system: System
    points: Array
    edges: Sequence[float]

    @property
    def shape(self) -> tuple[int, int]:
        """Number of states, number of points."""
        return self.system.N_DIFFERENTIAL, len(self.points)

    @property
    def polynomial(self) -> bool:
        """Whether the rates are polynomials of low degree, with no functions of time.

        Then nothing is so narrow that it hides between the stages of a step.
        """
        system, start = self.system, self.edges[0]
        if not system.SEPARATED or len(system.time_factors(np.array([start]))) > 1:
            return False
        return max((len(states) for *_, states in system.TERMS), default=0) <= _LOW_DEGREE

    def run(
        self,
        recorder: Recorder,
        rtol: float,
        atol: Array,
        stiff: bool = False,
        max_step: float = math.inf,
        bearable: int = 0,
    ) -> tuple[Array, float]:
        """Integrate until the end or a failure.

        Parameters
        ----------
        recorder : Recorder
        rtol : float
        atol : ndarray (n, 1)
        stiff : bool
            Whether to begin with Radau; otherwise it is taken where DOP853 meets stiffness.
        max_step : float
            Longest step.
        bearable : int
            So many steps of DOP853 are made although stability limits them; in between they are
            less accurate then.

        Returns
        -------
        state : ndarray (n, m)
            After the last step.
        left : float
            Steps that DOP853 would still have made when it was given up for Radau; 0 if it was not.
        """
        n, m = self.shape
        absolute = np.broadcast_to(atol, (n, m)).ravel()
        steps = {"max_step": max_step}
        left = math.inf
        with np.errstate(all="ignore"):
            if not stiff:
                explicit = partial(StackedDOP853, states=n, rtol=rtol, atol=absolute, **steps)
                met = partial(self._met_stiffness, bearable=bearable)
                state, left = self._steps(explicit, recorder, met)
                if not left:
                    return state, left
            loose = {"rtol": _IMPLICIT * rtol, "atol": _IMPLICIT * absolute}
            between = () if self.polynomial else _BETWEEN
            implicit = partial(StackedRadau, blocks=self._blocks, between=between, **loose, **steps)
            state, _ = self._steps(implicit, recorder, lambda solver, count: 0.0)
        return state, left

    def _steps(
        self, method: Any, recorder: Recorder, give_up: Callable[[Any, int], float]
    ) -> tuple[Array, float]:
        """Step over all segments: the last state, and the steps left if the method is given up."""
        state = initial_values(self.system, np.ascontiguousarray(self.points.T))
        recorder.begin(self.edges[0])
        count = stuck = 0
        least = _LEAST * (self.edges[-1] - self.edges[0])
        for a, b in itertools.pairwise(self.edges):
            solver = method(self._right_hand_side(a, b), a, state.ravel(), b)
            while solver.status == "running":
                solver.step()
                check_time()
                if solver.status == "failed":
                    return state, 0.0
                recorder.add(solver)
                stuck = stuck + 1 if solver.step_size < least else 0
                if stuck == _STUCK:
                    return np.asarray(solver.y.reshape(self.shape)), 0.0
                state, count = solver.y.reshape(self.shape), count + 1
                left = give_up(solver, count)
                if left:
                    return state, left
        return state, 0.0

    def _right_hand_side(self, a: float, b: float) -> Callable[[float, Array], Array]:
        """The stacked right-hand side on a segment; factors are never taken at its very ends."""
        rhs, shape = self.system.rhs, self.shape
        parameters = np.ascontiguousarray(self.points.T)
        if len(self.edges) == 2:
            return lambda t, y: rhs(t, y.reshape(shape), parameters).ravel()
        near = inset(a, b)
        least, most = a + near, b - near
        return lambda t, y: rhs(min(max(t, least), most), y.reshape(shape), parameters).ravel()

    def _met_stiffness(self, solver: Any, count: int, bearable: int) -> float:
        """The steps left, if they are more than bearable and stability limits them; or 0.

        It does by the fastest rate of decay at the present state.
        """
        if count not in _FIRST_PROBES and count % _PROBE_STEPS:
            return 0.0
        left = (self.edges[-1] - solver.t) / solver.step_size
        blocks = self._blocks(solver.t, solver.y)
        if left <= bearable or not np.isfinite(blocks).all():
            return 0.0
        decay = float(-np.linalg.eigvals(blocks).real.min())
        return left if decay * solver.step_size > _STIFF_PRODUCT else 0.0

    def _blocks(self, t: float, y: Array) -> Array:
        """Jacobian of each trajectory, (m, n, n)."""
        n, m = self.shape
        jacobian = self.system.jacobian(t, y.reshape(n, m), self.points.T)
        return np.moveaxis(np.broadcast_to(jacobian, (n, n, m)), 2, 0)


def quickest(system: System, time: float, state: Array, points: Array, floor: Any) -> int:
    """The trajectory of a stack, state (n, m) at points (m, d), that is the first to have no end.

    The one whose rates are the first not to be finite a little later, or the one that changes
    fastest in its size; ``floor`` is a size below which states do not count.
    """
    with np.errstate(all="ignore"):
        rates = system.rhs(time, state, points.T)
        for step in _AHEAD:
            later = system.rhs(time, state + step * np.abs(state) * np.sign(rates), points.T)
            lost = ~np.isfinite(later).all(axis=0)
            if lost.any():
                return int(np.argmax(lost))
        speeds = np.abs(rates) / np.maximum(np.abs(state), floor)
    return int(np.argmax(np.nan_to_num(speeds, nan=np.inf).max(axis=0)))


def initial_values(system: System, parameters: Array) -> Array:
    """Initial states at parameter points (d, m): shape (n, m)."""
    if not system.SEPARATED:
        with np.errstate(all="ignore"):
            return system.initial(parameters)
    m = parameters.shape[1]
    rows = [system.parameter_factors(j, parameters[j]) for j in range(len(parameters))]
    values = np.zeros((system.N_DIFFERENTIAL, m))
    for coefficient, state, factors in system.INITIAL:
        product = np.full(m, coefficient)
        for row, index in zip(rows, factors, strict=True):
            product = product * row[index]
        values[state] += product
    return values
