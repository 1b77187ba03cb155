"""What a page shows of a solution, in plain data, and what it says of it in sentences."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.export.explorer.mathml import Notation
from rankone.export.packing import PackedModel
from rankone.ir.metadata import Role
from rankone.statistics.distributions import Measure, from_text
from rankone.support.arrays import Array
from rankone.support.wording import listing

if TYPE_CHECKING:
    from rankone.statistics.densities import DistributionOverBox

__all__ = [
    "BAND",
    "content",
    "curve_times",
    "lead",
    "place",
    "quality",
    "spread",
    "with_derivatives",
]

BAND = (0.025, 0.975)
"""Probabilities between which the bands lie."""

_TIMES, _IN_SLAB, _MOST_SLABS = 401, 4, 100
_SENSITIVITIES, _MOST_SENSITIVITIES, _HALVINGS = 121, 600, 8
_SHARE, _NARROW = 0.003, 1e-6
"""How far interpolated Sobol indices may be off, and part of the horizon that is not halved."""
_POINTS = 2**12
"""Points over the box of which the quantiles are."""
_DIGITS = 7
_MOST_NAMED = 3
"""Parameters up to which each range is in the first sentence."""


def with_derivatives(solution: Any) -> Any:
    """The same solution, its derivatives that are states counted among the unknowns."""
    metadata = solution.metadata
    roles = tuple(Role.UNKNOWN if r == Role.DERIVATIVE else r for r in metadata.roles)
    return type(solution)(solution.outcome, replace(metadata, roles=roles))


def content(
    solution: DistributionOverBox, model: PackedModel, notation: Notation
) -> dict[str, Any]:
    """Names, ranges, times, bands and sensitivities.

    Parameters
    ----------
    solution : Solution
        Of :func:`with_derivatives`.
    model : PackedModel
        What the page evaluates, with the same unknowns.
    notation : Notation
        How names are written.
    """
    times = curve_times(solution)
    metadata = solution.metadata
    units = dict(model.units)

    def named(name: str) -> dict[str, Any]:
        symbol = notation.symbol(name)
        return {
            "name": name,
            "text": notation.text(name),
            "symbol": symbol,
            "unit": units.get(name, ""),
        }

    lowest, low, high, highest = solution.quantile((0.0, *BAND, 1.0), times, count=_POINTS)
    given = dict(metadata.distributions)
    derivatives = notation.derivatives
    return {
        "unknowns": [
            {
                **named(name),
                "derivative": name in derivatives,
                "error": None if np.isnan(model.errors[i]) else model.errors[i],
                "extent": [float(lowest[i].min()), float(highest[i].max())],
                "low": _rounded(low[i]) if metadata.parameters else None,
                "high": _rounded(high[i]) if metadata.parameters else None,
            }
            for i, name in enumerate(model.unknowns)
        ],
        "parameters": [
            {
                **named(name),
                "range": list(ends),
                "distribution": given.get(name, ""),
                "median": _median(name, ends, given.get(name)),
            }
            for name, ends in solution.parameters.items()
        ],
        "time": {**named(metadata.time), "range": list(model.intervals[0])},
        "times": times.tolist(),
        "sobol": _sensitivities(solution) if _has_sensitivities(solution) else None,
    }


def _median(name: str, ends: tuple[float, float], distribution: str | None) -> float:
    """The median of a parameter, with as many digits as a slider has."""
    lower, upper = ends
    if distribution is None:
        return lower + 0.5 * (upper - lower)
    measure = Measure(name, lower, upper, from_text(distribution), from_problem=True)
    value = round(float(measure.sample(np.array(0.5))), 3 - math.floor(math.log10(upper - lower)))
    return min(upper, max(lower, value))


def curve_times(solution: DistributionOverBox) -> Array:
    """Times at which curves are drawn: even ones, and some of every slab.

    Of each slab there is its beginning and the last time before its end, so that jumps are steep.
    """
    start, end = solution.time
    times = [np.linspace(start, end, _TIMES)]
    slabs = solution.outcome.slabs
    if len(slabs) <= _MOST_SLABS:
        times += [np.linspace(slab.start, slab.end, _IN_SLAB, endpoint=False) for slab in slabs]
    return _with_both_sides(solution, np.concatenate(times))


def _with_both_sides(solution: DistributionOverBox, times: Array) -> Array:
    """Times, and those at which slabs begin with the last ones before them, ascending."""
    start, end = solution.time
    inner = [slab.start for slab in itertools.islice(solution.outcome.slabs, 1, None)]
    found = np.unique(np.concatenate([times, inner, np.nextafter(inner, start)]))
    return found[(found >= start) & (found <= end)]


def _has_sensitivities(solution: DistributionOverBox) -> bool:
    """Whether there are several parameters, which are independent."""
    return len(solution.metadata.parameters) > 1 and not solution.metadata.correlations


def _sensitivities(solution: DistributionOverBox) -> dict[str, Any]:
    """Sobol indices over time: (unknowns, parameters, times) each; null where not defined.

    There are so many times that the page, which interpolates, is close enough in the middle
    between any two, unless there would be too many.
    """
    times = _with_both_sides(solution, np.linspace(*solution.time, _SENSITIVITIES))
    shares = _shares(solution, times)
    for _ in range(_HALVINGS):
        middles = 0.5 * (times[1:] + times[:-1])
        wide = np.diff(times) > _NARROW * (times[-1] - times[0])
        found, between = _shares(solution, middles), 0.5 * (shares[..., 1:] + shares[..., :-1])
        close = (np.abs(found - between) <= _SHARE) | (np.isnan(found) & np.isnan(between))
        new = np.flatnonzero(wide & ~close.all(axis=(0, 1, 2)))
        if not 0 < new.size <= _MOST_SENSITIVITIES - times.size:
            break
        times = np.insert(times, new + 1, middles[new])
        shares = np.insert(shares, new + 1, found[..., new], axis=-1)
    return {
        "times": times.tolist(),
        **{
            kind: [[_rounded(row, 5) for row in unknown] for unknown in share]
            for kind, share in zip(("first", "total"), shares.tolist(), strict=True)
        },
    }


def _shares(solution: DistributionOverBox, times: Array) -> Array:
    """Sobol indices, first and total: (2, unknowns, parameters, times)."""
    indices, _ = solution._indices(times, solution._statistics())
    return np.stack([indices.first, indices.total])


def _rounded(values: Any, digits: int = _DIGITS) -> list[float | None]:
    """Numbers with as many digits as a picture needs; null for what is none."""
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values]


# --- sentences -----------------------------------------------------------------------------------


def lead(data: Mapping[str, Any]) -> str:
    """The unknowns and the box, as the first sentence of a page.

    Parameters
    ----------
    data : mapping
        Of :func:`rankone.export.explorer.content.content`.
    """
    names = [unknown["text"] for unknown in data["unknowns"]]
    return f"{_named(names)} over {data['time']['text']}{_box(data)}."


def _box(data: Mapping[str, Any]) -> str:
    """The box in words."""
    if len(data["parameters"]) > _MOST_NAMED:
        return f", for every value of {len(data['parameters'])} parameters"
    ranges = [
        f"{entry['text']} from {entry['range'][0]:g} to {entry['range'][1]:g} {entry['unit']}"
        for entry in data["parameters"]
    ]
    return f", for every {_named([text.strip() for text in ranges])}" if ranges else ""


def _named(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def spread(data: Mapping[str, Any]) -> str:
    """How the parameters vary of which the bands are."""
    given = any(entry["distribution"] for entry in data["parameters"])
    return "under their distributions" if given else "over their ranges"


def place(solution: Any) -> str:
    """Where the error was measured; empty if it was not, or if there is no box."""
    measured = solution.outcome.measured
    if measured is None or not solution.metadata.parameters:
        return ""
    return "in the whole box" if measured.cover == "box" else "inside the box"


def quality(solution: Any, model: PackedModel) -> list[str]:
    """How good a solution is and what its success covers, in sentences.

    The first says how the solve ended.
    """
    end = solution.time[1]
    wanted = solution.metadata.horizon[1]
    time = solution.metadata.time
    lines = [f"{solution.message[:1].upper()}{solution.message[1:]}".rstrip(".") + "."]
    if end < wanted:
        lines.append(f"Only a part was solved: {time} up to {end:.6g} of {wanted:.6g}.")
    if solution.metadata.correlations:
        lines.append("Parameters are correlated: bands know it, Sobol indices are not defined.")
    measured = solution.outcome.measured
    if measured is None:
        return [*lines, "The error of this solution is not known: it was not measured."]
    lines.append(
        f"The error was measured on {measured.points} trajectories ({measured.method}), relative "
        f"to the largest value of each unknown; the tolerance asked for is {solution.rtol:.3g}."
    )
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
    made = [line for line in model.summary if line.startswith("Made smaller")]
    lines += [f"{line} The errors of the table are those of both together." for line in made]
    # a minus sign, at which lines are not broken
    return [re.sub(r"(?<=\de)-(?=\d)", "−", line.replace("`", "")) for line in lines]
