"""Quantities of interest: SymPy expressions of a solution's unknowns as functions of arrays."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sympy as sp
from scipy import special
from sympy.core.function import AppliedUndef

from rankone.agreement.comparison import check_outputs
from rankone.codegen.gaps import check_gaps, gap_text
from rankone.codegen.narrow import peaks, steps
from rankone.codegen.printer import numpy_text
from rankone.codegen.switching import boundaries, switches
from rankone.discretization.coordinates import name_of
from rankone.expressions.admissible import closed, gaps
from rankone.expressions.notation import plain_text
from rankone.expressions.numbers import exact
from rankone.expressions.parsing import parse_expression
from rankone.expressions.stable import stable
from rankone.ir.forms import Coordinate
from rankone.ir.functions import duration, first_crossing, known_applied, maximum, minimum
from rankone.ir.metadata import SolutionMetadata
from rankone.outputs.quantities import Kind, Quantities, Reduction, Source
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, ProblemError, RankoneError
from rankone.support.wording import did_you_mean, listing, quote, shown

__all__ = ["quantities_of"]

_REDUCTIONS = (maximum, minimum, first_crossing, duration, sp.Integral)
_MOST_PERIODS = 200
"""Most points of a periodic function."""
_SEED = 1812
_KINDS = {
    maximum: Kind.MAXIMUM,
    minimum: Kind.MINIMUM,
    first_crossing: Kind.CROSSING,
    duration: Kind.DURATION,
}


def quantities_of(
    given: Any,
    metadata: SolutionMetadata,
    horizon: tuple[float, float],
    samples: tuple[Array, Array, Array],
) -> Quantities:
    """What is asked of a solution.

    Parameters
    ----------
    given : mapping of str to Expr or str
    metadata : SolutionMetadata
        Of the solution.
    horizon : (float, float)
        Start and end of what was solved.
    samples : (m,), (d, m) and (n, m) ndarray
        Times, parameters and the states there, at which what is generated is checked.

    Raises
    ------
    OptionError
        If it is no such mapping, or an expression has something that the solution does not hold.
    """
    if not isinstance(given, Mapping) or not given:
        raise OptionError(
            f"{shown(given)} is not a mapping from names to expressions",
            term=given,
            remedy='give for example {"energy": x**2 / 2}',
        )
    for name in given:
        _check_name(name, metadata)
    translator = _Translator(metadata, horizon)
    expressions = {name: _expression(name, value, metadata) for name, value in given.items()}
    values = [translator.translated(name, value) for name, value in expressions.items()]
    texts = [f"{name} = {plain_text(value)}" for name, value in expressions.items()]
    known = {sp.Symbol(p): f"p[{j}]" for j, p in enumerate(metadata.parameters)}
    written = {
        **known,
        sp.Symbol(metadata.time): "t",
        **{symbol: f"s[{i}]" for i, symbol in enumerate(translator.sources.values())},
        **{symbol: f"r[{i}]" for i, symbol in enumerate(translator.reduced)},
    }
    parts = [*translator.integrands, *values]
    found = _gaps(parts, translator, metadata, horizon)
    moving = {*translator.sources.values(), *translator.running, sp.Symbol(metadata.time)}
    timeless = metadata.timeless or not any(value.free_symbols & moving for value in values)
    quantities = Quantities(
        names=tuple(expressions),
        texts=tuple(texts),
        timeless=timeless,
        sources=tuple(translator.sources),
        integrands=_function("t, s, p", translator.integrands, written),
        reductions=tuple(translator.reductions),
        middles=_function("t, s, p", _middles(parts, moving - {*translator.running}), written),
        ridges=_function("p", _ridges(parts, {*known}), written),
        breaks=_breaks(parts, metadata, horizon),
        values=_function("t, s, p, r", values, written),
        gaps=_function("t, s, p", [sp.Piecewise((1, r), (0, True)) for _, r in found], written),
        gap_texts=tuple(text for text, _ in found),
    )
    _check(quantities, translator, dict(zip(expressions, values, strict=True)), samples)
    return quantities


def _check(
    quantities: Quantities,
    translator: _Translator,
    values: Mapping[str, sp.Expr],
    samples: tuple[Array, Array, Array],
) -> None:
    """Compare the functions with what they are made of; derivatives and reductions are made up."""
    t, p, states = samples
    rng = np.random.default_rng(_SEED)
    length = np.ptp(t) or 1.0

    def sized(row: Array) -> Array:
        return np.asarray(np.abs(row).max() / length * rng.uniform(-1.0, 1.0, row.shape))

    rows = [states[s.row] if s.order == 0 else sized(states[s.row]) for s in quantities.sources]
    values_of = {sp.Symbol(translator.metadata.time): t}
    values_of |= {sp.Symbol(n): q for n, q in zip(translator.metadata.parameters, p, strict=True)}
    values_of |= dict(zip(translator.sources.values(), rows, strict=True))
    stacked = np.asarray(rows, dtype=float).reshape(len(rows), 1, t.size)
    made_up = [rng.uniform(0.0, 1.0, t.size) for _ in translator.reduced]

    def at(k: int) -> tuple[Array, Array, Array]:
        return t[k : k + 1, None], stacked[:, :, k : k + 1], p[:, k : k + 1]

    integrands = {r.text: translator.integrands[r.integrand] for r in quantities.reductions}
    with np.errstate(all="ignore"):
        if len(integrands) == len(translator.integrands):
            check_outputs(integrands, values_of, lambda k: quantities.integrands(*at(k)))
        values_of |= dict(zip(translator.reduced, made_up, strict=True))
        check_outputs(
            {f"the output {quote(name)}": value for name, value in values.items()},
            values_of,
            lambda k: quantities.values(*at(k), [r[k : k + 1] for r in made_up]),
        )


def _gaps(
    parts: Sequence[sp.Expr],
    translator: _Translator,
    metadata: SolutionMetadata,
    horizon: tuple[float, float],
) -> list[tuple[str, Any]]:
    """Where piecewise functions of the states have no branch: what to say, and the region.

    An OptionError if there are such gaps in time and parameters alone.
    """
    known = (metadata.time, *metadata.parameters)
    intervals = zip(known, (horizon, *metadata.box), strict=True)
    coordinates = [Coordinate(name, sp.Symbol(name), *ends) for name, ends in intervals]
    time = sp.Symbol(metadata.time)
    names = {
        symbol: sp.Function(metadata.states[source.row])(time).diff(time, source.order)
        for source, symbol in translator.sources.items()
    }
    try:
        check_gaps([("an output", None, part.xreplace(names)) for part in parts], coordinates)
    except ProblemError as error:
        raise OptionError(error.message, term=error.term, remedy=error.remedy) from error
    return [
        (gap_text("an output", function.xreplace(names), region.xreplace(names)), region)
        for part in parts
        for function, region in gaps(part)
        if region.free_symbols & set(names) and not region.free_symbols & {*translator.reduced}
    ]


def _middles(parts: Sequence[sp.Expr], symbols: set[sp.Symbol]) -> list[sp.Expr]:
    """What vanishes where functions of some symbols are narrow or steep."""

    def own(expression: sp.Basic) -> set[sp.Basic]:
        return {*(expression.free_symbols & symbols)}

    found = [middle for _, middle in itertools.chain(peaks(parts, own), steps(parts, own))]
    return [middle for middle in dict.fromkeys(found) if own(middle)]


def _ridges(parts: Sequence[sp.Expr], parameters: set[sp.Symbol]) -> list[sp.Expr]:
    """What vanishes where functions of several parameters alone are narrow, steep or kink."""
    found = [*_middles(parts, parameters), *(boundary for boundary, _ in boundaries(parts))]
    several = (f for f in dict.fromkeys(found) if len(f.free_symbols) > 1)
    return [function for function in several if function.free_symbols <= parameters]


def _breaks(
    parts: Sequence[sp.Expr], metadata: SolutionMetadata, horizon: tuple[float, float]
) -> tuple[tuple[float, ...], ...]:
    """For time and each parameter where functions of it alone are not smooth, or narrow."""
    intervals = (horizon, *metadata.box)
    coordinates = [
        Coordinate(name, sp.Symbol(name), *interval)
        for name, interval in zip((metadata.time, *metadata.parameters), intervals, strict=True)
    ]
    found = []
    for (lower, upper), places in zip(intervals, switches(coordinates, parts), strict=True):
        points = set(places.points)
        for first, period in places.periodic:
            count = min(math.floor((upper - first) / period), _MOST_PERIODS)
            start = math.ceil((lower - first) / period)
            points |= {
                first + period * i for i in range(start, min(count, start + _MOST_PERIODS) + 1)
            }
        near = 1e-12 * (upper - lower)
        found.append(tuple(sorted(x for x in points if lower + near < x < upper - near)))
    return tuple(found)


def _check_name(name: Any, metadata: SolutionMetadata) -> None:
    """Raise unless an output can be called so."""
    if not isinstance(name, str) or not name.strip():
        raise OptionError(
            f"the name of an output is {shown(name)}, not text", term=name, remedy="give it a name"
        )
    if name in (metadata.time, *metadata.parameters):
        raise OptionError(
            f"the output {quote(name)} has the name of a coordinate",
            term=name,
            remedy="give it another name",
        )


def _expression(name: str, value: Any, metadata: SolutionMetadata) -> sp.Expr:
    """An expression, or a text as one, in plain symbols."""
    t = sp.Symbol(metadata.time)
    if isinstance(value, str):
        names = {
            metadata.time: t,
            **{parameter: sp.Symbol(parameter) for parameter in metadata.parameters},
            **{f"{state}_t": sp.Function(state)(t).diff(t) for state in metadata.states},
            **{state: sp.Function(state)(t) for state in metadata.states},
        }
        further = {
            **{kind.__name__: kind for kind in _KINDS},
            **{name: _several(name) for name in ("max", "min", "Max", "Min")},
            "integral": lambda inner, *ends: sp.Integral(inner, (t, *ends)),
        }
        where = f"output {quote(name)}"
        try:
            return parse_expression(value, names, where=where, further=further)
        except ProblemError as error:
            text = error.message
            known = f"the solution knows {listing([*metadata.states, *metadata.coordinates])}"
            remedy = known if "declare" in (error.remedy or "declare") else error.remedy
            raise OptionError(text, term=value, remedy=remedy) from None
    try:
        expression = sp.sympify(value, strict=True)
    except (sp.SympifyError, TypeError):
        expression = None
    if not isinstance(expression, sp.Expr):
        raise OptionError(
            f"the output {quote(name)} is {shown(value)}, not an expression",
            term=value,
            remedy="give an expression of the unknowns, parameters and time, or its text",
        )
    plain = {symbol: sp.Symbol(symbol.name) for symbol in expression.atoms(sp.Symbol)}
    return exact(
        expression.xreplace({k: v for k, v in plain.items() if not isinstance(k, sp.Dummy)})
    )


def _several(name: str) -> Callable[..., sp.Expr]:
    """The largest or smallest of several; of one alone is what was meant over time."""

    def function(*arguments: sp.Expr) -> sp.Expr:
        if len(arguments) == 1:
            raise ProblemError(
                f"{quote(f'{name}({arguments[0]})')} is of one argument",
                term=arguments[0],
                remedy=f"write {name.lower()}imum(...) for the one over time",
            )
        return getattr(sp, name.title())(*arguments)

    return function


@dataclass
class _Translator:
    """Expressions in symbols of what is needed of the solution and of reductions."""

    metadata: SolutionMetadata
    horizon: tuple[float, float]
    sources: dict[Source, sp.Dummy] = field(default_factory=dict)
    integrands: list[sp.Expr] = field(default_factory=list)
    reductions: list[Reduction] = field(default_factory=list)
    reduced: list[sp.Dummy] = field(default_factory=list)
    running: list[sp.Dummy] = field(default_factory=list)

    def translated(self, name: str, expression: sp.Expr) -> sp.Expr:
        """An expression of sources, reductions, parameters and time."""
        found = _outermost(expression, _REDUCTIONS)
        if found and self.metadata.timeless:
            raise OptionError(
                f"the output {quote(name)} has {quote(found[0])}, but nothing depends on time",
                term=expression,
                remedy="ask the solution that depends on time",
            )
        replaced = {part: self._reduction(name, part) for part in found}
        return self._in_sources(name, expression.xreplace(replaced))

    def _reduction(self, name: str, part: sp.Expr) -> sp.Dummy:
        """The symbol of a reduction, which is added."""
        start, end = self.horizon
        kind, direction = _KINDS.get(part.func, Kind.INTEGRAL), 0
        if isinstance(part, sp.Integral):
            kind, inner, start, end = self._integral(name, part)
        elif isinstance(part, first_crossing):
            inner, direction = part.parts
            if not direction.is_number or float(direction) not in (-1.0, 0.0, 1.0):
                raise OptionError(
                    f"the direction of {quote(part)} is {quote(direction)}",
                    term=part,
                    remedy="give 1 (upwards), -1 (downwards) or 0",
                )
        else:
            (inner,) = part.args
        if inner.has(*_REDUCTIONS):
            raise OptionError(
                f"the output {quote(name)} has {quote(part)}, one function of time inside another",
                term=part,
                remedy="make the inner one an output, and go on from there",
            )
        self.integrands.append(self._in_sources(name, inner))
        given = kind, len(self.integrands) - 1, start, end, int(direction), plain_text(part)
        self.reductions.append(Reduction(*given))
        symbol = sp.Dummy(f"r{len(self.reduced)}")
        self.reduced.append(symbol)
        if kind is Kind.RUNNING:
            self.running.append(symbol)
        return symbol

    def _integral(self, name: str, part: sp.Integral) -> tuple[Kind, sp.Expr, float, float]:
        """Kind, integrand and limits of an integral."""
        start, end = self.horizon
        t = sp.Symbol(self.metadata.time)
        (limits, *others) = part.limits
        variable, *ends = limits
        if others:
            raise self._wrong_integral(name, part, "it has several variables")
        if variable != t and variable.name in self.metadata.parameters:
            raise self._wrong_integral(name, part, f"{quote(variable)} is a parameter")
        if variable != t and t in part.function.free_symbols:
            raise self._wrong_integral(name, part, f"it has both {quote(variable)} and {quote(t)}")
        inner = part.function.xreplace({variable: t})
        if not ends and variable == t:
            return Kind.INTEGRAL, inner, start, end
        if len(ends) != 2:
            raise self._wrong_integral(name, part, "it has no two limits")
        lower, upper = ends
        known = lower.is_extended_real and (upper.is_extended_real or upper == t)
        if not known or not lower.is_number or not (upper.is_number or upper == t):
            raise self._wrong_integral(name, part, "its limits are no numbers")
        low, high = float(lower), end if upper == t else float(upper)
        if not start <= low <= high <= end:
            raise self._wrong_integral(name, part, f"its limits are not in [{start:g}, {end:g}]")
        return Kind.RUNNING if upper == t else Kind.INTEGRAL, inner, low, high

    def _wrong_integral(self, name: str, part: sp.Integral, why: str) -> OptionError:
        start, t = self.horizon[0], self.metadata.time
        return OptionError(
            f"the output {quote(name)} has {quote(part)}: {why}",
            term=part,
            remedy=f"write Integral(x, ({t}, {start:g}, {self.horizon[1]:g})), or "
            f"Integral(x, ({t}, {start:g}, {t})) for a function of time",
        )

    def _in_sources(self, name: str, expression: sp.Expr) -> sp.Expr:
        """An expression with symbols for states and their derivatives."""
        parts = _outermost(expression, (sp.Derivative, AppliedUndef))
        plain = expression.xreplace({part: self._source(name, part) for part in parts})
        known = {*self.sources.values(), *self.reduced}
        names = self.metadata.coordinates
        for symbol in sorted(plain.free_symbols - known, key=str):
            if symbol == sp.Symbol(symbol.name) and symbol.name in names:
                continue
            if symbol.name in self.metadata.states:
                state = sp.Function(symbol.name)(sp.Symbol(self.metadata.time))
                plain = plain.xreplace({symbol: self._source(name, state)})
                continue
            raise OptionError(
                f"the output {quote(name)} has {quote(symbol)}"
                f"{did_you_mean(symbol.name, [*self.metadata.states, *names])}",
                term=symbol,
                remedy=f"the solution knows {listing([*self.metadata.states, *names])}",
            )
        if plain.has(sp.I, sp.nan, sp.zoo, sp.oo) or plain.is_extended_real is False:
            raise OptionError(
                f"the output {quote(name)}, {quote(expression)}, is not real and finite",
                term=expression,
            )
        return closed(plain)

    def _source(self, name: str, part: sp.Expr) -> sp.Dummy:
        """The symbol of a state or a derivative of one."""
        try:
            wanted = name_of(part, self.metadata.time)
        except RankoneError as error:
            raise OptionError(f"the output {quote(name)}: {error}", term=part) from None
        orders = part.derivative_count if isinstance(part, sp.Derivative) else 0
        state = name_of(part.expr if orders else part, self.metadata.time)
        if orders and self.metadata.timeless:
            raise OptionError(
                f"the output {quote(name)} has {quote(part)}, but nothing depends on time",
                term=part,
                remedy="ask the solution that depends on time",
            )
        states = self.metadata.states
        for order in range(orders + 1):
            held = wanted[: len(wanted) - order] if order < orders else state
            if held in states:
                source = Source(states.index(held), order)
                return self.sources.setdefault(source, sp.Dummy(f"s{len(self.sources)}"))
        raise OptionError(
            f"the output {quote(name)} has {quote(part)}{did_you_mean(state, states)}",
            term=part,
            remedy=f"the solution holds {listing(states)}",
        )


def _outermost(expression: sp.Expr, kinds: tuple[type, ...]) -> list[sp.Expr]:
    """Parts of some kinds that are in no other such part, each once."""
    found: dict[sp.Expr, None] = {}
    walk = sp.preorder_traversal(expression)
    for part in walk:
        if isinstance(part, kinds):
            found.setdefault(part)
            walk.skip()
    return list(found)


def _function(
    arguments: str, expressions: Iterable[sp.Expr], written: Mapping[sp.Symbol, str]
) -> Callable[..., Sequence[Any]]:
    """A function of arrays from expressions."""
    listed = list(expressions)
    texts = [numpy_text(stable(expression), dict(written)) for expression in listed]
    called = {part.written(): type(part)._imp_ for part in known_applied(listed)}
    namespace = {"np": np, "special": special, **called}
    made: Callable[..., Sequence[Any]] = eval(
        f"lambda {arguments}: [{', '.join(texts)}]", namespace
    )
    return made
