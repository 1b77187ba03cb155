"""A front that trajectories meet once, each at its own time and many of them after the horizon.

A substrate that is used up, or an epidemic, is over sooner or later, and what is seen of it until a
fixed time differs over the box: no few products give it. Where all trajectories pass a level if
they are followed for long enough, that is a marker, and the stretch behind it is as long for all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rankone.support.arrays import Array
from rankone.trajectories.events.event_integration import integrate_to_events
from rankone.trajectories.events.event_order import SPARE
from rankone.trajectories.events.event_trajectory import EventTrajectory
from rankone.trajectories.events.markers import rank_of
from rankone.trajectories.events.periods import FAR
from rankone.trajectories.events.stretches import timed_events
from rankone.trajectories.integrators.integrator import (
    Path,
    SpanIntegrator,
    Spans,
    Tolerances,
    joined,
)
from rankone.trajectories.system.events import Ending, EventOrder, Marker
from rankone.trajectories.system.system import System

_SOME = 24  # Trajectories that are followed beyond the horizon
_LEVELS = 0.5, 0.1, 0.9  # Levels that are tried, as shares of the range of a state
_FULL = 0.75  # Rank over clock time, over their number, from which it is looked for
_LOWER_RANK = 0.7  # Largest rank over the stretches, over that over clock time


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
    some = np.unique(np.linspace(0, len(paths) - 1, _SOME).astype(int))
    points, paths = points[some], [paths[k] for k in some.tolist()]
    candidates = _candidates(paths)
    over_clock = rank_of(paths, np.full((some.size, 1), end))
    if not candidates or over_clock < _FULL * some.size:
        return None
    timed = timed_events(system, (), candidates)

    def enough(trajectory: EventTrajectory, _edge: float) -> bool:
        return len({each.event for each in trajectory.occurrences}) == len(candidates)

    edges = (start, end, end + FAR * (end - start))
    followed = integrate_to_events(
        integrator, timed, points, edges, tolerances, timed.events, enough
    )
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
    if lowest[0] > _LOWER_RANK * over_clock:
        return None
    return lowest[1:]


def _candidates(paths: Sequence[Path]) -> list[Marker]:
    """Levels that some trajectories cross once, the others not, and all from the same side."""
    markers = list[Marker]()
    nodal = [path.nodal.reshape(-1, path.state.size) for path in paths]
    lower = np.min([each.min(axis=0) for each in nodal], axis=0)
    upper = np.max([each.max(axis=0) for each in nodal], axis=0)
    for state in np.flatnonzero(lower < upper).tolist():
        for share in _LEVELS:
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
