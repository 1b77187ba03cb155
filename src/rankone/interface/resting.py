"""Checks of starts at steady states: of totals when compiled, of branches when solved."""

from __future__ import annotations

import numpy as np

from rankone.frontend.problem import Problem
from rankone.ir.request import SolveRequest
from rankone.ir.system import System
from rankone.support.budget import limited
from rankone.support.errors import ProblemError
from rankone.support.wording import listing
from rankone.trajectories.steady.resting_start import RestingStart
from rankone.verification.points import branch_points


def check_totals(problem: Problem, system: System) -> None:
    """Raise a ProblemError for a conserved sum of states that `start` leaves out: it is zero."""
    start = system.at_rest
    if not isinstance(start, RestingStart):
        return
    symbols = problem.start_states
    centre = np.array([[0.5 * (lower + upper)] for lower, upper in system.box])
    for row in start.steady.conserved(centre.reshape(len(system.box), 1))[:, :, 0]:
        inside = [state for state, c in zip(problem.initial, row, strict=True) if c != 0.0]
        if not symbols.intersection(inside):
            raise ProblemError(
                f"no rate changes a sum of {listing(inside)}, and all of these start at zero",
                term=inside[0],
                remedy="give their values before the start: SteadyState(..., start="
                f"{{{inside[0]}: 1}})",
            )


def check_rest(system: System, request: SolveRequest) -> None:
    """Raise a ConvergenceError unless steady states at the start are on one branch in the box."""
    if isinstance(system.at_rest, RestingStart):
        points = branch_points(request.domain)
        with limited(request.limits.operations, request.limits.seconds):
            system.at_rest.check(points)
