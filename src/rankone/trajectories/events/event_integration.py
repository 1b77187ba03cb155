"""Events: roots of functions along trajectories, which end them or reset their states.

Trajectories are integrated from reset to reset, so that no step straddles one; events that change
nothing are recorded along the way. After a reset each trajectory has a start of its own, and goes
on for about as long as it took from the same events to the next ones before, and then for longer.
A stack integrates over the share of such a stretch, in which all trajectories begin and end
together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, Reached, charge, hold
from rankone.trajectories.events.event_crossings import Crossings
from rankone.trajectories.events.event_trajectory import SAME_INSTANT, EventTrajectory, Instants
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

_EVENT_COST = 1.5e5  # Operations of following a path to an event or its end
_OCCURRENCE_COST = 3e3  # Operations of keeping an event that changes nothing
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
        charge(_EVENT_COST * len(paths))
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
        charge(_OCCURRENCE_COST * sum(map(len, passed)))
        times = np.stack([np.full(most, path.breaks[0]) for path in paths])
        for row, each in zip(times, passed, strict=True):
            row[: len(each)] = [time for time, _ in each]
        states = np.moveaxis(Paths.of(paths)(times), 0, 2)
        for trajectory, each, of_each in zip(trajectories, passed, states, strict=True):
            for (time, k), state in zip(each, of_each, strict=False):
                trajectory.happen(k, time, state, state)
