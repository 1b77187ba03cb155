"""Solved time slabs as tensor trains, and the coordinate of a parameter that needs fewest nodes.

The calculus at the end (smaller solutions, derivatives) is exact; slabs that share the cores of
their parameters go on sharing them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import DTypeLike, NDArray

from rankone.support.arrays import AT_ONCE, Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, Cost, product
from rankone.tensors import (
    IDENTITY,
    Basis1D,
    Logarithm,
    Reciprocal,
    Scale,
    legendre_derivative,
    legendre_values,
)
from rankone.tensors.time_grid import TimeGrid
from rankone.tensors.train import Train

# Operations of multiplying a core: once, and for each of its entries at a point
_CORE_COST = Cost(10 * CALL, 0.1)
_MODE_COST = 15  # Operations of evaluating a mode at a point


@dataclass(frozen=True)
class SlabTrain:
    """States on one time slab for every parameter of the box, as a tensor train.

    Core 0 has the shape (states, time modes, r_1): coefficients of the Legendre polynomials
    orthonormal on [start, end]. Core j >= 1 has the shape (r_j, modes, r_{j+1}): coefficients of
    the modes of ``bases[j - 1]``.
    """

    start: float
    end: float
    train: Train
    bases: tuple[Basis1D, ...]

    @property
    def cores(self) -> tuple[Array, ...]:
        return self.train.cores

    @property
    def ranks(self) -> tuple[int, ...]:
        """The ranks r_1, ..., r_d between the cores."""
        return self.train.ranks

    def __call__(self, times: Array, points: Array) -> Array:
        """Evaluate at paired times (M,) and parameter points (d, M): shape (states, M).

        The plain way, without any preparation;
        :class:`~rankone.tensors.evaluator.TrainEvaluator` serves many calls.
        """
        modes = self.time_modes(times)
        products = np.multiply(modes.T[:, None], self.over_parameters(points))
        core = self.cores[0]
        return np.asarray(core.reshape(len(core), -1) @ products.reshape(-1, times.size))

    def over_parameters(self, points: Array, precision: DTypeLike = float) -> Array:
        """Product of the cores of the parameters at points (d, M): shape (r_1, M).

        By numbers of a ``precision``: float, or np.float32 where few digits do.
        """
        charge(sum(_CORE_COST(points.shape[1] * core.size) for core in self.cores[1:]))
        charge(_MODE_COST * points.shape[1] * sum(core.shape[1] for core in self.cores[1:]))
        count = points.shape[1]
        widest = max((_entries(core) for core in self.cores[1:]), default=1)
        step = max(AT_ONCE // widest, 1)
        if count <= step:
            return self._over_parameters(points, precision)
        pieces = np.array_split(points, -(-count // step), axis=1)
        blocks = [self._over_parameters(piece, precision) for piece in pieces]
        return np.concatenate(blocks, axis=1)

    def _over_parameters(self, points: Array, precision: DTypeLike) -> Array:
        """The same at so few points that the products of modes and columns are held at once."""
        columns = np.ones((1, points.shape[1]), dtype=precision)
        for exact, basis, row in zip(
            reversed(self.cores[1:]), reversed(self.bases), reversed(points), strict=True
        ):
            core = exact.astype(precision, copy=False)
            left, size, right = core.shape
            modes = basis.modal_values(row).T.astype(precision, copy=False)
            if left < right:
                of_modes = (core.reshape(-1, right) @ columns).reshape(left, size, -1)
                columns = np.einsum("lnm,nm->lm", of_modes, modes)
            else:
                products = np.multiply(modes[:, None], columns).reshape(size * right, -1)
                columns = core.reshape(left, -1) @ products
        return columns

    def with_slopes(self, points: Array, free: Sequence[int]) -> Array:
        """Product of the cores of the parameters and its derivatives, (r_1, N * (1 + k)).

        For each point the value, then the derivatives from the last parameter to the first.
        """
        count = points.shape[1]
        step = max(AT_ONCE // max((len(c) * c.shape[2] for c in self.cores[1:]), default=1), 1)
        products = np.empty((self.ranks[0] if self.ranks else 1, count, 1 + len(free)))
        for begin in range(0, count, step):
            here = slice(begin, begin + step)
            products[:, here] = self._with_slopes(points[:, here], free).transpose(0, 2, 1)
        return products.reshape(len(products), -1)

    def _with_slopes(self, points: Array, free: Sequence[int]) -> Array:
        """The same in the shape (r_1, 1 + k, N): a core becomes a matrix for each point."""
        products = np.ones((1, 1, points.shape[1]))
        for j in reversed(range(len(self.bases))):
            basis, core = self.bases[j], self.cores[j + 1].swapaxes(1, 2)
            entries = core.reshape(-1, core.shape[2])
            at = (entries @ basis.modal_values(points[j]).T).reshape(*core.shape[:2], -1)
            columns = np.einsum("rsn,swn->rwn", at, products)
            if j in free:
                slopes = (entries @ basis.modal_slopes(points[j]).T).reshape(at.shape)
                along = np.einsum("rsn,sn->rn", slopes, products[:, 0])
                columns = np.concatenate([columns, along[:, None]], axis=1)
            products = columns
        return products

    def on_grid(self, times: Array, columns: Array, modes: Array | None = None) -> Array:
        """Evaluate at all times (T,) for columns of :meth:`over_parameters`: (states, M, T).

        ``modes`` are those of :meth:`time_modes`, if they are there already.
        """
        states, rank = len(self.cores[0]), len(columns)
        charge(50 * CALL + product(states * times.size, rank, columns.shape[1]))
        modes = self.time_modes(times) if modes is None else modes
        at_times = np.matmul(modes, self.cores[0]).reshape(-1, rank) @ columns
        return np.asarray(at_times.reshape(states, times.size, -1).swapaxes(1, 2))

    def in_time(self, times: Array) -> Array:
        """The first core at times (T,): (states, T, r_1)."""
        return np.asarray(np.matmul(self.time_modes(times), self.cores[0]))

    def with_first(self, first: Array) -> SlabTrain:
        """The same slab with another first core."""
        return replace(self, train=self.train.with_first(first))

    def derivative(self) -> SlabTrain:
        """The derivatives of the states with respect to time."""
        slopes = legendre_derivative(self.cores[0].shape[1]) * (2.0 / (self.end - self.start))
        return self.with_first(slopes @ self.cores[0])

    def shares_parameters(self, other: SlabTrain) -> bool:
        """Whether all but the first core are those of another slab, or equal to them."""
        pairs = zip(self.cores[1:], other.cores[1:], strict=True)
        same = all(one is two or np.array_equal(one, two) for one, two in pairs)
        return same and self.bases == other.bases

    def time_modes(self, times: Array) -> Array:
        """Modes of the first core at times (T,): (T, modes)."""
        return legendre_values(self._places(times), self.cores[0].shape[1])

    def _places(self, times: Array) -> Array:
        """Times on [-1, 1]."""
        return (2.0 * times - (self.start + self.end)) / (self.end - self.start)


def modes_in_time(slabs: Sequence[SlabTrain], times: Sequence[Array]) -> list[Array]:
    """For each slab :meth:`SlabTrain.time_modes` at as many times (T,) of its own, made at once."""
    count = max(slab.cores[0].shape[1] for slab in slabs)
    places = [slab._places(each) for slab, each in zip(slabs, times, strict=True)]
    modes = np.split(legendre_values(np.concatenate(places), count), len(slabs))
    return [each[:, : len(slab.cores[0][0])] for slab, each in zip(slabs, modes, strict=True)]


def _entries(core: Array) -> int:
    """Numbers that a core (left, modes, right) is multiplied by, or makes, at a point."""
    left, size, right = core.shape
    return int(size * min(left, right))


def sharing(slabs: Sequence[SlabTrain]) -> Iterator[list[SlabTrain]]:
    """Runs of consecutive slabs that share the cores of their parameters."""
    run = [slabs[0]]
    for slab in slabs[1:]:
        if not slab.shares_parameters(run[0]):
            yield run
            run = []
        run.append(slab)
    yield run


def slab_positions(slabs: Sequence[SlabTrain], times: Array) -> NDArray[np.intp]:
    """Position of the slab that holds each time (T,); an end belongs to the next slab."""
    return np.searchsorted([slab.start for slab in slabs[1:]], times, side="right")


def slab_trains(grid: TimeGrid, train: Train, bases: Sequence[Basis1D]) -> tuple[SlabTrain, ...]:
    """One train for each slab of a grid, from one whose core 0 holds states at its times.

    That core has the shape (states, T, r_1); the other cores hold modes.
    """
    slabs = []
    for k, (start, end) in enumerate(itertools.pairwise(grid.breaks)):
        first = grid.to_modal @ train.first[:, k * grid.count : (k + 1) * grid.count]
        slabs.append(SlabTrain(start, end, train.with_first(first), tuple(bases)))
    return tuple(slabs)


def at_one_time(slabs: Sequence[SlabTrain], time: float, horizon: tuple[float, float]) -> SlabTrain:
    """The states at one time as constants over a horizon."""
    times = np.array([time])
    slab = slabs[int(slab_positions(slabs, times)[0])]
    first = slab.in_time(times)
    return SlabTrain(*horizon, slab.train.with_first(first), slab.bases)


def differentiated(slabs: Sequence[SlabTrain], parameter: int) -> tuple[SlabTrain, ...]:
    """The derivatives of the states with respect to one parameter, by its position."""

    def change(core: Array, basis: Basis1D) -> tuple[Array, Basis1D]:
        derivative, finer = basis.derivative
        return derivative @ core, finer

    return _changed(slabs, parameter, change)


def restricted(
    slabs: Sequence[SlabTrain], parameter: int, interval: tuple[float, float]
) -> tuple[SlabTrain, ...]:
    """The states for a smaller interval of one parameter, or a larger one: constant beyond."""

    def change(core: Array, basis: Basis1D) -> tuple[Array, Basis1D]:
        other = basis.restricted(*interval)
        nodes = np.clip(other.nodes, basis.lower, basis.upper)
        at_nodes = np.sqrt(other.weights)[:, None] * basis.modal_values(nodes)
        return np.matmul(other.to_modal @ at_nodes, core), other

    return _changed(slabs, parameter, change)


def fixed(slabs: Sequence[SlabTrain], parameter: int, value: float) -> tuple[SlabTrain, ...]:
    """The states for one value of a parameter, which ceases to be a coordinate."""
    merged: dict[tuple[int, int], Array] = {}
    smaller = []
    for slab in slabs:
        before, core = slab.cores[parameter], slab.cores[parameter + 1]
        key = id(before), id(core)
        if key not in merged:
            modes = slab.bases[parameter].modal_values(np.array([value]))[0]
            merged[key] = before @ np.einsum("rms,m->rs", core, modes)
        cores = (*slab.cores[:parameter], merged[key], *slab.cores[parameter + 2 :])
        bases = (*slab.bases[:parameter], *slab.bases[parameter + 1 :])
        smaller.append(replace(slab, train=Train(cores), bases=bases))
    return tuple(smaller)


def _changed(
    slabs: Sequence[SlabTrain],
    parameter: int,
    change: Callable[[Array, Basis1D], tuple[Array, Basis1D]],
) -> tuple[SlabTrain, ...]:
    """Slabs with another core and basis of one parameter."""
    pairs: dict[tuple[int, Basis1D], tuple[Array, Basis1D]] = {}
    changed = []
    for slab in slabs:
        core, basis = slab.cores[parameter + 1], slab.bases[parameter]
        key = id(core), basis
        if key not in pairs:
            pairs[key] = change(core, basis)
        core, basis = pairs[key]
        cores = (*slab.cores[: parameter + 1], core, *slab.cores[parameter + 2 :])
        bases = (*slab.bases[:parameter], basis, *slab.bases[parameter + 1 :])
        changed.append(replace(slab, train=Train(cores), bases=bases))
    return tuple(changed)


# -----------------------------------------------------------------------------
# Which coordinate of a parameter needs the fewest nodes, read off columns on lines.
#
# On a line that its nodes resolve, columns at the nodes of another coordinate are interpolated,
# which costs nothing. Where they do not, the lines are drawn again at those nodes.


# Ratio of the ends of an interval up to which all coordinates are much the same: a parameter that
# may be half as large or half as large again is left as it is, whatever its ends are rounded to
_LEAST_RATIO = 3.001
# Error over the size of tails, or of the highest modes, that they may explain: modes are larger at
# corners of the box, at borders and on narrow fronts, than on average;
# tests/benchmarks/attempts.py shows what it costs
TAIL_RATIO = 30.0
# Nodes in another coordinate over nodes in the first, below which it is taken
_CLEAR_RATIO = 0.8
# Nodes of interpolated columns over those of the lines: highest modes are then those of the columns
_FINE_RATIO = 2
# Nodes predicted, over those of the lines, above which a single parameter is drawn again: with
# several parameters fewer nodes save more than lines cost
_REDRAWN_ALONE_RATIO = 2.0


@dataclass(frozen=True)
class LineColumns:
    """Columns (rank, lines, size) on lines of one parameter at the nodes of a basis."""

    basis: Basis1D
    columns: Array

    @cached_property
    def spectrum(self) -> Array:
        """Largest size of each mode of the columns on some line, (size,)."""
        scaled = self.columns * np.sqrt(self.basis.weights)
        return np.asarray(np.linalg.norm(scaled @ self.basis.to_modal.T, axis=0).max(axis=0))

    def at(self, basis: Basis1D) -> LineColumns:
        """The columns interpolated to the nodes of another basis."""
        modal = basis_values(self.basis, basis.nodes)
        charge(5 * CALL + product(self.columns.size // self.basis.size, *modal.shape))
        return LineColumns(basis, (self.columns * np.sqrt(self.basis.weights)) @ modal.T)

    def error(self, other: LineColumns) -> float:
        """Largest error of the columns interpolated to the nodes of others.

        Later columns may have more coefficients, which earlier ones lack because they are zero.
        """
        errors = np.array(other.columns)
        errors[: len(self.columns)] -= self.at(other.basis).columns[: len(errors)]
        return float(np.linalg.norm(errors, axis=0).max())


def basis_values(basis: Basis1D, points: Array) -> Array:
    """From scaled values on a basis to values at points (N,): shape (N, size)."""
    return basis.modal_values(points) @ basis.to_modal


Needed = Callable[[Array], int]
"""The number of nodes that a spectrum predicts."""
Redraw = Callable[[Sequence[tuple[int, Array]]], list[Array]]
"""Columns (rank, lines, N) at places (N,) of parameters, in pairs (parameter, places)."""


def best_coordinates(
    lines: Sequence[LineColumns], free: Sequence[bool], redraw: Redraw, needed: Needed, tol: float
) -> list[LineColumns]:
    """For each parameter the columns in the coordinate that needs the fewest nodes.

    Parameters that are not ``free`` keep theirs. ``tol`` is the size of tails that ``needed``
    leaves out.
    """
    best, again = list(lines), list[tuple[int, Basis1D]]()
    patience = _REDRAWN_ALONE_RATIO if len(lines) == 1 else 1.0
    counts = [needed(line.spectrum) for line in lines]
    for j, line in enumerate(lines):
        others = candidates(line.basis) if free[j] else ()
        if counts[j] <= line.basis.degree:
            fine = replace(line.basis, degree=_FINE_RATIO * line.basis.degree)
            best[j] = min(
                (line, *(line.at(replace(fine, scale=scale)) for scale in others)),
                key=lambda each: needed(each.spectrum) / (1.0 if each is line else _CLEAR_RATIO),
            )
        elif counts[j] > patience * line.basis.degree:
            again += [(j, replace(line.basis, scale=scale)) for scale in others]
    drawn = redraw([(j, basis.nodes) for j, basis in again]) if again else []
    for (j, basis), columns in zip(again, drawn, strict=True):
        other, first = LineColumns(basis, columns), lines[j]
        allowed = max(first.error(other), TAIL_RATIO * tol)
        fewer = needed(other.spectrum) <= _CLEAR_RATIO * needed(best[j].spectrum)
        if fewer and other.error(first) <= allowed:
            best[j] = other
    return best


def candidates(basis: Basis1D) -> tuple[Scale, ...]:
    """The other coordinates of an interval that may need fewer nodes."""
    smallest, largest = sorted((abs(basis.lower), abs(basis.upper)))
    if basis.lower <= 0.0 <= basis.upper or largest < _LEAST_RATIO * smallest:
        return ()
    scales = (IDENTITY, Logarithm(), Reciprocal())
    return tuple(
        scale for scale in scales if scale != basis.scale and scale.allows(basis.lower, basis.upper)
    )
