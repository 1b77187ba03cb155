"""What is asked of a solve, checked, and the error it may end with."""

from __future__ import annotations

import math
import numbers
from typing import TYPE_CHECKING, Any

from rankone.errors import BlowUpError, OptionError
from rankone.solvers.outcome import Outcome, Status

if TYPE_CHECKING:
    from rankone.solution import Solution

__all__ = ["checked_number", "checked_points", "checked_rtol", "raise_blow_up"]

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


def raise_blow_up(solution: Solution, outcome: Outcome) -> None:
    """Raise a BlowUpError that carries the solution if a trajectory blew up."""
    if outcome.status is Status.BLOW_UP and outcome.blow_up is not None:
        when, values = outcome.blow_up
        where = dict(zip(solution.parameters, values, strict=True))
        at = ", ".join(f"{name} = {value:.6g}" for name, value in where.items())
        raise BlowUpError(
            f"the solution blows up inside the horizon: near t = {when:.4g}"
            + (f" at {at}" if at else ""),
            time=when,
            parameters=where,
            solution=solution,
            remedy=f"end the horizon before t = {when:.4g}, or narrow the box; the error carries "
            f"the part up to t = {solution.time[1]:.4g} as .solution",
        )
