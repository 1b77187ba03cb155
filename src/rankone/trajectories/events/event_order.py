"""The order in which the trajectories of a box meet their events, and what does not follow it."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import ConvergenceError
from rankone.support.wording import quote
from rankone.trajectories.events.event_integration import Goal, integrate_to_events
from rankone.trajectories.events.event_trajectory import SAME_INSTANT, EventTrajectory, Occurrence
from rankone.trajectories.events.periods import FAR, begin_in_step
from rankone.trajectories.integrators.diagnosis import first_to_end
from rankone.trajectories.integrators.integrator import SpanIntegrator, Tolerances
from rankone.trajectories.system.events import Ending, EventOrder
from rankone.trajectories.system.system import Clock, System
from rankone.trajectories.system.verdict import Status

SPARE = 0.05
"""Length of a last stretch beyond what all known trajectories need, over that."""
ONE_INSTANT = 10.0 * SAME_INSTANT
"""Part of the horizon within which events of an order are at one instant: paths end up to one
:data:`SAME_INSTANT` before or after an event, and times are rounded far from zero."""
REMEDY = "narrow the box to where all trajectories meet the same events in the same order"
"""What to do where they do not."""


class OrderError(ConvergenceError):
    """A trajectory does not meet the events of the others, or not in their order.

    ``limit`` is the one that was reached where that is known, and not solved for that. ``part`` are
    the intervals of a part of the box in which events come in one order, if one was found.
    """

    limit: Status | None = None
    part: tuple[tuple[float, float], ...] | None = None


class TrajectoryEndError(OrderError):
    """A trajectory ends although no event ends it."""


class AccumulationError(TrajectoryEndError):
    """A trajectory ends where its events accumulate."""


class MoreEventsError(OrderError):
    """A trajectory meets more events before the end than those that told their order."""


def event_order(
    system: System,
    points: Array,
    horizon: tuple[float, float],
    integrator: SpanIntegrator,
    tolerances: Tolerances,
    more: int = 0,
) -> EventOrder:
    """The order of the events of trajectories at points (m, d).

    Others may meet so many ``more`` before the end of the horizon.

    Raises
    ------
    OrderError
        If it is not the same at all of them, except for what comes after the horizon.
    """
    events, end = system.events, horizon[1]
    followed = integrate_to_events(integrator, system, points, horizon, tolerances)
    length = end - horizon[0]
    counts = [len(instants_of(each, length)) for each in followed]
    longest = int(np.argmax(counts))
    instants = tuple(_ids(instants_of(followed[longest], length)))
    sides = sides_of(system, followed[longest], len(instants), length)
    some = Clock(system, EventOrder(instants, Ending.EVENT, sides=sides), horizon)
    terminal = bool(instants) and any(events[k].terminal for k in instants[-1])
    if not terminal and min(counts) == max(counts) and not more:
        sides = sides_of(system, followed[longest], len(instants) + 1, length)
        order = EventOrder(instants, Ending.HORIZON, sides=sides)
        check_orders(Clock(system, order, horizon), followed, points)
        return order
    if not terminal:
        count = len(instants) + 1 + more
        try:
            further = follow(some, integrator, points, tolerances, count, followed)
            beyond = {tuple(_ids(instants_of(each, length))[:count]) for each in further}
            held = {sides_of(system, each, count, length) for each in further}
            if len(beyond) == len(held) == 1 and len(next(iter(beyond))) == count:
                return EventOrder(beyond.pop(), Ending.EVENT, sides=held.pop())
        except ConvergenceError:
            pass
    if more:
        raise MoreEventsError("trajectories meet different numbers of events", remedy=REMEDY)
    reached = follow(some, integrator, points, tolerances, len(instants), followed)
    check_orders(some, reached, points)
    if terminal:
        return some.order
    last = min(instants_of(each, length)[len(instants) - 1][0].time for each in reached)
    sides = sides_of(system, reached[longest], len(instants) + 1, length)
    return EventOrder(instants, Ending.LENGTH, (1.0 + SPARE) * (end - last), sides)


def follow(
    clock: Clock,
    integrator: SpanIntegrator,
    points: Array,
    tolerances: Tolerances,
    count: int,
    begun: Sequence[EventTrajectory] = (),
) -> list[EventTrajectory]:
    """Trajectories to the end of the horizon and to so many instants of events.

    They go on from those that have ``begun``. Where they repeat they are integrated no further.
    """
    (start, end), length = clock.horizon, clock.length

    def enough(trajectory: EventTrajectory, edge: float) -> bool:
        return edge > end and len(instants_of(trajectory, length)) >= count

    edges = [start, end, end + FAR * length]
    if clock.order.ending is Ending.HORIZON:
        edges = edges[:2]
    if clock.in_step:
        begun = begin_in_step(clock, integrator, points, tolerances, count, begun)
    goal = Goal(enough, count=count)
    followed = integrate_to_events(integrator, clock.system, points, edges, tolerances, goal, begun)
    early, stuck = list[int](), list[int]()
    for k, each in enumerate(followed):
        last = each.occurrences[-1:]
        terminal = any(clock.system.events[occurrence.event].terminal for occurrence in last)
        short = each.end < end - ONE_INSTANT * length
        if each.stuck and not terminal and (short or len(instants_of(each, length)) < count):
            stuck.append(k)
        if not terminal and short:
            early.append(k)
    if stuck:
        first = min(stuck, key=lambda k: followed[k].end)
        raise end_error(clock, points[first], followed[first].end, stuck=True)
    if early:  # a stack ends where the first of its trajectories does
        states = np.stack([followed[k].state for k in early], axis=1)
        time = min(followed[k].end for k in early)
        first = early[first_to_end(clock.system, time, states, points[early], tolerances.absolute)]
        raise end_error(clock, points[first], followed[first].end)
    return followed


def instants_of(trajectory: EventTrajectory, length: float) -> list[list[Occurrence]]:
    """The events of a trajectory, those at one instant together."""
    instants: list[list[Occurrence]] = []
    for each in trajectory.occurrences:
        if instants and each.time - instants[-1][0].time <= ONE_INSTANT * length:
            instants[-1].append(each)
        else:
            instants.append([each])
    return instants


def sides_of(
    system: System, trajectory: EventTrajectory, stretches: int, length: float
) -> tuple[tuple[int, ...], ...]:
    """The sides of switches of a trajectory on its first stretches.

    An OrderError where it is no number.
    """
    if not system.n_sides:
        return ((),) * stretches
    states = [trajectory.paths[0].state]
    states += [instant[-1].after for instant in instants_of(trajectory, length)]
    sides = np.stack(states)[:stretches, -system.n_sides :]
    if not np.isfinite(sides).all():
        raise OrderError("a trajectory is not finite where the rates switch")
    return tuple(tuple(map(round, each)) for each in sides.tolist())


def _ids(instants: Sequence[Sequence[Occurrence]]) -> list[tuple[int, ...]]:
    return [tuple(sorted(each.event for each in instant)) for instant in instants]


def check_orders(clock: Clock, trajectories: Sequence[EventTrajectory], points: Array) -> None:
    """Raise an OrderError, with the share of the trajectories, if some have another order."""
    errors: list[OrderError] = []
    for each, point in zip(trajectories, points, strict=True):
        try:
            check_order(clock, each, point)
        except OrderError as error:
            errors.append(error)
    if errors:
        share = f"; so for {len(errors)} of {len(points)} trajectories over the box"
        raise type(errors[0])(f"{errors[0].message}{share}", remedy=errors[0].remedy)


def check_order(clock: Clock, trajectory: EventTrajectory, point: Array) -> None:
    """Raise an OrderError if a trajectory does not meet the events in their order."""
    events, order = clock.system.events, clock.order
    instants = instants_of(trajectory, clock.length)
    met = _ids(instants)
    before = sum(instant[0].time < clock.horizon[1] for instant in instants)
    exact = order.ending is not Ending.EVENT
    sides = sides_of(clock.system, trajectory, order.stretches, clock.length)

    def named(ids: Sequence[int]) -> str:
        counts = Counter(quote(events[k].name) for k in ids)
        each = (
            f"{name} {count} times at once" if count > 1 else name for name, count in counts.items()
        )
        return " with ".join(each)

    for number, (here, there) in enumerate(itertools.zip_longest(met, order.instants), 1):
        if here == there:
            continue
        kind = OrderError
        if here is None:
            what = f"{named(there)}, event {number} elsewhere, does not come"
        elif there is None:
            if not exact or number > before:
                return
            what = f"{named(here)} comes after the last event elsewhere"
            kind = MoreEventsError
        else:
            what = f"event {number} is {named(here)}, elsewhere {named(there)}"
        raise kind(
            f"events do not come in the same order everywhere: {what}{at_point(clock, point)}",
            remedy=REMEDY,
        )
    for number, (side, there_too) in enumerate(zip(sides, order.sides, strict=False), 1):
        if side != there_too:
            raise OrderError(
                f"switches are on other sides than elsewhere on stretch {number}"
                f"{at_point(clock, point)}",
                remedy=REMEDY,
            )


def end_error(clock: Clock, point: Array, time: float, stuck: bool = False) -> TrajectoryEndError:
    """The error for a trajectory that ends at a time."""
    why = "events accumulate" if stuck else "it cannot be integrated further"
    kind = AccumulationError if stuck else TrajectoryEndError
    return kind(
        f"a trajectory ends{at_time(clock, time)}{at_point(clock, point)}: {why}",
        remedy="shorten the horizon or narrow the box",
    )


def at_time(clock: Clock, time: float) -> str:
    """A time; of one behind the horizon, where trajectories go on to their events, nothing else."""
    return f" at t = {time:.6g}" if time <= clock.horizon[1] else " behind the horizon"


def at_point(clock: Clock, point: Array) -> str:
    names = clock.system.parameters
    named = ", ".join(f"{name} = {x:.6g}" for name, x in zip(names, point, strict=True))
    return f" at {named}" if named else ""


def stretch_borders(clock: Clock, trajectories: Sequence[EventTrajectory], points: Array) -> Array:
    """Clock times (m, stretches + 1) at which the stretches of trajectories begin and end.

    Raises
    ------
    OrderError
        If a trajectory does not meet the events in their order, or more of them before the end.
    """
    order, (start, end) = clock.order, clock.horizon
    count = len(order.instants)
    borders = np.empty((len(points), order.stretches + 1))
    borders[:, 0] = start
    for each, point, row in zip(trajectories, points, borders, strict=True):
        check_order(clock, each, point)
        row[1 : 1 + count] = [i[0].time for i in instants_of(each, clock.length)[:count]]
    if order.ending is Ending.HORIZON:
        borders[:, -1] = end
    elif order.ending is Ending.LENGTH:
        borders[:, -1] = borders[:, -2] + order.length
    elif not clock.terminal and (borders[:, -1] < end).any():
        early = int(np.argmin(borders[:, -1]))
        raise MoreEventsError(
            "a trajectory meets more events before the end than those that told their order"
            f"{at_point(clock, points[early])}",
            remedy=REMEDY,
        )
    return borders
