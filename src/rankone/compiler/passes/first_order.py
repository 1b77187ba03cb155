"""Reduction to first order, the weak form, and parameters whose effects add up.

Derivatives below the highest of each unknown become states; the equations, linear in the highest
derivatives, are solved for them exactly, without simplification. The weak form is the first step of
the proper generalized decomposition ("A Prior Reduced Model of Dynamical Systems", MEIS 2014): with
parameters as further coordinates, one variational statement holds for all of their values at once.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import sympy as sp
from sympy.functions.elementary.piecewise import ExprCondPair

from rankone.problem.algebra.term_table import TabulatedRates, TermTable
from rankone.problem.expressions.conditions import rate_of, unknown_of, with_plain_conditions
from rankone.problem.expressions.notation import initial_latex, initial_texts, latex_of, text_of
from rankone.problem.forms import ConstraintForms, Coordinate, EventForm, Jump, State
from rankone.problem.functions import namespace_of
from rankone.problem.jumps import at_start, jump_latex, jump_texts, system_jumps, without_impulses
from rankone.problem.problem import Problem
from rankone.problem.user_events import Event, event_latex, event_texts, known_time
from rankone.solvers.outcome import Role
from rankone.support.arrays import Deferred
from rankone.support.errors import abridged, aligned_equations, check_kind, count, number, quote
from rankone.tensors.coordinates import name_of
from rankone.trajectories.system.features import BOTH, FALLING, RISING

_DIRECTIONS = {"rising": RISING, "falling": FALLING, "both": BOTH}


@dataclass(frozen=True, repr=False)
class Stage:
    """What the first-order system and its weak form have in common.

    Attributes
    ----------
    coordinates : tuple of Coordinate
        Time, then the parameters.
    states : tuple of State
        The unknowns, then the derivatives that became states.
    functions : tuple of Expr
        The states as functions of time: ``x(t)``, and ``x_t(t)`` for its derivative.
    initial : tuple of Expr
        For each state its initial value, an expression of the parameters.
    origins : tuple of (int or None)
        For each state the number, from 1, of the user's equation that was solved for its
        derivative; None if several equations were solved together.
    jumps : tuple of Jump
        After the start, by time.
    """

    coordinates: tuple[Coordinate, ...]
    states: tuple[State, ...]
    functions: tuple[sp.Expr, ...]
    initial: tuple[sp.Expr, ...]
    origins: tuple[int | None, ...]
    jumps: tuple[Jump, ...] = field(default=(), kw_only=True)

    def _initial_texts(self) -> list[str]:
        names = (state.name for state in self.states)
        return initial_texts(names, self.coordinates[0].lower, self.initial)

    def _jump_texts(self) -> Iterator[str]:
        return jump_texts(self.functions, self.jumps, self.coordinates[0].name)

    def _conditions_latex(self) -> list[str]:
        """Initial values and jumps."""
        clock = self.coordinates[0]
        lines = initial_latex(self.functions, clock.lower, self.initial)
        return [*lines, *jump_latex(self.functions, self.jumps, clock.symbol)]


@dataclass(frozen=True, repr=False)
class RestForm:
    """The system before a start at its steady state.

    Attributes
    ----------
    system : FirstOrderSystem
        It: over the same parameters, without jumps and events.
    settle : tuple of float
        The time at which trajectories are first looked at, and the longest that they may take.
    after : tuple of Expr or None
        The values of the states after jumps at the start, in those at rest.
    text : str
        The steady state in words.
    """

    system: FirstOrderSystem
    settle: tuple[float, float]
    after: tuple[sp.Expr, ...] | None
    text: str


@dataclass(frozen=True, repr=False)
class FirstOrderSystem(Stage):
    """An explicit first-order system.

    Attributes
    ----------
    coordinates, states, functions, initial, origins
        As for every :class:`Stage`.
    rhs : tuple of Expr
        For each state the right-hand side of its derivative, in the states' ``functions``.
    events : tuple of EventForm
        In the order of the user.
    constraints : ConstraintForms
        What algebraic equations say of the states.
    switches : tuple of Expr
        The surfaces of switches, whose sides are the last states; the last events set them.
    rest : RestForm or None
        The system before the start, where that is a steady state. Then ``initial`` is where that
        one starts.
    """

    rhs: Sequence[sp.Expr]
    events: tuple[EventForm, ...] = field(default=(), kw_only=True)
    constraints: ConstraintForms = field(default_factory=ConstraintForms, kw_only=True)
    switches: tuple[sp.Expr, ...] = field(default=(), kw_only=True)
    rest: RestForm | None = field(default=None, kw_only=True)

    @property
    def examined_rates(self) -> Sequence[sp.Expr]:
        """The right-hand sides, except of a table of terms: its functions are smooth and known."""
        return () if isinstance(self.rhs, Deferred) else self.rhs

    @property
    def table(self) -> TermTable | None:
        """The table of the rates, if they are not written out."""
        return self.rhs.table if isinstance(self.rhs, TabulatedRates) else None

    @property
    def known_expressions(self) -> tuple[sp.Expr, ...]:
        """All that rates and initial values are made of; of a table without its states."""
        table = self.table
        rates = self.examined_rates if table is None else table.expressions
        return (*rates, *self.initial)

    @property
    def user_functions(self) -> Mapping[str, Callable[..., object]]:
        """The functions of the user in the equations, by the names that generated source uses."""
        jumps = (after for jump in self.jumps for after in jump.values)
        further = (*self.event_expressions, *self.constraints.expressions)
        if self.rest is not None:
            before = self.rest.system
            further = (*further, *before.rhs, *before.initial, *(self.rest.after or ()))
        return namespace_of([*self.examined_rates, *self.initial, *jumps, *further])

    @property
    def event_expressions(self) -> tuple[sp.Expr, ...]:
        """What the events are made of."""
        return tuple(e for event in self.events for e in event.expressions)

    def piecewise(self) -> Iterator[tuple[str, int | None, sp.Expr]]:
        """Rates, initial values and values after jumps that have piecewise functions.

        Yields a description, the number of the user's equation, if there is one, and the
        expression.
        """
        written = [state.expression for state in self.states]
        for state, origin, rate in zip(written, self.origins, self.examined_rates, strict=False):
            if rate.has(sp.Piecewise):
                yield f"the derivative of {quote(state)}", origin, rate
        for state, start in zip(written, self.initial, strict=True):
            if start.has(sp.Piecewise):
                yield f"the initial value of {quote(state)}", None, start
        for jump in self.jumps:
            at = f"{self.coordinates[0].name} = {number(jump.time)}"
            for state, after in zip(written, jump.values, strict=True):
                if after.has(sp.Piecewise):
                    yield f"the value of {quote(state)} after the jump at {at}", None, after

    def _equations(self) -> list[sp.Eq]:
        t = self.coordinates[0].symbol
        pairs = zip(self.functions, self.rhs, strict=True)
        return [sp.Eq(sp.Derivative(u, t), f, evaluate=False) for u, f in pairs]

    def __repr__(self) -> str:
        states = count(len(self.states), "state")
        lines = [f"First-order system: {states}, {count(len(self.coordinates) - 1, 'parameter')}"]
        lines += [f"  {text}" for text in abridged(self._equations(), text_of)]
        pairs = zip(self._constraint_equations(), self.constraints.names, strict=True)
        lines += [f"  {text_of(equation)}  ({name})" for equation, name in pairs]
        names = (state.name for state in self.states)
        start, guessed = self.coordinates[0].lower, self.constraints.guessed
        starts = initial_texts(names, start, self.initial, guessed)
        if self.rest is not None:
            starts = [f"at the start: {self.rest.text}"]
        lines.append(f"  {', '.join(abridged(starts, str))}")
        texts = [*self._jump_texts(), *event_texts(self._events())]
        return "\n".join([*lines, *(f"  {text}" for text in texts)])

    def _repr_latex_(self) -> str:
        equations = [*self._equations(), *self._constraint_equations()]
        lines = [latex_of(equation) for equation in equations]
        events = event_latex(self._events())
        conditions = self._conditions_latex()
        if self.rest is not None:
            conditions[: len(self.states)] = [rf"& \text{{at the start: {self.rest.text}}}"]
        return aligned_equations([*lines, *conditions, *events])

    def _constraint_equations(self) -> list[sp.Eq]:
        """Each constraint as an expression that vanishes."""
        return [sp.Eq(0, e, evaluate=False) for e in self.constraints.expressions]

    def _events(self) -> Iterator[Event]:
        """The events in the states, with what they change."""
        words = {direction: word for word, direction in _DIRECTIONS.items()}
        for form in self.events:
            then = None
            if form.then is not None:
                pairs = zip(self.functions, form.then, strict=True)
                then = {state: after for state, after in pairs if state != after}
            yield Event(
                form.when,
                words[form.direction],
                then=then,
                terminal=form.terminal,
                name=form.name,
                delay=form.delay,
                priority=form.priority,
                persistent=form.persistent,
                overlapping=form.overlapping,
            )


def _states(problem: Problem) -> tuple[State, ...]:
    """The states of a problem, in the order of their initial values."""
    return tuple(
        State(
            name_of(e),
            e,
            Role.DERIVATIVE if isinstance(e, sp.Derivative) else Role.UNKNOWN,
            (problem.atol or {}).get(name_of(e)),
            (problem.units or {}).get(name_of(e), ""),
        )
        for e in problem.initial
    )


def first_order(problem: Problem) -> FirstOrderSystem:
    """Reduce a problem to first order and solve it for the derivatives.

    Raises
    ------
    OptionError
        If it is not a problem.
    """
    remedy = "build one with rankone.Problem(...); what is compiled has `.first_order`"
    check_kind("first_order", problem, Problem, remedy=remedy)
    time, states = problem.time[0], _states(problem)
    functions = {s.expression: unknown_of(s.name, time) for s in states}
    if problem.table is not None:
        return _of_table(problem, states, functions)
    rates, equations = _solved_rates(problem, functions)
    origin = dict(zip(problem.unknowns, equations, strict=True))
    origins = [origin[e.expr if isinstance(e, sp.Derivative) else e] for e in problem.initial]
    states_of_time = list(functions.values())
    rhs, impulses = without_impulses(rates, states_of_time, origins, problem.time)
    rhs = tuple(with_plain_conditions(rate, problem.coordinates[1:]) for rate in rhs)
    jumps = system_jumps(problem.jumps or {}, impulses, functions, problem.time)
    initial, reset = tuple(problem.initial.values()), None
    if jumps and at_start(jumps[0], problem.time):  # evaluation there is from the right
        reset, jumps = jumps[0].values, jumps[1:]
    if reset is not None and problem.rest is None:
        before = dict(zip(states_of_time, initial, strict=True))
        initial = tuple(after.xreplace(before) for after in reset)
    return FirstOrderSystem(
        coordinates=problem.coordinates,
        states=states,
        functions=tuple(states_of_time),
        rhs=rhs,
        initial=initial,
        origins=tuple(origins),
        jumps=jumps,
        events=tuple(_event(event, functions, time) for event in problem.events),
        constraints=_constraints(problem, functions),
        rest=_rest(problem, reset),
    )


def _solved_rates(
    problem: Problem, functions: Mapping[sp.Expr, sp.Expr]
) -> tuple[list[sp.Expr], list[int | None]]:
    """The rate of each state, and the number of the equation solved for each highest derivative."""
    solved, equations = problem.mass_form.solved()
    highest = dict(zip(problem.mass_form.leading, solved, strict=True))
    rates = (rate_of(state, problem.time[0]) for state in functions)
    return [highest.get(rate, rate).xreplace(dict(functions)) for rate in rates], equations


def _rates_of_table(problem: Problem, functions: Mapping[sp.Expr, sp.Expr]) -> list[sp.Expr]:
    return _solved_rates(problem, functions)[0]


def _of_table(
    problem: Problem, states: tuple[State, ...], functions: Mapping[sp.Expr, sp.Expr]
) -> FirstOrderSystem:
    """The system of a table of terms; its right-hand sides are written when they are read."""
    assert problem.table is not None
    equations, n = len(problem.unknowns), len(states)
    return FirstOrderSystem(
        coordinates=problem.coordinates,
        states=states,
        functions=tuple(functions.values()),
        rhs=TabulatedRates(n, partial(_rates_of_table, problem, dict(functions)), problem.table),
        initial=tuple(problem.initial.values()),
        origins=tuple(i % equations + 1 for i in range(n)),
    )


def _rest(problem: Problem, after: tuple[sp.Expr, ...] | None) -> RestForm | None:
    """The system before the start of a problem, and the values after jumps there."""
    if problem.rest is None:
        return None
    _, start, end = problem.time
    settle = (end - start, problem.written["initial"].longest(problem.time))
    return RestForm(first_order(problem.rest), settle, after, problem.rest_text)


def _constraints(problem: Problem, functions: Mapping[sp.Expr, sp.Expr]) -> ConstraintForms:
    """The constraints of a problem in the states of the first-order system."""
    if problem.reduction is None:
        return ConstraintForms()
    constraints, places = problem.reduction.constraints, list(functions)
    return ConstraintForms(
        names=tuple(constraint.name for constraint in constraints),
        expressions=tuple(c.expression.xreplace(dict(functions)) for c in constraints),
        guessed=tuple(places.index(unknown) for unknown in problem.reduction.iterated),
    )


def _event(event: Event, functions: Mapping[sp.Expr, sp.Expr], time: sp.Symbol) -> EventForm:
    """An event in the states of the first-order system."""
    states, then = dict(functions), None
    if event.then is not None:
        after = {states[u]: value.xreplace(states) for u, value in event.then.items()}
        then = tuple(after.get(u, u) for u in states.values())
    when, direction = event.when.xreplace(states), _DIRECTIONS[event.direction]
    delay, priority = (
        None if each is None else each.xreplace(states) for each in (event.delay, event.priority)
    )
    return EventForm(
        name=str(event.name),
        when=when,
        direction=direction,
        then=then,
        terminal=event.terminal,
        at=known_time(event, time),
        delay=delay,
        priority=priority,
        persistent=event.persistent,
        overlapping=event.overlapping,
    )


@dataclass(frozen=True, repr=False)
class WeakForm(Stage):
    """For each state: the integral of test function times residual vanishes.

    Attributes
    ----------
    coordinates, states, functions, initial, origins
        As for every :class:`~rankone.compiler.passes.first_order.Stage`; equation ``i`` is tested
        with the test function of state ``i``.
    residuals : tuple of Expr
        The residual u' - f of each equation, in the states' ``functions``.
    """

    residuals: Sequence[sp.Expr]

    @property
    def test_functions(self) -> tuple[sp.Symbol, ...]:
        """One for each state: ``u*`` for the state ``u``."""
        return tuple(sp.Symbol(f"{state.name}*") for state in self.states)

    @property
    def integrands(self) -> tuple[sp.Expr, ...]:
        """Test function times residual, for each state."""
        pairs = zip(self.test_functions, self.residuals, strict=True)
        return tuple(test * residual for test, residual in pairs)

    def __repr__(self) -> str:
        signs = " ".join(f"∫_{c.name}" for c in self.coordinates)
        measures = " ".join(f"d{c.name}" for c in reversed(self.coordinates))
        lines = [
            f"{signs}  {test} ({text_of(residual)}) {measures} = 0"
            for test, residual in zip(self.test_functions, self.residuals, strict=True)
        ]
        return "\n".join([*lines, *self._initial_texts(), *self._jump_texts()])

    def _repr_latex_(self) -> str:
        signs = " ".join(rf"\int_{{{sp.latex(c.symbol)}}}" for c in self.coordinates)
        measures = r" \, ".join(rf"d{sp.latex(c.symbol)}" for c in reversed(self.coordinates))
        lines = [
            rf"{signs} {{{latex_of(u)}}}^{{*}} \left({latex_of(residual)}\right) "
            rf"\, {measures} &= 0"
            for u, residual in zip(self.functions, self.residuals, strict=True)
        ]
        return aligned_equations([*lines, *self._conditions_latex()])


def weak_form(system: FirstOrderSystem | Problem) -> WeakForm:
    """Return the weak form over time and the box of the parameters.

    Parameters
    ----------
    system : FirstOrderSystem or Problem
        A problem is reduced to first order before.

    Raises
    ------
    OptionError
        If it is neither.
    """
    if isinstance(system, Problem):
        system = first_order(system)
    remedy = "give a problem or first_order(problem); what is compiled has `.weak_form`"
    check_kind("weak_form", system, FirstOrderSystem, Problem, remedy=remedy)
    t = system.coordinates[0].symbol
    residuals = partial(_residuals, t, system.functions, system.rhs)
    deferred = isinstance(system.rhs, Deferred)
    return WeakForm(
        coordinates=system.coordinates,
        states=system.states,
        functions=system.functions,
        initial=system.initial,
        origins=system.origins,
        residuals=Deferred(len(system.rhs), residuals) if deferred else tuple(residuals()),
        jumps=system.jumps,
    )


def _residuals(
    time: sp.Symbol, functions: Sequence[sp.Expr], rates: Sequence[sp.Expr]
) -> list[sp.Expr]:
    """The derivative of each state less its rate."""
    return [sp.Derivative(u, time) - f for u, f in zip(functions, rates, strict=True)]


# -----------------------------------------------------------------------------
# Parameters whose effects add up, such as the amount of a dose.
#
# Let the rates be linear in the states, with coefficients that do not depend on time, and let all
# else be proportional to one parameter: initial values, what jumps add, and rates without states.
# Then states are proportional to that parameter, and the curve of several doses is the sum of the
# curves of each one, counted from its own time.


_NONLINEAR = 2  # The degree of all that is neither constant nor affine


def additive_parameters(system: FirstOrderSystem) -> tuple[str, ...]:
    """Names of the parameters whose effects add up, whenever each of them begins.

    Rates are walked once, and once more for each parameter left that they hold.
    """
    clock, *parameters = system.coordinates
    times = _times_of_events(system.events)
    if times is None or system.rest is not None or system.constraints.expressions:
        return ()
    rates, states = system.examined_rates, system.functions
    if len(rates) < len(states):
        return ()
    amounts = {c.symbol for c in parameters}.difference(*(each.free_symbols for each in times))
    starts = [*system.initial, *_added(system)]
    amounts = _in_all(starts, amounts)
    if not amounts or any(_degree(rate, states, clock.symbol) > 1 for rate in rates):
        return ()
    at_zero = dict.fromkeys(states, sp.S.Zero)
    rests = [rate.xreplace(at_zero) for rate in rates]
    amounts = _in_all(rests, amounts)
    proportional = [
        p
        for p in amounts
        if all(_degree(each, (*states, p)) <= 1 for each in (*starts, *rates) if each.has_free(p))
        and not any(each.subs(p, 0) for each in (*starts, *rests) if each)
    ]
    return tuple(c.name for c in parameters if c.symbol in proportional)


def _times_of_events(events: Sequence[EventForm]) -> list[sp.Expr] | None:
    """The times of all events that reset states; None if the states have a say in one."""
    times = []
    for event in events:
        if event.terminal or event.delay is not None or event.priority is not None:
            return None
        if event.then is None:
            continue
        if event.at is None:
            return None
        times.append(event.at)
    return times


def _added(system: FirstOrderSystem) -> Iterator[sp.Expr]:
    """What each jump, and each event that resets states, adds to them."""
    after = [jump.values for jump in system.jumps]
    after += [event.then for event in system.events if event.then is not None]
    for values in after:
        yield from (value - state for value, state in zip(values, system.functions, strict=True))


def _in_all(expressions: Sequence[sp.Expr], symbols: set[sp.Symbol]) -> set[sp.Symbol]:
    """The symbols that occur in every expression other than zero."""
    return symbols.intersection(*(each.free_symbols for each in expressions if each))


def _degree(
    expression: sp.Basic, variables: Collection[sp.Expr], clock: sp.Symbol | None = None
) -> int:
    """0, 1 or ``_NONLINEAR``, as it is constant, affine or neither in the variables.

    With a ``clock`` the coefficients of what is affine do not depend on it.
    """
    variables = frozenset(variables)

    def walk(node: sp.Basic) -> tuple[int, bool]:
        """The degree, and whether the clock occurs outside the variables."""
        if node in variables:
            return 1, False
        if not node.args:
            return 0, node == clock
        degrees, timed = zip(*map(walk, node.args), strict=True)
        coefficients: Iterable[bool] = ()
        if isinstance(node, sp.Add):
            degree = max(degrees)
        elif isinstance(node, sp.Mul):
            degree = sum(degrees)
            coefficients = (late for late, each in zip(timed, degrees, strict=True) if not each)
        elif isinstance(node, sp.Piecewise):
            degree = max(degrees)
            coefficients = (walk(condition)[1] for _, condition in node.args)
        elif isinstance(node, ExprCondPair):
            degree = degrees[0] + _NONLINEAR * degrees[1]
        else:
            degree = _NONLINEAR * max(degrees)
        if degree and any(coefficients):
            degree = _NONLINEAR
        return min(degree, _NONLINEAR), any(timed)

    return walk(expression)[0]
