"""Markers of oscillators: crossings that all trajectories pass in step, once they get out of phase.

In clock time a front moves through the box wherever periods differ, and ranks grow with the
horizon. A marker is a state that crosses the middle of its range, in both directions. Stretches
between its crossings have times of their own, in which trajectories are in phase (compare the
shifted decompositions of Reiss et al., SIAM J. Sci. Comput. 40 (2018)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.ir.events import Ending, EventOrder, Marker
from rankone.ir.system import Clock, System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.trajectories.events.crossings import Crossings
from rankone.trajectories.events.event_order import follow
from rankone.trajectories.events.event_trajectory import EventTrajectory
from rankone.trajectories.events.instants import SAME_INSTANT
from rankone.trajectories.events.integration import integrate_to_events
from rankone.trajectories.events.periods import may_repeat, repeated, repeats
from rankone.trajectories.events.stretches import marker_event
from rankone.trajectories.integrator import SpanIntegrator, Spans, Tolerances
from rankone.trajectories.paths import NODES, Path, Paths

OUT_OF_PHASE = 8.0
"""Spread of the times of a crossing, over the time in which the state runs through its range, from
which markers pay."""
SCOUTS = slice(9)
"""Trajectories that are looked at first, corners of the box among them."""
_SCOUTED = 0.4  # Part of the spread that they have to show, roughly, before all are looked at
_FEWEST = 3  # Crossings that each trajectory has to pass
_LATER, _FURTHER = 0.1, 2.0  # Margins after the last marker: in gaps, and in errors of the fit
_TRANSVERSAL = 0.5  # Least slope at a crossing, over the range per mean gap between two crossings


@dataclass(frozen=True)
class _Candidate:
    """A state, its middle, and what its crossings are like."""

    marker: Marker
    spread: float
    steepness: float


def may_pay(scouts: Sequence[Path], further: float = 1.0) -> bool:
    """Whether some marker may pay for trajectories of which these are the first ones.

    The horizon is so many times as long as they are.
    """
    least = _SCOUTED * OUT_OF_PHASE / further
    return any(_rough_spread(scouts, *span) >= least for span in _spans(scouts))


def chosen_marker(
    system: System, paths: Sequence[Path], points: Array, further: float = 1.0
) -> Marker | None:
    """The marker for a system, by trajectories at points (m, d); None where none pays.

    The horizon is so many times as long as they are, and times drift apart as they did so far.
    Of the states that all trajectories cross transversally, with a spread that pays, it is the one
    that they cross most steeply. The first trajectories are looked at alone before the others.
    """
    candidates: list[_Candidate] = []
    for state, lower, upper in _spans(paths):
        if further * _rough_spread(paths[SCOUTS], state, lower, upper) < _SCOUTED * OUT_OF_PHASE:
            continue
        candidate = _candidate(system, paths, points, state, (lower, upper))
        if candidate is not None and further * candidate.spread >= OUT_OF_PHASE:
            candidates.append(candidate)
    best = max(candidates, key=lambda candidate: candidate.steepness, default=None)
    return None if best is None else best.marker


def _spans(paths: Sequence[Path]) -> list[tuple[int, float, float]]:
    """States, and the interval of each that all paths run through."""
    lower = np.max([path.nodal.min(axis=(0, 1)) for path in paths], axis=0)
    upper = np.min([path.nodal.max(axis=(0, 1)) for path in paths], axis=0)
    states = np.flatnonzero(lower < upper).tolist()
    return [(state, float(lower[state]), float(upper[state])) for state in states]


def _rough_spread(paths: Sequence[Path], state: int, lower: float, upper: float) -> float:
    """The spread of a candidate, from straight lines between the nodes; 0 for too few crossings."""
    level = 0.5 * (lower + upper)
    crossings: list[tuple[Array, Array]] = []
    for path in paths:
        heights = path.nodal[:, :, state].ravel() - level
        times = (path.breaks[:-1, None] + np.diff(path.breaks)[:, None] * NODES).ravel()
        k = np.flatnonzero(np.diff(np.signbit(heights)))
        if k.size < _FEWEST:
            return 0.0
        rates = (heights[k + 1] - heights[k]) / np.maximum(times[k + 1] - times[k], 1e-300)
        crossings.append((times[k] - heights[k] / rates, np.abs(rates)))
    fewest = min(times.size for times, _ in crossings)
    common = np.array([times[:fewest] for times, _ in crossings])
    slopes = np.array([each[:fewest] for _, each in crossings])
    return float((np.ptp(common, axis=0) * slopes.min(axis=0)).max()) / (upper - lower)


def _candidate(
    system: System, paths: Sequence[Path], points: Array, state: int, span: tuple[float, float]
) -> _Candidate | None:
    """How trajectories cross the middle of the range of a state that all run through."""
    lower, upper = span
    level = 0.5 * (lower + upper)
    if len({bool(path.nodal[0, 0, state] > level) for path in paths}) > 1:
        return None
    marker = Marker(state, level)
    event = marker_event(marker, "")
    nothing = [frozenset[int]()] * len(paths)
    first = np.ones(len(paths), dtype=bool)
    length = paths[0].end - paths[0].breaks[0]
    crossings = Crossings(system, paths, points, nothing, first, SAME_INSTANT * length)
    times = crossings.of(0, event)
    fewest = min(map(len, times))
    if fewest < _FEWEST:
        return None
    common = np.array([each[:fewest] for each in times])
    slopes = _slopes(system, paths, points, common, state)
    width = upper - lower
    gaps = np.diff(common, axis=1).mean(axis=1, keepdims=True)
    steepness = float((np.abs(slopes) * gaps / width).min())
    if not steepness >= _TRANSVERSAL:
        return None
    passing = width / np.abs(slopes).min(axis=0)
    return _Candidate(marker, float((np.ptp(common, axis=0) / passing).max()), steepness)


def _slopes(
    system: System, paths: Sequence[Path], points: Array, times: Array, state: int
) -> Array:
    """Rates of a state at times (m, T) of trajectories."""
    states = Paths.of(paths)(times)
    charge(function_cost(system.rhs, system.user_functions)(times.size))
    p = np.repeat(points.T, times.shape[1], axis=1)
    with np.errstate(all="ignore"):
        rates = system.rhs(times.ravel(), states.reshape(len(states), -1), p)[state]
    return np.broadcast_to(rates, times.size).reshape(times.shape)


@dataclass(frozen=True)
class LastMarks:
    """About when trajectories pass the last marker: a quadratic polynomial of the parameters.

    Attributes
    ----------
    centre, half_width : ndarray (d,)
        Of the box.
    coefficients : ndarray (monomials,)
    margin : float
        How much later it may be.
    """

    centre: Array
    half_width: Array
    coefficients: Array
    margin: float

    @classmethod
    def fitted(cls, bounds: Array, points: Array, times: Array, gap: float) -> LastMarks:
        """By least squares to times (m,) at points (m, d); markers are a ``gap`` apart."""
        centre, half = bounds.mean(axis=1), 0.5 * np.ptp(bounds, axis=1)
        monomials = _monomials((points - centre) / half)
        coefficients = np.asarray(np.linalg.lstsq(monomials, times, rcond=None)[0], dtype=float)
        missed = float(np.abs(monomials @ coefficients - times).max())
        return cls(centre, half, coefficients, _LATER * gap + _FURTHER * missed)

    def __call__(self, points: Array) -> Array:
        """Times (m,) at points (m, d)."""
        shares = (points - self.centre) / self.half_width
        return np.asarray(_monomials(shares) @ self.coefficients + self.margin)


def _monomials(shares: Array) -> Array:
    """Those of degree two at most of shares (m, d), (m, monomials)."""
    with_one = np.column_stack([np.ones(len(shares)), shares])
    pairs = np.triu_indices(with_one.shape[1])
    return np.asarray(with_one[:, pairs[0]] * with_one[:, pairs[1]])


def with_order(
    integrator: SpanIntegrator,
    clock: Clock,
    points: Array,
    paths: Sequence[Path],
    tolerances: Tolerances,
) -> tuple[Clock, list[EventTrajectory]] | None:
    """The clock with the order of its marker, and the trajectories to the last one.

    They go along the ``paths``, which are not integrated anew; None where these are shorter than
    the horizon and not all of them repeat, or not all of them pass as many markers. Other
    trajectories may meet one more before the end.
    """
    system, end = clock.system, clock.horizon[1]
    replay, edges = _Replay(tuple(paths)), (clock.horizon[0], paths[0].end)
    begun = integrate_to_events(replay, system, points, edges, tolerances, system.events)
    accuracy = tolerances.relative
    short = edges[1] < end
    if short and not all(repeats(each, accuracy) for each in begun):
        return None
    periodic = may_repeat(clock, integrator, points, begun, accuracy)
    clock = replace(clock, periodic=periodic)
    if short:
        if not periodic:
            return None
        begun = [repeated(each, 0, end) for each in begun]
    count = max(sum(mark.time < end for mark in each.occurrences) for each in begun) + 2
    followed = follow(clock, integrator, points, tolerances, count, begun)
    if min(len(each.occurrences) for each in followed) < count:
        return None
    return replace(clock, order=EventOrder(((0,),) * count, Ending.EVENT)), followed


@dataclass(frozen=True)
class _Replay:
    """Gives paths that are there already, which is what events that do not interrupt ask for."""

    recorded: tuple[Path, ...]

    def paths(
        self, _system: System, _points: Array, spans: Spans, _tolerances: Tolerances
    ) -> Sequence[Path]:
        """The paths over the horizon."""
        assert len(spans.ends) == len(self.recorded)
        return self.recorded
