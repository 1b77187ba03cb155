"""All elements of an SBML model, read into SymPy."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import sympy as sp

from rankone.models.algebraic import solved
from rankone.models.happenings import Happening, happenings_of
from rankone.models.mathml import Vocabulary, members
from rankone.models.quantities import Quantity, Species, quantities_of
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
