"""The error measure of the reference problems, independent of everything generated.

256 random interior points of the box with a fixed seed, 21 equispaced times; for each unknown the
largest difference from the trajectory divided by the unknown's largest value. Trajectories are
SciPy's, at rtol 1e-11, for a right-hand side written by hand; all points are integrated together
as one stacked system.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.integrate
import scipy.sparse
from numpy.typing import NDArray

from rankone import Solution

__all__ = ["POINTS", "TIMES", "Independent", "measured_errors"]

Array = NDArray[np.float64]

POINTS, TIMES, SEED = 256, 21, 4711


@dataclass(frozen=True)
class Independent:
    """A system written by hand.

    Attributes
    ----------
    rhs : callable
        ``rhs(t, u, p)`` for u (n, m) and p (d, m): the derivatives, a sequence of n rows.
    initial : callable
        ``initial(p)``: a sequence of n initial values, each a number or a row.
    box : tuple of (float, float)
    end : float
        The end of the horizon.
    sizes : tuple of float
        Orders of magnitude of the unknowns, for the absolute tolerance of the trajectories.
    stiff : bool
    start : float
        The beginning of the horizon.
    """

    rhs: Callable[[float, Array, Array], list[Array]]
    initial: Callable[[Array], list[Array | float]]
    box: tuple[tuple[float, float], ...]
    end: float
    sizes: tuple[float, ...]
    stiff: bool = False
    start: float = 0.0


@cache
def _trajectories(system: Independent) -> tuple[Array, Array, Array]:
    """Parameters (d, m), times (T,) and states (n, m, T)."""
    lower, upper = np.array(system.box).T
    points = np.random.default_rng(SEED).uniform(lower, upper, (POINTS, lower.size)).T
    times = np.linspace(system.start, system.end, TIMES)
    start = np.stack([np.broadcast_to(value, POINTS) for value in system.initial(points)])
    start = start.astype(float)
    n = len(start)

    def stacked(t: float, y: Array) -> Array:
        rows = system.rhs(t, y.reshape(n, POINTS), points)
        return np.stack([np.broadcast_to(row, POINTS) for row in rows]).ravel()

    options: dict[str, object] = {"method": "DOP853"}
    if system.stiff:
        blocks = scipy.sparse.kron(np.ones((n, n)), scipy.sparse.eye(POINTS))
        options = {"method": "Radau", "jac_sparsity": blocks}
    result = scipy.integrate.solve_ivp(
        stacked,
        (system.start, system.end),
        start.ravel(),
        t_eval=times,
        rtol=1e-11,
        atol=np.repeat(1e-13 * np.array(system.sizes), POINTS),
        **options,
    )
    assert result.success, result.message
    return points, times, result.y.reshape(n, POINTS, TIMES)


def measured_errors(solution: Solution, system: Independent) -> Array:
    """Largest error of each unknown, relative to the unknown's size, shape (n,)."""
    points, times, exact = _trajectories(system)
    values = {name: row[:, None] for name, row in zip(solution.parameters, points, strict=True)} | {
        solution.metadata.time: times
    }
    differences = np.abs(solution(values) - exact)
    return np.asarray(differences.max(axis=(1, 2)) / np.abs(exact).max(axis=(1, 2)))
