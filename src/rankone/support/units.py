"""Units as texts: they are shown and carried along, nothing is converted."""

from __future__ import annotations

import re
from collections.abc import Mapping

__all__ = ["of_derivatives", "per", "with_unit"]

_ONE_WORD = re.compile(r"[^\s/*^·⋅()+-]+")


def per(unit: str, by: str, times: int = 1) -> str:
    """The unit of a derivative, as text: a unit over another, to a power.

    >>> per("m", "s"), per("m", "s", 2), per("m/s", "1/s"), per("kg", "1")
    ('m/s', 'm/s^2', '(m/s)/(1/s)', 'kg')
    """
    if by == "1":
        return unit
    power = "" if times == 1 else f"^{times}"
    return f"{_bracketed(unit)}/{_bracketed(by)}{power}"


def of_derivatives(
    units: tuple[tuple[str, str], ...], states: tuple[str, ...], coordinate: str
) -> tuple[tuple[str, str], ...]:
    """Units after a derivative of all states with respect to a coordinate.

    A state whose unit, or that of the coordinate, is not known has none.
    """
    known: Mapping[str, str] = dict(units)
    by = known.get(coordinate)
    return tuple(
        (name, unit if name not in states or by is None else per(unit, by))
        for name, unit in units
        if name not in states or by is not None
    )


def with_unit(text: str, units: Mapping[str, str], name: str) -> str:
    """A text with the unit of a name behind it, if there is one."""
    return f"{text} {units[name]}" if name in units else text


def _bracketed(unit: str) -> str:
    return unit if _ONE_WORD.fullmatch(unit) else f"({unit})"
