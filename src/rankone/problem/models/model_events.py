"""The events of a model as the events of a problem, and the conditions that trigger them.

A condition holds where its surface is positive: ``x > 1 and t > 2`` where the smaller one of
``x - 1`` and ``t - 2`` is. What changes in steps alone, such as states that only events reset, is
a case of its own: ``x > 1 and flag == 1`` holds where ``x - 1`` is positive while the flag is 1.
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
from sympy.logic.boolalg import Boolean, BooleanFunction

from rankone.problem.models.elements import Happening, rate_of
from rankone.problem.user_events import Event, known_time
from rankone.support.errors import ProblemError, quote

_IN_STEPS = (sp.floor, sp.ceiling, sp.sign, Relational, BooleanFunction)
_MOST_DERIVATIVES = 3  # By which it is told to which side a trajectory leaves a surface
_MOST_CASES = 100  # Pieces of a condition whose piecewise functions are written out


@dataclass(frozen=True)
class StartingPoint:
    """Where trajectories start, and how fast.

    Attributes
    ----------
    time : Symbol
        The time.
    start : float
        When they start.
    initial, rates : mapping of Expr to Expr
        For each unknown its value at the start, and its rate.
    """

    time: sp.Symbol
    start: float
    initial: Mapping[sp.Expr, sp.Expr]
    rates: Mapping[sp.Expr, sp.Expr]

    def value(self, expression: sp.Basic) -> sp.Basic:
        """The value of an expression or condition at the start."""
        at_start = expression.xreplace(dict(self.initial))
        return at_start.subs(self.time, sp.Rational(repr(self.start)))

    def moves(self, node: sp.Basic) -> bool:
        """Whether an expression changes otherwise than in steps."""
        if isinstance(node, _IN_STEPS):
            return False
        if isinstance(node, AppliedUndef):
            return bool(self.rates[node] != 0)
        return node == self.time or any(map(self.moves, node.args))

    def changes(self, node: sp.Basic) -> bool:
        """Whether an expression has the time or an unknown."""
        return bool(node.atoms(AppliedUndef)) or self.time in node.free_symbols

    def rate(self, expression: sp.Expr) -> sp.Expr:
        """How fast an expression changes along a trajectory."""
        unknowns = {u: sp.Dummy() for u in expression.atoms(AppliedUndef)}
        written = {symbol: u for u, symbol in unknowns.items()}

        def rate(symbol: sp.Symbol) -> sp.Expr:
            return self.rates[written[symbol]] if symbol in written else sp.S.Zero

        return rate_of(expression.xreplace(unknowns), self.time, rate).xreplace(written)

    def after(self, condition: Boolean) -> Boolean:
        """Whether a condition holds right after the start; it stays where parameters decide."""
        comparisons = condition.atoms(Relational)
        return condition.xreplace({each: self._after(each) for each in comparisons})

    def _after(self, comparison: Relational) -> Boolean:
        """The truth of one comparison right after the start."""
        difference = comparison.lhs - comparison.rhs
        for _ in range(_MOST_DERIVATIVES):
            height = self.value(difference)
            if not height.is_number or not _vanishes(height):
                break
            if isinstance(comparison, sp.Eq | sp.Ne) or not self.moves(difference):
                break
            difference = self.rate(difference)
        return comparison.func(self.value(difference), 0)


def surface(condition: Boolean, point: StartingPoint, subject: str) -> sp.Expr:
    """What is positive where a condition holds, and crosses zero where it begins or ends to hold.

    A ProblemError that names the ``subject`` if the condition is an equality of what changes
    continuously, or has too many cases.
    """
    condition = sp.to_nnf(_written_out(condition, subject), simplify=False)
    if not any(map(point.moves, _sides(condition))):
        return sp.Piecewise((1, condition), (-1, True))
    if isinstance(condition, Relational):
        return _difference(condition, subject)
    conditions = list(condition.args)
    moving = [c for c in conditions if any(map(point.moves, _sides(c)))]
    surfaces = [surface(c, point, subject) for c in moving]
    steps = condition.func(*(c for c in conditions if c not in moving))
    if isinstance(condition, sp.And):
        smallest = sp.Min(*surfaces)
        return sp.Piecewise((smallest, steps), (-1, True)) if steps != sp.true else smallest
    largest = sp.Max(*surfaces)
    return sp.Piecewise((1, steps), (largest, True)) if steps != sp.false else largest


def _comparisons(condition: Boolean) -> list[Relational]:
    return sorted(condition.atoms(Relational), key=sp.default_sort_key)


def _sides(condition: Boolean) -> list[sp.Expr]:
    """The two sides of all comparisons."""
    return [side for comparison in _comparisons(condition) for side in comparison.args]


def _difference(comparison: Relational, subject: str) -> sp.Expr:
    """What is positive where one comparison of continuous changes holds."""
    if isinstance(comparison, sp.Eq | sp.Ne):
        raise ProblemError(
            f"{subject} compares what changes continuously: {quote(comparison)}",
            term=comparison,
            remedy="write < or > in its trigger",
        )
    difference = comparison.lhs - comparison.rhs
    return difference if isinstance(comparison, sp.Gt | sp.Ge) else -difference


def _written_out(condition: Boolean, subject: str, cases: int = 1) -> Boolean:
    """The condition with comparisons of the branches in place of piecewise functions."""
    for comparison in _comparisons(condition):
        functions = sorted(comparison.atoms(sp.Piecewise), key=sp.default_sort_key)
        inner = [f for f in functions if not any(b.has(sp.Piecewise) for b in f.args)]
        if not inner:
            continue
        function = inner[0]
        cases *= len(function.args)
        if cases > _MOST_CASES:
            message = f"the trigger of {subject} has more than {_MOST_CASES} cases"
            raise ProblemError(message, term=condition, remedy="write it with fewer branches")
        before, pieces = sp.false, []
        for branch, where in function.args:
            reached = sp.And(where, sp.Not(before))
            pieces.append(sp.And(reached, comparison.xreplace({function: branch})))
            before = sp.Or(before, where)
        return _written_out(condition.xreplace({comparison: sp.Or(*pieces)}), subject, cases)
    return condition


def _vanishes(height: sp.Expr) -> bool:
    if height.is_zero is not None:
        return bool(height.is_zero)
    return bool(sp.N(height) == 0)


# -----------------------------------------------------------------------------
# The events of a model as the events of a problem.
#
# A trigger becomes what crosses zero from below. Values that are taken at the trigger and set
# after a delay are kept in between: by further unknowns, whose rates are zero. An event at the
# start, which crosses nothing, becomes one at a known time.


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
            then=then,
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
