"""The reactions of an SBML model: their rates, and what they change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import sympy as sp

from rankone.models.mathml import Expressions, Formula, Vocabulary, exact_number, members
from rankone.models.quantities import Quantity, Species, reference_label, references_of
from rankone.support.errors import ProblemError
from rankone.support.wording import quote


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
    model: Any, vocabulary: Vocabulary, quantities: Mapping[str, Quantity], taken: set[str]
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
    reaction: Any, subject: str, taken: set[str]
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


def _law(reaction: Any, formula: Formula) -> sp.Expr:
    law = reaction.getKineticLaw()
    if law is None or law.getMath() is None:
        raise ProblemError(
            f"{formula.subject} has no kinetic law",
            term=reaction.getId(),
            remedy="give its rate",
        )
    return formula.expression(law.getMath())


def _changes(
    reaction: Any, vocabulary: Vocabulary, quantities: Mapping[str, Quantity]
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


def _stoichiometry(reaction: Any, reference: Any, vocabulary: Vocabulary) -> sp.Expr:
    if reference.isSetId():
        return vocabulary.names[reference.getId()]
    label = reference_label(reaction, reference)
    if not reference.isSetStoichiometry():
        raise ProblemError(f"{label} has no stoichiometry", term=reference, remedy="give it")
    return exact_number(reference.getStoichiometry(), label)
