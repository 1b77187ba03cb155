"""Densities and probabilities of the unknowns over the box, from evenly spread points."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.fft import dct
from scipy.optimize import brentq

from rankone.solution.core import UnknownView
from rankone.statistics.joint_distribution import Correlations, Distributions
from rankone.statistics.over_box import StatisticsOverBox, Times
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError, RankoneWarning
from rankone.support.labelled import Labelled, Table, Variables
from rankone.support.options import checked_count
from rankone.support.wording import listing, quote, shown

_BINS = 4096  # Bins of the histogram that is smoothed; far narrower than any kernel
# Probabilities of the quantiles that a density prints
_SHOWN_PROBABILITIES = (0.025, 0.25, 0.5, 0.75, 0.975)
_POINT_SETS = 8  # Sets of points whose spread is the error of a probability
_STILL = 1e-12  # Range of values, relative to their size, below which there is no density: rounding


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
        Standard deviation of the kernel: details finer than that are lost.
    """

    unknown: str
    values: Array
    density: Array
    bandwidth: float

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
        return Variables({"density": (("value",), self.density)}, {"value": self.values})


@dataclass(frozen=True, repr=False)
class Probability(Labelled):
    """Share of the box, weighted by its distributions, where a condition holds.

    Attributes
    ----------
    value, error : ndarray (*shape of the times)
        The probability and its standard error, from eight sets of points, each shifted by its own
        random numbers; at least one over the number of points.
    condition : str
        What is probable, such as ``"u > 2"``.
    times : ndarray
        As they were given; none if nothing depends on time.
    """

    value: Array
    error: Array
    condition: str
    times: Array

    def _table(self) -> Table:
        values, errors = np.ravel(self.value), np.ravel(self.error)
        when = [f"{time:.6g}" for time in self.times.ravel()] or [""]
        triples = zip(when, values, errors, strict=True)
        rows = [[time, f"{value:.4g}", f"{error:.1g}"] for time, value, error in triples]
        return Table(f"Probability of {self.condition}", ["time", "probability", "error"], rows)

    def _variables(self) -> Variables:
        columns = {"probability": self.value, "error": self.error}
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
        under: Distributions = None,
        correlation: Correlations = None,
        count: int = 2**14,
    ) -> Density:
        """Probability density of one unknown at one time.

        A kernel estimate from evenly spread points, whose kernel does not leak out of the range of
        the values. With the default ``count`` it is good to 1 or 2 % of the peak for smooth
        densities, also if they jump at the ends of the range; it smears poles, and kinks and jumps
        inside, over ``.bandwidth``.

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
        points = statistics.parameters.even_points(count)
        sample = statistics.at_points(float(times), points, state.row)
        if not sample.size:
            raise EvaluationError(
                f"all trajectories have ended before {self.metadata.time} = {times:g}",
                term=t,
                remedy="ask for an earlier time",
            )
        clock = np.linspace(*self.time, 5)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RankoneWarning)  # of trajectories that have ended
            largest = statistics.over_points(
                clock, points, lambda states: np.abs(states[0]).max(), [state.row]
            )
        if np.ptp(sample) <= _STILL * max(np.nanmax(largest), np.abs(sample).max()):
            raise EvaluationError(
                f"{quote(state.name)} does not vary there, and has no density",
                term=t,
                remedy="choose another time, or ask for its mean",
            )
        abscissae, density, bandwidth = density_of(sample, None if at is None else at.ravel())
        if at is not None:
            abscissae, density = at, density.reshape(at.shape)
        return Density(state.name, abscissae, density, bandwidth)

    def probability(
        self,
        t: Times = None,
        *,
        unknown: object = None,
        above: float | None = None,
        below: float | None = None,
        under: Distributions = None,
        correlation: Correlations = None,
        count: int = 2**15,
    ) -> Probability:
        """Probability that an unknown is above, below or between values at times.

        It is a share of evenly spread points, and comes with its error: about 1e-3 or less with the
        default ``count``. Smaller probabilities need more points.

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
            ``.value`` and its standard error ``.error``, each of the shape of t.

        Raises
        ------
        EvaluationError
            If there is no such unknown; and as for :meth:`mean`.
        OptionError
            If neither ``above`` nor ``below`` is given, or one is not a number; and as for
            :meth:`mean`.
        """
        row = self._one(unknown).row
        count = checked_count("count", count, _POINT_SETS, self._numbers_each())
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

        def share(states: Array) -> Array:
            return np.asarray(np.mean((states[0] > lower) & (states[0] < upper)))

        def shares_of_sets(times: Array) -> Array:
            parameters = statistics.parameters
            sets = (parameters.even_points(count // _POINT_SETS, s) for s in range(_POINT_SETS))
            return np.array([statistics.over_points(times, p, share, [row]) for p in sets])

        shares = self._at(t, shares_of_sets)
        error = shares.std(axis=0, ddof=1) / np.sqrt(_POINT_SETS)
        ends = f"{lower:g} < " if above is not None and below is not None else ""
        side = f" > {lower:g}" if below is None else f" < {upper:g}"
        condition = f"{ends}{self.states[row]}{side}"
        clock = np.asarray([] if t is None else t, dtype=float)
        return Probability(shares.mean(axis=0), np.maximum(error, 1.0 / count), condition, clock)

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


def density_of(sample: Array, at: Array | None) -> tuple[Array, Array, float]:
    """Values, density there, and bandwidth of a kernel estimate; 512 values if none are given.

    The width of the kernel is found from the sample (Botev, Grotowski & Kroese, "Kernel density
    estimation via diffusion", Annals of Statistics 38, 2010). Near the ends of the range, where the
    density may jump, it is fitted by a line instead of a constant (Jones, "Simple boundary
    correction for kernel density estimation", Statistics and Computing 3, 1993).
    """
    lower, upper = float(sample.min()), float(sample.max())
    width = upper - lower
    counts, edges = np.histogram(sample, _BINS, (lower, upper))
    shares = counts / sample.size
    bandwidth = float(np.sqrt(_best_time(dct(shares), sample)))
    smooth = np.maximum(_fitted(shares, bandwidth * _BINS), 0.0)
    smooth /= width * smooth.mean()
    if at is None:
        at = np.linspace(lower, upper, 512)
    centres = 0.5 * (edges[:-1] + edges[1:])
    inside = (at >= lower) & (at <= upper)
    return at, np.where(inside, np.interp(at, centres, smooth), 0.0), bandwidth * width


def _fitted(shares: Array, bandwidth: float) -> Array:
    """Lines fitted to the shares of bins with a normal kernel of a bandwidth in bins."""
    reach = min(int(8.0 * bandwidth) + 1, _BINS - 1)
    u = np.arange(-reach, reach + 1) / bandwidth
    kernel = np.exp(-0.5 * u**2)

    def around(of: Array, power: int) -> Array:
        """Sums of what is around each bin, with powers of the distance."""
        sums = scipy.signal.fftconvolve(of, kernel * (-u) ** power)
        return np.asarray(sums[reach : reach + _BINS])

    ones = np.ones(_BINS)
    zeroth, first, second = (around(ones, power) for power in range(3))
    intercept = second * around(shares, 0) - first * around(shares, 1)
    return np.asarray(intercept / (zeroth * second - first**2))


def _best_time(spectrum: Array, sample: Array) -> float:
    """The squared bandwidth, in squares of the range, with the least estimated error: the fixed
    point of section 5 of the paper, or Silverman's rule where it has none."""
    squares = np.arange(1.0, _BINS) ** 2
    sizes = (0.5 * spectrum[1:]) ** 2
    size = sample.size

    def residual(time: float) -> float:
        roughness = _roughness(5, time, squares, sizes)
        for s in range(4, 1, -1):
            odd = np.prod(np.arange(1.0, 2 * s, 2)) / np.sqrt(2.0 * np.pi)
            factor = (1.0 + 0.5 ** (s + 0.5)) / 3.0
            earlier = (2.0 * factor * odd / (size * roughness)) ** (2.0 / (3.0 + 2.0 * s))
            roughness = _roughness(s, earlier, squares, sizes)
        return float(time - (2.0 * size * np.sqrt(np.pi) * roughness) ** -0.4)

    with np.errstate(all="ignore"):
        trial = np.geomspace(1e-8, 0.1, 60)
        signs = np.sign([residual(time) for time in trial])
        changes = np.flatnonzero((signs[:-1] < 0) & (signs[1:] > 0))
        if changes.size:
            return float(brentq(residual, trial[changes[0]], trial[changes[0] + 1]))
    quartiles = np.subtract(*np.quantile(sample, [0.75, 0.25])) / 1.34
    spread = min(width for width in (sample.std(), quartiles) if width > 0)
    return float((0.9 * spread * size**-0.2 / np.ptp(sample)) ** 2)


def _roughness(s: int, time: float, squares: Array, sizes: Array) -> float:
    """Squared norm of the derivative of order s of the density after some time."""
    terms = squares**s * sizes * np.exp(-squares * np.pi**2 * time)
    return float(2.0 * np.pi ** (2 * s) * terms.sum())


def _reals(name: str, given: ArrayLike) -> Array:
    """Finite real numbers."""
    try:
        array = np.asarray(given)
        if array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            raise TypeError
        return array.astype(float)
    except (TypeError, ValueError):
        raise OptionError(f"{name}={shown(given)} are not real numbers", term=given) from None
