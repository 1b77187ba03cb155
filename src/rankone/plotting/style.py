"""Figures and axes, how they look, and labels: what all plots share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.errors import OptionError, RankoneError
from rankone.support.wording import shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "MOST_NAMED",
    "PALETTE",
    "axes_for",
    "beside",
    "colours_for",
    "name_ends",
    "several_axes",
    "stacked",
]

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#AA4499", "#E69F00", "#56B4E9", "#444444", "#8C6D31")
"""Colours that people with any kind of colour vision tell apart (after Okabe & Ito, 2008)."""
MOST_NAMED = 8
"""Lines up to which each one is named."""

_SHADES = (0.05, 0.87)
"""Part of the colour map that is used: neither too dark nor too light."""
_SIZE = (5.6, 3.5)
"""Width and height of a figure of one plot, in inches."""
_LINE = 1.25
"""Height of a line of labels, in units of the size of their letters."""


def _panels(count: int) -> list[Axes]:
    """So many axes of a new figure, at most three in a row (four as two by two)."""
    columns = 2 if count in (2, 4) else min(count, 3)
    rows = -(-count // columns)
    _, grid = _pyplot().subplots(
        rows, columns, figsize=(3.7 * columns, 2.9 * rows), layout="constrained", squeeze=False
    )
    axes: list[Axes] = [*grid.flat]
    for unused in axes[count:]:
        unused.remove()
    return [_dressed(one) for one in axes[:count]]


def several_axes(ax: Any, count: int) -> tuple[NDArray[np.object_], bool]:
    """The axes of so many panels (count,): those given, or of a new figure, and whether it is new.

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    OptionError
        If another number was given, or what is given are no axes.
    """
    found = np.empty(count, dtype=object)
    if ax is None:
        found[:] = _panels(count)
        return found, True
    given = list(np.ravel(np.asarray(ax, dtype=object)))
    if len(given) != count:
        raise OptionError(
            f"{len(given)} axes were given for {count} panels",
            term=ax,
            remedy=f"give {count}, or leave ax out",
        )
    found[:] = [axes_for(one) for one in given]
    return found, False


def stacked(*heights: float) -> tuple[Axes, ...]:
    """Axes of a new figure below each other, with one common abscissa."""
    width, height = _SIZE
    _, grid = _pyplot().subplots(
        len(heights),
        figsize=(width, height * sum(heights)),
        height_ratios=heights,
        sharex=True,
        layout="constrained",
        squeeze=False,
    )
    return tuple(_dressed(axes) for axes in grid.flat)


def axes_for(ax: Any) -> Axes:
    """The axes that were given, or those of a new figure; empty ones get a light grid.

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    OptionError
        If what was given are no axes.
    """
    pyplot = _pyplot()
    if ax is None:
        _, ax = pyplot.subplots(figsize=_SIZE, layout="constrained")
    from matplotlib.axes import Axes

    if not isinstance(ax, Axes):
        raise OptionError(
            f"ax={shown(ax)} are not axes of Matplotlib",
            term=ax,
            remedy="figure, ax = matplotlib.pyplot.subplots()",
        )
    return ax if ax.has_data() or ax.name != "rectilinear" else _dressed(ax)


def colours_for(ax: Axes, count: int) -> list[str]:
    """Colours of new lines, which go on where those that are there stop; of a scale for many."""
    if count > len(PALETTE):
        return shades(np.linspace(0.0, 1.0, count))
    first = len(ax.get_lines())
    return [PALETTE[(first + i) % len(PALETTE)] for i in range(count)]


def shades(shares: Array) -> list[str]:
    """Colours of a scale that gets lighter, for numbers from 0 to 1."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    darkest, lightest = _SHADES
    colours = colormaps["viridis"](darkest + (lightest - darkest) * shares)
    return [to_hex(colour) for colour in colours]


def _dressed(ax: Axes) -> Axes:
    """Axes with a light grid and without a box around."""
    ax.set_prop_cycle(color=PALETTE)
    ax.grid(True, color="0.9", linewidth=0.7)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def beside(ax: Axes, handles: Sequence[Any] | None = None, **options: Any) -> None:
    """A legend to the right of the axes, where it hides nothing."""
    given = {} if handles is None else {"handles": handles}
    ax.legend(
        **given,
        loc="upper left",
        bbox_to_anchor=(1.02, 1.0),
        borderaxespad=0.0,
        frameon=False,
        fontsize="small",
        **options,
    )


def name_ends(ax: Axes, lines: Sequence[Any], names: Sequence[str]) -> None:
    """Write names at the right ends of lines, moved apart; in a legend if there are many."""
    from matplotlib.font_manager import FontProperties

    ends = np.array([[float(np.asarray(part)[-1]) for part in line.get_data()] for line in lines])
    figure = ax.get_figure()
    assert figure is not None
    ax.autoscale_view()
    heights = ax.transData.transform(ends)[:, 1] * 72.0 / figure.dpi
    if len(lines) > MOST_NAMED or not np.isfinite(heights).all():
        for line, name in zip(lines, names, strict=True):
            line.set_label(name)
        beside(ax, lines)
        return
    letter = FontProperties(size="medium").get_size_in_points()
    places = _apart(heights, _LINE * letter)
    for line, name, end, move in zip(lines, names, ends, places - heights, strict=True):
        ax.annotate(
            name,
            tuple(end),
            xytext=(0.5 * letter, move),
            textcoords="offset points",
            color=line.get_color(),
            verticalalignment="center",
            annotation_clip=False,
        )


def _apart(wanted: Any, gap: float) -> Any:
    """Places with gaps that are closest to those wanted, in the mean square."""
    order = np.argsort(wanted, kind="stable")
    steps = gap * np.arange(len(order))
    found = np.empty(len(order))
    found[order] = scipy.optimize.isotonic_regression(np.asarray(wanted)[order] - steps).x + steps
    return found


def _pyplot() -> Any:
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise RankoneError(
            "plots need Matplotlib, which is not installed", remedy="pip install matplotlib"
        ) from error
    return plt
