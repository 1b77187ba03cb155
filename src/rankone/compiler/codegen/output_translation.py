"""Outputs in terms of a solution's states: derivatives, integrals, extremes and events listed."""

from __future__ import annotations

from dataclasses import dataclass, field

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.compiler.codegen.layout import Border, Kind, Reduction, Source
from rankone.problem.expressions.admissible import closed
from rankone.problem.expressions.notation import plain_text
from rankone.problem.functions import (
    at_event,
    duration,
    event_time,
    first_crossing,
    maximum,
    minimum,
)
from rankone.solvers.outcome import SolutionMetadata
from rankone.support.errors import OptionError, RankoneError, did_you_mean, listing, quote
from rankone.tensors.coordinates import name_of
from rankone.trajectories.system.timeline import Timeline

KINDS = {
    maximum: Kind.MAXIMUM,
    minimum: Kind.MINIMUM,
    first_crossing: Kind.CROSSING,
    duration: Kind.DURATION,
    at_event: Kind.INSTANT,
    event_time: Kind.INSTANT,
}
"""Kinds of what makes one number of a function of time, but for integrals."""
_REDUCTIONS = (*KINDS, sp.Integral)
_BEFORE = sp.Symbol("before")


@dataclass
class OutputTranslator:
    """Replaces states, their derivatives and reductions by symbols, and keeps a list of each."""

    metadata: SolutionMetadata
    horizon: tuple[float, float]
    timeline: Timeline | None = None
    sources: dict[Source, sp.Dummy] = field(default_factory=dict)
    integrands: list[sp.Expr] = field(default_factory=list)
    reductions: list[Reduction] = field(default_factory=list)
    reduced: list[sp.Dummy] = field(default_factory=list)
    running: list[sp.Dummy] = field(default_factory=list)

    def translated(self, name: str, expression: sp.Expr) -> sp.Expr:
        """An expression of sources, reductions, parameters and time."""
        reductions = _outermost(expression, _REDUCTIONS)
        if reductions and self.metadata.timeless:
            raise OptionError(
                f"the output {quote(name)} has {quote(reductions[0])}, but nothing depends on time",
                term=expression,
                remedy="ask the solution that depends on time",
            )
        symbols = {reduction: self._reduction(name, reduction) for reduction in reductions}
        return self._in_sources(name, expression.xreplace(symbols))

    def _reduction(self, name: str, applied: sp.Expr) -> sp.Dummy:
        """The symbol of a reduction, which is added to the list."""
        kind, inner, start, end = self._operand(name, applied)
        direction = 0
        if isinstance(applied, first_crossing):
            inner, direction = applied.parts
            if not direction.is_number or float(direction) not in (-1.0, 0.0, 1.0):
                raise OptionError(
                    f"the direction of {quote(applied)} is {quote(direction)}",
                    term=applied,
                    remedy="give 'rising', 'falling' or 'both'",
                )
        if inner.has(*_REDUCTIONS):
            raise OptionError(
                f"the output {quote(name)} has {quote(applied)}, one function of time inside "
                "another",
                term=applied,
                remedy="make the inner one an output, and go on from there",
            )
        self.integrands.append(self._in_sources(name, inner))
        self.reductions.append(
            Reduction(
                kind=kind,
                integrand=len(self.integrands) - 1,
                start=start,
                end=end,
                direction=int(direction),
                text=plain_text(applied),
            )
        )
        symbol = sp.Dummy(f"r{len(self.reduced)}")
        self.reduced.append(symbol)
        if kind is Kind.RUNNING:
            self.running.append(symbol)
        return symbol

    def _border(
        self,
        name: str,
        applied: sp.Expr,
        event: sp.Expr,
        occurrence: sp.Expr,
        side: sp.Expr = _BEFORE,
    ) -> Border:
        """Where an occurrence of an event ends a stretch."""

        def error(why: str, term: sp.Expr, remedy: str) -> OptionError:
            return OptionError(
                f"the output {quote(name)} has {quote(applied)}: {why}", term=term, remedy=remedy
            )

        if self.timeline is None:
            raise error("the solution has no events", event, "solve a problem with events")
        events, met = self.timeline.events, self.timeline.met
        if str(event) not in events:
            hint = did_you_mean(str(event), events)
            raise error(
                f"no event {quote(event)}{hint}", event, f"the events are {listing(events)}"
            )
        if str(side) not in ("before", "after"):
            raise error(f"the side is {quote(side)}", side, "give 'before' or 'after'")
        places = [place for place, instant in enumerate(met, 1) if str(event) in instant]
        if not (occurrence.is_Integer and -len(places) <= int(occurrence) < len(places)):
            counted = f"from 0 to {len(places) - 1}" if places else "none"
            raise error(
                f"{quote(event)} has no occurrence {occurrence} before the end",
                occurrence,
                f"those before the end are {counted}",
            )
        border = Border(places[int(occurrence)], str(side) == "after")
        if border.after and border.place == self.timeline.stretches:
            raise error("the solution ends there", side, "give 'before'")
        return border

    def _operand(
        self, name: str, applied: sp.Expr
    ) -> tuple[Kind, sp.Expr, float | Border, float | Border]:
        """Kind, operand and limits of a reduction: those of the horizon if it names none."""
        start, end = self.horizon
        kind = KINDS.get(applied.func, Kind.INTEGRAL)
        if isinstance(applied, sp.Integral):
            return self._integral(name, applied)
        if isinstance(applied, at_event):
            inner, event, occurrence, side = applied.args
            return kind, inner, self._border(name, applied, event, occurrence, side), end
        if isinstance(applied, event_time):
            at = self._border(name, applied, *applied.args)
            return kind, sp.Symbol(self.metadata.time), at, end
        return kind, applied.args[0], start, end

    def _integral(
        self, name: str, integral: sp.Integral
    ) -> tuple[Kind, sp.Expr, float | Border, float | Border]:
        """Kind, integrand and limits of an integral."""
        start, end = self.horizon
        t = sp.Symbol(self.metadata.time)
        (limits, *further) = integral.limits
        variable, *ends = limits
        if further:
            raise self._wrong_integral(name, integral, "it has several variables")
        if variable != t and variable.name in self.metadata.parameters:
            raise self._wrong_integral(name, integral, f"{quote(variable)} is a parameter")
        if variable != t and t in integral.function.free_symbols:
            raise self._wrong_integral(
                name, integral, f"it has both {quote(variable)} and {quote(t)}"
            )
        inner = integral.function.xreplace({variable: t})
        if not ends and variable == t:
            return Kind.INTEGRAL, inner, start, end
        if len(ends) != 2:
            raise self._wrong_integral(name, integral, "it has no two limits")
        borders = [
            self._border(name, limit, *limit.args) if isinstance(limit, event_time) else None
            for limit in ends
        ]
        if any(borders):
            numbers = [
                border or self._number(name, integral, limit)
                for border, limit in zip(borders, ends, strict=True)
            ]
            return Kind.INTEGRAL, inner, numbers[0], numbers[1]
        lower, upper = ends
        real = lower.is_extended_real and (upper.is_extended_real or upper == t)
        if not real or not lower.is_number or not (upper.is_number or upper == t):
            raise self._wrong_integral(name, integral, "its limits are not numbers")
        low, high = float(lower), end if upper == t else float(upper)
        if not start <= low <= high <= end:
            raise self._wrong_integral(
                name, integral, f"its limits are not in [{start:g}, {end:g}]"
            )
        return Kind.RUNNING if upper == t else Kind.INTEGRAL, inner, low, high

    def _number(self, name: str, integral: sp.Integral, limit: sp.Expr) -> float:
        """The limit of an integral, a number inside of the horizon."""
        start, end = self.horizon
        if not limit.is_number or not limit.is_extended_real:
            raise self._wrong_integral(name, integral, "its limits are not numbers or event times")
        if not start <= float(limit) <= end:
            where = f"its limits are not in [{start:g}, {end:g}]"
            raise self._wrong_integral(name, integral, where)
        return float(limit)

    def _wrong_integral(self, name: str, integral: sp.Integral, why: str) -> OptionError:
        start, t = self.horizon[0], self.metadata.time
        return OptionError(
            f"the output {quote(name)} has {quote(integral)}: {why}",
            term=integral,
            remedy=f"write Integral(x, ({t}, {start:g}, {self.horizon[1]:g})), or "
            f"Integral(x, ({t}, {start:g}, {t})) for a function of time",
        )

    def _in_sources(self, name: str, expression: sp.Expr) -> sp.Expr:
        """An expression with symbols for states and their derivatives."""
        states = _outermost(expression, (sp.Derivative, AppliedUndef))
        plain = expression.xreplace({state: self._source(name, state) for state in states})
        names = self.metadata.coordinates
        translated = {*self.sources.values(), *self.reduced}
        for symbol in sorted(plain.free_symbols - translated, key=str):
            if symbol == sp.Symbol(symbol.name) and symbol.name in names:
                continue
            if symbol.name in self.metadata.states:
                state = sp.Function(symbol.name)(sp.Symbol(self.metadata.time))
                plain = plain.xreplace({symbol: self._source(name, state)})
                continue
            quantities = [*self.metadata.states, *names]
            raise OptionError(
                f"the output {quote(name)} has {quote(symbol)}"
                f"{self.metadata.hint(symbol.name, *names)}",
                term=symbol,
                remedy=f"names are {listing(quantities, symbol.name)}",
            )
        not_real = plain.is_number and plain.is_extended_real is False  # slow for long sums
        if not_real or plain.has(sp.I, sp.nan, sp.zoo, sp.oo):
            raise OptionError(
                f"the output {quote(name)}, {quote(expression)}, is not real and finite",
                term=expression,
            )
        return closed(plain)

    def _source(self, name: str, unknown: sp.Expr) -> sp.Dummy:
        """The symbol of a state or a derivative of one."""
        try:
            full_name = name_of(unknown, self.metadata.time)
        except RankoneError as error:
            raise OptionError(f"the output {quote(name)}: {error}", term=unknown) from None
        orders = unknown.derivative_count if isinstance(unknown, sp.Derivative) else 0
        state = name_of(unknown.expr if orders else unknown, self.metadata.time)
        if orders and self.metadata.timeless:
            raise OptionError(
                f"the output {quote(name)} has {quote(unknown)}, but nothing depends on time",
                term=unknown,
                remedy="ask the solution that depends on time",
            )
        states = self.metadata.states
        for order in range(orders + 1):
            held = full_name[: len(full_name) - order] if order < orders else state
            if held in states:
                source = Source(states.index(held), order)
                return self.sources.setdefault(source, sp.Dummy(f"s{len(self.sources)}"))
        raise OptionError(
            f"the output {quote(name)} has {quote(unknown)}{self.metadata.hint(state)}",
            term=unknown,
            remedy=f"the solution holds {listing(states, state)}",
        )


def _outermost(expression: sp.Expr, types: tuple[type, ...]) -> list[sp.Expr]:
    """Subexpressions of some types that are in no other such subexpression, each once."""
    nodes: dict[sp.Expr, None] = {}
    walk = sp.preorder_traversal(expression)
    for node in walk:
        if isinstance(node, types):
            nodes.setdefault(node)
            walk.skip()
    return list(nodes)
