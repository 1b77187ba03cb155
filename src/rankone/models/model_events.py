"""The events of a model as the events of a problem.

A trigger becomes what crosses zero from below. Values that are taken at the trigger and set after a
delay are kept in between: by further unknowns, whose rates are zero. An event at the start, which
crosses nothing, becomes one at a known time.
"""

from __future__ import annotations

import itertools
import keyword
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational
from sympy.logic.boolalg import Boolean

from rankone.frontend.events import Event, known_time
from rankone.models.happenings import Happening
from rankone.models.triggers import StartingPoint, surface
from rankone.support.errors import ProblemError

_FIRST = sp.Integer(10) ** 9
"""Priority of what keeps values: before anything else at the instant changes them."""


@dataclass(frozen=True)
class _Reset:
    """An event in the unknowns of a problem, before it is known what crosses zero."""

    happening: Happening
    name: str
    trigger: Boolean
    then: Mapping[sp.Expr, sp.Expr]
    sizes: Mapping[sp.Expr, sp.Expr]
    delay: sp.Expr | None
    priority: sp.Expr | None
    overlapping: bool = True

    @property
    def values(self) -> dict[sp.Expr, sp.Expr]:
        """What states are set to: concentrations times the sizes that the event leaves."""
        after = {state: size.xreplace(dict(self.then)) for state, size in self.sizes.items()}
        return {state: value * after.get(state, 1) for state, value in self.then.items()}

    def event(self, when: sp.Expr, name: str) -> Event:
        then = self.values
        persistent = self.happening.persistent
        return Event(
            when,
            "rising",
            then,
            name=name,
            delay=self.delay,
            priority=self.priority,
            persistent=persistent,
            overlapping=self.overlapping,
        )


def events_of(
    happenings: Iterable[Happening],
    finished: Callable[[Any], Any],
    unknowns: Mapping[str, sp.Expr],
    point: StartingPoint,
) -> tuple[list[Event], list[sp.Expr]]:
    """The events of a problem, and the further unknowns that keep values during delays.

    ``finished`` puts unknowns and numbers into the formulas of the model.
    """
    resets = [_finished(each, finished, unknowns) for each in happenings if each.then]
    _check_order(resets)
    events: list[Event] = []
    memory: list[sp.Expr] = []
    for reset in resets:
        if not _needs_memory(reset, resets, point):
            events += [*_at_start(reset, point), *_at_crossings(reset, point)]
            continue
        keeper, later = _kept(reset, point.time)
        if reset.delay is None:
            starting = [*_at_start(keeper, point), *_at_start(later, point)]
        else:
            starting = _at_start(_with_first_values(reset, point), point)
        crossings = [*_at_crossings(keeper, point), *_at_crossings(later, point)]
        if crossings or reset.delay is None:
            memory += keeper.then
        events += [*starting, *crossings]
    return events, memory


def _finished(
    happening: Happening, finished: Callable[[Any], Any], unknowns: Mapping[str, sp.Expr]
) -> _Reset:
    """An event in unknowns and numbers."""
    delay, priority = (
        None if each is None else finished(each) for each in (happening.delay, happening.priority)
    )
    name = happening.name + "_" * keyword.iskeyword(happening.name)
    then = {unknowns[state]: finished(value) for state, value in happening.then.items()}
    sizes = {unknowns[state]: finished(size) for state, size in happening.sizes.items()}
    return _Reset(happening, name, finished(happening.trigger), then, sizes, delay, priority)


def _check_order(resets: Sequence[_Reset]) -> None:
    """Raise where SBML leaves to chance which of two events at one instant is the first."""
    for a, b in itertools.combinations(resets, 2):
        if a.priority is None or a.priority != b.priority or a.trigger != b.trigger:
            continue
        both = a.then.keys() & b.then.keys()
        conflict = any(a.then[state] != b.then[state] for state in both)
        if conflict or not (a.happening.persistent and b.happening.persistent):
            raise ProblemError(
                f"{a.happening.label} and {b.happening.label} have the same trigger and priority: "
                "which of them is the first is left to chance",
                term=a.name,
                remedy="give them different priorities",
            )


def _needs_memory(reset: _Reset, resets: Iterable[_Reset], point: StartingPoint) -> bool:
    """Whether values are taken at the trigger, and may change until they are set."""
    if not reset.happening.values_at_trigger:
        return False
    if reset.delay is not None:
        return any(map(point.changes, reset.then.values()))
    read = sp.Tuple(*reset.then.values()).atoms(AppliedUndef)
    changed = {state for each in resets for state in each.then}
    return any(
        not read.isdisjoint(other.then) and _may_coincide(reset, other, changed, point)
        for other in resets
        if other is not reset
    )


def _may_coincide(a: _Reset, b: _Reset, changed: Set[sp.Expr], point: StartingPoint) -> bool:
    """Whether two events may happen at one instant other than by accident.

    That is so if they share a comparison, if one is set off by what events have ``changed``, or if
    their times are known and not known to differ.
    """
    comparisons, others = (each.trigger.atoms(Relational) for each in (a, b))
    states = sp.Tuple(a.trigger, b.trigger).atoms(AppliedUndef)
    if comparisons & others or states & changed:
        return True
    if states:
        return False
    times = [_known_instant(each, point) for each in (a, b)]
    return None in times or times[0] == times[1]


def _known_instant(reset: _Reset, point: StartingPoint) -> sp.Expr | None:
    """When an event happens, if a number is known for it."""
    if not point.changes(reset.trigger):
        return sp.S.Zero
    event = reset.event(surface(reset.trigger, point, reset.happening.label), reset.name)
    at = known_time(event, point.time)
    instant = None if at is None else at + (reset.delay or 0)
    return instant if instant is not None and instant.is_number else None


def _kept(reset: _Reset, time: sp.Symbol) -> tuple[_Reset, _Reset]:
    """An event that keeps values at the trigger, and the one that sets them later."""
    kept = {
        state: sp.Function(f"{reset.name}_value_{k}")(time) for k, state in enumerate(reset.then)
    }
    values = {kept[state]: value for state, value in reset.then.items()}
    keeper = replace(
        reset, name=f"{reset.name}_trigger", then=values, sizes={}, delay=None, priority=_FIRST
    )
    return keeper, replace(reset, then=kept, overlapping=reset.delay is None)


def _with_first_values(reset: _Reset, point: StartingPoint) -> _Reset:
    """An event that sets the values at the start, which are known and need no memory."""
    return replace(reset, then={state: point.value(v) for state, v in reset.then.items()})


def _at_crossings(reset: _Reset, point: StartingPoint) -> list[Event]:
    """The event where the trigger becomes true after the start, if it may do so."""
    if not point.changes(reset.trigger):
        return []
    event = reset.event(surface(reset.trigger, point, reset.happening.label), reset.name)
    if known_time(event, point.time) is not None and point.value(event.when) == 0:
        return []  # it happens at the start alone, if at all
    return [event]


def _at_start(reset: _Reset, point: StartingPoint) -> list[Event]:
    """The event at the start, if the trigger becomes true there."""
    now, after = point.value(reset.trigger), point.after(reset.trigger)
    holds_now = sp.And(now, not reset.happening.held_before)
    fires = sp.Or(holds_now, sp.And(sp.Not(now), after))
    if fires == sp.false:
        return []
    later = reset.delay is not None and reset.delay != 0
    if later and (fires != sp.true or not reset.happening.persistent):
        why = "only for some parameters" if fires != sp.true else "unless its trigger turns false"
        raise ProblemError(
            f"{reset.happening.label} happens after a delay from the start, {why}",
            term=reset.name,
            remedy="leave out the delay, or let its trigger be false at the start",
        )
    if not reset.happening.persistent and holds_now != sp.false:
        fires = reset.trigger  # what another event at the start has turned false
    if fires != sp.true:
        then = {
            state: sp.Piecewise((value, fires), (state, True))
            for state, value in reset.values.items()
        }
        reset = replace(reset, then=then, sizes={})
    name = reset.name if not point.changes(reset.trigger) else f"{reset.name}_at_start"
    event = reset.event(point.time - sp.Rational(repr(point.start)), name)
    return [replace(event, persistent=True)]
