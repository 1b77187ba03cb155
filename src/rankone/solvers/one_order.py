"""A part of a box in which events come in one order, for the message of a refused solve."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rankone.ir.measures import Interval
from rankone.ir.verdict import NarrowBox
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, budget_left, persisting
from rankone.support.wording import quote
from rankone.trajectories.events.event_order import REMEDY, OrderError
from rankone.trajectories.events.orders import OrderSearch
from rankone.verification.points import check_points

_STEP = 0.02  # Of a face, outwards, over the width of the whole box
_INSIDE = 0.1  # Distance of the faces that are told from points of other orders, over the part
_CHECKED = 48  # Trajectories inside of a part that have to be of one order as well
_ROUNDS = 4  # Parts that are tried: each leaves out what the check of the one before met
_UNITS = 20.0  # Units of the last digit in an interval that is told, at least
_ROUNDING = 1e-6  # Of such a unit
_SHARE = 0.1  # Of what is left of the budget, for the search for a part
_LEAST = 0.05  # Width of a part, over that of the box, below which it is of no use


def one_order(search: OrderSearch) -> tuple[Interval, ...] | None:
    """The intervals of a part in which all trajectories meet the same events in the same order.

    None where there is none of some size. Further trajectories inside of it are followed.
    """
    for _ in range(_ROUNDS):
        part = _largest_part(search)
        if part is None:
            return None
        points = check_points(part, _CHECKED, every_corner=True)
        try:
            inside = search.at(points)
        except OrderError:
            return None
        if len(inside.groups()) == 1:
            return tuple((float(lower), float(upper)) for lower, upper in part)
        search = search.joined_with(inside)
    return None


def remedy_of(search: OrderSearch) -> tuple[str, tuple[Interval, ...] | None]:
    """What to do about orders that cannot be continued: a part of the box, if there is one."""
    try:
        with persisting(_SHARE * budget_left()):
            part = one_order(search)
    except OutOfBudgetError:
        part = None
    if part is None:
        return REMEDY, None
    narrowed = narrowing_text(search.system.parameters, search.bounds, part)
    return f"narrow {narrowed}: events come in one order there", part


def box_of_one_order(names: Sequence[str], bounds: Array, part: Sequence[Interval]) -> NarrowBox:
    """Which parameters to narrow, and to what, for one order of events."""
    return NarrowBox(
        tuple(
            (name, *inside(ends))
            for name, whole, ends in zip(names, bounds.tolist(), part, strict=True)
            if list(ends) != whole
        ),
        one_order=True,
    )


def narrowing_text(names: Sequence[str], bounds: Array, part: Sequence[Interval]) -> str:
    """Which parameters to narrow, and to what."""
    narrowed = [
        "{} to [{:.12g}, {:.12g}]".format(quote(name), *inside(ends))
        for name, whole, ends in zip(names, bounds.tolist(), part, strict=True)
        if list(ends) != whole
    ]
    return " and ".join(narrowed)


def inside(ends: Interval) -> Interval:
    """An interval inside another one, with ends of few digits."""
    lower, upper = ends
    unit = 10.0 ** math.floor(math.log10((upper - lower) / _UNITS))
    low = math.ceil(lower / unit - _ROUNDING) * unit
    high = math.floor(upper / unit + _ROUNDING) * unit
    return float(f"{low:.12g}"), float(f"{high:.12g}")


def _largest_part(search: OrderSearch) -> Array | None:
    """The largest part (d, 2) that is found around a point, without points of other orders."""
    lower, width = search.bounds[:, 0], np.ptp(search.bounds, axis=1)
    unit = (search.points - lower) / width
    best, largest = None, 0.0
    for places in search.groups().values():
        others = np.delete(unit, places, axis=0)
        part = _grown(_inmost(unit[places], others), others)
        volume = float(np.ptp(part, axis=1).prod())
        if volume > largest:
            best, largest = part, volume
    if best is None:
        return None
    at_faces = np.stack([best[:, 0] <= 0.0, best[:, 1] >= 1.0], axis=1)
    inner = best + _INSIDE * np.ptp(best, axis=1)[:, None] * np.array([1.0, -1.0])
    part = np.where(at_faces, [0.0, 1.0], inner)
    if np.ptp(part, axis=1).min() < _LEAST:
        return None
    return np.asarray(np.where(at_faces, search.bounds, lower[:, None] + width[:, None] * part))


def _inmost(points: Array, others: Array) -> Array:
    """Of points (m, d) the one that is farthest from all others, which may be none."""
    if not len(others):
        return np.asarray(points[0])
    distances = np.abs(points[:, None] - others).max(axis=2).min(axis=1)
    return np.asarray(points[int(np.argmax(distances))])


def _grown(start: Array, others: Array) -> Array:
    """The part (d, 2) of the unit cube around a point, each face as far out as no other point is.

    All faces go outwards in turns.
    """
    part = np.stack([start, start], axis=1)
    open_faces = [(j, side) for j in range(len(start)) for side in (0, 1)]
    while open_faces:
        for j, side in [*open_faces]:
            grown = part.copy()
            grown[j, side] = np.clip(part[j, side] + (2 * side - 1) * _STEP, 0.0, 1.0)
            if grown[j, side] == part[j, side] or _holds(grown, others):
                open_faces.remove((j, side))
            else:
                part = grown
    return part


def _holds(part: Array, points: Array) -> bool:
    """Whether a part has some of the points (m, d)."""
    inside: NDArray[np.bool_] = (points >= part[:, 0]) & (points <= part[:, 1])
    return bool(inside.all(axis=1).any())
