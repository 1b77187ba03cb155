"""The cross engine: interpolate, check against SciPy, ask for more where it does not suffice."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import ClassVar

import numpy as np

from rankone.solvers.attempts import CLOSE_ERROR_RATIO, Attempt, Progress
from rankone.solvers.engines.cross_samples import (
    LineLimits,
    TooManyTrajectories,
    Trajectories,
    TrajectoryEnds,
    WorstLines,
    first_jump,
    steepest_front,
    worst_lines,
)
from rankone.solvers.engines.engine_options import (
    CROSS,
    TIGHTENING,
    AttemptCost,
    CrossOptions,
    CrossRecord,
)
from rankone.solvers.march import MarchResult
from rankone.solvers.request import SolveRequest
from rankone.solvers.verification.cuts import Cuts, in_scale, resolving_pieces
from rankone.solvers.verification.points import FEW_PARAMETERS, candidate_points, steepest_point
from rankone.solvers.verification.reference import Reference
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.solvers.ways import Engine
from rankone.support.arrays import ACCUMULATED, Array
from rankone.support.budget import (
    OutOfBudgetError,
    OutOfWorkError,
    ProgressEvent,
    Report,
    unlimited,
    work_done,
    work_left,
)
from rankone.tensors import BASES, Basis1D
from rankone.tensors.adaptive import TUNING as INTERPOLATION
from rankone.tensors.adaptive import (
    AdaptiveInterpolation,
    InterpolationLimits,
    KnownElements,
    LinePoints,
    Lines,
)
from rankone.tensors.basis import nodes_for
from rankone.tensors.slab import LineColumns, slab_trains
from rankone.tensors.time_grid import TimeGrid, resolving_breaks
from rankone.tensors.train import Train
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import (
    Cause,
    MemoryNeeded,
    MovingFeatures,
    Status,
    SteepParameter,
    TrajectoryStops,
)

# Failures for which a steep dependence on a parameter may be the reason
_UNRESOLVED = (
    Status.TOLERANCE,
    Status.RANK_LIMIT,
    Status.NODE_LIMIT,
    Status.TRAJECTORY_LIMIT,
    Status.WORK_LIMIT,
    Status.TIME_LIMIT,
)


class _JumpFound(Exception):
    """The solution jumps along a parameter: no number of nodes resolves it."""


class Pace:
    """The part of an attempt that is done: first lines through the box, then a sweep over bonds."""

    def __init__(self, report: Report, event: ProgressEvent) -> None:
        self.report, self.event = report, event
        self._stage = 0.0, CROSS.lines_fraction

    def bond(self, done: int, total: int, rank: int) -> None:
        """A sweep begins a bond after ``done`` of them; ``rank`` is the largest so far."""
        width = (1.0 - CROSS.lines_fraction) / total
        begin = CROSS.lines_fraction + done * width
        self._stage = begin, begin + width
        self.event = replace(self.event, rank=max(rank, self.event.rank))
        self.batch(0.0)

    def batch(self, share: float) -> None:
        """A share of the trajectories that are being integrated is done."""
        begin, end = self._stage
        fraction = begin + share * (end - begin)
        if fraction >= self.event.fraction + CROSS.reported_fraction:
            self.event = replace(self.event, fraction=fraction)
            self.report(self.event)


class CrossMarcher:
    """Interpolates the whole horizon at once, each time with more nodes, points or accuracy."""

    remedies: ClassVar[Mapping[Status, str]] = {
        Status.RANK_LIMIT: "raise max_rank, narrow the box or loosen rtol",
        Status.NODE_LIMIT: "raise max_nodes, narrow the box or loosen rtol",
        Status.SLAB_LIMIT: "raise max_slabs or shorten the horizon",
        Status.TRAJECTORY_LIMIT: (
            "raise max_trajectories of method='cross', narrow the box or loosen rtol"
        ),
        Status.NO_CONVERGENCE: "narrow the box or shorten the horizon",
        Status.TOLERANCE: "loosen rtol, narrow the box or shorten the horizon",
        Status.STEEP: "narrow the box or shorten the horizon",
    }

    def __init__(
        self, request: SolveRequest, reference_set: ReferenceSet, workers: Workers
    ) -> None:
        self.workers = workers
        self.rtol, self.options = request.rtol, request.options_of(CrossOptions)
        self.reference_set = reference_set
        marked = _is_marked(reference_set.system)
        self.adaptive = _interpolation(reference_set.system, request)
        self.breaks: set[float] = set()
        self.worst: list[tuple[float, ...]] = []
        self.trajectories: Trajectories | None = None
        self.integrated, self.error, self.ends = 0, np.inf, reference_set.end
        self.tightness = CROSS.first_marked_tightness if marked else CROSS.first_tightness
        self.integrators: tuple[str, str] | None = None
        self.last: AttemptCost | None = None
        self.jump: SteepParameter | None = None
        self.search_work = 0.0

    def march(self, number: int, report: Report) -> MarchResult:
        """Interpolate over the whole horizon."""
        level = self.adaptive.level
        grid = self._grid(level)
        if grid is None:
            return MarchResult(stopped=Status.SLAB_LIMIT)
        pace = Pace(report, ProgressEvent(grid.breaks[0], 0.0, number, grid.slabs, 1))
        self.trajectories = trajectories = Trajectories(
            self.reference_set,
            grid,
            CROSS.integration_share * level,
            self.tightness,
            self.options.max_trajectories - self.integrated,
            self.workers,
            pace.batch,
        )
        if self.integrators is not None:
            trajectories.integrator, trajectories.taken = self.integrators
        try:
            march = self._marched(trajectories, level, number, pace)
        except _JumpFound:
            march = self._stopped(Status.STEEP, grid)
        except TooManyTrajectories:
            march = self._stopped(Status.TRAJECTORY_LIMIT, grid)
        except OutOfBudgetError as out:
            march = self._stopped(Status.of_limit(out), grid)
            march.memory_needed = MemoryNeeded.of(out)
        except TrajectoryEnds as ends:
            march = MarchResult(stopped=Status.NO_CONVERGENCE, points=ends.point[None, :])
            self.ends = ends.time
        self.integrated += trajectories.count
        self.tightness = trajectories.tightness
        self.integrators = trajectories.integrator, trajectories.taken
        march.sampled = trajectories.work
        return march

    def _marched(
        self, trajectories: Trajectories, level: float, number: int, pace: Pace
    ) -> MarchResult:
        """The interpolation of trajectories, with its record."""
        march, grid, before = MarchResult(), trajectories.grid, work_done()
        self.search_work = 0.0
        train, limited = self.adaptive.interpolate(
            trajectories, self._known_elements, pace.bond, self._consider
        )
        bases, spectra = self.adaptive.bases or (), self.adaptive.spectra
        if limited:
            march.limits.add(Status.RANK_LIMIT)
        if any(basis.size >= self.options.max_nodes for basis in bases):
            march.limits.add(Status.NODE_LIMIT)
        states = trajectories.states(train.first)
        march.slabs = list(slab_trains(grid, train.with_first(states), bases))
        march.points = candidate_points(march.slabs, trajectories.sizes, number, self.rtol)
        start, end = grid.breaks[0], grid.breaks[-1]
        tails = tuple(b.tail(spectrum) for b, spectrum in zip(bases, spectra, strict=True))
        sizes = tuple(basis.size for basis in bases)
        counts = trajectories.count, grid.slabs
        record = CrossRecord(number, start, end, True, level, tails, train.ranks, sizes, *counts)
        record = replace(record, integrator=trajectories.taken)
        march.records.append(record)
        work = work_done() - before - self.search_work
        self.last = AttemptCost(sizes, train.ranks, trajectories.count, work)
        pace.report(ProgressEvent(end, 1.0, number, grid.slabs, max(train.ranks, default=1)))
        return march

    def _consider(self, bases: Sequence[Basis1D]) -> None:
        """Raise an error if an attempt with these bases would be in vain.

        An OutOfWorkError if it would not come to its end. In the first attempt a _JumpFound if
        lines that are not resolved hold a jump, or that meet events: beside a jump these are found
        at some points and missed at others.
        """
        if self.last is not None and bases:
            if self.last.least([basis.size for basis in bases]) > work_left():
                raise OutOfWorkError
            return
        rough = self.adaptive.unresolved(bases)
        if self._meets_events:
            rough += self.adaptive.with_jumps(bases)
        if rough and self.trajectories is not None:
            domain, system = self.reference_set.domain, self.reference_set.system
            points = LinePoints(domain.box, domain.first_coordinates).through
            before = work_done()
            jump = first_jump(self.trajectories.uncounted, system, domain, points, rough)
            self.search_work = work_done() - before
            if jump is not None and jump.change > self.rtol:
                self.jump = jump
                raise _JumpFound

    @property
    def _meets_events(self) -> bool:
        """Whether the stretches are those between events that are met at times of their own."""
        system = self.reference_set.system
        return system.clock is not None and not system.clock.in_step

    def _stopped(self, status: Status, grid: TimeGrid) -> MarchResult:
        """The trajectory at the centre for every parameter, which is better than nothing."""
        reference_set, basis_type = self.reference_set, BASES[self.options.basis]
        box = reference_set.domain.box
        bases = tuple(basis_type(lower, upper, INTERPOLATION.least_nodes) for lower, upper in box)
        constant = [np.sqrt(basis.weights)[None, :, None] for basis in bases]
        with unlimited():
            states = reference_set.reference.of(slice(1))(grid.times)
            centre = reference_set.seen(grid.times, states, slice(1))[:, 0, :, None]
        train = Train((centre, *constant)).apply_to_modes([basis.to_modal for basis in bases])
        return MarchResult(list(slab_trains(grid, train, bases)), stopped=status, whole=True)

    def _grid(self, level: float) -> TimeGrid | None:
        """Slabs that resolve the reference, or None if there are too many."""
        reference_set = self.reference_set
        start, end = reference_set.reference.start, reference_set.end
        between = {*reference_set.cuts, *self.breaks}
        edges = [start, *sorted(cut for cut in between if cut < end), end]
        units = reference_set.states[:, None, None]
        count = self.options.nodes_in_time(self.rtol)
        highest_modes = CROSS.highest_time_modes_share * level
        tolerance = max(highest_modes, ACCUMULATED)

        breaks: Sequence[float] = edges
        # slabs that do not resolve some trajectories need no look at all of them
        for some in (slice(CROSS.worst_points), slice(None)):
            reference = reference_set.reference.of(some)

            def in_units(times: Array, reference: Reference = reference, s: slice = some) -> Array:
                return reference_set.seen(times, reference(times), s) / units

            most, held = self.options.max_slabs, reference.times_held
            finer = resolving_breaks(in_units, breaks, count, tolerance, most, held)
            if finer is None:
                return None
            breaks = finer
        return TimeGrid(tuple(breaks), count)

    def _known_elements(self, nodes: int) -> list[KnownElements]:
        """Elements of ``nodes`` nodes that resolve the known functions of each parameter."""
        reference_set, known_elements = self.reference_set, []
        tolerance = CROSS.known_functions_share * self.adaptive.level
        domain = reference_set.domain
        for j, (interval, scale) in enumerate(
            zip(domain.box, domain.first_coordinates, strict=True)
        ):
            cuts = reference_set.parameter_cuts[j] if reference_set.parameter_cuts else Cuts()
            if cuts.smooth:
                known_elements.append(KnownElements(cuts.points))
                continue
            factors = partial(reference_set.system.parameter_factors, j)
            scaled, ends = in_scale(factors, interval, scale)
            places = scale.to_scale(np.array(cuts.points)).tolist()
            for count in (nodes, *(round(ratio * nodes) for ratio in CROSS.known_node_ratios)):
                pieces = resolving_pieces(scaled, *ends, places, count, tolerance)
                if count == nodes:
                    begins = np.array([a for a, _ in pieces[1:]])
                    borders = scale.from_scale(begins).tolist()
                if len(pieces) == 1:
                    known_elements.append(KnownElements(least_nodes=count))
                    break
            else:
                known_elements.append(KnownElements(borders))
        return known_elements

    def refine(self, attempt: Attempt, progress: Progress) -> bool:
        """More nodes where the highest modes are not small, more points, or more accuracy."""
        adaptive = self.adaptive
        if attempt.result.stopped or adaptive.bases is None:
            return False
        if attempt.error > self.error and adaptive.undo_division():
            return True
        self._halve_slabs()
        adaptive.steep, adaptive.doubtful = attempt.result.points, attempt.result.doubtful
        if adaptive.doubtful is not None:  # lines through these first
            steep = [] if adaptive.steep is None else [adaptive.steep]
            adaptive.steep = np.concatenate([adaptive.doubtful, *steep])
        grows = adaptive.adds_elements
        patient = progress.pays or self._patient(attempt, progress.stalls, grows)
        self.error = attempt.error
        if not patient:
            return False
        close = attempt.error < CLOSE_ERROR_RATIO * self.rtol
        tighten = close or (progress.stalls > 0 and not grows)
        lines = self._worst_lines(attempt)
        if self.worst:
            doubtful = [] if adaptive.doubtful is None else [adaptive.doubtful]
            adaptive.doubtful = np.concatenate([*doubtful, np.array(self.worst)])
        explained = lines is not None and not close and lines.explain(attempt.error)
        least = () if lines is None else lines.nodes
        adaptive.refine(attempt.error, tighten, least, explained)
        return True

    def _worst_lines(self, attempt: Attempt) -> WorstLines | None:
        """What lines through the latest worst points tell; None with a single parameter."""
        bases, domain = self.adaptive.bases, self.reference_set.domain
        if self.trajectories is None or not bases or len(bases) < 2 or attempt.measured is None:
            return None
        if attempt.measured.worst:
            latest = [attempt.measured.worst, *attempt.measured.also_bad, *self.worst]
            self.worst = list(dict.fromkeys(latest))[: CROSS.worst_points]
        if not self.worst:
            return None
        points, trajectories = (
            np.array(self.worst[: INTERPOLATION.max_steep_lines]),
            self.trajectories,
        )
        share = CROSS.lines_budget_share * work_left()
        affordable = max(trajectories.count, share / trajectories.work_of_each)
        limits = LineLimits(self.options.max_nodes, affordable)
        try:
            return worst_lines(trajectories.uncounted, domain, bases, points, self.rtol, limits)
        except (OutOfBudgetError, TrajectoryEnds):
            return None

    def _patient(self, attempt: Attempt, stalls: int, grows: bool) -> bool:
        """Whether another attempt may be worth its cost; ``grows``: it has more elements."""
        if self.integrated < CROSS.cheap_trajectories:
            return grows or stalls < CROSS.max_stalls
        affordable = CROSS.untightened_ratio * CROSS.cheap_trajectories
        if self.adaptive.share == 1.0 and self.integrated < affordable:
            return True
        far, fast = CLOSE_ERROR_RATIO * self.rtol, CROSS.fast_error_ratio * self.error
        return stalls < CROSS.max_costly_stalls and attempt.error < max(far, fast)

    def _halve_slabs(self) -> None:
        """Halve the slabs on which some trajectory varies more than those of the reference."""
        assert self.trajectories is not None
        breaks = np.array(self.trajectories.grid.breaks)
        tolerance = CROSS.highest_time_modes_share * self.adaptive.share * self.rtol
        rough = self.trajectories.highest_modes > tolerance
        self.breaks |= {*(0.5 * (breaks[:-1] + breaks[1:])[rough]).tolist()}

    def modes_on_lines(self) -> list[tuple[Basis1D, Array]]:
        """Bases, and the sizes of their modes on the lines that choose them."""
        trajectories, domain = self.trajectories, self.reference_set.domain
        if trajectories is None:
            return []
        count = round(CROSS.line_node_ratio * nodes_for(self.rtol, 4.0))
        kind, modes = BASES[self.options.basis], list[tuple[Basis1D, Array]]()

        def columns(points: Array) -> Array:
            states = trajectories.uncounted(points)
            return states.reshape(-1, len(points)) / math.sqrt(states.shape[1])

        scales = domain.first_coordinates
        lines = Lines(columns, LinePoints(domain.box, scales))
        for j, ((lower, upper), scale) in enumerate(zip(domain.box, scales, strict=True)):
            basis = kind(lower, upper, count, scale=scale)
            try:
                (on_line,) = lines([(j, basis.nodes)])
            except TrajectoryEnds:
                return []
            modes.append((basis, LineColumns(basis, on_line).spectrum))
        return modes

    def explained(self, status: Status, attempt: Attempt) -> tuple[Status, Cause | None]:
        """Whether a steep dependence on a parameter is the reason, and on which."""
        trajectories, domain = self.trajectories, self.reference_set.domain
        if self.jump is not None:
            return status, self.jump
        if status is Status.NO_CONVERGENCE:
            return status, TrajectoryStops(float(self.ends))
        system = self.reference_set.system
        moves = system.features.n_moving_cuts > 0 and status in (*_UNRESOLVED, Status.SLAB_LIMIT)
        cause = MovingFeatures() if moves else None
        if status not in _UNRESOLVED or trajectories is None or not domain.box:
            return status, cause
        # later attempts cost more
        trajectories.allowed_error = CROSS.integration_share * self.rtol
        lines = [domain.bounds.mean(axis=1)]
        try:
            if attempt.result.slabs:
                lines.append(steepest_point(attempt.result.slabs[-1], trajectories.sizes))
            front = steepest_front(trajectories.uncounted, system, domain, lines)
        except (OutOfBudgetError, TrajectoryEnds):
            front = None
        return (status, cause) if front is None else (Status.STEEP, front)


def _is_marked(system: System) -> bool:
    """Whether a system runs in stretches between markers."""
    return system.clock is not None and system.clock.in_step


def _interpolation(system: System, request: SolveRequest) -> AdaptiveInterpolation:
    """The interpolation of a solve, before its first attempt."""
    options, domain = request.options_of(CrossOptions), request.domain
    basis, most = BASES[options.basis], (options.max_nodes, options.max_rank)
    limits = InterpolationLimits(basis, *most, polynomials=system.at_point is not None)
    target = (CROSS.first_marked_level if _is_marked(system) else 1.0) * request.rtol
    return AdaptiveInterpolation(domain.box, limits, target, TIGHTENING, domain.first_coordinates)


def _first_points(system: System, request: SolveRequest) -> Array:
    """The points of the first lines, where they are few beside the check points."""
    points = _interpolation(system, request).first_points
    return points if len(request.domain.box) <= FEW_PARAMETERS else points[:0]


ENGINE = Engine("cross", CrossOptions, CrossRecord, CrossMarcher, _first_points, observes=True)
