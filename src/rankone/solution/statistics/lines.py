"""Averages over lines through the box, divided where the solution jumps.

Lines run through the cube in a direction of whole numbers, leave it through a face and enter it
again through the opposite one, until they close. The average over all of it is the average, over
points of a lattice, of the averages along the lines through them. Along a line the surfaces are
points: they are bisected, and between two of them Gauss's rule applies. The average along a line is
a continuous function of the line, for which lattices converge fast (Griewank, Kuo, Leövey & Sloan,
"High dimensional integration of kinks and jumps: smoothing by preintegration", Journal of
Computational and Applied Mathematics 344, 2018; a line along one axis alone misses the surfaces
that are parallel to it). Functions of one or two coordinates are integrated almost exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rankone.solution.statistics.solution_statistics import POINTS_AT_ONCE, quiet
from rankone.support.arrays import ROUNDING, Array
from rankone.support.budget import StepReport, check_time
from rankone.support.errors import warn
from rankone.tensors.branch_evaluator import BranchEvaluator, PieceEvaluator
from rankone.tensors.timeline_evaluator import TimelineEvaluator

Labels = Callable[[NDArray[np.intp], Array], NDArray[np.intp]]
"""Labels (M,) of the smooth pieces in which shares (M,) of segments (M,) lie."""

FIRST_LINES = 16
"""Lines before the first refinement."""
_SEGMENTS = 4  # Of a line at least, so that Gauss's rule resolves what is smooth
_SEGMENTS_OF_ONE = (8, 13)  # The same where there is one line alone, first and refined
_SAMPLES = np.linspace(0.0, 1.0, 13)  # Places on a segment at which labels are compared
_HALVINGS = 20  # Of the interval between two of them
_MOST_BREAKS = 4  # Most changes of labels in it
_MOST_STEPS = 4  # Largest component of a direction, which is the number of times a line wraps
_LATTICE = 49851  # Multiplier of the Korobov lattice, the best of 400 for 2 to 5 coordinates
_LATTICE_SIZE = 2**20
_GOLDEN_RATIO = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True)
class Pieces:
    """Pieces of ``segments`` (P,) of lines, and the shares of these where they begin and end."""

    segments: NDArray[np.intp]
    begins: Array
    ends: Array


@dataclass(frozen=True)
class Lines:
    """Closed lines through the unit cube, as straight segments.

    ``starts`` (D, S) and ``ends`` (D, S) are those of all segments, and ``lengths`` (S,) their
    shares of a line.
    """

    starts: Array
    ends: Array
    lengths: Array

    @classmethod
    def between(cls, first: int, last: int, dimensions: int, segments: int = _SEGMENTS) -> Lines:
        """The lines through the points of a lattice numbered from ``first`` up to ``last``.

        Each is cut at the faces of the cube, and at the ends of so many ``segments`` of one length.
        """
        steps = 1 + np.arange(dimensions) % _MOST_STEPS
        through = _lattice(first, last, dimensions)
        places = [np.full(last - first, k / segments) for k in range(1, segments + 1)]
        for y, step in zip(through, steps, strict=True):
            places += [(m - y) / step for m in range(1, step + 1)]
        breaks = np.sort(np.array(places), axis=0)
        begins, ends = breaks, np.concatenate([breaks[1:], breaks[:1] + 1.0])
        corner = np.floor(through[:, None] + steps[:, None, None] * (0.5 * (begins + ends)))
        coordinates = (
            through[:, None] + steps[:, None, None] * at - corner for at in (begins, ends)
        )
        lengths = (ends - begins).ravel()
        shape = dimensions, lengths.size
        starts, stops = (np.clip(at, 0.0, 1.0).reshape(shape) for at in coordinates)
        return cls(starts, stops, lengths)

    def at(self, segments: NDArray[np.intp], shares: Array) -> Array:
        """Points (D, M) at shares (M,) of the way along segments (M,)."""
        start = self.starts[:, segments]
        return start + shares * (self.ends[:, segments] - start)

    def pieces(self, labels: Labels) -> Pieces:
        """The pieces of segments on which labels are equal."""
        segments, breaks = self._breaks(labels)
        owners = np.concatenate([np.arange(self.lengths.size), segments])
        begins = np.concatenate([np.zeros(self.lengths.size), breaks])
        order = np.lexsort((begins, owners))
        owners, begins = owners[order], begins[order]
        ends = np.append(begins[1:], 1.0)
        ends[np.append(owners[1:] != owners[:-1], True)] = 1.0
        return Pieces(owners, begins, ends)

    def rule(self, pieces: Pieces, nodes: int) -> tuple[Array, Array]:
        """Gauss's points (D, M) and weights (M,) on pieces, with ``nodes`` on each."""
        places, weights = np.polynomial.legendre.leggauss(nodes)
        lengths = pieces.ends - pieces.begins
        shares = pieces.begins + 0.5 * (1.0 + places)[:, None] * lengths
        segments = np.broadcast_to(pieces.segments, shares.shape)
        points = self.at(segments.ravel(), shares.ravel())
        weights = 0.5 * weights[:, None] * (lengths * self.lengths[pieces.segments])
        return points, weights.ravel()

    def on_all(self, shares: Array) -> Array:
        """Points (D, len(shares) * S) at shares of the way along each segment."""
        return self.at(*_on_each(self.lengths.size, shares))

    def _breaks(self, labels: Labels) -> tuple[NDArray[np.intp], Array]:
        """Segments, and the shares of them, at which labels change."""
        sampled = labels(*_on_each(self.lengths.size, _SAMPLES)).reshape(_SAMPLES.size, -1)
        before, segments = np.nonzero(sampled[1:] != sampled[:-1])
        lower, end = _SAMPLES[before], _SAMPLES[before + 1]
        first, last = sampled[before, segments], sampled[before + 1, segments]
        owners, breaks = [segments[:0]], [lower[:0]]
        for _ in range(_MOST_BREAKS):
            if not segments.size:
                break
            upper = end
            for _ in range(_HALVINGS):
                middle = 0.5 * (lower + upper)
                same = labels(segments, middle) == first
                lower, upper = np.where(same, middle, lower), np.where(same, upper, middle)
            owners.append(segments)
            breaks.append(upper)
            behind = labels(segments, upper)
            more = behind != last
            segments, lower, first = segments[more], upper[more], behind[more]
            end, last = end[more], last[more]
        return np.concatenate(owners), np.concatenate(breaks)


def _on_each(count: int, shares: Array) -> tuple[NDArray[np.intp], Array]:
    """Segments (len(shares) * count,) and shares of all shares on all segments."""
    return np.tile(np.arange(count), shares.size), np.repeat(shares, count)


def refinements(dimensions: int, most: int, first: int = FIRST_LINES) -> Iterator[Lines]:
    """Lines whose averages are averaged one after the other: as many as before, up to ``most``."""
    if dimensions < 2:
        for segments in _SEGMENTS_OF_ONE:  # there is no other line
            yield Lines.between(0, 1, dimensions, segments)
        return
    count = first
    yield Lines.between(0, count, dimensions)
    while 2 * count <= most:
        yield Lines.between(count, 2 * count, dimensions)
        count *= 2


def _lattice(first: int, last: int, dimensions: int) -> Array:
    """Points (D, N) of a lattice by their numbers; the first coordinate, which no line needs, is 0.

    The first 2^m points are a lattice for every m.
    """
    numbers, inverse = np.arange(first, last), np.zeros(last - first, dtype=np.int64)
    size = _LATTICE_SIZE
    while numbers.any():  # digits in reverse order
        size //= 2
        inverse += size * (numbers % 2)
        numbers //= 2
    points = np.zeros((dimensions, last - first))
    factor = 1
    for j in range(1, dimensions):
        shift = j * _GOLDEN_RATIO  # so that no line meets an edge
        points[j] = ((inverse * factor) % _LATTICE_SIZE / _LATTICE_SIZE + shift) % 1.0
        factor = factor * _LATTICE % _LATTICE_SIZE
    return points


# -----------------------------------------------------------------------------
# Averages of states at a clock time over lines through the box, divided where states jump.


PointsOf = Callable[[Array], Array]
"""Parameters (d, M) of points (D, M) of a unit cube."""
Weighted = Callable[[Array, Array], tuple[Array, Array]]
"""A statistic, and the unit of its changes, of states (rows, M) with weights (M,) of sum one."""

_MOST_POINTS = 2**18  # Points of lines, each at one time: about 5 s
_POINTS_OF_LINE = 240  # About as many are on a line when the nodes have been found
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
    for start in range(0, count, POINTS_AT_ONCE):
        check_time()
        yield slice(start, start + POINTS_AT_ONCE)


def _interpolation(shares: Array) -> Array:
    """Weights (M, nodes) of values at nodes for polynomials at shares."""
    apart = shares[:, None] - _NODES
    apart = np.where(np.abs(apart) < ROUNDING, ROUNDING, apart)
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
