"""How estimated levels of noise make intervals longer.

Weights that are estimated from few data are uncertain. The covariance of the other parameters grows
with that, and the degrees of freedom of a quantity are those of the levels that decide on its
variance (Kenward & Roger, "Small sample inference for fixed effects from restricted maximum
likelihood", 1997; Satterthwaite 1946).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rankone.estimation.likelihood import Likelihood
from rankone.support.arrays import Array


@dataclass(frozen=True)
class LevelUncertainty:
    """What k levels of noise are worth for n parameters.

    ``information`` (k, n, n) is that of all data, times the derivative of the logarithm of their
    standard deviations with respect to each level; ``squares`` (k, k, n, n) times those with
    respect to two. ``covariance`` (k, k) is that of the levels, ``root`` (n, r) one of the
    covariance of all parameters if the levels were known.
    """

    information: Array
    squares: Array
    covariance: Array
    root: Array

    def enlarged(self, root: Array) -> Array:
        """A root (n, r) of the covariance of all parameters; the weights add theirs."""
        inside = root.T @ self.information @ root
        more = np.einsum("kl,klab->ab", self.covariance, root.T @ self.squares @ root)
        less = np.einsum("kl,kab,lbc->ac", self.covariance, inside, inside)
        growth = 8.0 * (more - less)
        values, vectors = np.linalg.eigh(0.5 * (growth + growth.T))
        return np.asarray(root @ (vectors * np.sqrt(1.0 + np.maximum(values, 0.0))))

    def dof(self, slope: Array) -> float:
        """Degrees of freedom of the variance of a quantity with derivatives (n,)."""
        along = self.root @ (self.root.T @ slope)
        change = 2.0 * np.einsum("a,kab,b->k", along, self.information, along)
        variance = float(change @ self.covariance @ change)
        return 2.0 * float(slope @ along) ** 2 / variance if variance > 0.0 else math.inf


def level_uncertainty(
    problem: Likelihood, jacobian: Array, root: Array, shares: Mapping[int, float]
) -> LevelUncertainty:
    """That of the free levels of noise, at a point with Jacobian (r, n).

    Of the data, ``shares`` are left to estimate each level.
    """
    levels = list(problem.levels)
    location, moved = [], []
    for trial, i, here in problem.blocks:
        rows = jacobian[here]
        location.append(rows)
        if trial.observations.noises[i].estimated:
            size = here.stop - here.start
            scaled = jacobian[here.stop : here.stop + size][:, levels]
            moved.append(scaled / trial.observations.noises[i].scale_root)
        else:
            moved.append(np.zeros((len(rows), len(levels))))
    x, d = np.concatenate(location), np.concatenate(moved)
    left = np.sqrt([shares.get(j, 1.0) for j in levels])
    covariance = (root @ root.T)[np.ix_(levels, levels)] / np.outer(left, left)
    return LevelUncertainty(
        np.einsum("mk,ma,mb->kab", d, x, x),
        np.einsum("mk,ml,ma,mb->klab", d, d, x, x),
        covariance,
        root,
    )
