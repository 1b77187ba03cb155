"""What a solution with events says of their times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, did_you_mean, listing
from rankone.tensors.branch_evaluator import BranchEvaluator, PieceEvaluator
from rankone.tensors.coordinates import name_of
from rankone.tensors.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline


class EventTimes(SolutionCore):
    """The times of events, as functions of the parameters."""

    @property
    def timeline(self) -> Timeline | BranchedTimeline:
        """The events that end the stretches of all trajectories, in their order.

        Where the order changes inside the box, that is a :class:`BranchedTimeline`.

        Raises
        ------
        EvaluationError
            If the problem has no events, nothing was solved, or the solution is joined of pieces,
            of which each has a timeline.
        """
        self.outcome.refuse_pieces("timeline")
        timeline = self.outcome.timeline
        if not self.outcome.slabs:
            raise EvaluationError(f"nothing was solved: {self.message}")
        if timeline is None:
            raise EvaluationError("the solution is over clock time: it has no events or timeline")
        return timeline

    @property
    def time_error(self) -> float:
        """Largest measured error of the time of an event, relative to the horizon.

        NaN if unchecked, or without events.
        """
        measured = self.outcome.measured
        error = None if measured is None else measured.time_error
        return float("nan") if error is None else error

    @property
    def share_error(self) -> float:
        """Largest measured error of a state at equal shares of the stretches between events.

        It is relative to the size of the state, and compares what is solved: :attr:`error`, at
        equal clock times, has the errors of the times of events in it as well. NaN if unchecked, or
        without events.
        """
        measured = self.outcome.measured
        error = None if measured is None else measured.share_error
        return float("nan") if error is None else error

    def event_times(self, event: object, *at: object, **named: object) -> Array:
        """When an event occurs, for given values of the parameters.

        Parameters
        ----------
        event : str
            Its name.
        *at, **named
            Values of the parameters, as in a call, without times.

        Returns
        -------
        ndarray (largest count over the box, *broadcast shape of the values)
            The times in order, NaN for those that are not reached by the end. Several at one
            instant count as one.

        Raises
        ------
        EvaluationError
            If there is no such event, or as in a call.
        """
        if self.outcome.pieces:
            return self._in_own_pieces(
                lambda piece, points: piece.event_times(event, points), at, named
            )
        timeline, name = self.timeline, name_of(event)
        if name not in timeline.events:
            raise EvaluationError(
                f"no event `{name}`{did_you_mean(name, timeline.events)}; "
                f"the events are {listing(timeline.events) or 'none'}",
                term=event,
            )
        evaluator = self._evaluator
        if isinstance(evaluator, BranchEvaluator):
            points, shape = self._points(at, named)
            assert isinstance(timeline, BranchedTimeline)
            times = _times_in_branches(evaluator, timeline, name, points)
        else:
            borders, shape = self._borders(at, named)
            times = borders[_places(timeline.met, name)]
        times[times > timeline.horizon[1]] = np.nan
        return times.reshape(len(times), *shape)

    def branch(self, *at: object, **named: object) -> NDArray[np.intp]:
        """Which order of events holds, for given values of the parameters.

        Arguments are those of a call, without times.

        Returns
        -------
        ndarray of int (broadcast shape of the values)
            The position in ``timeline.branches``, or -1 where it is undecided which one holds:
            there values are NaN as far as branches differ. Zeros for a single order of events.

        Raises
        ------
        EvaluationError
            As for :attr:`timeline`, or as in a call.
        """
        self.timeline  # noqa: B018 - raises if there is none
        evaluator, (points, shape) = self._evaluator, self._points(at, named)
        if not isinstance(evaluator, BranchEvaluator):
            return np.zeros(shape, dtype=np.intp)
        return evaluator.held(points).reshape(shape)

    def end(self, *at: object, **named: object) -> Array:
        """When the solution ends: at a terminal event, or at the end of the horizon.

        Arguments and errors are those of a call, without times.

        Returns
        -------
        ndarray (broadcast shape of the values)
        """
        if self.outcome.pieces:
            ends = self._in_own_pieces(lambda piece, points: piece.end(points)[None], at, named)
            return np.asarray(ends[0])
        timeline, (_, horizon) = self.outcome.timeline, self.metadata.horizon
        if timeline is None or not timeline.terminal:
            self._evaluator  # noqa: B018 - raises if nothing was solved
            values = self._parameters(at, named)
            return np.full(np.broadcast_shapes(*(v.shape for v in values)), horizon)
        borders, shape = self._borders(at, named)
        last = borders[-1]
        if isinstance(timeline, BranchedTimeline):  # those of shorter branches are NaN
            counts = np.isfinite(borders).sum(axis=0)
            last = np.take_along_axis(borders, np.maximum(counts - 1, 0)[None], axis=0)[0]
            last = np.where(counts > 0, last, np.nan)
        return np.asarray(np.minimum(last, horizon).reshape(shape))

    def _in_own_pieces(
        self,
        of: Callable[[EventTimes, dict[str, Array]], Array],
        at: tuple[object, ...],
        named: dict[str, object],
    ) -> Array:
        """Rows (count, N) of the pieces that hold points, NaN where a piece has fewer of them."""
        points, shape = self._points(at, named)
        assert isinstance(self._evaluator, PieceEvaluator)
        table = np.full((0, points.shape[1]), np.nan)
        for position, here in self._evaluator.tiling.groups(points):
            piece = self.outcome.pieces[position]
            own = EventTimes(piece.outcome, piece.metadata)
            rows = of(own, dict(zip(self.metadata.parameters, points[:, here], strict=True)))
            more = max(len(rows) - len(table), 0)
            table = np.pad(table, ((0, more), (0, 0)), constant_values=np.nan)
            table[: len(rows), here] = rows
        return table.reshape(len(table), *shape)

    def _borders(
        self, at: tuple[object, ...], named: dict[str, object]
    ) -> tuple[Array, tuple[int, ...]]:
        """Clock times (stretches + 1, N) of the borders of stretches, and the shape of N."""
        evaluator = self._evaluator
        assert isinstance(evaluator, TimelineEvaluator | BranchEvaluator)
        points, shape = self._points(at, named)
        return evaluator.borders(points), shape

    def _points(
        self, at: tuple[object, ...], named: dict[str, object]
    ) -> tuple[Array, tuple[int, ...]]:
        """The points (d, N) of the parameters, and the shape of N."""
        values = np.broadcast_arrays(*self._parameters(at, named))
        shape = values[0].shape if values else ()
        return np.array([v.ravel() for v in values]) if values else np.empty((0, 1)), shape

    def _parameters(self, at: tuple[object, ...], named: dict[str, object]) -> list[Array]:
        """The values of the parameters; times are no coordinate here."""
        clock = self.metadata.time
        timed = [one for one in at if not isinstance(one, Mapping)]
        timed += [keys for keys in (*at, named) if isinstance(keys, Mapping) and clock in keys]
        if timed:
            raise EvaluationError(
                "the times of events depend on the parameters alone",
                term=timed[0],
                remedy="leave the time out",
            )
        start = {} if self.metadata.timeless else {clock: self.time[0]}
        gathered = self._coordinates.gather(at, {**start, **named})
        return self._coordinates.arrays(gathered)[1:]


def _places(met: Sequence[Sequence[str]], name: str) -> list[int]:
    """The borders of stretches at which an event occurs."""
    return [i for i, instant in enumerate(met, 1) if name in instant]


def _times_in_branches(
    evaluator: BranchEvaluator, timeline: BranchedTimeline, name: str, points: Array
) -> Array:
    """The times of an event (count, N) in the branches that hold at points (d, N)."""
    decision = evaluator.decided(points)
    places = [_places(branch.met, name) for branch in timeline.branches]
    times = np.full((max(map(len, places)), points.shape[1]), np.nan)
    for k, own in enumerate(places):
        timed = ~decision.undecided & ~decision.at_turn
        here = np.flatnonzero((decision.chosen == k) & timed)
        if own and here.size:
            times[: len(own), here] = evaluator.branches[k].borders(points[:, here])[own]
    return times
