"""Constants that are run-time values, and starts at the steady state of other conditions.

A problem keeps the arguments that it was made of; each function here returns those of another one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.equations import (
    Symbols,
    algebraic_unknowns,
    as_expression,
    highest_orders,
    listed_equations,
    state_of,
)
from rankone.problem.expressions.notation import exact, named_constants, text_of, written_in
from rankone.problem.integration import Integration
from rankone.problem.jumps import instants_of
from rankone.problem.numeric import NumericEquations
from rankone.problem.shorthand import Shorthand
from rankone.problem.user_events import Event
from rankone.support.arrays import LEAST_SQUARED, Array
from rankone.support.errors import (
    ConvergenceError,
    EvaluationError,
    ProblemError,
    did_you_mean,
    listing,
    quote,
    shown,
)
from rankone.support.options import checked_number
from rankone.tensors.coordinates import name_of

Arguments = Mapping[str, Any]
"""The arguments of a problem by name."""
Changes = Iterable[tuple[Any, Any]]
"""Pairs of a constant or parameter, or its name, and what it becomes."""


def changes_of(mapping: object, named: Mapping[str, Any]) -> Changes:
    """Changes that were given as a mapping and by keyword."""
    if mapping is not None and not isinstance(mapping, Mapping):
        raise ProblemError(
            f"{shown(mapping)} is not a mapping",
            term=mapping,
            remedy="give {symbol: ...}, or names as keywords, for example m=2.5",
        )
    return [*(mapping or {}).items(), *named.items()]


def with_constants(written: Arguments, numbers: Changes, states: Iterable[str]) -> Arguments:
    """The arguments with these numbers of constants and parameters; ``states`` are for messages."""
    parameters, constants = dict(written["parameters"]), dict(written["constants"] or {})
    correlated = {*map(name_of, itertools.chain(*(written["correlation"] or {})))}
    for symbol, value in changed_symbols(written, numbers, states):
        if symbol in parameters and symbol.name in correlated:
            raise ProblemError(
                f"{quote(symbol)} is correlated with another parameter: fixed, it changes the "
                "distribution of that one",
                term=symbol,
                remedy="build a problem without the correlation",
            )
        parameters.pop(symbol, None)
        constants[symbol] = value
    return {**written, "parameters": parameters, "constants": constants}


def with_parameters(written: Arguments, intervals: Changes, states: Iterable[str]) -> Arguments:
    """The arguments with these intervals of constants and parameters."""
    parameters, constants = dict(written["parameters"]), dict(written["constants"] or {})
    for symbol, interval in changed_symbols(written, intervals, states):
        constants.pop(symbol, None)
        parameters[symbol] = interval
    return {**written, "parameters": parameters, "constants": constants}


def changed_symbols(
    written: Arguments, changes: Changes, states: Iterable[str]
) -> Iterator[tuple[sp.Symbol, Any]]:
    """The changes by symbol; an error if the problem lacks a name, or one comes twice."""
    symbols = (*written["parameters"], *(written["constants"] or {}))
    declared = {symbol.name: symbol for symbol in symbols}
    elsewhere = dict.fromkeys(_defined(written), ("definition", "change what it is made of"))
    elsewhere |= dict.fromkeys(states, ("state", "give another value in `initial`"))
    changed: set[str] = set()
    for key, change in changes:
        try:
            name = name_of(key)
        except EvaluationError as error:
            raise ProblemError(error.message, term=key, remedy=error.remedy) from None
        if name in elsewhere:
            noun, remedy = elsewhere[name]
            message = f"{quote(name)} is a {noun}, neither a constant nor a parameter"
            raise ProblemError(message, term=key, remedy=remedy)
        if name not in declared:
            raise ProblemError(
                f"there is no constant or parameter {quote(name)}{did_you_mean(name, declared)}",
                term=key,
                remedy=f"choose from {listing(declared)}" if declared else None,
            )
        if name in changed:
            raise ProblemError(f"{quote(name)} is given twice", term=key, remedy="give it once")
        changed.add(name)
        yield declared[name], change


def _defined(written: Arguments) -> Iterator[str]:
    return map(name_of, written["definitions"] or {})


# -----------------------------------------------------------------------------
# Which constants of a problem are run-time values, and which are written in.


def with_decisive(
    shorthand: Shorthand, written: Mapping[str, Any], coupled: Set[str] = frozenset()
) -> Shorthand:
    """The shorthand with its decisive constants, on which the generated code depends.

    A constant that is zero is one: terms vanish. So are those whose squares are no floating-point
    numbers, those in expressions that are not finite, so that the error names them, and those with
    the names ``coupled``.
    """
    constants = frozenset(shorthand.constants)
    numbers = shorthand.constants.items()
    decisive = {symbol for symbol, at in numbers if _is_extreme(at) or symbol.name in coupled}
    for expression in _smooth(written):
        for term in _terms(shorthand.expanded(expression)):
            involved = term.free_symbols & constants
            if involved - decisive:
                decisive |= written_in(term, constants)
                if term.xreplace(dict(numbers)).has(sp.zoo, sp.nan, sp.oo, -sp.oo):
                    decisive |= involved
    for expression in _deciding(written):
        expression = shorthand.expanded(expression)
        if not _of_states(expression):
            decisive |= expression.free_symbols & constants
    return replace(shorthand, decisive=frozenset(decisive))


def _is_extreme(number: sp.Expr) -> bool:
    """Whether a number is zero, or so small or large that products may be lost."""
    return not LEAST_SQUARED <= abs(float(number)) <= 1.0 / LEAST_SQUARED


def coupled_by(residuals: Sequence[sp.Expr]) -> set[str]:
    """The named constants in a mass matrix that is inverted: its inverse would be long.

    With algebraic equations those are all, since they decide what is solved for what.
    """
    highest = highest_orders(residuals)
    everywhere = {constant.name for constant in named_constants(residuals)}
    if algebraic_unknowns(residuals):
        return everywhere
    names: set[str] = set()
    for residual in residuals:
        orders = {d for d in residual.atoms(sp.Derivative) if d.derivative_count == highest[d.expr]}
        if not orders:
            return everywhere
        if len(orders) > 1:
            terms = (term for term in sp.Add.make_args(residual) if term.has(*orders))
            names |= {constant.name for constant in named_constants(terms)}
    return names


def _terms(expression: sp.Basic) -> Iterator[sp.Basic]:
    """The addends of an expression, or of both sides of an equation."""
    for side in expression.args if isinstance(expression, sp.Eq) else (expression,):
        yield from sp.Add.make_args(side)


def _of_states(expression: sp.Basic) -> bool:
    return bool(expression.atoms(AppliedUndef))


def _smooth(written: Mapping[str, Any]) -> Iterator[sp.Basic]:
    """Equations, initial values, and values after jumps and events."""
    resets = [*_values(written["jumps"]), *(event.then for event in _events(written))]
    listed = [
        *_values(written["initial"]),
        *(value for reset in resets for value in _values(reset)),
    ]
    listed += written["equations"]
    listed += [event.when for event in _events(written)]
    yield from (e for e in listed if isinstance(e, sp.Basic))


def _deciding(written: Mapping[str, Any]) -> Iterator[sp.Basic]:
    """Times of jumps and events, delays and priorities."""
    jumps = written["jumps"]
    listed = [at for key in jumps for at in instants_of(key)] if isinstance(jumps, Mapping) else []
    for event in _events(written):
        listed += [event.when, event.delay, event.priority]
    yield from (e for e in listed if isinstance(e, sp.Basic))


def _events(written: Mapping[str, Any]) -> list[Event]:
    events = written["events"]
    return [e for e in events if isinstance(e, Event)] if isinstance(events, Sequence) else []


def _values(mapping: object) -> list[Any]:
    return [*mapping.values()] if isinstance(mapping, Mapping) else []


# -----------------------------------------------------------------------------
# Starts at the steady state of other conditions: a system that has come to rest is disturbed.


USUAL_HORIZONS = 100.0
"""Horizons of the problem that trajectories may take to settle."""
_LONGER = 10.0  # How much longer trajectories are followed, to the last digit
_RTOL = 1e-11  # Of the trajectories that come to rest
_SAME = 1e-8  # Relative change of states from one of these times to the next that is rest


@dataclass(frozen=True)
class SteadyState(Mapping[Any, Any]):
    """A start at the steady state of other conditions, in place of initial values.

    Before the start of time the problem has other conditions, for so long that it is at rest: cells
    without a drug, a machine without a load. ``Problem(..., initial=SteadyState(...))``.

    Parameters
    ----------
    conditions : mapping of Symbol to Expr or number
        Constants and parameters that are different before the start, ``{dose: 0}``: numbers, or
        expressions of parameters and constants, ``{k: 2 * k}``. Empty for those of the problem.
    start : mapping of Expr to Expr or number
        Where trajectories under these conditions start, as in ``initial``; what is left out is
        zero. It decides on one of several steady states, and on totals that no rate changes.
    settle : float, optional
        The longest time that such a trajectory may take to come to rest, by default a hundred
        horizons of the problem.

    Notes
    -----
    As a mapping it is ``start``. The jumps and events of the problem do not happen before its
    start. A jump at the start, ``jumps={0: {L: L + dose}}``, changes what is at rest.

    Raises
    ------
    ProblemError
        If one of these is not as described.

    Examples
    --------
    >>> import rankone as ro
    >>> t, k, dose = sp.symbols("t k dose")
    >>> x = sp.Function("x")(t)
    >>> rest = SteadyState(conditions={dose: 0})
    >>> equation = sp.Eq(x.diff(t), 2 + dose - k * x)
    >>> ro.Problem([equation], (t, 0, 5), {k: (1, 2)}, rest, constants={dose: 3})
    Problem: 1 unknown, 1 parameter
      dx/dt = dose - k*x + 2
      at the start: the steady state with dose = 0, from x = 0
      t in [0, 5], k in [1, 2]
      dose = 3
    """

    conditions: Mapping[Any, Any] = field(default_factory=dict)
    _: KW_ONLY
    start: Mapping[Any, Any] = field(default_factory=dict)
    settle: float | None = None

    def __post_init__(self) -> None:
        for name in ("conditions", "start"):
            mapping = getattr(self, name)
            if not isinstance(mapping, Mapping):
                example = "{dose: 0}" if name == "conditions" else "{x: 1}"
                raise ProblemError(
                    f"{name} of SteadyState are {shown(mapping)}, not a mapping",
                    term=mapping,
                    remedy=f"give for example {name}={example}",
                )
            object.__setattr__(self, name, dict(mapping))
        if self.settle is not None:
            settle = checked_number("settle", self.settle, 1e-300, 1e300, float)
            object.__setattr__(self, "settle", settle)

    def __getitem__(self, state: sp.Expr) -> Any:
        return self.start[state]

    def __iter__(self) -> Iterator[Any]:
        return iter(self.start)

    def __len__(self) -> int:
        return len(self.start)

    def longest(self, time: tuple[sp.Symbol, float, float]) -> float:
        """The longest time that a trajectory may take, of a problem over a time."""
        return self.settle or USUAL_HORIZONS * (time[2] - time[1])


def conditioned(written: Mapping[str, Any], rest: SteadyState, symbols: Symbols) -> dict[str, Any]:
    """The arguments of the problem before the start, of those of a problem that starts at rest.

    Its horizon is longer than trajectories may take, for a long integration to end at rest.
    """
    time, states = written["time"], map(name_of, symbols.states)
    changed = {
        symbol: _condition(symbol, value, written)
        for symbol, value in changed_symbols(written, rest.conditions.items(), states)
    }

    def under(expression: sp.Basic | float) -> sp.Basic:
        _check_defined(sp.sympify(expression), changed)
        return sp.sympify(expression).xreplace(changed)

    start = {state_of(key, symbols): under(value) for key, value in rest.start.items()}
    definitions = (written["definitions"] or {}).items()
    return {
        **written,
        "equations": [under(equation) for equation in listed_equations(written["equations"])],
        "time": (time[0], time[1], time[1] + _LONGER * rest.longest(time)),
        "initial": {state: start.get(state, sp.S.Zero) for state in symbols.states},
        "definitions": {symbol: under(value) for symbol, value in definitions},
        "jumps": None,
        "events": (),
        "name": None,
        "correlation": None,
    }


def _check_defined(expression: sp.Basic, changed: Mapping[sp.Basic, sp.Expr]) -> None:
    """Raise a ProblemError if some term has no value where symbols are replaced, as log(s) at 0."""
    for term in sp.postorder_traversal(expression):
        if term.is_Atom or not term.free_symbols & changed.keys():
            continue
        if term.xreplace(changed).has(sp.zoo, sp.nan, sp.oo, -sp.oo):
            where = ", ".join(
                f"{symbol} = {changed[symbol]}" for symbol in changed if term.has(symbol)
            )
            raise ProblemError(
                f"the term {quote(text_of(term))} has no value at {where}, under the "
                "conditions of the start",
                term=term,
                remedy="give conditions under which all rates are defined",
            )


def check_autonomous(residuals: Sequence[sp.Expr], time: sp.Symbol) -> None:
    """Raise a ProblemError if time appears in an equation."""
    for i, residual in enumerate(residuals, 1):
        states = {e: sp.Dummy() for e in residual.atoms(sp.Derivative)}
        plain = residual.xreplace(states)
        plain = plain.xreplace({e: sp.Dummy() for e in plain.atoms(AppliedUndef)})
        if time in plain.free_symbols:
            raise ProblemError(
                f"the start is a steady state, and the time {quote(time)} appears in the equation "
                "under its conditions",
                equation=i,
                term=residual,
                remedy="give conditions under which what depends on time is constant, for example "
                "an amplitude of zero",
            )


def _condition(symbol: sp.Symbol, value: object, written: Mapping[str, Any]) -> sp.Expr:
    """What stands for a constant or parameter before the start."""
    subject, remedy = f"the condition of {quote(symbol)}", "give a number, for example {dose: 0}"
    expression = as_expression(value, subject, remedy)
    declared = {*written["parameters"], *(written["constants"] or {})}
    if expression.atoms(AppliedUndef) or expression.has(sp.nan, sp.oo, -sp.oo, sp.zoo, sp.I):
        raise ProblemError(f"{subject} is {quote(expression)}", term=value, remedy=remedy)
    for other in sorted(expression.free_symbols - declared, key=str):
        raise ProblemError(
            f"{subject}, {quote(expression)}, has {quote(other)}, which is neither a parameter nor "
            "a constant",
            term=value,
            remedy="give a number, or an expression of parameters and constants",
        )
    return exact(expression)


def rest_text(conditions: Mapping[Any, Any], start: Mapping[str, sp.Expr]) -> str:
    """``the steady state with dose = 0, from x = 1``."""
    names = ", ".join(f"{symbol} = {text_of(sp.sympify(v))}" for symbol, v in conditions.items())
    starts = ", ".join(f"{name} = {text_of(value)}" for name, value in start.items())
    return f"the steady state{f' with {names}' if names else ''}, from {starts}"


class SettledStart:
    """The start of trajectories by long integration of the equations under the conditions.

    Independent of generated code, and of Newton's method.
    """

    def __init__(self, equations: NumericEquations, first: float) -> None:
        self.equations = equations
        _, start, end = equations.time
        count = max(int(np.ceil(np.log2((end - start) / first))), 0)
        looks = [first * 2.0**k for k in range(count)]
        self.times = start + np.array([look for look in looks if look < end - start])
        self.times = np.append(self.times, end)

    def __call__(self, _time: float, _states: Array, parameters: Array) -> Array:
        """The states (n,) at rest; a ConvergenceError if they still move at the end."""
        states = Integration(self.equations, parameters, self.times, _RTOL).values
        sizes = np.abs(states).max(axis=1, keepdims=True)
        moved = np.abs(np.diff(states, axis=1)) <= _SAME * np.where(sizes > 0.0, sizes, 1.0)
        if not moved[:, -1:].all():
            at = zip(self.equations.parameters, parameters.tolist(), strict=True)
            where = ", ".join(f"{name} = {x:.6g}" for name, x in at)
            raise ConvergenceError(
                "the start is a steady state, but trajectories under its conditions have not "
                f"settled by t = {self.times[-1]:g}{f' at {where}' if where else ''}",
                remedy="give a larger settle= to SteadyState",
            )
        return np.asarray(states[:, -1])
