"""Densities, base functions and surfaces of unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.share.plotting import style
from rankone.share.plotting.arguments import check_solution, sometimes_of, state_of, unknown_of
from rankone.share.plotting.style import (
    axes_for,
    axis_scale,
    colour_scale,
    figure_of,
    label_of,
    name_fixed,
    several_axes,
)
from rankone.solution.evaluation.smaller import merged
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.options import checked_number
from rankone.support.wording import did_you_mean, listing, quote, shown
from rankone.tensors.bases import Logarithm
from rankone.tensors.bases.coordinates import name_of
from rankone.tensors.bases.joint_distribution import Correlations, Under
from rankone.tensors.bases.scales import evenly_on_scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.solution.solution import Solution


def plot_density(
    solution: Solution,
    unknown: object = None,
    t: ArrayLike | None = None,
    *,
    under: Under = None,
    correlation: Correlations = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot the probability density of an unknown at one time or at several.

    Parameters
    ----------
    solution : Solution
    unknown : name or symbol, optional
        By default the first unknown.
    t : float or array_like
        Times; none if nothing depends on time.
    under, correlation
        As for :meth:`rankone.Solution.density`.
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    OptionError, EvaluationError
        As for :meth:`rankone.Solution.density`.
    """
    check_solution("plot_density", solution)
    name = unknown_of(solution, unknown)
    if t is None and not solution.metadata.timeless:
        start, end = solution.time
        remedy = f"give a number in [{start:g}, {end:g}], or several"
        raise OptionError("this plot needs a time", remedy=remedy)
    times = sometimes_of(solution, t, 1)
    axes = style.axes_for(ax)
    instants = [None] if times is None else [float(time) for time in times]
    colours = style.colours_for(axes, len(instants))
    for instant, colour in zip(instants, colours, strict=True):
        density = solution.density(instant, unknown=name, under=under, correlation=correlation)
        clock = solution.metadata.time
        label = None if instant is None else style.value_of(solution, clock, instant)
        axes.plot(density.values, density.density, color=colour, label=label)
        axes.fill_between(density.values, density.density, color=colour, alpha=0.15, linewidth=0)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel(style.label_of(solution, name))
    axes.set_ylabel("density")
    if times is not None:
        style.legend_inside(axes, axes.get_lines())
    return axes


# -----------------------------------------------------------------------------
# The base functions of one unknown: `plot_modes`.


_POINTS = 301  # Points at which a base function is drawn


def plot_modes(
    solution: Solution,
    unknown: object = None,
    *,
    modes: int = 5,
    rtol: float = 1e-3,
    ax: Sequence[Axes] | NDArray[np.object_] | None = None,
) -> NDArray[np.object_]:
    """Plot the base functions of one unknown, T_i(t), P_i(p), ..., and their amplitudes.

    They are those of :meth:`rankone.Solution.to_canonical`: of unit mean square, and in one
    parameter orthonormal.

    Parameters
    ----------
    unknown : symbol or str, optional
        May be left out if there is only one.
    modes : int
        Most modes drawn; the amplitudes are always shown for all.
    rtol : float
        Tolerance of the canonical form.
    ax : sequence of matplotlib.axes.Axes, optional
        Axes to draw into, one for each coordinate and one for the amplitudes. Those of a new
        figure, which has a title, if left out.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        One for each panel.

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    EvaluationError
        If there are several unknowns and none was chosen, or there is no such unknown.
    OptionError
        If an option is out of its range, or ``ax`` are not as many axes as there are panels.
    """
    check_solution("plot_modes", solution)
    if modes < 1:
        raise OptionError(f"modes={modes!r} is too small", remedy="at least 1")
    name = state_of(solution, unknown, "plot_modes")
    form = solution.to_canonical(rtol)[name]
    title = f"{name}: {form.rank} modes, mean square error {form.error:.1e}"
    axes = several_axes(ax, len(form.axes) + 1, title)
    shown = min(modes, form.rank)
    for panel, axis in zip(axes, form.axes, strict=False):
        start, end = axis.scale.to_scale(np.array([axis.breaks[0], axis.breaks[-1]]))
        points = axis.scale.from_scale(np.linspace(start, end, _POINTS))
        functions = axis.interpolate(form.factors[axis.name][:, :shown], points)
        for i, column in enumerate(functions.T):
            panel.plot(points, column, label=f"{i + 1}")
        panel.set(xlabel=axis.name, title=f"functions of {axis.name}")
        if isinstance(axis.scale, Logarithm):
            panel.set_xscale("log")
    if shown:
        lines = axes[0].get_lines()[-shown:]
        if ax is None:
            figure_of(axes[0]).legend(handles=lines, title="mode", loc="outside right upper")
        else:
            axes[0].legend(handles=lines, title="mode", fontsize="small")
        axes[-1].semilogy(range(1, form.rank + 1), form.amplitudes, "o-")
    axes[-1].set(xlabel="mode", title="amplitudes")
    return axes


# -----------------------------------------------------------------------------
# An unknown over two coordinates: `plot_surface`.


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
