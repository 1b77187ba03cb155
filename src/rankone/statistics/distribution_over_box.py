"""More of the distribution of a solution over its box, as methods."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.statistics.densities import Density, Probability, density_of
from rankone.statistics.over_box import StatisticsOverBox
from rankone.statistics.solution_statistics import Statistics
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.options import checked_count, checked_number
from rankone.support.wording import did_you_mean, listing, quote, shown

__all__ = ["DistributionOverBox", "MainEffects"]

_SETS = 8
"""Sets of points of which the spread is the error of a probability."""
_CONSTANT = 1e-12
"""Range of values, relative to their size, below which there is no density."""

_Given = Mapping[Any, Any] | None


@dataclass(frozen=True)
class MainEffects:
    """Means of the unknowns given one parameter.

    Attributes
    ----------
    parameters, unknowns : tuple of str
    times : ndarray
        As they were given; none if nothing depends on time.
    values : dict of str to ndarray (count,)
        Values of each parameter, from one end of its interval to the other.
    means : dict of str to ndarray (unknowns, count, *shape of the times)
    """

    parameters: tuple[str, ...]
    unknowns: tuple[str, ...]
    times: Array
    values: dict[str, Array]
    means: dict[str, Array]


class DistributionOverBox(StatisticsOverBox):
    """A solution whose parameters are random: higher moments, main effects, densities."""

    def moment(
        self,
        order: int,
        t: Any = None,
        *,
        under: _Given = None,
        correlation: _Given = None,
        central: bool = True,
    ) -> Array:
        """Means of powers of the unknowns, minus their means if ``central``.

        Nothing is sampled. The third and fourth are inner products of squares of the tensor train,
        truncated first to a tenth of the solution's ``rtol``, relative to the standard deviation.
        Their cost grows with the sixth power of the ranks left; where these are above 32 for a
        single unknown and time, more is truncated, and from 1e-5 on a warning says so.

        Parameters
        ----------
        order : int
            From 1 to 4.
        t, under
            As for :meth:`mean`.
        correlation
            As for :meth:`mean`, for orders up to 2.
        central : bool

        Returns
        -------
        ndarray (unknowns, *shape of t)
            In the unit of the unknown to the power of the order.

        Raises
        ------
        OptionError
            If the order is another, or is 3 or 4 and parameters are correlated; and as for
            :meth:`mean`.
        """
        order = checked_number("order", order, 1, 4)
        if order == 1:
            mean = self.mean(t, under=under, correlation=correlation)
            return np.zeros_like(mean) if central else mean
        if order == 2:
            variance = self.var(t, under=under, correlation=correlation)
            if central:
                return variance
            return variance + self.mean(t, under=under, correlation=correlation) ** 2
        size, *shares = self._higher(t, under, correlation, central)
        return np.asarray(size**order * np.nan_to_num(shares[order - 3]))

    def skewness(self, t: Any = None, *, under: _Given = None, correlation: _Given = None) -> Array:
        """Third central moments over the cubes of the standard deviations.

        Arguments, shape and errors as for :meth:`moment`. NaN where nothing varies; where the
        standard deviation is below the error of the solution, they are those of the error.
        """
        return np.asarray(self._higher(t, under, correlation, True)[1])

    def kurtosis(self, t: Any = None, *, under: _Given = None, correlation: _Given = None) -> Array:
        """Fourth central moments over the squared variances, minus 3 (0 for a normal distribution).

        Arguments, shape and errors as for :meth:`moment`. NaN where nothing varies; where the
        standard deviation is below the error of the solution, they are those of the error.
        """
        return np.asarray(self._higher(t, under, correlation, True)[2] - 3.0)

    def main_effects(
        self,
        t: Any = None,
        *,
        count: int = 101,
        under: _Given = None,
        correlation: _Given = None,
    ) -> MainEffects:
        """Means of the unknowns as functions of each parameter, over all others.

        Exact for the tensor train. Of correlated parameters the others follow the one that is
        given: what is seen is what is observed, not what a change of this one alone would do.

        Parameters
        ----------
        t, under, correlation
            As for :meth:`mean`.
        count : int
            Number of values of each parameter, from one end of its interval to the other.
        """
        count = checked_count("count", count, 2, self._numbers_each())
        values = {name: np.linspace(*ends, count) for name, ends in self.parameters.items()}

        def mean(j: int, points: Array) -> Array:
            def of(statistics: Statistics, times: Array) -> Array:
                return statistics.main_effect(times, j, points)

            return self._over_box(t, under, of, correlation)

        means = {name: mean(j, values[name]) for j, name in enumerate(values)}
        times = np.asarray([] if t is None else t, dtype=float)
        return MainEffects(tuple(values), self.unknowns, times, values, means)

    def density(
        self,
        t: Any = None,
        *,
        unknown: Any = None,
        values: Any = None,
        under: _Given = None,
        correlation: _Given = None,
        count: int = 2**14,
    ) -> Density:
        """Probability density of one unknown at one time.

        A kernel estimate from evenly spread points, whose kernel does not leak out of the range of
        the values. Smooth densities, which may jump at the ends of the range, are met to 1 or 2 %
        of their peak with the default ``count``; kinks and jumps inside and poles are smeared out
        over ``.bandwidth``.

        Parameters
        ----------
        t : float, optional
            One time; none if nothing depends on time.
        unknown : str or Symbol, optional
            Which one, or a derivative that is a state; not needed if there is only one unknown.
        values : array_like, optional
            Where the density is wanted; otherwise 512 values over the range.
        under, correlation
            As for :meth:`mean`.
        count : int
            Number of points.

        Raises
        ------
        EvaluationError
            If there is no such unknown, or it does not vary; and as for :meth:`mean`.
        OptionError
            If values are no real numbers, or times are several; and as for :meth:`mean`.
        """
        name, row = self._one(unknown)
        count = checked_count("count", count, 16, self._numbers_each())
        at = None if values is None else _reals("values", values)
        times = self._times(t)
        if times.ndim:
            raise OptionError("t is not one time", term=t, remedy="ask for one after the other")
        self._evaluator  # noqa: B018 - raises if nothing was solved
        statistics = self._statistics(under, correlation)
        points = statistics.points(count)
        each = np.array([float(times), *np.linspace(*self.time, 5)])
        samples = statistics.over_points(each, points, lambda found: found[0], [row])
        sample = samples[:, 0]
        if np.ptp(sample) <= _CONSTANT * np.abs(samples).max():
            raise EvaluationError(
                f"{quote(name)} does not vary there, and has no density",
                term=t,
                remedy="choose another time, or ask for its mean",
            )
        found, density, bandwidth = density_of(sample, None if at is None else at.ravel())
        if at is not None:
            found, density = at, density.reshape(at.shape)
        return Density(name, found, density, bandwidth)

    def probability(
        self,
        t: Any = None,
        *,
        unknown: Any = None,
        above: float | None = None,
        below: float | None = None,
        under: _Given = None,
        correlation: _Given = None,
        count: int = 2**15,
    ) -> Probability:
        """Probability that an unknown is above, below or between values at times.

        The share of evenly spread points. Its error is part of the answer; with the default
        ``count`` it is about 1e-3 or less. Probabilities that small need more points.

        Parameters
        ----------
        t, under, correlation
            As for :meth:`mean`.
        unknown : str or Symbol, optional
            Which one, or a derivative that is a state; not needed if there is only one unknown.
        above, below : float
            One of them, or both for an interval.
        count : int
            Number of points.

        Returns
        -------
        Probability
            ``.value`` and its standard error ``.error``, each of the shape of t.

        Raises
        ------
        EvaluationError
            If there is no such unknown; and as for :meth:`mean`.
        OptionError
            If neither ``above`` nor ``below`` is given, or one is no number; and as for
            :meth:`mean`.
        """
        _, row = self._one(unknown)
        count = checked_count("count", count, _SETS, self._numbers_each())
        if above is None and below is None:
            raise OptionError(
                "a probability of what?", remedy="give above=value, below=value, or both"
            )
        lower = -np.inf if above is None else _reals("above", above)
        upper = np.inf if below is None else _reals("below", below)
        if np.ndim(lower) or np.ndim(upper) or not lower < upper:
            raise OptionError(
                f"above={above!r} and below={below!r} are not the ends of an interval",
                term=(above, below),
            )

        def of(statistics: Statistics, times: Array) -> Array:
            def share(values: Array) -> Array:
                return np.asarray(np.mean((values[0] > lower) & (values[0] < upper)))

            each = (statistics.points(count // _SETS, seed) for seed in range(_SETS))
            return np.array([statistics.over_points(times, p, share, [row]) for p in each])

        shares = self._over_box(t, under, of, correlation)
        error = shares.std(axis=0, ddof=1) / np.sqrt(_SETS)
        return Probability(shares.mean(axis=0), np.maximum(error, 1.0 / count))

    def _higher(self, t: Any, under: _Given, correlation: _Given, central: bool) -> Array:
        """Root mean squares, and third and fourth moments relative to them."""
        if self._copula(correlation) is not None:
            raise OptionError(
                "third and fourth moments are not there for correlated parameters",
                term=correlation,
                remedy="take those of samples: solution(t=t, **solution.sample(10**5, "
                "correlation=...))",
            )

        def of(statistics: Statistics, times: Array) -> Array:
            return statistics.higher(times, central, 0.1 * self.rtol)

        return self._over_box(t, under, of, correlation)

    def _one(self, unknown: Any) -> tuple[str, int]:
        """Name and row of one state."""
        if unknown is None and len(self.unknowns) == 1:
            return self.unknowns[0], self.metadata.unknown_rows[0]
        if unknown is None:
            raise EvaluationError(
                f"there are several unknowns, {listing(self.unknowns)}",
                remedy=f"say which: unknown={self.unknowns[0]!r}",
            )
        name = name_of(unknown, self.metadata.time)
        if name not in self.states:
            raise EvaluationError(
                f"no unknown {quote(name)}{did_you_mean(name, self.states)}; "
                f"the solution holds {listing(self.states)}",
                term=unknown,
            )
        return name, self.states.index(name)


def _reals(name: str, given: Any) -> Array:
    """Finite real numbers."""
    try:
        numbers = np.asarray(given)
        if numbers.dtype.kind not in "iuf" or not np.isfinite(numbers).all():
            raise TypeError
        return numbers.astype(float)
    except (TypeError, ValueError):
        raise OptionError(f"{name}={shown(given)} are no real numbers", term=given) from None
