"""Posterior samples by a Markov chain, for more parameters than quadrature can take.

Walkers that move by differences of others (ter Braak & Vrugt, "Differential evolution Markov chain
with snooker updater", 2008), of emcee: ``pip install emcee``.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats

from rankone.estimation.likelihood import Posterity
from rankone.support.arrays import Array
from rankone.support.errors import RankoneError

__all__ = ["Chain", "chain"]

_WALKERS = 16
"""Walkers for each parameter; at least 32."""
_LONG_ENOUGH = 40.0
"""Steps in autocorrelation times from which a chain is long enough."""


@dataclass(frozen=True)
class Chain:
    """Points of a chain after its start.

    Attributes
    ----------
    nodes : ndarray (k, n)
        In the unit cube.
    autocorrelation : float
        Steps after which walkers forget; the largest over the parameters.
    length : int
        Number of steps.
    """

    nodes: Array
    autocorrelation: float
    length: int

    @property
    def masses(self) -> Array:
        """Probability of each point (k,)."""
        return np.full(len(self.nodes), 1.0 / len(self.nodes))

    @property
    def success(self) -> bool:
        """Whether the chain is many autocorrelation times long."""
        return bool(self.length >= _LONG_ENOUGH * self.autocorrelation)

    @property
    def message(self) -> str:
        """How long the chain is."""
        time = f"{self.autocorrelation:.3g}"
        text = f"the chain has {self.length} steps, its autocorrelation time is {time}"
        return text if self.success else f"{text}: too short; remedy: steps={4 * self.length}"

    def marginal(self, j: int, z: Array) -> Array:
        """Marginal density of coordinate j at z (k,), by a Gaussian kernel."""
        column = self.nodes[:, j]
        mirrored = np.concatenate([column, -column, 2.0 - column])
        kernel = scipy.stats.gaussian_kde(mirrored[:: max(1, mirrored.size // 30000)])
        return np.asarray(3.0 * kernel(z))

    def quantile(self, j: int, shares: Array) -> Array:
        """Values of coordinate j below which there are shares (k,) of the points."""
        return np.asarray(np.quantile(self.nodes[:, j], shares))


def chain(density: Posterity, likely: Array, seed: int, steps: int) -> Chain:
    """A seeded chain from points where the density is large (k, n).

    Raises
    ------
    RankoneError
        If emcee is not installed.
    """
    emcee = _emcee()
    n = density.dimension
    count = max(32, _WALKERS * n)
    generator = np.random.default_rng(seed)
    chosen = likely[generator.integers(0, len(likely), count)]
    start = np.clip(chosen + 1e-4 * generator.standard_normal(chosen.shape), 1e-9, 1.0 - 1e-9)

    def log_density(z: Array) -> Array:
        inside = ((z >= 0.0) & (z <= 1.0)).all(axis=1)
        found = np.full(len(z), -np.inf)
        if inside.any():
            found[inside] = density(z[inside])
        return found

    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(count, n, log_density, moves=moves, vectorize=True)
    state = np.random.RandomState(seed).get_state()
    sampler.run_mcmc(emcee.State(start, random_state=state), steps)
    time = float(np.max(sampler.get_autocorr_time(tol=0)))
    time = time if np.isfinite(time) else float(steps)
    burn = int(min(5.0 * time, 0.5 * steps))
    return Chain(sampler.get_chain(discard=burn, flat=True), time, steps)


def _emcee() -> Any:
    try:
        return importlib.import_module("emcee")
    except ImportError:
        raise RankoneError(
            "posteriors of more than three parameters need emcee",
            remedy="pip install emcee, or fix parameters",
        ) from None
