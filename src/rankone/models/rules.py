"""The rules and initial assignments of an SBML model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import sympy as sp

from rankone.models.mathml import Expressions, Formula, Vocabulary, members
from rankone.models.quantities import Quantity
from rankone.support.errors import ProblemError
from rankone.support.wording import quote


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


def rules_of(model: Any, vocabulary: Vocabulary, quantities: Mapping[str, Quantity]) -> Rules:
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
