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

from rankone.support.arrays import NEGLIGIBLE, Array
from rankone.support.errors import quote
from rankone.trajectories.events.event_integration import (
    LOOKING,
    Flow,
    Move,
    guard_heights,
    nearest_roots,
    nearest_turns,
)
from rankone.trajectories.events.sides import REMEDY, OrderError, at_point, on_sides
from rankone.trajectories.events.stretches import PseudoTimeTrajectories
from rankone.trajectories.integrators.integrator import (
    EARLY_STEPS,
    SIZE_TIMES,
    Paths,
    SeparateRun,
    SpanIntegrator,
    Spans,
    Tolerances,
    share_paths,
)
from rankone.trajectories.system.features import Clearance, Ending, ForcedOrder, Guard, Turn
from rankone.trajectories.system.system import Clock, System
from rankone.trajectories.system.timeline import CLOCK_STATES

_NOT_FINITE = "runs to where its rates are not finite"


class ContinuationError(OrderError):
    """An order of events cannot be continued to all of the points (m, d).

    ``fails`` (m,) marks those at which it cannot. ``missed`` is the stretch whose event does not
    come, if that is why. It may be that it cannot ``at_corners`` of the box alone.
    """

    fails: NDArray[np.bool_]
    missed: int | None = None
    at_corners: bool = False


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
    flows: Sequence[Flow]
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
        return np.asarray(np.abs(self(np.linspace(0.0, self.end, SIZE_TIMES))).max(axis=2))

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


_Moved = dict[tuple[int, tuple[int, ...]], Move]
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
        flows, borders = list[Flow](), [times]
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
    ) -> tuple[Flow, Array]:
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
            move = Move(height - begins, height, opened.fading)
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
    ) -> Flow:
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
        return Flow(times, self._parameters, forwards, back, ahead, behind, first, last, system)

    def _turns(self, stretch: int) -> list[Turn]:
        """The turns of a stretch at which heights are asked for."""
        both = *self._forced.guards, *self._forced.opened
        return [each for each in both if isinstance(each, Turn) and each.stretch == stretch]

    def _expected(self, turn: Turn) -> Array:
        """About the elapsed time of a turn, (m,)."""
        return turn.times(self.points[:, : turn.columns])[:, 0]

    def _at_turn(self, turn: Turn, flow: Flow) -> tuple[Array, Array, Array]:
        """The elapsed times (m,) of a turn along a flow, the heights there and the rises to it."""
        event, expected = self.clock.system.events[turn.event], self._expected(turn)
        around = expected - turn.margin, expected + turn.margin
        times, heights = nearest_turns(flow, turn.event, turn.sign, around, expected)
        self._raise(~np.isfinite(times), f"does not turn next to event {quote(event.name)}")
        if turn.lowest:
            before = np.zeros_like(times), times
            start = -nearest_turns(flow, turn.event, -turn.sign, before)[1]
        else:
            start = turn.sign * flow.heights(turn.event, np.zeros((len(times), 1)))[:, 0]
        rises = (times > 0.0) & (heights > start)
        self._raise(~rises, f"turns no nearer to event {quote(event.name)} than it starts")
        return times, heights, heights - start

    def _heights_at_turns(self, stretch: int, flow: Flow, guards: Array, turns: Array) -> None:
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
    ) -> tuple[Flow, Array]:
        """The flow past an opened event, and the elapsed times (m,) of its last root before a turn.

        The surface is moved between the start, where a ``column`` of the points would be one, and
        the turn, where it would be zero: there is always a root.
        """
        event, i = self.clock.system.events[turn.event], turn.stretch
        for factor in LOOKING.wider:
            low = expected - factor * self._forced.margins[i]
            flow = self._flow(i, times, states, np.maximum(expected, 0.0), np.minimum(low, 0.0))
            at_turn, height, rise = self._at_turn(turn, flow)
            by = turn.sign * (self.points[:, column] ** 2 * rise - height)
            low = np.minimum(low, np.minimum(at_turn - factor * turn.margin, 0.0))
            never = np.zeros(times.shape, dtype=bool)
            between = low, at_turn
            elapsed = nearest_roots(flow, turn.event, between, at_turn, never, Move(by))
            if np.isfinite(elapsed).all():
                moved.update({(k, sides): Move(scale * by) for k, sides, scale in turn.surface})
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
        moved: Move | None,
    ) -> tuple[Flow, Array]:
        """The flow around the expected root of an event, and the elapsed times (m,) of roots.

        They are at most a horizon before the start: farther back, trajectories may grow without
        bound, and take ever more work. Those where rates cease to be finite are none: rounding
        would decide on which side of that they are.
        """
        (event, *_), margin = self._forced.met[i], self._forced.margins[i]
        start, end = self.clock.horizon
        earliest = 2.0 * start - end - times
        if moved is not None and moved.start is not None:
            earliest, expected = np.zeros_like(times), np.maximum(expected, 0.0)
        for factor in LOOKING.wider:
            low = np.maximum(expected - factor * margin, earliest)
            high = np.maximum(expected + factor * margin, earliest)
            to = np.maximum(high, 0.0), np.minimum(low, 0.0)
            flow = self._flow(i, times, states, *to, whole=False)
            between = np.maximum(low, flow.first), np.minimum(high, flow.last)
            elapsed = nearest_roots(flow, event, between, expected, at_root, moved)
            least = (1.0 - NEGLIGIBLE) * np.where(low < flow.first, flow.first, -np.inf)
            most = (1.0 - NEGLIGIBLE) * np.where(flow.last < high, flow.last, np.inf)
            elapsed[(elapsed < least) | (most < elapsed)] = np.nan
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
