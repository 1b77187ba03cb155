"""Curves of the unknowns over time: `plot_trajectories`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from rankone.plotting.asked import (
    check_solution,
    label_of,
    labels_of,
    needs_time,
    states_of,
    times_of,
)
from rankone.plotting.style import (
    MOST_NAMED,
    PALETTE,
    axes_for,
    beside,
    colours_for,
    name_ends,
    shades,
)
from rankone.solution.smaller import merged
from rankone.support.arrays import Array
from rankone.support.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.interface.solution import Solution

__all__ = ["plot_trajectories"]

_TIMES = 401
_STYLES: tuple[Literal["-", "--", ":", "-."], ...] = ("-", "--", ":", "-.")


@dataclass(frozen=True)
class _Family:
    """Points of the parameters, each of which is a curve.

    Attributes
    ----------
    names : tuple of str
        Parameters with more than one value.
    values : ndarray (names, curves)
    """

    names: tuple[str, ...]
    values: Array

    def titles(self) -> list[str]:
        return [
            ", ".join(f"{name} = {value:.4g}" for name, value in zip(self.names, row, strict=True))
            for row in self.values.T
        ]


def plot_trajectories(
    solution: Solution,
    values: Mapping[Any, Any] | None = None,
    /,
    *,
    unknowns: Any = None,
    t: Any = None,
    ax: Axes | None = None,
    **named: Any,
) -> Axes:
    """Plot unknowns over time for given values of the parameters.

    Arrays of values broadcast as in a call and give families of curves. Where one parameter varies,
    its value is the colour; several unknowns of a family have different strokes.

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
        If there is no such unknown or parameter, a value is missing or outside of the box, the
        shapes do not broadcast, or the solution has no time.
    OptionError
        If a name is given twice, or there is nothing to plot.
    """
    check_solution("plot_trajectories", solution)
    needs_time(solution, "curves")
    names = states_of(solution, unknowns)
    given = merged(values, named)
    time = solution.metadata.time
    if time in given and t is not None:
        raise OptionError(f"`{time}` is given twice", term=time, remedy="give it once")
    times = times_of(solution, given.pop(time, t), _TIMES)
    family = _family(solution, given)
    everything = {name: np.asarray(v)[..., None] for name, v in given.items()}
    curves = [
        np.broadcast_to(
            solution[name](times, everything), (*_shape(everything), times.size)
        ).reshape(-1, times.size)
        for name in names
    ]
    axes = axes_for(ax)
    axes.set(xlabel=label_of(solution, time), ylabel=labels_of(solution, names))
    if not family.names:
        _draw_single(axes, names, times, [rows[0] for rows in curves])
    else:
        _draw_family(axes, solution, names, times, curves, family)
    axes.margins(x=0.0)
    return axes


def _shape(everything: Mapping[str, Array]) -> tuple[int, ...]:
    """Shape of the points, without that of the times."""
    return np.broadcast_shapes(*(v.shape for v in everything.values()), (1,))[:-1]


def _family(solution: Solution, given: Mapping[str, Any]) -> _Family:
    """The curves asked for; what is wrong with the values is found here."""
    checked = solution._coordinates.gather((solution.time[0],), dict(given))
    arrays = solution._coordinates.arrays(checked)
    points, _ = solution._coordinates.broadcast(arrays)
    if not points.shape[1]:
        raise OptionError("there is no curve: an array of values is empty", remedy="give values")
    varying = [j for j in range(1, len(points)) if np.ptp(points[j]) > 0.0]
    names = solution._coordinates.names
    return _Family(tuple(names[j] for j in varying), points[varying])


def _draw_single(ax: Axes, names: Sequence[str], times: Array, curves: Sequence[Array]) -> None:
    """One curve for each unknown, named at its end."""
    colours = colours_for(ax, len(names))
    lines = [
        ax.plot(times, curve, color=colour, label=name)[0]
        for name, curve, colour in zip(names, curves, colours, strict=True)
    ]
    if len(lines) > 1:
        name_ends(ax, lines, names)


def _draw_family(
    ax: Axes,
    solution: Solution,
    names: Sequence[str],
    times: Array,
    curves: Sequence[Array],
    family: _Family,
) -> None:
    """Several curves for each unknown."""
    from matplotlib.lines import Line2D

    titles = family.titles()
    few = len(titles) <= MOST_NAMED
    colours = _colours(family)
    strokes = [_STYLES[i % len(_STYLES)] for i in range(len(names))]
    for stroke, rows in zip(strokes, curves, strict=True):
        for colour, title, row in zip(colours, titles, rows, strict=True):
            label = title if few and stroke == strokes[0] else f"_{title}"
            ax.plot(times, row, color=colour, linestyle=stroke, label=label, linewidth=1.3)
    entries = []
    if len(names) > 1:
        pairs = zip(names, strokes, strict=True)
        entries = [Line2D([], [], color="0.3", linestyle=s, label=name) for name, s in pairs]
    if few:
        entries += [
            Line2D([], [], color=colour, label=title)
            for colour, title in zip(colours, titles, strict=True)
        ]
    elif len(family.names) == 1:
        _scale(ax, label_of(solution, family.names[0]), family.values[0])
    if entries and few:
        beside(ax, entries)
    elif entries:
        ax.legend(handles=entries, fontsize="small", framealpha=0.8)


def _colours(family: _Family) -> list[Any]:
    """A colour for each curve: of its value where one parameter varies."""
    count = family.values.shape[1]
    if len(family.names) == 1:
        row = family.values[0]
        return shades((row - row.min()) / np.ptp(row))
    if count <= MOST_NAMED:
        return list(PALETTE[:count])
    from matplotlib.colors import to_rgba

    return [to_rgba(PALETTE[0], 0.35)] * count


def _scale(ax: Axes, label: str, values: Array) -> None:
    """A colour scale beside the axes."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    colours = ListedColormap(shades(np.linspace(0.0, 1.0, 256)))
    mappable = ScalarMappable(Normalize(values.min(), values.max()), colours)
    figure = ax.get_figure()
    assert figure is not None
    bar = figure.colorbar(mappable, ax=ax, label=label, pad=0.02)
    bar.outline.set_visible(False)
