"""Rates of many states as a table of terms, and rate laws of one form as factors of them.

A thousand laws ``k*x/(K + x)`` are one expression with slots, and a table of what stands in them.
Each law has a key: its tree with slots in place of unknowns and numbers, in the order in which it
meets them. Laws with equal keys have one form, so forms are found in a time in proportion to what
is written. A long sum in an argument, as in ``tanh(w1*x1 + ... + w9*x9)``, is a slot itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from functools import cached_property, lru_cache
from typing import NamedTuple, TypeAlias

import sympy as sp
from sympy.core.function import Application

from rankone.problem.box import Box
from rankone.problem.expressions.conditions import KEPT, rate_of
from rankone.problem.expressions.notation import exact
from rankone.support.arrays import FEW, MANY_STATES, Deferred, Item
from rankone.support.errors import ProblemError
from rankone.tensors.coordinates import name_of

Product = tuple[int, tuple[int, ...]]
"""Number of a function of time and parameters, and the symbols multiplied, ascending."""
TermSum = dict[Product, Fraction]
"""A coefficient for each product."""

_LARGEST_FORM = 24  # Terms of all sums inside a form; what is inside a larger one is a symbol
_ARITHMETIC: dict[str, Callable[..., sp.Expr]] = {
    "fraction": lambda a, b: a / (a + b),
    "power": lambda base, exponent: base**exponent,
    "product": lambda a, b: a * b,
    "quotient": lambda a, b: a / b,
    "reciprocal": lambda a: 1 / a,
    "total": lambda a: a,
}
FUNCTIONS: dict[str, Callable[..., sp.Expr]] = {
    name: getattr(sp, name)
    for name in ("sin", "cos", "exp", "sinh", "cosh", "tanh", "atan", "erf", "log", "sqrt")
}
"""Functions of one argument that are smooth wherever they are finite and real."""

_Arguments = tuple[tuple[tuple[Product, Fraction], ...], ...]
_Term: TypeAlias = "tuple[Fraction | None, int, tuple[_Node | int, ...]]"
"""Coefficient, None for a slot, number of the function, and operations or slots of symbols."""


class _Node(NamedTuple):
    """An operation on sums of terms."""

    operation: str
    sums: tuple[tuple[_Term, ...], ...]


@dataclass(frozen=True)
class Value:
    """What a form gives for some symbols and numbers in its slots; ``symbol`` stands for it."""

    symbol: int
    form: int
    symbols: tuple[int, ...]
    numbers: tuple[Fraction, ...]


@dataclass(frozen=True)
class RateForm:
    """An expression of time, parameters, and slots for symbols and for numbers."""

    expression: sp.Expr
    symbols: tuple[sp.Dummy, ...]
    numbers: tuple[sp.Dummy, ...]

    def filled(self, symbols: Iterable[sp.Expr], numbers: Iterable[Fraction]) -> sp.Expr:
        """The expression with these in its slots."""
        filled = dict(zip(self.symbols, symbols, strict=True))
        pairs = zip(self.numbers, numbers, strict=True)
        filled |= {slot: rational(x) for slot, x in pairs}
        return self.expression.xreplace(filled)


@dataclass
class _Applied:
    """An operation applied to sums, or a long sum, where there is no operation."""

    operation: str
    arguments: _Arguments
    size: int
    inside: bool


@dataclass
class RateLaws:
    """The operations on unknowns in all rates, each of them once.

    Symbols from ``first`` on stand for them, in an order in which each needs those before it.
    """

    first: int
    _applied: list[_Applied] = field(default_factory=list)
    _symbols: dict[tuple[str, _Arguments], int] = field(default_factory=dict)

    def symbol(self, operation: str, *arguments: TermSum) -> int:
        """The symbol of an operation applied to sums."""
        written = tuple(map(self._argument, arguments))
        size = 1 + sum(map(self._size, written))
        fits = size <= _LARGEST_FORM
        return self._place(_Applied(operation, written, size if fits else 1, fits))

    def _place(self, applied: _Applied) -> int:
        """The symbol of an operation; a new one if it has none yet."""
        key = applied.operation, applied.arguments
        place = self._symbols.setdefault(key, self.first + len(self._applied))
        if place == self.first + len(self._applied):
            self._applied.append(applied)
        return place

    def _argument(self, argument: TermSum) -> tuple[tuple[Product, Fraction], ...]:
        """A sum in a fixed order; a long one is the symbol of its own."""
        written = tuple(sorted(argument.items()))
        if sum(bool(symbols) for (_, symbols), _ in written) < FEW >= len(written):
            return written
        return (((0, (self._place(_Applied("", (written,), 1, True)),)), Fraction(1)),)

    def _size(self, argument: tuple[tuple[Product, Fraction], ...]) -> int:
        symbols = (s for (_, symbols), _ in argument for s in symbols if s >= self.first)
        return len(argument) + sum(self._applied[s - self.first].size for s in symbols)

    def tabulated(
        self, used: Iterable[int], functions: Sequence[sp.Expr]
    ) -> tuple[list[RateForm], list[Value], dict[int, TermSum]]:
        """The forms, what they are applied to, and long sums, of symbols that are used.

        Symbols inside a form are no longer used.
        """
        keys: dict[tuple[_Node, int], int] = {}
        values: dict[int, Value] = {}
        sums: dict[int, TermSum] = {}
        waiting = [symbol for symbol in used if symbol >= self.first]
        while waiting:
            symbol = waiting.pop()
            if symbol in values or symbol in sums:
                continue
            applied = self._applied[symbol - self.first]
            if not applied.operation:
                sums[symbol] = dict(applied.arguments[0])
                further = [s for _, symbols in sums[symbol] for s in symbols]
            else:
                key = _Key(self._applied, self.first)
                node = key.of(applied)
                form = keys.setdefault((node, len(key.numbers)), len(keys))
                values[symbol] = Value(symbol, form, tuple(key.symbols), tuple(key.numbers))
                further = list(key.symbols)
            waiting += [s for s in further if s >= self.first]
        slots = {value.form: len(value.symbols) for value in values.values()}
        forms = [
            _form(node, slots[form], numbers, functions) for (node, numbers), form in keys.items()
        ]
        return forms, [values[symbol] for symbol in sorted(values)], sums


class _Key:
    """The tree of one law, with slots; what stands in the slots is collected on the way."""

    def __init__(self, applied: Sequence[_Applied], first: int) -> None:
        self._applied, self._first = applied, first
        self.symbols: dict[int, int] = {}
        self.numbers: list[Fraction] = []

    def of(self, applied: _Applied) -> _Node:
        """The tree of an operation."""
        sums: list[tuple[_Term, ...]] = []
        for k, argument in enumerate(applied.arguments):
            whole = all(coefficient.denominator == 1 for _, coefficient in argument)
            exponent = k > 0 and applied.operation == "power"
            sums.append(self._sum(argument, applied, as_written=exponent and whole))
        return _Node(applied.operation, tuple(sums))

    def _sum(
        self, terms: Iterable[tuple[Product, Fraction]], outer: _Applied, *, as_written: bool
    ) -> tuple[_Term, ...]:
        """The tree of a sum; numbers beside functions decide how these are written."""
        among = {s for (_, symbols), _ in terms for s in symbols}
        inner = {s: a for s in among if (a := self._inside(s, outer)) is not None}
        as_written |= any(a.operation not in _ARITHMETIC for a in inner.values())

        def pattern(term: tuple[Product, Fraction]) -> tuple[object, ...]:
            (function, symbols), coefficient = term
            return function, len(symbols), coefficient not in (1, -1), symbols

        written: list[_Term] = []
        for (function, symbols), coefficient in sorted(terms, key=pattern):
            in_slot = coefficient not in (1, -1) and not as_written
            if in_slot:
                self.numbers.append(coefficient)
            factors = (
                self.of(inner[s]) if s in inner else self.symbols.setdefault(s, len(self.symbols))
                for s in symbols
            )
            written.append((None if in_slot else coefficient, function, tuple(factors)))
        return tuple(written)

    def _inside(self, symbol: int, outer: _Applied) -> _Applied | None:
        """The operation of a symbol that is written inside of another."""
        if symbol < self._first or not outer.inside:
            return None
        applied = self._applied[symbol - self._first]
        return applied if applied.operation and applied.inside else None


def _form(node: _Node, symbols: int, numbers: int, functions: Sequence[sp.Expr]) -> RateForm:
    """The form of a key."""
    slots = [sp.Dummy(f"x{k}", real=True) for k in range(symbols)]
    constants = [sp.Dummy(f"c{k}", real=True) for k in range(numbers)]
    expression = _Expression(slots, iter(constants), functions).of(node)
    return RateForm(expression, tuple(slots), tuple(constants))


class _Expression:
    """Writes the tree of a form; its numbers come in the order in which the tree meets them."""

    def __init__(
        self,
        slots: Sequence[sp.Dummy],
        numbers: Iterable[sp.Dummy],
        functions: Sequence[sp.Expr],
    ) -> None:
        self._slots, self._numbers, self._functions = slots, iter(numbers), functions

    def of(self, node: _Node) -> sp.Expr:
        function = _ARITHMETIC.get(node.operation) or FUNCTIONS[node.operation]
        return function(*map(self._sum, node.sums))

    def _sum(self, terms: Iterable[_Term]) -> sp.Expr:
        return sp.Add(*[self._term(*term) for term in terms])

    def _term(
        self, coefficient: Fraction | None, function: int, factors: Iterable[_Node | int]
    ) -> sp.Expr:
        constant = next(self._numbers) if coefficient is None else rational(coefficient)
        written = [self.of(f) if isinstance(f, _Node) else self._slots[f] for f in factors]
        return sp.Mul(constant, self._functions[function], *written)


def rational(number: Fraction) -> sp.Rational:
    """A fraction as SymPy has it."""
    return sp.Rational(number.numerator, number.denominator)


# -----------------------------------------------------------------------------
# Rates of many states as a table of terms, from which no expression has to be written.
#
# Matrices, reactions and texts say which products of states change which state, and how fast; rate
# laws of a few forms are factors like states. A table keeps that as it is; the equations are
# written out when somebody looks at them.


FEWEST_TABULATED = MANY_STATES
"""Unknowns from which a problem is kept as a table: fewer are compiled as quickly either way."""
# Functions that a coefficient may have: they are smooth wherever they are finite
_SMOOTH = (sp.sin, sp.cos, sp.tan, sp.exp, sp.sinh, sp.cosh, sp.tanh)

Entry = tuple[Fraction, int, int, tuple[int, ...]]
"""Coefficient, state whose rate it is in, number of the function, states multiplied."""


@dataclass(frozen=True, eq=False)
class TermTable:
    """Rates as sums of terms: a coefficient times a function times a product of states.

    Attributes
    ----------
    states : tuple of Expr
        The unknowns, then their lower derivatives, by order.
    functions : tuple of Expr
        Functions of time and parameters.
    terms : tuple of Entry
        Those of all rates; the states multiplied are ascending. Numbers above those of states
        stand for ``values``, or for sums inside of them, which have terms of their own.
    texts : tuple of str
        The right-hand sides of which the terms were read, if they came as texts.
    rates : tuple of Expr
        The same if they came as expressions.
    forms : tuple of RateForm
        Expressions with slots: rate laws that are no products.
    values : tuple of Value
        What the forms give with states, other values, sums and numbers in their slots.
    """

    states: tuple[sp.Expr, ...]
    functions: tuple[sp.Expr, ...]
    terms: tuple[Entry, ...]
    texts: tuple[str, ...] = ()
    rates: tuple[sp.Expr, ...] = ()
    forms: tuple[RateForm, ...] = ()
    values: tuple[Value, ...] = ()

    def __reduce__(self) -> tuple[object, ...]:
        """Without what was written out."""
        return TermTable, tuple(getattr(self, each.name) for each in fields(self))

    def with_numbers(self, constants: Mapping[sp.Symbol, sp.Expr]) -> TermTable | None:
        """The table with numbers for constants; None where terms vanish or have no value."""
        symbols = self.symbols if constants else ()
        involved = {symbol: at for symbol, at in constants.items() if symbol in symbols}
        if not involved:
            return self
        functions = tuple(function.xreplace(involved) for function in self.functions)
        forms = tuple(
            replace(form, expression=form.expression.xreplace(involved)) for form in self.forms
        )
        if any(f.is_zero or f.has(sp.zoo, sp.nan, sp.oo, -sp.oo) for f in functions):
            return None
        for form, before in zip(forms, self.forms, strict=True):
            left = before.expression.free_symbols - {*involved}
            if form.expression.free_symbols != left or form.expression.has(sp.zoo, sp.nan, sp.oo):
                return None
        return replace(self, functions=functions, forms=forms)

    def fits(self, time: sp.Symbol, box: Box) -> bool:
        """Whether all functions are smooth ones of time and the parameters of a box."""
        return self.symbols <= {time, *box} and all(map(is_smooth, self.functions))

    @property
    def symbols(self) -> set[sp.Basic]:
        """The symbols of the functions and forms but for slots."""
        own = (f.expression.free_symbols.difference(f.symbols, f.numbers) for f in self.forms)
        return set().union(*(f.free_symbols for f in self.functions), *own)

    @property
    def expressions(self) -> tuple[sp.Expr, ...]:
        """All that is not a product of states: functions, and forms with their slots."""
        return (*self.functions, *(form.expression for form in self.forms))

    @cached_property
    def _sources(self) -> Mapping[int, Value | list[Entry]]:
        """What each number above those of states stands for."""
        n = len(self.states)
        sources: dict[int, Value | list[Entry]] = {value.symbol: value for value in self.values}
        for entry in self.terms:
            if entry[1] >= n:
                listed = sources.setdefault(entry[1], [])
                assert isinstance(listed, list)
                listed.append(entry)
        return sources

    @cached_property
    def _written(self) -> dict[int, sp.Expr]:
        """What numbers in terms stand for, as far as it was written out."""
        return dict(enumerate(self.states))

    def written(self, symbol: int) -> sp.Expr:
        """What a number in terms stands for."""
        if symbol not in self._written:
            source = self._sources[symbol]
            if isinstance(source, Value):
                slots = map(self.written, source.symbols)
                self._written[symbol] = self.forms[source.form].filled(slots, source.numbers)
            else:
                self._written[symbol] = sp.Add(*map(self.product, source))
        return self._written[symbol]

    def is_linear(self, symbol: int) -> bool:
        """Whether a number in terms stands for a sum of multiples of states, and a constant."""
        source = self._sources[symbol]
        if isinstance(source, Value):
            return False
        constant = all(self.functions[function].is_number for _, _, function, _ in source)
        return constant and all(
            len(s) < 2 and max(s, default=0) < len(self.states) for *_, s in source
        )

    def product(self, entry: Entry) -> sp.Expr:
        """A term as an expression."""
        coefficient, _, function, symbols = entry
        return sp.Mul(rational(coefficient), self.functions[function], *map(self.written, symbols))

    def start(
        self, initial: object, box: Box, constants: Mapping[sp.Symbol, sp.Expr]
    ) -> dict[sp.Expr, sp.Expr] | None:
        """The initial value of each state; None if they are not numbers or expressions of the box.

        The general checks then say what is wrong with them.
        """
        if not isinstance(initial, Mapping) or initial.keys() != {*self.states}:
            return None
        start, parameters = {}, {*box}
        for state in self.states:
            written = initial[state]
            expression = sp.sympify(written) if isinstance(written, sp.Expr) else _number(written)
            if expression is not None and constants:
                expression = expression.xreplace(dict(constants))
            if expression is None or not expression.free_symbols <= parameters:
                return None
            if not expression.is_Rational:
                if expression.atoms(sp.Function) or not expression.is_polynomial(*parameters):
                    return None
                expression = exact(expression)
            start[state] = expression
        return start


class _Tabulated(Deferred[Item]):
    """Expressions that are written out when they are first read, and the table of their terms."""

    def __init__(self, length: int, make: Callable[[], Sequence[Item]], table: TermTable) -> None:
        super().__init__(length, make)
        self.table = table

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self._length, self._make, self.table)


class TabulatedEquations(_Tabulated[sp.Basic]):
    """Equations with the table of their terms."""


class TabulatedRates(_Tabulated[sp.Expr]):
    """Right-hand sides with the table of their terms."""


def is_smooth(function: sp.Expr) -> bool:
    """Whether a function of time and parameters is smooth wherever it is finite."""
    return all(isinstance(inner, _SMOOTH) for inner in function.atoms(Application))


def written_rates(table: TermTable, time: sp.Symbol, equations: int) -> list[sp.Eq]:
    """The first equations of a table of the first order, solved for the derivatives."""
    rates: list[list[sp.Expr]] = [[] for _ in range(equations)]
    for entry in table.terms:
        if entry[1] < equations:
            rates[entry[1]].append(table.product(entry))
    return [
        sp.Eq(rate_of(state, time), sp.Add(*terms), evaluate=False)
        for state, terms in zip(table.states, rates, strict=False)
    ]


def has_distinct_names(
    states: Iterable[sp.Expr], time: sp.Symbol, symbols: Iterable[sp.Symbol]
) -> bool:
    """Whether no name is taken twice, and all can be printed."""
    names = [time.name, *(symbol.name for symbol in symbols), *map(name_of, states)]
    return len({*names}) == len(names) and all(n.isprintable() and n.strip() for n in names)


@lru_cache(KEPT)
def fraction_of(number: float) -> Fraction:
    """The decimal fraction that a number stands for; see :func:`exact`."""
    rational = exact(sp.Float(number))
    return Fraction(int(rational.p), int(rational.q))


@lru_cache(KEPT)
def _rational(number: float) -> sp.Rational | None:
    try:
        return exact(sp.Float(number))
    except ProblemError:
        return None


def _number(written: object) -> sp.Rational | None:
    """A real number as a fraction; None for anything else."""
    if isinstance(written, bool) or not hasattr(written, "__float__"):
        return None
    try:
        value = float(written)
    except (TypeError, ValueError, OverflowError):
        return None
    return _rational(value) if abs(value) < float("inf") else None
