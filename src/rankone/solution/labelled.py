"""Values of a solution on a grid with labels: xarray and pandas.

They need xarray: ``pip install xarray``, or ``pip install ".[io]"`` in the folder of the project.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.solution.core import SolutionCore
from rankone.support.errors import RankoneError

if TYPE_CHECKING:
    import xarray

__all__ = ["dataset"]

_TIMES = 101
"""Times where none are given."""


def dataset(solution: SolutionCore, given: Mapping[Any, Any]) -> xarray.Dataset:
    """The unknowns on the grid of all combinations of values; numbers are coordinates alone.

    Parameters
    ----------
    solution : SolutionCore
    given : mapping
        For coordinates, by names, a number or one-dimensional values.
    """
    module = _xarray()
    start, end = solution.time
    values = {name_of(key): value for key, value in given.items()}
    names = solution.metadata.coordinates
    if not solution.metadata.timeless:
        values.setdefault(solution.metadata.time, np.linspace(start, end, _TIMES))
    grid = solution.grid(values)
    units = {name: {"units": unit} for name, unit in solution.metadata.units}
    axes = {name: np.asarray(values[name], dtype=float) for name in names}
    made: xarray.Dataset = module.Dataset(
        {
            name: (
                tuple(axes),
                found,
                {"long_name": name, "error": solution.errors[name], **units.get(name, {})},
            )
            for name, found in zip(solution.unknowns, grid, strict=True)
        },
        {
            name: (name, np.atleast_1d(axis), {"long_name": name, **units.get(name, {})})
            for name, axis in axes.items()
        },
        {
            "title": "; ".join(solution.metadata.statements),
            "source": f"rankone {solution.metadata.version}, method {solution.method}",
            "rtol": solution.rtol,
            "success": int(solution.success),
            "comment": solution.message,
        },
    )
    numbers = [name for name, axis in axes.items() if axis.ndim == 0]
    squeezed: xarray.Dataset = made.squeeze(numbers)
    return squeezed


def _xarray() -> Any:
    try:
        return importlib.import_module("xarray")
    except ImportError:
        raise RankoneError(
            "labelled values need xarray, which is not installed", remedy="pip install xarray"
        ) from None
