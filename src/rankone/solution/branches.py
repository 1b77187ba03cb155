"""The evaluator of a solution in branches."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

from rankone.ir.timeline import BranchedTimeline
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.slab import SlabTrain
from rankone.tensors.timeline import TimelineEvaluator


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
    evaluators = [
        TimelineEvaluator(own, branch.horizon, branch.affine_borders)
        for own, branch in zip(slabs_of_branches(slabs, timeline), timeline.branches, strict=True)
    ]
    return BranchEvaluator(
        evaluators,
        timeline.guards,
        timeline.forks,
        timeline.width,
        timeline.tolerances,
        timeline.grazings,
    )
