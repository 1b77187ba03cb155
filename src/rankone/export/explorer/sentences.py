"""What a page says of a solution: what it holds for, and how good it is."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from rankone.export.packing import PackedModel
from rankone.support.wording import listing

__all__ = ["lead", "place", "quality", "spread"]

_MOST_NAMED = 3
"""Parameters up to which each range is in the first sentence."""


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
