"""The evaluator of a solution in branches, and the box over which each is solved."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linprog

from rankone.ir.measures import Interval
from rankone.ir.timeline import CLOCK_STATES, BranchedTimeline, Opening
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.decisions import Decider
from rankone.tensors.slab import SlabTrain, restricted
from rankone.tensors.timeline import HeightRoot, TimelineEvaluator

_BEYOND = 0.02  # Reach of a branch beyond the part of the box where it holds, in horizons


def slabs_of_branches(
    slabs: Sequence[SlabTrain], timeline: BranchedTimeline
) -> list[tuple[SlabTrain, ...]]:
    """The slabs of each branch, which follow those of the one before, from 0 on."""
    ends = itertools.accumulate(branch.stretches for branch in timeline.branches)
    every, start = list[tuple[SlabTrain, ...]](), 0
    for end in ends:
        own = (
            replace(slab, start=slab.start - start, end=slab.end - start)
            for slab in slabs
            if start <= 0.5 * (slab.start + slab.end) < end
        )
        every.append(tuple(own))
        start = end
    return every


def box_of_branch(
    timeline: BranchedTimeline, branch: int, whole: Sequence[Interval]
) -> tuple[Interval, ...]:
    """The box around the part of the whole one where a branch holds, and some way beyond.

    The whole one unless times of events that are affine in the parameters alone tell where.
    """
    times = timeline.branches[branch].affine_times
    guarded = any(timeline.guards) or any(fork.guard is not None for fork in timeline.forks)
    known = all(len(b.affine_times) == len(b.instants) for b in timeline.branches)
    if guarded or not known or len(times) < 2:
        return tuple(whole)
    earlier = -np.diff([coefficients for _, coefficients in times], axis=0)
    start, end = timeline.horizon
    most = _BEYOND * (end - start) - earlier[:, 0]
    box = list(whole)
    for j in np.flatnonzero(earlier[:, 1:].any(axis=0)).tolist():
        (lower, upper), along = whole[j], np.eye(len(whole))[j]
        ends = [linprog(sign * along, earlier[:, 1:], most, bounds=whole) for sign in (1, -1)]
        if not all(each.success for each in ends):
            return tuple(whole)
        low, high = (float(each.x[j]) for each in ends)
        if low < high:
            box[j] = max(low, lower), min(high, upper)
    return tuple(box)


def slabs_over(slabs: Sequence[SlabTrain], box: Sequence[Interval]) -> tuple[SlabTrain, ...]:
    """Slabs over another box of the parameters, constant beyond the one they are solved over."""
    slabs = tuple(slabs)
    for j, interval in enumerate(box):
        if slabs and (slabs[0].bases[j].lower, slabs[0].bases[j].upper) != interval:
            slabs = restricted(slabs, j, interval)
    return slabs


def branch_evaluator(slabs: Sequence[SlabTrain], timeline: BranchedTimeline) -> BranchEvaluator:
    """The evaluator of slabs of branches, each behind those of the one before."""
    return evaluator_of_branches(slabs_of_branches(slabs, timeline), timeline)


def evaluator_of_branches(
    slabs_of: Sequence[Sequence[SlabTrain]], timeline: BranchedTimeline
) -> BranchEvaluator:
    """The evaluator of the slabs of each branch, from 0 on."""
    evaluators = dict[int, TimelineEvaluator]()

    def evaluator(k: int) -> TimelineEvaluator:
        """That of a branch, after those of the parents of its openings."""
        if k not in evaluators:
            branch = timeline.branches[k]
            roots = [root(each) for each in timeline.openings if each.branch == k]
            evaluators[k] = TimelineEvaluator(
                slabs_of[k], branch.horizon, branch.affine_borders, roots
            )
        return evaluators[k]

    def root(opening: Opening) -> HeightRoot:
        of, k = evaluator(opening.parent), opening.parent
        row = len(of.slabs[0].cores[0]) - CLOCK_STATES - timeline.guards[k] + opening.guard
        return HeightRoot(of, row, opening.lower, opening.upper)

    return BranchEvaluator(
        [evaluator(k) for k in range(len(timeline.branches))],
        timeline.guards,
        Decider(
            timeline.forks,
            timeline.highest,
            timeline.grazings,
            timeline.width,
            timeline.horizon,
        ),
        timeline.tolerances,
    )
