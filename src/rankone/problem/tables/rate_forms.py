"""Rate laws of one form: trees that differ in their unknowns and numbers alone.

A thousand laws ``k*x/(K + x)`` are one expression with slots, and a table of what stands in them.
Each law has a key: its tree with slots in place of unknowns and numbers, in the order in which it
meets them. Laws with equal keys have one form, so forms are found in a time in proportion to what
is written. A long sum in an argument, as in ``tanh(w1*x1 + ... + w9*x9)``, is a slot itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import sympy as sp

Product = tuple[int, tuple[int, ...]]
"""Number of a function of time and parameters, and the symbols multiplied, ascending."""
TermSum = dict[Product, Fraction]
"""A coefficient for each product."""

_MOST_INSIDE = 4  # Terms of a sum that are written inside a form; longer sums are symbols
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
_Node = tuple[object, ...]


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
        if sum(bool(symbols) for (_, symbols), _ in written) < _MOST_INSIDE >= len(written):
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
        nodes: list[_Node] = []
        for k, argument in enumerate(applied.arguments):
            whole = all(coefficient.denominator == 1 for _, coefficient in argument)
            exponent = k > 0 and applied.operation == "power"
            nodes.append(self._sum(argument, applied, as_written=exponent and whole))
        return (applied.operation, *nodes)

    def _sum(
        self, terms: Iterable[tuple[Product, Fraction]], outer: _Applied, *, as_written: bool
    ) -> _Node:
        """The tree of a sum; numbers beside functions decide how these are written."""
        among = {s for (_, symbols), _ in terms for s in symbols}
        inner = {s: a for s in among if (a := self._inside(s, outer)) is not None}
        as_written |= any(a.operation not in _ARITHMETIC for a in inner.values())

        def pattern(term: tuple[Product, Fraction]) -> tuple[object, ...]:
            (function, symbols), coefficient = term
            return function, len(symbols), coefficient not in (1, -1), symbols

        node: list[object] = []
        for (function, symbols), coefficient in sorted(terms, key=pattern):
            in_slot = coefficient not in (1, -1) and not as_written
            if in_slot:
                self.numbers.append(coefficient)
            factors = (
                self.of(inner[s]) if s in inner else self.symbols.setdefault(s, len(self.symbols))
                for s in symbols
            )
            node.append((None if in_slot else coefficient, function, tuple(factors)))
        return tuple(node)

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
        operation, *arguments = node
        name = str(operation)
        function = _ARITHMETIC.get(name) or FUNCTIONS[name]
        return function(*[self._sum(argument) for argument in arguments])

    def _sum(self, terms: Any) -> sp.Expr:
        return sp.Add(*[self._term(*term) for term in terms])

    def _term(self, coefficient: Fraction | None, function: int, factors: Any) -> sp.Expr:
        constant = next(self._numbers) if coefficient is None else rational(coefficient)
        written = [self.of(f) if isinstance(f, tuple) else self._slots[f] for f in factors]
        return sp.Mul(constant, self._functions[function], *written)


def rational(number: Fraction) -> sp.Rational:
    """A fraction as SymPy has it."""
    return sp.Rational(number.numerator, number.denominator)
