"""What a checked problem holds: its box, how it is shown, and when two problems are equal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import sympy as sp

from rankone.problem.algebra.algebraic import Reduction
from rankone.problem.algebra.mass import MassForm, check_mass
from rankone.problem.expressions.admissible import closed
from rankone.problem.expressions.notation import (
    exact,
    initial_latex,
    initial_texts,
    latex_of,
    named_constants,
    text_of,
)
from rankone.problem.forms import Coordinate, Jump
from rankone.problem.jumps import jump_latex, jump_texts, system_jumps
from rankone.problem.shorthand import Shorthand
from rankone.problem.steady_start import rest_text
from rankone.problem.tables.term_table import TermTable
from rankone.problem.user_events import Event, event_latex, event_texts
from rankone.solvers.outcome import with_unit
from rankone.support.wording import abridged, aligned_equations, count
from rankone.tensors.bases.coordinates import name_of
from rankone.tensors.bases.distributions import scale_of
from rankone.tensors.bases.scales import LINEAR, with_measure, written_scale

_MORE_LATEX = r"& \ldots \text{{ {} more}}"


class ProblemContent:
    """The checked attributes of a :class:`rankone.Problem`, and what follows from them alone."""

    equations: Sequence[sp.Basic]
    time: tuple[sp.Symbol, float, float]
    parameters: Mapping[sp.Symbol, tuple[float, float]]
    initial: Mapping[sp.Expr, Any]
    name: str | None
    jumps: Mapping[Any, Mapping[sp.Expr, Any]] | None
    units: Mapping[Any, str] | None
    tail: float
    correlation: Mapping[Any, float] | None
    events: Sequence[Event]
    constants: Mapping[sp.Symbol, Any] | None
    definitions: Mapping[sp.Expr, Any] | None
    atol: Mapping[Any, float] | None
    distributions: Mapping[str, str]
    unknowns: tuple[sp.Expr, ...]
    table: TermTable | None
    reduction: Reduction | None
    rest: Any
    shorthand: Shorthand
    written: Mapping[str, Any]

    @cached_property
    def residuals(self) -> tuple[sp.Expr, ...]:
        """For each equation its left minus its right side, with constants and definitions put in.

        Checks set them, except of a table of terms.
        """
        put_in = self.shorthand.put_in
        return tuple(closed(put_in(exact(e.lhs - e.rhs))) for e in self._shown())

    @cached_property
    def mass(self) -> MassForm:
        """The residuals as mass matrix times highest derivatives, and the rest; likewise."""
        return check_mass(self.residuals, self.unknowns, self.coordinates)

    @property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """The dimensions of the box: time, then the parameters in the order given."""
        intervals = [self.time, *((symbol, *ends) for symbol, ends in self.parameters.items())]
        return tuple(
            Coordinate(symbol.name, symbol, a, b, self._scales.get(symbol.name, LINEAR))
            for symbol, a, b in intervals
        )

    @cached_property
    def _scales(self) -> dict[str, str]:
        """The scales of parameters that have one other than the linear one."""
        scales = {
            symbol.name: scale_of(self.distributions[symbol.name], lower)
            for symbol, (lower, _) in self.parameters.items()
            if symbol.name in self.distributions
        }
        return {name: scale for name, scale in scales.items() if scale != LINEAR}

    def written_parameters(self) -> dict[sp.Symbol, Any]:
        """The box with distributions as texts, and scales as words."""
        parameters: dict[sp.Symbol, Any] = dict(self.parameters)
        for symbol, ends in self.parameters.items():
            text = self.distributions.get(symbol.name)
            word = written_scale(text)
            parameters[symbol] = (*ends, word) if word else text or ends
        return parameters

    def content(self, plain: bool = False) -> tuple[object, ...]:
        """Everything that two equal problems have in common, perhaps of symbols by name alone."""
        expressions: list[sp.Basic] = [sp.Tuple(*self.residuals), sp.Tuple(*self.unknowns)]
        mappings = self.initial, self.parameters, self.constants, self.definitions
        resets = ((sp.Float(at), reset) for at, reset in (self.jumps or {}).items())
        expressions += [_tuple_of(mapping or {}) for mapping in mappings]
        expressions += [sp.Tuple(at, _tuple_of(reset)) for at, reset in resets]
        expressions += [sp.Tuple(*e.expressions, _tuple_of(e.then or {})) for e in self.events]
        expressions = _in_numbers(expressions)  # the same whether run-time values or written in
        if plain:
            names = {s: sp.Symbol(s.name) for e in expressions for s in e.free_symbols}
            expressions = [expression.xreplace(names) for expression in expressions]
        named = self.units, self.distributions, self.correlation, self.atol
        flags = [
            (e.name, e.direction, e.terminal, e.persistent, e.overlapping) for e in self.events
        ]
        others: list[object] = [dict(mapping or {}) for mapping in named]
        if self.rest is not None:
            others += [self.rest.content(plain)]
        return expressions, others, flags, str(self.time[0]), self.time[1:], self.name, self.tail

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ProblemContent):
            return NotImplemented
        return self is other or self.content() == other.content()

    def __hash__(self) -> int:
        return hash((*_in_numbers(self.residuals), self.unknowns, self.time))

    def __repr__(self) -> str:
        title = "Problem" if self.name is None else f"Problem {self.name!r}"
        unknowns = count(len(self.unknowns), "unknown")
        lines = [f"{title}: {unknowns}, {count(len(self.parameters), 'parameter')}"]
        definitions = (self.written["definitions"] or {}).items()
        lines += [f"  {name_of(symbol)} = {text_of(sp.sympify(e))}" for symbol, e in definitions]
        lines += [f"  {line}" for line in self._equation_texts()]
        starts = self._shown_initial()
        guessed = {
            i for i, u in enumerate(starts) if self.reduction and u in self.reduction.guessed
        }
        at_start = abridged(
            initial_texts(map(name_of, starts), self.time[1], starts.values(), guessed), str
        )
        if self.rest is not None:
            at_start = [f"at the start: {self.rest_text}"]
        units = self.units or {}
        intervals = [
            with_measure(
                with_unit(f"{c.name} in [{c.lower:g}, {c.upper:g}]", units, c.name),
                self.distributions.get(c.name),
            )
            for c in self.coordinates
        ]
        lines += ["  " + ", ".join(at_start), "  " + ", ".join(intervals)]
        constants = (
            with_unit(f"{symbol.name} = {text_of(value)}", units, symbol.name)
            for symbol, value in (self.constants or {}).items()
        )
        lines += [f"  {', '.join(constants)}"] if self.constants else []
        with_units = [name for name in map(name_of, self.initial) if name in units]
        if with_units:
            lines.append("  " + ", ".join(f"{name} in {units[name]}" for name in with_units))
        if self.atol:
            tolerances = (f"{name} to {size:g}" for name, size in self.atol.items())
            lines.append(f"  absolute tolerances: {', '.join(tolerances)}")
        texts = jump_texts(list(self.initial), self._jumps(), self.time[0].name)
        return "\n".join([*lines, *(f"  {text}" for text in (*texts, *event_texts(self.events)))])

    def _repr_latex_(self) -> str:
        written = {**(self.written["definitions"] or {}), **(self.constants or {})}
        lines = [f"{sp.latex(s)} &= {latex_of(sp.sympify(e))}" for s, e in written.items()]
        lines += abridged(self._shown(), latex_of, _MORE_LATEX)
        starts = self._shown_initial()
        if self.rest is None:
            at_start = initial_latex(starts, self.time[1], starts.values())
            lines += abridged(at_start, str, _MORE_LATEX)
        else:
            lines.append(rf"& \text{{at the start: {self.rest_text}}}")
        lines += [
            rf"{sp.latex(c.symbol)} &\in [{c.lower:g}, {c.upper:g}]" for c in self.coordinates
        ]
        lines += jump_latex(list(self.initial), self._jumps(), self.time[0])
        lines += event_latex(self.events)
        return aligned_equations(lines)

    @property
    def rest_text(self) -> str:
        """The steady state at which a problem starts, in words."""
        names = {state: sp.Symbol(name_of(state)) for state in self.initial}
        starts = ((name_of(u), e.xreplace(names)) for u, e in self.initial.items())
        return rest_text(self.written["initial"].conditions, dict(starts))

    def _shown_initial(self) -> dict[sp.Expr, sp.Expr]:
        """The initial values without those that algebraic equations give."""
        solved = self.reduction.solved if self.reduction else {}
        return {state: start for state, start in self.initial.items() if state not in solved}

    def _jumps(self) -> tuple[Jump, ...]:
        """The jumps that were given, in the states as they are written."""
        states = {state: state for state in self.initial}
        return system_jumps(self.jumps or {}, {}, states, self.time)

    def _equation_texts(self) -> list[str]:
        """The equations; those of many texts are not read for that."""
        if self.table is None or not self.table.texts:
            return abridged(self._shown(), text_of)
        rates = [*zip(map(name_of, self.unknowns), self.table.texts, strict=True)]
        time = self.time[0].name
        return abridged(rates, lambda rate: f"d{rate[0]}/d{time} = {' '.join(rate[1].split())}")

    def _shown(self) -> list[sp.Eq]:
        """The equations; an expression that vanishes equals zero."""
        return [
            equation if isinstance(equation, sp.Eq) else sp.Eq(equation, 0, evaluate=False)
            for equation in self.equations
        ]


def _in_numbers(expressions: Sequence[sp.Basic]) -> list[sp.Basic]:
    """Expressions with plain numbers for those that have names."""
    numbers = {constant: constant.value for constant in named_constants(expressions)}
    return [e.xreplace(numbers) for e in expressions] if numbers else [*expressions]


def _tuple_of(mapping: Mapping[sp.Expr, Any]) -> sp.Tuple:
    """The pairs of a mapping as an expression."""
    return sp.Tuple(*(sp.Tuple(key, sp.sympify(value)) for key, value in mapping.items()))
