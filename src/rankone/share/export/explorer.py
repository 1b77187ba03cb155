"""The page that explores a solution: one HTML file, its data and its sentences."""

from __future__ import annotations

import html
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.share.export.mathml import Notation
from rankone.share.export.packing import PackedBranch, PackedModel, PackedTimeline, pack
from rankone.share.export.pages import (
    CURVE_TIMES,
    ENDED,
    asked_for,
    equation_fields,
    error_fields,
    heading,
    named,
    over_box,
    page_target,
    page_text,
    paragraphs,
    parameter_entries,
    rounded_curve,
    unbroken,
    unknown_entries,
)
from rankone.solvers.outcome import Measured, Role
from rankone.support.arrays import SAME, Array
from rankone.support.errors import ExportError, RankoneWarning, listing
from rankone.support.files import write_files
from rankone.tensors.branch_evaluator import BranchEvaluator
from rankone.tensors.timeline_evaluator import TimelineEvaluator

if TYPE_CHECKING:
    from rankone.solution.statistics.densities import DistributionOverBox


__all__ = ["export_page"]

_SCRIPTS = (
    *("values", "measurements", "fitting", "looks", "events", "curves", "phase", "shares"),
    *("controls", "legend", "state", "frames", "trajectory", "drawing", "moves", "actions", "main"),
)


def export_page(
    solution: DistributionOverBox,
    path: str | PathLike[str],
    *,
    title: str | None = None,
    rtol: float | None = None,
    overwrite: bool = False,
    allow_failed: bool = False,
) -> Path:
    """What :meth:`rankone.Solution.explore` does."""
    target = page_target(path, overwrite)
    title = heading(title, solution.metadata, target)
    if solution.metadata.timeless:
        raise ExportError(
            "these values do not depend on time, and a page shows curves over time",
            remedy="write a model (model.js), or plot them: rankone.share.plotting.plot_surface",
        )
    full = with_derivatives(solution)
    model = pack(full, rtol=rtol, allow_failed=allow_failed)
    text = _page(full, solution, model, title, rtol)
    write_files({target: text}, overwrite, ExportError)
    return target


def _page(
    full: DistributionOverBox,
    solution: DistributionOverBox,
    model: PackedModel,
    title: str,
    rtol: float | None,
) -> str:
    """Text of the page; ``full`` is the solution with its derivatives among the unknowns."""
    notation = Notation(solution.metadata)
    data = content(full, model, notation)
    sentences = quality(solution, model)
    distributed = any(parameter["distribution"] for parameter in data["parameters"])
    fields = {
        "title": html.escape(title),
        "lead": html.escape(lead(data)),
        "success": "yes" if solution.success else "",
        "covers": _covers(solution, rtol),
        "bands": "under their distributions" if distributed else "over their ranges",
        "message": html.escape(sentences[0]),
        "quality": paragraphs(sentences),
        **error_fields(data["unknowns"]),
        **equation_fields(notation),
        "parameters": "yes" if data["parameters"] else "",
        "sobol": "yes" if data["sobol"] else "",
        "events": "yes" if model.events else "",
        "running": " of what still runs" if model.terminal else "",
        "phase": "yes" if len(data["unknowns"]) > 1 else "",
    }
    return page_text("curves.html.in", _SCRIPTS, data, model, fields)


def _covers(solution: DistributionOverBox, rtol: float | None) -> str:
    """Where the error was measured, and what it may be, in HTML."""
    measured = solution.outcome.measured
    if measured is None:
        return ""
    place = "in the whole box" if measured.cover == "box" else "inside the box"
    text = asked_for(solution.rtol, rtol)
    return f"{place} ({text})" if solution.parameters else f"({text})"


# -----------------------------------------------------------------------------
# The data of the page, and its sentences about the solution.


_TIMES_IN_SLAB = 4  # Further times in each slab
_MOST_SLABS = 100  # Slabs up to which each has further times; of more slabs, even times show enough
_SENSITIVITY_TIMES = 61  # Evenly spaced times with Sobol indices, at first
_MOST_SENSITIVITY_TIMES = 600  # Most times with Sobol indices, so that a page stays small
_MAX_HALVINGS = 8  # How often the intervals between times with Sobol indices are halved
_SHARE_TOLERANCE = 0.003  # How far interpolated Sobol indices may be off: about a pixel
_TIMES_IN_STRETCH = 16  # Times at least in each stretch between events
_MOST_NAMED = 3  # Parameters up to which each range is in the first sentence


def with_derivatives(solution: DistributionOverBox) -> DistributionOverBox:
    """The same solution with derivatives that are states among the unknowns."""
    metadata = solution.metadata
    roles = tuple(Role.UNKNOWN if r == Role.DERIVATIVE else r for r in metadata.roles)
    return type(solution)(solution.outcome, replace(metadata, roles=roles))


def content(
    solution: DistributionOverBox, model: PackedModel, notation: Notation
) -> dict[str, Any]:
    """Names, ranges, times, bands and sensitivities of a solution with its derivatives.

    ``model`` is what the page evaluates, with the same unknowns.
    """
    times = curve_times(solution)
    metadata = solution.metadata
    units = dict(model.units)
    quantiles = over_box(solution, times)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ENDED, RankoneWarning)
        sobol = _sensitivities(solution) if _has_indices(solution) else None
    _, low, high, _ = quantiles
    errors = {
        name: None if np.isnan(error) else error
        for name, error in zip(model.unknowns, model.errors, strict=True)
    }
    return {
        "unknowns": unknown_entries(solution, quantiles, errors, notation),
        "parameters": parameter_entries(metadata, notation),
        "time": {
            **named(metadata.time, notation, units),
            "range": list(model.intervals[0]),
            "start": _opening_time(times, low, high),
        },
        "times": times.tolist(),
        "stretches": _stretches(model),
        "terminal": model.terminal,
        "sobol": sobol,
    }


def _opening_time(times: Array, low: Array, high: Array) -> float:
    """The time at which the bands of the unknowns (n, times) are widest, beside their own largest.

    The beginning where nothing varies.
    """
    widths = np.nan_to_num(high - low, nan=0.0)
    largest = widths.max(axis=1, keepdims=True, initial=0.0)
    shares = np.divide(widths, largest, out=np.zeros(widths.shape), where=largest > 0.0)
    return float(times[int(np.argmax(shares.sum(axis=0)))])


def _has_indices(solution: DistributionOverBox) -> bool:
    """Whether there are shares of the variance."""
    return len(solution.metadata.parameters) > 1 and not solution.metadata.correlations


def _stretches(model: PackedModel) -> list[list[list[float]]] | None:
    """For each order of events the shares of each stretch at which curves are drawn, from 0 on."""
    if model.events is None:
        return None
    pairs = zip(model.branches, model.timelines, strict=True)
    return [_shares(branch, timeline) for branch, timeline in pairs]


def _shares(branch: PackedBranch, timeline: PackedTimeline) -> list[list[float]]:
    """Shares of each stretch between events at which curves are drawn, from 0 on."""
    stretches = []
    for i, (first, last) in enumerate(pairwise(timeline.first_slabs)):
        slabs = [i, *branch.starts[first + 1 : last], i + 1]
        if len(branch.starts) > _MOST_SLABS:
            slabs = [i, i + 1]
        each = max(_TIMES_IN_SLAB, math.ceil(_TIMES_IN_STRETCH / (len(slabs) - 1)))
        shares = [np.linspace(a, b, each, endpoint=False) - i for a, b in pairwise(slabs)]
        stretches.append(np.concatenate(shares).tolist())
    return stretches


def curve_times(solution: DistributionOverBox) -> Array:
    """Times at which curves are drawn: evenly spaced, further ones in each slab.

    Each slab has its beginning and the last time before its end, so that jumps are steep. With
    events the page adds its own times in each stretch.
    """
    start, end = solution.time
    times = [np.linspace(start, end, CURVE_TIMES)]
    slabs = solution.outcome.slabs
    if solution.outcome.timeline is None and len(slabs) <= _MOST_SLABS:
        times += [
            np.linspace(slab.start, slab.end, _TIMES_IN_SLAB, endpoint=False) for slab in slabs
        ]
    return _with_both_sides(solution, np.concatenate(times))


def _with_both_sides(solution: DistributionOverBox, times: Array) -> Array:
    """Times, the beginnings of slabs and the last times before them, ascending.

    With events times around those that are the same for all parameters.
    """
    start, end = solution.time
    evaluator = solution._evaluator
    if isinstance(evaluator, BranchEvaluator):
        around = (_around_fixed_borders(b, solution.parameters) for b in evaluator.branches)
        inner = np.concatenate([*around])
    elif isinstance(evaluator, TimelineEvaluator):
        inner = _around_fixed_borders(evaluator, solution.parameters)
    else:
        starts = [slab.start for slab in solution.outcome.slabs[1:]]
        inner = np.concatenate([starts, np.nextafter(starts, start)])
    merged = np.unique(np.concatenate([times, inner]))
    return merged[(merged >= start) & (merged <= end)]


def _around_fixed_borders(
    evaluator: TimelineEvaluator, box: Mapping[str, tuple[float, float]]
) -> Array:
    """Times around the borders of stretches that are the same at two corners and in the middle."""
    ends = np.array(list(box.values())).reshape(-1, 2)
    borders = evaluator.borders(ends @ np.array([[1.0, 0.5, 0.0], [0.0, 0.5, 1.0]]))
    aside = SAME * (evaluator.horizon[1] - evaluator.horizon[0])
    fixed = borders[np.ptp(borders, axis=1) <= aside]
    return np.concatenate([fixed.min(axis=1) - aside, fixed.max(axis=1) + aside])


def _sensitivities(solution: DistributionOverBox) -> dict[str, Any]:
    """Sobol indices over time: (unknowns, parameters, times) each; null where not defined.

    The page interpolates: intervals between times are halved until that is accurate in their
    middles, or there are too many times. With events times are even.
    """

    def shares_at(times: Array) -> Array:
        return np.stack(solution._first_and_total(times, solution._statistics()))

    eventful = solution.outcome.timeline is not None
    times = _with_both_sides(solution, np.linspace(*solution.time, _SENSITIVITY_TIMES))
    shares = shares_at(times)
    for _ in range(0 if eventful else _MAX_HALVINGS):
        middles = 0.5 * (times[1:] + times[:-1])
        wide = np.diff(times) > SAME * (times[-1] - times[0])
        exact, between = shares_at(middles), 0.5 * (shares[..., 1:] + shares[..., :-1])
        close = (np.abs(exact - between) <= _SHARE_TOLERANCE) | (
            np.isnan(exact) & np.isnan(between)
        )
        halved = np.flatnonzero(wide & ~close.all(axis=(0, 1, 2)))
        if not 0 < halved.size <= _MOST_SENSITIVITY_TIMES - times.size:
            break
        times = np.insert(times, halved + 1, middles[halved])
        shares = np.insert(shares, halved + 1, exact[..., halved], axis=-1)
    return {
        "times": times.tolist(),
        **{
            order: [[rounded_curve(row) for row in unknown] for unknown in share]
            for order, share in zip(("first", "total"), shares.tolist(), strict=True)
        },
    }


def lead(data: Mapping[str, Any]) -> str:
    """The unknowns and the box, as the first sentence of a page with this :func:`content`."""

    def joined(names: Sequence[str]) -> str:
        return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"

    parameters = data["parameters"]
    box = f", for every value of {len(parameters)} parameters" if parameters else ""
    if 0 < len(parameters) <= _MOST_NAMED:
        ranges = [
            f"{p['text']} from {p['range'][0]:g} to {p['range'][1]:g} {p['unit']}".strip()
            for p in parameters
        ]
        box = f", for every {joined(ranges)}"
    unknowns = joined([unknown["text"] for unknown in data["unknowns"]])
    return f"{unknowns} over {data['time']['text']}{box}."


def quality(solution: DistributionOverBox, model: PackedModel) -> list[str]:
    """How the solve ended, how good the solution is and what its success covers, in sentences."""
    end = solution.time[1]
    horizon_end = solution.metadata.horizon[1]
    time = solution.metadata.time
    lines = [f"{solution.message[:1].upper()}{solution.message[1:]}".rstrip(".") + "."]
    if end < horizon_end:
        lines.append(f"Only a part was solved: {time} up to {end:.6g} of {horizon_end:.6g}.")
    if solution.metadata.correlations:
        lines.append("Parameters are correlated: bands know it, Sobol indices are not defined.")
    measured = solution.outcome.measured
    if measured is None:
        return [*lines, "The error of this solution is not known: it was not measured."]
    lines += _of_errors(measured, solution)
    if model.events is not None and _has_indices(solution):
        lines.append("Sobol indices are from points, and good to 0.02.")
    if model.terminal:
        lines.append(
            "Where some trajectories have ended, bands are those of the others, and Sobol indices "
            "are not defined."
        )
    if model.choice is not None:
        lines.append(
            "The order of events changes with the parameters. Next to a change curves that depend "
            "on it have a gap, and bands are those of the likelier order."
        )
    if model.reduction is not None:
        lines.append(f"{model.reduction} The errors of the table are those of both together.")
    return unbroken(lines)


def _of_errors(measured: Measured, solution: DistributionOverBox) -> list[str]:
    """Where the error was measured, and how large the parts of it are, in sentences."""
    if not measured.points:
        return [
            "The error is bounded by the measured errors of fields, relative to the largest value "
            f"of each unknown; the tolerance asked for is {solution.rtol:.3g}."
        ]
    lines = [
        f"The error was measured on {measured.points} trajectories ({measured.method}), relative "
        f"to the largest value of each unknown; the tolerance asked for is {solution.rtol:.3g}."
    ]
    if measured.counted is not None:
        names = listing(solution.states[i] for i in measured.counted)
        lines.append(f"Success is about {names} alone.")
    if measured.cover == "box":
        lines.append("The corners of the box are among them.")
    elif measured.corners:
        lines.append(
            "It covers the interior of the box; its corners do not count: there the error is up to "
            f"{measured.corner_error:.2g}."
        )
    if measured.quantile is not None:
        lines.append(f"95 % of the trajectories are met to {measured.quantile:.2g}.")
    if measured.drift is not None:
        lines.append(f"Lifted states drift by {measured.drift:.2g} from what they stand for.")
    if measured.constraint_drift is not None:
        drift = f"{measured.constraint_drift:.2g}"
        lines.append(f"The constraints of algebraic equations are met to {drift}.")
    if measured.time_error is not None:
        lines.append(f"Times of events are met to {measured.time_error:.2g} of the horizon.")
    return lines
