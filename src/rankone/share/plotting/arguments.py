"""Arguments of plots: the solution, the unknowns and the times that they select, checked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.wording import listing, quote, shown

if TYPE_CHECKING:
    from rankone.solution.solution import Solution

CURVE_TIMES = 401
"""Times of a curve, about a pixel each."""


def check_solution(function: str, given: object) -> None:
    """Raise an OptionError unless what a function was given is a solution."""
    if not isinstance(given, SolutionCore):
        raise OptionError(
            f"{function} needs a Solution, not {type(given).__name__}",
            term=given,
            remedy="give what rankone.solve(problem) returns",
        )


def states_of(solution: Solution, given: object) -> list[str]:
    """Names of one or several unknowns or derivatives that are states; all unknowns for None."""
    if given is None:
        return list(solution.unknowns)
    several = given if isinstance(given, list | tuple) else [given]
    names = [solution[one].name for one in several]
    if not names or len(set(names)) < len(names):
        problem = "one of them occurs twice" if names else "none is given"
        raise OptionError(
            f"the unknowns are {shown(given)}: {problem}",
            term=given,
            remedy=f"choose from {listing(solution.states)}",
        )
    return names


def unknowns_of(solution: Solution, given: object) -> list[str]:
    """The names of unknowns; statistics know no other states."""
    names = states_of(solution, given)
    for name in names:
        if name not in solution.unknowns:
            raise EvaluationError(
                f"{quote(name)} is a state, not an unknown; there are statistics of "
                f"{listing(solution.unknowns)}",
                term=name,
                remedy="solution.diff gives derivatives as a solution with statistics of its own",
            )
    return names


def unknown_of(solution: Solution, given: object) -> str:
    """The name of one unknown; the first for None."""
    return unknowns_of(solution, _one(given))[0]


def state_of(solution: Solution, given: object, function: str) -> str:
    """The name of one unknown, or derivative that is a state; the only unknown for None."""
    if _one(given) is not None:
        return states_of(solution, given)[0]
    if len(solution.unknowns) > 1:
        raise EvaluationError(
            f"there are {len(solution.unknowns)} unknowns: {', '.join(solution.unknowns)}",
            remedy=f"choose one: {function}(solution, unknown)",
        )
    return solution.unknowns[0]


def _one(given: object) -> object:
    """The given unknown, or an OptionError if there are several."""
    if isinstance(given, list | tuple):
        raise OptionError(
            f"unknown={shown(given)} names several", term=given, remedy="plot one after another"
        )
    return given


def times_of(solution: Solution, t: ArrayLike | None, count: int) -> Array:
    """The given times, (times,), or ``count`` times over the horizon."""
    if t is None:
        return fine_times(solution, solution.time[1], count)
    times = np.atleast_1d(solution._coordinates.checked(0, t))
    if times.ndim > 1 or not times.size:
        problem = "more than one dimension" if times.ndim > 1 else "no entry"
        raise OptionError(f"the times have {problem}", term=t, remedy="give a list of times")
    return times


def fine_times(solution: Solution, end: float, count: int) -> Array:
    """Even times up to an end, and both sides of each meeting of slabs: states may jump there."""
    if solution.outcome.timeline is not None:  # jumps are at times of their own at each point
        return np.linspace(solution.time[0], end, count)
    evenly = np.linspace(solution.time[0], end, count)
    meetings = np.array([slab.start for slab in solution.outcome.slabs[1:]])
    meetings = meetings[(meetings > evenly[0]) & (meetings < end)]
    return np.unique(np.concatenate([evenly, np.nextafter(meetings, evenly[0]), meetings]))


def needs_time(solution: Solution, subject: str) -> None:
    """Raise an EvaluationError if the values do not depend on time."""
    if solution.metadata.timeless:
        raise EvaluationError(
            f"the values do not depend on time: there are no {subject} over it",
            remedy="plot_surface, plot_sobol and plot_main_effects plot them over the parameters",
        )


def sometimes_of(solution: Solution, t: ArrayLike | None, count: int) -> Array | None:
    """The same as :func:`times_of`; None if nothing depends on time."""
    if not solution.metadata.timeless:
        return times_of(solution, t, count)
    solution._times(t)  # raises if a time is given
    return None


def one_time(solution: Solution, t: ArrayLike | None) -> float | None:
    """The one given time; None if nothing depends on time."""
    start, end = solution.time
    remedy = f"give a number in [{start:g}, {end:g}]"
    times = sometimes_of(solution, t, 1)
    if times is None:
        return None
    if t is None:
        raise OptionError("this plot needs a time", remedy=remedy)
    if times.size > 1:
        raise OptionError(f"t={shown(t)} are several times", term=t, remedy=remedy)
    return float(times[0])
