"""Measurements, best fits, residuals and the ends of all starts: `plot_calibration`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rankone.calibration.comparison import Comparison
from rankone.calibration.result import Calibration
from rankone.plotting import style
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_PANELS = 7  # Observables that are drawn unless they are named
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
        Those to be drawn; by default the first seven.
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
    if not isinstance(calibration, Calibration):
        raise OptionError(
            f"plot_calibration needs a Calibration, not {type(calibration).__name__}",
            term=calibration,
            remedy="give what rankone.calibrate(...) returns",
        )
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
    _draw_residuals(axes[-2], calibration.comparisons, experiments)
    _draw_starts(axes[-1], calibration)
    return axes


def _chosen(calibration: Calibration, observables: Sequence[str] | None) -> list[str]:
    """The observables to be drawn."""
    every = list(dict.fromkeys(each.observable for each in calibration.comparisons))
    if observables is None:
        return every[:_MOST_PANELS]
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
        panel.errorbar(times, each.measured, bars, fmt="o", ms=3, lw=0.8, color=colour)
        panel.plot(times, each.predicted, "-", lw=1.5, color=colour)
        panel.fill_between(times, *each.band, color=colour, alpha=0.2, lw=0)
    if sizes.min() > 0.0 and sizes.max() > _FAR * sizes.min():
        panel.set_yscale("log")
    panel.set_xlabel("time")


def _draw_residuals(
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
    panel.axhline(0.0, lw=0.8, color=style.PALETTE[6])
    panel.set(title="residuals", xlabel="time", ylabel="standard deviations")


def _draw_starts(panel: Axes, calibration: Calibration) -> None:
    """How far the ends of the starts are below the best one."""
    ends = np.array([start.log_likelihood for start in calibration.starts])
    gaps = np.maximum(calibration.log_likelihood - ends, _LEAST_GAP)
    panel.plot(1 + np.arange(ends.size), gaps, "o-", ms=4, lw=0.8, color=style.PALETTE[0])
    panel.set_yscale("log")
    panel.set_ylim(0.5 * _LEAST_GAP, max(2.0 * float(gaps[np.isfinite(gaps)].max()), 1.0))
    panel.set(title="starts", xlabel="rank", ylabel="log-likelihood below the best")


def _drawn(times: Array) -> Array:
    """Times as they are drawn; those at rest, which are infinite, are spread side by side."""
    if np.isfinite(times).all():
        return times
    return np.where(np.isfinite(times), times, np.arange(times.size, dtype=float))
