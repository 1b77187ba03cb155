"""Pointwise functions: rates, Jacobians, initial values, features, at given states and parameters.

:class:`PointwiseWriter` turns expressions, or the terms of a separated form, into a
:class:`PointwiseFunction`: what is computed in which order, with the text of each expression. A
:class:`Printer` knows the language: how an expression is written, and how a function is laid out.
:class:`NumPyPrinter` writes functions that are vectorised over points; an integrator calls them
too, so they use few operations: what occurs twice is computed once.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import sympy as sp

from rankone.compiler.codegen.layout import INDENT, Names, assignment, docstring, unpacking
from rankone.compiler.codegen.printer import common_subexpressions
from rankone.problem.expressions.conditions import unknown_of
from rankone.problem.forms import Coordinate, Jump, State
from rankone.problem.functions import nodes_of
from rankone.support.files import WIDTH

Index: TypeAlias = "tuple[int, ...]"
"""Where an entry is in the array that a function returns: (row,) or (row, column)."""
Shared: TypeAlias = "list[tuple[str, str]]"
"""Names and the text of what they stand for, each using only what precedes it."""


@dataclass(frozen=True)
class Entry:
    """An entry of the value: its place, the terms of a sum as text, and what it means."""

    index: Index
    terms: Sequence[str]
    meaning: str = ""


@dataclass(frozen=True)
class Statements:
    """Intermediate terms, then the entries that use them; for one ``kind``, the first argument."""

    intermediate: Shared
    entries: Sequence[Entry]
    kind: int | None = None


@dataclass(frozen=True)
class PointwiseFunction:
    """A function of ``kind``, time ``t``, states ``u`` or ``x``, and parameters ``p``.

    It is in no language yet. The value at one point has a ``shape``; the entries that are not
    computed are what ``start`` says. Parameters and states have local names, ``_`` for those that
    are not used. ``array_time`` says whether expressions need the time as an array.
    """

    name: str
    arguments: tuple[str, ...]
    summary: str
    shape: Index
    start: Literal["empty", "zeros", "states"]
    parameters: Sequence[str]
    states: Sequence[str]
    statements: Sequence[Statements]
    array_time: bool = False


class Printer(Protocol):
    """How expressions and pointwise functions are written in one language."""

    @property
    def reserved(self) -> Sequence[str]:
        """Names that no parameter, state or intermediate term may have."""

    def expressions(
        self,
        expressions: Sequence[sp.Expr],
        names: dict[sp.Symbol, str],
        temporaries: Iterator[str],
    ) -> tuple[Shared, list[str]]:
        """Text of expressions of named symbols, after what they share under fresh names."""

    def function(self, function: PointwiseFunction) -> list[str]:
        """Source lines of a function."""


class NumPyPrinter:
    """Writes functions of arrays: t (...), u (n, ...) and p (d, ...) broadcast together."""

    reserved = (
        "np",
        "special",
        "CubicSpline",
        "CONSTANTS",
        "t",
        "u",
        "x",
        "p",
        "kind",
        "shape",
        "out",
    )
    _MAX_BROADCAST_ARGUMENTS = 64
    """Arguments that ``np.broadcast`` takes."""
    expressions = staticmethod(common_subexpressions)

    def function(self, function: PointwiseFunction) -> list[str]:
        states = "x" if "x" in function.arguments else "u"
        lines = [
            f"def {function.name}({', '.join(function.arguments)}):",
            *docstring([function.summary]),
        ]
        before = function.start == "states"
        of_rows = None if before else self._shape_of_rows(function, states)
        if of_rows is None:  # unpacking may replace the argument
            lines.append(f"    shape = {self._shape(function, states)}")
        if before:
            whole = f"({function.shape[0]}, *shape)"
            lines.append(f"    out = np.array(np.broadcast_to({states}, {whole}))")
        if function.array_time:
            lines.append("    t = np.asarray(t, dtype=float)")
        lines += unpacking(function.parameters, "p")
        lines += unpacking(function.states, states)
        if of_rows is not None:
            lines.append(f"    shape = {of_rows}")
        allocation = f"np.{function.start}(({', '.join(map(str, function.shape))}, *shape))"
        for block in function.statements:
            written = self._intermediate(block)
            if not before and not block.entries:
                return [*lines, *written, "    # Output", f"    return {allocation}"]
            if not before:
                written += ["    # Output", f"    out = {allocation}"]
            for entry in block.entries:
                target = f"out[{', '.join(map(str, entry.index))}]"
                written += assignment(target, entry.terms, entry.meaning)
            if block.kind is not None:
                written = [f"    if kind == {block.kind}:", *(INDENT + line for line in written)]
            lines += written
        return [*lines, "    return out"]

    def _shape(self, function: PointwiseFunction, states: str) -> str:
        """The expression for the common shape of all points."""
        if "t" in function.arguments and states not in function.arguments:
            return "np.broadcast_shapes(np.shape(t), np.shape(p)[1:])"
        if "t" in function.arguments:
            count = 1 + len(function.states) + len(function.parameters)
            if count <= self._MAX_BROADCAST_ARGUMENTS:
                return f"np.broadcast(t, *{states}, *p).shape"
            return f"np.broadcast_shapes(np.shape(t), np.shape({states})[1:], np.shape(p)[1:])"
        if states in function.arguments:
            return f"np.broadcast_shapes(np.shape({states})[1:], np.shape(p)[1:])"
        return "np.broadcast_shapes(*map(np.shape, p)) or np.shape(p)[1:]"

    def _shape_of_rows(self, function: PointwiseFunction, states: str) -> str | None:
        """The shape from unpacked rows, which is faster; None where one line does not do."""
        unpacked = {states: function.states, "p": function.parameters}
        names = [name for rows in unpacked.values() for name in rows]
        many = len(names) >= self._MAX_BROADCAST_ARGUMENTS
        if many or not {"t", states} <= {*function.arguments} or {*unpacked} & {*names}:
            return None
        rows = [f"*{whole}" if "_" in some else ", ".join(some) for whole, some in unpacked.items()]
        shape = f"np.broadcast({', '.join(['t', *filter(None, rows)])}).shape"
        return shape if len(f"    shape = {shape}") <= WIDTH else None

    def _intermediate(self, block: Statements) -> list[str]:
        """The lines that compute the intermediate terms."""
        if not block.intermediate:
            return []
        lines = [f"    # Intermediate terms ({len(block.intermediate)})"]
        return lines + [
            line for name, text in block.intermediate for line in assignment(name, [text])
        ]


class PointwiseWriter:
    """Writes the pointwise functions of one system; its coordinates are time, then parameters.

    Expressions hold the states as ``x(t)``, time and parameters; they are written over real
    symbols. ``operations`` counts those of each function written so far, and ``printed`` holds the
    expressions written so far.
    """

    def __init__(
        self,
        coordinates: Sequence[Coordinate],
        states: Sequence[State],
        printer: Printer | None = None,
    ) -> None:
        clock, *parameters = coordinates
        self.printer: Printer = printer or NumPyPrinter()
        self.operations: dict[str, int] = {}
        self.printed: list[sp.Expr] = []
        self.time = sp.Symbol(clock.name, real=True)
        self.parameters = [sp.Symbol(c.name, real=True) for c in parameters]
        self.states = [sp.Symbol(state.name, real=True) for state in states]
        self._real: dict[sp.Expr, sp.Symbol] = {
            unknown_of(state.name, clock.symbol): symbol
            for state, symbol in zip(states, self.states, strict=True)
        }
        self._replaced: dict[sp.Expr, sp.Expr] = {}
        symbols = (self.time, *self.parameters)
        self._real |= {c.symbol: symbol for c, symbol in zip(coordinates, symbols, strict=True)}

    def state_name(self, row: int) -> str:
        """The name of a state."""
        return str(self.states[row].name)

    def is_polynomial(self, expression: sp.Expr) -> bool:
        """Whether an expression is a polynomial of the states."""
        real = self.real(expression)
        unknowns = [symbol for symbol in self.states if symbol in real.free_symbols]
        return not unknowns or bool(real.is_polynomial(*unknowns))

    def real(self, expression: sp.Expr) -> sp.Expr:
        """An expression over real symbols; what occurs often is replaced once."""
        if expression in self._real:
            return self._real[expression]
        if expression not in self._replaced:
            args = [self.real(each) for each in expression.args]
            same = all(map(operator.is_, args, expression.args))
            self._replaced[expression] = expression if same else expression.func(*args)
        return self._replaced[expression]

    def vector(
        self,
        name: str,
        arguments: str,
        summary: str,
        expressions: Sequence[sp.Expr],
        meanings: Sequence[str] = (),
    ) -> list[str]:
        """Source lines of a function with expressions as its entries; none without expressions."""
        if not expressions:
            return []
        entries: dict[Index, sp.Expr] = {(i,): e for i, e in enumerate(expressions)}
        shape = (len(expressions),)
        return self.array(
            name, arguments, summary, shape, entries, lambda i: meanings[i] if meanings else ""
        )

    def array(
        self,
        name: str,
        arguments: str,
        summary: str,
        shape: Index,
        entries: Mapping[Index, sp.Expr],
        meaning: Callable[..., str],
        start: Literal["empty", "zeros"] = "empty",
    ) -> list[str]:
        """Source lines of a function with expressions as some entries of its value."""
        scope = self._scope()
        statements = self._statements(name, scope, entries, meaning)
        return self.written(scope, name, arguments, summary, shape, start, [statements])

    def jumped(self, jumps: Sequence[Jump]) -> list[str]:
        """Source lines of ``jumped``: for each kind of jump the states that it changes."""
        if not jumps:
            return []
        n, scope, statements = len(self.states), self._scope(), []
        for kind, states_after in enumerate(Jump.kinds(jumps)):
            pairs = enumerate(zip(self.states, map(self.real, states_after), strict=True))
            entries: dict[Index, sp.Expr] = {(i,): after for i, (u, after) in pairs if after != u}
            statements.append(
                self._statements(
                    "jumped", scope, entries, lambda i: f"{self.state_name(i)} after it", kind
                )
            )
        summary = f"States right after a jump from u ({n}, ...) before, at p (d, ...): ({n}, ...)."
        return self.written(scope, "jumped", "kind, u, p", summary, (n,), "states", statements)

    def _scope(self) -> Scope:
        """Fresh names for a function."""
        names = [s.name for s in self.parameters], [s.name for s in self.states]
        return Scope(self.printer, *names)

    def _statements(
        self,
        name: str,
        scope: Scope,
        entries: Mapping[Index, sp.Expr],
        meaning: Callable[..., str],
        kind: int | None = None,
    ) -> Statements:
        """The statements that compute entries from expressions."""
        expressions = [self.real(expression) for expression in entries.values()]
        self.printed += expressions
        symbols = nodes_of(expressions, sp.Symbol)
        scope.used_parameters |= {j for j, p in enumerate(self.parameters) if p in symbols}
        scope.used_states |= {i for i, u in enumerate(self.states) if u in symbols}
        scope.uses_time |= self.time in symbols
        names = {self.time: "t"}
        names |= dict(zip(self.parameters, scope.parameters, strict=True))
        names |= dict(zip(self.states, scope.states, strict=True))
        shared, texts = self.printer.expressions(expressions, names, scope.fresh.numbered("c"))
        count = sum(map(_operations, (*(text for _, text in shared), *texts)))
        self.operations[name] = self.operations.get(name, 0) + count
        pairs = zip(entries, texts, strict=True)
        return Statements(
            shared, [Entry(i, [_as_float(text)], meaning(*i)) for i, text in pairs], kind
        )

    def written(
        self,
        scope: Scope,
        name: str,
        arguments: str,
        summary: str,
        shape: Index,
        start: Literal["empty", "zeros", "states"],
        statements: Sequence[Statements],
    ) -> list[str]:
        """Source lines of a function whose statements are made."""
        listed = tuple(arguments.split(", "))
        return self.printer.function(
            PointwiseFunction(
                name,
                listed,
                summary,
                shape,
                start,
                _masked(scope.parameters, scope.used_parameters),
                _masked(scope.states, scope.used_states),
                statements,
                scope.uses_time and "t" in listed,
            )
        )


class Scope:
    """The names inside one function, and which of its arguments it uses."""

    def __init__(self, printer: Printer, parameters: Sequence[str], states: Sequence[str]) -> None:
        self.fresh = Names(printer.reserved)
        self.parameters = [self.fresh(name) for name in parameters]
        self.fresh.taken -= {"u", "x"}  # states are unpacked last and may replace the argument
        self.states = [self.fresh(name) for name in states]
        self.used_parameters: set[int] = set()
        self.used_states: set[int] = set()
        self.uses_time = False


def _masked(names: Sequence[str], used: set[int]) -> list[str]:
    """The names with ``_`` for those not used."""
    return [name if k in used else "_" for k, name in enumerate(names)]


def _operations(text: str) -> int:
    """How many operations a line of source has, roughly: its operators and calls."""
    return sum(text.count(f" {sign} ") for sign in "+-*/") + text.count("(") + text.count("**")


def _as_float(text: str) -> str:
    return f"{text}.0" if text.removeprefix("-").isdigit() else text
