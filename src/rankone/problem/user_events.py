"""Events: what happens where an expression of the states crosses zero."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.box import Box, Time
from rankone.problem.equations import Symbols, check_names
from rankone.problem.expressions.admissible import closed
from rankone.problem.expressions.conditions import slope
from rankone.problem.expressions.notation import latex_of, text_of
from rankone.problem.functions import check_name
from rankone.problem.jumps import (
    LATE_REMEDY,
    MovingImpulses,
    change_latex,
    change_texts,
    check_of_states,
    check_reset,
    instants_of,
)
from rankone.support.errors import ProblemError, did_you_mean, listing, quote, shown, warn
from rankone.tensors.coordinates import name_of

_DIRECTIONS = {"both": "crosses", "rising": "rises through", "falling": "falls through"}
_ARROWS = {"both": r"\leftrightarrows", "rising": r"\nearrow", "falling": r"\searrow"}
_LIST_REMEDY = "give a list of them: events=[rankone.Event(x, then={x: 1})]"
_WHEN_REMEDY = "give what crosses zero, an expression of unknowns, time and parameters: x - level"
_DELAY_REMEDY = "give a time that is not negative, from the crossing to the event"
_PRIORITY_REMEDY = "give a number, or an expression of unknowns, time and parameters"
_THEN_REMEDY = "give {unknown: value after it}, for example {v: -e*v}"


@dataclass(frozen=True)
class Event:
    """What happens where an expression crosses zero.

    Without ``then`` and ``terminal`` the instant is only marked. At the instant of an event a
    trajectory has the values after it. A start at zero is no crossing, but an event at a time that
    depends on parameters alone, ``t - lag``, happens at the start too. After an event that leaves
    its expression at zero the next crossing counts.

    Parameters
    ----------
    when : Expr
        What crosses zero: an expression of time, unknowns, their derivatives, and parameters.
    direction : {"both", "rising", "falling"}
        Which crossings count.
    then : mapping of Expr to Expr, optional
        States and their values after the event, in terms of those before it, all at once:
        ``{x.diff(t): -e * x.diff(t)}``.
    terminal : bool
        Whether the trajectory ends there.
    name : str, optional
        A Python identifier; by default ``event_0``, ``event_1``, ..., by the position in the list.
    delay : Expr, optional
        The time from the crossing to the event, an expression in the values at the crossing. It is
        not negative. States are reset, and time ends, at the later time, from the values then.
    priority : Expr, optional
        Of several events at one instant, the one of the highest priority is the first; priorities
        are taken anew after each of them, and those that are equal go by the list. Without one it
        is 0.
    persistent : bool
        Whether the event still happens if ``when`` crosses zero back before the delay is over, or
        is turned back by an event before it at the same instant. ``False`` needs a direction.
    overlapping : bool
        Whether ``when`` may cross zero again before the delay of an earlier crossing is over. With
        ``False`` that is an error: where ``then`` reads what a crossing keeps, the next one would
        overwrite it.

    Examples
    --------
    A ball bounces on the floor:

    >>> t, e = sp.symbols("t e")
    >>> x = sp.Function("x")(t)
    >>> bounce = Event(x, "falling", then={x.diff(t): -e * x.diff(t)}, name="bounce")
    """

    when: Any
    direction: str = "both"
    _: KW_ONLY
    then: Mapping[Any, Any] | None = None
    terminal: bool = False
    name: str | None = None
    delay: Any = None
    priority: Any = None
    persistent: bool = True
    overlapping: bool = True

    @property
    def expressions(self) -> list[sp.Expr]:
        """What crosses zero, the values after it, delay and priority."""
        further = [e for e in (self.delay, self.priority) if e is not None]
        return [self.when, *(self.then or {}).values(), *further]

    def xreplace(self, replacements: Mapping[sp.Expr, sp.Expr]) -> Event:
        """The same event with expressions put in for others, but for the states that it resets."""
        if not replacements:
            return self
        then = self.then and {u: after.xreplace(replacements) for u, after in self.then.items()}
        when, delay, priority = (
            None if each is None else each.xreplace(replacements)
            for each in (self.when, self.delay, self.priority)
        )
        return replace(self, when=when, then=then, delay=delay, priority=priority)


def event_name(name: object, position: int) -> str:
    """The name of an event; by default by its position, from 0."""
    return f"event_{position}" if name is None else str(name)


def known_time(event: Event, time: sp.Symbol) -> sp.Expr | None:
    """When an event happens, an expression of parameters; None where the trajectory tells.

    That is the root of what is linear in time alone, with a number as its slope.
    """
    if event.when.has(AppliedUndef):
        return None
    rate = slope(event.when, time)
    if not rate.is_number or not rate.is_real or rate == 0:
        return None
    wrong = "falling" if rate > 0 else "rising"
    return None if event.direction == wrong else -event.when.subs(time, 0) / rate


def check_events(events: object, symbols: Symbols) -> tuple[Event, ...]:
    """Return the events with exact numbers, each with its name."""
    if events is None:
        return ()
    if not isinstance(events, Sequence) or isinstance(events, str):
        message = f"events are {shown(events)}, not a list of events"
        raise ProblemError(message, term=events, remedy=_LIST_REMEDY)
    checked = tuple(_checked(event, k, symbols) for k, event in enumerate(events))
    owners = [(str(event.name), f"event {k}") for k, event in enumerate(checked)]
    states = [(name_of(state), state) for state in symbols.states]
    further = [*symbols.shorthand.owners, *owners]
    check_names(states, symbols.parameters, symbols.time[0], further)
    return checked


def moving_jumps(jumps: object, symbols: Symbols) -> tuple[object, list[Event]]:
    """The jumps at known times, and those whose times depend on parameters, as events.

    A ProblemError if a time depends on something else.
    """
    if not isinstance(jumps, Mapping):
        return jumps, []
    at_times: dict[object, object] = {}
    moving: list[Event] = []
    put_in = symbols.shorthand.put_in
    for key, reset in jumps.items():
        instants = tuple(put_in(at) if isinstance(at, sp.Expr) else at for at in instants_of(key))
        fixed = tuple(at for at in instants if not getattr(at, "free_symbols", None))
        if fixed in at_times:
            message = f"there are two jumps at {symbols.time[0]} = {listing(fixed)}"
            raise ProblemError(message, term=key, remedy="give all that is reset in one mapping")
        if fixed or not instants:
            at_times[fixed] = reset
        for at in instants:
            if at in fixed:
                continue
            others = sorted(map(str, at.free_symbols - {*symbols.parameters}))
            if others:
                raise ProblemError(
                    f"the time of a jump, {quote(at)}, depends on {listing(others)}",
                    term=at,
                    remedy="it may depend on parameters; for anything else write an Event",
                )
            name = f"jump_{len(moving)}"
            moving.append(Event(symbols.time[0] - at, "rising", then=reset, name=name))
    return at_times, moving


def warn_of_late(events: Iterable[Event], box: Box, time: Time) -> None:
    """Warn of events at times of parameters that are behind the end at all corners of the box."""
    for event in events:
        at = sp.expand(time[0] - event.when)
        if not at.free_symbols <= box.keys() or at.atoms(AppliedUndef):
            continue
        symbols = [symbol for symbol in box if symbol in at.free_symbols]
        corners = itertools.product(*(box[symbol] for symbol in symbols))
        instants = (at.xreplace(dict(zip(symbols, corner, strict=True))) for corner in corners)
        if all(instant >= time[2] for instant in instants):
            warn(
                f"{quote(event.name)} happens at {time[0]} = {text_of(at)}, which is not before "
                f"the end of time, {time[2]:.12g}, at any corner of the box",
                remedy=LATE_REMEDY,
            )


def impulse_events(impulses: MovingImpulses, symbols: Symbols, first: int) -> list[Event]:
    """Impulses at times of parameters as events, named ``jump_n`` from a first number on."""
    states = list(symbols.states)
    return [
        Event(
            symbols.time[0] - at,
            "rising",
            then={states[i]: states[i] + size for i, size in sizes.items()},
            name=f"jump_{position}",
        )
        for position, (at, sizes) in enumerate(impulses.items(), first)
    ]


def _checked(event: object, position: int, symbols: Symbols) -> Event:
    """One event, with its name."""
    if not isinstance(event, Event):
        remedy = _LIST_REMEDY
        if isinstance(event, Mapping):
            remedy = "write rankone.Event(...); Problem.from_strings takes mappings"
        message = f"event {position} is {shown(event)}, not a rankone.Event"
        raise ProblemError(message, term=event, remedy=remedy)
    if event.name is not None:
        check_name(event.name)
    name = event_name(event.name, position)
    subject = f"event {quote(name)}"
    check_direction(event, subject)
    when = _when(event, subject, symbols)
    then = _then(event, subject, symbols)
    delay, priority = (
        None
        if value is None
        else closed(check_of_states(value, f"`{field}` of {subject}", symbols, remedy))
        for field, value, remedy in (
            ("delay", event.delay, _DELAY_REMEDY),
            ("priority", event.priority, _PRIORITY_REMEDY),
        )
    )
    if delay is not None and delay.is_negative:
        raise ProblemError(
            f"the delay of {subject} is {quote(delay)}", term=event.delay, remedy=_DELAY_REMEDY
        )
    if delay is not None and then is None and not event.terminal:
        raise ProblemError(
            f"{subject} has a delay, and resets nothing",
            term=event,
            remedy="give `then` or `terminal`, or leave out the delay to mark the crossing",
        )
    return replace(event, when=closed(when), then=then, name=name, delay=delay, priority=priority)


def check_direction(event: Event, subject: str) -> None:
    """Raise if an event has no such direction, or flags that are not true or false."""
    direction = event.direction
    if not isinstance(direction, str) or direction not in _DIRECTIONS:
        raise ProblemError(
            f"the direction of {subject} is {shown(direction)}"
            f"{did_you_mean(str(direction), _DIRECTIONS)}",
            term=direction,
            remedy=f"choose from {listing(_DIRECTIONS)}",
        )
    for field in ("terminal", "persistent", "overlapping"):
        value = getattr(event, field)
        if not isinstance(value, bool):
            raise ProblemError(
                f"`{field}` of {subject} is {shown(value)}", term=value, remedy="give True or False"
            )
    if not event.persistent and direction == "both":
        raise ProblemError(
            f"{subject} is not persistent, and happens in both directions",
            term=event,
            remedy="give the direction of the crossing that starts it; the other one withdraws it",
        )


def _when(event: Event, subject: str, symbols: Symbols) -> sp.Expr:
    """What crosses zero at an event."""
    when = check_of_states(event.when, f"`when` of {subject}", symbols.with_rates, _WHEN_REMEDY)
    if not when.has(AppliedUndef) and symbols.time[0] not in when.free_symbols:
        raise ProblemError(
            f"`when` of {subject}, {quote(when)}, changes neither with time nor with an unknown",
            term=event.when,
            remedy=_WHEN_REMEDY,
        )
    return when


def _then(event: Event, subject: str, symbols: Symbols) -> dict[sp.Expr, sp.Expr] | None:
    """The states after an event; None if it resets nothing."""
    then = event.then
    if then is None or (isinstance(then, Mapping) and not then and event.terminal):
        return None
    if isinstance(then, Mapping) and not then:
        raise ProblemError(
            f"{subject} has an empty `then`",
            term=event,
            remedy=f"leave it out to mark the instant only, or {_THEN_REMEDY}",
        )
    if not isinstance(then, Mapping):
        message = f"`then` of {subject} is {shown(then)}, not a mapping from unknowns"
        raise ProblemError(message, term=then, remedy=_THEN_REMEDY)
    after = check_reset(then, subject, symbols, _THEN_REMEDY)
    return {state: closed(value) for state, value in after.items()}


def without_rates(events: Sequence[Event], rates: Mapping[sp.Expr, sp.Expr]) -> tuple[Event, ...]:
    """Events of states alone: what crosses zero has expressions in place of highest derivatives."""
    return tuple(replace(event, when=event.when.xreplace(rates)) for event in events)


def event_texts(events: Iterable[Event]) -> Iterator[str]:
    """Lines such as ``bounce: where x falls through 0: v -> -e*v``."""
    for event in events:
        changes = change_texts((event.then or {}).items()) + ["time ends"] * event.terminal
        what = f": {', '.join(changes)}" if changes else ""
        later = "" if event.delay is None else f", {text_of(event.delay)} later"
        later += "" if event.persistent else ", unless it turns back"
        first = "" if event.priority is None else f", of priority {text_of(event.priority)}"
        where = f"where {text_of(event.when)} {_DIRECTIONS[event.direction]} 0"
        yield f"{event.name}: {where}{later}{first}{what}"


def event_latex(events: Iterable[Event]) -> Iterator[str]:
    """The same as :func:`event_texts` as LaTeX, with ``&``."""
    for event in events:
        changes = change_latex((event.then or {}).items())
        changes += [r"\text{time ends}"] * event.terminal
        if event.delay is not None:
            changes = [rf"\text{{after }} {latex_of(event.delay)}", *changes]
        if event.priority is not None:
            changes = [*changes, rf"\text{{priority }} {latex_of(event.priority)}"]
        if not event.persistent:
            changes = [*changes, r"\text{unless it turns back}"]
        name = str(event.name).replace("_", r"\_")
        crossing = rf"{latex_of(event.when)} {_ARROWS[event.direction]} 0"
        yield rf"\text{{{name}}}:\; & " + r",\; ".join([crossing, *changes])
