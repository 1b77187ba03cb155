"""Distributions of one parameter: of scipy.stats, as text, and cut at the ends of an interval.

The text, such as ``norm(1.0, 0.1)`` or ``gamma(2.0, scale=0.5)``, is what a Python reader would
write. It is read as a name and numbers; nothing is executed.
"""

from __future__ import annotations

import ast
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, TypeGuard

import numpy as np
import scipy
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from rankone.support.arrays import (
    ACCUMULATED,
    COARSE,
    EPSILON,
    HALVINGS,
    NEGLIGIBLE,
    ROUNDING,
    TINY,
    Array,
)
from rankone.support.errors import OptionError, did_you_mean, quote, warn
from rankone.tensors import Basis1D, Scale
from rankone.tensors.coordinates import LINEAR, LOG, written_scale

_EXAMPLE = "give one of scipy.stats, for example scipy.stats.norm(1, 0.1)"
_LOGARITHMIC = ("loguniform", "reciprocal", "lognorm")  # Families whose logarithm is natural
_FINITE_MOMENTS = "give one with finite moments, or one that is cut, such as scipy.stats.truncnorm"

# Gauss nodes on each panel: exact for smooth densities to rounding on the panels below
_PANEL_NODES = 24
# Ends of panels, together with their complements: densities vary on the scale of quantiles
_PANEL_QUANTILES = np.append(0.0, ndtr(np.linspace(ndtri(ROUNDING), 0.0, 11)))
# Shares of the probability that are evaluated: quantiles of 0 and 1 may be infinite
_SHARE_RANGE = (TINY, 1.0 - 0.5 * EPSILON)
# Weight, relative to the largest, of points that a Gauss rule leaves out
_NEGLIGIBLE_WEIGHT = 1e-40


class Distribution(Protocol):
    """A frozen continuous distribution, as scipy.stats makes them."""

    def pdf(self, x: ArrayLike, /) -> Array: ...
    def logpdf(self, x: ArrayLike, /) -> Array: ...
    def cdf(self, x: ArrayLike, /) -> Array: ...
    def sf(self, x: ArrayLike, /) -> Array: ...
    def ppf(self, q: ArrayLike, /) -> Array: ...
    def isf(self, q: ArrayLike, /) -> Array: ...
    def mean(self) -> float: ...
    def var(self) -> float: ...
    def support(self) -> tuple[float, float]: ...


def is_frozen(distribution: object) -> TypeGuard[Distribution]:
    """Whether this is one continuous distribution with all its parameters."""
    if not all(hasattr(distribution, name) for name in ("pdf", "cdf", "sf", "ppf", "isf")):
        return False
    generic = isinstance(distribution, scipy.stats.rv_continuous)
    if generic and not isinstance(distribution, scipy.stats.rv_histogram):
        return False
    return np.ndim(distribution.ppf(0.5)) == 0  # type: ignore[attr-defined]


def interval_of(distribution: Distribution, tail: float) -> tuple[float, float]:
    """The support; where that has no end, from one quantile to another.

    ``tail`` is the probability left out on either side of an unbounded support. A distribution
    without finite variance is refused: where it is cut would decide about all moments.
    """
    moments = float(distribution.mean()), float(distribution.var())
    if not all(map(math.isfinite, moments)):
        raise OptionError(
            f"{quote(_shown(distribution))} has no finite mean and variance: where it is cut would "
            "decide about all statistics",
            term=distribution,
            remedy=_FINITE_MOMENTS,
        )
    lower, upper = map(float, distribution.support())
    if math.isfinite(lower) and math.isfinite(upper):
        return lower, upper
    return float(distribution.ppf(tail)), float(distribution.isf(tail))


def as_text(distribution: object) -> str:
    """A frozen distribution of scipy.stats as text; an OptionError for any other."""
    family = getattr(distribution, "dist", None)
    name = getattr(family, "name", None)
    if not is_frozen(distribution) or not isinstance(family, scipy.stats.rv_continuous):
        raise OptionError(
            f"{distribution!r} is not a frozen continuous distribution",
            term=distribution,
            remedy=_EXAMPLE,
        )
    if type(family) is not type(getattr(scipy.stats, str(name), None)):
        raise OptionError(
            f"scipy.stats knows no distribution named {quote(name)}",
            term=distribution,
            remedy="give an interval, and the distribution with under={...} in the statistics",
        )
    return _shown(distribution)


def scale_of(text: str, lower: float) -> str:
    """The scale in which a distribution, as text, is natural from ``lower`` on.

    The logarithm for those of a logarithm that is uniform or normal,
    :data:`rankone.tensors.coordinates`.
    """
    distribution: Any = from_text(text)
    arguments, family = distribution.args, distribution.dist
    shift = distribution.kwds.get("loc", 0.0)
    if len(arguments) > family.numargs:
        shift = arguments[family.numargs]
    if lower <= 0.0 or shift != 0.0:
        return LINEAR
    if family.name in _LOGARITHMIC:
        return LOG
    return written_scale(text) or LINEAR


def from_text(text: str) -> Distribution:
    """The frozen distribution of scipy.stats that a text stands for; an OptionError otherwise."""
    try:
        name, arguments, keywords = _parsed(text)
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError):
        raise OptionError(
            f"{quote(text)} is not the name of a distribution with numbers",
            term=text,
            remedy="write it like norm(1, 0.1), as in scipy.stats",
        ) from None
    family = getattr(scipy.stats, name, None)
    if not isinstance(family, scipy.stats.rv_continuous):
        families = vars(scipy.stats).items()
        names = [key for key, kin in families if isinstance(kin, scipy.stats.rv_continuous)]
        raise OptionError(
            f"scipy.stats has no continuous distribution {quote(name)}{did_you_mean(name, names)}",
            term=text,
        )
    try:
        distribution: Distribution = family(*arguments, **keywords)
        median = float(distribution.ppf(0.5))
    except TypeError as error:
        raise OptionError(f"{quote(text)}: {error}", term=text) from None
    if not math.isfinite(median):
        raise OptionError(
            f"{quote(text)} is not defined for these numbers",
            term=text,
            remedy=f"see scipy.stats.{name} for what they may be",
        )
    return distribution


def _shown(distribution: Any) -> str:
    """Name and numbers of a distribution of scipy.stats; the repr of any other."""
    name = getattr(getattr(distribution, "dist", None), "name", None)
    if name is None:
        return repr(distribution)
    arguments = [repr(float(argument)) for argument in distribution.args]
    keywords = [f"{key}={float(argument)!r}" for key, argument in distribution.kwds.items()]
    return f"{name}({', '.join([*arguments, *keywords])})"


def _parsed(text: str) -> tuple[str, list[float], dict[str, float]]:
    call = ast.parse(text.strip(), mode="eval").body
    if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
        raise ValueError(text)
    arguments = [_constant(node) for node in call.args]
    keywords = {word.arg: _constant(word.value) for word in call.keywords if word.arg}
    if len(keywords) < len(call.keywords):
        raise ValueError(text)
    return call.func.id, arguments, keywords


def _constant(node: ast.expr) -> float:
    literal = ast.literal_eval(node)
    if isinstance(literal, bool) or not isinstance(literal, int | float):
        raise ValueError(literal)
    return float(literal)


# --- cut at the ends of an interval --------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Measure:
    """A distribution of one parameter on its interval, of total mass one there.

    It is cut at the ends of the interval, and uniform if none is given. If it comes from the
    problem, its author chose where to cut it, and nobody is warned.
    """

    name: str
    lower: float
    upper: float
    distribution: Distribution | None = None
    from_problem: bool = False

    def __post_init__(self) -> None:
        distribution = self.distribution
        if distribution is None:
            return
        if not is_frozen(distribution):
            raise OptionError(
                f"the distribution of {quote(self.name)} is {distribution!r}, not a frozen "
                "continuous distribution",
                term=distribution,
                remedy=_EXAMPLE,
            )
        if not self.mass > 0.0:
            raise OptionError(
                f"the distribution of {quote(self.name)} has no probability in "
                f"[{self.lower:g}, {self.upper:g}]",
                term=distribution,
                remedy="choose one that fits the box, or solve on another box",
            )
        outside = 1.0 - self.mass
        if outside > COARSE and not math.isfinite(distribution.var()):
            raise OptionError(
                f"the distribution of {quote(self.name)} has no finite mean and variance, and "
                f"{100 * outside:.3g} % of it is outside [{self.lower:g}, {self.upper:g}]: "
                "where it is cut would decide about all statistics",
                term=distribution,
                remedy=_FINITE_MOMENTS,
            )
        if outside > COARSE and not self.from_problem:
            warn(
                f"{100 * outside:.3g} % of the distribution of {quote(self.name)} is outside "
                f"[{self.lower:g}, {self.upper:g}] and left out",
                remedy="solve on a wider box",
            )

    @property
    def key(self) -> object:
        """Equal for the same distribution object."""
        return id(self.distribution)

    @cached_property
    def mass(self) -> float:
        """Probability of the interval before it is cut."""
        if self.distribution is None:
            return 1.0
        below, above = self._ends
        return abs(above - below)

    @cached_property
    def _ends(self) -> tuple[float, float]:
        """Probabilities below both ends, or above them in the upper tail."""
        lower, upper = self._cumulative([self.lower, self.upper])
        return float(lower), float(upper)

    @cached_property
    def _in_upper_tail(self) -> bool:
        """Whether most of the distribution is below the interval: cdf would be one to rounding."""
        return self.distribution is not None and bool(self.distribution.cdf(self.lower) > 0.5)

    def _cumulative(self, points: ArrayLike) -> Array:
        """Probabilities below points, or above them in the upper tail."""
        assert self.distribution is not None
        tail = self.distribution.sf if self._in_upper_tail else self.distribution.cdf
        return tail(points)

    def share(self, lower: float, upper: float) -> float:
        """The probability of a part of the interval."""
        if self.distribution is None:
            return (upper - lower) / (self.upper - self.lower)
        below, above = self._cumulative([lower, upper])
        return float(abs(above - below) / self.mass)

    def cut(self, lower: float, upper: float) -> Measure:
        """The measure on a part of the interval."""
        return Measure(self.name, lower, upper, self.distribution, from_problem=True)

    def integrals(self, basis: Basis1D) -> tuple[Array, Array]:
        """Means of the modes of a basis, (size,), and a root R (size, k) of means of products.

        R R^T has the means of products of two modes. R is found by QR: nothing is squared.
        """
        points, weights = self.quadrature(basis)
        modes = basis.modal_values(points)
        root: Array = np.asarray(np.linalg.qr(np.sqrt(weights)[:, None] * modes, mode="r"))
        return weights @ modes, np.ascontiguousarray(root.T)

    def sample(self, shares: Array) -> Array:
        """Values at shares in [0, 1] of the probability of the interval, from its lower end."""
        if self.distribution is None:
            return np.asarray(self.lower + (self.upper - self.lower) * shares)
        lower, upper = self._ends
        inverse = self.distribution.isf if self._in_upper_tail else self.distribution.ppf
        points = inverse(lower + (upper - lower) * np.clip(shares, *_SHARE_RANGE))
        return np.asarray(np.clip(points, self.lower, self.upper))

    def normal(self, point: float) -> float:
        """The standard normal quantile at the share of the probability below a point."""
        if self.distribution is None:
            share = (point - self.lower) / (self.upper - self.lower)
        else:
            lower, upper = self._ends
            share = (float(self._cumulative(point)) - lower) / (upper - lower)
        return float(ndtri(min(max(share, 4.0 * EPSILON), 1.0 - 4.0 * EPSILON)))

    def rule(self, basis: Basis1D, factors: int = 2) -> tuple[Array, Array]:
        """The Gauss rule of each element: it integrates products of ``factors`` modes.

        The weights have the sum one.
        """
        points, weights = self.quadrature(basis, factors)
        count = factors * (basis.degree - 1) // 2 + 1
        element = np.searchsorted(basis.edges[1:-1], points, side="right")
        masks = [element == e for e in range(basis.elements)]
        scaled = basis.scale.to_scale(points)
        rules = [gauss_rule(scaled[mask], weights[mask], count) for mask in masks]
        scaled, weights = (np.concatenate(arrays) for arrays in zip(*rules, strict=True))
        return basis.scale.from_scale(scaled), weights / weights.sum()

    def quadrature(self, basis: Basis1D, factors: int = 2) -> tuple[Array, Array]:
        """Points and weights of sum one that integrate products of modes."""
        enough = factors * basis.degree // 2 + 1
        if not basis.scale.is_identity:  # the density of x over its scale is another factor
            enough += basis.scale.slope_modes(self.lower, self.upper, inverse=True) // 2
        if self.distribution is None:
            return _panels(basis.edges, enough, 1.0 / (self.upper - self.lower), basis.scale)
        shares = np.concatenate([_PANEL_QUANTILES, 1.0 - _PANEL_QUANTILES])
        quantiles = map(float, self.distribution.ppf(shares))
        inside = [q for q in quantiles if math.isfinite(q) and self.lower < q < self.upper]
        edges = sorted({*basis.edges.tolist(), *inside})
        count = max(_PANEL_NODES, enough)
        points, weights = _panels(np.array(edges), count, 1.0, basis.scale)
        weights = weights * self.distribution.pdf(points)
        if not abs(float(weights.sum()) - self.mass) <= NEGLIGIBLE * self.mass:
            points, weights = self._by_probability(basis)
        return points, weights / weights.sum()

    def _by_probability(self, basis: Basis1D) -> tuple[Array, Array]:
        """Points and weights over the probability, for densities with poles, jumps or gaps.

        Panels are halved until the means of the modes do not change.
        """
        lower, upper = self._ends
        shares = (np.asarray(self._cumulative(basis.edges)) - lower) / (upper - lower)
        edges = np.concatenate([shares, _PANEL_QUANTILES, 1.0 - _PANEL_QUANTILES])
        edges = np.unique(np.clip(edges, 0.0, 1.0))
        waiting = np.stack([edges[:-1], edges[1:]], axis=1)
        rules: list[tuple[Array, Array]] = []
        for level in range(HALVINGS):
            points, weights = self._on_panels(waiting)
            halves = np.repeat(waiting, 2, axis=0)
            halves[::2, 1] = halves[1::2, 0] = waiting.mean(axis=1)
            finer, finer_weights = self._on_panels(halves)
            coarse = _sums(basis, points, weights)
            fine = _sums(basis, finer, finer_weights).reshape(len(waiting), 2, -1).sum(axis=1)
            good = np.abs(fine - coarse).max(axis=1) <= ROUNDING
            good |= level == HALVINGS - 1
            both = np.repeat(good, 2)
            rules.append((finer[both].ravel(), finer_weights[both].ravel()))
            waiting = halves[~both]
            if not len(waiting):
                break
        points, weights = (np.concatenate(arrays) for arrays in zip(*rules, strict=True))
        return points, weights

    def _on_panels(self, panels: Array) -> tuple[Array, Array]:
        """Points and weights on panels (k, 2) of the probability, (k, nodes) each."""
        xi, weights = leggauss(_PANEL_NODES)
        half = 0.5 * (panels[:, 1:] - panels[:, :1])
        return self.sample(panels[:, :1] + half * (xi + 1.0)), half * weights


@dataclass(frozen=True, eq=False)
class PointMeasure(Measure):
    """A parameter that has one value in its interval."""

    at: float = math.nan

    @property
    def key(self) -> object:
        """See :attr:`Measure.key`."""
        return self.at

    def share(self, lower: float, upper: float) -> float:
        """See :meth:`Measure.share`; of two parts the upper one has the point between them."""
        return float(lower <= self.at and (self.at < upper or upper >= self.upper))

    def cut(self, lower: float, upper: float) -> Measure:
        """See :meth:`Measure.cut`."""
        return PointMeasure(self.name, lower, upper, at=self.at)

    def sample(self, shares: Array) -> Array:
        """See :meth:`Measure.sample`."""
        return np.full(np.shape(shares), self.at)

    def quadrature(self, basis: Basis1D, factors: int = 2) -> tuple[Array, Array]:
        """See :meth:`Measure.quadrature`."""
        return np.array([self.at]), np.ones(1)


def gauss_rule(points: Array, weights: Array, count: int) -> tuple[Array, Array]:
    """The Gauss rule of a discrete measure: at most ``count`` of points, exact to 2 count - 1.

    By the Lanczos process with full orthogonalisation (Gautschi, Orthogonal Polynomials, 2004,
    section 2.2.3).
    """
    used = weights > _NEGLIGIBLE_WEIGHT * weights.max(initial=0.0)
    points, weights = points[used], weights[used]
    if points.size <= count:
        return points, weights
    mass = weights.sum()
    centre = float(weights @ points / mass)
    size = float(np.abs(points - centre).max())
    x = (points - centre) / size
    rows = np.sqrt(weights / mass)[None, :]
    while len(rows) < count:
        polynomial = x * rows[-1]
        for _ in range(2):
            polynomial = polynomial - (rows @ polynomial) @ rows
        length = float(np.linalg.norm(polynomial))
        if length < ACCUMULATED:
            break
        rows = np.vstack([rows, polynomial / length])
    nodes, vectors = np.linalg.eigh((rows * x) @ rows.T)
    return centre + size * nodes, mass * vectors[0] ** 2


def _sums(basis: Basis1D, points: Array, weights: Array) -> Array:
    """Sums of the modes over each panel, (panels, size)."""
    modes = basis.modal_values(points.ravel()).reshape(*points.shape, basis.size)
    return np.asarray(np.einsum("kp,kps->ks", weights, modes))


def _panels(edges: Array, count: int, factor: float, scale: Scale) -> tuple[Array, Array]:
    """Gauss-Legendre points in a scale, and weights, on consecutive panels between edges."""
    xi, weights = leggauss(count)
    edges = scale.to_scale(edges)
    half = 0.5 * np.diff(edges)[:, None]
    points = scale.from_scale(edges[:-1, None] + half * (xi + 1.0)).ravel()
    weights = (factor * half * weights).ravel()
    return points, weights if scale.is_identity else weights / scale.slope(points)
