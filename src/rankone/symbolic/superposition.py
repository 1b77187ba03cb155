"""Parameters whose effects add up, such as the amount of a dose.

Let the rates be linear in the states, with coefficients that do not depend on time, and let all
else be proportional to one parameter: initial values, what jumps add, and rates without states.
Then states are proportional to that parameter, and the curve of several doses is the sum of the
curves of each one, counted from its own time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.ir.forms import EventForm
from rankone.symbolic.first_order import FirstOrderSystem


def additive_parameters(system: FirstOrderSystem) -> tuple[str, ...]:
    """Names of the parameters whose effects add up, whenever each of them begins."""
    clock, *parameters = system.coordinates
    times = _times_of_events(system.events)
    if times is None or system.rest is not None or system.constraints.expressions:
        return ()
    amounts = [c.symbol for c in parameters if _proportional(system.initial, c.symbol)]
    for added in _added(system):
        amounts = [p for p in amounts if _proportional(added, p)]
    amounts = [p for p in amounts if _free_of(times, p)]
    if len(system.examined_rates) < len(system.states):
        return ()
    states = set(system.functions)

    @cache
    def split(rate: sp.Expr) -> tuple[list[sp.Expr], sp.Expr]:
        """Slopes of a rate in its states, and what it is without them."""
        present = states & rate.atoms(AppliedUndef)
        slopes = [rate.diff(state) for state in present]
        return slopes, rate.xreplace(dict.fromkeys(present, sp.S.Zero))

    def adds_up(p: sp.Symbol) -> bool:
        """Rates with the parameter come first: they decide soon, of many states too."""
        rates = sorted(system.examined_rates, key=lambda rate: p not in rate.free_symbols)
        splits = (split(rate) for rate in rates)
        return all(_free_of(slopes, p) and _proportional([rest], p) for slopes, rest in splits)

    amounts = [p for p in amounts if adds_up(p)]
    if amounts and not all(_free_of(split(r)[0], clock.symbol) for r in system.examined_rates):
        return ()
    return tuple(p.name for p in amounts)


def _times_of_events(events: Sequence[EventForm]) -> list[sp.Expr] | None:
    """The times of all events that reset states; None if the states have a say in one."""
    times = []
    for event in events:
        if event.terminal or event.delay is not None or event.priority is not None:
            return None
        if event.then is None:
            continue
        if event.at is None:
            return None
        times.append(event.at)
    return times


def _added(system: FirstOrderSystem) -> Iterator[list[sp.Expr]]:
    """What each jump, and each event that resets states, adds to them."""
    after = [jump.values for jump in system.jumps]
    after += [event.then for event in system.events if event.then is not None]
    for values in after:
        yield [value - state for value, state in zip(values, system.functions, strict=True)]


def _proportional(expressions: Sequence[sp.Expr], p: sp.Symbol) -> bool:
    """Whether expressions are zero, or p times something without p and without states."""
    slopes = [each.diff(p) for each in expressions]
    return _free_of(slopes, p) and all(each.subs(p, 0) == 0 for each in expressions)


def _free_of(expressions: Sequence[sp.Expr], p: sp.Symbol) -> bool:
    return not any(p in each.free_symbols for each in expressions)
