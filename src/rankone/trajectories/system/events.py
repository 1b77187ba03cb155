"""Events: roots along trajectories that reset or end them, and the order in which they come."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.support.wording import quote

RISING, FALLING, BOTH = 1, -1, 0

# Maps times (N,), states (n, N) and parameters (d, N) to numbers (N,), or to states (n, N)
OfTrajectory: TypeAlias = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True)
class Row:
    """One row of a generated function."""

    function: OfTrajectory
    row: int

    def __call__(self, times: Array, states: Array, parameters: Array) -> Array:
        return np.asarray(self.function(times, states, parameters)[self.row])


CROSSINGS = 2
"""Crossings of a marker in a period of an oscillator: rising and falling."""


@dataclass(frozen=True)
class Marker:
    """A state that crosses a level, in both directions, where stretches end."""

    state: int
    level: float


@dataclass(frozen=True)
class SystemEvent:
    """A root of ``when``, rising (1), falling (-1) or both (0).

    ``then`` maps the states before it to those after it; it ends the trajectory if ``terminal``.
    ``at`` maps parameters (d, N) to its times (N,) where they are known; then it happens once,
    unless that is before the start. Where they are affine, ``coefficients`` are the constant and
    the slope of each parameter. With a ``delay`` the states are reset that much later, unless
    ``when`` turns back and the event is not ``persistent``; a further root before that is an error
    unless they may be ``overlapping``. Of several at one instant the one of the highest
    ``priority`` is first. It is ``timed`` if it is no event of the user; rates switch
    at a ``switch``, which resets sides of surfaces alone; it ``starts`` or ``cancels`` the event at
    that position, whose times trajectories tell one by one. It may be that of a ``marker``.
    """

    when: OfTrajectory
    direction: int = BOTH
    then: OfTrajectory | None = None
    terminal: bool = False
    name: str = ""
    at: Callable[[Array], Array] | None = None
    timed: bool = False
    switch: bool = False
    delay: OfTrajectory | None = None
    priority: OfTrajectory | None = None
    persistent: bool = True
    overlapping: bool = True
    starts: int | None = None
    cancels: int | None = None
    coefficients: tuple[float, ...] | None = None
    marker: Marker | None = None

    @property
    def interrupts(self) -> bool:
        """Whether the trajectory does not go on as if nothing had been."""
        acts_later = self.starts is not None or self.cancels is not None
        return self.terminal or self.switch or self.then is not None or acts_later

    @property
    def jumps(self) -> bool:
        """Whether values of the solution jump there, or end."""
        return self.terminal or (self.then is not None and not self.switch)


def overlap(name: str, place: str) -> ProblemError:
    """The error for an event that is set off again before its delay is over."""
    return ProblemError(
        f"event {quote(name)} is set off again at {place}, while an earlier one is still to come: "
        "its new values, taken when it is set off, would be overwritten",
        term=name,
        remedy="let its delay be shorter than the time between two of them, or take its values "
        'after the delay (useValuesFromTriggerTime="false" in SBML)',
    )


OfPoints: TypeAlias = Callable[[Array], Array]
"""Maps points (m, d) to numbers (m,)."""


@dataclass(frozen=True)
class Foreseen:
    """About the ``times`` (m, marks) of marks, and ``margins`` (marks,) by which they may be later.

    They may be off by as much as was ``missed`` where they are known.
    """

    times: Array
    margins: Array
    missed: float


OfMarks: TypeAlias = Callable[[Array, int], Foreseen]
"""Maps points (m, d) and a count of marks to what is foreseen of these."""


@dataclass(frozen=True)
class Guard:
    """What ``when`` of an event is at an instant, which tells how trajectories go on there.

    The instant -1 is the start. The states are those after so many of the events at the instant
    are ``applied``, with a ``side`` of its own for the switch that the event sets, if told.
    """

    instant: int
    applied: int
    event: int
    side: float | None = None


@dataclass(frozen=True)
class Clearance:
    """``sign`` times what ``when`` of an event is, which falls through zero where the event comes.

    It is a function of the parameters and of the time along each stretch.
    """

    event: int
    sign: float


@dataclass(frozen=True, eq=False)
class Turn:
    """Where trajectories turn next to the surface of an event, past it or before they reach it.

    The height at the turn is ``sign`` times what ``when`` of the event is, and largest there; below
    zero the event is missed. It is on a ``stretch``, after an elapsed time that ``times`` predicts,
    (m, 1) at the first ``columns`` of points (m, d), to about ``margin``. ``surface`` has the
    events with the same surface, on sides of switches, and the factors of their ``when`` over that
    of the event. Heights are relative to the rise to the turn from the start of the stretch or,
    where that is on the surface, from the ``lowest`` place between.
    """

    stretch: int
    event: int
    sign: float
    surface: tuple[tuple[int, tuple[int, ...], float], ...]
    times: OfPoints
    margin: float
    columns: int
    lowest: bool = False


@dataclass(frozen=True)
class Beginning:
    """Where a stretch begins that is none where ``when`` of its event is not above zero there.

    So a mass sticks only where friction is larger than the force at a turning point. That is a
    ``guard`` of the branch that goes on in another way. Along the stretch the surface comes back
    from where it is moved to, at a rate of ``fading`` times by how much.
    """

    stretch: int
    event: int
    guard: Guard
    fading: float = 0.0


@dataclass(frozen=True)
class ForcedOrder:
    """An order that trajectories follow wherever it holds or not.

    ``met`` are the events at each instant in the order in which they happen: the first one ends the
    stretch. Stretches may then be of negative length. ``lengths`` predicts those up to the last
    instant, (m, instants) at points (m, d), to about ``margins`` (instants,). The ``guards`` are
    functions of the parameters besides, at instants or turns, and the ``clearances`` of parameters
    and time.

    Events that are met just before a turn, and missed where its height is below zero, are
    ``opened``: a coordinate behind the parameters is the root of the height over the rise to
    the turn, and the surface is moved until that is so. Where it is the root of the
    true one, nothing is moved. Stretches may be opened at their beginning as well: what ``when`` of
    the event is there is the square of the coordinate then.
    """

    met: tuple[tuple[int, ...], ...]
    lengths: OfPoints
    margins: tuple[float, ...]
    guards: tuple[Guard | Turn, ...] = ()
    clearances: tuple[Clearance, ...] = ()
    opened: tuple[Turn | Beginning, ...] = ()


class Ending(StrEnum):
    """What ends the last stretch of all trajectories."""

    EVENT = "event"
    """The last event, which may come after the horizon."""
    HORIZON = "horizon"
    """The end of the horizon: all trajectories meet as many events before it."""
    LENGTH = "length"
    """The same time after the last event, which may come after the horizon."""


@dataclass(frozen=True)
class EventOrder:
    """The events of all trajectories of a box, in their order.

    ``instants`` are the positions of the events at each instant, several where they coincide. A
    stretch lies before each of them, and one more behind the last unless the ``ending`` is an
    event; ``length`` is its own where it is the same for all trajectories. ``sides`` are those of
    held switches, for each stretch.
    """

    instants: tuple[tuple[int, ...], ...]
    ending: Ending
    length: float = 0.0
    sides: tuple[tuple[int, ...], ...] = ()

    @property
    def stretches(self) -> int:
        """Number of stretches."""
        return len(self.instants) + (self.ending is not Ending.EVENT)
