"""The checks of a problem's arguments, what follows from them, and how it is shown."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import sympy as sp

from rankone.problem import user_events
from rankone.problem.algebra import algebraic as consistency
from rankone.problem.algebra import term_table
from rankone.problem.algebra.algebraic import Reduction, has_constraints, reduced
from rankone.problem.algebra.mass import MassForm, check_mass
from rankone.problem.algebra.tabulated import tabulated_equations
from rankone.problem.algebra.term_table import TermTable
from rankone.problem.box import (
    Box,
    Time,
    check_correlation,
    check_parameters,
    check_time,
    check_tolerances,
    check_units,
)
from rankone.problem.equations import (
    Symbols,
    algebraic_unknowns,
    check_equations,
    check_initial,
    check_lengths,
    check_names,
    check_symbols,
    check_unknowns,
    listed_equations,
    state_expressions,
    state_of,
)
from rankone.problem.expressions.admissible import closed
from rankone.problem.expressions.conditions import rate_of
from rankone.problem.expressions.notation import (
    exact,
    initial_latex,
    initial_texts,
    latex_of,
    named_constants,
    text_of,
)
from rankone.problem.forms import Coordinate, Jump
from rankone.problem.functions import check_distinct
from rankone.problem.jumps import check_jumps, jump_latex, jump_texts, moving_impulses, system_jumps
from rankone.problem.shorthand import (
    Shorthand,
    check_apart,
    check_shorthand,
    check_symbols_as_unknowns,
)
from rankone.problem.steady_start import (
    SteadyState,
    check_autonomous,
    conditioned,
    coupled_by,
    rest_text,
    with_decisive,
)
from rankone.problem.user_events import Event, event_latex, event_texts
from rankone.solvers.outcome import with_unit
from rankone.support.errors import (
    ProblemError,
    RankoneWarning,
    abridged,
    aligned_equations,
    count,
    is_line,
    quote,
    shown,
    warn,
)
from rankone.tensors.coordinates import LINEAR, name_of, with_measure, written_scale
from rankone.tensors.distributions import scale_of

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
    mass: Mapping[Any, Any] | None
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
    def mass_form(self) -> MassForm:
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
        lines += ["  " + ", ".join(at_start), *self._closing_lines()]
        texts = jump_texts(list(self.initial), self._jumps(), self.time[0].name)
        return "\n".join([*lines, *(f"  {text}" for text in (*texts, *event_texts(self.events)))])

    def _closing_lines(self) -> list[str]:
        """The lines of a representation from the box on: constants, units and tolerances."""
        units = self.units or {}
        intervals = [
            with_measure(
                with_unit(f"{c.name} in [{c.lower:g}, {c.upper:g}]", units, c.name),
                self.distributions.get(c.name),
            )
            for c in self.coordinates
        ]
        lines = ["  " + ", ".join(intervals)]
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
        return lines

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


# -----------------------------------------------------------------------------
# The checks of a problem's arguments, and all that follows from them.


_Tabulated = tuple[term_table.TermTable, dict[sp.Expr, sp.Expr], Shorthand]
"""A table, the initial values of its states, and its constants."""


def warn_of_unused(parameters: Iterable[sp.Symbol], used: Set[sp.Basic]) -> None:
    """Warn of parameters that are not among the symbols used."""
    for symbol in parameters:
        if symbol not in used:
            warn(
                f"parameter {quote(symbol)} appears nowhere in the problem",
                remedy="remove it from `parameters`",
            )


class CheckedProblem(ProblemContent):
    """What checks the arguments of a :class:`rankone.Problem` and sets its other attributes."""

    shorthand: Shorthand

    def _check(self) -> None:
        """Validate what was given, and set what follows from it."""
        self._check_title()
        if self.mass is not None:
            raise ProblemError(
                f"`mass` is {shown(self.mass)}, and the problem has no fields",
                term=self.mass,
                remedy="write masses into the equations, or declare vectors by rankone.field",
            )
        time = check_time(self.time)
        box, distributions = check_parameters(self.parameters, time[0], self.tail)
        if self._is_plain and not self.constants:
            self._keep(equations=tabulated_equations(self.written["equations"], time[0], box))
        if (kept := self._tabulated(time[0], box)) is not None:
            self._keep_table(*kept, time, box, distributions)
            return
        equations = listed_equations(self.written["equations"])
        shorthand, residuals = self._put_in(equations, box, time[0])
        symbols = self._symbols(residuals, box, time, shorthand)
        declared = [*box, *shorthand.symbols]
        conditions = self._conditions(residuals, symbols)
        moving, used = conditions.pop("moving"), conditions.pop("used")
        self._keep(
            equations=equations,
            time=time,
            parameters=MappingProxyType(box),
            distributions=MappingProxyType(distributions),
            correlation=MappingProxyType(check_correlation(self.correlation, box)),
            constants=MappingProxyType(dict(shorthand.constants)),
            definitions=MappingProxyType(dict(shorthand.definitions)),
            shorthand=shorthand,
            **self._named(time[0], declared, symbols.states),
            unknowns=symbols.unknowns,
            residuals=tuple(residuals),
            **conditions,
        )
        if isinstance(self.written["initial"], SteadyState):
            rest = self._under_conditions(self.written["initial"], symbols)
            self._keep(rest=rest)
            used |= sp.Tuple(*rest.residuals, *rest.initial.values()).free_symbols
        warn_of_unused(symbols.parameters, used)
        self._determine_rates(symbols, moving)
        user_events.warn_of_late(self.events, box, time)

    def _check_title(self) -> None:
        if self.name is not None and not is_line(self.name):
            message = f"the name is {shown(self.name)}, not text in one line"
            raise ProblemError(message, term=self.name, remedy="give a title")

    def _determine_rates(self, symbols: Symbols, moving: int) -> None:
        """Set the mass matrix, and what else tells the rates; ``moving`` jumps are events."""
        if has_constraints(self.residuals, symbols.unknowns, symbols.time[0]):
            self._reduce(symbols.states)
            return
        self._keep(mass_form=check_mass(self.residuals, symbols.unknowns, self.coordinates))
        self._take_out_impulses(symbols, moving)
        self._take_out_rates()

    @property
    def _is_plain(self) -> bool:
        """Whether there are equations, constants and initial values alone."""
        besides = self.jumps, self.events, self.definitions
        return not any(map(bool, besides)) and not isinstance(self.initial, SteadyState)

    def _tabulated(self, time: sp.Symbol, box: Box) -> _Tabulated | None:
        """The table of terms that the equations are, with numbers for constants; or None.

        Whatever else there is needs the equations as expressions, and so does what is not valid.
        """
        if not isinstance(self.equations, term_table.TabulatedEquations) or not self._is_plain:
            return None
        if self.constants and len(self.equations) < term_table.FEWEST_TABULATED:
            return None  # run-time values of what is compiled
        shorthand = check_shorthand(self.written["constants"], None, time)
        check_apart(shorthand, box, self.initial)
        shorthand = replace(shorthand, decisive=frozenset(shorthand.constants))
        table = self.equations.table.with_numbers(shorthand.constants)
        names = [*box, *shorthand.constants]
        if table is None or not table.fits(time, box):
            return None
        if not term_table.has_distinct_names(table.states, time, names):
            return None
        initial = table.start(self.initial, box, shorthand.constants)
        return None if initial is None else (table, initial, shorthand)

    def _keep_table(
        self,
        table: term_table.TermTable,
        initial: dict[sp.Expr, sp.Expr],
        shorthand: Shorthand,
        time: Time,
        box: Box,
        distributions: dict[str, str],
    ) -> None:
        """Set what follows from a table of terms, without the equations."""
        starts = set().union(*(start.free_symbols for start in initial.values()))
        warn_of_unused(box, table.symbols | starts)
        self._keep(
            time=time,
            parameters=MappingProxyType(box),
            distributions=MappingProxyType(distributions),
            correlation=MappingProxyType(check_correlation(self.correlation, box)),
            constants=MappingProxyType(dict(shorthand.constants)),
            definitions=MappingProxyType({}),
            shorthand=shorthand,
            **self._named(time[0], [*box, *shorthand.constants], table.states),
            unknowns=table.states[: len(self.equations)],
            table=table,
            initial=MappingProxyType(initial),
            jumps=MappingProxyType({}),
            events=(),
        )

    def _named(
        self, time: sp.Symbol, declared: Sequence[sp.Expr], states: Sequence[sp.Expr]
    ) -> dict[str, Any]:
        """Units and absolute tolerances by name."""
        return {
            "units": MappingProxyType(check_units(self.units, time, declared, states)),
            "atol": MappingProxyType(check_tolerances(self.atol, states, time)),
        }

    def _keep(self, **attributes: Any) -> None:
        """Set attributes; from outside they are frozen."""
        for name, attribute in attributes.items():
            object.__setattr__(self, name, attribute)

    def _put_in(
        self, equations: Sequence[sp.Basic], box: Box, time: sp.Symbol
    ) -> tuple[Shorthand, list[sp.Expr]]:
        """Constants and definitions, and the residuals of the equations with these put in."""
        shorthand = check_shorthand(self.written["constants"], self.written["definitions"], time)
        check_apart(shorthand, box, self.initial)
        check_symbols_as_unknowns(equations, [*box, *shorthand.symbols], self.initial, time)
        arguments = {**self.written, "equations": equations}
        shorthand = with_decisive(shorthand, arguments)
        residuals = check_equations(equations, time, shorthand)
        if coupled := coupled_by(residuals):
            shorthand = with_decisive(shorthand, arguments, coupled)
            residuals = check_equations(equations, time, shorthand)
        return shorthand, [closed(residual) for residual in residuals]

    def _symbols(
        self, residuals: Sequence[sp.Expr], box: Box, time: Time, shorthand: Shorthand
    ) -> Symbols:
        """The unknowns and states of the residuals, and what else expressions may name."""
        unknowns = check_unknowns(residuals, self.initial, time[0])
        states = state_expressions(residuals, unknowns, time[0])
        named_states = [(name_of(state), state) for state in states]
        check_names(named_states, box, time[0], shorthand.owners)
        constrained = has_constraints(residuals, unknowns, time[0])
        highest = {rate_of(state, time[0]) for state in states} - {*states}
        rates = () if constrained else tuple(sorted(highest, key=sp.default_sort_key))
        symbols = Symbols(time, tuple(box), unknowns, states, shorthand, rates)
        check_symbols(residuals, symbols)
        return symbols

    def _conditions(self, residuals: Sequence[sp.Expr], symbols: Symbols) -> dict[str, Any]:
        """Initial values, jumps and events, by name; how many jumps ``moving`` are events, and all
        symbols ``used``.
        """
        rest = self.initial if isinstance(self.initial, SteadyState) else None
        free = algebraic_unknowns(residuals) if rest is None else symbols.states
        initial = check_initial(self.initial, symbols, free)
        initial = {state: closed(start) for state, start in initial.items()}
        if rest is not None:
            initial = {state: initial.get(state, sp.S.Zero) for state in symbols.states}
        at_numbers, moving = user_events.moving_jumps(self.jumps, symbols)
        jumps = {
            at: {state: closed(after) for state, after in reset.items()}
            for at, reset in check_jumps(at_numbers, symbols).items()
        }
        after_jumps = [after for reset in jumps.values() for after in reset.values()]
        events = user_events.check_events(
            [*self.events, *moving] if moving else self.events, symbols
        )
        of_events = [expression for event in events for expression in event.expressions]
        further = [*initial.values(), *after_jumps, *of_events]
        check_lengths(further, 0)
        check_distinct([*residuals, *further])
        return {
            "used": sp.Tuple(*residuals, *further).free_symbols,
            "initial": MappingProxyType(initial),
            "jumps": MappingProxyType(jumps),
            "events": events,
            "moving": len(moving),
        }

    def _under_conditions(self, rest: SteadyState, symbols: Symbols) -> Any:
        """The problem before the start, which comes to rest."""
        if has_constraints(self.residuals, self.unknowns, self.time[0]):
            raise ProblemError(
                "the start is a steady state, and there are algebraic equations",
                term=rest,
                remedy="solve them for the unknowns that are not differentiated, and give these as "
                "definitions",
            )
        arguments = conditioned(self.written, rest, symbols)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RankoneWarning)
            try:
                before = type(self)(**arguments)
            except ProblemError as error:
                message = f"under the conditions of the start, {error.message}"
                raise ProblemError(message, term=error.term, remedy=error.remedy) from None
        check_autonomous(before.residuals, self.time[0])
        return before

    @property
    def start_states(self) -> set[sp.Expr]:
        """The states whose values were given, and do not follow."""
        symbols = Symbols(self.time, (), self.unknowns, [*self.initial])
        return {state_of(key, symbols) for key in self.written["initial"]}

    def _take_out_rates(self) -> None:
        """Put what equations say of highest derivatives in their place, where events cross zero."""
        leading = set(self.mass_form.leading)
        if any(event.when.atoms(sp.Derivative) & leading for event in self.events):
            rates = dict(zip(self.mass_form.leading, self.mass_form.solved()[0], strict=True))
            self._keep(events=user_events.without_rates(self.events, rates))

    def _reduce(self, states: Sequence[sp.Expr]) -> None:
        """Reduce algebraic equations, and complete initial values and resets by them."""
        consistency.check_impulses(self.residuals, self.time[0])
        reduction = reduced(self.residuals, self.unknowns, self.coordinates, self.initial)
        initial = consistency.consistent_initial(self.initial, states, reduction, self.time)
        consistency.check_consistent(initial, reduction, self.coordinates)
        jumps = consistency.consistent_jumps(self.jumps or {}, reduction, self.time[0])
        self._keep(
            reduction=reduction,
            mass_form=reduction.mass,
            initial=MappingProxyType(initial),
            jumps=MappingProxyType(jumps),
            events=consistency.consistent_events(self.events, reduction),
        )

    def _take_out_impulses(self, symbols: Symbols, first: int) -> None:
        """Make events of the impulses at times of parameters, numbered from ``first`` on."""
        if not any(residual.has(sp.DiracDelta) for residual in self.residuals):
            return
        time = self.time[0]
        rates, origins = self.mass_form.rates_of(symbols.states, time)
        deltas, impulses = moving_impulses(rates, symbols.states, origins, time, self.parameters)
        if not deltas:
            return
        gone = dict.fromkeys(deltas, sp.S.Zero)
        residuals = tuple(residual.xreplace(gone) for residual in self.residuals)
        self._keep(
            equations=tuple(equation.xreplace(gone) for equation in self.equations),
            residuals=residuals,
            events=user_events.check_events(
                [*self.events, *user_events.impulse_events(impulses, symbols, first)], symbols
            ),
            mass_form=check_mass(residuals, self.unknowns, self.coordinates),
        )
