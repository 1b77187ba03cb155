"""Trajectories at many parameter points, integrated together as one stacked system by SciPy.

DOP853, or Radau where a trajectory is stiff, with the generated pointwise right-hand side.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np

from rankone.discretization.radau import inset
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import Cost, eigenvalues, function_cost, in_pieces
from rankone.trajectories.defects import DefectControl
from rankone.trajectories.steppers import StackedDOP853, StackedRadau

__all__ = ["NUMBERS_LEFT", "Recorder", "Stack", "quickest"]

_FIRST_PROBES, _PROBE_STEPS = (10, 15, 20, 30), 100
"""DOP853 steps after which it is asked whether stability limits the step, first and then."""
_AHEAD = (0.0, 1e-12, 1e-9, 1e-6, 1e-4)
"""Relative changes of the states after which rates are asked for, to find those not finite."""
_STUCK, _LEAST = 1000, 1e-9
"""So many steps one after the other below this part of the horizon are the end of a trajectory."""
NUMBERS_LEFT = 100
"""Floating-point numbers to the end of a segment from which it is reached."""
_STIFF_PRODUCT = 3.0
"""Step times decay rate above which it does (stability ends at about 6)."""
_REFUSALS = 10
"""Refused steps after which it is asked as well."""
_IMPLICIT = 1.7
"""Tolerance of Radau over that of DOP853 for about the same error: its estimate is cautious."""
_LOW_DEGREE = 4
"""Degree of rates, in the unknowns, up to which nothing is narrower than the unknowns change."""
_ENTRY = 10.0
"""Operations for each entry of a stack of Jacobians that is made or read."""
_STAGE, _STEP = Cost(8e3, 5.0), Cost(40e3, 5.0)
"""What an integrator does for each evaluation of the rates, and for each step besides: operations
for a stack, and for each number of its state."""


class Recorder(Protocol):
    """Takes notice of the steps of an integration."""

    def begin(self, start: float) -> None:
        """An integration begins, perhaps anew with another method."""

    def add(self, solver: Any) -> None:
        """A step was made."""


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
        return self.system.n_differential, len(self.points)

    @cached_property
    def costs(self) -> tuple[float, float]:
        """Operations of an evaluation of the rates in a step, and of their Jacobians."""
        n, m = self.shape
        system = self.system
        rates = function_cost(system.rhs, system.user_functions)
        jacobian = function_cost(system.jacobian, system.user_functions)
        return rates(m) + _STAGE(n * m), jacobian(m) + _ENTRY * n * n * m

    @property
    def polynomial(self) -> bool:
        """Whether the rates are polynomials of low degree, with no functions of time.

        Then nothing is so narrow that it hides between the stages of a step.
        """
        system, start = self.system, self.edges[0]
        if not system.separated or len(system.time_factors(np.array([start]))) > 1:
            return False
        return max((len(states) for *_, states in system.terms), default=0) <= _LOW_DEGREE

    def run(
        self,
        recorder: Recorder,
        rtol: float,
        atol: Array,
        stiff: bool = False,
        max_step: float = math.inf,
        bearable: int = 0,
        watched: bool = False,
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
        watched : bool
            Whether steps are looked at at random places too for what may be narrow over the
            states, and not only where that is known. Systems that separate are polynomials in
            their states, of limited degree: there is nothing narrow over them.

        Returns
        -------
        state : ndarray (n, m)
            After the last step.
        left : float
            Steps that DOP853 would still have made when it was given up for Radau; 0 if it was not.
        """
        n, m = self.shape
        absolute = np.broadcast_to(atol, (n, m)).ravel()
        watch = None if self.system.separated else DefectControl(self.system, self.points, watched)
        steps: dict[str, Any] = {"max_step": max_step, "states": n, "watch": watch}
        left = math.inf
        with np.errstate(all="ignore"):
            if not stiff:
                explicit = partial(StackedDOP853, rtol=rtol, atol=absolute, **steps)
                met = partial(self._met_stiffness, bearable=bearable)
                state, left = self._steps(explicit, recorder, met)
                if not left:
                    return state, left
            loose: dict[str, Any] = {"rtol": _IMPLICIT * rtol, "atol": _IMPLICIT * absolute}
            implicit = partial(
                StackedRadau,
                blocks=self.jacobians,
                looks_between=not self.polynomial,
                **loose,
                **steps,
            )
            state, _ = self._steps(implicit, recorder, lambda solver, count: 0.0)
        return state, left

    def _steps(
        self, method: Any, recorder: Recorder, give_up: Callable[[Any, int], float]
    ) -> tuple[Array, float]:
        """Step over all segments: the last state, and the steps left if the method is given up."""
        state = self.system.initial(np.ascontiguousarray(self.points.T))
        recorder.begin(self.edges[0])
        count = stuck = 0
        least = _LEAST * (self.edges[-1] - self.edges[0])
        for a, b in itertools.pairwise(self.edges):
            state = self._jumped(a, state)
            if a != self.edges[0] and not self._goes_on(a, state):
                return state, 0.0
            solver = method(self._right_hand_side(a, b), a, state.ravel(), b)
            while solver.status == "running":
                charge(_STEP(state.size))
                solver.step()
                if solver.status == "failed":
                    if b - solver.t <= NUMBERS_LEFT * np.spacing(abs(b)):
                        break  # SciPy makes no step of so few floating-point numbers
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

    def _jumped(self, time: float, state: Array) -> Array:
        """The states after what is reset at a time, if anything is."""
        kind = self.system.jumps.kind_at(time)
        if kind is None:
            return state
        return self.system.jumps.jumped(kind, state, np.ascontiguousarray(self.points.T))

    def _goes_on(self, time: float, state: Array) -> bool:
        """Whether states, perhaps after a jump, and their rates are finite."""
        if self.system.jumps.kind_at(time) is None:
            return True
        rates = self.system.rhs(time, state, np.ascontiguousarray(self.points.T))
        return bool(np.isfinite(state).all() and np.isfinite(rates).all())

    def _right_hand_side(self, a: float, b: float) -> Callable[[float, Array], Array]:
        """The stacked right-hand side on a segment; factors are never taken at its very ends."""
        rhs, shape = self.system.rhs, self.shape
        parameters = np.ascontiguousarray(self.points.T)
        near = inset(a, b) if len(self.edges) > 2 else 0.0
        least, most = a + near, b - near
        cost, _ = self.costs

        def rates(t: float, y: Array) -> Array:
            charge(cost)
            return rhs(min(max(t, least), most), y.reshape(shape), parameters).ravel()

        return rates

    def _met_stiffness(self, solver: Any, count: int, bearable: int) -> float:
        """The steps left, if they are more than bearable and stability limits them; or 0.

        It does by the fastest rate of decay at the present state. The estimate of the error lets
        unstable steps pass while what they amplify is small; the watch refuses them, and a fifth of
        their length is stable. So the length that was refused counts.
        """
        if count not in _FIRST_PROBES and count % _PROBE_STEPS and solver.refusals < _REFUSALS:
            return 0.0
        longest = solver.longest_tried()
        left = (self.edges[-1] - solver.t) / solver.step_size
        if left <= bearable:
            return 0.0
        blocks = self.jacobians(solver.t, solver.y)
        if not np.isfinite(blocks).all():
            return 0.0
        return left if _decays_faster(blocks, _STIFF_PRODUCT / longest) else 0.0

    def jacobians(self, t: float, y: Array) -> Array:
        """Jacobian of each trajectory at the states (n m,) or (n, m): shape (m, n, n)."""
        n, m = self.shape
        charge(self.costs[1])
        jacobian = self.system.jacobian(t, y.reshape(n, m), self.points.T)
        return np.moveaxis(np.broadcast_to(jacobian, (n, n, m)), 2, 0)


def _decays_faster(blocks: Array, rate: float) -> bool:
    """Whether some matrix (n, n) of a stack has an eigenvalue with a real part below ``-rate``."""
    size = blocks.shape[-1]
    cost = eigenvalues(size)
    for some in in_pieces(blocks, cost):
        charge(_ENTRY * some.size)
        bounds = np.abs(some).sum(axis=2).max(axis=1)  # no eigenvalue is larger
        suspicious = some[bounds > rate]
        charge(cost * len(suspicious))
        if -np.linalg.eigvals(suspicious).real.min(initial=0.0) > rate:
            return True
    return False


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
