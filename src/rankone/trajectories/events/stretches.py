"""Trajectories over stretches: from event to event, each in a time of its own.

Stretch ``i`` of a trajectory goes from its event before to the next one. Over the pseudo-time ``s``
from i to i + 1 its clock runs evenly, and so all trajectories of a box meet their events together:

    t = τ_i(p) + (s - i) T_i(p),  T_i = τ_{i+1} - τ_i.

The states, and with them the clock ``t`` and the length ``T``, are as smooth over the parameters as
the flow is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from rankone.ir.constraints import Constraints
from rankone.ir.events import (
    RISING,
    EventOrder,
    ForcedOrder,
    Marker,
    OfMarks,
    OfTrajectory,
    SystemEvent,
)
from rankone.ir.features import Features, Jumps, VectorLike
from rankone.ir.system import Clock, ModuleSpecification, System, UserFunction
from rankone.ir.timeline import CLOCK_STATES
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost

Answer = TypeVar("Answer")
_STEP = 1e-6  # Step over which clearances are differentiated, in horizons


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
        name = f"turn past {events[turn.event].name}"
        names.append(f"{name}, event {turn.stretch + 1}" if name in names else name)
    return names


def in_stretches(clock: Clock) -> System:
    """The system over the pseudo-time of stretches, with its clock and their lengths as states.

    Guards of a forced order are constant states before these, and then come its clearances. The
    roots of heights of opened events are parameters behind the others. Its Jacobian leaves out how
    the rates depend on the clock.
    """
    system, order, guards = clock.system, clock.order, clock.n_guards
    opened = () if clock.forced is None else clock.forced.opened
    d = len(system.parameters)
    cost, n = function_cost(system.rhs, system.user_functions), clock.n_states
    clearances = () if clock.forced is None else clock.forced.clearances
    now = n + guards  # the row of the clock
    stretches = order.stretches
    sides = np.array(order.sides, dtype=float).reshape(stretches, system.n_sides)

    def of_system(s: float | Array, rows: Array) -> Array:
        """The states with the sides of switches on the stretch."""
        if not system.n_sides:
            return rows[:n]
        at = np.broadcast_to(s, rows.shape[1:])
        stretch = np.clip(np.floor(at), 0, stretches - 1).astype(int)
        return np.concatenate([rows[:n], np.moveaxis(sides[stretch], -1, 0)])

    def rhs(s: float | Array, u: VectorLike, p: VectorLike) -> Array:
        rows, p = np.asarray(u), p[:d]
        states, time, length = of_system(s, rows), rows[now], rows[now + 1]
        charge(cost(length.size))
        rates = np.broadcast_to(system.rhs(time, states, p), states.shape)
        of_guards = np.zeros((guards, *length.shape))
        for row, each in enumerate(clearances, guards - len(clearances)):
            step = _STEP * clock.length
            ahead, behind = (
                system.events[each.event].when(time + h, states + h * rates, np.asarray(p))
                for h in (step, -step)
            )
            of_guards[row] = length * each.sign * (ahead - behind) / (2.0 * step)
        return np.concatenate([length * rates[:n], of_guards, [length, np.zeros_like(length)]])

    def jacobian(s: float | Array, u: VectorLike, p: VectorLike) -> Array:
        rows, p = np.asarray(u), p[:d]
        states, time, length = of_system(s, rows), rows[now], rows[now + 1]
        matrices = np.zeros((now + CLOCK_STATES, now + CLOCK_STATES, *length.shape))
        matrices[:n, :n] = length * np.asarray(system.jacobian(time, states, p))[:n, :n]
        matrices[:n, now + 1] = np.asarray(system.rhs(time, states, p))[:n]
        matrices[now, now + 1] = 1.0
        return matrices

    def parameter_factors(j: int, values: Array) -> Array:
        return system.parameter_factors(j, values) if j < d else np.ones((1, values.size))

    def surfaces(s: float | Array, u: VectorLike, p: VectorLike) -> Array:
        rows = np.asarray(u)
        return system.features.state_surfaces(rows[now], of_system(s, rows), p[:d])

    def parameter_surfaces(p: VectorLike) -> Array:
        return system.features.parameter_surfaces(p[:d])

    def initial(p: VectorLike) -> Array:
        parameters = np.asarray(p)[:d]
        count = parameters.shape[1]
        clock_states = [np.full(count, clock.horizon[0]), np.full(count, clock.length / stretches)]
        start = system.initial(parameters)
        of_guards = np.ones((guards, count))
        for row, each in enumerate(clearances, guards - len(clearances)):
            height = system.events[each.event].when(clock_states[0], start, parameters)
            of_guards[row] = each.sign * height
        return np.concatenate([start[:n], of_guards, clock_states])

    features = system.features
    features = Features(
        cuts=((), *features.cuts[1:], *((),) * len(opened)),
        periodic_cuts=((), *features.periodic_cuts[1:], *((),) * len(opened)),
        n_parameter_surfaces=features.n_parameter_surfaces,
        parameter_surfaces=parameter_surfaces,
        n_peaks=features.n_peaks,
        n_kinks=features.n_kinks,
        n_steps=features.n_steps,
        state_surfaces=surfaces,
    )
    specification = system.specification
    return replace(
        system.starting_at(initial),
        separated=False,
        states=(*system.states[:n], *(f"G{k}" for k in range(guards)), "t", "T"),
        parameters=(*system.parameters, *_names_of_turns(clock)),
        n_differential=now + CLOCK_STATES,
        n_lifted=0,
        n_sides=0,
        held=None,
        products=(),
        horizon=(0.0, float(stretches)),
        terms=(),
        time_factors=lambda s: np.ones((1, s.size)),
        parameter_factors=parameter_factors,
        with_products=lambda u: np.asarray(u),
        rhs=rhs,
        jacobian=jacobian,
        quadratic_jacobian=jacobian,
        features=features,
        jumps=Jumps(),
        events=(),
        constraints=Constraints(),
        clock=clock,
        specification=specification
        and StretchSpecification(
            specification,
            order,
            clock.cuts,
            clock.horizon,
            clock.markers,
            clock.in_step,
            clock.foreseen_marks,
            clock.forced,
            clock.repeats_from,
            clock.swings,
        ),
    )


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
