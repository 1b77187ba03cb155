"""What events do to trajectories at one instant, and what crosses zero there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL
from rankone.support.errors import ProblemError
from rankone.support.wording import quote
from rankone.trajectories.events.event_trajectory import EventTrajectory
from rankone.trajectories.integrators.integrator import NODES
from rankone.trajectories.system.events import BOTH, SystemEvent, overlap

LOOK_COST = 10.0
"""Operations of an event function for each number that it reads."""
_ROUNDINGS = 64.0 * np.finfo(float).eps  # Of numbers that a height is made of, relative to them
_CHANGES = 3  # Random changes by as much, which tell what becomes of them


def heights_of(event: SystemEvent, times: Array, states: Array, parameters: Array) -> Array:
    """What crosses zero at an event, (N,), at times (N,), states (n, N) and parameters (d, N)."""
    charge(CALL + LOOK_COST * states.size)
    with np.errstate(all="ignore"):
        heights = np.asarray(event.when(times, states, parameters), dtype=float)
    return np.broadcast_to(heights, times.shape).copy()


def roundings_of(
    event: SystemEvent,
    times: Array,
    states: Array,
    parameters: Array,
    sizes: Array,
    heights: Array,
) -> Array:
    """By how much heights (N,) change if what they are made of is rounded.

    States are rounded relative to their ``sizes`` (n, N) nearby: next to zero they are no more
    accurate than where they came from. Whatever is on a surface to within that is on it.
    """
    random, largest = np.random.default_rng(3061), np.zeros(times.size)
    for _ in range(_CHANGES):
        factors = [random.uniform(0.5, 1.0, k) for k in (1, len(sizes), len(parameters))]
        time, state, parameter = (
            (_ROUNDINGS * factor * random.choice([-1.0, 1.0], factor.size))[:, None]
            for factor in factors
        )
        changed = heights_of(
            event, times * (1.0 + time[0]), states + state * sizes, parameters * (1.0 + parameter)
        )
        with np.errstate(all="ignore"):
            largest = np.fmax(largest, np.abs(changed - heights))
    return largest


def sides_of_surface(
    event: SystemEvent, times: Array, states: Array, parameters: Array, sizes: Array
) -> Array:
    """The sides of its surface that states are on, (N,): 0 on it, NaN where it is no number."""
    heights = heights_of(event, times, states, parameters)
    roundings = roundings_of(event, times, states, parameters, sizes, heights)
    return np.where(np.abs(heights) <= roundings, 0.0, np.sign(heights))


# -----------------------------------------------------------------------------
# What events do to trajectories at one instant: resets, what these trigger, and ends.


MOST_ROUNDS = 100
"""Events of a trajectory at one instant, after which it ends."""
SAME_INSTANT = 1e-12
"""Part of the horizon within which times along a trajectory are the same."""


@dataclass(frozen=True)
class Instants:
    """Applies events to trajectories that meet them, all at one instant, round after round."""

    events: tuple[SystemEvent, ...]
    horizon: float

    def apply(
        self,
        trajectories: Sequence[EventTrajectory],
        fired: list[list[int]],
        times: Array,
        states: Array,
        points: Array,
    ) -> None:
        """Apply the events that each trajectory has met at its time, and what they trigger.

        Times are (m,), states (n, m) and points (d, m).
        """
        active, before, last = np.arange(len(trajectories)), states, states.copy()
        all_happened: list[list[int]] = [[] for _ in fired]
        sizes = _sizes(trajectories, states)
        sides = self._sides(times, states, points, sizes)
        for k, place in np.argwhere(sides == 0.0).tolist():
            if k not in fired[place]:
                sides[k, place] = self._came_from(k, trajectories[place], points[:, place])
        landed = np.zeros(sides.shape, dtype=bool)
        while active.size:
            now, at = times[active], points[:, active]
            after, happened = self._reset(fired, now, before, at, sizes[:, active])
            last[:, active] = after
            self._put_off(trajectories, active, happened, now, before, at)
            for place, each, *pair in zip(
                active.tolist(), happened, before.T, after.T, strict=True
            ):
                trajectory = trajectories[place]
                here = trajectory.end
                for k in each:
                    trajectory.happen(k, here, *pair)
                trajectory.rounds += 1
            sizes[:, active] = np.maximum(sizes[:, active], np.abs(after))
            came, on = sides[:, active], self._sides(now, after, at, sizes[:, active])
            for column, each in enumerate(fired):
                came[each, column] = 0.0
            landed[:, active] = on == 0.0
            sides[:, active] = np.where(on == 0.0, came, on)
            triggered = self._triggered(came, on)
            for place, time, each in zip(active.tolist(), now, triggered, strict=True):
                each += self.due(trajectories[place], time)
            goes_on = np.array(
                [
                    bool(further)
                    and not any(self.events[k].terminal for k in each)
                    and trajectories[place].rounds < MOST_ROUNDS
                    for place, each, further in zip(
                        active.tolist(), happened, triggered, strict=True
                    )
                ]
            )
            fired = [each for each, on in zip(triggered, goes_on, strict=True) if on]
            for place, each in zip(active.tolist(), happened, strict=True):
                all_happened[place] += each
            active, before = active[goes_on], after[:, goes_on]
        pairs = zip(trajectories, times.tolist(), last.T, all_happened, strict=True)
        for place, (trajectory, time, state, each) in enumerate(pairs):
            trajectory.stuck = trajectory.rounds >= MOST_ROUNDS
            trajectory.landed = _landed(landed[:, place], sides[:, place])
            trajectory.leave(time, tuple(each), self.horizon)
            terminal = any(self.events[k].terminal for k in each)
            trajectory.ends = terminal or trajectory.stuck or not np.isfinite(state).all()

    def _came_from(self, k: int, trajectory: EventTrajectory, point: Array) -> float:
        """The side of the surface of event ``k`` from which a trajectory came to it, 0 for none.

        It met the event already, unless it was beside the surface since.
        """
        path = trajectory.paths[-1]
        if not path.steps:
            return trajectory.landed.get(k, 0.0)
        times = path.breaks[-2] + (path.breaks[-1] - path.breaks[-2]) * NODES
        states = path.nodal[-1].T
        sizes = np.broadcast_to(np.abs(states).max(axis=1, keepdims=True), states.shape)
        columns = np.broadcast_to(point[:, None], (point.size, times.size))
        sides = sides_of_surface(self.events[k], times, states, columns, sizes)
        beside = np.flatnonzero(np.abs(sides) > 0.0)
        if not beside.size:
            return trajectory.landed.get(k, 0.0)
        last = float(times[beside[-1]])
        met = any(each.event == k and each.time >= last for each in trajectory.occurrences)
        return 0.0 if met else float(sides[beside[-1]])

    def land(
        self, trajectories: Sequence[EventTrajectory], times: Array, states: Array, points: Array
    ) -> None:
        """Note on which surfaces trajectories begin, or jump to, at times (m,); from no side."""
        sides = self._sides(times, states, points, _sizes(trajectories, states))
        for trajectory, each in zip(trajectories, sides.T, strict=True):
            trajectory.landed = _landed(each == 0.0, each)

    def due(self, trajectory: EventTrajectory, time: float) -> list[int]:
        """The events of a trajectory at known times that are not later than a time."""
        return np.flatnonzero(trajectory.ahead <= time + SAME_INSTANT * self.horizon).tolist()

    def _reset(
        self,
        fired: Sequence[Sequence[int]],
        times: Array,
        states: Array,
        points: Array,
        sizes: Array,
    ) -> tuple[Array, list[list[int]]]:
        """The states (n, m) after events at times (m,), and the events in their order.

        That is the order of their priorities, taken anew after each of them, and then of the list.
        An event that does not persist is left out once another one has turned it back.
        """
        states = states.copy()
        happened: list[list[int]] = [[] for _ in fired]
        waiting = np.array([[k in each for each in fired] for k in range(len(self.events))])
        for k, event in enumerate(self.events):
            if event.cancels is not None:
                waiting[event.cancels] &= ~waiting[k]
        turned = self._turned(waiting, times, states, points, sizes)
        while waiting.any():
            waiting &= turned | ~self._turned(waiting, times, states, points, sizes)
            priorities = np.where(
                waiting, self._priorities(waiting, times, states, points), -math.inf
            )
            chosen = np.where(waiting.any(axis=0), priorities.argmax(axis=0), -1)
            for k in np.unique(chosen[chosen >= 0]).tolist():
                met, then = chosen == k, self.events[k].then
                waiting[k, met] = False
                for place in np.flatnonzero(met).tolist():
                    happened[place].append(k)
                if then is not None:
                    after = then(times[met], states[:, met], points[:, met])
                    states[:, met] = np.asarray(after, dtype=float).reshape(len(states), -1)
        return states, happened

    def _turned(
        self, waiting: NDArray[np.bool_], times: Array, states: Array, points: Array, sizes: Array
    ) -> NDArray[np.bool_]:
        """Which events (events, m) do not persist, and are on the side that they came from."""
        turned = np.zeros(waiting.shape, dtype=bool)
        for k, event in enumerate(self.events):
            if not event.persistent and waiting[k].any():
                side = sides_of_surface(event, times, states, points, sizes)
                turned[k] = event.direction * side < 0.0
        return turned

    def _priorities(
        self, waiting: NDArray[np.bool_], times: Array, states: Array, points: Array
    ) -> Array:
        """The priorities of events (events, m), 0 for those that have none."""
        priorities = np.zeros(waiting.shape)
        for k, event in enumerate(self.events):
            if event.priority is not None and waiting[k].any():
                priorities[k] = event.priority(times, states, points)
        return priorities

    def _put_off(
        self,
        trajectories: Sequence[EventTrajectory],
        active: NDArray[np.intp],
        happened: Sequence[Sequence[int]],
        times: Array,
        states: Array,
        points: Array,
    ) -> None:
        """Put off what events start after a delay, and give up what they cancel."""
        for k, event in enumerate(self.events):
            met = np.array([k in each for each in happened])
            if not met.any():
                continue
            some = [trajectories[place] for place in active[met].tolist()]
            if event.cancels is not None:
                for trajectory in some:
                    trajectory.put_off(event.cancels, [])
            if event.starts is None or event.delay is None:
                continue
            delays = event.delay(times[met], states[:, met], points[:, met])
            delays = np.broadcast_to(np.asarray(delays, dtype=float), times[met].shape)
            if not (delays >= 0.0).all():
                worst = int(np.flatnonzero(~(delays >= 0.0))[0])
                raise ProblemError(
                    f"the delay of event {quote(self.events[event.starts].name)} is "
                    f"{delays[worst]:.6g} at t = {times[met][worst]:.6g}",
                    remedy="let it be a time that is not negative, everywhere in the box",
                )
            for trajectory, due in zip(some, (times[met] + delays).tolist(), strict=True):
                planned = trajectory.due.get(event.starts, [])
                if planned and not event.overlapping:
                    raise overlap(self.events[event.starts].name, f"t = {trajectory.end:.6g}")
                trajectory.put_off(event.starts, [*planned, due])

    def _sides(self, times: Array, states: Array, points: Array, sizes: Array) -> Array:
        """The sides of their surfaces that states (n, m) are on, (events, m), 0 if on them.

        NaN for events at known times, whatever the states.
        """
        sides = np.full((len(self.events), times.size), np.nan)
        for k, event in enumerate(self.events):
            if event.at is None:
                sides[k] = sides_of_surface(event, times, states, points, sizes)
        return sides

    def _triggered(self, before: Array, after: Array) -> list[list[int]]:
        """The events whose surface a reset jumps across, from some sides (events, m) to others."""
        directions = np.array([[event.direction] for event in self.events])
        crossed = (before * after < 0.0) & ((directions == BOTH) | (after == directions))
        return [np.flatnonzero(each).tolist() for each in crossed.T]


def _sizes(trajectories: Sequence[EventTrajectory], states: Array) -> Array:
    """The sizes of states (n, m) that trajectories are put to, and of those before."""
    before = np.stack([each.sizes for each in trajectories], axis=1)
    return np.asarray(np.maximum(before, np.abs(states)))


def _landed(on: NDArray[np.bool_], sides: Array) -> dict[int, float]:
    """The events on whose surface a trajectory is, of all (events,), and where it came from."""
    return {k: float(sides[k]) for k in np.flatnonzero(on).tolist()}
