"""Trajectories over the pseudo-time of stretches, integrated over clock time."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.errors import ConvergenceError
from rankone.trajectories.events import sides as event_order
from rankone.trajectories.events.event_trajectory import EventTrajectory, folded
from rankone.trajectories.events.forced import ForcedTrajectories, forced_trajectories
from rankone.trajectories.events.sides import check_sides, times_to_check
from rankone.trajectories.events.stretches import PseudoTimeTrajectories
from rankone.trajectories.integrators.integrator import (
    EARLY_STEPS,
    SIZE_TIMES,
    Path,
    Paths,
    SampledTrajectories,
    SpanIntegrator,
    Spans,
    Tolerances,
    joined,
)
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.integrators.workers import OnWorkers, hold_all
from rankone.trajectories.stacks.stack import StackedIntegrator
from rankone.trajectories.system.features import Ending, SystemEvent
from rankone.trajectories.system.system import Clock, System
from rankone.trajectories.system.timeline import CLOCK_STATES

_DIGITS = 12  # Decimal digits of pseudo-times that differ


@dataclass(frozen=True)
class StretchTrajectories(PseudoTimeTrajectories):
    """Trajectories over the pseudo-time of stretches, integrated over clock time.

    ``borders`` (m, stretches + 1) are the clock times at which stretches begin and end; ``points``
    are (m, d). Lifted states of the ``system`` are what they stand for.
    """

    system: System
    points: Array
    trajectories: Sequence[EventTrajectory]
    clock: Clock
    borders: Array
    integrator: str
    method: str
    avoided: float = 0.0

    @property
    def end(self) -> float:
        return float(self.clock.order.stretches)

    @property
    def steps(self) -> int:
        return max(each.steps for each in self.trajectories)

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
            np.max([path.largest(steps) for path in each.paths], axis=0)[: self.clock.n_states]
            for each in self.trajectories
        ]
        largest = np.concatenate([np.stack(states, axis=1), clock])
        if not self.system.n_lifted:
            return largest
        lifted = self(np.linspace(0.0, self.end, SIZE_TIMES))[len(largest) :]
        return np.concatenate([largest, np.abs(lifted).max(axis=2)])

    def __call__(self, times: Array) -> Array:
        """States, clock and length of the stretch (n + 2, m, T) at pseudo-times (T,)."""
        stretch = np.clip(np.floor(times).astype(int), 0, self.clock.order.stretches - 1)
        n = self.clock.n_states
        lengths = np.diff(self.borders, axis=1)[:, stretch]
        at = self.borders[:, stretch] + (times - stretch) * lengths
        states = np.empty((n + CLOCK_STATES, len(self.trajectories), times.size))
        states[n], states[n + 1] = at, lengths
        read, place = self._distinct(times, stretch)
        first, at = self._first_alike[stretch[read]], folded(at[:, read], *self._periods)
        distinct = np.empty((n, len(self.trajectories), read.size))
        for i in np.unique(first):
            here = first == i
            distinct[:, :, here] = self._paths[i](at[:, here])[:n]
        states[:n] = distinct[:, :, place]
        return self._with_lifted(times, states)

    def _distinct(
        self, times: Array, stretch: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Of pseudo-times (T,) those to be read, and for each time the one with the same states.

        Where all trajectories repeat, they are where they were some periods before.
        """
        ends, periods = self._periods
        if not periods.all():
            return np.arange(times.size), np.arange(times.size)
        settled = int((self.borders[:, 1:] <= ends).sum(axis=1).max())
        period = self.clock.marks_per_period
        rounds = np.maximum((stretch - settled) // period + 1, 0)
        before = np.round(times - rounds * period, _DIGITS)
        _, read, place = np.unique(before, return_index=True, return_inverse=True)
        return read, place

    def of(self, trajectories: slice) -> StretchTrajectories:
        """Some of the trajectories; see :meth:`DenseTrajectories.of`."""
        points, borders = self.points[trajectories], self.borders[trajectories]
        each = self.trajectories[trajectories]
        return replace(self, points=points, trajectories=each, borders=borders)

    def _with_lifted(self, times: Array, states: Array) -> Array:
        """The states (n + 2, m, T), and behind them the lifted ones."""
        count = self.system.n_lifted
        if not count:
            return states
        lifted = np.concatenate([states, np.ones((count, *states.shape[1:]))])
        points = np.ascontiguousarray(self.points.T)[:, :, None]
        for _ in range(count):  # some stand for functions of others
            lifted[len(states) :] = self.system.meanings(times, lifted, points)
        return lifted

    def at(self, k: int, times: Array) -> Array:
        """States (n, T) of one trajectory at clock times (T,), NaN after its end."""
        return self.trajectories[k](times)[: self.clock.n_states]

    def check_sides(self) -> None:
        """Raise an OrderError if a trajectory is not on the sides of switches that it should be."""
        times = times_to_check(self.borders)
        states = [each(times[:, i]) for i, each in enumerate(self._paths)]
        check_sides(self.clock, np.stack(states, axis=2), times, self.points)

    def samples(self, count: int) -> list[tuple[float, Array]]:
        s = np.linspace(0.0, self.end, count + 2)[1:]
        return list(zip(s.tolist(), np.moveaxis(self(s), 2, 0), strict=True))

    @cached_property
    def _periods(self) -> tuple[Array, Array]:
        """Where the paths of trajectories end (m, 1), and the periods in which they go on."""
        ends = [[each.paths[-1].end] for each in self.trajectories]
        return np.array(ends), np.array([[each.period] for each in self.trajectories])

    @cached_property
    def _paths(self) -> list[Paths]:
        """The trajectories over clock time on each stretch."""
        events = self.clock.system.events
        if not any(event.interrupts for event in events):  # one path serves all stretches
            own = [[path for path in each.paths if path.steps] for each in self.trajectories]
            return [Paths.of([*map(joined, own)])] * self.clock.order.stretches
        each = zip(self.trajectories, self.borders, strict=True)
        length = self.clock.length
        paths = [_paths(trajectory, events, borders, length) for trajectory, borders in each]
        stretches: list[Paths] = []
        before: tuple[Path, ...] = ()
        for stretch in zip(*paths, strict=True):
            alike = all(map(operator.is_, stretch, before)) if before else False
            stretches.append(stretches[-1] if alike else Paths.of(stretch))
            before = stretch
        return stretches

    @cached_property
    def _first_alike(self) -> NDArray[np.intp]:
        """For each stretch the first one whose paths serve it too."""
        firsts: dict[int, int] = {}
        return np.array([firsts.setdefault(id(each), i) for i, each in enumerate(self._paths)])


def _paths(
    trajectory: EventTrajectory, events: Sequence[SystemEvent], borders: Array, length: float
) -> list[Path]:
    """A trajectory over each stretch: a path between two resets serves several.

    Resets at one instant may be a rounding apart; what is between them is on no stretch.
    """
    resets = [
        [o for o in instant if events[o.event].interrupts]
        for instant in event_order.instants_of(trajectory, length)
    ]
    first, last = (np.array([each[place].time for each in resets if each]) for place in (0, -1))
    pieces: dict[int, list[Path]] = {}
    for path in trajectory.paths:
        piece = int(np.searchsorted(first, path.breaks[0], side="right"))
        if path.steps and not (piece and path.breaks[0] < last[piece - 1]):
            pieces.setdefault(piece, []).append(path)
    whole = {piece: joined(paths) for piece, paths in pieces.items()}
    for piece, each in enumerate(filter(None, resets), 1):
        # where the next one is at once, the trajectory rests
        whole.setdefault(piece, Path.resting(each[-1].time, each[-1].after))
    start = trajectory.paths[0]  # an event at its very start ends a stretch of no length
    whole.setdefault(0, Path.resting(float(start.breaks[0]), start.state))
    instant = event_order.ONE_INSTANT * length
    return [whole[0], *(whole[int(k)] for k in np.searchsorted(first - instant, borders[1:-1]))]


@dataclass(frozen=True)
class StretchIntegrator:
    """An :class:`Integrator` of systems in stretches: integrates over clock time, by another one.

    Trajectories that an integrator on workers would divide into groups are followed so, with the
    same bits whoever follows them.

    An OrderError says where a trajectory does not meet the events of the others.
    """

    integrator: SpanIntegrator
    name: str

    def run(
        self, system: System, points: Array, edges: Sequence[float], tolerances: Tolerances
    ) -> StretchTrajectories | ForcedTrajectories:
        """Trajectories at all pseudo-times, always to their end; see :meth:`Integrator.run`."""
        clock = system.clock
        assert clock is not None
        assert tuple(edges[:: len(edges) - 1]) == system.horizon
        n, order = clock.n_states, clock.order
        per_stretch = clock.length / order.stretches
        absolute = np.broadcast_to(tolerances.absolute, (system.n_differential, 1))[:n]
        tolerances = replace(
            tolerances,
            absolute=np.concatenate([absolute, np.ones((clock.system.n_sides, 1))]),
            longest_step=tolerances.longest_step * per_stretch,
        )
        if clock.forced is not None:
            return forced_trajectories(system, clock, self.integrator, points, tolerances)
        if isinstance(self.integrator, OnWorkers):
            trajectories, borders = self._in_groups(self.integrator, system, points, tolerances)
        else:
            trajectories, borders = self.followed(clock, points, tolerances)
        single = self.name == "single"
        method = "LSODA" if single else "DOP853"
        name = "single" if single else "stack"
        dense = StretchTrajectories(system, points, trajectories, clock, borders, name, method)
        if clock.system.n_sides:
            dense.check_sides()
        return dense

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

    def _in_groups(
        self,
        integrator: OnWorkers[SingleIntegrator] | OnWorkers[StackedIntegrator],
        system: System,
        points: Array,
        tolerances: Tolerances,
    ) -> tuple[list[EventTrajectory], Array]:
        """The same as :meth:`followed`, group by group."""
        assert system.clock is not None
        alone = replace(self, integrator=integrator.integrator)
        groups = integrator.groups(system.clock.system, points)
        tasks = [(alone, group, tolerances) for group in groups]
        results = integrator.map(_followed, system, tasks, ConvergenceError)
        trajectories = [each for some, _ in results for each in some]
        if integrator.sends(system) and len(results) > 1:
            hold_all([path for each in trajectories for path in each.paths])
        return trajectories, np.concatenate([borders for _, borders in results])

    def followed(
        self, clock: Clock, points: Array, tolerances: Tolerances
    ) -> tuple[list[EventTrajectory], Array]:
        """Trajectories from event to event, and the times at which their stretches end."""
        trajectories = event_order.follow(
            clock, self.integrator, points, tolerances, len(clock.order.instants)
        )
        borders = event_order.stretch_borders(clock, trajectories, points)
        if clock.order.ending is Ending.LENGTH:
            self._finish(clock, trajectories, points, borders[:, -1], tolerances)
        return trajectories, borders

    def _finish(
        self,
        clock: Clock,
        trajectories: Sequence[EventTrajectory],
        points: Array,
        ends: Array,
        tolerances: Tolerances,
    ) -> None:
        """Go on to the ends, beyond the horizon without events."""
        short = [k for k, each in enumerate(trajectories) if each.end < ends[k]]
        if not short:
            return
        starts = np.array([trajectories[k].end for k in short])
        states = np.stack([trajectories[k].state for k in short], axis=1)
        spans = Spans(starts, states, ends[short])
        paths = self.integrator.paths(clock.system, points[short], spans, tolerances)
        for k, path in zip(short, paths, strict=True):
            if path.end < ends[k] - event_order.ONE_INSTANT * clock.length:
                raise event_order.end_error(clock, points[k], path.end)
            trajectories[k].paths.append(path)


def _followed(
    system: System, integrator: StretchIntegrator, points: Array, tolerances: Tolerances
) -> tuple[list[EventTrajectory], Array]:
    """What a worker follows."""
    assert system.clock is not None
    return integrator.followed(system.clock, points, tolerances)
