"""Events: roots of functions along trajectories, which end them or reset their states.

Trajectories are integrated from reset to reset, so that no step straddles one; events that change
nothing are recorded along the way. After a reset each trajectory has a start of its own, and goes
on for about as long as the last reset came after the one before it, and then for longer. A stack
integrates over the share of such a stretch, in which all trajectories begin and end together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, Reached, charge
from rankone.support.costs import CALL
from rankone.trajectories.defects import roots
from rankone.trajectories.integrator import Integrator, Spans, Tolerances
from rankone.trajectories.paths import NODES, Path, joined

MOST_ROUNDS = 100
"""Events of a trajectory at one instant, after which it ends."""
_INSTANT = 1e-12  # Part of the horizon within which times are the same instant
_LOOK_COST = 10.0  # Operations of an event function for each number that it reads
_STRETCH = 1.5  # Length of what is integrated after a reset, over the time since the last one
_LEAST_STRETCH = 1e-3  # The same at least, in horizons
_LONGER = 4.0  # Factor from a stretch without a reset to the next one
_RISING, _FALLING, _BOTH = 1, -1, 0

# Maps times (N,), states (n, N) and parameters (d, N) to numbers (N,), or to states (n, N)
OfTrajectory = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True)
class Event:
    """A root of ``when``, rising (1), falling (-1) or both (0).

    ``then`` maps the states before it to those after it; it ends the trajectory if ``terminal``.
    """

    when: OfTrajectory
    direction: int = _BOTH
    then: OfTrajectory | None = None
    terminal: bool = False

    @property
    def interrupts(self) -> bool:
        """Whether the trajectory does not go on as if nothing had been."""
        return self.terminal or self.then is not None


@dataclass(frozen=True)
class Occurrence:
    """An event of a trajectory: which one, when, and the states (n,) before and after it."""

    event: int
    time: float
    before: Array
    after: Array


@dataclass
class EventTrajectory:
    """A trajectory from event to event. It ``ends`` early at a terminal event, or where it cannot
    go on; it is ``stuck`` where events accumulate at one instant. It was ``interrupted`` last at a
    time, and goes on for a ``stretch`` at once.
    """

    paths: list[Path]
    interrupted: float
    stretch: float = math.inf
    occurrences: list[Occurrence] = field(default_factory=list)
    ends: bool = False
    stuck: bool = False
    rounds: int = 0

    @property
    def end(self) -> float:
        return self.paths[-1].end

    @property
    def state(self) -> Array:
        """The last state (n,), after a reset there."""
        at_end = self.occurrences and self.occurrences[-1].time == self.end
        return self.occurrences[-1].after if at_end else self.paths[-1].state

    @property
    def steps(self) -> int:
        return sum(path.steps for path in self.paths)

    def next_end(self, edge: float) -> float:
        """The end of what is integrated next, on the way to an edge."""
        far = edge - self.end > _STRETCH * self.stretch
        return self.end + self.stretch if far else edge

    def times_of(self, event: int) -> Array:
        """The times of an event, in order."""
        return np.array([each.time for each in self.occurrences if each.event == event])

    def __call__(self, times: Array) -> Array:
        """States (n, T), after an event at its time; NaN after the end."""
        path = joined(self.paths)
        states = path(times)
        states[:, times > self.end] = np.nan
        states[:, times == self.end] = self.state[:, None]
        return states


def integrate_to_events(
    integrator: Integrator,
    system: System,
    points: Array,
    edges: Sequence[float],
    tolerances: Tolerances,
    events: Sequence[Event],
) -> list[EventTrajectory]:
    """The trajectories at points (m, d), with events.

    States are reset at the edges where the system jumps, and after that by events. An
    OutOfBudgetError says which time all trajectories have reached.
    """
    states = system.initial(np.ascontiguousarray(points.T)).T
    nothing = np.zeros((0, NODES.size, states.shape[1]))
    start = np.array([edges[0]])
    trajectories = [EventTrajectory([Path(start, nothing, each)], edges[0]) for each in states]
    search = _Search(system, tuple(events), edges[-1] - edges[0], tolerances)
    for a, b in itertools.pairwise(edges):
        search.jump(trajectories, points, a)
        while running := [k for k, each in enumerate(trajectories) if _runs(each, b)]:
            some = [trajectories[k] for k in running]
            ends = np.array([each.next_end(b) for each in some])
            try:
                paths = search.paths(integrator, some, points[running], ends)
                for k, path, end in zip(running, paths, ends.tolist(), strict=True):
                    search.advance(trajectories[k], path, points[k], end)
            except OutOfBudgetError as out:
                raise type(out)(_reached(some, out.reached)) from out
    return trajectories


def _reached(trajectories: Sequence[EventTrajectory], further: Reached | None) -> Reached:
    """How far all trajectories came, and perhaps ``further`` in the paths that were cut short."""
    time = min(each.end for each in trajectories)
    steps = max(each.steps for each in trajectories)
    if further is None:
        return Reached(time, steps, None)
    return Reached(further.time, steps + further.steps, further.chattering)


def _runs(trajectory: EventTrajectory, end: float) -> bool:
    return not trajectory.ends and trajectory.end < end


@dataclass(frozen=True)
class _Search:
    """Integrates from event to event, and looks for the next ones."""

    system: System
    events: tuple[Event, ...]
    horizon: float
    tolerances: Tolerances

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

    def paths(
        self,
        integrator: Integrator,
        trajectories: Sequence[EventTrajectory],
        points: Array,
        ends: Array,
    ) -> Sequence[Path]:
        """The trajectories from where they are to their ends, or as far as they go."""
        starts = np.array([each.end for each in trajectories])
        states = np.stack([each.state for each in trajectories], axis=1)
        spans = Spans(starts, states, ends)
        return integrator.paths(self.system, points, spans, self.tolerances)

    def advance(self, trajectory: EventTrajectory, path: Path, point: Array, end: float) -> None:
        """Follow a path to the first event that interrupts it, or to its end."""
        if not path.steps:
            trajectory.ends = True
            return
        crossings = self._crossings(trajectory, path, point)
        pairs = zip(self.events, crossings, strict=True)
        time = min((x for event, xs in pairs if event.interrupts for x in xs), default=math.inf)
        first, last = (time + sign * _INSTANT * self.horizon for sign in (-1.0, 1.0))
        self._record(trajectory, path, crossings, first)
        if time == math.inf:
            trajectory.paths.append(path)
            trajectory.ends = path.end < end - _INSTANT * self.horizon
            trajectory.stretch, trajectory.rounds = _LONGER * trajectory.stretch, 0
            return
        fired = [k for k, xs in enumerate(crossings) if any(first <= x <= last for x in xs)]
        before = path(np.array([time]))[:, 0]
        cut = path.until(time, before)
        if cut.steps:
            trajectory.paths.append(cut)
        after, column = before.copy(), point[:, None]
        for k in fired:
            reset = self.events[k].then
            if reset is not None:
                now = reset(np.array([time]), before[:, None], column)
                after += np.asarray(now).reshape(-1) - before
        trajectory.occurrences += [Occurrence(k, trajectory.end, before, after) for k in fired]
        again = trajectory.rounds + 1 if self._at_once(cut) else 1
        trajectory.rounds, trajectory.stuck = again, again >= MOST_ROUNDS
        gap, trajectory.interrupted = time - trajectory.interrupted, time
        trajectory.stretch = max(_STRETCH * gap, _LEAST_STRETCH * self.horizon)
        terminal = any(self.events[k].terminal for k in fired)
        trajectory.ends = terminal or trajectory.stuck or not np.isfinite(after).all()

    def _at_once(self, path: Path) -> bool:
        return bool(path.end - path.breaks[0] <= _INSTANT * self.horizon)

    def _record(
        self, trajectory: EventTrajectory, path: Path, crossings: Sequence[Array], end: float
    ) -> None:
        """Record the events on a path that change nothing, up to an end."""
        passed = sorted((x, k) for k, xs in enumerate(crossings) for x in xs.tolist() if x < end)
        if passed:
            states = path(np.array([time for time, _ in passed])).T
            trajectory.occurrences += [
                Occurrence(k, time, state, state)
                for (time, k), state in zip(passed, states, strict=True)
            ]

    def _crossings(self, trajectory: EventTrajectory, path: Path, point: Array) -> list[Array]:
        """The times of each event on a path, in order; of those that interrupt it the first."""
        times = (path.breaks[:-1, None] + np.diff(path.breaks)[:, None] * NODES).ravel()
        states = path.nodal.reshape(times.size, -1).T
        fired = {each.event for each in trajectory.occurrences if each.time == trajectory.end}
        return [
            self._roots(event, path, point, (times, states), k in fired)
            for k, event in enumerate(self.events)
        ]

    def _roots(
        self,
        event: Event,
        path: Path,
        point: Array,
        nodes: tuple[Array, Array],
        has_fired: bool,
    ) -> Array:
        """The roots of an event on a path; the first one alone if it interrupts the trajectory.

        A trajectory that begins at the event is on its surface except for rounding. It is there
        again at once if it was reset and goes on to the same side as before.
        """
        times, states = nodes
        heights = self._heights(event, point, times, states)
        if has_fired:
            side = np.sign(heights[1])
            if event.then is not None and side and side == event.direction:
                return times[:1]
            heights[0] = heights[1]
        before, after = np.sign(heights[:-1]), np.sign(heights[1:])
        # not a number is no side
        crossed = (before != after) & (before != 0.0) & np.isfinite(before) & np.isfinite(after)
        if event.direction != _BOTH:
            crossed &= before == -event.direction
        k = np.flatnonzero(crossed)[: 1 if event.interrupts else None]
        if not k.size:
            return times[:0]
        a, width = times[k], times[k + 1] - times[k]

        def height(shares: Array) -> Array:
            place = a + width * shares
            return self._heights(event, point, place, path(place))

        return np.asarray(a + width * roots(height, heights[k], heights[k + 1]))

    def _heights(self, event: Event, point: Array, times: Array, states: Array) -> Array:
        charge(CALL + _LOOK_COST * states.size)
        parameters = np.repeat(point[:, None], times.size, axis=1)
        with np.errstate(all="ignore"):
            heights = np.asarray(event.when(times, states, parameters), dtype=float)
        return np.broadcast_to(heights, times.shape).copy()
