"""What data say about parameters and populations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.design import Design
from rankone.inference.estimation.fit import Fit
from rankone.inference.estimation.identification import Stop
from rankone.inference.estimation.posterior import Posterior
from rankone.inference.populations.population import PopulationFit
from rankone.inference.populations.predictive_check import PredictiveCheck
from rankone.share.plotting import style
from rankone.share.plotting.style import fine_times
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, check_kind, did_you_mean, listing, quote
from rankone.support.options import LEVEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

    from rankone.solution.solution import Solution


_SAMPLES = 20_000  # Points from which pairs of parameters are drawn
_BINS = 40  # Bins of a pair in each direction
_LEVELS = (LEVEL, 0.5)  # Shares of the probability inside of contours
_SHOWN_RISE = 2.5  # Largest rise of a profile that is shown, in units of that at the interval


def plot_posterior(
    posterior: Posterior, *, seed: int = 0, ax: object = None
) -> NDArray[np.object_]:
    """Plot the marginal density of each parameter, and of each pair below: a corner plot.

    The 95 % interval of each parameter is shaded; contours hold 50 and 95 % of a pair.

    Parameters
    ----------
    posterior : Posterior
        What :meth:`rankone.Solution.posterior` or :func:`rankone.posterior` returns.
    seed : int
        Of the random points from which pairs are drawn.
    ax : axes of Matplotlib, (n, n), optional

    Returns
    -------
    ndarray (n, n) of matplotlib.axes.Axes
        Those above the diagonal are hidden.

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    OptionError
        If it is no posterior, or there are not n times n axes.
    """
    check_kind(
        "plot_posterior", posterior, Posterior, remedy="give what solution.posterior(...) returns"
    )
    names = posterior.parameters
    axes = _square(ax, len(names))
    solution = cast("Solution", posterior.fit.solution)
    points = posterior.sample(_SAMPLES, seed=seed)
    wide = posterior.interval(0.998)
    ends = {name: _padded(*wide[name]) for name in names}
    for i, row in enumerate(names):
        for j, column in enumerate(names):
            panel = axes[i, j]
            if j > i:
                panel.set_visible(False)
                continue
            if i == j:
                _draw_marginal(panel, posterior, row, ends[row])
            else:
                _draw_pair(panel, points[column], points[row], (ends[column], ends[row]))
            panel.set_xlim(*ends[column])
            panel.tick_params(labelbottom=i == len(names) - 1, labelleft=j == 0 < i)
            if i == len(names) - 1:
                panel.set_xlabel(style.label_of(solution, column))
            if j == 0 < i:
                panel.set_ylabel(style.label_of(solution, row))
    return axes


def plot_profiles(
    fit: Fit, parameters: Sequence[object] | None = None, *, ax: object = None
) -> NDArray[np.object_]:
    """Plot how much worse the data are fitted as each parameter is held away from its estimate.

    The ordinate is the rise of -2 log L, or of the squares over their mean where sigma is not
    known. The dashed line is the limit at the level of the fit: the interval lies below it. The
    dotted curve is the linearised model.

    Parameters
    ----------
    fit : Fit
    parameters : list of names or symbols, optional
        By default all free parameters.
    ax : axes of Matplotlib, one for each parameter, optional

    Returns
    -------
    ndarray of matplotlib.axes.Axes

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    OptionError
        If it is no fit, or there is no such parameter.
    """
    check_kind("plot_profiles", fit, Fit, remedy="give what solution.fit(...) returns")
    free = fit._problem.free
    names = [free.names[free.index(p)] for p in (parameters or free.names)]
    axes = style.several_axes(ax, len(names), "Profile likelihoods")
    for panel, name in zip(axes, names, strict=True):
        _draw_profile(panel, fit, name)
        panel.set_xlabel(style.label_of(cast("Solution", fit.solution), name))
    axes[0].set_ylabel("rise of −2 log L")
    return axes


def plot_design(design: Design, *, ax: Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """Plot the expected curves with the chosen times, and below them what others would add.

    Parameters
    ----------
    design : Design
        What :meth:`rankone.Solution.design` returns.
    ax : two axes of Matplotlib, optional

    Returns
    -------
    tuple of matplotlib.axes.Axes

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    OptionError
        If it is no design, or there are not two axes.
    """
    check_kind("plot_design", design, Design, remedy="give what solution.design(...) returns")
    trial = design._blocks.trial
    solution = cast("Solution", trial.solution)
    upper, lower = style.stacked(0.9, 0.5) if ax is None else style.several_axes(ax, 2, "")
    curves = design._blocks.curves()
    names = trial.observations.names
    colours = style.colours_for(upper, len(names))
    times, counts = np.unique(design.times, return_counts=True)
    lines: list[Line2D] = []
    for name, curve, colour in zip(names, curves, colours, strict=True):
        lines += upper.plot(design.candidates, curve, color=colour, label=name)
        chosen = np.interp(times, design.candidates, curve)
        upper.scatter(times, chosen, 26.0 * counts, color=colour, zorder=3)
    style.name_ends(upper, lines, names)
    lower.plot(design.candidates, design.gain, color=style.PALETTE[6])
    for panel in (upper, lower):
        for time in times:
            panel.axvline(float(time), color="0.6", linewidth=1, linestyle=":", zorder=0)
    upper.set_ylabel("expected")
    lower.set_ylabel("gain of one\nmore")
    lower.set_xlabel(style.label_of(solution, solution.metadata.time))
    return upper, lower


def _square(ax: object, n: int) -> NDArray[np.object_]:
    axes = style.several_axes(ax, n * n, "") if ax is not None else style.grid_of(n)
    return axes.reshape(n, n)


def _padded(low: float, high: float) -> tuple[float, float]:
    room = 0.05 * (high - low)
    return low - room, high + room


def _draw_marginal(panel: Axes, posterior: Posterior, name: str, ends: tuple[float, float]) -> None:
    colour = style.PALETTE[0]
    x = np.linspace(*ends, style.SMOOTH_POINTS)
    density = posterior.density(name, x)
    low, high = posterior.interval()[name]
    panel.plot(x, density, color=colour)
    inside = (x >= low) & (x <= high)
    panel.fill_between(x[inside], density[inside], color=colour, **style.BAND)
    panel.set_ylim(bottom=0.0)
    panel.set_yticks([])


def _draw_pair(
    panel: Axes, x: Array, y: Array, ends: tuple[tuple[float, float], tuple[float, float]]
) -> None:
    """Contours of a histogram that hold shares of the points."""
    counts, xs, ys = np.histogram2d(x, y, _BINS, range=ends)
    smooth = _smoothed(counts)
    order = np.sort(smooth.ravel())[::-1]
    inside = np.cumsum(order) / order.sum()
    heights = [float(order[np.searchsorted(inside, level)]) for level in _LEVELS]
    centres = (0.5 * (edges[1:] + edges[:-1]) for edges in (xs, ys))
    top = float(order[0]) * (1.0 + 1e-9)
    if heights[0] < heights[1] < top:
        colours = [f"{style.PALETTE[0]}40", f"{style.PALETTE[0]}A0"]
        panel.contourf(*centres, smooth.T, levels=[*heights, top], colors=colours)
    panel.set_ylim(*ends[1])


def _smoothed(counts: Array) -> Array:
    """Counts averaged with their neighbours."""
    kernel = np.array([0.25, 0.5, 0.25])
    for axis in (0, 1):
        counts = np.apply_along_axis(lambda row: np.convolve(row, kernel, "same"), axis, counts)
    return counts


def _draw_profile(panel: Axes, fit: Fit, name: str) -> None:
    free = fit._problem.free
    j = free.names.index(name)
    profile, limit, unit = fit.profile(name), fit.rise(name), 1.0
    if not fit.unit_known:
        unit = fit.sigma**2 or 1.0
    shown = profile.rise <= _SHOWN_RISE * limit
    x = free.values(profile.path)[:, j]
    panel.plot(x[shown], profile.rise[shown] / unit, color=style.PALETTE[0])
    panel.axhline(limit / unit, color="0.4", linestyle="--", linewidth=1)
    deviation = fit.std[name]
    if np.isfinite(deviation) and shown.any():
        line = np.linspace(x[shown].min(), x[shown].max(), style.SMOOTH_POINTS)
        panel.plot(line, ((line - fit.x[name]) / deviation) ** 2, color="0.5", linestyle=":")
    panel.axvline(fit.x[name], color="0.8", linewidth=1, zorder=0)
    for end in (profile.lower, profile.upper):
        if end.stop is Stop.DATA:
            place = free.values(np.where(np.arange(len(free.names)) == j, end.z, 0.5))[j]
            panel.plot([place], [limit / unit], "o", color=style.PALETTE[0], markersize=4)
    panel.set_ylim(0.0, _SHOWN_RISE * limit / unit)


# -----------------------------------------------------------------------------
# Curves of the subjects of a population, and its predictive check: `plot_population`.


_MOST_PANELS = 12  # Subjects that are drawn if none are named
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
    remedy = "give what solution.fit_population(...) returns, or its predictive_check()"
    check_kind("plot_population", fit, PopulationFit, remedy=remedy)
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
    times = fine_times(cast("Solution", fit.solution), last, style.SMOOTH_POINTS)
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
    middle = len(check.quantiles) // 2
    for q, share in enumerate(check.quantiles):
        colour = style.PALETTE[1] if q == middle else style.PALETTE[0]
        low, _, high = check.simulated[q]
        label = f"{100 * share:g} % quantile"
        ax.fill_between(check.times, low, high, color=colour, **style.BAND)
        ax.plot(check.times, check.observed[q], color=colour, label=label)
    points = ax.plot(*check.data, "o", color="0.6", markersize=2, zorder=1, label="data")
    solution = cast("Solution", check.solution)
    ax.set_xlabel(style.label_of(solution, solution.metadata.time))
    corrected = ", predictions corrected" if check.corrected else ""
    ax.set_ylabel(f"{style.label_of(solution, check.observable)}{corrected}")
    shares = [f"{100 * share:g}" for share in check.quantiles]
    style.legend_above(
        ax,
        [
            *points,
            style.line_key(f"quantiles of data: {', '.join(shares)} %"),
            style.band_key(f"simulated: {100 * check.level:g} %"),
        ],
    )
