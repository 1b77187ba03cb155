"""Events that trajectories meet just before a turn, or miss where they turn too early.

Where the height of the turn over the surface vanishes, the event and the next crossing merge like
a square root, and are gone beyond. An order with such an event is opened. Its relative height is
that over the rise to the turn, from the start of the stretch or, if that is on the surface, from
the lowest place between; the root s of this becomes a coordinate behind the parameters, and for
any s < 1 and p the surface is moved until the relative height is s². The trajectories are smooth
functions of p and s, and true where s² is the true one.

A stretch that some trajectories do not have, such as a stick where others slip on, may have no
continuation to a negative length. It is opened where it begins: what is zero at its end is s²
there.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import MINOR, NEGLIGIBLE, Array, spread
from rankone.trajectories.events.event_integration import guard_heights
from rankone.trajectories.events.orders import Lengths, Opened, Order, OrderSearch
from rankone.trajectories.system.features import FALLING, Beginning, ForcedOrder, Guard, Turn


@dataclass(frozen=True)
class _Opening:
    """How far an opened event is continued, and where it has been far enough."""

    samples: int
    lowest: int
    fewest: int
    further: int
    near: float
    sliver: float
    above: float
    to_start: float
    fading: float
    most_sides: int


_OPENING = _Opening(
    samples=257,  # Places behind an event at which its turn is looked for
    lowest=3,  # One of so many of the turns, the lowest ones, begins the continuation
    fewest=6,  # Turns that it may begin with
    further=256,  # Points, evenly spread over parameters and roots, to which orders are continued
    near=MINOR,  # Share of the points that tell how many are next to the border
    sliver=0.003,  # Share of the box, about, in which a height is as good as zero
    above=1.1,  # Largest root of a relative height over that at the points
    to_start=0.5,  # Share of what is left to the start by which it may be larger
    fading=0.2,  # Rate at which a surface moved at a beginning comes back, over height and length
    most_sides=8,  # Coordinates up to which it is predicted at the corners too
)


@dataclass(frozen=True)
class ContinuedOrder:
    """An order that is continued to all points of its opened events."""

    order: Order
    forced: ForcedOrder
    opened: Opened


def opened_after(
    search: OrderSearch,
    parent: ContinuedOrder,
    order: Order,
    places: NDArray[np.intp],
    stretch: int,
) -> Opened | None:
    """The points and turns of an order whose event at the end of a stretch a parent misses.

    The order holds at ``places``; both have the same stretches before. None if the parent does not
    turn next to the event, or does so nowhere but where the event is met.

    Raises
    ------
    ContinuationError
        If the turn cannot be continued over the whole box, or is no nearer to the event than the
        start of the stretch.
    """
    turn = _turn(search, parent, order, places, stretch)
    if turn is None:
        return None
    forced = replace(parent.forced, guards=(turn,))
    heights = search.forced(parent.order, forced, parent.opened.points).guards[0]
    if not (heights[places] > 0.0).all() or not (heights < 0.0).any():
        return None
    return _with_root(search, parent.opened, turn, heights)


def opened_at_beginning(
    search: OrderSearch,
    parent: ContinuedOrder,
    order: Order,
    places: NDArray[np.intp],
) -> Opened | None:
    """The points and openings of an order that has a stretch where a parent goes on at once.

    The order holds at ``places``. None if what is zero at the end of the stretch does not tell
    where it begins.

    Raises
    ------
    ContinuationError
        If the parent cannot be followed.
    """
    stretch = order.parts_at(parent.order)
    guard = _beginning_guard(search, order, stretch)
    if guard is None:
        return None
    forced = replace(parent.forced, guards=(guard,))
    heights = search.forced(parent.order, forced, parent.opened.points).guards[0]
    if not (heights[places] > 0.0).all() or not (heights < 0.0).any():
        return None
    upper = _OPENING.above * float(np.sqrt(_highest_anywhere(parent.opened, heights)))
    longest = float(search.lengths(order, places)[:, stretch].max())
    begins = Beginning(stretch, guard.event, guard, _OPENING.fading / (upper**2 * longest))
    return _with_coordinate(search, parent.opened, begins, heights, (0.0, upper))


def _beginning_guard(search: OrderSearch, order: Order, stretch: int) -> Guard | None:
    """What is zero at the end of a stretch, at its beginning; None if that is not a switch."""
    events = search.system.events
    if stretch >= len(order.met):
        return None
    ends = order.met[stretch][0]
    switches = [k for k, each in enumerate(events) if each.switch and each.then is not None]
    if ends not in switches or events[ends].direction != FALLING:
        return None
    side = float(order.sides[stretch][switches.index(ends)])
    return Guard(stretch - 1, min(stretch, 1), ends, side)


def _turn(
    search: OrderSearch,
    parent: ContinuedOrder,
    order: Order,
    places: NDArray[np.intp],
    stretch: int,
) -> Turn | None:
    """The turn of the parent next to an event, continued from where that is met."""
    event = order.met[stretch][0]
    times, heights, sign = _first_turns(search, parent, order, places, stretch)
    lowest = np.argsort(np.where(np.isfinite(times), heights, np.inf), kind="stable")
    count = max(_OPENING.fewest, np.isfinite(times).sum() // _OPENING.lowest)
    chosen = lowest[: min(count, np.isfinite(times).sum())]
    if len(chosen) < _OPENING.fewest:
        return None
    opened = parent.opened
    surface = _surface(search, event, order.sides[stretch])
    before = order.met[stretch - 1] if stretch else ()
    on_surface = any(k in before for k, _, _ in surface)

    def turn(expected: Lengths, margins: tuple[float, ...]) -> Turn:
        columns = opened.points.shape[1]
        return Turn(stretch, event, sign, surface, expected, margins[0], columns, on_surface)

    def reached(
        expected: Lengths, margins: tuple[float, ...], chunk: NDArray[np.intp]
    ) -> tuple[Array, NDArray[np.intp]]:
        forced = replace(parent.forced, guards=(turn(expected, margins),))
        there, chunk = search.reached(parent.order, forced, opened.points, chunk)
        return there.turns.T, chunk

    return turn(*opened.spread(places[chosen], times[chosen, None], reached))


def _first_turns(
    search: OrderSearch,
    parent: ContinuedOrder,
    order: Order,
    places: NDArray[np.intp],
    stretch: int,
) -> tuple[Array, Array, float]:
    """Elapsed times and heights (m,) of the first turn of the parent behind an event; the sign.

    Times are NaN where it does not turn.
    """
    forced = replace(parent.forced, guards=())
    met = search.lengths(order, places)[:, stretch]
    further = replace(search, horizon=(search.horizon[0], search.horizon[1] + float(met.max())))
    flow = further.forced(parent.order, forced, parent.opened.points[places]).flows[stretch]
    shares = np.linspace(0.0, 1.0, _OPENING.samples)
    elapsed = met[:, None] + np.maximum(flow.to_ahead - met, 0.0)[:, None] * shares
    heights = flow.heights(order.met[stretch][0], elapsed)
    sign = float(np.sign(np.median(np.sign(heights[:, 1]))))
    heights = sign * heights
    turns = (heights[:, 1:-1] > heights[:, :-2]) & (heights[:, 1:-1] > heights[:, 2:])
    first, rows = 1 + turns.argmax(axis=1), np.arange(len(places))
    near = turns.any(axis=1) & (heights[:, 1] > 0.0)  # and not beyond the turn already
    times = np.where(near, elapsed[rows, first], np.nan)
    return times, heights[rows, first], sign


def _surface(
    search: OrderSearch, event: int, sides: tuple[int, ...]
) -> tuple[tuple[int, tuple[int, ...], float], ...]:
    """The events, on sides of switches, with the surface of one on its sides, and their factors."""
    count, n = len(search.points), search.system.n_differential - search.system.n_sides
    states = search.sizes.max() * spread(count, n, np.random.default_rng(20150)).T
    times = np.full(count, search.horizon[0])

    def heights(k: int, on: tuple[int, ...]) -> Array:
        there = np.repeat(np.array(on, dtype=float)[:, None], count, axis=1)
        with_sides = np.concatenate([states, there])
        return guard_heights(search.system, k, None, times, with_sides, search.points)

    own, surface = heights(event, sides), []
    if not own.any():  # of the time alone: nothing moves it
        return ()
    for on in {each: None for order in search.groups() for each in order.sides}:
        for k, each in enumerate(search.system.events):
            other = heights(k, on)
            if each.at is not None or not np.isfinite(other).all():
                continue
            factor = float(other @ own) / float(own @ own)
            if factor and np.abs(other - factor * own).max() <= NEGLIGIBLE * np.abs(other).max():
                surface.append((k, on, factor))
    return tuple(surface)


def _with_root(search: OrderSearch, parent: Opened, turn: Turn, heights: Array) -> Opened:
    """The points of a parent with the roots of relative heights (m,), and further ones."""
    count = len(search.points)
    near = np.sort(np.abs(heights[:count]))
    k = int(_OPENING.near * count)
    lower = float(np.sqrt(near[k] * _OPENING.sliver * count / k))
    largest = float(np.sqrt(_highest(parent, heights)))
    upper = min(_OPENING.above * largest, largest + _OPENING.to_start * (1.0 - largest))
    return _with_coordinate(search, parent, turn, heights, (lower, upper))


def _with_coordinate(
    search: OrderSearch,
    parent: Opened,
    opening: Turn | Beginning,
    heights: Array,
    ends: tuple[float, float],
) -> Opened:
    """The points of a parent with the roots of heights (m,) between two ends, and further ones."""
    count = len(search.points)
    roots = np.clip(np.sqrt(np.maximum(heights[:count], 0.0)), *ends)
    points = np.column_stack([parent.points[:count], roots])
    bounds = np.vstack([parent.bounds, ends])
    shares = spread(_OPENING.further, len(bounds), np.random.default_rng(20149))
    further = bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) * shares
    return Opened((*parent.turns, opening), np.concatenate([points, further]), bounds)


def _highest(opened: Opened, heights: Array) -> float:
    """The largest of heights (m,), and of those predicted at the corners, but for the start."""
    highest = float(heights.max())
    return max(highest, min(_highest_anywhere(opened, heights), 0.5 * (1.0 + highest)))


def _highest_anywhere(opened: Opened, heights: Array) -> float:
    """The largest of heights (m,), and of those predicted at the corners."""
    highest = float(heights.max())
    if len(opened.bounds) > _OPENING.most_sides:
        return highest
    predicted = Lengths.through(opened.bounds, opened.points, heights[:, None])
    corners = np.array(list(itertools.product(*opened.bounds.tolist())))
    return max(highest, float(predicted(corners).max()))
