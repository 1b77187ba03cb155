"""Jumps that are written as ``DiracDelta`` of time in the equations."""

from __future__ import annotations

import math
from collections.abc import Sequence

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.frontend.box import Time
from rankone.frontend.jumps import LATE, LEAST_APART, check_apart, value_at
from rankone.ir.functions import Table
from rankone.support.errors import ProblemError, warn
from rankone.support.wording import listing, quote

__all__ = ["Impulses", "without_impulses"]

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
