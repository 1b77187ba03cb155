"""Joint distributions of the coordinates, and points drawn from them in sets.

Standard normal numbers z with the correlations given are turned into shares Phi(z) of the
probability of each parameter, and these into its values. The distribution of each parameter alone
stays as it is (Nelsen, An Introduction to Copulas, 2006, section 2.3).
"""

from __future__ import annotations

import itertools
import math
import numbers
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
import scipy
from scipy.special import ndtr, ndtri

from rankone.support.arrays import EPSILON, NEGLIGIBLE, SEED, TINY, Array
from rankone.support.errors import OptionError, did_you_mean, listing, quote, shown
from rankone.support.options import LEVEL
from rankone.tensors.coordinates import name_of
from rankone.tensors.distributions import Distribution, Measure, PointMeasure

Entry = TypeVar("Entry")
Distributions = Mapping[Any, Distribution] | None
"""Distributions by parameter, a name or a symbol; those of the problem where none are given."""
Correlations = Mapping[Any, float] | None
"""Correlations by pair of parameters, names or symbols; None for those of the problem."""


class Known(NamedTuple):
    """What a fit says of parameters: distributions, their correlations, and fixed values.

    ``open`` are parameters that have several values in the experiments of the fit.
    """

    distributions: dict[str, Distribution]
    correlation: dict[tuple[str, str], float]
    fixed: dict[str, float]
    open: tuple[str, ...]


@runtime_checkable
class Fitted(Protocol):
    """A fit, whose estimates are uncertain."""

    @property
    def known(self) -> Known:
        """The distribution of the parameters."""


Under = Distributions | Fitted
"""Distributions by parameter, or a fit."""

_LARGEST_NORMAL = 6.5  # Largest normal number of the quadrature; the probability beyond is 1e-10
_MOST_GRID_DIMENSIONS = 3  # Most correlated parameters for a grid; more take evenly spread points
# Steps of grids in normal numbers, finer and finer
_GRID_STEPS = 0.5 ** (np.arange(9) / 2)
_MOST_GRID_POINTS = 2**17  # Most points of a grid, to bound time and memory
_EVEN_POINTS = 2**14  # Evenly spread points, which are good to about 1e-3 of the standard deviation


@dataclass(frozen=True)
class Copula:
    """Correlations of the normal numbers of some parameters.

    ``positions``, ascending, are the parameters that are correlated with some other.
    """

    positions: tuple[int, ...]
    matrix: tuple[tuple[float, ...], ...]

    @cached_property
    def root(self) -> Array:
        """The upper triangle U with U U^T = matrix: the last parameter depends on one number."""
        return np.linalg.cholesky(np.array(self.matrix)[::-1, ::-1])[::-1, ::-1]

    def joined(self, shares: Array) -> Array:
        """Shares (d, M) of all parameters: independent ones turned into correlated ones."""
        joined, rows = shares.copy(), list(self.positions)
        joined[rows] = ndtr(self.root @ _normals(shares[rows]))
        return joined

    def rules(self) -> list[tuple[Array, Array]]:
        """Quadratures over the correlated parameters, finer and finer: shares (k, Q), weights (Q,).

        The trapezoidal rule in independent normal numbers, which converges exponentially for smooth
        functions (Trefethen, "Exactness of quadrature formulas", SIAM Review 64, 2022); one rule of
        evenly spread points for more than three parameters.
        """
        return [(ndtr(self.root @ z), weights) for z, weights in _normal(len(self.positions))]

    def given(self, index: int, normal: float) -> list[tuple[Array, Array]]:
        """The same, conditional on the normal number of the parameter at ``index``."""
        rules = _normal(len(self.positions) - 1)
        return [(self._shares_given(index, normal, z), weights) for z, weights in rules]

    def joined_given(self, shares: Array, index: int, normal: float) -> Array:
        """Shares (d, M) as :meth:`joined` has them, conditional on the parameter at ``index``."""
        joined, rows = shares.copy(), list(self.positions)
        free = [j for i, j in enumerate(rows) if i != index]
        joined[rows] = self._shares_given(index, normal, _normals(shares[free]))
        return joined

    def _shares_given(self, index: int, normal: float, z: Array) -> Array:
        """Shares (k, M) of the correlated parameters from independent normal numbers (k - 1, M)."""
        matrix = np.array(self.matrix)
        free = [i for i in range(len(matrix)) if i != index]
        slope = matrix[free, index]
        root = np.linalg.cholesky(matrix[np.ix_(free, free)] - np.outer(slope, slope))
        every = np.insert(slope[:, None] * normal + root @ z, index, normal, axis=0)
        return np.asarray(ndtr(every))


def _normals(shares: Array) -> Array:
    """Normal numbers whose probabilities are shares."""
    return np.asarray(ndtri(np.clip(shares, TINY, 1.0 - 0.5 * EPSILON)))


def _normal(count: int) -> list[tuple[Array, Array]]:
    """Quadratures for independent standard normal numbers."""
    if count > _MOST_GRID_DIMENSIONS:
        shares = even_shares(_EVEN_POINTS, count, SEED)
        return [
            (ndtri(np.clip(shares, 4.0 * EPSILON, 1.0)), np.full(_EVEN_POINTS, 1.0 / _EVEN_POINTS))
        ]
    rules = []
    for step in _GRID_STEPS:
        line = np.arange(-_LARGEST_NORMAL, _LARGEST_NORMAL + 0.5 * step, step)
        if 0.8 * line.size**count > _MOST_GRID_POINTS:
            break
        z = np.stack(np.meshgrid(*[line] * count, indexing="ij")).reshape(count, -1)[::-1]
        squares = np.sum(z**2, axis=0)
        inside = squares <= _LARGEST_NORMAL**2
        weights = np.exp(-0.5 * squares[inside])
        rules.append((z[:, inside], weights / weights.sum()))
    return rules


def copula_of(names: Sequence[str], correlation: Correlations) -> Copula | None:
    """The copula of correlations by pairs of parameters; None if nothing is correlated.

    Pairs occur once and lie inside (-1, 1); their matrix must be positive definite.
    """
    if not isinstance(correlation, Mapping | None):
        raise OptionError(
            f"correlation={shown(correlation)} is not a mapping from pairs to numbers",
            term=correlation,
            remedy="give {(k, c): 0.6}",
        )
    coefficients: dict[tuple[int, int], float] = {}
    for key, coefficient in (correlation or {}).items():
        pair = _pair(names, key)
        if pair in coefficients:
            raise OptionError(
                f"the correlation of {listing(names[i] for i in pair)} is given twice", term=key
            )
        coefficients[pair] = _coefficient(names, pair, coefficient)
    coefficients = {pair: coefficient for pair, coefficient in coefficients.items() if coefficient}
    if not coefficients:
        return None
    positions = sorted(set(itertools.chain(*coefficients)))
    matrix = np.eye(len(positions))
    for (i, j), coefficient in coefficients.items():
        a, b = positions.index(i), positions.index(j)
        matrix[a, b] = matrix[b, a] = coefficient
    if np.linalg.eigvalsh(matrix)[0] < NEGLIGIBLE:
        raise OptionError(
            f"the correlations of {listing(names[i] for i in positions)} contradict each other: "
            "their matrix is not positive definite",
            term=correlation,
            remedy="pairs that are left out have the correlation 0; give all pairs, or smaller "
            "numbers",
        )
    return Copula(tuple(positions), tuple(map(tuple, matrix.tolist())))


def _pair(names: Sequence[str], key: object) -> tuple[int, int]:
    """Positions of two parameters, ascending."""
    if not isinstance(key, tuple | frozenset) or len(key) != 2:
        raise OptionError(
            f"{shown(key)} is not a pair of parameters",
            term=key,
            remedy="give correlation={(k, c): 0.6}",
        )
    i, j = sorted(names.index(_checked_name(names, parameter)) for parameter in key)
    if i == j:
        raise OptionError(f"{quote(names[i])} is paired with itself", term=key)
    return i, j


def _checked_name(names: Sequence[str], key: object, prefix: str = "") -> str:
    """The name of a parameter; an OptionError if there is no such parameter."""
    name = name_of(key)
    if name not in names:
        raise OptionError(
            f"{prefix}there is no parameter {quote(name)}{did_you_mean(name, names)}",
            term=name,
            remedy=f"known are {listing(names)}" if names else "the solution has none",
        )
    return name


def _coefficient(names: Sequence[str], pair: tuple[int, int], given: object) -> float:
    """A correlation inside of (-1, 1)."""
    real = isinstance(given, numbers.Real) and not isinstance(given, bool)
    coefficient = float(given) if real else math.nan  # type: ignore[arg-type]
    if -1.0 < coefficient < 1.0:
        return coefficient
    raise OptionError(
        f"the correlation of {listing(names[i] for i in pair)} is {shown(given)}, not a number "
        "between -1 and 1",
        term=given,
        remedy="write one parameter by the other in the equations"
        if math.isclose(abs(coefficient), 1.0)
        else None,
    )


def measures_of(
    names: Sequence[str],
    box: Sequence[tuple[float, float]],
    under: Distributions,
    from_problem: Mapping[str, Distribution],
) -> tuple[Measure, ...]:
    """The measure of each parameter: as given, from the problem, or else uniform."""
    named = by_name("under", under, names)
    return tuple(
        Measure(name, *ends, named.get(name, from_problem.get(name)), name not in named)
        for name, ends in zip(names, box, strict=True)
    )


def fitted_distribution(
    names: Sequence[str],
    box: Sequence[tuple[float, float]],
    fit: Fitted,
    correlation: Correlations,
    from_problem: Mapping[str, Distribution],
) -> JointDistribution:
    """Parameters as a fit knows them; those that it does not know have what the problem says.

    An OptionError if the fit knows none of them, or has a value for each experiment.
    """
    estimate = fit.known
    several = [name for name in names if name in estimate.open]
    if several:
        raise OptionError(
            f"under: experiments or doses of the fit have their own values of {listing(several)}",
            term=tuple(several),
            remedy="fix values, and ask that solution: "
            f"solution.fix({', '.join(f'{name}=...' for name in several)})",
        )
    if not {*estimate.distributions, *estimate.fixed} & {*names}:
        raise OptionError(
            f"under: the fit is of {listing(estimate.distributions)}, and the solution has "
            f"{listing(names) if names else 'no parameters'}",
            remedy="give a fit of this solution",
        )
    measures: list[Measure] = []
    for name, (lower, upper) in zip(names, box, strict=True):
        if name not in estimate.fixed:
            of_fit = estimate.distributions.get(name)
            distribution = from_problem.get(name) if of_fit is None else of_fit
            measures.append(Measure(name, lower, upper, distribution, from_problem=of_fit is None))
            continue
        if not lower <= estimate.fixed[name] <= upper:
            raise OptionError(
                f"under: the fit has {name} = {estimate.fixed[name]:g}, outside "
                f"[{lower:g}, {upper:g}]",
                term=name,
                remedy="solve on a box that holds it",
            )
        measures.append(PointMeasure(name, lower, upper, at=estimate.fixed[name]))
    if correlation is None:
        correlation = {pair: c for pair, c in estimate.correlation.items() if {*pair} <= {*names}}
    return JointDistribution(tuple(measures), copula_of(names, correlation))


def by_name(
    option: str, given: Mapping[Any, Entry] | None, names: Sequence[str]
) -> dict[str, Entry]:
    """The entries of an option that is a mapping from parameters, by names."""
    if not isinstance(given, Mapping | None):
        raise OptionError(
            f"{option}={given!r} is not a mapping from parameters",
            term=given,
            remedy=f"give {option}={{name: ...}}",
        )
    named: dict[str, Entry] = {}
    for key, entry in (given or {}).items():
        name = _checked_name(names, key, f"{option}: ")
        if name in named:
            raise OptionError(f"{option}: {quote(name)} is given twice", term=given)
        named[name] = entry
    return named


@dataclass(frozen=True)
class JointDistribution:
    """The distribution of all parameters over their box; without a copula they are independent."""

    measures: tuple[Measure, ...]
    copula: Copula | None = None

    @property
    def key(self) -> tuple[object, ...]:
        """Equal for equal correlations of the same distribution objects."""
        return self.copula, tuple(measure.key for measure in self.measures)

    def points(self, shares: Array) -> Array:
        """Values of the parameters at independent shares of their probability, (d, count)."""
        if self.copula is not None:
            shares = self.copula.joined(shares)
        rows = [measure.sample(row) for measure, row in zip(self.measures, shares, strict=True)]
        return np.array(rows).reshape(len(self.measures), shares.shape[1])

    def points_given(self, j: int, place: float, shares: Array) -> Array:
        """Values (d, M) where one parameter has a value, at shares (d - 1, M) of the others."""
        every = np.insert(shares, j, 0.5, axis=0)
        if self.copula is not None and j in self.copula.positions:
            normal = self.measures[j].normal(place)
            every = self.copula.joined_given(every, self.copula.positions.index(j), normal)
        elif self.copula is not None:
            every = self.copula.joined(every)
        rows = [measure.sample(row) for measure, row in zip(self.measures, every, strict=True)]
        rows[j] = np.full(shares.shape[1], place)
        return np.array(rows)

    def even_points(self, count: int) -> Array:
        """Evenly spread values of the parameters, (d, count)."""
        return self.points(even_shares(count, len(self.measures), SEED))

    def sets_of_points(self, count: int) -> Array:
        """About ``count`` values in sets, one after the other, (d, SETS * each)."""
        shares = sets_of_shares(count, len(self.measures), SEED)
        return np.hstack([self.points(each) for each in shares])

    def require_independent(self, message: str, remedy: str) -> None:
        """Raise an OptionError if parameters are correlated."""
        if self.copula is not None:
            names = tuple(self.measures[i].name for i in self.copula.positions)
            raise OptionError(message, term=names, remedy=remedy)


# -----------------------------------------------------------------------------
# Points drawn for statistics, in sets whose spread is the error of what they say.
#
# Each set is a Sobol sequence that is scrambled by random numbers of its own. The mean over a set
# has the right expectation, so the sets tell the error of their mean, whatever the function
# (L'Ecuyer, Nakayama, Owen & Tuffin, "Confidence intervals for randomized quasi-Monte Carlo
# estimators", Proceedings of the Winter Simulation Conference, 2023).


SETS = 16
"""Sets of points that are scrambled independently."""
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
