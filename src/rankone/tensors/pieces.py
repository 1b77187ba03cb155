"""Evaluation of pieces that tile a box: each point belongs to one of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.evaluator import Rows, TrainEvaluator
from rankone.tensors.over_clock import ClockEvaluator
from rankone.tensors.tiling import Tiling
from rankone.tensors.timeline import TimelineEvaluator

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
