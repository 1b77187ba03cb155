"""Measurements, the curve fitted to them and what is left: `plot_fit`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from rankone.arrays import Array
from rankone.errors import OptionError
from rankone.plotting.asked import label_of, labels_of
from rankone.plotting.style import axes_for, colours_for, name_ends, stacked
from rankone.wording import shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.solution import Solution

__all__ = ["FitLike", "plot_fit"]

_TIMES = 401


class FitLike(Protocol):
    """What is needed of a fit.

    Attributes
    ----------
    solution : Solution
    times : ndarray (times,)
    data : ndarray (outputs, times)
        Measurements; NaN where there is none.
    observe : tuple of str
        The unknown, or derivative that is a state, of each row of the data.
    sigma : float or ndarray (outputs,) or (outputs, times), or None
        Standard deviations of the measurements; None if they are not known.
    x : dict of str to float
        The parameters found, and those that were fixed.
    """

    solution: Any
    times: Any
    data: Any
    observe: Any
    sigma: Any
    x: Any


def plot_fit(fit: FitLike, *, ax: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """Plot measurements with error bars, the fitted curves, and below them the residuals.

    Error bars are one standard deviation to either side. Residuals are measurement less curve, in
    standard deviations where these are known.

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
    OptionError
        If ``ax`` are not one or two axes, or ``fit`` is no fit.
    """
    missing = [name for name in FitLike.__annotations__ if not hasattr(fit, name)]
    if missing:
        raise OptionError(
            f"{shown(fit)} is not a fit: it has no {missing[0]}",
            term=fit,
            remedy="give what solution.fit(...) returns",
        )
    axes = _axes(ax)
    solution: Solution = fit.solution
    names = [solution[one].name for one in fit.observe]
    times = np.asarray(fit.times, dtype=float)
    data = np.asarray(fit.data, dtype=float).reshape(len(names), times.size)
    sigma = _deviations(fit.sigma, data)
    fine = np.linspace(solution.time[0], times.max(), _TIMES)
    curves = np.array([solution[name](fine, fit.x) for name in names])
    _draw_data(axes[0], names, times, data, sigma, fine, curves)
    axes[0].set_ylabel(labels_of(solution, names))
    axes[-1].set_xlabel(label_of(solution, solution.metadata.time))
    if len(axes) > 1:
        rest = data - np.array([solution[name](times, fit.x) for name in names])
        _draw_residuals(axes[1], names, times, rest, sigma)
        axes[1].set_ylabel("residual" if sigma is None else "residual\n[std]")
    return axes


def _axes(ax: Any) -> tuple[Axes, ...]:
    """One or two axes."""
    if ax is None:
        return stacked(0.9, 0.35)
    several = tuple(np.ravel(ax)) if isinstance(ax, list | tuple | np.ndarray) else (ax,)
    if len(several) not in (1, 2):
        raise OptionError(f"{len(several)} axes were given", remedy="give one or two")
    return tuple(axes_for(one) for one in several)


def _deviations(sigma: Any, data: Array) -> Array | None:
    """Standard deviations for each measurement."""
    if sigma is None:
        return None
    given = np.asarray(sigma, dtype=float)
    if given.ndim == 1 and given.size == len(data):
        given = given[:, None]
    return np.broadcast_to(given, data.shape)


def _draw_data(
    ax: Axes,
    names: Sequence[str],
    times: Array,
    data: Array,
    sigma: Array | None,
    fine: Array,
    curves: Array,
) -> None:
    """Measurements and curve of each output."""
    lines = []
    colours = colours_for(ax, len(names))
    for i, (name, colour) in enumerate(zip(names, colours, strict=True)):
        ax.errorbar(
            times,
            data[i],
            None if sigma is None else sigma[i],
            fmt="o",
            color=colour,
            markersize=4,
            markerfacecolor="white",
            elinewidth=1,
            label=f"{name}, measured" if len(names) > 1 else "measured",
        )
        label = f"{name}, fitted" if len(names) > 1 else "fitted"
        lines += ax.plot(fine, curves[i], color=colour, label=label)
    if len(names) > 1:
        name_ends(ax, lines, names)
    else:
        ax.legend(fontsize="small", framealpha=0.8)


def _draw_residuals(
    ax: Axes, names: Sequence[str], times: Array, rest: Array, sigma: Array | None
) -> None:
    """What is left of each measurement."""
    scaled = rest if sigma is None else rest / sigma
    colours = colours_for(ax, len(names))
    for i, (name, colour) in enumerate(zip(names, colours, strict=True)):
        ax.plot(times, scaled[i], "o", color=colour, markersize=4, label=name)
    if sigma is not None:
        ax.axhspan(-2.0, 2.0, color="0.93", zorder=0)
    ax.axhline(0.0, color="0.4", linewidth=1, zorder=1.5)
    largest = float(np.nanmax(np.abs(scaled), initial=0.0))
    limit = 1.15 * max(largest, 2.3 if sigma is not None else 0.0)
    if limit > 0.0:
        ax.set_ylim(-limit, limit)
