"""All elements of an SBML model, read into SymPy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import sympy as sp

from rankone.models.algebraic import solved
from rankone.models.happenings import Happening, happenings_of
from rankone.models.mathml import Vocabulary, members
from rankone.models.quantities import Quantity, quantities_of
from rankone.models.reactions import Reactions, reactions_of, unused
from rankone.models.rules import Rules, rules_of


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


def elements_of(model: Any) -> Elements:
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
