"""Densities and probabilities of the unknowns over the box, from sets of evenly spread points."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d

from rankone.solution.evaluation.core import UnknownView
from rankone.solution.statistics.over_box import BOX_POINTS, StatisticsOverBox, Times
from rankone.solution.statistics.solution_statistics import Statistics
from rankone.support.arrays import COINCIDENT, Array, Labelled, Table, Variables
from rankone.support.errors import (
    EvaluationError,
    OptionError,
    RankoneWarning,
    listing,
    quote,
    shown,
)
from rankone.support.options import checked_count
from rankone.tensors.joint_distribution import SETS, Correlations, Under, half_width, share_of

_VALUES = 512  # Values at which a density is evaluated
_BINS = 4096  # Bins of the histogram that is smoothed
# Standard deviations of kernels in bins: the narrowest is as wide as values are apart
_WIDTHS = np.geomspace(_BINS / _VALUES, _BINS / 8, 16)
_NOISE_WEIGHT = 3.5  # Of noise over smear, which is most at poles and jumps that nothing resolves
_NARROWER = 5  # Kernels below the chosen one is the one that hardly smears, a quarter as wide
_KNOTS, _SMOOTHED = 64, _BINS // 64  # Knots of a scale, and bins over which its slope is smoothed
_LEAST_SHARE = 1e-4  # Added to the probability between knots, so that the scale rises everywhere
# Probabilities of the quantiles that a density prints
_SHOWN_PROBABILITIES = (0.025, 0.25, 0.5, 0.75, 0.975)


@dataclass(frozen=True, repr=False)
class Density(Labelled):
    """Probability density of one unknown at one time.

    Attributes
    ----------
    unknown : str
    values : ndarray (values,)
        Values of the unknown.
    density : ndarray (values,)
        Their density, in one over the unit of the unknown.
    bandwidth : float
        Standard deviation of the kernel, the median over the probability: details finer than that
        are lost. It is narrower where the density is high, and wider in tails.
    half_width : ndarray (values,)
        Half-widths of 95 %: those of a kernel a quarter as wide, from 16 sets of points, and
        what it changes. They do not hold at poles and jumps.
    """

    unknown: str
    values: Array
    density: Array
    bandwidth: float
    half_width: Array

    def quantile(self, q: ArrayLike) -> Array:
        """Quantiles of the unknown at probabilities, from the density at the values."""
        steps = 0.5 * (self.density[1:] + self.density[:-1]) * np.diff(self.values)
        cumulative = np.concatenate([[0.0], np.cumsum(steps)])
        return np.asarray(np.interp(np.asarray(q) * cumulative[-1], cumulative, self.values))

    def _table(self) -> Table:
        peak = float(self.values[np.argmax(self.density)])
        shares = self.quantile(_SHOWN_PROBABILITIES)
        header = ["", "peak", *(f"{100 * q:g} %" for q in _SHOWN_PROBABILITIES)]
        row = [self.unknown, *(f"{x:.5g}" for x in (peak, *shares))]
        remark = f"{self.values.size} values, details finer than {self.bandwidth:.2g} are lost"
        return Table(f"Density of {self.unknown}", header, [row], [remark])

    def _variables(self) -> Variables:
        arrays = {"density": self.density, "half_width": self.half_width}
        return Variables({k: (("value",), x) for k, x in arrays.items()}, {"value": self.values})


@dataclass(frozen=True, repr=False)
class Probability(Labelled):
    """Share of the box, weighted by its distributions, where a condition holds.

    Attributes
    ----------
    value, error : ndarray (*shape of the times)
        The probability and its standard error, from 16 sets of points, each scrambled by its own
        random numbers; at least one over the number of points.
    half_width : ndarray (*shape of the times)
        Half-width of 95 %: from the same sets, at least three over the number of points, and the
        probability of values that are closer to a limit than the error of the solution.
    condition : str
        What is probable, such as ``"u > 2"``.
    times : ndarray
        As they were given; none if nothing depends on time.
    """

    value: Array
    error: Array
    condition: str
    times: Array
    half_width: Array

    def _table(self) -> Table:
        values, widths = np.ravel(self.value), np.ravel(self.half_width)
        when = [f"{time:.6g}" for time in self.times.ravel()] or [""]
        triples = zip(when, values, widths, strict=True)
        rows = [[time, f"{value:.4g}", f"± {width:.1g}"] for time, value, width in triples]
        return Table(f"Probability of {self.condition}", ["time", "probability", "95 %"], rows)

    def _variables(self) -> Variables:
        columns = {"probability": self.value, "error": self.error, "half_width": self.half_width}
        if not self.times.size:
            return Variables({name: ((), x) for name, x in columns.items()}, {})
        arrays = {name: (("time",), np.ravel(x)) for name, x in columns.items()}
        return Variables(arrays, {"time": self.times.ravel()})


class DistributionOverBox(StatisticsOverBox):
    """A solution whose parameters are random: densities and probabilities beside moments."""

    def density(
        self,
        t: Times = None,
        *,
        unknown: object = None,
        values: ArrayLike | None = None,
        under: Under = None,
        correlation: Correlations = None,
        count: int = 2**17,
    ) -> Density:
        """Probability density of one unknown at one time.

        A kernel estimate from 16 sets of scrambled Sobol points, whose kernel does not leak out of
        the range of the values. Its width is the one that smears as much as the sets differ. With
        the default ``count`` the mean absolute error was below 3 % in all of 200 functions of 1 to
        10 parameters. Poles, and jumps inside, are smeared over ``.bandwidth``.

        Parameters
        ----------
        t : float, optional
            One time; none if nothing depends on time.
        unknown : str or Symbol, optional
            An unknown, or a derivative that is a state; by default the only unknown.
        values : array_like, optional
            Values of the unknown at which the density is evaluated; by default 512 over its range.
        under, correlation
            As for :meth:`mean`.
        count : int
            Number of points.

        Raises
        ------
        EvaluationError
            If there is no such unknown, or it does not vary; and as for :meth:`mean`.
        OptionError
            If values are not real numbers, or ``t`` is several times; and as for :meth:`mean`.
        """
        state = self._one(unknown)
        count = checked_count("count", count, 16, self._numbers_each())
        at = None if values is None else _reals("values", values)
        times = self._times(t)
        if times.ndim:
            raise OptionError("t is not one time", term=t, remedy="ask for one after the other")
        statistics = self._statistics(under, correlation)
        points = statistics.parameters.sets_of_points(count)
        sets = [
            own[np.isfinite(own)]
            for own in np.split(statistics.at_points(float(times), points, state.row), SETS)
        ]
        sample = np.concatenate(sets)
        if not sample.size:
            raise EvaluationError(
                f"all trajectories have ended before {self.metadata.time} = {times:g}",
                term=t,
                remedy="ask for an earlier time",
            )
        clock, few = np.linspace(*self.time, 5), points[:, : points.shape[1] // SETS]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RankoneWarning)  # of trajectories that have ended
            largest = statistics.over_points(
                clock, few, lambda states: np.nanmax(np.abs(states[0])), [state.row]
            )
        if np.ptp(sample) <= COINCIDENT * max(np.nanmax(largest), np.abs(sample).max()):
            raise EvaluationError(
                f"{quote(state.name)} does not vary there, and has no density",
                term=t,
                remedy="choose another time, or ask for its mean",
            )
        abscissae, density, error, bandwidth = density_of(sets, None if at is None else at.ravel())
        if at is not None:
            abscissae, density, error = at, density.reshape(at.shape), error.reshape(at.shape)
        return Density(state.name, abscissae, density, bandwidth, error)

    def probability(
        self,
        t: Times = None,
        *,
        unknown: object = None,
        above: float | None = None,
        below: float | None = None,
        under: Under = None,
        correlation: Correlations = None,
        count: int = BOX_POINTS,
    ) -> Probability:
        """Probability that an unknown is above, below or between values at times.

        It is a share of scrambled Sobol points in 16 sets, and comes with a half-width of 95 %: at
        most 1e-2 with the default ``count``, and often below 1e-3, beside what the error of the
        solution makes doubtful. Small probabilities need more points.

        Parameters
        ----------
        t, under, correlation
            As for :meth:`mean`.
        unknown : str or Symbol, optional
            An unknown, or a derivative that is a state; by default the only unknown.
        above, below : float
            One of them, or both for an interval.
        count : int
            Number of points.

        Returns
        -------
        Probability
            ``.value``, its standard error ``.error`` and ``.half_width`` of 95 %, each of the shape
            of t.

        Raises
        ------
        EvaluationError
            If there is no such unknown; and as for :meth:`mean`.
        OptionError
            If neither ``above`` nor ``below`` is given, or one is not a number; and as for
            :meth:`mean`.
        """
        row = self._one(unknown).row
        count = checked_count("count", count, SETS, self._numbers_each())
        if above is None and below is None:
            raise OptionError(
                "a probability needs a limit", remedy="give above=value, below=value, or both"
            )
        lower = -np.inf if above is None else _reals("above", above)
        upper = np.inf if below is None else _reals("below", below)
        if np.ndim(lower) or np.ndim(upper) or not lower < upper:
            raise OptionError(
                f"above={above!r} and below={below!r} are not the ends of an interval",
                term=(above, below),
            )
        statistics = self._statistics(under, correlation)

        uncertain = self._uncertain(statistics, row)

        def share(states: Array) -> Array:
            """The share inside, its error and half-width, and the share that errors may move."""
            runs = np.isfinite(states[0])
            near = [
                (states[0] > lower - change) & (states[0] < upper + change)
                for change in (0.0, uncertain, -uncertain)
            ]
            hits, wider, narrower = np.array(near).reshape(3, SETS, -1).sum(axis=2)
            sampled = share_of(hits, runs.reshape(SETS, -1).sum(axis=1))
            doubtful = np.maximum(wider - hits, hits - narrower).sum() / runs.sum()
            return np.array([*sampled, doubtful])

        def shares(times: Array) -> Array:
            points = statistics.parameters.sets_of_points(count)
            return statistics.over_points(times, points, share, [row])

        value, error, sampled, doubtful = self._at(t, shares)
        ends = f"{lower:g} < " if above is not None and below is not None else ""
        side = f" > {lower:g}" if below is None else f" < {upper:g}"
        condition = f"{ends}{self.states[row]}{side}"
        clock = np.asarray([] if t is None else t, dtype=float)
        return Probability(value, error, condition, clock, sampled + doubtful)

    def _uncertain(self, statistics: Statistics, row: int) -> float:
        """The error of a state, as the solution measured it: zero if it is no unknown."""
        if row not in statistics.rows:
            return 0.0
        return float(self._sizes_and_errors(statistics)[1][statistics.rows.index(row)])

    def _one(self, unknown: object) -> UnknownView:
        """One state; the only unknown where none is named."""
        if unknown is None and len(self.unknowns) == 1:
            return self[self.unknowns[0]]
        if unknown is None:
            raise EvaluationError(
                f"there are several unknowns, {listing(self.unknowns)}",
                remedy=f"say which: unknown={self.unknowns[0]!r}",
            )
        return self[unknown]


def density_of(sets: Sequence[Array], at: Array | None) -> tuple[Array, Array, Array, float]:
    """Values, density and its half-width there, and bandwidth of a kernel estimate from sets.

    At 512 values if none are given. The kernel is as wide as the sets justify. A wider one averages
    more: its noise, by which the sets differ, is smaller. What it smears is what it changes beyond
    that noise in the estimate of some narrower kernel, and the sum of both is least (Goldenshluger
    & Lepski, "Bandwidth selection in kernel density estimation", Annals of Statistics 39, 2011;
    they bound the noise where we measure it). It is narrower where the density is high: it has one
    width on a scale that is stretched there. Near the ends of the range, where the density may
    jump, it is fitted by a line instead of a constant (Jones, "Simple boundary correction for
    kernel density estimation", Statistics and Computing 3, 1993).
    """
    sample = np.concatenate(list(sets))
    lower, upper = float(sample.min()), float(sample.max())
    scale = _Scale(sample)
    shares = np.array(
        [np.histogram(scale(own), _BINS, (0.0, 1.0))[0] / own.size for own in sets if own.size]
    )
    estimates = np.array([_fitted(shares, width) for width in _WIDTHS])
    means = estimates.mean(axis=1)
    noise = np.array([_noise(own) for own in estimates])
    smeared = np.zeros(_WIDTHS.size)
    for wide, narrow in combinations(range(_WIDTHS.size - 1, -1, -1), 2):
        apart = np.abs(means[wide] - means[narrow]).mean()
        by_chance = _noise(estimates[wide] - estimates[narrow])
        smeared[wide] = max(smeared[wide], np.sqrt(max(apart**2 - by_chance**2, 0.0)))
    best = int(np.argmin(smeared + _NOISE_WEIGHT * noise))
    smooth = np.maximum(means[best], 0.0)
    narrower = max(best - _NARROWER, 0)
    errors = np.abs(means[best] - means[narrower]) + half_width(estimates[narrower])
    if at is None:
        at = np.linspace(lower, upper, _VALUES)
    centres, places = (np.arange(_BINS) + 0.5) / _BINS, scale(at)
    rise = np.where((at >= lower) & (at <= upper), scale.slope(at), 0.0) / smooth.mean()
    density, error = (rise * np.interp(places, centres, each) for each in (smooth, errors))
    bandwidth = np.median(_WIDTHS[best] / _BINS / scale.slope(sample))
    return at, density, error, float(bandwidth)


class _Scale:
    """A scale from 0 to 1 over the range of a sample, smooth, and steeper where it is denser.

    Its slope is about the power 1/3 of the density: with the density itself all values were as
    likely, but tails were smeared.
    """

    def __init__(self, sample: Array) -> None:
        lower, upper = sample.min(), sample.max()
        quantiles = np.quantile(sample, np.linspace(0.0, 1.0, _KNOTS))
        knots = np.union1d(quantiles, np.linspace(lower, upper, _KNOTS // 4))
        below = np.searchsorted(np.sort(sample), knots, side="right") / sample.size
        below[0] = 0.0
        steps = np.cbrt((np.diff(below) + _LEAST_SHARE) * np.diff(knots / (upper - lower)) ** 2)
        rough = np.append(0.0, np.cumsum(steps)) / steps.sum()
        self.edges = np.linspace(0.0, 1.0, _BINS + 1)
        lengths = np.log(np.diff(np.interp(self.edges, rough, knots)))
        lengths = np.exp(gaussian_filter1d(lengths, _SMOOTHED, mode="nearest"))
        lengths *= (upper - lower) / lengths.sum()
        self.places = np.append(lower + np.cumsum(lengths) - lengths, upper)
        self.slopes = 1.0 / (_BINS * lengths)

    def __call__(self, x: Array) -> Array:
        """The scale at values."""
        return np.asarray(np.interp(x, self.places, self.edges))

    def slope(self, x: Array) -> Array:
        """Its slope there."""
        return np.asarray(np.interp(x, 0.5 * (self.places[1:] + self.places[:-1]), self.slopes))


def _noise(of_sets: Array) -> float:
    """The mean error of the mean of estimates (sets, bins): of absolute normal numbers."""
    spread = of_sets.std(axis=0, ddof=1) / np.sqrt(len(of_sets))
    return float(np.sqrt(2.0 / np.pi) * spread.mean())


def _fitted(shares: Array, bandwidth: float) -> Array:
    """Lines fitted to shares of bins (sets, bins) with a normal kernel of a bandwidth in bins."""
    reach = min(int(8.0 * bandwidth) + 1, _BINS - 1)
    u = np.arange(-reach, reach + 1) / bandwidth
    kernel = np.exp(-0.5 * u**2)

    def around(of: Array, power: int) -> Array:
        """Sums of what is around each bin, with powers of the distance."""
        sums = scipy.signal.fftconvolve(of, (kernel * (-u) ** power)[None], axes=1)
        return np.asarray(sums[:, reach : reach + _BINS])

    ones = np.ones((1, _BINS))
    zeroth, first, second = (around(ones, power) for power in range(3))
    intercept = second * around(shares, 0) - first * around(shares, 1)
    return np.asarray(intercept / (zeroth * second - first**2)) * _BINS


def _reals(name: str, given: ArrayLike) -> Array:
    """Finite real numbers."""
    try:
        array = np.asarray(given)
        if array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            raise TypeError
        return array.astype(float)
    except (TypeError, ValueError):
        raise OptionError(f"{name}={shown(given)} are not real numbers", term=given) from None
