"""Times at which narrow outputs are checked: there they are largest, or steepest."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rankone.ir.observation import Observation
from rankone.support.arrays import Array
from rankone.verification.reference import Reference

_SAMPLES = 201  # Evenly spaced times between which surfaces are crossed at most once
_PARTS = 32  # Parts of an interval of which one is kept
_ROUNDS = 6  # How often: the interval is a billionth of itself then
_MOST_TIMES = 200  # Most times that are kept, evenly spread over those that are found


def narrow_times(reference: Reference, observed: Observation | None, end: float) -> Array:
    """When trajectories of the reference cross the surfaces of what is observed, in order: (k,)."""
    if observed is None or observed.surfaces is None:
        return np.empty(0)
    times = np.linspace(reference.start, end, _SAMPLES)
    places: set[tuple[int, int, int]] = set()
    for block, first in _blocks(reference, times):
        part = times[first : first + block.shape[2]]
        surfaces = observed.surfaces_at(part, block, reference.points)
        places |= {(s, i, first + k) for s, i, k in _crossings(surfaces)}
    kept = sorted(places, key=lambda place: (place[2], *place))
    spread = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), _MOST_TIMES)).astype(int))
    crossing_times = [_refined(reference, observed, kept[k], times) for k in spread]
    return np.unique(np.array(crossing_times, dtype=float))


def _blocks(reference: Reference, times: Array) -> Iterator[tuple[Array, int]]:
    """States at parts of the times that share an end, each with the position of its first time."""
    most = max(reference.times_held, 2)
    for first in range(0, times.size - 1, most - 1):
        yield reference(times[first : first + most]), first


def _crossings(surfaces: Array) -> list[tuple[int, int, int]]:
    """Where surfaces (s, m, T) vanish or change their sign before the next time."""
    signs = np.sign(surfaces)
    changes = (signs[..., :-1] != signs[..., 1:]) & (signs[..., 1:] != 0.0)
    return [(int(s), int(i), int(k)) for s, i, k in np.argwhere(changes)]


def _refined(
    reference: Reference, observed: Observation, place: tuple[int, int, int], times: Array
) -> float:
    """When a trajectory crosses a surface: surface, trajectory, and position of the time before."""
    surface, trajectory, k = place
    alone = reference.of(slice(trajectory, trajectory + 1))
    begin, end = times[k], times[k + 1]
    for _ in range(_ROUNDS):
        within = np.linspace(begin, end, _PARTS + 1)
        values = observed.surfaces_at(within, alone(within), alone.points)[surface, 0]
        changes = np.flatnonzero(np.sign(values[:-1]) != np.sign(values[1:]))
        if not changes.size:
            break
        begin, end = within[changes[0]], within[changes[0] + 1]
    return float(0.5 * (begin + end))
