"""Orders of events that hold in parts of a box, each continued to all of it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist

from rankone.support.arrays import Array
from rankone.support.errors import quote
from rankone.trajectories.events import sides as event_order
from rankone.trajectories.events.event_integration import guard_heights, integrate_to_events
from rankone.trajectories.events.event_trajectory import EventTrajectory
from rankone.trajectories.events.forced import (
    ContinuationError,
    ForcedTrajectories,
    forced_trajectories,
)
from rankone.trajectories.events.stretches import in_stretches
from rankone.trajectories.integrators.integrator import SpanIntegrator, Tolerances
from rankone.trajectories.system.features import (
    BOTH,
    Beginning,
    Clearance,
    Ending,
    EventOrder,
    ForcedOrder,
    Guard,
    Turn,
)
from rankone.trajectories.system.system import Clock, System


@dataclass(frozen=True)
class _Continuing:
    """How an order is continued from point to point."""

    first_chunk: int
    first_margin: float
    last_margin: float
    safety: float
    most_roots: int
    cornered: int
    fewest: int
    apart: float
    least_apart: float
    smoothing: float


_ORDERS = _Continuing(
    # Points to which an order is continued at once, or half as many as it has come to
    first_chunk=8,
    first_margin=0.2,  # Distance of roots from what is expected, over lengths
    last_margin=0.05,
    safety=4.0,  # The same over the errors of what was expected before
    most_roots=4,  # Roots at which stretches of one order may end
    cornered=3,  # Parameters up to which an order is continued to all corners of the box
    fewest=12,  # Lengths of stretches that tell such roots apart
    apart=4.0,  # Gap between lengths of stretches that end at different roots, over further gaps
    least_apart=0.01,  # About the least such gap, over the horizon, and over ``_ORDERS.apart``
    # Weight of smoothness beside values: lengths at points that nearly coincide differ by rounding
    smoothing=1e-10,
)


Step: TypeAlias = tuple[tuple[int, ...], tuple[int, ...], int]
"""The events at an instant, the sides after them, and which root the first of them is."""


@dataclass(frozen=True)
class Order:
    """The events that a trajectory meets before the end, in their order, and its sides.

    The first event at an instant ends the stretch. The ``sides`` of switches are those on each
    stretch; nothing follows the last event if that is ``terminal``. Where some trajectories miss an
    event by grazing and meet it later, the ``roots`` tell them apart, one for each instant.
    """

    met: tuple[tuple[int, ...], ...]
    sides: tuple[tuple[int, ...], ...]
    terminal: bool
    roots: tuple[int, ...]

    @classmethod
    def of(cls, system: System, trajectory: EventTrajectory, length: float) -> Order:
        """The order of a trajectory over a horizon of some length."""
        instants = event_order.instants_of(trajectory, length)
        met = tuple(tuple(each.event for each in instant) for instant in instants)
        terminal = bool(met) and any(system.events[k].terminal for k in met[-1])
        stretches = len(met) + (not terminal)
        sides = event_order.sides_of(system, trajectory, stretches, length)
        return cls(met, sides, terminal, (0,) * len(met))

    @property
    def ending(self) -> Ending:
        """What ends the last stretch."""
        return Ending.EVENT if self.terminal else Ending.HORIZON

    @property
    def steps(self) -> list[Step]:
        """The sides at the start, and for each instant the events with the sides after them."""
        after = [*self.sides[1:], ()] if self.terminal else self.sides[1:]
        return [((), self.sides[0], 0), *zip(self.met, after, self.roots, strict=True)]

    @property
    def at_any_roots(self) -> Order:
        """The order, without telling roots apart."""
        return replace(self, roots=(0,) * len(self.met))

    def begins(self, other: Order) -> bool:
        """Whether another order goes on as this one, up to the end of the horizon and further."""
        return not self.terminal and other.steps[: len(self.steps)] == self.steps

    def until(self, stretch: int) -> Order:
        """The order that meets nothing from a stretch on."""
        return Order(self.met[:stretch], self.sides[: stretch + 1], False, self.roots[:stretch])

    def ends_with(self, event: int) -> list[bool]:
        """Whether an event ends each of the stretches."""
        ends = [event in each for each in self.met]
        return [*ends, *[False] * (len(self.sides) - len(ends))]

    def parts_at(self, other: Order) -> int:
        """The first of the steps that is not the same in another order."""
        pairs = enumerate(zip(self.steps, other.steps, strict=False))
        shorter = min(len(self.steps), len(other.steps))
        return next((k for k, (one, two) in pairs if one != two), shorter)

    def clock(self, system: System, horizon: tuple[float, float], forced: ForcedOrder) -> Clock:
        """The clock of trajectories that are forced to follow this order."""
        instants = tuple(tuple(sorted(each)) for each in self.met)
        order = EventOrder(instants, self.ending, sides=self.sides)
        return Clock(system, order, horizon, forced=forced)


def _with_roots(orders: Sequence[Order], lengths: Sequence[Array], least: float) -> list[Order]:
    """Orders that tell apart at which roots stretches end, by their lengths (instants,)."""
    orders = [*orders]
    for instant in range(max((len(order.met) for order in orders), default=0)):
        alike: dict[tuple[Step, ...], list[int]] = {}
        for k, order in enumerate(orders):
            if len(order.met) > instant:
                alike.setdefault(tuple(order.steps[: instant + 2]), []).append(k)
        for places in alike.values():
            ends = np.array([lengths[k][instant] for k in places])
            for k, root in zip(places, _groups_apart(ends, least), strict=True):
                before, after = orders[k].roots[:instant], orders[k].roots[instant + 1 :]
                orders[k] = replace(orders[k], roots=(*before, root, *after))
    return orders


def _groups_apart(lengths: Array, least: float) -> list[int]:
    """Which group each of the lengths (m,) is in: a few gaps are far larger than all others."""
    ordered = np.sort(lengths)
    gaps = np.sort(np.diff(ordered))[::-1]
    largest = gaps[: _ORDERS.most_roots]
    if len(lengths) < _ORDERS.fewest:
        return [0] * len(lengths)
    wider = largest[:-1] / np.maximum(largest[1:], least)
    count = int(np.argmax(wider)) + 1
    if wider[count - 1] < _ORDERS.apart:
        return [0] * len(lengths)
    starts = ordered[1:][np.diff(ordered) >= largest[count - 1]]
    groups: list[int] = np.searchsorted(starts, lengths, side="right").tolist()
    return groups


@dataclass(frozen=True)
class Lengths:
    """Lengths of stretches as functions of the parameters, through scattered points."""

    lower: Array
    width: Array
    interpolant: RBFInterpolator | None
    constant: Array

    @classmethod
    def through(cls, bounds: Array, points: Array, lengths: Array) -> Lengths:
        """Through lengths (m, k) at points (m, d) of a box (d, 2)."""
        lower, width = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
        constant = lengths.mean(axis=0)
        if not lengths.shape[1]:
            return cls(lower, width, None, constant)
        degree = 1 if len(points) > 2 * (1 + len(bounds)) else 0
        kernel = "cubic" if degree else "linear"
        try:
            unit = (points - lower) / width
            interpolant = RBFInterpolator(
                unit, lengths, smoothing=_ORDERS.smoothing, kernel=kernel, degree=degree
            )
        except (np.linalg.LinAlgError, ValueError):
            interpolant = None
        return cls(lower, width, interpolant, constant)

    def __call__(self, points: Array) -> Array:
        """Lengths (m, k) at points (m, d)."""
        if self.interpolant is None:
            return np.broadcast_to(self.constant, (len(points), self.constant.size)).copy()
        return np.asarray(self.interpolant((points - self.lower) / self.width))


Reach = Callable[[Lengths, tuple[float, ...], NDArray[np.intp]], tuple[Array, NDArray[np.intp]]]
"""Finds values near to what is expected, to margins, at points at some positions.

With the positions of those at which there are any.
"""


@dataclass(frozen=True)
class Opened:
    """Turns at which events of an order are opened, and points (m, d) to which it is continued.

    Behind the parameters, the points and their ``bounds`` (d, 2) have the roots of the heights at
    the turns, or at the beginnings of stretches.
    """

    turns: tuple[Turn | Beginning, ...]
    points: Array
    bounds: Array

    @property
    def root_bounds(self) -> Array:
        """Those of the roots, (turns, 2)."""
        return self.bounds[len(self.bounds) - len(self.turns) :]

    def spread(
        self, places: NDArray[np.intp], values: Array, reach: Reach
    ) -> tuple[Lengths, tuple[float, ...]]:
        """Values (m, k) known at some of the points, continued to all of them.

        With margins to which they are predicted. A ContinuationError if they cannot be.
        """
        lower, width = self.bounds[:, 0], self.bounds[:, 1] - self.bounds[:, 0]
        unit = (self.points - lower) / width
        waiting = np.setdiff1d(np.arange(len(self.points)), places)
        margins = _ORDERS.first_margin * np.abs(values).max(axis=0, initial=0.0)
        while waiting.size:
            distance = cdist(unit[waiting], unit[places]).min(axis=1)
            size = max(_ORDERS.first_chunk, len(places) // 2)
            chunk = waiting[np.argsort(distance, kind="stable")[:size]]
            expected = Lengths.through(self.bounds, self.points[places], values)
            there, chunk = reach(expected, tuple(margins.tolist()), chunk)
            missed = np.abs(there - expected(self.points[chunk])).max(axis=0, initial=0.0)
            values, places = np.concatenate([values, there]), np.append(places, chunk)
            margins = np.maximum(
                _ORDERS.first_margin * np.abs(values).max(axis=0, initial=0.0),
                _ORDERS.safety * missed,
            )
            waiting = np.setdiff1d(waiting, chunk)
        return self._through(self.points[places], values)

    def _through(self, points: Array, values: Array) -> tuple[Lengths, tuple[float, ...]]:
        """Through values at points; the margins are errors at half of them."""
        expected = Lengths.through(self.bounds, points, values)
        half = Lengths.through(self.bounds, points[::2], values[::2])
        missed = np.abs(half(points[1::2]) - values[1::2]).max(axis=0, initial=0.0)
        least = _ORDERS.last_margin * np.abs(values).max(axis=0, initial=0.0)
        return expected, tuple(np.maximum(least, _ORDERS.safety * missed).tolist())


@dataclass(frozen=True)
class OrderSearch:
    """Orders of trajectories at points (m, d) of a box (d, 2), and their continuation.

    It ``tells_roots`` apart where orders cannot be continued without. Orders are continued to its
    points, and to ``further`` ones (k, d).
    """

    system: System
    horizon: tuple[float, float]
    bounds: Array
    points: Array
    trajectories: Sequence[EventTrajectory]
    integrator: SpanIntegrator
    tolerances: Tolerances
    tells_roots: bool = False
    further: Array | None = None

    @property
    def length(self) -> float:
        return self.horizon[1] - self.horizon[0]

    @property
    def sizes(self) -> Array:
        """The largest values of the states along the trajectories, (n,); one if they vanish."""
        n = self.system.n_differential - self.system.n_sides
        largest = [
            np.abs(path.nodal[:, -1, :n]).max(axis=0, initial=0.0)
            for each in self.trajectories
            for path in each.paths
        ]
        sizes = np.max(largest, axis=0)
        return np.where(sizes > 0.0, sizes, 1.0)

    @cached_property
    def telling_roots(self) -> OrderSearch:
        """The same search, which tells apart at which roots stretches end."""
        return self if self.tells_roots else replace(self, tells_roots=True)

    @property
    def to_corners(self) -> OrderSearch:
        """The same search, with the corners of the box as further points, if they are few."""
        if len(self.bounds) > _ORDERS.cornered:
            return self
        return replace(self, further=np.array(list(itertools.product(*self.bounds.tolist()))))

    @cached_property
    def orders(self) -> list[Order]:
        """Those of the trajectories."""
        orders = [Order.of(self.system, each, self.length) for each in self.trajectories]
        if not self.tells_roots:
            return orders
        lengths = [self._lengths(k) for k in range(len(orders))]
        return _with_roots(orders, lengths, _ORDERS.least_apart * self.length)

    def _check_end(self, trajectory: EventTrajectory, point: Array) -> None:
        """Raise an OrderError for a trajectory that ends although nothing ends it."""
        events, occurrences = self.system.events, trajectory.occurrences
        terminal = bool(occurrences) and events[occurrences[-1].event].terminal
        early = trajectory.end < self.horizon[1] - event_order.ONE_INSTANT * self.length
        if terminal or not (early or trajectory.stuck):
            return
        clock = Clock(self.system, EventOrder((), Ending.HORIZON), self.horizon)
        raise event_order.end_error(clock, point, trajectory.end, trajectory.stuck)

    def followed(self, points: Array) -> list[EventTrajectory]:
        """Trajectories at points (m, d); an OrderError where one ends although nothing ends it."""
        followed = integrate_to_events(
            self.integrator, self.system, points, self.horizon, self.tolerances
        )
        for trajectory, point in zip(followed, points, strict=True):
            self._check_end(trajectory, point)
        return followed

    def at(self, points: Array) -> OrderSearch:
        """The search with trajectories at points (m, d) in place of its own."""
        return replace(self, points=points, trajectories=self.followed(points))

    def joined_with(self, other: OrderSearch) -> OrderSearch:
        """The search with the trajectories of another one as well."""
        points = np.concatenate([self.points, other.points])
        return replace(self, points=points, trajectories=[*self.trajectories, *other.trajectories])

    def with_points(self, points: Array) -> OrderSearch:
        """The search with trajectories at further points (m, d)."""
        return self.joined_with(self.at(points))

    def named(self, order: Order) -> str:
        """An order of events, as messages name it."""
        names = ", ".join(
            name if (times := len([*same])) == 1 else f"{name} {times} times"
            for name, same in itertools.groupby(
                quote(self.system.events[met[0]].name) for met in order.met
            )
        )
        return f"the order of events {names}" if names else "the case without events"

    def places(self, steps: Sequence[object]) -> NDArray[np.intp]:
        """The positions of the trajectories that begin with some steps."""
        begun = [order.steps[: len(steps)] == steps for order in self.orders]
        return np.flatnonzero(begun)

    def groups(self) -> dict[Order, NDArray[np.intp]]:
        """The points at which each order holds, those of the longest orders first."""
        groups: dict[Order, list[int]] = {}
        for k, order in enumerate(self.orders):
            groups.setdefault(order, []).append(k)
        longest = sorted(groups.items(), key=lambda pair: (-len(pair[0].met), -len(pair[1])))
        return {order: np.array(places) for order, places in longest}

    def lengths(self, order: Order, places: NDArray[np.intp]) -> Array:
        """Lengths (m, instants) of the stretches of trajectories that begin with an order."""
        count = len(order.met)
        lengths = [self._lengths(k)[:count] for k in places.tolist()]
        return np.reshape(lengths, (len(places), count))

    def _lengths(self, k: int) -> Array:
        """Those of the trajectory at a position, (instants,)."""
        instants = event_order.instants_of(self.trajectories[k], self.length)
        times = [instant[0].time for instant in instants]
        return np.diff(times, prepend=self.horizon[0])

    def continued(
        self, order: Order, places: NDArray[np.intp], opened: Opened | None = None
    ) -> ForcedOrder:
        """An order continued from the points at which it holds to all of them.

        With ``opened`` events to all points of these, of which the first are those of the search.

        Raises
        ------
        ContinuationError
            If it cannot be.
        """
        opened = opened or self.unopened

        def reached(
            expected: Lengths, margins: tuple[float, ...], chunk: NDArray[np.intp]
        ) -> tuple[Array, NDArray[np.intp]]:
            forced = ForcedOrder(order.met, expected, margins, opened=opened.turns)
            there, chunk = self.reached(order, forced, opened.points, chunk)
            return np.diff(there.borders, axis=1)[:, : len(order.met)], chunk

        lengths = self.lengths(order, places)
        expected, margins = opened.spread(places, lengths, reached)
        if max(margins, default=0.0) > self.length:
            error = self._not_smooth(order, int(np.argmax(margins)), len(opened.points))
            error.at_corners = not opened.turns and self.further is not None
            raise error
        return ForcedOrder(order.met, expected, margins, opened=opened.turns)

    def _not_smooth(self, order: Order, stretch: int, count: int) -> ContinuationError:
        """The error for a stretch whose length jumps somewhere between so many points."""
        event = quote(self.system.events[order.met[stretch][0]].name)
        error = ContinuationError(
            "an order of events that holds in a part of the box cannot be continued: the time "
            f"of event {event} jumps as a function of the parameters",
            remedy=event_order.REMEDY,
        )
        error.fails, error.missed = np.ones(count, dtype=bool), stretch
        return error

    @property
    def unopened(self) -> Opened:
        """The points of the search and the further ones, without opened events."""
        further = self.points[:0] if self.further is None else self.further
        return Opened((), np.concatenate([self.points, further]), self.bounds)

    def reached(
        self, order: Order, forced: ForcedOrder, points: Array, chunk: NDArray[np.intp]
    ) -> tuple[ForcedTrajectories, NDArray[np.intp]]:
        """Forced trajectories at those of some points to which the order can be continued now."""
        while True:
            try:
                return self.forced(order, forced, points[chunk]), chunk
            except ContinuationError as error:
                if error.fails.all():
                    corners = not forced.opened and chunk.min() >= len(self.points)
                    error.at_corners = bool(corners)
                    raise
                chunk = chunk[~error.fails]

    def forced(self, order: Order, forced: ForcedOrder, points: Array) -> ForcedTrajectories:
        """Trajectories at points (m, d) that are forced to follow an order."""
        clock = order.clock(self.system, self.horizon, forced)
        stretched = in_stretches(clock)
        return forced_trajectories(stretched, clock, self.integrator, points, self.tolerances)

    def clearance(self, order: Order, step: int) -> tuple[Clearance, float]:
        """From the event that an order meets at a step while others go on, with its size.

        An OrderError if that does not come where it falls or rises to zero.
        """
        k = order.met[step - 1][0]
        event = self.system.events[k]
        if event.at is not None or event.direction == BOTH:
            raise self.unforeseen(order)
        states = np.stack([each.paths[0].state for each in self.trajectories], axis=1)
        times = np.full(len(self.points), self.horizon[0])
        heights = guard_heights(self.system, k, None, times, states, self.points)
        return Clearance(k, -float(event.direction)), float(np.abs(heights).max()) or 1.0

    def unforeseen(self, order: Order) -> event_order.OrderError:
        """The error for an order that holds in a part of the box and cannot be continued."""
        return event_order.OrderError(
            f"{self.named(order)} holds in a small part of the box and cannot "
            "be continued from there",
            remedy=event_order.REMEDY,
        )

    def guard(
        self,
        instant: int,
        first: NDArray[np.intp],
        second: NDArray[np.intp],
    ) -> tuple[Guard, float, float]:
        """The guard that tells two sets of trajectories apart which part at an instant.

        With its sign on the first set, and its size. An OrderError if there is none.
        """
        for guard in self._guards(instant):
            heights = [self._heights(guard, places) for places in (first, second)]
            if any(each is None for each in heights):
                continue
            one, other = heights
            assert one is not None
            assert other is not None
            for sign in (1.0, -1.0):
                if (sign * one > 0.0).all() and (sign * other < 0.0).all():
                    size = max(np.abs(one).max(), np.abs(other).max())
                    return guard, sign, float(size)
        orders = dict.fromkeys(self.named(self.orders[places[0]]) for places in (first, second))
        raise event_order.OrderError(
            f"trajectories part at one instant of {' and '.join(orders)}, and nothing tells which "
            "goes on how",
            remedy=event_order.REMEDY,
        )

    def _guards(self, instant: int) -> list[Guard]:
        """The guards that may tell trajectories apart at an instant."""
        guards: list[Guard] = []
        for k, event in enumerate(self.system.events):
            if event.at is not None:
                continue
            sets_side = event.switch and event.then is not None
            for applied in (0,) if instant < 0 else (0, 1):
                sides = (1.0, 0.0) if sets_side else (None,)
                guards += [Guard(instant, applied, k, side) for side in sides]
        return guards

    def _heights(self, guard: Guard, places: NDArray[np.intp]) -> Array | None:
        """A guard at true trajectories, (m,); None if one of them has no such instant."""
        times, states = [], []
        for k in places.tolist():
            trajectory = self.trajectories[k]
            if guard.instant < 0:
                times.append(self.horizon[0])
                states.append(trajectory.paths[0].state)
                continue
            instants = event_order.instants_of(trajectory, self.length)
            if guard.instant >= len(instants):
                return None
            instant = instants[guard.instant]
            times.append(instant[0].time)
            states.append(instant[0].after if guard.applied else instant[0].before)
        at = np.array(times), np.stack(states, axis=1), self.points[places]
        return guard_heights(self.system, guard.event, guard.side, *at)
