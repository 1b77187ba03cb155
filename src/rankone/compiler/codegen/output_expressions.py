"""Outputs: SymPy expressions of a solution's unknowns, as functions of arrays."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.compiler.agreement import check_outputs
from rankone.compiler.codegen.layout import Quantities, Source, WrittenFunction
from rankone.compiler.codegen.output_translation import KINDS, OutputTranslator
from rankone.compiler.codegen.printer import numpy_text
from rankone.compiler.codegen.sums import Sums, long_sums
from rankone.compiler.passes.feature_pass import cuts_of
from rankone.compiler.passes.well_posed import Gap, check_gaps
from rankone.problem.expressions.admissible import gaps
from rankone.problem.expressions.boundaries import (
    CONTINUOUS,
    DISCONTINUOUS,
    boundaries,
    peaks,
    steps,
)
from rankone.problem.expressions.conditions import rate_of, unknown_of
from rankone.problem.expressions.notation import exact, expression_of, plain_text
from rankone.problem.expressions.parsing import parse_expression
from rankone.problem.expressions.stable import stable
from rankone.problem.forms import Coordinate
from rankone.problem.functions import known_applied
from rankone.solvers.outcome import SolutionMetadata
from rankone.support.arrays import COINCIDENT, SEED, Array
from rankone.support.errors import OptionError, ProblemError, listing, quote, shown
from rankone.trajectories.system.timeline import Timeline

# Cuts of one period over the horizon; a quadrature between more would take minutes
_MAX_REPEATS = 201


@dataclass(frozen=True)
class OutputFormulas:
    """Outputs that were translated, and their functions of arrays, for any domain.

    ``evaluated`` are the formulas of time, parameters and the symbols of ``states``. They may be
    ``narrow`` somewhere over several parameters.
    """

    quantities: Quantities
    evaluated: tuple[sp.Expr, ...]
    metadata: SolutionMetadata
    states: Mapping[sp.Symbol, sp.Expr]
    narrow: bool

    def over(self, box: Sequence[tuple[float, float]], horizon: tuple[float, float]) -> Quantities:
        """The outputs over a domain; an OptionError where a piecewise function has no branch."""
        names, intervals = (self.metadata.time, *self.metadata.parameters), (horizon, *box)
        coordinates = [
            Coordinate(name, sp.Symbol(name), *interval)
            for name, interval in zip(names, intervals, strict=True)
        ]
        self._check_gaps(coordinates)
        return replace(self.quantities, cuts=_cuts(self.evaluated, coordinates))

    def _check_gaps(self, coordinates: Sequence[Coordinate]) -> None:
        """Raise an OptionError where a function of time and parameters alone has no branch."""
        open_ones = [term for term in self.evaluated if any(gaps(term))]
        try:
            check_gaps(
                [("an output", None, term.xreplace(self.states)) for term in open_ones], coordinates
            )
        except ProblemError as error:
            raise OptionError(error.message, term=error.term, remedy=error.remedy) from error


def output_formulas(
    outputs: object,
    metadata: SolutionMetadata,
    horizon: tuple[float, float],
    samples: tuple[Array, Array, Array],
    timeline: Timeline | None = None,
    *,
    with_sums: bool = False,
) -> OutputFormulas:
    """Outputs, expressions or their texts by name, translated for the states of a solution.

    Texts alone are the names of definitions. Integrals are over the horizon.

    The generated functions are checked at ``samples``: times (m,), parameters (d, m) and the states
    there (n, m). The events are those of its ``timeline``. With sums, long sums of states are
    sources of their own. An OptionError if ``outputs`` is not such a mapping, or an expression has
    something that the solution does not hold.
    """
    translator = OutputTranslator(metadata, horizon, timeline)
    expressions = {
        name: _expression(name, term, metadata, timeline)
        for name, term in _by_name(outputs, metadata).items()
    }
    formulas = [translator.translated(name, term) for name, term in expressions.items()]
    texts = [f"{name} = {plain_text(term)}" for name, term in expressions.items()]
    time = sp.Symbol(metadata.time)
    parameters = {sp.Symbol(p): f"p[{j}]" for j, p in enumerate(metadata.parameters)}
    written = [*translator.integrands, *formulas]
    rows = {symbol: source.row for source, symbol in translator.sources.items() if source.is_state}
    evaluated, sums = long_sums(written, rows if with_sums else ())
    used = set[sp.Basic]().union(*(expression.free_symbols for expression in evaluated))
    sources = {symbol: source for source, symbol in translator.sources.items() if symbol in used}
    sources |= {symbol: Source(len(metadata.states) + k) for k, symbol in enumerate(sums)}
    names = {
        **parameters,
        time: "t",
        **{symbol: f"s[{i}]" for i, symbol in enumerate(sources)},
        **{symbol: f"r[{i}]" for i, symbol in enumerate(translator.reduced)},
    }
    states = _meanings(translator, sums)
    count = len(translator.integrands)
    integrands, values = evaluated[:count], evaluated[count:]
    gap_regions = _gaps(evaluated, states, {*translator.reduced})
    moving = {*sources, *translator.running, time}
    timeless = metadata.timeless or not any(formula.free_symbols & moving for formula in values)
    of_states, jumps = _state_surfaces(evaluated, moving - {*translator.running})
    of_parameters = _parameter_surfaces(evaluated, {*parameters})
    quantities = Quantities(
        names=tuple(expressions),
        texts=tuple(texts),
        timeless=timeless,
        sources=tuple(sources.values()),
        integrands=_function("t, s, p", integrands, names),
        reductions=tuple(translator.reductions),
        n_state_surfaces=len(of_states),
        state_surfaces=_function("t, s, p", [*of_states, *jumps], names),
        parameter_surfaces=_function("p", of_parameters, names),
        cuts=(),
        values=_function("t, s, p, r", values, names),
        gaps=_function(
            "t, s, p", [sp.Piecewise((1, region), (0, True)) for region in gap_regions], names
        ),
        gap_texts=tuple(gap_regions.values()),
        sums=tuple(
            tuple((rows[state], weight) for state, weight in weights.items())
            for weights in sums.values()
        ),
    )
    _check(quantities, translator, dict(zip(expressions, formulas, strict=True)), samples)
    return OutputFormulas(quantities, tuple(evaluated), metadata, states, bool(of_parameters))


def _meanings(translator: OutputTranslator, sums: Sums) -> dict[sp.Symbol, sp.Expr]:
    """States, their derivatives and sums of them as functions of time, by symbol."""
    time, names = sp.Symbol(translator.metadata.time), translator.metadata.states
    states: dict[sp.Symbol, sp.Expr] = {
        symbol: rate_of(unknown_of(names[source.row], time), time, source.order)
        for source, symbol in translator.sources.items()
    }
    return states | {
        symbol: sp.Add(*(weight * states[state] for state, weight in weights.items()))
        for symbol, weights in sums.items()
    }


def _by_name(outputs: object, metadata: SolutionMetadata) -> Mapping[str, object]:
    """Outputs by name; texts alone are the names of definitions."""
    if isinstance(outputs, str):
        outputs = {outputs: outputs}
    elif isinstance(outputs, list | tuple) and all(isinstance(name, str) for name in outputs):
        outputs = {name: name for name in outputs} or outputs
    if not isinstance(outputs, Mapping) or not outputs:
        empty = isinstance(outputs, Mapping | list | tuple) and not outputs
        wrong = "names no output" if empty else "is not a mapping from names to expressions"
        raise OptionError(
            f"{shown(outputs)} {wrong}",
            term=outputs,
            remedy='give for example {"energy": x**2 / 2}, or the name of a definition',
        )
    for name in outputs:
        _check_name(name, metadata)
    return outputs


def _check(
    quantities: Quantities,
    translator: OutputTranslator,
    formulas: Mapping[str, sp.Expr],
    samples: tuple[Array, Array, Array],
) -> None:
    """Compare the functions with their formulas, at random derivatives and reductions."""
    t, p, states = samples
    rng = np.random.default_rng(SEED)
    length = np.ptp(t) or 1.0

    def sized(row: Array) -> Array:
        return np.asarray(np.abs(row).max() / length * rng.uniform(-1.0, 1.0, row.shape))

    sampled = {
        source: states[source.row] if source.order == 0 else sized(states[source.row])
        for source in translator.sources
    }
    samples_of = {sp.Symbol(translator.metadata.time): t}
    samples_of |= {sp.Symbol(n): q for n, q in zip(translator.metadata.parameters, p, strict=True)}
    samples_of |= {translator.sources[source]: row for source, row in sampled.items()}
    sums = [sum(weight * states[row] for row, weight in each) for each in quantities.sums]
    sampled |= {Source(len(states) + k): row for k, row in enumerate(sums)}
    rows = [sampled[source] for source in quantities.sources]
    stacked = np.asarray(rows, dtype=float).reshape(len(rows), 1, t.size)
    reduced = [rng.uniform(0.0, 1.0, t.size) for _ in translator.reduced]

    def at(k: int) -> tuple[Array, Array, Array]:
        return t[k : k + 1, None], stacked[:, :, k : k + 1], p[:, k : k + 1]

    integrands = {r.text: translator.integrands[r.integrand] for r in quantities.reductions}
    with np.errstate(all="ignore"):
        if len(integrands) == len(translator.integrands):
            check_outputs(integrands, samples_of, lambda k: quantities.integrands(*at(k)))
        samples_of |= dict(zip(translator.reduced, reduced, strict=True))
        check_outputs(
            {f"the output {quote(name)}": formula for name, formula in formulas.items()},
            samples_of,
            lambda k: quantities.values(*at(k), [r[k : k + 1] for r in reduced]),
        )


def _gaps(
    formulas: Sequence[sp.Expr], states: Mapping[sp.Symbol, sp.Expr], reduced: set[sp.Symbol]
) -> dict[sp.Basic, str]:
    """Where piecewise functions of the states have no branch: regions, and what to say of them."""
    return {
        region: Gap("an output", None, function, region).text(dict(states))
        for formula in formulas
        for function, region in gaps(formula)
        if region.free_symbols & states.keys() and not region.free_symbols & reduced
    }


def _surfaces(formulas: Sequence[sp.Expr], symbols: set[sp.Symbol]) -> list[sp.Expr]:
    """What vanishes where functions of some symbols are narrow or steep."""

    def variables(expression: sp.Basic) -> set[sp.Expr]:
        return {*(expression.free_symbols & symbols)}

    narrow = itertools.chain(peaks(formulas, variables), steps(formulas, variables))
    return [middle for middle in dict.fromkeys(m for _, m in narrow) if variables(middle)]


def _state_surfaces(
    formulas: Sequence[sp.Expr], symbols: set[sp.Symbol]
) -> tuple[list[sp.Expr], list[sp.Expr]]:
    """What vanishes where functions of symbols are narrow, steep or kink; and where they jump."""

    def levels(functions: tuple[type, ...]) -> list[sp.Expr]:
        zero = (f for f, levels in boundaries(formulas, functions) if levels == (0.0,))
        return [f for f in zero if f.free_symbols & symbols]

    smooth = dict.fromkeys([*_surfaces(formulas, symbols), *levels(CONTINUOUS)])
    jumps = dict.fromkeys(levels(DISCONTINUOUS))
    return [*smooth], [f for f in jumps if f not in smooth]


def _parameter_surfaces(formulas: Sequence[sp.Expr], parameters: set[sp.Symbol]) -> list[sp.Expr]:
    """What vanishes where functions of several parameters alone are narrow, steep or kink."""
    surfaces = [*_surfaces(formulas, parameters), *(f for f, _ in boundaries(formulas))]
    several = (f for f in dict.fromkeys(surfaces) if len(f.free_symbols) > 1)
    return [function for function in several if function.free_symbols <= parameters]


def _cuts(
    formulas: Sequence[sp.Expr], coordinates: Sequence[Coordinate]
) -> tuple[tuple[float, ...], ...]:
    """For time and each parameter the points inside at which functions of it are not smooth."""
    inside = []
    for c, cuts in zip(coordinates, cuts_of(coordinates, formulas), strict=True):
        near = COINCIDENT * (c.upper - c.lower)
        points = {*cuts.inside(c.lower, c.upper, _MAX_REPEATS)}
        inside.append(tuple(sorted(x for x in points if c.lower + near < x < c.upper - near)))
    return tuple(inside)


def _check_name(name: object, metadata: SolutionMetadata) -> None:
    """Raise an OptionError if an output cannot have this name."""
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


def _expression(
    name: str, output: object, metadata: SolutionMetadata, timeline: Timeline | None
) -> sp.Expr:
    """An output, given as expression or text, in plain symbols."""
    if isinstance(output, str):
        text = dict(metadata.definitions).get(output.strip(), output)
        return _parsed(name, text, metadata, timeline, _shorthand(metadata))
    expression = expression_of(output)
    if expression is None:
        raise OptionError(
            f"the output {quote(name)} is {shown(output)}, not an expression",
            term=output,
            remedy="give an expression of the unknowns, parameters and time, or its text",
        )
    plain = {s: sp.Symbol(s.name) for s in expression.atoms(sp.Symbol) - expression.atoms(sp.Dummy)}
    expression = expression.xreplace(plain)
    shorthand = _shorthand(metadata)
    applied = (f for f in expression.atoms(AppliedUndef) if f.args == (sp.Symbol(metadata.time),))
    named = {f: f.func.__name__ for f in applied} | {s: s.name for s in expression.free_symbols}
    held = {*metadata.states, *metadata.coordinates}
    short = {e: shorthand[n] for e, n in named.items() if n in {*shorthand} - held}
    try:
        return exact(expression.xreplace(short))
    except ProblemError as error:
        message = f"the output {quote(name)}: {error.message}"
        raise OptionError(message, term=output, remedy=error.remedy) from None


def _shorthand(metadata: SolutionMetadata) -> dict[str, sp.Expr]:
    """Constants, fixed parameters and definitions by name.

    Definitions with functions that text does not have, such as tables, are left out.
    """
    numbers = dict((*metadata.constants, *metadata.fixed))
    shorthand = {n: exact(sp.Float(at)) for n, at in numbers.items() if n != metadata.time}
    for name, text in metadata.definitions:
        with contextlib.suppress(OptionError):
            shorthand[name] = _parsed(name, text, metadata, None, {})
    return shorthand


def _parsed(
    name: str,
    output: str,
    metadata: SolutionMetadata,
    timeline: Timeline | None,
    shorthand: Mapping[str, sp.Expr],
) -> sp.Expr:
    """An output of a text."""
    t = sp.Symbol(metadata.time)
    words = ("before", "after", "rising", "falling", "both")
    names = {
        **{word: sp.Symbol(word) for word in words},
        **{event: sp.Symbol(event) for event in (timeline.events if timeline else ())},
        metadata.time: t,
        **{state: unknown_of(state, t) for state in metadata.left_out},  # named in the error
        **shorthand,
        **{parameter: sp.Symbol(parameter) for parameter in metadata.parameters},
        **{f"{state}_t": rate_of(unknown_of(state, t), t) for state in metadata.states},
        **{state: unknown_of(state, t) for state in metadata.states},
    }
    further: dict[str, Callable[..., sp.Expr]] = {
        **{reduction.__name__: reduction for reduction in KINDS},
        **{name: _extreme(name) for name in ("max", "min", "Max", "Min")},
        "integral": lambda inner, *ends: sp.Integral(inner, (t, *ends)),
    }
    named = [*metadata.states, *metadata.coordinates, *dict(metadata.definitions)]
    listed = f"names are {listing(named)}"
    try:
        return parse_expression(
            output,
            names,
            where=f"output {quote(name)}",
            further=further,
            unknown_name_remedy=listed,
        )
    except ProblemError as error:
        remedy = error.remedy or listed
        raise OptionError(error.message, term=output, remedy=remedy) from None


def _extreme(name: str) -> Callable[..., sp.Expr]:
    """``Max`` or ``Min`` of several arguments; of one alone, the user meant the one over time."""

    def function(*arguments: sp.Expr) -> sp.Expr:
        if len(arguments) == 1:
            raise ProblemError(
                f"{quote(f'{name}({arguments[0]})')} is of one argument",
                term=arguments[0],
                remedy=f"write {name.lower()}imum(...) for the one over time",
            )
        return {"Max": sp.Max, "Min": sp.Min}[name.title()](*arguments)

    return function


def _function(
    arguments: str, expressions: Sequence[sp.Expr], names: Mapping[sp.Symbol, str]
) -> WrittenFunction:
    """A function of arrays from expressions."""
    texts = tuple(numpy_text(stable(expression), dict(names)) for expression in expressions)
    called = {node.written(): type(node)._imp_ for node in known_applied(expressions)}
    return WrittenFunction(arguments, texts, called)
