"""Means and bands of the unknowns over time: `plot_bands`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.plotting.asked import (
    check_solution,
    label_of,
    labels_of,
    needs_time,
    times_of,
    unknowns_of,
)
from rankone.plotting.style import axes_for, beside, colours_for, name_ends
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.options import checked_number
from rankone.support.wording import shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.interface.solution import Solution

__all__ = ["plot_bands"]

_TIMES = 201
_QUANTILES = (0.025, 0.975)


def plot_bands(
    solution: Solution,
    unknowns: Any = None,
    t: Any = None,
    *,
    quantiles: tuple[float, float] | None = None,
    sigmas: float | None = None,
    under: Mapping[Any, Any] | None = None,
    correlation: Mapping[Any, Any] | None = None,
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
        Instead of quantiles: the band is the mean and so many standard deviations to either side.
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
        If there is no such unknown, a time is outside of the horizon, or the solution has no time.
    OptionError
        If quantiles or sigmas are out of their range or both given, or ``under`` or
        ``correlation`` do not fit.
    """
    check_solution("plot_bands", solution)
    needs_time(solution, "bands")
    names = unknowns_of(solution, unknowns)
    ends = _checked(quantiles, sigmas)
    times = times_of(solution, t, _TIMES)
    rows = [solution.unknowns.index(name) for name in names]
    over: dict[str, Any] = {"under": under, "correlation": correlation}
    mean = solution.mean(times, **over)[rows]
    if sigmas is None:
        lower, upper = solution.quantile(ends, times, **over)[:, rows]
        meaning = f"{100 * ends[0]:.3g} to {100 * ends[1]:.3g} %"
    else:
        spread = sigmas * solution.std(times, **over)[rows]
        lower, upper = mean - spread, mean + spread
        meaning = f"± {sigmas:g} std"
    axes = axes_for(ax)
    axes.set(xlabel=label_of(solution, solution.metadata.time), ylabel=labels_of(solution, names))
    _draw(axes, names, times, (lower, mean, upper), meaning)
    axes.margins(x=0.0)
    return axes


def _checked(quantiles: Any, sigmas: Any) -> tuple[float, float]:
    """The probabilities of the band."""
    if sigmas is not None:
        checked_number("sigmas", sigmas, 0, kind=float)
        if quantiles is not None:
            raise OptionError("quantiles and sigmas are both given", remedy="choose one of them")
    if quantiles is None:
        return _QUANTILES
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


def _draw(
    ax: Axes, names: Sequence[str], times: Array, band: tuple[Array, Array, Array], meaning: str
) -> None:
    """A line and a band for each unknown, (unknowns, times) each."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    lines = []
    colours = colours_for(ax, len(names))
    for name, colour, lower, mean, upper in zip(names, colours, *band, strict=True):
        ax.fill_between(times, lower, upper, color=colour, alpha=0.2, linewidth=0)
        lines += ax.plot(times, mean, color=colour, label=f"mean of {name}")
    alone = len(names) == 1
    colour = colours[0] if alone else "0.3"
    band_entry = Patch(color=colour, alpha=0.2, linewidth=0, label=meaning)
    entries = [Line2D([], [], color=colour, label="mean"), band_entry]
    if alone or np.isfinite(band[1][:, -1]).all():
        ax.legend(handles=entries, fontsize="small", framealpha=0.8)
    else:
        beside(ax, entries)
    if not alone:
        name_ends(ax, lines, names)
