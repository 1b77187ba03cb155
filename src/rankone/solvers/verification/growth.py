"""How much errors grow that are made on the way."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse

from rankone.solvers.verification.check_tuning import CHECK
from rankone.solvers.verification.reference import Reference
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.arrays import Array
from rankone.support.budget import COPIES, reserve
from rankone.support.costs import SparseFactors
from rankone.support.precision import AT_ONCE
from rankone.trajectories.system.system import PatternJacobian, pattern_of


def amplification(reference_set: ReferenceSet) -> Callable[[float], float]:
    """Largest later growth of an error made at time t, along a few trajectories.

    The variational equation ``w' = J(t) w`` is stepped on a uniform grid with the Cayley transform
    of the scaled Jacobian, which is stable for stiff systems. The amplification, at least 1, is the
    largest Frobenius norm, divided by sqrt(n), of the propagator from t to any later time. Of many
    states it is estimated from random columns of the propagator.
    """
    start = reference_set.reference.start
    pattern = pattern_of(reference_set.system.jacobian)
    if pattern is None:
        largest = _of_propagators(reference_set)
    else:
        largest = _of_columns(reference_set, pattern)
    grid = np.linspace(start, reference_set.end, CHECK.growth_steps + 1)
    return lambda t: float(np.interp(t, grid, largest))


def _of_propagators(reference_set: ReferenceSet) -> Array:
    """The amplification at the steps (steps + 1,), from whole propagators."""
    n, start = reference_set.system.n_differential, reference_set.reference.start
    width = (reference_set.end - start) / CHECK.growth_steps
    reference = reference_set.reference
    count = min(CHECK.growth_trajectories, len(reference.points))
    together = max(AT_ONCE // (n * n * CHECK.growth_steps), 1)
    largest = np.ones(CHECK.growth_steps + 1)
    for first in range(0, count, together):
        some = reference.of(slice(first, min(first + together, count)))
        reserve(8.0 * COPIES * n * n * CHECK.growth_steps * len(some.points))
        step = _cayley_steps(reference_set, some, width)
        propagator = step
        for gap in range(1, CHECK.growth_steps + 1):
            norms = np.sqrt(np.einsum("kmij,kmij->km", propagator, propagator).max(axis=1) / n)
            np.maximum(largest[: norms.size], norms, out=largest[: norms.size])
            if gap < CHECK.growth_steps:
                propagator = np.matmul(step[gap:], propagator[:-1])
    return largest


def _of_columns(reference_set: ReferenceSet, pattern: PatternJacobian) -> Array:
    """The same from random columns, stepped with sparse factors (Hutchinson's estimate, 1990)."""
    n, reference = reference_set.system.n_differential, reference_set.reference
    width = (reference_set.end - reference.start) / CHECK.growth_steps
    middle = np.asarray(
        reference.start + width * (np.arange(CHECK.growth_steps) + 0.5), dtype=float
    )
    sizes = reference_set.states
    scale = 0.5 * width * sizes[pattern.columns] / sizes[pattern.rows]
    places, eye = (pattern.rows, pattern.columns), scipy.sparse.identity(n, format="csc")
    first = np.random.default_rng(0).standard_normal((n, CHECK.growth_columns)) / np.sqrt(
        n * CHECK.growth_columns
    )
    largest = np.ones(CHECK.growth_steps + 1)
    reserve(8.0 * COPIES * n * CHECK.growth_columns * CHECK.growth_steps)
    for point in range(min(CHECK.growth_trajectories, len(reference.points))):
        some = reference.of(slice(point, point + 1))
        entries = pattern.entries(middle, some(middle)[:, 0], some.points[0][:, None])
        entries = np.broadcast_to(entries, (pattern.rows.size, CHECK.growth_steps))
        columns = np.empty((n, 0))
        for step in range(CHECK.growth_steps):
            half = scipy.sparse.csc_matrix((scale * entries[:, step], places), (n, n))
            columns = np.concatenate([columns, first], axis=1)  # errors made here
            try:
                columns = SparseFactors(eye - half).solve(columns + half @ columns)
            except RuntimeError:  # a growth rate at a pole of the transform
                half = CHECK.beside_pole * half
                columns = SparseFactors(eye - half).solve(columns + half @ columns)
            norms = np.linalg.norm(columns.reshape(n, -1, CHECK.growth_columns), axis=(0, 2))
            np.maximum(largest[: norms.size], norms, out=largest[: norms.size])
    return largest


def _cayley_steps(reference_set: ReferenceSet, reference: Reference, width: float) -> Array:
    """Propagators (steps, m, n, n) of steps of a width along trajectories, in units of sizes."""
    system, n = reference_set.system, reference_set.system.n_differential
    middle = np.asarray(
        reference.start + width * (np.arange(CHECK.growth_steps) + 0.5), dtype=float
    )
    states, points = reference(middle), reference.points
    jacobian = system.jacobian(middle, states, points.T[:, :, None])
    jacobian = np.broadcast_to(jacobian, (n, n, len(points), CHECK.growth_steps))
    scale = reference_set.states[None, :] / reference_set.states[:, None]
    half, eye = 0.5 * width * jacobian.transpose(3, 2, 0, 1) * scale, np.eye(n)
    try:
        steps = np.linalg.solve(eye - half, eye + half)
    except np.linalg.LinAlgError:  # a growth rate at a pole of the transform
        steps = np.linalg.solve(eye - CHECK.beside_pole * half, eye + CHECK.beside_pole * half)
    return np.asarray(steps, dtype=float)
