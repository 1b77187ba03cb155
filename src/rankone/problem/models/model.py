"""A model that was read from a file: symbols, nominal values, and the problems made of it."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import sympy as sp

from rankone.problem.expressions.notation import text_of
from rankone.problem.models.elements import Definitions, Happening, expanded, reached
from rankone.problem.models.model_events import StartingPoint, events_of
from rankone.problem.problem import Problem
from rankone.support.errors import ProblemError, count, did_you_mean, listing, quote, shown
from rankone.support.options import checked_number
from rankone.tensors.coordinates import name_of

LARGEST_SPREAD = 1e6  # Factor by which an interval goes beyond the nominal value
_FACTOR_REMEDY = "give an interval: parameters={name: (lower, upper)}"


@dataclass(frozen=True, eq=False, repr=False)
class Model:
    """A model from a file, with nominal values for all its parameters.

    Attributes
    ----------
    name : str or None
        The title of the model.
    time : Symbol
        The time.
    rates : mapping of Symbol to Expr
        For each state its rate, in symbols of states, parameters, definitions and time.
    initial : mapping of Symbol to Expr
        For each state its value at the start.
    definitions : mapping of Symbol to Expr
        Rules, rates of reactions, and concentrations in compartments that change; each behind
        those that it refers to.
    numbers : mapping of Symbol to Rational or None
        Nominal values as exact numbers; None where the file has none.
    happenings : tuple of Happening
        The events of the file, in terms of states.
    constraints : mapping of Symbol to Expr
        For each state that an algebraic rule determines what vanishes.
    units : mapping of str to str
        Units by name, as far as the file has them.
    start : Symbol
        Stands for the time of the start in ``initial`` and ``definitions``.
    """

    name: str | None
    time: sp.Symbol
    rates: Definitions
    initial: Definitions
    definitions: Definitions
    numbers: Mapping[sp.Symbol, sp.Rational | None]
    happenings: tuple[Happening, ...] = ()
    constraints: Definitions = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    start: sp.Symbol = field(default_factory=lambda: sp.Dummy("start"))

    @cached_property
    def unknowns(self) -> tuple[sp.Expr, ...]:
        """The unknowns of the problems, functions of time."""
        return tuple(self._functions.values())

    @cached_property
    def parameters(self) -> dict[str, float]:
        """Nominal values by name; NaN where the file has none.

        Besides the constants of the file there are initial values: ``S1_0`` is that of ``S1``, an
        amount or a concentration as the file gives it. Local parameters of a reaction have its name
        before their own: ``R1_k``.
        """
        return {
            symbol.name: math.nan if value is None else float(value)
            for symbol, value in self.numbers.items()
        }

    @cached_property
    def _functions(self) -> dict[sp.Symbol, sp.Expr]:
        return {symbol: sp.Function(symbol.name)(self.time) for symbol in self._states}

    @cached_property
    def _states(self) -> tuple[sp.Symbol, ...]:
        return (*self.rates, *self.constraints)

    def expression(self, name: object) -> sp.Expr:
        """What a name of the model stands for, in unknowns, parameters and time.

        For :meth:`Solution.output`: the rate of a reaction, an assignment rule, a concentration.
        """
        symbol = self._symbol(name)
        if symbol in self._functions:
            return self._functions[symbol]
        return self._full(symbol)

    def in_states(self, expression: sp.Expr) -> sp.Expr:
        """An expression of names of the model in states and numbers, which are symbols.

        Names that the model does not have stay as they are; the time is the symbol ``time``.
        """
        symbols = {s.name: s for s in (*self._states, *self.definitions, *self.numbers)}
        written = {s: symbols[s.name] for s in expression.free_symbols if s.name in symbols}
        full = expression.xreplace(written).xreplace(self._expanded)
        return full.xreplace({self.time: sp.Symbol("time"), self.start: sp.S.Zero})

    def with_numbers(self, numbers: Mapping[str, float]) -> Model:
        """The model with other nominal values of some parameters."""
        exact = {sp.Symbol(name): sp.Rational(repr(float(x))) for name, x in numbers.items()}
        return replace(self, numbers={**self.numbers, **exact}) if exact else self

    @cached_property
    def used(self) -> frozenset[str]:
        """Names of the parameters that rates or initial values depend on."""
        return self.depends_on({})

    def depends_on(self, constants: Mapping[str, float]) -> frozenset[str]:
        """The names used where some parameters have numbers; factors of zero make others vanish."""
        exact = {sp.Symbol(name): sp.Rational(repr(float(x))) for name, x in constants.items()}
        formulas = [*self.rates.values(), *self.constraints.values(), *self.initial.values()]
        expanded = (e.xreplace(self._expanded).xreplace(exact) for e in formulas)
        symbols = {symbol for e in expanded for symbol in e.free_symbols}
        return frozenset(symbol.name for symbol in symbols & set(self.numbers))

    @cached_property
    def _expanded(self) -> dict[sp.Symbol, sp.Expr]:
        return expanded(self.definitions)

    def _symbol(self, name: object) -> sp.Symbol:
        symbols = {s.name: s for s in (*self._states, *self.definitions, *self.numbers)}
        text = name_of(name)
        if text not in symbols:
            raise ProblemError(
                f"the model has no {quote(text)}{did_you_mean(text, symbols)}", term=name
            )
        return symbols[text]

    def problem(
        self,
        parameters: Mapping[Any, Any] | Iterable[Any] = (),
        *,
        time: tuple[float, float],
        spread: float | None = None,
    ) -> Problem:
        """A problem in which some parameters are free and all others have nominal values.

        Parameters
        ----------
        parameters : mapping of str to (float, float) or distribution, or list of str
            The box, as :class:`Problem` takes it, by names of :attr:`parameters`; or names alone,
            whose intervals go from the nominal value ÷ ``spread`` to × ``spread``.
        time : (float, float)
            Start and end. Initial values are those at the start.
        spread : float, optional
            The factor for a list of names, larger than 1.

        Raises
        ------
        ProblemError
            If a name is not that of a parameter, a nominal value is missing that counts, or the
            problem is not well posed.
        """
        start, end = _horizon(time)
        box = self._box(parameters, spread)
        functions = self._functions
        decided = {self.start: sp.Rational(repr(start))}
        self._check_happenings()
        point = self._starting_point(start, decided)
        while decisive := self._decisive(point, box, decided):
            decided |= decisive
            point = self._starting_point(start, decided)

        def full(expression: sp.Basic) -> sp.Basic:
            return self._full(expression).xreplace(decided)

        unknowns = {symbol.name: unknown for symbol, unknown in functions.items()}
        events, memory = events_of(self.happenings, full, unknowns, point)
        written = {**functions, **decided}
        rates = {functions[s]: e.xreplace(written) for s, e in self.rates.items()}
        rates |= dict.fromkeys(memory, sp.S.Zero)
        vanishing = [e.xreplace(written) for e in self.constraints.values()]
        initial = {**point.initial, **dict.fromkeys(memory, sp.S.Zero)}
        definitions, constants = self._shorthand(written, box)
        full_rates = [*point.rates.values(), *map(full, self.constraints.values())]
        self._check_numbers([*full_rates, *point.initial.values()], box)
        names = {self.time.name, *map(name_of, (*rates, *box, *definitions, *constants))}
        return Problem(
            equations=[
                *(
                    sp.Eq(unknown.diff(self.time), rate, evaluate=False)
                    for unknown, rate in rates.items()
                ),
                *(sp.Eq(0, residual, evaluate=False) for residual in vanishing),
            ],
            time=(self.time, start, end),
            parameters=box,
            initial=initial,
            name=self.name,
            units={name: unit for name, unit in self.units.items() if name in names},
            events=events,
            constants=constants,
            definitions=definitions,
        )

    def _check_happenings(self) -> None:
        """Raise if an event depends on what a constraint determines: its start is not known yet."""
        for each in self.happenings:
            formulas = [each.trigger, each.delay, each.priority, *each.then.values()]
            symbols = {
                s
                for e in formulas
                if e is not None
                for s in e.xreplace(self._expanded).free_symbols
            }
            for symbol in sorted(symbols & {*self.constraints}, key=str):
                raise ProblemError(
                    f"{each.label} depends on {quote(symbol)}, which an algebraic rule determines "
                    "that is not linear in it",
                    term=each.name,
                    remedy="write an assignment rule",
                )

    def _full(self, expression: sp.Basic) -> sp.Basic:
        """An expression or condition in unknowns and numbers, without definitions."""
        return expression.xreplace(self._expanded).xreplace(self._functions)

    def _starting_point(self, start: float, decided: Mapping[sp.Symbol, sp.Expr]) -> StartingPoint:
        """Where trajectories start; ``decided`` has what is put in for some numbers."""
        initial, rates = (
            {
                self._functions[symbol]: self._full(expression).xreplace(decided)
                for symbol, expression in table.items()
            }
            for table in (self.initial, self.rates)
        )
        return StartingPoint(self.time, start, initial, rates)

    def _decisive(
        self,
        point: StartingPoint,
        box: Mapping[sp.Symbol, Any],
        decided: Mapping[sp.Symbol, sp.Expr],
    ) -> dict[sp.Symbol, sp.Rational]:
        """Further numbers that tell which triggers hold at the start, fixed from then on."""
        triggers = [self._full(each.trigger).xreplace(decided) for each in self.happenings]
        at_start = [truth(each) for each in triggers for truth in (point.value, point.after)]
        symbols = set().union(*(truth.free_symbols for truth in at_start))
        numbers = {s: value for s, value in self.numbers.items() if s in symbols - set(box)}
        return {symbol: value for symbol, value in numbers.items() if value is not None}

    def _shorthand(
        self, written: Mapping[sp.Symbol, sp.Expr], box: Mapping[sp.Symbol, Any]
    ) -> tuple[dict[sp.Symbol, sp.Expr], dict[sp.Symbol, sp.Rational]]:
        """The definitions and constants of a problem, without those that lack a number."""
        constants = {
            symbol: value
            for symbol, value in self.numbers.items()
            if value is not None and symbol not in box and symbol not in written
        }
        missing = {s for s, value in self.numbers.items() if value is None and s not in box}
        definitions = {
            symbol: expression.xreplace(written)
            for symbol, expression in self.definitions.items()
            if not self._expanded[symbol].free_symbols & missing
        }
        return definitions, constants

    def _check_numbers(self, expressions: Iterable[sp.Expr], box: Collection[sp.Symbol]) -> None:
        """Raise if an expression has a parameter without a number that is not free."""
        missing = {s for s, value in self.numbers.items() if value is None and s not in box}
        for expression in expressions:
            for symbol in sorted(expression.free_symbols & missing, key=str):
                raise ProblemError(
                    f"the file has no value for {quote(symbol)}",
                    term=symbol,
                    remedy=f"give its interval in `parameters`, for example {{{symbol}: (1, 2)}}",
                )

    # -- the box ----------------------------------------------------------------------------------

    def _box(self, parameters: object, spread: float | None) -> dict[sp.Symbol, Any]:
        """The intervals by symbol."""
        if isinstance(parameters, str) or not isinstance(parameters, Iterable):
            raise ProblemError(
                f"parameters are {shown(parameters)}, neither a mapping nor a list of names",
                term=parameters,
                remedy='write {"k": (0.5, 2)}, or ["k"] with spread=1.5',
            )
        if isinstance(parameters, Mapping):
            if spread is not None:
                raise ProblemError(
                    "`spread` is for a list of names; the parameters have intervals",
                    term=spread,
                    remedy="leave it out, or give the names alone",
                )
            return {self._parameter(name): bounds for name, bounds in parameters.items()}
        names = list(parameters)
        if names and spread is None:
            raise ProblemError(
                "parameters are names without intervals",
                term=names,
                remedy="give spread=1.5 for nominal values ÷ 1.5 to × 1.5, or intervals",
            )
        return {symbol: self._spread(symbol, spread) for symbol in map(self._parameter, names)}

    def _spread(self, symbol: sp.Symbol, spread: float | None) -> tuple[float, float]:
        """The interval around a nominal value."""
        factor = checked_number("spread", spread, 1.0, LARGEST_SPREAD, float)
        nominal = self.parameters[symbol.name]
        if math.isnan(nominal) or nominal == 0.0 or factor == 1.0:
            what = "spread is 1" if factor == 1.0 else f"{quote(symbol)} is {nominal:g} in the file"
            what = f"the file has no value for {quote(symbol)}" if math.isnan(nominal) else what
            raise ProblemError(
                f"{what}: there is no interval around it", term=symbol, remedy=_FACTOR_REMEDY
            )
        lower, upper = sorted((nominal / factor, nominal * factor))
        return lower, upper

    def _parameter(self, name: object) -> sp.Symbol:
        """The symbol of a parameter; an error says what else a name is."""
        text = name_of(name)
        symbols = {symbol.name: symbol for symbol in self.numbers}
        if text in symbols:
            return symbols[text]
        by_name = {s.name: s for s in (*self._states, *self.definitions)}
        message, remedy = f"the model has no parameter {quote(text)}", "see `model.parameters`"
        if text in by_name:
            fault = "an unknown" if by_name[text] in self._states else "computed from others"
            table = self.initial if by_name[text] in self._states else self.definitions
            origins = self._origins(table[by_name[text]])
            message += f": it is {fault}"
            remedy = f"vary {listing(origins)}" if origins else remedy
        else:
            message += did_you_mean(text, symbols)
        raise ProblemError(message, term=name, remedy=remedy)

    def _origins(self, expression: sp.Expr) -> list[str]:
        """The parameters that an expression depends on."""
        symbols = expression.xreplace(self._expanded).free_symbols & set(self.numbers)
        return sorted(symbol.name for symbol in symbols)

    # -- text -------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        title = "Model" if self.name is None else f"Model {self.name!r}"
        lines = [
            f"{title}: {count(len(self._states), 'unknown')}, "
            f"{count(len(self.numbers), 'parameter')}, {count(len(self.happenings), 'event')}"
        ]
        used = reached([*self.rates.values(), *self.constraints.values()], self.definitions)
        lines += [f"  {s} = {text_of(e)}" for s, e in self.definitions.items() if s in used]
        lines += [f"  d{symbol}/dt = {text_of(rate)}" for symbol, rate in self.rates.items()]
        lines += [f"  0 = {text_of(residual)}" for residual in self.constraints.values()]
        lines += [f"  {s}({self.time}0) = {text_of(e)}" for s, e in self.initial.items()]
        lines += [f"  {name} = {value:g}" for name, value in self.parameters.items()]
        lines += [f"  {each.name}: when {each.trigger}" for each in self.happenings]
        return "\n".join(lines)


def _horizon(time: object) -> tuple[float, float]:
    """Start and end as numbers; :class:`Problem` checks the order."""
    if isinstance(time, tuple | list) and len(time) == 2:
        start, end = time
        if all(isinstance(at, int | float) and math.isfinite(at) for at in (start, end)):
            return float(start), float(end)
    raise ProblemError(f"time is {shown(time)}", term=time, remedy="give time=(start, end)")
