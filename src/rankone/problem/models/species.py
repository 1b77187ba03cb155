"""The quantities of an SBML model and the reactions that change them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import sympy as sp

from rankone.problem.models.sbml_formulas import (
    Expressions,
    Formula,
    Vocabulary,
    exact_number,
    members,
)
from rankone.support.errors import ProblemError, quote

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
