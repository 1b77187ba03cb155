"""Jumps at known times: doses, kicks and restarts, also those written as ``DiracDelta`` of time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.discretization.coordinates import name_of
from rankone.expressions.notation import latex_of, text_of
from rankone.expressions.numbers import exact
from rankone.frontend.box import Time, real_number
from rankone.frontend.equations import as_expression, explain_symbol
from rankone.ir.forms import Jump
from rankone.ir.functions import Table
from rankone.support.errors import ProblemError, warn
from rankone.support.wording import did_you_mean, listing, quote, shown

__all__ = [
    "LATE",
    "LEAST_APART",
    "Impulses",
    "Resets",
    "at_start",
    "check_apart",
    "check_jumps",
    "jump_latex",
    "jump_texts",
    "system_jumps",
    "value_at",
    "without_impulses",
]


Resets = dict[float, dict[sp.Expr, sp.Expr]]
"""For each time the states that jump, as the user writes them, and their values after it."""

_SEVERAL = (tuple, range, frozenset, sp.Tuple)
"""Keys that stand for several times."""
_REMEDY = "give {time: {unknown: value after it}}, for example {8.0: {x: x + dose}}"
_TOGETHER = "give all that is reset at a time in one mapping"
LATE = "remedy: remove it, unless `t_final` is to be later"
LEAST_APART = 1e-9
"""Least time between two jumps, in horizons."""


def check_jumps(
    given: Any,
    states: Iterable[sp.Expr],
    unknowns: Iterable[sp.Expr],
    parameters: Iterable[sp.Symbol],
    time: Time,
) -> Resets:
    """Return the jumps by time; a time may be a number or a tuple of numbers.

    Raises
    ------
    ProblemError
        If a time is no number or before the horizon, two are the same, or a value is no
        expression of unknowns and parameters.

    Warns
    -----
    RankoneWarning
        If a jump is not before the end of the horizon.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise ProblemError(f"jumps are {shown(given)}, not a mapping", term=given, remedy=_REMEDY)
    known = list(states), list(unknowns), list(parameters)
    found: Resets = {}
    for key, values in given.items():
        instants = tuple(key) if isinstance(key, _SEVERAL) else (key,)
        if not instants:
            raise ProblemError("a jump has no times", term=values, remedy=_REMEDY)
        for instant in instants:
            at = _instant(instant, time)
            if at in found:
                message = f"there are two jumps at {time[0]} = {at:g}"
                raise ProblemError(message, term=key, remedy=_TOGETHER)
            found[at] = _values(values, at, *known, time[0])
    check_apart(found, time)
    late = [at for at in sorted(found) if at >= time[2] - LEAST_APART * (time[2] - time[1])]
    if late:
        first = f"the jump at {time[0]} = {late[0]:.12g}"
        rest = f" and {len(late) - 1} more" if len(late) > 1 else ""
        near = f" by {LEAST_APART:g} of the horizon" if late[0] < time[2] else ""
        warn(f"{first}{rest}: not before the end of time, {time[2]:.12g}{near}; {LATE}")
    return {at: found[at] for at in sorted(found)}


def _instant(value: Any, time: Time) -> float:
    """The time of a jump as a float."""
    symbols: set[sp.Symbol] = getattr(value, "free_symbols", set())
    if symbols:
        raise ProblemError(
            f"the time of a jump, {quote(value)}, depends on {listing(sorted(map(str, symbols)))}",
            term=value,
            remedy="jumps are at known times; count time from it, or in units of it",
        )
    at = real_number(value, "the time of a jump", _REMEDY)
    if at < time[1]:
        raise ProblemError(
            f"the jump at {time[0]} = {at:g} is before the start of time, {time[1]:g}",
            term=value,
            remedy="give a time inside the horizon",
        )
    return at


def check_apart(times: Iterable[float], time: Time) -> None:
    """Raise if two jumps are at times that are hardly told apart."""
    for a, b in itertools.pairwise(sorted(times)):
        if b - a < LEAST_APART * (time[2] - time[1]):
            raise ProblemError(
                f"the jumps at {time[0]} = {a!r} and {b!r} are too close to each other",
                remedy="make one jump of them",
            )


def _values(
    given: Any,
    at: float,
    states: list[sp.Expr],
    unknowns: list[sp.Expr],
    parameters: list[sp.Symbol],
    time: sp.Symbol,
) -> dict[sp.Expr, sp.Expr]:
    """The values of the states that one jump resets."""
    if not isinstance(given, Mapping) or not given:
        raise ProblemError(
            f"the jump at {time} = {at:g} is {shown(given)}, not a mapping from unknowns",
            term=given,
            remedy=_REMEDY,
        )
    found: dict[sp.Expr, sp.Expr] = {}
    for state, value in given.items():
        if state not in states:
            name = text_of(state) if isinstance(state, sp.Basic) else str(state)
            names = {text_of(known): known for known in states}
            names |= {name_of(known): known for known in states}
            hint = did_you_mean(name, names)
            if name in names:
                hint = f" (did you mean {quote(names[name])}?)"
            raise ProblemError(
                f"the jump at {time} = {at:g} resets {shown(state)}, which is no state{hint}",
                term=state,
                remedy=f"use the states themselves as keys: {listing(states)}",
            )
        found[state] = _value(state, value, at, states, unknowns, parameters, time)
    return found


def _value(
    state: sp.Expr,
    value: Any,
    at: float,
    states: list[sp.Expr],
    unknowns: list[sp.Expr],
    parameters: list[sp.Symbol],
    time: sp.Symbol,
) -> sp.Expr:
    """The value of a state after a jump."""
    what = f"the value of {quote(state)} after the jump at {time} = {at:g}"
    remedy = "give an expression of the unknowns before it and of the parameters"
    if isinstance(value, str):
        remedy += ", without quotes; Problem.from_strings takes text"
    expression = as_expression(value, what, remedy)
    what = f"{what}, {quote(expression)},"
    places = {known: sp.Dummy() for known in states}
    rest = expression.xreplace(places)
    parts = expression.atoms(AppliedUndef, sp.Derivative) - set(states)
    for part in sorted(parts, key=sp.default_sort_key):
        hint = did_you_mean(str(part), map(str, states))
        message = f"{what} names {quote(part)}, which is no state{hint}"
        raise ProblemError(message, term=value, remedy=remedy)
    loose = rest.free_symbols - {*parameters, *places.values(), time}
    for symbol in sorted(loose, key=sp.default_sort_key):
        message, declare = explain_symbol(symbol, unknowns, parameters)
        raise ProblemError(f"{what} has a problem: {message}", term=value, remedy=declare)
    if expression.has(sp.I, sp.oo, -sp.oo, sp.zoo, sp.nan, sp.DiracDelta):
        raise ProblemError(f"{what} is not a finite real number", term=value, remedy=remedy)
    return value_at(exact(expression), time, at)


def value_at(expression: sp.Expr, time: sp.Symbol, at: float) -> sp.Expr:
    """The value at a time, but for the unknowns there, and their derivatives."""
    unknowns = expression.atoms(sp.Derivative) | expression.atoms(AppliedUndef)
    places = {u: sp.Dummy() for u in unknowns}
    back = {place: u for u, place in places.items()}
    value: sp.Expr = expression.xreplace(places).subs(time, exact(sp.Float(at))).xreplace(back)
    return value


def system_jumps(
    resets: Mapping[float, Mapping[sp.Expr, sp.Expr]],
    impulses: Mapping[float, Mapping[int, sp.Expr]],
    functions: Mapping[sp.Expr, sp.Expr],
    time: Time,
) -> tuple[Jump, ...]:
    """All jumps by time, in the states of the first-order system.

    Parameters
    ----------
    resets, impulses
        As given, and those of ``DiracDelta``.
    functions : mapping
        The states as the user writes them, and as functions of time.
    """
    for at in sorted(set(resets) & set(impulses)):
        raise ProblemError(
            f"there are both a jump and a DiracDelta at {time[0]} = {at:g}",
            remedy="put the impulse into the jump",
        )
    check_apart([*resets, *impulses], time)
    states = list(functions.values())
    found = []
    for at in sorted([*resets, *impulses]):
        if at in resets:
            values = {
                functions[state]: value.xreplace(dict(functions))
                for state, value in resets[at].items()
            }
        else:
            values = {states[i]: states[i] + value for i, value in impulses[at].items()}
        found.append(Jump(at, tuple(values.get(u, u) for u in states)))
    return tuple(jump for jump in found if jump.values != tuple(states))


def at_start(jump: Jump, time: Time) -> bool:
    """Whether a jump is at the start of time, or hardly after it."""
    return jump.time - time[1] < LEAST_APART * (time[2] - time[1])


def jump_latex(states: Sequence[sp.Expr], jumps: Iterable[Jump], time: sp.Symbol) -> Iterator[str]:
    """The same as :func:`jump_texts` as LaTeX, with ``&``."""
    for values, times in Jump.kinds(jumps).items():
        pairs = zip(states, values, strict=True)
        changes = (rf"{latex_of(u)} \to {latex_of(v)}" for u, v in pairs if u != v)
        at = ", ".join(f"{at:g}" for at in times)
        yield rf"{sp.latex(time)} = {at}:\; & " + r",\; ".join(changes)


def jump_texts(states: Sequence[sp.Expr], jumps: Iterable[Jump], time: str) -> Iterator[str]:
    """Lines such as ``at t = 8, 16: C -> C + D``, one for each kind of jump."""
    for values, times in Jump.kinds(jumps).items():
        pairs = zip(states, values, strict=True)
        changes = (f"{text_of(u)} -> {text_of(v)}" for u, v in pairs if u != v)
        yield f"at {time} = {', '.join(f'{at:g}' for at in times)}: {', '.join(changes)}"


_BESIDE = 1e-9
"""Where what is multiplied by an impulse is looked at on either side of it."""
_SWITCHING = (sp.Heaviside, sp.sign, sp.floor, sp.ceiling, sp.Piecewise, sp.Mod)

Impulses = dict[float, dict[int, sp.Expr]]
"""For each time what is added to states, by their number."""


def without_impulses(
    rates: Sequence[sp.Expr],
    functions: Sequence[sp.Expr],
    origins: Sequence[int | None],
    time: Time,
) -> tuple[tuple[sp.Expr, ...], Impulses]:
    """The rates without their ``DiracDelta`` of time, and what those add to the states.

    Raises
    ------
    ProblemError
        If one is at no known time, is not added to a rate, or is multiplied by what jumps at the
        same time.
    """
    found: Impulses = {}
    rest: list[sp.Expr] = []
    for number, (rate, origin) in enumerate(zip(rates, origins, strict=True)):
        impulses = sorted(rate.atoms(sp.DiracDelta), key=sp.default_sort_key)
        places = {impulse: sp.Dummy() for impulse in impulses}
        plain, parts = _split(rate.xreplace(places), set(places.values()))
        for impulse, place in places.items():
            at, size = _impulse(impulse, time[0], origin)
            factor = parts[place]
            if factor.has(*places.values()):
                raise ProblemError(
                    f"{quote(impulse)} does not enter as a product with what is finite",
                    equation=origin,
                    term=impulse,
                    remedy="an impulse adds to a rate: Eq(x.diff(t), f + dose*DiracDelta(t - 8))",
                )
            if not time[1] <= at:
                warn(
                    f"{quote(impulse)} is before the start of time, {time[1]:g}, and does nothing; "
                    "remedy: remove it"
                )
                continue
            if at >= time[2] - LEAST_APART * (time[2] - time[1]):
                warn(f"{quote(impulse)} is not before the end of time, {time[2]:g}; {LATE}")
            _check_steady(factor, impulse, at, time[0], origin)
            added = found.setdefault(at, {})
            value = size * value_at(factor, time[0], at)
            added[number] = added.get(number, sp.S.Zero) + value
        rest.append(plain)
    for at, added in found.items():
        for number, value in added.items():
            for other in added:
                if value.has(functions[other]):
                    raise ProblemError(
                        f"the impulse at {time[0]} = {at:g} is multiplied by "
                        f"`{functions[other]}`, which jumps there itself",
                        equation=origins[number],
                        term=value,
                        remedy="give the values after it as jumps={time: {unknown: value}}",
                    )
    check_apart(found, time)
    return tuple(rest), found


def _split(rate: sp.Expr, impulses: set[sp.Dummy]) -> tuple[sp.Expr, dict[sp.Dummy, sp.Expr]]:
    """A rate without impulses, and what each of them is multiplied by."""
    parts: dict[sp.Dummy, sp.Expr] = dict.fromkeys(impulses, sp.S.Zero)
    rest = []
    for term in sp.Add.make_args(rate):
        own = sorted(term.free_symbols & impulses, key=sp.default_sort_key)
        rest.append(term.xreplace(dict.fromkeys(own, sp.S.Zero)) if own else term)
        for place in own:
            parts[place] += term.diff(place)
    return sp.Add(*rest), parts


def _impulse(impulse: sp.DiracDelta, time: sp.Symbol, origin: int | None) -> tuple[float, sp.Expr]:
    """When an impulse is, and its size."""
    argument = impulse.args[0]

    def wrong(message: str) -> ProblemError:
        return ProblemError(
            f"{quote(impulse)} {message}",
            equation=origin,
            term=impulse,
            remedy=f"write DiracDelta({time} - 8) with a number: jumps are at known times; "
            "count time from it, or in units of it",
        )

    if len(impulse.args) > 1 and impulse.args[1] != 0:
        raise wrong("is a derivative of an impulse")
    others = argument.free_symbols - {time}
    if others or argument.atoms(AppliedUndef):
        named = sorted(map(str, [*others, *argument.atoms(AppliedUndef)]))
        raise wrong(f"is at a time that depends on {listing(named)}")
    slope = argument.diff(time)
    if slope.has(time) or slope == 0:
        raise wrong("is not at one time")
    at = float(-argument.subs(time, 0) / slope)
    if not math.isfinite(at):
        raise wrong("is at no finite time")
    return at, 1 / sp.Abs(slope)


def _check_steady(
    factor: sp.Expr, impulse: sp.Expr, at: float, time: sp.Symbol, origin: int | None
) -> None:
    """Raise if what an impulse is multiplied by switches at the same time."""
    near = _BESIDE * max(abs(at), 1.0)
    tables = (part for part in factor.atoms(Table) if part.kind == "previous")
    for part in (*factor.atoms(*_SWITCHING), *tables):
        before, after = (value_at(part, time, at + side * near) for side in (-1, 1))
        if (after - before).is_number and abs(after - before) < math.sqrt(_BESIDE):
            continue
        raise ProblemError(
            f"{quote(impulse)} is multiplied by {quote(part)}, which may switch at the same time",
            equation=origin,
            term=part,
            remedy="give the values after it as jumps={time: {unknown: value}}",
        )
