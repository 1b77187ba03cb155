"""The equations of a problem as functions of numbers, and the sides of its events' surfaces.

Nothing here reads generated code, so that trajectories integrated with it are an independent check
of solutions. The highest derivatives are solved for numerically, by the mass matrix.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.algebra.algebraic import Reduction, no_consistent_values
from rankone.problem.algebra.mass import MassForm
from rankone.problem.box import Time
from rankone.problem.expressions.boundaries import DISCONTINUOUS, boundaries, peaks, steps
from rankone.problem.expressions.conditions import rate_of, slope, unknown_of
from rankone.problem.expressions.stable import NUMPY, in_floats, stable
from rankone.problem.functions import known_applied
from rankone.problem.jumps import Impulses, Resets, at_end, at_start, system_jumps, without_impulses
from rankone.problem.user_events import Event, known_time
from rankone.support.arrays import EPSILON, HALVINGS, MANY_SAMPLES, ROUNDING, Array
from rankone.tensors.coordinates import name_of
from rankone.trajectories.system.features import Constraints, VectorLike

Numbers = Callable[[float, Array, Array], Array]
"""Maps time, states (n,) and parameters (d,) to as many numbers as there are expressions."""
_SIDES = {"rising": 1, "falling": -1, "both": 0}  # To which side an event goes
_ROOT_ACCURACY = 4.0 * EPSILON  # Relative accuracy of times: a few roundings


@dataclass(frozen=True)
class _Switch:
    """A function of time and parameters, and its levels at which something switches or is narrow.

    The levels are None for all integers.
    """

    surface: Callable[[float, Array], float]
    levels: Array | None
    linear: bool

    def times(self, time: Time, parameters: Array) -> list[float]:
        """When the function takes one of its levels, as far as samples tell."""

        def height(at: float, level: float = 0.0) -> float:
            return self.surface(at, parameters) - level

        samples = np.linspace(time[1], time[2], 2 if self.linear else MANY_SAMPLES)
        heights = np.array([height(at) for at in samples])
        taken = self._between(heights, heights)
        times = [float(at) for at, level in zip(samples, taken, strict=True) if level.size]
        for k, levels in enumerate(self._between(heights[:-1], heights[1:])):
            for level in levels:
                if (heights[k] - level) * (heights[k + 1] - level) < 0.0:
                    ends = float(samples[k]), float(samples[k + 1])
                    size = _ROOT_ACCURACY * max(map(abs, ends))
                    root = scipy.optimize.brentq(
                        height, *ends, args=(level,), xtol=size, rtol=_ROOT_ACCURACY
                    )
                    times.append(root)
        return times

    def _between(self, first: Array, second: Array) -> list[Array]:
        """The levels between pairs of heights, ends included."""
        finite = np.isfinite(first) & np.isfinite(second)
        pairs = np.sort(np.where(finite, [first, second], np.nan), axis=0).T
        nothing = np.empty(0)
        if self.levels is None:
            return [
                np.arange(np.ceil(a), np.floor(b) + 1.0) if a <= b else nothing for a, b in pairs
            ]
        levels = self.levels
        return [levels[(levels >= a) & (levels <= b)] for a, b in pairs]


class NumericSteps:
    """Where the rates of a problem jump with its states: a threshold, a relay, a rounded number.

    States and parameters are divided into cells in which the rates do not jump.
    """

    def __init__(self, equations: NumericEquations, expressions: Sequence[sp.Expr]) -> None:
        moving = [
            (surface, levels)
            for surface, levels in boundaries(expressions, DISCONTINUOUS)
            if surface.has(AppliedUndef)
        ]
        self._heights = equations.function([surface for surface, _ in moving])
        self._levels = [None if levels is None else np.array(levels) for _, levels in moving]

    def __len__(self) -> int:
        return len(self._levels)

    def cells(self, time: float, states: Array, parameters: Array) -> tuple[float, ...]:
        """The cell of a state: for each surface how many of its levels are below."""
        heights = self._heights(time, states, parameters)
        return tuple(
            float(np.floor(height)) if levels is None else float(np.searchsorted(levels, height))
            for height, levels in zip(heights, self._levels, strict=True)
        )


class NumericEvents:
    """The events of a problem as functions of numbers.

    Attributes
    ----------
    names : list of str
        The names of the events.
    when : callable
        Maps time, states and parameters to what crosses zero (events,).
    then : list of callable or None
        For each event the states (n,) after it; None if it resets nothing.
    known : list of bool
        Whether its time depends on parameters alone.
    delays, priorities : list of callable or None
        For each event one number (1,), at the same arguments; None if it has none.
    withdrawn : list of bool
        Whether it does not happen once its ``when`` has turned back.
    overlapping : list of bool
        Whether it may be set off again before its delay is over.
    """

    def __init__(self, equations: NumericEquations, events: Sequence[Event]) -> None:
        self.names = [str(event.name) for event in events]
        self._directions = [_SIDES[event.direction] for event in events]
        self.terminal = [event.terminal for event in events]
        self.scheduled = [known_time(event, equations.time[0]) is not None for event in events]
        self.withdrawn = [not event.persistent for event in events]
        self.overlapping = [event.overlapping for event in events]
        self.delays, self.priorities = (
            [None if each is None else equations.function([each]) for each in expressions]
            for expressions in (
                [event.delay for event in events],
                [event.priority for event in events],
            )
        )
        self.when = equations.function([event.when for event in events])
        self.then = [_reset(equations, event.then) if event.then else None for event in events]
        partials = [equations.partials(event.when) for event in events]
        self._places = [(k, j) for k, row in enumerate(partials) for j in row]
        self._partials = equations.function([entry for row in partials for entry in row.values()])
        self._shape = len(events), 1 + len(equations.states)

    def __len__(self) -> int:
        return len(self.names)

    def counts(self, event: int, side: int) -> bool:
        """Whether a crossing to a side is one in the direction of an event."""
        return self._directions[event] in (0, side)

    def interrupts(self, event: int) -> bool:
        """Whether a trajectory does not go on after an event as if nothing had been."""
        return self.terminal[event] or self.then[event] is not None

    def turned(self, event: int, side: int) -> bool:
        """Whether a crossing to a side turns back an event that does not persist."""
        return self.withdrawn[event] and self._directions[event] == -side

    def slopes(self, time: float, rates: Array, states: Array, parameters: Array) -> Array:
        """How fast each ``when`` changes along a trajectory (events,); NaN if that is not known.

        What rounding leaves of a sum that vanishes is zero.
        """
        jacobian = self._jacobian(time, states, parameters)
        terms = np.nan_to_num(jacobian) * np.array([1.0, *rates])
        slopes = np.where(np.isnan(jacobian).any(axis=1), np.nan, terms.sum(axis=1))
        slopes[np.abs(slopes) <= ROUNDING * np.abs(terms).sum(axis=1)] = 0.0
        return np.asarray(slopes)

    def noise(self, time: float, states: Array, parameters: Array, sizes: Array) -> Array:
        """What rounding of states of some sizes (n,) may change each ``when`` by (events,)."""
        jacobian = self._jacobian(time, states, parameters)
        noise = ROUNDING * (np.abs(jacobian) @ np.array([abs(time), *sizes]))
        return np.where(np.isfinite(noise), noise, 0.0)

    def _jacobian(self, time: float, states: Array, parameters: Array) -> Array:
        """Derivatives of each ``when`` by time and states."""
        jacobian = np.zeros(self._shape)
        if self._places:
            entries = self._partials(time, states, parameters)
            jacobian[tuple(np.transpose(self._places))] = entries
        return jacobian


class NumericEquations:
    """The rates, initial values, jumps and switches of a problem as functions of numbers.

    States are the unknowns and their lower derivatives, in the order of ``initial``.

    Attributes
    ----------
    initial : callable
        Maps time, states and parameters to the states (n,) at the start of time; which states it
        is given does not matter.
    jumps : list of (float, callable)
        Times inside the horizon, the start included, at which states are reset, in order, and the
        states after it.
    events : NumericEvents
        The events.
    steps : NumericSteps
        Where rates jump with the states.
    """

    def __init__(
        self,
        time: Time,
        parameters: Sequence[sp.Symbol],
        mass: MassForm,
        initial: Mapping[sp.Expr, sp.Expr],
        resets: Resets,
        events: Sequence[Event],
        reduction: Reduction | None = None,
    ) -> None:
        self.time, self.states = time, tuple(initial)
        self.clock, self.parameters = time[0].name, [symbol.name for symbol in parameters]
        self._arguments = {v: sp.Dummy(real=True) for v in (time[0], *self.states, *parameters)}
        places = {state: k for k, state in enumerate((*self.states, *mass.leading))}
        self._rate_places = [places[rate_of(state, time[0])] for state in self.states]
        self._rows, self._equations = mass.rows, mass.places
        entries = [entry for row in mass.rows for entry in row.values()]
        remainders = [_without_impulses(sp.Add(*terms)) for terms in mass.remainders]
        self._entries, self._remainders = self.function(entries), self.function(remainders)
        when = [event.when for event in events]
        self._switches = self._known_switches([*entries, *remainders, *when], when)
        self.initial = self.function(list(initial.values()))
        solved = {} if reduction is None else reduction.solved
        self._solved_places = [self.states.index(unknown) for unknown in solved]
        self._solved = self.function(list(solved.values()))
        if reduction is not None and reduction.guessed:
            self.initial = self._consistent(self.initial, reduction)
        self.jumps = self._known_jumps(mass, resets)
        self.events = NumericEvents(self, [event.xreplace(solved) for event in events])
        self.steps = NumericSteps(self, [*entries, *remainders])

    def function(self, expressions: Sequence[sp.Expr]) -> Numbers:
        """Expressions of time, states and parameters as a function of numbers."""
        plain = [expression.xreplace(self._arguments) for expression in expressions]
        implementations: dict[str, Callable[..., np.float64]] = {}
        for k, kind in enumerate(dict.fromkeys(applied.func for applied in known_applied(plain))):
            name = f"data_{k}"
            implementations[name] = _of_numbers(kind._imp_)
            plain = [e.replace(kind, sp.Function(name, real=True)) for e in plain]
        modules = [implementations, NUMPY, "numpy", "scipy"]
        arguments = list(self._arguments.values())
        compiled = sp.lambdify(arguments, [in_floats(stable(e)) for e in plain], modules, cse=True)

        def evaluate(time: float, states: Array, parameters: Array) -> Array:
            return np.array(compiled(np.float64(time), *states, *parameters), dtype=float)

        return evaluate

    def partials(self, expression: sp.Expr) -> dict[int, sp.Expr]:
        """Derivatives of an expression by time (0) and states (from 1), as far as it has them."""
        plain = expression.xreplace(self._arguments)
        variables = [self._arguments[v] for v in (self.time[0], *self.states)]
        present = plain.free_symbols
        return {j: slope(plain, v) for j, v in enumerate(variables) if v in present}

    def completed(self, times: Array, states: Array, parameters: Array) -> Array:
        """States (n, T) of a trajectory with the unknowns that algebraic equations give."""
        complete = states.copy()
        if self._solved_places:
            for i, time in enumerate(times.tolist()):
                complete[self._solved_places, i] = self._solved(time, states[:, i], parameters)
        return complete

    def _consistent(self, guess: Numbers, reduction: Reduction) -> Numbers:
        """The initial values with those of guessed unknowns found by Newton's method."""
        expressions = [constraint.expression for constraint in reduction.constraints]
        places = [(k, j - 1) for k, e in enumerate(expressions) for j in self.partials(e) if j]
        residuals = self.function(expressions)
        partials = self.function(
            [slope for e in expressions for j, slope in self.partials(e).items() if j]
        )

        def slopes(time: float | Array, states: VectorLike, parameters: VectorLike) -> Array:
            matrix = np.zeros((len(expressions), len(self.states), 1))
            column = partials(float(time), np.ravel(states), np.ravel(parameters))
            matrix[tuple(np.transpose(places))] = column[:, None]
            return matrix

        constraints = Constraints(
            names=tuple(constraint.name for constraint in reduction.constraints),
            guessed=tuple(self.states.index(unknown) for unknown in reduction.iterated),
            residuals=lambda t, u, p: residuals(float(t), np.ravel(u), np.ravel(p))[:, None],
            slopes=slopes,
        )

        def consistent(time: float, states: Array, parameters: Array) -> Array:
            start = guess(time, states, parameters)
            states = constraints.consistent(time, start[:, None], parameters[:, None])[:, 0]
            if np.isfinite(start).all() and not np.isfinite(states).all():
                raise no_consistent_values(self.parameters, parameters, reduction.guessed)
            return states

        return consistent

    def highest(self, time: float, states: Array, parameters: Array) -> Array:
        """The highest derivatives, in the order of the unknowns; NaN if nothing determines them."""
        entries = self._entries(time, states, parameters)
        remainders = self._remainders(time, states, parameters)
        if self._equations is not None:
            order = [self._equations[i] for i in range(len(remainders))]
            return np.asarray(-remainders[order] / entries[order])
        matrix = np.zeros((len(remainders), len(remainders)))
        places = [(i, j) for i, row in enumerate(self._rows) for j in row]
        matrix[tuple(np.transpose(places))] = entries
        try:
            return np.asarray(np.linalg.solve(matrix, -remainders), dtype=float)
        except np.linalg.LinAlgError:
            return np.full(len(remainders), np.nan)

    def rates(self, time: float, states: Array, parameters: Array) -> Array:
        """The derivatives of the states (n,)."""
        derivatives = np.concatenate([states, self.highest(time, states, parameters)])
        return np.asarray(derivatives[self._rate_places])

    def switch_times(self, parameters: Array) -> list[float]:
        """When functions of time and parameters in the equations switch or are narrow, in order."""
        return sorted(at for switch in self._switches for at in switch.times(self.time, parameters))

    def _known_switches(
        self, expressions: Sequence[sp.Expr], further: Sequence[sp.Expr]
    ) -> list[_Switch]:
        """Boundaries, peaks and steps of functions of time and parameters alone.

        And where further functions of these vanish.
        """
        time = self.time[0]

        def moving(expression: sp.Basic) -> set[sp.Symbol]:
            of_time = time in expression.free_symbols and not expression.has(AppliedUndef)
            return {time} if of_time else set()

        narrow = itertools.chain(peaks(expressions, moving), steps(expressions, moving))
        middles = [(surface, (0.0,)) for node, surface in narrow if moving(node)]
        zeros = [(expression, (0.0,)) for expression in further]
        return [
            _Switch(
                self._of_time(surface),
                None if levels is None else np.array(levels, dtype=float),
                linear=_is_linear(surface, time),
            )
            for surface, levels in itertools.chain(boundaries(expressions), middles, zeros)
            if moving(surface)
        ]

    def _of_time(self, expression: sp.Expr) -> Callable[[float, Array], float]:
        """An expression of time and parameters alone as a function of numbers."""
        of_states, nothing = self.function([expression]), np.full(len(self.states), np.nan)
        return lambda time, parameters: float(of_states(time, nothing, parameters)[0])

    def _known_jumps(self, mass: MassForm, resets: Resets) -> list[tuple[float, Numbers]]:
        """Jumps and impulses from the start of time on and before its end."""
        time = self.time[0]
        functions = {state: unknown_of(name_of(state), time) for state in self.states}
        impulses: Impulses = {}
        if any(term.has(sp.DiracDelta) for terms in mass.remainders for term in terms):
            rates, origins = mass.rates_of(self.states, time)
            rates = [rate.xreplace(functions) for rate in rates]
            _, impulses = without_impulses(rates, list(functions.values()), origins, self.time)
        written = {function: state for state, function in functions.items()}
        return [
            (
                self.time[1] if at_start(jump, self.time) else jump.time,
                self.function([value.xreplace(written) for value in jump.values]),
            )
            for jump in system_jumps(resets, impulses, functions, self.time)
            if not at_end(jump, self.time)
        ]


def _reset(equations: NumericEquations, then: Mapping[sp.Expr, sp.Expr]) -> Numbers:
    """Maps time, states and parameters to the states after an event."""
    places = [equations.states.index(state) for state in then]
    values = equations.function(list(then.values()))

    def after(time: float, states: Array, parameters: Array) -> Array:
        reset = states.copy()
        reset[places] = values(time, states, parameters)
        return reset

    return after


def _is_linear(expression: sp.Expr, time: sp.Symbol) -> bool:
    rate = slope(expression, time)
    return rate is not sp.nan and time not in rate.free_symbols


def _without_impulses(expression: sp.Expr) -> sp.Expr:
    return expression.xreplace(dict.fromkeys(expression.atoms(sp.DiracDelta), sp.S.Zero))


def _of_numbers(function: Callable[..., Array]) -> Callable[..., np.float64]:
    """A function of arrays as one of numbers."""

    def of_numbers(*arguments: float) -> np.float64:
        return np.float64(function(*(np.atleast_1d(a) for a in arguments))[0])

    return of_numbers


# -----------------------------------------------------------------------------
# On which sides of its events' surfaces a trajectory is, and where it crosses them.
#
# The surface of an event is where its ``when`` vanishes. A trajectory has a side of each: 1 or -1,
# or 0 as long as it is on the surface and nothing tells where it goes. Rounding never changes a
# side.


SHARES = np.linspace(0.125, 1.0, 8)
"""Shares of a step at which it is looked on which side of a surface it is."""


def first_change(
    cells: Callable[[float], tuple[float, ...]], start: float, end: float
) -> float | None:
    """When what is constant between jumps first differs from the start of a step; None if never.

    The time is right behind the jump.
    """
    first, before = cells(start), start
    for behind in (start + (end - start) * SHARES).tolist():
        if cells(behind) != first:
            break
        before = behind
    else:
        return None
    middle = 0.5 * (before + behind)
    while before < middle < behind:
        before, behind = (middle, behind) if cells(middle) == first else (before, middle)
        middle = 0.5 * (before + behind)
    return float(behind)


class Crossing(NamedTuple):
    """When a trajectory crosses the surface of an event, by its index, and to which side.

    It is ``unresolved`` if the trajectory came from that surface, was never seen beside it, and
    still moves away from it, by its rates: the flight is below the tolerance of the steps.
    """

    time: float
    event: int
    side: int
    unresolved: bool = False


class Sides:
    """The sides of one trajectory with parameters (d,)."""

    def __init__(self, events: NumericEvents, point: Array) -> None:
        self.events, self.point = events, point
        self.sides = np.zeros(len(events), dtype=int)
        self._before = np.zeros(len(events), dtype=int)  # sides before the last return to a surface
        self._expected = np.zeros(len(events), dtype=bool)  # sides that only rates have told
        self._sightings: list[tuple[float, int, int]] = []  # times, events and sides of a step

    def settle(
        self,
        time: float,
        state: Array,
        rates: Array,
        unmoved: Collection[int] = (),
        moving: Collection[int] = (),
    ) -> list[int]:
        """Take the sides after the start or a reset; return the events that it sets off.

        A trajectory that is on a surface goes to the side that its rates tell, and that is no
        crossing. ``unmoved`` are events whose surface it is on, whatever rounding says. Where it
        was ``moving`` before a reset, and is at rest now, it is on the side that it came from.
        """
        slopes = self.events.slopes(time, rates, state, self.point)
        sides = self.beside(time, state, rates)
        crossed = []
        for k, speed in enumerate(slopes):
            side = 0 if k in unmoved else int(sides[k])
            if side == 0 and self.sides[k] == 0:
                at_rest = speed == 0.0 and k in moving
                self.sides[k] = self._before[k] if at_rest else np.sign(np.nan_to_num(speed))
                self._expected[k] = True
            elif side != 0:
                if self.sides[k] == -side and self.events.counts(k, side):
                    crossed.append(k)
                self.sides[k], self._expected[k] = side, False
        return crossed

    def beside(self, time: float, state: Array, rates: Array) -> Array:
        """The sides of surfaces that a state is on (events,), 0 for those that it is on itself."""
        heights = self.events.when(time, state, self.point)
        slopes = self.events.slopes(time, rates, state, self.point)
        noise = self.events.noise(time, state, self.point, np.abs(state))
        definite = np.abs(heights) > noise + ROUNDING * np.abs(np.nan_to_num(slopes) * time)
        return np.where(definite, np.sign(heights), 0.0)

    def crossings(
        self,
        path: Callable[[Array], Array],
        start: float,
        end: float,
        rates: Callable[[float, Array], Array],
    ) -> list[Crossing]:
        """All crossings of a step, in order; :meth:`pass_until` takes the sides after them."""

        def leaves(time: float, event: int, side: int) -> bool:
            state = path(np.array([time]))[:, 0]
            slopes = self.events.slopes(time, rates(time, state), state, self.point)
            return float(slopes[event]) * side > 0.0

        times = start + (end - start) * SHARES
        states = path(times)
        heights = np.array(
            [self.events.when(at, y, self.point) for at, y in zip(times, states.T, strict=True)]
        )
        largest = np.abs(states).max(axis=1)
        noise = self.events.noise(end, states[:, -1], self.point, largest)
        crossings: list[Crossing] = []
        self._sightings = []
        for k, side in enumerate(self.sides.tolist()):
            left, expected = start, bool(self._expected[k])
            for at, height in zip(times.tolist(), heights[:, k].tolist(), strict=True):
                if not abs(height) > noise[k]:
                    continue
                if height * side < 0.0:
                    root = self._root(path, k, side, left, at)
                    unresolved = expected and (root == start or leaves(root, k, side))
                    crossings.append(Crossing(root, k, -side, unresolved))
                side, left, expected = int(np.sign(height)), at, False
                self._sightings.append((at, k, side))
        self._sightings += [
            (crossing.time, crossing.event, crossing.side) for crossing in crossings
        ]
        return sorted(crossings)

    def pass_until(self, time: float) -> None:
        """Take the sides that a trajectory has at a time of the last step."""
        for at, k, side in sorted(self._sightings):
            if at <= time:
                self.sides[k], self._expected[k] = side, False

    def ahead(self, time: float, state: Array, rates: Array) -> dict[int, float]:
        """The interrupting events that a straight path crosses, and how long that takes."""
        heights = self.events.when(time, state, self.point)
        slopes = self.events.slopes(time, rates, state, self.point)
        return {
            k: max(-float(height / slope), 0.0)
            for k, (height, slope) in enumerate(zip(heights, slopes, strict=True))
            if self.sides[k] * slope < 0.0
            and self.events.interrupts(k)
            and self.events.counts(k, -int(self.sides[k]))
        }

    def return_to(self, events: Collection[int]) -> None:
        """The trajectory is on the surfaces of events."""
        self._before = self.sides.copy()
        self.sides[list(events)] = 0

    def _root(
        self, path: Callable[[Array], Array], event: int, side: int, left: float, right: float
    ) -> float:
        """Where a surface is crossed from a side to the other one, which the right end is on."""

        def height(time: float) -> float:
            state = path(np.array([time]))[:, 0]
            return float(self.events.when(time, state, self.point)[event])

        # the left end may be on the surface itself
        distances = (right - left) * 0.5 ** np.arange(HALVINGS)
        for at in (left, *(left + distances[1:]).tolist()):
            if height(at) * side > 0.0:
                size = _ROOT_ACCURACY * max(abs(at), abs(right), right - left)
                root = scipy.optimize.brentq(height, at, right, xtol=size, rtol=_ROOT_ACCURACY)
                return float(root)
        return left
