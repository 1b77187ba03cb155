"""Parameters whose effects add up, such as the amount of a dose.

Let the rates be linear in the states, with coefficients that do not depend on time, and let all
else be proportional to one parameter: initial values, what jumps add, and rates without states.
Then states are proportional to that parameter, and the curve of several doses is the sum of the
curves of each one, counted from its own time.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence

import sympy as sp
from sympy.functions.elementary.piecewise import ExprCondPair

from rankone.compiler.passes.first_order import FirstOrderSystem
from rankone.problem.forms import EventForm

_NONLINEAR = 2  # The degree of all that is neither constant nor affine


def additive_parameters(system: FirstOrderSystem) -> tuple[str, ...]:
    """Names of the parameters whose effects add up, whenever each of them begins.

    Rates are walked once, and once more for each parameter left that they hold.
    """
    clock, *parameters = system.coordinates
    times = _times_of_events(system.events)
    if times is None or system.rest is not None or system.constraints.expressions:
        return ()
    rates, states = system.examined_rates, system.functions
    if len(rates) < len(states):
        return ()
    amounts = {c.symbol for c in parameters}.difference(*(each.free_symbols for each in times))
    given = [*system.initial, *_added(system)]
    amounts = _in_all(given, amounts)
    if not amounts or any(_degree(rate, states, clock.symbol) > 1 for rate in rates):
        return ()
    at_zero = dict.fromkeys(states, sp.S.Zero)
    rests = [rate.xreplace(at_zero) for rate in rates]
    amounts = _in_all(rests, amounts)
    proportional = [
        p
        for p in amounts
        if all(_degree(each, (*states, p)) <= 1 for each in (*given, *rates) if each.has_free(p))
        and not any(each.subs(p, 0) for each in (*given, *rests) if each)
    ]
    return tuple(c.name for c in parameters if c.symbol in proportional)


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


def _added(system: FirstOrderSystem) -> Iterator[sp.Expr]:
    """What each jump, and each event that resets states, adds to them."""
    after = [jump.values for jump in system.jumps]
    after += [event.then for event in system.events if event.then is not None]
    for values in after:
        yield from (value - state for value, state in zip(values, system.functions, strict=True))


def _in_all(expressions: Sequence[sp.Expr], symbols: set[sp.Symbol]) -> set[sp.Symbol]:
    """The symbols that occur in every expression other than zero."""
    return symbols.intersection(*(each.free_symbols for each in expressions if each))


def _degree(
    expression: sp.Basic, variables: Collection[sp.Expr], clock: sp.Symbol | None = None
) -> int:
    """0, 1 or ``_NONLINEAR``, as it is constant, affine or neither in the variables.

    With a ``clock`` the coefficients of what is affine do not depend on it.
    """
    variables = frozenset(variables)

    def walk(node: sp.Basic) -> tuple[int, bool]:
        """The degree, and whether the clock occurs outside the variables."""
        if node in variables:
            return 1, False
        if not node.args:
            return 0, node == clock
        degrees, timed = zip(*map(walk, node.args), strict=True)
        coefficients: Iterable[bool] = ()
        if isinstance(node, sp.Add):
            degree = max(degrees)
        elif isinstance(node, sp.Mul):
            degree = sum(degrees)
            coefficients = (late for late, each in zip(timed, degrees, strict=True) if not each)
        elif isinstance(node, sp.Piecewise):
            degree = max(degrees)
            coefficients = (walk(condition)[1] for _, condition in node.args)
        elif isinstance(node, ExprCondPair):
            degree = degrees[0] + _NONLINEAR * degrees[1]
        else:
            degree = _NONLINEAR * max(degrees)
        if degree and any(coefficients):
            degree = _NONLINEAR
        return min(degree, _NONLINEAR), any(timed)

    return walk(expression)[0]
