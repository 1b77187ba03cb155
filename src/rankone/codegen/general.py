"""The generated module of a system that does not separate: pointwise functions alone.

It has the names that sampling trajectories needs: ``rhs``, ``jacobian``, ``initial``, and the known
functions of one coordinate, ``time_factors`` and ``parameter_factors``, which say where to look
closely. The kernels of the separated form are missing; ``SEPARATED`` says so.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Protocol

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.codegen.definitions import constants, cut_table, definitions, module_source
from rankone.codegen.derivatives import Differentiator
from rankone.codegen.events import event_functions, moving_switches, parameter_surfaces
from rankone.codegen.factors import coordinate_functions
from rankone.codegen.gaps import Named, gap_functions, gap_tables
from rankone.codegen.header import opening
from rankone.codegen.jumps import jump_function, jump_table, jumped_values, jumps_text
from rankone.codegen.names import Names
from rankone.codegen.pointwise import Index, mask, shape_line
from rankone.codegen.printer import common_subexpressions, numpy_text
from rankone.codegen.text import assignment, docstring, paragraph, unpacking
from rankone.expressions.admissible import known_functions
from rankone.expressions.notation import plain_text
from rankone.expressions.stable import stable
from rankone.ir.forms import Coordinate, Jump, State
from rankone.support.errors import ProblemError, SeparationError
from rankone.support.wording import number

__all__ = ["ExplicitSystem", "general_equation_texts", "general_source"]


class ExplicitSystem(Protocol):
    """An explicit first-order system u' = f(t, p, u)."""

    @property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """Time, then the parameters."""

    @property
    def states(self) -> tuple[State, ...]:
        """The states."""

    @property
    def functions(self) -> tuple[sp.Expr, ...]:
        """The states as functions of time."""

    @property
    def rhs(self) -> tuple[sp.Expr, ...]:
        """For each state its derivative."""

    @property
    def initial(self) -> tuple[sp.Expr, ...]:
        """For each state its initial value."""

    @property
    def origins(self) -> tuple[int | None, ...]:
        """For each state the number of the user's equation."""

    @property
    def jumps(self) -> tuple[Jump, ...]:
        """Jumps after the start, by time."""


def general_source(system: ExplicitSystem, title: str | None = None) -> str:
    """Python source of the module for a system that does not separate.

    Parameters
    ----------
    system : FirstOrderSystem
    title : str, optional
        First line of the module's docstring.

    Raises
    ------
    ProblemError
        If a function cannot be written with NumPy or SciPy, or has no derivative that can.
    """
    writer = _Writer(system)
    functions = [writer.rhs(), writer.jacobian(), writer.initial(), _with_products(writer.n)]
    functions += [writer.moving_cuts(), writer.surfaces(), writer.events()]
    functions.append(jump_function(system.states, system.coordinates, system.jumps))
    rates = writer.named_rates()
    functions += gap_functions(rates, system.jumps, system.states, system.coordinates)
    everything = [*system.rhs, *system.initial, *jumped_values(system.jumps)]
    known = known_functions(system.coordinates, everything)
    factors = [(sp.S.One, *found) for found in known]
    blocks = [
        *definitions([*everything, *writer.printed]),
        *coordinate_functions(system.coordinates, factors),
        *functions,
    ]
    names = [state.name for state in system.states]
    tables = constants(False, names, len(names), (), system.coordinates)
    tables += cut_table(system.coordinates, everything)
    tables += [*jump_table(system.jumps), *gap_tables(rates, system.jumps, system.states)]
    tables += writer.counts
    return module_source(partial(_header, system, writer.operations, title), tables, blocks)


def general_equation_texts(system: ExplicitSystem) -> list[str]:
    """Equations, solved for the derivatives, and initial values as people write them."""
    names = {u: sp.Symbol(s.name) for u, s in zip(system.functions, system.states, strict=True)}
    start = number(system.coordinates[0].lower)
    texts = []
    for left, expressions in (("{}'", system.rhs), (f"{{}}({start})", system.initial)):
        for state, expression in zip(system.states, expressions, strict=True):
            text = plain_text(expression.xreplace(names))
            texts.append(f"{left.format(state.name)} = {text}")
    return texts + jumps_text(system.states, system.coordinates, system.jumps)


def _header(
    system: ExplicitSystem, operations: Mapping[str, int], title: str | None, scipy: bool
) -> list[str]:
    texts = general_equation_texts(system)
    lines = opening(title, "Right-hand side", system.states, system.coordinates, texts, scipy)
    counted = (f"{name} {count}" for name, count in operations.items())
    lines += ["", "It does not separate: pointwise functions alone"]
    return [*lines, *paragraph(f"Operations: {', '.join(counted)}")]


def _with_products(n: int) -> list[str]:
    return [
        "def with_products(u):",
        *docstring([f"All states, ({n}, ...): there are no products to append."]),
        "    return np.array(u, dtype=float)",
    ]


_OF_P = "    shape = np.broadcast_shapes(*map(np.shape, p)) or np.shape(p)[1:]"
"""The shape of values at p."""


class _Writer:
    """Writes the pointwise functions over real symbols, which SymPy differentiates as such."""

    def __init__(self, system: ExplicitSystem) -> None:
        self.n, self.system = len(system.states), system
        self.states = [sp.Symbol(state.name, real=True) for state in system.states]
        self.coordinates = [sp.Symbol(c.name, real=True) for c in system.coordinates]
        real = dict(zip(system.functions, self.states, strict=True))
        symbols = {c.symbol: s for c, s in zip(system.coordinates, self.coordinates, strict=True)}
        self.real = {**real, **symbols}
        self.operations: dict[str, int] = {}
        places = enumerate(zip(system.rhs, system.origins, strict=True))
        self.f = [self._checked(f, f"{self._name(i)}'", number) for i, (f, number) in places]
        self.start = [
            self._checked(value, f"the initial value of {self._name(i)}", None)
            for i, value in enumerate(system.initial)
        ]
        self.printed: list[sp.Expr] = []
        self.counts: list[str] = []

    def _name(self, i: int) -> str:
        return self.system.states[i].name

    def named_rates(self) -> list[Named]:
        """The rates with what they are and the numbers of the user's equations."""
        system = self.system
        pairs = zip(system.origins, system.rhs, strict=True)
        return [(f"{self._name(i)}'", origin, f) for i, (origin, f) in enumerate(pairs)]

    def _checked(self, expression: sp.Expr, what: str, origin: int | None) -> sp.Expr:
        """The expression in real symbols; an error that says where, if it cannot be written."""
        for applied in sorted(expression.atoms(AppliedUndef), key=sp.default_sort_key):
            if applied not in self.real:
                raise ProblemError(f"{applied} in {what} is unknown", equation=origin, term=applied)
        real = stable(expression.xreplace(self.real))
        try:
            numpy_text(real, {})
        except SeparationError as error:
            message = error.message
            raise ProblemError(
                f"{what}: {message} or SciPy",
                equation=origin,
                term=error.term,
                remedy="rewrite it with functions they have, or give it with its derivative: "
                "rankone.function(name, value, derivative)",
            ) from None
        return real

    def rhs(self) -> list[str]:
        n = self.n
        entries: dict[Index, sp.Expr] = {(i,): f for i, f in enumerate(self.f)}
        return [
            "def rhs(t, u, p):",
            *docstring([f"Right-hand side f(t, u, p) at u ({n}, ...): shape ({n}, ...)."]),
            *self._body("rhs", f"np.empty(({n}, *shape))", entries, self._derivative),
        ]

    def jacobian(self) -> list[str]:
        n = self.n
        entries: dict[Index, sp.Expr] = {}
        rules = [Differentiator(symbol) for symbol in self.states]
        for i, f in enumerate(self.f):
            for j, derivative in enumerate(rules):
                try:
                    slope = derivative(f)
                except ProblemError as error:
                    message = error.message
                    origin = self.system.origins[i]
                    raise ProblemError(
                        message, equation=origin, term=error.term, remedy=error.remedy
                    ) from None
                if slope != 0:
                    entries[(i, j)] = slope
        return [
            "def jacobian(t, u, p):",
            *docstring([f"Jacobian df/du at u ({n}, ...): shape ({n}, {n}, ...)."]),
            *self._body("jacobian", f"np.zeros(({n}, {n}, *shape))", entries, self._derivative),
        ]

    def initial(self) -> list[str]:
        entries: dict[Index, sp.Expr] = {(i,): value for i, value in enumerate(self.start)}
        return [
            "def unseparated_initial(p):",
            *docstring([f"Initial values at p (d, ...): shape ({self.n}, ...)."]),
            *self._body("initial", f"np.empty(({self.n}, *shape))", entries, self._name, _OF_P),
        ]

    def moving_cuts(self) -> list[str]:
        """Where functions of time and parameters switch; nothing if there are none."""
        found = moving_switches(self.system.coordinates, self.system.rhs)
        self.counts += [f"N_MOVING_CUTS = {len(found)}"] if found else []
        about = "Times at which functions of time and of p (d, ...) switch: ({}, ...)."
        return self._vector("moving_cuts", "p", found, about, _OF_P)

    def surfaces(self) -> list[str]:
        """Where functions of several parameters are narrow; nothing if there are none."""
        system = self.system
        everything = [*system.rhs, *system.initial, *jumped_values(system.jumps)]
        found = parameter_surfaces(system.coordinates, everything)
        self.counts += [f"N_PARAMETER_SURFACES = {len(found)}"] if found else []
        about = "Zero where functions of p (d, ...) switch or peak: ({}, ...)."
        return self._vector("parameter_surfaces", "p", found, about, _OF_P)

    def events(self) -> list[str]:
        """Where functions of the states switch or are narrow; nothing if there are none."""
        time = self.system.coordinates[0].symbol
        found = event_functions(time, self.system.rhs)
        if any(found):
            self.counts.append(f"STATE_SURFACES = {tuple(map(len, found))}  # peaks, kinks, steps")
        about = f"Zero where functions of u ({self.n}, ...) switch or peak: ({{}}, ...)."
        return self._vector("state_surfaces", "t, u, p", list(itertools.chain(*found)), about)

    def _vector(
        self,
        function: str,
        arguments: str,
        expressions: Sequence[sp.Expr],
        about: str,
        shape: str | None = None,
    ) -> list[str]:
        """A function with expressions as the entries of its value; nothing if there are none."""
        entries: dict[Index, sp.Expr] = {
            (i,): e.xreplace(self.real) for i, e in enumerate(expressions)
        }
        if not entries:
            return []
        allocation = f"np.empty(({len(entries)}, *shape))"
        return [
            f"def {function}({arguments}):",
            *docstring([about.format(len(entries))]),
            *self._body(function, allocation, entries, shape=shape),
        ]

    def _derivative(self, row: int, *column: int) -> str:
        """What an entry of the rates, or of their Jacobian, means."""
        rate = f"{self._name(row)}'"
        return f"d({rate})/d{self._name(column[0])}" if column else rate

    def _body(
        self,
        function: str,
        allocation: str,
        entries: Mapping[Index, sp.Expr],
        meaning: Callable[..., str] | None = None,
        shape: str | None = None,
    ) -> list[str]:
        """Statements that compute the entries of an array, from the arguments to the return."""
        names = Names(["np", "special", "t", "u", "p", "shape", "out"])
        own = [names(c.name) for c in self.system.coordinates[1:]]
        names.taken -= {"u"}  # states are unpacked last and may replace the argument
        local = [names(state.name) for state in self.system.states]
        written = dict(zip(self.coordinates, ["t", *own], strict=True))
        written |= dict(zip(self.states, local, strict=True))
        expressions = list(entries.values())
        self.printed += expressions
        used = set().union(*(e.free_symbols for e in expressions)) if expressions else set()
        shared, texts = common_subexpressions(expressions, written, names.numbered("c"))
        self.operations[function] = sum(
            _operations(text) for text in (*(text for _, text in shared), *texts)
        )
        lines = [shape or shape_line("u", self.n, len(own))]
        if self.coordinates[0] in used:
            lines.append("    t = np.asarray(t, dtype=float)")
        lines += unpacking(mask(own, _places(self.coordinates[1:], used)), "p")
        lines += unpacking(mask(local, _places(self.states, used)), "u")
        for name, text in shared:
            lines += assignment(name, [text])
        lines.append(f"    out = {allocation}")
        for index, text in zip(entries, texts, strict=True):
            target = f"out[{', '.join(map(str, index))}]"
            lines += assignment(target, [_as_float(text)], meaning(*index) if meaning else "")
        return [*lines, "    return out"]


def _places(symbols: Sequence[sp.Symbol], used: set[sp.Symbol]) -> list[int]:
    return [k for k, symbol in enumerate(symbols) if symbol in used]


def _operations(text: str) -> int:
    """How many operations a line of generated source has, roughly: its operators and calls."""
    return sum(text.count(f" {sign} ") for sign in "+-*/") + text.count("(") + text.count("**")


def _as_float(text: str) -> str:
    return f"{text}.0" if text.removeprefix("-").isdigit() else text
