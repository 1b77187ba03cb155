"""What is asked of a solve, checked, and what it delivers: a solution or an error."""

from __future__ import annotations

import math
import operator
from typing import TYPE_CHECKING, Literal

from rankone.errors import BlowUpError, ConvergenceError, OptionError
from rankone.solvers.outcome import Outcome, Status

if TYPE_CHECKING:
    from rankone.solution import Solution

__all__ = ["checked_points", "checked_rtol", "delivered"]

_TIGHTEST, _LOOSEST = 1e-10, 0.1
_CHECK_POINTS = 24


def checked_rtol(rtol: float) -> float:
    """The relative tolerance as a float between 1e-10 and 0.1, or an OptionError."""
    try:
        value = float(rtol)
    except (TypeError, ValueError):
        value = math.nan
    if isinstance(rtol, bool) or not _TIGHTEST <= value <= _LOOSEST:
        raise OptionError(
            f"rtol={rtol!r} is out of range",
            remedy=f"choose a number between {_TIGHTEST:g} and {_LOOSEST:g}",
        )
    return value


def checked_points(check: bool | int) -> int:
    """The number of random check points: 24 for True, 0 for False, or an OptionError."""
    if isinstance(check, bool):
        return _CHECK_POINTS if check else 0
    try:
        points = operator.index(check)
    except TypeError:
        points = -1
    if points < 0:
        raise OptionError(
            f"check={check!r} is no number of points", remedy="True, False or an integer >= 0"
        )
    return points


def delivered(
    solution: Solution, outcome: Outcome, on_failure: Literal["return", "raise"]
) -> Solution:
    """Return the solution or raise what its status asks for."""
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
    if on_failure == "raise" and not solution.success:
        raise ConvergenceError(outcome.message, solution=solution)
    return solution
