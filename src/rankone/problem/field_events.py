"""Events and jumps of problems with fields: a functional crosses zero, whole fields are reset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NoReturn

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.equations import Symbols, check_names
from rankone.problem.expressions.notation import exact, expression_of, text_of
from rankone.problem.field_rates import State, check_smooth, check_symbols
from rankone.problem.fields import (
    Field,
    FieldDerivative,
    Operator,
    constant_of,
    size_of,
)
from rankone.problem.functions import check_name
from rankone.problem.jumps import instants_of
from rankone.problem.user_events import Event, check_direction, event_name, known_time, moving_jumps
from rankone.support.errors import ProblemError, count, listing, quote, shown
from rankone.tensors.coordinates import name_of

_WHEN_REMEDY = (
    "give one number that crosses zero: a functional of a field, rankone.apply(row, u) - level "
    "with a matrix of one row, or an expression of time, parameters and scalar unknowns"
)
_THEN_REMEDY = "give {u: value after it}, an expression of the unknowns before it, such as {u: u/2}"


def field_events(
    events: object, jumps: object, rates: Mapping[State, sp.Expr], symbols: Symbols
) -> tuple[Event, ...]:
    """The events with exact numbers, each with its name; jumps are events at known times.

    ``rates`` are those of all states, of first order.
    """
    listed: Sequence[object] = () if events is None else events  # type: ignore[assignment]
    if not isinstance(listed, Sequence) or isinstance(listed, str):
        raise ProblemError(
            f"events are {shown(events)}, not a list of events",
            term=events,
            remedy="give a list of them: events=[rankone.Event(when, then={u: u/2})]",
        )
    every = [*listed, *_of_jumps(jumps, symbols)]
    checked = tuple(_checked(event, k, rates, symbols) for k, event in enumerate(every))
    owners = [(str(event.name), f"event {k}") for k, event in enumerate(checked)]
    named = [(name_of(state), state) for state in rates]
    further = [*symbols.shorthand.owners, *owners]
    check_names(named, symbols.parameters, symbols.time[0], further)
    return checked


def known_field_time(event: Event, time: sp.Symbol) -> sp.Expr | None:
    """When an event happens, an expression of parameters; None where the trajectory tells."""
    return None if event.when.atoms(Field) else known_time(event, time)


def _of_jumps(jumps: object, symbols: Symbols) -> list[Event]:
    """Jumps as events, at times that are numbers or depend on parameters."""
    if jumps is None:
        return []
    fixed, moving = moving_jumps(jumps, symbols)
    if not isinstance(fixed, Mapping):
        raise ProblemError(
            f"jumps are {shown(jumps)}, not a mapping",
            term=jumps,
            remedy="give {time: {u: value after it}}",
        )
    time, start, end = symbols.time
    events = [replace(event, name=None) for event in moving]
    for key, reset in fixed.items():
        for instant in instants_of(key):
            at = expression_of(instant)
            if at is None or not at.is_real or not start <= float(at) < end:
                raise ProblemError(
                    f"there is a jump at {time} = {shown(instant)}, which is no time of the "
                    f"horizon, from {start:g} to before {end:g}",
                    term=instant,
                    remedy="give a time inside of it, or move the end",
                )
            events.append(Event(time - exact(at), "rising", then=reset))
    return [replace(event, name=f"jump_{k}") for k, event in enumerate(events)]


def _checked(
    event: object, position: int, rates: Mapping[State, sp.Expr], symbols: Symbols
) -> Event:
    """One event, with its name."""
    if not isinstance(event, Event):
        raise ProblemError(
            f"event {position} is {shown(event)}, not a rankone.Event",
            term=event,
            remedy="write rankone.Event(when, then={u: u/2})",
        )
    if event.name is not None:
        check_name(event.name)
    name = event_name(event.name, position)
    subject = f"event {quote(name)}"
    check_direction(event, subject)
    _refuse_unsupported(event, subject)
    expressions = _Expressions(subject, rates, symbols)
    when = expressions.checked(event.when, "`when`", _WHEN_REMEDY)
    if size_of(when) != 1:
        _refuse(subject, "`when`", when, f"has {size_of(when)} entries", _WHEN_REMEDY)
    if not when.atoms(Field, AppliedUndef) and symbols.time[0] not in when.free_symbols:
        _refuse(
            subject, "`when`", when, "changes neither with time nor with an unknown", _WHEN_REMEDY
        )
    then = None if event.then is None else _resets(event.then, expressions)
    if then is None and not event.terminal and event.then is not None:
        _refuse(subject, "`then`", event.then, "is empty", "leave it out to mark the instant only")
    return replace(event, when=when, then=then, name=name)


def _refuse_unsupported(event: Event, subject: str) -> None:
    """Raise for what events of fields do not have."""
    flags = {
        "delay": event.delay is not None,
        "priority": event.priority is not None,
        "persistent=False": not event.persistent,
        "overlapping=False": not event.overlapping,
    }
    for name, is_given in flags.items():
        if is_given:
            raise ProblemError(
                f"{subject} has `{name}`, which events of fields do not take",
                term=event,
                remedy="leave it out: events of fields happen where `when` crosses zero, those of "
                "one instant in the order of the list",
            )


def _resets(written: object, expressions: _Expressions) -> dict[State, sp.Expr] | None:
    """The states that are reset, and their values after it; None without any."""
    subject = expressions.subject
    if not isinstance(written, Mapping):
        raise ProblemError(
            f"`then` of {subject} is {shown(written)}, not a mapping from unknowns",
            term=written,
            remedy=_THEN_REMEDY,
        )
    after: dict[State, sp.Expr] = {}
    for key, value in written.items():
        state = expressions.state(key)
        what = f"the value of {quote(name_of(state))} after it,"
        expression = expressions.checked(value, what, _THEN_REMEDY)
        if size_of(expression) not in (1, size_of(state)):
            _refuse(
                subject,
                what,
                expression,
                f"has {size_of(expression)} entries",
                f"give {count(size_of(state), 'entry', 'entries')}: whole fields are reset",
            )
        after[state] = expression
    return after or None


class _Expressions:
    """Checks the expressions of one event."""

    def __init__(self, subject: str, rates: Mapping[State, sp.Expr], symbols: Symbols) -> None:
        self.subject, self._rates, self._symbols = subject, rates, symbols
        time = symbols.time[0]
        named = {name_of(state): state for state in rates}
        self._states: dict[sp.Expr, State] = {state: state for state in rates}
        for state in rates:
            velocity = named.get(f"{name_of(state)}_t")
            if isinstance(state, Field) and velocity is not None:
                self._states[state.diff(time)] = velocity

    def state(self, key: object) -> State:
        """The state that a key of ``then`` names."""
        if not isinstance(key, sp.Expr) or key not in self._states:
            raise ProblemError(
                f"{self.subject} resets {shown(key)}, which is not a state",
                term=key,
                remedy=f"use the states themselves as keys, whole fields: {listing(self._states)}",
            )
        return self._states[key]

    def checked(self, written: object, what: str, remedy: str) -> sp.Expr:
        """An expression of states, time, parameters and arrays, with exact numbers."""
        expression = expression_of(written)
        if expression is None and not isinstance(written, str | Mapping | None):
            constant = constant_of(written, f"{what} of {self.subject}")
            expression = None if isinstance(constant, Operator) else constant
        if expression is None:
            raise ProblemError(
                f"{what} of {self.subject} is {shown(written)}, not an expression",
                term=written,
                remedy=remedy,
            )
        expression = exact(self._symbols.shorthand.put_in(expression)).xreplace(self._states)
        if derivatives := expression.atoms(FieldDerivative, sp.Derivative):
            _refuse(
                self.subject,
                what,
                expression,
                f"names {listing(derivatives)}",
                "write the rate itself in its place",
            )
        try:
            check_symbols(expression, self._symbols, None)
            check_smooth(expression, self._symbols, None)
            size_of(expression)
        except ProblemError as error:
            message = f"{self.subject}: {error.message}"
            raise ProblemError(message, term=error.term, remedy=error.remedy) from None
        return expression


def _refuse(subject: str, what: str, term: object, fault: str, remedy: str) -> NoReturn:
    written = text_of(term) if isinstance(term, sp.Basic) else term
    raise ProblemError(f"{what} of {subject}, {quote(written)}, {fault}", term=term, remedy=remedy)
