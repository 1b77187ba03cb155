"""The coordinates of a problem: the time interval, the box of the parameters, and its pieces."""

from __future__ import annotations

import itertools
import math
import numbers
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, SupportsFloat

import numpy as np
import sympy as sp

from rankone.problem.expressions.notation import check_size
from rankone.problem.forms import Coordinate
from rankone.solvers.outcome import per
from rankone.support.arrays import LEAST
from rankone.support.errors import (
    EvaluationError,
    OptionError,
    ProblemError,
    did_you_mean,
    is_line,
    listing,
    quote,
    shown,
)
from rankone.support.options import checked_number
from rankone.tensors.coordinates import (
    SCALES,
    check_scale,
    evenly_on_scale,
    measure_text,
    name_of,
    split,
)
from rankone.tensors.distributions import as_text, from_text, interval_of
from rankone.tensors.joint_distribution import copula_of

Time = tuple[sp.Symbol, float, float]
"""The symbol of time, the start and the end."""
Box = dict[sp.Symbol, tuple[float, float]]
_OTHER_UNITS = "choose larger units"


def check_time(time: object) -> Time:
    """Return (symbol, start, end) of ``time=(t, t0, t1)``."""
    remedy = "give the symbol, the start and the end, for example time=(t, 0, 6)"
    if not isinstance(time, tuple | list | sp.Tuple) or len(time) != 3:
        raise ProblemError(f"time is {quote(time)}", term=time, remedy=remedy)
    symbol, start, end = time
    if not isinstance(symbol, sp.Symbol):
        raise ProblemError(f"time {quote(symbol)} is not a SymPy symbol", term=time, remedy=remedy)
    t0 = real_number(start, "the start of time", remedy)
    t1 = real_number(end, "the end of time", remedy)
    horizon = f"the time horizon from {t0:g} to {t1:g}"
    if t1 <= t0:
        fault = "zero" if t1 == t0 else "negative"
        remedy = "let time end after it starts"
        raise ProblemError(f"{horizon} is {fault}", term=time, remedy=remedy)
    if t1 - t0 < LEAST:
        raise ProblemError(f"{horizon} is too short", term=time, remedy=_OTHER_UNITS)
    return symbol, t0, t1


def check_parameters(
    parameters: object, time: sp.Symbol, tail: object
) -> tuple[Box, dict[str, str]]:
    """Return the box of ``parameters={symbol: (lower, upper)}`` as floats, and distributions.

    Distributions are texts by the names of their parameters; an interval with a scale, as
    ``(lower, upper, "log")``, is one too. The interval of a distribution is its support; where that
    is unbounded, it reaches from the quantile ``tail`` to ``1 - tail``.
    """
    probability = _probability(tail)
    if not isinstance(parameters, Mapping):
        raise ProblemError(
            f"parameters are {quote(parameters)}, not a mapping",
            term=parameters,
            remedy="give {symbol: (lower, upper), ...}, or {} if there are none",
        )
    box: Box = {}
    distributions: dict[str, str] = {}
    for symbol, bounds in parameters.items():
        _check_symbol(symbol, time)
        box[symbol], distribution = _interval_and_distribution(symbol, bounds, probability)
        if distribution is not None:
            distributions[symbol.name] = distribution
    return box, distributions


def _probability(tail: object) -> float:
    if isinstance(tail, bool) or not isinstance(tail, numbers.Real) or not 0.0 < float(tail) < 0.5:
        raise ProblemError(
            f"tail is {shown(tail)}, not a probability between 0 and 0.5",
            term=tail,
            remedy="give the probability to cut off unbounded distributions, for example 1e-6",
        )
    return float(tail)


def _check_symbol(symbol: object, time: sp.Symbol) -> None:
    """Raise if a parameter is not a symbol, or is the time."""
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


def _interval_and_distribution(
    symbol: sp.Symbol, bounds: object, tail: float
) -> tuple[tuple[float, float], str | None]:
    """The interval of a parameter, and its distribution as a text; None if that is uniform."""
    bounds, scale = split(bounds)
    distribution = None
    if hasattr(bounds, "ppf") or isinstance(bounds, str):
        try:
            distribution = as_text(from_text(bounds) if isinstance(bounds, str) else bounds)
            bounds = interval_of(from_text(distribution), tail)
        except OptionError as error:
            message = f"the distribution of parameter {quote(symbol)}: {error.message}"
            raise ProblemError(message, term=symbol, remedy=error.remedy) from None
    interval = _interval(symbol, bounds)
    if scale is not None:
        try:
            measure = measure_text(check_scale(symbol.name, interval, scale), interval)
        except OptionError as error:
            raise ProblemError(error.message, term=symbol, remedy=error.remedy) from None
        distribution = distribution if measure is None else measure
    return interval, distribution


def check_correlation(
    correlation: Mapping[Any, float] | None, box: Box
) -> dict[tuple[str, str], float]:
    """Return correlations by the names of pairs, each pair in the order of the box."""
    names = [symbol.name for symbol in box]
    try:
        copula = copula_of(names, correlation)
    except (OptionError, EvaluationError) as error:
        raise ProblemError(error.message, term=correlation, remedy=error.remedy) from None
    if copula is None:
        return {}
    return {
        (names[copula.positions[a]], names[copula.positions[b]]): copula.matrix[a][b]
        for a, b in itertools.combinations(range(len(copula.positions)), 2)
        if copula.matrix[a][b]
    }


def _interval(symbol: sp.Symbol, bounds: object) -> tuple[float, float]:
    """The interval of a parameter; it has to agree with the assumptions of the symbol."""
    remedy = f"give numbers (lower, upper), for example {{{symbol}: (0.5, 1.5)}}"
    try:
        if not isinstance(bounds, Iterable):
            raise TypeError
        lower, upper = bounds
    except (TypeError, ValueError):
        raise ProblemError(
            f"the box of parameter {quote(symbol)} is {quote(bounds)}, not a pair of numbers",
            term=symbol,
            remedy=remedy,
        ) from None
    low = real_number(lower, f"the lower bound of parameter {quote(symbol)}", remedy)
    high = real_number(upper, f"the upper bound of parameter {quote(symbol)}", remedy)
    interval = f"the box ({low:g}, {high:g}) of parameter {quote(symbol)}"
    if low == high:
        remedy = "widen it, or write the number itself in the equations"
        raise ProblemError(f"{interval} is empty", term=symbol, remedy=remedy)
    if low < high and high - low < LEAST:
        raise ProblemError(f"{interval} is too narrow", term=symbol, remedy=_OTHER_UNITS)
    if low > high:
        remedy = f"write ({high:g}, {low:g})"
        raise ProblemError(f"{interval} is reversed", term=symbol, remedy=remedy)
    check_assumptions(symbol, low, high, interval)
    return low, high


def check_assumptions(symbol: sp.Symbol, low: float, high: float, subject: str) -> None:
    """Raise if what a symbol is declared to be contradicts an interval, or a single number.

    Messages name the interval as the ``subject``: ``"the box (1, 2) of parameter `k`"``.
    """
    if not symbol.is_commutative or symbol.is_extended_real is False:
        raise ProblemError(
            f"{quote(symbol)} is declared not to be real: {subject}",
            term=symbol,
            remedy=f"declare it as sympy.Symbol({symbol.name!r})",
        )
    contradicted = {
        "integer": symbol.is_integer and not low == high == round(low),
        "positive": symbol.is_positive and low < 0,
        "nonnegative": symbol.is_nonnegative and low < 0,
        "negative": symbol.is_negative and high > 0,
        "nonpositive": symbol.is_nonpositive and high > 0,
        "nonzero": symbol.is_nonzero and low == high == 0,
    }
    for assumption, holds in contradicted.items():
        if holds:
            raise ProblemError(
                f"{subject} contradicts the assumption that {symbol} is {assumption}",
                term=symbol,
                remedy="change the number or the assumption"
                if low == high
                else "change the box or the assumption",
            )


def real_number(value: object, subject: str, remedy: str) -> float:
    """Return a value as a finite float; a ProblemError says what else it is."""
    try:
        if isinstance(value, str | bool) or not isinstance(value, SupportsFloat):
            raise TypeError
        if isinstance(value, sp.Basic):
            check_size(value)
        real = float(value)
    except (TypeError, ValueError, OverflowError):
        raise ProblemError(
            f"{subject} is {shown(value)}, not a real number", term=value, remedy=remedy
        ) from None
    if not math.isfinite(real):
        raise ProblemError(f"{subject} is {real}, not finite", term=value, remedy=remedy)
    return real


def check_tolerances(atol: object, states: Iterable[sp.Expr], time: sp.Symbol) -> dict[str, float]:
    """Absolute tolerances by the names of states; zero asks for the state's own size."""
    remedy = "give {unknown: error}, for example {x: 1e-6}"
    if not isinstance(atol, Mapping | None):
        raise ProblemError(f"atol is {shown(atol)}, not a mapping", term=atol, remedy=remedy)
    names = [name_of(state) for state in states]
    tolerances: dict[str, float] = {}
    for key, written in (atol or {}).items():
        try:
            name = name_of(key, time.name)
        except EvaluationError as error:
            raise ProblemError(f"atol: {error.message}", term=key, remedy=error.remedy) from None
        if name not in names:
            raise ProblemError(
                f"atol has {quote(name)}, which is no unknown{did_you_mean(name, names)}",
                term=key,
                remedy=f"choose from {listing(names)}",
            )
        size = real_number(written, f"the absolute tolerance of {quote(name)}", remedy)
        if size < 0.0 or name in tolerances:
            fault = "given twice" if name in tolerances else f"{size:g}, which is negative"
            message = f"the absolute tolerance of {quote(name)} is {fault}"
            raise ProblemError(message, term=key, remedy=remedy)
        tolerances[name] = size
    return tolerances


def _name_among(names: Sequence[str], key: object, time: sp.Symbol) -> str:
    """The name of a quantity with a unit; a ProblemError if it is not among ``names``."""
    try:
        name = name_of(key, time.name)
    except EvaluationError as error:
        message = f"units: {error.message}"
        raise ProblemError(message, term=key, remedy=error.remedy) from None
    if name not in names:
        raise ProblemError(
            f"units has {quote(name)}, which is neither time nor a parameter nor an unknown"
            f"{did_you_mean(name, names)}",
            term=key,
            remedy=f"known are {listing(names)}",
        )
    return name


def check_units(
    units: object, time: sp.Symbol, named: Iterable[sp.Expr], states: Iterable[sp.Expr]
) -> dict[str, str]:
    """Units by name: of time, parameters and what else is ``named``, and states, in this order.

    A derivative that is a state and has no unit gets the unit of its unknown over that of time, if
    both have one.
    """
    if not isinstance(units, Mapping | None):
        raise ProblemError(
            f"units are {shown(units)}, not a mapping from symbols or names to texts",
            term=units,
            remedy='write units={x: "m", t: "s"}',
        )
    states = list(states)
    names = [time.name, *map(name_of, named), *map(name_of, states)]
    unit_of: dict[str, str] = {}
    for key, unit in (units or {}).items():
        name = _name_among(names, key, time)
        if name in unit_of:
            raise ProblemError(
                f"the unit of {quote(name)} is given twice", term=key, remedy="give it once"
            )
        if not is_line(unit) or not unit.strip():
            raise ProblemError(
                f"the unit of {quote(name)} is {shown(unit)}, not a text in one line",
                term=unit,
                remedy='write it like "m/s", or "1" for a plain number',
            )
        unit_of[name] = str(unit.strip())
    for state in states:
        unknown = name_of(state.args[0]) if isinstance(state, sp.Derivative) else None
        if unknown in unit_of and time.name in unit_of:
            rate_unit = per(unit_of[unknown], unit_of[time.name], state.derivative_count)
            unit_of.setdefault(name_of(state), rate_unit)
    return {name: unit_of[name] for name in names if name in unit_of}


# -----------------------------------------------------------------------------
# A box cut into pieces along some of its parameters.


BoxPiece = dict[str, tuple[float, float]]
"""An interval for each parameter, by name."""
# Most pieces along one parameter; more are a mistake
_MOST_CUTS = 100_000


def pieces_of(
    coordinates: Sequence[Coordinate], counts: Sequence[tuple[Any, Any]]
) -> list[BoxPiece]:
    """The pieces of a box, cut into the counts given for some parameters, by names or symbols.

    They are even on the scale of each parameter; a count may also be a list of the values at which
    to cut. The last parameter changes fastest.
    """
    names = [coordinate.name for coordinate in coordinates]
    asked: dict[str, Any] = {}
    for key, cuts in counts:
        name = name_of(key)
        if name not in names:
            raise OptionError(
                f"there is no parameter {quote(name)}{did_you_mean(name, names)}",
                term=key,
                remedy=f"choose from {listing(names)}" if names else None,
            )
        if name in asked:
            raise OptionError(f"{quote(name)} is given twice", term=key, remedy="give it once")
        asked[name] = cuts
    edges = [_edges(coordinate, asked.get(coordinate.name, 1)) for coordinate in coordinates]
    boxes = itertools.product(*(itertools.pairwise(line) for line in edges))
    return [dict(zip(names, box, strict=True)) for box in boxes]


def _edges(coordinate: Coordinate, cuts: object) -> list[float]:
    """The ends of the intervals of one parameter, ascending."""
    name, ends = coordinate.name, (float(coordinate.lower), float(coordinate.upper))
    if not isinstance(cuts, Sequence | np.ndarray) or isinstance(cuts, str):
        count = checked_number(f"the number of pieces of {quote(name)}", cuts, 1, _MOST_CUTS)
        even = evenly_on_scale(SCALES[coordinate.scale], ends, count + 1)
        return [float(edge) for edge in even]
    try:
        inner = [float(cut) for cut in cuts]
    except (TypeError, ValueError):
        inner = [np.nan]
    edges = [ends[0], *(cut for cut in inner if cut not in ends), ends[1]]
    if not all(a < b for a, b in itertools.pairwise(edges)):
        raise OptionError(
            f"the cuts of {quote(name)} are {shown(cuts)}, not ascending values inside "
            f"({ends[0]:g}, {ends[1]:g})",
            term=cuts,
            remedy=f"give a number of pieces, or values such as [{0.5 * sum(ends):g}]",
        )
    return edges


def counts_of(counts: Mapping[Any, Any] | None, named: Mapping[str, Any]) -> list[tuple[Any, Any]]:
    """Counts that were given as a mapping and by keyword."""
    if counts is not None and not isinstance(counts, Mapping):
        raise OptionError(
            f"{shown(counts)} is not a mapping from parameters to numbers of pieces",
            term=counts,
            remedy="give {k: 4}, or k=4",
        )
    return [*(counts or {}).items(), *named.items()]
