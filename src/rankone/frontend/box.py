"""The coordinates of a problem: the time interval, the box of the parameters, and units."""

from __future__ import annotations

import itertools
import math
import numbers
from collections.abc import Iterable, Mapping
from typing import Any

import sympy as sp

from rankone.discretization.coordinates import name_of
from rankone.expressions.numbers import check_size
from rankone.ir.domain import LEAST_WIDTH
from rankone.statistics.distributions import as_text, from_text, interval_of
from rankone.statistics.joint_distribution import copula_of
from rankone.support.errors import EvaluationError, OptionError, ProblemError
from rankone.support.naming import is_line
from rankone.support.units import per
from rankone.support.wording import did_you_mean, listing, quote, shown

__all__ = [
    "Box",
    "Time",
    "check_correlation",
    "check_parameters",
    "check_time",
    "check_units",
    "real_number",
]


Time = tuple[sp.Symbol, float, float]
Box = dict[sp.Symbol, tuple[float, float]]
_OTHER_UNITS = "choose larger units"


def check_time(time: Any) -> Time:
    """Return (symbol, start, end) of ``time=(t, t0, t1)``."""
    remedy = "give the symbol, the start and the end, for example time=(t, 0, 6)"
    if not isinstance(time, tuple | list | sp.Tuple) or len(time) != 3:
        raise ProblemError(f"time is {quote(time)}", term=time, remedy=remedy)
    symbol, start, end = time
    if not isinstance(symbol, sp.Symbol):
        raise ProblemError(f"time {quote(symbol)} is not a SymPy symbol", term=time, remedy=remedy)
    t0, t1 = (
        real_number(start, "the start of time", remedy),
        real_number(end, "the end of time", remedy),
    )
    if t1 > t0 and t1 - t0 < LEAST_WIDTH:
        raise ProblemError(
            f"the time horizon from {t0:g} to {t1:g} is too short", term=time, remedy=_OTHER_UNITS
        )
    if not t1 > t0:
        kind = "zero" if t1 == t0 else "negative"
        raise ProblemError(
            f"the time horizon from {t0:g} to {t1:g} is {kind}",
            term=time,
            remedy="let time end after it starts",
        )
    return symbol, t0, t1


def check_parameters(parameters: Any, time: sp.Symbol, tail: Any) -> tuple[Box, dict[str, str]]:
    """Return the box of ``parameters={symbol: (lower, upper)}`` as floats, and distributions.

    Distributions are texts by the names of their parameters; their intervals are the supports, or
    where these have no end those between the quantiles ``tail`` and ``1 - tail``.
    """
    number = isinstance(tail, numbers.Real) and not isinstance(tail, bool)
    if not number or not 0.0 < float(tail) < 0.5:
        raise ProblemError(
            f"tail is {shown(tail)}, not a probability between 0 and 0.5",
            term=tail,
            remedy="give what may be left out of unbounded distributions, for example 1e-6",
        )
    if not isinstance(parameters, Mapping):
        raise ProblemError(
            f"parameters are {quote(parameters)}, not a mapping",
            term=parameters,
            remedy="give {symbol: (lower, upper), ...}, or {} if there are none",
        )
    box: Box = {}
    distributions: dict[str, str] = {}
    for symbol, bounds in parameters.items():
        if not isinstance(symbol, sp.Symbol):
            raise ProblemError(
                f"parameter {symbol!r} is not a SymPy symbol",
                term=symbol,
                remedy="use the symbols that appear in the equations as keys",
            )
        if symbol.name == time.name:
            raise ProblemError(
                f"{quote(symbol)} is both the time and a parameter",
                term=symbol,
                remedy="rename one of them",
            )
        if hasattr(bounds, "ppf") or isinstance(bounds, str):
            distributions[symbol.name], bounds = _distributed(symbol, bounds, float(tail))
        box[symbol] = _interval(symbol, bounds)
    return box, distributions


def check_correlation(given: Any, box: Box) -> dict[tuple[str, str], float]:
    """Return correlations by the names of pairs, each pair in the order of the box."""
    names = [symbol.name for symbol in box]
    try:
        copula = copula_of(names, given)
    except (OptionError, EvaluationError) as error:
        raise ProblemError(str(error), term=given) from None
    if copula is None:
        return {}
    places = itertools.combinations(range(len(copula.positions)), 2)
    return {
        (names[copula.positions[a]], names[copula.positions[b]]): copula.matrix[a][b]
        for a, b in places
        if copula.matrix[a][b]
    }


def _distributed(symbol: sp.Symbol, given: Any, tail: float) -> tuple[str, tuple[float, float]]:
    """A distribution as text, and its interval."""
    try:
        text = as_text(from_text(given) if isinstance(given, str) else given)
        return text, interval_of(from_text(text), tail)
    except OptionError as error:
        raise ProblemError(
            f"the distribution of parameter {quote(symbol)}: {error}", term=symbol
        ) from None


def _interval(symbol: sp.Symbol, bounds: Any) -> tuple[float, float]:
    remedy = f"give numbers (lower, upper), for example {{{symbol}: (0.5, 1.5)}}"
    try:
        lower, upper = bounds
    except (TypeError, ValueError):
        raise ProblemError(
            f"the box of parameter {quote(symbol)} is {quote(bounds)}, not a pair of numbers",
            term=symbol,
            remedy=remedy,
        ) from None
    low = real_number(lower, f"the lower bound of parameter {quote(symbol)}", remedy)
    high = real_number(upper, f"the upper bound of parameter {quote(symbol)}", remedy)
    shown = f"the box ({low:g}, {high:g}) of parameter {quote(symbol)}"
    if low == high:
        raise ProblemError(
            f"{shown} is empty",
            term=symbol,
            remedy="widen it, or write the number itself in the equations",
        )
    if low < high and high - low < LEAST_WIDTH:
        raise ProblemError(f"{shown} is too narrow", term=symbol, remedy=_OTHER_UNITS)
    if low > high:
        raise ProblemError(f"{shown} is reversed", term=symbol, remedy=f"write ({high:g}, {low:g})")
    if not symbol.is_commutative or symbol.is_extended_real is False:
        raise ProblemError(
            f"parameter {quote(symbol)} is declared not to be real",
            term=symbol,
            remedy=f"declare it as sympy.Symbol({symbol.name!r})",
        )
    contradicted = {
        "integer": symbol.is_integer,
        "positive": symbol.is_positive and low < 0,
        "nonnegative": symbol.is_nonnegative and low < 0,
        "negative": symbol.is_negative and high > 0,
        "nonpositive": symbol.is_nonpositive and high > 0,
    }
    for assumption, holds in contradicted.items():
        if holds:
            raise ProblemError(
                f"{shown} contradicts the assumption that {symbol} is {assumption}",
                term=symbol,
                remedy="change the box or the assumption",
            )
    return low, high


def real_number(value: Any, what: str, remedy: str) -> float:
    """Return a finite float, or say what the value is a wrong value of."""
    try:
        if isinstance(value, str | bool):
            raise TypeError
        if isinstance(value, sp.Basic):
            check_size(value)
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise ProblemError(
            f"{what} is {shown(value)}, not a real number", term=value, remedy=remedy
        ) from None
    if not math.isfinite(number):
        raise ProblemError(f"{what} is {number}, not finite", term=value, remedy=remedy)
    return number


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
