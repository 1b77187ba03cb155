"""What is asked of a solve, checked, and the error it may end with."""

from __future__ import annotations

import numbers
from typing import TYPE_CHECKING

from rankone.errors import BlowUpError, OptionError
from rankone.solvers.outcome import Outcome, Status

if TYPE_CHECKING:
    from rankone.solution import Solution

__all__ = ["checked_points", "checked_rtol", "raise_blow_up"]

_TIGHTEST, _LOOSEST = 1e-10, 0.1
_CHECK_POINTS = 24


def checked_rtol(rtol: float) -> float:
    """The relative tolerance as a float between 1e-10 and 0.1, or an OptionError."""
    number = isinstance(rtol, numbers.Real) and not isinstance(rtol, bool)
    if not (number and _TIGHTEST <= rtol <= _LOOSEST):
        remedy = f"choose a number between {_TIGHTEST:g} and {_LOOSEST:g}"
        raise OptionError(f"rtol={rtol!r} is out of range", remedy=remedy)
    return float(rtol)


def checked_points(check: bool | int) -> int:
    """The number of random check points: 24 for True, 0 for False, or an OptionError."""
    if isinstance(check, bool):
        return _CHECK_POINTS if check else 0
    if not isinstance(check, numbers.Integral) or check < 0:
        remedy = "True, False or an integer >= 0"
        raise OptionError(f"check={check!r} is no number of points", remedy=remedy)
    return int(check)


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
