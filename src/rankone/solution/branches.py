"""The evaluator of a solution in branches."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

from rankone.ir.timeline import CLOCK_STATES, BranchedTimeline, Opening
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.decisions import Decider
from rankone.tensors.slab import SlabTrain
from rankone.tensors.timeline import HeightRoot, TimelineEvaluator


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
