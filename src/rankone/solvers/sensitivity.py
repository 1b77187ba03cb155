"""How much an error made at one time has grown later: the amplification along a trajectory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rankone.solvers.reference import Reference
from rankone.system import Array, System

__all__ = ["amplification"]


def amplification(
    system: System, reference: Reference, scale: Array, steps: int = 64
) -> Callable[[float], float]:
    """Largest later growth of an error made at time t, along the trajectory at the box centre.

    The variational equation ``w' = J(t) w`` is stepped on a uniform grid with the Cayley
    transform of the scaled Jacobian, which is stable for stiff systems.

    Parameters
    ----------
    system : System
    reference : Reference
        Its first point is the centre.
    scale : ndarray (n,)
        Size of each differential state; errors are in this unit.
    steps : int
        Number of steps over the horizon.

    Returns
    -------
    callable
        ``amplification(t) >= 1``, the largest 2-norm of the propagator from t to any later time.
    """
    n = system.N_DIFFERENTIAL
    width = (reference.end - reference.start) / steps
    middle = reference.start + width * (np.arange(steps) + 0.5)
    centre = reference.points[0]
    jacobian = system.jacobian(middle, reference(middle)[:, 0], centre[:, None])
    jacobian = np.moveaxis(np.broadcast_to(jacobian, (n, n, steps)), 2, 0)
    half = 0.5 * width * jacobian * (scale[None, None, :] / scale[None, :, None])
    eye = np.eye(n)
    step = np.linalg.solve(eye - half, eye + half)
    largest = np.ones(steps + 1)
    propagator = step.copy()
    for gap in range(1, steps + 1):
        norms = np.linalg.norm(propagator, axis=(1, 2), ord=2 if n <= 12 else "fro")
        np.maximum(largest[: norms.size], norms, out=largest[: norms.size])
        if gap < steps:
            propagator = np.matmul(step[gap:], propagator[:-1])
    grid = reference.start + width * np.arange(steps + 1)

    def growth(t: float) -> float:
        return float(np.interp(t, grid, largest))

    return growth
