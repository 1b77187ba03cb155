"""Steps of trajectories of fields, from event to event.

They are those of SciPy's backward differences (Shampine & Reichelt, SIAM J. Sci. Comput. 18
(1997), 1) with the sparse Jacobian.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.integrate
import scipy.sparse as ss

from rankone.support.arrays import COINCIDENT, EPSILON, TINY, Array
from rankone.support.budget import charge
from rankone.trajectories.events.event_trajectory import accumulate
from rankone.trajectories.fields.field_crossings import (
    FieldCrossings,
    Occurred,
    UnresolvedEventError,
)
from rankone.trajectories.fields.field_factors import Factorisation, factorisation_of
from rankone.trajectories.fields.field_system import FieldSystem

_GROWTH = 1e3  # Of the largest value, at which it leaves all bounds
_LINEAR_ENTRY = 2.0  # Operations for each entry of a matrix
_MOST_STRETCHES = 1000  # From event to event; where there are more of them they accumulate


class EndsEarlyError(Exception):
    """A trajectory of fields does not reach the end: ``time`` is as far as it came.

    It ``grows`` beyond all bounds there, its events ``accumulate``, rates are ``undefined``, or its
    steps shrink without such a reason.
    """

    def __init__(
        self,
        time: float,
        point: Array,
        grows: bool = False,
        accumulate: bool = False,
        undefined: bool = False,
    ) -> None:
        super().__init__(time, point, grows, accumulate, undefined)
        self.time, self.point = time, point
        self.grows, self.accumulate, self.undefined = grows, accumulate, undefined


@dataclass(frozen=True, eq=False)
class StepTolerances:
    """How accurate steps are: ``relative``, and ``absolute`` (N,) for each entry."""

    relative: float
    absolute: Array


class FieldSteps:
    """The start and the ends of all steps of a trajectory, or states at ascending times.

    Iterating gives pairs of times and states (N,). Where fields are reset there are two of them
    at one time, before and after, and one at a distance ``beside`` to each side, if it is positive.

    Attributes
    ----------
    occurred : list of Occurred
        The events so far.
    ends : bool
        Whether one of them was terminal.
    """

    def __init__(
        self,
        system: FieldSystem,
        point: Array,
        tolerances: StepTolerances,
        times: Array | None = None,
        beside: float = 0.0,
    ) -> None:
        self._system, self._point, self._tolerances = system, point, tolerances
        self._times, self._beside = times, beside
        self._factors = factorisation_of(system)
        mass = system.mass
        self._mass = None if mass is None else ss.csc_array(mass)
        self._inverse = None if self._mass is None else Factorisation().of(self._mass)
        self._own = system.at(point)
        self._crossings = FieldCrossings(system, point, self._rates)
        self._after: list[float] = []
        self._returns: dict[tuple[int, ...], tuple[float, float]] = {}
        self._shorter = 0
        self._passed: list[tuple[float, float]] = []
        self.occurred: list[Occurred] = []
        self.ends = False

    def __iter__(self) -> Iterator[tuple[float, Array]]:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of rates that are not finite: told below
            try:
                yield from self._all()
            except UnresolvedEventError:
                time = self._passed[-1][0]
                raise EndsEarlyError(time, self._point, accumulate=True) from None

    def _all(self) -> Iterator[tuple[float, Array]]:
        start, end = self._system.horizon
        time, state = start, self._system.initial(self._point)
        if self._times is None:
            yield time, state
        self._passed = [(start, float(np.abs(state).max()))]
        fired = self._crossings.begin(time, state)
        for _ in range(_MOST_STRETCHES):
            if fired:
                state = self._reset(time, state, fired)
                if self.ends:
                    return
                if self._times is None:
                    yield time, state
            if time >= end:
                return
            time, state, fired = yield from self._stretch(time, state, end)
        raise EndsEarlyError(time, self._point, accumulate=True)

    def _reset(self, time: float, state: Array, fired: Sequence[int]) -> Array:
        """The state after events, and what they set off."""
        if self._beside > 0.0:
            self._after = [time + self._beside]
        happened, state, self.ends = self._crossings.apply(time, state, fired)
        self.occurred += happened
        met = tuple(each.event for each in happened)
        last, before = self._returns.get(met, (-math.inf, 0.0))
        cycle = time - last
        self._returns[met] = time, cycle
        self._shorter = self._shorter + 1 if cycle < before else 0
        start, end = self._system.horizon
        if accumulate(self._shorter, cycle, before, end - start):
            raise EndsEarlyError(time, self._point, accumulate=True)
        return state

    def _stretch(
        self, time: float, state: Array, end: float
    ) -> Generator[tuple[float, Array], None, tuple[float, Array, list[int]]]:
        """Steps to the next event that interrupts, or to the end: what is there, and the events."""
        bound = self._crossings.next_known(time, end)
        if bound - time <= COINCIDENT * (end - self._system.horizon[0]):
            return bound, state, self._crossings.known_at(bound)
        solver = self._solver(time, state, bound)
        beginning = self._times is not None and time == self._system.horizon[0]
        while solver.status == "running":
            before = solver.t
            try:
                solver.step()
            except RuntimeError:  # a matrix of numbers that are not finite
                grows = _grows(self._passed)
                raise EndsEarlyError(before, self._point, grows, undefined=True) from None
            self._passed.append((float(solver.t), float(np.abs(solver.y).max())))
            if solver.status == "failed" or not np.isfinite(solver.y).all():
                raise EndsEarlyError(float(solver.t), self._point, _grows(self._passed))
            charge(_LINEAR_ENTRY * 4.0 * state.size)
            path = solver.dense_output() if self._reads_paths else None
            until, fired = float(solver.t), list[int]()
            if path is not None and self._crossings.looks:
                marks, until, fired = self._crossings.along(path, before, until)
                self.occurred += marks
            yield from self._between(path, before, until, bool(fired), beginning)
            beginning = False
            if fired:
                assert path is not None
                state = path(until)
                if self._times is None:
                    yield until, state
                return until, state, fired
            if self._times is None:
                yield until, solver.y.copy()
        return bound, solver.y.copy(), self._crossings.known_at(bound)

    @property
    def _reads_paths(self) -> bool:
        return self._times is not None or self._beside > 0.0 or self._crossings.looks

    def _between(
        self,
        path: scipy.integrate.DenseOutput | None,
        before: float,
        until: float,
        fired: bool,
        beginning: bool,
    ) -> Iterator[tuple[float, Array]]:
        """States inside of a step: at the times that were asked for, or beside events."""
        if path is None:
            return
        if self._times is not None:
            times = self._times
            within = times[(times <= until) & ((times > before) | (beginning & (times == before)))]
        else:
            beside = [time for time in self._after if before < time < until]
            self._after = [time for time in self._after if time >= until]
            known = self._crossings.known_at(until) if not fired else [0]
            if known and self._beside > 0.0:
                beside += [until - self._beside] if until - self._beside > before else []
            within = np.array(sorted(beside))
        if within.size:
            yield from zip(within.tolist(), path(within).T, strict=True)

    def _rates(self, t: float, u: Array) -> Array:
        """The rates (N,) of the fields."""
        force = self._own.force(t, u)
        return force if self._inverse is None else self._inverse.solve(force)

    def _solver(self, time: float, state: Array, bound: float) -> scipy.integrate.BDF:
        """SciPy's integrator, with factors of a fixed order and a mass matrix.

        Of u' = f it solves (1 - h J) d = h f - b, with numbers h and b of its own; of M u' = f it
        is to solve (M - h J) d = M (h f' - b), where f' are the rates, f over M.
        """
        own, mass = self._own, self._mass
        solver = scipy.integrate.BDF(
            self._rates,
            time,
            state,
            bound,
            rtol=max(self._tolerances.relative, 100.0 * EPSILON),
            atol=self._tolerances.absolute,
            jac=own.jacobian,
            max_step=self._system.longest_step,
        )
        solver.lu = self._factors.of
        if mass is not None:
            solver.I = mass
            solver.solve_lu = lambda lu, right: lu.solve(mass @ right)
        else:
            solver.solve_lu = lambda lu, right: lu.solve(right)
        return solver


def _grows(passed: Sequence[tuple[float, float]]) -> bool:
    """Whether the largest value is far above that of the first half of the time, at the end."""
    half = 0.5 * (passed[0][0] + passed[-1][0])
    usual = max(size for time, size in passed if time <= half)
    return not passed[-1][1] <= _GROWTH * max(usual, TINY)
