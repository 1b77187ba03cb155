"""The evaluator of a solution in branches."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

from rankone.ir.timeline import BranchedTimeline
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.slab import SlabTrain
from rankone.tensors.timeline import TimelineEvaluator


def branch_evaluator(slabs: Sequence[SlabTrain], timeline: BranchedTimeline) -> BranchEvaluator:
    """The evaluator of slabs of branches, each behind those of the one before."""
    ends = itertools.accumulate(branch.stretches for branch in timeline.branches)
    evaluators, start = list[TimelineEvaluator](), 0
    for branch, end in zip(timeline.branches, ends, strict=True):
        own = [
            replace(slab, start=slab.start - start, end=slab.end - start)
            for slab in slabs
            if start <= 0.5 * (slab.start + slab.end) < end
        ]
        evaluators.append(TimelineEvaluator(own, branch.horizon, branch.affine_borders))
        start = end
    return BranchEvaluator(
        evaluators, timeline.guards, timeline.forks, timeline.width, timeline.tolerances
    )
