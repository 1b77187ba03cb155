"""Probability measures of parameters: integrals of the modes of a basis, and samples."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.special import ndtri

from rankone.discretization import Basis1D
from rankone.statistics.distributions import is_frozen
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, warn
from rankone.support.wording import quote

__all__ = ["Measure", "gauss_rule"]

_NODES = 24
"""Quadrature nodes on each panel."""
_QUANTILES = (0.0, 1e-14, 1e-11, 1e-8, 1e-6, 1e-4, 1e-3, 0.01, 0.05, 0.15, 0.3, 0.5)
"""Ends of panels, with their complements: densities vary with their quantiles."""
_EXACT = 1e-10
"""Error of the probability of the interval up to which the quadrature counts as exact."""
_INSIDE = (1e-300, 1.0 - 2.0**-53)
"""Shares of the probability: at the very ends there may be infinite values."""
_LEVELS, _SETTLED = 52, 1e-14
"""Most halvings of panels, and the change of a mean of a mode from which they go on."""
_OUTSIDE = 1e-3
"""Probability outside of the box from which there is a warning."""
_NOTHING, _INVARIANT = 1e-40, 1e-13
"""Relative weights of points that do not count; norm below which a polynomial is none any more."""


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
    usual : bool
        Whether it came with the problem, which said where it is cut.
    """

    name: str
    lower: float
    upper: float
    distribution: Any = None
    usual: bool = False

    def __post_init__(self) -> None:
        if self.distribution is None:
            return
        if not is_frozen(self.distribution):
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
        if 1.0 - mass > _OUTSIDE and not math.isfinite(self.distribution.var()):
            raise OptionError(
                f"the distribution of {quote(self.name)} has no finite mean and variance, and "
                f"{100 * (1 - mass):.3g} % of it is outside of [{self.lower:g}, {self.upper:g}]: "
                "where it is cut would decide about all statistics",
                term=self.distribution,
                remedy="give one with finite moments, or one that is cut, such as "
                "scipy.stats.truncnorm",
            )
        if 1.0 - mass > _OUTSIDE and not self.usual:
            warn(
                f"{100 * (1 - mass):.3g} % of the distribution of {quote(self.name)} is outside of "
                f"[{self.lower:g}, {self.upper:g}] and left out; remedy: solve on a wider box"
            )

    @cached_property
    def mass(self) -> float:
        """Probability of the interval before it is cut."""
        if self.distribution is None:
            return 1.0
        below, above = self._ends
        return abs(above - below)

    @cached_property
    def _ends(self) -> tuple[float, float]:
        """Probabilities at both ends, of what is below, or above in the upper tail."""
        function = self.distribution.sf if self._in_upper_tail else self.distribution.cdf
        lower, upper = function([self.lower, self.upper])
        return float(lower), float(upper)

    @cached_property
    def _in_upper_tail(self) -> bool:
        """Whether most of the distribution is below the interval: differences to one are lost."""
        return bool(self.distribution.cdf(self.lower) > 0.5)

    def _at_share(self, shares: Array) -> Array:
        """Values at shares of the probability of the interval, from its lower end."""
        lower, upper = self._ends
        shares = np.clip(shares, *_INSIDE)
        inverse = self.distribution.isf if self._in_upper_tail else self.distribution.ppf
        values = inverse(lower + (upper - lower) * shares)
        return np.asarray(np.clip(values, self.lower, self.upper))

    def integrals(self, basis: Basis1D) -> tuple[Array, Array]:
        """Means of the modes of a basis, (size,), and a root R of those of their products.

        R (size, k) has the means of products as R R^T; by QR, so that nothing is squared.
        """
        points, weights = self._quadrature(basis)
        values = basis.modal_values(points)
        root: Array = np.asarray(np.linalg.qr(np.sqrt(weights)[:, None] * values, mode="r"))
        return weights @ values, np.ascontiguousarray(root.T)

    def sample(self, shares: Array) -> Array:
        """Values at shares in [0, 1] of the probability."""
        if self.distribution is None:
            return np.asarray(self.lower + (self.upper - self.lower) * shares)
        return self._at_share(shares)

    def normal(self, value: float) -> float:
        """The standard normal number below which there is as much probability as below a value."""
        if self.distribution is None:
            share = (value - self.lower) / (self.upper - self.lower)
        else:
            function = self.distribution.sf if self._in_upper_tail else self.distribution.cdf
            lower, upper = self._ends
            share = (float(function(value)) - lower) / (upper - lower)
        return float(ndtri(min(max(share, 1e-15), 1.0 - 1e-15)))

    def rule(self, basis: Basis1D, factors: int = 2) -> tuple[Array, Array]:
        """Few points and weights of sum one that integrate products of so many modes.

        On each element the Gauss rule of the distribution.
        """
        points, weights = self._quadrature(basis, factors)
        count = factors * (basis.degree - 1) // 2 + 1
        element = np.searchsorted(basis.edges[1:-1], points, side="right")
        own = [element == e for e in range(basis.elements)]
        rules = [gauss_rule(points[here], weights[here], count) for here in own]
        points, weights = (np.concatenate(part) for part in zip(*rules, strict=True))
        return points, weights / weights.sum()

    def _quadrature(self, basis: Basis1D, factors: int = 2) -> tuple[Array, Array]:
        """Points and weights of sum one that integrate products of modes."""
        enough = factors * basis.degree // 2 + 1
        if self.distribution is None:
            return _panels(np.asarray(basis.edges), enough, 1.0 / (self.upper - self.lower))
        edges = sorted({*basis.edges.tolist(), *self._quantiles()})
        points, weights = _panels(np.array(edges), max(_NODES, enough), 1.0)
        weights = weights * self.distribution.pdf(points)
        if not abs(float(weights.sum()) - self.mass) <= _EXACT * self.mass:
            points, weights = self._by_probability(basis)
        return points, weights / weights.sum()

    def _by_probability(self, basis: Basis1D) -> tuple[Array, Array]:
        """The same over the probability, for densities that are not finite, jump or have gaps.

        Panels are halved until the means of the modes do not change.
        """
        function = self.distribution.sf if self._in_upper_tail else self.distribution.cdf
        lower, upper = self._ends
        shares = (np.asarray(function(basis.edges)) - lower) / (upper - lower)
        tails = np.array(_QUANTILES)
        edges = np.unique(np.clip([*shares, *tails, *(1.0 - tails)], 0.0, 1.0))
        waiting = np.stack([edges[:-1], edges[1:]], axis=1)
        done: list[tuple[Array, Array]] = []
        for level in range(_LEVELS):
            points, weights = self._on_panels(waiting)
            halves = np.repeat(waiting, 2, axis=0)
            halves[::2, 1] = halves[1::2, 0] = waiting.mean(axis=1)
            finer, finer_weights = self._on_panels(halves)
            coarse = _sums(basis, points, weights)
            fine = _sums(basis, finer, finer_weights).reshape(len(waiting), 2, -1).sum(axis=1)
            good = np.abs(fine - coarse).max(axis=1) <= _SETTLED
            good |= level == _LEVELS - 1
            both = np.repeat(good, 2)
            done.append((finer[both].ravel(), finer_weights[both].ravel()))
            waiting = halves[~both]
            if not len(waiting):
                break
        parts = zip(*done, strict=True)
        points, weights = (np.concatenate(part) for part in parts)
        return points, weights

    def _on_panels(self, panels: Array) -> tuple[Array, Array]:
        """Points and weights on panels (k, 2) of the probability, (k, nodes) each."""
        xi, weights = leggauss(_NODES)
        half = 0.5 * (panels[:, 1:] - panels[:, :1])
        return self._at_share(panels[:, :1] + half * (xi + 1.0)), half * weights

    def _quantiles(self) -> list[float]:
        """Quantiles inside of the interval."""
        shares = np.array([*_QUANTILES, *(1.0 - q for q in _QUANTILES)])
        values = self.distribution.ppf(shares)
        return [float(v) for v in values if math.isfinite(v) and self.lower < v < self.upper]


def gauss_rule(points: Array, weights: Array, count: int) -> tuple[Array, Array]:
    """The Gauss rule of a discrete measure: at most ``count`` of points, exact to 2 count - 1.

    By the Lanczos process with full orthogonalisation (Gautschi, Orthogonal Polynomials, 2004,
    section 2.2.3).
    """
    used = weights > _NOTHING * weights.max(initial=0.0)
    points, weights = points[used], weights[used]
    if points.size <= count:
        return points, weights
    mass = weights.sum()
    centre = float(weights @ points / mass)
    size = float(np.abs(points - centre).max())
    x = (points - centre) / size
    rows = np.sqrt(weights / mass)[None, :]
    while len(rows) < count:
        new = x * rows[-1]
        for _ in range(2):
            new = new - (rows @ new) @ rows
        length = float(np.linalg.norm(new))
        if length < _INVARIANT:
            break
        rows = np.vstack([rows, new / length])
    nodes, vectors = np.linalg.eigh((rows * x) @ rows.T)
    return centre + size * nodes, mass * vectors[0] ** 2


def _sums(basis: Basis1D, points: Array, weights: Array) -> Array:
    """Sums of the modes over each panel, (panels, size)."""
    values = basis.modal_values(points.ravel()).reshape(*points.shape, basis.size)
    return np.asarray(np.einsum("kp,kps->ks", weights, values))


def _panels(edges: Array, count: int, factor: float) -> tuple[Array, Array]:
    """Gauss-Legendre points and weights on consecutive panels."""
    xi, weights = leggauss(count)
    half = 0.5 * np.diff(edges)[:, None]
    points = edges[:-1, None] + half * (xi + 1.0)
    return points.ravel(), (factor * half * weights).ravel()
