"""Evaluation of pieces that tile a box: each point belongs to one of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.evaluator import Rows, TrainEvaluator
from rankone.tensors.over_clock import ClockEvaluator
from rankone.tensors.tiling import Tiling
from rankone.tensors.timeline import TimelineEvaluator

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

    def curves(self, times: Array, points: Array, rows: Rows) -> Array:
        shared = times.shape[1] == 1
        states = np.empty((0, len(times), points.shape[1]))
        if not points.shape[1]:
            return self.pieces[0].curves(times, points, rows)
        for position, here in self.tiling.groups(points):
            at = times if shared else times[:, here]
            own = self.pieces[position].curves(at, points[:, here], rows)
            if not len(states):
                states = np.empty((len(own), len(times), points.shape[1]))
            states[:, :, here] = own
        return states

    def grid(self, axes: Sequence[Array], rows: Rows) -> Array:
        states = np.empty((0, *(axis.size for axis in axes)))
        for position, here in self.tiling.on_axes(axes[1:]):
            own_axes = [axes[0], *(axis[k] for axis, k in zip(axes[1:], here, strict=True))]
            own = self.pieces[position].grid(own_axes, rows)
            if not len(states):
                states = np.empty((len(own), *states.shape[1:]))
            every = np.arange(len(own)), np.arange(axes[0].size)
            states[np.ix_(*every, *here)] = own
        if not len(states):  # an axis without values
            return self.pieces[0].grid(axes, rows)
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
