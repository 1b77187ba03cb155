"""Where the entries of fields are, as pages draw them: on a line, in a plane, on a mesh."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.solution.fields.field_view import FieldView
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError, count, listing, quote, shown

if TYPE_CHECKING:
    from rankone.solution.fields.field_core import FieldCore

Coordinates: TypeAlias = Mapping[str, ArrayLike | tuple[str, ArrayLike]]
"""By names, as :meth:`FieldSolution.to_xarray` takes them: along axes of a grid, or by entry."""
Displacement: TypeAlias = Sequence[Any]
"""Two unknowns, or views of as many entries as there are places: along each axis."""
_AXES: tuple[str, ...] = ("x", "y")


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
    names: tuple[str, ...] = _AXES

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
    coordinates: Coordinates | None,
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
    sizes = [unknown.size for unknown in modes.unknowns if unknown.is_field]
    names = _AXES
    if coordinates:
        if places is not None:
            raise OptionError(
                f"coordinates ({listing(coordinates)}) and places are two layouts",
                term=[*coordinates],
                remedy="give one of them",
            )
        axes, by_entry = _axes(coordinates, sizes)
        if len(axes) == len(_AXES) and by_entry:
            names, places = tuple(axes), np.stack([*axes.values()], axis=1)
    if places is not None:
        corners = None if triangles is None else np.asarray(triangles)
        return _mesh(names, _numbers("places", places, 2), corners, displacement, sizes)
    if triangles is not None or displacement:
        raise OptionError(
            f"{'triangles' if triangles is not None else 'displacement'} needs places of entries",
            remedy="give places=, an array (entries, 2)",
        )
    return _grid(axes, sizes) if coordinates else None


def displacement_views(
    displacement: Displacement | None, solution: FieldCore
) -> tuple[FieldView, ...]:
    """Two unknowns of a solution, by symbols or names, or views of it, as views."""
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
        views = tuple(x if isinstance(x, FieldView) else solution[x] for x in displacement)
    except EvaluationError as error:
        raise OptionError(f"displacement: {error}", term=displacement) from None
    for view in views:
        if view.coefficients is not solution.coefficients:
            raise OptionError(
                f"the displacement solution[{view.name}] is a view of another solution",
                term=view.name,
                remedy="give views of the solution that the page is of",
            )
    return views


def _described(term: object) -> str:
    return f"solution[{term.name}]" if isinstance(term, FieldView) else shown(term)


def _axes(coordinates: Coordinates, sizes: Sequence[int]) -> tuple[dict[str, Array], bool]:
    """Coordinates as numbers, and whether each has one for each entry.

    They have where they are pairs ``("entry", numbers)``, or make no grid of entries.
    """
    if not isinstance(coordinates, Mapping):
        raise OptionError(
            f"coordinates={shown(coordinates)} is not a mapping",
            remedy='give {"x": x} for a line, {"x": x, "y": y} for a plane',
        )
    if len(coordinates) > len(_AXES):
        raise OptionError(
            f"there are {len(coordinates)} coordinates, {listing(coordinates)}, and pages draw "
            "lines and planes",
            term=[*coordinates],
            remedy="write a page of outputs: solution.output({...}).explore(path)",
        )
    axes, pairs = dict[str, Array](), []
    for name, written in coordinates.items():
        pairs.append(isinstance(written, tuple) and bool(written) and written[0] == "entry")
        numbers = cast("tuple[str, ArrayLike]", written)[-1] if pairs[-1] else written
        axes[str(name)] = _numbers(quote(name), cast("ArrayLike", numbers), 1)
    if any(pairs) and not all(pairs):
        raise OptionError(
            f"of the coordinates {listing(axes)} only some are by entry",
            term=[*axes],
            remedy='give all as ("entry", numbers), or all along the axes of a grid',
        )
    points = math.prod(axis.size for axis in axes.values())
    by_entry = points not in sizes and all(axis.size in sizes for axis in axes.values())
    return axes, all(pairs) or by_entry


def _grid(axes: Mapping[str, Array], sizes: Sequence[int]) -> Grid:
    """A line or a plane with as many points as a field has entries."""
    for name, axis in axes.items():
        steps = np.diff(axis)
        if len(axes) > 1 and not (np.all(steps > 0.0) or np.all(steps < 0.0)):
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
    names: tuple[str, ...],
    at: Array,
    triangles: NDArray[Any] | None,
    displacement: tuple[FieldView, ...],
    sizes: Sequence[int],
) -> Mesh:
    """Places and triangles of as many entries as a field or the displacement has."""
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
    corners = None if triangles is None else _corners(triangles, len(at))
    return Mesh(at, corners, displacement, names)


def _corners(corners: NDArray[Any], size: int) -> NDArray[np.intp]:
    """Indices of places, three for each triangle."""
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
