"""Densities, base functions, surfaces, and what happened in the loops of a solve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.share.export.pages import CURVE_TIMES
from rankone.share.plotting import style
from rankone.share.plotting.style import (
    MOST_NAMED,
    axes_for,
    axis_scale,
    check_solution,
    colour_scale,
    figure_of,
    label_of,
    name_fixed,
    several_axes,
    sometimes_of,
    state_of,
    unknown_of,
)
from rankone.solution.evaluation.domains import merged
from rankone.solvers.engines.engine_options import CrossRecord
from rankone.solvers.engines.greedy_engine import EquationRecord, GreedySlabRecord
from rankone.solvers.outcome import SlabRecord
from rankone.support.arrays import COINCIDENT, Array
from rankone.support.errors import (
    EvaluationError,
    OptionError,
    count,
    did_you_mean,
    listing,
    quote,
    shown,
)
from rankone.support.options import checked_number
from rankone.tensors import Logarithm
from rankone.tensors.coordinates import evenly_on_scale, name_of
from rankone.tensors.joint_distribution import Correlations, Under

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
        axes.fill_between(density.values, density.density, color=colour, **style.BAND)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel(style.label_of(solution, name))
    axes.set_ylabel("density")
    if times is not None:
        style.legend_inside(axes, axes.get_lines())
    return axes


# -----------------------------------------------------------------------------
# The base functions of one unknown: `plot_modes`.


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
        points = axis.scale.from_scale(np.linspace(start, end, CURVE_TIMES))
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
    if highest - lowest <= COINCIDENT * max(abs(lowest), abs(highest)):
        lowest, highest = lowest - 0.5, highest + 0.5
    levels = MaxNLocator(_CONTOUR_LEVELS).tick_values(lowest, highest)
    filled = ax.contourf(x, y, heights, levels, cmap="viridis")
    ax.contour(x, y, heights, levels, colors="white", linestyles="solid", linewidths=0.5, alpha=0.5)
    ax.grid(False)
    colour_scale(ax, filled, label)


# -----------------------------------------------------------------------------
# What happened in the loops of a solve: `plot_history`.


def plot_history(
    solution: Solution, *, slab: int = -1, ax: Sequence[Axes] | NDArray[np.object_] | None = None
) -> NDArray[np.object_]:
    """Plot what happened in the loops of a solve.

    For ``method="greedy"``, on one slab: change of each new mode in the passes of its fixed point,
    residual after every enrichment, amplitudes of the modes in the end; for all slabs: change of
    the unknowns in every update of the lagged terms. For ``method="train"``: change in every sweep
    of each slab, and the ranks of the slabs. For ``method="cross"``, which has one record for each
    attempt: size of the two highest modes of each parameter, and the ranks.

    Parameters
    ----------
    slab : int
        Slab of the first three plots of ``method="greedy"``: an index into the accepted slabs of
        the last attempt.
    ax : sequence of matplotlib.axes.Axes, optional
        Axes to draw into: four for ``method="greedy"``, else two. Those of a new figure, which has
        a title, if left out.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        One for each panel.

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    EvaluationError
        If there is no history.
    OptionError
        If there is no such slab, or ``ax`` are not as many axes as there are panels.
    """
    check_solution("plot_history", solution)
    if not solution.history:
        raise EvaluationError("there is no history to plot")
    last = max(record.attempt for record in solution.history)
    records = [record for record in solution.history if record.attempt == last]
    if isinstance(records[-1], CrossRecord):
        return _plot_attempts(solution, records[-1].slabs, ax)
    accepted = [record for record in records if record.accepted] or records
    if not -len(accepted) <= slab < len(accepted):
        raise OptionError(f"slab={slab!r} is out of range", remedy=f"there are {len(accepted)}")
    chosen = accepted[slab]
    if isinstance(chosen, GreedySlabRecord) and chosen.equations:
        over = f"slab [{chosen.start:.3g}, {chosen.end:.3g}]"
        title = f"{solution.metadata.method}, {over}; updates of all slabs"
        axes = several_axes(ax, 4, title)
        _plot_fixed_points(axes[0], chosen.equations)
        _plot_residuals(axes[1], chosen.equations, chosen.tolerance)
        _plot_amplitudes(axes[2], chosen.equations)
        _plot_changes(axes[3], records, "update of the lagged terms")
        return axes
    title = f"{solution.metadata.method}, {count(len(records), 'slab')}"
    axes = several_axes(ax, 2, title)
    _plot_changes(axes[0], records, "sweep" if solution.metadata.method == "train" else "update")
    _plot_ranks(axes[1], records)
    return axes


def _plot_fixed_points(axes: Axes, equations: Sequence[EquationRecord]) -> None:
    """One line for each new mode; with lagged terms there are many, the later the darker."""
    runs = [mode.differences for record in equations for mode in record.modes]
    for i, differences in enumerate(runs):
        shade = 0.25 + 0.75 * (i + 1) / len(runs)
        axes.semilogy(
            range(1, len(differences) + 1), _positive(differences), "o-", color="C0", alpha=shade
        )
    axes.set(xlabel="pass over the dimensions", title="fixed point: change of a new mode")


def _plot_residuals(axes: Axes, equations: Sequence[EquationRecord], tolerance: float) -> None:
    """Residuals after every enrichment, over all updates, a line for each solve."""
    for color, state in enumerate(dict.fromkeys(record.state for record in equations)):
        count = 0
        for record in (record for record in equations if record.state == state):
            residuals = [mode.residual for mode in record.modes]
            steps = range(count + 1, count + 1 + len(residuals))
            label = state if not count and residuals else None
            axes.semilogy(steps, _positive(residuals), ".-", color=f"C{color}", label=label)
            count += len(residuals)
    axes.axhline(tolerance, color="grey", linestyle=":", label="tolerance")
    axes.set(xlabel="enrichment, over all updates", title="residual")
    axes.legend(fontsize="small")


def _plot_amplitudes(axes: Axes, equations: Sequence[EquationRecord]) -> None:
    """Amplitudes of the last solve of every state."""
    last = {record.state: record.amplitudes for record in equations}
    for state, amplitudes in last.items():
        axes.semilogy(range(1, len(amplitudes) + 1), _positive(amplitudes), "o-", label=state)
    axes.set(xlabel="mode", title="amplitudes in the end")
    axes.legend(fontsize="small")


def _plot_changes(axes: Axes, records: Sequence[SlabRecord], step: str) -> None:
    """Changes in every sweep or update, a line for each slab; rejected ones are dashed."""
    few = len(records) <= MOST_NAMED
    for i, record in enumerate(records):
        axes.semilogy(
            range(1, len(record.residuals) + 1),
            _positive(record.residuals),
            "o-" if record.accepted else "x--",
            label=f"[{record.start:.3g}, {record.end:.3g}]",
            color=f"C{i}" if few else "C0",
            alpha=1.0 if few else 0.35,
        )
    axes.set(xlabel=step, title="largest change of a state, in units of its size")
    if few:
        axes.legend(title="slab", fontsize="small")


def _plot_attempts(solution: Solution, slabs: int, ax: object) -> NDArray[np.object_]:
    """For each parameter its highest modes and the rank before it, a line for each attempt."""
    records = solution.history
    title = f"cross, {count(slabs, 'slab')}, {count(len(records), 'attempt')}"
    axes = several_axes(ax, 2, title)
    names = solution.metadata.parameters
    for record in records:
        label = f"{record.attempt + 1}"
        axes[0].semilogy(range(len(names)), _positive(record.residuals), "o-", label=label)
        axes[1].plot(range(len(names)), record.ranks, "o-", label=label)
    axes[0].set(title="two highest modes, in units of a state's size")
    axes[1].set(title="ranks before each parameter")
    for panel in axes:
        panel.set_xticks(range(len(names)), names)
        panel.set_xlabel("parameter")
        panel.legend(title="attempt", fontsize="small")
    return axes


def _plot_ranks(axes: Axes, records: Sequence[SlabRecord]) -> None:
    """Ranks of the accepted slabs over time, a line for each bond of the train."""
    accepted = [record for record in records if record.accepted and record.ranks]
    for bond in range(max((len(record.ranks) for record in accepted), default=0)):
        edges = [*(record.start for record in accepted), accepted[-1].end]
        axes.stairs([record.ranks[bond] for record in accepted], edges, label=f"{bond + 1}")
    axes.set(xlabel="time", title="ranks")
    if accepted:
        axes.legend(title="bond", fontsize="small")


def _positive(sizes: Sequence[float]) -> list[float]:
    """Sizes for a logarithmic axis: zeros and infinities leave gaps."""
    return [size if 0.0 < size < float("inf") else float("nan") for size in sizes]
