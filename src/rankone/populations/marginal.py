"""The marginal likelihood of the population parameters by Laplace's method.

-2 log L_i = -2 log p(y_i | eta_i) + eta_i' Omega^-1 eta_i + log |I + L' M_i L|, with the Fisher
information M_i of the data about the random effects at their mode eta_i: first-order conditional
estimation with interaction (Lindstrom & Bates, Biometrics 46, 1990; Wang, J. Pharmacokinet.
Pharmacodyn. 34, 2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rankone.populations.individuals import MOST_STEPS, EmpiricalBayes, Individuals, Start
from rankone.populations.slopes import Slopes, slopes_of
from rankone.support.arrays import Array

_POINTS_AT_ONCE = 256  # Population parameters that are evaluated together, to bound memory


@dataclass(frozen=True)
class Marginal:
    """-2 log L of the population parameters, and what follows from it."""

    search: EmpiricalBayes

    def at(self, psi: Array, start: Start, steps: int = MOST_STEPS) -> tuple[Array, Individuals]:
        """-2 log L (K,), up to a constant, at psi (K, P), and the random effects there."""
        individuals = self.search(psi, start, steps)
        return self._values(psi, individuals), individuals

    def values(self, psi: Array, start: Start) -> Array:
        """-2 log L (K,) at psi (K, P), block after block."""
        blocks = range(0, len(psi), _POINTS_AT_ONCE)
        return np.concatenate([self.at(psi[k : k + _POINTS_AT_ONCE], start)[0] for k in blocks])

    def slopes(self, psi: Array, individuals: Individuals) -> Slopes:
        """The derivatives at psi (K, P), where the random effects are at their modes."""
        return slopes_of(self.search, psi, individuals)

    def gradients(self, psi: Array, start: Start) -> Array:
        """The derivatives (K, P) of -2 log L at psi (K, P), from a start for each of these."""
        layout = self.search.layout
        step = max(_POINTS_AT_ONCE // (2 * len(layout.names) + 2 * len(layout.levels)), 1)
        gradients = []
        for here in (slice(k, k + step) for k in range(0, len(psi), step)):
            individuals = self.search(psi[here], start._replace(eta=start.eta[here]))
            gradients.append(self.slopes(psi[here], individuals).gradient)
        return np.concatenate(gradients)

    def _values(self, psi: Array, individuals: Individuals) -> Array:
        factor = self.search.layout.cholesky(psi)[:, None]
        random = list(self.search.layout.random)
        information = individuals.at.information[..., random, :][..., random]
        with np.errstate(all="ignore"):
            matrix = np.eye(len(random)) + factor.swapaxes(-1, -2) @ information @ factor
            usable = np.asarray(np.isfinite(matrix).all(axis=(-1, -2)))
            matrix = np.where(usable[..., None, None], matrix, np.eye(len(random)))
            each = individuals.at.cost + individuals.penalty + np.linalg.slogdet(matrix)[1]
        whole = each.sum(axis=-1)
        return np.where(np.isnan(whole), np.inf, whole)

    def information_of_means(self, psi: Array, individuals: Individuals) -> Array:
        """The expected information (K, B, B) about means and coefficients at psi (K, P).

        X' (M - M Z (Z' M Z + Omega^-1)^-1 Z' M) X, summed over subjects: that of the linear mixed
        model at the modes.
        """
        marginal = self.marginal_information(psi, individuals)
        designs = self.search.layout.designs
        return np.asarray(np.einsum("nep,knef,nfq->kpq", designs, marginal, designs, optimize=True))

    def marginal_information(self, psi: Array, individuals: Individuals) -> Array:
        """The information (K, n, E, E) of each subject about its typical coordinates."""
        random = list(self.search.layout.random)
        whole = individuals.at.information
        factor = self.search.layout.cholesky(psi)[:, None]
        to_random = whole[..., random] @ factor
        inner = np.eye(len(random)) + factor.swapaxes(-1, -2) @ to_random[..., random, :]
        return np.asarray(whole - to_random @ np.linalg.solve(inner, to_random.swapaxes(-1, -2)))

    def posterior_covariance(self, psi: Array, individuals: Individuals) -> Array:
        """The covariance (K, n, q, q) of the random effects of each subject given its data."""
        random = list(self.search.layout.random)
        factor = self.search.layout.cholesky(psi)[:, None]
        information = individuals.at.information[..., random, :][..., random]
        inner = np.eye(len(random)) + factor.swapaxes(-1, -2) @ information @ factor
        return np.asarray(factor @ np.linalg.solve(inner, factor.swapaxes(-1, -2)))
