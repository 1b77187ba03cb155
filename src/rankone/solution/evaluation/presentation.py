"""A solution as people and other libraries see it: its summary, and xarray.

Labelled values need xarray: ``pip install xarray``, or ``pip install ".[io]"`` in the folder of the
project.
"""

from __future__ import annotations

import html
import textwrap
from collections.abc import Iterable, Mapping
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from rankone.solution.evaluation.core import SolutionCore
from rankone.solvers.outcome import Outcome, with_unit
from rankone.support.arrays import Array
from rankone.support.errors import count, listing, optional_module, shortened
from rankone.support.options import in_words
from rankone.tensors.coordinates import name_of, with_measure

if TYPE_CHECKING:
    import xarray

_TIMES = 101  # Times of labelled values where none are given: one per percent of the horizon
_WIDTH = 96  # Characters of a line of the summary: it fits into a terminal beside a prompt
_MOST_NAMES = 8  # Entries of a list before its middle is left out


def summary_text(solution: SolutionCore) -> str:
    """The summary in lines."""
    title = f"Solution (rankone {solution.metadata.version})".replace(" (rankone )", "")
    return in_lines(title, _summary(solution))


def summary_html(solution: SolutionCore) -> str:
    """The summary as a table, for notebooks."""
    return in_table("Solution", _summary(solution))


def in_lines(title: str, summary: Iterable[tuple[str, str]]) -> str:
    """Headings and texts under a title, in lines that fit into a terminal."""
    lines = [title]
    for heading, text in summary:
        lines += textwrap.wrap(
            text,
            _WIDTH,
            initial_indent=f"  {heading:<10}",
            subsequent_indent=" " * 12,
            break_long_words=False,
        )
    return "\n".join(lines)


def in_table(title: str, summary: Iterable[tuple[str, str]]) -> str:
    """Headings and texts as a table of HTML with a title."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(heading)}</th>"
        f"<td style='text-align:left'>{html.escape(text)}</td></tr>"
        for heading, text in summary
    )
    return f"<table><caption>{html.escape(title)}</caption><tbody>{rows}</tbody></table>"


def _summary(solution: SolutionCore) -> list[tuple[str, str]]:
    """Headings and texts of the summary."""
    metadata, units = solution.metadata, dict(solution.metadata.units)
    named = [f"{name} [{units[name]}]" if name in units else name for name in solution.unknowns]
    timings = [f"{stage} {seconds:.3g} s" for stage, seconds in solution.outcome.timings.items()]
    return [
        ("unknowns", some(named)),
        ("over", over(solution)),
        ("success", f"{'yes' if solution.success else 'no'}: {shortened(solution.message)}"),
        ("error", _error(solution)),
        (metadata.method, trains(solution.outcome)),
        *([("timings", ", ".join(timings))] if timings else []),
    ]


def over(solution: SolutionCore) -> str:
    """The horizon and the box, with what is fixed."""
    metadata, (start, end) = solution.metadata, solution.time
    lower, upper = metadata.horizon
    units, distributions = dict(metadata.units), dict(metadata.distributions)
    whole = "" if end == upper else f" of [{lower:g}, {upper:g}]"
    clock = with_unit(f"{metadata.time} in [{start:g}, {end:g}]{whole}", units, metadata.time)
    box = [
        with_measure(with_unit(f"{name} in [{lo:g}, {hi:g}]", units, name), distributions.get(name))
        for name, (lo, hi) in solution.parameters.items()
    ]
    over = some(box if metadata.timeless else [clock, *box]) or "nothing"
    if metadata.fixed:
        over += "; at " + some(f"{name} = {at:g}" for name, at in metadata.fixed)
    return over


def trains(outcome: Outcome) -> str:
    """How many slabs there are, of which ranks and nodes, and what they take."""
    wholes = [piece.outcome for piece in outcome.pieces] or [outcome]
    slabs = [slab for whole in wholes for slab in whole.slabs]
    ranks = [slab.ranks for slab in slabs]
    highest = max((max(each, default=1) for each in ranks), default=0)
    pieces = [count(len(outcome.pieces), "piece")] if outcome.pieces else []
    texts = [*pieces, count(len(slabs), "slab"), f"rank {highest}"]
    if slabs and slabs[0].bases:
        # branches may have coordinates behind the parameters
        largest = [max(column) for column in zip_longest(*ranks, fillvalue=1)]
        sizes = ([basis.size for basis in slab.bases] for slab in slabs)
        nodes = [max(column) for column in zip_longest(*sizes, fillvalue=1)]
        texts.append(f"ranks up to ({some(map(str, largest))})")
        texts.append(f"nodes up to ({some(map(str, nodes))})")
    sampled = outcome.history[-1].integrator if outcome.history else ""
    if outcome.measured is not None and sampled not in ("", outcome.measured.integrator):
        texts.append(f"samples ({sampled})")
    size = sum(core.nbytes for slab in slabs for core in slab.cores)
    return ", ".join([*texts, in_words(size)])


def _error(solution: SolutionCore) -> str:
    """The measured errors, and of which states."""
    measured, tolerance = solution.outcome.measured, f"tolerance {solution.rtol:.3g}"
    if measured is None:
        return f"not measured, {tolerance}"
    means = f"({measured.integrator}, {measured.method})"
    how = f"measured on {measured.points} trajectories {means}"
    if not measured.points:
        how = "bounded by the measured errors of fields"
    text = f"{solution.error:.2g} {how}, {tolerance}"
    if measured.drift is not None:
        text += f", lifted states drift by {measured.drift:.2g}"
    if measured.constraint_drift is not None:
        text += f", constraints drift by {measured.constraint_drift:.2g}"
    if measured.counted is not None:
        text = f"of {listing(solution.states[i] for i in measured.counted)} {text}"
    if measured.quantile is not None:
        text += f", 95 % below {measured.quantile:.2g}"
    if len(solution.errors) > 1:
        text += "; " + some(f"{name} {error:.2g}" for name, error in solution.errors.items())
    if solution.metadata.atol:
        absolute = (f"{name} {size:.2g}" for name, size in solution.metadata.atol)
        text += f"; absolute tolerances {some(absolute)}"
    return text


def some(texts: Iterable[str]) -> str:
    """Join texts, leaving out the middle of many."""
    visible = list(texts)
    if len(visible) > _MOST_NAMES:
        hidden = len(visible) - _MOST_NAMES + 1
        visible[_MOST_NAMES - 2 : -1] = [f"... ({hidden} more)"]
    return ", ".join(visible)


def dataset(solution: SolutionCore, coordinates: Mapping[Any, ArrayLike]) -> xarray.Dataset:
    """The unknowns on the grid of all combinations of coordinates.

    Each coordinate, by name, is a number, which becomes a scalar coordinate, or one-dimensional.
    """
    module, points = xarray_and_points(solution, coordinates)
    grid = solution.grid(points)
    units = {name: {"units": unit} for name, unit in solution.metadata.units}
    axes = {name: np.asarray(points[name], dtype=float) for name in solution.metadata.coordinates}
    labelled: xarray.Dataset = module.Dataset(
        {
            name: (
                tuple(axes),
                on_grid,
                {"long_name": name, "error": solution.errors[name], **units.get(name, {})},
            )
            for name, on_grid in zip(solution.unknowns, grid, strict=True)
        },
        labelled_axes(solution, axes),
        {
            **request_of(solution),
            "success": int(solution.success),
            "comment": solution.message,
        },
    )
    return labelled.squeeze([name for name, axis in axes.items() if axis.ndim == 0])


def xarray_and_points(
    solution: SolutionCore, coordinates: Mapping[Any, ArrayLike]
) -> tuple[Any, dict[str, Any]]:
    """The module, and values of all coordinates by name; times where none are given."""
    module = optional_module("xarray", "labelled values need xarray", "pip install xarray")
    start, end = solution.time
    points: dict[str, Any] = {name_of(key): at for key, at in coordinates.items()}
    if not solution.metadata.timeless:
        points.setdefault(solution.metadata.time, np.linspace(start, end, _TIMES))
    return module, points


def labelled_axes(solution: SolutionCore, axes: Mapping[str, Array]) -> dict[str, Any]:
    """Time and parameters as coordinates of a data set."""
    units = dict(solution.metadata.units)
    named = {name: {"units": units[name]} if name in units else {} for name in axes}
    return {
        name: (name, np.atleast_1d(axis), {"long_name": name, **named[name]})
        for name, axis in axes.items()
    }


def request_of(solution: SolutionCore) -> dict[str, Any]:
    """What was asked, as attributes of a data set."""
    return {
        "title": "; ".join(solution.metadata.statements),
        "source": f"rankone {solution.metadata.version}, method {solution.method}",
        "rtol": solution.rtol,
    }
