"""The quantities of an SBML model: compartments, species, parameters and stoichiometries."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import sympy as sp

from rankone.models.mathml import exact_number, members
from rankone.support.errors import ProblemError
from rankone.support.wording import quote


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


def quantities_of(model: Any) -> dict[str, Quantity]:
    """All quantities of a libsbml model by their ids."""
    quantities = [
        *(_compartment(each) for each in members(model.getListOfCompartments())),
        *(_species(each, model) for each in members(model.getListOfSpecies())),
        *(_parameter(each) for each in members(model.getListOfParameters())),
        *_references(model),
    ]
    return {quantity.name: quantity for quantity in quantities}


def reference_label(reaction: Any, reference: Any) -> str:
    """How messages name a reactant or product of a reaction."""
    return f"reaction {quote(reaction.getId())}, species {quote(reference.getSpecies())},"


def references_of(reaction: Any) -> Iterator[tuple[int, Any]]:
    """The reactants of a reaction with -1, and its products with 1."""
    for reference in members(reaction.getListOfReactants()):
        yield -1, reference
    for reference in members(reaction.getListOfProducts()):
        yield 1, reference


def _number(is_set: bool, number: float, label: str) -> sp.Rational | None:
    """A number of the file; None if it is missing."""
    return exact_number(number, label) if is_set and not math.isnan(number) else None


def _compartment(compartment: Any) -> Quantity:
    name = compartment.getId()
    size = _number(compartment.isSetSize(), compartment.getSize(), f"compartment {quote(name)}")
    return Quantity(name, "compartment", size, compartment.getConstant())


def _parameter(parameter: Any) -> Quantity:
    name = parameter.getId()
    value = _number(parameter.isSetValue(), parameter.getValue(), f"parameter {quote(name)}")
    return Quantity(name, "parameter", value, parameter.getConstant())


def _species(species: Any, model: Any) -> Species:
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


def _references(model: Any) -> Iterator[Quantity]:
    """The stoichiometries that have ids."""
    for reaction in members(model.getListOfReactions()):
        for _, reference in references_of(reaction):
            if reference.isSetId():
                label = reference_label(reaction, reference)
                stoichiometry = reference.getStoichiometry()
                start = _number(reference.isSetStoichiometry(), stoichiometry, label)
                yield Quantity(reference.getId(), "stoichiometry", start, reference.getConstant())
