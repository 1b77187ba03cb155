"""Starts at the steady state of other conditions: a system that has come to rest is disturbed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.changes import changed_symbols
from rankone.problem.equations import Symbols, as_expression, listed_equations, state_of
from rankone.problem.expressions.notation import exact, text_of
from rankone.problem.integration import Integration
from rankone.problem.numeric import NumericEquations
from rankone.support.arrays import Array
from rankone.support.errors import ConvergenceError, ProblemError
from rankone.support.options import checked_number
from rankone.support.wording import quote, shown
from rankone.tensors.bases.coordinates import name_of

USUAL_HORIZONS = 100.0
"""Horizons of the problem that trajectories may take to settle."""
_LONGER = 10.0  # How much longer trajectories are followed, to the last digit
_RTOL = 1e-11  # Of the trajectories that come to rest
_LOOKS = 2.0  # Factor from one time to the next at which they are looked at
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
        count = max(int(np.ceil(np.log((end - start) / first) / np.log(_LOOKS))), 0)
        looks = [first * _LOOKS**k for k in range(count)]
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
