"""The checks of a problem with fields, and all that follows from them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType

import sympy as sp

from rankone.problem.box import (
    check_correlation,
    check_parameters,
    check_time,
    check_tolerances,
    check_units,
)
from rankone.problem.checked import CheckedProblem, warn_of_unused
from rankone.problem.equations import (
    Symbols,
    check_names,
)
from rankone.problem.expressions.notation import text_of
from rankone.problem.field_events import field_events
from rankone.problem.field_rates import State, check_rates, field_equations, solved_rates
from rankone.problem.field_values import initial_fields, mass_matrices
from rankone.problem.fields import (
    Field,
    Operator,
    size_of,
)
from rankone.problem.shorthand import Shorthand, check_apart, check_shorthand
from rankone.problem.steady_start import SteadyState
from rankone.problem.user_events import event_latex, event_texts, warn_of_late
from rankone.support.errors import (
    ProblemError,
    aligned_equations,
    count,
)
from rankone.tensors.coordinates import name_of


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
        equations = field_equations(self.written["equations"], time[0])
        rates, unknowns = solved_rates(equations, time, shorthand)
        states = [*rates]
        named = [(name_of(state), state) for state in states]
        check_names(named, box, time[0], shorthand.owners)
        scalars = tuple(state for state in states if not isinstance(state, Field))
        symbols = Symbols(time, tuple(box), scalars, states, shorthand)
        check_rates(rates, symbols, len(equations))
        initial = initial_fields(self.initial, rates, symbols)
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
            masses=MappingProxyType(mass_matrices(self.mass, rates, unknowns)),
            jumps=MappingProxyType({}),
            events=field_events(self.events, self.jumps, rates, symbols),
        )
        self._keep(mass=MappingProxyType(dict(self.mass or {})))
        of_events = [expression for event in self.events for expression in event.expressions]
        used = sp.Tuple(*rates.values(), *initial.values(), *of_events).free_symbols
        warn_of_late(self.events, box, time)
        warn_of_unused(box, used)

    def _refuse_unsupported(self) -> None:
        """Raise for what fields do not take."""
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
        expressions += [
            sp.Tuple(*event.expressions, *(sp.Tuple(*pair) for pair in (event.then or {}).items()))
            for event in self.events
        ]
        box = sp.Tuple(*(sp.Tuple(symbol, *ends) for symbol, ends in self.parameters.items()))
        named = (self.units, self.distributions, self.correlation, self.atol)
        others = [dict(mapping or {}) for mapping in named]
        flags = [(event.name, event.direction, event.terminal) for event in self.events]
        return (
            expressions,
            box,
            others,
            flags,
            str(self.time[0]),
            self.time[1:],
            self.name,
            self.tail,
        )

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
        noun = "entry" if entries == "1" else "entries"
        kinds = [f"{count(len(fields), 'field')} of {entries} {noun}"]
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
        lines += ["  " + ", ".join(self._initial_texts()), *self._closing_lines()]
        return "\n".join([*lines, *(f"  {text}" for text in event_texts(self.events))])

    def _repr_latex_(self) -> str:
        lines = [
            rf"{sp.latex(equation.lhs)} &= {sp.latex(equation.rhs)}" for equation in self.equations
        ]
        lines += [
            rf"{sp.latex(c.symbol)} &\in [{c.lower:g}, {c.upper:g}]" for c in self.coordinates
        ]
        return aligned_equations([*lines, *event_latex(self.events)])
