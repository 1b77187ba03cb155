"""Separated forms: frozen data between the symbolic front end and code generation.

A parametric system ``u' = f(t, p, u)`` is held as the residual ``u' - f`` in separated terms

    coefficient x  a_0(t) a_1(p_1) ... a_d(p_d)  x  monomial in the states  x  test function,

so that every integral of the weak form over the (d + 1)-dimensional box is a product of
one-dimensional integrals (:class:`SeparatedForm`); then as f alone with products of at most two
states, its terms grouped by their parameter factors (:class:`QuadraticSystem`). There are no
algorithms here, and SymPy is imported for type checkers alone.
"""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING

from rankone.solvers.outcome import Role
from rankone.support.errors import (
    SeparationError,
    aligned_equations,
    count,
    html_table,
    latex,
    latex_number,
    number,
    text_table,
)
from rankone.tensors.coordinates import LINEAR

if TYPE_CHECKING:
    import sympy as sp

MOST_KERNEL_STATES = 200
"""States and products up to which methods that need separated terms apply."""
_Table = tuple[str, list[str], list[list[str]]]
"""Summary, header and rows."""


@dataclass(frozen=True, slots=True)
class Coordinate:
    """One dimension of the box: time (always the first) or a parameter, with its scale."""

    name: str
    symbol: sp.Symbol
    lower: float
    upper: float
    scale: str = LINEAR


@dataclass(frozen=True, slots=True)
class State:
    """One scalar function of time.

    Its name is the unknown's, with ``_t`` appended once per time derivative (``x_t``, ``x_tt``);
    the expression is the applied function, its derivative or the product of states, as the user
    writes it. ``atol`` over the relative tolerance adds to the size that errors of it are relative
    to; without one a tiny part of the largest state of the same ``unit`` does, if it has a unit.
    """

    name: str
    expression: sp.Expr
    role: Role = Role.UNKNOWN
    atol: float | None = None
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Jump:
    """States that are reset at a known time, such as a dose.

    ``values`` has for each differential state its value right after that time, in the values of the
    states before, ``x(t)``, and the parameters.
    """

    time: float
    values: tuple[sp.Expr, ...]

    @staticmethod
    def kinds(jumps: Iterable[Jump]) -> dict[tuple[sp.Expr, ...], list[float]]:
        """The times of jumps by their values: a dose repeats."""
        times: dict[tuple[sp.Expr, ...], list[float]] = {}
        for jump in jumps:
            times.setdefault(jump.values, []).append(jump.time)
        return times


def affine_coefficients(
    expression: sp.Expr, parameters: Sequence[sp.Symbol]
) -> tuple[float, ...] | None:
    """The constant and the slopes of an expression that is affine in the parameters."""
    if not expression.is_polynomial(*parameters):
        return None
    slopes = [expression.diff(p) for p in parameters]
    numbers = [expression.subs(dict.fromkeys(parameters, 0)), *slopes]
    return tuple(map(float, numbers)) if all(n.is_number for n in numbers) else None


@dataclass(frozen=True, slots=True)
class EventForm:
    """An event: what crosses zero, in which direction, and what it resets.

    ``when`` and ``then`` are in time, the values of the states before, ``x(t)``, and the
    parameters. ``then`` has a value for each differential state, or is None. ``at`` is the time of
    the event, of the parameters, where it is known beforehand, or None. ``delay`` and ``priority``
    are like ``when``, or None.
    """

    name: str
    when: sp.Expr
    direction: int
    then: tuple[sp.Expr, ...] | None
    terminal: bool
    at: sp.Expr | None = None
    delay: sp.Expr | None = None
    priority: sp.Expr | None = None
    persistent: bool = True
    overlapping: bool = True

    def coefficients(self, parameters: Sequence[sp.Symbol]) -> tuple[float, ...] | None:
        """The constant and the slopes of ``at`` if it is affine in the parameters."""
        return None if self.at is None else affine_coefficients(self.at, parameters)

    @property
    def interrupts(self) -> bool:
        """Whether it may end, reset or divide trajectories; others mark what they pass."""
        return self.terminal or self.then is not None or self.at is not None

    @property
    def expressions(self) -> tuple[sp.Expr, ...]:
        """What it is made of, but for ``at``."""
        extra = (e for e in (self.delay, self.priority) if e is not None)
        return (self.when, *(self.then or ()), *extra)


@dataclass(frozen=True, slots=True)
class ConstraintForms:
    """Expressions of the states that vanish on all trajectories, in time and parameters.

    ``names`` say where each comes from. ``guessed`` are the positions of states whose initial
    values are starting guesses: the constraints determine them.
    """

    names: tuple[str, ...] = ()
    expressions: tuple[sp.Expr, ...] = ()
    guessed: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Factor:
    """A function of one coordinate; factor 0 of every dimension is the constant one."""

    dimension: int
    expression: sp.Expr


@dataclass(frozen=True, slots=True)
class Term:
    """One separated term of an equation, or of an initial condition.

    ``equation`` is the index of its state. The coefficient is exact if it is rational. ``factors``
    has for each dimension the index of the factor; 0 is "one". ``monomial`` has the indices of the
    states multiplied, ascending, repeated for powers; it is empty for a constant. ``derivative`` is
    the order of d/dt on the monomial: 1 for the terms u', 0 for all others.
    """

    equation: int
    coefficient: Fraction | float
    factors: tuple[int, ...]
    monomial: tuple[int, ...] = ()
    derivative: int = 0

    @property
    def size(self) -> Fraction | float:
        """The coefficient without its sign."""
        return -self.coefficient if self.coefficient < 0 else self.coefficient


@dataclass(frozen=True, slots=True)
class GeneralTerm:
    """A term of f in u' = f, or of an initial value, that does not separate.

    Attributes
    ----------
    equation : int
        Index of the state whose equation (or initial value) the term belongs to.
    expression : Expr
        The term as the user would write it.
    initial : bool
        Whether it belongs to the initial value.
    reason : str
        Why it does not separate.
    remedy : str
        What to do about it.
    origin : int or None
        Number, from 1, of the user's equation it comes from, as far as it comes from one.
    """

    equation: int
    expression: sp.Expr
    initial: bool
    reason: str
    remedy: str
    origin: int | None = None

    @property
    def error(self) -> SeparationError:
        """The error for methods that need separated terms."""
        return SeparationError(
            self.reason, equation=self.origin, term=self.expression, remedy=self.remedy
        )


@dataclass(frozen=True, slots=True, repr=False)
class SeparatedForm:
    """A parametric first-order system as a sum of separated terms.

    Attributes
    ----------
    coordinates : tuple of Coordinate
        Time first, then the parameters in the order the user gave.
    states : tuple of State
        The unknowns in the user's order, then the derivatives that became states.
    factors : tuple of tuple of Factor
        For each dimension its distinct factors; the first of each is the constant one.
    terms : tuple of Term
        The residual u' - f = 0, all equations.
    initial : tuple of Term
        The initial values: ``equation`` is the state, ``monomial`` is empty, the time factor one.
    general : sequence of GeneralTerm
        Terms that do not separate; without any, ``terms`` and ``initial`` are complete.
    jumps : tuple of Jump
        By time; they need not separate.
    """

    coordinates: tuple[Coordinate, ...]
    states: tuple[State, ...]
    factors: tuple[tuple[Factor, ...], ...]
    terms: tuple[Term, ...]
    initial: tuple[Term, ...]
    general: Sequence[GeneralTerm] = ()
    jumps: tuple[Jump, ...] = ()

    def require_separated(self) -> None:
        """Raise the SeparationError of the first general term, if there is one."""
        if self.general:
            raise self.general[0].error

    def require_separated_rates(self) -> None:
        """The same; initial values may be general."""
        for term in self.general:
            if not term.initial:
                raise term.error

    def __str__(self) -> str:
        return "\n".join([text_table(*self._table()), *self._general_lines()])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        general = html.escape("\n".join(self._general_lines()))
        return html_table(*self._table()) + (f"<pre>{general}</pre>" if general else "")

    def _repr_latex_(self) -> str:
        """Each equation, and each initial value, as a sum of separated products."""
        clock = self.coordinates[0]
        lines = []
        for i in range(len(self.states)):
            general = [rf"- \left({text}\right)" for text in self._latex_general(i, initial=False)]
            lines.append(f"{' '.join([self._latex_sum(self.terms, i), *general])} &= 0")
        for i, state in enumerate(self.states):
            at_start = rf"\Big|_{{{latex(clock.symbol)} = {clock.lower:g}}}"
            general = [rf"+ {text}" for text in self._latex_general(i, initial=True)]
            start = " ".join([self._latex_sum(self.initial, i), *general]).removeprefix("0 + ")
            lines.append(f"{self._latex_state(state)} {at_start} &= {start}")
        return aligned_equations(lines)

    def _general_lines(self) -> list[str]:
        """The general terms, one a line under a heading."""
        start = f"({self.coordinates[0].lower:g})"
        lines = [
            f"  {self.states[term.equation].name}{start if term.initial else ''}: {term.reason}"
            for term in self.general
        ]
        return ["General terms, which do not separate:", *lines] if lines else []

    def _latex_general(self, equation: int, *, initial: bool) -> list[str]:
        return [
            latex(term.expression)
            for term in self.general
            if term.equation == equation and term.initial == initial
        ]

    def _table(self) -> _Table:
        counts = [
            count(len(self.states), "equation"),
            count(len(self.terms), "term"),
            *([count(len(self.general), "general term")] if self.general else []),
            count(len(self.coordinates), "dimension"),
            count(sum(len(distinct) - 1 for distinct in self.factors), "factor"),
        ]
        clock, *parameters = (c.name for c in self.coordinates)
        header = ["equation", "coefficient", "monomial", clock, *parameters]
        start = f"({self.coordinates[0].lower:g})"
        rows = [
            [
                self.states[term.equation].name + suffix,
                number(term.coefficient),
                f"d{text}/d{clock}" if term.derivative else text,
                *factor_texts(self.factors, term.factors),
            ]
            for terms, suffix in ((self.terms, ""), (self.initial, start))
            for term in terms
            for text in [monomial_text(self.states, term.monomial)]
        ]
        return f"Separated form: {', '.join(counts)} (residual u' - f = 0)", header, rows

    def _latex_sum(self, terms: Sequence[Term], equation: int) -> str:
        products = (self._latex_term(term) for term in terms if term.equation == equation)
        return " ".join(products).removeprefix("+ ") or "0"

    def _latex_term(self, term: Term) -> str:
        """The term with its sign in front."""
        size = latex_number(term.size)
        factors = [
            rf"\left[{latex(distinct[i].expression)}\right]"
            for distinct, i in zip(self.factors, term.factors, strict=True)
            if i
        ]
        if term.derivative:
            factors.append(rf"\frac{{d}}{{d {latex(self.coordinates[0].symbol)}}}")
        for i, power in sorted(Counter(term.monomial).items()):
            raised = f"^{{{power}}}" if power > 1 else ""
            factors.append(f"{{{self._latex_state(self.states[i])}}}{raised}")
        if size != "1" or not factors:
            factors.insert(0, size)
        return " ".join(["-" if term.coefficient < 0 else "+", *factors])

    def _latex_state(self, state: State) -> str:
        """A state without its argument."""
        time = latex(self.coordinates[0].symbol)
        return latex(state.expression).replace(rf"{{\left({time} \right)}}", "")


@dataclass(frozen=True, slots=True)
class Group:
    """Terms of degree at most two that share their parameter factors, and so a contraction.

    ``signature`` is for each parameter the factor's row; 0 is one. Quadratic monomials ``x_a x_b``
    are evaluated as ``x_a`` times a contraction of ``x_b``: ``paired`` are the second states b,
    ``blocks`` for each of them the first states a, ascending.
    """

    index: int
    signature: tuple[int, ...]
    constant: tuple[Term, ...]
    linear: tuple[Term, ...]
    quadratic: tuple[Term, ...]
    paired: tuple[int, ...]
    blocks: tuple[tuple[int, ...], ...]

    @property
    def by_degree(self) -> dict[str, tuple[Term, ...]]:
        """The terms by the name of their degree."""
        return {"constant": self.constant, "linear": self.linear, "quadratic": self.quadratic}

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms of all degrees."""
        return (*self.constant, *self.linear, *self.quadratic)

    @property
    def monomials(self) -> tuple[tuple[int, int], ...]:
        """Quadratic monomials (a, b), b paired, in the order they are evaluated."""
        return tuple(
            (a, b) for b, block in zip(self.paired, self.blocks, strict=True) for a in block
        )


@dataclass(frozen=True, repr=False)
class QuadraticSystem:
    """The right-hand side f of ``u' = f``, as it is and with products of at most two states.

    Attributes
    ----------
    coordinates, factors
        As in the separated form.
    states : tuple of State
        The differential states, then the auxiliary ones, which are products.
    rhs : tuple of Term
        The terms of f, of any degree, in the differential states.
    products : tuple of (int, int)
        For each auxiliary state the states multiplied.
    groups : tuple of Group
        The terms of the quadratic system: f of every differential state, then ``s_a s_b - w`` of
        every product.
    initial : tuple of Term
        The initial values of the differential states.
    coupled : tuple of GeneralTerm
        Parts of initial values that do not separate.
    jumps : tuple of Jump
        By time.
    """

    coordinates: tuple[Coordinate, ...]
    states: tuple[State, ...]
    factors: tuple[tuple[Factor, ...], ...]
    rhs: tuple[Term, ...]
    products: tuple[tuple[int, int], ...]
    groups: tuple[Group, ...]
    initial: tuple[Term, ...]
    coupled: tuple[GeneralTerm, ...] = ()
    jumps: tuple[Jump, ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all states."""
        return tuple(state.name for state in self.states)

    @property
    def has_kernels(self) -> bool:
        """Whether there are operators over states and time: not for very many states."""
        return len(self.states) <= MOST_KERNEL_STATES

    @cached_property
    def differential(self) -> tuple[State, ...]:
        """The states with a differential equation: all but the auxiliary ones."""
        return tuple(state for state in self.states if state.role is not Role.AUXILIARY)

    @cached_property
    def terms(self) -> tuple[Term, ...]:
        """All terms of the groups."""
        return tuple(term for group in self.groups for term in group.terms)

    @cached_property
    def rates(self) -> tuple[str, ...]:
        """The left side of each equation as text: ``x'``, or ``x*x - w0``, which vanishes."""
        rates = (f"{state.name}'" for state in self.differential)
        return (*rates, *(f"{product} - {name}" for name, product in self._auxiliary))

    @cached_property
    def definitions(self) -> tuple[str, ...]:
        """The auxiliary states as text: ``w0 = x*x``."""
        return tuple(f"{name} = {product}" for name, product in self._auxiliary)

    @property
    def _auxiliary(self) -> list[tuple[str, str]]:
        """Name and product of each auxiliary state."""
        auxiliary = (state.name for state in self.states if state.role is Role.AUXILIARY)
        products = (f"{self.names[a]}*{self.names[b]}" for a, b in self.products)
        return list(zip(auxiliary, products, strict=True))

    def __str__(self) -> str:
        return text_table(*self._table())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html_table(*self._table())

    def _table(self) -> _Table:
        states, terms = count(len(self.states), "state"), count(len(self.terms), "term")
        auxiliary = f" ({', '.join(self.definitions)})" if self.products else ""
        in_groups = f"{terms} in {count(len(self.groups), 'group')}"
        summary = f"Quadratic system: {states}{auxiliary}, {in_groups} (u' = f)"
        clock, *parameters = (c.name for c in self.coordinates)
        header = ["group", *parameters, "equation", "coefficient", "monomial", clock]
        rows = [
            [
                str(group.index),
                *factor_texts(self.factors, term.factors)[1:],
                self.names[term.equation],
                number(term.coefficient),
                monomial_text(self.states, term.monomial),
                factor_texts(self.factors, term.factors)[0],
            ]
            for group in self.groups
            for term in group.terms
        ]
        return summary, header, rows


def factor_texts(factors: Sequence[Sequence[Factor]], rows: Sequence[int]) -> list[str]:
    """Text of one factor for each dimension."""
    return [str(distinct[i].expression) for distinct, i in zip(factors, rows, strict=True)]


def monomial_text(states: Sequence[State], monomial: Sequence[int]) -> str:
    """``x**2*y``; one for a constant."""
    powers = sorted(Counter(monomial).items())
    return "*".join(states[i].name + (f"**{k}" if k > 1 else "") for i, k in powers) or "1"
