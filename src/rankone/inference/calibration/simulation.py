"""States of a calibration problem at the times of its measurements, with derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.inference.calibration.calibrated_parameters import Assigned, Condition, Records
from rankone.inference.calibration.dynamics import Dynamics
from rankone.inference.calibration.experiment_conditions import Settings
from rankone.support.arrays import Array
from rankone.support.errors import BlowUpError, ConvergenceError, ProblemError
from rankone.support.wording import quote
from rankone.trajectories.integrators.integrator import DenseTrajectories, Spans, Tolerances
from rankone.trajectories.integrators.sensitivities import (
    Forcing,
    RateSlopes,
    Start,
    sensitive_path,
    sensitivities,
)
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.stacks.stack import StackedIntegrator
from rankone.trajectories.steady.rest import SteadyStates, from_states
from rankone.trajectories.system.system import System

_LEAST_SIZE = 1e-9  # Absolute tolerance of coarse trajectories, over the largest state and theirs
_SMALL_STATE = 1e-3  # Share of its size down to which a state has relative accuracy
# Ratio of a presumed size to that of a trajectory that need not be integrated again
_SAME_SIZE = 10.0
_TINY = 1e-250  # Floor of sizes
_MOST_RUNS = 4
_ALL_STEPS = 10**9  # More steps than any trajectory has


class Following:
    """Follows the experiments from their start."""

    def __init__(self, records: Records, dynamics: Dynamics) -> None:
        self.records, self.dynamics = records, dynamics

    def together(self, started: Started, grid: Array, accuracy: float) -> tuple[Array, Array]:
        """States (n, E, T) and derivatives (n, w, E, T) at ascending times."""
        (n, w, count), end = started.slopes.shape, float(grid.max(initial=0.0))
        if not end:
            states = np.repeat(started.states[:, :, None], grid.size, axis=2)
            return states, np.repeat(started.slopes[..., None], grid.size, axis=3)
        system = from_states(self.dynamics.system, (0.0, end))
        moved = np.concatenate([started.points, started.states.T], axis=1)
        edges = [0.0, *self._cuts(started.points, end), end]
        path = self._paths(system, moved, edges, accuracy)
        states = path(grid)
        if not w:
            return states, np.empty((n, 0, count, grid.size))
        directions = started.directions

        def rates(times: Array, at: Array, which: NDArray[np.intp]) -> Array:
            inner = self.dynamics.rate_slopes(times, at, started.points[which])
            return np.asarray(np.einsum("ndk,kdw->nwk", inner, directions[which]))

        inside = [t for t, _ in path.samples(_ALL_STEPS) if 0.0 < t < end]
        forcing = Forcing(rates, started.slopes)
        return states, sensitivities(system, moved, path, sorted({*edges, *inside}), forcing, grid)

    def _paths(
        self, system: System, moved: Array, edges: Sequence[float], accuracy: float
    ) -> DenseTrajectories:
        """All trajectories by implicit steps, each state to an accuracy relative to its size.

        Coarse trajectories tell the sizes.
        """
        integrator, relative = StackedIntegrator(stiff=True), COARSE
        n = system.n_differential
        largest = np.abs(moved[:, -n:]).max(axis=1, initial=0.0)
        tolerated = np.broadcast_to(
            _LEAST_SIZE * np.where(largest > 0.0, largest, 1.0), (n, len(moved))
        )
        for _ in range(_MOST_RUNS):
            path = integrator.run(system, moved, edges, Tolerances.down_to(relative, tolerated))
            if path.end < edges[-1]:
                raise self._ended(path, moved)
            sizes = _SMALL_STATE * path.largest
            enough = relative == accuracy and (tolerated <= _SAME_SIZE * sizes + _TINY).all()
            if enough:
                break
            relative, tolerated = accuracy, np.maximum(sizes, _TINY)
        return path

    def each(self, started: Started, grid: Array, accuracy: float) -> tuple[Array, Array]:
        """The states one by one, for a search; NaN at times at which nothing was measured."""
        (n, w, count), system = started.slopes.shape, self.dynamics.system
        states = np.full((n, count, grid.size), np.nan)
        slopes = np.full((n, w, count, grid.size), np.nan)
        for e, point in enumerate(started.points):
            times = self._times_of(e)
            if not times.size:
                continue
            start = Start(started.states[:, e], started.slopes[:, :, e])
            last = float(times[-1])
            at = sensitive_path(
                system,
                point,
                [0.0, *self._cuts(point[None], last), last],
                search_tolerances(start.state, accuracy),
                times,
                start,
                self._rate_slopes(point, started.directions[e]),
            )
            reached = np.isfinite(at.states).all(axis=1)
            if not reached.all():
                raise self._stopped(e, point, float(times[reached].max(initial=0.0)))
            places = np.searchsorted(grid, times)
            states[:, e, places] = at.states.T
            slopes[:, :, e, places] = np.moveaxis(at.slopes, 0, 2)
        return states, slopes

    def _times_of(self, experiment: int) -> Array:
        """The finite times at which anything is measured in an experiment, ascending."""
        series = self.records.series
        times = np.concatenate([each.times[each.experiments == experiment] for each in series])
        return np.unique(times[np.isfinite(times)])

    def _rate_slopes(self, point: Array, directions: Array) -> RateSlopes:
        """Derivatives of rates along directions (d, w) at a point (d,)."""

        def slopes(times: Array, states: Array) -> Array:
            points = np.broadcast_to(point, (times.size, point.size))
            inner = self.dynamics.rate_slopes(times, states, points)
            return np.asarray(np.tensordot(directions, inner, (0, 1)).swapaxes(0, 1))

        return slopes

    def _cuts(self, points: Array, end: float) -> list[float]:
        """Times inside the horizon at which rates may jump, at any of the points."""
        features = self.dynamics.system.features
        times = [float(at) for at in features.cuts[0]]
        for at, period in features.periodic_cuts[0]:
            times += (at + period * np.arange(-(at // period), (end - at) // period + 1)).tolist()
        if features.n_moving_cuts:
            times += np.ravel(features.moving_cuts(np.ascontiguousarray(points.T))).tolist()
        return sorted({at for at in times if 0.0 < at < end})

    def _ended(self, path: DenseTrajectories, moved: Array) -> BlowUpError:
        """The error for a trajectory that does not reach the last measurement."""
        sizes = np.abs(path.state) / np.where(path.largest > 0.0, path.largest, 1.0)
        which = int(np.argmax(np.nan_to_num(sizes.max(axis=0), nan=np.inf)))
        return self._stopped(which, moved[which], path.end)

    def _stopped(self, which: int, point: Array, time: float) -> BlowUpError:
        """The error for an experiment whose trajectory stops at a time."""
        experiment = self.records.experiments[which]
        return BlowUpError(
            f"the trajectory of {quote(experiment.name)} cannot be continued beyond t = {time:.6g}",
            time=time,
            parameters=dict(zip(self.dynamics.inputs, point.tolist(), strict=False)),
            remedy="the parameters are probably far from those of the data",
        )


# -----------------------------------------------------------------------------
# Where experiments come to rest: steady states, with their derivatives.


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


# -----------------------------------------------------------------------------
# States of a calibration problem at the times of its measurements, with their derivatives.


@dataclass(frozen=True)
class States:
    """States (n, m) at m measurements, and derivatives (n, m, w) by w values; none are asked for
    where w is zero."""

    states: Array
    slopes: Array


class Simulation:
    """Simulates the experiments of a calibration problem, all at once."""

    def __init__(self, records: Records, settings: Settings, dynamics: Dynamics) -> None:
        self.records, self.settings, self.dynamics = records, settings, dynamics
        self._resting, self._following = Resting(dynamics), Following(records, dynamics)

    def states(
        self,
        values: Mapping[str, float],
        by: Sequence[str],
        accuracy: float,
        *,
        quick: bool = False,
    ) -> list[States]:
        """The states at the measurements of each series, with derivatives by some parameters.

        ``values`` are those of all parameters of the table. Where it has to be ``quick``, each
        experiment has steps of its own, and only LSODA's word for its accuracy.

        Raises
        ------
        BlowUpError, ConvergenceError
            If a trajectory does not reach the last measurement, or no steady state.
        """
        self.check_smooth(by)
        started = self._started(values, by, quick)
        pairs = [(series, np.isfinite(series.times)) for series in self.records.series]
        grid = np.unique(np.concatenate([series.times[f] for series, f in pairs]))
        follow = self._following.each if quick else self._following.together
        path, slopes = follow(started, grid, accuracy)
        resting = sorted({int(e) for series, f in pairs for e in series.experiments[~f]})
        at_rest = self._resting(started, resting, quick)
        each = []
        for series, here in pairs:
            n, w = len(started.states), len(by)
            states, own = np.empty((n, here.size)), np.empty((n, w, here.size))
            which, places = series.experiments[here], np.searchsorted(grid, series.times[here])
            states[:, here], own[:, :, here] = path[:, which, places], slopes[:, :, which, places]
            last = [resting.index(int(e)) for e in series.experiments[~here]]
            states[:, ~here], own[:, :, ~here] = at_rest.states[:, last], at_rest.slopes[:, :, last]
            each.append(States(states, np.moveaxis(own, 1, 2)))
        return each

    def check_smooth(self, by: Sequence[str]) -> None:
        """Raise if a parameter that derivatives are asked for decides where rates jump."""
        if by and self.dynamics.jumps_with_states:
            raise ProblemError(
                "rates jump with the states, and cannot be differentiated yet",
                remedy="ask for the objective alone",
            )
        for condition in self.settings.conditions:
            numbers = self.settings.at[condition.name]
            for name in sorted(self.dynamics.decisive):
                if numbers[name] in by:
                    raise ProblemError(
                        f"rates jump where {quote(name)} says, and it is estimated: nothing can be "
                        "differentiated by it yet",
                        term=numbers[name],
                        remedy="fix it (estimate 0 in the parameter table)",
                    )

    def _point(self, condition: Condition, values: Mapping[str, float]) -> Array:
        numbers = self.settings.at[condition.name]

        def number(assigned: Assigned) -> float:
            return values[assigned] if isinstance(assigned, str) else assigned

        return np.array([number(numbers[name]) for name in self.dynamics.inputs], dtype=float)

    def _directions(self, condition: Condition, by: Sequence[str]) -> Array:
        """Derivatives (d, w) of the inputs by the values of parameters."""
        numbers = self.settings.at[condition.name]
        assigned = [numbers[name] for name in self.dynamics.inputs]
        return np.array([[float(a == name) for name in by] for a in assigned]).reshape(
            len(assigned), len(by)
        )

    def _initial(
        self, conditions: Sequence[Condition], values: Mapping[str, float], by: Sequence[str]
    ) -> Started:
        """Conditions at their initial values."""
        points = np.array([self._point(c, values) for c in conditions])
        directions = np.array([self._directions(c, by) for c in conditions])
        states = self.dynamics.system.initial(np.ascontiguousarray(points.T))
        slopes = np.zeros((len(states), len(by), len(points)))
        if by:
            inner = self.dynamics.initial_slopes(points)
            slopes = np.einsum("ndm,mdw->nwm", inner, directions)
        return Started(points, directions, states, slopes)

    def _started(self, values: Mapping[str, float], by: Sequence[str], quick: bool) -> Started:
        """All experiments at time 0."""
        experiments = self.records.experiments
        started = self._initial([each.condition for each in experiments], values, by)
        befores = {e.before.name: e.before for e in experiments if e.before is not None}
        if not befores:
            return started
        before = self._initial([*befores.values()], values, by)
        rested = self._resting(before, range(len(befores)), quick)
        states, slopes, names = started.states.copy(), started.slopes.copy(), [*befores]
        for e, experiment in enumerate(experiments):
            if experiment.before is None:
                continue
            k = names.index(experiment.before.name)
            kept = ~self._reset(experiment.condition)
            states[kept, e], slopes[kept, :, e] = rested.states[kept, k], rested.slopes[kept, :, k]
        return replace(started, states=states, slopes=slopes)

    def _reset(self, condition: Condition) -> NDArray[np.bool_]:
        """The states (n,) that a condition sets after a steady state."""
        assigned = {name for name, value in condition.assigned.items() if value is not None}
        return np.array([name in assigned for name in self.dynamics.system.states])
