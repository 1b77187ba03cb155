"""What the parameters do to an unknown: `plot_sobol` and `plot_main_effects`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from rankone.share.plotting import style
from rankone.share.plotting.style import check_solution, one_time, sometimes_of, unknown_of
from rankone.solution.statistics.over_box import VISIBLE_HALF_WIDTH
from rankone.solution.statistics.solution_statistics import Sobol
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError, did_you_mean, quote, shown
from rankone.tensors.joint_distribution import Correlations, Under

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from rankone.solution.solution import Solution

_EFFECT_POINTS = 101  # Values of each parameter at which its main effect is drawn

_WORDS = {"first": "first-order", "total": "total"}


Kind = Literal["total", "first", "both"]


def plot_sobol(
    solution: Solution,
    unknown: object = None,
    t: ArrayLike | None = None,
    *,
    kind: Kind = "total",
    under: Under = None,
    correlation: Correlations = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot the Sobol indices of one unknown: lines over time, or bars at one time.

    Bands around lines, and whiskers of bars, are the half-widths of 95 % of the indices. There are
    no indices where the standard deviation is below the measured error of the solution.

    Parameters
    ----------
    solution : Solution
    unknown : symbol or str, optional
        The first if left out.
    t : float or array_like, optional
        One time for bars, or times; about 201 over the horizon if left out. Where nothing depends
        on time there are bars.
    kind : {"total", "first", "both"}
        Total indices; first-order ones, stacked over time with the share of interactions on top; or
        both as lines.
    under : mapping, optional
        Distributions of parameters, as for :meth:`rankone.Solution.mean`.
    correlation : mapping, optional
        There are no indices of correlated parameters: ``{}`` where the problem has correlations.
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
        If there is no such unknown or no parameter, a time is outside the horizon, or there
        are no indices at any time.
    OptionError
        If ``kind`` is unknown, ``under`` does not fit, or parameters are correlated.
    """
    check_solution("plot_sobol", solution)
    name = unknown_of(solution, unknown)
    if kind not in get_args(Kind):
        raise OptionError(
            f"kind={shown(kind)} is unknown{did_you_mean(str(kind), get_args(Kind))}",
            term=kind,
            remedy="choose 'total', 'first' or 'both'",
        )
    _needs_parameters(solution)
    times = sometimes_of(solution, t, style.SMOOTH_POINTS)
    indices, _ = solution._indices(times, solution._statistics(under, correlation))
    shares, halves = _shares(indices, name, kind)
    if not any(np.isfinite(table).any() for table in shares.values()):
        raise EvaluationError(
            f"{quote(name)} does not vary by more than its error: there are no Sobol indices",
            term=name,
            remedy="choose a time at which it depends on the parameters",
        )
    axes = style.axes_for(ax)
    if times is None or times.size == 1:
        when = _at(solution, None if times is None else float(times[0]))
        _draw_bars(
            axes, indices.parameters, {k: table[:, 0] for k, table in shares.items()}, halves
        )
        axes.set_xlabel(_title(shares, name) + when)
        return axes
    axes.set(xlabel=style.label_of(solution, solution.metadata.time), ylabel=_title(shares, name))
    axes.set_xlim(times.min(), times.max())
    axes.set_ylim(0.0, 1.0 if kind == "first" else 1.02 * max(1.0, np.nanmax(shares["total"])))
    if kind == "first":
        _draw_stack(axes, indices.parameters, times, shares["first"])
    else:
        _draw_lines(axes, indices.parameters, times, shares, halves)
    return axes


def plot_main_effects(
    solution: Solution,
    unknown: object = None,
    t: ArrayLike | None = None,
    *,
    under: Under = None,
    correlation: Correlations = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot the mean of an unknown given one parameter, as a function of each parameter.

    All curves share the abscissa, on which the range of each parameter has the length one. The
    dotted line is the mean over all parameters.

    Parameters
    ----------
    solution : Solution
    unknown : symbol or str, optional
        The first if left out.
    t : float
        The time; left out for solutions without time.
    under, correlation : mapping, optional
        Distributions of parameters and correlations of pairs of them, as for
        :meth:`rankone.Solution.main_effects`.
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
        If there is no such unknown or no parameter, or the time is outside the horizon.
    OptionError
        If there is no time, or ``under`` or ``correlation`` do not fit.
    """
    check_solution("plot_main_effects", solution)
    name = unknown_of(solution, unknown)
    _needs_parameters(solution)
    time = one_time(solution, t)
    statistics = solution._statistics(under, correlation)
    effects = solution._main_effects(time, _EFFECT_POINTS, statistics)
    row = solution.unknowns.index(name)
    mean = solution._at(time, statistics.mean)[row]
    axes = style.axes_for(ax)
    colours = style.colours_for(axes, len(effects.parameters))
    for parameter, colour in zip(effects.parameters, colours, strict=True):
        shares = style.shares_of(solution, parameter, effects.values[parameter])
        label = style.range_of(solution, parameter)
        axes.plot(shares, effects.means[parameter][row], color=colour, label=label)
    axes.axhline(float(mean), color="0.4", linestyle=":", linewidth=1, zorder=1.5)
    when = _at(solution, time)
    axes.set(
        xlabel="parameter within its range",
        ylabel=f"mean of {style.label_of(solution, name)}{when}",
        xticks=[0.0, 0.25, 0.5, 0.75, 1.0],
        xticklabels=["smallest", "", "middle", "", "largest"],
    )
    axes.margins(x=0.0)
    style.legend_beside(axes, axes.get_legend_handles_labels()[0][-len(effects.parameters) :])
    return axes


def _needs_parameters(solution: Solution) -> None:
    if not solution.parameters:
        raise EvaluationError(
            "the solution has no parameters: nothing varies",
            remedy="plot_trajectories plots its unknowns over time",
        )


def _at(solution: Solution, time: float | None) -> str:
    return "" if time is None else f" at {style.value_of(solution, solution.metadata.time, time)}"


def _shares(indices: Sobol, name: str, kind: Kind) -> tuple[dict[str, Array], dict[str, Array]]:
    """Tables (parameters, times) of one unknown and of their half-widths, by kind of indices."""
    row, count = indices.unknowns.index(name), len(indices.parameters)
    shares, halves = {}, {}
    for each in ("total", "first"):
        if kind in (each, "both"):
            shares[each] = np.reshape(getattr(indices, each)[row], (count, -1))
            half_width = getattr(indices, f"{each}_half_width")[row]
            halves[each] = np.reshape(half_width, (count, -1))
    return shares, halves


def _visible(half_widths: Array) -> Array | None:
    """Half-widths, or None if none would be seen."""
    half_widths = np.nan_to_num(half_widths)
    return half_widths if half_widths.max(initial=0.0) > VISIBLE_HALF_WIDTH else None


def _title(shares: Mapping[str, Array], name: str) -> str:
    kinds = [_WORDS[kind] for kind in shares if len(shares) == 1]
    return " ".join([*kinds, f"Sobol indices of {name}"])


def _draw_bars(
    ax: Axes,
    parameters: Sequence[str],
    shares: Mapping[str, Array],
    halves: Mapping[str, Array],
) -> None:
    """Horizontal bars, the largest on top; first-order indices inside of total ones."""
    order = np.argsort(next(iter(shares.values())), kind="stable")
    longest = np.max([*shares.values()], axis=0)[order]
    places = np.arange(len(order))
    for kind, row in shares.items():
        inner = kind == "first" and len(shares) > 1
        ax.barh(
            places,
            row[order],
            height=0.36 if inner else 0.68,
            color=style.PALETTE[0] if inner or len(shares) == 1 else style.PALETTE[5],
            label=_WORDS[kind],
        )
        if (half := _visible(halves[kind][order, 0])) is not None:
            apart = 0.26 * (kind == "total" and len(shares) > 1)
            where = row[order], places - apart
            ax.errorbar(*where, xerr=half, fmt="none", ecolor="0.3", elinewidth=1, capsize=2)
    longest_end = longest + np.nan_to_num(np.max([each[order, 0] for each in halves.values()], 0))
    for place, length, end in zip(places, longest, longest_end, strict=True):
        ax.annotate(
            f"{length:.2f}",
            (end, place),
            xytext=(4, 0),
            textcoords="offset points",
            verticalalignment="center",
        )
    ax.set_yticks(places, [parameters[i] for i in order])
    ax.tick_params(axis="y", length=0)
    ax.grid(False, axis="y")
    ax.set_xlim(0.0, max(1.0, 1.1 * float(longest_end.max())))
    if len(shares) > 1:
        ax.legend(loc="lower right", fontsize="small")


def _draw_stack(ax: Axes, parameters: Sequence[str], times: Array, shares: Array) -> None:
    """Shares of the variance above each other, with interactions on top."""
    from matplotlib.patches import Patch

    interactions = np.clip(1.0 - shares.sum(axis=0), 0.0, None)
    colours = [*style.colours_for(ax, len(parameters)), "0.85"]
    names = [*parameters, "interactions"]
    ax.stackplot(
        times, np.vstack([shares, interactions]), colors=colours, edgecolor="white", linewidth=0.5
    )
    pairs = zip(names, colours, strict=True)
    style.legend_beside(ax, [Patch(color=colour, label=name) for name, colour in pairs][::-1])


def _draw_lines(
    ax: Axes,
    parameters: Sequence[str],
    times: Array,
    shares: Mapping[str, Array],
    halves: Mapping[str, Array],
) -> None:
    """A line with a band for each parameter, first-order indices dashed."""
    lines, banded = [], False
    colours = style.colours_for(ax, len(parameters))
    for kind, stroke in (("total", "-"), ("first", "--")):
        for position, (name, colour, row) in enumerate(
            zip(parameters, colours, shares.get(kind, ()), strict=False)
        ):
            label = name if kind == "total" else f"_{name}"
            half = _visible(halves[kind][position])
            if half is not None:
                ax.fill_between(times, row - half, row + half, color=colour, **style.BAND)
                banded = True
            (line,) = ax.plot(times, row, stroke, color=colour, label=label)
            lines += [line] if kind == "total" else []
    handles: list[Artist] = []
    if len(shares) > 1:
        strokes = (("total", "-"), ("first-order", "--"))
        handles += [style.line_key(word, ls=s) for word, s in strokes]
    if banded:
        handles.append(style.band_key("± half-width of 95 %"))
    if handles:
        style.legend_inside(ax, handles)
    style.name_ends(ax, lines, parameters)
