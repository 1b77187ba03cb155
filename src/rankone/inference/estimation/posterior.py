"""Posterior distributions of parameters: by quadrature, or by a Markov chain beyond three."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from rankone.inference.estimation import estimates as results
from rankone.inference.estimation.cube_distributions import Chain, CubeDistribution, adapted, chain
from rankone.inference.estimation.experiments import trial_of
from rankone.inference.estimation.fit import Fit
from rankone.inference.estimation.free_parameters import FreeParameters
from rankone.inference.estimation.least_squares import minima_across_jumps
from rankone.inference.estimation.likelihood import Likelihood
from rankone.inference.estimation.observations import Measurements
from rankone.inference.estimation.search import fit
from rankone.solution.evaluation.core import SolutionCore
from rankone.solution.evaluation.domains import with_fixed
from rankone.solution.statistics.over_box import checked_probabilities
from rankone.support.arrays import (
    COARSE,
    COINCIDENT,
    NEGLIGIBLE,
    TINY,
    Array,
    Labelled,
    Table,
    Variables,
    spread,
)
from rankone.support.errors import OptionError, listing, quote, shown, with_remedy
from rankone.support.options import LEVEL, checked_count, checked_number, takes_options_of
from rankone.support.tasks import ExecutorLike, Shared, checked_executor, open_pool
from rankone.tensors.distributions import Distribution, Measure, from_text
from rankone.tensors.joint_distribution import Distributions, by_name, measures_of


@dataclass(frozen=True)
class PosteriorTuning:
    """Tuning of posteriors, and the largest numbers that they take."""

    most_steps: int = 10**6
    """Most steps of a chain."""
    most_chains: int = 1000
    """More chains than this are a mistake."""
    points_at_once: int = 8192
    """Points at which the density is evaluated at once, by one worker."""
    most_quadrature_parameters: int = 3
    """Most parameters for quadrature: the number of cells grows with its power."""
    accurate: float = COARSE
    """Error of integrals up to which the quadrature counts as exact."""
    unnoticed_change: float = 1e-4
    """Change of the data by smaller ranks, in standard deviations of the noise: below notice."""
    mode_starts: int = 24
    """Starts of searches for modes."""
    mode_depth: float = 6.0
    """Depth below the best mode at which other modes are left out, in standard deviations."""
    drawn_points: int = 400
    """Random points around the modes that guide the first cells."""


TUNING = PosteriorTuning()


@dataclass(frozen=True)
class LogPosterior:
    """Logarithm of the posterior density in the unit cube; ``measures`` are the priors.

    Where only the factor of all standard deviations is unknown, it is integrated over with the
    density 1/sigma (Gelman et al., Bayesian Data Analysis, ch. 14.2); levels of noise are
    parameters with that density.
    """

    problem: Likelihood
    measures: tuple[Measure, ...]

    def __call__(self, z: Array) -> Array:
        """Logarithms at z (N, n): shape (N,); minus infinity where the prior is zero."""
        _, costs = self.problem.costs(z)
        logs = -0.5 * costs
        if not self.problem.unit_known:
            logs = -0.5 * self.problem.size * np.log(np.maximum(costs, TINY))
        free = self.problem.free
        points, slopes = free.values(z), free.slopes(z)
        for j, measure in enumerate(self.measures):
            if measure.distribution is not None:
                near = NEGLIGIBLE * (measure.upper - measure.lower)
                at = np.clip(points[:, j], measure.lower + near, measure.upper - near)
                with np.errstate(divide="ignore"):
                    logs = logs + measure.distribution.logpdf(at)
            if free.logarithmic[j] and (measure.distribution is not None or j not in self.levels):
                logs = logs + np.log(slopes[:, j])
        return np.where(np.isnan(logs), -math.inf, logs)

    @property
    def levels(self) -> tuple[int, ...]:
        """Positions of the levels of noise, whose prior is uniform in their logarithm."""
        return self.problem.levels


@dataclass(frozen=True, repr=False)
class Posterior(Labelled):
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
        centre = self._distribution.masses @ self._points
        return dict(zip(self.parameters, map(float, centre), strict=True))

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters, (n, n)."""
        masses, points = self._distribution.masses, self._points
        centred = points - masses @ points
        return np.asarray((centred * masses[:, None]).T @ centred)

    @property
    def _free(self) -> FreeParameters:
        return self._log_density.problem.free

    @property
    def _points(self) -> Array:
        """Values of the parameters at the nodes (k, n)."""
        return self._free.values(self._distribution.nodes)

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
        columns = [
            self._distribution.quantile(j, shares.ravel()) for j in range(len(self.parameters))
        ]
        values = self._free.values(np.stack(columns, axis=-1))
        rows = values.T.reshape(len(columns), *shares.shape)
        return dict(zip(self.parameters, rows, strict=True))

    def interval(self, level: float = LEVEL) -> dict[str, tuple[float, float]]:
        """For each parameter the interval that leaves out equal tails."""
        level = checked_number("level", level, 0.0, 1.0, float)
        ends = self._quantiles(np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level]))
        return {name: (float(low), float(high)) for name, (low, high) in ends.items()}

    def density(self, parameter: object, values: ArrayLike) -> Array:
        """The marginal density of one parameter at values; zero outside its bounds."""
        j, points = self._free.index(parameter), np.asarray(values, dtype=float)
        inside = (points >= self._free.lower[j]) & (points <= self._free.upper[j])
        every = np.tile(self._free.lower, (points.size, 1))
        every[:, j] = np.where(inside, points, self._free.lower[j]).ravel()
        z = np.clip(self._free.places(every), 0.0, 1.0)
        marginal = self._distribution.marginal(j, z[:, j]) / self._free.slopes(z)[:, j]
        return np.where(inside, marginal.reshape(points.shape), 0.0)

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
        return dict(zip(self._free.order, self._free.points(z), strict=True))

    def _table(self) -> Table:
        ends, deviations = self.interval(), self.std
        rows = []
        for name, mean in self.mean.items():
            ends_of = results.interval_text(ends[name])
            rows.append([name, f"{mean:.6g}", f"{deviations[name]:.2g}", ends_of])
        return Table(
            f"Posterior of {', '.join(self.parameters)} by {self.method}",
            ["parameter", "mean", "std", "95 % interval"],
            rows,
            [results.verdict(self)],
        )

    def _variables(self) -> Variables:
        """Means with deviations and intervals, and the covariance."""
        low, high = np.array(list(self.interval().values())).T
        columns = {
            "mean": list(self.mean.values()),
            "std": list(self.std.values()),
            "lower": low,
            "upper": high,
        }
        return results.by_parameter(columns, self.parameters, self.covariance)


@takes_options_of(fit)
def posterior(
    self: SolutionCore,
    times: object,
    data: Measurements | None = None,
    *,
    prior: Distributions = None,
    seed: int = 0,
    steps: int = 1000,
    chains: int = 1,
    executor: ExecutorLike | None = None,
    **options: Any,
) -> Posterior:
    """The distribution of the parameters after the data are known, for any kind of noise.

    Up to three free parameters are integrated on cells that are refined where the density is
    large. More take Markov chains, which need emcee.

    Parameters
    ----------
    times, data, **options
        As for :meth:`fit`. A sigma that is not given, and levels of noise, are integrated over
        with the density 1/sigma.
    prior : mapping, optional
        For parameters, by names or symbols, frozen continuous distributions of scipy.stats,
        cut at the bounds. Other parameters have the distribution of the problem, or a uniform
        one. Priors are independent, even if the problem has correlations.
    seed, steps : int
        Seed and number of steps of the Markov chain.
    chains : int
        Number of Markov chains that know nothing of each other; it is not a success if they differ.
        The first one is that of a single chain.
    executor : int, concurrent.futures.Executor, distributed.Client or str, optional
        Where chains, and the density at the nodes of cells, are computed: as in
        :func:`rankone.solve_many`. The bits are the same as without.

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
    seed = checked_number("seed", seed, 0)
    steps = checked_number("steps", steps, 100, TUNING.most_steps)
    chains = checked_number("chains", chains, 1, TUNING.most_chains)
    best = fit(self, times, data, **options)
    return posterior_of(best, prior, seed=seed, steps=steps, chains=chains, executor=executor)


def posterior_of(
    fit: Fit,
    prior: Distributions = None,
    *,
    seed: int = 0,
    steps: int = 1000,
    chains: int = 1,
    executor: ExecutorLike | None = None,
) -> Posterior:
    """The distribution of the parameters of any fit, also of several experiments.

    Parameters
    ----------
    fit : Fit
    prior, seed, steps, chains, executor
        As for :meth:`Solution.posterior`.
    """
    if not isinstance(fit, Fit):
        raise OptionError(f"{shown(fit)} is not a Fit", term=fit, remedy="give what a fit returned")
    seed = checked_number("seed", seed, 0)
    steps = checked_number("steps", steps, 100, TUNING.most_steps)
    chains = checked_number("chains", chains, 1, TUNING.most_chains)
    wanted = None if executor is None else checked_executor("executor", executor)
    priors = by_name("prior", prior, fit._problem.free.order)
    log_density = LogPosterior(_without_fixed(fit), _priors(fit, priors))
    likely, extents = _likely(fit, log_density)
    names = [name for name, identified in fit.identifiable.items() if not identified]
    limits = f"; the data do not identify {listing(names)} alone: box and prior limit them"
    boxed = limits if names else ""
    with nullcontext() if wanted is None else open_pool(wanted) as pool:
        shared = Shared("the posterior density", log_density, pool)
        if len(log_density.measures) > TUNING.most_quadrature_parameters:
            seeds = [seed, *np.random.SeedSequence(seed).generate_state(chains - 1).tolist()]
            tasks = [(likely, each, steps) for each in seeds]
            links = Chain.of(shared.map(chain, tasks))
            message = links.message + boxed
            return Posterior(fit, "mcmc", math.nan, links.success, message, log_density, links)

        def logs(z: Array) -> Array:
            blocks = np.array_split(z, len(z) // TUNING.points_at_once + 1)
            return np.concatenate(shared.map(LogPosterior.__call__, [(each,) for each in blocks]))

        cells, evidence = adapted(logs, likely, extents)
    success = bool(cells.error <= TUNING.accurate)
    message = f"integrals are exact to about {cells.error:.1e}{boxed}"
    if not success:
        remedy = "restrict the box to where the density is, or fix parameters"
        message = with_remedy(message, remedy)
    return Posterior(fit, "quadrature", evidence, success, message, log_density, cells)


def _priors(fit: Fit, prior: Mapping[str, Distribution]) -> tuple[Measure, ...]:
    """The prior of each free parameter, cut at its bounds.

    It is the one given, that of the fit, that of the problem, or uniform.
    """
    free = fit._problem.free
    for name in prior:
        if name in free.fixed:
            raise OptionError(f"{quote(name)} is fixed, and has a prior", term=name)
    box = [(float(a), float(b)) for a, b in zip(free.lower, free.upper, strict=True)]
    solutions = (trial.solution for trial in fit.trials)
    from_problem = {
        name: from_text(text) for each in solutions for name, text in each.metadata.distributions
    }
    informed = (each for each in fit._problem.priors if isinstance(each, Measure))
    of_fit = {each.name: each for each in informed if each.name not in prior}
    measures = measures_of(free.names, box, prior, from_problem)
    return tuple(of_fit.get(each.name, each) for each in measures)


def _without_fixed(fit: Fit) -> Likelihood:
    """The likelihood with solutions of the free parameters alone, and ranks that the noise allows.

    Ranks stay as they are where an expression of the unknowns was measured.
    """
    trials = []
    for trial, noise in zip(fit.trials, fit.deviations, strict=True):
        solution = trial.solution
        held = {**fit.fixed, **trial.fixed}
        held = {name: x for name, x in held.items() if name in solution.parameters}
        if held:
            solution = SolutionCore(*with_fixed(solution.outcome, solution.metadata, held))
        data = trial.observations, trial.doses, trial.places
        alone = trial_of(trial.name, solution, trial.fixed, *data)
        plain = all(formula.is_name for formula in trial.observations.formulas)
        if plain and alone.rows == tuple((f.names[0],) for f in trial.observations.formulas):
            scale = np.divide(1.0, noise, out=np.ones(noise.size), where=noise > 0.0)
            model = alone.model.thinned(scale, TUNING.unnoticed_change)
            alone = replace(alone, model=model)
        trials.append(alone)
    return replace(fit._problem, trials=tuple(trials), priors=())


def _likely(fit: Fit, log_density: LogPosterior) -> tuple[Array, Array]:
    """Points where the posterior is large (k, n), and its extents there (n,), others held."""
    problem, n = log_density.problem, len(log_density.measures)
    generator = np.random.default_rng(11)
    unit = max(fit._unit, COINCIDENT) if math.isfinite(fit._unit) else 1.0
    starts = np.vstack([fit._best.z, spread(TUNING.mode_starts, n, generator)])
    minima = minima_across_jumps(problem, starts)
    good = minima.cost <= minima.cost.min() + TUNING.mode_depth**2 * unit**2
    near, extents = [], np.ones(n)
    for z, jacobian in zip(minima.z[good], minima.jacobian[good], strict=True):
        slopes = np.maximum(np.linalg.norm(jacobian, axis=0), COINCIDENT)
        extents = np.minimum(extents, unit / slopes)
        _, singular, right = np.linalg.svd(jacobian, full_matrices=False)
        root = right.T * np.minimum(unit / np.maximum(singular, COINCIDENT), 1.0)
        normal = generator.standard_normal((TUNING.drawn_points // good.sum(), len(root.T)))
        near.append(z + normal @ root.T)
    wide = generator.random((8 * TUNING.drawn_points, n))
    centres = [m.sample(ndtr(np.arange(-2.0, 3.0))) for m in log_density.measures]
    prior = problem.free.places(np.array(centres).T)
    points = np.vstack([minima.z[good], np.clip(np.vstack(near), 0.0, 1.0), prior, wide])
    logs = log_density(points)
    if not np.isfinite(logs.max()):
        raise OptionError("the prior has no probability where the data have any")
    likely = points[logs > logs.max() - 0.5 * (3.0**2 + n)]
    return likely, np.minimum(extents, _spreads(log_density.measures, problem.free))


def _spreads(measures: tuple[Measure, ...], free: FreeParameters) -> Array:
    """Extents of the priors in the unit cube (n,)."""
    ends = np.array([measure.sample(ndtr([-1.0, 1.0])) for measure in measures]).T
    low, high = free.places(ends)
    informed = np.array([measure.distribution is not None for measure in measures])
    return np.where(informed, np.maximum(0.5 * (high - low), COINCIDENT), 1.0)
