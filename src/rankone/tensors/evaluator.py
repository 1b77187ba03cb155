"""Evaluation of tensor trains at many points, at one point, along curves and on grids.

The cores are rearranged once: on every element of a dimension the polynomials become Chebyshev
polynomials, whose values at all points come from few vectorised products, and every core becomes
one matrix per element. Evaluation then goes from the last dimension to the first; each step
multiplies the values of the polynomials with the contraction so far (a column-wise Kronecker
product) and the core with the result, one matrix product for all points of a chunk.

Time is the first dimension and comes last, so that the product of the cores of the parameters at a
point serves all times there. Slabs that share these cores are one train.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import AT_ONCE, Array
from rankone.tensors import IDENTITY, Basis1D, LegendreBasis
from rankone.tensors.slab import SlabTrain, sharing

Rows = slice | NDArray[np.intp]

_POINTS = 1024  # Points taken at once at most
_TIMES = 256  # Times taken at once at least, where one product serves many


def chebyshev_polynomials(xi: Array, count: int) -> Array:
    """Values T_0 ... T_{count-1} at points (N,) of [-1, 1], shape (count, N).

    By ``T_{k+i} = 2 T_k T_i - T_{k-i}``, which doubles the number of known rows in three
    vectorised operations (DLMF 18.18.21).
    """
    rows = np.empty((count, xi.size))
    rows[0] = 1.0
    if count > 1:
        rows[1] = xi
    done = 1
    while done < count - 1:
        extra = min(done, count - 1 - done)
        block = rows[done + 1 : done + 1 + extra]
        np.multiply(rows[1 : 1 + extra], 2.0 * rows[done], out=block)
        block -= rows[done - extra : done][::-1]
        done += extra
    return rows


def _to_chebyshev(basis: Basis1D) -> Array:
    """Map coefficients of one element's modes to Chebyshev coefficients, (degree, degree).

    Mode k has no part above degree k: exact zeros there keep high modes zero that are zero.
    """
    count = basis.degree
    angles = np.pi * (np.arange(count) + 0.5) / count
    one = replace(basis, lower=-1.0, upper=1.0, elements=1, breaks=(), scale=IDENTITY)
    modes = one.modal_values(np.cos(angles))
    transform = np.cos(np.arange(count)[:, None] * angles) * (2.0 / count)
    transform[0] *= 0.5
    return np.triu(transform @ modes * np.sqrt(basis.elements))


class _Dimension:
    """One core of one slab: for each element a matrix (left, degree * right).

    Edges, lower end and elements per unit are those in the coordinate of the scale.
    """

    def __init__(self, core: Array, basis: Basis1D) -> None:
        self.left, _, self.right = core.shape
        self.degree, self.elements = basis.degree, basis.elements
        self.coordinate = basis.scale
        self.scaled = not basis.scale.is_identity
        edges = basis.scaled_edges.tolist()
        self.edges: tuple[float, ...] = (*edges,) if basis.breaks else ()
        self.lower: float = edges[0]
        self.scale = basis.elements / (edges[-1] - edges[0])
        split = core.reshape(self.left, self.elements, self.degree, self.right)
        tensor = np.matmul(_to_chebyshev(basis), split).transpose(1, 0, 2, 3)
        self.tensor = np.ascontiguousarray(tensor)
        self.matrices = [m.reshape(self.left, -1) for m in self.tensor]

    def locate(self, points: Array) -> tuple[Array, NDArray[np.intp] | None]:
        """Local coordinates in [-1, 1] of points (N,), and their elements if there are several."""
        if self.scaled:
            points = self.coordinate.to_scale(points)
        position = (points - self.lower) * self.scale
        if self.elements == 1:
            return 2.0 * position - 1.0, None
        element = np.clip(position.astype(np.intp), 0, self.elements - 1)
        return 2.0 * (position - element) - 1.0, element

    def locate_one(self, point: float) -> tuple[float, int]:
        """Local coordinate and element of one point."""
        if self.scaled:
            point = float(self.coordinate.to_scale(np.array(point)))
        position = (point - self.lower) * self.scale
        element = max(0, min(int(position), self.elements - 1)) if self.elements > 1 else 0
        return 2.0 * (position - element) - 1.0, element

    def contract(self, points: Array, contraction: Array | None, rows: Rows | None = None) -> Array:
        """Multiply the core, at points (N,), with the contraction (right, N): shape (left, N)."""
        xi, element = self.locate(points)
        polynomials = chebyshev_polynomials(xi, self.degree)
        groups = _by_element(element)
        if len(groups) == 1:
            return self._applied(groups[0][0], polynomials, contraction, rows)
        contracted = np.empty((self.left if rows is None else self.count(rows), xi.size))
        for e, here in groups:
            columns = None if contraction is None else _columns(contraction, here)
            contracted[:, here] = self._applied(e, _columns(polynomials, here), columns, rows)
        return contracted

    def _applied(
        self, e: int, polynomials: Array, contraction: Array | None, rows: Rows | None
    ) -> Array:
        """An element's matrix, or some of its rows, times the products of both: (left, N).

        The contraction comes first where that leaves fewer numbers.
        """
        tensor = self.tensor[e] if rows is None else self.tensor[e, rows]
        left = len(tensor)
        if contraction is None or left >= self.right:
            products = _columnwise_kronecker(polynomials, contraction)
            return np.asarray(tensor.reshape(left, -1) @ products)
        products = tensor.reshape(-1, self.right) @ contraction
        products = products.reshape(left, self.degree, -1)
        return np.asarray(np.einsum("lnN,nN->lN", products, polynomials))

    def count(self, rows: Rows) -> int:
        """How many rows some are."""
        return len(self.matrices[0][rows])

    def spread(self, points: Array, contraction: Array, of: NDArray[np.intp], rows: Rows) -> Array:
        """Multiply the core, at points (N,), with the columns ``of`` the contraction (right, M).

        The columns (N,) repeat, so that these products come first. The shape is (left, N).
        """
        xi, element = self.locate(points)
        polynomials = chebyshev_polynomials(xi, self.degree)
        contracted = np.empty((self.count(rows), xi.size))
        for e, here in _by_element(element):
            columns = of[here]
            first, last = columns.min(), columns.max()
            products = self.tensor[e, rows] @ contraction[:, first : last + 1]
            contracted[:, here] = np.einsum(
                "lnN,nN->lN", products.take(columns - first, 2), polynomials[:, here]
            )
        return contracted

    def outer(self, points: Array, contraction: Array, rows: Rows | None = None) -> Array:
        """Multiply the core, at points (N,), with all columns (right, M): shape (left, N, M)."""
        xi, element = self.locate(points)
        polynomials = chebyshev_polynomials(xi, self.degree).T
        tensor = self.tensor if rows is None else self.tensor[:, rows]
        groups = _by_element(element)
        if len(groups) == 1:
            return _multiplied(polynomials, tensor[groups[0][0]], contraction)
        contracted = np.empty((tensor.shape[1], xi.size, contraction.shape[1]))
        for e, here in groups:
            contracted[:, here] = _multiplied(polynomials[here], tensor[e], contraction)
        return contracted


class _UnequalDimension(_Dimension):
    """One core whose elements are unequal: between two of them the later one counts."""

    def __init__(self, core: Array, basis: Basis1D) -> None:
        super().__init__(core, basis)
        edges = basis.scaled_edges
        self.breaks = edges[1:-1].tolist()
        self.lowers, self.scales = edges[:-1], 1.0 / np.diff(edges)

    def locate(self, points: Array) -> tuple[Array, NDArray[np.intp] | None]:
        if self.scaled:
            points = self.coordinate.to_scale(points)
        element = np.searchsorted(self.breaks, points, side="right")
        position = (points - self.lowers[element]) * self.scales[element]
        return 2.0 * position - 1.0, element

    def locate_one(self, point: float) -> tuple[float, int]:
        if self.scaled:
            point = float(self.coordinate.to_scale(np.array(point)))
        element = bisect_right(self.breaks, point)
        position = (point - self.lowers[element]) * self.scales[element]
        return 2.0 * position - 1.0, element


def _by_element(element: NDArray[np.intp] | None) -> list[tuple[int, Rows]]:
    """The elements that have points, and which points these are; at least one element."""
    counts = np.zeros(0, dtype=np.intp) if element is None else np.bincount(element)
    occupied = np.flatnonzero(counts).tolist()
    if element is None or len(occupied) < 2:
        return [(occupied[0] if occupied else 0, slice(None))]
    ends = np.cumsum(counts).tolist()
    groups = [slice(ends[e] - int(counts[e]), ends[e]) for e in occupied]
    if (element[1:] >= element[:-1]).all():
        return [*zip(occupied, groups, strict=True)]
    order = _stable_order(element, counts.size)
    return [(e, order[here]) for e, here in zip(occupied, groups, strict=True)]


def _stable_order(integers: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """The order of integers below a count; equal ones stay in theirs."""
    # the stable sort of 16-bit integers is a radix sort
    return np.argsort(integers.astype(np.min_scalar_type(count)), kind="stable")


def _columns(array: Array, here: Rows) -> Array:
    """Some columns of an array."""
    return array[:, here] if isinstance(here, slice) else array.take(here, 1)


def _multiplied(polynomials: Array, core: Array, contraction: Array) -> Array:
    """Values (N, n) by a core (left, n, right) by a contraction (right, M): shape (left, N, M)."""
    (count, degree), (right, columns) = polynomials.shape, contraction.shape
    if right * count * (degree + columns) < degree * columns * (right + count):
        return np.asarray((polynomials @ core) @ contraction)
    return np.asarray(polynomials @ (core @ contraction))


def _columnwise_kronecker(polynomials: Array, contraction: Array | None) -> Array:
    """Kronecker products of the columns of (n, N) and (r, N): shape (n * r, N)."""
    if contraction is None:
        return polynomials
    return np.multiply(polynomials[:, None], contraction).reshape(-1, polynomials.shape[1])


class _Train:
    """Slabs that share the cores of their parameters, as elements of the first core."""

    def __init__(self, slabs: Sequence[SlabTrain]) -> None:
        starts = tuple(slab.start for slab in slabs)
        first = np.concatenate([slab.cores[0] for slab in slabs], axis=1)
        first /= np.sqrt(len(slabs))  # orthonormal on all elements, not on each
        degree = slabs[0].cores[0].shape[1]
        time = LegendreBasis(starts[0], slabs[-1].end, degree, breaks=starts[1:])
        cores, bases = (first, *slabs[0].cores[1:]), (time, *slabs[0].bases)
        self.dimensions = tuple(
            (_UnequalDimension if basis.breaks else _Dimension)(core, basis)
            for core, basis in zip(cores, bases, strict=True)
        )
        self.time = self.dimensions[0]
        self.widest = max(dimension.degree * dimension.right for dimension in self.dimensions)
        self.chunk = min(max(AT_ONCE // self.widest, 64), _POINTS)
        self.degree = max(dimension.degree for dimension in self.dimensions)

    def over_parameters(self, points: Array) -> Array:
        """Product of the cores of the parameters at points (d, N): shape (right of time, N)."""
        contraction = None
        for dimension, coordinates in zip(self.dimensions[:0:-1], points[::-1], strict=True):
            contraction = dimension.contract(coordinates, contraction)
        return np.ones((1, points.shape[1])) if contraction is None else contraction

    def over_grid(self, axes: Sequence[Array]) -> Array:
        """The same on the tensor grid of d axes, flattened."""
        contraction = np.ones((1, 1))
        for dimension, axis in zip(self.dimensions[:0:-1], axes[::-1], strict=True):
            contraction = dimension.outer(axis, contraction).reshape(dimension.left, -1)
        return contraction

    def one(self, point: Sequence[float], rows: Rows) -> Array:
        """Values at one point, given as 1 + d numbers: shape (rows,)."""
        pairs = zip(self.dimensions, point, strict=True)
        located = [dimension.locate_one(coordinate) for dimension, coordinate in pairs]
        table = chebyshev_polynomials(np.array([xi for xi, _ in located]), self.degree).T
        contraction: Array | None = None
        for k in range(len(self.dimensions) - 1, -1, -1):
            dimension = self.dimensions[k]
            polynomials = table[k, : dimension.degree]
            matrix = dimension.matrices[located[k][1]]
            if k == 0:
                matrix = matrix[rows]
            if contraction is not None:
                polynomials = np.multiply.outer(polynomials, contraction).ravel()
            contraction = matrix @ polynomials
        assert contraction is not None
        return contraction


def _runs(slabs: Sequence[SlabTrain]) -> Iterator[list[SlabTrain]]:
    """Slabs after each other that differ in the first core alone, not in its shape."""
    for run in sharing(slabs):
        for _, group in groupby(run, key=lambda slab: slab.cores[0].shape):
            yield [*group]


def _chunks(positions: NDArray[np.intp], size: int) -> Iterator[NDArray[np.intp]]:
    """Positions (N,) in parts of bounded size."""
    for begin in range(0, positions.size, size):
        yield positions[begin : begin + size]


def _parts(axes: Sequence[Array], most: int) -> Iterator[tuple[int, Sequence[Array]]]:
    """Parts of a tensor grid of about so many points, and where they begin in it, flattened."""
    sizes = [axis.size for axis in axes]
    several = next((k for k, size in enumerate(sizes) if size > 1), 0)
    if math.prod(sizes) <= most:
        yield 0, axes
        return
    after = math.prod(sizes[several + 1 :])
    step = max(most // after, 1)
    for begin in range(0, sizes[several], step):
        part = [*axes[:several], axes[several][begin : begin + step], *axes[several + 1 :]]
        yield begin * after, part


@dataclass(frozen=True)
class AtTimes:
    """Trains at fixed times: for each train its times, and the matrix of its first core there.

    The ``shape`` is (rows, T).
    """

    shape: tuple[int, int]
    matrices: Sequence[tuple[_Train, NDArray[np.intp], Array]]

    def __call__(self, points: Array) -> Array:
        """States (rows, T, N) at points (d, N)."""
        states = np.empty((*self.shape, points.shape[1]))
        for train, owned, matrix in self.matrices:
            for here in _chunks(np.arange(points.shape[1]), train.chunk):
                values = matrix @ train.over_parameters(points[:, here])
                states[:, owned[:, None], here] = values.reshape(len(states), owned.size, -1)
        return states


class TrainEvaluator:
    """Tensor trains on consecutive time slabs, arranged for fast evaluation.

    Nothing is checked here: points outside the box or the horizon are extrapolated.
    """

    def __init__(self, slabs: Sequence[SlabTrain]) -> None:
        self.trains = tuple(_Train(run) for run in _runs(slabs))
        self._slab_breaks = np.array([slab.start for slab in slabs[1:]])
        self._breaks = np.array([train.dimensions[0].lower for train in self.trains[1:]])

    def one(self, point: Sequence[float], rows: Rows) -> Array:
        """Evaluate at one point, 1 + d numbers: shape (rows,); much less overhead than `many`."""
        several = len(self.trains) > 1
        owner = int(self._breaks.searchsorted(point[0], side="right")) if several else 0
        return self.trains[owner].one(point, rows)

    def many(self, points: Array, rows: Rows) -> Array:
        """Evaluate at paired points (1 + d, N), in chunks of bounded memory: shape (rows, N)."""
        states = np.empty((self.count(rows), points.shape[1]))
        # points in the order of the slabs: those of a chunk have few slabs
        for train, owned in self._owned(points[0], self._slab_breaks):
            for here in _chunks(owned, train.chunk):
                chunk = points.take(here, 1)
                contraction = train.over_parameters(chunk[1:])
                states[:, here] = train.time.contract(chunk[0], contraction, rows)
        return states

    def curves(self, times: Array, points: Array, rows: Rows) -> Array:
        """Evaluate at several times for each point of the parameters: shape (rows, T, N).

        ``times`` (T, N) belong to the ``points`` (d, N), or of the shape (T, 1) to all. The cores
        of the parameters are multiplied once for each point.
        """
        several, count = len(times), points.shape[1]
        if times.shape[1] == 1:

            def contractions(train: _Train) -> Iterator[tuple[int, Array]]:
                for begin in range(0, count, train.chunk):
                    yield begin, train.over_parameters(points[:, begin : begin + train.chunk])

            return self._at_all(times[:, 0], count, contractions, rows)
        if several == 1:
            return self.many(np.concatenate([times, points]), rows)[:, None]
        alike = (times == times[:, :1]).all(axis=1)
        if count and alike.any():
            states = np.empty((self.count(rows), several, count))
            states[:, alike] = self.curves(times[alike, :1], points, rows)
            if not alike.all():
                states[:, ~alike] = self.curves(times[~alike], points, rows)
            return states
        states = np.empty((self.count(rows), count, several))
        for begin in range(0, count, _POINTS):
            columns = slice(begin, begin + _POINTS)
            block = self._paired_curves(times[:, columns], points[:, columns], rows)
            states[:, columns] = block
        return states.swapaxes(1, 2)

    def at_times(self, times: Array, rows: Rows) -> AtTimes:
        """What evaluates at the same times (T,) for any points (d, N): the cores of time there."""
        matrices = list[tuple[_Train, NDArray[np.intp], Array]]()
        for train, owned in self._owned(times, self._breaks):
            matrix = train.time.outer(times[owned], np.eye(train.time.right), rows)
            matrices.append((train, owned, matrix.reshape(-1, train.time.right)))
        return AtTimes((self.count(rows), times.size), matrices)

    def _paired_curves(self, times: Array, points: Array, rows: Rows) -> Array:
        """The same at times (T, N) of their own for some points: shape (rows, N, T)."""
        several, count = times.shape
        paired = times.T.ravel()
        states = np.empty((self.count(rows), paired.size))
        for train, owned in self._owned(paired, self._slab_breaks):
            column = owned // several
            present = np.zeros(count, dtype=bool)
            present[column] = True
            of, chosen = (np.cumsum(present) - 1)[column], points[:, present]
            contraction = np.concatenate(
                [
                    train.over_parameters(chosen[:, begin : begin + train.chunk])
                    for begin in range(0, chosen.shape[1], train.chunk)
                ],
                axis=1,
            )
            most = max(AT_ONCE // (len(states) * train.time.degree), 1)
            for part in _chunks(np.arange(owned.size), most):
                here = owned[part]
                states[:, here] = train.time.spread(paired[here], contraction, of[part], rows)
        return states.reshape(len(states), count, several)

    def grid(self, axes: Sequence[Array], rows: Rows) -> Array:
        """Evaluate on a tensor grid of 1 + d axes in any order: (rows, *sizes of the axes)."""
        sizes = [axis.size for axis in axes]

        def contractions(train: _Train) -> Iterator[tuple[int, Array]]:
            for begin, part in _parts(axes[1:], max(AT_ONCE // train.widest, 1)):
                yield begin, train.over_grid(part)

        states = self._at_all(axes[0], math.prod(sizes[1:]), contractions, rows)
        return states.reshape(len(states), *sizes)

    def _at_all(
        self,
        times: Array,
        count: int,
        contractions: Callable[[_Train], Iterable[tuple[int, Array]]],
        rows: Rows,
    ) -> Array:
        """States (rows, T, N) at all times (T,) for N products of the cores of the parameters.

        ``contractions`` yields for a train the products at parts of the N columns, and where each
        part begins.
        """
        states = np.empty((self.count(rows), times.size, count))
        for train, owned in self._owned(times, self._breaks):
            for begin, contraction in contractions(train):
                for here in _chunks(owned, max(AT_ONCE // max(contraction.shape), _TIMES)):
                    width = max(AT_ONCE // (len(states) * here.size), 1)
                    for first in range(0, contraction.shape[1], width):
                        part = contraction[:, first : first + width]
                        columns = slice(begin + first, begin + first + part.shape[1])
                        states[:, here, columns] = train.time.outer(times[here], part, rows)
        return states

    def _owned(self, times: Array, breaks: Array) -> Iterator[tuple[_Train, NDArray[np.intp]]]:
        """The trains that have some of the times (N,), and which, ordered by the breaks."""
        if not breaks.size:
            yield self.trains[0], np.arange(times.size)
            return
        owner = np.searchsorted(breaks, times, side="right")
        order = _stable_order(owner, len(breaks) + 1)
        counts = np.cumsum(np.bincount(owner, minlength=len(breaks) + 1))
        last = [*np.searchsorted(breaks, self._breaks).tolist(), len(breaks)]
        begin = 0
        for train, end in zip(self.trains, counts[last].tolist(), strict=True):
            if end > begin:
                yield train, order[begin:end]
            begin = end

    def count(self, rows: Rows) -> int:
        """How many states some rows are."""
        return self.trains[0].time.count(rows)
