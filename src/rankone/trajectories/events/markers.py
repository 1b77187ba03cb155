"""Markers: levels of states at which stretches end, on oscillators and on fronts that come late.

In clock time a front moves through the box wherever periods differ, and ranks grow with the
horizon. A marker is a state that crosses the middle of its range, in both directions. Stretches
between its crossings have times of their own, in which trajectories are in phase (compare the
shifted decompositions of Reiss et al., SIAM J. Sci. Comput. 40 (2018)).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.support.arrays import MINOR, TINY, Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.trajectories.events.event_crossings import Crossings
from rankone.trajectories.events.event_integration import Goal, integrate_to_events
from rankone.trajectories.events.event_trajectory import SAME_INSTANT, EventTrajectory
from rankone.trajectories.events.periods import FAR, repeated, repeating_from, repeats
from rankone.trajectories.events.sides import SPARE, follow
from rankone.trajectories.events.stretches import marker_event, timed_events
from rankone.trajectories.integrators.integrator import (
    NODES,
    Path,
    Paths,
    SpanIntegrator,
    Spans,
    Tolerances,
    joined,
)
from rankone.trajectories.system.features import Ending, EventOrder, Foreseen, Marker
from rankone.trajectories.system.system import Clock, System

OUT_OF_PHASE = 8.0
"""Spread of the times of a crossing, over the time in which the state runs through its range, from
which markers pay."""
SCOUTS = slice(9)
"""Trajectories that are looked at first, corners of the box among them."""


@dataclass(frozen=True)
class _MarkerChoice:
    """What a state has to show before its crossings are markers."""

    scouted: float
    fewest: int
    front: float
    later: float
    further: float
    most_degree: int
    transversal: float
    levels: tuple[float, ...]
    much_steeper: float
    spike: float
    lower_rank: float
    nearly: float
    furthest: float
    beyond: float
    ranked: int
    rank_tolerance: float
    telling: tuple[int, int]
    most_places: int
    full: float


_CHOICE = _MarkerChoice(
    # Part of the spread and of the steepness that they have to show, roughly, before all are looked
    # at
    scouted=0.4,
    fewest=3,  # Crossings that each has to pass, and least slope where they are fewer
    front=10.0,
    later=MINOR,  # Margins after a mark that is foreseen: in gaps, and in errors
    further=2.0,
    most_degree=8,  # Of the polynomials that foresee marks
    transversal=0.5,  # Least slope at a crossing, over the range per mean gap between two crossings
    levels=(0.5, 0.2, 0.8),  # Shares of the range of a state that are tried
    much_steeper=4.0,
    spike=MINOR,  # Gap between crossings, over the mean one, below which both are on one spike
    lower_rank=0.8,  # Largest rank over stretches before and behind a front, over that without
    # Change over a period of trajectories that are continued to tell how many crossings there are,
    # and how many times as far as they were integrated
    nearly=0.01,
    furthest=3.0,
    beyond=0.25,  # Time from the end to the last mark, at least, in periods
    ranked=24,  # Trajectories of which a rank is taken
    rank_tolerance=3e-4,  # What is left out of them, over the largest states
    telling=(0, -1),  # Those whose steps tell the places where they are compared
    most_places=512,
    full=0.75,  # Rank over clock time, over their number, from which a front is looked for
)


@dataclass(frozen=True)
class _Candidate:
    """A state, its middle, its crossings on each trajectory, and what these are like."""

    marker: Marker
    times: Sequence[Array]
    spread: float
    steepness: float

    @property
    def on_spikes(self) -> bool:
        """Whether two crossings are close to each other, beside the mean gap from the start."""
        gaps = [(np.diff(each).min(initial=math.inf), each[-1] / each.size) for each in self.times]
        return any(least < _CHOICE.spike * mean for least, mean in gaps)


def may_pay(scouts: Sequence[Path]) -> bool:
    """Whether some marker may pay for trajectories of which these are the first ones."""
    least = _CHOICE.scouted * OUT_OF_PHASE
    return any(_rough_spread(scouts, *span) >= least for span in _spans(scouts))


def chosen_markers(
    system: System, paths: Sequence[Path], points: Array, further: float = 1.0
) -> tuple[Marker, ...]:
    """The markers for a system, by trajectories at points (m, d); none where none pays.

    The horizon is so many times as long as they are, and times drift apart as they did so far.
    Of the states that all trajectories cross transversally, with a spread that pays, it is the one
    that they cross most steeply; but rather none that they cross twice on each spike, which misses
    the spikes in the other direction. The first trajectories are looked at alone before the others.
    """
    candidates: list[_Candidate] = []
    for state, lower, upper in _spans(paths):
        if (
            further * _rough_spread(paths[SCOUTS], state, lower, upper)
            < _CHOICE.scouted * OUT_OF_PHASE
        ):
            continue
        candidate = _steepest(system, paths, points, state, (lower, upper))
        if candidate is not None and further * candidate.spread >= OUT_OF_PHASE:
            candidates.append(candidate)
    best = min(candidates, key=lambda each: (each.on_spikes, -each.steepness), default=None)
    return () if best is None else (best.marker,)


def swings_of(paths: Sequence[Path], length: float) -> float:
    """How many times a state would go through its size over a length of time at its fastest."""
    sizes = np.max([np.abs(path.nodal).max(axis=(0, 1)) for path in paths], axis=0)
    fastest = np.zeros_like(sizes)
    for path in paths:
        times = np.diff(path.breaks)[:, None] * np.diff(NODES)
        rates = np.abs(np.diff(path.nodal, axis=1)) / times[:, :, None]
        fastest = np.maximum(fastest, rates.max(axis=(0, 1)))
    return float((length * fastest / np.where(sizes > 0.0, sizes, 1.0)).max())


def rank_of(paths: Sequence[Path], crossings: Array) -> float:
    """The rank of some trajectories over stretches between their crossings (m, k)."""
    some = np.unique(np.linspace(0, len(paths) - 1, _CHOICE.ranked).astype(int))
    chosen = [paths[k] for k in some.tolist()]
    starts = np.array([[path.breaks[0]] for path in chosen])
    borders = np.concatenate([starts, crossings[some]], axis=1)
    pseudo = np.unique(np.concatenate([_steps(chosen[k], borders[k]) for k in _CHOICE.telling]))
    pseudo = pseudo[:: -(-pseudo.size // _CHOICE.most_places)]
    stretch = pseudo.astype(int)
    times = borders[:, stretch] + (pseudo - stretch) * np.diff(borders, axis=1)[:, stretch]
    states = Paths.of(chosen)(times)
    sizes = np.abs(states).max(axis=(1, 2), keepdims=True)
    rows = np.moveaxis(states / np.where(sizes > 0.0, sizes, 1.0), 1, 2).reshape(-1, some.size)
    values = np.linalg.svd(rows, compute_uv=False)
    left = np.sqrt(np.cumsum(values[::-1] ** 2))
    return float((left > _CHOICE.rank_tolerance * math.sqrt(rows.size)).sum())


def _steps(path: Path, borders: Array) -> Array:
    """The pseudo-times at which steps of a path begin, close to each other where it is steep."""
    times = path.breaks[path.breaks < borders[-1]]
    stretch = np.searchsorted(borders, times, side="right") - 1
    return np.asarray(stretch + (times - borders[stretch]) / np.diff(borders)[stretch])


def _spans(paths: Sequence[Path]) -> list[tuple[int, float, float]]:
    """States, and the interval of each that all paths run through."""
    nodal = [path.nodal.reshape(-1, path.nodal.shape[2]) for path in paths]
    every, first = np.concatenate(nodal), np.cumsum([0, *map(len, nodal[:-1])])
    lower = np.minimum.reduceat(every, first).max(axis=0)
    upper = np.maximum.reduceat(every, first).min(axis=0)
    states = np.flatnonzero(lower < upper).tolist()
    return [(state, float(lower[state]), float(upper[state])) for state in states]


def _rough_spread(paths: Sequence[Path], state: int, lower: float, upper: float) -> float:
    """The spread of a candidate, from straight lines between the nodes; 0 if some do not cross."""
    crossings = _rough_crossings(paths, state, 0.5 * (lower + upper))
    fewest = min(times.size for times, _ in crossings)
    if not fewest:
        return 0.0
    common = np.array([times[:fewest] for times, _ in crossings])
    slopes = np.array([each[:fewest] for _, each in crossings])
    return float((np.ptp(common, axis=0) * slopes.min(axis=0)).max()) / (upper - lower)


def _rough_steepness(paths: Sequence[Path], state: int, level: float) -> tuple[float, bool]:
    """The same for the least slope times the mean gap, and whether some cross several times."""
    crossings = _rough_crossings(paths, state, level)
    fewest = min(times.size for times, _ in crossings)
    if not fewest:
        return math.inf, True  # perhaps between the nodes
    begin = paths[0].breaks[0]
    steep = [rates[:fewest].min() * (times[fewest - 1] - begin) for times, rates in crossings]
    return float(min(steep)) / fewest, max(times.size for times, _ in crossings) >= _CHOICE.fewest


def _rough_crossings(paths: Sequence[Path], state: int, level: float) -> list[tuple[Array, Array]]:
    """Times and absolute rates at which a state of each path crosses a level, by straight lines."""
    crossings: list[tuple[Array, Array]] = []
    breaks, times = np.zeros(0), np.zeros(0)
    for path in paths:
        if path.breaks is not breaks:  # paths of a stack share them
            breaks = path.breaks
            times = (breaks[:-1, None] + np.diff(breaks)[:, None] * NODES).ravel()
        heights = path.nodal[:, :, state].ravel() - level
        below = np.signbit(heights)
        k = np.flatnonzero(below[1:] != below[:-1])
        with np.errstate(over="ignore"):  # where it jumps
            rates = (heights[k + 1] - heights[k]) / np.maximum(times[k + 1] - times[k], TINY)
        crossings.append((times[k] - heights[k] / rates, np.abs(rates)))
    return crossings


def _steepest(
    system: System,
    paths: Sequence[Path],
    points: Array,
    state: int,
    span: tuple[float, float],
) -> _Candidate | None:
    """The candidate of a state: the middle of its range, or another level if it is much steeper.

    A spike that falls slowly behind its peak is steep in both directions at its foot.
    """
    candidates = [_candidate(system, paths, points, state, span, share) for share in _CHOICE.levels]
    middle, *others = candidates
    levels = [each for each in others if each is not None]
    best = max(levels, key=lambda each: each.steepness, default=None)
    if middle is None or best is None:
        return middle or best
    return best if best.steepness > _CHOICE.much_steeper * middle.steepness else middle


def _candidate(
    system: System,
    paths: Sequence[Path],
    points: Array,
    state: int,
    span: tuple[float, float],
    share: float,
) -> _Candidate | None:
    """How trajectories cross a level of a state, a share of the range that all run through."""
    lower, width = span[0], span[1] - span[0]
    level = lower + share * width
    if len({bool(path.nodal[0, 0, state] > level) for path in paths}) > 1:
        return None
    steepness, several = _rough_steepness(paths[SCOUTS], state, level)
    least = _CHOICE.transversal if several else _CHOICE.front
    if steepness < _CHOICE.scouted * least * width:
        return None
    marker = Marker(state, level)
    event = marker_event(marker, "")
    nothing = [dict[int, int]()] * len(paths)
    length = paths[0].end - paths[0].breaks[0]
    crossings = Crossings(system, paths, points, nothing, SAME_INSTANT * length)
    times = crossings.of(0, event)
    fewest = min(map(len, times))
    if not fewest:
        return None
    common = np.array([each[:fewest] for each in times])
    slopes = _slopes(system, paths, points, common, state)
    gaps = (common[:, -1:] - paths[0].breaks[0]) / fewest
    steepness = float((np.abs(slopes) * gaps / width).min())
    several = fewest >= _CHOICE.fewest or max(map(len, times)) >= _CHOICE.fewest
    if not steepness >= (_CHOICE.transversal if several else _CHOICE.front):
        return None
    passing = width / np.abs(slopes).min(axis=0)
    return _Candidate(marker, times, float((np.ptp(common, axis=0) / passing).max()), steepness)


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
class ForeseenMarks:
    """About when trajectories pass their marks: polynomials of the parameters.

    Attributes
    ----------
    centre, half_width : ndarray (d,)
        Of the box.
    coefficients : ndarray (monomials, marks)
    missed : ndarray (marks,)
        The largest errors where they are known.
    margin : float
        How much later they may be besides.
    degree : int
        The total degree.
    """

    centre: Array
    half_width: Array
    coefficients: Array
    missed: Array
    margin: float
    degree: int

    @classmethod
    def fitted(cls, bounds: Array, points: Array, times: Array, gap: float) -> ForeseenMarks:
        """By least squares to times (m, marks) at points (m, d); marks are a ``gap`` apart.

        Of the highest degree for which there are twice as many points as monomials, or of two.
        """
        centre, half = bounds.mean(axis=1), 0.5 * np.ptp(bounds, axis=1)
        count, dimensions, degree = len(points), bounds.shape[0], 2
        while (
            2 * math.comb(dimensions + degree + 1, dimensions) <= count
            and degree < _CHOICE.most_degree
        ):
            degree += 1
        monomials = _monomials((points - centre) / half, degree)
        coefficients = np.asarray(np.linalg.lstsq(monomials, times, rcond=None)[0], dtype=float)
        missed = np.abs(monomials @ coefficients - times).max(axis=0)
        return cls(centre, half, coefficients, missed, _CHOICE.later * gap, degree)

    def __call__(self, points: Array, count: int) -> Foreseen:
        """The first marks at points (m, d), no more than are known."""
        shares = (points - self.centre) / self.half_width
        times = _monomials(shares, self.degree) @ self.coefficients[:, :count]
        missed = self.missed[:count]
        return Foreseen(
            np.asarray(times), self.margin + _CHOICE.further * missed, float(missed.max())
        )


def _monomials(shares: Array, degree: int) -> Array:
    """Products of Chebyshev polynomials of shares (m, d), by total degree: (m, monomials)."""
    dimensions = shares.shape[1]
    polynomials = np.polynomial.chebyshev.chebvander(shares, degree)  # (m, d, degree + 1)
    columns = []
    for chosen in itertools.combinations_with_replacement(range(dimensions + 1), degree):
        degrees = np.bincount(chosen, minlength=dimensions + 1)[:dimensions]
        columns.append(polynomials[:, np.arange(dimensions), degrees].prod(axis=1))
    return np.stack(columns, axis=1)


def with_order(
    integrator: SpanIntegrator,
    clock: Clock,
    points: Array,
    paths: Sequence[Path],
    tolerances: Tolerances,
) -> tuple[Clock, list[EventTrajectory]] | None:
    """The clock with the order of its markers, and the trajectories to the last one.

    They go along the ``paths``, which are not integrated anew. Where these are shorter than the
    horizon, trajectories go on as over their last period. None where not all of them nearly repeat
    then, or not all of them pass as many markers. Of more than a period the last marker is passed
    by all of them well after the end: other trajectories may be faster.
    """
    system, (start, end), reached = clock.system, clock.horizon, paths[0].end
    replay, period, accuracy = _Replay(tuple(paths)), clock.marks_per_period, tolerances.relative
    begun = integrate_to_events(replay, system, points, (start, reached), tolerances)
    short = reached < end
    if short and not all(repeats(each, _CHOICE.nearly, period) for each in begun):
        return None
    repeats_from = repeating_from(clock, integrator, points, begun, accuracy)
    if short and not repeats_from:
        if end - start > _CHOICE.furthest * (reached - start):
            return None
        if any(repeats(each, accuracy, period) for each in begun):  # next to what is unstable
            return None
    if short:
        begun = [repeated(each, period, 0, end) for each in begun]
    before = [sum(mark.time < end for mark in each.occurrences) for each in begun]
    count = max(before) + (period if max(before) > period else 1)
    if short:
        followed = [repeated(each, period, count, end) for each in begun]
    else:
        followed = follow(clock, integrator, points, tolerances, count, begun)
    if max(before) > period:
        count = _enough_marks(followed, period, max(before), count, end)
    ending = Ending.EVENT
    if min(before) == max(before) and min(len(each.occurrences) for each in followed) < count:
        ending, count = Ending.HORIZON, min(before)  # a front that comes once
    orders = {tuple(mark.event for mark in each.occurrences[:count]) for each in followed}
    if len(orders) > 1 or len(order := orders.pop()) < count:
        return None
    in_order = EventOrder(tuple((k,) for k in order), ending)
    return replace(clock, order=in_order, repeats_from=repeats_from), followed


def _enough_marks(
    trajectories: Sequence[EventTrajectory], period: int, passed: int, most: int, end: float
) -> int:
    """The fewest marks, more than were ``passed`` by the end, that all pass well after it."""
    if any(len(each.occurrences) < most for each in trajectories):
        return most
    times = np.array([[mark.time for mark in each.occurrences[:most]] for each in trajectories])
    enough = times >= end + _CHOICE.beyond * (times[:, period:] - times[:, :-period])[:, -1:]
    return next((k for k in range(passed + 1, most) if enough[:, k - 1].all()), most)


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


# -----------------------------------------------------------------------------
# A front that trajectories meet once, each at its own time and many of them after the horizon.
#
# A substrate that is used up, or an epidemic, is over sooner or later, and what is seen of it until
# a fixed time differs over the box: no few products give it. Where all trajectories pass a level if
# they are followed for long enough, that is a marker, and the stretch behind it is as long for all.


def late_front(
    system: System,
    points: Array,
    paths: Sequence[Path],
    horizon: tuple[float, float],
    integrator: SpanIntegrator,
    tolerances: Tolerances,
) -> tuple[Marker, EventOrder] | None:
    """A marker and the order of its events, by trajectories at points (m, d) over clock time.

    Some pass it before the end of the horizon, and others after it. None where there is none, or
    the rank of the trajectories is hardly lower over the stretches before and behind it.
    """
    start, end = horizon
    some = np.unique(np.linspace(0, len(paths) - 1, _CHOICE.ranked).astype(int))
    points, paths = points[some], [paths[k] for k in some.tolist()]
    candidates = _candidates(paths)
    over_clock = rank_of(paths, np.full((some.size, 1), end))
    if not candidates or over_clock < _CHOICE.full * some.size:
        return None
    timed = timed_events(system, (), candidates)

    def enough(trajectory: EventTrajectory, _edge: float) -> bool:
        return len({each.event for each in trajectory.occurrences}) == len(candidates)

    edges = (start, end, end + FAR * (end - start))
    followed = integrate_to_events(integrator, timed, points, edges, tolerances, Goal(enough))
    times = {k: [each.times_of(k) for each in followed] for k in range(len(candidates))}
    marks = {k: np.array(each) for k, each in times.items() if all(one.size == 1 for one in each)}
    if not marks:
        return None
    rests = {k: end - float(each.min()) for k, each in marks.items()}
    ends = np.max([marks[k][:, 0] + rests[k] for k in marks], axis=0)
    further = _continued(timed, points, followed, ends, integrator, tolerances)
    if any(path.end < last for path, last in zip(further, ends, strict=True)):
        return None
    ranks: list[tuple[float, Marker, EventOrder]] = []
    for k, each in marks.items():
        order = EventOrder(((0,),), Ending.LENGTH, (1.0 + SPARE) * rests[k])
        ranks.append((rank_of(further, np.hstack([each, each + rests[k]])), candidates[k], order))
    lowest = min(ranks, key=lambda each: each[0])
    if lowest[0] > _CHOICE.lower_rank * over_clock:
        return None
    return lowest[1:]


def _candidates(paths: Sequence[Path]) -> list[Marker]:
    """Levels that some trajectories cross once, the others not, and all from the same side."""
    markers = list[Marker]()
    nodal = [path.nodal.reshape(-1, path.state.size) for path in paths]
    lower = np.min([each.min(axis=0) for each in nodal], axis=0)
    upper = np.max([each.max(axis=0) for each in nodal], axis=0)
    for state in np.flatnonzero(lower < upper).tolist():
        for share in _CHOICE.levels:
            level = float(lower[state] + share * (upper[state] - lower[state]))
            above = [each[:, state] > level for each in nodal]
            crossings = {int(np.count_nonzero(np.diff(each))) for each in above}
            if crossings == {0, 1} and len({bool(each[0]) for each in above}) == 1:
                markers.append(Marker(state, level))
    return markers


def _continued(
    system: System,
    points: Array,
    trajectories: Sequence[EventTrajectory],
    ends: Array,
    integrator: SpanIntegrator,
    tolerances: Tolerances,
) -> list[Path]:
    """The paths of trajectories, to their ends (m,) at least where these are reached."""
    paths = [joined(each.paths) for each in trajectories]
    short = [k for k, path in enumerate(paths) if path.end < ends[k]]
    if short:
        starts = np.array([paths[k].end for k in short])
        states = np.stack([paths[k].state for k in short], axis=1)
        spans = Spans(starts, states, ends[short])
        further = integrator.paths(system, points[short], spans, tolerances)
        for k, path in zip(short, further, strict=True):
            paths[k] = joined((paths[k], path))
    return paths
