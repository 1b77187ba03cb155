"""Trajectories over stretches: from event to event, each in a time of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from rankone.support.arrays import DIFFERENCE, Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.trajectories.system.features import (
    RISING,
    Constraints,
    EventOrder,
    Features,
    ForcedOrder,
    Jumps,
    Marker,
    OfMarks,
    OfTrajectory,
    SystemEvent,
    Turn,
    VectorLike,
)
from rankone.trajectories.system.system import Clock, ModuleSpecification, System, UserFunction
from rankone.trajectories.system.timeline import CLOCK_STATES


class PseudoTimeTrajectories(ABC):
    """Trajectories from 0 to the number of stretches, all of which go to their end.

    Subclasses fulfil :class:`DenseTrajectories`.
    """

    @property
    @abstractmethod
    def end(self) -> float:
        """The number of stretches."""

    @abstractmethod
    def __call__(self, times: Array) -> Array:
        """States at pseudo-times (T,): shape (n, m, T)."""

    @property
    def start(self) -> float:
        return 0.0

    @property
    def has_begun(self) -> bool:
        return True

    @property
    def state(self) -> Array:
        return self(np.array([self.end]))[:, :, 0]

    @property
    def last(self) -> Array:
        return self.state


# -----------------------------------------------------------------------------
# Trajectories over stretches: from event to event, each in a time of its own.
#
# Stretch ``i`` of a trajectory goes from its event before to the next one. Over the pseudo-time
# ``s`` from i to i + 1 its clock runs evenly, and so all trajectories of a box meet their events
# together:
#
#     t = τ_i(p) + (s - i) T_i(p),  T_i = τ_{i+1} - τ_i.
#
# The states, and with them the clock ``t`` and the length ``T``, are as smooth over the parameters
# as the flow is.


Answer = TypeVar("Answer")


def fixed_times(system: System, cuts: Sequence[float]) -> list[float]:
    """The times of jumps, and cuts of time, that are the same for all parameters."""
    return sorted({*cuts, *system.jumps.inside(*system.horizon)})


def timed_events(system: System, cuts: Sequence[float], markers: Sequence[Marker] = ()) -> System:
    """The system with its jumps, its markers, and cuts of its time that may move, as events."""
    jumps, times = system.jumps, fixed_times(system, cuts)

    def known(
        at: Callable[[Array], Array],
        name: str,
        then: OfTrajectory | None,
        coefficients: tuple[float, ...] | None = None,
    ) -> SystemEvent:
        def when(t: Array, _u: Array, p: Array) -> Array:
            return t - at(p)

        switch = then is None
        return SystemEvent(
            when,
            RISING,
            then,
            name=name,
            at=at,
            timed=True,
            switch=switch,
            coefficients=coefficients,
        )

    def event(time: float) -> SystemEvent:
        kind = jumps.kind_at(time)

        def then(_t: Array, u: Array, p: Array) -> Array:
            assert kind is not None
            return np.asarray(jumps.jumped(kind, u, p))

        name = f"t = {time:.12g}"
        resets = None if kind is None else then
        return known(lambda p: np.full(p.shape[1], time), name, resets, (time,))

    def moving(k: int) -> SystemEvent:
        def at(p: Array) -> Array:
            return np.broadcast_to(system.features.moving_cuts(p)[k], p.shape[1])

        return known(at, "a switch", None)

    switches = map(moving, range(system.features.n_moving_cuts))
    marking = (marker_event(marker, f"marker_{k}") for k, marker in enumerate(markers))
    timed = (event(time) for time in times)
    events = (*_put_off(system.events), *marking, *timed, *switches)
    features = replace(system.features, cuts=((), *system.features.cuts[1:]), n_moving_cuts=0)
    features = replace(features, n_moving_steps=0)
    features = replace(features, periodic_cuts=((), *system.features.periodic_cuts[1:]))
    return replace(system, events=events, jumps=Jumps(), features=features)


def marker_event(marker: Marker, name: str) -> SystemEvent:
    """The event that marks where a state crosses a level."""

    def when(_t: Array, u: Array, _p: Array) -> Array:
        return np.asarray(u[marker.state] - marker.level)

    return SystemEvent(when, name=name, marker=marker)


def _put_off(events: Sequence[SystemEvent]) -> list[SystemEvent]:
    """Events where those with a delay are started, and perhaps cancelled, by further ones."""
    put_off, further = [*events], []

    def never(p: Array) -> Array:
        return np.full(p.shape[1], np.inf)

    for k, event in enumerate(events):
        if event.delay is None:
            continue
        put_off[k] = replace(event, at=never, delay=None, coefficients=None)
        start = replace(event, name=f"the start of {event.name}", timed=True, starts=k)
        further.append(replace(start, then=None, terminal=False, priority=None, persistent=True))
        if not event.persistent:
            end = SystemEvent(event.when, -event.direction, name=f"the withdrawal of {event.name}")
            further.append(replace(end, timed=True, cancels=k))
    return [*put_off, *further]


def _names_of_turns(clock: Clock) -> list[str]:
    """Names of the roots of heights of opened events, as messages have them."""
    events, names = clock.system.events, list[str]()
    for turn in () if clock.forced is None else clock.forced.opened:
        what = "turn past" if isinstance(turn, Turn) else "start before"
        name = f"{what} {events[turn.event].name}"
        names.append(f"{name}, event {turn.stretch + 1}" if name in names else name)
    return names


def in_stretches(clock: Clock) -> System:
    """The system over the pseudo-time of stretches, with its clock and their lengths as states.

    Guards of a forced order are constant states before these, and then come its clearances. The
    roots of heights of opened events are parameters behind the others. Its Jacobian leaves out how
    the rates depend on the clock.
    """
    system, functions = clock.system, _StretchFunctions(clock)
    states = system.states[: clock.n_states]
    return replace(
        system.starting_at(functions.initial).with_rates(functions.rhs, functions.jacobian),
        separated=False,
        states=(*states, *(f"G{k}" for k in range(clock.n_guards)), "t", "T"),
        parameters=(*system.parameters, *_names_of_turns(clock)),
        n_differential=functions.clock_row + CLOCK_STATES,
        n_lifted=0,
        n_sides=0,
        held=None,
        products=(),
        horizon=(0.0, float(clock.order.stretches)),
        terms=(),
        time_factors=lambda s: np.ones((1, s.size)),
        parameter_factors=functions.parameter_factors,
        with_products=lambda u: np.asarray(u),
        quadratic_jacobian=functions.jacobian,
        features=functions.features,
        jumps=Jumps(),
        events=(),
        constraints=Constraints(),
        clock=clock,
        specification=_specification(clock),
    )


def _specification(clock: Clock) -> StretchSpecification | None:
    """What the system over the stretches of a clock is loaded from."""
    inner = clock.system.specification
    if inner is None:
        return None
    return StretchSpecification(
        inner,
        clock.order,
        clock.cuts,
        clock.horizon,
        clock.markers,
        clock.in_step,
        clock.foreseen_marks,
        clock.forced,
        clock.repeats_from,
        clock.swings,
    )


class _StretchFunctions:
    """The functions of a system over the stretches of a clock.

    Vectors (n, ...) have the states, the guards, and then in the ``clock_row`` the clock, and
    behind it the length of the stretch; parameters may be followed by roots of heights.
    """

    def __init__(self, clock: Clock) -> None:
        self.clock, self.system, self.stretches = clock, clock.system, clock.order.stretches
        self.clearances = () if clock.forced is None else clock.forced.clearances
        self.opened = () if clock.forced is None else clock.forced.opened
        self.clock_row = clock.n_states + clock.n_guards
        self._parameters = len(self.system.parameters)
        self._cost = function_cost(self.system.rhs, self.system.user_functions)
        shape = self.stretches, self.system.n_sides
        self._sides = np.array(clock.order.sides, dtype=float).reshape(shape)

    def rhs(self, s: float | Array, u: VectorLike, p: VectorLike) -> Array:
        """The rates of all states by the pseudo-time."""
        rows, p = np.asarray(u), p[: self._parameters]
        states, (time, length) = self._of_system(s, rows), rows[self.clock_row :][:CLOCK_STATES]
        charge(self._cost(length.size))
        rates = np.broadcast_to(self.system.rhs(time, states, p), states.shape)
        of_guards = np.zeros((self.clock.n_guards, *length.shape))
        for row, each in enumerate(self.clearances, len(of_guards) - len(self.clearances)):
            when, step = self.system.events[each.event].when, DIFFERENCE * self.clock.length
            ahead, behind = (
                when(time + h, states + h * rates, np.asarray(p)) for h in (step, -step)
            )
            of_guards[row] = length * each.sign * (ahead - behind) / (2.0 * step)
        of_states = length * rates[: self.clock.n_states]
        return np.concatenate([of_states, of_guards, [length, np.zeros_like(length)]])

    def jacobian(self, s: float | Array, u: VectorLike, p: VectorLike) -> Array:
        """That of the rates, but for how they depend on the clock."""
        rows, p, n, now = np.asarray(u), p[: self._parameters], self.clock.n_states, self.clock_row
        states, (time, length) = self._of_system(s, rows), rows[now:][:CLOCK_STATES]
        matrices = np.zeros((now + CLOCK_STATES, now + CLOCK_STATES, *length.shape))
        matrices[:n, :n] = length * np.asarray(self.system.jacobian(time, states, p))[:n, :n]
        matrices[:n, now + 1] = np.asarray(self.system.rhs(time, states, p))[:n]
        matrices[now, now + 1] = 1.0
        return matrices

    def initial(self, p: VectorLike) -> Array:
        """The states at the start, with guards of one, and stretches of one length."""
        clock, parameters = self.clock, np.asarray(p)[: self._parameters]
        count = parameters.shape[1]
        begin = np.full(count, clock.horizon[0])
        start = self.system.initial(parameters)
        of_guards = np.ones((clock.n_guards, count))
        for row, each in enumerate(self.clearances, len(of_guards) - len(self.clearances)):
            height = self.system.events[each.event].when(begin, start, parameters)
            of_guards[row] = each.sign * height
        lengths = np.full(count, clock.length / self.stretches)
        return np.concatenate([start[: clock.n_states], of_guards, [begin, lengths]])

    def parameter_factors(self, j: int, values: Array) -> Array:
        """Those of the system; a root has none."""
        known = j < self._parameters
        return self.system.parameter_factors(j, values) if known else np.ones((1, values.size))

    @property
    def features(self) -> Features:
        """Those of the system without what happens at known times."""
        features, roots = self.system.features, ((),) * len(self.opened)
        return Features(
            cuts=((), *features.cuts[1:], *roots),
            periodic_cuts=((), *features.periodic_cuts[1:], *roots),
            n_parameter_surfaces=features.n_parameter_surfaces,
            parameter_surfaces=self._parameter_surfaces,
            n_peaks=features.n_peaks,
            n_kinks=features.n_kinks,
            n_steps=features.n_steps,
            state_surfaces=self._state_surfaces,
        )

    def _parameter_surfaces(self, p: VectorLike) -> Array:
        return self.system.features.parameter_surfaces(p[: self._parameters])

    def _state_surfaces(self, s: float | Array, u: VectorLike, p: VectorLike) -> Array:
        rows, p = np.asarray(u), p[: self._parameters]
        states = self._of_system(s, rows)
        return self.system.features.state_surfaces(rows[self.clock_row], states, p)

    def _of_system(self, s: float | Array, rows: Array) -> Array:
        """The states of the system, with the sides of switches on the stretch."""
        states = rows[: self.clock.n_states]
        if not self.system.n_sides:
            return states
        at = np.broadcast_to(s, rows.shape[1:])
        stretch = np.clip(np.floor(at), 0, self.stretches - 1).astype(int)
        return np.concatenate([states, np.moveaxis(self._sides[stretch], -1, 0)])


@dataclass(frozen=True)
class StretchSpecification:
    """What a system in stretches is loaded from: the system over clock time, and the order."""

    inner: ModuleSpecification
    order: EventOrder
    cuts: tuple[float, ...]
    horizon: tuple[float, float]
    markers: tuple[Marker, ...] = ()
    in_step: bool = False
    foreseen_marks: OfMarks | None = None
    forced: ForcedOrder | None = None
    repeats_from: int = 0
    swings: float = 0.0

    @property
    def namespace(self) -> dict[str, UserFunction]:
        return dict(self.inner.namespace)

    def call(self, function: Callable[..., Answer], *arguments: object) -> Answer:
        """``function(system, *arguments)``, in any process."""
        answer: Answer = self.inner.call(_called, self, function, *arguments)
        return answer


def _called(
    system: System,
    specification: StretchSpecification,
    function: Callable[..., Answer],
    *arguments: object,
) -> Answer:
    cuts, markers = specification.cuts, specification.markers
    timed = timed_events(system, cuts, markers)
    clock = Clock(
        timed,
        specification.order,
        specification.horizon,
        cuts,
        markers,
        specification.in_step,
        specification.foreseen_marks,
        specification.forced,
        specification.repeats_from,
        specification.swings,
    )
    return function(in_stretches(clock), *arguments)
