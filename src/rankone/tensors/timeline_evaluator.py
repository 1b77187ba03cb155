"""Evaluation over clock time of slabs over stretches."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import AT_ONCE, Array
from rankone.tensors.coordinates import round_off
from rankone.tensors.evaluator import AtTimes, Rows, TrainEvaluator
from rankone.tensors.slab import SlabTrain, slab_positions

Part = tuple[slice, slice, slice]
"""Some of the values (rows, T, N)."""


class ClockEvaluator(ABC):
    """States at clock times, with the methods of :class:`TrainEvaluator`."""

    @property
    @abstractmethod
    def numbers_each(self) -> int:
        """Numbers that decide at a point of the parameters which slabs hold."""

    @abstractmethod
    def count(self, rows: Rows) -> int:
        """How many states some rows are."""

    @abstractmethod
    def curves(self, times: Array, points: Array, rows: Rows) -> Array:
        """States at several times for each point of the parameters: shape (rows, T, N).

        ``times`` (T, N) belong to the ``points`` (d, N), or of the shape (T, 1) to all.
        """

    def parts(self, times: Array, points: Array) -> Iterator[tuple[Part, Array, Array]]:
        """Parts of the values (rows, T, N) that are evaluated at once, with times and points."""
        several, count = len(times), points.shape[1]
        columns = max(AT_ONCE // (min(several, AT_ONCE) + self.numbers_each), 1)
        for first in range(0, several, AT_ONCE):
            for begin in range(0, count, columns):
                when, here = slice(first, first + AT_ONCE), slice(begin, begin + columns)
                at = times[when] if times.shape[1] == 1 else times[when, here]
                yield (slice(None), when, here), at, points[:, here]

    def one(self, point: Sequence[float], rows: Rows) -> Array:
        """States at one point, 1 + d numbers: shape (rows,)."""
        return self.many(np.array(point, dtype=float)[:, None], rows)[:, 0]

    def many(self, points: Array, rows: Rows) -> Array:
        """States at paired points (1 + d, N): shape (rows, N)."""
        return self.curves(points[:1], points[1:], rows)[:, 0]

    def grid(self, axes: Sequence[Array], rows: Rows) -> Array:
        """States on a tensor grid of 1 + d axes: (rows, *sizes of the axes)."""
        times, sizes = np.asarray(axes[0])[:, None], [axis.size for axis in axes]
        states = np.empty((self.count(rows), sizes[0], math.prod(sizes[1:])))
        columns = max(AT_ONCE // max(sizes[0], 1), 1)
        for begin in range(0, states.shape[2], columns):
            here = slice(begin, min(begin + columns, states.shape[2]))
            places = np.unravel_index(np.arange(here.start, here.stop), sizes[1:] or 1)
            points = np.empty((len(sizes) - 1, here.stop - begin))
            for row, axis, place in zip(points, axes[1:], places, strict=False):
                row[:] = axis[place]
            states[:, :, here] = self.curves(times, points, rows)
        return states.reshape(len(states), *sizes)


# -----------------------------------------------------------------------------
# Evaluation over clock time of slabs over stretches: the stretch first, then its states.


@dataclass(frozen=True)
class HeightRoot:
    """The root of a height over a surface, from ``lower`` to ``upper``, as a coordinate of slabs.

    The height, relative to that of the start, is a ``row`` of another evaluator that is the same at
    all times.
    """

    evaluator: TimelineEvaluator
    row: int
    lower: float
    upper: float

    def height(self, points: Array) -> Array:
        """That at points (d, N), (N,)."""
        rows = np.array([self.row])
        return np.asarray(self.evaluator.on_stretches(np.zeros((1, 1)), points, rows)[0, 0])

    def __call__(self, points: Array) -> Array:
        """The roots at points (d, N), (N,), those nearest to the height."""
        root = np.sqrt(np.maximum(self.height(points), 0.0))
        return np.asarray(np.clip(root, self.lower, self.upper))

    def with_slopes(self, points: Array, free: Sequence[int]) -> Array:
        """The roots and their derivatives, (N, 1 + k)."""
        at = self.evaluator.row_with_slopes(self.row, points, free)
        root = np.sqrt(np.maximum(at[:, :1], 0.0))
        inside = (root > self.lower) & (root < self.upper)
        at[:, 1:] = np.where(inside, 0.5 * at[:, 1:] / np.where(inside, root, 1.0), 0.0)
        at[:, :1] = np.clip(root, self.lower, self.upper)
        return at


class TimelineEvaluator(ClockEvaluator):
    """States at clock times, of slabs over pseudo-time: stretch i is [i, i + 1].

    The last two of their states are the clock and the length of the stretch. ``affine_borders``
    maps borders, 0 for the start of the first stretch, to the constant and the slopes of their
    times, where these are known. Other borders are rounded, so that a time just before one counts
    as at it. Values are NaN where no stretch reaches. Slabs may have further ``roots`` as
    coordinates behind the parameters.
    """

    def __init__(
        self,
        slabs: Sequence[SlabTrain],
        horizon: tuple[float, float],
        affine_borders: Mapping[int, Sequence[float]],
        roots: Sequence[HeightRoot] = (),
    ) -> None:
        self.horizon, self.affine_borders, self.roots = horizon, affine_borders, tuple(roots)
        self.slabs, self.trains = tuple(slabs), TrainEvaluator(slabs)
        stretches = round(slabs[-1].end)
        self._clock = np.array([len(slabs[0].cores[0]) - 2], dtype=np.intp)
        # a stretch begins at the clock of its own slabs, and the last one ends before the end
        self._begins = np.arange(stretches, dtype=float)
        self._last = np.nextafter(float(stretches), 0.0)
        self._rounding = round_off(*horizon)
        self._early = np.full((stretches + 1, 1), self._rounding)  # before a border, yet at it
        self._early[list(affine_borders)] = 0.0

    def borders(self, points: Array) -> Array:
        """Clock times (stretches + 1, N) at which stretches begin and end at points (d, N)."""
        return np.asarray(np.maximum.accumulate(self.borders_as_solved(points), axis=0))

    def borders_as_solved(self, points: Array) -> Array:
        """The same, in the order of the stretches, in which they need not ascend."""
        return self._with_affine(self._clock_at_borders(self.own(points))[0], points)

    @cached_property
    def _clock_at_borders(self) -> AtTimes:
        """The clock at the borders of stretches."""
        return self.trains.at_times(np.append(self._begins, self._last), self._clock)

    def own(self, points: Array) -> Array:
        """Points (d, N) with the roots of heights behind them."""
        return np.stack([*points, *(root(points) for root in self.roots)]) if self.roots else points

    def on_stretches(self, pseudo: Array, points: Array, rows: Rows) -> Array:
        """States (rows, T, N) at pseudo-times (T, N) or (T, 1) and points (d, N)."""
        return self.trains.curves(pseudo, self.own(points), rows)

    def _with_affine(self, times: Array, points: Array) -> Array:
        """Times of borders (stretches + 1, N) by the slabs, the affine ones replaced."""
        for border, (constant, *slopes) in self.affine_borders.items():
            times[border] = constant
            for j in np.flatnonzero(slopes):
                times[border] += slopes[j] * points[j]
        return times

    @property
    def numbers_each(self) -> int:
        return len(self._begins) + 1

    def count(self, rows: Rows) -> int:
        return self.trains.count(rows)

    def curves(self, times: Array, points: Array, rows: Rows) -> Array:
        states = np.empty((self.count(rows), len(times), points.shape[1]))
        for part, at, here in self.parts(times, points):
            states[part] = self._curves(at, here, rows)
        return states

    def _curves(self, times: Array, points: Array, rows: Rows) -> Array:
        """The curves, all at once."""
        times = np.broadcast_to(times, (len(times), points.shape[1]))
        borders = self.borders_as_solved(points)
        pseudo, outside = self._pseudo_times(times, borders)
        states = self.on_stretches(pseudo, points, rows)
        states[:, outside] = math.nan
        return states

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Where the order of the stretches holds at points (d, N): everywhere."""
        return np.ones(points.shape[1], dtype=bool)

    def deciders(self, points: Array) -> Array:
        """Smooth functions (k, N) of points (d, N) that tell in which stretch a time is."""
        return self.borders_as_solved(points)

    def smooth_pieces(self, times: Array, deciders: Array) -> NDArray[np.intp]:
        """The stretches (T, N) of times (T, 1) or (T, N) by deciders (k, N), -1 for none."""
        times = np.broadcast_to(times, (len(times), deciders.shape[1]))
        stretch, outside = self.stretches(times, deciders)
        return np.where(outside, -1, stretch)

    def linearised(
        self, times: Array, points: Array, rows: Rows, free: Sequence[int]
    ) -> tuple[Array, Array]:
        """States (rows, T, N) at times (T, N), and derivatives (rows, T, N, k).

        They are with respect to some parameters at positions ``free``, ascending, at fixed clock
        time: events move with the parameters, and with them the pseudo-time.
        """
        width = 1 + len(free)
        table = np.empty((self.count(rows), *times.shape, width))
        ranks = sum(slab.cores[0].shape[2] for slab in self.slabs)
        columns = max(AT_ONCE // (width * (ranks + table[..., :1, 0].size)), 1)
        for begin in range(0, points.shape[1], columns):
            here = slice(begin, begin + columns)
            table[:, :, here] = self._linearised(times[:, here], points[:, here], rows, free)
        return table[..., 0], table[..., 1:]

    def _linearised(self, times: Array, points: Array, rows: Rows, free: Sequence[int]) -> Array:
        """States and their derivatives (rows, T, N, 1 + k), all at once."""
        count, width = points.shape[1], 1 + len(free)
        products: list[Array] = []
        roots = self._roots_with_slopes(points, free)
        for i, slab in enumerate(self.slabs):
            if i and slab.shares_parameters(self.slabs[i - 1]):
                products.append(products[-1])
            else:
                products.append(_with_slopes(slab, points, free, roots))
        borders = self._borders_with_slopes(products, points, free)
        pseudo, outside = self._pseudo_times(times, borders[..., 0])
        stretch = np.minimum(np.floor(pseudo), self._begins[-1]).astype(np.intp)
        column = np.broadcast_to(np.arange(count), times.shape)
        begin = borders[stretch, column]
        lengths = borders[stretch + 1, column] - begin
        share = (pseudo - stretch)[..., None]
        moved = -(begin[..., 1:] + share * lengths[..., 1:])
        moved /= np.where(lengths[..., :1] > 0.0, lengths[..., :1], np.inf)
        n = len(self.slabs[0].cores[0][rows])
        states = np.empty((n, *times.shape, width))
        owner = slab_positions(self.slabs, pseudo.ravel()).reshape(pseudo.shape)
        for k in np.unique(owner):
            here, slab = owner == k, self.slabs[k]
            at = products[k][:, column[here]]
            for_states = slab.with_first(slab.cores[0][rows])
            in_time = for_states.in_time(pseudo[here])
            slopes = np.einsum(
                "ner,re->ne", for_states.derivative().in_time(pseudo[here]), at[:, :, 0]
            )
            changes = np.einsum("ner,rek->nek", in_time, at)
            changes[..., 1:] += slopes[..., None] * moved[here]
            states[:, here] = changes
        states[:, outside] = math.nan
        return states

    def _roots_with_slopes(self, points: Array, free: Sequence[int]) -> list[Array]:
        """The roots of heights with their derivatives, (N, 1 + k) each."""
        return [root.with_slopes(points, free) for root in self.roots]

    def row_with_slopes(self, row: int, points: Array, free: Sequence[int]) -> Array:
        """A row that is the same at all times, with its derivatives, (N, 1 + k)."""
        slab = self.slabs[0]
        at = _with_slopes(slab, points, free, self._roots_with_slopes(points, free))
        core = slab.with_first(slab.cores[0][[row]])
        return np.tensordot(core.in_time(np.array([slab.start]))[0, 0], at, 1)

    def _borders_with_slopes(
        self, products: Sequence[Array], points: Array, free: Sequence[int]
    ) -> Array:
        """Clock times (stretches + 1, N) of borders, with their derivatives along a last axis."""
        pseudo = np.append(self._begins, self._last)
        owners = slab_positions(self.slabs, pseudo)
        borders = []
        for s, k in zip(pseudo, owners, strict=True):
            clock = self.slabs[k].with_first(self.slabs[k].cores[0][self._clock])
            borders.append(np.tensordot(clock.in_time(np.array([s]))[0, 0], products[k], 1))
        at = np.array(borders)
        at[:, :, 0] = self._with_affine(at[:, :, 0], points)
        for border, (_, *slopes) in self.affine_borders.items():
            at[border, :, 1:] = [slopes[j] if slopes else 0.0 for j in free]
        return at

    def _pseudo_times(self, times: Array, borders: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pseudo-times (T, N) of clock times, and which are in no stretch."""
        stretch, outside = self.stretches(times, borders)
        begin = np.take_along_axis(borders, stretch, axis=0)
        length = np.take_along_axis(borders, stretch + 1, axis=0) - begin
        share = (times - begin) / np.where(length > 0.0, length, 1.0)
        latest = np.minimum(np.nextafter(stretch + 1.0, 0.0), self._last)
        return np.clip(stretch + share, stretch, latest), outside

    def stretches(self, times: Array, borders: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Stretches (T, N) of clock times, by the clock times of borders, and which are in none."""
        # no stretch ends before it begins
        inner = np.maximum.accumulate(borders - self._early, axis=0)[1:-1]
        stretch = np.zeros(times.shape, dtype=np.intp)
        size = 1 << len(inner).bit_length() >> 1  # halved down to one: by bisection
        while size:
            tried = stretch + size
            inside = np.minimum(tried, len(inner)) - 1
            passed = times >= np.take_along_axis(inner, inside, axis=0)
            stretch = np.where((tried <= len(inner)) & passed, tried, stretch)
            size >>= 1
        return stretch, times > borders[-1] + self._rounding


def _with_slopes(
    slab: SlabTrain, points: Array, free: Sequence[int], roots: Sequence[Array]
) -> Array:
    """Products (r, N, 1 + k) of the parameters of a slab, and their derivatives by some of them.

    Behind the points (d, N) come ``roots``, with their derivatives by the same.
    """
    d, count, width = len(points), points.shape[1], 1 + len(free)
    points = np.stack([*points, *(root[:, 0] for root in roots)]) if roots else points
    every = [*free, *range(d, d + len(roots))]
    columns = slab.with_slopes(points, every).reshape(-1, count, 1 + len(every))
    # the value, then the derivatives in the order of the parameters
    products = np.concatenate([columns[:, :, :1], columns[:, :, :0:-1]], axis=2)
    for k, root in enumerate(roots, width):
        products[:, :, 1:width] += products[:, :, k : k + 1] * root[:, 1:]
    return products[:, :, :width]
