"""Which of several branches holds: by the forks at which they part, and by events they graze.

Exported models decide in the same way: the text of this module is part of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array

LOOKS = 65  # Times along a stretch at which a grazed event is looked for


class Decision(NamedTuple):
    """Which branch holds at N points, and by how much it is ahead of each (branches, N).

    ``clear`` is by how much it misses events that are only grazed, (N,). Points are ``undecided``
    if no branch is ahead of all others, or it meets one of these. Those ``at_turn`` of an event are
    so near that its time is not known. ``borders`` are those of the stretches of each branch, as
    solved.
    """

    chosen: NDArray[np.intp]
    ahead: Array
    clear: Array
    undecided: NDArray[np.bool_]
    at_turn: NDArray[np.bool_]
    borders: Sequence[Array]


class Decider:
    """Decides by the ``forks``, known up to a ``width`` relative to the horizon or their scales.

    The second branch of each is solved up to the ``highest`` value of its guard.
    """

    def __init__(
        self,
        forks: Sequence[DecidingFork],
        highest: Sequence[float],
        grazings: Sequence[GrazedEvent],
        width: float,
        horizon: tuple[float, float],
    ) -> None:
        self.forks, self.highest, self.grazings = forks, highest, grazings
        self.width, self.horizon = width, horizon

    def decision(self, borders: Sequence[Array], guards: Array, clearances: Array) -> Decision:
        """The branches that hold at N points.

        By the ``borders`` (stretches + 1, N) of each branch, as solved, the ``guards`` (k, N) of
        the forks that have one, and how far events that are only grazed are missed, (grazings, N).
        """
        length = self.horizon[1] - self.horizon[0]
        ahead, beyond, at_turn = self._at_forks(borders, guards)
        least = ahead.min(axis=1)
        chosen = least.argmax(axis=0)
        columns = np.arange(chosen.size)
        undecided = ~(least[chosen, columns] > -self.width) | beyond[chosen, columns]
        for k in np.unique(chosen):
            here = chosen == k
            times = borders[k][:, here]
            back = (np.diff(times, axis=0) < -self.width * length) & (times[:-1] < self.horizon[1])
            undecided[here] |= back.any(axis=0)
        clear = np.full(chosen.shape, np.inf)
        for grazing, distance in zip(self.grazings, clearances, strict=True):
            here = chosen == grazing.branch
            clear[here] = np.minimum(clear[here], distance[here] / grazing.scale)
        undecided |= ~(clear > self.width)
        margins, close = ahead[chosen, :, columns].T, at_turn[chosen, columns]
        return Decision(chosen, margins, clear, undecided, close, borders)

    def _at_forks(
        self, borders: Sequence[Array], guards: Array
    ) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """By how much each branch is ahead of each other, (branches, branches, N).

        With where each is beyond what is solved, and next to an event at its turn, (branches, N).
        """
        count, length = len(borders), self.horizon[1] - self.horizon[0]
        guard = iter(guards)
        ahead = np.full((count, count, borders[0].shape[1]), np.inf)
        beyond, at_turn = np.zeros((2, count, borders[0].shape[1]), dtype=bool)
        for fork, highest in zip(self.forks, self.highest, strict=True):
            a, b = fork.first, fork.second
            if fork.guard is None:
                one, other = (np.diff(borders[k][fork.stretch :][:2], axis=0)[0] for k in (a, b))
                margin = _earlier(one, other, fork.may_be_past) / length
            else:
                height = next(guard)
                margin = fork.sign * height / fork.scale
                beyond[b] |= height > highest
            if fork.at_turn:
                at_turn[[a, b]] |= np.abs(margin) < 1.0
                margin = self.width * margin
            ahead[a, b], ahead[b, a] = margin, -margin
        return ahead, beyond, at_turn

    def held(self, decision: Decision) -> NDArray[np.intp]:
        """The branch that holds, or -1 within a width of where another one does, (N,)."""
        rivals = (decision.ahead < self.width).any(axis=0)
        return np.where(decision.undecided | rivals, -1, decision.chosen)

    def merged(
        self,
        decision: Decision,
        shape: tuple[int, ...],
        tolerances: Array,
        states: Callable[[int, NDArray[np.intp]], Array],
    ) -> tuple[Array, NDArray[np.bool_]]:
        """States (rows, T, N) of the branches that hold, and where these are doubtful (T, N).

        They are where branches that may hold as well differ by more than ``tolerances`` (rows,).
        ``states`` gives those of a branch at some of the points.
        """
        merged = np.full((len(tolerances), *shape), np.nan)
        doubtful = np.zeros(shape, dtype=bool)
        for k in np.unique(decision.chosen).tolist():
            here = np.flatnonzero(decision.chosen == k)
            merged[:, :, here] = states(k, here)
        for k in range(len(decision.ahead)):
            rival = (decision.ahead[k] < self.width) & (decision.chosen != k)
            here = np.flatnonzero(rival & ~decision.undecided)
            if here.size:
                other, mine = states(k, here), merged[:, :, here]
                differ = ~(np.abs(other - mine) <= tolerances[:, None, None])
                differ &= ~(np.isnan(other) & np.isnan(mine))
                doubtful[:, here] |= differ.any(axis=0)
        doubtful[:, decision.undecided] = True
        return merged, doubtful


def looks(grazing: GrazedEvent) -> Array:
    """The times (T,) of a branch at which its guard is looked at, in stretches."""
    return grazing.stretch + np.linspace(0.0, np.nextafter(1.0, 0.0), LOOKS)


def clearance(grazing: GrazedEvent, heights: Array) -> Array:
    """How far a guard stays from a fall through zero, (N,), by ``heights`` (T, N) at its looks.

    So far are the turns, by parabolas, before which it is on the same side as after them, and the
    ends of the stretch. It is below zero where the guard falls through zero.
    """
    ends = np.where([[grazing.begins], [grazing.ends]], np.inf, np.abs(heights[[0, -1]]))
    heights = heights.copy()
    if grazing.begins:
        heights[0] = 0.0
    if grazing.ends:
        heights[-1] = 0.0
    if grazing.first and not grazing.ends:
        ends[0] = heights.min(axis=0)
    falls = np.where((heights[:-1] > 0.0) & (heights[1:] < 0.0), heights[1:], np.inf)
    before, here, after = heights[:-2], heights[1:-1], heights[2:]
    slope, bend = 0.5 * (after - before), after - 2.0 * here + before
    side = np.sign(here)
    turns = (np.sign(before) == side) & (np.sign(after) == side)
    turns &= (side * bend > 0.0) & (np.abs(slope) <= np.abs(bend))
    lowest = here - 0.5 * slope**2 / np.where(turns, bend, np.inf)
    nearest = np.where(turns, side * lowest, np.inf)
    return np.asarray(np.concatenate([ends, falls, nearest]).min(axis=0))


def _earlier(one: Array, other: Array, may_be_past: tuple[bool, bool]) -> Array:
    """By how much the first of two events (N,) is the next one; those in the past are not."""
    margin = other - one
    first_past, second_past = (
        past & (elapsed < 0.0) for past, elapsed in zip(may_be_past, (one, other), strict=True)
    )
    if may_be_past[0]:
        margin = np.where(~first_past & (margin > 0.0), np.minimum(margin, one), margin)
        margin = np.where(first_past, -np.minimum(np.abs(one), np.abs(other)), margin)
    if may_be_past[1]:
        margin = np.where(~second_past & (margin < 0.0), -np.minimum(-margin, other), margin)
        margin = np.where(second_past, np.minimum(np.abs(one), np.abs(other)), margin)
    return np.where(first_past & second_past, -np.inf, margin)


# -----------------------------------------------------------------------------
# What tells branches apart, as those who decide see it: forks, and events that are grazed.


class DecidingFork(Protocol):
    """A fork of two branches; see :class:`rankone.trajectories.system.timeline.Fork`."""

    @property
    def first(self) -> int: ...
    @property
    def second(self) -> int: ...
    @property
    def stretch(self) -> int: ...
    @property
    def guard(self) -> int | None: ...
    @property
    def sign(self) -> float: ...
    @property
    def scale(self) -> float: ...
    @property
    def may_be_past(self) -> tuple[bool, bool]: ...
    @property
    def at_turn(self) -> bool: ...


class GrazedEvent(Protocol):
    """An event that is only grazed; see :class:`rankone.trajectories.system.timeline.Grazing`."""

    @property
    def branch(self) -> int: ...
    @property
    def stretch(self) -> int: ...
    @property
    def guard(self) -> int: ...
    @property
    def scale(self) -> float: ...
    @property
    def begins(self) -> bool: ...
    @property
    def ends(self) -> bool: ...
    @property
    def first(self) -> bool: ...
