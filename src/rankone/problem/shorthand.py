"""Constants and definitions that a problem names, and what is often mistaken for an unknown."""

from __future__ import annotations

import graphlib
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.box import Box, check_assumptions, real_number
from rankone.problem.expressions.notation import NamedConstant, exact, expression_of, plain_text
from rankone.support.errors import ProblemError, quote, shown
from rankone.tensors.coordinates import name_of

Fault = tuple[str, sp.Expr, str]
"""A message, the term and the remedy."""
_NO_DELAY = (
    "nothing without a delay is the same; a chain of n further unknowns, "
    "z1' = n*({x} - z1)/tau, ..., zn' = n*(z(n-1) - zn)/tau, is {x} after a delay that is spread "
    "around tau"
)
_AT_TIME = "equations may have unknowns at the time {t} alone"


def wrong_argument(applied: sp.Expr, time: sp.Symbol) -> Fault:
    """Say what is wrong with x(s), x(t - 1), x(2*t), x(0) or x(t, k)."""
    name = applied.func.__name__
    fault = f"is not a function of the time {quote(time)} alone"
    remedy = f"write {name}({time}); parameters are symbols of their own"
    if len(applied.args) == 1:
        argument = applied.args[0]
        if isinstance(argument, sp.Symbol) and argument.name == time.name:
            remedy = "use one symbol for the time everywhere"
            fault = f"uses another symbol {quote(argument)} than the time, with other assumptions"
        elif time in argument.free_symbols:
            fault, remedy = _at_another_time(argument, name, time)
    return f"{quote(applied)} {fault}", applied, remedy


def unsupported(term: sp.Expr, time: sp.Symbol) -> Fault:
    """Say what is wrong with an integral, or with a derivative at another time."""
    if isinstance(term, sp.Subs) and term.point and time in term.point[0].free_symbols:
        unknown = next(iter(term.expr.atoms(AppliedUndef)), term.expr)
        fault, remedy = _at_another_time(term.point[0], unknown.func.__name__, time)
        return f"{quote(term)} {fault}", term, remedy
    message = f"{quote(term)} is not supported in an equation"
    return message, term, "integrals can be written as unknowns with equations of their own"


def _at_another_time(argument: sp.Expr, name: str, time: sp.Symbol) -> tuple[str, str]:
    """What is wrong with an unknown at the time of an argument, and what to do."""
    if time in (argument - time).free_symbols:
        fault = f"takes the unknown at another time than {quote(time)}"
        return fault, _AT_TIME.format(t=time)
    fault = f"takes the unknown at another time than {quote(time)}: delays are not supported"
    return fault, _NO_DELAY.format(x=name)


def check_symbols_as_unknowns(
    equations: Sequence[sp.Basic], declared: Iterable[sp.Expr], initial: object, time: sp.Symbol
) -> None:
    """Raise for a symbol in place of an unknown: SymPy takes its derivative as zero."""
    symbols = {time, *declared}
    starts = [*initial] if isinstance(initial, Mapping) else []
    for symbol in (key for key in starts if isinstance(key, sp.Symbol)):
        involved = [i for i, e in enumerate(equations, 1) if symbol in _free_symbols(e)]
        if involved and symbol not in symbols:
            raise ProblemError(
                f"{quote(symbol)} has an initial value but is a symbol, whose derivative is zero",
                equation=involved[0],
                term=symbol,
                remedy=f'make it a function of time: {symbol} = sympy.Function("{symbol}")({time})',
            )
    for i, equation in enumerate(equations, 1):
        if isinstance(equation, sp.Eq) and equation.lhs.is_Symbol and equation.lhs not in symbols:
            symbol = equation.lhs
            raise ProblemError(
                f"{quote(symbol)} is given by an equation, but is a symbol",
                equation=i,
                term=symbol,
                remedy=f"put it into `definitions`, {{{symbol}: {equation.rhs}}}, or make it a "
                f'function of time, {symbol} = sympy.Function("{symbol}")({time})',
            )


def _free_symbols(equation: object) -> set[sp.Basic]:
    return equation.free_symbols if isinstance(equation, sp.Basic) else set()


# -----------------------------------------------------------------------------
# Constants and definitions: the names that a problem gives to numbers and to expressions.
#
# Constants that enter smoothly are named numbers from here on, and run-time values of what is
# compiled (:mod:`~rankone.problem.expressions.notation`); the others are written in.


# Operations of a definition whose own definitions are put in: more take minutes to compile
_MOST_OPERATIONS = 50_000


@dataclass(frozen=True)
class Shorthand:
    """Constants and definitions of a problem.

    Attributes
    ----------
    constants : dict of Symbol to Expr
        Exact numbers.
    definitions : dict of (Symbol or applied function of time) to Expr
        In the order given, each in terms of unknowns, time, parameters and constants.
    decisive : frozenset of Symbol
        The constants that are written in as numbers.
    """

    constants: Mapping[sp.Symbol, sp.Expr] = field(default_factory=dict)
    definitions: Mapping[sp.Expr, sp.Expr] = field(default_factory=dict)
    decisive: frozenset[sp.Symbol] = frozenset()

    @cached_property
    def named(self) -> dict[sp.Symbol, NamedConstant]:
        """The constants that are run-time values."""
        return {
            symbol: NamedConstant(symbol.name, value)
            for symbol, value in self.constants.items()
            if symbol not in self.decisive
        }

    @property
    def symbols(self) -> tuple[sp.Expr, ...]:
        """What the names are written as."""
        return *self.constants, *self.definitions

    @property
    def names(self) -> tuple[str, ...]:
        """All names, constants first."""
        return tuple(map(name_of, self.symbols))

    @property
    def owners(self) -> list[tuple[str, str]]:
        """All names with what has them: ``("m", "constant `m`")``."""
        listed = (("constant", self.constants), ("definition", self.definitions))
        return [(name_of(s), f"{noun} {quote(s)}") for noun, of in listed for s in of]

    def is_like(self, other: Shorthand) -> bool:
        """Whether the two differ in numbers of run-time constants alone, and these in no sign."""
        named, others = self.named, other.named
        same = self.decisive == other.decisive and self.definitions == other.definitions
        return (
            same
            and all(self.constants[s] == other.constants[s] for s in self.decisive)
            and named.keys() == others.keys()
            and all(named[s].is_positive == others[s].is_positive for s in named)
        )

    @cached_property
    def _replacement(self) -> dict[sp.Expr, sp.Expr]:
        """What stands for each name: no other name is in it."""
        numbers: dict[sp.Expr, sp.Expr] = {**self.constants, **self.named}
        return {**numbers, **{s: e.xreplace(numbers) for s, e in self.definitions.items()}}

    @property
    def texts(self) -> Iterator[tuple[str, str]]:
        """The definitions by name, of states by name: ``("F", "k*x + 0.1*x_t")``."""
        numbers = dict(self.constants)
        for symbol, definition in self.definitions.items():
            expression = definition.xreplace(numbers)
            states = expression.atoms(sp.Derivative) | expression.atoms(AppliedUndef)
            named = {state: sp.Symbol(name_of(state)) for state in states}
            yield name_of(symbol), plain_text(expression.xreplace(named))

    def expanded(self, expression: sp.Basic) -> sp.Basic:
        """An expression with definitions put in, and symbols for constants."""
        return expression.xreplace(dict(self.definitions)) if self.definitions else expression

    def put_in(self, expression: sp.Expr) -> sp.Expr:
        """An expression with numbers for constants and expressions for definitions.

        Numbers of constants that are run-time values have their names.
        """
        if not self.symbols:
            return expression
        replaced: sp.Expr = expression.xreplace(self._replacement)
        derivatives = replaced.atoms(sp.Derivative) - expression.atoms(sp.Derivative)
        carried_out = {d: d.doit() for d in derivatives if not isinstance(d.expr, AppliedUndef)}
        return replaced.xreplace(carried_out) if carried_out else replaced


def check_shorthand(constants: object, definitions: object, time: sp.Symbol) -> Shorthand:
    """Return the constants as exact numbers, and the definitions without each other.

    A ProblemError if a constant is no number, or definitions go in a circle.
    """
    numbers = _check_constants(constants, time)
    return Shorthand(numbers, _expanded(_check_definitions(definitions, time)))


def _check_constants(constants: object, time: sp.Symbol) -> dict[sp.Symbol, sp.Expr]:
    if not isinstance(constants, Mapping | None):
        raise ProblemError(
            f"constants are {shown(constants)}, not a mapping",
            term=constants,
            remedy="give {symbol: number, ...}, for example {m: 3.0}",
        )
    numbers: dict[sp.Symbol, sp.Expr] = {}
    for symbol, value in (constants or {}).items():
        if not isinstance(symbol, sp.Symbol):
            raise ProblemError(
                f"constant {shown(symbol)} is not a SymPy symbol",
                term=symbol,
                remedy="use the symbols that appear in the equations as keys",
            )
        if symbol.name == time.name:
            message = f"{quote(symbol)} is both the time and a constant"
            raise ProblemError(message, term=symbol, remedy="rename one of them")
        numbers[symbol] = constant_value(symbol, value)
    return numbers


def constant_value(symbol: sp.Symbol, value: object) -> sp.Expr:
    """The exact number of a constant; a ProblemError if it has another value."""
    subject = f"the constant {quote(symbol)}"
    if isinstance(value, sp.Expr) and value.free_symbols:
        raise ProblemError(
            f"{subject} is {quote(value)}, not a number",
            term=value,
            remedy="give an expression in `definitions`",
        )
    remedy = "give a number; an interval belongs in `parameters`, a formula in `definitions`"
    nearest = real_number(value, subject, remedy)
    check_assumptions(symbol, nearest, nearest, f"the value {nearest:g} of {subject[4:]}")
    return exact(value if isinstance(value, sp.Expr) else sp.sympify(nearest))


def _check_definitions(definitions: object, time: sp.Symbol) -> dict[sp.Expr, sp.Expr]:
    """The definitions as expressions, perhaps of each other."""
    if not isinstance(definitions, Mapping | None):
        raise ProblemError(
            f"definitions are {shown(definitions)}, not a mapping",
            term=definitions,
            remedy="give {symbol: expression, ...}, for example {F: k*x}",
        )
    written: dict[sp.Expr, sp.Expr] = {}
    for symbol, value in (definitions or {}).items():
        applied = isinstance(symbol, AppliedUndef) and symbol.args == (time,)
        if not isinstance(symbol, sp.Symbol) and not applied:
            raise ProblemError(
                f"{shown(symbol)} cannot be defined: it is neither a symbol nor a function of the "
                f"time {quote(time)}",
                term=symbol,
                remedy="give symbols as keys, for example {F: k*x}",
            )
        if symbol == time:
            raise ProblemError(
                f"{quote(symbol)} is both the time and a definition",
                term=symbol,
                remedy="rename one of them",
            )
        expression = expression_of(value)
        if expression is None or isinstance(expression, sp.MatrixExpr):
            remedy = "give an expression of unknowns, parameters, constants and time"
            remedy += "; Problem.from_strings takes text" if isinstance(value, str) else ""
            raise ProblemError(
                f"the definition of {quote(symbol)} is {shown(value)}, not an expression",
                term=value,
                remedy=remedy,
            )
        written[symbol] = exact(expression)
    return written


def _expanded(written: Mapping[sp.Expr, sp.Expr]) -> dict[sp.Expr, sp.Expr]:
    """The definitions with each other put in, in the order given."""
    needs = {symbol: _among(written, expression) for symbol, expression in written.items()}
    try:
        order = list(graphlib.TopologicalSorter(needs).static_order())
    except graphlib.CycleError as error:
        circle = error.args[1][::-1]
        steps = (f"{quote(a)} needs {quote(b)}" for a, b in itertools.pairwise(circle))
        raise ProblemError(
            f"definitions go in a circle: {', '.join(steps)}",
            term=circle[0],
            remedy="define each by what does not need it; what changes by itself is an unknown",
        ) from None
    operations: dict[sp.Expr, float] = {}
    expanded: dict[sp.Expr, sp.Expr] = {}
    for symbol in order:
        expression = written[symbol]
        inner = sum(operations[s] * expression.count(s) for s in needs[symbol])
        operations[symbol] = inner + float(sp.count_ops(expression)) + 1.0
        if operations[symbol] > _MOST_OPERATIONS:
            raise ProblemError(
                f"the definition of {quote(symbol)} has {operations[symbol]:.3g} operations when "
                "the others are put in",
                term=symbol,
                remedy="make one of those it needs an unknown with an equation of its own",
            )
        expanded[symbol] = expression.xreplace(expanded)
    return {symbol: expanded[symbol] for symbol in written}


def _among(written: Mapping[sp.Expr, sp.Expr], expression: sp.Expr) -> list[sp.Expr]:
    """The definitions that an expression needs."""
    named = expression.free_symbols | expression.atoms(AppliedUndef)
    return [symbol for symbol in written if symbol in named]


def check_apart(shorthand: Shorthand, box: Box, initial: object) -> None:
    """Raise if a constant or a definition is a parameter too, or has an initial value."""
    for symbol in shorthand.symbols:
        noun = "constant" if symbol in shorthand.constants else "definition"
        if symbol in box:
            raise ProblemError(
                f"{quote(symbol)} is both a parameter and a {noun}",
                term=symbol,
                remedy="keep it in one of the two; problem.set and problem.vary move it",
            )
        if isinstance(initial, Mapping) and symbol in initial:
            raise ProblemError(
                f"{quote(symbol)} has both a {noun} and an initial value",
                term=symbol,
                remedy="remove one of the two",
            )
