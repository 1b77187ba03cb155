"""Evaluation of what a box is divided into: branches, and pieces that tile it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import AT_ONCE, COINCIDENT, MOST_NUMBERS, Array
from rankone.support.errors import OptionError, quote, warn
from rankone.tensors.decisions import LOOKS, Decider, Decision, GrazedEvent, clearance, looks
from rankone.tensors.evaluator import Rows, TrainEvaluator
from rankone.tensors.timeline_evaluator import ClockEvaluator, TimelineEvaluator


class BranchEvaluator(ClockEvaluator):
    """States at clock times, of the branch that holds at each point.

    Values are NaN, with a warning, where it is undecided which branch holds: where guards are
    within the width of the ``decider`` of their signs, and states of the branches differ by more
    than ``tolerances`` (n,).
    """

    def __init__(
        self,
        branches: Sequence[TimelineEvaluator],
        guards: Sequence[int],
        decider: Decider,
        tolerances: Sequence[float],
    ) -> None:
        self.branches, self.guards = tuple(branches), tuple(guards)
        self.decider, self.tolerances = decider, np.array(tolerances, dtype=float)
        self.width, self.horizon = decider.width, decider.horizon
        self.takes_likeliest = False

    def _row(self, branch: int, guard: int) -> int:
        """The row of a guard of a branch."""
        rows = len(self.branches[branch].slabs[0].cores[0])
        return rows - 2 - self.guards[branch] + guard

    def likeliest(self) -> BranchEvaluator:
        """One that takes the branch that is ahead also where that is undecided, without NaN."""
        other = copy(self)
        other.takes_likeliest = True
        return other

    def decided(self, points: Array) -> Decision:
        """The branches that hold at points (d, N)."""
        return self._decided_by(self.deciders(points))

    def held(self, points: Array) -> NDArray[np.intp]:
        """The branch that holds at points (d, N); -1 within a width of where another one does."""
        return self.decider.held(self.decided(points))

    def deciders(self, points: Array) -> Array:
        """Smooth functions (k, N) of points (d, N) that tell branches and stretches.

        They are the borders of all branches, as solved, the guards of the forks, and by how much
        branches miss events that are only grazed.
        """
        borders = [branch.borders_as_solved(points) for branch in self.branches]
        guards = [
            self._guard(fork.first, fork.guard, points)[None]
            for fork in self.decider.forks
            if fork.guard is not None
        ]
        clearances = [self._clearance(grazing, points)[None] for grazing in self.decider.grazings]
        return np.concatenate([*borders, *guards, *clearances])

    def _decided_by(self, deciders: Array) -> Decision:
        """The branches that hold by deciders (k, N)."""
        ends = np.cumsum([round(branch.slabs[-1].end) + 1 for branch in self.branches])
        *borders, others = np.split(deciders, ends)
        guards, clearances = np.split(others, [len(others) - len(self.decider.grazings)])
        return self.decider.decision(borders, guards, clearances)

    def _clearance(self, grazing: GrazedEvent, points: Array) -> Array:
        """How far a guard stays from a fall through zero on its stretch, at points (d, N)."""
        evaluator = self.branches[grazing.branch]
        row = self._row(grazing.branch, grazing.guard)
        heights = evaluator.on_stretches(looks(grazing)[:, None], points, np.array([row]))[0]
        return clearance(grazing, heights)

    def _guard(self, branch: int, guard: int, points: Array) -> Array:
        """A guard of a branch at points (d, N)."""
        rows, start = np.array([self._row(branch, guard)]), np.zeros((1, 1))
        return np.asarray(self.branches[branch].on_stretches(start, points, rows)[0, 0])

    def curves(self, times: Array, points: Array, rows: Rows) -> Array:
        states, doubtful = self.with_doubts(times, points, rows)
        _warn_of(doubtful)
        return states

    @property
    def numbers_each(self) -> int:
        borders = sum(branch.numbers_each for branch in self.branches)
        return borders + len(self.decider.forks) + LOOKS * len(self.decider.grazings)

    def count(self, rows: Rows) -> int:
        return self.branches[0].count(rows)

    def with_doubts(
        self, times: Array, points: Array, rows: Rows
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Curves, and where it is undecided which branch holds (T, N)."""
        shape = len(times), points.shape[1]
        states, doubtful = np.empty((self.count(rows), *shape)), np.zeros(shape, bool)
        for part, at, here in self.parts(times, points):
            states[part], doubtful[part[1:]] = self._with_doubts(at, here, rows)
        return states, doubtful

    def _with_doubts(
        self, times: Array, points: Array, rows: Rows
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Curves and doubts, all at once."""
        times = np.broadcast_to(times, (len(times), points.shape[1]))

        def states(k: int, here: NDArray[np.intp]) -> Array:
            return self.branches[k].curves(times[:, here], points[:, here], rows)

        return self._merged(self.decided(points), times.shape, rows, states)

    def smooth_pieces(self, times: Array, deciders: Array) -> NDArray[np.intp]:
        """Branch and stretch, as one number, of times (T, 1) or (T, N) by deciders (k, N): (T, N).

        Numbers below zero stand for no stretch.
        """
        times = np.broadcast_to(times, (len(times), deciders.shape[1]))
        decision = self._decided_by(deciders)
        pieces = np.full(times.shape, -1, dtype=np.intp)
        for k in np.unique(decision.chosen).tolist():
            here = np.flatnonzero(decision.chosen == k)
            borders = decision.borders[k][:, here]
            stretch, outside = self.branches[k].stretches(times[:, here], borders)
            pieces[:, here] = np.where(outside, -1, stretch * len(self.branches) + k)
        return pieces

    def borders(self, points: Array) -> Array:
        """Clock times (most stretches + 1, N) of the borders of the branch that holds at points.

        NaN behind the last one of a branch, and where none is decided.
        """
        decision = self.decided(points)
        most = max(round(branch.slabs[-1].end) for branch in self.branches)
        borders = np.full((most + 1, points.shape[1]), math.nan)
        for k in np.unique(decision.chosen).tolist():
            timed = ~decision.undecided & ~decision.at_turn
            here = np.flatnonzero((decision.chosen == k) & timed)
            if here.size:
                own = self.branches[k].borders(points[:, here])
                borders[: len(own), here] = own
        return borders

    def linearised(
        self, times: Array, points: Array, rows: Rows, free: Sequence[int]
    ) -> tuple[Array, Array]:
        """States (rows, T, N) at times (T, N), and derivatives (rows, T, N, k)."""
        decision = self.decided(points)
        count = len(self.branches[0].slabs[0].cores[0][rows])
        slopes = np.full((count, *times.shape, len(free)), math.nan)

        def states(k: int, here: NDArray[np.intp]) -> Array:
            at = times[:, here], points[:, here], rows, free
            here_states, here_slopes = self.branches[k].linearised(*at)
            mine = decision.chosen[here] == k
            slopes[:, :, here[mine]] = here_slopes[:, :, mine]
            return here_states

        merged, doubtful = self._merged(decision, times.shape, rows, states)
        slopes[:, doubtful] = math.nan
        _warn_of(doubtful)
        return merged, slopes

    def _merged(
        self,
        decision: Decision,
        shape: tuple[int, ...],
        rows: Rows,
        states: Callable[[int, NDArray[np.intp]], Array],
    ) -> tuple[Array, NDArray[np.bool_]]:
        """States (rows, T, N) of the branches that hold, and where these are doubtful (T, N).

        ``states`` gives those of a branch at some of the points.
        """
        merged, doubtful = self.decider.merged(decision, shape, self.tolerances[rows], states)
        if self.takes_likeliest:
            doubtful[:] = False
        merged[:, doubtful] = math.nan
        return merged, doubtful


class ContinuedBranch(TimelineEvaluator):
    """One branch over the whole box: where it does not hold, stretches may have negative lengths.

    Borders are in the order of the stretches, so that they are smooth. Roots of heights are
    coordinates behind the parameters.
    """

    def __init__(self, branches: BranchEvaluator, branch: int) -> None:
        own = branches.branches[branch]
        super().__init__(own.slabs, own.horizon, own.affine_borders)
        self._branches, self._branch = branches, branch
        self._opened = len(own.roots)

    def borders(self, points: Array) -> Array:
        return self.borders_as_solved(points)

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Where the branch holds at points (d, N), and not just about, whatever the roots are."""
        decision = self._branches.decided(points[: len(points) - self._opened])
        return np.asarray((decision.chosen == self._branch) & ~decision.undecided)


def _warn_of(doubtful: NDArray[np.bool_]) -> None:
    """Warn of values that are NaN since they are doubtful."""
    if doubtful.any():
        warn(
            "values are NaN where it is undecided in which order events come",
            remedy="`solution.branch(...)` is -1 there",
        )


# -----------------------------------------------------------------------------
# Boxes that tile a box, and evaluation of the piece that holds a point.


_EMPTY = -1  # The owner of a cell that no box covers


@dataclass(frozen=True, eq=False)
class Tiling:
    """Boxes without gaps and overlaps, on the grid of all of their edges.

    ``edges`` has the edges along each parameter, the ends included; ``owners`` (cells along
    parameter 1, cells along parameter 2, ...) the position of the box that covers each cell. An
    edge belongs to the box above it, the last one to the box below.
    """

    edges: tuple[Array, ...]
    owners: NDArray[np.intp]

    @classmethod
    def of(cls, boxes: Sequence[Sequence[tuple[float, float]]], names: Sequence[str]) -> Tiling:
        """The tiling of boxes, each an interval for each of the parameters ``names``.

        An OptionError that shows where two of them overlap, or where there is a gap.
        """
        bounds = np.array(boxes, dtype=float).reshape(len(boxes), len(names), 2)
        edges = tuple(_distinct(bounds[:, j].ravel()) for j in range(len(names)))
        sizes = [line.size - 1 for line in edges]
        if math.prod(sizes) > MOST_NUMBERS:
            raise OptionError(
                f"the pieces are cut at too many different places: {sizes} along the parameters",
                remedy="cut them at the same values, as problem.split does",
            )
        owners = np.full(sizes, _EMPTY, dtype=np.intp)
        for position, box in enumerate(bounds):
            pairs = zip(edges, box, strict=True)
            cells = tuple(slice(*_nearest(line, ends).tolist()) for line, ends in pairs)
            taken = np.argwhere(owners[cells] != _EMPTY)
            if len(taken):
                first = [s.start + int(k) for s, k in zip(cells, taken[0], strict=True)]
                other = int(owners[tuple(first)])
                shared = _where(names, _common(bounds[other], box))
                raise OptionError(
                    f"pieces {other} and {position} overlap where {shared}",
                    remedy="leave one of them out, or restrict it: piece.restrict(...)",
                )
            owners[cells] = position
        empty = np.argwhere(owners == _EMPTY)
        if len(empty):
            cell = [(line[k], line[k + 1]) for line, k in zip(edges, empty[0], strict=True)]
            more = f", the first of {len(empty)} gaps" if len(empty) > 1 else ""
            raise OptionError(
                f"no piece covers the box where {_where(names, cell)}{more}",
                remedy="solve that box too, or join fewer pieces",
            )
        return cls(edges, owners)

    @property
    def box(self) -> tuple[tuple[float, float], ...]:
        """The box that is tiled."""
        return tuple((float(line[0]), float(line[-1])) for line in self.edges)

    def owners_at(self, points: Array) -> NDArray[np.intp]:
        """The positions of the boxes that hold points (d, N)."""
        pairs = zip(self.edges, points, strict=True)
        cells = tuple(np.searchsorted(line[1:-1], row, side="right") for line, row in pairs)
        if not cells:
            return np.zeros(points.shape[1], dtype=np.intp)
        return np.asarray(self.owners[cells])

    def groups(self, points: Array) -> Iterator[tuple[int, NDArray[np.intp]]]:
        """The boxes that hold some of the points (d, N), and which points these are."""
        owners = self.owners_at(points)
        order = np.argsort(owners, kind="stable")
        present, starts = np.unique(owners[order], return_index=True)
        for position, here in zip(present, np.split(order, starts[1:]), strict=True):
            yield int(position), here

    def at(self, parameter: int, value: float) -> list[int]:
        """The positions of the boxes that hold a value of the parameter at a position."""
        cell = int(np.searchsorted(self.edges[parameter][1:-1], value, side="right"))
        return [int(position) for position in np.unique(self.owners.take(cell, axis=parameter))]

    def cells_of(self, position: int) -> tuple[NDArray[np.intp], ...]:
        """The cells along each parameter that a box covers."""
        inside = np.argwhere(self.owners == position)
        columns = inside.T if inside.size else np.zeros((self.owners.ndim, 0), dtype=np.intp)
        return tuple(np.unique(column) for column in columns)

    def box_of(self, position: int) -> list[tuple[float, float]]:
        """The intervals of a box."""
        pairs = zip(self.edges, self.cells_of(position), strict=True)
        return [(float(line[cells[0]]), float(line[cells[-1] + 1])) for line, cells in pairs]

    def on_axes(self, axes: Sequence[Array]) -> Iterator[tuple[int, tuple[NDArray[np.intp], ...]]]:
        """The boxes that hold some points of a grid, and which values of each axis these have."""
        pairs = zip(self.edges, axes, strict=True)
        cells = [np.searchsorted(line[1:-1], axis, side="right") for line, axis in pairs]
        for position in range(int(self.owners.max(initial=0)) + 1):
            own = zip(cells, self.cells_of(position), strict=True)
            here = tuple(np.flatnonzero(np.isin(along, inside)) for along, inside in own)
            if all(index.size for index in here):
                yield position, here


def _distinct(ends: Array) -> Array:
    """Ends in ascending order, those that differ by rounding once."""
    ascending = np.unique(ends)
    reach = COINCIDENT * (ascending[-1] - ascending[0])
    return np.asarray(ascending[np.diff(ascending, prepend=-np.inf) > reach])


def _nearest(line: Array, ends: Array) -> NDArray[np.intp]:
    """The positions in a line of the edges nearest to some ends."""
    after = np.clip(np.searchsorted(line, ends), 1, line.size - 1)
    return np.asarray(after - (ends - line[after - 1] < line[after] - ends))


def _common(one: Array, other: Array) -> Iterator[tuple[float, float]]:
    """The intervals (d, 2) that two boxes share."""
    for (a, b), (c, d) in zip(one, other, strict=True):
        yield max(a, c), min(b, d)


def _where(names: Sequence[str], box: Iterable[tuple[float, float]]) -> str:
    """A box as a user reads it."""
    pairs = zip(names, box, strict=True)
    return " and ".join(f"{quote(name)} is in [{a:.6g}, {b:.6g}]" for name, (a, b) in pairs)


# -----------------------------------------------------------------------------
# Evaluation of pieces that tile a box: each point belongs to one of them.


PieceOf = TrainEvaluator | TimelineEvaluator | BranchEvaluator
"""The evaluator of one piece."""


class PieceEvaluator(ClockEvaluator):
    """States at clock times, of the piece of a tiling that holds each point."""

    def __init__(self, pieces: Sequence[PieceOf], tiling: Tiling) -> None:
        self.pieces, self.tiling = tuple(pieces), tiling

    def likeliest(self) -> PieceEvaluator:
        """One whose branches take the one that is ahead also where that is undecided."""
        pieces = (p.likeliest() if isinstance(p, BranchEvaluator) else p for p in self.pieces)
        return PieceEvaluator(list(pieces), self.tiling)

    def one(self, point: Sequence[float], rows: Rows) -> Array:
        owner = self.tiling.owners_at(np.array(point[1:], dtype=float)[:, None])
        return self.pieces[int(owner[0])].one(point, rows)

    @property
    def numbers_each(self) -> int:
        pieces = (piece for piece in self.pieces if not isinstance(piece, TrainEvaluator))
        return max((piece.numbers_each for piece in pieces), default=0)

    def count(self, rows: Rows) -> int:
        return self.pieces[0].count(rows)

    def curves(self, times: Array, points: Array, rows: Rows) -> Array:
        states = np.empty((self.count(rows), len(times), points.shape[1]))
        for part, when, at in self.parts(times, points):
            for position, here in self.tiling.groups(at):
                own_times = when if when.shape[1] == 1 else when[:, here]
                own = self.pieces[position].curves(own_times, at[:, here], rows)
                states[part][:, :, here] = own
        return states

    def grid(self, axes: Sequence[Array], rows: Rows) -> Array:
        states = np.empty((self.count(rows), *(axis.size for axis in axes)))
        every = np.arange(len(states)), np.arange(axes[0].size)
        for position, here in self.tiling.on_axes(axes[1:]):
            for part in _parts(here, len(states) * axes[0].size):
                own_axes = [axes[0], *(axis[k] for axis, k in zip(axes[1:], part, strict=True))]
                states[np.ix_(*every, *part)] = self.pieces[position].grid(own_axes, rows)
        return states

    def deciders(self, points: Array) -> Array:
        """Functions (k, N) of points (d, N) that tell pieces, and branches and stretches of each.

        They are the points themselves, and then what decides in each piece, taken where it ends
        for points beyond.
        """
        return np.concatenate([points, *(self._own(k, points) for k in range(len(self.pieces)))])

    def smooth_pieces(self, times: Array, deciders: Array) -> NDArray[np.intp]:
        """Piece, branch and stretch, as one number, of times by deciders (k, N): (T, N).

        Numbers below zero stand for no stretch.
        """
        dimensions = len(self.tiling.edges)
        labels = np.zeros((len(times), deciders.shape[1]), dtype=np.intp)
        own = np.split(deciders[dimensions:], np.cumsum(self._counts)[:-1])
        for position, here in self.tiling.groups(deciders[:dimensions]):
            piece, stretch = self.pieces[position], labels[:, here]
            if not isinstance(piece, TrainEvaluator):
                at = times if times.shape[1] == 1 else times[:, here]
                stretch = piece.smooth_pieces(at, own[position][:, here])
            number = stretch * len(self.pieces) + position
            labels[:, here] = np.where(stretch < 0, stretch, number)
        return labels

    def _own(self, position: int, points: Array) -> Array:
        """What decides in one piece, (k, N); nothing without events."""
        piece = self.pieces[position]
        if isinstance(piece, TrainEvaluator):
            return np.empty((0, points.shape[1]))
        ends = np.array(self.tiling.box_of(position)).reshape(-1, 2)
        return piece.deciders(np.clip(points, ends[:, :1], ends[:, 1:]))

    @cached_property
    def _counts(self) -> list[int]:
        """How many functions decide in each piece."""
        start = np.array([line[:1] for line in self.tiling.edges]).reshape(-1, 1)
        return [len(self._own(k, start)) for k in range(len(self.pieces))]


def _parts(
    places: tuple[NDArray[np.intp], ...], numbers: int
) -> Iterator[tuple[NDArray[np.intp], ...]]:
    """Places on the axes of a grid in parts, cut along its longest axis.

    A point has so many numbers; those of a part are few unless the other axes have many points.
    """
    sizes = [place.size for place in places]
    if not sizes:
        yield ()
        return
    longest = int(np.argmax(sizes))
    count = min(math.ceil(numbers * math.prod(sizes) / AT_ONCE), sizes[longest])
    for cut in np.array_split(places[longest], max(count, 1)):
        yield (*places[:longest], cut, *places[longest + 1 :])
