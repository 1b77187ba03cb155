"""Reference trajectories at single parameter points: the yardstick every solve is held against.

All points are integrated together as one stacked system by SciPy, with the generated pointwise
right-hand side: DOP853, or Radau where the centre trajectory is stiff.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.integrate
import scipy.sparse

from rankone.solvers.outcome import Measured
from rankone.system import Array, System
from rankone.tensors.slab import SlabTrain

__all__ = ["Reference", "check_points", "initial_values", "integrate_reference", "measure"]

_STIFF_STEPS = 1500.0
"""DOP853 steps that stability alone may cost before the stiff integrator is taken."""
_CHECK_TIMES = np.array([0.0, 0.13, 0.31, 0.5, 0.69, 0.87, 1.0])
"""Where a slab is checked, relative to its length."""
_DENSE_STATES = 240
"""Largest stacked system whose Jacobian is factored densely."""


def check_points(box: Array, count: int, seed: int = 20140) -> Array:
    """The centre of the box, corners, and random interior points, shape (m, d).

    Parameters
    ----------
    box : ndarray (d, 2)
    count : int
        Number of random points; with it come all corners for d <= 3, else eight of them.
    """
    rng = np.random.default_rng(seed)
    d = len(box)
    lower, width = box[:, 0], box[:, 1] - box[:, 0]
    if d == 0 or count == 0:
        return (lower + 0.5 * width)[None, :]
    if d <= 3:
        corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * d, indexing="ij"), axis=-1).reshape(-1, d)
    else:
        corners = rng.integers(0, 2, size=(8, d)).astype(float)
        corners[0], corners[1] = 0.0, 1.0
    unit = np.concatenate([np.full((1, d), 0.5), corners, rng.random((count, d))])
    return np.asarray(lower + width * unit)


@dataclass(frozen=True)
class Reference:
    """Trajectories at the check points, dense in time.

    Attributes
    ----------
    points : ndarray (m, d)
        Parameter points; the first is the centre of the box.
    end : float
        Time reached; before the horizon where a trajectory blows up.
    stiff : bool
        Whether the stiff integrator was used.
    blown : int or None
        The point whose trajectory blows up at ``end``.
    """

    points: Array
    start: float
    end: float
    stiff: bool
    blown: int | None
    dense: Any
    states: int
    evaluations: int

    def __call__(self, times: Array) -> Array:
        """States at the times (T,): shape (n, m, T)."""
        values = self.dense(times)
        return np.asarray(values.reshape(self.states, len(self.points), -1))


def integrate_reference(
    system: System, points: Array, start: float, end: float, rtol: float
) -> Reference:
    """Integrate the system from ``start`` to ``end`` at all points (m, d).

    ``rtol`` is the relative tolerance of the integrator.
    """
    n, m = system.N_DIFFERENTIAL, len(points)
    parameters = np.ascontiguousarray(points.T)
    initial = initial_values(system, parameters)

    def right_hand_side(t: float, y: Array) -> Array:
        return system.rhs(t, y.reshape(n, m), parameters).ravel()

    size = np.abs(initial).max(initial=0.0)
    options: dict[str, Any] = {"rtol": rtol, "atol": rtol * 1e-7 * (size if size > 0 else 1.0)}
    stiff = _is_stiff(system, initial[:, 0], points[0], start, end)
    if stiff:
        options |= {"method": "Radau", "jac": _stacked_jacobian(system, parameters, n, m)}
    else:
        options |= {"method": "DOP853"}
    with np.errstate(all="ignore"):
        result = scipy.integrate.solve_ivp(
            right_hand_side, (start, end), initial.ravel(), dense_output=True, **options
        )
    blown = None
    if result.status != 0:
        last = np.abs(result.y[:, -1].reshape(n, m))
        growth = last / np.maximum(np.abs(result.y.reshape(n, m, -1)[:, :, 0]), size + 1e-300)
        blown = int(np.argmax(np.nan_to_num(growth, nan=np.inf).max(axis=0)))
    return Reference(
        points, start, float(result.t[-1]), stiff, blown, result.sol, n, int(result.nfev)
    )


def initial_values(system: System, parameters: Array) -> Array:
    """Initial states at parameter points (d, m): shape (n, m)."""
    m = parameters.shape[1]
    rows = [system.parameter_factors(j, parameters[j]) for j in range(len(parameters))]
    values = np.zeros((system.N_DIFFERENTIAL, m))
    for coefficient, state, factors in system.INITIAL:
        product = np.full(m, coefficient)
        for row, index in zip(rows, factors, strict=True):
            product = product * row[index]
        values[state] += product
    return values


def measure(
    slabs: Sequence[SlabTrain], reference: Reference, scale: Array, corners: int
) -> Measured:
    """Errors of the slabs against the reference over their whole time span.

    Parameters
    ----------
    slabs : sequence of SlabTrain
    reference : Reference
    scale : ndarray (n,)
        Size of each state.
    corners : int
        Number of check points, after the centre, that are corners of the box.
    """
    m, d = reference.points.shape
    errors = np.zeros((reference.states, m))
    for slab in slabs:
        times = slab.start + (slab.end - slab.start) * _CHECK_TIMES
        exact = reference(times)
        pairs = np.tile(times, m), np.repeat(reference.points, times.size, axis=0).T
        values = slab(pairs[0], pairs[1].reshape(d, -1)).reshape(exact.shape)
        errors = np.maximum(errors, np.abs(values - exact).max(axis=2))
    errors = np.where(np.isfinite(errors), errors, np.inf) / scale[:, None]
    at_corners = errors[:, 1 : 1 + corners].max(axis=1, initial=0.0)
    interior = np.maximum(errors[:, 0], errors[:, 1 + corners :].max(axis=1, initial=0.0))
    if d <= 3:
        interior = np.maximum(interior, at_corners)
    return Measured(
        tuple(interior.tolist()),
        tuple(at_corners.tolist()) if corners else (),
        m,
        "Radau" if reference.stiff else "DOP853",
    )


def _is_stiff(system: System, initial: Array, point: Array, start: float, end: float) -> bool:
    """Whether stability would force DOP853 to many more steps than accuracy needs."""

    def right_hand_side(t: float, y: Array) -> Array:
        return system.rhs(t, y, point)

    with np.errstate(all="ignore"):
        solution = scipy.integrate.solve_ivp(
            right_hand_side, (start, end), initial, method="LSODA", rtol=1e-4, atol=1e-10
        )
        times, states = solution.t, solution.y
        jacobians = system.jacobian(times, states, point[:, None])
        jacobians = np.moveaxis(np.broadcast_to(jacobians, (*jacobians.shape[:2], times.size)), 2, 0)
        finite = np.isfinite(jacobians).all(axis=(1, 2))
        damping = np.zeros(times.size)
        damping[finite] = np.maximum(-np.linalg.eigvals(jacobians[finite]).real.min(axis=1), 0.0)
    steps = float(np.sum(0.5 * (damping[1:] + damping[:-1]) * np.diff(times))) / 6.0
    return steps > _STIFF_STEPS


def _stacked_jacobian(system: System, parameters: Array, n: int, m: int) -> Any:
    """Block Jacobian of the stacked system in the order (state, point)."""
    rows = (np.arange(n)[:, None, None] * m + np.arange(m)) + np.zeros((n, n, m), dtype=int)
    columns = (np.arange(n)[None, :, None] * m + np.arange(m)) + np.zeros((n, n, m), dtype=int)
    shape = (n * m, n * m)

    def jacobian(t: float, y: Array) -> Any:
        blocks = np.broadcast_to(system.jacobian(t, y.reshape(n, m), parameters), (n, n, m))
        entries = (blocks.ravel(), (rows.ravel(), columns.ravel()))
        matrix = scipy.sparse.csc_matrix(entries, shape=shape)
        return matrix.toarray() if n * m <= _DENSE_STATES else matrix

    return jacobian
