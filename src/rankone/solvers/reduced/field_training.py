"""Modes of fields, from full trajectories where the reduced system is worst.

Full trajectories at a few points give modes, these a small system, and its trajectories at many
points tell, by the residual in the equations of the fields, where the next full ones belong
(POD-greedy: Haasdonk & Ohlberger, ESAIM: M2AN 42 (2008), 277).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.reduced.field_bases import FieldSnapshots, Interpolation, Snapshots
from rankone.solvers.reduced.field_causes import SlowModes, TooFewTrajectories
from rankone.solvers.reduced.field_comparison import CoefficientCurves, Curve, FieldComparison
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.solvers.reduced.field_request import FIELDS, FieldRequest
from rankone.solvers.reduced.field_residual import FieldResidual
from rankone.solvers.reduced.reduced_system import ReducedSystem, reduced_system
from rankone.solvers.verification.points import Coverage
from rankone.support.arrays import AT_ONCE, TINY, Array, corners, spread
from rankone.support.budget import ProgressEvent, Report
from rankone.support.tasks import Pool
from rankone.trajectories.events.event_integration import integrate_to_events
from rankone.trajectories.fields.field_steps import EndsEarlyError
from rankone.trajectories.fields.field_system import FieldSystem
from rankone.trajectories.fields.field_trajectories import (
    FieldIntegration,
    FieldTrajectory,
    field_sizes,
    field_trajectory,
)
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.integrator_choice import integrator_for, span_integrator_for
from rankone.trajectories.system.verdict import Cause, Status

Columns = slice | NDArray[np.bool_]
"""Some of the times of a trajectory."""


class SolveEndedError(Exception):
    """A solve of fields has ended, and how."""

    def __init__(self, status: Status, cause: Cause | None = None) -> None:
        super().__init__(status, cause)
        self.status, self.cause = status, cause


class FieldTraining:
    """The full trajectories of one solve so far, and the modes made of them.

    Attributes
    ----------
    modes : FieldModes or None
        Of all trajectories so far.
    scales : ndarray (unknowns,)
        The largest values of the unknowns so far.
    count : int
        Full trajectories so far.
    beside : ndarray (m, d)
        Points next to narrow features of the coefficients: to be among those of a check.
    """

    def __init__(self, fields: FieldSystem, request: FieldRequest, report: Report) -> None:
        self.fields, self.request, self.report = fields, request, report
        self.coverage = Coverage.of_domain(request.domain)
        self.comparison = FieldComparison.of(fields, request.rtol)
        self.generator = np.random.default_rng(20151)
        self.states = FieldSnapshots({}, np.ones(len(fields.unknowns)), 0.0)
        self.pointwise = [Snapshots(0.0) for _ in fields.pointwise]
        self.scales = np.zeros(len(fields.unknowns))
        self.seen: list[Array] = []
        self.count = 0
        self.modes: FieldModes | None = None
        self.left_out = FIELDS.modes
        self.beside = np.zeros((0, len(request.domain.box)))
        self.worst: float | None = None

    # --- full trajectories -----------------------------------------------------------------

    def begin(self, pool: Pool | None) -> None:
        """Sizes, tolerances, and the trajectories at the first points."""
        d, rtol = len(self.request.domain.box), self.request.rtol
        centre = self.coverage.points(np.full((1, d), 0.5))
        self._limit_steps(centre)
        narrow, self.beside = self._narrow_points(centre[0])
        first = centre[:0]
        if d:
            first = self.coverage.points(corners(d, FIELDS.first_corners, self.generator))
        sizes = field_sizes(self.fields, np.concatenate([centre, first]))
        absolute = np.array([u.absolute for u in self.fields.unknowns]) / rtol
        self.sizes = sizes = np.maximum(sizes, absolute)
        tolerance = self._step_tolerance(centre[0], sizes)
        kept = self._kept
        beside = self.comparison.beside
        self.integration = FieldIntegration(self.fields, sizes, tolerance, kept, pool, beside)
        self.states = FieldSnapshots(self.fields.velocities, sizes, kept)
        self.pointwise = [Snapshots(kept, relative=True) for _ in self.fields.pointwise]
        self.learn(self.full_trajectories(centre))
        self._reduced()  # ends where the modes of the first trajectory alone do not decay
        if d:
            self.learn(self.full_trajectories(np.concatenate([first, narrow])))

    def _limit_steps(self, centre: Array) -> None:
        """Keep steps from passing over pulses in time; end where these are too short."""
        d = len(self.request.domain.box)
        points = np.concatenate([centre, self.coverage.points(spread(8, d, self.generator))])
        times = np.linspace(*self.fields.horizon, 4 * FIELDS.line_places)
        c = self._explicit(times, points)
        change = np.abs(np.diff(c, axis=1)).max(axis=1)
        shares = change / np.maximum(np.ptp(c, axis=1), TINY)
        share = float(np.nan_to_num(shares).max(initial=0.0))
        if share > FIELDS.jump:
            raise SolveEndedError(Status.NARROW)
        if share > FIELDS.slow:
            longest = 2.0 * float(times[1] - times[0]) / share
            self.fields = replace(self.fields, longest_step=longest)

    def _narrow_points(self, centre: Array) -> tuple[Array, Array]:
        """Points at which rates are far from usual in a narrow part of the box, and beside.

        Along each parameter, through the centre.
        """
        d, (start, end) = len(self.request.domain.box), self.fields.horizon
        peaks, beside = list[Array](), list[Array]()
        times = np.linspace(start, end, 33)
        for j in range(d):
            line = self.coverage.line(j, FIELDS.line_places)
            points = np.tile(centre[:, None], (1, line.size))
            points[j] = line
            c = self._explicit(times, points.T)
            off = np.abs(c - np.median(c, axis=2, keepdims=True)).max(axis=1)
            for profile in off:
                inside = np.flatnonzero(profile > 0.5 * profile.max())
                if 0 < inside.size <= FIELDS.narrow * line.size:
                    peaks.append(points[:, int(np.argmax(profile))])
                    beside += [points[:, inside[0]], points[:, inside[-1]]]
        at_peaks, at_sides = (np.reshape(some, (len(some), d)) for some in (peaks, beside))
        return np.unique(at_peaks, axis=0), np.unique(at_sides, axis=0)

    def _explicit(self, times: Array, points: Array) -> Array:
        """How rates depend on times (T,) and points (m, d) where states stay: (numbers, T, m).

        The coefficients, and elementwise functions at a few entries, of the initial values and of
        others.
        """
        p, fields = points.T[:, None, :], self.fields
        shape = times.size, len(points)
        c = fields.coefficients(times[:, None], p)
        numbers = [np.broadcast_to(c, (len(c), *shape))]
        states = np.stack([fields.initial(point) for point in points], axis=1)
        for term in fields.pointwise:
            count = term.after.shape[1]
            some = np.unique(np.linspace(0, count - 1, FIELDS.looked_at).astype(int))
            vectors = [vector[some, None, None] for vector in term.vectors]
            for moved in (0.0, 1.0):
                arguments = [(a[some] @ (states + moved))[:, None, :] for a in term.arguments]
                values = fields.elementwise(term.function)(
                    times[:, None], [*arguments, *vectors], p
                )
                numbers.append(np.broadcast_to(values, (some.size, *shape)))
        return np.nan_to_num(np.concatenate(numbers), posinf=0.0, neginf=0.0)

    @property
    def _kept(self) -> float:
        """What compressed trajectories leave out, relative to the sizes of the fields."""
        share = FIELDS.kept_motion if self.fields.velocities else FIELDS.kept
        return share * self.request.rtol

    def _step_tolerance(self, point: Array, sizes: Array) -> float:
        """A tolerance of steps whose trajectories are accurate enough.

        Those of two tolerances are compared, and the next ones are what their difference suggests.
        """
        rtol, times = self.request.rtol, self.telling_times(FIELDS.tolerance_times)
        share = FIELDS.integrated_motion if self.fields.velocities else FIELDS.integrated
        kept, wanted = self._kept, share * rtol
        tolerance = FIELDS.first_step * rtol
        while True:
            try:
                coarse, fine = (
                    field_trajectory(self.fields, point, sizes, factor * tolerance, kept, times)
                    for factor in (1.0, FIELDS.finer)
                )
            except EndsEarlyError as end:
                if not end.accumulate or tolerance <= FIELDS.least_step:
                    raise
                tolerance *= FIELDS.finer  # which may tell its events apart
                continue
            error = self.comparison.difference(coarse, fine, sizes)
            if error <= wanted or tolerance <= FIELDS.least_step:
                return tolerance
            tolerance *= min(FIELDS.finer, 0.5 * wanted / error)

    def full_trajectories(self, points: Array) -> list[FieldTrajectory]:
        """Full trajectories, as far as there are some left."""
        most = self.request.trajectories
        if self.count + len(points) > most:
            cause = TooFewTrajectories(most, self.rank, self.worst)
            raise SolveEndedError(Status.TRAJECTORY_LIMIT, cause)
        answers = self.integration.trajectories(points)
        self.count += len(points)
        self.seen += list(points)
        done = min(self.count / self.request.trajectories, 1.0)
        self.report(ProgressEvent(self.fields.horizon[0], done, 0, 0, self.rank))
        for trajectory in answers:
            np.maximum(self.scales, trajectory.largest, out=self.scales)
        return answers

    @property
    def rank(self) -> int:
        return 0 if self.modes is None else len(self.modes.names)

    def learn(self, trajectories: Iterable[FieldTrajectory]) -> None:
        """Take trajectories into the modes."""
        for trajectory in trajectories:
            self.states.add(trajectory.states)
            for snapshots, values in zip(self.pointwise, trajectory.pointwise, strict=True):
                snapshots.add(values)

    # --- modes -----------------------------------------------------------------------------

    def train(self) -> tuple[ReducedSystem, list[Interpolation]]:
        """Modes that suffice at the points where residuals are worst.

        By far in one round, or in two of them: a few points may be good by chance.
        """
        within = False
        while True:
            reduced, interpolations = self._reduced()
            points = self.worst_points(reduced, interpolations, FIELDS.at_once)
            trajectories = self.full_trajectories(points)
            errors = [self.error_of(reduced, trajectory) for trajectory in trajectories]
            self.worst = max(errors)
            self._tighten(trajectories, errors)
            self.learn(trajectories)
            before, far = within, max(errors) <= FIELDS.far_below * self.request.rtol
            within = max(errors) <= FIELDS.reduced * self.request.rtol
            if far or (within and before):
                return self._reduced()

    def _tighten(self, trajectories: Sequence[FieldTrajectory], errors: Sequence[float]) -> None:
        """Let modes leave out less where they hold a trajectory, but its reduced system is off."""
        rtol = self.request.rtol
        for trajectory, error in zip(trajectories, errors, strict=True):
            missed = max(self._errors(self._projected(trajectory), trajectory))
            held = missed <= max(self.left_out * rtol, error / FIELDS.added)
            if held and error > FIELDS.reduced * rtol:
                self.left_out = max(FIELDS.tightened * self.left_out, FIELDS.fewest_left_out)
                return

    def _projected(self, trajectory: FieldTrajectory) -> Array:
        """The coefficients (R, T) closest to a full trajectory."""
        assert self.modes is not None
        pairs = zip(self.modes.modes, trajectory.states, strict=True)
        blocks = [m.T @ states.modes @ states.numbers / len(m) for m, states in pairs]
        return np.concatenate(blocks)

    def _reduced(self) -> tuple[ReducedSystem, list[Interpolation]]:
        """The reduced system of all trajectories so far."""
        left_out = self.left_out * self.request.rtol
        scales = np.maximum(self.scales, self.sizes * (self.scales == 0.0))
        blocks = self.states.modes(left_out * scales)
        self.modes = FieldModes(
            self.fields.unknowns, tuple(blocks), tuple(scales.tolist()), (), self.count
        )
        self._refuse_slow(left_out)
        interpolations = [
            Interpolation.of(s.modes(left_out * s.largest), s.modes(0.0)) for s in self.pointwise
        ]
        tolerance = FIELDS.solved * self.request.rtol
        return reduced_system(self.fields, self.modes, interpolations, tolerance), interpolations

    def _refuse_slow(self, left_out: float) -> None:
        """End where the modes of an unknown do not decay."""
        assert self.modes is not None
        if self.rank <= FIELDS.most_modes:
            return
        worst = int(np.argmax(self.modes.counts))
        needed = self.modes.counts[worst]
        count = FIELDS.most_modes * needed // self.rank  # its share
        missed = self.states.missed(worst, count) / self.scales[worst]
        name = self.fields.unknowns[worst].name
        cause = SlowModes(name, count, missed, left_out, needed, self.count)
        raise SolveEndedError(Status.RANK_LIMIT, cause)

    def worst_points(
        self,
        reduced: ReducedSystem,
        interpolations: Sequence[Interpolation],
        count: int,
        others: Array | None = None,
    ) -> Array:
        """New points (count, d) at which the residual of the reduced system is largest.

        They are apart from those of full trajectories, and from ``others`` (m, d).
        """
        assert self.modes is not None
        d = len(self.request.domain.box)
        if d == 0:
            return np.zeros((1, 0))
        points = self.candidates(FIELDS.candidates)
        times = self.telling_times(FIELDS.residual_times)
        states, ended = self.reduced_states(reduced, points, times, self.request.rtol)
        residual = FieldResidual(self.fields, self.modes, interpolations, reduced)
        r, m, count_times = states.shape
        flat = residual(
            np.tile(times, m), states.reshape(r, -1), np.repeat(points.T, count_times, axis=1)
        )
        heights = np.nan_to_num(flat, nan=np.inf).reshape(m, -1)
        heights = np.where(ended, 0.0, heights).max(axis=1)
        width = np.ptp(self.request.domain.bounds, axis=1)
        order = np.argsort(-heights, kind="stable")
        seen, chosen = [*self.seen, *(() if others is None else others)], list[int]()
        for far in (FIELDS.distance, 0.0):  # where all of them are near, the worst
            for k in order:
                distance = (np.abs(np.array(seen) - points[k]) / width).max(axis=1).min()
                if len(chosen) < count and distance > far:
                    chosen.append(k)
                    seen.append(points[k])
        return points[chosen]

    def candidates(self, count: int) -> Array:
        """So many evenly spread points, and as many corners."""
        d = len(self.request.domain.box)
        if d == 0:
            return np.zeros((1, 0))
        some = spread(count, d, self.generator), corners(d, count, self.generator)
        return self.coverage.points(np.concatenate(some))

    def telling_times(self, count: int) -> Array:
        """Times after the start, ascending: half of them even, and half closer and closer to it."""
        start, end = self.fields.horizon
        half = count // 2
        even = np.linspace(0.0, 1.0, half + 1)[1:]
        return np.asarray(start + (end - start) * np.union1d(0.5 ** np.arange(2, half + 2), even))

    def reduced_states(
        self, reduced: ReducedSystem, points: Array, times: Array, rtol: float
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Coefficients (R, m, T) of the reduced system at points (m, d); NaN beyond their end.

        And which times (m, T) are behind a terminal event.
        """
        assert self.modes is not None
        counts, sizes = self.modes.counts, np.minimum(self.modes.scales, self.sizes)
        absolute = rtol * np.repeat(sizes / np.sqrt(counts), counts)[:, None]
        tolerances = Tolerances(max(rtol, 1e-12), absolute, self.fields.longest_step)
        system, horizon = reduced.system, self.fields.horizon
        states = np.full((len(reduced.names), len(points), len(times)), np.nan)
        ended = np.zeros(states.shape[1:], dtype=bool)
        if not system.events:
            alone = len(points) == 1
            chosen = integrator_for(system, "single" if alone else "auto", stiff=True)
            dense = chosen.run(system, points, horizon, tolerances)
            there = times <= dense.end
            states[:, :, there] = dense(times[there])
            return states, ended
        spanning = span_integrator_for(system, "auto", stiff=True)
        for k, each in enumerate(
            integrate_to_events(spanning, system, points, horizon, tolerances)
        ):
            there = times <= each.end
            states[:, k, there] = each(times[there])
            last = each.occurrences[-1:]
            ended[k] = ~there & any(system.events[o.event].terminal for o in last)
        return states, ended

    @property
    def _accurate(self) -> float:
        """A tolerance of trajectories whose errors do not matter."""
        return FIELDS.finer * self.integration.tolerance

    def error_of(self, reduced: ReducedSystem, trajectory: FieldTrajectory) -> float:
        """The error of the reduced system at the point of a full trajectory."""

        def curve(times: Array) -> Array:
            states, _ = self.reduced_states(reduced, trajectory.point[None], times, self._accurate)
            return states[:, 0]

        return max(self.errors_along(curve, trajectory))

    def distances(self, reduced: ReducedSystem, curves: CoefficientCurves, points: Array) -> Array:
        """How far fields of curves are from those of the reduced system at points (m, d): (m,)."""
        assert self.modes is not None
        times = self.telling_times(FIELDS.residual_times)
        states, _ = self.reduced_states(reduced, points, times, self._accurate)
        worst = np.zeros(len(points))
        for k, point in enumerate(points):
            difference = np.nan_to_num(curves.at(point)(times) - states[:, k])
            for j, (modes, scale) in enumerate(zip(self.modes.modes, self.scales, strict=True)):
                gap = modes @ difference[self.modes.coefficients_of(j)]
                worst[k] = max(worst[k], np.abs(gap).max() / scale if scale else 0.0)
        return worst

    def measured_modes(self, errors: tuple[float, ...]) -> FieldModes:
        """The modes, with errors (unknowns,) that a check showed."""
        assert self.modes is not None
        scales = tuple(self.scales.tolist())
        self.modes = replace(self.modes, errors=errors, scales=scales, trajectories=self.count)
        return self.modes

    def errors_along(self, curve: Curve, trajectory: FieldTrajectory) -> list[float]:
        """The largest difference of coefficients from a full trajectory, by unknown.

        Times next to jumps do not count; infinite where one of the two ends before the other.
        """
        if self.comparison.goes_on(curve, trajectory):
            return [math.inf] * len(self.fields.unknowns)
        counted = self.comparison.counted(trajectory)
        return self._errors(curve(trajectory.times[counted]), trajectory, counted)

    def _errors(
        self, coefficients: Array, trajectory: FieldTrajectory, counted: Columns = slice(None)
    ) -> list[float]:
        """The largest difference of coefficients (R, T) from a full trajectory, by unknown."""
        assert self.modes is not None
        errors = []
        chosen = np.zeros(trajectory.times.size, dtype=bool)
        chosen[counted] = True
        for k, exact in enumerate(trajectory.states):
            own, worst = coefficients[self.modes.coefficients_of(k)], 0.0
            step = max(AT_ONCE // len(self.modes.modes[k]), 1)
            for first in range(0, chosen.size, step):  # nobody holds all entries at all times
                some = slice(first, first + step)
                before, count = int(chosen[:first].sum()), int(chosen[some].sum())
                ours = self.modes.modes[k] @ own[:, before : before + count]
                gap = np.abs(ours - exact.at(some)[:, chosen[some]])
                worst = float(np.maximum(worst, gap.max(initial=0.0)))
            errors.append(worst / self.scales[k] if self.scales[k] else 0.0)
        return [math.inf if math.isnan(error) else error for error in errors]

    # --- the solution ----------------------------------------------------------------------
