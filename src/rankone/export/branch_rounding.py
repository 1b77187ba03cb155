"""Smaller slabs of a model in whose box the order of events changes.

Branches are cut as the slabs of one order are, and compared with the solution where both say which
branch holds. What tells that is moved by the cut as well: it is known less well, so that the model
has a somewhat larger part of the box in which values are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rankone.export.rounding import (
    BORDER_SIDE,
    climbed_differences,
    interruptions,
    loosest,
    random_points,
    smaller_slabs,
)
from rankone.ir.timeline import BranchedTimeline
from rankone.solution.branches import evaluator_of_branches
from rankone.support.arrays import Array
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.slab import SlabTrain
from rankone.verification.branches import undecided_share
from rankone.verification.coverage import Coverage

_BISECTIONS = 40  # Of the way between two points, to a change of order
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
    comparison = _Comparison(slabs, intervals, rtol, timeline)
    best = loosest(comparison.smaller, comparison.differences, rtol)
    if best is None:
        return slabs, timeline, (0.0,) * (1 + len(timeline.tolerances))
    smaller, differences = best
    evaluator = _evaluator(smaller, comparison.timeline)
    coverage = Coverage.of_box(np.array(intervals[1:]).reshape(-1, 2))
    undecided = undecided_share(evaluator, coverage)
    return smaller, replace(comparison.timeline, undecided=undecided), differences


class _Comparison:
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
        for _ in range(_BISECTIONS):
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
        times += BORDER_SIDE * self._rtol * self._length * rng.choice([-1.0, 1.0], half.shape[1])
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
