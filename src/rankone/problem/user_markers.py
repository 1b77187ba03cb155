"""Markers that users give: expressions that end stretches of time where they cross zero."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from rankone.problem.problem import Problem
from rankone.problem.text import formula
from rankone.problem.user_events import Event
from rankone.support.errors import OptionError, ProblemError, warn
from rankone.support.wording import listing, quote
from rankone.tensors.bases.coordinates import name_of
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline

_REMEDY = "give a list of expressions that cross zero, such as [x - 3], or 'auto', or None"


def with_markers(problem: Problem, markers: object) -> Problem:
    """The problem with events ``marker_0``, ``marker_1``, ... that change nothing.

    Parameters
    ----------
    problem : Problem
    markers : sequence of Expr or str
        What crosses zero there, in unknowns, derivatives that are states, time and parameters.

    Raises
    ------
    OptionError
        If they are not a sequence of expressions of the problem, or there are none.
    """
    if isinstance(markers, str | sp.Basic) or not isinstance(markers, Sequence) or not markers:
        raise OptionError(f"markers={markers!r} is no list of expressions", remedy=_REMEDY)
    names = {name_of(u): u for u in problem.initial if not isinstance(u, sp.Derivative)}
    names |= {c.name: c.symbol for c in problem.coordinates}
    try:
        events = [
            Event(formula(marker, names, "marker", None), name=f"marker_{k}")
            if isinstance(marker, str)
            else Event(marker, name=f"marker_{k}")
            for k, marker in enumerate(markers)
        ]
        return type(problem)(**{**problem.written, "events": [*problem.events, *events]})
    except ProblemError as error:
        message = f"markers={quote(markers)}: {error.message}"
        raise OptionError(message, term=error.term, remedy=error.remedy or _REMEDY) from None


def warn_of_missed_markers(
    markers: Sequence[object], timeline: Timeline | BranchedTimeline | None
) -> None:
    """Warn of markers that no trajectory crosses, so that no stretch ends with them."""
    if timeline is None:
        return
    met = {name for instant in timeline.met for name in instant}
    missed = [str(marker) for k, marker in enumerate(markers) if f"marker_{k}" not in met]
    if missed:
        warn(
            f"no trajectory crosses zero in {listing(missed)}: time is that of the clock there",
            remedy="mark what every trajectory crosses, or leave markers out",
        )
