"""Measurements, the fitted curves and the residuals: `plot_fit`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np

from rankone.estimation.fit import Fit
from rankone.plotting import style
from rankone.plotting.arguments import CURVE_TIMES, fine_times, needs_time
from rankone.support.arrays import Array
from rankone.support.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from rankone.interface.solution import Solution


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
    if not isinstance(fit, Fit):
        raise OptionError(
            f"plot_fit needs a Fit, not {type(fit).__name__}",
            term=fit,
            remedy="give what solution.fit(...) returns",
        )
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
            curve = fit.curve(name, fine, k)
            residuals = fit.standardised[k][here] if scaled else data - fit.curve(name, times, k)[0]
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
            ax.fill_between(times, curve - half, curve + half, color=colour, alpha=0.2, linewidth=0)
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
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    points = Line2D([], [], color=colour, marker="o", markersize=4, markerfacecolor="white", ls="")
    handles: dict[str, Artist] = {"measured": points, "fitted": Line2D([], [], color=colour)}
    if band:
        handles[band] = Patch(color=colour, alpha=0.2, linewidth=0)
    for word, handle in handles.items():
        handle.set_label(word)
    style.legend_above(ax, [*handles.values()])


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
