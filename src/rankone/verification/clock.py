"""Errors over clock time of slabs over stretches between events."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rankone.ir.system import Clock, System
from rankone.ir.timeline import Timeline
from rankone.support.arrays import Array
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain
from rankone.tensors.timeline import TimelineEvaluator
from rankone.trajectories.events.event_trajectory import EventTrajectory
from rankone.trajectories.events.stretch_integrator import StretchTrajectories
from rankone.verification.reference import Reference

_TIMES = 41  # Evenly spaced times of the horizon at which values are compared
_SHARES = np.array([0.0, 0.03, 0.2, 0.5, 0.8, 0.97, 1.0])  # Compared times of each stretch, besides
_BEYOND = 0.02  # How far beyond where an order holds its errors count, in horizons
_TOGETHER = 1 << 21  # Numbers of solutions that are read together
_BESIDE = 1.001  # Distance of the nearest compared time from an event, in those left out


@dataclass(frozen=True)
class ClockErrors:
    """Errors against trajectories, n states and m points.

    ``states`` (n, m) are the largest ones at clock times, and ``largest`` (n, m) the largest states
    there; ``at_shares`` (n, m) are those where both are at the same share of the same stretch, up
    to the end of the horizon. ``time`` is the largest error of the time of an event before the end,
    over the horizon. ``off_constraints`` (n, m) is how far states are from satisfying constraints.
    """

    states: Array
    largest: Array
    at_shares: Array
    time: float
    off_constraints: Array


def clock_errors(
    reference: Reference, clock: Clock, slabs: Sequence[SlabTrain], rtol: float
) -> ClockErrors:
    """The errors of slabs over stretches.

    Times within ``rtol`` horizons of an event that resets states are left out. An error is
    infinite where the slabs have no value and the reference has one, or the other way round.
    """
    evaluator = TimelineEvaluator(slabs, clock.horizon, Timeline.of(clock).affine_borders)
    n = clock.n_states
    errors, largest, off = np.zeros((3, n, len(reference.points)))
    rows, time_error = slice(0, n), 0.0
    columns = np.ascontiguousarray(reference.points.T)
    borders = evaluator.borders(columns)
    all_times = [
        _compared(batch.trajectories[at], clock.system, clock.horizon, batch.borders[at], rtol)
        for batch, at in _each(reference)
    ]
    solutions = _curves(evaluator, all_times, columns, rows)
    each = zip(reference.points, _each(reference), all_times, solutions, strict=True)
    for k, (point, (batch, at), times, solution) in enumerate(each):
        exact = batch.at(at, times)
        missing = np.isnan(exact)
        if missing.any() and not clock.terminal:
            errors[:, k] = np.inf
            continue
        defects = np.abs(solution - exact)
        defects = np.where(missing & np.isnan(solution), 0.0, np.nan_to_num(defects, nan=np.inf))
        errors[:, k] = defects.max(axis=1, initial=0.0)
        exact_borders = batch.borders[at]
        inside = exact_borders <= clock.horizon[1]
        missed = np.abs(borders[:, k] - exact_borders)[inside].max(initial=0.0)
        time_error = max(time_error, float(missed) / clock.length)
        largest[:, k] = np.abs(np.where(missing, 0.0, exact)).max(axis=1, initial=0.0)
        off[:, k] = _off_constraints(clock.system, times, solution, point)
    begins = np.arange(clock.order.stretches)[:, None]
    pseudo = np.minimum(begins + _SHARES, np.nextafter(begins + 1.0, begins)).ravel()
    exact = np.swapaxes(reference(pseudo), 1, 2)
    solved = evaluator.trains.curves(pseudo[:, None], columns, rows)
    before = exact[n] <= clock.horizon[1]  # the row behind the states is the clock
    at_shares = np.where(before, np.abs(solved - exact[:n]), 0.0).max(axis=1)
    return ClockErrors(errors, largest, at_shares, time_error, off)


def _curves(
    evaluator: TimelineEvaluator, all_times: Sequence[Array], points: Array, rows: slice
) -> Iterator[Array]:
    """States (n, T) at the times (T,) of each of the points (d, m), which are read together."""
    longest = max(times.size for times in all_times)
    together = max(_TOGETHER // (longest * evaluator.count(rows)), 1)
    for first in range(0, len(all_times), together):
        some = all_times[first : first + together]
        padded = np.stack([np.pad(times, (0, longest - times.size), "edge") for times in some], 1)
        states = evaluator.curves(padded, points[:, first : first + together], rows)
        for k, times in enumerate(some):
            yield states[:, : times.size, k]


def _off_constraints(system: System, times: Array, states: Array, point: Array) -> Array:
    """How far states (n, T) of a trajectory are from satisfying constraints, at most: (n,)."""
    there = ~np.isnan(states).any(axis=0)
    if not system.constraints.names or not there.any():
        return np.zeros(len(states))
    times, states = times[there], states[:, there]
    sizes = np.abs(states).max(axis=1)
    sizes = np.where(sizes > 0.0, sizes, sizes.max() or 1.0)
    columns = np.repeat(point[:, None], times.size, axis=1)
    return np.asarray(system.constraints.distances(times, states, columns, sizes).max(axis=1))


def _each(reference: Reference) -> Iterator[tuple[StretchTrajectories, int]]:
    for batch in reference.batches:
        assert isinstance(batch, StretchTrajectories)
        for k in range(len(batch.trajectories)):
            yield batch, k


def compared_times(
    trajectory: EventTrajectory, system: System, horizon: tuple[float, float], rtol: float
) -> Array:
    """The clock times at which a trajectory over a horizon is compared."""
    borders = np.array([horizon[0], *(each.time for each in trajectory.occurrences), horizon[1]])
    return _compared(trajectory, system, horizon, borders, rtol)


def _compared(
    trajectory: EventTrajectory,
    system: System,
    horizon: tuple[float, float],
    borders: Array,
    rtol: float,
) -> Array:
    """The clock times at which a trajectory with stretches between borders is compared."""
    start, end = horizon
    out = rtol * (end - start)
    times = [np.linspace(start, end, _TIMES), borders[0] + (end - borders[0]) * _SHARES]
    times += [a + (b - a) * _SHARES for a, b in itertools.pairwise(borders)]
    resets = np.array([o.time for o in trajectory.occurrences if system.events[o.event].jumps])
    times += [resets - _BESIDE * out, resets + _BESIDE * out]
    all_times = np.unique(np.concatenate(times))
    all_times = all_times[(all_times >= start) & (all_times <= end)]
    if resets.size:
        away = np.abs(all_times[:, None] - resets).min(axis=1) >= out
        all_times = all_times[away]
    return np.asarray(all_times)


def forced_errors(
    reference: Reference, clock: Clock, slabs: Sequence[SlabTrain]
) -> tuple[Array, Array]:
    """Errors of slabs of a forced order, and the largest values, (rows, m) each.

    Rows are states, guards, clock and length at equal shares of stretches. What is far beyond where
    the order holds does not count.
    """
    n = clock.n_states + clock.n_guards
    begins = np.arange(clock.order.stretches)[:, None]
    pseudo = np.minimum(begins + _SHARES, np.nextafter(begins + 1.0, begins)).ravel()
    exact = np.swapaxes(reference(pseudo), 1, 2)
    evaluator = TrainEvaluator(slabs)
    columns = np.ascontiguousarray(reference.points.T)
    ours = evaluator.curves(pseudo[:, None], columns, slice(0, n + 2))
    beyond = _BEYOND * clock.length
    lengths, now = exact[n + 1], exact[n]
    counts = (now <= clock.horizon[1] + beyond) & (lengths >= -beyond).all(axis=0)
    errors = np.where(counts, np.abs(ours - exact), 0.0).max(axis=1)
    return errors, np.where(counts, np.abs(exact), 0.0).max(axis=1)
