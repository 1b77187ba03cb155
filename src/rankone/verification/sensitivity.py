"""How much an error made at one time has grown later: the amplification along a trajectory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.verification.reference import Reference

__all__ = ["amplification"]

_STEPS, _TRAJECTORIES = 32, 5
"""Steps over the horizon, and check points followed, the centre first."""
_BESIDE_POLE = 0.99
"""Factor on the rates where the Cayley transform does not exist for one of them."""


def amplification(
    system: System, reference: Reference, scale: Array, end: float
) -> Callable[[float], float]:
    """Largest later growth of an error made at time t, along a few trajectories.

    The variational equation ``w' = J(t) w`` is stepped on a uniform grid with the Cayley
    transform of the scaled Jacobian, which is stable for stiff systems.

    Parameters
    ----------
    reference : Reference
        Its first point is the centre of the box.
    scale : ndarray (n,)
        Size of each differential state; errors are in this unit.
    end : float
        End of the horizon considered.

    Returns
    -------
    callable
        ``amplification(t) >= 1``: the largest Frobenius norm, divided by sqrt(n), of the
        propagator from t to any later time.
    """
    n = system.n_differential
    width = (end - reference.start) / _STEPS
    middle = np.asarray(reference.start + width * (np.arange(_STEPS) + 0.5), dtype=float)
    points = reference.points[:_TRAJECTORIES]
    m = len(points)
    states = reference(middle)[:, :m]
    jacobian = system.jacobian(middle, states, points.T[:, :, None])
    jacobian = np.broadcast_to(jacobian, (n, n, m, _STEPS)).transpose(3, 2, 0, 1)
    half = 0.5 * width * jacobian * (scale[None, :] / scale[:, None])
    eye = np.eye(n)
    try:
        step = np.linalg.solve(eye - half, eye + half)
    except np.linalg.LinAlgError:  # a growth rate at a pole of the transform
        step = np.linalg.solve(eye - _BESIDE_POLE * half, eye + _BESIDE_POLE * half)
    largest = np.ones(_STEPS + 1)
    propagator = step
    for gap in range(1, _STEPS + 1):
        norms = np.sqrt(np.einsum("kmij,kmij->km", propagator, propagator).max(axis=1) / n)
        np.maximum(largest[: norms.size], norms, out=largest[: norms.size])
        if gap < _STEPS:
            propagator = np.matmul(step[gap:], propagator[:-1])
    grid = reference.start + width * np.arange(_STEPS + 1)
    return lambda t: float(np.interp(t, grid, largest))
