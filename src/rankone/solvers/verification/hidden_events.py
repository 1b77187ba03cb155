"""Events that take place so briefly that no step of a reference trajectory saw them.

Each step is looked at through :mod:`enclosures <rankone.solvers.verification.enclosures>` of the
heights of events, which cross zero there. Where they may hide a zero, the step is halved, and only
the halves in doubt are looked at again. The crossings that samples show there are compared with
those that the trajectory met.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.verification.enclosures.bounds import Function
from rankone.solvers.verification.enclosures.enclosure import Enclosure
from rankone.solvers.verification.enclosures.generated import UnsuitableError, arguments, enclosed
from rankone.solvers.verification.steps import HALVINGS, Allowance, Pieces, Steps, blocks
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import Cost, function_cost
from rankone.trajectories.events.event_trajectory import EventTrajectory, held_together
from rankone.trajectories.integrators.integrator import NODES
from rankone.trajectories.system.events import BOTH, Row, SystemEvent
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import HiddenEvent

_LEAST_DOUBT = 1e-12  # Doubt over the largest height of an event that may hide a zero
_ROUNDINGS = 64.0 * np.finfo(float).eps  # Of numbers that a height is made of, relative to them
_NEAR = 0.01  # Distance in time from an event that is not told from it, in horizons, over rtol
_CHANGES = 3  # Random changes by as much, which tell what becomes of heights


def hidden_event(
    system: System,
    trajectories: Sequence[EventTrajectory],
    points: Array,
    horizon: tuple[float, float],
    rtol: float,
) -> HiddenEvent | None:
    """An event that a trajectory at one of the points (m, d) misses before the end, if it does.

    Events at known times are never missed. Conditions that call helpers of a generated module are
    not looked at. Limits of the solve hold.
    """
    conditions = _Conditions.of(system)
    if conditions is None:
        return None
    near = _NEAR * rtol * (horizon[1] - horizon[0])
    for some in held_together(trajectories):
        paths = [(path, k) for k, each in enumerate(trajectories[some]) for path in each.paths]
        owners = [k for _, k in paths]
        steps = Steps.of(system.jumps.times, [path for path, _ in paths], owners, points[some])
        steps = steps.before(horizon[1])
        look = _Look(conditions, steps)
        with np.errstate(all="ignore"):
            samples, left = look.samples()
            met = _Met(conditions, steps, trajectories[some], near)
            place = next(filter(None, map(met.missed, samples.groups())), left)
        if place is not None:
            at = zip(system.parameters, steps.parameters[:, place.step].tolist(), strict=True)
            time = steps.time(place.step, place.share)
            return HiddenEvent(system.events[place.event].name, time, tuple(at))
    return None


@dataclass(frozen=True)
class _Conditions:
    """What crosses zero at some ``events``, by their positions: rows of a generated function."""

    events: dict[int, SystemEvent]
    rows: list[int]
    function: Function
    cost: Cost

    @classmethod
    def of(cls, system: System) -> _Conditions | None:
        """Those of a system at times that are not known, None where there are none to look at."""
        events = {k: e for k, e in enumerate(system.events) if e.at is None}
        rows = {k: e.when for k, e in events.items() if isinstance(e.when, Row)}
        if not rows:
            return None
        generated = next(iter(rows.values())).function
        try:
            function = enclosed(generated)
        except UnsuitableError:
            return None
        cost = function_cost(generated, system.user_functions)
        numbers = [row.row for row in rows.values()]
        return cls({k: events[k] for k in rows}, numbers, function, cost)

    def enclosed(self, times: Array, states: Array, parameters: Array) -> list[Enclosure]:
        """Heights on pieces, at times (nodes, N), states (n, nodes, N), parameters (d, N)."""
        all_rows = self.function(*arguments(self.cost, times, states, parameters))
        return [Enclosure.of(all_rows[row]) for row in self.rows]


@dataclass(frozen=True)
class _Group:
    """Samples of the heights of an event on a step, at ascending shares (k,), with their signs.

    None of the ``signs`` (k,) is zero.
    """

    event: int
    step: int
    shares: Array
    signs: Array

    def of(self, chosen: NDArray[np.bool_]) -> _Group:
        """Some of the samples."""
        return _Group(self.event, self.step, self.shares[chosen], self.signs[chosen])

    def crossings(self, direction: int) -> Array:
        """Shares about where heights cross zero in a direction."""
        change = np.sign(np.diff(self.signs))
        crossed = change != 0.0 if direction == BOTH else change == direction
        return np.asarray(0.5 * (self.shares[:-1] + self.shares[1:])[crossed])


@dataclass(frozen=True)
class _Samples:
    """Signs of heights of events at shares of steps, all (N,)."""

    event: NDArray[np.intp]
    step: NDArray[np.intp]
    share: Array
    sign: Array

    @classmethod
    def joined(cls, parts: Sequence[_Samples]) -> _Samples:
        """All samples of several parts."""
        each = ([p.event, p.step, p.share, p.sign] for p in parts)
        return cls(*map(np.concatenate, zip(*each, strict=True)))

    def groups(self) -> Iterator[_Group]:
        """Those of an event on a step together, where signs differ."""
        order = np.lexsort((self.share, self.step, self.event))
        order = order[np.abs(self.sign[order]) == 1.0]  # neither zero nor not a number
        event, step = self.event[order], self.step[order]
        share, sign = self.share[order], self.sign[order]
        borders = 1 + np.flatnonzero((np.diff(event) != 0) | (np.diff(step) != 0))
        for places in np.split(np.arange(order.size), borders):
            if places.size and (sign[places] != sign[places[0]]).any():
                first = places[0]
                yield _Group(int(event[first]), int(step[first]), share[places], sign[places])


@dataclass(frozen=True)
class _Place:
    """A share of a step where an event is missed."""

    event: int
    step: int
    share: float


@dataclass(frozen=True)
class _Look:
    """A look at what the heights of events hide on steps."""

    conditions: _Conditions
    steps: Steps

    def samples(self) -> tuple[_Samples, _Place | None]:
        """Samples where heights were in doubt, and a place if there are too many to look at.

        Where there are too many, every second trajectory that is in doubt goes on.
        """
        pieces = Pieces.whole(self.steps.starts.size)
        in_doubt = np.ones((len(self.conditions.events), pieces.step.size), bool)
        allowance, seen, left = Allowance(self.steps.owners), list[_Samples](), None
        least: Array | None = None
        for _ in range(HALVINGS):
            going_on = allowance.going_on(pieces)
            if going_on is None:
                left = self._first_of(pieces, in_doubt)
                break
            pieces, in_doubt = pieces.some(going_on), in_doubt[:, going_on]
            values, hidden = self._heights(pieces)
            if least is None:
                sizes = np.abs(np.where(np.isfinite(values), values, 0.0)).max(axis=(1, 2))
                least = _LEAST_DOUBT * sizes[:, None]
            doubtful = in_doubt & (hidden > least)
            seen.append(self._samples_of(pieces, values, in_doubt if seen else doubtful))
            chosen = np.flatnonzero(doubtful.any(axis=0))
            pieces, in_doubt = pieces.some(chosen).halves(), np.tile(doubtful[:, chosen], 2)
            if not pieces.step.size:
                break
        return _Samples.joined(seen), left

    def _heights(self, pieces: Pieces) -> tuple[Array, Array]:
        """Heights of events (events, nodes, N), and how much may hide a zero there (events, N)."""
        parts = [self._block(pieces.some(block)) for block in blocks(pieces.step.size)]
        values, hidden = zip(*parts, strict=True)
        return np.concatenate(values, axis=2), np.concatenate(hidden, axis=1)

    def _block(self, pieces: Pieces) -> tuple[Array, Array]:
        shares = pieces.shares
        times, states = self.steps.at(pieces)
        rows = self.conditions.enclosed(times, states, self.steps.parameters[:, pieces.step])
        values = np.stack([np.broadcast_to(row.values, shares.shape) for row in rows])
        hidden = np.stack([np.broadcast_to(_hidden(row), shares.shape[1:]) for row in rows])
        return values, np.where(np.isnan(values).all(axis=1), 0.0, hidden)

    def _first_of(self, pieces: Pieces, doubtful: NDArray[np.bool_]) -> _Place:
        """The middle of the first piece, where some events are in doubt: (events, N)."""
        event = [*self.conditions.events][int(doubtful[:, 0].argmax())]
        return _Place(event, int(pieces.step[0]), float(pieces.lower[0] + 0.5 * pieces.length[0]))

    def _samples_of(self, pieces: Pieces, values: Array, chosen: NDArray[np.bool_]) -> _Samples:
        """Samples at the nodes of pieces of the events chosen there, (events, N)."""
        row, piece = np.nonzero(chosen)
        event = np.array([*self.conditions.events])[row]
        nodes = NODES.size
        return _Samples(
            np.repeat(event, nodes),
            np.repeat(pieces.step[piece], nodes),
            pieces.shares[:, piece].T.ravel(),
            np.sign(values[row, :, piece]).ravel(),
        )


def _hidden(height: Enclosure) -> Array | float:
    """The doubt (N,) about a height where its range holds zero, else zero."""
    if height.doubt is None:
        return 0.0
    low, high = height.range()
    return np.where((low <= 0.0) & (high >= 0.0), height.doubt, 0.0)


@dataclass(frozen=True)
class _Met:
    """What trajectories have met of what samples of heights show: not what is ``near`` to it."""

    conditions: _Conditions
    steps: Steps
    trajectories: Sequence[EventTrajectory]
    near: float

    def missed(self, group: _Group) -> _Place | None:
        """Where a trajectory passes an event more often than it has met it."""
        event = self.conditions.events[group.event]
        begin, end = self.steps.times(group.step, np.array([0.0, 1.0]))
        met = self.trajectories[self.steps.owners[group.step]].times_of(group.event)
        inside = (met > begin + self.near) & (met < end - self.near)
        times = self.steps.times(group.step, group.shares)
        apart = np.abs(times[:, None] - met).min(axis=1, initial=np.inf) > self.near
        group = group.of(apart)
        if group.crossings(event.direction).size <= inside.sum():
            return None
        group = group.of(self._beyond_rounding(event, group))
        crossings = group.crossings(event.direction)
        if crossings.size <= inside.sum():
            return None
        times = self.steps.times(group.step, crossings)
        unmet = np.abs(times[:, None] - met[inside]).min(axis=1, initial=np.inf).argmax()
        return _Place(group.event, group.step, float(crossings[unmet]))

    def _beyond_rounding(self, event: SystemEvent, group: _Group) -> NDArray[np.bool_]:
        """Whether signs of samples (k,) stay as they are if what heights are made of is rounded."""
        step = np.full(group.shares.size, group.step)
        shares = group.shares[None]
        times, states = self.steps.times(step, shares), self.steps.states(step, shares)
        sizes = np.abs(self.steps.nodal[group.step]).max(axis=0)[:, None]
        parameters = self.steps.parameters[:, step]
        random, same = np.random.default_rng(3061), np.ones(step.size, dtype=bool)
        charge(_CHANGES * self.conditions.cost(step.size))
        for _ in range(_CHANGES):
            time, state, parameter = (
                _ROUNDINGS * random.choice([-1.0, 1.0], (k, 1))
                for k in (1, len(sizes), len(parameters))
            )
            changed = event.when(
                times[0] * (1.0 + time[0]),
                states[:, 0] + state * sizes,
                parameters * (1.0 + parameter),
            )
            same &= np.sign(changed) == group.signs
        return same
