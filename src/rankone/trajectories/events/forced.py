"""Trajectories that follow an order of events, whether it holds or not.

Each stretch ends at the root of its event that is nearest to where it is expected, whatever comes
before it. Where other events would come first, that root lies in the past, and the stretch is
integrated backwards. So the trajectories depend smoothly on the parameters over the whole box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.precision import EPSILON, NEGLIGIBLE, ROUNDING, TINY
from rankone.support.wording import quote
from rankone.trajectories.events.event_order import REMEDY, OrderError, at_point
from rankone.trajectories.events.sides import on_sides
from rankone.trajectories.events.stretches import PseudoTimeTrajectories
from rankone.trajectories.integrators.defects import roots
from rankone.trajectories.integrators.integrator import (
    EARLY_STEPS,
    Paths,
    SeparateRun,
    SpanIntegrator,
    Spans,
    Tolerances,
    share_paths,
)
from rankone.trajectories.system.events import Clearance, Ending, ForcedOrder, Guard, Turn
from rankone.trajectories.system.system import Clock, System
from rankone.trajectories.system.timeline import CLOCK_STATES


@dataclass(frozen=True)
class _Following:
    """Where roots of a forced order are looked for."""

    looks: int
    wider: tuple[float, float]
    finer: int
    at_root: float
    most_faded: float


_FOLLOWING = _Following(
    looks=65,  # Places at which a root is looked for
    wider=(1.0, 4.0),  # Factors on the distance up to which it is looked for
    finer=3,  # Looks at a turn, each between the neighbours of the highest place before
    at_root=1e-7,  # Height at the beginning, over the largest one, where a stretch begins at a root
    most_faded=20.0,  # Logarithm of the factor by which a surface that was moved comes back
)
_NOT_FINITE = "runs to where its rates are not finite"
_SAMPLES = 129  # Places of pseudo-time, evenly spaced, that tell the sizes of states


class ContinuationError(OrderError):
    """An order of events cannot be continued to all of the points (m, d).

    ``fails`` (m,) marks those at which it cannot. ``missed`` is the stretch whose event does not
    come, if that is why. It may be that it cannot ``at_corners`` of the box alone.
    """

    fails: NDArray[np.bool_]
    missed: int | None = None
    at_corners: bool = False


@dataclass(frozen=True)
class _Move:
    """By how much the surface of an event is moved, (m,), perhaps from a ``start`` of heights.

    What it is moved up by then, b, fades like exp(-b times the elapsed time), so that it is met;
    what it is moved down by grows as fast, so that it is met no later.
    """

    by: Array
    start: Array | None = None
    fading: float = 0.0

    def at_start(self, heights: Array) -> Array:
        """The heights (m, K) at the beginning of the stretch, from those that are not moved.

        A start of zero is a root, whatever the rounding of these.
        """
        return heights + self.by[:, None] if self.start is None else self.start[:, None]

    def __call__(self, elapsed: Array) -> Array:
        """The same after elapsed times (m, K): (m, K)."""
        by = self.by[:, None]
        exponents = np.clip(
            self.fading * by * elapsed, -_FOLLOWING.most_faded, _FOLLOWING.most_faded
        )
        return np.asarray(by * np.exp(-exponents))


@dataclass(frozen=True)
class _Flow:
    """States along stretches that go on from their beginnings, forwards and backwards.

    ``starts`` are times (m,), ``points`` (m, d); ``ahead`` and ``behind`` are paths over the share
    of the way to times ``to_ahead``, ``to_behind`` (m,) from there, of which the second are
    negative, or zero. Rates are finite between elapsed times ``first`` and ``last`` (m,). The
    ``system`` is on the sides of the stretch, which are no states of it.
    """

    starts: Array
    points: Array
    ahead: Paths
    behind: Paths | None
    to_ahead: Array
    to_behind: Array
    first: Array
    last: Array
    system: System

    def __call__(self, elapsed: Array) -> Array:
        """States (n, m, K) after elapsed times (m, K)."""
        states = self.ahead(_share(elapsed, self.to_ahead))
        if self.behind is not None and (elapsed < 0.0).any():
            before = self.behind(_share(elapsed, self.to_behind))
            states = np.where(elapsed < 0.0, before, states)
        return states

    def of(self, trajectories: slice) -> _Flow:
        """That of some of the trajectories."""
        places = np.arange(self.starts.size)[trajectories]
        return _Flow(
            self.starts[places],
            self.points[places],
            self.ahead.chosen(places),
            None if self.behind is None else self.behind.chosen(places),
            self.to_ahead[places],
            self.to_behind[places],
            self.first[places],
            self.last[places],
            self.system,
        )

    def heights(self, event: int, elapsed: Array, moved: _Move | None = None) -> Array:
        """What crosses zero at an event, perhaps moved, after elapsed times (m, K): (m, K)."""
        states, when = self(elapsed), self.system.events[event].when
        columns = np.repeat(self.points.T, elapsed.shape[1], axis=1)
        times = (self.starts[:, None] + elapsed).ravel()
        with np.errstate(all="ignore"):
            heights = when(times, states.reshape(len(states), -1), columns)
        heights = np.broadcast_to(heights, times.shape).reshape(elapsed.shape)
        if moved is None:
            return np.asarray(heights)
        return np.where(elapsed == 0.0, moved.at_start(heights), heights + moved(elapsed))


def _share(elapsed: Array, whole: Array) -> Array:
    """Elapsed times (m, K) over whole ones (m,), inside of [0, 1]."""
    shares = elapsed / np.where(whole == 0.0, 1.0, whole)[:, None]
    return np.clip(shares, 0.0, 1.0)


@dataclass(frozen=True)
class ForcedTrajectories(PseudoTimeTrajectories):
    """Trajectories of a forced order, over the pseudo-time of its stretches.

    ``borders`` (m, stretches + 1) are clock times, which need not ascend; ``guards`` (g, m) belong
    to the order, with the elapsed ``turns`` (g, m) of those at turns. Its clearances are rows
    behind these.
    """

    system: System
    points: Array
    clock: Clock
    flows: Sequence[_Flow]
    borders: Array
    guards: Array
    turns: Array
    steps: int
    integrator: str
    method: str
    avoided: float = 0.0

    @property
    def end(self) -> float:
        return float(len(self.flows))

    @property
    def largest(self) -> Array:
        return np.asarray(np.abs(self(np.linspace(0.0, self.end, _SAMPLES))).max(axis=2))

    @property
    def early(self) -> Array:
        """Largest absolute values after the first steps."""
        flow, n = self.flows[0], self.clock.n_states
        count = min(EARLY_STEPS, flow.ahead.breaks.shape[1] - 1)
        shares = np.where(np.isfinite(flow.ahead.breaks), flow.ahead.breaks, 1.0)[:, 1 : 1 + count]
        states = np.abs(flow(shares * flow.to_ahead[:, None])).max(axis=2)
        return np.concatenate([states, self.largest[n:]])

    def __call__(self, times: Array) -> Array:
        """States, guards, clock and length of the stretch at pseudo-times (T,)."""
        n, g = self.clock.n_states, self.clock.n_guards
        stretch = np.clip(np.floor(times).astype(int), 0, len(self.flows) - 1)
        lengths = np.diff(self.borders, axis=1)
        states = np.empty((n + g + CLOCK_STATES, len(self.points), times.size))
        constant = n + len(self.guards)
        states[n:constant] = self.guards[:, :, None]
        elapsed = (times - stretch) * lengths[:, stretch]
        states[n + g], states[n + g + 1] = (
            self.borders[:, stretch] + elapsed,
            lengths[:, stretch],
        )
        for i in np.unique(stretch):
            here = stretch == i
            states[:n, :, here] = self.flows[i](elapsed[:, here])
            for row, each in enumerate(self._clearances, constant):
                heights = self.flows[i].heights(each.event, elapsed[:, here])
                states[row, :, here] = each.sign * heights.T
        return states

    @property
    def _clearances(self) -> tuple[Clearance, ...]:
        return () if self.clock.forced is None else self.clock.forced.clearances

    def of(self, trajectories: slice) -> ForcedTrajectories:
        """Some of the trajectories; see :meth:`DenseTrajectories.of`."""
        return replace(
            self,
            points=self.points[trajectories],
            flows=[flow.of(trajectories) for flow in self.flows],
            borders=self.borders[trajectories],
            guards=self.guards[:, trajectories],
            turns=self.turns[:, trajectories],
        )

    def samples(self, count: int) -> list[tuple[float, Array]]:
        """Pseudo-times with the states (n, m) there."""
        times = np.linspace(0.0, self.end, max(count, 2))
        return list(zip(times.tolist(), np.moveaxis(self(times), 2, 0), strict=True))


def forced_trajectories(
    system: System,
    clock: Clock,
    integrator: SpanIntegrator,
    points: Array,
    tolerances: Tolerances,
) -> ForcedTrajectories:
    """Trajectories of the forced order of a clock at points (m, d).

    ``system`` is the one over its stretches.

    Raises
    ------
    ContinuationError
        If they cannot be continued to some of the points.
    """
    return _Follower(system, clock, integrator, points, tolerances).trajectories()


_Moved = dict[tuple[int, tuple[int, ...]], _Move]
"""By how much the surfaces of events are moved, on sides of switches."""


@dataclass(frozen=True)
class _Follower:
    """Follows a forced order, stretch after stretch."""

    system: System
    clock: Clock
    integrator: SpanIntegrator
    points: Array
    tolerances: Tolerances

    @property
    def _forced(self) -> ForcedOrder:
        assert self.clock.forced is not None
        return self.clock.forced

    @property
    def _parameters(self) -> Array:
        """Those of the system at the points, (m, d)."""
        return self.points[:, : self.points.shape[1] - len(self._forced.opened)]

    def trajectories(self) -> ForcedTrajectories:
        clock, forced = self.clock, self._forced
        times = np.full(len(self.points), clock.horizon[0])
        expected = forced.lengths(self.points)
        states = self._on_sides(clock.system.initial(np.ascontiguousarray(self._parameters.T)), 0)
        guards = np.ones((len(forced.guards), len(self.points)))
        turns, moved = np.full_like(guards, np.nan), _Moved()
        self._guard(guards, -1, 0, times, states)
        flows, borders = list[_Flow](), [times]
        for i, met in enumerate(forced.met):
            flow, elapsed = self._stretch(i, times, states, expected[:, i], moved)
            self._heights_at_turns(i, flow, guards, turns)
            flows.append(flow)
            times = times + elapsed
            borders.append(times)
            states = self._on_sides(flow(elapsed[:, None])[:, :, 0], i)
            states = self._reset(i, met, times, states, guards)
        if clock.order.ending is Ending.HORIZON:
            flow = self._flow(len(forced.met), times, states, clock.horizon[1] - times)
            self._heights_at_turns(len(forced.met), flow, guards, turns)
            flows.append(flow)
            borders.append(np.full_like(times, clock.horizon[1]))
        return ForcedTrajectories(
            self.system,
            self.points,
            clock,
            tuple(flows),
            np.stack(borders, axis=1),
            guards,
            turns,
            sum(flow.ahead.breaks.shape[1] - 1 for flow in flows),
            "stack",
            "DOP853",
        )

    def _stretch(
        self, i: int, times: Array, states: Array, expected: Array, moved: _Moved
    ) -> tuple[_Flow, Array]:
        """The flow of a stretch from times (m,) to its event, and the elapsed times (m,).

        A surface that is ``moved`` by an opened event joins the others.
        """
        (first, *_), before = self._forced.met[i], self._forced.met[i - 1] if i else ()
        event = self.clock.system.events[first]
        if event.at is not None:
            at = event.at(np.ascontiguousarray(self._parameters.T))
            elapsed = np.broadcast_to(at, times.shape) - times
            return self._flow(i, times, states, elapsed), elapsed
        margin = self._forced.margins[i]
        at_root = np.full(times.shape, first in before)
        for column, opened in enumerate(self._forced.opened, self._parameters.shape[1]):
            if opened.stretch != i:
                continue
            if isinstance(opened, Turn):
                return self._to_opened(opened, column, times, states, expected, moved)
            begins = guard_heights(self.clock.system, first, None, times, states, self._parameters)
            height = self.points[:, column] ** 2
            move = _Move(height - begins, height, opened.fading)
            return self._to_root(i, times, states, expected, np.zeros_like(at_root), move)
        begins_at_it = first in before[:1]
        if not begins_at_it:  # at points that do, it is the one expected
            at_root = np.abs(expected) > margin
        return self._to_root(
            i, times, states, expected, at_root, moved.get((first, self.clock.order.sides[i]))
        )

    def _reset(
        self, instant: int, met: tuple[int, ...], times: Array, states: Array, guards: Array
    ) -> Array:
        """States (n, m) after the events at an instant, on the sides of the next stretch."""
        self._guard(guards, instant, 0, times, states)
        columns = np.ascontiguousarray(self._parameters.T)
        for count, k in enumerate(met, 1):
            then = self.clock.system.events[k].then
            if then is not None:
                after = np.asarray(then(times, states, columns), dtype=float)
                states = np.broadcast_to(after, states.shape)
            self._guard(guards, instant, count, times, states)
        last = instant + 1 == self.clock.order.stretches
        return states if last else self._on_sides(states, instant + 1)

    def _on_sides(self, states: Array, stretch: int) -> Array:
        """States (n, m), with sides or without, on the sides of a stretch."""
        alone, sides = states[: self.clock.n_states], self._sides(stretch)
        rows = [np.full((1, alone.shape[1]), float(side)) for side in sides]
        return np.concatenate([alone, *rows])

    def _sides(self, stretch: int) -> tuple[int, ...]:
        """The sides of switches on a stretch."""
        return self.clock.order.sides[stretch] if self.clock.system.n_sides else ()

    def _guard(
        self, guards: Array, instant: int, applied: int, times: Array, states: Array
    ) -> None:
        """Fill in the guards at an instant, after so many events there."""
        for row, guard in zip(guards, self._forced.guards, strict=True):
            if not isinstance(guard, Guard):
                continue
            if (guard.instant, guard.applied) == (instant, applied):
                at = times, states, self._parameters
                row[:] = guard_heights(self.clock.system, guard.event, guard.side, *at)

    def _flow(
        self,
        stretch: int,
        times: Array,
        states: Array,
        ahead: Array,
        behind: Array | float = 0.0,
        whole: bool = True,
    ) -> _Flow:
        """The flow of a stretch from times (m,) and states, up to elapsed times (m,) and back.

        It reaches around the turns of the stretch. Unless it is wanted ``whole``, it ends where
        its rates are not finite.
        """
        behind = np.broadcast_to(behind, times.shape)
        for turn in self._turns(stretch):
            expected = self._expected(turn)
            behind = np.minimum(np.minimum(behind, np.minimum(ahead, 0.0)), expected - turn.margin)
            ahead = np.maximum(np.maximum(ahead, 0.0), expected + turn.margin)
        system = on_sides(self.clock.system, self._sides(stretch))
        alone = states[: system.n_differential]
        forwards, last = self._paths(system, times, alone, ahead, whole)
        back, first = None, behind
        if (behind < 0.0).any():
            back, first = self._paths(system, times, alone, behind, whole)
        return _Flow(times, self._parameters, forwards, back, ahead, behind, first, last, system)

    def _turns(self, stretch: int) -> list[Turn]:
        """The turns of a stretch at which heights are asked for."""
        both = *self._forced.guards, *self._forced.opened
        return [each for each in both if isinstance(each, Turn) and each.stretch == stretch]

    def _expected(self, turn: Turn) -> Array:
        """About the elapsed time of a turn, (m,)."""
        return turn.times(self.points[:, : turn.columns])[:, 0]

    def _at_turn(self, turn: Turn, flow: _Flow) -> tuple[Array, Array, Array]:
        """The elapsed times (m,) of a turn along a flow, the heights there and the rises to it."""
        event, expected = self.clock.system.events[turn.event], self._expected(turn)
        around = expected - turn.margin, expected + turn.margin
        times, heights = _nearest_turns(flow, turn.event, turn.sign, around, expected)
        self._raise(~np.isfinite(times), f"does not turn next to event {quote(event.name)}")
        if turn.lowest:
            before = np.zeros_like(times), times
            start = -_nearest_turns(flow, turn.event, -turn.sign, before)[1]
        else:
            start = turn.sign * flow.heights(turn.event, np.zeros((len(times), 1)))[:, 0]
        rises = (times > 0.0) & (heights > start)
        self._raise(~rises, f"turns no nearer to event {quote(event.name)} than it starts")
        return times, heights, heights - start

    def _heights_at_turns(self, stretch: int, flow: _Flow, guards: Array, turns: Array) -> None:
        """Fill in the guards at turns of a stretch, and the elapsed times of these."""
        for row, guard in enumerate(self._forced.guards):
            if isinstance(guard, Turn) and guard.stretch == stretch:
                turns[row], height, rise = self._at_turn(guard, flow)
                guards[row] = height / rise

    def _to_opened(
        self,
        turn: Turn,
        column: int,
        times: Array,
        states: Array,
        expected: Array,
        moved: _Moved,
    ) -> tuple[_Flow, Array]:
        """The flow past an opened event, and the elapsed times (m,) of its last root before a turn.

        The surface is moved between the start, where a ``column`` of the points would be one, and
        the turn, where it would be zero: there is always a root.
        """
        event, i = self.clock.system.events[turn.event], turn.stretch
        for factor in _FOLLOWING.wider:
            low = expected - factor * self._forced.margins[i]
            flow = self._flow(i, times, states, np.maximum(expected, 0.0), np.minimum(low, 0.0))
            at_turn, height, rise = self._at_turn(turn, flow)
            by = turn.sign * (self.points[:, column] ** 2 * rise - height)
            low = np.minimum(low, np.minimum(at_turn - factor * turn.margin, 0.0))
            never = np.zeros(times.shape, dtype=bool)
            between = low, at_turn
            elapsed = _nearest_roots(flow, turn.event, between, at_turn, never, _Move(by))
            if np.isfinite(elapsed).all():
                moved.update({(k, sides): _Move(scale * by) for k, sides, scale in turn.surface})
                return flow, elapsed
        self._raise(~np.isfinite(elapsed), f"does not come to event {quote(event.name)}", i)
        raise AssertionError

    def _paths(
        self, system: System, times: Array, states: Array, elapsed: Array, whole: bool
    ) -> tuple[Paths, Array]:
        """The paths from times (m,) and states to elapsed times, and how far they come, (m,)."""
        spans = Spans(times, states, times + elapsed)
        run = cast(SeparateRun, self.integrator.run)
        absolute = np.broadcast_to(self.tolerances.absolute, (self.clock.system.n_differential, 1))
        tolerances = replace(self.tolerances, absolute=absolute[: len(states)])
        paths = share_paths(run, system, self._parameters, spans, tolerances)
        ends = np.array([path.end if path.steps else 0.0 for path in paths])
        self._raise(ends < 1.0 - NEGLIGIBLE if whole else ends == 0.0, _NOT_FINITE)
        return Paths.of(paths), ends * elapsed

    def _to_root(
        self,
        i: int,
        times: Array,
        states: Array,
        expected: Array,
        at_root: NDArray[np.bool_],
        moved: _Move | None,
    ) -> tuple[_Flow, Array]:
        """The flow around the expected root of an event, and the elapsed times (m,) of roots.

        They are at most a horizon before the start: farther back, trajectories may grow without
        bound, and take ever more work.
        """
        (event, *_), margin = self._forced.met[i], self._forced.margins[i]
        start, end = self.clock.horizon
        earliest = 2.0 * start - end - times
        if moved is not None and moved.start is not None:
            earliest, expected = np.zeros_like(times), np.maximum(expected, 0.0)
        for factor in _FOLLOWING.wider:
            low = np.maximum(expected - factor * margin, earliest)
            high = np.maximum(expected + factor * margin, earliest)
            to = np.maximum(high, 0.0), np.minimum(low, 0.0)
            flow = self._flow(i, times, states, *to, whole=False)
            between = np.maximum(low, flow.first), np.minimum(high, flow.last)
            elapsed = _nearest_roots(flow, event, between, expected, at_root, moved)
            if np.isfinite(elapsed).all():
                return flow, elapsed
        ended = (low < flow.first) | (flow.last < high)
        self._raise(~np.isfinite(elapsed) & ended, _NOT_FINITE, i)
        name = quote(self.clock.system.events[event].name)
        self._raise(~np.isfinite(elapsed), f"does not come to event {name}", i)
        raise AssertionError

    def _raise(self, fails: NDArray[np.bool_], what: str, missed: int | None = None) -> None:
        """Raise a ContinuationError if some trajectories fail."""
        if not fails.any():
            return
        point = self._parameters[int(np.argmax(fails))]
        error = ContinuationError(
            f"an order of events that holds in a part of the box cannot be continued: a trajectory "
            f"{what}{at_point(self.clock, point)}",
            remedy=REMEDY,
        )
        error.fails, error.missed = fails, missed
        raise error


def guard_heights(
    system: System, event: int, side: float | None, times: Array, states: Array, points: Array
) -> Array:
    """What ``when`` of an event is at times (m,) and states (n, m), perhaps on a side, (m,)."""
    if side is not None:
        states = states.copy()
        crossings = [k for k, e in enumerate(system.events) if e.switch and e.then is not None]
        states[len(states) - system.n_sides + crossings.index(event)] = side
    with np.errstate(all="ignore"):
        heights = system.events[event].when(times, states, np.ascontiguousarray(points.T))
    return np.broadcast_to(heights, times.shape)


def _nearest_roots(
    flow: _Flow,
    event: int,
    between: tuple[Array, Array],
    expected: Array,
    at_root: NDArray[np.bool_],
    moved: _Move | None = None,
) -> Array:
    """The roots of an event nearest to what is expected, (m,); NaN where there are none between.

    Where stretches begin ``at_root`` (m,), that one does not count, and none that is passed in
    another direction than that of the event. Where rates switch, either direction counts: a slip
    that goes on where it would stick turns back.
    """
    low, high = between
    elapsed = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, _FOLLOWING.looks)
    heights = flow.heights(event, elapsed, moved)
    what = flow.system.events[event]
    passed = what.switch | (np.diff(heights) * what.direction >= 0.0)
    at_start = np.abs(flow.heights(event, np.zeros((len(low), 1)), moved)[:, 0])
    deflated = at_root & (at_start <= _FOLLOWING.at_root * np.abs(heights).max(axis=1))
    heights = _deflated(heights, elapsed, deflated)
    signs = np.sign(heights)
    crossed = signs[:, :-1] * signs[:, 1:] < 0.0
    crossed |= (signs[:, :-1] == 0.0) & (signs[:, 1:] != 0.0)
    crossed &= passed
    middle = 0.5 * (elapsed[:, :-1] + elapsed[:, 1:])
    distance = np.where(crossed, np.abs(middle - expected[:, None]), np.inf)
    chosen = distance.argmin(axis=1)
    rows = np.arange(len(low))
    exists = np.isfinite(distance[rows, chosen])

    def height(at: Array) -> Array:
        heights = flow.heights(event, at[:, None], moved)
        return _deflated(heights, at[:, None], deflated)[:, 0]

    begin = elapsed[rows, chosen]
    length = elapsed[rows, chosen + 1] - begin
    start, end = (np.where(exists, heights[rows, chosen + k], 0.0) for k in (0, 1))
    rounding = EPSILON * (np.abs(flow.starts) + np.abs(begin)) / np.maximum(np.abs(length), TINY)
    accuracy = np.maximum(2.0 * rounding, ROUNDING)
    shares = roots(lambda share: height(begin + share * length), start, end, accuracy)
    return np.where(exists, begin + shares * length, np.nan)


def _nearest_turns(
    flow: _Flow,
    event: int,
    sign: float,
    between: tuple[Array, Array],
    expected: Array | None = None,
) -> tuple[Array, Array]:
    """The turns nearest to what is expected, (m,), and their heights; NaN where there are none.

    Those of the largest heights, times a ``sign``, where nothing is ``expected``.
    """
    low, high = between
    rows = np.arange(len(low))
    exists = np.ones(len(low), dtype=bool)
    for finer in range(_FOLLOWING.finer):
        elapsed = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, _FOLLOWING.looks)
        heights = sign * flow.heights(event, elapsed)
        chosen = np.clip(heights.argmax(axis=1), 1, _FOLLOWING.looks - 2)
        if not finer:
            inner = heights[:, 1:-1]
            turns = (inner >= heights[:, :-2]) & (inner >= heights[:, 2:])
            exists[:] = turns.any(axis=1)
            if expected is not None:
                apart = np.abs(elapsed[:, 1:-1] - expected[:, None])
                chosen = 1 + np.where(turns, apart, np.inf).argmin(axis=1)
        low, high = elapsed[rows, chosen - 1], elapsed[rows, chosen + 1]
    before, here, after = (heights[rows, chosen + k] for k in (-1, 0, 1))
    slope, bend = 0.5 * (after - before), after - 2.0 * here + before
    step = -slope / np.where(bend < 0.0, bend, -np.inf)
    times = elapsed[rows, chosen] + 0.5 * (high - low) * step
    return np.where(exists, times, np.nan), here + 0.5 * slope * step


def _deflated(heights: Array, elapsed: Array, deflated: NDArray[np.bool_]) -> Array:
    """Heights (m, K) without the root at the beginning of some stretches (m,)."""
    with np.errstate(over="ignore"):  # where it is not deflated
        divided = heights / np.where(elapsed == 0.0, TINY, elapsed)
    return np.where(deflated[:, None], divided, heights)
