"""Roots of functions along trajectories, events that end or reset them, and flows between."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import EPSILON, RESOLVED, ROUNDING, TINY, Array
from rankone.support.budget import OutOfBudgetError, Reached, charge, hold
from rankone.support.costs import CALL
from rankone.trajectories.events.event_crossings import Crossings
from rankone.trajectories.events.event_trajectory import SAME_INSTANT, EventTrajectory, Instants
from rankone.trajectories.integrators.defects import roots
from rankone.trajectories.integrators.integrator import (
    NODES,
    Path,
    Paths,
    Spanning,
    Spans,
    Tolerances,
)
from rankone.trajectories.system.features import SystemEvent
from rankone.trajectories.system.system import System


@dataclass(frozen=True)
class _Looking:
    """Where roots of a forced order are looked for."""

    looks: int
    wider: tuple[float, float]
    finer: int
    at_root: float
    most_faded: float


LOOKING = _Looking(
    looks=65,  # Places at which a root is looked for
    wider=(1.0, 4.0),  # Factors on the distance up to which it is looked for
    finer=3,  # Looks at a turn, each between the neighbours of the highest place before
    at_root=RESOLVED,  # Height over the largest one where a stretch begins at a root
    most_faded=20.0,  # Logarithm of the factor by which a surface that was moved comes back
)


@dataclass(frozen=True)
class Move:
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
        exponents = np.clip(self.fading * by * elapsed, -LOOKING.most_faded, LOOKING.most_faded)
        return np.asarray(by * np.exp(-exponents))


@dataclass(frozen=True)
class Flow:
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

    def of(self, trajectories: slice) -> Flow:
        """That of some of the trajectories."""
        places = np.arange(self.starts.size)[trajectories]
        return Flow(
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

    def heights(self, event: int, elapsed: Array, moved: Move | None = None) -> Array:
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


def nearest_roots(
    flow: Flow,
    event: int,
    between: tuple[Array, Array],
    expected: Array,
    at_root: NDArray[np.bool_],
    moved: Move | None = None,
) -> Array:
    """The roots of an event nearest to what is expected, (m,); NaN where there are none between.

    Where stretches begin ``at_root`` (m,), that one does not count, and none that is passed in
    another direction than that of the event. Where rates switch, either direction counts: a slip
    that goes on where it would stick turns back.
    """
    low, high = between
    elapsed = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, LOOKING.looks)
    heights = flow.heights(event, elapsed, moved)
    what = flow.system.events[event]
    passed = what.switch | (np.diff(heights) * what.direction >= 0.0)
    at_start = np.abs(flow.heights(event, np.zeros((len(low), 1)), moved)[:, 0])
    deflated = at_root & (at_start <= LOOKING.at_root * np.abs(heights).max(axis=1))
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


def nearest_turns(
    flow: Flow,
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
    for finer in range(LOOKING.finer):
        elapsed = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, LOOKING.looks)
        heights = sign * flow.heights(event, elapsed)
        chosen = np.clip(heights.argmax(axis=1), 1, LOOKING.looks - 2)
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


def _share(elapsed: Array, whole: Array) -> Array:
    """Elapsed times (m, K) over whole ones (m,), inside of [0, 1]."""
    shares = elapsed / np.where(whole == 0.0, 1.0, whole)[:, None]
    return np.clip(shares, 0.0, 1.0)


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


# -----------------------------------------------------------------------------
# Events: roots of functions along trajectories, which end them or reset their states.
#
# Trajectories are integrated from reset to reset, so that no step straddles one; events that change
# nothing are recorded along the way. After a reset each trajectory has a start of its own, and goes
# on for about as long as it took from the same events to the next ones before, and then for longer.
# A stack integrates over the share of such a stretch, in which all trajectories begin and end
# together.


_COPIES = 2  # Copies of a path: alone, and joined with those before it
_LONGER = 4.0  # Factor from a stretch without a reset to the next one


@dataclass(frozen=True)
class Ahead:
    """What is foreseen of m trajectories: their next ``marks`` (m, k), and ``ends`` (m,).

    They stop at the ends. Either may be left open.
    """

    marks: Array | None = None
    ends: Array | None = None

    def of(self, some: list[int], starts: Array, ends: Array) -> tuple[Array, Array | None]:
        """The ends of some trajectories, and the marks on the way there from their starts.

        Those that are beyond the foreseen ends already, or have none, go on to other ``ends``.
        """
        if self.ends is not None:
            ends = np.where(self.ends[some] > starts, self.ends[some], ends)
        if self.marks is None:
            return ends, None
        marks = self.marks[some]
        gaps = np.diff(marks, axis=1, prepend=starts[:, None], append=ends[:, None])
        return ends, marks if (gaps > 0.0).all() else None


@dataclass(frozen=True)
class Goal:
    """How far trajectories are followed, unless to the last edge.

    One is followed no further once it is ``enough`` on the way to the next edge. The first
    integration is as told by what is ``ahead``; so many events are asked for at least.
    """

    enough: Callable[[EventTrajectory, float], bool] | None = None
    ahead: Ahead | None = None
    count: int = 0


def integrate_to_events(
    integrator: Spanning,
    system: System,
    points: Array,
    edges: Sequence[float],
    tolerances: Tolerances,
    goal: Goal | None = None,
    begun: Sequence[EventTrajectory] = (),
) -> list[EventTrajectory]:
    """The trajectories at points (m, d), with the events of the system.

    They go on from those that have ``begun``, if any. States are reset at the edges where the
    system jumps, and after that by events. An OutOfBudgetError says which time all trajectories
    have reached.
    """
    goal = goal or Goal()
    enough, ahead, count = goal.enough, goal.ahead, goal.count
    search = _Search(system, Instants(system.events, edges[-1] - edges[0]), tolerances)
    trajectories = [each.copy() for each in begun] or search.begin(points, edges[0])
    for a, b in itertools.pairwise(edges):
        search.jump(trajectories, points, a)
        while running := [
            k
            for k, each in enumerate(trajectories)
            if _runs(each, b) and not (enough and enough(each, b))
        ]:
            some = [trajectories[k] for k in running]
            ends = np.array([each.next_end(b, count) for each in some])
            between, told, ahead = None, ahead, None
            if told is not None:
                ends, between = told.of(running, np.array([each.end for each in some]), ends)
            try:
                paths = search.paths(integrator, some, points[running], ends, between)
                search.advance_all(some, paths, points[running], ends.tolist())
            except OutOfBudgetError as out:
                raise out.at(_reached(some, out.reached)) from out
    return trajectories


def _reached(trajectories: Sequence[EventTrajectory], further: Reached | None) -> Reached:
    """How far all trajectories came, and perhaps ``further`` in the paths that were cut short."""
    time = min(each.end for each in trajectories)
    steps = max(each.steps for each in trajectories)
    if further is None:
        return Reached(time, steps, None)
    return Reached(further.time, steps + further.steps, further.chattering)


def _hold(paths: Sequence[Path]) -> None:
    """Count the bytes of paths that are followed to their events."""
    for path in paths:
        hold(path, _COPIES * path.nbytes)


def _runs(trajectory: EventTrajectory, end: float) -> bool:
    return not trajectory.ends and trajectory.end < end


@dataclass(frozen=True)
class _Search:
    """Integrates from event to event, and looks for the next ones."""

    system: System
    instants: Instants
    tolerances: Tolerances

    @property
    def events(self) -> tuple[SystemEvent, ...]:
        return self.instants.events

    @property
    def horizon(self) -> float:
        return self.instants.horizon

    def begin(self, points: Array, time: float) -> list[EventTrajectory]:
        """Trajectories at their first time, after the known events there."""
        columns = np.ascontiguousarray(points.T)
        states = self.system.initial(columns)
        ahead = np.full((len(self.events), len(points)), math.inf)
        for k, event in enumerate(self.events):
            if event.at is not None:
                ahead[k] = event.at(columns)
        instant = SAME_INSTANT * self.horizon
        ahead[~(ahead >= time - instant)] = math.inf
        nothing = np.zeros((0, NODES.size, len(states)))
        trajectories = [
            EventTrajectory([Path(np.array([time]), nothing, state)], time, known)
            for state, known in zip(states.T, ahead.T.copy(), strict=True)
        ]
        self.instants.land(trajectories, np.full(len(points), time), states, columns)
        at_once = np.flatnonzero((ahead <= time + instant).any(axis=0))
        if at_once.size:
            some = [trajectories[k] for k in at_once.tolist()]
            fired = [self.instants.due(each, time) for each in some]
            times = np.full(at_once.size, time)
            self.instants.apply(some, fired, times, states[:, at_once], columns[:, at_once])
            for each in some:
                each.stretch = math.inf
        return trajectories

    def jump(self, trajectories: Sequence[EventTrajectory], points: Array, time: float) -> None:
        """Reset the states where the system jumps."""
        kind = self.system.jumps.kind_at(time)
        for each, point in zip(trajectories, points, strict=True):
            if kind is None or each.ends:
                continue
            with np.errstate(all="ignore"):
                after = self.system.jumps.jumped(kind, each.state[:, None], point[:, None])[:, 0]
            if each.occurrences and each.occurrences[-1].time == time:
                each.occurrences[-1] = replace(each.occurrences[-1], after=after)
            else:
                each.paths.append(replace(each.paths[-1], state=after))
                each.paths[-1] = Path(np.array([time]), each.paths[-1].nodal[:0], after)
            self.instants.land([each], np.array([time]), after[:, None], point[:, None])

    def paths(
        self,
        integrator: Spanning,
        trajectories: Sequence[EventTrajectory],
        points: Array,
        ends: Array,
        between: Array | None,
    ) -> Sequence[Path]:
        """The trajectories from where they are to their ends, or as far as they go."""
        starts = np.array([each.end for each in trajectories])
        states = np.stack([each.state for each in trajectories], axis=1)
        spans = Spans(starts, states, ends, between)
        paths = integrator.paths(self.system, points, spans, self.tolerances)
        _hold(paths)
        return paths

    def advance_all(
        self,
        trajectories: Sequence[EventTrajectory],
        paths: Sequence[Path],
        points: Array,
        ends: Sequence[float],
    ) -> None:
        """Follow each path to the first event that interrupts it, or to its end.

        A stack ends early where one of its trajectories leaves where rates are finite. If an event
        interrupted some of them before that, the others may go on without those.
        """
        charge(150 * CALL * len(paths))  # each is followed to an event or its end
        for each, path in zip(trajectories, paths, strict=True):
            each.ends |= not path.steps
        moved = [k for k, path in enumerate(paths) if path.steps]
        if not moved:
            return
        some = [trajectories[k] for k in moved]
        moving = [paths[k] for k in moved]
        instant = SAME_INSTANT * self.horizon
        fired = [each.fired(instant) for each in some]
        landed = [each.landed for each in some]
        crossings = Crossings(self.system, moving, points[moved], fired, instant, landed)
        of_events = [
            crossings.of(k, event) if event.at is None else self._known(k, some, moving)
            for k, event in enumerate(self.events)
        ]
        crossed = [[times[place] for times in of_events] for place in range(len(moved))]
        next_times = np.array([self._next(each) for each in crossed])
        self._record(some, moving, crossed, next_times)
        interrupted = np.flatnonzero(next_times < math.inf)
        for place in np.flatnonzero(next_times == math.inf).tolist():
            each, k = some[place], moved[place]
            each.paths.append(paths[k])
            each.landed = {}
            each.stretch, each.rounds = _LONGER * each.stretch, 0
            each.ends = not interrupted.size and each.end < ends[k] - SAME_INSTANT * self.horizon
        if interrupted.size:
            at = next_times[interrupted]
            met = Paths.of([moving[k] for k in interrupted.tolist()])
            before = self._on_sides(met(at[:, None])[:, :, 0])
            for column, k in enumerate(interrupted.tolist()):
                if at[column] == moving[k].breaks[0]:  # where it is, to the last bit
                    before[:, column] = some[k].state
            cuts = met.until(at, before)
            _hold(cuts)
            for place, cut in zip(interrupted.tolist(), cuts, strict=True):
                some[place].reach(cut, self._at_once(cut))
            fired_now = [self._fired(crossed[k], next_times[k]) for k in interrupted.tolist()]
            at_points = np.ascontiguousarray(points[moved][interrupted].T)
            self.instants.apply(
                [some[k] for k in interrupted.tolist()], fired_now, at, before, at_points
            )

    def _on_sides(self, states: Array) -> Array:
        """States (n, m) whose sides are whole numbers, as steps have them but for rounding."""
        first = len(states) - self.system.n_sides
        states[first:] = np.rint(states[first:])
        return states

    def _known(
        self, k: int, trajectories: Sequence[EventTrajectory], paths: Sequence[Path]
    ) -> list[Array]:
        """For each path the known time of event ``k``, if the path reaches it."""
        instant = SAME_INSTANT * self.horizon
        pairs = [
            (each.ahead[k : k + 1], path) for each, path in zip(trajectories, paths, strict=True)
        ]
        return [np.minimum(time, path.end)[time <= path.end + instant] for time, path in pairs]

    def _next(self, crossings: Sequence[Array]) -> float:
        """The time of the first event that interrupts, infinite if none does."""
        pairs = zip(self.events, crossings, strict=True)
        return min((x for event, xs in pairs if event.interrupts for x in xs), default=math.inf)

    def _fired(self, crossings: Sequence[Array], time: float) -> list[int]:
        """The events at a time."""
        first, last = (time + sign * SAME_INSTANT * self.horizon for sign in (-1.0, 1.0))
        return [k for k, xs in enumerate(crossings) if any(first <= x <= last for x in xs)]

    def _at_once(self, path: Path) -> bool:
        return bool(path.end - path.breaks[0] <= SAME_INSTANT * self.horizon)

    def _record(
        self,
        trajectories: Sequence[EventTrajectory],
        paths: Sequence[Path],
        crossed: Sequence[Sequence[Array]],
        next_times: Array,
    ) -> None:
        """Record the events on paths that change nothing, before those at the next times."""
        ends = next_times - SAME_INSTANT * self.horizon
        passed = [
            sorted((x, k) for k, xs in enumerate(crossings) for x in xs.tolist() if x < end)
            for crossings, end in zip(crossed, ends, strict=True)
        ]
        most = max(map(len, passed))
        if not most:
            return
        charge(3 * CALL * sum(map(len, passed)))  # each event is kept
        times = np.stack([np.full(most, path.breaks[0]) for path in paths])
        for row, each in zip(times, passed, strict=True):
            row[: len(each)] = [time for time, _ in each]
        states = np.moveaxis(Paths.of(paths)(times), 0, 2)
        for trajectory, each, of_each in zip(trajectories, passed, states, strict=True):
            for (time, k), state in zip(each, of_each, strict=False):
                trajectory.happen(k, time, state, state)
