"""Solves of fields by their modes: look where they are worst, and measure what came of it.

Full trajectories at a few points give modes, these a small system, and its trajectories at many
points tell, by the residual in the equations of the fields, where the next full ones belong
(POD-greedy: Haasdonk & Ohlberger, ESAIM: M2AN 42 (2008), 277). When full trajectories at new points
agree with the small system, the cross engine solves that, and the solution is measured against full
trajectories at further points, which no mode has seen.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.engines import cross_engine
from rankone.solvers.engines.engine_options import CrossOptions
from rankone.solvers.outcome import Outcome, SolutionMetadata
from rankone.solvers.reduced.field_bases import FieldSnapshots, Interpolation, Snapshots
from rankone.solvers.reduced.field_comparison import CoefficientCurves, Curve, FieldComparison
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.solvers.reduced.field_residual import FieldResidual
from rankone.solvers.reduced.reduced_system import ReducedSystem, reduced_system
from rankone.solvers.request import Check, Domain, Limits, SolveRequest
from rankone.solvers.selection import solve_with
from rankone.solvers.verification.points import Coverage
from rankone.support.arrays import TINY, Array, corners, spread
from rankone.support.budget import OutOfBudgetError, ProgressEvent, Report, limited, quiet, timed
from rankone.support.tasks import ExecutorLike, Pool, open_pool
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
from rankone.trajectories.system.verdict import Cause, Status, Verdict


@dataclass(frozen=True)
class FieldTuning:
    """The numbers of a solve by modes; shares are of the tolerance that was asked for."""

    integrated: float = 0.05
    """Error of full trajectories."""
    integrated_motion: float = 0.01
    """The same where there are velocities: stiff bodies amplify rough parts of modes."""
    first_step: float = 0.01
    """Tolerance of a step at first; it is lowered until the error above is met."""
    finer: float = 0.1
    """Factor on the tolerance of trajectories that tell errors of others."""
    least_step: float = 1e-12
    tolerance_times: int = 48
    kept: float = 0.01
    """What compressed trajectories leave out."""
    kept_motion: float = 0.001
    """The same where there are velocities."""
    modes: float = 0.4
    """What the modes leave out of all trajectories so far, at first."""
    fewest_left_out: float = 0.02
    """The same at least."""
    tightened: float = 0.3
    """Factor on it where the reduced system adds much to what the modes leave out."""
    added: float = 3.0
    """Error of the reduced system over what its modes leave out that is much."""
    reduced: float = 0.8
    """Error of the reduced system at which it is solved."""
    solved: float = 0.4
    """Tolerance of its solution, at first."""
    solution: float = 0.5
    """Error of its solution, against trajectories of the reduced system, that suffices."""
    first_corners: int = 4
    """Corners among the first points, beside the centre."""
    at_once: int = 3
    """Further points of a round."""
    candidates: int = 64
    """Points, and corners, at which the residual is looked at."""
    residual_times: int = 24
    distance: float = 0.15
    """Least distance of new points, in widths of the box."""
    effort: float = 16.0
    """Budget of the solve for coefficients, over that of a system without fields."""
    spread_checks: int = 12
    worst_checks: int = 8
    most_modes: int = 150
    """Coefficients of all unknowns together."""
    most_trajectories: int = 100
    line_places: int = 1025
    """Places on a line through the box, and times, at which coefficients are looked at."""
    narrow: float = 0.1
    """Part of a line on which a coefficient is far from its median that is narrow."""
    slow: float = 0.02
    """Change of a coefficient from one time to the next, over all of it, that needs no care."""
    jump: float = 0.5
    """The same that is too much to be followed."""
    coefficient_checks: int = 16
    """Points, and corners, at which a solution for the coefficients is compared with these."""
    rounds: int = 4
    """Solutions that are measured at most: what disagrees becomes modes."""


FIELDS = FieldTuning()
# Solutions for the coefficients whose fields are measured: some suffice though theirs do not
_MEASURED = (Status.CONVERGED, Status.TOLERANCE)


@dataclass(frozen=True)
class SlowModes(Cause):
    """Too many modes would be needed: those of fronts that travel, and of noise, do not decay."""

    unknown: str
    count: int
    left_out: float
    allowed: float
    needed: int
    trajectories: int
    text: ClassVar[str] = (
        "the modes of {unknown} decay too slowly: {count} of them leave out {left_out:.1e} of "
        "{trajectories} trajectories; for {allowed:.1e} they would need at least {needed}"
    )


@dataclass(frozen=True)
class FieldsEnd(Cause):
    """A trajectory of fields that does not reach the end of the horizon."""

    time: float
    at: tuple[tuple[str, float], ...]

    def sentence(self, status: Status) -> str:
        place = ", ".join(f"{name} = {value:.6g}" for name, value in self.at)
        place = f" with {place}" if place else ""
        remedy = "end the horizon before, or take a box without it"
        text = status.value
        if status is Status.BLOW_UP:
            text = "a trajectory leaves all bounds inside the horizon"
        if status is Status.SWITCHES:
            text = "events of a trajectory follow each other too closely to be told apart"
        return f"{text}, at t = {self.time:.6g}{place}; {remedy}"


@dataclass(frozen=True)
class TooFewTrajectories(Cause):
    """The full trajectories that were allowed did not suffice."""

    most: int
    modes: int
    error: float | None

    def sentence(self, status: Status) -> str:
        text = f"{status.value}: at most {self.most} were to be integrated"
        if self.error is not None:
            missed = f"{self.error:.1e} of the largest value"
            text += f"; {self.modes} modes missed the last ones by {missed}"
        return f"{text}; raise max_trajectories or rtol, or take a smaller box"


@dataclass(frozen=True)
class FieldError(Cause):
    """How far the solution is from full trajectories at new points.

    With events ``time_error`` is the largest error of their times, over the horizon.
    """

    error: float
    unknown: str
    points: int
    trajectories: int
    time_error: float | None = None
    text: ClassVar[str] = (
        "{status}: {error:.1e} of the largest value of {unknown}, against {points} trajectories "
        "that no mode was made of, {trajectories} in all"
    )

    def sentence(self, status: Status) -> str:
        text = super().sentence(status)
        if self.time_error is not None:
            text += f"; times of events within {self.time_error:.1e} of the horizon"
        return text


@dataclass(frozen=True)
class ReducedEnds(Cause):
    """How the solve of the reduced system ended."""

    message: str
    modes: int
    text: ClassVar[str] = "the system of {modes} coefficients is not solved: {message}"


@dataclass(frozen=True)
class FieldRequest:
    """What is asked of a solve of fields.

    ``check`` is the number of evenly spread points at which errors are measured, beside the worst
    ones; none are with 0. ``options`` are those of the cross engine, ``executor`` takes the full
    trajectories, of which there are ``trajectories`` at most.
    """

    rtol: float
    domain: Domain
    check: int = FIELDS.spread_checks
    limits: Limits = field(default_factory=Limits)
    options: CrossOptions = field(default_factory=CrossOptions)
    executor: ExecutorLike | None = None
    trajectories: int = FIELDS.most_trajectories


@dataclass(frozen=True)
class ReducedOutcome:
    """What a solve of fields came to: modes, the outcome of the coefficients, and how it ended.

    Without any, where it ended before.
    """

    verdict: Verdict
    modes: FieldModes | None = None
    outcome: Outcome | None = None
    metadata: SolutionMetadata | None = None
    timings: dict[str, float] = field(default_factory=dict)
    work: float = 0.0
    trajectories: int = 0


def solve_fields(
    fields: FieldSystem, request: FieldRequest, report: Report = quiet
) -> ReducedOutcome:
    """Solve for all points of a box at once, by modes."""
    domain = request.domain
    fields = replace(fields, box=domain.box, horizon=domain.horizon, scales=domain.scales)
    solve = _FieldSolve(fields, request, report)
    held = limited(seconds=request.limits.seconds, memory=request.limits.memory)
    with held as account, np.errstate(all="ignore"):
        before = account.done
        try:
            if request.executor is None:
                solve.run(None)
            else:
                with open_pool(request.executor) as pool:
                    solve.run(pool)
        except EndsEarlyError as end:
            at = tuple(zip(fields.parameters, end.point.tolist(), strict=True))
            stalled = Status.SWITCHES if end.accumulate else Status.STALLS
            solve.ended(Status.BLOW_UP if end.grows else stalled, FieldsEnd(end.time, at))
        except OutOfBudgetError as out:
            solve.ended(Status.of_limit(out))
        work = account.done - before
    return replace(solve.result, work=work, timings=solve.timings, trajectories=solve.count)


Columns = slice | NDArray[np.bool_]
"""Some of the times of a trajectory."""


class _SolvedEarlyError(Exception):
    """The solve has ended; the result says how."""


class _FieldSolve:
    """The state of one solve."""

    def __init__(self, fields: FieldSystem, request: FieldRequest, report: Report) -> None:
        self.fields, self.request, self.report = fields, request, report
        self.timings: dict[str, float] = {}
        self.result = ReducedOutcome(Verdict(Status.TRAJECTORY_LIMIT))
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

    def ended(self, status: Status, cause: Cause | None = None) -> None:
        """Keep how the solve ended."""
        self.result = replace(self.result, verdict=Verdict(status, cause))

    def run(self, pool: Pool | None) -> None:
        try:
            with timed(self.timings, "first trajectories"):
                self._begin(pool)
            with timed(self.timings, "modes"):
                reduced, interpolations = self._train()
            self._measured_solution(reduced, interpolations)
        except _SolvedEarlyError:
            pass

    # --- full trajectories -----------------------------------------------------------------

    def _begin(self, pool: Pool | None) -> None:
        """Sizes, tolerances, and the trajectories at the first points."""
        d, rtol = len(self.request.domain.box), self.request.rtol
        centre = self.coverage.points(np.full((1, d), 0.5))
        self._limit_steps(centre)
        narrow, self.beside = self._narrow_points(centre[0])
        sizes = field_sizes(self.fields, centre[0])
        absolute = np.array([u.absolute for u in self.fields.unknowns]) / rtol
        self.sizes = sizes = np.maximum(sizes, absolute)
        tolerance = self._step_tolerance(centre[0], sizes)
        kept = self._kept
        beside = self.comparison.beside
        self.integration = FieldIntegration(self.fields, sizes, tolerance, kept, pool, beside)
        self.states = FieldSnapshots(self.fields.velocities, sizes, kept)
        self.pointwise = [Snapshots(kept, relative=True) for _ in self.fields.pointwise]
        self._learn(self._trajectories(centre))
        self._reduced()  # ends where the modes of the first trajectory alone do not decay
        if d:
            first = self.coverage.points(corners(d, FIELDS.first_corners, self.generator))
            self._learn(self._trajectories(np.concatenate([first, narrow])))

    def _limit_steps(self, centre: Array) -> None:
        """Keep steps from passing over pulses of the coefficients; end where they are too short."""
        d = len(self.request.domain.box)
        points = np.concatenate([centre, self.coverage.points(spread(8, d, self.generator))])
        times = np.linspace(*self.fields.horizon, 4 * FIELDS.line_places)
        c = self.fields.coefficients(times[:, None], points.T[:, None, :])
        c = np.broadcast_to(c, (len(c), times.size, len(points)))
        change = np.abs(np.diff(c, axis=1)).max(axis=1)
        shares = change / np.maximum(np.ptp(c, axis=1), TINY)
        share = float(np.nan_to_num(shares).max(initial=0.0))
        if share > FIELDS.jump:
            self.ended(Status.NARROW)
            raise _SolvedEarlyError
        if share > FIELDS.slow:
            longest = 2.0 * float(times[1] - times[0]) / share
            self.fields = replace(self.fields, longest_step=longest)

    def _narrow_points(self, centre: Array) -> tuple[Array, Array]:
        """Points at which coefficients are far from usual in a narrow part of the box, and beside.

        Along each parameter, through the centre.
        """
        d, (start, end) = len(self.request.domain.box), self.fields.horizon
        peaks, beside = list[Array](), list[Array]()
        times = np.linspace(start, end, 33)[:, None]
        for j in range(d):
            line = self.coverage.line(j, FIELDS.line_places)
            points = np.tile(centre[:, None], (1, line.size))
            points[j] = line
            c = self.fields.coefficients(times, points[:, None, :])
            c = np.broadcast_to(c, (len(c), len(times), line.size))
            off = np.abs(c - np.median(c, axis=2, keepdims=True)).max(axis=1)
            for profile in off:
                inside = np.flatnonzero(profile > 0.5 * profile.max())
                if 0 < inside.size <= FIELDS.narrow * line.size:
                    peaks.append(points[:, int(np.argmax(profile))])
                    beside += [points[:, inside[0]], points[:, inside[-1]]]
        at_peaks, at_sides = (np.reshape(some, (len(some), d)) for some in (peaks, beside))
        return np.unique(at_peaks, axis=0), np.unique(at_sides, axis=0)

    @property
    def _kept(self) -> float:
        """What compressed trajectories leave out, relative to the sizes of the fields."""
        share = FIELDS.kept_motion if self.fields.velocities else FIELDS.kept
        return share * self.request.rtol

    def _step_tolerance(self, point: Array, sizes: Array) -> float:
        """A tolerance of steps whose trajectories are accurate enough.

        Those of two tolerances are compared, and the next ones are what their difference suggests.
        """
        rtol, times = self.request.rtol, self._telling_times(FIELDS.tolerance_times)
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

    def _trajectories(self, points: Array) -> list[FieldTrajectory]:
        """Full trajectories, as far as there are some left."""
        most = self.request.trajectories
        if self.count + len(points) > most:
            cause = TooFewTrajectories(most, self._rank, self.worst)
            self.ended(Status.TRAJECTORY_LIMIT, cause)
            raise _SolvedEarlyError
        answers = self.integration.trajectories(points)
        self.count += len(points)
        self.seen += list(points)
        done = min(self.count / self.request.trajectories, 1.0)
        self.report(ProgressEvent(self.fields.horizon[0], done, 0, 0, self._rank))
        for trajectory in answers:
            np.maximum(self.scales, trajectory.largest, out=self.scales)
        return answers

    @property
    def _rank(self) -> int:
        return 0 if self.modes is None else len(self.modes.names)

    def _learn(self, trajectories: Iterable[FieldTrajectory]) -> None:
        """Take trajectories into the modes."""
        for trajectory in trajectories:
            self.states.add(trajectory.states)
            for snapshots, values in zip(self.pointwise, trajectory.pointwise, strict=True):
                snapshots.add(values)

    # --- modes -----------------------------------------------------------------------------

    def _train(self) -> tuple[ReducedSystem, list[Interpolation]]:
        """Modes that suffice at the points where residuals are worst."""
        while True:
            reduced, interpolations = self._reduced()
            points = self._worst(reduced, interpolations, FIELDS.at_once)
            trajectories = self._trajectories(points)
            errors = [self._error_of(reduced, trajectory) for trajectory in trajectories]
            self.worst = max(errors)
            self._tighten(trajectories, errors)
            self._learn(trajectories)
            if max(errors) <= FIELDS.reduced * self.request.rtol:
                return self._reduced()

    def _tighten(self, trajectories: Sequence[FieldTrajectory], errors: Sequence[float]) -> None:
        """Let modes leave out less, where the reduced system amplifies what they leave out."""
        for trajectory, error in zip(trajectories, errors, strict=True):
            missed = max(self._errors(self._projected(trajectory), trajectory))
            if error > max(FIELDS.added * missed, FIELDS.reduced * self.request.rtol):
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
        if self._rank <= FIELDS.most_modes:
            return
        worst = int(np.argmax(self.modes.counts))
        needed = self.modes.counts[worst]
        count = FIELDS.most_modes * needed // self._rank  # its share
        missed = self.states.missed(worst, count) / self.scales[worst]
        name = self.fields.unknowns[worst].name
        cause = SlowModes(name, count, missed, left_out, needed, self.count)
        self.ended(Status.RANK_LIMIT, cause)
        raise _SolvedEarlyError

    def _worst(
        self, reduced: ReducedSystem, interpolations: Sequence[Interpolation], count: int
    ) -> Array:
        """New points (count, d) at which the residual of the reduced system is largest."""
        assert self.modes is not None
        d = len(self.request.domain.box)
        if d == 0:
            return np.zeros((1, 0))
        points = self._candidates(FIELDS.candidates)
        times = self._telling_times(FIELDS.residual_times)
        states, ended = self._reduced_states(reduced, points, times, self.request.rtol)
        residual = FieldResidual(self.fields, self.modes, interpolations, reduced)
        r, m, count_times = states.shape
        flat = residual(
            np.tile(times, m), states.reshape(r, -1), np.repeat(points.T, count_times, axis=1)
        )
        heights = np.nan_to_num(flat, nan=np.inf).reshape(m, -1)
        heights = np.where(ended, 0.0, heights).max(axis=1)
        width = np.ptp(self.request.domain.bounds, axis=1)
        order = np.argsort(-heights, kind="stable")
        seen, chosen = list(self.seen), list[int]()
        for far in (FIELDS.distance, 0.0):  # where all of them are near, the worst
            for k in order:
                distance = (np.abs(np.array(seen) - points[k]) / width).max(axis=1).min()
                if len(chosen) < count and distance > far:
                    chosen.append(k)
                    seen.append(points[k])
        return points[chosen]

    def _candidates(self, count: int) -> Array:
        """So many evenly spread points, and as many corners."""
        d = len(self.request.domain.box)
        if d == 0:
            return np.zeros((1, 0))
        some = spread(count, d, self.generator), corners(d, count, self.generator)
        return self.coverage.points(np.concatenate(some))

    def _telling_times(self, count: int) -> Array:
        """Times after the start, ascending: half of them even, and half closer and closer to it."""
        start, end = self.fields.horizon
        half = count // 2
        even = np.linspace(0.0, 1.0, half + 1)[1:]
        return np.asarray(start + (end - start) * np.union1d(0.5 ** np.arange(2, half + 2), even))

    def _reduced_states(
        self, reduced: ReducedSystem, points: Array, times: Array, rtol: float
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Coefficients (R, m, T) of the reduced system at points (m, d); NaN beyond their end.

        And which times (m, T) are behind a terminal event.
        """
        absolute = rtol * reduced.scales[:, None]
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

    def _error_of(self, reduced: ReducedSystem, trajectory: FieldTrajectory) -> float:
        """The error of the reduced system at the point of a full trajectory."""
        accurate = FIELDS.finer * self.integration.tolerance

        def curve(times: Array) -> Array:
            states, _ = self._reduced_states(reduced, trajectory.point[None], times, accurate)
            return states[:, 0]

        return max(self._errors_along(curve, trajectory))

    def _errors_along(self, curve: Curve, trajectory: FieldTrajectory) -> list[float]:
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
        for k, exact in enumerate(trajectory.states):
            ours = self.modes.modes[k] @ coefficients[self.modes.coefficients_of(k)]
            difference = np.abs(ours - exact.at(counted)).max(initial=0.0)
            errors.append(float(difference / self.scales[k]) if self.scales[k] else 0.0)
        return [math.inf if math.isnan(error) else error for error in errors]

    # --- the solution ----------------------------------------------------------------------

    def _measured_solution(
        self, reduced: ReducedSystem, interpolations: list[Interpolation]
    ) -> None:
        """Solve the reduced system, and measure; what disagrees becomes modes, some times."""
        rtol = self.request.rtol
        wanted = FIELDS.solution * rtol
        for _ in range(FIELDS.rounds):
            with timed(self.timings, "solve"):
                outcome, metadata = self._solved(reduced, wanted)
            if not outcome.slabs or outcome.status not in _MEASURED:
                self.ended(outcome.status, ReducedEnds(outcome.message, self._rank))
                return
            self.result = replace(self.result, modes=self.modes, outcome=outcome, metadata=metadata)
            if not self.request.check:
                self.ended(Status.UNCHECKED)
                return
            with timed(self.timings, "check"):
                checked = self._check_trajectories(reduced, interpolations)
                curves = CoefficientCurves(outcome, self.fields, self._rank)
                errors = np.array([self._solution_errors(curves, each) for each in checked])
            assert self.modes is not None
            worst = errors.max(axis=0)
            self.modes = replace(
                self.modes,
                errors=tuple(worst.tolist()),
                scales=tuple(self.scales.tolist()),
                trajectories=self.count,
            )
            self.result = replace(self.result, modes=self.modes)
            error, name = float(worst.max()), self.fields.unknowns[int(worst.argmax())].name
            good = error <= rtol
            times = [curves.time_error(self.comparison, each) for each in checked]
            time_error = max(times) if self.fields.events else None
            cause = FieldError(error, name, len(checked), self.count, time_error)
            self.ended(Status.CONVERGED if good else Status.TOLERANCE, cause)
            if good:
                return
            of_modes = max(self._error_of(reduced, each) for each in checked)
            if of_modes > FIELDS.reduced * rtol:
                with timed(self.timings, "modes"):
                    self._learn(checked)
                    reduced, interpolations = self._train()
            else:
                wanted *= 0.25

    def _solved(self, reduced: ReducedSystem, wanted: float) -> tuple[Outcome, SolutionMetadata]:
        """The coefficients over the box, with fields as accurate as ``wanted``, if possible."""
        points, rtol = (
            self._candidates(FIELDS.coefficient_checks),
            FIELDS.solved / FIELDS.solution * wanted,
        )
        for _ in range(FIELDS.rounds):
            outcome, metadata = self._solved_to(replace(reduced, rtol=rtol))
            if not outcome.slabs or outcome.status not in _MEASURED or self.fields.events:
                break
            error = self._distance(reduced, outcome, points, FIELDS.finer * wanted)
            if error <= wanted:
                break
            rtol *= max(0.5 * wanted / error, FIELDS.finer)
        return outcome, metadata

    def _distance(
        self, reduced: ReducedSystem, outcome: Outcome, points: Array, rtol: float
    ) -> float:
        """How far the fields are from those of the reduced system at points (m, d)."""
        assert self.modes is not None
        times = self._telling_times(FIELDS.residual_times)
        states, _ = self._reduced_states(reduced, points, times, rtol)
        curves, worst = CoefficientCurves(outcome, self.fields, self._rank), 0.0
        for k, point in enumerate(points):
            difference = curves.at(point)(times) - states[:, k]
            for j, (modes, scale) in enumerate(zip(self.modes.modes, self.scales, strict=True)):
                gap = modes @ difference[self.modes.coefficients_of(j)]
                worst = max(worst, float(np.abs(gap).max()) / scale if scale else 0.0)
        return worst

    def _solved_to(self, reduced: ReducedSystem) -> tuple[Outcome, SolutionMetadata]:
        """The coefficients over the box by the cross engine."""
        request = self.request
        limits = Limits(FIELDS.effort * request.limits.operations, memory=request.limits.memory)
        check, options = Check(FIELDS.coefficient_checks), (request.options,)
        asked = SolveRequest(reduced.rtol, request.domain, check, limits, options, markers=False)
        return solve_with((cross_engine.ENGINE,), reduced.system, asked, reduced.metadata)

    def _check_trajectories(
        self, reduced: ReducedSystem, interpolations: Sequence[Interpolation]
    ) -> list[FieldTrajectory]:
        """Full trajectories at points that no mode has seen: spread ones, and the worst."""
        d = len(self.request.domain.box)
        if d == 0:
            return self._trajectories(np.zeros((1, 0)))
        even = self.coverage.points(spread(self.request.check, d, self.generator))
        self.seen += list(even)
        worst = self._worst(reduced, interpolations, FIELDS.worst_checks)
        del self.seen[-len(even) :]
        return self._trajectories(np.concatenate([even, worst, self.beside]))

    def _solution_errors(
        self, curves: CoefficientCurves, trajectory: FieldTrajectory
    ) -> list[float]:
        """The errors by unknown; infinite where the solution has other events."""
        if math.isinf(curves.time_error(self.comparison, trajectory)):
            return [math.inf] * len(self.fields.unknowns)
        return self._errors_along(curves.at(trajectory.point), trajectory)
