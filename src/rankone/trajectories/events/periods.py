"""Periods that repeat: an autonomous oscillator that has come back goes on as it went before.

A trajectory repeats once it has crossed its marker three times in a row in states, and after
times, that agree with those one period before. It is integrated no further then: it goes on as over
its last period. This takes no account of what happens at known times, so that the rates must
leave the time out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rankone.ir.system import Clock, System
from rankone.support.arrays import Array
from rankone.trajectories.events.event_trajectory import EventTrajectory
from rankone.trajectories.events.integration import integrate_to_events
from rankone.trajectories.integrator import SpanIntegrator, Tolerances
from rankone.trajectories.paths import joined

PERIOD = 2
"""Crossings of a marker in a period: rising and falling."""
_AGREEING = 3  # Crossings in a row that agree with those one period before
_FIRST, _MORE = 6, 1.5  # Crossings before they are compared first, and factor to the next time


def may_repeat(clock: Clock) -> bool:
    """Whether nothing but the states decides how trajectories go on between markers."""
    system = clock.system
    return bool(clock.markers) and len(system.events) == 1 and is_autonomous(system)


def is_autonomous(system: System) -> bool:
    """Whether the rates leave the time out: then they are finite also where it is not a number.

    Functions of the user may do as they like with it. Rates that switch at known times have cuts.
    """
    features = system.features
    if features.cuts[0] or features.n_moving_cuts or system.user_functions:
        return False
    p = np.array(system.box, dtype=float).reshape(-1, 2).mean(axis=1, keepdims=True)
    with np.errstate(all="ignore"):
        rates = system.rhs(math.nan, system.initial(p), p)
    return bool(np.isfinite(rates).all())


def begin_with_periods(
    clock: Clock,
    integrator: SpanIntegrator,
    points: Array,
    tolerances: Tolerances,
    count: int,
    begun: Sequence[EventTrajectory] = (),
) -> list[EventTrajectory]:
    """Trajectories at points (m, d) until they repeat, or to the end of the horizon.

    Those that repeat go on to the end and to a ``count`` of crossings. They may have ``begun``.
    """
    (start, end), events = clock.horizon, clock.system.events
    some, stage = [*begun], _FIRST
    first_ends = None
    if not some:
        last = clock.last_marks(points) if clock.last_marks else np.full(len(points), end)
        first_ends = start + min((_FIRST + 0.5) / max(count, 1), 1.0) * (last - start)

    def enough(trajectory: EventTrajectory, _edge: float) -> bool:
        return len(trajectory.occurrences) >= stage or repeats(trajectory, tolerances.relative)

    while True:
        some = integrate_to_events(
            integrator,
            clock.system,
            points,
            clock.horizon,
            tolerances,
            events,
            enough,
            some,
            first_ends,
            stage,
        )
        going = [each for each in some if each.end < end and not each.ends]
        if all(repeats(each, tolerances.relative) for each in going):
            break
        stage, first_ends = math.ceil(_MORE * stage), None
    return [
        repeated(each, count, end) if repeats(each, tolerances.relative) else each for each in some
    ]


def repeats(trajectory: EventTrajectory, accuracy: float) -> bool:
    """Whether the last crossings agree, to a relative accuracy, with those one period before.

    Each state is compared with its own size over the last period, however small it is.
    """
    if trajectory.period:
        return True
    last = trajectory.occurrences[-_AGREEING - PERIOD :]
    if len(last) < _AGREEING + PERIOD:
        return False
    times = np.array([each.time for each in last])
    periods = times[PERIOD:] - times[:-PERIOD]
    if np.ptp(periods) > accuracy * periods[-1]:
        return False
    states = np.array([each.before for each in last])
    changes = np.abs(states[PERIOD:] - states[:-PERIOD]).max(axis=0)
    path = joined(trajectory.paths)
    first = np.searchsorted(path.breaks, times[-1 - PERIOD], side="right") - 1
    sizes = np.abs(path.nodal[first:]).max(axis=(0, 1))
    return bool((changes <= accuracy * sizes).all())


def repeated(trajectory: EventTrajectory, count: int, end: float) -> EventTrajectory:
    """One that repeats, from its last crossing on as over its last period.

    It goes on to an end, and to a ``count`` of crossings.
    """
    marks = trajectory.occurrences
    last, period = marks[-1].time, marks[-1].time - marks[-1 - PERIOD].time
    begun = trajectory.paths[-1] if trajectory.period else joined(trajectory.paths).until(last)
    missing = math.ceil((count - len(marks)) / PERIOD)
    rounds = range(1, max(missing, math.ceil((end - last) / period)) + 1)
    further = [
        replace(each, time=each.time + k * period) for k in rounds for each in marks[-PERIOD:]
    ]
    return replace(trajectory, paths=[begun], occurrences=[*marks, *further], period=period)
