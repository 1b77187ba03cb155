"""Distributions in a unit cube: on cells that are halved, or as points of a Markov chain.

Up to three parameters the density is known on cells, each with a tensor grid of Gauss-Legendre
nodes. A cell is halved, in the direction in which the density varies most, until its halves have
the same integral.

Beyond three, walkers move by differences of others (ter Braak & Vrugt, "Differential evolution
Markov chain with snooker updater", 2008), by emcee: ``pip install emcee``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy
from numpy.polynomial.legendre import leggauss, legint, legval, legvander

from rankone.support.arrays import COINCIDENT, HALVINGS, NEGLIGIBLE, Array, bisected
from rankone.support.errors import optional_module, with_remedy

Density = Callable[[Array], Array]
"""A density, or its logarithm, at points (N, n) of the unit cube: shape (N,)."""

_NODES = {1: 10, 2: 7, 3: 5}  # Gauss nodes of a cell in each direction, by dimension
# Sum of the errors of the integrals over all cells, in shares of the whole, by dimension
_TOLERANCE = {1: 1e-8, 2: 1e-5, 3: 3e-4}


@dataclass(frozen=True)
class CubeTuning:
    """Tuning of cells, and of Markov chains."""

    least_shares: int = 50
    """Least number of equal shares into which the tolerance is divided among cells."""
    most_points: int = 2_000_000
    """Evaluations of the density after which no cell is halved, to bound time and memory."""
    most_first_cells: int = 4000
    """Number of cells above which the first cells are not cut again."""
    ceiling_ratio: float = 1.3
    """Ceiling of the density on a cell, over its largest value at the nodes."""
    walkers_each: int = 16
    """Walkers for each parameter."""
    least_walkers: int = 32
    """Least number of walkers, also for few parameters."""
    long_enough: float = 40.0
    """Least length of a chain, in autocorrelation times, at which its integrals are trusted."""
    most_reduction: float = 1.05
    """Factor up to which chains agree."""
    discarded_times: float = 5.0
    """Autocorrelation times at the start of a chain that are discarded."""


TUNING = CubeTuning()

_FIRST_CELLS = {1: 16, 2: 8, 3: 4}  # Cells in each direction to begin with, by dimension
# Width of the first cells where the density is large, in its standard deviations
_FIRST_DEVIATIONS = {1: 2.0, 2: 2.0, 3: 4.0}


class CubeDistribution(Protocol):
    """A distribution in the unit cube: nodes with masses, marginals, quantiles and samples."""

    @property
    def nodes(self) -> Array: ...
    @property
    def masses(self) -> Array: ...
    def marginal(self, j: int, z: Array) -> Array: ...
    def quantile(self, j: int, shares: Array) -> Array: ...
    def sample(self, count: int, density: Density, generator: np.random.Generator) -> Array: ...


@dataclass(frozen=True)
class Cells:
    """A density of total mass one on the unit cube, known at the nodes of cells (c, *nodes).

    ``lower`` and ``width`` of the cells have the shape (c, n). ``error`` of integrals is relative.
    """

    lower: Array
    width: Array
    densities: Array
    error: float

    @cached_property
    def nodes(self) -> Array:
        """All nodes (c * nodes, n)."""
        return _nodes(self.lower, self.width).reshape(-1, self.lower.shape[1])

    @cached_property
    def masses(self) -> Array:
        """Probability at each of the nodes (c * nodes,)."""
        return (self.densities.reshape(len(self.densities), -1) * _weights(self.width)).ravel()

    def marginal(self, j: int, z: Array) -> Array:
        """Marginal density of coordinate j at z (k,)."""
        lower, width, coefficients, _ = self._marginals[j]
        end = lower + width
        density = np.zeros(z.shape)
        for i, point in enumerate(z):
            here = np.flatnonzero((lower <= point) & ((point < end) | (end >= 1.0)))
            xi = 2.0 * (point - lower[here]) / width[here] - 1.0
            density[i] = legval(xi, coefficients[here].T, tensor=False).sum()
        return density

    def cumulative(self, j: int, z: Array) -> Array:
        """Probability that coordinate j is below z (k,)."""
        lower, width, coefficients, masses = self._marginals[j]
        probability = np.zeros(z.shape)
        for i, point in enumerate(z):
            past = lower + width <= point
            here = np.flatnonzero(~past & (lower < point))
            xi = 2.0 * (point - lower[here]) / width[here] - 1.0
            integrals = legval(xi, legint(coefficients[here].T, lbnd=-1), tensor=False)
            probability[i] = masses[past].sum() + (integrals * 0.5 * width[here]).sum()
        return probability

    def quantile(self, j: int, shares: Array) -> Array:
        """Quantiles of coordinate j at shares (k,) of the probability."""
        low, high = np.zeros(shares.shape), np.ones(shares.shape)
        low, high = bisected(low, high, lambda z: self.cumulative(j, z) < shares)
        return np.asarray(0.5 * (low + high))

    def sample(self, count: int, density: Density, generator: np.random.Generator) -> Array:
        """Random points (count, n), by rejection on cells; ``density`` is normalised."""
        flat = self.densities.reshape(len(self.densities), -1)
        ceiling = TUNING.ceiling_ratio * flat.max(axis=1)
        share = ceiling * np.prod(self.width, axis=1)
        share = share / share.sum()
        blocks: list[Array] = []
        missing = count
        while missing > 0:
            chosen = generator.choice(share.size, 2 * missing + 16, p=share)
            inside = generator.random((chosen.size, self.lower.shape[1]))
            points = self.lower[chosen] + self.width[chosen] * inside
            kept = points[generator.random(chosen.size) * ceiling[chosen] < density(points)]
            blocks.append(kept[:missing])
            missing -= len(blocks[-1])
        return np.concatenate(blocks) if blocks else np.zeros((0, self.lower.shape[1]))

    @cached_property
    def _marginals(self) -> list[tuple[Array, Array, Array, Array]]:
        """For each coordinate: lower ends and widths of the cells, Legendre coefficients of the
        marginal density on each, and its mass."""
        n = self.lower.shape[1]
        xi, weights = leggauss(_NODES[n])
        degrees = np.arange(xi.size)
        to_modes = (legvander(xi, xi.size - 1) * weights[:, None]).T * (degrees[:, None] + 0.5)
        marginals = []
        for j in range(n):
            density = np.moveaxis(self.densities, 1 + j, 1)
            widths = np.delete(self.width, j, axis=1)
            for k in range(n - 1):
                density = density @ (0.5 * weights)
                density = density * widths[:, k].reshape(-1, *[1] * (density.ndim - 1))
            coefficients, width = density @ to_modes.T, self.width[:, j]
            marginals.append((self.lower[:, j], width, coefficients, coefficients[:, 0] * width))
        return marginals


def adapted(log_density: Density, likely: Array, spread: Array) -> tuple[Cells, float]:
    """The cells of a density, and the logarithm of its integral.

    ``log_density`` takes points (N, n) of the unit cube; it is known up to a summand. The first
    cells are small at the points ``likely`` (k, n), where the density is large; ``spread`` (n,) is
    its extent there in each direction, with the other coordinates held.
    """
    lower, width = _first(likely, spread)
    logs = _evaluated(log_density, lower, width)
    points, whole, error = logs.size, 0.0, 0.0
    top = float(max(logs.max(), np.max(log_density(likely))))
    done: list[tuple[Array, Array, Array]] = []
    for turn in range(HALVINGS):
        halves = _halved(lower, width, np.exp(logs - top))
        finer = _evaluated(log_density, *halves)
        points += finer.size
        higher = max(top, float(finer.max()))
        whole, error = whole * np.exp(top - higher), error * np.exp(top - higher)
        top = higher
        fine = _integrals(halves[1], finer, top).reshape(2, -1).sum(axis=0)
        errors = np.abs(_integrals(width, logs, top) - fine)
        tolerance = _TOLERANCE[lower.shape[1]] * (whole + float(fine.sum()))
        good = errors <= tolerance / max(len(errors), TUNING.least_shares)
        if points > TUNING.most_points or turn == HALVINGS - 1:
            good[:] = True
        whole, error = whole + float(fine[good].sum()), error + float(errors[good].sum())
        both = np.tile(good, 2)
        done.append((halves[0][both], halves[1][both], finer[both]))
        lower, width, logs = halves[0][~both], halves[1][~both], finer[~both]
        if not len(lower):
            break
    lower, width, logs = (np.concatenate(arrays) for arrays in zip(*done, strict=True))
    densities = np.exp(logs - top) / whole
    return Cells(lower, width, densities, error / whole), top + float(np.log(whole))


def _integrals(width: Array, logs: Array, top: float) -> Array:
    """Integrals over cells (c,) of densities given by logarithms."""
    densities = np.exp(logs - top).reshape(len(logs), -1)
    return np.asarray(np.sum(densities * _weights(width), axis=1))


def _first(likely: Array, spread: Array) -> tuple[Array, Array]:
    """The first cells: small where the density is likely to be large."""
    n = likely.shape[1]
    count = _FIRST_CELLS[n]
    lower = np.array(list(itertools.product(range(count), repeat=n))) / count
    width = np.full(lower.shape, 1.0 / count)
    narrow = np.maximum(_FIRST_DEVIATIONS[n] * spread, COINCIDENT)
    for _ in range(200):
        inside = np.zeros(len(lower), dtype=bool)
        for k in np.flatnonzero((width > narrow).any(axis=1)):
            between = (likely >= lower[k]) & (likely <= lower[k] + width[k])
            inside[k] = bool(between.all(axis=1).any())
        if not inside.any() or len(lower) > TUNING.most_first_cells:
            break
        widest = np.argmax(width[inside] / narrow, axis=1)
        cut_lower, cut_width = _cut(lower[inside], width[inside], widest)
        lower = np.concatenate([lower[~inside], cut_lower])
        width = np.concatenate([width[~inside], cut_width])
    return lower, width


def _halved(lower: Array, width: Array, densities: Array) -> tuple[Array, Array]:
    """All lower halves of the cells, then all upper ones, cut where the density varies most."""
    n = lower.shape[1]
    rough = np.empty(lower.shape)
    for j in range(n):
        along = np.moveaxis(densities, 1 + j, -1)
        change = np.abs(np.diff(along, n=2, axis=-1))
        rough[:, j] = change.reshape(len(densities), -1).sum(axis=1)
    axis = np.where(rough.max(axis=1) > 0.0, rough.argmax(axis=1), width.argmax(axis=1))
    return _cut(lower, width, axis)


def _cut(lower: Array, width: Array, axis: Array) -> tuple[Array, Array]:
    rows = np.arange(len(lower))
    half = width.copy()
    half[rows, axis] *= 0.5
    upper = lower.copy()
    upper[rows, axis] += half[rows, axis]
    return np.concatenate([lower, upper]), np.concatenate([half, half])


def _nodes(lower: Array, width: Array) -> Array:
    """Nodes of cells, (c, nodes, n)."""
    n = lower.shape[1]
    xi, _ = leggauss(_NODES[n])
    grid = np.stack(np.meshgrid(*[0.5 * (xi + 1.0)] * n, indexing="ij"), axis=-1).reshape(-1, n)
    return np.asarray(lower[:, None, :] + width[:, None, :] * grid)


def _weights(width: Array) -> Array:
    """Weights of the nodes of cells, (c, nodes)."""
    n = width.shape[1]
    _, weights = leggauss(_NODES[n])
    product = np.ones(1)
    for _ in range(n):
        product = np.multiply.outer(product, 0.5 * weights).ravel()
    return np.asarray(np.prod(width, axis=1)[:, None] * product)


def _evaluated(log_density: Density, lower: Array, width: Array) -> Array:
    """Logarithms at the nodes of cells, (c, *nodes)."""
    n = lower.shape[1]
    logs = log_density(_nodes(lower, width).reshape(-1, n))
    return logs.reshape(len(lower), *[_NODES[n]] * n)


# --- Markov chains -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Chain:
    """Points (k, n) of chains in the unit cube without their starts, of ``length`` steps each.

    ``autocorrelation`` is the autocorrelation time in steps; the largest over parameters and
    chains. ``reduction`` is the factor by which longer chains might narrow the distribution, which
    is 1 where all chains have the same means (Gelman & Rubin, "Inference from iterative simulation
    using multiple sequences", Statistical Science 7, 1992).
    """

    nodes: Array
    autocorrelation: float
    length: int
    count: int = 1
    reduction: float = 1.0

    @classmethod
    def of(cls, chains: Sequence[Chain]) -> Chain:
        """All chains together."""
        if len(chains) == 1:
            return chains[0]
        within = np.mean([chain.nodes.var(axis=0) for chain in chains], axis=0)
        between = np.var([chain.nodes.mean(axis=0) for chain in chains], axis=0, ddof=1)
        shares = between / np.where(within > 0.0, within, np.inf)
        nodes = np.concatenate([chain.nodes for chain in chains])
        slowest = max(chain.autocorrelation for chain in chains)
        reduction = float(np.sqrt(1.0 + shares.max()))
        return cls(nodes, slowest, chains[0].length, len(chains), reduction)

    @property
    def masses(self) -> Array:
        """Probability of each point (k,)."""
        return np.full(len(self.nodes), 1.0 / len(self.nodes))

    @property
    def success(self) -> bool:
        """Whether the chains are many autocorrelation times long, and agree."""
        return self._is_long and self.reduction <= TUNING.most_reduction

    @property
    def _is_long(self) -> bool:
        return bool(self.length >= TUNING.long_enough * self.autocorrelation)

    @property
    def message(self) -> str:
        """How long the chains are, and whether they agree."""
        time = f"{self.autocorrelation:.3g}"
        text = f"the chain has {self.length} steps, its autocorrelation time is {time}"
        if self.count > 1:
            text = (
                f"{self.count} chains have {self.length} steps each, the longest autocorrelation "
                f"time is {time}, and they agree to a factor of {self.reduction:.3g}"
            )
        if self.success:
            return text
        short = f"{text}: too short" if not self._is_long else f"{text}: too different"
        return with_remedy(short, f"steps={4 * self.length}")

    def marginal(self, j: int, z: Array) -> Array:
        """Marginal density of coordinate j at z (k,), by a Gaussian kernel."""
        column = self.nodes[:, j]
        mirrored = np.concatenate([column, -column, 2.0 - column])
        kernel = scipy.stats.gaussian_kde(mirrored[:: max(1, mirrored.size // 30000)])
        return np.asarray(3.0 * kernel(z))

    def quantile(self, j: int, shares: Array) -> Array:
        """Quantiles of coordinate j at shares (k,) of the points."""
        return np.asarray(np.quantile(self.nodes[:, j], shares))

    def sample(self, count: int, density: Density, generator: np.random.Generator) -> Array:
        """Random points (count, n) of the chain."""
        return self.nodes[generator.integers(0, len(self.nodes), count)]


def chain(log_density: Density, likely: Array, seed: int, steps: int) -> Chain:
    """A seeded chain for the logarithm of a density, from points where it is large (k, n)."""
    emcee = optional_module(
        "emcee",
        "posteriors of more than three parameters need emcee",
        "pip install emcee, or fix parameters",
    )
    n = likely.shape[1]
    count = max(TUNING.least_walkers, TUNING.walkers_each * n)
    generator = np.random.default_rng(seed)
    chosen = likely[generator.integers(0, len(likely), count)]
    start = np.clip(
        chosen + 1e-4 * generator.standard_normal(chosen.shape), NEGLIGIBLE, 1.0 - NEGLIGIBLE
    )

    def inside_cube(z: Array) -> Array:
        inside = ((z >= 0.0) & (z <= 1.0)).all(axis=1)
        logs = np.full(len(z), -np.inf)
        if inside.any():
            logs[inside] = log_density(z[inside])
        return logs

    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(count, n, inside_cube, moves=moves, vectorize=True)
    state = np.random.RandomState(seed).get_state()
    sampler.run_mcmc(emcee.State(start, random_state=state), steps)
    time = float(np.max(sampler.get_autocorr_time(tol=0)))
    time = time if np.isfinite(time) else float(steps)
    burn = int(min(TUNING.discarded_times * time, 0.5 * steps))
    return Chain(sampler.get_chain(discard=burn, flat=True), time, steps)
