"""The events of an SBML model, as the file has them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import sympy as sp
from sympy.logic.boolalg import Boolean

from rankone.models.mathml import Expressions, Formula, Vocabulary, members
from rankone.support.wording import quote


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


def happenings_of(model: Any, vocabulary: Vocabulary) -> tuple[Happening, ...]:
    """Read all events; one without a trigger or without assignments does nothing."""
    happenings = [
        _happening(event, position, vocabulary)
        for position, event in enumerate(members(model.getListOfEvents()))
    ]
    return tuple(each for each in happenings if each is not None)


def _happening(event: Any, position: int, vocabulary: Vocabulary) -> Happening | None:
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


def _optional(element: Any, formula: Formula) -> sp.Expr | None:
    """The formula of a delay or priority, if there is one."""
    if element is None or element.getMath() is None:
        return None
    return formula.expression(element.getMath())
