"""Measurements, fitted curves and residuals, of fits and of calibrations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from rankone.inference.calibration.result import Calibration, Comparison
from rankone.inference.estimation.fit import Fit
from rankone.share.export.pages import CURVE_TIMES
from rankone.share.plotting import style
from rankone.share.plotting.style import fine_times, needs_time
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, check_kind, did_you_mean, listing, quote

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from rankone.solution.solution import Solution


_LEAST_GAP = 0.01  # Gap of a log-likelihood to the best one that is drawn as none
_FAR = (
    100.0  # Ratio of the largest to the smallest of measurements from which their axis is of logs
)


def plot_calibration(
    calibration: Calibration,
    *,
    observables: Sequence[str] | None = None,
    ax: object = None,
) -> NDArray[np.object_]:
    """Plot measurements and the best fit, the residuals, and where the starts ended.

    There is a panel for each observable, with a colour for each experiment: measurements with error
    bars of one standard deviation of the noise, predictions, and the band in which these are known
    with 95 %. Then there are the residuals of all of them, in standard deviations, with the names
    of the experiments, and the starts
    in the order of their ends, by how far these are below the best log-likelihood: starts that
    found the same optimum make a step.

    Parameters
    ----------
    calibration : Calibration
        What :func:`rankone.calibrate` or ``read_petab(...).fit()`` returns.
    observables : sequence of str, optional
        Those to be drawn; by default the first eight.
    ax : array of matplotlib.axes.Axes, optional
        One for each observable and two more; those of a new figure if left out.

    Returns
    -------
    ndarray of matplotlib.axes.Axes

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    OptionError
        If ``calibration`` is none, found nothing, or there is no such observable.
    """
    remedy = "give what rankone.calibrate(...) returns"
    check_kind("plot_calibration", calibration, Calibration, remedy=remedy)
    if not calibration.comparisons:
        raise OptionError(f"there is nothing to be drawn: {calibration.message}")
    chosen = _chosen(calibration, observables)
    title = f"log-likelihood {calibration.log_likelihood:.6g}"
    axes = style.several_axes(ax, len(chosen) + 2, title)
    experiments = list(dict.fromkeys(each.experiment for each in calibration.comparisons))
    for panel, observable in zip(axes, chosen, strict=False):
        some = [each for each in calibration.comparisons if each.observable == observable]
        _draw_measurements(panel, some, experiments)
        panel.set_title(observable)
    _draw_calibration_residuals(axes[-2], calibration.comparisons, experiments)
    _draw_starts(axes[-1], calibration)
    return axes


def _chosen(calibration: Calibration, observables: Sequence[str] | None) -> list[str]:
    """The observables to be drawn."""
    every = list(dict.fromkeys(each.observable for each in calibration.comparisons))
    if observables is None:
        return every[: style.MOST_NAMED]
    names = [observables] if isinstance(observables, str) else list(observables)
    for name in names:
        if name not in every:
            raise OptionError(
                f"there is no observable {quote(name)}{did_you_mean(str(name), every)}",
                term=name,
                remedy=f"choose from {listing(every)}",
            )
    return names


def _colour(experiment: str, experiments: Sequence[str]) -> str:
    return style.PALETTE[experiments.index(experiment) % len(style.PALETTE)]


def _draw_measurements(
    panel: Axes, comparisons: Sequence[Comparison], experiments: Sequence[str]
) -> None:
    """Measurements, predictions and their bands, a colour for each experiment."""
    sizes = np.concatenate([each.measured for each in comparisons])
    for each in comparisons:
        colour, times = _colour(each.experiment, experiments), _drawn(each.times)
        bars = np.abs(each.bars - each.measured)
        panel.errorbar(times, each.measured, bars, fmt="o", ms=3, lw=1, color=colour)
        panel.plot(times, each.predicted, "-", color=colour)
        panel.fill_between(times, *each.band, color=colour, **style.BAND)
    if sizes.min() > 0.0 and sizes.max() > _FAR * sizes.min():
        panel.set_yscale("log")
    panel.set_xlabel("time")


def _draw_calibration_residuals(
    panel: Axes, comparisons: Sequence[Comparison], experiments: Sequence[str]
) -> None:
    """All residuals by time, and which colour is which experiment."""
    for experiment in experiments:
        own = [each for each in comparisons if each.experiment == experiment]
        times = np.concatenate([_drawn(each.times) for each in own])
        residuals = np.concatenate([each.standardised for each in own])
        colour = _colour(experiment, experiments)
        panel.plot(times, residuals, "o", ms=3, color=colour, label=experiment)
    if len(experiments) > 1:
        panel.legend()
    panel.axhline(0.0, lw=1, color=style.PALETTE[6])
    panel.set(title="residuals", xlabel="time", ylabel="standard deviations")


def _draw_starts(panel: Axes, calibration: Calibration) -> None:
    """How far the ends of the starts are below the best one."""
    ends = np.array([start.log_likelihood for start in calibration.starts])
    gaps = np.maximum(calibration.log_likelihood - ends, _LEAST_GAP)
    panel.plot(1 + np.arange(ends.size), gaps, "o-", ms=4, lw=1, color=style.PALETTE[0])
    panel.set_yscale("log")
    panel.set_ylim(0.5 * _LEAST_GAP, max(2.0 * float(gaps[np.isfinite(gaps)].max()), 1.0))
    panel.set(title="starts", xlabel="rank", ylabel="log-likelihood below the best")


def _drawn(times: Array) -> Array:
    """Times as they are drawn; those at rest, which are infinite, are spread side by side."""
    if np.isfinite(times).all():
        return times
    return np.where(np.isfinite(times), times, np.arange(times.size, dtype=float))


# -----------------------------------------------------------------------------
# Measurements, the fitted curves and the residuals: `plot_fit`.


def plot_fit(fit: Fit, *, ax: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """Plot measurements with error bars, the fitted curves, and below them the residuals.

    Error bars are one standard deviation to either side, as given or as estimated by the fit.
    Around each curve is the band in which it is known, by linearisation, at the level of the fit.
    Residuals are measurement less curve, in standard deviations.

    Parameters
    ----------
    fit : Fit
        What :meth:`rankone.Solution.fit` returns.
    ax : matplotlib.axes.Axes or two of them, optional
        Axes for measurements and curves, and for the residuals; with one there are no residuals.
        Those of a new figure, one below the other, if left out.

    Returns
    -------
    tuple of matplotlib.axes.Axes
        Those that were drawn into.

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    EvaluationError
        If the values fitted do not depend on time.
    OptionError
        If ``ax`` are not one or two axes, or ``fit`` is not a fit.

    Notes
    -----
    Each observable of each experiment has its curve. There is no band where the data do not
    identify the curve. Residuals have the unit of the data if sigma is not given and the data are
    met exactly.
    """
    check_kind("plot_fit", fit, Fit, remedy="give what solution.fit(...) returns")
    for trial in fit.trials:
        needs_time(cast("Solution", trial.solution), "curves of a fit")
    axes = _axes(ax)
    outputs = list(_outputs(fit))
    solution = cast("Solution", fit.solution)
    _draw_data(axes[0], outputs, f"{100 * fit.level:g} % band of the curve")
    states = [name for name in fit.observed if name in solution.states]
    ylabel = style.labels_of(solution, states) if len(states) == len(fit.observed) else None
    axes[0].set_ylabel(ylabel or ", ".join(fit.observed))
    axes[-1].set_xlabel(style.label_of(solution, solution.metadata.time))
    if len(axes) > 1:
        _draw_residuals(axes[1], outputs)
        unit = "[std]" if fit.noise_given else "[estimated std]"
        axes[1].set_ylabel("residual" if outputs[0].sigma is None else f"residual\n{unit}")
    return axes


@dataclass(frozen=True)
class _Output:
    """What was measured of one observable, its sigma if it is known, and the curve fitted.

    The curve (3, times) has times, values, and half the width of its band. Residuals are
    measurement less curve, in standard deviations if these are known.
    """

    name: str
    times: Array
    data: Array
    sigma: Array | None
    curve: Array

    residuals: Array


def _outputs(fit: Fit) -> Iterator[_Output]:
    """What was measured in each experiment."""
    several = len(fit.trials) > 1
    for k, trial in enumerate(fit.trials):
        solution, observed = cast("Solution", trial.solution), trial.observations
        for i, name in enumerate(observed.names):
            here = observed.of(i)
            times, data = observed.times[here], observed.values[here]
            if not times.size:
                continue
            sigma = fit.deviations[k][here]
            scaled = bool(np.isfinite(sigma).all() and (sigma > 0.0).all())
            fine = fine_times(solution, float(times.max()), CURVE_TIMES)
            curve = fit.curve(name, fine, experiment=k)
            residuals = (
                fit.standardised[k][here]
                if scaled
                else data - fit.curve(name, times, experiment=k)[0]
            )
            yield _Output(
                f"{name}, {trial.name}" if several else name,
                times,
                data,
                sigma if scaled else None,
                np.array([fine, *curve]),
                residuals,
            )


def _axes(ax: object) -> tuple[Axes, ...]:
    if ax is None:
        return style.stacked(0.9, 0.35)
    several = tuple(np.ravel(ax)) if isinstance(ax, list | tuple | np.ndarray) else (ax,)
    if len(several) not in (1, 2):
        raise OptionError(f"{len(several)} axes were given", remedy="give one or two")
    return tuple(style.axes_for(one) for one in several)


def _draw_data(ax: Axes, outputs: Sequence[_Output], band: str) -> None:
    """Measurements, curve and band of each output."""
    several = len(outputs) > 1
    banded = any(np.isfinite(output.curve[2]).any() for output in outputs)
    colours = style.colours_for(ax, len(outputs))
    lines = []
    for output, colour in zip(outputs, colours, strict=True):
        times, curve, half = output.curve
        before = f"{output.name}, " if several else ""
        if banded:
            ax.fill_between(times, curve - half, curve + half, color=colour, **style.BAND)
        ax.errorbar(
            output.times,
            output.data,
            output.sigma,
            fmt="o",
            color=colour,
            markersize=4,
            markerfacecolor="white",
            elinewidth=1,
            label=f"{before}measured",
        )
        lines += ax.plot(times, curve, color=colour, label=f"{before}fitted")
    _legend(ax, "0.3" if several else colours[0], band if banded else None)
    if several:
        style.name_ends(ax, lines, [output.name for output in outputs])


def _legend(ax: Axes, colour: str, band: str | None) -> None:
    """What points, lines and bands are, above the axes, where it hides nothing."""
    points = style.line_key("measured", colour, marker="o", markersize=4, ls="")
    points.set_markerfacecolor("white")
    handles: list[Artist] = [points, style.line_key("fitted", colour)]
    style.legend_above(ax, [*handles, style.band_key(band, colour)] if band else handles)


def _draw_residuals(ax: Axes, outputs: Sequence[_Output]) -> None:
    for output, colour in zip(outputs, style.colours_for(ax, len(outputs)), strict=True):
        ax.plot(output.times, output.residuals, "o", color=colour, markersize=4, label=output.name)
    scaled = outputs[0].sigma is not None
    if scaled:
        ax.axhspan(-2.0, 2.0, color="0.93", zorder=0)
    ax.axhline(0.0, color="0.4", linewidth=1, zorder=1.5)
    largest = max(float(np.abs(output.residuals).max(initial=0.0)) for output in outputs)
    limit = 1.15 * max(largest, 2.3 if scaled else 0.0)
    if limit > 0.0:
        ax.set_ylim(-limit, limit)
