"""Where the entries of fields are, as pages draw them: on a line, in a plane, on a mesh."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.solution.fields.field_view import FieldView
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError, count, listing, quote, shown

Displacement: TypeAlias = Sequence[Any]
"""Two unknowns, or views of as many entries as there are places: along each axis."""
_AXES = ("x", "y")


@dataclass(frozen=True, eq=False)
class Grid:
    """Entries on a line or in a plane, by the values along its axes; the last one runs first."""

    names: tuple[str, ...]
    axes: tuple[Array, ...]

    @property
    def size(self) -> int:
        """Number of its points."""
        return math.prod(axis.size for axis in self.axes)

    @property
    def content(self) -> dict[str, Any]:
        """What a page has of it."""
        kind = "line" if len(self.axes) == 1 else "plane"
        return {"kind": kind, "names": self.names, "axes": [axis.tolist() for axis in self.axes]}


@dataclass(frozen=True, eq=False)
class Mesh:
    """Entries at places (n, 2) of a plane, alone or as corners of triangles (m, 3).

    The places move by a ``displacement``, two views of n entries each.
    """

    places: Array
    triangles: NDArray[np.intp] | None = None
    displacement: tuple[FieldView, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes."""
        return _AXES

    @property
    def size(self) -> int:
        """Number of places."""
        return len(self.places)

    @property
    def content(self) -> dict[str, Any]:
        """What a page has of it; where the places may move to comes later."""
        return {
            "kind": "mesh",
            "names": self.names,
            "axes": self.places.T.tolist(),
            "triangles": None if self.triangles is None else self.triangles.ravel().tolist(),
            "displacement": [
                {"name": view.name, "positions": view.positions.tolist()}
                for view in self.displacement
            ],
        }


Layout: TypeAlias = Grid | Mesh


def index_line(size: int) -> Grid:
    """The entries of a field by their index."""
    return Grid(("entry",), (np.arange(float(size)),))


def layout_of(
    modes: FieldModes,
    coordinates: Mapping[str, ArrayLike] | None,
    places: ArrayLike | None,
    triangles: ArrayLike | None,
    displacement: tuple[FieldView, ...],
) -> Layout | None:
    """What was written as one layout, which some field fits; None where nothing was.

    Raises
    ------
    OptionError
        If it is no layout, or no field has as many entries.
    """
    if places is None and (triangles is not None or displacement):
        raise OptionError(
            f"{'triangles' if triangles is not None else 'displacement'} needs places of entries",
            remedy="give places=, an array (entries, 2)",
        )
    if coordinates and places is not None:
        raise OptionError(
            f"coordinates of a grid ({listing(coordinates)}) and places of a mesh are two layouts",
            term=[*coordinates],
            remedy="give one of them",
        )
    sizes = [unknown.size for unknown in modes.unknowns if unknown.is_field]
    if coordinates:
        return _grid(coordinates, sizes)
    return None if places is None else _mesh(places, triangles, displacement, sizes)


def displacement_views(
    displacement: Displacement | None, view: Callable[[object], FieldView]
) -> tuple[FieldView, ...]:
    """Two unknowns as views, where ``view`` makes one of a symbol or a name."""
    if displacement is None:
        return ()
    if isinstance(displacement, str | FieldView) or not isinstance(displacement, Sequence):
        raise OptionError(
            f"displacement={_described(displacement)} is one unknown",
            remedy="give two, along x and y: displacement=(ux, uy)",
        )
    if len(displacement) != len(_AXES):
        raise OptionError(
            f"displacement has {count(len(displacement), 'unknown')}, and pages draw planes",
            remedy="give two, along x and y: displacement=(ux, uy)",
        )
    try:
        return tuple(each if isinstance(each, FieldView) else view(each) for each in displacement)
    except EvaluationError as error:
        raise OptionError(f"displacement: {error}", term=displacement) from None


def _described(term: object) -> str:
    return f"solution[{term.name}]" if isinstance(term, FieldView) else shown(term)


def _grid(coordinates: Mapping[str, ArrayLike], sizes: Sequence[int]) -> Grid:
    """A line or a plane with as many points as a field has entries."""
    if not isinstance(coordinates, Mapping):
        raise OptionError(
            f"coordinates={shown(coordinates)} is not a mapping",
            remedy='give {"x": x} for a line, {"x": x, "y": y} for a plane',
        )
    axes = {str(name): _numbers(quote(name), axis, 1) for name, axis in coordinates.items()}
    if len(axes) > len(_AXES):
        raise OptionError(
            f"the grid has {len(axes)} axes, {listing(axes)}, and pages draw lines and planes",
            term=[*axes],
            remedy="write a page of outputs: solution.output({...}).explore(path)",
        )
    for name, axis in axes.items():
        steps = np.diff(axis)
        if not (np.all(steps > 0.0) or np.all(steps < 0.0)):
            raise OptionError(
                f"the coordinate {quote(name)} neither ascends nor descends",
                term=name,
                remedy="give the places of the cells along the axis, in their order",
            )
    grid = Grid(tuple(axes), tuple(axes.values()))
    if grid.size not in sizes:
        lengths = " x ".join(str(axis.size) for axis in grid.axes)
        product = f"{lengths} = {grid.size}" if len(axes) > 1 else lengths
        raise OptionError(
            f"the grid of {listing(axes)} has {product} points, and {_of_fields(sizes)}",
            term=[*axes],
            remedy="give as many coordinates along each axis as the grid has points there",
        )
    return grid


def _mesh(
    places: ArrayLike,
    triangles: ArrayLike | None,
    displacement: tuple[FieldView, ...],
    sizes: Sequence[int],
) -> Mesh:
    """Places and triangles of as many entries as a field or the displacement has."""
    at = _numbers("places", places, 2)
    if at.shape[1] != len(_AXES):
        raise OptionError(
            f"places has the shape {at.shape}", remedy="give an array (entries, 2): x and y of each"
        )
    for view in displacement:
        if view.shape != (len(at),):
            raise OptionError(
                f"the displacement solution[{view.name}] has the shape {view.shape}, and there are "
                f"{count(len(at), 'place')}",
                term=view.name,
                remedy="give entries of a field, one for each place: solution[u][0::2]",
            )
    if len(at) not in sizes and not displacement:
        raise OptionError(
            f"there are {count(len(at), 'place')}, and {_of_fields(sizes)}",
            remedy="give a place for each entry, in their order",
        )
    return Mesh(at, None if triangles is None else _corners(triangles, len(at)), displacement)


def _corners(triangles: ArrayLike, size: int) -> NDArray[np.intp]:
    """Indices of places, three for each triangle."""
    corners = np.asarray(triangles)
    if corners.ndim != 2 or corners.shape[1] != 3 or corners.dtype.kind not in "iu":
        raise OptionError(
            f"triangles has the shape {corners.shape} and numbers of the type {corners.dtype}",
            remedy="give integers (triangles, 3): the indices of the places at the corners",
        )
    if corners.size and not (corners.min() >= 0 and corners.max() < size):
        wrong = corners.min() if corners.min() < 0 else corners.max()
        raise OptionError(
            f"a corner of the triangles is place {wrong}, and there are {count(size, 'place')}",
            remedy=f"give indices from 0 to {size - 1}",
        )
    return corners.astype(np.intp)


def _numbers(name: str, values: ArrayLike, dimensions: int) -> Array:
    """Finite numbers in an array of so many dimensions, or an OptionError."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise OptionError(f"{name} is {shown(values)}, not an array of numbers") from None
    if array.ndim != dimensions or not array.size or not np.isfinite(array).all():
        problem = (
            f"has the shape {array.shape}"
            if array.ndim != dimensions or not array.size
            else "has entries that are not finite"
        )
        shape = "one-dimensional array" if dimensions == 1 else "array (entries, 2)"
        raise OptionError(f"{name} {problem}", remedy=f"give a {shape} of finite numbers")
    return array


def _of_fields(sizes: Sequence[int]) -> str:
    """How many entries the fields have."""
    if len({*sizes}) == 1:
        noun = "the field has" if len(sizes) == 1 else "the fields have"
        return f"{noun} {count(sizes[0], 'entry', 'entries')}"
    return f"the fields have {' and '.join(map(str, sizes))} entries"
