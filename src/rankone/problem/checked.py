"""The checks of a problem's arguments, and all that follows from them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence, Set
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import sympy as sp

from rankone.problem import user_events
from rankone.problem.algebra import consistency
from rankone.problem.algebra.algebraic import has_constraints, reduced
from rankone.problem.algebra.mass import check_mass
from rankone.problem.box import (
    Box,
    Time,
    check_correlation,
    check_parameters,
    check_time,
    check_tolerances,
    check_units,
)
from rankone.problem.changes import coupled_by, with_decisive
from rankone.problem.content import ProblemContent
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
from rankone.problem.expressions.derivatives import rate_of
from rankone.problem.functions import check_distinct
from rankone.problem.jumps import check_jumps, moving_impulses
from rankone.problem.shorthand import (
    Shorthand,
    check_apart,
    check_shorthand,
    check_symbols_as_unknowns,
)
from rankone.problem.steady_start import SteadyState, check_autonomous, conditioned
from rankone.problem.tables import term_table
from rankone.problem.tables.tabulated import tabulated_equations
from rankone.support.errors import ProblemError, RankoneWarning, warn
from rankone.support.wording import is_line, quote, shown
from rankone.tensors.bases.coordinates import name_of

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
        if self.name is not None and not is_line(self.name):
            message = f"the name is {shown(self.name)}, not text in one line"
            raise ProblemError(message, term=self.name, remedy="give a title")
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

    def _determine_rates(self, symbols: Symbols, moving: int) -> None:
        """Set the mass matrix, and what else tells the rates; ``moving`` jumps are events."""
        if has_constraints(self.residuals, symbols.unknowns, symbols.time[0]):
            self._reduce(symbols.states)
            return
        self._keep(mass=check_mass(self.residuals, symbols.unknowns, self.coordinates))
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
        leading = set(self.mass.leading)
        if any(event.when.atoms(sp.Derivative) & leading for event in self.events):
            rates = dict(zip(self.mass.leading, self.mass.solved()[0], strict=True))
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
            mass=reduction.mass,
            initial=MappingProxyType(initial),
            jumps=MappingProxyType(jumps),
            events=consistency.consistent_events(self.events, reduction),
        )

    def _take_out_impulses(self, symbols: Symbols, first: int) -> None:
        """Make events of the impulses at times of parameters, numbered from ``first`` on."""
        if not any(residual.has(sp.DiracDelta) for residual in self.residuals):
            return
        time = self.time[0]
        rates, origins = self.mass.rates_of(symbols.states, time)
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
            mass=check_mass(residuals, self.unknowns, self.coordinates),
        )
