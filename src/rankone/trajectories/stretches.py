"""Trajectories over stretches: from event to event, each in a time of its own.

Stretch ``i`` of a trajectory goes from its event before to the next one. Over the pseudo-time ``s``
from i to i + 1 its clock runs evenly, and so all trajectories of a box meet their events together:

    t = τ_i(p) + (s - i) T_i(p),  T_i = τ_{i+1} - τ_i.

The states, and with them the clock ``t`` and the length ``T``, are as smooth over the parameters as
the flow is.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from rankone.ir.events import RISING, Ending, EventOrder, SystemEvent
from rankone.ir.features import Features, Jumps, VectorLike
from rankone.ir.system import Clock, ModuleSpecification, System, UserFunction
from rankone.ir.timeline import CLOCK_STATES
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.support.errors import ConvergenceError
from rankone.support.wording import quote
from rankone.trajectories.diagnosis import first_to_end
from rankone.trajectories.events import EventTrajectory, Occurrence, integrate_to_events
from rankone.trajectories.integrator import (
    EARLY_STEPS,
    Integrator,
    SampledTrajectories,
    Spans,
    Tolerances,
)
from rankone.trajectories.paths import Path, joined

Answer = TypeVar("Answer")

_FAR = 4.0  # Horizons beyond the horizon up to which events are waited for
_SPARE = 0.05  # Length of a last stretch beyond what all known trajectories need, over that
_SAME_INSTANT = 1e-11  # Part of the horizon within which events are at one instant
_REMEDY = "narrow the box to where all trajectories meet the same events in the same order"


class OrderError(ConvergenceError):
    """A trajectory does not meet the events of the others, or not in their order."""


class MoreEventsError(OrderError):
    """A trajectory meets more events before the end than those that told their order."""


def timed_events(system: System, cuts: Sequence[float]) -> System:
    """The system with its jumps, and with cuts of its time that may move, as events."""
    jumps = system.jumps
    times = sorted({*cuts, *jumps.inside(*system.horizon)})

    def event(time: float) -> SystemEvent:
        kind = jumps.kind_at(time)

        def then(t: Array, u: Array, p: Array) -> Array:
            return np.array(u) if kind is None else np.asarray(jumps.jumped(kind, u, p))

        name = f"t = {time:.12g}"
        return SystemEvent(lambda t, _u, _p: t - time, RISING, then, name=name, timed=True)

    def moving(k: int) -> SystemEvent:
        def when(t: Array, _u: Array, p: Array) -> Array:
            return np.asarray(t - system.features.moving_cuts(p)[k])

        return SystemEvent(when, RISING, lambda _t, u, _p: np.array(u), name="t", timed=True)

    switches = map(moving, range(system.features.n_moving_cuts))
    events = (*system.events, *(event(time) for time in times), *switches)
    features = replace(system.features, cuts=((), *system.features.cuts[1:]), n_moving_cuts=0)
    features = replace(features, periodic_cuts=((), *system.features.periodic_cuts[1:]))
    return replace(system, events=events, jumps=Jumps(), features=features)


def event_order(
    system: System,
    points: Array,
    horizon: tuple[float, float],
    integrator: Integrator,
    tolerances: Tolerances,
    more: int = 0,
) -> EventOrder:
    """The order of the events of trajectories at points (m, d).

    Others may meet so many ``more`` before the end of the horizon.

    Raises
    ------
    OrderError
        If it is not the same at all of them, except for what comes after the horizon.
    """
    events, end = system.events, horizon[1]
    followed = integrate_to_events(integrator, system, points, horizon, tolerances, events)
    length = end - horizon[0]
    counts = [len(_instants(each, length)) for each in followed]
    longest = int(np.argmax(counts))
    instants = tuple(_ids(_instants(followed[longest], length)))
    some = Clock(system, EventOrder(instants, Ending.EVENT), horizon)
    terminal = bool(instants) and any(events[k].terminal for k in instants[-1])
    if not terminal and min(counts) == max(counts) and not more:
        order = EventOrder(instants, Ending.HORIZON)
        for each, point in zip(followed, points, strict=True):
            _check_order(Clock(system, order, horizon), each, point)
        return order
    if not terminal:
        count = len(instants) + 1 + more
        try:
            further = _followed(some, integrator, points, tolerances, count)
            beyond = {tuple(_ids(_instants(each, length))[:count]) for each in further}
            if len(beyond) == 1 and len(next(iter(beyond))) == count:
                return EventOrder(beyond.pop(), Ending.EVENT)
        except ConvergenceError:
            pass
    if more:
        raise MoreEventsError("trajectories meet different numbers of events", remedy=_REMEDY)
    reached = _followed(some, integrator, points, tolerances, len(instants))
    for each, point in zip(reached, points, strict=True):
        _check_order(some, each, point)
    if terminal:
        return some.order
    last = min(_instants(each, length)[len(instants) - 1][0].time for each in reached)
    return EventOrder(instants, Ending.LENGTH, (1.0 + _SPARE) * (end - last))


def in_stretches(clock: Clock) -> System:
    """The system over the pseudo-time of stretches, with its clock and their lengths as states.

    Its Jacobian leaves out how the rates depend on the clock.
    """
    system, order = clock.system, clock.order
    cost, n = function_cost(system.rhs, system.user_functions), system.n_differential
    stretches = order.stretches

    def rhs(_s: float | Array, u: VectorLike, p: VectorLike) -> Array:
        rows = np.asarray(u)
        states, time, length = rows[:n], rows[n], rows[n + 1]
        charge(cost(length.size))
        rates = np.broadcast_to(system.rhs(time, states, p), states.shape)
        return np.concatenate([length * rates, [length, np.zeros_like(length)]])

    def jacobian(_s: float | Array, u: VectorLike, p: VectorLike) -> Array:
        rows = np.asarray(u)
        states, time, length = rows[:n], rows[n], rows[n + 1]
        matrices = np.zeros((n + CLOCK_STATES, n + CLOCK_STATES, *length.shape))
        matrices[:n, :n] = length * system.jacobian(time, states, p)
        matrices[:n, n + 1] = system.rhs(time, states, p)
        matrices[n, n + 1] = 1.0
        return matrices

    def surfaces(_s: float | Array, u: VectorLike, p: VectorLike) -> Array:
        rows = np.asarray(u)
        return system.features.state_surfaces(rows[n], rows[:n], p)

    def initial(p: VectorLike) -> Array:
        parameters = np.asarray(p)
        count = parameters.shape[1]
        clock_states = [np.full(count, clock.horizon[0]), np.full(count, clock.length / stretches)]
        return np.concatenate([system.initial(parameters), clock_states])

    features = system.features
    features = Features(
        cuts=((), *features.cuts[1:]),
        periodic_cuts=((), *features.periodic_cuts[1:]),
        n_parameter_surfaces=features.n_parameter_surfaces,
        parameter_surfaces=features.parameter_surfaces,
        n_peaks=features.n_peaks,
        n_kinks=features.n_kinks,
        n_steps=features.n_steps,
        state_surfaces=surfaces,
    )
    specification = system.specification
    return replace(
        system,
        separated=False,
        states=(*system.states[:n], "t", "T"),
        n_differential=n + CLOCK_STATES,
        n_lifted=0,
        products=(),
        horizon=(0.0, float(stretches)),
        terms=(),
        initial_terms=(),
        initial_separates=False,
        unseparated_initial=initial,
        time_factors=lambda s: np.ones((1, s.size)),
        with_products=lambda u: np.asarray(u),
        rhs=rhs,
        jacobian=jacobian,
        quadratic_jacobian=jacobian,
        features=features,
        jumps=Jumps(),
        events=(),
        clock=clock,
        specification=specification
        and StretchSpecification(specification, order, clock.cuts, clock.horizon),
    )


@dataclass(frozen=True)
class StretchSpecification:
    """What a system in stretches is loaded from: the system over clock time, and the order."""

    inner: ModuleSpecification
    order: EventOrder
    cuts: tuple[float, ...]
    horizon: tuple[float, float]

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
    timed = timed_events(system, specification.cuts)
    clock = Clock(timed, specification.order, specification.horizon, specification.cuts)
    return function(in_stretches(clock), *arguments)


@dataclass(frozen=True)
class StretchTrajectories:
    """Trajectories over the pseudo-time of stretches. Fulfils :class:`DenseTrajectories`.

    ``borders`` (m, stretches + 1) are the clock times at which stretches begin and end.
    """

    trajectories: Sequence[EventTrajectory]
    clock: Clock
    borders: Array
    integrator: str
    method: str
    avoided: float = 0.0

    @property
    def start(self) -> float:
        return 0.0

    @property
    def end(self) -> float:
        return float(self.clock.order.stretches)

    @property
    def steps(self) -> int:
        return max(each.steps for each in self.trajectories)

    @property
    def has_begun(self) -> bool:
        return True

    @property
    def state(self) -> Array:
        return self(np.array([self.end]))[:, :, 0]

    @property
    def last(self) -> Array:
        return self.state

    @property
    def largest(self) -> Array:
        return self._largest(None)

    @property
    def early(self) -> Array:
        return self._largest(EARLY_STEPS)

    def _largest(self, steps: int | None) -> Array:
        """Largest absolute values after any of the first steps of a stretch, (n + 2, m)."""
        lengths = np.diff(self.borders, axis=1)
        clock = np.stack([np.abs(self.borders).max(axis=1), np.abs(lengths).max(axis=1)])
        states = [
            np.max([path.largest(steps) for path in each.paths], axis=0)
            for each in self.trajectories
        ]
        return np.concatenate([np.stack(states, axis=1), clock])

    def __call__(self, times: Array) -> Array:
        """States, clock and length of the stretch (n + 2, m, T) at pseudo-times (T,)."""
        stretch = np.clip(np.floor(times).astype(int), 0, self.clock.order.stretches - 1)
        n = self.clock.system.n_differential
        lengths = np.diff(self.borders, axis=1)[:, stretch]
        at = self.borders[:, stretch] + (times - stretch) * lengths
        states = np.empty((n + CLOCK_STATES, len(self.trajectories), times.size))
        states[n], states[n + 1] = at, lengths
        for k, paths in enumerate(self._paths):
            for i in np.unique(stretch):
                here = stretch == i
                states[:n, k, here] = paths[i](at[k, here])
        return states

    def at(self, k: int, times: Array) -> Array:
        """States (n, T) of one trajectory at clock times (T,), NaN after its end."""
        return self.trajectories[k](times)

    def samples(self, count: int) -> list[tuple[float, Array]]:
        s = np.linspace(0.0, self.end, count + 2)[1:]
        return list(zip(s.tolist(), np.moveaxis(self(s), 2, 0), strict=True))

    @cached_property
    def _paths(self) -> list[list[Callable[[Array], Array]]]:
        """For each trajectory its states over clock time on each stretch."""
        events = self.clock.system.events
        each = zip(self.trajectories, self.borders, strict=True)
        return [_paths(trajectory, events, borders) for trajectory, borders in each]


def _paths(
    trajectory: EventTrajectory, events: Sequence[SystemEvent], borders: Array
) -> list[Callable[[Array], Array]]:
    """The states of a trajectory over each stretch: a path between two resets serves several."""
    resets = [o for o in trajectory.occurrences if events[o.event].interrupts]
    times = np.unique([o.time for o in resets])
    pieces: dict[int, list[Path]] = {}
    for path in trajectory.paths:
        if path.steps:
            piece = int(np.searchsorted(times, path.breaks[0], side="right"))
            pieces.setdefault(piece, []).append(path)
    whole = {piece: joined(paths) for piece, paths in pieces.items()}
    after = {int(np.searchsorted(times, o.time, side="right")): o.after for o in resets}

    def resting(state: Array) -> Callable[[Array], Array]:
        return lambda t: np.repeat(state[:, None], t.size, axis=1)

    over: list[Callable[[Array], Array]] = []
    for begin in borders[:-1]:
        piece = int(np.searchsorted(times, begin, side="right"))
        over.append(whole[piece] if piece in whole else resting(after[piece]))
    return over


@dataclass(frozen=True)
class StretchIntegrator:
    """An :class:`Integrator` of systems in stretches: integrates over clock time, by another one.

    An OrderError says where a trajectory does not meet the events of the others.
    """

    integrator: Integrator
    name: str

    def run(
        self, system: System, points: Array, edges: Sequence[float], tolerances: Tolerances
    ) -> StretchTrajectories:
        """Trajectories at all pseudo-times, always to their end; see :meth:`Integrator.run`."""
        clock = system.clock
        assert clock is not None
        assert tuple(edges[:: len(edges) - 1]) == system.horizon
        n, order = clock.system.n_differential, clock.order
        per_stretch = clock.length / order.stretches
        tolerances = replace(
            tolerances,
            absolute=np.broadcast_to(tolerances.absolute, (n + CLOCK_STATES, 1))[:n],
            longest_step=tolerances.longest_step * per_stretch,
        )
        least = len(order.instants)
        followed = _followed(clock, self.integrator, points, tolerances, least)
        borders = np.empty((len(points), order.stretches + 1))
        borders[:, 0] = clock.horizon[0]
        for each, point, row in zip(followed, points, borders, strict=True):
            _check_order(clock, each, point)
            instants = _instants(each, clock.length)[:least]
            row[1 : 1 + least] = [instant[0].time for instant in instants]
        if order.ending is Ending.HORIZON:
            borders[:, -1] = clock.horizon[1]
        if order.ending is Ending.EVENT and not clock.terminal:
            for early in np.flatnonzero(borders[:, -1] < clock.horizon[1])[:1]:
                raise MoreEventsError(
                    "a trajectory meets more events before the end than those that told their "
                    f"order{_at(clock, points[early])}",
                    remedy=_REMEDY,
                )
        if order.ending is Ending.LENGTH:
            borders[:, -1] = borders[:, -2] + order.length
            self._finish(clock, followed, points, borders[:, -1], tolerances)
        single = self.name == "single"
        method = "LSODA" if single else "DOP853"
        return StretchTrajectories(
            followed, clock, borders, "single" if single else "stack", method
        )

    def sample(
        self,
        system: System,
        points: Array,
        edges: Sequence[float],
        tolerances: Tolerances,
        times: Array,
    ) -> SampledTrajectories:
        """Trajectories at ascending pseudo-times; see :meth:`Integrator.sample`."""
        dense = self.run(system, points, edges, tolerances)
        states = np.moveaxis(dense(times), 2, 0)
        return SampledTrajectories(states, times.size, dense.end, states[-1], dense.integrator)

    def paths(
        self, system: System, points: Array, spans: Spans, tolerances: Tolerances
    ) -> Sequence[Path]:
        """Systems in stretches are always integrated from their start."""
        raise NotImplementedError

    def _finish(
        self,
        clock: Clock,
        followed: Sequence[EventTrajectory],
        points: Array,
        ends: Array,
        tolerances: Tolerances,
    ) -> None:
        """Go on to the ends, beyond the horizon without events."""
        short = [k for k, each in enumerate(followed) if each.end < ends[k]]
        if not short:
            return
        starts = np.array([followed[k].end for k in short])
        states = np.stack([followed[k].state for k in short], axis=1)
        spans = Spans(starts, states, ends[short])
        paths = self.integrator.paths(clock.system, points[short], spans, tolerances)
        for k, path in zip(short, paths, strict=True):
            if path.end < ends[k] - _SAME_INSTANT * clock.length:
                raise _ends(clock, points[k], path.end)
            followed[k].paths.append(path)


def _followed(
    clock: Clock, integrator: Integrator, points: Array, tolerances: Tolerances, count: int
) -> list[EventTrajectory]:
    """Trajectories to the end of the horizon and to so many instants of events."""
    (start, end), length = clock.horizon, clock.length

    def enough(trajectory: EventTrajectory, edge: float) -> bool:
        return edge > end and len(_instants(trajectory, length)) >= count

    edges = [start, end, end + _FAR * length]
    if clock.order.ending is Ending.HORIZON:
        edges = edges[:2]
    events = clock.system.events
    followed = integrate_to_events(
        integrator, clock.system, points, edges, tolerances, events, enough
    )
    early: list[int] = []
    for k, each in enumerate(followed):
        terminal = bool(each.occurrences) and events[each.occurrences[-1].event].terminal
        short = each.end < end - _SAME_INSTANT * length
        if each.stuck and not terminal and (short or len(_instants(each, length)) < count):
            raise _ends(clock, points[k], each.end, stuck=True)
        if not terminal and short:
            early.append(k)
    if early:  # a stack ends where the first of its trajectories does
        states = np.stack([followed[k].state for k in early], axis=1)
        time = min(followed[k].end for k in early)
        first = first_to_end(clock.system, time, states, points[early], tolerances.absolute)
        raise _ends(clock, points[early[first]], time)
    return followed


def _instants(trajectory: EventTrajectory, length: float) -> list[list[Occurrence]]:
    """The events of a trajectory, those at one instant together."""
    instants: list[list[Occurrence]] = []
    for each in trajectory.occurrences:
        if instants and each.time - instants[-1][0].time <= _SAME_INSTANT * length:
            instants[-1].append(each)
        else:
            instants.append([each])
    return instants


def _ids(instants: Sequence[Sequence[Occurrence]]) -> list[tuple[int, ...]]:
    return [tuple(sorted(each.event for each in instant)) for instant in instants]


def _check_order(clock: Clock, trajectory: EventTrajectory, point: Array) -> None:
    """Raise an OrderError if a trajectory does not meet the events in their order."""
    events, order = clock.system.events, clock.order
    instants = _instants(trajectory, clock.length)
    found = _ids(instants)
    before = sum(instant[0].time < clock.horizon[1] for instant in instants)
    exact = order.ending is not Ending.EVENT

    def named(ids: Sequence[int]) -> str:
        return " with ".join(quote(events[k].name) for k in ids)

    for number, (here, there) in enumerate(itertools.zip_longest(found, order.instants), 1):
        if here == there:
            continue
        kind = OrderError
        if here is None:
            what = f"{named(there)}, event {number} elsewhere, does not come"
        elif there is None:
            if not exact or number > before:
                return
            what = f"{named(here)} comes after the last event elsewhere"
            kind = MoreEventsError
        else:
            what = f"event {number} is {named(here)}, elsewhere {named(there)}"
        raise kind(
            f"events do not come in the same order everywhere: {what}{_at(clock, point)}",
            remedy=_REMEDY,
        )


def _ends(clock: Clock, point: Array, time: float, stuck: bool = False) -> OrderError:
    """The error for a trajectory that ends at a time."""
    why = "events accumulate" if stuck else "it cannot be integrated further"
    return OrderError(
        f"a trajectory ends at t = {time:.6g}{_at(clock, point)}: {why}",
        remedy="shorten the horizon or narrow the box",
    )


def _at(clock: Clock, point: Array) -> str:
    names = clock.system.parameters
    named = ", ".join(f"{name} = {x:.6g}" for name, x in zip(names, point, strict=True))
    return f" at {named}" if named else ""
