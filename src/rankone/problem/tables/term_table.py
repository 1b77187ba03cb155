"""Rates of many states as a table of terms, from which no expression has to be written.

Matrices, reactions and texts say which products of states change which state, and how fast; rate
laws of a few forms are factors like states. A table keeps that as it is; the equations are written
out when somebody looks at them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from functools import cached_property, lru_cache

import sympy as sp
from sympy.core.function import Application

from rankone.problem.box import Box
from rankone.problem.expressions.derivatives import rate_of
from rankone.problem.expressions.notation import exact
from rankone.problem.tables.rate_forms import RateForm, Value, rational
from rankone.support.arrays import Deferred, Item
from rankone.support.errors import ProblemError
from rankone.tensors.bases.coordinates import name_of

FEWEST_TABULATED = 64
"""Unknowns from which a problem is kept as a table: fewer are compiled as quickly either way."""
# Functions that a coefficient may have: they are smooth wherever they are finite
_SMOOTH = (sp.sin, sp.cos, sp.tan, sp.exp, sp.sinh, sp.cosh, sp.tanh)
_KEPT = 10_000  # Fractions of numbers that are kept

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


@lru_cache(_KEPT)
def fraction_of(number: float) -> Fraction:
    """The decimal fraction that a number stands for; see :func:`exact`."""
    rational = exact(sp.Float(number))
    return Fraction(int(rational.p), int(rational.q))


@lru_cache(_KEPT)
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
