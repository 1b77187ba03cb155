"""An unknown over two coordinates: `plot_surface`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.ir.measures import evenly_on_scale
from rankone.plotting.arguments import check_solution, state_of
from rankone.plotting.style import axes_for, axis_scale, colour_scale, label_of, name_fixed
from rankone.solution.smaller import merged
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.options import checked_number
from rankone.support.wording import did_you_mean, listing, quote, shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.interface.solution import Solution

_CONTOUR_LEVELS = 20  # Most levels of contours: thin lines stay apart


def plot_surface(
    solution: Solution,
    unknown: object = None,
    values: Mapping[Any, float] | None = None,
    *,
    x: object,
    y: object,
    points: int = 101,
    ax: Axes | None = None,
    **fixed: float,
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
        a value is missing or outside its interval.
    OptionError
        If both coordinates are the same, one has a value as well, or a value is not a number.
    """
    check_solution("plot_surface", solution)
    name = state_of(solution, unknown, "plot_surface")
    points = checked_number("points", points, 2, 10_000)
    across, up = _coordinate(solution, x), _coordinate(solution, y)
    if across == up:
        raise OptionError(
            f"x and y are both {quote(across)}", term=x, remedy="choose two coordinates"
        )
    fixed_at = _fixed(merged(values, fixed), across, up)
    coordinates = solution._coordinates
    ranges = dict(zip(coordinates.names, coordinates.intervals, strict=True))
    lines = {
        one: evenly_on_scale(solution._scale(one), ranges[one], points) for one in (across, up)
    }
    heights = np.reshape(solution[name].grid({**fixed_at, **lines}), (points, points))
    if [one for one in coordinates.names if one in lines] == [across, up]:
        heights = heights.T
    drawn = axes_for(ax)
    name_fixed(drawn, solution, {one: float(at) for one, at in fixed_at.items()})
    _draw(drawn, lines[across], lines[up], heights, label_of(solution, name))
    drawn.set(xlabel=label_of(solution, across), ylabel=label_of(solution, up))
    if drawn.name != "3d":  # there ticks of logarithms would be wrong
        drawn.set(xscale=axis_scale(solution, across), yscale=axis_scale(solution, up))
    return drawn


def _coordinate(solution: Solution, key: object) -> str:
    coordinates = solution.metadata.coordinates
    name = name_of(key)
    if name not in coordinates:
        raise EvaluationError(
            f"there is no coordinate {quote(name)}{did_you_mean(name, coordinates)}",
            term=key,
            remedy=f"choose from {listing(coordinates)}",
        )
    return name


def _fixed(values: Mapping[str, float], across: str, up: str) -> dict[str, float]:
    for name, at in values.items():
        if name in (across, up):
            raise OptionError(
                f"{quote(name)} is along an axis and has a value as well",
                term=name,
                remedy="leave the value out; solution.restrict narrows the interval of a parameter",
            )
        if np.ndim(at) > 0:
            raise OptionError(
                f"{quote(name)} is {shown(at)}, not a number", term=name, remedy="fix one value"
            )
    return dict(values)


def _draw(ax: Axes, x: Array, y: Array, heights: Array, label: str) -> None:
    """Filled contours with thin lines, or a surface where the axes have three dimensions."""
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
    levels = MaxNLocator(_CONTOUR_LEVELS).tick_values(lowest, highest)
    filled = ax.contourf(x, y, heights, levels, cmap="viridis")
    ax.contour(x, y, heights, levels, colors="white", linestyles="solid", linewidths=0.4, alpha=0.6)
    ax.grid(False)
    colour_scale(ax, filled, label)
