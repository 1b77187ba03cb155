"""All elements of an SBML model, read into SymPy: quantities, reactions, rules and events."""

from __future__ import annotations

import graphlib
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import sympy as sp
from sympy.logic.boolalg import Boolean
from sympy.matrices.exceptions import NonInvertibleMatrixError
from sympy.solvers.solveset import NonlinearError

from rankone.problem.models.sbml_formulas import (
    Expressions,
    Formula,
    Vocabulary,
    exact_number,
    members,
)
from rankone.support.errors import ProblemError, count, listing, quote

if TYPE_CHECKING:
    import libsbml


@dataclass(frozen=True)
class Quantity:
    """What an id of a model stands for.

    Attributes
    ----------
    name : str
        The id.
    role : str
        ``"compartment"``, ``"species"``, ``"parameter"`` or ``"stoichiometry"``.
    start : Rational or None
        The value that the file gives it at the start; None if it gives none.
    constant : bool
        Whether the file says that nothing changes it.
    """

    name: str
    role: str
    start: sp.Rational | None
    constant: bool

    @property
    def label(self) -> str:
        """How messages name it: ``species `S1```."""
        return f"{self.role} {quote(self.name)}"


@dataclass(frozen=True)
class Species(Quantity):
    """A species; in formulas its id is an amount if ``only_amounts``, else a concentration.

    ``start`` is an amount if ``starts_as_amount``, else a concentration. ``factor`` is the id of
    its conversion factor, by which reactions change its amount.
    """

    compartment: str
    only_amounts: bool
    starts_as_amount: bool
    boundary: bool
    factor: str | None


def quantities_of(model: libsbml.Model) -> dict[str, Quantity]:
    """All quantities of a libsbml model by their ids."""
    quantities = [
        *(_compartment(each) for each in members(model.getListOfCompartments())),
        *(_species(each, model) for each in members(model.getListOfSpecies())),
        *(_parameter(each) for each in members(model.getListOfParameters())),
        *_references(model),
    ]
    return {quantity.name: quantity for quantity in quantities}


def reference_label(reaction: libsbml.Reaction, reference: libsbml.SpeciesReference) -> str:
    """How messages name a reactant or product of a reaction."""
    return f"reaction {quote(reaction.getId())}, species {quote(reference.getSpecies())},"


def references_of(reaction: libsbml.Reaction) -> Iterator[tuple[int, libsbml.SpeciesReference]]:
    """The reactants of a reaction with -1, and its products with 1."""
    for reference in members(reaction.getListOfReactants()):
        yield -1, reference
    for reference in members(reaction.getListOfProducts()):
        yield 1, reference


def _number(is_set: bool, number: float, label: str) -> sp.Rational | None:
    """A number of the file; None if it is missing."""
    return exact_number(number, label) if is_set and not math.isnan(number) else None


def _compartment(compartment: libsbml.Compartment) -> Quantity:
    name = compartment.getId()
    size = _number(compartment.isSetSize(), compartment.getSize(), f"compartment {quote(name)}")
    return Quantity(name, "compartment", size, compartment.getConstant())


def _parameter(parameter: libsbml.Parameter) -> Quantity:
    name = parameter.getId()
    value = _number(parameter.isSetValue(), parameter.getValue(), f"parameter {quote(name)}")
    return Quantity(name, "parameter", value, parameter.getConstant())


def _species(species: libsbml.Species, model: libsbml.Model) -> Species:
    name, label = species.getId(), f"species {quote(species.getId())}"
    compartment = model.getCompartment(species.getCompartment())
    if compartment is None:
        raise ProblemError(
            f"{label} is in the unknown compartment {quote(species.getCompartment())}", term=name
        )
    amount = _number(species.isSetInitialAmount(), species.getInitialAmount(), label)
    concentration = _number(
        species.isSetInitialConcentration(), species.getInitialConcentration(), label
    )
    factor = species.getConversionFactor() or model.getConversionFactor()
    return Species(
        name,
        "species",
        concentration if amount is None else amount,
        species.getConstant(),
        compartment=compartment.getId(),
        only_amounts=species.getHasOnlySubstanceUnits()
        or compartment.getSpatialDimensionsAsDouble() == 0.0,
        starts_as_amount=amount is not None,
        boundary=species.getBoundaryCondition(),
        factor=factor or None,
    )


def _references(model: libsbml.Model) -> Iterator[Quantity]:
    """The stoichiometries that have ids."""
    for reaction in members(model.getListOfReactions()):
        for _, reference in references_of(reaction):
            if reference.isSetId():
                label = reference_label(reaction, reference)
                stoichiometry = reference.getStoichiometry()
                start = _number(reference.isSetStoichiometry(), stoichiometry, label)
                yield Quantity(reference.getId(), "stoichiometry", start, reference.getConstant())


# -----------------------------------------------------------------------------
# The reactions of an SBML model: their rates, and what they change.


@dataclass(frozen=True)
class Reactions:
    """What the reactions of a model say.

    Attributes
    ----------
    laws : mapping of str to Expr
        For each reaction its rate, an amount by time.
    changes : mapping of str to Expr
        For each species that reactions change the rate of its amount, in symbols of reactions.
    local : mapping of Symbol to Rational or None
        Local parameters ``reaction_parameter`` and their numbers; None if the file has none.
    """

    laws: Expressions
    changes: Expressions
    local: Mapping[sp.Symbol, sp.Rational | None]


def reactions_of(
    model: libsbml.Model,
    vocabulary: Vocabulary,
    quantities: Mapping[str, Quantity],
    taken: set[str],
) -> Reactions:
    """Read all reactions; names of local parameters are added to those ``taken``."""
    laws: dict[str, sp.Expr] = {}
    changes: dict[str, sp.Expr] = {}
    local: dict[sp.Symbol, sp.Rational | None] = {}
    for reaction in members(model.getListOfReactions()):
        name = reaction.getId()
        subject = f"reaction {quote(name)}"
        if reaction.getFast():
            raise ProblemError(
                f"{subject} is fast, which is not supported",
                term=name,
                remedy="write its equilibrium as an assignment rule",
            )
        own = _local_parameters(reaction, subject, taken)
        local |= dict(own.values())
        names = {parameter: symbol for parameter, (symbol, _) in own.items()}
        laws[name] = _law(reaction, Formula(vocabulary, subject, names))
        for species, change in _changes(reaction, vocabulary, quantities):
            changes[species] = changes.get(species, sp.S.Zero) + change
    return Reactions(laws, changes, local)


def unused(name: str, taken: set[str]) -> str:
    """A name that is not taken yet, which it then is."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _local_parameters(
    reaction: libsbml.Reaction, subject: str, taken: set[str]
) -> dict[str, tuple[sp.Symbol, sp.Rational | None]]:
    """The local parameters of a reaction by their ids: their symbols and numbers."""
    law = reaction.getKineticLaw()
    if law is None:
        return {}
    local = {}
    for parameter in members(law.getListOfParameters()):
        name = parameter.getId()
        symbol = sp.Symbol(unused(f"{reaction.getId()}_{name}", taken))
        label = f"local parameter {quote(name)} of {subject}"
        is_set = parameter.isSetValue()
        local[name] = symbol, exact_number(parameter.getValue(), label) if is_set else None
    return local


def _law(reaction: libsbml.Reaction, formula: Formula) -> sp.Expr:
    law = reaction.getKineticLaw()
    if law is None or law.getMath() is None:
        raise ProblemError(
            f"{formula.subject} has no kinetic law",
            term=reaction.getId(),
            remedy="give its rate",
        )
    return formula.expression(law.getMath())


def _changes(
    reaction: libsbml.Reaction, vocabulary: Vocabulary, quantities: Mapping[str, Quantity]
) -> list[tuple[str, sp.Expr]]:
    """What a reaction adds to the rates of amounts of species."""
    rate = sp.Symbol(reaction.getId())
    changes = []
    for sign, reference in references_of(reaction):
        species = quantities.get(reference.getSpecies())
        if not isinstance(species, Species):
            label = f"reaction {quote(reaction.getId())}"
            name = reference.getSpecies()
            raise ProblemError(f"{label} has the unknown species {quote(name)}", term=name)
        if species.constant or species.boundary:
            continue
        change = sign * _stoichiometry(reaction, reference, vocabulary) * rate
        if species.factor is not None:
            change *= vocabulary.names[species.factor]
        changes.append((species.name, change))
    return changes


def _stoichiometry(
    reaction: libsbml.Reaction, reference: libsbml.SpeciesReference, vocabulary: Vocabulary
) -> sp.Expr:
    if reference.isSetId():
        return vocabulary.names[reference.getId()]
    label = reference_label(reaction, reference)
    if not reference.isSetStoichiometry():
        raise ProblemError(f"{label} has no stoichiometry", term=reference, remedy="give it")
    return exact_number(reference.getStoichiometry(), label)


# -----------------------------------------------------------------------------
# All elements of an SBML model, read into SymPy: definitions, rules and events.


Definitions = Mapping[sp.Symbol, sp.Expr]


def ordered(definitions: Definitions) -> dict[sp.Symbol, sp.Expr]:
    """The same, each behind those that it refers to; a ProblemError names a circle."""
    needs = {symbol: sorted(e.free_symbols, key=str) for symbol, e in definitions.items()}
    try:
        order = graphlib.TopologicalSorter(needs).static_order()
        return {symbol: definitions[symbol] for symbol in order if symbol in definitions}
    except graphlib.CycleError as error:
        circle = error.args[1][::-1]
        steps = (f"{quote(a)} needs {quote(b)}" for a, b in itertools.pairwise(circle))
        raise ProblemError(
            f"rules and rates of reactions go in a circle: {', '.join(steps)}",
            term=circle[0],
            remedy="let them determine one after the other",
        ) from None


def expanded(definitions: Definitions) -> dict[sp.Symbol, sp.Expr]:
    """Definitions in order, each with the earlier ones put in."""
    full: dict[sp.Symbol, sp.Expr] = {}
    for symbol, expression in definitions.items():
        full[symbol] = expression.xreplace(full)
    return full


def reached(expressions: list[sp.Basic], definitions: Definitions) -> dict[sp.Symbol, sp.Expr]:
    """The definitions, in order, that expressions refer to, directly or not."""
    needed: set[sp.Basic] = set().union(*(e.free_symbols for e in expressions))
    for symbol, expression in reversed(list(definitions.items())):
        if symbol in needed:
            needed |= expression.free_symbols
    return {symbol: e for symbol, e in definitions.items() if symbol in needed}


def rate_of(expression: sp.Expr, time: sp.Symbol, rate: Callable[[sp.Symbol], sp.Expr]) -> sp.Expr:
    """The rate of change of an expression of time and symbols, whose rates are given."""
    terms = [
        expression.diff(symbol) * (sp.S.One if symbol == time else rate(symbol))
        for symbol in sorted(expression.free_symbols, key=str)
    ]
    return sp.Add(*terms)


# -----------------------------------------------------------------------------
# The events of an SBML model, as the file has them.


@dataclass(frozen=True)
class Happening:
    """An event of a model: what happens each time its trigger becomes true.

    Attributes
    ----------
    name : str
        Its id, or ``event_0``, ``event_1``, ... by its position.
    trigger : Boolean
        The condition.
    held_before : bool
        Whether the trigger counts as true before the start; if not, and it holds there, the event
        happens at the start.
    then : mapping of str to Expr
        New values by id.
    delay, priority : Expr or None
        The time from the trigger to the reset; the highest priority is the first at one instant.
    persistent : bool
        Whether it happens although the trigger turns false during the delay.
    values_at_trigger : bool
        Whether the new values are taken at the trigger; else after the delay.
    sizes : mapping of str to Expr
        By what values are multiplied as they are set: concentrations by a size that changes.
    """

    name: str
    trigger: Boolean
    held_before: bool
    then: Expressions
    delay: sp.Expr | None
    priority: sp.Expr | None
    persistent: bool
    values_at_trigger: bool
    sizes: Expressions = field(default_factory=dict)

    @property
    def label(self) -> str:
        """How messages name it."""
        return f"event {quote(self.name)}"


def happenings_of(model: libsbml.Model, vocabulary: Vocabulary) -> tuple[Happening, ...]:
    """Read all events; one without a trigger or without assignments does nothing."""
    happenings = [
        _happening(event, position, vocabulary)
        for position, event in enumerate(members(model.getListOfEvents()))
    ]
    return tuple(each for each in happenings if each is not None)


def _happening(event: libsbml.Event, position: int, vocabulary: Vocabulary) -> Happening | None:
    name = event.getIdAttribute() or f"event_{position}"
    formula = Formula(vocabulary, f"event {quote(name)}")
    trigger = event.getTrigger()
    then = {
        assignment.getVariable(): formula.expression(assignment.getMath())
        for assignment in members(event.getListOfEventAssignments())
        if assignment.getMath() is not None
    }
    if trigger is None or trigger.getMath() is None:
        return None
    return Happening(
        name,
        formula.condition(trigger.getMath()),
        held_before=not trigger.isSetInitialValue() or trigger.getInitialValue(),
        then=then,
        delay=_optional(event.getDelay(), formula),
        priority=_optional(event.getPriority(), formula),
        persistent=not trigger.isSetPersistent() or trigger.getPersistent(),
        values_at_trigger=event.getUseValuesFromTriggerTime(),
    )


def _optional(element: libsbml.SBase, formula: Formula) -> sp.Expr | None:
    """The formula of a delay or priority, if there is one."""
    if element is None or element.getMath() is None:
        return None
    return formula.expression(element.getMath())


# -----------------------------------------------------------------------------
# Algebraic rules: those that are linear in what they determine become assignment rules.
#
# Others stay equations, and Newton's method finds what they determine.


def solved(
    rules: Rules,
    reactions: Reactions,
    quantities: Mapping[str, Quantity],
    reset: frozenset[str],
) -> tuple[Expressions, Expressions]:
    """Assignment rules for what algebraic rules determine, or for each what vanishes.

    These are what may change but has no rule and is neither changed by reactions nor ``reset`` by
    events. A ProblemError names the rules if they determine too little.
    """
    if not rules.algebraic:
        return {}, {}
    tables = (rules.assigned, reactions.laws)
    definitions = {sp.Symbol(name): e for table in tables for name, e in table.items()}
    full = expanded(ordered(definitions))
    residuals = [e.xreplace(full) for e in rules.algebraic.values()]
    determined = {*rules.assigned, *rules.rates, *reactions.changes, *reset}
    free = {name for name, each in quantities.items() if not each.constant} - determined
    present = sorted(
        {symbol for e in residuals for symbol in e.free_symbols if symbol.name in free}, key=str
    )
    labels = ", ".join(rules.algebraic)
    if len(present) != len(residuals):
        raise ProblemError(
            f"{labels}: {count(len(residuals), 'rule')} for what nothing else determines: "
            f"{listing(map(str, present)) or 'nothing'}",
            term=labels,
            remedy="write assignment rules",
        )
    try:
        matrix, right = sp.linear_eq_to_matrix(residuals, present)
        values = matrix.LUsolve(right)
    except NonlinearError:
        pairs = zip(present, rules.algebraic.values(), strict=True)
        return {}, {symbol.name: residual for symbol, residual in pairs}
    except (NonInvertibleMatrixError, ZeroDivisionError):
        raise ProblemError(
            f"{labels}: they do not determine {listing(map(str, present))}", term=labels
        ) from None
    return {symbol.name: value for symbol, value in zip(present, values, strict=True)}, {}


# -----------------------------------------------------------------------------
# The rules and initial assignments of an SBML model.


@dataclass(frozen=True)
class Rules:
    """What the rules of a model say, by the ids that they determine.

    Attributes
    ----------
    assigned : mapping of str to Expr
        The value at any time.
    rates : mapping of str to Expr
        The rate of change.
    starts : mapping of str to Expr
        The value at the start.
    algebraic : mapping of str to Expr
        What vanishes at any time, by a label for messages.
    """

    assigned: Expressions
    rates: Expressions
    starts: Expressions
    algebraic: Expressions


def rules_of(
    model: libsbml.Model, vocabulary: Vocabulary, quantities: Mapping[str, Quantity]
) -> Rules:
    """Read all rules and initial assignments; one without a formula says nothing."""
    assigned: dict[str, sp.Expr] = {}
    rates: dict[str, sp.Expr] = {}
    algebraic: dict[str, sp.Expr] = {}
    for position, rule in enumerate(members(model.getListOfRules()), 1):
        if rule.getMath() is None:
            continue
        if rule.isAlgebraic():
            name = rule.getIdAttribute() or str(position)
            label = f"algebraic rule {quote(name)}"
            algebraic[label] = Formula(vocabulary, label).expression(rule.getMath())
            continue
        name = rule.getVariable()
        what = "rate rule" if rule.isRate() else "assignment rule"
        subject = f"the {what} of {quote(name)}"
        _check_variable(name, subject, quantities)
        target = rates if rule.isRate() else assigned
        target[name] = Formula(vocabulary, subject).expression(rule.getMath())
    starts: dict[str, sp.Expr] = {}
    for assignment in members(model.getListOfInitialAssignments()):
        if assignment.getMath() is None:
            continue
        name = assignment.getSymbol()
        subject = f"the initial assignment of {quote(name)}"
        _check_variable(name, subject, quantities)
        starts[name] = Formula(vocabulary, subject).expression(assignment.getMath())
    return Rules(assigned, rates, starts, algebraic)


def _check_variable(name: str, subject: str, quantities: Mapping[str, Quantity]) -> None:
    if name not in quantities:
        raise ProblemError(
            f"{subject} determines {quote(name)}, which is no quantity of the model", term=name
        )


# -----------------------------------------------------------------------------
# All elements of an SBML model, read into SymPy.


@dataclass(frozen=True)
class Elements:
    """The elements of a model in terms of symbols.

    Attributes
    ----------
    quantities : mapping of str to Quantity
        By id.
    vocabulary : Vocabulary
        What the formulas may name.
    rules : Rules
        Rules and initial assignments; algebraic ones by the ids that they determine.
    reactions : Reactions
        Rates of reactions, and what they change.
    happenings : tuple of Happening
        The events.
    taken : set of str
        All names in use.
    """

    quantities: Mapping[str, Quantity]
    vocabulary: Vocabulary
    rules: Rules
    reactions: Reactions
    happenings: tuple[Happening, ...]
    taken: set[str]


def elements_of(model: libsbml.Model) -> Elements:
    """Read the elements of a libsbml model."""
    quantities = quantities_of(model)
    taken = {*quantities, *(each.getId() for each in members(model.getListOfReactions()))}
    functions = members(model.getListOfFunctionDefinitions())
    vocabulary = Vocabulary(
        names={name: sp.Symbol(name) for name in sorted(taken)},
        functions={f.getId(): f.getMath() for f in functions if f.getMath() is not None},
        time=sp.Symbol(unused("t", taken)),
        rates={name: sp.Symbol(unused(f"{name}_rate", taken)) for name in quantities},
    )
    rules = rules_of(model, vocabulary, quantities)
    reactions = reactions_of(model, vocabulary, quantities, taken)
    happenings = happenings_of(model, vocabulary)
    reset = frozenset(name for happening in happenings for name in happening.then)
    solutions, implicit = solved(rules, reactions, quantities, reset)
    rules = replace(rules, assigned={**rules.assigned, **solutions}, algebraic=implicit)
    return Elements(quantities, vocabulary, rules, reactions, happenings, taken)


def with_free_starts(elements: Elements, ids: Collection[str]) -> Elements:
    """The elements with a number for the start of some ids, in place of initial assignments.

    The number means what the id means in formulas. There is none yet where the file gives a formula
    or a number in other units.
    """
    rules = elements.rules
    quantities = dict(elements.quantities)
    for name in quantities.keys() & set(ids):
        quantity = quantities[name]
        if name in rules.starts:
            quantity = replace(quantity, start=None)
        if isinstance(quantity, Species) and quantity.starts_as_amount != quantity.only_amounts:
            quantity = replace(quantity, start=None, starts_as_amount=quantity.only_amounts)
        quantities[name] = quantity
    starts = {name: e for name, e in rules.starts.items() if name not in ids}
    return replace(elements, quantities=quantities, rules=replace(rules, starts=starts))
