"""One ordinary trajectory of a problem, integrated by SciPy: a first check of any solution.

It is integrated from one known time to the next, jumps and switches alike, so that no step
straddles one. Steps are those of :class:`scipy.integrate.LSODA`, which
:func:`scipy.integrate.solve_ivp` takes as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from rankone.discretization.coordinates import name_of
from rankone.frontend.numeric import NumericEquations
from rankone.support.arrays import Array
from rankone.support.errors import BlowUpError, ConvergenceError, EvaluationError
from rankone.support.wording import count, did_you_mean, listing, number

Rates = Callable[[float, Array], Array]
LEAST_RTOL, MOST_RTOL = 1e-12, 0.1
_SMALL_STATE = 1e-3  # States below this share of their largest value need not be as accurate
_LEAST_TOLERANCE = 1e-13  # Of a step, over the largest value: below it rounding counts
_FIRST_CHANGE = 0.01  # Relative change of the states over the time in which first rates are taken
_FIRST_TIMES = 9  # Times in it at which rates are taken
_FIRST_SHARE = 1e-6  # Size of a state that starts at zero, over its change in that time
_LEAST_SIZE = 1e-12  # Size of states if nothing tells it
_ROUNDING = 8.0 * np.finfo(float).eps  # Relative change of the states that tells the noise of rates
_SAME_INSTANT = 1e-12  # Part of the horizon within which two times are one
_MOST_STALLS = 200  # Steps in a row that are shorter than rounding of time; the first ones may be
_MOST_STEPS = 1_000_000  # Steps of a trajectory: about a minute


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
    """

    t: Array
    values: Array
    states: Mapping[str, Array]

    def __getitem__(self, state: object) -> Array:
        """One unknown, or one derivative that is a state: ``trajectory[x.diff(t)]``."""
        name = name_of(state)
        if name not in self.states:
            raise EvaluationError(
                f"no unknown `{name}`{did_you_mean(name, self.states)}; "
                f"the trajectory has {listing(self.states)}",
                term=state,
            )
        return self.states[name]

    def __iter__(self) -> Iterator[Array]:
        return iter(self.values)

    def __array__(self, dtype: object = None, copy: bool | None = None) -> Array:
        return np.array(self.values, dtype=dtype, copy=copy)  # type: ignore[call-overload,no-any-return]

    def __repr__(self) -> str:
        times = count(self.t.size, "time")
        return f"Trajectory of {listing(self.states)} at {times}"


def integrate(equations: NumericEquations, point: Array, times: Array, rtol: float) -> Array:
    """The states (n, *shape of the times) of the trajectory at a point (d,) of the box.

    Raises
    ------
    BlowUpError
        If the trajectory cannot be continued to the last of the times.
    ConvergenceError
        If it takes too many steps.
    """
    with np.errstate(all="ignore"):
        states = _Run(equations, point, np.unique(times), rtol).states()
    return states[:, np.unique(times, return_inverse=True)[1].reshape(np.shape(times))]


class _Run:
    """The integration of one trajectory from piece to piece, for ascending times."""

    def __init__(
        self, equations: NumericEquations, point: Array, times: Array, rtol: float
    ) -> None:
        self.equations, self.point, self.times, self.rtol = equations, point, times, rtol
        _, self.start, self.end = equations.time
        self.values = np.full((len(equations.states), times.size), np.nan)
        self.instant = _SAME_INSTANT * (self.end - self.start)
        self.steps = 0
        nothing = np.full(len(equations.states), np.nan)
        self.state = equations.initial(self.start, nothing, point)
        self.sizes = np.abs(self.state)

    def states(self) -> Array:
        """The states (n, T) at the times; after a jump at its time."""
        jumps = dict(self.equations.jumps)
        for a, b in itertools.pairwise(self._pieces(list(jumps))):
            if a in jumps:
                self.state = jumps[a](a, self.state, self.point)
            self.values[:, self.times == a] = self.state[:, None]
            self._integrate(a, b)
        return self.values

    def _pieces(self, jumps: list[float]) -> list[float]:
        """The start, the jumps and switches in order, and the end; no two of them are the same."""
        ends = [self.start, *jumps, self.end]
        for at in self.equations.switch_times(self.point):
            if self.start < at < self.end and min(abs(at - e) for e in ends) > self.instant:
                ends.append(at)
        return sorted(set(ends))

    def _integrate(self, start: float, end: float) -> None:
        """Integrate over one piece, and keep the states at the times inside and at its end."""
        # what switches at the ends of a piece has its value inside
        inside = 0.25 * min(self.instant, end - start)

        def rates(time: float, state: Array) -> Array:
            time = min(max(time, start + inside), end - inside)
            return self.equations.rates(time, state, self.point)

        self.sizes = np.maximum(self.sizes, np.abs(self.state))
        if not np.isfinite(rates(start, self.state)).all():
            raise self._blow_up(start)
        atol = self._tolerances(rates, start, end)
        solver = scipy.integrate.LSODA(rates, start, self.state, end, rtol=self.rtol, atol=atol)
        stalled = 0
        while solver.status == "running":
            before = solver.t
            failure = solver.step()
            stalled = stalled + 1 if solver.t == before else 0
            if failure is not None or stalled > _MOST_STALLS or not np.isfinite(solver.y).all():
                raise self._blow_up(before)
            self.steps += 1
            if self.steps > _MOST_STEPS:
                raise self._too_long(solver.t)
            self.sizes = np.maximum(self.sizes, np.abs(solver.y))
            first, last = np.searchsorted(self.times, [before, solver.t], side="right")
            if first < last:
                self.values[:, first:last] = solver.dense_output()(self.times[first:last])
        self.state = solver.y

    def _tolerances(self, rates: Rates, start: float, end: float) -> Array:
        """The absolute tolerance (n,) of each state, a share of its size, and more than rounding.

        How large a state becomes that starts at zero, its first rates tell, or the other states.
        """
        state, sizes = self.state, self.sizes.copy()
        first = rates(start, state)
        slowness = np.abs(state / first)[(state != 0.0) & (first != 0.0)]
        span = min(end - start, _FIRST_CHANGE * float(np.min(slowness, initial=np.inf)))
        ahead = np.linspace(0.0, span, _FIRST_TIMES)
        changes = span * np.array([np.abs(rates(start + s, state + s * first)) for s in ahead])
        change = np.max(np.where(np.isfinite(changes), changes, 0.0), axis=0)
        at_zero = sizes == 0.0
        sizes[at_zero] = _FIRST_SHARE * change[at_zero]
        positive = sizes[sizes > 0.0]
        sizes[sizes == 0.0] = _FIRST_SHARE * positive.min() if positive.size else _LEAST_SIZE
        beside = rates(start, state * (1.0 + _ROUNDING))
        noise = np.where(np.isfinite(beside), span * np.abs(beside - first), 0.0)
        return np.maximum(max(_SMALL_STATE * self.rtol, _LEAST_TOLERANCE) * sizes, noise)

    def _place(self) -> dict[str, float]:
        return dict(zip(self.equations.parameters, self.point.tolist(), strict=True))

    def _blow_up(self, time: float) -> BlowUpError:
        """The error for a trajectory that does not go on."""
        at = "".join(f", {name} = {value:.6g}" for name, value in self._place().items())
        return BlowUpError(
            f"the trajectory cannot be continued beyond {self.equations.clock} = {time:.6g}{at}: "
            "it grows without bound there, or a rate is not finite",
            time=time,
            parameters=self._place(),
            remedy="let time end earlier, or change the equations",
        )

    def _too_long(self, time: float) -> ConvergenceError:
        return ConvergenceError(
            f"the trajectory takes more than {_MOST_STEPS} steps; it has reached "
            f"{self.equations.clock} = {number(time)}",
            remedy="let time end earlier, or increase rtol",
        )
