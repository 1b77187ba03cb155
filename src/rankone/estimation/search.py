"""Parameters of a solution from data, by weighted least squares."""

from __future__ import annotations

import math

import numpy as np

from rankone.estimation.fit import Fit, checked_level, quantile_of
from rankone.estimation.free_parameters import (
    Bounds,
    FreeParameters,
    ParameterValues,
    free_parameters,
)
from rankone.estimation.identification import identify
from rankone.estimation.least_squares import LeastSquares, Minima, squares_of
from rankone.estimation.models import model_of
from rankone.estimation.observations import Measurements, Observations, observed
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array, spread
from rankone.support.budget import NORMAL, operations_for
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.options import checked_number
from rankone.support.wording import count, listing

_SCREENED_POINTS = 128  # Points of the box among which the starts are chosen, for normal effort
_MOST_SCREENED_POINTS = 2**15  # Most of these points, whatever the effort
_MOST_STARTS = 128  # Most starts, whatever the effort
_DISTINCT_DISTANCE = 1e-2  # Distance in the cube above which minima are different ones
_EQUAL_COST_SHARE = 1e-3  # Difference of costs, in shares of the mean square, that counts as none
_SAME_DISTANCE = 1e-3  # Distance in the cube below which minima are the same


def fit(
    self: SolutionCore,
    times: Measurements,
    data: Measurements,
    *,
    observe: object = None,
    sigma: Measurements | None = None,
    weights: Measurements | None = None,
    fixed: ParameterValues = None,
    start: ParameterValues = None,
    bounds: Bounds = None,
    starts: int = 4,
    effort: str | float = "normal",
    level: float = 0.95,
    missing: str = "error",
) -> Fit:
    """Parameters from data, by weighted least squares with exact derivatives.

    Parameters
    ----------
    times : array_like (times,) or mapping
        Times of the measurements; a time may occur more than once. A mapping from outputs
        gives each its own times.
    data : array_like (times,) or (outputs, times), or mapping
        Measurements of one output, of several, or of each by name.
    observe : name, symbol or list of them, optional
        The measured unknowns, or derivatives that are states. By default the names of the
        data, or all unknowns.
    sigma : float or array_like, optional
        Standard deviation of the noise: one number, one for each output, or one for each
        datum. Without it, one for all data is estimated from the residuals.
    weights : array_like, optional
        Factors of the squares in place of sigma, in the same shapes: one over the variance up
        to a common factor, which is estimated.
    fixed : mapping, optional
        Values of known parameters, by names or symbols.
    start : mapping, optional
        Values of some parameters to start from; the others start in the middle.
    bounds : mapping, optional
        Intervals of some parameters inside the box; by default the box.
    starts : int
        Number of further starts, the best of a sample all over the box.
    effort : {"low", "normal", "high"} or float
        Factor on the numbers of points and starts: 0.2, 1, 10 or any other.
    level : float
        Probability of the intervals.
    missing : {"error", "drop"}
        Whether NaN among the data is an error, or left out.

    Returns
    -------
    Fit
        With the estimates ``x``, ``covariance``, ``interval()``, ``residuals``,
        ``identifiable``, ``success`` and ``message``. It is a success if the search converged
        inside the bounds, every parameter is identified, the residuals are not far above
        sigma, and the error of the solution is small beside the noise.

    Raises
    ------
    OptionError
        If shapes do not fit, data are NaN, free parameters outnumber the data, sigma is not
        positive, a name is unknown, all parameters are fixed or a start is outside its bounds.
    EvaluationError
        If a time is outside the horizon, or a value outside the box; or if an event ends the
        solution before the last of the data at all points that are tried.
    """
    self._evaluator  # noqa: B018 - raises if nothing was solved
    free = free_parameters(self, fixed, bounds, start)
    observations = observed(
        self, times, data, observe, sigma=sigma, weights=weights, missing=missing
    )
    level = checked_level(level)
    starts = checked_number("starts", starts, 0 if start is not None else 1, _SCREENED_POINTS)
    factor = operations_for(effort) / NORMAL
    starts = min(math.ceil(factor * starts), _MOST_STARTS)
    screened = min(math.ceil(factor * _SCREENED_POINTS), _MOST_SCREENED_POINTS)
    _check_size(observations, free)
    model = model_of(self.outcome, observations.rows, observations.times)
    problem = LeastSquares(model, observations, free)
    residuals, first = _starts(problem, starts, max(screened, starts, 1))
    minima = problem.minima(first)
    k = _chosen(minima)
    z, cost, jacobian = minima.z[k], float(minima.cost[k]), minima.jacobian[k]
    dof = max(observations.size - len(free.names), 1)
    unit = 1.0 if observations.sigma_known else math.sqrt(cost / dof)
    q = quantile_of(level, observations.sigma_known, dof)
    identification = identify(problem, z, cost, jacobian, q, unit)
    distinct = () if identification.flat else _others(problem, minima, k, (q * unit) ** 2)
    tried = residuals[np.isfinite(residuals).all(axis=1)]
    largest = np.abs(tried / observations.scale + observations.values).max(axis=0)
    outputs = range(len(observations.names))
    sizes = np.array([largest[observations.owner == i].max() for i in outputs])
    return Fit(
        self,
        observations,
        level,
        cost,
        bool(minima.converged[k]),
        problem,
        z,
        minima.residuals[k],
        identification,
        distinct,
        sizes[observations.owner],
    )


def _others(
    problem: LeastSquares, minima: Minima, k: int, limit: float
) -> tuple[dict[str, float], ...]:
    """Minima apart from the chosen one whose costs are within a limit of it."""
    chosen = [minima.z[k]]
    for z, cost, ended in zip(minima.z, minima.cost, minima.converged, strict=True):
        apart = all(np.abs(z - minimum).max() > _DISTINCT_DISTANCE for minimum in chosen)
        if ended and apart and cost <= minima.cost[k] + max(limit, 1e-9 * minima.cost[k]):
            chosen.append(z)
    return tuple(problem.free.named(z) for z in chosen[1:])


def _check_size(observations: Observations, free: FreeParameters) -> None:
    """Raise an OptionError if there are fewer data than parameters."""
    free_sigma = not observations.sigma_known
    if observations.size < len(free.names) + free_sigma:
        raise OptionError(
            f"there are {count(observations.size, 'value')} for "
            f"{count(len(free.names), 'parameter')}{' and sigma' if free_sigma else ''}: "
            f"{listing(free.names)}",
            remedy="measure more, or fix parameters: fixed={name: value}"
            + ("; or give sigma" if free_sigma else ""),
        )


def _starts(problem: LeastSquares, starts: int, screened: int) -> tuple[Array, Array]:
    """Residuals (N, m) at points all over the cube, and the best of them that are apart (k, n)."""
    n = len(problem.free.names)
    points = spread(screened, n, np.random.default_rng(7))
    points[0] = 0.5
    residuals = problem.residuals(points)
    squares = squares_of(residuals)
    if not np.isfinite(squares).any():
        raise EvaluationError(
            "the solution ends before the last of the data, wherever it was tried",
            remedy="leave out later data, or restrict the solution to parameters where it goes on",
        )
    order = np.argsort(squares)[: np.isfinite(squares).sum()]
    chosen: list[Array] = [] if problem.free.start is None else [problem.free.start]
    apart = 0.5 * starts ** (-1.0 / n) if starts else 0.0
    most = len(chosen) + starts
    for point in points[order]:
        if len(chosen) == most:
            break
        if all(np.abs(point - start).max() >= apart for start in chosen):
            chosen.append(point)
    return residuals, np.array(chosen)


def _chosen(minima: Minima) -> int:
    """The best minimum; among equally good ones the farthest from the bounds."""
    mean = minima.cost.min() / minima.residuals.shape[1]
    good = np.flatnonzero(minima.cost <= minima.cost.min() + _EQUAL_COST_SHARE * mean)
    inside = np.minimum(minima.z[good], 1.0 - minima.z[good]).min(axis=1)
    apart = np.abs(minima.z[good] - minima.z[minima.cost.argmin()]).max(axis=1)
    if apart.max() <= _SAME_DISTANCE:
        return int(minima.cost.argmin())
    return int(good[np.argmax(inside)])
