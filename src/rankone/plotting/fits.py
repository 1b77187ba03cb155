"""Measurements, the curve fitted to them and what is left: `plot_fit`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from rankone.arrays import Array
from rankone.coordinates import name_of
from rankone.errors import OptionError
from rankone.plotting.asked import fine_times, label_of, labels_of, needs_time, states_of, times_of
from rankone.plotting.style import axes_for, colours_for, name_ends, stacked
from rankone.wording import quote, shown

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
    times : ndarray (times,), or dict of str to them
    data : ndarray (outputs, times) or (times,), or dict of str to ndarray (times,)
        Measurements; NaN where there is none.
    observe : tuple of str
        The unknown, or derivative that is a state, of each row of the data.
    sigma : float or ndarray (outputs,) or that of the data, or dict of them, or None
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
    EvaluationError
        If a time or a parameter of the fit is outside of its interval.
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
    outputs = _outputs(fit)
    names = [output.name for output in outputs]
    solution: Solution = fit.solution
    _draw_data(axes[0], outputs)
    axes[0].set_ylabel(labels_of(solution, names))
    axes[-1].set_xlabel(label_of(solution, solution.metadata.time))
    if len(axes) > 1:
        _draw_residuals(axes[1], outputs)
        known = all(output.sigma is not None for output in outputs)
        axes[1].set_ylabel("residual\n[std]" if known else "residual")
    return axes


@dataclass(frozen=True)
class _Output:
    """What was measured of one state, and the curve fitted.

    Attributes
    ----------
    name : str
    times, data, fitted : ndarray (times,)
    sigma : ndarray (times,) or None
    curve : (ndarray, ndarray)
        Times and values of the curve fitted.
    """

    name: str
    times: Array
    data: Array
    fitted: Array
    sigma: Array | None
    curve: tuple[Array, Array]

    @property
    def residuals(self) -> Array:
        """Measurement less curve, in standard deviations if these are known."""
        return (self.data - self.fitted) / (1.0 if self.sigma is None else self.sigma)


def _outputs(fit: FitLike) -> list[_Output]:
    """The outputs of a fit.

    Raises
    ------
    OptionError
        If shapes do not fit.
    """
    solution: Solution = fit.solution
    needs_time(solution, "curves of a fit")
    keys = fit.observe if isinstance(fit.observe, list | tuple) else (fit.observe,)
    names = states_of(solution, list(keys))
    found = []
    for i, name in enumerate(names):
        times = times_of(solution, _part(fit.times, name, None), 1)
        data = np.ravel(np.asarray(_part(fit.data, name, i), dtype=float))
        sigma = None if fit.sigma is None else _sigma(fit, name, i, len(names))
        if data.shape != times.shape or (sigma is not None and sigma.shape not in ((), data.shape)):
            raise OptionError(
                f"the data of {quote(name)} or their sigma do not fit {times.size} times",
                term=fit,
                remedy="give what solution.fit(...) returns",
            )
        fine = fine_times(solution, float(times.max()), _TIMES)
        one = solution[name]
        sigma = None if sigma is None else np.broadcast_to(sigma, data.shape)
        curve = fine, one(fine, fit.x)
        found.append(_Output(name, times, data, one(times, fit.x), sigma, curve))
    return found


def _part(given: Any, name: str, row: int | None) -> Any:
    """What was given for one output: by its name, by its row, or the same for all."""
    if isinstance(given, Mapping):
        by_name = {name_of(key): value for key, value in given.items()}
        return by_name[name]
    array = np.asarray(given)
    return array[row] if row is not None and array.ndim > 1 else array


def _sigma(fit: FitLike, name: str, row: int, outputs: int) -> Array:
    """Standard deviations of one output."""
    given = fit.sigma
    if not isinstance(given, Mapping) and np.shape(given) == (outputs,) != np.shape(fit.data):
        given = given[row]
    return np.asarray(_part(given, name, row), dtype=float)


def _axes(ax: Any) -> tuple[Axes, ...]:
    """One or two axes."""
    if ax is None:
        return stacked(0.9, 0.35)
    several = tuple(np.ravel(ax)) if isinstance(ax, list | tuple | np.ndarray) else (ax,)
    if len(several) not in (1, 2):
        raise OptionError(f"{len(several)} axes were given", remedy="give one or two")
    return tuple(axes_for(one) for one in several)


def _draw_data(ax: Axes, outputs: Sequence[_Output]) -> None:
    """Measurements and curve of each output."""
    lines = []
    several = len(outputs) > 1
    for output, colour in zip(outputs, colours_for(ax, len(outputs)), strict=True):
        before = f"{output.name}, " if several else ""
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
        lines += ax.plot(*output.curve, color=colour, label=f"{before}fitted")
    if several:
        name_ends(ax, lines, [output.name for output in outputs])
    else:
        ax.legend(fontsize="small", framealpha=0.8)


def _draw_residuals(ax: Axes, outputs: Sequence[_Output]) -> None:
    """What is left of each measurement."""
    for output, colour in zip(outputs, colours_for(ax, len(outputs)), strict=True):
        ax.plot(output.times, output.residuals, "o", color=colour, markersize=4, label=output.name)
    known = all(output.sigma is not None for output in outputs)
    if known:
        ax.axhspan(-2.0, 2.0, color="0.93", zorder=0)
    ax.axhline(0.0, color="0.4", linewidth=1, zorder=1.5)
    largest = float(np.nanmax(np.abs([r for o in outputs for r in o.residuals]), initial=0.0))
    limit = 1.15 * max(largest, 2.3 if known else 0.0)
    if limit > 0.0:
        ax.set_ylim(-limit, limit)
