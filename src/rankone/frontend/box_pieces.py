"""A box cut into pieces along some of its parameters."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.discretization.scales import SCALES
from rankone.ir.forms import Coordinate
from rankone.ir.measures import evenly_on_scale
from rankone.support.errors import OptionError
from rankone.support.options import checked_number
from rankone.support.wording import did_you_mean, listing, quote, shown

BoxPiece = dict[str, tuple[float, float]]
"""An interval for each parameter, by name."""
# Most pieces along one parameter; more are a mistake
_MOST_CUTS = 100_000


def pieces_of(
    coordinates: Sequence[Coordinate], counts: Sequence[tuple[Any, Any]]
) -> list[BoxPiece]:
    """The pieces of a box, cut into the counts given for some parameters, by names or symbols.

    They are even on the scale of each parameter; a count may also be a list of the values at which
    to cut. The last parameter changes fastest.
    """
    names = [coordinate.name for coordinate in coordinates]
    asked: dict[str, Any] = {}
    for key, cuts in counts:
        name = name_of(key)
        if name not in names:
            raise OptionError(
                f"there is no parameter {quote(name)}{did_you_mean(name, names)}",
                term=key,
                remedy=f"choose from {listing(names)}" if names else None,
            )
        if name in asked:
            raise OptionError(f"{quote(name)} is given twice", term=key, remedy="give it once")
        asked[name] = cuts
    edges = [_edges(coordinate, asked.get(coordinate.name, 1)) for coordinate in coordinates]
    boxes = itertools.product(*(itertools.pairwise(line) for line in edges))
    return [dict(zip(names, box, strict=True)) for box in boxes]


def _edges(coordinate: Coordinate, cuts: Any) -> list[float]:
    """The ends of the intervals of one parameter, ascending."""
    name, ends = coordinate.name, (float(coordinate.lower), float(coordinate.upper))
    if not isinstance(cuts, Sequence | np.ndarray) or isinstance(cuts, str):
        count = checked_number(f"the number of pieces of {quote(name)}", cuts, 1, _MOST_CUTS)
        even = evenly_on_scale(SCALES[coordinate.scale], ends, count + 1)
        return [float(edge) for edge in even]
    try:
        inner = [float(cut) for cut in cuts]
    except (TypeError, ValueError):
        inner = [np.nan]
    edges = [ends[0], *(cut for cut in inner if cut not in ends), ends[1]]
    if not all(a < b for a, b in itertools.pairwise(edges)):
        raise OptionError(
            f"the cuts of {quote(name)} are {shown(cuts)}, not ascending values inside "
            f"({ends[0]:g}, {ends[1]:g})",
            term=cuts,
            remedy=f"give a number of pieces, or values such as [{0.5 * sum(ends):g}]",
        )
    return edges


def counts_of(counts: Mapping[Any, Any] | None, named: Mapping[str, Any]) -> list[tuple[Any, Any]]:
    """Counts that were given as a mapping and by keyword."""
    if counts is not None and not isinstance(counts, Mapping):
        raise OptionError(
            f"{shown(counts)} is not a mapping from parameters to numbers of pieces",
            term=counts,
            remedy="give {k: 4}, or k=4",
        )
    return [*(counts or {}).items(), *named.items()]
