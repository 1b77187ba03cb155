"""Where experiments come to rest: steady states, with their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.calibration.dynamics import Dynamics
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.errors import BlowUpError, ConvergenceError, ProblemError
from rankone.trajectories.integrator import Spans, Tolerances
from rankone.trajectories.single import SingleIntegrator
from rankone.trajectories.steady.rest import SteadyStates, from_states

_SETTLE = 1e8  # Longest time to a steady state, in horizons
_LATER = (1.0, 1e3)  # Horizons after which rates at rest have to be the same
_SAME_RATES = 1e-9  # Their change, over the largest rate of change of any state
COARSE = 1e-3  # Relative tolerance of trajectories that tell how large states become
_ABSOLUTE = 1e-3  # Absolute tolerance of a search, over the relative one times a state's size


@dataclass(frozen=True)
class Started:
    """Experiments at the start: points (E, d), directions (E, d, w), states (n, E), (n, w, E)."""

    points: Array
    directions: Array
    states: Array
    slopes: Array

    def some(self, which: Sequence[int]) -> Started:
        return Started(
            self.points[which],
            self.directions[which],
            self.states[:, which],
            self.slopes[:, :, which],
        )


class Resting:
    """Brings experiments to their steady states."""

    def __init__(self, dynamics: Dynamics) -> None:
        self.dynamics = dynamics

    def __call__(self, started: Started, which: Sequence[int], quick: bool) -> Started:
        """Where some experiments come to rest."""
        follow = self._followed if quick else None
        some = started.some(list(which))
        states, slopes = some.states.copy(), some.slopes.copy()
        horizon = self.dynamics.system.horizon[1]
        for k in range(len(some.points)):
            moved = np.concatenate([some.points[k], some.states[:, k]])
            system = self._starting(moved, _SETTLE * horizon)
            steady = SteadyStates(system, horizon, _SETTLE * horizon, follow=follow)
            self._check_rest(some.points[k], some.states[:, k])
            try:
                states[:, k] = steady(moved[:, None])[:, 0]
            except (ConvergenceError, BlowUpError) as error:
                raise ConvergenceError(
                    f"no steady state is reached: {error.message}",
                    remedy="the parameters are probably far from those of the data",
                ) from None
            self._check_rest(some.points[k], states[:, k])
            if slopes.shape[1]:
                slopes[:, :, k] = self._slopes_at_rest(steady, some, k, states[:, k])
        return replace(some, states=states, slopes=slopes)

    def _followed(
        self, states: Array, points: Array, start: float, end: float
    ) -> tuple[Array, Array]:
        """States at the end of trajectories, one by one; see :class:`SteadyStates`."""
        ends, largest = states.copy(), np.abs(states)
        for k, point in enumerate(points):
            span = Spans(np.array([start]), states[:, [k]], np.array([end]))
            at = point[None, : len(self.dynamics.inputs)]
            tolerances = search_tolerances(states[:, k], COARSE)
            (path,) = SingleIntegrator().paths(self.dynamics.system, at, span, tolerances)
            if path.end < end:
                raise BlowUpError(f"a trajectory blows up at t = {path.end:.6g}", time=path.end)
            ends[:, k], largest[:, k] = path.state, path.largest()
        return ends, largest

    def _starting(self, moved: Array, end: float) -> System:
        """The system that starts at the states behind the parameters."""
        whole = from_states(self.dynamics.system, (0.0, end))
        names = (*whole.parameters, *(f"{name}(0)" for name in whole.states))
        box = tuple((float(x), float(x)) for x in moved)
        return replace(whole, parameters=names, box=box)

    def _check_rest(self, point: Array, states: Array) -> None:
        """Raise if rates at rest depend on the time."""
        system, columns = self.dynamics.system, (states[:, None], point[:, None])
        horizon = system.horizon[1]
        rates = [system.rhs(at, *columns) for at in (0.0, *(f * horizon for f in _LATER))]
        sizes = np.abs(states).max(initial=0.0) / horizon
        if np.abs(np.diff(np.stack(rates), axis=0)).max(initial=0.0) > _SAME_RATES * sizes:
            raise ProblemError(
                "rates at a steady state depend on the time",
                remedy="give a condition before the start in which nothing depends on the time",
            )

    def _slopes_at_rest(self, steady: SteadyStates, some: Started, k: int, states: Array) -> Array:
        """Derivatives (n, w) of a steady state: rates vanish and conserved sums are kept."""
        dynamics, point = self.dynamics, some.points[k]
        n = len(states)
        jacobian = dynamics.system.jacobian(0.0, states[:, None], point[:, None])
        matrix = np.broadcast_to(jacobian, (n, n, 1))[:, :, 0]
        forced = dynamics.rate_slopes(np.zeros(1), states[:, None], point[None])[:, :, 0]
        kept = steady.conserved(np.concatenate([point, some.states[:, k]])[:, None])[:, :, 0]
        left = np.concatenate([matrix, kept])
        right = np.concatenate([-forced @ some.directions[k], kept @ some.slopes[:, :, k]])
        rows = np.abs(left).max(axis=1, keepdims=True)
        rows = np.where(rows > 0.0, rows, 1.0)
        return np.asarray(np.linalg.lstsq(left / rows, right / rows, rcond=None)[0])


def search_tolerances(state: Array, accuracy: float) -> Tolerances:
    """Those of a search: relative to each state's size, the largest one for those that are zero."""
    sizes = np.abs(state)
    sizes = np.where(sizes > 0.0, sizes, sizes.max(initial=0.0) or 1.0)
    return Tolerances.down_to(accuracy, _ABSOLUTE * sizes[:, None])
