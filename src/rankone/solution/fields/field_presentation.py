"""A solution of fields as people and other libraries see it: its summary, and xarray."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from rankone.solution.evaluation.presentation import (
    in_lines,
    in_table,
    labelled_axes,
    over,
    request_of,
    some,
    trains,
    xarray_and_points,
)
from rankone.solution.solution import Solution
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, count, listing, quote, shortened

if TYPE_CHECKING:
    import xarray


def field_summary_text(coefficients: Solution, modes: FieldModes, verdict: str) -> str:
    """The summary in lines; the verdict says whether it is a success, and why."""
    title = f"FieldSolution (rankone {coefficients.metadata.version})".replace(" (rankone )", "")
    return in_lines(title, _summary(coefficients, modes, verdict))


def field_summary_html(coefficients: Solution, modes: FieldModes, verdict: str) -> str:
    """The summary as a table, for notebooks."""
    return in_table("FieldSolution", _summary(coefficients, modes, verdict))


def _summary(coefficients: Solution, modes: FieldModes, verdict: str) -> list[tuple[str, str]]:
    """Headings and texts of the summary."""
    unknowns = [
        f"{unknown.name} ({count(len(own), 'entry', 'entries')}, {count(own.shape[1], 'mode')})"
        if unknown.is_field
        else unknown.name
        for unknown, own in zip(modes.unknowns, modes.modes, strict=True)
    ]
    timings = [f"{stage} {seconds:.3g} s" for stage, seconds in coefficients.timings.items()]
    return [
        ("unknowns", some(unknowns)),
        ("over", over(coefficients)),
        ("success", shortened(verdict)),
        ("error", _error(coefficients, modes)),
        (coefficients.method, trains(coefficients.outcome)),
        *([("timings", ", ".join(timings))] if timings else []),
    ]


def _error(coefficients: Solution, modes: FieldModes) -> str:
    """The measured errors, and of which norm."""
    tolerance = f"tolerance {coefficients.rtol:.3g}"
    if not modes.errors:
        return f"not measured, {tolerance}"
    text = f"{max(modes.errors):.2g} measured at all entries, relative to the largest value of the "
    text += (
        f"field, {tolerance}; {count(modes.trajectories, 'full trajectory', 'full trajectories')}"
    )
    if len(modes.errors) > 1:
        pairs = zip(modes.unknowns, modes.errors, strict=True)
        text += "; " + some(f"{unknown.name} {error:.2g}" for unknown, error in pairs)
    return text


def field_dataset(
    coefficients: Solution,
    modes: FieldModes,
    at: Mapping[Any, ArrayLike],
    coordinates: Mapping[str, ArrayLike | tuple[str, ArrayLike]],
    verdict: Mapping[str, Any],
) -> xarray.Dataset:
    """All unknowns on the grid of all combinations of ``at``, entries first, with labels.

    Fields whose entries are as many as points of the grid of ``coordinates`` have its dimensions.
    """
    module, points = xarray_and_points(coefficients, at)
    axes = {
        name: np.asarray(points[name], dtype=float) for name in coefficients.metadata.coordinates
    }
    grid, along = _grid_and_places(coordinates, modes)
    taken = (*axes, *(unknown.name for unknown in modes.unknowns))
    _check_names({**grid, **along}, taken)
    _check_grid(grid, modes)
    shape = tuple(axis.size for axis in grid.values())
    several = len({unknown.size for unknown in modes.unknowns if unknown.is_field}) > 1
    values = coefficients.grid(points)
    errors = modes.errors or (float("nan"),) * len(modes.unknowns)
    variables, used = {}, dict[str, Any]()
    for k, unknown in enumerate(modes.unknowns):
        own = np.tensordot(modes.modes[k], values[modes.coefficients_of(k)], axes=1)
        dimensions: tuple[str, ...] = (f"{unknown.name}_entry" if several else "entry",)
        if not unknown.is_field:
            own, dimensions = own[0], ()
        elif grid and unknown.size == math.prod(shape):
            own, dimensions = own.reshape((*shape, *own.shape[1:])), tuple(grid)
            used = {name: (name, axis) for name, axis in grid.items()}
        else:
            places = {n: (*dimensions, a) for n, a in along.items() if a.size == unknown.size}
            used.update(places)
        about = {"long_name": unknown.name, "error": errors[k], "scale": modes.scales[k]}
        variables[unknown.name] = ((*dimensions, *axes), own, about)
    labelled: xarray.Dataset = module.Dataset(
        variables,
        {**used, **labelled_axes(coefficients, axes)},
        {**request_of(coefficients), **verdict},
    )
    return labelled.squeeze([name for name, axis in axes.items() if axis.ndim == 0])


def _grid_and_places(
    coordinates: Mapping[str, Any], modes: FieldModes
) -> tuple[dict[str, Array], dict[str, Array]]:
    """The axes of a grid, and coordinates that have a number for each entry.

    The latter are pairs ``("entry", numbers)``, or arrays that make no grid of entries.
    """
    sizes = {unknown.size for unknown in modes.unknowns if unknown.is_field}
    axes, places = dict[str, Array](), dict[str, Array]()
    for name, written in coordinates.items():
        if isinstance(written, tuple) and written and isinstance(written[0], str):
            places[str(name)] = np.asarray(written[-1], dtype=float)
        else:
            axes[str(name)] = np.asarray(written)
    by_entry = axes and all(axis.ndim == 1 and axis.size in sizes for axis in axes.values())
    if by_entry and math.prod(axis.size for axis in axes.values()) not in sizes:
        axes, places = {}, {**places, **axes}
    for name, array in places.items():
        if array.ndim != 1 or array.size not in sizes:
            raise OptionError(
                f"the coordinate {quote(name)} along `entry` has the shape {array.shape}, and the "
                f"fields have {' and '.join(map(str, sorted(sizes)))} entries",
                term=name,
                remedy="give one number for each entry",
            )
    return axes, places


def _check_names(coordinates: Mapping[str, Array], taken: Sequence[str]) -> None:
    """Raise an OptionError unless coordinates have one dimension, and names of their own."""
    for name, axis in coordinates.items():
        if axis.ndim != 1 or name in taken:
            problem = (
                "is a name of the solution" if name in taken else f"has the shape {axis.shape}"
            )
            raise OptionError(
                f"the coordinate {quote(name)} {problem}",
                term=name,
                remedy="give names of their own, and one-dimensional arrays",
            )


def _check_grid(grid: Mapping[str, Array], modes: FieldModes) -> None:
    """Raise an OptionError unless a grid has as many points as a field has entries."""
    points = math.prod(axis.size for axis in grid.values())
    sizes = [unknown.size for unknown in modes.unknowns if unknown.is_field]
    if grid and points not in sizes:
        raise OptionError(
            f"the grid of {listing(grid)} has {points} points, and the fields have "
            f"{' and '.join(map(str, sizes))} entries",
            term=[*grid],
            remedy="give as many coordinates along each axis as the grid has points there; on "
            "another mesh, arrays with a number for each entry",
        )
