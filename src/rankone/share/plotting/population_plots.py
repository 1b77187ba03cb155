"""Curves of the subjects of a population, and its predictive check: `plot_population`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from rankone.inference.populations.population_fit import PopulationFit
from rankone.inference.populations.predictive_check import PredictiveCheck
from rankone.share.plotting import style
from rankone.share.plotting.arguments import fine_times
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.solution.solution import Solution

_MOST_PANELS = 12  # Subjects that are drawn if none are named
_CURVE_TIMES = 201
_TYPICAL = "0.55"  # Grey of the curves of typical subjects


def plot_population(
    fit: PopulationFit | PredictiveCheck,
    *,
    subjects: Iterable[object] | None = None,
    observable: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Sequence[Axes]:
    """Plot the fitted curves of subjects, or a visual predictive check.

    Of a fit, a panel for each subject with its data, its fitted curve, and dashed the curve of a
    typical subject with its covariates. Of a predictive check, the data, the quantiles of the data
    as lines, and the bands of simulated quantiles.

    Parameters
    ----------
    fit : PopulationFit or PredictiveCheck
        What :meth:`rankone.Solution.fit_population` or its ``predictive_check`` returns.
    subjects : iterable, optional
        Names of the subjects to draw; the first twelve if left out.
    observable : str, optional
        What to draw of a fit; the first observable if left out.
    ax : matplotlib.axes.Axes or several, optional
        One for each subject, or one for a check; those of a new figure if left out.

    Returns
    -------
    sequence of matplotlib.axes.Axes
        Those that were drawn into.

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    OptionError
        If there is no such subject or observable, or ``ax`` does not fit.
    """
    if isinstance(fit, PredictiveCheck):
        if subjects is not None or observable is not None:
            raise OptionError(
                "a predictive check is of one observable and all subjects",
                remedy="leave subjects and observable out",
            )
        axes = style.axes_for(ax)
        _draw_check(fit, axes)
        return (axes,)
    if not isinstance(fit, PopulationFit):
        raise OptionError(
            f"plot_population needs a PopulationFit, not {type(fit).__name__}",
            term=fit,
            remedy="give what solution.fit_population(...) returns, or its predictive_check()",
        )
    names = _subjects(fit, subjects)
    observed = fit.measured(observable)
    title = f"{observed.name}: data, fitted curves, and typical ones dashed"
    panels = style.several_axes(ax, len(names), title)
    solution = cast("Solution", fit.solution)
    for name, panel in zip(names, panels, strict=True):
        _draw_subject(fit, name, observed.name, panel)
        panel.set_xlabel(style.label_of(solution, solution.metadata.time))
        panel.set_ylabel(style.label_of(solution, observed.name))
    return tuple(panels)


def _subjects(fit: PopulationFit, given: Iterable[object] | None) -> list[str]:
    """Names of the subjects to draw."""
    if given is None:
        return list(fit.subjects[:_MOST_PANELS])
    several = isinstance(given, Iterable) and not isinstance(given, str)
    names = [str(each) for each in (given if several else [given])]
    for name in names:
        if name not in fit.subjects:
            raise OptionError(
                f"there is no subject {quote(name)}{did_you_mean(name, fit.subjects)}",
                term=name,
                remedy=f"choose from {listing(fit.subjects[:_MOST_PANELS])}",
            )
    return names


def _draw_subject(fit: PopulationFit, name: str, observable: str, ax: Axes) -> None:
    one = fit.measured(observable)
    records = np.flatnonzero(fit.owner == fit.subjects.index(name))
    last = float(one.times[records][one.present[records]].max(initial=0.0))
    times = fine_times(cast("Solution", fit.solution), last, _CURVE_TIMES)
    own = np.atleast_2d(fit.curve(name, times, observable=observable))
    typical = np.atleast_2d(fit.curve(name, times, observable=observable, typical=True))
    colours = style.colours_for(ax, len(records))
    for record, colour, curve, expected in zip(records, colours, own, typical, strict=True):
        here = one.present[record]
        ax.plot(times, expected, "--", color=_TYPICAL, linewidth=1.0)
        ax.plot(times, curve, color=colour)
        data = one.times[record, here], one.data[record, here]
        ax.plot(*data, "o", color=colour, markersize=4, markerfacecolor="white")
    ax.set_title(name, fontsize="medium")


def _draw_check(check: PredictiveCheck, ax: Axes) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    middle = len(check.quantiles) // 2
    for q, share in enumerate(check.quantiles):
        colour = style.PALETTE[1] if q == middle else style.PALETTE[0]
        low, _, high = check.simulated[q]
        label = f"{100 * share:g} % quantile"
        ax.fill_between(check.times, low, high, color=colour, alpha=0.25, linewidth=0)
        ax.plot(check.times, check.observed[q], color=colour, label=label)
    points = ax.plot(*check.data, "o", color="0.6", markersize=2.5, zorder=1, label="data")
    solution = cast("Solution", check.solution)
    ax.set_xlabel(style.label_of(solution, solution.metadata.time))
    corrected = ", predictions corrected" if check.corrected else ""
    ax.set_ylabel(f"{style.label_of(solution, check.observable)}{corrected}")
    shares = [f"{100 * share:g}" for share in check.quantiles]
    style.legend_above(
        ax,
        [
            *points,
            Line2D([], [], color="0.3", label=f"quantiles of data: {', '.join(shares)} %"),
            Patch(
                color="0.3", alpha=0.25, linewidth=0, label=f"simulated: {100 * check.level:g} %"
            ),
        ],
    )
