"""Flows: states along stretches, forwards and backwards, and the roots and turns on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import EPSILON, ROUNDING, TINY, Array
from rankone.trajectories.integrators.defects import roots
from rankone.trajectories.integrators.integrator import Paths
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
    at_root=1e-7,  # Height at the beginning, over the largest one, where a stretch begins at a root
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
