"""What is asked of a solve, checked."""

from __future__ import annotations

import math
import numbers
from typing import Any

from rankone.errors import OptionError

__all__ = ["checked_number", "checked_points", "checked_rtol"]

_TIGHTEST, _LOOSEST = 1e-10, 0.1
_CHECK_POINTS = 24


def checked_number(
    name: str, value: Any, least: float, most: float = math.inf, kind: type = int
) -> Any:
    """The value as an int or float (``kind``) between two others, or an OptionError."""
    number = numbers.Integral if kind is int else numbers.Real
    valid = isinstance(value, number) and not isinstance(value, bool)
    if not (valid and least <= value <= most):
        what = "an integer" if kind is int else "a number"
        where = f"of at least {least:g}" if most == math.inf else f"from {least:g} to {most:g}"
        raise OptionError(f"{name}={value!r} is not valid", remedy=f"choose {what} {where}")
    return kind(value)


def checked_rtol(rtol: float) -> float:
    """The relative tolerance as a float between 1e-10 and 0.1, or an OptionError."""
    return float(checked_number("rtol", rtol, _TIGHTEST, _LOOSEST, float))


def checked_points(check: bool | int) -> int:
    """The number of random check points: 24 for True, 0 for False, or an OptionError."""
    if isinstance(check, bool):
        return _CHECK_POINTS if check else 0
    return int(checked_number("check", check, 0))
