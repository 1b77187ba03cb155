"""Parameters of a solution from data, by weighted least squares."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rankone.estimation.fit import Fit, checked_level, quantile_of
from rankone.estimation.free import Free, free_parameters
from rankone.estimation.identification import identify
from rankone.estimation.least_squares import LeastSquares, Minima
from rankone.estimation.model import TrainModel
from rankone.estimation.observations import Observations, observed
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.budget import NORMAL, operations_for
from rankone.support.errors import OptionError
from rankone.support.options import checked_number
from rankone.support.spread import spread
from rankone.support.wording import count, listing

__all__ = ["fit"]

_LOOKED_AT, _MOST_POINTS, _MOST_STARTS = 128, 2**15, 128
"""Points of the box among which the starts are chosen, the most of them and of starts, whatever the
effort."""
_APART = 1e-2
"""Distance in the cube from which minima are different ones."""
_AS_GOOD = 1e-3
"""Share of the mean square by which minima count as equally good."""


def fit(
    solution: SolutionCore,
    times: Any,
    data: Any,
    *,
    observe: Any = None,
    sigma: Any = None,
    weights: Any = None,
    fixed: Mapping[Any, Any] | None = None,
    start: Mapping[Any, Any] | None = None,
    bounds: Mapping[Any, Any] | None = None,
    starts: int = 4,
    effort: str | float = "normal",
    level: float = 0.95,
    missing: str = "error",
) -> Fit:
    """Fit parameters to data; parameters and errors are those of :meth:`~rankone.Solution.fit`."""
    solution._evaluator  # noqa: B018 - raises if nothing was solved
    free = free_parameters(solution, fixed, bounds, start)
    seen = observed(solution, times, data, observe, sigma=sigma, weights=weights, missing=missing)
    level = checked_level(level)
    starts = checked_number("starts", starts, 0 if start is not None else 1, _LOOKED_AT)
    factor = operations_for(effort) / NORMAL
    starts = min(math.ceil(factor * starts), _MOST_STARTS)
    looked_at = max(min(math.ceil(factor * _LOOKED_AT), _MOST_POINTS), starts, 1)
    _enough(seen, free)
    problem = LeastSquares(TrainModel(solution.outcome.slabs, seen.rows, seen.times), seen, free)
    residuals, from_where = _starts(problem, starts, looked_at)
    minima = problem.minima(from_where)
    k = _chosen(minima)
    z, cost, jacobian = minima.z[k], float(minima.cost[k]), minima.jacobian[k]
    dof = max(seen.size - len(free.names), 1)
    unit = 1.0 if seen.known else math.sqrt(cost / dof)
    q = quantile_of(level, seen.known, dof)
    known = identify(problem, z, cost, jacobian, q, unit)
    values = np.abs(residuals / seen.scale + seen.values)
    largest = values.max(axis=0)
    size = np.array([largest[seen.owner == i].max() for i in range(len(seen.names))])[seen.owner]
    return Fit(
        solution,
        seen,
        level,
        cost,
        bool(minima.converged[k]),
        problem,
        z,
        minima.residuals[k],
        known,
        _others(problem, minima, k, (q * unit) ** 2) if not known.flat else (),
        size,
    )


def _others(
    problem: LeastSquares, minima: Minima, k: int, limit: float
) -> tuple[dict[str, float], ...]:
    """Minima apart from the chosen one whose costs are within a limit of it."""
    chosen = [minima.z[k]]
    for z, cost, ended in zip(minima.z, minima.cost, minima.converged, strict=True):
        apart = all(np.abs(z - other).max() > _APART for other in chosen)
        if ended and apart and cost <= minima.cost[k] + max(limit, 1e-9 * minima.cost[k]):
            chosen.append(z)
    return tuple(problem.free.named(z) for z in chosen[1:])


def _enough(seen: Observations, free: Free) -> None:
    """An error for fewer data than parameters."""
    least = len(free.names) if seen.known else len(free.names) + 1
    if seen.size < least:
        spread_too = "" if seen.known else " and sigma"
        raise OptionError(
            f"there are {count(seen.size, 'value')} for {count(len(free.names), 'parameter')}"
            f"{spread_too}: {listing(free.names)}",
            remedy="measure more, or fix parameters: fixed={name: value}"
            + ("" if seen.known else "; or give sigma"),
        )


def _starts(problem: LeastSquares, number: int, looked_at: int) -> tuple[Array, Array]:
    """Residuals (N, m) at points all over the cube, and the best of them that are apart (k, n)."""
    n = len(problem.free.names)
    points = spread(looked_at, n, np.random.default_rng(7))
    points[0] = 0.5
    residuals = problem.residuals(points)
    order = np.argsort(np.einsum("km,km->k", residuals, residuals))
    chosen: list[Array] = [] if problem.free.start is None else [problem.free.start]
    apart = 0.5 * number ** (-1.0 / n) if number else 0.0
    wanted = len(chosen) + number
    for point in points[order]:
        if len(chosen) == wanted:
            break
        if all(np.abs(point - other).max() >= apart for other in chosen):
            chosen.append(point)
    return residuals, np.array(chosen)


def _chosen(minima: Minima) -> int:
    """The best minimum; of those that are as good, the one farthest from the bounds."""
    mean = minima.cost.min() / minima.residuals.shape[1]
    good = np.flatnonzero(minima.cost <= minima.cost.min() + _AS_GOOD * mean)
    inside = np.minimum(minima.z[good], 1.0 - minima.z[good]).min(axis=1)
    apart = np.abs(minima.z[good] - minima.z[minima.cost.argmin()]).max(axis=1)
    if apart.max() <= 1e-3:
        return int(minima.cost.argmin())
    return int(good[np.argmax(inside)])
