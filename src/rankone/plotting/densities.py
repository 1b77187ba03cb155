"""Densities of unknowns: `plot_density`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from rankone.plotting import style
from rankone.plotting.arguments import check_solution, sometimes_of, unknown_of
from rankone.statistics.joint_distribution import Correlations, Under
from rankone.support.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.interface.solution import Solution


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
