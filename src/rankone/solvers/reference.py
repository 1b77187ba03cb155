"""Reference trajectories at single parameter points: the yardstick every solve is held against.

All points are integrated together as one stacked system by SciPy, with the generated pointwise
right-hand side: DOP853, or Radau where the centre trajectory is stiff.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.integrate
import scipy.sparse

from rankone.errors import ConvergenceError
from rankone.solvers.outcome import Measured
from rankone.system import Array, System
from rankone.tensors.slab import SlabTrain

__all__ = ["Reference", "check_points", "initial_values", "integrate_reference", "measure"]

_PROBE_STEPS = 100
"""DOP853 steps after which it is asked whether stability limits the step."""
_STIFF_PRODUCT = 3.0
"""Step times decay rate above which it does (the stability interval is about 6)."""
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
    tolerances = {"rtol": rtol, "atol": rtol * 1e-7 * (size if size > 0 else 1.0)}
    with np.errstate(all="ignore"):
        trajectory = _explicit(right_hand_side, initial, start, end, tolerances, system, parameters)
        stiff = trajectory is None
        if trajectory is None:
            result = scipy.integrate.solve_ivp(
                right_hand_side,
                (start, end),
                initial.ravel(),
                method="Radau",
                jac=_stacked_jacobian(system, parameters, n, m),
                dense_output=True,
                **tolerances,
            )
            trajectory = result.sol, result.y[:, -1], result.status == 0
    dense, last, finished = trajectory
    blown = None
    if not finished:
        growth = np.abs(last.reshape(n, m)) / np.maximum(np.abs(initial), size + 1e-300)
        blown = int(np.argmax(np.nan_to_num(growth, nan=np.inf).max(axis=0)))
    return Reference(points, start, float(dense.t_max), stiff, blown, dense, n)


def _explicit(
    right_hand_side: Callable[[float, Array], Array],
    initial: Array,
    start: float,
    end: float,
    tolerances: dict[str, float],
    system: System,
    parameters: Array,
) -> tuple[Any, Array, bool] | None:
    """Integrate with DOP853: dense output, last state, whether the end was reached.

    None when the system turns out to be stiff: when stability limits the step.
    """
    n, m = initial.shape
    solver = scipy.integrate.DOP853(right_hand_side, start, initial.ravel(), end, **tolerances)
    times, pieces = [start], []
    while solver.status == "running":
        solver.step()
        if solver.status == "failed":
            break
        times.append(solver.t)
        pieces.append(solver.dense_output())
        if len(pieces) % _PROBE_STEPS == 0:
            jacobian = system.jacobian(solver.t, solver.y.reshape(n, m), parameters)
            blocks = np.moveaxis(np.broadcast_to(jacobian, (n, n, m)), 2, 0)
            if np.isfinite(blocks).all():
                decay = -np.linalg.eigvals(blocks).real.min()
                if decay * solver.step_size > _STIFF_PRODUCT:
                    return None
    finished = solver.status == "finished"
    if not pieces:
        raise ConvergenceError(
            f"no trajectory can be integrated from t = {start:g}: the right-hand side is not "
            "finite there or varies without bound",
            remedy="check the initial values and the coefficients",
        )
    return scipy.integrate.OdeSolution(times, pieces), solver.y, finished


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
        values = slab(*pairs).reshape(exact.shape)
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
