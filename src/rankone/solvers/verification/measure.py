"""Errors measured against the reference set of a solve, over clock time and in branches."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.outcome import Measured
from rankone.solvers.request import Domain
from rankone.solvers.tuning import CHECK
from rankone.solvers.verification.points import Coverage, check_points, worst_apart
from rankone.solvers.verification.reference import Reference
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.arrays import AT_ONCE, Array, lobatto, spread
from rankone.support.budget import charge, unlimited
from rankone.support.costs import CALL, Cost
from rankone.support.options import LEVEL
from rankone.tensors.branch_evaluator import BranchEvaluator
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain, modes_in_time
from rankone.tensors.time_grid import times_within
from rankone.tensors.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.events.event_trajectory import EventTrajectory
from rankone.trajectories.events.orders import Order
from rankone.trajectories.events.stretch_integrator import StretchTrajectories
from rankone.trajectories.system.system import Clock, System
from rankone.trajectories.system.timeline import CLOCK_STATES, Timeline

_SHARES = lobatto(8)  # Compared times of each stretch, besides
BEYOND = 0.02
"""How far beyond where an order of events holds a branch reaches, and its errors count."""


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
        off[:, k] = _off_along(clock.system, times, solution, point)
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
    together = max(AT_ONCE // (longest * evaluator.count(rows)), 1)
    for first in range(0, len(all_times), together):
        some = all_times[first : first + together]
        padded = np.stack([np.pad(times, (0, longest - times.size), "edge") for times in some], 1)
        states = evaluator.curves(padded, points[:, first : first + together], rows)
        for k, times in enumerate(some):
            yield states[:, : times.size, k]


def _off_along(system: System, times: Array, states: Array, point: Array) -> Array:
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
    times = [
        np.linspace(start, end, CHECK.measure_times),
        borders[0] + (end - borders[0]) * _SHARES,
    ]
    times += [a + (b - a) * _SHARES for a, b in itertools.pairwise(borders)]
    resets = np.array([o.time for o in trajectory.occurrences if system.events[o.event].jumps])
    times += [resets - CHECK.event_distance * out, resets + CHECK.event_distance * out]
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
    beyond = BEYOND * clock.length
    lengths, now = exact[n + 1], exact[n]
    counts = (now <= clock.horizon[1] + beyond) & (lengths >= -beyond).all(axis=0)
    errors = np.where(counts, np.abs(ours - exact), 0.0).max(axis=1)
    return errors, np.where(counts, np.abs(exact), 0.0).max(axis=1)


# -----------------------------------------------------------------------------
# Errors measured against the reference set of a solve.


_CHECK_SHARES = lobatto(7)  # Checked times, in slab lengths
# Operations of a least change that satisfies constraints, for each entry of their slopes
_CONSTRAINT_COST = Cost(50 * CALL, 400)
_DRIFT_SHARES = lobatto(4)  # Compared times, in slab lengths


def measure(reference_set: ReferenceSet, slabs: Sequence[SlabTrain]) -> Measured | None:
    """Errors of the slabs over their whole time span; None without check or slabs.

    They are in units of the sizes; at corners, of the largest size there if that is larger.
    """
    if not slabs or not reference_set.checked:
        return None
    reference, m = reference_set.reference, len(reference_set.reference.points)
    corners, unknowns = slice(1, 1 + reference_set.corners), len(reference_set.system.unknowns)
    if reference_set.observed is not None:
        unknowns = len(reference_set.names)
    all_times = [times_within(slab.start, slab.end, _CHECK_SHARES) for slab in slabs]
    if (clock := reference_set.system.clock) is not None:
        return _over_clock_time(reference_set, clock, slabs)
    with unlimited():
        errors, largest = np.zeros((reference_set.states.size, m)), reference_set.states
        off = np.zeros_like(errors)
        carried = with_contractions(slabs, reference.points)
        count = _CHECK_SHARES.size
        all_exact = (
            exact
            for block in reference.blocks(np.concatenate(all_times), count)
            for exact in np.split(block, block.shape[2] // count, axis=2)
        )
        all_modes = modes_in_time(slabs, all_times)
        for (slab, contraction), times, modes, exact in zip(
            carried, all_times, all_modes, all_exact, strict=True
        ):
            exact = reference_set.seen(times, exact)
            states = slab.on_grid(times, contraction, modes)
            errors = np.maximum(errors, np.abs(states - exact).max(axis=2))
            off = np.maximum(off, _off_constraints(reference_set, times, states))
            at_corners = np.abs(exact[:, corners]).max(axis=(1, 2), initial=0.0)
            at_corners += reference_set.added_to_seen
            largest = np.maximum(largest, at_corners)
            at_narrow = _narrow_errors(reference_set, slab, contraction)
            errors = np.maximum(errors, at_narrow)
    units = np.repeat(reference_set.states[:, None], m, axis=1)
    units[:, corners] = largest[:, None]
    errors = (np.where(np.isfinite(errors), errors, np.inf) / units)[:unknowns]
    return measured_from(reference_set, errors, (off / units)[:unknowns])


def _narrow_errors(
    reference_set: ReferenceSet, slab: SlabTrain, contraction: Array
) -> Array | float:
    """Largest errors of quantities where they are narrow inside a slab, (n, m)."""
    times = reference_set.narrow_times
    times = times[(times >= slab.start) & (times < slab.end)]
    if not times.size:
        return 0.0
    exact = np.concatenate([*reference_set.quantities(times)], axis=2)
    return np.asarray(np.abs(slab.on_grid(times, contraction) - exact).max(axis=2))


def _off_constraints(reference_set: ReferenceSet, times: Array, states: Array) -> Array:
    """How far states (n, m, T) are from satisfying the constraints, at most: (n, m)."""
    constraints, (n, m, count) = reference_set.system.constraints, states.shape
    if not constraints.names or reference_set.observed is not None:
        return np.zeros((n, m))
    charge(_CONSTRAINT_COST(m * count * n * len(constraints.names)))
    columns = np.repeat(reference_set.reference.points.T, count, axis=1)
    flat = states.reshape(n, m * count)
    off = constraints.distances(np.tile(times, m), flat, columns, reference_set.states)
    return np.asarray(off.reshape(n, m, count).max(axis=2))


def _over_clock_time(
    reference_set: ReferenceSet, clock: Clock, slabs: Sequence[SlabTrain]
) -> Measured:
    """Errors of slabs over stretches, over clock time, in units of the sizes over it."""
    unknowns = len(reference_set.system.unknowns)
    slabs = [slab.with_first(slab.cores[0][:unknowns]) for slab in slabs]
    if clock.forced is not None:
        return _of_forced(reference_set, clock, slabs)
    with unlimited():
        errors = clock_errors(reference_set.reference, clock, slabs, reference_set.rtol)
    largest = errors.largest + reference_set.added[: len(errors.largest), None]
    interior = reference_set.interior(largest, axis=1).max(axis=1)
    units = np.repeat(np.where(interior > 0.0, interior, 1.0)[:, None], largest.shape[1], 1)
    corners = slice(1, 1 + reference_set.corners)
    at_corners = np.maximum(interior, largest[:, corners].max(axis=1, initial=0.0))
    units[:, corners] = np.where(at_corners > 0.0, at_corners, 1.0)[:, None]
    measured = measured_from(reference_set, errors.states / units, errors.off_constraints / units)
    at_shares = float((errors.at_shares / units).max())
    return replace(measured, time_error=errors.time, share_error=at_shares)


def _of_forced(reference_set: ReferenceSet, clock: Clock, slabs: Sequence[SlabTrain]) -> Measured:
    """Errors of slabs of a forced order; those of its guards and times count for each state."""
    with unlimited():
        errors, largest = forced_errors(reference_set.reference, clock, slabs)
    units = largest.max(axis=1, keepdims=True)
    units = np.where(units > 0.0, units, 1.0)
    units[-CLOCK_STATES:] = clock.length
    relative, n = errors / units, clock.n_states
    of_states = np.maximum(relative[:n], relative[n:].max(axis=0))
    return measured_from(reference_set, of_states, np.zeros_like(of_states))


def measured_from(reference_set: ReferenceSet, errors: Array, off: Array) -> Measured:
    """What errors (unknowns, m) in units of the sizes amount to.

    The distances ``off`` from where constraints hold are errors as well.
    """
    drift = float(off.max(initial=0.0)) if _has_constraints(reference_set) else None
    errors = np.maximum(errors, off)
    reference, corners = reference_set.reference, slice(1, 1 + reference_set.corners)
    counts = np.ones(errors.shape[1], dtype=bool)
    counts[corners] = reference_set.whole_box
    of_states = errors if reference_set.counted is None else errors[list(reference_set.counted)]
    of_points = of_states[:, counts].max(axis=0)
    corner_errors = errors[:, corners].max(axis=1, initial=0.0)
    spread = counts.copy()
    spread[reference_set.places_on_lines] = False
    worst, *also_bad = worst_apart(reference_set.domain, reference.points[counts], of_points)
    return Measured(
        interior=tuple(errors[:, counts].max(axis=1).tolist()),
        corners=tuple(corner_errors.tolist()) if reference_set.corners else (),
        points=counts.size,
        method=reference.method,
        cover="box" if reference_set.whole_box else "interior",
        quantile=float(np.quantile(of_points[spread[counts]], LEVEL, method="higher")),
        worst=worst,
        also_bad=tuple(also_bad),
        counted=reference_set.counted,
        integrator=reference.integrator,
        constraint_drift=drift,
    )


def _has_constraints(reference_set: ReferenceSet) -> bool:
    clock = reference_set.system.clock
    system = reference_set.system if clock is None else clock.system
    return bool(system.constraints.names) and reference_set.observed is None


def with_contractions(
    slabs: Sequence[SlabTrain], points: Array
) -> Iterator[tuple[SlabTrain, Array]]:
    """Each slab with its trains over the parameters at points (m, d), made once if shared."""
    last, contraction = None, points
    for slab in slabs:
        if last is None or not slab.shares_parameters(last):
            last, contraction = slab, slab.over_parameters(points.T)
        yield slab, contraction


def drift(system: System, domain: Domain, slabs: Sequence[SlabTrain]) -> float:
    """Largest difference between lifted states and what they stand for, relative to their sizes.

    ``s`` for ``sin(x)`` and ``c`` for ``cos(x)`` are on the circle as long as both stay sine and
    cosine of the ``x`` that is solved for with them.
    """
    points = check_points(domain.bounds, CHECK.drift_points, scales=domain.coordinates)
    count = system.n_lifted
    size, worst = np.zeros(count), np.zeros(count)
    for slab, contraction in with_contractions(slabs, points):
        times = times_within(slab.start, slab.end, _DRIFT_SHARES)
        states = slab.on_grid(times, contraction)
        lifted, meant = states[-count:], system.meanings(times, states, points.T[:, :, None])
        size = np.maximum(size, np.abs(lifted).max(axis=(1, 2)))
        worst = np.maximum(worst, np.abs(lifted - meant).max(axis=(1, 2)))
    return float(np.nan_to_num(worst / np.where(size > 0.0, size, 1.0), nan=np.inf).max())


# -----------------------------------------------------------------------------
# Errors of branches against trajectories that follow their own order of events.


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
