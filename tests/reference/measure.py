"""The error measure of the reference problems, independent of everything generated.

256 random interior points of the box with a fixed seed, 21 equispaced times; for each unknown the
largest difference from the trajectory divided by the unknown's largest value. Trajectories are
SciPy's, at rtol 1e-11, for a right-hand side written by hand; all points are integrated together
as one stacked system.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import scipy.integrate
import scipy.sparse
from numpy.typing import NDArray

from rankone import Solution

__all__ = ["POINTS", "TIMES", "Independent", "measured_errors", "trajectories"]

Array = NDArray[np.float64]

POINTS, TIMES, SEED = 256, 21, 4711


@dataclass(frozen=True, eq=False)
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
    jumps : mapping of float to callable
        Times at which the states u (n, m) become ``jump(u, p)``; none at the start.
    """

    rhs: Callable[[float, Array, Array], list[Array]]
    initial: Callable[[Array], list[Array | float]]
    box: tuple[tuple[float, float], ...]
    end: float
    sizes: tuple[float, ...]
    stiff: bool = False
    start: float = 0.0
    jumps: Mapping[float, Callable[[Array, Array], list[Array]]] = field(default_factory=dict)


@cache
def trajectories(
    system: Independent, count: int = POINTS, rtol: float = 1e-11
) -> tuple[Array, Array, Array]:
    """Random parameters (d, count), times (T,) and states (n, count, T)."""
    lower, upper = np.array(system.box).T
    points = np.random.default_rng(SEED).uniform(lower, upper, (count, lower.size)).T
    times = np.linspace(system.start, system.end, TIMES)
    start = np.stack([np.broadcast_to(value, count) for value in system.initial(points)])
    start = start.astype(float)
    n = len(start)

    def stacked(t: float, y: Array) -> Array:
        rows = system.rhs(t, y.reshape(n, count), points)
        return np.stack([np.broadcast_to(row, count) for row in rows]).ravel()

    options: dict[str, object] = {"method": "DOP853"}
    if system.stiff:
        blocks = scipy.sparse.kron(np.ones((n, n)), scipy.sparse.eye(count))
        options = {"method": "Radau", "jac_sparsity": blocks}
    found = np.empty((TIMES, start.size))
    state, edges = start.ravel(), [system.start, *sorted(system.jumps), system.end]
    for a, b in itertools.pairwise(edges):
        if a in system.jumps:
            state = np.stack(system.jumps[a](state.reshape(n, count), points)).ravel()
        inside = (times >= a) & ((times < b) | (b == system.end))
        result = scipy.integrate.solve_ivp(
            stacked,
            (a, b),
            state,
            t_eval=[*times[inside], *([] if b == system.end else [b])],
            rtol=rtol,
            atol=np.repeat(0.01 * rtol * np.array(system.sizes), count),
            **options,
        )
        assert result.success, result.message
        state = result.y[:, -1]
        found[inside] = result.y.T[: np.count_nonzero(inside)]
    return points, times, found.T.reshape(n, count, TIMES)


def measured_errors(
    solution: Solution, system: Independent, count: int = POINTS, rtol: float = 1e-11
) -> Array:
    """Largest error of each unknown at random points, relative to the unknown's size: (n,)."""
    points, times, exact = trajectories(system, count, rtol)
    values = {name: row[:, None] for name, row in zip(solution.parameters, points, strict=True)} | {
        solution.metadata.time: times
    }
    exact = exact[: len(solution.unknowns)]  # states that are derivatives come after them
    differences = np.abs(solution(values) - exact)
    return np.asarray(differences.max(axis=(1, 2)) / np.abs(exact).max(axis=(1, 2)))
