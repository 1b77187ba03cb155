"""Errors of branches against trajectories that follow their own order of events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.verification.check_tuning import CHECK
from rankone.solvers.verification.measure import compared_times
from rankone.solvers.verification.points import Coverage
from rankone.support.arrays import Array, spread
from rankone.tensors.evaluators.branch_evaluator import BranchEvaluator
from rankone.trajectories.events.event_trajectory import EventTrajectory
from rankone.trajectories.events.orders import Order
from rankone.trajectories.system.system import System

MOST_UNDECIDED = 0.01
"""Largest share of the box that may be undecided."""


@dataclass(frozen=True)
class BranchErrors:
    """Errors against trajectories, n states and m points.

    ``states`` (n, m) are the largest ones at clock times, and ``largest`` (n, m) the largest states
    there. ``time`` is the largest error of the time of an event, over the horizon. Points are
    ``decided`` (m,) where one branch is ahead of all others and no two of its events coincide.
    """

    states: Array
    largest: Array
    time: float
    decided: NDArray[np.bool_]


def branch_errors(
    evaluator: BranchEvaluator,
    system: System,
    points: Array,
    trajectories: Sequence[EventTrajectory],
    rtol: float,
) -> BranchErrors:
    """The errors of branches at points (m, d) with trajectories of their own.

    Times within ``rtol`` horizons of an event that resets states are left out, and values that are
    declared to be doubtful. An error is infinite where the branches have no value and the
    trajectory has one, or the other way round.
    """
    n = system.n_differential - system.n_sides
    errors, largest = np.zeros((2, n, len(points)))
    decided = _margins(evaluator, points) >= evaluator.width
    decided &= ~_coincide(evaluator, points)
    all_times = [compared_times(each, system, evaluator.horizon, rtol) for each in trajectories]
    for block in np.array_split(
        np.arange(len(points)), max(-(-len(points) * n // CHECK.branch_points_at_once), 1)
    ):
        most = max(len(all_times[k]) for k in block)
        times = np.stack([np.resize(all_times[k], most) for k in block], axis=1)
        exact = np.stack([trajectories[k](times[:, i])[:n] for i, k in enumerate(block)], axis=2)
        ours, doubtful = evaluator.with_doubts(times, points[block].T.copy(), slice(0, n))
        missing = np.isnan(exact)
        defects = np.abs(ours - exact)
        both = missing & np.isnan(ours)
        defects = np.where(both, 0.0, np.nan_to_num(defects, nan=np.inf))
        defects[:, doubtful] = 0.0
        errors[:, block] = defects.max(axis=1, initial=0.0)
        largest[:, block] = np.abs(np.where(missing, 0.0, exact)).max(axis=1, initial=0.0)
    time = _time_error(
        evaluator, points[decided], [t for t, d in zip(trajectories, decided, strict=True) if d]
    )
    return BranchErrors(errors, largest, time, decided)


def _coincide(evaluator: BranchEvaluator, points: Array) -> NDArray[np.bool_]:
    """Whether events of the branch that holds at points (m, d) are at about one time, (m,).

    Those behind the end of the horizon do not count.
    """
    borders = evaluator.borders(np.ascontiguousarray(points.T))
    near = evaluator.width * (evaluator.horizon[1] - evaluator.horizon[0])
    coincide = (np.diff(borders, axis=0) < near) & (borders[:-1] < evaluator.horizon[1])
    return np.asarray(coincide[1:].any(axis=0))


def _time_error(
    evaluator: BranchEvaluator, points: Array, trajectories: Sequence[EventTrajectory]
) -> float:
    """The largest error of the time of an event before the end, over the horizon."""
    start, end = evaluator.horizon
    largest = 0.0
    if not len(points):
        return largest
    borders = evaluator.borders(np.ascontiguousarray(points.T))
    for trajectory, row in zip(trajectories, borders.T, strict=True):
        times = np.array([each.time for each in trajectory.occurrences])
        if times.size:
            row = row[np.isfinite(row)]
            largest = max(largest, float(np.abs(times[:, None] - row).min(axis=1).max()))
    return largest / (end - start)


def points_near_changes(evaluator: BranchEvaluator, coverage: Coverage) -> Array:
    """Points (m, d) next to where one order gives way to another."""
    d = len(coverage.box)
    points = coverage.points(spread(CHECK.change_candidates, d, np.random.default_rng(20145)))
    least = np.concatenate([_margins(evaluator, block) for block in _blocks(points)])
    order = np.argsort(least, kind="stable")
    return np.asarray(points[order[: CHECK.change_points]])


def points_with_other_events(
    evaluator: BranchEvaluator, system: System, orders: Sequence[Order], coverage: Coverage
) -> Array:
    """Points (m, d) at which the branch that holds passes an event that is not in its order."""
    d = len(coverage.box)
    points = coverage.points(spread(CHECK.change_candidates, d, np.random.default_rng(20147)))
    passes = np.zeros(len(points), dtype=bool)
    for places in np.array_split(np.arange(len(points)), len(_blocks(points))):
        decision = evaluator.decided(np.ascontiguousarray(points[places].T))
        for k in np.unique(decision.chosen).tolist():
            here = places[(decision.chosen == k) & ~decision.undecided]
            if here.size:
                passes[here] = _passes_others(evaluator, system, k, orders[k], points[here])
    passing = points[passes]
    return np.asarray(
        passing[:: max(len(passing) // CHECK.most_surprising, 1)][: CHECK.most_surprising]
    )


def _passes_others(
    evaluator: BranchEvaluator, system: System, branch: int, order: Order, points: Array
) -> NDArray[np.bool_]:
    """Whether a branch passes events that do not end its stretches, at points (m, d)."""
    columns = np.ascontiguousarray(points.T)
    at_all = np.repeat(columns, CHECK.event_looks, axis=1)
    shares = np.linspace(0.0, np.nextafter(1.0, 0.0), CHECK.event_looks)[:, None]
    n, end = system.n_differential - system.n_sides, evaluator.horizon[1]
    passes = np.zeros(len(points), dtype=bool)
    for stretch, sides in enumerate(order.sides):
        values = evaluator.branches[branch].on_stretches(stretch + shares, columns, slice(None))
        clock = values[-2].T
        states = np.swapaxes(values[:n], 1, 2).reshape(n, -1)
        on_sides = np.repeat(np.array(sides, dtype=float)[:, None], clock.size, axis=1)
        states = np.concatenate([states, on_sides])
        running = (clock[:, 1:] <= end) & (np.diff(clock) > 0.0)
        for k, event in enumerate(system.events):
            if not event.interrupts:
                continue
            with np.errstate(all="ignore"):
                heights = event.when(clock.ravel(), states, at_all)
            sign = np.sign(np.broadcast_to(heights, clock.size).reshape(clock.shape))
            passed = (sign[:, :-1] * sign[:, 1:] < 0.0) & running
            passed &= event.direction * np.diff(sign) >= 0.0
            ends = order.ends_with(k)
            passed[:, 0] &= not (stretch and ends[stretch - 1])
            passed[:, -1] &= not ends[stretch]
            passes |= passed.any(axis=1)
    return passes


def undecided_share(evaluator: BranchEvaluator, coverage: Coverage) -> float:
    """The share of the box in which it is undecided which branch holds, and states differ.

    Times next to events, where values jump in any case, do not count.
    """
    d = len(coverage.box)
    points = coverage.points(spread(CHECK.share_points, d, np.random.default_rng(20146)))
    times = np.linspace(*evaluator.horizon, CHECK.event_looks)[:, None]
    count, aside = 0, 2.0 * evaluator.width * (evaluator.horizon[1] - evaluator.horizon[0])
    for block in _blocks(points):
        near = block[_margins(evaluator, block) < evaluator.width]
        if len(near):
            rows, columns = slice(0, evaluator.tolerances.size), np.ascontiguousarray(near.T)
            _, doubtful = evaluator.with_doubts(times, columns, rows)
            for branch in evaluator.branches:
                for border in branch.borders(columns)[1:-1]:
                    doubtful &= np.abs(times - border) > aside
            count += int(doubtful.any(axis=0).sum())
    return count / len(points)


def _blocks(points: Array) -> list[Array]:
    return np.array_split(points, max(-(-len(points) // CHECK.branch_points_at_once), 1))


def _margins(evaluator: BranchEvaluator, points: Array) -> Array:
    """By how much the branch that holds at points (m, d) is ahead of all others, (m,).

    Or by how much it misses an event that is only grazed.
    """
    decision = evaluator.decided(np.ascontiguousarray(points.T))
    ahead = np.minimum(decision.ahead.min(axis=0), decision.clear)
    return np.where(decision.undecided, -np.inf, ahead)
