"""Evaluation of tensor trains at many points, at one point and on grids.

The cores are rearranged once: on every element of a dimension the polynomials become Chebyshev
polynomials, whose values at all points come from few vectorised products, and every core becomes
one matrix per element. Evaluation then goes from the last dimension to the first; each step
multiplies the values of the polynomials with the vector carried so far (a column-wise Kronecker
product) and the core with the result, one matrix product for all points of a chunk.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rankone.arrays import Array
from rankone.discretization import Basis1D, LegendreBasis
from rankone.tensors.slab import SlabTrain

__all__ = ["Rows", "TrainEvaluator"]

Rows = slice | NDArray[np.intp]

_BUFFER = 1 << 19
"""Numbers in the largest product of a chunk (4 MiB): cached, and enough for the matrix product."""


def chebyshev_polynomials(xi: Array, count: int) -> Array:
    """Values T_0 ... T_{count-1} at points (N,) of [-1, 1], shape (count, N).

    By ``T_{k+i} = 2 T_k T_i - T_{k-i}``, which doubles the number of known rows in three
    vectorised operations (DLMF 18.18.21).
    """
    values = np.empty((count, xi.size))
    values[0] = 1.0
    if count > 1:
        values[1] = xi
    known = 1
    while known < count - 1:
        more = min(known, count - 1 - known)
        new = values[known + 1 : known + 1 + more]
        np.multiply(values[1 : 1 + more], 2.0 * values[known], out=new)
        new -= values[known - more : known][::-1]
        known += more
    return values


def _to_chebyshev(basis: Basis1D) -> Array:
    """Map coefficients of one element's modes to Chebyshev coefficients, (degree, degree).

    Mode k has no part above degree k; zeros there are exact, so that high modes which are zero stay
    zero.
    """
    count = basis.degree
    angles = np.pi * (np.arange(count) + 0.5) / count
    one = replace(basis, lower=-1.0, upper=1.0, elements=1, breaks=())
    modes = one.modal_values(np.cos(angles))
    transform = np.cos(np.arange(count)[:, None] * angles) * (2.0 / count)
    transform[0] *= 0.5
    return np.triu(transform @ modes * np.sqrt(basis.elements))


class _Dimension:
    """One core of one slab: for each element a matrix (left, degree * right)."""

    def __init__(self, core: Array, basis: Basis1D) -> None:
        self.left, _, self.right = core.shape
        self.degree, self.elements = basis.degree, basis.elements
        self.edges: tuple[float, ...] = (*basis.edges.tolist(),) if basis.breaks else ()
        self.lower = basis.lower
        self.scale = basis.elements / (basis.upper - basis.lower)
        split = core.reshape(self.left, self.elements, self.degree, self.right)
        tensor = np.matmul(_to_chebyshev(basis), split).transpose(1, 0, 2, 3)
        self.tensor = np.ascontiguousarray(tensor)
        self.matrices = [m.reshape(self.left, -1) for m in self.tensor]

    def locate(self, points: Array) -> tuple[Array, NDArray[np.intp] | None]:
        """Local coordinates in [-1, 1] of points (N,), and their elements if there are several."""
        position = (points - self.lower) * self.scale
        if self.elements == 1:
            return 2.0 * position - 1.0, None
        element = np.clip(position.astype(np.intp), 0, self.elements - 1)
        return 2.0 * (position - element) - 1.0, element

    def locate_one(self, point: float) -> tuple[float, int]:
        """Local coordinate and element of one point."""
        position = (point - self.lower) * self.scale
        element = max(0, min(int(position), self.elements - 1)) if self.elements > 1 else 0
        return 2.0 * (position - element) - 1.0, element

    def contract(self, points: Array, carry: Array | None, rows: Rows | None = None) -> Array:
        """Multiply the core, at points (N,), with the carry (right, N): shape (left, N)."""
        xi, element = self.locate(points)
        values = chebyshev_polynomials(xi, self.degree)
        matrices = self.matrices if rows is None else [m[rows] for m in self.matrices]
        if element is None:
            return np.asarray(matrices[0] @ _columnwise_kronecker(values, carry))
        result = np.empty((len(matrices[0]), xi.size))
        for e, matrix in enumerate(matrices):
            here = np.flatnonzero(element == e)
            if here.size:
                part = None if carry is None else carry[:, here]
                result[:, here] = matrix @ _columnwise_kronecker(values[:, here], part)
        return result

    def sections(self, points: Array, rows: Rows | None = None) -> Array:
        """The core at points (N,): shape (left, N, right)."""
        xi, element = self.locate(points)
        values = chebyshev_polynomials(xi, self.degree).T
        tensor = self.tensor if rows is None else self.tensor[:, rows]
        if element is None:
            return np.asarray(np.matmul(values, tensor[0]))
        result = np.empty((tensor.shape[1], xi.size, self.right))
        for e, block in enumerate(tensor):
            here = np.flatnonzero(element == e)
            result[:, here] = np.matmul(values[here], block)
        return result


class _UnequalDimension(_Dimension):
    """One core whose elements are unequal: between two of them the later one counts."""

    def __init__(self, core: Array, basis: Basis1D) -> None:
        super().__init__(core, basis)
        self.breaks = basis.breaks
        self.lowers, self.scales = basis.edges[:-1], 1.0 / np.diff(basis.edges)

    def locate(self, points: Array) -> tuple[Array, NDArray[np.intp] | None]:
        element = np.searchsorted(self.breaks, points, side="right")
        position = (points - self.lowers[element]) * self.scales[element]
        return 2.0 * position - 1.0, element

    def locate_one(self, point: float) -> tuple[float, int]:
        element = bisect_right(self.breaks, point)
        position = (point - self.lowers[element]) * self.scales[element]
        return 2.0 * position - 1.0, element


def _columnwise_kronecker(values: Array, carry: Array | None) -> Array:
    """Kronecker products of the columns of (n, N) and (r, N): shape (n * r, N)."""
    if carry is None:
        return values
    return np.multiply(values[:, None], carry).reshape(-1, values.shape[1])


class _SlabEvaluator:
    """The cores of one slab, ready for evaluation."""

    def __init__(self, slab: SlabTrain) -> None:
        time = LegendreBasis(slab.start, slab.end, slab.cores[0].shape[1])
        self.dimensions = tuple(
            (_UnequalDimension if basis.breaks else _Dimension)(core, basis)
            for core, basis in zip(slab.cores, (time, *slab.bases), strict=True)
        )
        largest = max(dimension.degree * dimension.right for dimension in self.dimensions)
        self.chunk = min(max(_BUFFER // largest, 64), 1024)
        self.degree = max(dimension.degree for dimension in self.dimensions)

    def many(self, points: Array, rows: Rows) -> Array:
        """Values at points (1 + d, N) of the slab: shape (rows, N)."""
        carry = None
        for dimension, values in zip(self.dimensions[:0:-1], points[:0:-1], strict=True):
            carry = dimension.contract(values, carry)
        return self.dimensions[0].contract(points[0], carry, rows)

    def one(self, point: Sequence[float], rows: Rows) -> Array:
        """Values at one point, given as 1 + d numbers: shape (rows,)."""
        located = [
            dimension.locate_one(value)
            for dimension, value in zip(self.dimensions, point, strict=True)
        ]
        table = chebyshev_polynomials(np.array([xi for xi, _ in located]), self.degree).T
        carry: Array | None = None
        for k in range(len(self.dimensions) - 1, -1, -1):
            dimension = self.dimensions[k]
            values = table[k, : dimension.degree]
            matrix = dimension.matrices[located[k][1]]
            if k == 0:
                matrix = matrix[rows]
            carry = matrix @ (values if carry is None else np.multiply.outer(values, carry).ravel())
        assert carry is not None
        return carry

    def grid(self, axes: Sequence[Array], rows: Rows) -> Array:
        """Values on the tensor grid of 1 + d axes: shape (rows, *sizes of the axes)."""
        carry = np.ones((1, 1))
        for dimension, axis in zip(self.dimensions[:0:-1], axes[:0:-1], strict=True):
            carry = (dimension.sections(axis) @ carry).reshape(dimension.left, -1)
        values = self.dimensions[0].sections(axes[0], rows) @ carry
        return np.asarray(values.reshape(len(values), *(axis.size for axis in axes)))


class TrainEvaluator:
    """Tensor trains on consecutive time slabs, arranged for fast evaluation.

    Nothing is checked here: points outside of the box or the horizon are extrapolated.

    Parameters
    ----------
    slabs : sequence of SlabTrain
        Consecutive slabs of the same states and parameters.
    """

    def __init__(self, slabs: Sequence[SlabTrain]) -> None:
        self.slabs = tuple(_SlabEvaluator(slab) for slab in slabs)
        self._breaks = np.array([slab.start for slab in slabs[1:]])

    def many(self, points: Array, rows: Rows) -> Array:
        """Evaluate at paired points, in chunks of bounded memory.

        ``points`` (1 + d, N) are times, then the values of each parameter; the shape is (rows, N).
        """
        count = points.shape[1]
        result = np.empty((len(self.slabs[0].dimensions[0].matrices[0][rows]), count))
        if len(self.slabs) == 1:
            self._fill(result, points, self.slabs[0], rows)
            return result
        # the stable sort of 16-bit integers is a radix sort
        small = np.min_scalar_type(len(self.slabs))
        owner = np.searchsorted(self._breaks, points[0], side="right").astype(small)
        order = np.argsort(owner, kind="stable")
        ends = np.cumsum(np.bincount(owner, minlength=len(self.slabs)))
        begin = 0
        for slab, end in zip(self.slabs, ends, strict=True):
            here = order[begin:end]
            if here.size:
                part = np.empty((len(result), here.size))
                self._fill(part, points[:, here], slab, rows)
                result[:, here] = part
            begin = end
        return result

    @staticmethod
    def _fill(result: Array, points: Array, slab: _SlabEvaluator, rows: Rows) -> None:
        for begin in range(0, points.shape[1], slab.chunk):
            piece = slice(begin, begin + slab.chunk)
            result[:, piece] = slab.many(points[:, piece], rows)

    def one(self, point: Sequence[float], rows: Rows) -> Array:
        """Evaluate at one point, 1 + d numbers: shape (rows,); much less overhead than `many`."""
        if len(self.slabs) == 1:
            return self.slabs[0].one(point, rows)
        return self.slabs[int(self._breaks.searchsorted(point[0], side="right"))].one(point, rows)

    def grid(self, axes: Sequence[Array], rows: Rows) -> Array:
        """Evaluate on a tensor grid.

        The 1 + d axes, times and then each parameter, may have any order of values; the shape is
        (rows, *sizes of the axes).
        """
        owner = np.searchsorted(self._breaks, axes[0], side="right")
        count = len(self.slabs[0].dimensions[0].matrices[0][rows])
        result = np.empty((count, *(axis.size for axis in axes)))
        for index in np.unique(owner):
            here = np.flatnonzero(owner == index)
            result[:, here] = self.slabs[index].grid([axes[0][here], *axes[1:]], rows)
        return result
