"""The error a solve may end with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rankone.errors import BlowUpError
from rankone.solvers.outcome import Outcome, Status

if TYPE_CHECKING:
    from rankone.solution import Solution

__all__ = ["raise_blow_up"]


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
