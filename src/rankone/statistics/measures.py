"""Probability measures of parameters: integrals of the modes of a basis, and samples."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss

from rankone.arrays import Array
from rankone.discretization import Basis1D
from rankone.errors import OptionError, warn
from rankone.wording import quote

__all__ = ["Measure"]

_NODES = 24
"""Quadrature nodes on each panel."""
_QUANTILES = (0.0, 1e-14, 1e-11, 1e-8, 1e-6, 1e-4, 1e-3, 0.01, 0.05, 0.15, 0.3, 0.5)
"""Ends of panels, with their complements: densities vary with their quantiles."""
_EXACT = 1e-10
"""Error of the probability of the interval up to which the quadrature counts as exact."""
_OUTSIDE = 1e-3
"""Probability outside of the box from which there is a warning."""


@dataclass(frozen=True, eq=False)
class Measure:
    """A distribution of one parameter on its interval, of total mass one there.

    Parameters
    ----------
    name : str
        Of the parameter.
    lower, upper : float
    distribution : frozen continuous distribution of scipy.stats, optional
        Cut at the ends of the interval; uniform if none is given.
    """

    name: str
    lower: float
    upper: float
    distribution: Any = None

    def __post_init__(self) -> None:
        if self.distribution is None:
            return
        if not all(hasattr(self.distribution, method) for method in ("pdf", "cdf", "ppf")):
            raise OptionError(
                f"the distribution of {quote(self.name)} is {self.distribution!r}, not a frozen "
                "continuous distribution",
                term=self.distribution,
                remedy="give one of scipy.stats, for example scipy.stats.norm(1, 0.1)",
            )
        mass = self.mass
        if not mass > 0.0:
            raise OptionError(
                f"the distribution of {quote(self.name)} has no probability in "
                f"[{self.lower:g}, {self.upper:g}]",
                term=self.distribution,
                remedy="choose one that fits the box, or solve on another box",
            )
        if 1.0 - mass > _OUTSIDE:
            warn(
                f"{100 * (1 - mass):.2g} % of the distribution of {quote(self.name)} is outside of "
                f"[{self.lower:g}, {self.upper:g}] and left out; remedy: solve on a wider box"
            )

    @cached_property
    def mass(self) -> float:
        """Probability of the interval before it is cut."""
        if self.distribution is None:
            return 1.0
        below, up_to = self.distribution.cdf([self.lower, self.upper])
        return float(up_to - below)

    def integrals(self, basis: Basis1D) -> tuple[Array, Array]:
        """Means of the modes of a basis, (size,), and of their products, (size, size)."""
        points, weights = self._quadrature(basis)
        values = basis.modal_values(points)
        return weights @ values, values.T @ (weights[:, None] * values)

    def sample(self, shares: Array) -> Array:
        """Values at shares in [0, 1] of the probability."""
        if self.distribution is None:
            return np.asarray(self.lower + (self.upper - self.lower) * shares)
        below = float(self.distribution.cdf(self.lower))
        values = self.distribution.ppf(below + self.mass * shares)
        return np.asarray(np.clip(values, self.lower, self.upper))

    def _quadrature(self, basis: Basis1D) -> tuple[Array, Array]:
        """Points and weights of sum one that integrate products of modes."""
        if self.distribution is None:
            count = basis.degree + 1
            return _panels(np.asarray(basis.edges), count, 1.0 / (self.upper - self.lower))
        edges = sorted({*basis.edges.tolist(), *self._quantiles()})
        points, weights = _panels(np.array(edges), max(_NODES, basis.degree + 1), 1.0)
        weights = weights * self.distribution.pdf(points)
        if not abs(float(weights.sum()) - self.mass) <= _EXACT * self.mass:
            points, weights = self._by_probability(basis)
        return points, weights / weights.sum()

    def _by_probability(self, basis: Basis1D) -> tuple[Array, Array]:
        """The same over the probability, for densities that are not finite or have gaps."""
        shares = [float(self.distribution.cdf(edge)) for edge in basis.edges]
        between = [*_QUANTILES, *(1.0 - q for q in _QUANTILES)]
        inside = {q for q in between if shares[0] < q < shares[-1]}
        edges = np.array(sorted({*shares, *inside}))
        fine = np.concatenate(
            [np.linspace(a, b, 9)[:-1] for a, b in itertools.pairwise(edges)] + [edges[-1:]]
        )
        probabilities, weights = _panels(fine, _NODES, 1.0)
        points = np.clip(self.distribution.ppf(probabilities), self.lower, self.upper)
        return points, weights

    def _quantiles(self) -> list[float]:
        """Quantiles inside of the interval."""
        shares = np.array([*_QUANTILES, *(1.0 - q for q in _QUANTILES)])
        values = self.distribution.ppf(shares)
        return [float(v) for v in values if math.isfinite(v) and self.lower < v < self.upper]


def _panels(edges: Array, count: int, factor: float) -> tuple[Array, Array]:
    """Gauss-Legendre points and weights on consecutive panels."""
    xi, weights = leggauss(count)
    half = 0.5 * np.diff(edges)[:, None]
    points = edges[:-1, None] + half * (xi + 1.0)
    return points.ravel(), (factor * half * weights).ravel()
