"""Unknowns over time, for given parameters or over the box: `plot_trajectories`, `plot_bands`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from rankone.share.export.pages import CURVE_TIMES
from rankone.share.plotting import style
from rankone.share.plotting.style import (
    check_solution,
    needs_time,
    states_of,
    times_of,
    unknowns_of,
)
from rankone.solution.evaluation.domains import merged
from rankone.solution.statistics.over_box import BOX_POINTS, CENTRAL
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, shown
from rankone.support.options import checked_number
from rankone.tensors.coordinates import round_off
from rankone.tensors.joint_distribution import Correlations, Under

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D
    from matplotlib.typing import ColorType

    from rankone.solution.solution import Solution

# Strokes of the unknowns of a family of curves
_STROKES: tuple[Literal["-", "--", ":", "-."], ...] = ("-", "--", ":", "-.")


@dataclass(frozen=True)
class _Family:
    """Points (names, curves) of the parameters that vary, one for each curve."""

    names: tuple[str, ...]
    points: Array


def plot_trajectories(
    solution: Solution,
    values: Mapping[Any, ArrayLike] | None = None,
    /,
    *,
    unknowns: object = None,
    t: ArrayLike | None = None,
    ax: Axes | None = None,
    **named: ArrayLike,
) -> Axes:
    """Plot unknowns over time for given values of the parameters.

    Arrays of values broadcast as in a call and give families of curves. Where one parameter varies,
    its value is the colour; several unknowns of a family have different strokes. Curves jump where
    events reset states, and end where time does; events of few curves are ticks on the time axis.
    The title has the values of the parameters that do not vary.

    Parameters
    ----------
    solution : Solution
    values, **named
        For each parameter, by symbols or names, a number or an array.
    unknowns : symbol, str or list of them, optional
        Unknowns, or derivatives that are states; all unknowns if left out.
    t : array_like, optional
        Times; about 401 over the horizon if left out.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into; those of a new figure if left out.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    EvaluationError
        If there is no such unknown or parameter, a value is missing or outside the box, the
        shapes do not broadcast, or the solution has no time.
    OptionError
        If a name is given twice, or there is nothing to plot.
    """
    check_solution("plot_trajectories", solution)
    needs_time(solution, "curves")
    names = states_of(solution, unknowns)
    arrays = merged(values, named)
    time = solution.metadata.time
    if time in arrays and t is not None:
        raise OptionError(f"`{time}` is given twice", term=time, remedy="give it once")
    chosen = arrays.pop(time, t)
    times = times_of(solution, chosen, CURVE_TIMES)
    family = _family(solution, arrays)
    if chosen is None and solution.outcome.timeline is not None:
        times = _with_borders(solution, arrays, times)
    columns = {name: np.asarray(array)[..., None] for name, array in arrays.items()}
    shape = np.broadcast_shapes(*(column.shape for column in columns.values()), (1,))[:-1]
    tables = (solution[name](times, columns) for name in names)
    shape = (*shape, times.size)
    curves = [np.broadcast_to(table, shape).reshape(-1, times.size) for table in tables]
    axes = style.axes_for(ax)
    fixed = {n: np.ravel(array)[0] for n, array in arrays.items() if n not in family.names}
    style.name_fixed(axes, solution, {n: float(x) for n, x in fixed.items()})
    axes.set(xlabel=style.label_of(solution, time), ylabel=style.labels_of(solution, names))
    events: dict[str, Array] = {}
    if family.points.shape[1] <= style.MOST_NAMED:
        events = {
            name: own[(own >= times[0]) & (own <= times[-1])]
            for name, own in _event_times(solution, arrays)
        }
    if not family.names:
        coloured = zip(names, curves, style.colours_for(axes, len(names)), strict=True)
        lines = [axes.plot(times, rows[0], color=c, label=name)[0] for name, rows, c in coloured]
        if len(lines) > 1:
            style.name_ends(axes, lines, names)
        if ticks := _draw_events(axes, events):
            style.legend_inside(axes, ticks)
    else:
        _draw_family(axes, solution, names, times, curves, family, events)
    axes.margins(x=0.0)
    return axes


def _with_borders(solution: Solution, values: Mapping[str, Any], times: Array) -> Array:
    """Times, and both sides of each border of a timeline, where states may jump."""
    borders = solution._borders((values,), {})[0].ravel()
    inside = borders[(borders > times[0]) & (borders <= times[-1])]
    before = np.maximum(inside - 2.0 * round_off(*solution.metadata.horizon), times[0])
    return np.unique(np.concatenate([times, before, inside]))


def _event_times(solution: Solution, values: Mapping[str, Any]) -> Iterator[tuple[str, Array]]:
    """The times of each event of some curves within the horizon."""
    timeline = solution.outcome.timeline
    if timeline is None:
        return
    for name in timeline.events:
        if any(name in each for each in timeline.met):
            times = solution.event_times(name, dict(values)).ravel()
            yield name, np.unique(times[~np.isnan(times)])


def _draw_events(ax: Axes, times: Mapping[str, Array]) -> list[Line2D]:
    """Ticks on the axis of time where events occur, with the names of these as a label."""
    names = [name for name, own in times.items() if own.size]
    if not names:
        return []
    every = np.unique(np.concatenate([*times.values()]))
    along = ax.get_xaxis_transform()
    ticks = ax.plot(every, np.zeros(every.size), "|", color="0.3", transform=along)[0]
    label = f"at {', '.join(names)}" if len(names) <= style.MOST_IN_LABEL else "at events"
    ticks.set(markersize=10, markeredgewidth=1, label=label, clip_on=False)
    return [ticks]


def _family(solution: Solution, values: Mapping[str, Any]) -> _Family:
    """The curves for values of the parameters, checked."""
    checked = solution._coordinates.gather((solution.time[0],), dict(values))
    arrays = solution._coordinates.arrays(checked)
    points, _ = solution._coordinates.broadcast(arrays)
    if not points.shape[1]:
        raise OptionError("there is no curve: an array of values is empty", remedy="give values")
    varying = [j for j in range(1, len(points)) if np.ptp(points[j]) > 0.0]
    names = solution._coordinates.names
    return _Family(tuple(names[j] for j in varying), points[varying])


def _draw_family(
    ax: Axes,
    solution: Solution,
    names: Sequence[str],
    times: Array,
    curves: Sequence[Array],
    family: _Family,
    events: Mapping[str, Array],
) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, LogNorm, Normalize

    pairs = (zip(family.names, point, strict=True) for point in family.points.T)
    titles = [", ".join(f"{name} = {x:.4g}" for name, x in point) for point in pairs]
    few = len(titles) <= style.MOST_NAMED
    colours = _colours(solution, family)
    strokes = [_STROKES[i % len(_STROKES)] for i in range(len(names))]
    for stroke, rows in zip(strokes, curves, strict=True):
        for colour, title, row in zip(colours, titles, rows, strict=True):
            label = title if few and stroke == strokes[0] else f"_{title}"
            ax.plot(times, row, color=colour, linestyle=stroke, label=label, linewidth=1)
    handles = []
    if len(names) > 1:
        styled = zip(names, strokes, strict=True)
        handles = [style.line_key(name, ls=s) for name, s in styled]
    if few:
        named = zip(titles, colours, strict=True)
        handles += [style.line_key(title, colour) for title, colour in named]
    elif len(family.names) == 1:
        row, shades = family.points[0], style.shades(np.linspace(0.0, 1.0, 256))
        norm = LogNorm if style.axis_scale(solution, family.names[0]) == "log" else Normalize
        mappable = ScalarMappable(norm(row.min(), row.max()), ListedColormap(shades))
        style.colour_scale(ax, mappable, style.label_of(solution, family.names[0]))
    handles += _draw_events(ax, events)
    if handles and few:
        style.legend_beside(ax, handles)
    elif handles:
        style.legend_inside(ax, handles)


def _colours(solution: Solution, family: _Family) -> Sequence[ColorType]:
    """A colour for each curve: of its value on its axis, where one parameter varies."""
    count = family.points.shape[1]
    if len(family.names) == 1:
        row = family.points[0]
        if style.axis_scale(solution, family.names[0]) == "log":
            row = np.log(row)
        return style.shades((row - row.min()) / np.ptp(row))
    if count <= style.MOST_NAMED:
        return list(style.PALETTE[:count])
    from matplotlib.colors import to_rgba

    return [to_rgba(style.PALETTE[0], 0.35)] * count


def plot_bands(
    solution: Solution,
    unknowns: object = None,
    t: ArrayLike | None = None,
    *,
    quantiles: tuple[float, float] | None = None,
    sigmas: float | None = None,
    under: Under = None,
    correlation: Correlations = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot the mean over the box and a band around it, over time.

    Parameters
    ----------
    solution : Solution
    unknowns : symbol, str or list of them, optional
        All unknowns if left out.
    t : array_like, optional
        Times; about 201 over the horizon if left out.
    quantiles : (float, float), optional
        Probabilities at the lower and the upper end of the band; 0.025 and 0.975 if left out.
    sigmas : float, optional
        Half width of the band in standard deviations, in place of quantiles.
    under, correlation : mapping, optional
        Distributions of parameters and correlations of pairs of them, as for
        :meth:`rankone.Solution.mean`.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into; those of a new figure if left out.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    EvaluationError
        If there is no such unknown, a time is outside the horizon, or the solution has no time.
    OptionError
        If quantiles or sigmas are out of their range or both given, or ``under`` or
        ``correlation`` do not fit.
    """
    check_solution("plot_bands", solution)
    needs_time(solution, "bands")
    names = unknowns_of(solution, unknowns)
    ends = _probabilities(quantiles, sigmas)
    times = times_of(solution, t, style.SMOOTH_POINTS)
    rows = [solution.unknowns.index(name) for name in names]
    statistics = solution._statistics(under, correlation)
    mean = statistics.mean(times)[rows]
    if sigmas is None:
        lower, upper = statistics.quantiles(times, np.array(ends), BOX_POINTS)[0][:, rows]
        meaning = f"{100 * ends[0]:.3g} to {100 * ends[1]:.3g} %"
    else:
        spread = sigmas * np.sqrt(statistics.variance(times)[rows])
        lower, upper = mean - spread, mean + spread
        meaning = f"± {sigmas:g} std"
    axes = style.axes_for(ax)
    axes.set(
        xlabel=style.label_of(solution, solution.metadata.time),
        ylabel=style.labels_of(solution, names),
    )
    _draw_bands(axes, names, times, (lower, mean, upper), meaning)
    axes.margins(x=0.0)
    return axes


def _probabilities(
    quantiles: tuple[float, float] | None, sigmas: float | None
) -> tuple[float, float]:
    if sigmas is not None:
        checked_number("sigmas", sigmas, 0, kind=float)
        if quantiles is not None:
            raise OptionError("quantiles and sigmas are both given", remedy="choose one of them")
    if quantiles is None:
        return CENTRAL
    try:
        lower, upper = (float(q) for q in quantiles)
        valid = 0.0 <= lower < upper <= 1.0
    except (TypeError, ValueError):
        valid = False
    if not valid:
        raise OptionError(
            f"quantiles={shown(quantiles)} are not valid",
            term=quantiles,
            remedy="two ascending probabilities, for example (0.025, 0.975)",
        )
    return lower, upper


def _draw_bands(
    ax: Axes, names: Sequence[str], times: Array, band: tuple[Array, Array, Array], meaning: str
) -> None:
    """A line and a band for each unknown, (unknowns, times) each."""
    lines = []
    colours = style.colours_for(ax, len(names))
    for name, colour, lower, mean, upper in zip(names, colours, *band, strict=True):
        ax.fill_between(times, lower, upper, color=colour, **style.BAND)
        lines += ax.plot(times, mean, color=colour, label=f"mean of {name}")
    alone = len(names) == 1
    colour = colours[0] if alone else "0.3"
    handles = [style.line_key("mean", colour), style.band_key(meaning, colour)]
    if alone or np.isfinite(band[1][:, -1]).all():
        style.legend_inside(ax, handles)
    else:
        style.legend_beside(ax, handles)
    if not alone:
        style.name_ends(ax, lines, names)
