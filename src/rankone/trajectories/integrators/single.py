"""Trajectories integrated one by one with SciPy's LSODA, each with steps of its own.

For systems whose trajectories do not share steps: where each jumps at its own time, the common
steps of a stack are short all the time.

LSODA is called by ``odeint``, which stays in compiled code between two calls of the rates. Steps as
functions of time take two passes: the times at which the first one calls the rates tell its steps,
and the second one reads the states at nodes within them.
"""

from __future__ import annotations

import itertools
import math
import threading
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
import scipy.integrate
from numpy.typing import NDArray

from rankone.support.arrays import COINCIDENT, ROUNDING, Array
from rankone.support.budget import OutOfBudgetError, Reached, charge, hold
from rankone.support.costs import Cost, inverse
from rankone.tensors.time_grid import inset
from rankone.trajectories.integrators import lsoda
from rankone.trajectories.integrators.defects import SHORTENING, DefectControl, Interpolant
from rankone.trajectories.integrators.diagnosis import switching_state
from rankone.trajectories.integrators.integrator import (
    EARLY_STEPS,
    NODES,
    Path,
    SampledTrajectories,
    Spans,
    Tolerances,
    jacobians,
    joined,
)
from rankone.trajectories.stacks.stack import has_smooth_rates
from rankone.trajectories.system.features import Jumps
from rankone.trajectories.system.system import System


@dataclass(frozen=True)
class _SingleSteps:
    """How LSODA is called, and steps that missed something are made again."""

    tolerance: float
    checked: int
    short: int
    nearer: float
    longer: float


_STEPS = _SingleSteps(
    tolerance=0.01,  # Factor on tolerances: errors of LSODA are larger than theirs
    checked=256,  # Steps whose defects are looked at together
    short=10,  # Short steps at least after one that had to be made again
    nearer=0.25,  # Length of a step that missed something, over the distance of a border
    longer=8.0,  # Factor from a stretch that missed nothing to the next one
)
_LEAST_RELATIVE = 2.0 * ROUNDING  # Tightest relative tolerance that LSODA takes
_ONE_AT_A_TIME = threading.RLock()  # LSODA in Fortran keeps its state in common blocks
_NODE_COST = Cost(150, 5)  # Operations of reading states: once, and for each state

Span: TypeAlias = "tuple[float, float]"  # From a time to another


@dataclass(frozen=True)
class _Lengths:
    """The longest step of LSODA, and the first one that it tries; with zero it takes its own.

    Its own one depends on the times that are asked for: two passes need the same to step alike,
    and the ``second`` one goes as far as the first.
    """

    longest: float = math.inf
    first: float = 0.0
    second: bool = False


@dataclass(frozen=True)
class SingleIntegrator:
    """An :class:`Integrator` of one trajectory after the other.

    With ``looks_anywhere`` steps are checked at random places too, and not only at state surfaces.
    Systems whose rates are smooth are never checked.
    """

    looks_anywhere: bool = False

    def run(
        self, system: System, points: Array, edges: Sequence[float], tolerances: Tolerances
    ) -> SingleTrajectories:
        """Trajectories at all times; see :meth:`Integrator.run`."""
        initial = system.initial(np.ascontiguousarray(points.T))
        paths: list[Path] = []
        end = edges[-1]
        for point, start in zip(points, initial.T, strict=True):
            single = _Single(system, point, edges, tolerances, self.looks_anywhere)
            path = single.path(start, end)
            hold(path, path.nbytes, (len(points) - len(paths) - 1) * path.nbytes)
            paths.append(path)
            end = min(end, paths[-1].end)
        times = np.array([end])
        states = [p.state if p.end == end or not p.steps else p(times)[:, 0] for p in paths]
        return SingleTrajectories(tuple(paths), end, np.stack(states, axis=1))

    def sample(
        self,
        system: System,
        points: Array,
        edges: Sequence[float],
        tolerances: Tolerances,
        times: Array,
    ) -> SampledTrajectories:
        """Trajectories at ascending times; see :meth:`Integrator.sample`."""
        initial = system.initial(np.ascontiguousarray(points.T))
        states = np.empty((times.size, *initial.shape))
        final, end, reached = initial.copy(), edges[-1], times.size
        for j, (point, start) in enumerate(zip(points, initial.T, strict=True)):
            single = _Single(system, point, edges, tolerances, self.looks_anywhere)
            path: Path | None = None
            sampled = single.sampled(start, times[:reached])
            if sampled is None:
                path = single.path(start, end)
                end = min(end, path.end)
                reached = int(np.searchsorted(times, end, side="right"))
                sampled = path(times[:reached]).T if path.steps else start[None]
            states[:reached, :, j] = sampled[:reached]
            final[:, j] = sampled[-1] if path is None else path.state
        return SampledTrajectories(states, reached, end, final, "single")

    def paths(
        self, system: System, points: Array, spans: Spans, tolerances: Tolerances
    ) -> list[Path]:
        """Trajectories of spans of their own; see :meth:`SpanIntegrator.paths`."""
        system, paths = replace(system, jumps=Jumps()), list[Path]()
        each = zip(points, spans.starts.tolist(), spans.states.T, spans.ends.tolist(), strict=True)
        for point, a, state, b in each:
            single = _Single(system, point, (a, b), tolerances, self.looks_anywhere, inset(a, b))
            try:
                paths.append(single.path(state, b))
            except OutOfBudgetError as out:
                reached = out.reached
                if reached is not None and reached.time is not None:
                    waiting = spans.starts[len(paths) + 1 :]
                    reached = reached._replace(time=float(min([reached.time, *waiting])))
                raise out.at(reached) from out
        return paths


@dataclass(frozen=True)
class _Single:
    """The integration at one point (d,)."""

    system: System
    point: Array
    edges: Sequence[float]
    tolerances: Tolerances
    looks_anywhere: bool
    near: float = 0.0  # how far times stay inside of a span of its own

    @property
    def horizon(self) -> float:
        return self.edges[-1] - self.edges[0]

    @cached_property
    def tighter(self) -> Tolerances:
        """The tolerances that LSODA gets."""
        tolerances = self.tolerances.times(_STEPS.tolerance)
        absolute = np.broadcast_to(tolerances.absolute, (self.system.n_differential, 1))
        relative = max(tolerances.relative, _LEAST_RELATIVE)
        return Tolerances(relative, absolute, tolerances.longest_step)

    @cached_property
    def checked(self) -> bool:
        """Whether something narrow may hide within a step."""
        return not has_smooth_rates(self.system, self.edges[0]) and (
            self.looks_anywhere or self.system.features.n_state_surfaces > 0
        )

    def path(self, start: Array, end: float) -> Path:
        """The trajectory at all times up to an end, or as far as it goes."""
        nothing = np.zeros((0, NODES.size, start.size))
        paths = [Path(np.array([self.edges[0]]), nothing, start)]
        try:
            for a, b in self._segments(end):
                begun = self._begun(a, paths[-1].state)
                if begun is None:
                    break
                for stretch in self._stretches(a, b, begun):
                    paths.append(stretch)
                if paths[-1].end < b:
                    break
        except OutOfBudgetError as out:
            raise out.at(self._reached(paths[-1])) from out
        return joined(paths)

    def sampled(self, start: Array, times: Array) -> Array | None:
        """States (T, n) at times; None where steps have to be looked at, or do not reach them."""
        if self.checked:
            return None
        states = np.empty((times.size, start.size))
        state, first = start, 0
        for a, b in self._segments(self.edges[-1]):
            begun = self._begun(a, state)
            if begun is None:
                return None
            last = int(np.searchsorted(times, b, side="right"))
            passed = np.concatenate([[a], times[first:last], [b]])
            try:
                path = self._integrated((a, b), begun, passed, _Lengths())
            except lsoda.Border:
                return None
            states[first:last] = path[1:-1]
            state, first = path[-1], last
        return states

    def _segments(self, end: float) -> Iterator[tuple[float, float]]:
        """The segments that begin before an end."""
        for a, b in itertools.pairwise(self.edges):
            if a < end:
                yield a, min(b, end)

    def _begun(self, a: float, state: Array) -> Array | None:
        """The state after the jump where a segment begins; None if it is not finite."""
        kind = self.system.jumps.kind_at(a)
        if kind is None:
            return state
        column = self.point[:, None]
        with np.errstate(all="ignore"):
            after = self.system.jumps.jumped(kind, state[:, None], column)
            rates = self.system.rhs(a, after, column)
        if a == self.edges[0] or (np.isfinite(after).all() and np.isfinite(rates).all()):
            return np.asarray(after[:, 0])
        return None

    def _reached(self, path: Path) -> Reached:
        """How far it came."""
        state = path.state[:, None]
        switch = switching_state(self.system, path.end, state, self.point[None], self.horizon)
        return Reached(path.end, path.steps, None if switch is None else switch[0])

    def _stretches(self, a: float, b: float, state: Array) -> Iterator[Path]:
        """Paths from a to b, or as far as they go.

        Where steps missed something, or met rates that are not finite, they are made again and
        shorter; then stretches become longer again.
        """
        time, length, longest = a, b - a, math.inf
        while time < b:
            end = b if b - time <= length * (1.0 + COINCIDENT) else time + length
            good, again = self._stretch((a, b), (time, end), state, longest)
            if good.steps:
                yield good
                time, state = good.end, good.state
            if again is None:
                length, longest = _STEPS.longer * length, math.inf
                continue
            longest = SHORTENING * (again if good.steps else min(again, longest))
            if longest < COINCIDENT * self.horizon:
                return
            length = _STEPS.short * longest

    def _stretch(
        self, segment: Span, span: Span, state: Array, longest: float
    ) -> tuple[Path, float | None]:
        """A path over a span, as far as it missed nothing, and the length of the step that did.

        The length is zero where an integration creeps.
        """
        (start, end), again = span, None
        called: list[float] = []
        try:
            self._integrated(segment, state, np.array([start, end]), _Lengths(longest), called)
        except lsoda.Border as border:
            safe = max((t for t in called if t < border.time), default=start)
            end = safe if border.safe is None else max(border.safe, start)
            if not isinstance(border, lsoda.Crawl):
                again = _STEPS.nearer * (border.time - end) if border.safe is None else 0.0
        try:
            first = next((t - start for t in called if t > start), 0.0)
            breaks = _steps_of(called, start, end)
            path = self._read(segment, state, breaks, _Lengths(longest, first, second=True))
        except lsoda.Border as border:
            return self._nothing(start, state), _STEPS.nearer * (border.time - start)
        missed = self._missed(path, end)
        if missed is None:
            return path, again
        breaks = path.breaks[: missed + 1]
        good = Path(breaks, path.nodal[:missed], path.nodal[missed, 0])
        return good, float(path.breaks[missed + 1] - path.breaks[missed])

    def _nothing(self, start: float, state: Array) -> Path:
        return Path(np.array([start]), np.zeros((0, NODES.size, state.size)), state)

    def _read(self, segment: Span, state: Array, breaks: Array, lengths: _Lengths) -> Path:
        """The path whose steps are between these times."""
        if breaks.size < 2:
            return self._nothing(float(breaks[0]), state)
        within = breaks[:-1, None] + np.diff(breaks)[:, None] * NODES[1:-1]
        times = np.append(breaks[:1], np.concatenate([within, breaks[1:, None]], axis=1).ravel())
        charge(_NODE_COST(state.size) * times.size)
        states = self._integrated(segment, state, times, lengths)
        later = states[1:].reshape(len(within), -1, state.size)
        first = np.concatenate([states[:1], later[:-1, -1]])[:, None]
        return Path(breaks, np.concatenate([first, later], axis=1), states[-1])

    def _missed(self, path: Path, end: float) -> int | None:
        """The first of the steps that missed something; shorter ones than rounding are good."""
        if not self.checked:
            return None
        shortest = 1000 * np.spacing(max(abs(path.breaks[0]), abs(end)))
        for first in range(0, path.steps, _STEPS.checked):
            last = min(first + _STEPS.checked, path.steps)
            some = Path(path.breaks[first : last + 1], path.nodal[first:last], path.state)
            points = np.tile(self.point, (some.steps, 1))
            control = DefectControl(self.system, points, self.looks_anywhere)
            steps = StepsOfOne(self.system, self.point, some, self.tighter, end)
            with np.errstate(all="ignore"):
                missed = control.missed(steps, steps.before) & (np.diff(some.breaks) > shortest)
            if missed.any():
                return first + int(np.argmax(missed))
        return None

    def _integrated(
        self,
        segment: Span,
        state: Array,
        times: Array,
        lengths: _Lengths,
        called: list[float] | None = None,
    ) -> Array:
        """States (T, n) at times, the first of which is the start; a Border where it ends.

        The times at which rates are ``called`` are appended.
        """
        rates, jacobian = self._called(*segment, restarts=not lengths.second)
        if called is not None:
            rates = lsoda.recording(rates, called)
        longest = min(lengths.longest, self.tighter.longest_step)
        with _ONE_AT_A_TIME, np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("error", scipy.integrate.ODEintWarning)
            try:
                states = scipy.integrate.odeint(
                    rates,
                    state,
                    times,
                    Dfun=jacobian,
                    tfirst=True,
                    tcrit=times[-1:],
                    rtol=self.tighter.relative,
                    atol=self.tighter.absolute[:, 0],
                    h0=lengths.first,
                    hmax=0.0 if longest == math.inf else longest,  # zero: no limit
                    mxstep=np.iinfo(np.int32).max,
                )
            except scipy.integrate.ODEintWarning:
                raise lsoda.Border(times[-1], times[0]) from None
        if not np.isfinite(states).all():
            raise lsoda.Border(times[-1], times[0])
        return np.asarray(states)

    def _called(
        self, a: float, b: float, *, restarts: bool
    ) -> tuple[lsoda.Rates, lsoda.Jacobian | None]:
        """What LSODA calls on a segment; factors of time are never taken at its very ends."""
        near = inset(a, b) if len(self.edges) > 2 else self.near
        span = a + near, b - near
        return lsoda.called_by_lsoda(self.system, self.point, span, self.horizon, restarts=restarts)


def _steps_of(called: Sequence[float], start: float, end: float) -> Array:
    """The times at which steps begin and end, by those at which rates were called."""
    times = np.minimum.accumulate(np.array([*called, end])[::-1])[::-1]  # no refused attempts
    times = np.unique(times)
    least = COINCIDENT * max(abs(start), abs(end))
    times = times[(times > start + least) & (times < end - least)]
    times = times[np.diff(times, prepend=start) > least]
    return np.concatenate([[start], times, [end]]) if end > start else np.array([start])


# -----------------------------------------------------------------------------
# Trajectories that were integrated one by one, and the control of their steps.


@dataclass(frozen=True)
class SingleTrajectories:
    """Dense trajectories that each have their own steps. Fulfils :class:`DenseTrajectories`."""

    paths: tuple[Path, ...]
    end: float
    state: Array
    avoided: float = 0.0
    integrator: str = "single"
    method: str = "LSODA"

    @property
    def start(self) -> float:
        return float(self.paths[0].breaks[0])

    @property
    def steps(self) -> int:
        return max(path.steps for path in self.paths)

    @property
    def has_begun(self) -> bool:
        return self.end > self.start

    @cached_property
    def last(self) -> Array:
        if not self.has_begun:
            return self.state
        end = np.array([np.nextafter(self.end, self.start)])
        return np.stack([path(end)[:, 0] for path in self.paths], axis=1)

    @property
    def largest(self) -> Array:
        return np.stack([path.largest() for path in self.paths], axis=1)

    @property
    def early(self) -> Array:
        return np.stack([path.largest(EARLY_STEPS) for path in self.paths], axis=1)

    def __call__(self, times: Array) -> Array:
        """States at times (T,), after a jump at its time: shape (n, m, T)."""
        return np.stack([path(times) for path in self.paths], axis=1)

    def of(self, trajectories: slice) -> SingleTrajectories:
        """Some of the trajectories; see :meth:`DenseTrajectories.of`."""
        return replace(self, paths=self.paths[trajectories], state=self.state[:, trajectories])

    def samples(self, count: int) -> list[tuple[float, Array]]:
        """Ends of steps of the first trajectory, with all states there."""
        ends = self.paths[0].breaks[1:]
        ends = ends[ends <= self.end]
        times = ends[:: max(1, len(ends) // count)]
        return list(zip(times.tolist(), np.moveaxis(self(times), 2, 0), strict=True))


class StepsOfOne:
    """Steps of the trajectory at a point (d,), for defect control: fulfils :class:`Steps`."""

    def __init__(
        self, system: System, point: Array, path: Path, tolerances: Tolerances, end: float
    ) -> None:
        self.system, self.point, self.t_bound = system, point, end
        self.t_old, self.t = path.breaks[:-1], path.breaks[1:]
        self.coefficients = path.coefficients
        self.before, self.y = path.nodal[:, 0].T.ravel(), path.nodal[:, -1].T.ravel()
        self.rtol = tolerances.relative
        self.atol = np.broadcast_to(tolerances.absolute, (path.state.size, path.steps)).ravel()

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:
        """The polynomials of some steps."""
        coefficients = self.coefficients[:, columns].transpose(0, 2, 1)

        def evaluate(shares: Array, slopes: bool) -> tuple[Array, Array]:
            place, (_, n, c) = 2.0 * shares - 1.0, coefficients.shape
            y = np.zeros((n, *shares.shape))
            slope = np.zeros_like(y)
            of_powers = coefficients.reshape(-1, n, *(1,) * (shares.ndim - 1), c)
            for coefficient in of_powers[::-1]:
                if slopes:
                    slope = slope * place + y
                y = y * place + coefficient
            return y, 2.0 * slope

        return evaluate

    def error_of(self, defect: Array, columns: NDArray[np.intp]) -> Array:
        """The defect divided by the matrices of an implicit Euler step."""
        n, count = len(defect), self.t.size
        blocks = jacobians(self.system, np.tile(self.point, (count, 1)), self.t, self.y)
        lengths = (self.t - self.t_old)[:, None, None]
        charge(count * inverse(n, real=True))
        try:
            inverses = np.linalg.inv(np.eye(n) - lengths * np.nan_to_num(blocks))
        except np.linalg.LinAlgError:
            return defect
        return np.asarray(np.matmul(inverses[columns], defect.T[:, :, None])[:, :, 0].T)
