"""Boxes that tile a box, and evaluation of the piece that holds a point."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import quote
from rankone.tensors.evaluators.branch_evaluator import BranchEvaluator
from rankone.tensors.evaluators.evaluator import Rows, TrainEvaluator
from rankone.tensors.evaluators.timeline_evaluator import ClockEvaluator, TimelineEvaluator

# Distance, over the length of the whole interval, below which two edges are the same
_SAME_EDGE = 1e-12
# Cells of the grid of all edges, beyond which boxes are cut at too many different places
_MOST_CELLS = 10_000_000
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
        if math.prod(sizes) > _MOST_CELLS:
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
    reach = _SAME_EDGE * (ascending[-1] - ascending[0])
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


_VALUES = 1 << 22  # Numbers of one piece that are held at once beside all of them
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
    count = min(math.ceil(numbers * math.prod(sizes) / _VALUES), sizes[longest])
    for cut in np.array_split(places[longest], max(count, 1)):
        yield (*places[:longest], cut, *places[longest + 1 :])
