"""A trajectory with events: what it has met, and what it still has ahead."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import takewhile

import numpy as np

from rankone.support.arrays import Array
from rankone.trajectories.integrators.integrator import Path, joined
from rankone.trajectories.system.events import CROSSINGS

_MARGIN = 0.1  # Of gaps between events, beyond the last one that is asked for
_LEAST_STRETCH = 1e-3  # Length of what is integrated after a reset at least, in horizons
_SHRINKING = 10  # Shorter and shorter times until the same events, after which they may accumulate
_REST = 1e-7  # Time within which all further ones would come if these shrink on, in horizons
_STRETCH = 1.2  # Length of what is integrated after a reset, over the time it took before


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
        far = edge - self.end > _STRETCH * stretch
        return self.end + stretch if far else edge

    def _until_passed(self, count: int) -> float:
        """About how long it takes to pass so many further marks."""
        ahead = self.marks_ahead(count + 1)
        if ahead is None:
            gap = (self.end - float(self.paths[0].breaks[0])) / len(self.occurrences)
            return gap * (count + _MARGIN)
        until = float(ahead[-2] + _MARGIN * (ahead[-1] - ahead[-2])) - self.end
        period = self.occurrences[-1].time - self.occurrences[-1 - self._marks_per_period].time
        return max(until, _MARGIN * period)

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
        self.stretch = max(_STRETCH * self.gaps.get(met, gap), _LEAST_STRETCH * horizon)
        last, before = self.returns.get(met, (-math.inf, 0.0))
        cycle = time - last
        self.returns[met] = time, cycle
        self.shorter = self.shorter + 1 if cycle < before else 0
        left = cycle / (1.0 - cycle / before) if self.shorter else math.inf
        self.stuck |= self.shorter >= _SHRINKING and left <= _REST * horizon

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
