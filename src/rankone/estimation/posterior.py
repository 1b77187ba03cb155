"""Posterior distributions of parameters: by quadrature, or by a Markov chain beyond three."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.estimation.cells import Cells, adapted
from rankone.estimation.chains import chain
from rankone.estimation.fit import Fit
from rankone.estimation.least_squares import LeastSquares
from rankone.estimation.likelihood import Posterity, priors
from rankone.estimation.model import TrainModel
from rankone.estimation.search import fit
from rankone.solution.core import SolutionCore
from rankone.statistics.distributions import from_text
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.options import checked_count, checked_number
from rankone.support.spread import spread
from rankone.support.wording import did_you_mean, listing, quote
from rankone.tensors.calculus import fixed

__all__ = ["Posterior", "posterior"]

_MOST_STEPS = 10**6
"""Steps of a chain at most."""
_BY_QUADRATURE = 3
"""Most parameters for quadrature."""
_ACCURATE = 1e-3
"""Error of integrals up to which the quadrature counts as exact."""
_UNNOTICED = 1e-4
"""Change of the data, in standard deviations of the noise, that does not count."""
_MODES, _FAR = 24, 6.0
"""Starts of searches for modes, and how far below the best one they count, in deviations."""
_DRAWN = 400
"""Points by which the cells are told where the density is."""


class _Found(Protocol):
    """A distribution in the unit cube: nodes with masses, marginals and samples."""

    @property
    def nodes(self) -> Array: ...
    @property
    def masses(self) -> Array: ...
    def marginal(self, j: int, z: Array) -> Array: ...
    def quantile(self, j: int, shares: Array) -> Array: ...


@dataclass(frozen=True, repr=False)
class Posterior:
    """The distribution of the parameters after the data are known.

    Attributes
    ----------
    fit : Fit
        The fit by least squares that it was started from.
    method : {"quadrature", "mcmc"}
    log_evidence : float
        Logarithm of the integral of the likelihood over the prior, up to what depends on the data
        and sigma alone; NaN for chains.
    success : bool
        Whether the integrals are exact to about 1e-3, or the chain is long enough.
    message : str
    """

    fit: Fit
    method: str
    log_evidence: float
    success: bool
    message: str
    _density: Posterity
    _found: _Found

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return self.fit.parameters

    @property
    def mean(self) -> dict[str, float]:
        """The mean of each parameter."""
        return self._density.problem.free.named(self._found.masses @ self._found.nodes)

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters, (n, n)."""
        masses, nodes = self._found.masses, self._found.nodes
        centred = (nodes - masses @ nodes) * self._density.unit[1]
        return np.asarray((centred * masses[:, None]).T @ centred)

    @property
    def std(self) -> dict[str, float]:
        """The standard deviation of each parameter."""
        roots = np.sqrt(np.diag(self.covariance))
        return dict(zip(self.parameters, map(float, roots), strict=True))

    def quantile(self, q: Any) -> dict[str, Any]:
        """Quantiles of each parameter, numbers or arrays like ``q``.

        Raises
        ------
        OptionError
            If a probability is not in [0, 1].
        """
        try:
            shares = np.asarray(q, dtype=float)
        except (TypeError, ValueError):
            raise OptionError(f"q={q!r} are no numbers", term=q) from None
        if not ((shares >= 0.0) & (shares <= 1.0)).all():
            raise OptionError(f"q={q!r} is not in [0, 1]", term=q)
        lower, width = self._density.unit
        found: dict[str, Any] = {}
        for j, name in enumerate(self.parameters):
            z = self._found.quantile(j, shares.ravel()).reshape(shares.shape)
            values = lower[j] + width[j] * z
            found[name] = float(values) if values.ndim == 0 else values
        return found

    def interval(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """For each parameter the interval between equal tails."""
        level = checked_number("level", level, 0.0, 1.0, float)
        found = self.quantile([0.5 - 0.5 * level, 0.5 + 0.5 * level])
        return {name: (float(ends[0]), float(ends[1])) for name, ends in found.items()}

    def density(self, parameter: Any, values: Any) -> Array:
        """The marginal density of one parameter at values; zero outside of its bounds."""
        name = name_of(parameter)
        if name not in self.parameters:
            raise OptionError(
                f"{quote(name)} is no free parameter{did_you_mean(name, self.parameters)}",
                term=parameter,
                remedy=f"choose from {listing(self.parameters)}",
            )
        j = self.parameters.index(name)
        lower, width = self._density.unit
        z = (np.asarray(values, dtype=float) - lower[j]) / width[j]
        inside = (z >= 0.0) & (z <= 1.0)
        found = self._found.marginal(j, np.clip(z, 0.0, 1.0).ravel()).reshape(z.shape)
        return np.where(inside, found / width[j], 0.0)

    def sample(self, count: int, *, seed: int | None = None) -> dict[str, Array]:
        """Random values of all parameters, fixed ones as well, by name, (count,) each.

        ``solution(t=1.0, **posterior.sample(1000))`` are predictions.
        """
        count = checked_count("count", count, 0, 3 * len(self.fit._problem.free.order))
        seed = None if seed is None else checked_number("seed", seed, 0)
        generator = np.random.default_rng(seed)
        if isinstance(self._found, Cells):
            shift = self.log_evidence

            def density(z: Array) -> Array:
                return np.asarray(np.exp(self._density(z) - shift))

            z = self._found.sample(count, density, generator)
        else:
            z = self._found.nodes[generator.integers(0, len(self._found.nodes), count)]
        free = self.fit._problem.free
        every = dict(zip(free.names, free.values(z).T, strict=True))
        every |= {name: np.full(count, value) for name, value in free.fixed.items()}
        return {name: every[name] for name in free.order}

    def __repr__(self) -> str:
        lines = [f"Posterior of {', '.join(self.parameters)} by {self.method}"]
        ends, deviations = self.interval(), self.std
        for name, mean in self.mean.items():
            low, high = ends[name]
            lines.append(
                f"  {name}  {mean:.6g} ± {deviations[name]:.2g}, 95 % in [{low:.6g}, {high:.6g}]"
            )
        return "\n".join(
            [*lines, f"  {'success' if self.success else 'no success'}: {self.message}"]
        )


def posterior(
    solution: SolutionCore,
    times: Any,
    data: Any,
    *,
    prior: Mapping[Any, Any] | None = None,
    seed: int = 0,
    steps: int = 1000,
    **given: Any,
) -> Posterior:
    """The posterior; parameters and errors are those of :meth:`~rankone.Solution.posterior`."""
    if not isinstance(prior, Mapping | None):
        raise OptionError(f"prior={prior!r} is not a mapping from parameters", term=prior)
    seed = checked_number("seed", seed, 0)
    steps = checked_number("steps", steps, 100, _MOST_STEPS)
    found = fit(solution, times, data, **given)
    usual = {name: from_text(text) for name, text in solution.metadata.distributions}
    density = Posterity(_smaller(found), priors(found._problem.free, prior, usual))
    likely, extents = _likely(found, density)
    if density.dimension > _BY_QUADRATURE:
        links = chain(density, likely, seed, steps)
        return Posterior(
            found, "mcmc", math.nan, links.success, links.message + _boxed(found), density, links
        )
    cells, evidence = adapted(density, likely, extents)
    success = cells.error <= _ACCURATE
    message = f"integrals are exact to about {cells.error:.1e}{_boxed(found)}"
    if not success:
        message += "; remedy: restrict the box to where the density is, or fix parameters"
    return Posterior(found, "quadrature", evidence, success, message, density, cells)


def _boxed(found: Fit) -> str:
    """Words on parameters that the data alone do not identify."""
    names = [name for name, identified in found.identifiable.items() if not identified]
    if not names:
        return ""
    return f"; the data do not identify {listing(names)} alone: box and prior limit them"


def _smaller(found: Fit) -> LeastSquares:
    """The least squares of the free parameters alone, with ranks that the noise allows."""
    free, seen = found._problem.free, found.observations
    slabs = found.solution.outcome.slabs
    for position in reversed(range(len(free.order))):
        if free.order[position] in free.fixed:
            slabs = fixed(slabs, position, free.fixed[free.order[position]])
    model = TrainModel(slabs, seen.rows, seen.times)
    unit = found._unit if found._unit > 0.0 else 1.0
    positions = tuple(range(len(free.names)))
    alone = replace(free, order=free.names, positions=positions, fixed={})
    return LeastSquares(model.thinned(seen.scale, _UNNOTICED * unit), seen, alone)


def _likely(found: Fit, density: Posterity) -> tuple[Array, Array]:
    """Points where the posterior is large (k, n), and its extents there, others held (n,)."""
    problem, n = density.problem, density.dimension
    generator = np.random.default_rng(11)
    unit = max(found._unit, 1e-12) if math.isfinite(found._unit) else 1.0
    minima = problem.minima(np.vstack([found._z, spread(_MODES, n, generator)]))
    good = minima.cost <= minima.cost.min() + _FAR**2 * unit**2
    near, extents = [], np.ones(n)
    for z, jacobian in zip(minima.z[good], minima.jacobian[good], strict=True):
        slopes = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
        extents = np.minimum(extents, unit / slopes)
        _, singular, right = np.linalg.svd(jacobian, full_matrices=False)
        root = right.T * np.minimum(unit / np.maximum(singular, 1e-12), 1.0)
        near.append(z + generator.standard_normal((_DRAWN // good.sum(), len(root.T))) @ root.T)
    wide = generator.random((8 * _DRAWN, n))
    centres = [m.sample(np.array([0.01, 0.1, 0.5, 0.9, 0.99])) for m in density.measures]
    lower, width = density.unit
    prior = (np.array(centres).T - lower) / width
    every = np.clip(np.vstack(near), 0.0, 1.0)
    points = np.vstack([minima.z[good], every, prior, wide])
    logs = density(points)
    if not np.isfinite(logs.max()):
        raise OptionError("the prior has no probability where the data have any")
    likely = points[logs > logs.max() - 0.5 * (3.0**2 + n)]
    spreads = [_spread(m, z) for m, z in zip(density.measures, width, strict=True)]
    return likely, np.minimum(extents, np.array(spreads))


def _spread(measure: Any, width: float) -> float:
    """Extent of a prior in the unit interval."""
    if measure.distribution is None:
        return 1.0
    low, high = measure.sample(np.array([0.16, 0.84]))
    return float(max(0.5 * (high - low) / width, 1e-12))
