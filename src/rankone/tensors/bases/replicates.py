"""Points drawn for statistics, in sets whose spread is the error of what they say.

Each set is a Sobol sequence that is scrambled by random numbers of its own. The mean over a set has
the right expectation, so the sets tell the error of their mean, whatever the function (L'Ecuyer,
Nakayama, Owen & Tuffin, "Confidence intervals for randomized quasi-Monte Carlo estimators",
Proceedings of the Winter Simulation Conference, 2023).
"""

from __future__ import annotations

import warnings

import numpy as np
import scipy

from rankone.support.arrays import Array

SETS = 16
"""Sets of points that are scrambled independently."""
LEVEL = 0.95
"""Probability that intervals and half-widths hold, unless a user chooses another."""
SEED = 20144
"""Of all points: the same call has the same answer."""
_FEW = 3.0  # Points that may lie elsewhere at 95 % although no set says so: the rule of three


def even_shares(count: int, d: int, seed: int | tuple[int, int]) -> Array:
    """Scrambled Sobol points of the unit cube, (d, count): best for a power of two."""
    generator = np.random.default_rng(seed)
    if d > scipy.stats.qmc.Sobol.MAXDIM:
        return generator.random((d, count))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The balance properties of Sobol' points")
        points = scipy.stats.qmc.Sobol(d, seed=generator).random(count)
    return np.ascontiguousarray(points.T)


def sets_of_shares(count: int, d: int, seed: int) -> Array:
    """About ``count`` points in sets that are scrambled independently, (SETS, d, each)."""
    each = max(-(-count // SETS), 1)
    return np.array([even_shares(each, d, (seed, k)) for k in range(SETS)])


def half_width(of_sets: Array, axis: int = 0) -> Array:
    """Half-widths of 95 % of means over the sets along an axis, from their spread."""
    quantile = float(scipy.stats.t.ppf(0.5 + 0.5 * LEVEL, of_sets.shape[axis] - 1))
    return quantile * standard_error(of_sets, axis)


def standard_error(of_sets: Array, axis: int = 0) -> Array:
    """The standard errors of means over the sets along an axis."""
    return np.asarray(of_sets.std(axis=axis, ddof=1) / np.sqrt(of_sets.shape[axis]))


def share_of(hits: Array, running: Array) -> tuple[Array, Array, Array]:
    """Shares (...) of the points, their standard errors, and their half-widths of 95 %.

    Of each set (..., SETS) ``hits`` are counted, and of all points (SETS,) those ``running``.
    Where the sets agree, the error is one point, and the half-width three.
    """
    points = running.sum()
    shares = hits.sum(axis=-1) / points
    apart = (hits - shares[..., None] * running) / running.mean()
    errors = np.maximum(standard_error(apart, -1), 1.0 / points)
    return shares, errors, np.maximum(half_width(apart, -1), _FEW / points)
