"""Errors measured against the reference set of a solve."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from rankone.discretization.time_grid import times_within
from rankone.ir.outcome import Measured
from rankone.ir.request import Domain
from rankone.ir.system import Clock, System
from rankone.ir.timeline import CLOCK_STATES
from rankone.support.arrays import Array
from rankone.support.budget import charge, unlimited
from rankone.support.costs import Cost
from rankone.tensors.slab import SlabTrain, modes_in_time
from rankone.verification.clock import clock_errors, forced_errors
from rankone.verification.points import check_points, worst_apart
from rankone.verification.reference_set import ReferenceSet

_CHECK_SHARES = np.array([0.0, 0.13, 0.31, 0.5, 0.69, 0.87, 1.0])  # Checked times, in slab lengths
SAFE_QUANTILE = 0.95  # Part of the points whose errors the reported quantile bounds
# Operations of a least change that satisfies constraints, for each entry of their slopes
_CONSTRAINT_COST = Cost(50e3, 400.0)
_DRIFT_POINTS = 24  # Points at which lifted states are compared with what they stand for
_DRIFT_SHARES = np.array([0.0, 0.31, 0.69, 1.0])  # Compared times, in slab lengths


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
        quantile=float(np.quantile(of_points[spread[counts]], SAFE_QUANTILE, method="higher")),
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
    points = check_points(domain.bounds, _DRIFT_POINTS, scales=domain.coordinates)
    count = system.n_lifted
    size, worst = np.zeros(count), np.zeros(count)
    for slab, contraction in with_contractions(slabs, points):
        times = times_within(slab.start, slab.end, _DRIFT_SHARES)
        states = slab.on_grid(times, contraction)
        lifted, meant = states[-count:], system.meanings(times, states, points.T[:, :, None])
        size = np.maximum(size, np.abs(lifted).max(axis=(1, 2)))
        worst = np.maximum(worst, np.abs(lifted - meant).max(axis=(1, 2)))
    return float(np.nan_to_num(worst / np.where(size > 0.0, size, 1.0), nan=np.inf).max())
