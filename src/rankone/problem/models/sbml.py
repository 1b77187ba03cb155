"""SBML and Antimony files as models: their elements assembled to a system.

A species is followed by what its id means in formulas, a concentration or an amount. Where its
compartment changes, its amount is followed instead, and defines the concentration.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from os import PathLike
from typing import TYPE_CHECKING

import sympy as sp

from rankone.problem.models.elements import (
    Elements,
    Happening,
    Quantity,
    Species,
    elements_of,
    ordered,
    rate_of,
    unused,
    with_free_starts,
)
from rankone.problem.models.model import Model
from rankone.problem.models.sbml_formulas import members, open_document, sbml_library
from rankone.support.errors import ProblemError, bounded_depth, listing, quote

if TYPE_CHECKING:
    import libsbml


class Assembly:
    """What follows from the elements of a model.

    Attributes
    ----------
    time, start : Symbol
        The time, and a stand-in for the time at which it starts.
    rates : dict of Symbol to Expr
        For each state its rate.
    constraints : dict of Symbol to Expr
        For each state that an algebraic rule determines what vanishes.
    definitions : dict of Symbol to Expr
        What is determined at any time by states, numbers and time; each behind those that it
        refers to.
    initial : dict of Symbol to Expr
        For each state its value at the start, an expression of numbers and the start.
    numbers : dict of Symbol to Rational or None
        What is given as a number; None where the file leaves it out.
    """

    def __init__(self, elements: Elements) -> None:
        self.elements = elements
        self.time, self.start = elements.vocabulary.time, sp.Dummy("start")
        self.numbers: dict[sp.Symbol, sp.Rational | None] = dict(elements.reactions.local)
        self._starts: dict[sp.Symbol, sp.Expr] = {}
        self._rate_names = {symbol: name for name, symbol in elements.vocabulary.rates.items()}
        self._changing = self._changing_ids()
        self._states = {
            name: self._state(name) for name in elements.quantities if self._moves(name)
        }
        self._givens = {
            name: self._given(quantity)
            for name, quantity in elements.quantities.items()
            if name not in elements.rules.assigned and name not in elements.rules.starts
        }
        algebraic = elements.rules.algebraic
        self.rates = {
            s: self._rate(name) for name, s in self._states.items() if name not in algebraic
        }
        self.constraints = {self._implicit(name): e for name, e in algebraic.items()}
        self.definitions = self._all_definitions()
        self.initial = {symbol: self._initial(name) for name, symbol in self._states.items()}

    @property
    def start_numbers(self) -> dict[str, sp.Symbol]:
        """The symbols of the numbers at which ids start, except where a formula decides."""
        return self._givens

    def happenings(self) -> tuple[Happening, ...]:
        """The events, which reset states.

        A concentration that is set gives an amount in the compartment as it is before the event.
        """
        return tuple(self._of_states(happening) for happening in self.elements.happenings)

    def _of_states(self, happening: Happening) -> Happening:
        """An event that resets the states which follow ids."""
        sizes = {}
        for name in happening.then:
            quantity = self.elements.quantities[name]
            if isinstance(quantity, Species) and self._by_amount(quantity):
                sizes[self._states[name].name] = sp.Symbol(quantity.compartment)
        then = {self._states[name].name: value for name, value in happening.then.items()}
        return replace(happening, then=then, sizes=sizes)

    # -- what changes -----------------------------------------------------------------------------

    def _changing_ids(self) -> set[str]:
        """The ids that have rates or are reset; an error for one that is determined twice."""
        rules, changes = self.elements.rules, self.elements.reactions.changes
        reset = {name for happening in self.elements.happenings for name in happening.then}
        for name in sorted({*rules.assigned, *rules.rates, *changes, *reset}):
            quantity = self.elements.quantities.get(name)
            ways = [
                word
                for word, determined in (
                    ("an assignment rule", rules.assigned),
                    ("a rate rule", rules.rates),
                    ("reactions", changes),
                )
                if name in determined
            ]
            if quantity is None:
                raise ProblemError(f"an event resets the unknown id {quote(name)}", term=name)
            if name in reset and name in rules.assigned:
                ways.append("an event")
            if len(ways) > 1:
                raise ProblemError(
                    f"{quantity.label} is determined both by {ways[0]} and by {ways[1]}",
                    term=name,
                    remedy="leave one of them out",
                )
        return {*rules.rates, *changes, *reset, *rules.algebraic} or self._unchanged()

    def _unchanged(self) -> set[str]:
        """What is followed if nothing changes: what may do so, or else everything."""
        quantities, assigned = self.elements.quantities, self.elements.rules.assigned
        free = {name for name in quantities if name not in assigned}
        if not free:
            content = f"rules alone, for {listing(sorted(assigned))}" if assigned else "no elements"
            raise ProblemError(
                f"the model has {content}: nothing in it has a rate of change",
                term=sorted(assigned),
                remedy="evaluate its formulas; there is nothing to integrate",
            )
        return {name for name in free if not quantities[name].constant} or free

    def _moves(self, name: str) -> bool:
        return name in self._changing

    def _state(self, name: str) -> sp.Symbol:
        """The state that follows a quantity."""
        quantity = self.elements.quantities[name]
        if self._by_amount(quantity):
            return sp.Symbol(unused(f"{name}_amount", self.elements.taken))
        return sp.Symbol(name)

    def _implicit(self, name: str) -> sp.Symbol:
        """The state that an algebraic rule determines."""
        symbol, quantity = self._states[name], self.elements.quantities[name]
        sized = {each.compartment for each in self.elements.quantities.values()
                 if isinstance(each, Species)}  # fmt: skip
        if symbol.name != name or name in sized:
            raise ProblemError(
                f"{quantity.label} is determined by an algebraic rule that is not linear in it, "
                "and a compartment changes",
                term=name,
                remedy="write an assignment rule",
            )
        return symbol

    def _by_amount(self, quantity: Quantity) -> bool:
        """Whether this is a concentration in a compartment that changes."""
        if not isinstance(quantity, Species) or quantity.only_amounts:
            return False
        home = quantity.compartment
        return self._moves(home) or home in self.elements.rules.assigned

    def _rate(self, name: str) -> sp.Expr:
        """The rate of the state that follows a quantity."""
        rules, changes = self.elements.rules, self.elements.reactions.changes
        quantity = self.elements.quantities[name]
        size = sp.Symbol(quantity.compartment) if isinstance(quantity, Species) else sp.S.One
        if name in rules.rates and self._by_amount(quantity):
            growth = self.elements.vocabulary.rates[str(size)]
            return rules.rates[name] * size + sp.Symbol(name) * growth
        if name in rules.rates:
            return rules.rates[name]
        change = changes.get(name, sp.S.Zero)
        is_amount = not isinstance(quantity, Species) or quantity.only_amounts
        return change if is_amount or self._by_amount(quantity) else change / size

    # -- the start --------------------------------------------------------------------------------

    def _given(self, quantity: Quantity) -> sp.Symbol:
        """The symbol of the number that the file gives a quantity at the start.

        It is the id itself where nothing changes, and the number is what the id means.
        """
        own = not isinstance(quantity, Species) or (
            quantity.starts_as_amount == quantity.only_amounts and not self._by_amount(quantity)
        )
        name = quantity.name
        if not own or self._moves(name):
            name = unused(f"{name}_0", self.elements.taken)
        symbol = sp.Symbol(name)
        self.numbers[symbol] = quantity.start
        return symbol

    def _first_value(self, name: str) -> sp.Expr:
        """What an id means at the start."""
        rules, quantity = self.elements.rules, self.elements.quantities[name]
        for table in (rules.assigned, rules.starts):
            if name in table:
                return self.at_start(table[name])
        start = self._givens[name]
        if not isinstance(quantity, Species) or quantity.starts_as_amount == quantity.only_amounts:
            return start
        size = self.at_start(sp.Symbol(quantity.compartment))
        return start / size if quantity.starts_as_amount else start * size

    def at_start(self, expression: sp.Expr) -> sp.Expr:
        """The value of an expression at the start, in terms of numbers and the start."""
        symbols = sorted(expression.free_symbols, key=str)
        return expression.xreplace({symbol: self._at_start(symbol) for symbol in symbols})

    def _at_start(self, symbol: sp.Symbol) -> sp.Expr:
        if symbol == self.time:
            return self.start
        if symbol in self.numbers or symbol == self.start:
            return symbol
        if symbol in self._starts:
            if self._starts[symbol] is sp.nan:
                raise ProblemError(
                    f"the initial value of {quote(symbol)} depends on itself",
                    term=symbol,
                    remedy="let the initial assignments determine one after the other",
                )
            return self._starts[symbol]
        self._starts[symbol] = sp.nan
        value = self._value_at_start(symbol)
        self._starts[symbol] = value
        return value

    def _value_at_start(self, symbol: sp.Symbol) -> sp.Expr:
        name = symbol.name
        if name in self.elements.quantities:
            return self._first_value(name)
        if name in self.elements.reactions.laws:
            return self.at_start(self.elements.reactions.laws[name])
        return self.at_start(self._change(sp.Symbol(self._rate_names[symbol])))

    def _initial(self, name: str) -> sp.Expr:
        """The initial value of the state that follows a quantity."""
        quantity, value = self.elements.quantities[name], self._at_start(sp.Symbol(name))
        if isinstance(quantity, Species) and self._states[name].name != name:
            value = value * self.at_start(sp.Symbol(quantity.compartment))
        return value

    # -- definitions ------------------------------------------------------------------------------

    def _all_definitions(self) -> dict[sp.Symbol, sp.Expr]:
        """Rates of reactions, rules, concentrations of amounts, values of initial assignments."""
        elements = self.elements
        tables = (elements.reactions.laws, elements.rules.assigned)
        definitions = {sp.Symbol(name): e for table in tables for name, e in table.items()}
        for name, quantity in elements.quantities.items():
            symbol = sp.Symbol(name)
            if name in elements.rules.assigned or symbol in self._followed:
                continue
            if isinstance(quantity, Species) and self._by_amount(quantity):
                definitions[symbol] = self._amount(name) / sp.Symbol(quantity.compartment)
            else:
                definitions[symbol] = self._at_start(symbol)
        self.definitions = definitions
        return ordered(self._with_rates(definitions))

    @property
    def _followed(self) -> set[sp.Symbol]:
        """States and numbers, which need no definition."""
        return {*self.rates, *self.constraints, *self.numbers}

    def _amount(self, name: str) -> sp.Expr:
        """The amount of a species in a compartment that changes."""
        return self._states[name] if self._moves(name) else self._initial_amount(name)

    def _initial_amount(self, name: str) -> sp.Expr:
        quantity = self.elements.quantities[name]
        assert isinstance(quantity, Species)
        size = self.at_start(sp.Symbol(quantity.compartment))
        return self._at_start(sp.Symbol(name)) * size

    def _with_rates(self, definitions: dict[sp.Symbol, sp.Expr]) -> dict[sp.Symbol, sp.Expr]:
        """Definitions with those of the rates of change that formulas ask for."""
        happenings = self.elements.happenings
        formulas = [*definitions.values(), *self.rates.values(), *self.constraints.values()]
        formulas += [e for each in happenings for e in (*each.then.values(), each.trigger)]
        formulas += [e for each in happenings for e in (each.delay, each.priority) if e is not None]
        waiting = set().union(*(formula.free_symbols for formula in formulas))
        complete = dict(definitions)
        while waiting:
            symbol = waiting.pop()
            if symbol in self._rate_names and symbol not in complete:
                complete[symbol] = self._change(sp.Symbol(self._rate_names[symbol]))
                waiting |= complete[symbol].free_symbols
        return complete

    def _change(self, symbol: sp.Symbol) -> sp.Expr:
        """The rate of change of what a symbol stands for."""
        if symbol in self.numbers or symbol == self.start:
            return sp.S.Zero
        if symbol in self.rates:
            return self.rates[symbol]
        if symbol in self.constraints:
            raise ProblemError(
                f"a formula asks for the rate of change of {quote(symbol)}, which an algebraic "
                "rule determines that is not linear in it",
                term=symbol,
                remedy="write an assignment rule",
            )
        if symbol in self._rate_names:
            expression = self._change(sp.Symbol(self._rate_names[symbol]))
        else:
            expression = self.definitions[symbol]
        return rate_of(expression, self.time, self._change)


# -----------------------------------------------------------------------------
# SBML and Antimony files as models, and the units they declare.


_SYMBOLS = {
    "mole": "mol",
    "litre": "L",
    "liter": "L",
    "second": "s",
    "metre": "m",
    "meter": "m",
    "gram": "g",
    "kilogram": "kg",
    "kelvin": "K",
    "item": "item",
    "dimensionless": "1",
    "ampere": "A",
    "volt": "V",
    "joule": "J",
    "newton": "N",
    "pascal": "Pa",
    "hertz": "Hz",
    "watt": "W",
    "coulomb": "C",
}
_PREFIXES = {
    -15: "f",
    -12: "p",
    -9: "n",
    -6: "µ",
    -3: "m",
    -2: "c",
    -1: "d",
    0: "",
    3: "k",
    6: "M",
    9: "G",
}


def units_of(model: libsbml.Model, time: str) -> dict[str, str]:
    """Units of quantities by id, and of time by its name, as far as the model gives them."""
    quantities = [
        *members(model.getListOfSpecies()),
        *members(model.getListOfParameters()),
        *members(model.getListOfCompartments()),
    ]
    pairs = [(each.getId(), unit_text(each.getDerivedUnitDefinition())) for each in quantities]
    pairs.append((time, _named(model, model.getTimeUnits())))
    return {name: text for name, text in pairs if text}


def _named(model: libsbml.Model, name: str) -> str:
    """The unit of a name: one of the model's definitions, or a unit itself."""
    definition = model.getUnitDefinition(name) if name else None
    return unit_text(definition) if definition is not None else _SYMBOLS.get(name, name)


def unit_text(definition: libsbml.UnitDefinition) -> str:
    """A unit such as ``µmol/L``; empty if there is none, or it is a plain number."""
    if definition is None:
        return ""
    above: list[str] = []
    below: list[str] = []
    for unit in members(definition.getListOfUnits()):
        exponent = unit.getExponentAsDouble()
        symbol = _unit_symbol(unit)
        if symbol == "1" or exponent == 0.0:
            continue
        power = f"^{abs(exponent):g}" if abs(exponent) != 1.0 else ""
        (above if exponent > 0.0 else below).append(symbol + power)
    if not above and not below:
        return ""
    text = "*".join(above) or "1"
    return "/".join([text, *below])


def _unit_symbol(unit: libsbml.Unit) -> str:
    """The symbol of a unit with its prefix: ``µmol``, or ``(60 s)`` where none fits."""
    name: str = sbml_library().UnitKind_toString(unit.getKind())
    symbol = _SYMBOLS.get(name, name)
    factor, scale = unit.getMultiplier(), unit.getScale()
    if symbol == "1":
        return "1"
    if factor == 1.0 and scale in _PREFIXES:
        return _PREFIXES[scale] + symbol
    return f"({factor * 10.0**scale:g} {symbol})"


# -----------------------------------------------------------------------------
# SBML and Antimony files as models.


def read_sbml(path: str | PathLike[str]) -> Model:
    """Read a model from an SBML file, or from Antimony text.

    Compartments, species, parameters, reactions, rules, initial assignments, function definitions
    and events of Levels 1 to 3 are read, and submodels are put into one model. What is not
    supported, such as delay equations and fast reactions, is an error that names the element.

    Parameters
    ----------
    path : path
        A file that ends in ``.xml`` or ``.sbml``; or in ``.ant`` or ``.antimony``, which needs the
        package ``antimony``.

    Returns
    -------
    Model
        Its ``.problem(...)`` is a :class:`Problem`.

    Raises
    ------
    ProblemError
        If the file cannot be read, or an element is not supported.
    """
    return read_with_starts(path, ())[0]


def read_with_starts(
    path: str | PathLike[str], ids: Collection[str]
) -> tuple[Model, dict[str, str]]:
    """Read a model in which some ids start at numbers of their own, without initial assignments.

    Such a number means what the id means in formulas. Returns the model and the parameter of each
    of the ids; there is none for an id that a rule determines, or that the model does not have.
    """
    document, model = open_document(path)
    with bounded_depth():
        assembly = Assembly(with_free_starts(elements_of(model), ids))
        read = Model(
            name=model.getName() or model.getId() or None,
            time=assembly.time,
            rates=assembly.rates,
            constraints=assembly.constraints,
            initial=assembly.initial,
            definitions=assembly.definitions,
            numbers=assembly.numbers,
            happenings=assembly.happenings(),
            units=units_of(model, assembly.time.name),
            start=assembly.start,
        )
    del document  # the model lives as long as its document
    starts = assembly.start_numbers
    return read, {name: starts[name].name for name in ids if name in starts}
