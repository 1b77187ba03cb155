"""Posterior distributions of parameters: by quadrature, or by a Markov chain beyond three."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rankone.estimation.cube_distributions import CubeDistribution, adapted, chain
from rankone.estimation.fit import Fit
from rankone.estimation.free_parameters import Bounds, ParameterValues
from rankone.estimation.least_squares import LeastSquares
from rankone.estimation.models import model_of
from rankone.estimation.observations import Measurements
from rankone.estimation.search import fit
from rankone.solution.core import SolutionCore
from rankone.statistics.distributions import Distribution, Measure, from_text
from rankone.statistics.joint_distribution import Distributions, by_name, measures_of
from rankone.statistics.over_box import checked_probabilities
from rankone.support.arrays import Array, spread
from rankone.support.errors import OptionError, with_remedy
from rankone.support.options import checked_count, checked_number
from rankone.support.wording import listing, quote

_MOST_STEPS = 10**6  # Most steps of a chain
# Most parameters for quadrature: the number of cells grows with its power
_MOST_QUADRATURE_PARAMETERS = 3
_ACCURATE = 1e-3  # Error of integrals up to which the quadrature counts as exact
# Change of the data by smaller ranks, in standard deviations of the noise: below notice
_UNNOTICED_CHANGE = 1e-4
_MODE_STARTS = 24  # Starts of searches for modes
# Depth below the best mode at which other modes are left out, in standard deviations
_MODE_DEPTH = 6.0
_DRAWN_POINTS = 400  # Random points around the modes that guide the first cells
# Distance from the ends of an interval, in widths: a density may be infinite there
_END_DISTANCE = 1e-9


@dataclass(frozen=True)
class LogPosterior:
    """Logarithm of the posterior density in the unit cube; ``measures`` are the priors.

    Gaussian noise; where its sigma is not known, it is integrated over with the density 1/sigma
    (Gelman et al., Bayesian Data Analysis, ch. 14.2).
    """

    problem: LeastSquares
    measures: tuple[Measure, ...]

    @property
    def unit(self) -> tuple[Array, Array]:
        """Lower bounds and widths of the parameters."""
        return self.problem.free.lower, self.problem.free.width

    def __call__(self, z: Array) -> Array:
        """Logarithms at z (N, n): shape (N,); minus infinity where the prior is zero."""
        residuals = self.problem.residuals(z)
        squares = np.einsum("km,km->k", residuals, residuals)
        logs = -0.5 * squares
        if not self.problem.observations.sigma_known:
            size = residuals.shape[1]
            logs = -0.5 * size * np.log(np.maximum(squares, 1e-300))
        points = self.problem.free.values(z)
        for column, measure in zip(points.T, self.measures, strict=True):
            if measure.distribution is not None:
                near = _END_DISTANCE * (measure.upper - measure.lower)
                at = np.clip(column, measure.lower + near, measure.upper - near)
                with np.errstate(divide="ignore"):
                    logs = logs + measure.distribution.logpdf(at)
        return np.where(np.isnan(logs), -math.inf, logs)


@dataclass(frozen=True, repr=False)
class Posterior:
    """The distribution of the parameters after the data are known.

    Attributes
    ----------
    fit : Fit
        The fit by least squares that the posterior starts from.
    method : {"quadrature", "mcmc"}
    log_evidence : float
        Logarithm of the integral of the likelihood over the prior, up to terms of the data and
        sigma alone; NaN for chains.
    success : bool
        Whether the integrals are exact to about 1e-3, or the chain is long enough.
    message : str
    """

    fit: Fit
    method: str
    log_evidence: float
    success: bool
    message: str
    _log_density: LogPosterior
    _distribution: CubeDistribution

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return self.fit.parameters

    @property
    def mean(self) -> dict[str, float]:
        """The mean of each parameter."""
        centre = self._distribution.masses @ self._distribution.nodes
        return self._log_density.problem.free.named(centre)

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters, (n, n)."""
        masses, nodes = self._distribution.masses, self._distribution.nodes
        centred = (nodes - masses @ nodes) * self._log_density.unit[1]
        return np.asarray((centred * masses[:, None]).T @ centred)

    @property
    def std(self) -> dict[str, float]:
        """The standard deviation of each parameter."""
        roots = np.sqrt(np.diag(self.covariance))
        return dict(zip(self.parameters, map(float, roots), strict=True))

    def quantile(self, q: ArrayLike) -> dict[str, float] | dict[str, Array]:
        """Quantiles of each parameter, numbers or arrays like ``q``.

        Raises
        ------
        OptionError
            If a probability is not in [0, 1].
        """
        shares = checked_probabilities(q)
        quantiles = self._quantiles(shares)
        if shares.ndim:
            return quantiles
        return {name: float(quantile) for name, quantile in quantiles.items()}

    def _quantiles(self, shares: Array) -> dict[str, Array]:
        lower, width = self._log_density.unit
        return {
            name: lower[j]
            + width[j] * self._distribution.quantile(j, shares.ravel()).reshape(shares.shape)
            for j, name in enumerate(self.parameters)
        }

    def interval(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """For each parameter the interval that leaves out equal tails."""
        level = checked_number("level", level, 0.0, 1.0, float)
        ends = self._quantiles(np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level]))
        return {name: (float(low), float(high)) for name, (low, high) in ends.items()}

    def density(self, parameter: object, values: ArrayLike) -> Array:
        """The marginal density of one parameter at values; zero outside its bounds."""
        j = self._log_density.problem.free.index(parameter)
        lower, width = self._log_density.unit
        z = (np.asarray(values, dtype=float) - lower[j]) / width[j]
        inside = (z >= 0.0) & (z <= 1.0)
        marginal = self._distribution.marginal(j, np.clip(z, 0.0, 1.0).ravel()).reshape(z.shape)
        return np.where(inside, marginal / width[j], 0.0)

    def sample(self, count: int, *, seed: int | None = None) -> dict[str, Array]:
        """Random values of all parameters, fixed ones as well, by name, (count,) each.

        ``solution(t=1.0, **posterior.sample(1000))`` are predictions.
        """
        count = checked_count("count", count, 0, 3 * len(self.fit._problem.free.order))
        seed = None if seed is None else checked_number("seed", seed, 0)
        generator = np.random.default_rng(seed)

        def density(z: Array) -> Array:
            return np.asarray(np.exp(self._log_density(z) - self.log_evidence))

        z = self._distribution.sample(count, density, generator)
        free = self.fit._problem.free
        return dict(zip(free.order, free.points(z), strict=True))

    def __repr__(self) -> str:
        lines = [f"Posterior of {', '.join(self.parameters)} by {self.method}"]
        ends, deviations = self.interval(), self.std
        for name, mean in self.mean.items():
            low, high = ends[name]
            spread = f"{mean:.6g} ± {deviations[name]:.2g}"
            lines.append(f"  {name}  {spread}, 95 % in [{low:.6g}, {high:.6g}]")
        lines.append(f"  {'success' if self.success else 'no success'}: {self.message}")
        return "\n".join(lines)


def posterior(
    self: SolutionCore,
    times: Measurements,
    data: Measurements,
    *,
    observe: object = None,
    sigma: Measurements | None = None,
    prior: Distributions = None,
    fixed: ParameterValues = None,
    bounds: Bounds = None,
    weights: Measurements | None = None,
    missing: str = "error",
    seed: int = 0,
    steps: int = 1000,
) -> Posterior:
    """The distribution of the parameters after the data are known, for Gaussian noise.

    Up to three free parameters are integrated on cells that are refined where the density is
    large. More take a Markov chain, which needs emcee.

    Parameters
    ----------
    times, data, observe, sigma, fixed, bounds, weights, missing
        As for :meth:`fit`. A sigma that is not given is integrated over, with the density
        1/sigma.
    prior : mapping, optional
        For parameters, by names or symbols, frozen continuous distributions of scipy.stats,
        cut at the bounds. Other parameters have the distribution of the problem, or a uniform
        one. Priors are independent, even if the problem has correlations.
    seed, steps : int
        Seed and number of steps of the Markov chain.

    Returns
    -------
    Posterior
        With ``mean``, ``std``, ``covariance``, ``quantile``, ``interval``, ``density`` and
        ``sample``.

    Raises
    ------
    OptionError, EvaluationError
        As for :meth:`fit`, and if a prior does not fit.
    RankoneError
        If emcee is needed and not installed.
    """
    priors = by_name("prior", prior, tuple(self.parameters))
    seed = checked_number("seed", seed, 0)
    steps = checked_number("steps", steps, 100, _MOST_STEPS)
    best = fit(
        self,
        times,
        data,
        observe=observe,
        sigma=sigma,
        weights=weights,
        fixed=fixed,
        bounds=bounds,
        missing=missing,
    )
    log_density = LogPosterior(_without_fixed(best), _priors(best, priors))
    likely, extents = _likely(best, log_density)
    names = [name for name, identified in best.identifiable.items() if not identified]
    limits = f"; the data do not identify {listing(names)} alone: box and prior limit them"
    boxed = limits if names else ""
    if len(log_density.measures) > _MOST_QUADRATURE_PARAMETERS:
        links = chain(log_density, likely, seed, steps)
        message = links.message + boxed
        return Posterior(best, "mcmc", math.nan, links.success, message, log_density, links)
    cells, evidence = adapted(log_density, likely, extents)
    success = cells.error <= _ACCURATE
    message = f"integrals are exact to about {cells.error:.1e}{boxed}"
    if not success:
        remedy = "restrict the box to where the density is, or fix parameters"
        message = with_remedy(message, remedy)
    return Posterior(best, "quadrature", evidence, success, message, log_density, cells)


def _priors(fit: Fit, prior: Mapping[str, Distribution]) -> tuple[Measure, ...]:
    """The prior of each free parameter, cut at its bounds: as given, of the problem, or uniform."""
    free = fit._problem.free
    for name in prior:
        if name in free.fixed:
            raise OptionError(f"{quote(name)} is fixed, and has a prior", term=name)
    box = [(float(a), float(b)) for a, b in zip(free.lower, free.upper, strict=True)]
    from_problem = {name: from_text(text) for name, text in fit.solution.metadata.distributions}
    return measures_of(free.names, box, prior, from_problem)


def _without_fixed(fit: Fit) -> LeastSquares:
    """The least squares of the free parameters alone, with ranks that the noise allows."""
    free, observations = fit._problem.free, fit.observations
    outcome = fit.solution.outcome
    for position in reversed(range(len(free.order))):
        if free.order[position] in free.fixed:
            outcome = outcome.fixed(position, free.fixed[free.order[position]])
    model = model_of(outcome, observations.rows, observations.times)
    unit = fit._unit if fit._unit > 0.0 else 1.0
    positions = tuple(range(len(free.names)))
    alone = replace(free, order=free.names, positions=positions, fixed={})
    thinned = model.thinned(observations.scale, _UNNOTICED_CHANGE * unit)
    return LeastSquares(thinned, observations, alone)


def _likely(fit: Fit, log_density: LogPosterior) -> tuple[Array, Array]:
    """Points where the posterior is large (k, n), and its extents there (n,), others held."""
    problem, n = log_density.problem, len(log_density.measures)
    generator = np.random.default_rng(11)
    unit = max(fit._unit, 1e-12) if math.isfinite(fit._unit) else 1.0
    minima = problem.minima(np.vstack([fit._z, spread(_MODE_STARTS, n, generator)]))
    good = minima.cost <= minima.cost.min() + _MODE_DEPTH**2 * unit**2
    near, extents = [], np.ones(n)
    for z, jacobian in zip(minima.z[good], minima.jacobian[good], strict=True):
        slopes = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
        extents = np.minimum(extents, unit / slopes)
        _, singular, right = np.linalg.svd(jacobian, full_matrices=False)
        root = right.T * np.minimum(unit / np.maximum(singular, 1e-12), 1.0)
        normal = generator.standard_normal((_DRAWN_POINTS // good.sum(), len(root.T)))
        near.append(z + normal @ root.T)
    wide = generator.random((8 * _DRAWN_POINTS, n))
    centres = [m.sample(np.array([0.01, 0.1, 0.5, 0.9, 0.99])) for m in log_density.measures]
    lower, width = log_density.unit
    prior = (np.array(centres).T - lower) / width
    points = np.vstack([minima.z[good], np.clip(np.vstack(near), 0.0, 1.0), prior, wide])
    logs = log_density(points)
    if not np.isfinite(logs.max()):
        raise OptionError("the prior has no probability where the data have any")
    likely = points[logs > logs.max() - 0.5 * (3.0**2 + n)]
    spreads = [_spread(m, z) for m, z in zip(log_density.measures, width, strict=True)]
    return likely, np.minimum(extents, np.array(spreads))


def _spread(measure: Measure, width: float) -> float:
    """Extent of a prior in the unit interval."""
    if measure.distribution is None:
        return 1.0
    low, high = measure.sample(np.array([0.16, 0.84]))
    return float(max(0.5 * (high - low) / width, 1e-12))
