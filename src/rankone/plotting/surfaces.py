"""An unknown over two coordinates: `plot_surface`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.plotting.asked import check_solution, label_of, only_unknown, states_of, value_of
from rankone.plotting.style import axes_for
from rankone.solution.smaller import merged
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.options import checked_number
from rankone.support.wording import did_you_mean, listing, quote, shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.interface.solution import Solution

__all__ = ["plot_surface"]

_LEVELS = 20


def plot_surface(
    solution: Solution,
    unknown: Any = None,
    values: Mapping[Any, Any] | None = None,
    *,
    x: Any,
    y: Any,
    points: int = 101,
    ax: Axes | None = None,
    **fixed: Any,
) -> Axes:
    """Plot an unknown over two coordinates, time or parameters, the others at fixed values.

    Parameters
    ----------
    solution : Solution
    unknown : symbol or str, optional
        An unknown, or a derivative that is a state; may be left out if there is only one unknown.
    values, **fixed
        For each other coordinate, by symbols or names, a number.
    x, y : symbol or str
        The coordinates along the axes.
    points : int
        Points along each of them, over its whole interval.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into: in three dimensions a surface, else filled contours with a colour scale.
        Contours in a new figure if left out.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    EvaluationError
        If there are several unknowns and none was chosen, there is no such unknown or coordinate,
        a value is missing or outside of its interval.
    OptionError
        If both coordinates are the same, one has a value as well, or a value is no number.
    """
    check_solution("plot_surface", solution)
    name = _state(solution, unknown)
    points = checked_number("points", points, 2, 10_000)
    across, up = _coordinate(solution, x), _coordinate(solution, y)
    if across == up:
        raise OptionError(
            f"x and y are both {quote(across)}", term=x, remedy="choose two coordinates"
        )
    fixed_at = _fixed(merged(values, fixed), across, up)
    coordinates = solution._coordinates
    ranges = dict(zip(coordinates.names, coordinates.intervals, strict=True))
    axes_values = {one: np.linspace(*ranges[one], points) for one in (across, up)}
    found = np.reshape(solution[name].grid({**fixed_at, **axes_values}), (points, points))
    order = [one for one in coordinates.names if one in axes_values]
    heights = found.T if order == [across, up] else found
    drawn = axes_for(ax)
    _draw(drawn, axes_values[across], axes_values[up], heights, label_of(solution, name))
    drawn.set(xlabel=label_of(solution, across), ylabel=label_of(solution, up))
    if fixed_at:
        where = (value_of(solution, name, float(value)) for name, value in fixed_at.items())
        drawn.set_title(", ".join(where), fontsize="medium", loc="left")
    return drawn


def _state(solution: Solution, unknown: Any) -> str:
    if isinstance(unknown, list | tuple):
        raise OptionError(
            f"unknown={shown(unknown)} are several", term=unknown, remedy="plot one after another"
        )
    if unknown is None:
        return only_unknown(solution, "plot_surface")
    return states_of(solution, unknown)[0]


def _coordinate(solution: Solution, key: Any) -> str:
    """Name of a coordinate along an axis."""
    known = solution.metadata.coordinates
    name = name_of(key)
    if name not in known:
        raise EvaluationError(
            f"there is no coordinate {quote(name)}{did_you_mean(name, known)}",
            term=key,
            remedy=f"choose from {listing(known)}",
        )
    return name


def _fixed(given: Mapping[str, Any], across: str, up: str) -> dict[str, Any]:
    """The values of the other coordinates."""
    for name, value in given.items():
        if name in (across, up):
            raise OptionError(
                f"{quote(name)} is along an axis and has a value as well",
                term=name,
                remedy="leave the value out; solution.restrict narrows the interval of a parameter",
            )
        if np.ndim(value) > 0:
            raise OptionError(
                f"{quote(name)} is {shown(value)}, not a number", term=name, remedy="fix one value"
            )
    return dict(given)


def _draw(ax: Axes, x: Array, y: Array, heights: Array, label: str) -> None:
    """Filled contours with thin lines, or a surface where the axes have three dimensions."""
    figure = ax.get_figure()
    assert figure is not None
    if ax.name == "3d":
        ax.plot_surface(  # type: ignore[attr-defined]
            *np.meshgrid(x, y), heights, cmap="viridis", linewidth=0, rcount=len(y), ccount=len(x)
        )
        ax.set_zlabel(label)  # type: ignore[attr-defined]
        return
    from matplotlib.ticker import MaxNLocator

    lowest, highest = float(heights.min()), float(heights.max())
    if highest - lowest <= 1e-12 * max(abs(lowest), abs(highest)):
        lowest, highest = lowest - 0.5, highest + 0.5
    levels = MaxNLocator(_LEVELS).tick_values(lowest, highest)
    filled = ax.contourf(x, y, heights, levels, cmap="viridis")
    ax.contour(x, y, heights, levels, colors="white", linestyles="solid", linewidths=0.4, alpha=0.6)
    ax.grid(False)
    bar = figure.colorbar(filled, ax=ax, label=label, pad=0.02)
    bar.outline.set_visible(False)
