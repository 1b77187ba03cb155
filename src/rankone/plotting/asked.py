"""What a plot was asked for: unknowns, times, and the labels of both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.wording import listing, quote, shown

if TYPE_CHECKING:
    from rankone.interface.solution import Solution

__all__ = [
    "check_solution",
    "fine_times",
    "label_of",
    "labels_of",
    "needs_time",
    "one_time",
    "only_unknown",
    "range_of",
    "sometimes_of",
    "states_of",
    "times_of",
    "unknown_of",
    "unknowns_of",
    "value_of",
]

_MOST_IN_LABEL = 4
"""Unknowns that are named beside an axis."""


def check_solution(function: str, given: Any) -> None:
    """Raise an OptionError unless what a function was given is a solution."""
    if not isinstance(given, SolutionCore):
        raise OptionError(
            f"{function} needs a Solution, not {type(given).__name__}",
            term=given,
            remedy="give what rankone.solve(problem) returns",
        )


def label_of(solution: Solution, name: str) -> str:
    """Name of an unknown or a coordinate, with its unit: ``x [m]``."""
    return _with_unit(name, _units(solution).get(name))


def value_of(solution: Solution, name: str, value: float) -> str:
    """A value of a coordinate with its unit: ``t = 2 s``."""
    return f"{name} = {value:.4g} {_units(solution).get(name, '')}".rstrip()


def range_of(solution: Solution, name: str) -> str:
    """The interval of a parameter with its unit: ``m: 1 to 2 kg``."""
    lower, upper = solution.parameters[name]
    return f"{name}: {lower:.4g} to {upper:.4g} {_units(solution).get(name, '')}".rstrip()


def labels_of(solution: Solution, names: Sequence[str]) -> str:
    """Names of several unknowns; the unit once where all have the same: ``x, y [m]``."""
    units = _units(solution)
    many = len(names) > _MOST_IN_LABEL
    if len({units.get(name) for name in names}) == 1:
        return _with_unit("unknowns" if many else ", ".join(names), units.get(names[0]))
    if many:
        return "unknowns"
    return ", ".join(label_of(solution, name) for name in names)


def _units(solution: Solution) -> dict[str, str]:
    return dict(solution.metadata.units)


def _with_unit(name: str, unit: str | None) -> str:
    return f"{name} [{unit}]" if unit else name


# --- unknowns ----------------------------------------------------------------------------------


def states_of(solution: Solution, asked: Any) -> list[str]:
    """Names of one or several unknowns or derivatives that are states; all unknowns for None.

    Raises
    ------
    EvaluationError
        If there is no such state.
    OptionError
        If nothing is asked for, or one of them twice.
    """
    if asked is None:
        return list(solution.unknowns)
    several = asked if isinstance(asked, list | tuple) else [asked]
    names = [solution[one].name for one in several]
    if not names or len(set(names)) < len(names):
        problem = "one of them is there twice" if names else "there are none"
        raise OptionError(
            f"the unknowns are {shown(asked)}: {problem}",
            term=asked,
            remedy=f"choose from {listing(solution.states)}",
        )
    return names


def unknowns_of(solution: Solution, asked: Any) -> list[str]:
    """The same for statistics, which are those of unknowns alone."""
    names = states_of(solution, asked)
    for name in names:
        if name not in solution.unknowns:
            raise EvaluationError(
                f"{quote(name)} is a state, not an unknown; there are statistics of "
                f"{listing(solution.unknowns)}",
                term=name,
                remedy="solution.diff gives derivatives as a solution with statistics of its own",
            )
    return names


def unknown_of(solution: Solution, asked: Any) -> str:
    """The one unknown asked for; the first for None."""
    if isinstance(asked, list | tuple):
        raise OptionError(
            f"unknown={shown(asked)} are several", term=asked, remedy="one unknown for each plot"
        )
    return unknowns_of(solution, asked)[0] if asked is not None else solution.unknowns[0]


def only_unknown(solution: Solution, function: str) -> str:
    """The one unknown that there is; an EvaluationError if there are several."""
    if len(solution.unknowns) > 1:
        raise EvaluationError(
            f"there are {len(solution.unknowns)} unknowns: {', '.join(solution.unknowns)}",
            remedy=f"choose one: {function}(solution, unknown)",
        )
    return solution.unknowns[0]


# --- times -------------------------------------------------------------------------------------


def times_of(solution: Solution, t: Any, count: int) -> Array:
    """Times that were given, (times,), or so many over the horizon.

    Raises
    ------
    EvaluationError
        If a time is outside of the horizon.
    OptionError
        If there are no times, or in more than one dimension.
    """
    if t is None:
        return fine_times(solution, solution.time[1], count)
    times = np.atleast_1d(solution._coordinates.checked(0, t))
    if times.ndim > 1 or not times.size:
        what = "more than one dimension" if times.ndim > 1 else "no entry"
        raise OptionError(f"the times have {what}", term=t, remedy="give a list of times")
    return times


def fine_times(solution: Solution, end: float, count: int) -> Array:
    """So many times up to an end, and both sides of where slabs meet: states may jump there."""
    evenly = np.linspace(solution.time[0], end, count)
    meetings = np.array([slab.start for slab in solution.outcome.slabs[1:]])
    meetings = meetings[(meetings > evenly[0]) & (meetings < end)]
    return np.unique(np.concatenate([evenly, np.nextafter(meetings, evenly[0]), meetings]))


def needs_time(solution: Solution, what: str) -> None:
    """Raise an EvaluationError if the values do not depend on time."""
    if solution.metadata.timeless:
        raise EvaluationError(
            f"the values do not depend on time: there are no {what} over it",
            remedy="plot_surface, plot_sobol and plot_main_effects plot them over the parameters",
        )


def sometimes_of(solution: Solution, t: Any, count: int) -> Array | None:
    """The same as :func:`times_of`; None if nothing depends on time."""
    if not solution.metadata.timeless:
        return times_of(solution, t, count)
    if t is not None:
        raise EvaluationError(
            f"t={shown(t)} is given, but the values do not depend on time",
            term=t,
            remedy="leave t out",
        )
    return None


def one_time(solution: Solution, t: Any) -> float | None:
    """The one time that was given; None if nothing depends on time.

    Raises
    ------
    OptionError
        If there is none, or there are several.
    """
    start, end = solution.time
    remedy = f"give a number in [{start:g}, {end:g}]"
    times = sometimes_of(solution, t, 1)
    if times is None:
        return None
    if t is None:
        raise OptionError("a plot for one time needs it", remedy=remedy)
    if times.size > 1:
        raise OptionError(f"t={shown(t)} are several times", term=t, remedy=remedy)
    return float(times[0])
