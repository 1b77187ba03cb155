"""Units of a problem: a text for some of its coordinates and states."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import sympy as sp

from rankone.discretization.coordinates import name_of
from rankone.support.errors import EvaluationError, ProblemError
from rankone.support.naming import is_line
from rankone.support.units import per
from rankone.support.wording import did_you_mean, listing, quote, shown

__all__ = ["check_units"]


def check_units(
    given: Any, time: sp.Symbol, parameters: Iterable[sp.Symbol], states: Iterable[sp.Expr]
) -> dict[str, str]:
    """Units by name: of time, parameters and states, in this order.

    A derivative that is a state, of which no unit is given, has that of its unknown over that of
    time, if both are given.

    Raises
    ------
    ProblemError
        If units are no mapping, one is no text, or there is nothing of that name.
    """
    if not isinstance(given, Mapping | None):
        raise ProblemError(
            f"units are {shown(given)}, not a mapping from symbols or names to texts",
            term=given,
            remedy='write units={x: "m", t: "s"}',
        )
    states = list(states)
    known = [time.name, *(symbol.name for symbol in parameters), *map(name_of, states)]
    found: dict[str, str] = {}
    for key, unit in (given or {}).items():
        name = _known_name(key, time, known)
        if name in found:
            raise ProblemError(
                f"the unit of {quote(name)} is given twice", term=key, remedy="give it once"
            )
        found[name] = _checked(name, unit)
    for state in states:
        unknown = name_of(state.args[0]) if isinstance(state, sp.Derivative) else None
        if unknown in found and time.name in found:
            composed = per(found[unknown], found[time.name], state.derivative_count)
            found.setdefault(name_of(state), composed)
    return {name: found[name] for name in known if name in found}


def _known_name(key: Any, time: sp.Symbol, known: list[str]) -> str:
    """The name of a symbol, a function or a text that has to be known."""
    try:
        name = name_of(key, time.name)
    except EvaluationError as error:
        raise ProblemError(f"units: {error}", term=key) from None
    if name not in known:
        raise ProblemError(
            f"units has {quote(name)}, which is neither time nor a parameter nor an unknown"
            f"{did_you_mean(name, known)}",
            term=key,
            remedy=f"known are {listing(known)}",
        )
    return name


def _checked(name: str, unit: Any) -> str:
    """One unit: a text in one line."""
    if not is_line(unit) or not unit.strip():
        raise ProblemError(
            f"the unit of {quote(name)} is {shown(unit)}, not a text in one line",
            term=unit,
            remedy='write it like "m/s", or "1" for a plain number',
        )
    return str(unit.strip())
