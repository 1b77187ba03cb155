"""Differences from full trajectories of fields that events reset or end.

As for other solutions, times next to a jump are left out: there values differ by the jump.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.branches import branch_evaluator
from rankone.solvers.outcome import Outcome
from rankone.solvers.tuning import CHECK
from rankone.support.arrays import Array
from rankone.tensors.branch_evaluator import BranchEvaluator
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.fields.field_crossings import Occurred
from rankone.trajectories.fields.field_system import FieldSystem
from rankone.trajectories.fields.field_trajectories import FieldTrajectory
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline

_MOST_LEFT_OUT = 0.5  # Of the horizon, next to jumps
Curve = Callable[[Array], Array]
"""Coefficients (R, T) at times (T,); NaN behind a terminal event."""


@dataclass(frozen=True, eq=False)
class FieldComparison:
    """How trajectories of a system of fields are compared, to a tolerance.

    What is within ``out`` of a jump is left out.
    """

    fields: FieldSystem
    out: float

    @classmethod
    def of(cls, fields: FieldSystem, rtol: float) -> FieldComparison:
        """The comparison at a tolerance, which is that of times over the horizon as well."""
        start, end = fields.horizon
        return cls(fields, rtol * (end - start))

    @property
    def beside(self) -> float:
        """The distance from jumps at which full trajectories are to be known; 0 without events."""
        return CHECK.event_distance * self.out if self.fields.events else 0.0

    def counted(self, trajectory: FieldTrajectory, *others: FieldTrajectory) -> NDArray[np.bool_]:
        """The times of a trajectory that count: away from its jumps, and from those of others.

        Where jumps are so many that most of the horizon would be left out, half of each stretch
        between them counts.
        """
        jumps = np.concatenate([each.jumps(self.fields) for each in (trajectory, *others)])
        if not jumps.size:
            return np.ones(trajectory.times.size, dtype=bool)
        borders = np.unique(np.concatenate([self.fields.horizon, jumps]))
        out = np.full(borders.size - 1, self.out)
        if np.minimum(np.diff(borders), 2.0 * self.out).sum() > _MOST_LEFT_OUT * np.ptp(borders):
            out = np.minimum(self.out, 0.25 * np.diff(borders))
        times = trajectory.times
        stretch = np.clip(np.searchsorted(borders, times, "right") - 1, 0, out.size - 1)
        after, before = times - borders[stretch], borders[stretch + 1] - times
        begins, ends = np.isin(borders[stretch], jumps), np.isin(borders[stretch + 1], jumps)
        near = (begins & (after < out[stretch])) | (ends & (before < out[stretch]))
        return np.asarray(~near)

    def goes_on(self, curve: Curve, trajectory: FieldTrajectory) -> bool:
        """Whether coefficients go on where the trajectory has ended."""
        beyond = trajectory.end + self.beside
        if beyond >= self.fields.horizon[1]:
            return False
        return bool(np.isfinite(curve(np.array([beyond]))).any())

    def difference(self, a: FieldTrajectory, b: FieldTrajectory, sizes: Array) -> float:
        """The largest difference of two trajectories at the same times, and of their events.

        Relative to sizes (unknowns,), and that of events to the horizon; 1 if these differ.
        """
        missed = self.time_error(a.occurred, b.occurred)
        count = min(a.times.size, b.times.size)
        here = self.counted(a, b)[:count]
        for x, y, size in zip(a.states, b.states, sizes, strict=True):
            gap = x.at(slice(0, count)) - y.at(slice(0, count))
            missed = max(missed, float(np.abs(gap[:, here]).max(initial=0.0) / size))
        return missed if math.isfinite(missed) else 1.0

    def time_error(self, own: Sequence[Occurred], exact: Sequence[Occurred]) -> float:
        """The largest difference of the times of events, over the horizon.

        Infinite where they are not the same events; those at the very end do not count.
        """
        start, end = self.fields.horizon
        worst = 0.0
        for k in range(len(self.fields.events)):
            ours, theirs = (
                sorted(each.time for each in some if each.event == k) for some in (own, exact)
            )
            ours, theirs = (
                times if len(ours) == len(theirs) else [x for x in times if x < end - self.out]
                for times in (ours, theirs)
            )
            if len(ours) != len(theirs):
                return math.inf
            worst = max([worst, *np.abs(np.subtract(ours, theirs)).tolist()])
        return worst / (end - start)


class CoefficientCurves:
    """Coefficients over clock time, and their events, of what was solved for them."""

    def __init__(self, outcome: Outcome, fields: FieldSystem, count: int) -> None:
        self._rows, self._timeline = slice(0, count), outcome.timeline
        self._names = [event.name for event in fields.events]
        self._end = fields.horizon[1]
        self._evaluator: TrainEvaluator | TimelineEvaluator | BranchEvaluator
        if self._timeline is None:
            self._evaluator = TrainEvaluator(outcome.slabs)
        elif isinstance(self._timeline, BranchedTimeline):
            self._evaluator = branch_evaluator(outcome.slabs, self._timeline)
        else:
            timeline = self._timeline
            self._evaluator = TimelineEvaluator(
                outcome.slabs, timeline.horizon, timeline.affine_borders
            )

    def at(self, point: Array) -> Curve:
        """The coefficients at a point (d,), as a function of times."""
        columns = point[:, None]

        def curve(times: Array) -> Array:
            states = self._evaluator.curves(times[:, None], columns, self._rows)
            return np.asarray(states[:, :, 0])

        return curve

    def time_error(self, comparison: FieldComparison, trajectory: FieldTrajectory) -> float:
        """The error of times of events at the point of a full trajectory, over the horizon."""
        return comparison.time_error(self.occurred(trajectory.point), trajectory.occurred)

    def occurred(self, point: Array) -> list[Occurred]:
        """The events at a point (d,), up to the end of the horizon."""
        if self._timeline is None or isinstance(self._evaluator, TrainEvaluator):
            return []
        timeline = self._timeline
        if isinstance(timeline, BranchedTimeline):
            assert isinstance(self._evaluator, BranchEvaluator)
            held = int(self._evaluator.held(point[:, None])[0])
            if held < 0:
                return []
            timeline = timeline.branches[held]
        borders = self._evaluator.borders(point[:, None])[1:, 0]
        return list(self._listed(timeline, borders))

    def _listed(self, timeline: Timeline, borders: Array) -> list[Occurred]:
        """The events of a timeline whose stretches end at borders (stretches,)."""
        return [
            Occurred(self._names.index(name), time)
            for instant, time in zip(timeline.met, borders.tolist(), strict=False)
            for name in instant
            if name in self._names and time <= self._end
        ]
