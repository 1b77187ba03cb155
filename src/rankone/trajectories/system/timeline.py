"""The timeline of a solution with events: what ends each stretch, and where clock time is."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from rankone.support.errors import count
from rankone.trajectories.system.features import Ending, SystemEvent
from rankone.trajectories.system.system import Clock

_LONGEST_TURN, _FEWEST_TIMES = 8, 5  # Events that come in turn, and how often, to be one line
CLOCK_STATES = 2
"""States of slabs over stretches behind those of the problem: the clock, and the length."""


@dataclass(frozen=True)
class Timeline:
    """The events that end the stretches of all trajectories, in their order.

    ``events`` are the names of all events, and ``instants`` those of the events at each instant;
    ``resets`` says which of them reset states, and ``terminal`` whether the last one ends the
    trajectories. ``horizon`` is that of the clock. Behind the states of the slabs are the clock and
    the length of the stretch.

    ``affine_times`` has the borders of stretches whose times are affine in the parameters, with the
    constant and the slopes: the clock of the slabs has these times only to its tolerance.
    """

    events: tuple[str, ...]

    instants: tuple[tuple[str, ...], ...]
    resets: tuple[bool, ...]
    ending: Ending
    terminal: bool
    horizon: tuple[float, float]
    affine_times: tuple[tuple[int, tuple[float, ...]], ...] = ()

    @classmethod
    def of(cls, clock: Clock) -> Timeline:
        """The timeline of a solve."""
        events, instants = clock.system.events, clock.order.instants
        return cls(
            tuple(event.name for event in events if not event.timed),
            tuple(tuple(events[k].name for k in instant) for instant in instants),
            tuple(any(_resets(events[k]) for k in instant) for instant in instants),
            clock.order.ending,
            bool(instants) and any(events[k].terminal for k in instants[-1]),
            clock.horizon,
            tuple(
                (border, coefficients)
                for border, instant in enumerate(instants, 1)
                if (coefficients := _coefficients(events[k] for k in instant)) is not None
            ),
        )

    def __str__(self) -> str:
        """What ends each stretch, in words."""
        names = [" and ".join(instant) for instant in self.instants]
        last = {
            Ending.EVENT: "may come after the end" if not self.terminal else "ends it",
            Ending.HORIZON: "the end of the horizon",
            Ending.LENGTH: "the end of the horizon, or later",
        }[self.ending]
        if self.ending is Ending.EVENT:
            names[-1] += f" ({last})"
        else:
            names.append(last)
        start, end = self.horizon
        stretches = count(self.stretches, "stretch", "stretches")
        verb = "ends" if self.stretches == 1 else "end"
        lines = [f"{stretches} over [{start:g}, {end:g}], which {verb} with"]
        return "\n".join([*lines, *(f"  {name}" for name in _in_turns(names))])

    def fixed(self, parameter: int, value: float) -> Timeline:
        """The timeline where the parameter at a position is no longer a coordinate."""
        times = []
        for border, (constant, *slopes) in self.affine_times:
            if slopes:
                constant += slopes.pop(parameter) * value
            times.append((border, (constant, *slopes)))
        return replace(self, affine_times=tuple(times))

    @property
    def met(self) -> tuple[tuple[str, ...], ...]:
        """The instants that some trajectory meets before the end of the horizon."""
        beyond = self.ending is Ending.EVENT and not self.terminal
        return self.instants[:-1] if beyond else self.instants

    @property
    def moving_resets(self) -> tuple[str, ...]:
        """The events that reset states at times that are not known to be the same everywhere."""
        fixed = {border for border, (_, *slopes) in self.affine_times if not any(slopes)}
        moving = (
            name
            for border, (instant, resets) in enumerate(zip(self.met, self.resets, strict=False), 1)
            if resets and border not in fixed
            for name in instant
        )
        return tuple(dict.fromkeys(moving))

    def up_to(self, count: int) -> Timeline:
        """The timeline of trajectories that meet at most so many of the instants before the end."""
        if count >= len(self.met):
            return self
        kept = self.instants[: count + 1], self.resets[: count + 1]
        return replace(self, instants=kept[0], resets=kept[1], ending=Ending.EVENT, terminal=False)

    @property
    def affine_borders(self) -> dict[int, tuple[float, ...]]:
        """The constant and slopes of borders at affine times and at the ends of the horizon."""
        start, end = self.horizon
        ends = {self.stretches: (end,)} if self.ending is Ending.HORIZON else {}
        return {0: (start,), **dict(self.affine_times), **ends}

    @property
    def stretches(self) -> int:
        """Number of stretches."""
        return len(self.instants) + (self.ending is not Ending.EVENT)


@dataclass(frozen=True)
class Fork:
    """Two branches that are the same up to the beginning of a stretch, and then part.

    The ``first`` one holds if its stretch ends before that of the ``second``, or, where both end
    at once, if ``sign`` times a ``guard`` is positive: a row of the first one behind the states.
    The guard is relative to its ``scale``. One ``at_turn`` is the height at a turn over the rise to
    it, and decides nothing below the scale. The events that end the stretch ``may_be_past`` at its
    beginning: then they do not come.
    """

    first: int
    second: int
    stretch: int
    guard: int | None = None
    sign: float = 1.0
    scale: float = 1.0
    may_be_past: tuple[bool, bool] = (False, False)
    at_turn: bool = False


@dataclass(frozen=True)
class Grazing:
    """An event that a branch does not meet on a stretch, but for a sliver of where it holds.

    There a row of the branch behind its states, a ``guard``, falls through zero somewhere along the
    stretch. It is relative to its ``scale``. The event may have been met before: it ``begins`` the
    stretch then, or ``ends`` it. Before its ``first`` time the row is above zero all along.
    """

    branch: int
    stretch: int
    guard: int
    scale: float
    begins: bool = False
    ends: bool = False
    first: bool = False


@dataclass(frozen=True)
class Opening:
    """An event that a branch meets just before a turn at which its ``parent`` misses the event.

    The height of the turn over the surface, relative to the rise to the turn, is a row of the
    parent behind its states, a ``guard``. The branch is smooth over its
    root: a coordinate behind the parameters of its slabs, from ``lower`` to ``upper``.
    """

    branch: int
    parent: int
    guard: int
    lower: float
    upper: float


@dataclass(frozen=True)
class BranchedTimeline:
    """Timelines of branches: orders of events that hold in parts of the box.

    The slabs of each branch follow those of the one before. ``guards`` counts the functions behind
    the states of each branch that tell which one holds by the ``forks``. These are known up to a
    ``width``, relative to the horizon or to their scales. Where branches differ by more than the
    ``tolerances`` of the states within it, which one holds is ``undecided``: on that share of the
    box. So it is where an order holds that cannot be continued: by the ``grazings``.
    """

    branches: tuple[Timeline, ...]
    guards: tuple[int, ...]
    forks: tuple[Fork, ...]
    width: float
    tolerances: tuple[float, ...]
    undecided: float
    grazings: tuple[Grazing, ...] = ()
    openings: tuple[Opening, ...] = ()

    @property
    def events(self) -> tuple[str, ...]:
        """The names of all events."""
        return self.branches[0].events

    @property
    def horizon(self) -> tuple[float, float]:
        """That of the clock."""
        return self.branches[0].horizon

    @property
    def terminal(self) -> bool:
        """Whether an event may end the trajectories."""
        return any(branch.terminal for branch in self.branches)

    @property
    def stretches(self) -> int:
        """Number of stretches of all branches."""
        return sum(branch.stretches for branch in self.branches)

    @property
    def met(self) -> tuple[tuple[str, ...], ...]:
        """The instants that some trajectory meets before the end of the horizon, by branches."""
        return tuple(instant for branch in self.branches for instant in branch.met)

    @property
    def moving_resets(self) -> tuple[str, ...]:
        """The events that reset states at times that are not known to be the same everywhere."""
        names = (name for branch in self.branches for name in branch.moving_resets)
        return tuple(dict.fromkeys(names))

    @property
    def highest(self) -> tuple[float, ...]:
        """For each fork the largest guard for which the second of its branches is solved."""

        def of(fork: Fork) -> float:
            roots = (
                o.upper
                for o in self.openings
                if (o.branch, o.parent, o.guard) == (fork.second, fork.first, fork.guard)
            )
            return min((upper**2 for upper in roots), default=math.inf)

        return tuple(map(of, self.forks))

    def branch_of(self, time: float) -> int:
        """The branch of a pseudo-time of the slabs of all branches."""
        ends = itertools.accumulate(branch.stretches for branch in self.branches)
        return sum(time >= end for end in ends)

    def roots_of(self, branch: int) -> tuple[tuple[float, float], ...]:
        """The intervals of the coordinates of a branch behind the parameters."""
        return tuple((o.lower, o.upper) for o in self.openings if o.branch == branch)

    def fixed(self, parameter: int, value: float) -> BranchedTimeline:
        """The timeline where the parameter at a position is no longer a coordinate."""
        branches = tuple(branch.fixed(parameter, value) for branch in self.branches)
        return replace(self, branches=branches)

    def __str__(self) -> str:
        """The branches, and what is undecided, in words."""
        lines = [f"{count(len(self.branches), 'order')} of events, each in a part of the box"]
        if self.undecided:
            lines[0] += f"; undecided in {100 * self.undecided:.2g} % of it"
        for k, branch in enumerate(self.branches):
            lines += [f"order {k}: {branch}"]
        return "\n".join(lines)


def _in_turns(names: Sequence[str]) -> Iterator[str]:
    """The names, with one line for those that come in the same turn many times."""
    place = 0
    while place < len(names):
        turns = [(_times(names[place:], length), length) for length in range(1, _LONGEST_TURN + 1)]
        times, length = max(turns, key=lambda turn: (turn[0] * turn[1], -turn[1]))
        if not times:
            times = length = 1
        line = ", then ".join(names[place : place + length])
        yield line if times == 1 else f"{line}, {times} times"
        place += times * length


def _times(names: Sequence[str], length: int) -> int:
    """How many times the first names come one after the other; 0 if not often."""
    turn, times = names[:length], 1
    while names[times * length : (times + 1) * length] == turn:
        times += 1
    return times if times >= _FEWEST_TIMES else 0


def _resets(event: SystemEvent) -> bool:
    return event.then is not None and not event.switch


def _coefficients(instant: Iterable[SystemEvent]) -> tuple[float, ...] | None:
    """Those of the first event at an instant whose time is affine."""
    return next((e.coefficients for e in instant if e.coefficients is not None), None)
