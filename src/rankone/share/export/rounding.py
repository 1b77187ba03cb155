"""Smaller slabs of a model that may differ from its solution, also in branches.

Ranks are cut first, then entries that do not matter. Both bound a root mean square, so the largest
difference is measured at points, and the tolerance of the cut is adapted until that difference is
small enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rankone.solution.evaluation.core import timeline_evaluator
from rankone.solvers.branches import evaluator_of_branches
from rankone.solvers.tuning import CHECK
from rankone.solvers.verification.measure import undecided_share
from rankone.solvers.verification.points import Climb, Coverage, climbed
from rankone.support.arrays import HALVINGS, Array
from rankone.tensors.branch_evaluator import BranchEvaluator
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain, sharing
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline

RANDOM_POINTS = 4200  # Points at which a smaller model is compared, a multiple of six
_SHARES_AT_ENDS = (0.0, 0.5, 1.0)  # Parameters at ends of their intervals, by thirds
_MEASURED_MARGIN = 0.7  # Largest measured difference, over ``rtol``: points miss the largest one
_GOOD_ENOUGH = 0.45  # Measured difference over ``rtol`` above which no larger tolerance is tried
_MAX_LOOSENING = 4.0  # Largest tolerance of the cut over ``rtol``: it bounds a mean square
_MAX_ATTEMPTS = 9  # Cuts that are tried: doubling or reducing the tolerance, then bisecting
_CLIMBERS = 24  # Points from which larger differences are looked for
# How a point climbs to larger differences
_DIFFERENCE_CLIMB = Climb(rounds=15, tries=6, first_step=0.2, shrinkage=0.8, seed=1)


Smaller = TypeVar("Smaller")


@dataclass(frozen=True)
class Rounding:
    """Rounded trains; slabs that shared the cores of their parameters go on sharing them.

    ``differences`` are the largest ones of each state at random points and by climbing from the
    worst of them, relative to its largest value at the points.
    """

    slabs: tuple[SlabTrain, ...]
    differences: tuple[float, ...]


def rounded_slabs(
    slabs: Sequence[SlabTrain],
    intervals: Sequence[tuple[float, float]],
    rtol: float,
    timeline: Timeline | None = None,
) -> Rounding:
    """Trains with fewer coefficients that differ by at most ``rtol`` of each state's size.

    ``slabs`` are consecutive and of the same states, ``intervals`` those of time and of each
    parameter. The slabs stay as they are if no smaller ones are within ``rtol``. With a
    ``timeline`` the last state is the clock, and the others differ by at most ``rtol`` at clock
    times that are ``rtol`` horizons away from events that reset states or end them.
    """
    comparison = _SlabComparison(slabs, intervals, rtol, timeline)
    cut = partial(smaller_slabs, slabs, comparison.sizes)
    best = loosest(cut, comparison.differences, rtol)
    unchanged = Rounding(tuple(slabs), (0.0,) * len(comparison.sizes))
    return unchanged if best is None else Rounding(*best)


def loosest(
    cut: Callable[[float], Smaller], compared: Callable[[Smaller], Array], rtol: float
) -> tuple[Smaller, tuple[float, ...]] | None:
    """The smallest slabs that are within ``rtol``, with their differences, or none.

    ``cut`` makes slabs smaller by a tolerance, ``compared`` tells how far they are off then.
    """
    best: tuple[Smaller, tuple[float, ...]] | None = None
    low, high, tolerance = 0.0, 0.0, rtol
    for _ in range(_MAX_ATTEMPTS):
        smaller = cut(tolerance)
        differences = compared(smaller)
        largest = float(differences.max())
        if largest <= _MEASURED_MARGIN * rtol:
            best, low = (smaller, tuple(differences.tolist())), tolerance
        else:
            high = tolerance
        loose = largest >= _GOOD_ENOUGH * rtol or tolerance >= _MAX_LOOSENING * rtol
        if low == tolerance and loose:
            break
        tolerance = 2.0 * low if low else 0.3 * high
        if low and high:
            tolerance = math.sqrt(low * high)
    return best


class _SlabComparison:
    """Slabs, and points at which smaller ones are compared with them; ``sizes`` of the states."""

    def __init__(
        self,
        slabs: Sequence[SlabTrain],
        intervals: Sequence[tuple[float, float]],
        rtol: float,
        timeline: Timeline | None,
    ) -> None:
        self._intervals, self._timeline = intervals, timeline
        self._before = _evaluation(slabs, timeline)
        self._apart = rtol * (intervals[0][1] - intervals[0][0])
        self._points = random_points(slabs, intervals)
        if timeline is not None:
            self._move_to_events()
        self._states = self._before(self._points)
        self.sizes = np.nanmax(np.abs(self._states), axis=1)
        if timeline is not None:
            self.sizes = self.sizes[: len(slabs[0].cores[0])]
            self.sizes[-1] = intervals[0][1] - intervals[0][0]
        self.sizes[self.sizes == 0.0] = 1.0

    def differences(self, smaller: tuple[SlabTrain, ...]) -> Array:
        """Largest difference of each state over its size: at points, and climbing from the worst.

        That of the clock is the one of the times of events.
        """
        after = _evaluation(smaller, self._timeline)

        def changes(points: Array) -> Array:
            before = self._states if points is self._points else self._before(points)
            return self._changes(points, before, after(points))

        return climbed_differences(changes, self._points, self._intervals)

    def _changes(self, points: Array, before: Array, after: Array) -> Array:
        """Differences (states, N) over the sizes at points (coordinates, N)."""
        if self._timeline is None:
            return np.asarray(np.abs(after - before) / self.sizes[:, None])
        n = len(self.sizes) - 1
        changes = np.abs(after - before)
        ended = np.isnan(before[:n]) & np.isnan(after[:n])
        changes[:n] = np.where(ended, 0.0, np.nan_to_num(changes[:n], nan=np.inf))
        left_out = np.abs(points[0] - before[n:][interruptions(self._timeline)]) <= self._apart
        changes[:n, left_out.any(axis=0)] = 0.0
        of_clock = changes[n:].max(axis=0, keepdims=True)
        return np.asarray(np.concatenate([changes[:n], of_clock]) / self.sizes[:, None])

    def _move_to_events(self) -> None:
        """Every other point to a time just before or after an event."""
        assert self._timeline is not None
        rng = np.random.default_rng(1)
        half = self._points[:, ::2]
        borders = self._before(half)[-1 - self._timeline.stretches :]
        border = rng.integers(0, len(borders), half.shape[1])
        times = borders[border, np.arange(half.shape[1])]
        times += CHECK.event_distance * self._apart * rng.choice([-1.0, 1.0], half.shape[1])
        self._points[0, ::2] = np.clip(times, *self._intervals[0])


def _evaluation(slabs: Sequence[SlabTrain], timeline: Timeline | None) -> Callable[[Array], Array]:
    """States at points (1 + d, N), shape (states, N).

    With a timeline the last state of the slabs is the clock, and in its place come the clock times
    of the borders of stretches.
    """
    rows = slice(0, len(slabs[0].cores[0]))
    if timeline is None:
        evaluator = TrainEvaluator(slabs)
        return lambda points: evaluator.many(points, rows)
    # behind the clock stands the length of the stretch, which is not read
    padded = [slab.with_first(np.concatenate([c := slab.cores[0], c[-1:]])) for slab in slabs]
    over_clock = timeline_evaluator(padded, timeline)
    states = slice(0, rows.stop - 1)
    return lambda points: np.concatenate(
        [over_clock.many(points, states), over_clock.borders(points[1:])]
    )


def climbed_differences(
    changes: Callable[[Array], Array], points: Array, intervals: Sequence[tuple[float, float]]
) -> Array:
    """The largest of ``changes`` (rows, N) at points (coordinates, N), (rows,).

    At some points, and climbing from the worst of them.
    """
    at_points = changes(points)
    largest = at_points.max(axis=1)

    def difference(tried: Array) -> Array:
        nonlocal largest
        there = changes(tried.T)
        largest = np.maximum(largest, there.max(axis=1))
        return np.asarray(there.max(axis=0))

    worst = np.argsort(-at_points.max(axis=0))[:_CLIMBERS]
    heights = at_points[:, worst].max(axis=0)
    climbed(difference, points[:, worst].T, heights, np.array(intervals), _DIFFERENCE_CLIMB)
    return np.asarray(largest)


def interruptions(timeline: Timeline) -> list[int]:
    """The borders at which states are reset or end."""
    last = len(timeline.instants)
    resets = enumerate(timeline.resets, 1)
    return [i for i, reset in resets if reset or (timeline.terminal and i == last)]


def random_points(slabs: Sequence[SlabTrain], intervals: Sequence[tuple[float, float]]) -> Array:
    """Random points (coordinates, N), with many where trains differ most.

    A third lies anywhere, a third on faces and edges of the box, a third at its corners; half of
    all are at ends of slabs.
    """
    rng = np.random.default_rng(0)
    ends = np.array(intervals)
    shares = rng.random((len(ends), RANDOM_POINTS))
    at_ends = rng.random(shares.shape) < np.repeat(
        _SHARES_AT_ENDS, RANDOM_POINTS // len(_SHARES_AT_ENDS)
    )
    shares = np.where(at_ends, np.round(shares), shares)
    points = ends[:, :1] + shares * np.diff(ends)
    for j, basis in enumerate(slabs[0].bases[: len(points) - 1], start=1):
        if not basis.scale.is_identity:
            start, end = basis.scale.to_scale(ends[j])
            points[j] = basis.scale.from_scale(start + shares[j] * (end - start))
    points = np.clip(points, ends[:, :1], ends[:, 1:])
    edges = np.clip([edge for slab in slabs for edge in (slab.start, slab.end)], *ends[0])
    points[0, ::2] = rng.choice(edges, RANDOM_POINTS // 2)
    return points


def smaller_slabs(
    slabs: Sequence[SlabTrain], sizes: Array, tolerance: float
) -> tuple[SlabTrain, ...]:
    """Smaller slabs, within a tolerance of the sizes of the states in mean square."""
    return tuple(slab for run in sharing(slabs) for slab in _smaller(run, sizes, tolerance))


def _smaller(run: Sequence[SlabTrain], sizes: Array, tolerance: float) -> list[SlabTrain]:
    """Smaller slabs that share the cores of their parameters, within a tolerance in mean square.

    They are one train, whose first core has the polynomials of all of them.
    """
    first = np.concatenate([slab.cores[0] for slab in run], axis=1) / sizes[:, None, None]
    share = np.sqrt(0.5) * tolerance
    train = run[0].train.with_first(first).rounded(share).thinned(share)
    counts = np.cumsum([slab.cores[0].shape[1] for slab in run])
    firsts = np.split(train.first * sizes[:, None, None], counts[:-1], axis=1)
    return [
        replace(slab, train=train.with_first(first))
        for slab, first in zip(run, firsts, strict=True)
    ]


# -----------------------------------------------------------------------------
# Smaller slabs of a model in whose box the order of events changes.
#
# Branches are cut as the slabs of one order are, and compared with the solution where both say
# which branch holds. What tells that is moved by the cut as well: it is known less well, so that
# the model has a somewhat larger part of the box in which values are NaN.


_BESIDE = 4.0  # Distance of points from a change of order, at most, over ``rtol`` and the box

Branches = Sequence[Sequence[SlabTrain]]


def rounded_branches(
    slabs: Branches,
    intervals: Sequence[tuple[float, float]],
    rtol: float,
    timeline: BranchedTimeline,
) -> tuple[Branches, BranchedTimeline, tuple[float, ...]]:
    """Smaller slabs of branches, the timeline that goes with them, and the differences.

    The last states of the slabs are guards and the clock. The others differ by at most ``rtol`` of
    their sizes, as far as both are known, at clock times that are ``rtol`` horizons away from
    events that reset states or end them.
    """
    comparison = _BranchComparison(slabs, intervals, rtol, timeline)
    best = loosest(comparison.smaller, comparison.differences, rtol)
    if best is None:
        return slabs, timeline, (0.0,) * (1 + len(timeline.tolerances))
    smaller, differences = best
    evaluator = _evaluator(smaller, comparison.timeline)
    coverage = Coverage.of_box(np.array(intervals[1:]).reshape(-1, 2))
    undecided = undecided_share(evaluator, coverage)
    return smaller, replace(comparison.timeline, undecided=undecided), differences


class _BranchComparison:
    """Branches, and points at which smaller ones are compared with them.

    The ``timeline`` of the smaller ones has guards and times that are known less well.
    """

    def __init__(
        self,
        slabs: Branches,
        intervals: Sequence[tuple[float, float]],
        rtol: float,
        timeline: BranchedTimeline,
    ) -> None:
        self._slabs, self._intervals, self._rtol = slabs, intervals, rtol
        self._length = intervals[0][1] - intervals[0][0]
        self._tolerances = np.array(timeline.tolerances)
        self._before = _evaluator(slabs, timeline)
        self._interruptions = [interruptions(branch) for branch in timeline.branches]
        self._points = random_points(slabs[0], intervals)
        self._move_to_changes()
        self._move_to_events()
        states = self._before.with_doubts(*_apart(self._points), self._rows)[0][:, 0]
        sizes = np.nanmax(np.abs(states), axis=1)
        self._sizes = np.where(sizes > 0.0, sizes, 1.0)
        wider = (self._tolerances + rtol * self._sizes).tolist()
        self.timeline = replace(timeline, width=timeline.width + rtol, tolerances=tuple(wider))

    @property
    def _rows(self) -> slice:
        return slice(0, self._tolerances.size)

    def smaller(self, tolerance: float) -> Branches:
        """The branches, cut by a tolerance in mean square."""
        return [
            smaller_slabs(own, np.concatenate([self._sizes, guards, [self._length]]), tolerance)
            for own, guards in zip(self._slabs, map(self._guards, self._branches), strict=True)
        ]

    @property
    def _branches(self) -> range:
        return range(len(self._slabs))

    def _guards(self, branch: int) -> Array:
        """The sizes of the guards of a branch: how far one may be off to decide as before."""
        timeline = self.timeline
        sizes = np.full(timeline.guards[branch], np.inf)
        for fork in timeline.forks:
            if fork.first == branch and fork.guard is not None and not fork.at_turn:
                sizes[fork.guard] = min(sizes[fork.guard], fork.scale)
        for grazing in timeline.grazings:
            if grazing.branch == branch:
                sizes[grazing.guard] = min(sizes[grazing.guard], grazing.scale)
        for opening in timeline.openings:  # the slope of the root is largest at its lower end
            if opening.parent == branch:
                sizes[opening.guard] = min(sizes[opening.guard], opening.lower)
        return np.where(np.isfinite(sizes), sizes, 1.0)

    def differences(self, smaller: Branches) -> Array:
        """Largest difference of each state over its size, and of the times of events."""
        after = _evaluator(smaller, self.timeline)
        changes = partial(self._changes, after)
        return climbed_differences(changes, self._points, self._intervals)

    def _changes(self, after: BranchEvaluator, points: Array) -> Array:
        """Differences (states and the clock, N) over the sizes at points (coordinates, N)."""
        evaluators = self._before, after
        before, now = (each.decided(points[1:]) for each in evaluators)
        states, doubts = zip(
            *(each.with_doubts(*_apart(points), self._rows) for each in evaluators), strict=True
        )
        one, other = (values[:, 0] for values in states)
        changes = np.abs(other - one)
        ended = np.isnan(one) & np.isnan(other)
        changes = np.where(ended, 0.0, np.nan_to_num(changes, nan=np.inf))
        same = before.chosen == now.chosen
        # next to a change of order either branch will do
        excess = np.maximum(changes - self._tolerances[:, None], 0.0)
        changes = np.where(same, changes, excess)
        borders = [each.borders(points[1:]) for each in evaluators]
        left_out = (
            doubts[0][0] | doubts[1][0] | self._near_events(points, before.chosen, borders[0])
        )
        changes[:, left_out] = 0.0
        moved = np.nan_to_num(np.abs(borders[1] - borders[0]))
        of_clock = np.where(same, moved.max(axis=0), 0.0)
        return np.concatenate([changes / self._sizes[:, None], [of_clock / self._length]])

    def _near_events(
        self, points: Array, chosen: NDArray[np.intp], borders: Array
    ) -> NDArray[np.bool_]:
        """Where a time is next to an event of the branch that holds which resets states."""
        near = np.zeros(points.shape[1], dtype=bool)
        for k, rows in enumerate(self._interruptions):
            here = np.flatnonzero(chosen == k)
            apart = np.abs(points[0, here] - borders[rows][:, here])
            near[here] = (apart <= self._rtol * self._length).any(axis=0)
        return near

    def _move_to_changes(self) -> None:
        """Every third point to one next to a change of order on the way to another point."""
        places = np.arange(0, self._points.shape[1], 3)
        box = np.array(self._intervals[1:]).reshape(-1, 2)
        here = self._points[1:, places]
        there = np.roll(here, 1, axis=1)
        chosen = self._before.decided(here).chosen
        changing = np.flatnonzero(chosen != np.roll(chosen, 1))
        low, high, own = here[:, changing], there[:, changing], chosen[changing]
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            still = self._before.decided(middle).chosen == own
            low, high = np.where(still, middle, low), np.where(still, high, middle)
        aside = np.random.default_rng(2).uniform(-_BESIDE, _BESIDE, low.shape)
        moved = low + aside * self._rtol * np.ptp(box, axis=1, keepdims=True)
        self._points[1:, places[changing]] = np.clip(moved, box[:, :1], box[:, 1:])

    def _move_to_events(self) -> None:
        """Every other point to a time just before or after an event."""
        rng = np.random.default_rng(1)
        half = self._points[:, ::2]
        borders = self._before.borders(half[1:])
        border = rng.integers(0, len(borders), half.shape[1])
        times = borders[border, np.arange(half.shape[1])]
        distance = CHECK.event_distance * self._rtol * self._length
        times += distance * rng.choice([-1.0, 1.0], half.shape[1])
        times = np.where(np.isfinite(times), times, half[0])
        self._points[0, ::2] = np.clip(times, *self._intervals[0])


def _apart(points: Array) -> tuple[Array, Array]:
    """Times (1, N) and parameters (d, N) of points."""
    return points[:1], points[1:]


def _evaluator(slabs: Branches, timeline: BranchedTimeline) -> BranchEvaluator:
    """The evaluator of slabs whose last state is the clock."""
    # behind the clock stands the length of the stretch, which is not read
    padded = [
        tuple(s.with_first(np.concatenate([c := s.cores[0], c[-1:]])) for s in own) for own in slabs
    ]
    return evaluator_of_branches(padded, timeline)
