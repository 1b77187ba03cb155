"""What events do to trajectories at one instant: resets, what these trigger, and ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.ir.events import BOTH, SystemEvent, overlap
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.support.wording import quote
from rankone.trajectories.events.event_trajectory import EventTrajectory

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
        while active.size:
            now, at = times[active], points[:, active]
            after, happened = self._reset(fired, now, before, at)
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
            triggered = self._triggered(happened, now, (before, after), at)
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
        for trajectory, time, state, each in pairs:
            trajectory.stuck = trajectory.rounds >= MOST_ROUNDS
            trajectory.leave(time, tuple(each), self.horizon)
            terminal = any(self.events[k].terminal for k in each)
            trajectory.ends = terminal or trajectory.stuck or not np.isfinite(state).all()

    def due(self, trajectory: EventTrajectory, time: float) -> list[int]:
        """The events of a trajectory at known times that are not later than a time."""
        return np.flatnonzero(trajectory.ahead <= time + SAME_INSTANT * self.horizon).tolist()

    def _reset(
        self, fired: Sequence[Sequence[int]], times: Array, states: Array, points: Array
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
        first = np.minimum(self._heights(waiting, times, states, points), 0.0)
        while waiting.any():
            waiting &= self._heights(waiting, times, states, points) >= first
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

    def _heights(
        self, waiting: NDArray[np.bool_], times: Array, states: Array, points: Array
    ) -> Array:
        """How far events that do not persist are beyond zero (events, m), 0 for all others."""
        heights = np.zeros(waiting.shape)
        for k, event in enumerate(self.events):
            if not event.persistent and waiting[k].any():
                heights[k] = event.direction * np.asarray(event.when(times, states, points))
        return heights

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

    def _triggered(
        self,
        fired: Sequence[Sequence[int]],
        times: Array,
        states: tuple[Array, Array],
        points: Array,
    ) -> list[list[int]]:
        """The events whose surface a reset, from some states (n, m) to others, jumps across."""
        triggered: list[list[int]] = [[] for _ in fired]
        for k, event in enumerate(self.events):
            if event.at is not None:
                continue  # its time is known, whatever the states
            with np.errstate(all="ignore"):
                before, after = (
                    np.broadcast_to(np.sign(event.when(times, each, points)), times.shape)
                    for each in states
                )
            crossed = before * after < 0.0
            if event.direction != BOTH:
                crossed &= after == event.direction
            for place in np.flatnonzero(crossed).tolist():
                if k not in fired[place]:
                    triggered[place].append(k)
        return triggered
