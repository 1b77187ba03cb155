"""The march leads a controller and a slab solver, and no more."""

from __future__ import annotations

import numpy as np

from rankone.solvers.march import March, SlabTrial, Span
from rankone.solvers.outcome import SlabRecord
from rankone.support.budget import ProgressEvent
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train
from rankone.trajectories.system.verdict import Status


class Halving:
    """Begins with slabs of length one and halves after every rejection."""

    def __init__(self, end: float) -> None:
        self.end, self.length = end, 1.0

    def propose(self, start: float) -> Span | Status:
        if self.length < 0.1:
            return Status.NO_CONVERGENCE
        return Span(start, self.length, min(start + self.length, self.end))

    def adapt(self, span: Span, trial: SlabTrial) -> bool:
        self.length *= 1.0 if trial.record.accepted else 0.5
        return trial.record.accepted


class Picky:
    """Solves slabs up to a length."""

    def __init__(self, longest: float) -> None:
        self.longest = longest

    def solve(self, span: Span) -> SlabTrial:
        good = span.length <= self.longest
        record = SlabRecord(0, span.start, span.end, good, 0.0, (), (), ())
        return SlabTrial(record, set() if good else {Status.RANK_LIMIT})

    def accept(self, span: Span, trial: SlabTrial) -> list[SlabTrain]:
        return [SlabTrain(span.start, span.end, Train((np.ones((1, 2, 1)),)), ())]


def test_rejected_slabs_are_tried_again_shorter() -> None:
    events: list[ProgressEvent] = []
    result = March(Halving(1.25), Picky(0.5), 10).run(0.0, 1.25, 3, events.append)
    assert [(slab.start, slab.end) for slab in result.slabs] == [(0, 0.5), (0.5, 1), (1, 1.25)]
    assert [record.accepted for record in result.records] == [False, True, True, True]
    assert result.limits == {Status.RANK_LIMIT}
    assert result.stopped is None
    assert [event.fraction for event in events] == [0.4, 0.8, 1.0]
    assert [(event.attempt, event.slabs) for event in events] == [(3, 1), (3, 2), (3, 3)]


def test_why_it_stopped_is_said() -> None:
    result = March(Halving(1.0), Picky(0.01), 10).run(0.0, 1.0, 0, lambda event: None)
    assert result.stopped is Status.NO_CONVERGENCE
    assert len(result.records) == 4
    assert not result.slabs
    result = March(Halving(9.0), Picky(1.0), 3).run(0.0, 9.0, 0, lambda event: None)
    assert result.stopped is Status.SLAB_LIMIT
    assert len(result.slabs) == 3
