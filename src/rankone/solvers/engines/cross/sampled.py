"""Stacked trajectories on a time grid, held as coefficients in a growing orthonormal basis."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from rankone.solvers.engines.cross.cross_options import TUNING
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.arrays import Array
from rankone.support.budget import (
    COPIES,
    OutOfWorkError,
    memory_left,
    reserve,
    work_done,
    work_left,
)
from rankone.support.precision import ACCUMULATED, MANY_STATES, TINY
from rankone.tensors.bases.time_grid import TimeGrid
from rankone.tensors.trains.cross import GrowingBasis
from rankone.trajectories.integrators.diagnosis import first_to_end
from rankone.trajectories.integrators.integrator import Integrator, Tolerances
from rankone.trajectories.integrators.integrator_choice import following, integrator_for
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.system.system import System


class TooManyTrajectories(Exception):
    """The limit of trajectories was met."""


class TrajectoryEnds(Exception):
    """The trajectory at a point (d,) cannot be integrated beyond ``time``."""

    def __init__(self, time: float, point: Array) -> None:
        super().__init__(time, point)
        self.time, self.point = time, point


class Trajectories:
    """Trajectories at parameter points, in units of the states' sizes.

    A trajectory is a vector (state, time node), scaled so that its norm is the root mean square
    over the nodes, and of many states over the states as well; what the basis misses of it is below
    the tolerance. ``allowed_error`` is that of the integration, in units of sizes, and
    ``tightness`` the first tolerance of the integration and of the basis over it: some trajectories
    of the reference are integrated together with the first ones, and their error then sets it.
    ``report`` is called after each batch with the part of a call that is done. ``highest_modes``
    (slabs,) are those in time, the largest of all trajectories, and ``work`` counts the operations;
    ``least_work`` is that of a trajectory in the cheapest stack that was stiff and not small.
    ``integrator`` is the option for further trajectories, and ``taken`` what has taken the last
    ones: those after the reference, unless a caller sets them.
    """

    def __init__(
        self,
        reference_set: ReferenceSet,
        grid: TimeGrid,
        allowed_error: float,
        tightness: float,
        most: int,
        workers: Workers | None = None,
        report: Callable[[float], None] | None = None,
    ) -> None:
        self.workers, self.report = workers or Workers(reference_set.system), report
        self.reference_set, self.grid, self.most = reference_set, grid, most
        self.allowed_error = allowed_error
        avoided = reference_set.reference.avoided
        self.stiff = self.calibrated = avoided > TUNING.explicit_step_limit
        self.tightness = TUNING.aimed_error_ratio if self.stiff else tightness
        self.count, self.work, self.least_work = 0, 0.0, 0.0
        self._counted_work = 0.0
        self.integrator, self.taken = reference_set.taken, reference_set.reference.integrator
        self.scale = _norm_of_ones(grid.times.size, reference_set.states.size)
        self.units = reference_set.states * self.scale
        self.basis = GrowingBasis(self.units.size * grid.times.size)
        self.highest_modes = np.zeros(grid.slabs)

    def __call__(self, points: Array) -> Array:
        """Coefficients of the trajectories at points (m, d): shape (rank of the basis, m)."""
        if len(points) and np.array_equal(points, self.reference_set.lines):
            self._reserve(len(points))
            return self._coefficients(self._on_lines())
        if self.count + len(points) > self.most:
            raise TooManyTrajectories
        blocks, begun, before = [], 0, self.work
        for group in self._groups(points):
            least = TUNING.least_sample_ratio * self.least_work
            if least * (len(points) - begun) > work_left():
                raise OutOfWorkError
            begun += len(group)
            self._reserve(len(group))
            columns = self._integrated(group) if self.calibrated else self._calibrated(group)
            self.count += len(group)
            blocks.append(self._coefficients(columns))
        self._counted_work += self.work - before
        rank = len(blocks[-1])
        return np.concatenate([_with_rows(block, rank) for block in blocks], axis=1)

    def _coefficients(self, columns: Array) -> Array:
        """Coefficients of columns (n T, m), for which the basis grows: shape (rank, m)."""
        in_units = columns.reshape(self.units.size, -1, columns.shape[1])
        highest_modes = self.grid.highest_modes(in_units) * self.scale
        self.highest_modes = np.maximum(self.highest_modes, highest_modes)
        # steps may be more accurate than their tolerance, the basis must not be less
        lost = max(min(self.tightness, 1.0) * self.allowed_error, ACCUMULATED)
        return self.basis.coefficients(columns, lost)

    def _groups(self, points: Array) -> list[Array]:
        """Points whose columns are held at a time: few of many states, whole chunks of others."""
        numbers = self._read * self.grid.times.size
        held = min(TUNING.held_numbers, memory_left() / (8 * COPIES))
        size = max(int(held // numbers), self._chunk_size())
        return np.array_split(points, max(-(-len(points) // size), 1))

    def _reserve(self, count: int) -> None:
        """Raise an OutOfMemoryError if so many trajectories do not fit beside the basis."""
        times = self.grid.times.size
        numbers = COPIES * count * self._read * times + 2.0 * self.basis.vectors.size
        reserve(8 * numbers)

    @property
    def work_of_each(self) -> float:
        """Work of one of the trajectories that count."""
        return max(self._counted_work / max(self.count, 1), 1.0)

    @property
    def _read(self) -> int:
        """How many states of a trajectory are read."""
        observed = self.reference_set.observed
        return self.units.size if observed is None else max(len(observed.rows), 1)

    @property
    def sizes(self) -> Array:
        return self.reference_set.states

    def uncounted(self, points: Array) -> Array:
        """Trajectories at points (m, d) in units of the sizes: (n, T, m); they do not count."""
        return self._in_sizes(self._integrated(points))

    def states(self, coefficients: Array) -> Array:
        """States at the nodes from coefficients (rank, r): shape (n, T, r)."""
        columns = self.basis.columns(coefficients)
        states = columns.reshape(self.units.size, -1, coefficients.shape[1])
        return np.asarray(states * self.units[:, None, None])

    def _on_lines(self) -> Array:
        """The trajectories on lines that the reference has, (n T, m)."""
        states = self.reference_set.trajectories_on_lines(self.grid.times).transpose(0, 2, 1)
        scaled = states / self.units[:, None, None]
        return np.asarray(scaled.reshape(-1, states.shape[2]))

    def _calibrated(self, points: Array) -> Array:
        """The first trajectories, at a tolerance that brings the allowed error."""
        self.calibrated = True
        reference = self.reference_set.reference
        some = slice(TUNING.calibration_points)
        first, times = reference.of(some), self.grid.times
        exact = self.reference_set.seen(times, first(times), some) / self.sizes[:, None, None]
        exact_points = first.points
        before, ratio, used = math.inf, math.inf, self.tightness
        for calibration in range(TUNING.max_calibrations):
            columns = self._integrated(np.concatenate([exact_points, points]))
            self.count += len(exact_points) + (len(points) if calibration else 0)
            ours, columns = np.split(columns, [len(exact_points)], axis=1)
            errors = exact.swapaxes(1, 2) - self._in_sizes(ours)
            ratio = float(np.abs(errors).max()) / self.allowed_error
            if ratio > TUNING.reference_error_ratio * before:  # the reference's own error
                self.tightness = used
                break
            before, used = ratio, self.tightness
            if not TUNING.least_error_ratio <= ratio <= 1.0:
                factor = TUNING.aimed_error_ratio / max(ratio, TINY)
                factor = max(factor, TUNING.smallest_tightness_factor)
                self.tightness *= min(factor, TUNING.largest_tightness_factor)
            if ratio <= 1.0:
                break
        if ratio > 1.0 and reference.stiff:  # explicit steps do not come to the accuracy
            self.stiff, self.tightness = True, TUNING.aimed_error_ratio
            columns = self._integrated(points)
        return columns

    def _in_sizes(self, columns: Array) -> Array:
        """Trajectories (n T, m) in units of the sizes: shape (n, T, m)."""
        scaled = columns * self.scale
        return np.asarray(scaled.reshape(self.units.size, -1, columns.shape[1]))

    def _integrated(self, points: Array) -> Array:
        """Trajectories at the points, (n T, m).

        Trajectories of a chunk share their steps. So the chunks depend on the problem and on the
        number of points alone, and not on who integrates them.
        """
        reference_set, end = self.reference_set, self.grid.breaks[-1]
        cuts = (cut for cut in reference_set.cuts if cut < end)
        edges = [reference_set.domain.horizon[0], *cuts, end]
        tolerance = max(self.tightness * self.allowed_error, ACCUMULATED)
        least_sizes = TUNING.absolute_tolerance_ratio * reference_set.of_states
        floor = np.minimum(least_sizes, reference_set.reference.floor)
        least = np.maximum(reference_set.reference.rounded, reference_set.reference.least)
        absolute = np.maximum(tolerance * floor, least)
        chunks = np.array_split(points, max(-(-len(points) // self._chunk_size()), 1))
        integrator = integrator_for(
            reference_set.system,
            self.integrator,
            stiff=self.stiff,
            bearable_steps=TUNING.explicit_step_limit,
        )
        tolerances = Tolerances(tolerance, absolute[:, None])
        observed = reference_set.observed
        rows = None if observed is None else observed.rows
        common = (
            integrator,
            edges,
            tolerances,
            self.grid.times,
            self.units if rows is None else rows,
        )
        tasks = [(chunk, *common) for chunk in chunks]
        before = work_done()
        try:
            sampled = self.workers.map(_integrated, tasks, TrajectoryEnds, done=self.report)
            if self.stiff and 2 * len(points) >= self._chunk_size():
                work = (work_done() - before) / len(points)
                self.least_work = min(self.least_work or work, work)
            clock = reference_set.system.clock
            for (_, self.taken), chunk in zip(sampled, chunks, strict=True):
                self.integrator = following(self.integrator, self.taken, len(chunk), clock)
            pairs = zip(sampled, chunks, strict=True)
            columns = [x if rows is None else self._observed(x, chunk) for (x, _), chunk in pairs]
            return columns[0] if len(columns) == 1 else np.concatenate(columns, axis=1)
        finally:
            self.work += work_done() - before

    def _observed(self, states: Array, points: Array) -> Array:
        """What is observed of the states that it reads (k, T, m), in units: (n T, m)."""
        observed = self.reference_set.observed
        assert observed is not None
        return _in_units(observed.of_rows(self.grid.times, states, points), self.units)

    def _chunk_size(self) -> int:
        """Largest number of trajectories in a chunk."""
        if self.reference_set.system.user_functions:
            return TUNING.max_user_stack
        most = TUNING.max_stiff_stack if self.stiff else TUNING.max_stack
        states = self.reference_set.system.n_differential
        return min(max(TUNING.stack_states // states, TUNING.min_stack), most)


def _norm_of_ones(times: int, states: int) -> float:
    """The norm of a trajectory of ones before it is scaled.

    An error that all of many states share is not taken for a larger one.
    """
    return float(np.sqrt(times * max(states / MANY_STATES, 1.0)))


def _with_rows(block: Array, rank: int) -> Array:
    """Coefficients with zeros for the vectors by which the basis has grown since."""
    return np.pad(block, ((0, rank - len(block)), (0, 0)))


def _integrated(
    system: System,
    points: Array,
    integrator: Integrator,
    edges: list[float],
    tolerances: Tolerances,
    times: Array,
    units: Array | tuple[int, ...],
) -> tuple[Array, str]:
    """Trajectories at points (m, d) in units of states, (n T, m); the integrator.

    With a tuple for the units some rows of them as they are, (k, T, m).
    """
    sampled = integrator.sample(system, points, edges, tolerances, times)
    if sampled.reached < times.size or not np.isfinite(sampled.states).all():
        floor = tolerances.absolute
        ends = first_to_end(system, sampled.end, sampled.state, points, floor)
        raise TrajectoryEnds(sampled.end, points[ends])
    states = sampled.states.transpose(1, 0, 2)
    if isinstance(units, tuple):
        return states[list(units)], sampled.integrator
    return _in_units(states, units), sampled.integrator


def _in_units(states: Array, units: Array) -> Array:
    """States (n, T, m) in units (n,), one under the other: (n T, m)."""
    scaled = np.empty(states.shape)
    np.divide(states, units[:, None, None], out=scaled)
    return scaled.reshape(-1, states.shape[2])
