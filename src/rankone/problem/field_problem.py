"""The checks of a problem with fields, and all that follows from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.box import (
    Time,
    check_correlation,
    check_parameters,
    check_time,
    check_tolerances,
    check_units,
)
from rankone.problem.checked import CheckedProblem, warn_of_unused
from rankone.problem.equations import (
    Symbols,
    check_equations,
    check_names,
    check_value,
    listed_equations,
    state_of,
)
from rankone.problem.expressions.conditions import rate_of
from rankone.problem.expressions.notation import exact, expression_of, text_of
from rankone.problem.fields import (
    Apply,
    Field,
    FieldDerivative,
    Operator,
    Vector,
    constant_of,
    size_of,
)
from rankone.problem.functions import DataFunction
from rankone.problem.shorthand import Shorthand, check_apart, check_shorthand
from rankone.problem.steady_start import SteadyState
from rankone.support.errors import (
    ProblemError,
    aligned_equations,
    count,
    did_you_mean,
    listing,
    quote,
    shown,
)
from rankone.tensors.bases.coordinates import name_of

State: TypeAlias = "sp.Expr"
"""A field, or a scalar unknown ``x(t)``."""
_HIGHEST_ORDER = 2
_NOT_SMOOTH = (
    sp.Piecewise,
    sp.Heaviside,
    sp.sign,
    sp.Abs,
    sp.Min,
    sp.Max,
    sp.floor,
    sp.ceiling,
    sp.frac,
    sp.Mod,
    sp.DiracDelta,
)


class CheckedFields(CheckedProblem):
    """What checks the arguments of a :class:`rankone.FieldProblem` and sets its attributes."""

    rates: Mapping[State, sp.Expr]
    masses: Mapping[State, Operator]

    def _check(self) -> None:
        """Validate what was given, and set what follows from it."""
        self._check_title()
        self._refuse_unsupported()
        time = check_time(self.time)
        box, distributions = check_parameters(self.parameters, time[0], self.tail)
        shorthand = check_shorthand(self.constants, self.definitions, time[0])
        shorthand = Shorthand(
            shorthand.constants, shorthand.definitions, frozenset(shorthand.constants)
        )
        check_apart(shorthand, box, self.initial)
        equations = _listed(self.written["equations"], time[0])
        rates, unknowns = _rates(equations, time, shorthand)
        states = [*rates]
        named = [(name_of(state), state) for state in states]
        check_names(named, box, time[0], shorthand.owners)
        scalars = tuple(state for state in states if not isinstance(state, Field))
        symbols = Symbols(time, tuple(box), scalars, states, shorthand)
        _check_rates(rates, symbols, len(equations))
        initial = _initial(self.initial, rates, symbols)
        declared = [*box, *shorthand.symbols]
        self._keep(
            equations=equations,
            time=time,
            parameters=MappingProxyType(box),
            distributions=MappingProxyType(distributions),
            correlation=MappingProxyType(check_correlation(self.correlation, box)),
            constants=MappingProxyType(dict(shorthand.constants)),
            definitions=MappingProxyType(dict(shorthand.definitions)),
            shorthand=shorthand,
            units=MappingProxyType(check_units(self.units, time[0], declared, states)),
            atol=MappingProxyType(check_tolerances(self.atol, states, time[0])),
            unknowns=unknowns,
            rates=MappingProxyType(rates),
            residuals=tuple(rates.values()),
            initial=MappingProxyType(initial),
            masses=MappingProxyType(_masses(self.mass, rates, unknowns)),
            jumps=MappingProxyType({}),
            events=(),
        )
        self._keep(mass=MappingProxyType(dict(self.mass or {})))
        warn_of_unused(box, sp.Tuple(*rates.values(), *initial.values()).free_symbols)

    def _refuse_unsupported(self) -> None:
        """Raise for what fields do not take."""
        if self.jumps:
            raise ProblemError(
                "fields do not take jumps",
                term=self.jumps,
                remedy="write a dose as a smooth source, a narrow pulse of time, or solve the "
                "stretches between jumps one by one",
            )
        if self.events:
            raise ProblemError(
                "fields do not take events",
                term=self.events,
                remedy="leave them out, and read crossings from the solution",
            )
        if isinstance(self.initial, SteadyState):
            raise ProblemError(
                "fields do not start at steady states",
                term=self.initial,
                remedy="give initial values; let time begin earlier for what has come to rest",
            )

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """The fields among the states, in order."""
        return tuple(state for state in self.rates if isinstance(state, Field))

    @property
    def size(self) -> int:
        """The number of entries of all states."""
        return sum(size_of(state) for state in self.rates)

    # -- how it is shown, and what is equal ----------------------------------------------------

    def content(self, plain: bool = False) -> tuple[object, ...]:
        """Everything that two equal problems have in common."""
        expressions: list[sp.Basic] = [
            sp.Tuple(*(sp.Tuple(*pair) for pair in mapping.items()))
            for mapping in (self.rates, self.initial, self.masses, self.definitions or {})
        ]
        box = sp.Tuple(*(sp.Tuple(symbol, *ends) for symbol, ends in self.parameters.items()))
        named = (self.units, self.distributions, self.correlation, self.atol)
        others = [dict(mapping or {}) for mapping in named]
        return expressions, box, others, str(self.time[0]), self.time[1:], self.name, self.tail

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CheckedFields):
            return NotImplemented
        return self is other or self.content() == other.content()

    def __hash__(self) -> int:
        return hash((self.residuals, self.unknowns, self.time))

    def _heading(self) -> str:
        """How many unknowns there are, in words."""
        fields = [u for u in self.unknowns if isinstance(u, Field)]
        entries = ", ".join(dict.fromkeys(str(u.size) for u in fields))
        kinds = [f"{count(len(fields), 'field')} of {entries} entries"]
        scalars = len(self.unknowns) - len(fields)
        kinds += [count(scalars, "scalar unknown")] if scalars else []
        return ", ".join([*kinds, count(len(self.parameters), "parameter")])

    def _equation_texts(self) -> list[str]:
        return [text_of(equation) for equation in self.equations]

    def _initial_texts(self) -> list[str]:
        return [
            f"{name_of(state)}({self.time[1]:g}) = {text_of(start)}"
            for state, start in self.initial.items()
        ]

    def __repr__(self) -> str:
        title = "Problem" if self.name is None else f"Problem {self.name!r}"
        lines = [f"{title}: {self._heading()}"]
        definitions = (self.written["definitions"] or {}).items()
        lines += [f"  {name_of(symbol)} = {text_of(sp.sympify(e))}" for symbol, e in definitions]
        lines += [f"  {line}" for line in self._equation_texts()]
        if self.masses:
            masses = (f"{name_of(u)}: {matrix.name}" for u, matrix in self.masses.items())
            lines.append(f"  mass {', '.join(masses)}")
        return "\n".join([*lines, "  " + ", ".join(self._initial_texts()), *self._closing_lines()])

    def _repr_latex_(self) -> str:
        lines = [
            rf"{sp.latex(equation.lhs)} &= {sp.latex(equation.rhs)}" for equation in self.equations
        ]
        lines += [
            rf"{sp.latex(c.symbol)} &\in [{c.lower:g}, {c.upper:g}]" for c in self.coordinates
        ]
        return aligned_equations(lines)


# -- equations ---------------------------------------------------------------------------------


def _listed(equations: object, time: sp.Symbol) -> tuple[sp.Eq, ...]:
    """The equations; rates by unknown as equations, too."""
    if not isinstance(equations, Mapping):
        listed = listed_equations(equations)
        return tuple(
            e if isinstance(e, sp.Eq) or not isinstance(e, sp.Expr) else sp.Eq(e, 0, evaluate=False)
            for e in listed
        )
    written = []
    for unknown, rate in equations.items():
        left = unknown.diff(time) if isinstance(unknown, Field) else None
        if isinstance(unknown, AppliedUndef):
            left = rate_of(unknown, time)
        if left is None:
            raise ProblemError(
                f"{shown(unknown)} is given a rate, but is neither a field nor a function of time",
                term=unknown,
                remedy='use what rankone.field("u", n) gives, or sympy.Function("x")(t), as keys',
            )
        expression = expression_of(rate)
        if expression is None:
            raise ProblemError(
                f"the rate of {quote(unknown)} is {shown(rate)}, not an expression",
                term=rate,
                remedy="give an expression of fields, parameters and time; "
                "Problem.from_strings takes text",
            )
        written.append(sp.Eq(left, expression, evaluate=False))
    return tuple(written)


def _rates(
    equations: Sequence[sp.Basic], time: Time, shorthand: Shorthand
) -> tuple[dict[State, sp.Expr], tuple[sp.Expr, ...]]:
    """The rate of each state, and the unknowns in the order of their equations."""
    residuals = check_equations(equations, time[0], shorthand)
    derivatives = [_derivatives(residual, i, time[0]) for i, residual in enumerate(residuals, 1)]
    orders: dict[sp.Expr, int] = {}
    for each in derivatives:
        for derivative in each:
            order = derivative.derivative_count
            orders[derivative.expr] = max(order, orders.get(derivative.expr, 0))
    for unknown, order in orders.items():
        _check_order(unknown, order)
    lower = {
        unknown.diff(time[0]): Field(f"{unknown.name}_t", unknown.size)
        for unknown, order in orders.items()
        if order > 1
    }
    given: dict[sp.Expr, sp.Expr] = {}
    for i, (residual, each) in enumerate(zip(residuals, derivatives, strict=True), 1):
        highest = [d for d in each if d.derivative_count == orders[d.expr]]
        if len(highest) != 1:
            raise ProblemError(
                f"it has {count(len(highest), 'highest derivative')}"
                + (f", {listing(highest)}" if highest else ""),
                equation=i,
                term=equations[i - 1],
                remedy="give one equation du/dt = ... for each unknown; equations of fields are "
                "not algebraic, and mass matrices are given by mass={u: M}",
            )
        unknown = highest[0].expr
        if unknown in given:
            raise ProblemError(
                f"{quote(unknown)} is given a rate twice",
                equation=i,
                term=highest[0],
                remedy="give one equation for each unknown",
            )
        given[unknown] = _solved(residual, highest[0], i).xreplace(lower)
    rates: dict[State, sp.Expr] = {}
    velocities: dict[State, sp.Expr] = {}
    for unknown, rate in given.items():
        if orders[unknown] > 1:
            velocity = lower[unknown.diff(time[0])]
            rates[unknown], velocities[velocity] = velocity, rate
        else:
            rates[unknown] = rate
    return {**rates, **velocities}, tuple(given)


def _derivatives(residual: sp.Expr, equation: int, time: sp.Symbol) -> list[sp.Expr]:
    """The derivatives in an equation, in a fixed order."""
    present = residual.atoms(FieldDerivative) | residual.atoms(sp.Derivative)
    ordered = sorted(present, key=lambda d: (name_of(d), sp.default_sort_key(d)))
    for derivative in ordered:
        if {*derivative.variables} != {time}:
            raise ProblemError(
                f"{quote(derivative)} is not a derivative in the time {quote(time)}",
                equation=equation,
                term=derivative,
                remedy=f"differentiate fields by {time} alone, and products by hand",
            )
    return ordered


def _check_order(unknown: sp.Expr, order: int) -> None:
    most = _HIGHEST_ORDER if isinstance(unknown, Field) else 1
    if order > most:
        noun = "fields" if isinstance(unknown, Field) else "scalar unknowns beside fields"
        raise ProblemError(
            f"{quote(unknown)} has a derivative of order {order}; {noun} have derivatives up to "
            f"order {most}",
            term=unknown,
            remedy="name a derivative, as an unknown with an equation of its own",
        )


def _solved(residual: sp.Expr, derivative: sp.Expr, equation: int) -> sp.Expr:
    """The derivative from an equation in which it has a factor without unknowns."""
    terms = sp.Add.make_args(residual)
    if not all(_is_multiple(term, derivative) for term in terms if term.has(derivative)):
        terms = sp.Add.make_args(sp.expand(residual))
    with_it = [term for term in terms if term.has(derivative)]
    factor = sp.Add(*(term / derivative for term in with_it))
    fault = None
    if not all(_is_multiple(term, derivative) for term in with_it):
        fault = f"{quote(derivative)} is inside of a function or a matrix"
    elif factor.atoms(Field, AppliedUndef, Apply):
        fault = f"the factor {quote(factor)} of {quote(derivative)} has unknowns"
    if fault is not None:
        raise ProblemError(
            fault,
            equation=equation,
            term=derivative,
            remedy="divide by the factor: write du/dt = ...; mass matrices are given by "
            "mass={u: M}",
        )
    rest = sp.Add(*(term for term in terms if not term.has(derivative)))
    return -rest if factor == 1 else rest if factor == -1 else -rest / factor


def _is_multiple(term: sp.Expr, derivative: sp.Expr) -> bool:
    return not (term / derivative).has(derivative)


def _check_rates(rates: Mapping[State, sp.Expr], symbols: Symbols, equations: int) -> None:
    """Raise unless rates have the sizes of the states, and known symbols and functions alone."""
    order = [s for s in rates if not (isinstance(s, Field) and isinstance(rates[s], Field))]
    numbers = {state: i for i, state in enumerate(order, 1)}
    for state, rate in rates.items():
        number = min(numbers.get(state, equations), equations)
        try:
            size = size_of(rate)
        except ProblemError as error:
            raise ProblemError(
                error.message, equation=number, term=error.term, remedy=error.remedy
            ) from None
        if size not in (1, size_of(state)):
            raise ProblemError(
                f"the rate of {quote(state)}, which has {count(size_of(state), 'entry', 'entries')}"
                f", has {size}",
                equation=number,
                term=rate,
                remedy="bring it to the right size by `apply`",
            )
        _check_symbols(rate, symbols, number)
        _check_smooth(rate, symbols, number)


def _check_symbols(rate: sp.Expr, symbols: Symbols, equation: int) -> None:
    """Raise if a rate has an unknown without an equation, or a symbol that nothing declares."""
    states = {*symbols.states}
    named = {name_of(state): state for state in states}
    for unknown in sorted(rate.atoms(Field, AppliedUndef) - states, key=str):
        if isinstance(unknown, DataFunction):
            continue
        twin = named.get(name_of(unknown))
        twin_size = f" with {size_of(twin)} entries" if twin is not None else ""
        raise ProblemError(
            f"{quote(unknown)} has no equation"
            + (f": it is not the {quote(twin)}{twin_size} that has one" if twin else ""),
            equation=equation,
            term=unknown,
            remedy=f"give its rate, {{{name_of(unknown)}: ...}}, or use one object everywhere",
        )
    declared = [symbols.time[0], *symbols.parameters]
    allowed = {*declared, *states}
    unknown_symbols = [
        s for s in rate.free_symbols if s not in allowed and not isinstance(s, Field | Vector)
    ]
    for symbol in sorted(unknown_symbols, key=sp.default_sort_key):
        if symbol.name in named:
            raise ProblemError(
                f"symbol {quote(symbol)} is not the unknown of that name",
                equation=equation,
                term=symbol,
                remedy=f'use what rankone.field("{symbol.name}", n) gave',
            )
        message, remedy = symbols.explained(symbol, declared)
        raise ProblemError(message, equation=equation, term=symbol, remedy=remedy)


def _check_smooth(rate: sp.Expr, symbols: Symbols, equation: int) -> None:
    """Raise for functions that jump or have kinks, and for users' functions."""
    moving = {symbols.time[0], *(s for s in symbols.states if isinstance(s, Field))}
    for node in sorted(rate.atoms(*_NOT_SMOOTH), key=sp.default_sort_key):
        if node.free_symbols & moving or node.atoms(AppliedUndef, Vector):
            raise ProblemError(
                f"{quote(node)} is not smooth, and the rates of fields are smooth",
                equation=equation,
                term=node,
                remedy="write a smooth transition, such as 1/(1 + exp(-(x - 1)/0.01)) for a step "
                "at x = 1; where it depends on place alone, give its values as an array",
            )
    for applied in sorted(rate.atoms(DataFunction), key=sp.default_sort_key):
        raise ProblemError(
            f"{quote(applied)} is a table or a function of the user, which fields do not take",
            equation=equation,
            term=applied,
            remedy="write it as a formula",
        )


# -- initial values and masses -----------------------------------------------------------------


def _initial(
    written: object, rates: Mapping[State, sp.Expr], symbols: Symbols
) -> dict[State, sp.Expr]:
    """The initial value of each state, an elementwise expression of parameters."""
    if not isinstance(written, Mapping):
        raise ProblemError(
            f"initial is {shown(written)}, not a mapping",
            term=written,
            remedy="give {u: array, v: number, ...}",
        )
    given: dict[State, sp.Expr] = {}
    for key, value in written.items():
        state = _state_of(key, rates, symbols)
        given[state] = _start(state, value, symbols)
    missing = [state for state in rates if state not in given]
    if missing:
        raise ProblemError(
            f"no initial value for {listing(missing)}",
            term=missing[0],
            remedy=f"add it to `initial`, for example {{{missing[0]}: 0}}",
        )
    return {state: given[state] for state in rates}


def _state_of(key: object, rates: Mapping[State, sp.Expr], symbols: Symbols) -> State:
    """The state that a key of ``initial`` names."""
    if isinstance(key, sp.Expr) and key in rates:
        return key
    named = {name_of(state): state for state in rates}
    if isinstance(key, FieldDerivative | str):
        name = key if isinstance(key, str) else name_of(key)
        if name in named:
            return named[name]
        if isinstance(key, FieldDerivative) and key.expr in rates:
            raise ProblemError(
                f"the initial value of {quote(key)} is not needed: the equations determine this "
                "derivative",
                term=key,
                remedy="leave it out",
            )
    elif isinstance(key, AppliedUndef | sp.Subs) and (state := state_of(key, symbols)) in rates:
        return state
    text = str(key)
    raise ProblemError(
        f"the key {shown(key)} of `initial` is no unknown{did_you_mean(text, named)}",
        term=key,
        remedy=f"use the unknowns themselves as keys: {listing(rates)}",
    )


def _start(state: State, value: object, symbols: Symbols) -> sp.Expr:
    """One initial value as an expression."""
    subject, size = f"the initial value of {quote(state)}", size_of(state)
    expression = expression_of(value) if isinstance(value, sp.Basic) or _is_number(value) else None
    if expression is None:
        remedy = f"give a number, an array of {size} numbers, or an expression of parameters"
        if isinstance(value, str | Mapping | sp.MatrixBase | None):
            raise ProblemError(f"{subject} is {shown(value)}", term=value, remedy=remedy)
        expression = constant_of(value, subject)
        if isinstance(expression, Operator):
            raise ProblemError(
                f"{subject} has the shape {expression.shape}",
                term=value,
                remedy="give an array of one dimension",
            )
    expression = exact(symbols.shorthand.put_in(expression))
    if size_of(expression) not in (1, size):
        raise ProblemError(
            f"{subject} has {size_of(expression)} entries",
            term=value,
            remedy=f"give {count(size, 'entry', 'entries')}, or one number for all",
        )
    remedy = "give a number, an array, or an expression of the parameters and of arrays"
    unknowns = expression.atoms(Field, AppliedUndef, FieldDerivative)
    if unknowns or symbols.time[0] in expression.free_symbols:
        term = listing(unknowns) if unknowns else f"the time {quote(symbols.time[0])}"
        raise ProblemError(f"{subject} names {term}", term=value, remedy=remedy)
    constants = {s: sp.Dummy() for s in expression.free_symbols if isinstance(s, Vector)}
    plain = expression.xreplace(constants)
    declared = [*symbols.parameters, *constants.values()]
    check_value(plain, subject, symbols, declared, remedy)
    return expression


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.generic)


def _masses(
    written: Mapping[Any, Any] | None, rates: Mapping[State, sp.Expr], unknowns: Iterable[sp.Expr]
) -> dict[State, Operator]:
    """The mass matrices of states; of a field of second order it is that of its velocity."""
    if written is None:
        return {}
    if not isinstance(written, Mapping):
        raise ProblemError(
            f"mass is {shown(written)}, not a mapping", term=written, remedy="give {u: M}"
        )
    fields = {name_of(u): u for u in unknowns if isinstance(u, Field)}
    velocities = {name_of(state): state for state in rates}
    masses: dict[State, Operator] = {}
    for key, matrix in written.items():
        named = key if isinstance(key, str) else getattr(key, "name", None)
        if named not in fields or not isinstance(key, Field | str):
            raise ProblemError(
                f"mass has {shown(key)}, which is no field of the problem",
                term=key,
                remedy=f"choose from {listing(fields.values())}",
            )
        state = velocities.get(f"{named}_t", fields[named])
        masses[state] = _mass(matrix, fields[named])
    return masses


def _mass(written: object, unknown: Field) -> Operator:
    """One mass matrix; its factorisation tells whether it is singular."""
    subject = f"the mass matrix of {quote(unknown)}"
    matrix = written if isinstance(written, Operator) else constant_of(written, subject)
    shape = matrix.shape if isinstance(matrix, Operator) else (matrix.size,)
    if isinstance(matrix, Vector) or shape != (unknown.size, unknown.size):
        raise ProblemError(
            f"{subject} is {' x '.join(map(str, shape))}",
            term=written,
            remedy=f"give a matrix of {unknown.size} x {unknown.size} entries",
        )
    try:
        scipy.sparse.linalg.splu(scipy.sparse.csc_array(matrix.matrix))
    except RuntimeError:
        raise ProblemError(
            f"{subject} is singular",
            term=written,
            remedy="leave out degrees of freedom that have no mass, or take those at the boundary "
            "from the boundary values",
        ) from None
    return matrix
