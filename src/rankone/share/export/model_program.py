"""Evaluation of the solved model: a tensor train of Chebyshev polynomials on each time slab.

At one point every core is a matrix, and the unknowns are their product. It is formed from the
last parameter to time; derivatives are carried along, one column for each coordinate passed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.tensors.coordinates import round_off

_CHUNK = 1024  # Points evaluated at once: their products stay in the cache

Place = float | tuple[float, ...]  # One, or one for each unequal element


class Model:
    """The unknowns and their derivatives as functions of time and of all parameters.

    The ``coordinates`` are time and the parameters; a value outside its interval is an error.
    """

    def __init__(
        self,
        unknowns: tuple[str, ...],
        coordinates: tuple[str, ...],
        keywords: tuple[str, ...],
        intervals: tuple[tuple[float, float], ...],
        starts: tuple[float, ...],
        cores: Sequence[tuple[Place, Place, tuple[int, int, int, int]]],
        slabs: Sequence[Sequence[int]],
        coefficients: Array,
        scales: Sequence[str] = (),
    ) -> None:
        self.unknowns, self.coordinates, self.intervals = unknowns, coordinates, intervals
        self._names = dict(zip(keywords, coordinates, strict=True))
        self._starts = np.array(starts)
        self._scales = scales or ["linear"] * len(coordinates)
        tensors: list[tuple[Array, Array, Array]] = []
        offset = 0
        for lower, scale, shape in cores:
            end = offset + int(np.prod(shape))
            tensor = coefficients[offset:end].reshape(shape)
            tensors.append((np.array(lower), np.array(scale), tensor))
            offset = end
        self._cores = tensors
        self._slabs = [[tensors[position] for position in slab] for slab in slabs]

    def value(self, values: Mapping[str, Any] | None = None, /, **named: Any) -> Array:
        """Values of the unknowns: shape (unknowns, *broadcast shape of the coordinates)."""
        points, shape = self._points({**(values or {}), **named})
        return self._evaluate(points, derivatives=False).reshape(len(self.unknowns), *shape)

    def gradient(self, values: Mapping[str, Any] | None = None, /, **named: Any) -> Array:
        """Derivatives with respect to each coordinate, in their order.

        The shape is (unknowns, coordinates, *broadcast shape of the coordinates). Where two time
        slabs meet, the derivative is that of the later one.
        """
        points, shape = self._points({**(values or {}), **named})
        slopes = self._evaluate(points, derivatives=True)[:, 1:]
        return slopes.reshape(*slopes.shape[:2], *shape)

    def _points(self, at: Mapping[str, Any], first: int = 0) -> tuple[Array, tuple[int, ...]]:
        """Points (coordinates, N) inside of the intervals, and the shape they stand for.

        The coordinates are those from the ``first`` on.
        """
        coordinates = self.coordinates[first:]
        named = {self._names.get(name, name): array for name, array in at.items()}
        if named.keys() != set(coordinates) or len(named) != len(at):
            expected = ", ".join(coordinates) or "nothing"
            raise ValueError(f"values of {', '.join(at) or 'nothing'} were given, not {expected}")
        arrays = []
        for name, (lower, upper) in zip(coordinates, self.intervals[first:], strict=True):
            array = _numbers(name, named[name])
            slack = round_off(lower, upper)
            outside = array[~((array >= lower - slack) & (array <= upper + slack))]
            if outside.size:
                raise ValueError(f"{name} is {outside[0]:.12g}, not in [{lower!r}, {upper!r}]")
            arrays.append(np.clip(array, lower, upper))
        shape = np.broadcast_shapes(*(array.shape for array in arrays))
        points = np.empty((len(arrays), *shape))
        for j, array in enumerate(arrays):
            points[j] = array
        return points.reshape(len(points), int(np.prod(shape))), shape

    def _evaluate(self, points: Array, derivatives: bool) -> Array:
        """Values, and derivatives if asked for, at points (coordinates, N) of all slabs.

        The shape is (unknowns, 1 or 1 + coordinates, N).
        """
        columns = 1 + len(points) if derivatives else 1
        states = np.empty((len(self.unknowns), columns, points.shape[1]))
        owner = np.searchsorted(self._starts[1:], points[0], side="right")
        for index in np.unique(owner):
            here = np.flatnonzero(owner == index)
            for begin in range(0, here.size, _CHUNK):
                chunk = here[begin : begin + _CHUNK]
                at = points[:, chunk]
                states[:, :, chunk] = _train(self._slabs[index], self._scales, at, derivatives)
        return states


def _numbers(name: str, argument: object) -> Array:
    """The values of a coordinate, or a ValueError that names it and what was given."""
    try:
        array = np.asarray(argument)
        if array.dtype.kind in "biufO" and argument is not None:
            return array.astype(float)
    except (TypeError, ValueError):
        pass
    raise ValueError(f"{name} is {argument!r}, not a number or an array of numbers")


def _train(
    cores: Sequence[tuple[Array, Array, Array]],
    scales: Sequence[str],
    points: Array,
    derivatives: bool,
    product: Sequence[Array] = (),
) -> Array:
    """Values and derivatives of one slab at points (coordinates, N).

    The ``product`` is that of all further cores, a value and derivatives (right, N) each.
    """
    columns = [*product] or [np.ones((1, points.shape[1]))]
    coordinates = zip(cores[::-1], scales[::-1], points[::-1], strict=True)
    for (lower, scale, tensor), kind, coordinate in coordinates:
        _, left, degree, _ = tensor.shape
        scaled, rate = _scaled(kind, coordinate)
        element, local, scale = _located(lower, scale, len(tensor), scaled)
        t, slope = chebyshev(local, degree)
        pairs = [(t, column) for column in columns]
        if derivatives:
            pairs.insert(1, (2.0 * scale * rate * slope, columns[0]))
        columns = [np.empty((left, coordinate.size)) for _ in pairs]
        for e in np.unique(element):
            here = np.flatnonzero(element == e)
            matrix = tensor[e].reshape(left, -1)
            for out, (basis, contraction) in zip(columns, pairs, strict=True):
                products = basis[:, None, here] * contraction[:, here]
                out[:, here] = matrix @ products.reshape(-1, here.size)
    return np.stack(columns, axis=1)


def _scaled(kind: str, x: Array) -> tuple[Array, Array]:
    """The coordinate s in which cores are polynomials, and its slope ds/dx, at x (N,)."""
    if kind == "log":
        return np.log(x), 1.0 / x
    if kind == "reciprocal":
        return -1.0 / x, 1.0 / (x * x)
    return x, np.ones_like(x)


def _located(
    lower: Array, scale: Array, elements: int, x: Array
) -> tuple[NDArray[np.intp], Array, Array]:
    """For points (N,) their elements, the coordinates in [-1, 1] there, elements per unit."""
    if lower.ndim:
        element = np.searchsorted(lower[1:], x, side="right")
        return element, 2.0 * ((x - lower[element]) * scale[element]) - 1.0, scale[element]
    position = (x - lower) * scale
    element = np.clip(position.astype(np.intp), 0, elements - 1)
    return element, 2.0 * (position - element) - 1.0, scale


def chebyshev(x: Array, count: int) -> tuple[Array, Array]:
    """Chebyshev polynomials T_0 ... T_{count - 1} and their derivatives, each (count, N)."""
    t, slope = np.ones((count, x.size)), np.zeros((count, x.size))
    if count > 1:
        t[1], slope[1] = x, 1.0
    for k in range(2, count):
        t[k] = 2.0 * x * t[k - 1] - t[k - 2]
        slope[k] = 2.0 * (t[k - 1] + x * slope[k - 1]) - slope[k - 2]
    return t, slope
