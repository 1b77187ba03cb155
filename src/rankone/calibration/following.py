"""Trajectories of the experiments, with their derivatives: all together, or one by one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rankone.calibration.dynamics import Dynamics
from rankone.calibration.records import Records
from rankone.calibration.resting import COARSE, Started, search_tolerances
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.errors import BlowUpError
from rankone.support.wording import quote
from rankone.trajectories.integrator import DenseTrajectories, Tolerances
from rankone.trajectories.sensitive_paths import RateSlopes, Start, sensitive_path
from rankone.trajectories.sensitivities import Forcing, sensitivities
from rankone.trajectories.stacks.integrator import StackedIntegrator
from rankone.trajectories.steady.rest import from_states

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
