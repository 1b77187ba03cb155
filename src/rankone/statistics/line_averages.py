"""Averages of states at a clock time over lines through the box, divided where states jump."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rankone.statistics.closed_lines import FIRST_LINES, Lines, Pieces, refinements
from rankone.statistics.solution_statistics import quiet
from rankone.support.arrays import Array
from rankone.support.budget import check_time
from rankone.support.errors import warn
from rankone.support.progress import StepReport
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.pieces import PieceEvaluator
from rankone.tensors.timeline import TimelineEvaluator

PointsOf = Callable[[Array], Array]
"""Parameters (d, M) of points (D, M) of a unit cube."""
Weighted = Callable[[Array, Array], tuple[Array, Array]]
"""A statistic, and the unit of its changes, of states (rows, M) with weights (M,) of sum one."""

_MOST_POINTS = 2**18  # Points of lines, each at one time: about 5 s
_POINTS_OF_LINE = 240  # About as many are on a line when the nodes have been found
_POINTS_AT_ONCE = 2**14
# Chebyshev points of a segment, between which what decides about pieces is a polynomial
_NODES = 0.5 - 0.5 * np.cos(np.pi * (np.arange(9) + 0.5) / 9)
_BARYCENTRIC = np.sin(np.pi * (np.arange(9) + 0.5) / 9) * (-1.0) ** np.arange(9)
_LASTING = 0.25  # Share of a change that is expected of the next one
# Nodes of Gauss's rule on a smooth piece of a line: at first, and most of them
_FEWEST_NODES, _MOST_NODES = 4, 64


@dataclass(frozen=True)
class Accuracy:
    """When to stop: changes by twice as many lines are relative to the unit of a statistic."""

    settled: float
    """Change that is small enough."""
    warned: float
    """Change above which a user is told."""
    most_lines: int


MOMENTS = Accuracy(1e-4, 1e-3, 512)
"""Of means, relative to the standard deviation, and of variances, relative to themselves."""


@dataclass
class _Average:
    """A statistic at one time, from the states (rows, M) at the points of all lines so far.

    ``nodes`` is the number on each smooth piece that resolves it, and ``unresolved`` what twice as
    many would have changed.
    """

    of: Weighted
    states: list[Array] = field(default_factory=list)
    weights: list[Array] = field(default_factory=list)
    latest: Array | None = None
    changes: tuple[float, float] = (np.inf, np.inf)
    share: float = 1.0
    nodes: int = 0
    unresolved: float = 0.0

    @property
    def points(self) -> int:
        """Points so far."""
        return sum(each.size for each in self.weights)

    @property
    def change(self) -> float:
        """The latest change, or what the one before lets expect: one may vanish by chance."""
        return max(self.changes)

    @property
    def error(self) -> float:
        """About the error, in units of the statistic; zero before there is a second look."""
        change = self.changes[0] if np.isfinite(self.changes[0]) else 0.0
        return max(change, self.unresolved)

    def add(self, values: Callable[[int], tuple[Array, Array]], settled: float) -> None:
        """Take in states and weights on further lines, which ``values`` gives by nodes of a piece.

        The first lines tell how many nodes are needed.
        """
        if self.nodes:
            states, weights = values(self.nodes)
        else:
            states, weights = self._resolved(values, settled)
        self.states.append(states)
        self.weights.append(weights)

    def _resolved(
        self, values: Callable[[int], tuple[Array, Array]], settled: float
    ) -> tuple[Array, Array]:
        """States and weights by twice as many nodes as are enough."""
        before, _, _ = self._running(*values(_FEWEST_NODES))
        self.nodes = _FEWEST_NODES
        while True:
            states, weights = values(2 * self.nodes)
            now, unit, _ = self._running(states, weights)
            self.unresolved = _relative_change(now, before, unit)
            if self.unresolved <= settled or 2 * self.nodes == _MOST_NODES:
                return states, weights
            self.nodes, before = 2 * self.nodes, now

    def _running(self, states: Array, weights: Array) -> tuple[Array | None, Array, float]:
        """The statistic of those that still run, the unit of its changes, and their share."""
        runs = np.isfinite(states).all(axis=0)
        running = weights[runs]
        share = float(running.sum() / weights.sum())
        if not share:
            return None, np.zeros(0), share
        return *self.of(states[:, runs], running / running.sum()), share

    def refine(self) -> None:
        """The statistic from all lines, and what the latest ones changed."""
        everything = np.hstack(self.states), np.concatenate(self.weights)
        statistic, unit, self.share = self._running(*everything)
        if self.latest is not None and statistic is not None:
            change = _relative_change(statistic, self.latest, unit)
            self.changes = change, _LASTING * self.changes[0]
        self.latest = statistic


def _relative_change(now: Array | None, before: Array | None, unit: Array) -> float:
    """The largest change of a statistic in its units; zero where nothing runs."""
    if now is None or before is None:
        return 0.0
    apart = np.abs(now - before)
    ratios = np.divide(apart, unit, out=np.zeros_like(apart), where=unit > 0.0)
    return float(np.nan_to_num(ratios).max(initial=0.0))


@dataclass(frozen=True)
class LineAverages:
    """Averages of the states ``rows`` of an evaluator over clock time."""

    evaluator: TimelineEvaluator | BranchEvaluator | PieceEvaluator
    rows: NDArray[np.intp]
    report: StepReport = quiet

    def __call__(
        self,
        times: Array,
        dimensions: int,
        points_of: PointsOf,
        of: Weighted,
        accuracy: Accuracy,
    ) -> tuple[Array, Array]:
        """A statistic over a unit cube, (..., times), and the share (times,) that still runs.

        It is NaN where nothing runs. A warning says how accurate it is if it does not settle, or
        if settling would take too many points.
        """
        averages = [_Average(of) for _ in range(times.size)]
        fitting = min(max(_MOST_POINTS // (_POINTS_OF_LINE * max(times.size, 1)), 2), FIRST_LINES)
        first = 2 ** (fitting.bit_length() - 1)
        rounds = list(refinements(dimensions, accuracy.most_lines, first))
        for step, lines in enumerate(rounds):
            left = [k for k, each in enumerate(averages) if each.change > accuracy.settled]
            ours = [averages[k] for k in left]
            twice = sum(each.points for each in (*averages, *ours))
            if not left or (step > 1 and twice > _MOST_POINTS):
                break
            self._add(lines, times[left], points_of, ours, accuracy.settled)
            for each in ours:
                each.refine()
            self.report(step + 1, len(rounds))
        self.report(len(rounds), len(rounds))
        _warn_of_changes(max((each.error for each in averages), default=0.0), accuracy.warned)
        shape = of(np.zeros((self.rows.size, 1)), np.ones(1))[0].shape
        nothing = np.full(shape, np.nan)
        columns = [nothing if each.latest is None else each.latest for each in averages]
        table = np.stack(columns, axis=-1) if columns else np.empty((*shape, 0))
        return table, np.array([each.share for each in averages])

    def _add(
        self,
        lines: Lines,
        times: Array,
        points_of: PointsOf,
        averages: Sequence[_Average],
        settled: float,
    ) -> None:
        """Take the states at times (T,) at the points of lines into averages."""
        points = points_of(lines.on_all(_NODES))
        deciders = np.hstack(
            [self.evaluator.deciders(points[:, here]) for here in _blocks(points.shape[1])]
        )
        table = deciders.reshape(len(deciders), _NODES.size, -1)
        for time, average in zip(times, averages, strict=True):
            at = np.array([time])
            pieces = lines.pieces(lambda *places, at=at: self._pieces(at, table, *places))

            def values(nodes: int, at: Array = at, pieces: Pieces = pieces) -> tuple[Array, Array]:
                points, weights = lines.rule(pieces, nodes)
                return self._states(at, points_of(points)), weights

            average.add(values, settled)

    def _pieces(
        self, time: Array, table: Array, segments: NDArray[np.intp], shares: Array
    ) -> NDArray[np.intp]:
        """Labels (M,) of the smooth pieces in which shares of segments lie.

        ``table`` (deciders, nodes, S) has what decides.
        """
        deciders = np.einsum("fkm,mk->fm", table[:, :, segments], _interpolation(shares))
        return np.asarray(self.evaluator.smooth_pieces(time[:, None], deciders)[0])

    def _states(self, time: Array, points: Array) -> Array:
        """States (rows, M) at one time."""
        blocks = [
            self.evaluator.curves(time[:, None], points[:, here], self.rows)[:, 0]
            for here in _blocks(points.shape[1])
        ]
        return np.hstack(blocks)


def _blocks(count: int) -> Iterator[slice]:
    """Slices of points that are evaluated together."""
    for start in range(0, count, _POINTS_AT_ONCE):
        check_time()
        yield slice(start, start + _POINTS_AT_ONCE)


def _interpolation(shares: Array) -> Array:
    """Weights (M, nodes) of values at nodes for polynomials at shares."""
    apart = shares[:, None] - _NODES
    apart = np.where(np.abs(apart) < 1e-14, 1e-14, apart)
    weights = _BARYCENTRIC / apart
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _warn_of_changes(change: float, warned: float) -> None:
    """Warn of a statistic that does not settle."""
    if change > warned:
        warn(
            f"statistics have settled to {change:.1e} of the spread only: the solution jumps or "
            "swings over the parameters in many places",
            remedy="compare with a sample: solution(t=t, **solution.sample(10**5))",
        )
