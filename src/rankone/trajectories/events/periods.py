"""Periods that repeat: an autonomous oscillator that has come back goes on as it went before.

A trajectory repeats once it has crossed its markers three times in a row in states, and after
times, that agree with those one period before. It is integrated no further then: it goes on as over
its last period. This takes no account of what happens at known times, so that the rates must
leave the time out, and none of what grows unseen, so that periods must not magnify small changes of
the states: Floquet multipliers tell (Guckenheimer & Holmes, Nonlinear Oscillations, 1983, 1.5).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.support.arrays import MINOR, NEGLIGIBLE, ROUNDING, TINY, Array
from rankone.trajectories.events.event_integration import Ahead, Goal, integrate_to_events
from rankone.trajectories.events.event_trajectory import EventTrajectory, Occurrence
from rankone.trajectories.integrators.integrator import (
    Path,
    SpanIntegrator,
    Spans,
    Tolerances,
    joined,
)
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.system.features import Ending, Foreseen
from rankone.trajectories.system.system import Clock, System

FAR = 10.0
"""Horizons beyond the horizon up to which events are waited for."""


@dataclass(frozen=True)
class _Repeating:
    """When a trajectory repeats, and how stable that has to be."""

    agreeing: int
    phase: float
    rough: float
    more: float
    changed: int
    fewest: int
    change: float
    most_growth: float


_REPEATING = _Repeating(
    agreeing=3,  # Crossings in a row that agree with those one period before
    # Error of marks that are foreseen, in times of a swing, above which less accurate trajectories
    # tell them, and the tolerance of these times the swings over the horizon
    phase=100.0,
    rough=MINOR,
    more=1.5,  # Factor from the crossings before they are compared first to those at the next time
    # Multipliers are those of a few trajectories, so many in all with the changed ones, over a
    # period, by relative changes of the states and at a relative tolerance
    changed=64,
    fewest=2,
    change=1e-4,
    most_growth=30.0,  # Factor by which changes may grow over the periods that are left out
)


def repeating_from(
    clock: Clock,
    integrator: SpanIntegrator,
    points: Array,
    trajectories: Sequence[EventTrajectory],
    accuracy: float,
) -> int:
    """The count of marks after which trajectories repeat, and go on so to the end of the horizon.

    Nothing but the states may decide how they go on, and some at points (m, d), which repeat to a
    relative accuracy, tell that these are stable as soon as they do. It is 0 where none repeats, or
    not stably.
    """
    system = clock.system
    if not clock.in_step or not is_autonomous(system):
        return 0
    count = max(_REPEATING.changed // (system.n_differential + 1), _REPEATING.fewest)
    places = {round(place) for place in np.linspace(0, len(trajectories) - 1, count).tolist()}
    repeating = [
        (k, first)
        for k in sorted(places)
        if (first := _first_repeated(trajectories[k], accuracy, clock.marks_per_period)) is not None
    ]
    marks = [trajectories[k].occurrences[: first + 1] for k, first in repeating]
    if not marks or max(each[-1].time for each in marks) >= clock.horizon[1]:
        return 0  # nothing would be left out
    growth = _growth(clock, integrator, points[[k for k, _ in repeating]], marks)
    stable = bool((growth < _REPEATING.most_growth).all())
    return 1 + max(first for _, first in repeating) if stable else 0


def _growth(
    clock: Clock, integrator: SpanIntegrator, points: Array, marks: Sequence[Sequence[Occurrence]]
) -> Array:
    """By what small changes of trajectories grow from their last marks to the horizon's end: (m,).

    Of each of m trajectories, each of n states is changed on its own; all are one stack.
    """
    last = np.array([each[-1].time for each in marks])
    periods = last - np.array([each[-1 - clock.marks_per_period].time for each in marks])
    states = np.stack([each[-1].before for each in marks])  # (m, n)
    sizes = np.maximum(np.abs(states), TINY)
    m, n = states.shape
    changes = np.concatenate([np.zeros((1, n)), _REPEATING.change * np.eye(n)])
    changed = (states[:, None] + changes * sizes[:, None]).reshape(-1, n).T
    spans = Spans(np.zeros(m * (n + 1)), changed, np.repeat(periods, n + 1))
    tolerances = Tolerances.down_to(NEGLIGIBLE, _REPEATING.change * sizes.min(axis=0)[:, None])
    paths = integrator.paths(clock.system, np.repeat(points, n + 1, axis=0), spans, tolerances)
    if any(path.end < end for path, end in zip(paths, spans.ends, strict=True)):
        return np.full(m, math.inf)
    ends = np.stack([path.state for path in paths]).reshape(m, n + 1, n)
    over_period = (ends[:, 1:] - ends[:, :1]) / (
        _REPEATING.change * sizes[:, None]
    )  # (m, changed, n)
    largest = np.abs(np.linalg.eigvals(over_period)).max(axis=1)
    return np.asarray(np.maximum(largest, 1.0) ** ((clock.horizon[1] - last) / periods))


def is_autonomous(system: System) -> bool:
    """Whether the rates leave the time out: then they are finite also where it is not a number.

    So are the surfaces on which they switch. Functions of the user may do as they like with the
    time. Rates that switch at known times have cuts.
    """
    features = system.features
    if features.cuts[0] or features.n_moving_cuts or system.user_functions:
        return False
    p = np.array(system.box, dtype=float).reshape(-1, 2).mean(axis=1, keepdims=True)
    with np.errstate(all="ignore"):
        at = math.nan, system.initial(p), p
        values = [*system.rhs(*at), *features.state_surfaces(*at)]
    return all(bool(np.isfinite(each).all()) for each in values)


def begin_in_step(
    clock: Clock,
    integrator: SpanIntegrator,
    points: Array,
    tolerances: Tolerances,
    count: int,
    begun: Sequence[EventTrajectory] = (),
) -> list[EventTrajectory]:
    """Trajectories at points (m, d), from some crossings of their markers to further ones.

    So they stay in phase, and a stack takes few common steps. They go on to the end of the horizon,
    or until they repeat if the ``clock`` says so: then they go on to the end as they did, and to a
    ``count`` of crossings. They may have ``begun``.
    """
    (start, end), period = clock.horizon, clock.marks_per_period
    far = end if clock.order.ending is Ending.HORIZON else end + FAR * clock.length
    some = [*begun]
    answers = dict[Occurrence, bool]()  # by the last mark, which copies share

    def settled(trajectory: EventTrajectory) -> bool:
        if not clock.repeats_from or not trajectory.occurrences:
            return False
        last = trajectory.occurrences[-1]
        if last not in answers:
            answers[last] = repeats(trajectory, tolerances.relative, period)
        return answers[last]

    def has_passed(trajectory: EventTrajectory) -> bool:
        return len(trajectory.occurrences) >= count and trajectory.end >= end

    def enough(trajectory: EventTrajectory, _edge: float) -> bool:
        some_passed = count > len(trajectory.occurrences) >= stage
        return some_passed or has_passed(trajectory) or settled(trajectory)

    foreseen = None if begun else _foreseen(clock, points, tolerances, count, far)
    for stage in _stages(clock, count, bool(begun)):
        marks, ahead = min(stage, count), None
        if foreseen:
            ahead = _ahead(clock, foreseen, some, marks, far)
        goal = Goal(enough, ahead, marks)
        some = integrate_to_events(
            integrator, clock.system, points, (start, far), tolerances, goal, some
        )
        if all(has_passed(each) or settled(each) or each.end >= far or each.ends for each in some):
            break
    return [repeated(each, period, count, end) if settled(each) else each for each in some]


def _stages(clock: Clock, count: int, begun: bool) -> Iterator[int]:
    """Counts of marks at which trajectories are brought in phase again, without an end.

    The first mark puts them in phase. Then they go to where they may repeat, if they do so from
    some mark on, and a few periods further each time; others go half as far again. Where the flow
    is steep they are in phase at each mark, and all of the ``count`` are foreseen.
    """
    if not begun and not clock.steep:
        yield 1
    period = clock.marks_per_period
    stage, rounds = _first_period(clock), 1
    if clock.steep and not begun and not clock.repeats_from:
        stage = count
    while True:
        yield stage
        if clock.repeats_from:
            stage, rounds = stage + rounds * period, 2 * rounds
        else:
            stage = period * math.ceil(_REPEATING.more * stage / period)


def _first_period(clock: Clock) -> int:
    """The count of marks after which trajectories may repeat, after a first one on the way."""
    return max(clock.repeats_from, _REPEATING.agreeing + clock.marks_per_period + 1)


def _foreseen(
    clock: Clock, points: Array, tolerances: Tolerances, count: int, far: float
) -> Foreseen:
    """What the clock foresees of a ``count`` of marks, or else marks that are evenly spaced.

    Where the flow is so steep that this is too rough, the marks are those of less accurate
    trajectories.
    """
    if clock.foreseen_marks is None:
        gap = clock.length / count
        times = np.tile(clock.horizon[0] + gap * np.arange(1, count + 1), (len(points), 1))
        return Foreseen(times, np.full(count, 0.5 * gap), clock.length)
    foreseen = clock.foreseen_marks(points, count)
    swing = clock.length / max(clock.swings, 1.0)
    rough = max(_REPEATING.rough / max(clock.swings, 1.0), tolerances.relative)
    if (
        not clock.steep
        or foreseen.missed <= _REPEATING.phase * swing
        or rough <= tolerances.relative
    ):
        return foreseen
    start, system = clock.horizon[0], clock.system

    def enough(trajectory: EventTrajectory, _edge: float) -> bool:
        return len(trajectory.occurrences) >= count

    looser = tolerances.times(rough / tolerances.relative)
    ahead = Ahead(None, np.minimum(foreseen.times[:, -1] + foreseen.margins[-1], far))
    goal = Goal(enough, ahead, count)
    trajectories = integrate_to_events(
        SingleIntegrator(), system, points, (start, far), looser, goal
    )
    if any(len(each.occurrences) < count for each in trajectories):
        return foreseen
    times = np.array([[mark.time for mark in each.occurrences[:count]] for each in trajectories])
    return replace(foreseen, times=times)


def _ahead(
    clock: Clock, foreseen: Foreseen, some: Sequence[EventTrajectory], stage: int, far: float
) -> Ahead | None:
    """What is ahead of trajectories up to so many marks.

    First as it is foreseen; then as over the last period of each of them. Marks are told where the
    flow is steep.
    """
    if stage <= _first_period(clock) or not some:
        marks = foreseen.times[:, :stage]
        ends = np.minimum(marks[:, -1] + foreseen.margins[stage - 1], far)
        return Ahead(None if some or not clock.steep else marks, ends)
    further = stage - np.array([len(each.occurrences) for each in some])
    if not clock.steep or further.min() != further.max() or further[0] < 1:
        return None
    each_ahead = [each.marks_ahead(int(further[0])) for each in some]
    foreseen_marks = [marks for marks in each_ahead if marks is not None]
    return Ahead(np.array(foreseen_marks)) if len(foreseen_marks) == len(some) else None


def repeats(trajectory: EventTrajectory, accuracy: float, period: int) -> bool:
    """Whether the last crossings agree, to a relative accuracy, with those one period before.

    A ``period`` has so many crossings. Each state is compared with its own swing over the last one,
    however small it is.
    """
    marks = trajectory.occurrences[-_REPEATING.agreeing - period :]
    return trajectory.period > 0.0 or _agree(trajectory, marks, accuracy, period)


def _first_repeated(trajectory: EventTrajectory, accuracy: float, period: int) -> int | None:
    """The place of the first crossing at which a trajectory repeats."""
    marks, count = trajectory.occurrences, _REPEATING.agreeing + period
    last = range(count - 1, len(marks))
    alike = (k for k in last if _agree(trajectory, marks[k + 1 - count : k + 1], accuracy, period))
    return next(alike, None)


def _agree(
    trajectory: EventTrajectory, marks: Sequence[Occurrence], accuracy: float, period: int
) -> bool:
    """Whether crossings in a row agree, those of two periods."""
    if len(marks) < _REPEATING.agreeing + period:
        return False
    if any(a.event != b.event for a, b in zip(marks, marks[period:], strict=False)):
        return False
    times = np.array([each.time for each in marks])
    periods = times[period:] - times[:-period]
    if np.ptp(periods) > accuracy * periods[-1]:
        return False
    states = np.array([each.before for each in marks])
    changes = np.abs(states[period:] - states[:-period]).max(axis=0)
    nodal = _over(trajectory.paths, *times[[-1 - period, -1]].tolist())
    swings = np.ptp(nodal, axis=0)
    return bool((changes <= accuracy * swings + ROUNDING * np.abs(nodal).max(axis=0)).all())


def _over(paths: Sequence[Path], start: float, end: float) -> Array:
    """States (N, n) at the nodes of the steps from one time to another."""
    nodal = list[Array]()
    for path in paths:
        if path.steps and path.breaks[0] <= end and start < path.end:
            first, last = np.searchsorted(path.breaks, [start, end], side="right") - 1
            nodal.append(path.nodal[max(first, 0) : last + 1].reshape(-1, path.state.size))
    return np.concatenate(nodal)


def repeated(trajectory: EventTrajectory, marks: int, count: int, end: float) -> EventTrajectory:
    """One that repeats, from its last crossing on as over its last period, of so many ``marks``.

    It goes on to an end, and to a ``count`` of crossings.
    """
    passed = trajectory.occurrences
    last, period = passed[-1].time, passed[-1].time - passed[-1 - marks].time
    begun = trajectory.paths[-1] if trajectory.period else joined(trajectory.paths).until(last)
    missing = math.ceil((count - len(passed)) / marks)
    rounds = range(1, max(missing, math.ceil((end - last) / period)) + 1)
    further = [
        Occurrence(each.event, each.time + k * period, each.before, each.after)
        for k in rounds
        for each in passed[-marks:]
    ]
    return replace(trajectory, paths=[begun], occurrences=[*passed, *further], period=period)
