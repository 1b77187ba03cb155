"""States of a solution for all subjects at once, each at the times of its own data."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rankone.estimation.doses import Response
from rankone.ir.timeline import BranchedTimeline
from rankone.solution.branches import branch_evaluator
from rankone.solution.core import SolutionCore, timeline_evaluator
from rankone.support.arrays import Array
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.slab import SlabTrain, slab_positions
from rankone.tensors.timeline import TimelineEvaluator

_POINTS_AT_ONCE = 4096  # Points that are evaluated together, to bound memory
# Change of states at the times of the data that nobody notices, in shares of the tolerance of the
# solution: the ranks are smaller after it
_UNNOTICED_SHARE = 0.1


class OwnTimes(Protocol):
    """States of n records, each at M times of its own, as functions of the parameters."""

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """States (K, n, M) at points (d, K, n), and derivatives (K, n, M, k).

        ``free`` are the positions of k parameters, ascending.
        """

    def selected(self, records: NDArray[np.intp]) -> OwnTimes:
        """The states of some of the records."""


def own_times(solution: SolutionCore, rows: NDArray[np.intp], response: Response) -> OwnTimes:
    """States ``rows`` (M,) of a solution where records have a response."""
    outcome = solution.outcome
    if isinstance(outcome.timeline, BranchedTimeline):
        return _OnTimeline(
            branch_evaluator(outcome.slabs, outcome.timeline).likeliest(), rows, response
        )
    if outcome.timeline is not None:
        return _OnTimeline(timeline_evaluator(outcome.slabs, outcome.timeline), rows, response)
    return _OnSlabs(outcome.slabs, rows, response, _UNNOTICED_SHARE * solution.rtol)


class _OnSlabs:
    """The first core of the train is evaluated once, at the times of each record, over its doses.

    Ranks that matter at no time of the data are left out, within a tolerance relative to each
    state's size: the root mean square over the box and over the data.
    """

    def __init__(
        self,
        slabs: Sequence[SlabTrain],
        rows: NDArray[np.intp],
        response: Response,
        tolerance: float,
    ) -> None:
        times, weights = response
        self.shape = times.shape[:2]
        owner = slab_positions(slabs, times.ravel()).reshape(times.shape)
        self._groups: list[tuple[SlabTrain, Array]] = []
        for k in np.unique(owner[weights != 0.0]):
            slab, here = slabs[k], (owner == k) & (weights != 0.0)
            records, columns, _ = np.nonzero(here)
            at = slab.in_time(times[here])[rows[columns], np.arange(records.size)]
            first = np.zeros((*self.shape, slab.cores[0].shape[2]))
            np.add.at(first, (records, columns), weights[here][:, None] * at)
            shared = (i for i, (one, _) in enumerate(self._groups) if one.shares_parameters(slab))
            same = next(shared, None)
            if same is None:
                self._groups.append((slab, first))
            else:
                self._groups[same][1][...] += first
        self._groups = [self._thinned(*group, rows, tolerance) for group in self._groups]

    def _thinned(
        self, slab: SlabTrain, first: Array, rows: NDArray[np.intp], tolerance: float
    ) -> tuple[SlabTrain, Array]:
        """A group with smaller ranks."""
        here = first.any(axis=2)
        train = slab.train.with_first(first[here]).right_orthonormal()
        norms = np.linalg.norm(train.first, axis=1)
        states = np.broadcast_to(rows, self.shape)[here]
        sizes = np.array([norms[states == state].max() for state in states])
        scaled = train.with_first(train.first / sizes[:, None])
        scaled, _ = scaled.truncated(tolerance * np.sqrt(norms.size))
        thinned = np.zeros((*self.shape, scaled.first.shape[1]))
        thinned[here] = scaled.first * sizes[:, None]
        return replace(slab, train=scaled.with_first(slab.cores[0])), thinned

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """See :meth:`OwnTimes.linearised`."""
        count, width = points.shape[1], 1 + len(free)
        table = np.zeros((self.shape[0], self.shape[1], count, width))
        step = max(_POINTS_AT_ONCE // max(self.shape[0], 1), 1)
        for slab, first in self._groups:
            records = np.flatnonzero(first.any(axis=(1, 2)))
            for begin in range(0, count, step):
                block = points[:, begin : begin + step, records]
                products = slab.with_slopes(block.reshape(len(points), -1), free)
                by_record = products.reshape(len(products), block.shape[1], records.size, width)
                columns = by_record.transpose(2, 0, 1, 3).reshape(records.size, len(products), -1)
                states = (first[records] @ columns).reshape(records.size, -1, block.shape[1], width)
                table[records, :, begin : begin + step] += states
        moved = table.transpose(2, 0, 1, 3)
        return moved[..., 0], moved[..., :0:-1]

    def selected(self, records: NDArray[np.intp]) -> _OnSlabs:
        """See :meth:`OwnTimes.selected`."""
        fewer = copy(self)
        fewer.shape = (records.size, self.shape[1])
        fewer._groups = [(slab, first[records]) for slab, first in self._groups]
        return fewer


class _OnTimeline:
    """A solution over stretches between events."""

    def __init__(
        self,
        evaluator: TimelineEvaluator | BranchEvaluator,
        rows: NDArray[np.intp],
        response: Response,
    ) -> None:
        self.evaluator, self.rows, self.response = evaluator, rows, response

    def selected(self, records: NDArray[np.intp]) -> _OnTimeline:
        """See :meth:`OwnTimes.selected`."""
        fewer = Response(*(each[records] for each in self.response))
        return _OnTimeline(self.evaluator, self.rows, fewer)

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """See :meth:`OwnTimes.linearised`."""
        d, count, records = points.shape
        times, weights = self.response
        values = np.empty((count, records, self.rows.size))
        slopes = np.empty((*values.shape, len(free)))
        step = max(_POINTS_AT_ONCE // max(records, 1), 1)
        for row in np.unique(self.rows):
            columns = np.flatnonzero(self.rows == row)
            shape = columns.size, times.shape[2]
            own = weights[:, columns]
            clock = times[:, columns].reshape(records, -1).T
            for begin in range(0, count, step):
                block = points[:, begin : begin + step]
                size = block.shape[1]
                at = np.tile(clock, (1, size))
                states, moved = self.evaluator.linearised(
                    at, block.reshape(d, -1), np.array([row]), free
                )
                here = slice(begin, begin + size)
                each = states[0].T.reshape(size, records, *shape)
                values[here][..., columns] = (own * each).sum(axis=-1)
                each = moved[0].swapaxes(0, 1).reshape(size, records, *shape, len(free))
                slopes[here][..., columns, :] = (own[..., None] * each).sum(axis=-2)
        return values, slopes
