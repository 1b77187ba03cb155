"""The equations of a problem and the initial values of its states."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Set
from functools import lru_cache
from typing import Any, NamedTuple

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.algebra.matrices import scalar_equations
from rankone.problem.box import Time
from rankone.problem.expressions.conditions import KEPT, rate_of
from rankone.problem.expressions.notation import exact, expression_of
from rankone.problem.shorthand import Shorthand, unsupported, wrong_argument
from rankone.support.errors import ProblemError, count, did_you_mean, listing, name_defect, quote

MOST_TERMS = 5000  # Terms of the longest sum: each takes some milliseconds to compile
_UNSUPPORTED = (sp.Integral, sp.Sum, sp.Product, sp.Limit, sp.Subs)
_NOT_FINITE = (sp.oo, -sp.oo, sp.zoo, sp.nan)


def listed_equations(equations: object) -> tuple[sp.Basic, ...]:
    """The scalar equations as they were given, those between matrices row by row."""
    single = isinstance(equations, sp.Basic) and not isinstance(equations, sp.Tuple | sp.MatrixBase)
    if isinstance(equations, sp.Eq) and any(map(_is_matrix, equations.args)):
        equations, single = (equations,), False
    try:
        if single or isinstance(equations, str | Mapping | Set) or hasattr(equations, "dtype"):
            raise TypeError
        written: tuple[Any, ...] = tuple(equations)  # type: ignore[arg-type]
    except TypeError:
        raise ProblemError(
            f"equations are {quote(equations)}, not a list of SymPy equations",
            term=equations,
            remedy="give a list of sympy.Eq; Problem.from_strings takes text",
        ) from None
    if not written:
        remedy = "give one equation for each unknown"
        raise ProblemError("the list of equations is empty", remedy=remedy)
    return scalar_equations(written)


def check_equations(
    equations: Sequence[sp.Basic], time: sp.Symbol, shorthand: Shorthand
) -> list[sp.Expr]:
    """Return the residuals of the equations, left minus right.

    In the residuals constants and definitions are put in, and every derivative is one of an
    unknown: ``Derivative(x**2, t)`` is carried out.
    """
    check_lengths((e for e in equations if isinstance(e, sp.Basic)), len(equations))
    return [_residual(equation, i, time, shorthand) for i, equation in enumerate(equations, 1)]


def _is_matrix(side: object) -> bool:
    return isinstance(side, sp.MatrixExpr | sp.MatrixBase)


def _residual(equation: sp.Basic, index: int, time: sp.Symbol, shorthand: Shorthand) -> sp.Expr:
    """Left minus right side of the equation of this number, counted from 1."""

    def error(message: str, term: object, remedy: str) -> ProblemError:
        return ProblemError(message, equation=index, term=term, remedy=remedy)

    residual = _difference(equation, error)
    for term in _in_order(residual.atoms(*_UNSUPPORTED)):
        raise error(*unsupported(term, time))
    residual = _carry_out_derivatives(shorthand.put_in(residual), time, error)
    for applied in _in_order(residual.atoms(AppliedUndef)):
        if applied.args != (time,):
            raise error(*wrong_argument(applied, time))
    if residual.has(sp.I):
        raise error(f"{quote(equation)} has complex coefficients", equation, "write real equations")
    if residual.has(*_NOT_FINITE):
        remedy = "check the coefficients and constants"
        raise error(f"{quote(equation)} is not finite", equation, remedy)
    try:
        return exact(residual)
    except ProblemError as out_of_range:
        raise error(out_of_range.message, out_of_range.term, str(out_of_range.remedy)) from None


def _difference(equation: sp.Basic, error: Callable[..., ProblemError]) -> sp.Expr:
    """Left minus right side of an equation as it is written."""
    if isinstance(equation, bool | sp.logic.boolalg.BooleanAtom):
        raise error(
            f"{quote(equation)} is a truth value, not an equation",
            equation,
            "write sympy.Eq(left, right); `left == right` compares the two as they stand, and "
            "SymPy turns an equation of two equal sides, of two numbers, of a matrix and a "
            "number, or of matrices of different shapes into a truth value",
        )
    if isinstance(equation, list | tuple | sp.Tuple):
        raise error(
            f"it is a list of {count(len(equation), 'equation')}",
            equation,
            "write all equations in one list: [*first, *second]",
        )
    if isinstance(equation, sp.Eq):
        return equation.lhs - equation.rhs
    if isinstance(equation, sp.Expr):
        return equation
    raise error(
        f"{quote(equation)} is a {type(equation).__name__}, not a scalar equation",
        equation,
        "write sympy.Eq(left, right), or an expression that vanishes, for each scalar equation",
    )


def _carry_out_derivatives(
    residual: sp.Expr, time: sp.Symbol, error: Callable[..., ProblemError]
) -> sp.Expr:
    """Leave only derivatives of unknowns in time."""
    for _ in range(2):
        carried_out = {}
        for derivative in _in_order(residual.atoms(sp.Derivative)):
            if any(t != time or not n.is_Integer for t, n in derivative.variable_count):
                raise error(
                    f"{quote(derivative)} is not a derivative in the time {quote(time)}",
                    derivative,
                    f"only derivatives with respect to {time} are possible (ordinary equations)",
                )
            if not isinstance(derivative.expr, AppliedUndef):
                carried_out[derivative] = derivative.doit()
        if not carried_out:
            break
        residual = residual.xreplace(carried_out)
    return residual


def _in_order(expressions: Iterable[sp.Expr]) -> list[sp.Expr]:
    """Sort, so that messages do not depend on hashes."""
    listed = list(expressions)
    return sorted(listed, key=sp.default_sort_key) if len(listed) > 1 else listed


def highest_orders(residuals: Sequence[sp.Expr]) -> dict[sp.Expr, int]:
    """Return the order of the highest derivative of each function that is differentiated."""
    highest: dict[sp.Expr, int] = {}
    for _, unknown, order in _derivatives(residuals):
        highest[unknown] = max(order, highest.get(unknown, 0))
    return highest


def algebraic_unknowns(residuals: Sequence[sp.Expr]) -> dict[sp.Expr, int]:
    """Unknowns that are not differentiated, and the number of the first equation of each."""
    differentiated = highest_orders(residuals)
    first: dict[sp.Expr, int] = {}
    for i, residual in enumerate(residuals, 1):
        for applied in _in_order(f for f in _functions_in(residual) if f not in differentiated):
            first.setdefault(applied, i)
    return first


@lru_cache(KEPT)
def _functions_in(residual: sp.Expr) -> frozenset[sp.Expr]:
    """The functions of time in a residual, which many checks look at."""
    return frozenset(residual.atoms(AppliedUndef))


def _derivatives(residuals: Iterable[sp.Expr]) -> Iterator[tuple[int, sp.Expr, int]]:
    """Yield (equation from 0, unknown, order of the derivative), equation by equation."""
    for i, residual in enumerate(residuals):
        for unknown, order in _derivatives_in(residual):
            yield i, unknown, order


@lru_cache(KEPT)
def _derivatives_in(residual: sp.Expr) -> tuple[tuple[sp.Expr, int], ...]:
    """The functions that a residual differentiates, and the orders."""
    derivatives = _in_order(residual.atoms(sp.Derivative))
    return tuple((d.expr, int(d.derivative_count)) for d in derivatives)


def check_lengths(expressions: Iterable[sp.Expr], equations: int) -> None:
    """Raise if a sum is longer than can be compiled; the first expressions are the equations."""
    for i, expression in enumerate(expressions, 1):
        longest = max((len(total.args) for total in expression.atoms(sp.Add)), default=0)
        if longest > MOST_TERMS:
            raise ProblemError(
                f"a sum has {longest} terms; at most {MOST_TERMS} are compiled",
                equation=i if i <= equations else None,
                remedy="gather like terms, or give their sum as a table (rankone.table)",
            )


def check_unknowns(
    residuals: Sequence[sp.Expr], initial: object, time: sp.Symbol
) -> tuple[sp.Expr, ...]:
    """Return the unknowns in order.

    Unknowns come in the order in which their highest derivatives enter the equations; those that
    enter in the same equation come in the order of ``initial``. Algebraic ones are the last.
    """
    highest = highest_orders(residuals)
    first: dict[sp.Expr, int] = {}
    for i, unknown, order in _derivatives(residuals):
        if order == highest[unknown]:
            first.setdefault(unknown, i)
    algebraic = algebraic_unknowns(residuals)
    for applied, i in algebraic.items():
        if len(first) + len(algebraic) > len(residuals):
            raise ProblemError(
                f"{quote(applied)} has no equation: its derivative appears nowhere",
                equation=i,
                term=applied,
                remedy=f"add an equation with {applied}.diff({time}), or an algebraic one that "
                "determines it, or use a symbol and declare it in `parameters`",
            )
    if not isinstance(initial, Mapping):
        raise ProblemError(
            f"initial is {quote(initial)}, not a mapping",
            term=initial,
            remedy="give {unknown: value, ...}, for example {x: 1}",
        )
    unknowns = [*first, *algebraic]
    if len(unknowns) != len(residuals) or not first:
        raise ProblemError(
            f"{count(len(residuals), 'equation')} for {count(len(unknowns), 'unknown')} "
            f"({listing(unknowns) if first else 'nothing is differentiated'})",
            remedy="give one equation for each unknown",
        )
    place = {key: i for i, key in enumerate(initial)}
    return (*sorted(first, key=lambda u: (first[u], place.get(u, len(place)))), *algebraic)


def state_expressions(
    residuals: Sequence[sp.Expr], unknowns: Sequence[sp.Expr], time: sp.Symbol
) -> list[sp.Expr]:
    """What needs an initial value: the unknowns, then their lower derivatives, by order."""
    highest = highest_orders(residuals)
    return [
        rate_of(unknown, time, order) if order else unknown
        for order in range(max(highest.values()))
        for unknown in unknowns
        if order < highest.get(unknown, 1)
    ]


def check_names(
    states: Iterable[tuple[str, sp.Expr]],
    parameters: Iterable[sp.Symbol],
    time: sp.Symbol,
    further: Iterable[tuple[str, str]] = (),
) -> None:
    """Raise unless all names differ and can be printed: results are labelled by name.

    ``further`` has names and their owners: ``("bounce", "event 1")``.
    """
    states, parameters, further = list(states), list(parameters), list(further)
    names = [time.name, *(p.name for p in parameters), *(n for n, _ in (*states, *further))]
    if name_defect((name, "") for name in names) is None:
        return
    named = [(time.name, "the time")]
    named += [(symbol.name, f"parameter {quote(symbol)}") for symbol in parameters]
    named += [(name, f"unknown {quote(expression)}") for name, expression in states]
    defect = name_defect([*named, *further])
    if defect is not None:
        name, message = defect
        raise ProblemError(message, term=name, remedy="rename it")


class Symbols(NamedTuple):
    """What the expressions of a problem may name; states are unknowns and lower derivatives.

    ``rates`` are the highest derivatives, where equations say what they are.
    """

    time: Time
    parameters: tuple[sp.Symbol, ...]
    unknowns: tuple[sp.Expr, ...]
    states: list[sp.Expr]
    shorthand: Shorthand = Shorthand()
    rates: tuple[sp.Expr, ...] = ()

    @property
    def with_rates(self) -> Symbols:
        """The symbols of expressions that may also name highest derivatives."""
        return self._replace(states=[*self.states, *self.rates])

    def explained(self, symbol: sp.Symbol, declared: Iterable[sp.Symbol]) -> tuple[str, str]:
        """Guess what an undeclared symbol was meant for: (message, remedy)."""
        further = [s for s in self.shorthand.symbols if isinstance(s, sp.Symbol)]
        by_name = {coordinate.name: coordinate for coordinate in (*declared, *further)}
        applied = {unknown.func.__name__: unknown for unknown in self.unknowns}
        if symbol.name in by_name:
            return (
                f"symbol {quote(symbol)} has other assumptions than the {quote(symbol)} declared "
                f"({_assumptions(symbol)} here, {_assumptions(by_name[symbol.name])} there)",
                "create the symbol once and use it everywhere",
            )
        if symbol.name in applied:
            return (
                f"symbol {quote(symbol)} is not the unknown {quote(applied[symbol.name])}",
                f"write {applied[symbol.name]}",
            )
        hint = did_you_mean(symbol.name, [*by_name, *applied])
        return (
            f"unknown symbol {quote(symbol)}{hint}",
            f"declare it in `parameters`, for example {{{symbol}: (0.5, 1.5)}}, or give its number "
            f"in `constants`, {{{symbol}: 1.0}}",
        )


def _assumptions(symbol: sp.Symbol) -> str:
    """The assumptions of a symbol, as they are written."""
    assumptions = sorted(dict(symbol._assumptions_orig).items())
    return ", ".join(f"{k}={v}" for k, v in assumptions) or "none"


def check_symbols(residuals: Iterable[sp.Expr], symbols: Symbols) -> None:
    """Raise if an equation has a symbol that is neither the time nor a parameter."""
    declared = [symbols.time[0], *symbols.parameters]
    for i, residual in enumerate(residuals, 1):
        for symbol in _in_order(residual.free_symbols - set(declared)):
            message, remedy = symbols.explained(symbol, declared)
            raise ProblemError(message, equation=i, term=symbol, remedy=remedy)


def as_expression(value: object, subject: str, remedy: str) -> sp.Expr:
    """A number or SymPy expression as the latter; else a ProblemError that says what it is for."""
    expression = expression_of(value)
    if expression is None:
        raise ProblemError(f"{subject} is {value!r}, not an expression", term=value, remedy=remedy)
    return expression


def check_value(
    expression: sp.Expr, subject: str, symbols: Symbols, declared: Iterable[sp.Symbol], remedy: str
) -> None:
    """Raise if an initial value, or a value after a jump, has another symbol or is not finite."""
    declared = list(declared)
    for symbol in _in_order(expression.free_symbols - set(declared)):
        message, declare = symbols.explained(symbol, declared)
        message = f"{subject} has a problem: {message}"
        raise ProblemError(message, term=expression, remedy=declare)
    if expression.has(sp.I, sp.DiracDelta, *_NOT_FINITE):
        message = f"{subject} is not a finite real number"
        raise ProblemError(message, term=expression, remedy=remedy)


def check_initial(
    initial: Mapping[Any, object], symbols: Symbols, optional: Collection[sp.Expr] = ()
) -> dict[sp.Expr, sp.Expr]:
    """Return the initial value of every state, in the order of the states.

    Some that are ``optional`` may be missing.

    Keys of ``initial`` are unknowns ``x(t)`` and, for higher order, their derivatives
    ``x(t).diff(t)``; also understood are both at the initial time: ``x(0)``,
    ``x(t).diff(t).subs(t, 0)``.
    """
    start: dict[sp.Expr, sp.Expr] = {}
    states = set(symbols.states)
    for key, written in initial.items():
        state = state_of(key, symbols)
        if state not in states:
            applied = state.expr if isinstance(state, sp.Derivative) else state
            if applied in states:
                raise ProblemError(
                    f"the initial value of {quote(key)} is not needed: the equations determine "
                    "this derivative",
                    term=key,
                    remedy="remove it",
                )
            raise ProblemError(
                f"`initial` has a value for {quote(key)}, which no equation determines"
                f"{did_you_mean(str(applied), map(str, symbols.states))}",
                term=key,
                remedy="remove it, or add its equation",
            )
        if state in start:
            raise ProblemError(f"{quote(state)} has two initial values", term=key)
        start[state] = exact(_initial_value(state, written, symbols))
    missing = [s for s in symbols.states if s not in start and s not in optional]
    if missing:
        raise ProblemError(
            f"no initial value for {listing(missing)}",
            term=missing[0],
            remedy=f"add it to `initial`, for example {{{missing[0]}: 0}}",
        )
    return {state: start[state] for state in symbols.states if state in start}


def state_of(key: sp.Basic, symbols: Symbols) -> sp.Expr:
    """Translate a key of ``initial`` into the unknown or derivative it stands for."""
    time, t0, _ = symbols.time
    instant, state = None, key
    if isinstance(key, sp.Subs) and len(key.variables) == 1:
        instant, state = key.point[0], key.expr.xreplace({key.variables[0]: time})
    elif isinstance(key, AppliedUndef) and len(key.args) == 1 and key.args[0].is_number:
        instant, state = key.args[0], key.func(time)
    if instant is not None and (not instant.is_number or float(instant) != t0):
        raise ProblemError(
            f"the key {quote(key)} of `initial` is not at the initial time {t0:g}",
            term=key,
            remedy="give the values at the start of time",
        )
    if instant is not None or isinstance(key, AppliedUndef | sp.Derivative):
        return state
    named = {unknown.func.__name__: unknown for unknown in symbols.unknowns}
    name = key if isinstance(key, str) else getattr(key, "name", getattr(key, "__name__", str(key)))
    hint = f" (did you mean {quote(named[name])}?)" if name in named else did_you_mean(name, named)
    fault = "text" if isinstance(key, str) else "not an unknown"
    raise ProblemError(
        f"the key {key!r} of `initial` is {fault}{hint}",
        term=key,
        remedy=f"use the unknowns themselves as keys: {listing(symbols.unknowns)}",
    )


def _initial_value(state: sp.Expr, written: object, symbols: Symbols) -> sp.Expr:
    """The initial value of a state as an expression of the parameters alone."""
    subject = f"the initial value of {quote(state)}"
    remedy = "give a number or an expression of the parameters"
    expression = as_expression(written, subject, remedy)
    subject = f"{subject}, {quote(expression)},"
    expression = symbols.shorthand.put_in(expression)
    for applied in _in_order(expression.atoms(AppliedUndef)):
        message = f"{subject} names the unknown {quote(applied)}"
        raise ProblemError(message, term=written, remedy=remedy)
    if symbols.time[0] in expression.free_symbols:
        message = f"{subject} names the time {quote(symbols.time[0])}"
        raise ProblemError(message, term=written, remedy=remedy)
    check_value(expression, subject, symbols, symbols.parameters, remedy)
    return expression
