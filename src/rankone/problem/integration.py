"""One trajectory of a problem, from event to event: a first check of any solution.

No step straddles a jump, a switch at a known time or an event that interrupts the trajectory. Steps
are those of :class:`scipy.integrate.LSODA`, which :func:`scipy.integrate.solve_ivp` takes as well.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from rankone.problem.forms import Coordinate
from rankone.problem.numeric import Crossing, NumericEquations, Sides, first_change
from rankone.support.arrays import (
    COARSE,
    COINCIDENT,
    EPSILON,
    LEAST_SQUARED,
    MOST_ROUNDS,
    NEGLIGIBLE,
    ROUNDING,
    SAME,
    Array,
)
from rankone.support.errors import (
    BlowUpError,
    ConvergenceError,
    EvaluationError,
    ProblemError,
    count,
    did_you_mean,
    listing,
    quote,
)
from rankone.support.options import STEP_RTOLS, checked_number
from rankone.tensors.coordinates import Coordinates, name_of
from rankone.trajectories.system.features import overlap

_LEAST_TOLERANCE = 8 * ROUNDING  # Of a step, over the largest value: below it rounding counts
_FIRST_CHANGE = 0.01  # Relative change of the states over the time in which first rates are taken
_FIRST_TIMES = 9  # Times in it at which rates are taken
_NOISE = 8 * EPSILON  # Relative change of the states that tells the noise of rates
_LEAST_PIECE = 4.0  # Shortest time that is integrated over, in roundings
_FEWEST_STEPS = 256  # Of a horizon if there are events: they are looked for in each step
_MOST_STEPS = 200_000  # Steps of a trajectory: about a minute
_MOST_CROSSINGS = 2000  # Places where rates jump with the states: sliding crosses without end
_SHARE_BEFORE = 0.98  # Of the time to a jump of the rates, up to which the next step may go


def _in_units(path: Callable[[Array], Array], units: Array) -> Callable[[Array], Array]:
    """A path of states (n, T) in ``units`` (n,), in those of the equations."""
    return path if (units == 1.0).all() else lambda times: units[:, None] * path(times)


class Integration:
    """One trajectory at a point (d,) of the box, for ascending times.

    Attributes
    ----------
    values : ndarray (n, T)
        The states at the times; after a jump or an event at its time, and NaN after a terminal one.
    events : mapping of str to ndarray
        When each event happened, by name, up to the last of the times.

    Raises
    ------
    BlowUpError
        If the trajectory cannot be continued to the last of the times.
    ConvergenceError
        If it takes too many steps, or events follow each other without end at one instant.
    """

    def __init__(
        self, equations: NumericEquations, point: Array, times: Array, rtol: float
    ) -> None:
        self.equations, self.point, self.times, self.rtol = equations, point, times, rtol
        _, self._start, self._end = equations.time
        self._instant = COINCIDENT * (self._end - self._start)
        self.values = np.full((len(equations.states), times.size), np.nan)
        self._occurrences: list[list[float]] = [[] for _ in equations.events.names]
        self._due: list[list[float]] = [[] for _ in equations.events.names]
        self._sides = Sides(equations.events, point)
        self._steps = self._rounds = self._crossings = 0
        self._interrupted, self._ended = -np.inf, False
        self._first_step: float | None = None
        self._limit = np.inf  # before which rates do not jump with the states
        if times.size:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.filterwarnings("ignore", "lsoda: ", UserWarning)  # failures are handled
                self._integrate()
                self.values = equations.completed(times, self.values, point)

    @property
    def events(self) -> dict[str, Array]:
        pairs = zip(self.equations.events.names, self._occurrences, strict=True)
        return {name: np.array(times, dtype=float) for name, times in pairs}

    def _integrate(self) -> None:
        """Integrate from piece to piece, up to the last of the times."""
        jumps = dict(self.equations.jumps)
        self._time = self._start
        nothing = np.full(len(self.equations.states), np.nan)
        self._state = self.equations.initial(self._start, nothing, self.point)
        self._sizes = np.zeros(len(self._state))
        for a, b in itertools.pairwise(self._pieces(list(jumps))):
            self._piece = a, b
            if a in jumps:
                self._state = jumps[a](a, self._state, self.point)
            fired = self._settled()
            if a == self._start:
                fired += self._known_at(a)
            self._react(a, fired)
            while self._goes_on() and self._time < b:
                due = min(itertools.chain(*self._due), default=b)
                self._follow(min(b, due, self._limit))
                if self._time >= self._limit:
                    self._limit = np.inf
                if self._goes_on() and self._time == due < b - self._instant:
                    self._react(due, [])
            if not self._goes_on():
                return
        self._react(self._end, self._known_at(self._end))

    def _goes_on(self) -> bool:
        return not self._ended and self._time <= self.times[-1]

    def _pieces(self, jumps: list[float]) -> list[float]:
        """The start, the jumps and switches in order, and the end; no two of them are the same."""
        ends = [self._start, *jumps, self._end]
        for at in self.equations.switch_times(self.point):
            if self._start < at < self._end and min(abs(at - e) for e in ends) > self._instant:
                ends.append(at)
        return sorted(set(ends))

    def _rates(self, time: float, state: Array) -> Array:
        """The rates; what switches at the ends of a piece has the value that it has inside."""
        a, b = self._piece
        inside = 0.25 * min(self._instant, b - a)
        return self.equations.rates(min(max(time, a + inside), b - inside), state, self.point)

    # -- steps ------------------------------------------------------------------------------------

    def _follow(self, end: float) -> None:
        """Integrate to the end of a piece, or to the first event that interrupts it."""
        if end - self._time <= _LEAST_PIECE * np.spacing(end):
            self._keep(end, lambda times: np.repeat(self._state[:, None], times.size, axis=1))
            self._time = end
            return
        self._sizes = np.maximum(self._sizes, np.abs(self._state))
        first = self._rates(self._time, self._state)
        if not np.isfinite([*self._state, *first]).all():
            raise self._blow_up()
        absolute, with_events = self._tolerances(end), len(self._occurrences) > 0
        # LSODA squares what it divides by tolerances: tiny states are in units of their own
        units = np.where(absolute < LEAST_SQUARED, np.exp2(np.frexp(absolute)[1] + 0.0), 1.0)
        solver = self._solver(end, absolute, units)
        start, stalls = self._time, 0
        while solver.status == "running" and self._goes_on():
            failure = solver.step()
            stalls = stalls + 1 if solver.t == self._time else 0
            if failure is not None or stalls > MOST_ROUNDS or not np.isfinite(solver.y).all():
                if self._time - start <= self._instant:
                    self._reach_event()
                self._first_step = NEGLIGIBLE * (self._end - self._start)
                return
            self._steps += 1
            if self._steps > _MOST_STEPS:
                raise self._too_long()
            state, path = units * solver.y, _in_units(solver.dense_output(), units)
            self._sizes = np.maximum(self._sizes, np.abs(state))
            if self._jumps_within(path, solver.t):
                return
            if with_events and solver.t > self._time and self._interrupts(path, solver.t):
                return
            self._keep(solver.t, path)
            self._time, self._state = solver.t, state

    def _solver(self, end: float, absolute: Array, units: Array) -> Any:
        """LSODA from the present state on, which is in ``units`` (n,).

        Its steps are short where there are events.
        """
        longest = (self._end - self._start) / _FEWEST_STEPS if self._occurrences else np.inf
        return scipy.integrate.LSODA(
            lambda time, state: self._rates(time, units * state) / units,
            self._time,
            self._state / units,
            end,
            rtol=self.rtol,
            atol=absolute / units,
            max_step=longest,
            first_step=self._first_step and min(self._first_step, end - self._time),
        )

    def _jumps_within(self, path: Callable[[Array], Array], end: float) -> bool:
        """Whether rates jump with the states within a step, which is then not taken.

        The next one ends before they seem to jump. Once a step is as short as an instant, the
        trajectory goes on from behind the jump.
        """
        steps = self.equations.steps
        if not len(steps) or end <= self._time:
            return False

        def cells(time: float) -> tuple[float, ...]:
            return steps.cells(time, path(np.array([time]))[:, 0], self.point)

        behind = first_change(cells, self._time, end)
        if behind is None:
            return False
        self._limit = self._time + _SHARE_BEFORE * (behind - self._time)
        if end - self._time <= self._instant or self._limit <= self._time + self._instant:
            behind = min(end, max(behind, self._time + self._instant))
            state = path(np.array([behind]))[:, 0]
            self._keep(behind, path)
            self._time, self._state, self._limit = behind, state, np.inf
            self._crossings += 1
            if self._crossings > _MOST_CROSSINGS:
                raise self._chatters()
        return True

    def _keep(self, end: float, path: Callable[[Array], Array]) -> None:
        """Keep the states at the times after the present one, up to an end."""
        first, last = np.searchsorted(self.times, [self._time, end], side="right")
        if first < last:
            self.values[:, first:last] = path(self.times[first:last])

    def _tolerances(self, end: float) -> Array:
        """The absolute tolerance (n,) of each state, a share of its size, and more than rounding.

        How large a state becomes that starts at zero, its first rates tell, or the other states.
        """
        start, state, sizes = self._time, self._state, self._sizes.copy()
        first = self._rates(start, state)
        slowness = np.abs(state / first)[(state != 0.0) & (first != 0.0)]
        span = min(end - start, _FIRST_CHANGE * float(np.min(slowness, initial=np.inf)))
        ahead = np.linspace(0.0, span, _FIRST_TIMES)
        rates = np.abs([self._rates(start + s, state + s * first) for s in ahead])
        change = span * np.max(np.where(np.isfinite(rates), rates, 0.0), axis=0)
        at_zero = sizes == 0.0
        sizes[at_zero] = SAME * change[at_zero]
        positive = sizes[sizes > 0.0]
        sizes[sizes == 0.0] = SAME * positive.min() if positive.size else COINCIDENT
        beside = self._rates(start, state * (1.0 + _NOISE))
        noise = np.where(np.isfinite(beside), span * np.abs(beside - first), 0.0)
        resolved = np.maximum(noise, np.finfo(float).smallest_subnormal)
        return np.maximum(max(COARSE * self.rtol, _LEAST_TOLERANCE) * sizes, resolved)

    # -- events -----------------------------------------------------------------------------------

    def _interrupts(self, path: Callable[[Array], Array], end: float) -> bool:
        """Look for events in a step; whether one interrupted the trajectory, which is then past it.

        Events within the same instant happen together.
        """
        events = self.equations.events
        crossings = self._sides.crossings(path, self._time, end, self._rates)
        counting = [
            c
            for c in crossings
            if events.counts(c.event, c.side) and (events.interrupts(c.event) or not c.unresolved)
        ]
        interrupting = [c.time for c in counting if events.interrupts(c.event)]
        if not interrupting:
            self._record(counting)
            self._withdraw(crossings, end)
            self._sides.pass_until(end)
            return False
        time = interrupting[0]
        self._withdraw(crossings, time)
        self._record([c for c in counting if c.time < time - self._instant])
        self._sides.pass_until(time - self._instant)
        now = [c for c in crossings if abs(c.time - time) <= self._instant]
        fired = sorted({c.event for c in now if events.counts(c.event, c.side)})
        unresolved = [c.event for c in now if c.unresolved and c.event in fired]
        if unresolved:
            raise self._stuck(unresolved[0], "it stays on its surface within the tolerance")
        if time > self._time:
            self._state = path(np.array([time]))[:, 0]
        self._keep(time, path)
        self._time = time
        self._react(time, fired, {c.event for c in now})
        return True

    def _reach_event(self) -> None:
        """Continue to an interrupting event right ahead, beyond which there are no rates.

        A tank that runs empty has no rate ``sqrt(x)`` below zero, so that no step passes its event.
        """
        rates = self._rates(self._time, self._state)
        ahead = self._sides.ahead(self._time, self._state, rates)
        reach = NEGLIGIBLE * (self._end - self._start)
        near = {k: delay for k, delay in ahead.items() if delay <= reach}
        if not near or not np.isfinite(rates).all():
            raise self._blow_up()
        delay = min(near.values())
        fired = [k for k, later in near.items() if later - delay <= self._instant]
        time, state = self._time + delay, self._state + delay * rates
        self._keep(time, lambda times: np.repeat(state[:, None], times.size, axis=1))
        self._time, self._state = time, state
        self._react(time, fired, fired)

    def _record(self, crossings: Sequence[Crossing]) -> None:
        for crossing in crossings:
            if crossing.time <= self.times[-1]:
                self._occurrences[crossing.event].append(crossing.time)

    def _settled(self, unmoved: Collection[int] = (), moving: Collection[int] = ()) -> list[int]:
        """Take the sides of the present state; the events that a reset sets off."""
        if not self._occurrences:
            return []
        rates = self._rates(self._time, self._state)
        fired = self._sides.settle(self._time, self._state, rates, unmoved, moving)
        for k, side in enumerate(self._sides.sides.tolist()):
            if self.equations.events.turned(k, side):
                self._due[k] = []
        return fired

    def _known_at(self, time: float) -> list[int]:
        """The events at known times that happen at the start, or at the end: they cross nothing."""
        events = self.equations.events
        if not any(events.scheduled):
            return []
        sides = self._sides.beside(time, self._state, self._rates(time, self._state))
        now = [k for k, at_times in enumerate(events.scheduled) if at_times and sides[k] == 0.0]
        return [k for k in now if not self._occurrences[k]]

    def _react(self, time: float, fired: list[int], on_surface: Collection[int] = ()) -> None:
        """Apply events, and those that are due, and then what they set off, round after round."""
        events = self.equations.events
        while (fired or self._any_due(time)) and not self._ended:
            at_once = time - self._interrupted <= self._instant
            self._rounds = self._rounds + 1 if at_once else 1
            self._interrupted = time
            now = self._started(time, fired)
            if self._rounds > MOST_ROUNDS:
                raise self._stuck(
                    (*fired, *now)[0], f"more than {MOST_ROUNDS} times at one instant"
                )
            before = events.when(time, self._state, self.point)
            slopes = events.slopes(time, self._rates(time, self._state), self._state, self.point)
            self._reset(time, now, before)
            after = events.when(time, self._state, self.point)
            unmoved = [k for k in on_surface if before[k] == after[k]]
            self._sides.return_to([*fired, *on_surface])
            moving = np.flatnonzero(np.nan_to_num(slopes)).tolist()
            fired, on_surface = self._settled(unmoved, moving), ()
        self.values[:, self.times == time] = self._state[:, None]

    def _any_due(self, time: float) -> bool:
        return any(due <= time + self._instant for due in itertools.chain(*self._due))

    def _started(self, time: float, fired: Sequence[int]) -> list[int]:
        """The events that happen now: those that have no delay, and those whose delay is over."""
        delays = self.equations.events.delays
        now = []
        for k in fired:
            delay = delays[k]
            if delay is None:
                now.append(k)
                continue
            (later,) = delay(time, self._state, self.point)
            if not later >= 0.0:
                name = quote(self.equations.events.names[k])
                raise ProblemError(
                    f"the delay of event {name} is {later:.6g} at {self._place()}",
                    remedy="let it be a time that is not negative, everywhere in the box",
                )
            if self._due[k] and not self.equations.events.overlapping[k]:
                raise overlap(self.equations.events.names[k], self._place())
            self._due[k] = sorted([*self._due[k], time + later])
        for k, due in enumerate(self._due):
            if due and due[0] <= time + self._instant:
                now.append(k)
                self._due[k] = due[1:]
        return now

    def _reset(self, time: float, waiting: list[int], first: Array) -> None:
        """Apply events by their priority, and then as listed, unless another one turns them back.

        ``first`` is what crosses zero (events,) before any of them.
        """
        events = self.equations.events
        waiting = sorted(waiting)
        while waiting:
            heights = events.when(time, self._state, self.point)
            sides = 1 * (heights > np.maximum(first, 0.0)) - (heights < np.minimum(first, 0.0))
            waiting = [k for k in waiting if not events.turned(k, int(sides[k]))]
            ranks = [self._priority(k) for k in waiting]
            if not waiting:
                return
            k = waiting.pop(int(np.argmax(ranks)))
            self._record([Crossing(time, k, 0)])
            reset = events.then[k]
            if reset is not None:
                self._state = reset(time, self._state, self.point)
            self._ended |= events.terminal[k]

    def _priority(self, event: int) -> float:
        priority = self.equations.events.priorities[event]
        return 0.0 if priority is None else float(priority(self._time, self._state, self.point)[0])

    def _withdraw(self, crossings: Sequence[Crossing], end: float) -> None:
        """Give up what is due but has turned back by the end of a step."""
        for crossing in crossings:
            if crossing.time <= end and self.equations.events.turned(crossing.event, crossing.side):
                self._due[crossing.event] = []

    # -- errors -----------------------------------------------------------------------------------

    def _place(self) -> str:
        """The present time and the parameters."""
        named = zip(self.equations.parameters, self.point.tolist(), strict=True)
        pairs = [(self.equations.clock, self._time), *named]
        return ", ".join(f"{name} = {value:.6g}" for name, value in pairs)

    def _blow_up(self) -> BlowUpError:
        """The error for a trajectory that does not go on."""
        return BlowUpError(
            f"the trajectory cannot be continued beyond {self._place()}: it grows without bound "
            "there, or a state or rate is not finite",
            time=self._time,
            parameters=dict(zip(self.equations.parameters, self.point.tolist(), strict=True)),
            remedy="let time end earlier, or change the equations",
        )

    def _chatters(self) -> ConvergenceError:
        return ConvergenceError(
            f"the rates jump to and fro more than {_MOST_CROSSINGS} times; the trajectory has "
            f"reached {self._place()}",
            remedy="ro.solve follows what slides where rates jump: evaluate its solution, "
            "or smooth the jump",
        )

    def _too_long(self) -> ConvergenceError:
        return ConvergenceError(
            f"the trajectory takes more than {_MOST_STEPS} steps; it has reached {self._place()}",
            remedy="let time end earlier, or increase rtol",
        )

    def _stuck(self, event: int, reason: str) -> ConvergenceError:
        """The error for events that follow each other without end."""
        name = self.equations.events.names[event]
        return ConvergenceError(
            f"event {quote(name)} happens again and again at {self._place()}: {reason}",
            term=name,
            remedy="let time end earlier, or with that event: terminal=True",
        )


# -----------------------------------------------------------------------------
# One ordinary trajectory of a problem, integrated by SciPy: a first check of any solution.


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """One trajectory of a problem, at the times asked for.

    ``np.asarray(trajectory)`` are its values, and a loop goes through the unknowns.

    Attributes
    ----------
    t : ndarray
        The times, as they were given.
    values : ndarray (unknowns, *shape of the times)
        The unknowns, as a solution returns them.
    states : mapping of str to ndarray
        Unknowns and derivatives that are states, by name.
    events : mapping of str to ndarray
        When each event happened, by name, up to the last of the times.
    """

    t: Array
    values: Array
    states: Mapping[str, Array]
    events: Mapping[str, Array]

    def __getitem__(self, state: object) -> Array:
        """One unknown, or one derivative that is a state: ``trajectory[x.diff(t)]``."""
        name = name_of(state)
        if name not in self.states:
            raise EvaluationError(
                f"no unknown `{name}`{did_you_mean(name, self.states)}; "
                f"the trajectory has {listing(self.states, name)}",
                term=state,
            )
        return self.states[name]

    def __iter__(self) -> Iterator[Array]:
        return iter(self.values)

    def __array__(self, dtype: object = None, copy: bool | None = None) -> Array:
        return np.array(self.values, dtype=dtype, copy=copy)  # type: ignore[call-overload,no-any-return]

    def __repr__(self) -> str:
        text = f"Trajectory of {listing(self.states)} at {count(self.t.size, 'time')}"
        counts = [f"{len(times)} of {name}" for name, times in self.events.items()]
        return f"{text}, with events: {', '.join(counts)}" if counts else text


def trajectory_of(
    equations: NumericEquations,
    coordinates: Sequence[Coordinate],
    unknowns: Sequence[str],
    rtol: object,
    given: tuple[tuple[object, ...], Mapping[str, object]],
) -> Trajectory:
    """The trajectory of equations at times and values ``given`` as the arguments of a call.

    See :meth:`rankone.Problem.trajectory`.
    """
    tolerance = checked_number("rtol", rtol, *STEP_RTOLS, float)
    axes = Coordinates([c.name for c in coordinates], [(c.lower, c.upper) for c in coordinates])
    at, named = given
    times, *values = axes.arrays(axes.gather(at, dict(named)))
    for coordinate, value in zip(coordinates[1:], values, strict=True):
        if value.size != 1:
            raise EvaluationError(
                f"`{coordinate.name}` has {value.size} values; a trajectory has one for each "
                "parameter",
                term=coordinate.name,
                remedy="call it for each",
            )
    point = np.array([value.item() for value in values])
    ascending, places = np.unique(times, return_inverse=True)
    integration = Integration(equations, point, ascending, tolerance)
    states = integration.values[:, places.reshape(times.shape)]
    by_name = dict(zip(map(name_of, equations.states), states, strict=True))
    rows = np.stack([by_name[unknown] for unknown in unknowns])
    return Trajectory(times, rows, by_name, integration.events)
