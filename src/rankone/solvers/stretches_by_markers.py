"""The reference of a solve, one for all attempts, over stretches where markers pay."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import TypeAlias, cast

import numpy as np

from rankone.solvers.request import Domain, SolveRequest
from rankone.solvers.tuning import SOLVE
from rankone.solvers.verification.cuts import system_cuts
from rankone.solvers.verification.points import check_points
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.arrays import Array
from rankone.support.budget import OutOfWorkError, limited, looking, memory_left, work_left
from rankone.trajectories.events.event_trajectory import EventTrajectory
from rankone.trajectories.events.markers import (
    SCOUTS,
    ForeseenMarks,
    chosen_markers,
    late_front,
    may_pay,
    swings_of,
    with_order,
)
from rankone.trajectories.events.periods import is_autonomous, repeating_from
from rankone.trajectories.events.sides import OrderError, event_order
from rankone.trajectories.events.stretch_integrator import StretchTrajectories
from rankone.trajectories.events.stretches import in_stretches, timed_events
from rankone.trajectories.integrators.integrator import (
    Path,
    SeparateTrajectories,
    SpanIntegrator,
    Spans,
    Tolerances,
    joined,
)
from rankone.trajectories.integrators.integrator_choice import span_integrator_for
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.stacks.newton import sparse_pattern
from rankone.trajectories.stacks.stack import has_smooth_rates
from rankone.trajectories.system.features import Ending, EventOrder
from rankone.trajectories.system.system import Clock, System


@dataclass
class _Kept:
    """The last reference set that was made, and what it was made for."""

    system: System | None = None
    request: SolveRequest | None = None
    reference_set: ReferenceSet | None = None


_KEPT: ContextVar[_Kept | None] = ContextVar("rankone_reference", default=None)


@contextmanager
def sharing_references() -> Iterator[None]:
    """Keep the last reference set of :func:`reference_set_of` for those inside that ask again."""
    token = _KEPT.set(_Kept())
    try:
        yield
    finally:
        _KEPT.reset(token)


def reference_set_of(
    system: System, request: SolveRequest, lines: Array | None, workers: Workers
) -> ReferenceSet:
    """The reference set of a system and a request: see :meth:`ReferenceSet.of`.

    One that was made for the same before is taken again, without its trajectories on ``lines``
    (m, d) where nobody asks for them. Nothing is kept where a user limits the memory.
    """
    kept, count = _KEPT.get(), 0 if lines is None else len(lines)
    if kept is None or request.limits.memory < math.inf:
        return ReferenceSet.of(system, request, lines, workers)
    reference_set = kept.reference_set
    if reference_set is not None and kept.system is system and kept.request is request:
        if count == reference_set.on_lines:
            return replace(reference_set, workers=workers)
        if not count and reference_set.reference.blown is None:
            return replace(reference_set.without_lines(), workers=workers)
    kept.reference_set = None  # two are not held at once
    integrated = ReferenceSet.of(system, request, lines, workers)
    kept.system, kept.request, kept.reference_set = system, request, integrated
    return integrated


# -----------------------------------------------------------------------------
# Solves over stretches between events or markers, where all trajectories are in step.


def clock_of(system: System, request: SolveRequest, more: int = 0) -> Clock:
    """The clock of a system with events, after some trajectories.

    Other trajectories may meet so many ``more`` events before the end of the horizon.

    Raises
    ------
    OrderError
        If the trajectories do not meet the same events in the same order.
    """
    domain = request.domain
    timed, cuts = timed_system(system, domain)
    points, tolerances = pilots(system, domain, SOLVE.order_pilot_rtol)
    chosen = span_integrator_for(timed, request.integrator)
    order = event_order(timed, points, domain.horizon, chosen, tolerances, more)
    return Clock(timed, order, domain.horizon, cuts)


def timed_system(system: System, domain: Domain) -> tuple[System, tuple[float, ...]]:
    """The system with all that happens at known times as events, and the cuts of its time."""
    in_time, *_ = system_cuts(system, domain)
    cuts = tuple(cut for cut in in_time.points if domain.horizon[0] < cut < domain.horizon[1])
    return timed_events(system, cuts), cuts


def pilots(system: System, domain: Domain, rtol: float) -> tuple[Array, Tolerances]:
    """Points (m, d) of trajectories that tell the order of events, and their tolerances."""
    points = check_points(
        domain.bounds, SOLVE.order_pilots, every_corner=True, scales=domain.coordinates
    )
    return points, Tolerances.down_to(rtol, SOLVE.pilot_floor * sizes_at_start(system, points))


def sizes_at_start(system: System, points: Array) -> Array:
    """The largest initial values of the states at points (m, d), (n, 1); none of them is zero."""
    largest = np.abs(system.initial(np.ascontiguousarray(points.T))).max(axis=1, keepdims=True)
    return np.where(largest > 0.0, largest, largest.max(initial=0.0) or 1.0)


def over_stretches(clock: Clock, request: SolveRequest) -> tuple[System, SolveRequest]:
    """The system and the request over the pseudo-time of its stretches."""
    domain, separated = request.domain, clock.system.separated_stretches
    system = in_stretches(clock) if separated is None else separated(clock, domain.box)
    domain = Domain(system.horizon, domain.box, domain.scales)
    return system, replace(request, domain=domain, observed=None)


# -----------------------------------------------------------------------------
# The reference of a solve: over stretches between markers where they pay, else over clock time.


_NO_ORDER = EventOrder((), Ending.EVENT)  # Before trajectories have told it

FirstPoints: TypeAlias = Callable[[System, SolveRequest], Array]
"""The points (m, d) whose trajectories an engine begins with."""


@dataclass(frozen=True)
class SolveStart:
    """A reference set, and the request of the solve for its system.

    They are over the stretches of a ``clock`` between markers, or over clock time without one.
    """

    request: SolveRequest
    reference_set: ReferenceSet
    clock: Clock | None = None


def start_of(
    workers: Workers, request: SolveRequest, markers: bool, first_points: FirstPoints | None = None
) -> SolveStart:
    """The reference, over stretches between markers if these are allowed and pay.

    It has trajectories at the ``first_points`` of an engine as well. Over clock time the
    ``workers`` of a system take part.

    Raises
    ------
    OrderError
        If trajectories do not meet the markers in the same order.
    """
    system = workers.system
    first_points = first_points or _nowhere
    lines = first_points(system, request)
    large = sparse_pattern(system) is not None  # over stretches the Jacobian is dense
    if system.events:
        return _by_events(system, request, first_points)
    if not markers or request.check.points == 0 or large or _interrupted(system):
        return SolveStart(request, reference_set_of(system, request, lines, workers))
    try:
        with looking(SOLVE.first_look_operations):
            reference_set = reference_set_of(system, request, lines, workers)
    except OutOfWorkError:
        if work_left() <= 0.0:
            raise
        start = _by_pilots(system, request, first_points)
        return start or SolveStart(request, reference_set_of(system, request, lines, workers))
    marked: SolveStart | None = None
    with suppress(OutOfWorkError), limited(SOLVE.marked_share * work_left()):
        marked = _by_reference(reference_set, request, first_points)
    return marked or SolveStart(request, reference_set)


def _nowhere(_system: System, request: SolveRequest) -> Array:
    """The first points of an engine that begins with none."""
    return np.zeros((0, len(request.domain.box)))


def goes_in_step(system: System, request: SolveRequest) -> bool:
    """Whether trajectories may go in step from event to event, of which none interrupts them."""
    marks = all(event.at is None and not event.interrupts for event in system.events)
    large = sparse_pattern(system) is not None
    checked = request.check.points > 0
    return bool(system.events) and marks and checked and not large and not _interrupted(system)


def _interrupted(system: System) -> bool:
    """Whether something happens at known times, beside which markers may come in any order."""
    features = system.features
    in_time = features.cuts[0] or features.periodic_cuts[0] or features.n_moving_cuts
    return bool(system.jumps.times or in_time)


def _by_reference(
    reference_set: ReferenceSet, request: SolveRequest, first_points: FirstPoints
) -> SolveStart | None:
    """The start over stretches, if markers pay for the trajectories of a reference."""
    system, reference = reference_set.system, reference_set.reference
    (dense,), sizes = reference.batches, reference_set.of_states[:, None]
    if reference.blown is not None or reference_set.cuts:
        return None
    separate = cast(SeparateTrajectories, dense)
    scouts = separate.of(SCOUTS).paths
    each = max(path.nbytes for path in scouts)
    if not may_pay(scouts) or SOLVE.path_copies * each * len(reference.points) > memory_left():
        return None
    tolerances = Tolerances.down_to(reference_set.accuracy, SOLVE.pilot_floor * sizes)
    return _by_paths(system, request, reference.points, separate.paths, tolerances, first_points)


def _by_pilots(
    system: System, request: SolveRequest, first_points: FirstPoints
) -> SolveStart | None:
    """The start over stretches, if markers pay for a few trajectories.

    They go over a part of the horizon at first, which is enough where all of them repeat.
    """
    points, tolerances = pilots(system, request.domain, SOLVE.marker_pilot_rtol)
    paths: Sequence[Path] = ()
    for paths in _pilot_paths(system, request, points, tolerances):
        try:
            start = _by_paths(system, request, points, paths, tolerances, first_points)
        except OrderError:  # perhaps they do not go on as they began
            if paths[0].end >= request.domain.horizon[1]:
                raise
            continue
        if start is not None:
            return start
    return _by_late_front(system, request, points, paths, first_points) if paths else None


def _pilot_paths(
    system: System, request: SolveRequest, points: Array, tolerances: Tolerances
) -> Iterator[Sequence[Path]]:
    """Trajectories at points (m, d) over parts of the horizon that end with all of it.

    None further where one does not reach the end of a part.
    """
    (start, end) = request.domain.horizon
    chosen = span_integrator_for(system, request.integrator)
    time, states, paths = start, system.initial(np.ascontiguousarray(points.T)), list[Path]()
    for share in SOLVE.pilot_shares if is_autonomous(system) else SOLVE.pilot_shares[-1:]:
        ends = np.full(len(points), end if share == 1.0 else start + share * (end - start))
        spans = Spans(np.full(len(points), time), states, ends)
        further = chosen.paths(system, points, spans, tolerances)
        if any(path.end < ends[0] for path in further):
            return
        paths = [joined(each) for each in zip(paths, further, strict=True)] if paths else [*further]
        time, states = float(ends[0]), np.stack([path.state for path in paths], axis=1)
        yield paths


def _by_events(system: System, request: SolveRequest, first_points: FirstPoints) -> SolveStart:
    """The start over stretches between events of the user that interrupt nothing."""
    points, tolerances = pilots(system, request.domain, SOLVE.marker_pilot_rtol)
    clock = Clock(system, _NO_ORDER, request.domain.horizon, in_step=True)
    for paths in _pilot_paths(system, request, points, tolerances):
        start = _in_step(clock, request, points, paths, tolerances, first_points)
        if start is not None:
            return start
    raise OrderError("trajectories do not pass the same events in step")


def _by_late_front(
    system: System,
    request: SolveRequest,
    points: Array,
    paths: Sequence[Path],
    first_points: FirstPoints,
) -> SolveStart | None:
    """The start over the stretches before and behind a front that many meet after the horizon."""
    if not is_autonomous(system):
        return None
    horizon = request.domain.horizon
    _, tolerances = pilots(system, request.domain, SOLVE.marker_pilot_rtol)
    chosen = span_integrator_for(system, request.integrator)
    try:
        with limited(SOLVE.late_share * work_left()):
            front = late_front(system, points, paths, horizon, chosen, tolerances)
    except OutOfWorkError:
        return None
    if front is None:
        return None
    marker, order = front
    clock = Clock(timed_events(system, (), (marker,)), order, horizon, (), (marker,))
    stretched, there = over_stretches(clock, request)
    lines = first_points(stretched, there)
    return SolveStart(there, ReferenceSet.of(stretched, there, lines), clock)


def _by_paths(
    system: System,
    request: SolveRequest,
    points: Array,
    paths: Sequence[Path],
    tolerances: Tolerances,
    first_points: FirstPoints,
) -> SolveStart | None:
    """The start over stretches, if markers pay for trajectories over clock time.

    Their paths may end before the horizon if they repeat.
    """
    domain = request.domain
    further = (domain.horizon[1] - domain.horizon[0]) / (paths[0].end - domain.horizon[0])
    markers = chosen_markers(system, paths, points, further)
    if not markers:
        return None
    timed = timed_events(system, (), markers)
    clock = Clock(timed, _NO_ORDER, domain.horizon, (), markers, in_step=True)
    return _in_step(clock, request, points, paths, tolerances, first_points)


def _in_step(
    clock: Clock,
    request: SolveRequest,
    points: Array,
    paths: Sequence[Path],
    tolerances: Tolerances,
    first_points: FirstPoints,
) -> SolveStart | None:
    """The start over stretches between the marks of a clock, along paths over clock time."""
    domain, system = request.domain, clock.system
    chosen = span_integrator_for(system, request.integrator)
    marked = with_order(chosen, clock, points, paths, tolerances)
    if marked is None or not marked[0].order.instants:
        return None
    clock, trajectories = marked
    clock = _foreseeing(clock, domain, points, trajectories)
    clock = replace(clock, swings=swings_of(paths, clock.length))
    whole, there = over_stretches(replace(clock, repeats_from=0), request)
    # samples end where they repeat: they cost less in steps of a series, or one by one
    samples_later = has_smooth_rates(system, domain.horizon[0]) or clock.steep
    lines = None if samples_later else first_points(whole, there)
    reference_set = ReferenceSet.of(whole, there, lines)  # to the end, whatever repeats
    clock = _after_reference(clock, chosen, reference_set)
    stretched, _ = over_stretches(clock, request)
    return SolveStart(there, replace(reference_set, system=stretched), clock)


def _foreseeing(
    clock: Clock, domain: Domain, points: Array, trajectories: Sequence[EventTrajectory]
) -> Clock:
    """The clock that foresees the marks of others by those of trajectories at points (m, d)."""
    count = len(clock.order.instants)
    times = np.array([[mark.time for mark in each.occurrences[:count]] for each in trajectories])
    gap = float(times.max() - domain.horizon[0]) / count
    return replace(clock, foreseen_marks=ForeseenMarks.fitted(domain.bounds, points, times, gap))


def _after_reference(
    clock: Clock, integrator: SpanIntegrator, reference_set: ReferenceSet
) -> Clock:
    """The clock for other trajectories: the accurate ones of a reference tell what is ahead.

    They tell from which mark on they repeat, too.
    """
    (dense,), points = reference_set.reference.batches, reference_set.reference.points
    assert isinstance(dense, StretchTrajectories)
    accuracy, trajectories = reference_set.accuracy, dense.trajectories
    clock = _foreseeing(clock, reference_set.domain, points, trajectories)
    return replace(
        clock, repeats_from=repeating_from(clock, integrator, points, trajectories, accuracy)
    )
