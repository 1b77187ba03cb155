"""What all plots share: checked arguments, figures and axes, legends and labels."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import (
    EvaluationError,
    OptionError,
    listing,
    optional_module,
    quote,
    shown,
)
from rankone.tensors.coordinates import LOG

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.typing import ColorType

    from rankone.solution.solution import Solution


PALETTE = ("#0072B2", "#D55E00", "#009E73", "#AA4499", "#E69F00", "#56B4E9", "#444444", "#8C6D31")
"""Colours that people with any kind of colour vision tell apart (after Okabe & Ito, 2008)."""
BAND: dict[str, Any] = {"alpha": 0.2, "linewidth": 0}
"""How bands are filled."""
MOST_NAMED = len(PALETTE)
"""Lines up to which each one is named: as many as there are colours."""

MOST_IN_LABEL = 4  # Unknowns that are named beside an axis; more do not fit
_SHADES = (0.05, 0.87)  # Range of the colour map that is used: neither too dark nor too light
FIGURE_SIZE = (5.6, 3.5)  # Width and height of a figure of one plot, in inches
_PANEL_SIZE = (3.7, 2.9)  # Width and height of each panel of several, in inches
_WIDEST_GRID = 9.0  # Width of a figure of many small panels, in inches
_MOST_FIXED = 12  # Values that are named above a plot
_TITLE_WIDTH = 76  # Letters of a line of them: the width of a figure
_FIXED = "fixed values"


def several_axes(ax: object, count: int, title: str) -> NDArray[np.object_]:
    """Axes of some panels, (count,): those given, or those of a new figure.

    A new figure has a title, and at most three panels in a row (four as two by two).
    """
    axes = np.empty(count, dtype=object)
    if ax is not None:
        several = list(np.ravel(np.asarray(ax, dtype=object)))
        if len(several) != count:
            raise OptionError(
                f"{len(several)} axes were given for {count} panels",
                term=ax,
                remedy=f"give {count}, or leave ax out",
            )
        axes[:] = [axes_for(one) for one in several]
        return axes
    columns = 2 if count in (2, 4) else min(count, 3)
    rows = -(-count // columns)
    width, height = _PANEL_SIZE
    figure, grid = _pyplot().subplots(
        rows, columns, figsize=(width * columns, height * rows), layout="constrained", squeeze=False
    )
    for unused in [*grid.flat][count:]:
        unused.remove()
    axes[:] = [_dressed(one) for one in [*grid.flat][:count]]
    figure.suptitle(title)
    return axes


def grid_of(n: int) -> NDArray[np.object_]:
    """Axes of a new figure in n rows and columns, (n * n,)."""
    width = min(_PANEL_SIZE[1], _WIDEST_GRID / n)
    _, grid = _pyplot().subplots(
        n, n, figsize=(width * n, width * n), layout="constrained", squeeze=False
    )
    axes = np.empty(n * n, dtype=object)
    axes[:] = [_dressed(one) for one in grid.flat]
    return axes


def stacked(*heights: float) -> tuple[Axes, ...]:
    """Axes of a new figure below each other, with one common abscissa."""
    width, height = FIGURE_SIZE
    _, grid = _pyplot().subplots(
        len(heights),
        figsize=(width, height * sum(heights)),
        height_ratios=heights,
        sharex=True,
        layout="constrained",
        squeeze=False,
    )
    return tuple(_dressed(axes) for axes in grid.flat)


def axes_for(ax: object) -> Axes:
    """The axes that were given, or those of a new figure; empty ones get a light grid."""
    pyplot = _pyplot()
    if ax is None:
        _, ax = pyplot.subplots(figsize=FIGURE_SIZE, layout="constrained")
    from matplotlib.axes import Axes

    if not isinstance(ax, Axes):
        raise OptionError(
            f"ax={shown(ax)} are not axes of Matplotlib",
            term=ax,
            remedy="figure, ax = matplotlib.pyplot.subplots()",
        )
    return ax if ax.has_data() or ax.name != "rectilinear" else _dressed(ax)


def figure_of(ax: Axes) -> Figure | SubFigure:
    """The figure that axes are in."""
    figure = ax.get_figure()
    assert figure is not None
    return figure


def _dressed(ax: Axes) -> Axes:
    ax.set_prop_cycle(color=PALETTE)
    ax.grid(True, color="0.9", linewidth=0.7)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def _pyplot() -> ModuleType:
    pyplot: ModuleType = optional_module(
        "matplotlib.pyplot", "plots need Matplotlib", "pip install matplotlib"
    )
    return pyplot


def colours_for(ax: Axes, count: int) -> list[str]:
    """Colours of new lines: the next ones of the palette, or of a scale for many lines."""
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


def colour_scale(ax: Axes, mappable: ScalarMappable, label: str) -> None:
    """A colour scale beside the axes."""
    bar = figure_of(ax).colorbar(mappable, ax=ax, label=label, pad=0.02)
    bar.outline.set_visible(False)


def line_key(label: str, colour: ColorType = "0.3", **look: Any) -> Line2D:
    """What a line means, for a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, label=label, **look)


def band_key(label: str, colour: ColorType = "0.3") -> Patch:
    """What a band means, for a legend."""
    from matplotlib.patches import Patch

    return Patch(color=colour, label=label, **BAND)


def legend_inside(ax: Axes, handles: Sequence[Artist]) -> None:
    """A legend where it hides least."""
    ax.legend(handles=handles, fontsize="small")


def legend_above(ax: Axes, handles: Sequence[Artist]) -> None:
    """A legend above the axes, where it hides nothing."""
    ax.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.2,
        ncols=len(handles),
        frameon=False,
        fontsize="small",
    )


def legend_beside(ax: Axes, handles: Sequence[Artist]) -> None:
    """A legend to the right of the axes, where it hides nothing."""
    ax.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(1.02, 1.0),
        borderaxespad=0.0,
        frameon=False,
        fontsize="small",
    )


def name_ends(ax: Axes, lines: Sequence[Line2D], names: Sequence[str]) -> None:
    """Write names at the right ends of lines, moved apart; in a legend if there are many."""

    last = [float(np.asarray(line.get_ydata())[-1]) for line in lines]
    if len(lines) > MOST_NAMED or not np.isfinite(last).all():
        for line, name in zip(lines, names, strict=True):
            line.set_label(name)
        legend_beside(ax, lines)
        return
    from rankone.share.plotting.line_ends import EndNames

    EndNames(ax, lines, names)


def name_fixed(ax: Axes, solution: Solution, values: Mapping[str, float]) -> None:
    """Name the coordinates that have one value, above axes without a title.

    A second drawing into the same axes with other values takes the first one's away.
    """
    texts = [value_of(solution, name, value) for name, value in values.items()]
    if len(texts) > _MOST_FIXED:
        texts[_MOST_FIXED:] = [f"and {len(texts) - _MOST_FIXED} more"]
    text = textwrap.fill(", ".join(texts), _TITLE_WIDTH)
    title = ax.findobj(lambda each: each.get_gid() == _FIXED, include_self=False)
    if title and title[0].get_text() != text:  # type: ignore[attr-defined]
        title[0].set(text="", gid=None)
    elif text and not ax.has_data() and not ax.get_title() and not ax.get_title(loc="left"):
        ax.set_title(text, fontsize="small", loc="left", color="0.3", gid=_FIXED)


def label_of(solution: Solution, name: str) -> str:
    """Name of an unknown or a coordinate, with its unit: ``x [m]``."""
    return labels_of(solution, [name])


def value_of(solution: Solution, name: str, point: float) -> str:
    """A value of a coordinate with its unit: ``t = 2 s``."""
    return f"{name} = {point:.4g} {dict(solution.metadata.units).get(name, '')}".rstrip()


def shares_of(solution: Solution, name: str, points: Array) -> Array:
    """Where values of a parameter lie in its interval, from 0 to 1, on its scale."""
    scale = solution._scale(name)
    lower, upper = scale.to_scale(np.array(solution.parameters[name]))
    return np.asarray((scale.to_scale(points) - lower) / (upper - lower))


def axis_scale(solution: Solution, name: str) -> str:
    """The scale of an axis of a coordinate, as Matplotlib calls it."""
    return "log" if solution._scale(name).kind == LOG else "linear"


def range_of(solution: Solution, name: str) -> str:
    """The interval of a parameter with its unit: ``m: 1 to 2 kg``."""
    lower, upper = solution.parameters[name]
    unit = dict(solution.metadata.units).get(name, "")
    return f"{name}: {lower:.4g} to {upper:.4g} {unit}".rstrip()


def labels_of(solution: Solution, names: Sequence[str]) -> str:
    """Names of several unknowns; the unit once where all have the same: ``x, y [m]``."""
    units = dict(solution.metadata.units)
    text = "unknowns" if len(names) > MOST_IN_LABEL else ", ".join(names)
    if len({units.get(name) for name in names}) == 1:
        unit = units.get(names[0])
        return f"{text} [{unit}]" if unit else text
    return text if len(names) > MOST_IN_LABEL else ", ".join(label_of(solution, n) for n in names)


# -----------------------------------------------------------------------------
# Arguments of plots: the solution, the unknowns and the times that they select, checked.


SMOOTH_POINTS = 201
"""Points of what is smoother than a curve: bands, indices, densities."""


def check_solution(function: str, solution: object) -> None:
    """Raise an OptionError unless what a function was given is a solution."""
    if not isinstance(solution, SolutionCore):
        raise OptionError(
            f"{function} needs a Solution, not {type(solution).__name__}",
            term=solution,
            remedy="give what rankone.solve(problem) returns; of a solution of fields an output: "
            'solution.output({"name": solution[u][3]})',
        )


def states_of(solution: Solution, given: object) -> list[str]:
    """Names of one or several unknowns or derivatives that are states; all unknowns for None."""
    if given is None:
        return list(solution.unknowns)
    several = given if isinstance(given, list | tuple) else [given]
    names = [solution[one].name for one in several]
    if not names or len(set(names)) < len(names):
        problem = "one of them occurs twice" if names else "none is given"
        raise OptionError(
            f"the unknowns are {shown(given)}: {problem}",
            term=given,
            remedy=f"choose from {listing(solution.states)}",
        )
    return names


def unknowns_of(solution: Solution, given: object) -> list[str]:
    """The names of unknowns; statistics know no other states."""
    names = states_of(solution, given)
    for name in names:
        if name not in solution.unknowns:
            raise EvaluationError(
                f"{quote(name)} is a state, not an unknown; there are statistics of "
                f"{listing(solution.unknowns)}",
                term=name,
                remedy="solution.diff gives derivatives as a solution with statistics of its own",
            )
    return names


def unknown_of(solution: Solution, given: object) -> str:
    """The name of one unknown; the first for None."""
    return unknowns_of(solution, _one(given))[0]


def state_of(solution: Solution, given: object, function: str) -> str:
    """The name of one unknown, or derivative that is a state; the only unknown for None."""
    if _one(given) is not None:
        return states_of(solution, given)[0]
    if len(solution.unknowns) > 1:
        raise EvaluationError(
            f"there are {len(solution.unknowns)} unknowns: {', '.join(solution.unknowns)}",
            remedy=f"choose one: {function}(solution, unknown)",
        )
    return solution.unknowns[0]


def _one(given: object) -> object:
    """The given unknown, or an OptionError if there are several."""
    if isinstance(given, list | tuple):
        raise OptionError(
            f"unknown={shown(given)} names several", term=given, remedy="plot one after another"
        )
    return given


def times_of(solution: Solution, t: ArrayLike | None, count: int) -> Array:
    """The given times, (times,), or ``count`` times over the horizon."""
    if t is None:
        return fine_times(solution, solution.time[1], count)
    times = np.atleast_1d(solution._coordinates.checked(0, t))
    if times.ndim > 1 or not times.size:
        problem = "more than one dimension" if times.ndim > 1 else "no entry"
        raise OptionError(f"the times have {problem}", term=t, remedy="give a list of times")
    return times


def fine_times(solution: Solution, end: float, count: int) -> Array:
    """Even times up to an end, and both sides of each meeting of slabs: states may jump there."""
    if solution.outcome.timeline is not None:  # jumps are at times of their own at each point
        return np.linspace(solution.time[0], end, count)
    evenly = np.linspace(solution.time[0], end, count)
    meetings = np.array([slab.start for slab in solution.outcome.slabs[1:]])
    meetings = meetings[(meetings > evenly[0]) & (meetings < end)]
    return np.unique(np.concatenate([evenly, np.nextafter(meetings, evenly[0]), meetings]))


def needs_time(solution: Solution, subject: str) -> None:
    """Raise an EvaluationError if the values do not depend on time."""
    if solution.metadata.timeless:
        raise EvaluationError(
            f"the values do not depend on time: there are no {subject} over it",
            remedy="plot_surface, plot_sobol and plot_main_effects plot them over the parameters",
        )


def sometimes_of(solution: Solution, t: ArrayLike | None, count: int) -> Array | None:
    """The same as :func:`times_of`; None if nothing depends on time."""
    if not solution.metadata.timeless:
        return times_of(solution, t, count)
    solution._times(t)  # raises if a time is given
    return None


def one_time(solution: Solution, t: ArrayLike | None) -> float | None:
    """The one given time; None if nothing depends on time."""
    start, end = solution.time
    remedy = f"give a number in [{start:g}, {end:g}]"
    times = sometimes_of(solution, t, 1)
    if times is None:
        return None
    if t is None:
        raise OptionError("this plot needs a time", remedy=remedy)
    if times.size > 1:
        raise OptionError(f"t={shown(t)} are several times", term=t, remedy=remedy)
    return float(times[0])
