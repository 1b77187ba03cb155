"""A trajectory with its events, and what events do at an instant."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import COARSE, COINCIDENT, MINOR, MOST_ROUNDS, RESOLVED, ROUNDING, Array
from rankone.support.budget import charge
from rankone.support.costs import CALL
from rankone.support.errors import ProblemError, quote
from rankone.trajectories.integrators.integrator import NODES, Path, joined
from rankone.trajectories.system.features import BOTH, CROSSINGS, SystemEvent, overlap


@dataclass(frozen=True)
class _Stretches:
    """How far trajectories are integrated after a reset, and when events accumulate."""

    least: float
    shrinking: int
    rest: float
    longer: float


_STRETCHES = _Stretches(
    least=COARSE,  # Length of what is integrated after a reset at least, in horizons
    # Shorter and shorter times until the same events, after which they may accumulate
    shrinking=10,
    rest=RESOLVED,  # Time within which all further ones would come if these shrink on, in horizons
    longer=1.2,  # Length of what is integrated after a reset, over the time it took before
)


def accumulate(shorter: int, cycle: float, before: float, horizon: float) -> bool:
    """Whether events come ever faster, so that all further ones are as good as at one instant.

    The time until the same events came again was a ``cycle``, and the one ``before`` it; so many in
    a row were ``shorter`` than the one before.
    """
    if not shorter or shorter < _STRETCHES.shrinking:
        return False
    return cycle / (1.0 - cycle / before) <= _STRETCHES.rest * horizon


@dataclass(frozen=True, eq=False)
class Occurrence:
    """An event of a trajectory: which one, when, and the states (n,) before and after it.

    It is that of one trajectory, and of the copies of it.
    """

    event: int
    time: float
    before: Array
    after: Array


@dataclass
class EventTrajectory:
    """A trajectory from event to event.

    It ``ends`` early at a terminal event, or where it cannot go on; it is ``stuck`` where events
    accumulate, after so many ``rounds`` of them at one instant, or ``shorter`` and shorter times in
    a row until the same ones come again. It was ``interrupted`` last at a time by the events
    ``met``, and goes on for a ``stretch`` at once; ``gaps`` are the times from such events to the
    next ones, ``returns`` when they came last and how long after the time before. Where its
    ``period`` is not 0 it goes on after its paths as over their last period, up to its last event.
    ``ahead`` (events,) are known times that it has not reached, infinite for other events; ``due``
    are the times at which events with a delay reset states.
    """

    paths: list[Path]
    interrupted: float
    ahead: Array
    due: dict[int, list[float]] = field(default_factory=dict)
    stretch: float = math.inf
    met: tuple[int, ...] = ()
    gaps: dict[tuple[int, ...], float] = field(default_factory=dict)
    returns: dict[tuple[int, ...], tuple[float, float]] = field(default_factory=dict)
    occurrences: list[Occurrence] = field(default_factory=list)
    ends: bool = False
    stuck: bool = False
    rounds: int = 0
    shorter: int = 0
    landed: Mapping[int, float] = field(default_factory=dict)
    period: float = 0.0

    @property
    def end(self) -> float:
        return self.occurrences[-1].time if self.period else self.paths[-1].end

    @property
    def state(self) -> Array:
        """The last state (n,), after a reset there."""
        at_end = self.occurrences and self.occurrences[-1].time == self.end
        return self.occurrences[-1].after if at_end else self.paths[-1].state

    @property
    def sizes(self) -> Array:
        """The largest absolute values of states (n,) on the last step to where it is."""
        last = next((path.nodal[-1] for path in reversed(self.paths) if path.steps), self.state)
        largest = np.abs(last).reshape(-1, self.state.size).max(axis=0)
        return np.asarray(np.maximum(largest, np.abs(self.state)))

    @property
    def steps(self) -> int:
        return sum(path.steps for path in self.paths)

    def next_end(self, edge: float, count: int = 0) -> float:
        """The end of what is integrated next, on the way to an edge: no known time is within.

        It is about where a trajectory that nothing has interrupted passes so many events.
        """
        edge, stretch = min(edge, self.ahead.min(initial=math.inf)), self.stretch
        passed = self.end - float(self.paths[0].breaks[0])
        if stretch == math.inf and self.occurrences and passed > 0.0:  # marks alone so far
            stretch = self._until_passed(max(count - len(self.occurrences), 1))
        far = edge - self.end > _STRETCHES.longer * stretch
        return self.end + stretch if far else edge

    def _until_passed(self, count: int) -> float:
        """About how long it takes to pass so many further marks."""
        ahead = self.marks_ahead(count + 1)
        if ahead is None:
            gap = (self.end - float(self.paths[0].breaks[0])) / len(self.occurrences)
            return gap * (count + MINOR)
        until = float(ahead[-2] + MINOR * (ahead[-1] - ahead[-2])) - self.end
        period = self.occurrences[-1].time - self.occurrences[-1 - self._marks_per_period].time
        return max(until, MINOR * period)

    def marks_ahead(self, count: int) -> Array | None:
        """About when it passes so many further marks, as over the last period; None without one."""
        per_period = self._marks_per_period
        marks = np.array([each.time for each in self.occurrences[-1 - per_period :]])
        if marks.size <= per_period:
            return None
        period, further = float(marks[-1] - marks[0]), np.arange(count)
        rounds = further // per_period + 1
        return np.asarray(marks[1:][further % per_period] + rounds * period)

    @property
    def _marks_per_period(self) -> int:
        return CROSSINGS * len({each.event for each in self.occurrences})

    def fired(self, instant: float) -> dict[int, int]:
        """The events where it is now, and how often each came within an ``instant`` before."""
        now = self.end
        last = takewhile(lambda each: now - each.time <= instant, reversed(self.occurrences))
        here = [(each.event, each.time) for each in last]
        often = Counter(event for event, _ in here)
        return {event: often[event] for event, time in here if time == now}

    def copy(self) -> EventTrajectory:
        """One that may go on by itself."""
        own = replace(self, paths=[*self.paths], occurrences=[*self.occurrences])
        own.gaps, own.ahead = {**self.gaps}, self.ahead.copy()
        own.returns = {**self.returns}
        own.due = {event: [*times] for event, times in self.due.items()}
        return own

    def happen(self, event: int, time: float, before: Array, after: Array) -> None:
        """Keep an event at a time."""
        self.occurrences.append(Occurrence(event, time, before, after))
        if times := self.due.get(event):
            self.put_off(event, times[1:])
        else:
            self.ahead[event] = math.inf

    def put_off(self, event: int, times: list[float]) -> None:
        """Let an event with a delay be due at times, and at no others."""
        self.due[event] = sorted(times)
        self.ahead[event] = min(times, default=math.inf)

    def reach(self, path: Path, returned: bool) -> None:
        """Follow a path up to an event, and whether it was there at once."""
        if path.steps:
            self.paths.append(path)
        self.rounds = self.rounds if returned else 0

    def leave(self, time: float, met: tuple[int, ...], horizon: float) -> None:
        """Go on after events: as long as after the same ones before, or as after the last ones.

        Times after which the same events come again, and which shrink like those of a ball that
        comes to rest, end it a little before it would pass through the surface by rounding.
        """
        gap, self.interrupted = time - self.interrupted, time
        self.gaps[self.met], self.met = gap, met
        self.stretch = max(_STRETCHES.longer * self.gaps.get(met, gap), _STRETCHES.least * horizon)
        last, before = self.returns.get(met, (-math.inf, 0.0))
        cycle = time - last
        self.returns[met] = time, cycle
        self.shorter = self.shorter + 1 if cycle < before else 0
        self.stuck |= accumulate(self.shorter, cycle, before, horizon)

    def times_of(self, event: int) -> Array:
        """The times of an event, in order."""
        return np.array([each.time for each in self.occurrences if each.event == event])

    def __call__(self, times: Array) -> Array:
        """States (n, T), after an event at its time; NaN after the end."""
        path = joined(self.paths)
        states = path(folded(times, path.end, self.period))
        states[:, times > self.end] = np.nan
        states[:, times == self.end] = self.state[:, None]
        return states


def folded(times: Array, ends: float | Array, periods: float | Array) -> Array:
    """Times, those after the end on the last period before it, where that is not 0."""
    later = (np.asarray(periods) > 0.0) & (times > ends)
    rounds = np.ceil((times - ends) / np.where(later, periods, 1.0))
    return np.where(later, times - rounds * periods, times)


# -----------------------------------------------------------------------------
# What events do to trajectories at one instant, and what crosses zero there.


LOOK_COST = 10.0
"""Operations of an event function for each number that it reads."""
_CHANGES = 3  # Random changes by as much, which tell what becomes of them


def heights_of(event: SystemEvent, times: Array, states: Array, parameters: Array) -> Array:
    """What crosses zero at an event, (N,), at times (N,), states (n, N) and parameters (d, N)."""
    charge(CALL + LOOK_COST * states.size)
    with np.errstate(all="ignore"):
        heights = np.asarray(event.when(times, states, parameters), dtype=float)
    return np.broadcast_to(heights, times.shape).copy()


def roundings_of(
    event: SystemEvent,
    times: Array,
    states: Array,
    parameters: Array,
    sizes: Array,
    heights: Array,
) -> Array:
    """By how much heights (N,) change if what they are made of is rounded.

    States are rounded relative to their ``sizes`` (n, N) nearby: next to zero they are no more
    accurate than where they came from. Whatever is on a surface to within that is on it.
    """
    random, largest = np.random.default_rng(3061), np.zeros(times.size)
    for _ in range(_CHANGES):
        factors = [random.uniform(0.5, 1.0, k) for k in (1, len(sizes), len(parameters))]
        time, state, parameter = (
            (ROUNDING * factor * random.choice([-1.0, 1.0], factor.size))[:, None]
            for factor in factors
        )
        changed = heights_of(
            event, times * (1.0 + time[0]), states + state * sizes, parameters * (1.0 + parameter)
        )
        with np.errstate(all="ignore"):
            largest = np.fmax(largest, np.abs(changed - heights))
    return largest


def sides_of_surface(
    event: SystemEvent, times: Array, states: Array, parameters: Array, sizes: Array
) -> Array:
    """The sides of its surface that states are on, (N,): 0 on it, NaN where it is no number."""
    heights = heights_of(event, times, states, parameters)
    roundings = roundings_of(event, times, states, parameters, sizes, heights)
    return np.where(np.abs(heights) <= roundings, 0.0, np.sign(heights))


# -----------------------------------------------------------------------------
# What events do to trajectories at one instant: resets, what these trigger, and ends.


SAME_INSTANT = COINCIDENT
"""Part of the horizon within which times along a trajectory are the same."""


@dataclass(frozen=True)
class Instants:
    """Applies events to trajectories that meet them, all at one instant, round after round."""

    events: tuple[SystemEvent, ...]
    horizon: float

    def apply(
        self,
        trajectories: Sequence[EventTrajectory],
        fired: list[list[int]],
        times: Array,
        states: Array,
        points: Array,
    ) -> None:
        """Apply the events that each trajectory has met at its time, and what they trigger.

        Times are (m,), states (n, m) and points (d, m).
        """
        active, before, last = np.arange(len(trajectories)), states, states.copy()
        all_happened: list[list[int]] = [[] for _ in fired]
        sizes = _sizes(trajectories, states)
        sides = self._sides(times, states, points, sizes)
        for k, place in np.argwhere(sides == 0.0).tolist():
            if k not in fired[place]:
                sides[k, place] = self._came_from(k, trajectories[place], points[:, place])
        landed = np.zeros(sides.shape, dtype=bool)
        while active.size:
            now, at = times[active], points[:, active]
            after, happened = self._reset(fired, now, before, at, sizes[:, active])
            last[:, active] = after
            self._put_off(trajectories, active, happened, now, before, at)
            for place, each, *pair in zip(
                active.tolist(), happened, before.T, after.T, strict=True
            ):
                trajectory = trajectories[place]
                here = trajectory.end
                for k in each:
                    trajectory.happen(k, here, *pair)
                trajectory.rounds += 1
            sizes[:, active] = np.maximum(sizes[:, active], np.abs(after))
            came, on = sides[:, active], self._sides(now, after, at, sizes[:, active])
            for column, each in enumerate(fired):
                came[each, column] = 0.0
            landed[:, active] = on == 0.0
            sides[:, active] = np.where(on == 0.0, came, on)
            triggered = self._triggered(came, on)
            for place, time, each in zip(active.tolist(), now, triggered, strict=True):
                each += self.due(trajectories[place], time)
            goes_on = np.array(
                [
                    bool(further)
                    and not any(self.events[k].terminal for k in each)
                    and trajectories[place].rounds < MOST_ROUNDS
                    for place, each, further in zip(
                        active.tolist(), happened, triggered, strict=True
                    )
                ]
            )
            fired = [each for each, on in zip(triggered, goes_on, strict=True) if on]
            for place, each in zip(active.tolist(), happened, strict=True):
                all_happened[place] += each
            active, before = active[goes_on], after[:, goes_on]
        pairs = zip(trajectories, times.tolist(), last.T, all_happened, strict=True)
        for place, (trajectory, time, state, each) in enumerate(pairs):
            trajectory.stuck = trajectory.rounds >= MOST_ROUNDS
            trajectory.landed = _landed(landed[:, place], sides[:, place])
            trajectory.leave(time, tuple(each), self.horizon)
            terminal = any(self.events[k].terminal for k in each)
            trajectory.ends = terminal or trajectory.stuck or not np.isfinite(state).all()

    def _came_from(self, k: int, trajectory: EventTrajectory, point: Array) -> float:
        """The side of the surface of event ``k`` from which a trajectory came to it, 0 for none.

        It met the event already, unless it was beside the surface since.
        """
        path = trajectory.paths[-1]
        if not path.steps:
            return trajectory.landed.get(k, 0.0)
        times = path.breaks[-2] + (path.breaks[-1] - path.breaks[-2]) * NODES
        states = path.nodal[-1].T
        sizes = np.broadcast_to(np.abs(states).max(axis=1, keepdims=True), states.shape)
        columns = np.broadcast_to(point[:, None], (point.size, times.size))
        sides = sides_of_surface(self.events[k], times, states, columns, sizes)
        beside = np.flatnonzero(np.abs(sides) > 0.0)
        if not beside.size:
            return trajectory.landed.get(k, 0.0)
        last = float(times[beside[-1]])
        met = any(each.event == k and each.time >= last for each in trajectory.occurrences)
        return 0.0 if met else float(sides[beside[-1]])

    def land(
        self, trajectories: Sequence[EventTrajectory], times: Array, states: Array, points: Array
    ) -> None:
        """Note on which surfaces trajectories begin, or jump to, at times (m,); from no side."""
        sides = self._sides(times, states, points, _sizes(trajectories, states))
        for trajectory, each in zip(trajectories, sides.T, strict=True):
            trajectory.landed = _landed(each == 0.0, each)

    def due(self, trajectory: EventTrajectory, time: float) -> list[int]:
        """The events of a trajectory at known times that are not later than a time."""
        return np.flatnonzero(trajectory.ahead <= time + SAME_INSTANT * self.horizon).tolist()

    def _reset(
        self,
        fired: Sequence[Sequence[int]],
        times: Array,
        states: Array,
        points: Array,
        sizes: Array,
    ) -> tuple[Array, list[list[int]]]:
        """The states (n, m) after events at times (m,), and the events in their order.

        That is the order of their priorities, taken anew after each of them, and then of the list.
        An event that does not persist is left out once another one has turned it back.
        """
        states = states.copy()
        happened: list[list[int]] = [[] for _ in fired]
        waiting = np.array([[k in each for each in fired] for k in range(len(self.events))])
        for k, event in enumerate(self.events):
            if event.cancels is not None:
                waiting[event.cancels] &= ~waiting[k]
        turned = self._turned(waiting, times, states, points, sizes)
        while waiting.any():
            waiting &= turned | ~self._turned(waiting, times, states, points, sizes)
            priorities = np.where(
                waiting, self._priorities(waiting, times, states, points), -math.inf
            )
            chosen = np.where(waiting.any(axis=0), priorities.argmax(axis=0), -1)
            for k in np.unique(chosen[chosen >= 0]).tolist():
                met, then = chosen == k, self.events[k].then
                waiting[k, met] = False
                for place in np.flatnonzero(met).tolist():
                    happened[place].append(k)
                if then is not None:
                    after = then(times[met], states[:, met], points[:, met])
                    states[:, met] = np.asarray(after, dtype=float).reshape(len(states), -1)
        return states, happened

    def _turned(
        self, waiting: NDArray[np.bool_], times: Array, states: Array, points: Array, sizes: Array
    ) -> NDArray[np.bool_]:
        """Which events (events, m) do not persist, and are on the side that they came from."""
        turned = np.zeros(waiting.shape, dtype=bool)
        for k, event in enumerate(self.events):
            if not event.persistent and waiting[k].any():
                side = sides_of_surface(event, times, states, points, sizes)
                turned[k] = event.direction * side < 0.0
        return turned

    def _priorities(
        self, waiting: NDArray[np.bool_], times: Array, states: Array, points: Array
    ) -> Array:
        """The priorities of events (events, m), 0 for those that have none."""
        priorities = np.zeros(waiting.shape)
        for k, event in enumerate(self.events):
            if event.priority is not None and waiting[k].any():
                priorities[k] = event.priority(times, states, points)
        return priorities

    def _put_off(
        self,
        trajectories: Sequence[EventTrajectory],
        active: NDArray[np.intp],
        happened: Sequence[Sequence[int]],
        times: Array,
        states: Array,
        points: Array,
    ) -> None:
        """Put off what events start after a delay, and give up what they cancel."""
        for k, event in enumerate(self.events):
            met = np.array([k in each for each in happened])
            if not met.any():
                continue
            some = [trajectories[place] for place in active[met].tolist()]
            if event.cancels is not None:
                for trajectory in some:
                    trajectory.put_off(event.cancels, [])
            if event.starts is None or event.delay is None:
                continue
            delays = event.delay(times[met], states[:, met], points[:, met])
            delays = np.broadcast_to(np.asarray(delays, dtype=float), times[met].shape)
            if not (delays >= 0.0).all():
                worst = int(np.flatnonzero(~(delays >= 0.0))[0])
                raise ProblemError(
                    f"the delay of event {quote(self.events[event.starts].name)} is "
                    f"{delays[worst]:.6g} at t = {times[met][worst]:.6g}",
                    remedy="let it be a time that is not negative, everywhere in the box",
                )
            for trajectory, due in zip(some, (times[met] + delays).tolist(), strict=True):
                planned = trajectory.due.get(event.starts, [])
                if planned and not event.overlapping:
                    raise overlap(self.events[event.starts].name, f"t = {trajectory.end:.6g}")
                trajectory.put_off(event.starts, [*planned, due])

    def _sides(self, times: Array, states: Array, points: Array, sizes: Array) -> Array:
        """The sides of their surfaces that states (n, m) are on, (events, m), 0 if on them.

        NaN for events at known times, whatever the states.
        """
        sides = np.full((len(self.events), times.size), np.nan)
        for k, event in enumerate(self.events):
            if event.at is None:
                sides[k] = sides_of_surface(event, times, states, points, sizes)
        return sides

    def _triggered(self, before: Array, after: Array) -> list[list[int]]:
        """The events whose surface a reset jumps across, from some sides (events, m) to others."""
        directions = np.array([[event.direction] for event in self.events])
        crossed = (before * after < 0.0) & ((directions == BOTH) | (after == directions))
        return [np.flatnonzero(each).tolist() for each in crossed.T]


def _sizes(trajectories: Sequence[EventTrajectory], states: Array) -> Array:
    """The sizes of states (n, m) that trajectories are put to, and of those before."""
    before = np.stack([each.sizes for each in trajectories], axis=1)
    return np.asarray(np.maximum(before, np.abs(states)))


def _landed(on: NDArray[np.bool_], sides: Array) -> dict[int, float]:
    """The events on whose surface a trajectory is, of all (events,), and where it came from."""
    return {k: float(sides[k]) for k in np.flatnonzero(on).tolist()}
