"""Moments, sensitivities and quantiles of a solution over its box, as methods."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from rankone.discretization.scales import IDENTITY, SCALES, Scale
from rankone.ir.measures import evenly_on_scale
from rankone.solution.core import SolutionCore
from rankone.statistics.distributions import Distribution, from_text, scale_of
from rankone.statistics.joint_distribution import (
    Correlations,
    Distributions,
    JointDistribution,
    copula_of,
    measures_of,
)
from rankone.statistics.piece_statistics import PieceStatistics
from rankone.statistics.solution_statistics import (
    ROUNDING_ERROR,
    MainEffects,
    Sobol,
    Statistics,
    doubtful_shares,
)
from rankone.statistics.timeline_statistics import TimelineStatistics
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError, warn
from rankone.support.options import checked_count, checked_number
from rankone.support.wording import shown
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.pieces import PieceEvaluator
from rankone.tensors.timeline import TimelineEvaluator

Times = ArrayLike | None
"""Times; None where nothing depends on time."""

_SIZE_TIMES = 25  # Times at which the size of an unknown is measured: a size need not be exact
# Truncation of a train for higher moments, in shares of the tolerance of the solution
_TRUNCATION_SHARE = 0.1


def checked_probabilities(q: ArrayLike) -> Array:
    """Numbers in [0, 1], or an OptionError."""
    try:
        probabilities = np.asarray(q, dtype=float)
    except (TypeError, ValueError):
        raise OptionError(f"q={q!r} are not numbers", term=q) from None
    if not np.all((probabilities >= 0.0) & (probabilities <= 1.0)):
        raise OptionError(f"q={q!r} is not in [0, 1]", term=q)
    return probabilities


class StatisticsOverBox(SolutionCore):
    """A solution whose parameters are random: moments, sensitivities, quantiles."""

    def mean(
        self, t: Times = None, *, under: Distributions = None, correlation: Correlations = None
    ) -> Array:
        """Means of the unknowns over the box at times.

        Integrals of products are products of integrals: nothing is sampled.

        Parameters
        ----------
        t : array_like, optional
            Times; none if nothing depends on time.
        under : mapping, optional
            For parameters, by symbols or names, frozen continuous distributions of scipy.stats, cut
            at the ends of the box. Other parameters have the distribution of the problem, or a
            uniform one.
        correlation : mapping, optional
            For pairs of parameters, the correlation of the normal numbers of their Gaussian copula:
            ``{(k, c): 0.6}``. It is the correlation of normal parameters, and 2 sin(pi s/6) for a
            rank correlation s of Spearman. Other pairs are independent. Up to three correlated
            parameters are integrated by a quadrature, refined until mean and covariance change by
            less than 1e-6, relative to the spread; more by evenly spread points, good to about
            1e-3 of the standard deviation.

        Over solutions with events, which jump over the parameters at a time, averages are over
        lines through the box that are divided where the solution jumps. The nodes of Gauss's rule
        on each smooth piece, and the lines, are doubled until that changes the statistic by less
        than 1e-4 of the spread. A warning says how much it changes still if 64 nodes or 512 lines
        are not enough and that is more than 1e-3.

        Returns
        -------
        ndarray (unknowns, *shape of t)

        Raises
        ------
        EvaluationError
            If a time is outside the horizon, or no times are given.
        OptionError
            If a parameter is unknown, a distribution has no probability in its interval, or
            correlations are not inside (-1, 1) or contradict each other.
        """
        return self._at(t, self._statistics(under, correlation).mean)

    def var(
        self, t: Times = None, *, under: Distributions = None, correlation: Correlations = None
    ) -> Array:
        """Variances; arguments and shape as for :meth:`mean`."""
        return self._at(t, self._statistics(under, correlation).variance)

    def std(
        self, t: Times = None, *, under: Distributions = None, correlation: Correlations = None
    ) -> Array:
        """Standard deviations; arguments and shape as for :meth:`mean`."""
        return np.asarray(np.sqrt(self.var(t, under=under, correlation=correlation)))

    def cov(
        self, t: Times = None, *, under: Distributions = None, correlation: Correlations = None
    ) -> Array:
        """Covariances of the unknowns at the same time, (unknowns, unknowns, *shape of t)."""
        return self._at(t, self._statistics(under, correlation).covariance)

    def moment(
        self,
        order: int,
        t: Times = None,
        *,
        under: Distributions = None,
        correlation: Correlations = None,
        central: bool = True,
    ) -> Array:
        """Means of powers of the unknowns, minus their means if ``central``.

        Nothing is sampled. The third and fourth are inner products of squares of the tensor train,
        truncated first to a tenth of the solution's ``rtol``, relative to the standard deviation.
        Their cost grows with the sixth power of the remaining ranks. Ranks above 32 for a single
        unknown and time are truncated further, with a warning above 1e-5.

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
        statistics = self._statistics(under, correlation)
        if order > 2:
            size, *shares = self._higher(t, statistics, central)
            return np.asarray(size**order * np.nan_to_num(shares[order - 3]))
        if order == 2 and central:
            return self._at(t, statistics.variance)
        mean = self._at(t, statistics.mean)
        if order == 2:
            return self._at(t, statistics.variance) + mean**2
        return np.zeros_like(mean) if central else mean

    def skewness(
        self, t: Times = None, *, under: Distributions = None, correlation: Correlations = None
    ) -> Array:
        """Third central moments over the cubes of the standard deviations.

        Arguments, shape and errors as for :meth:`moment`. NaN where nothing varies; meaningless
        where the standard deviation is below the error of the solution.
        """
        return np.asarray(self._higher(t, self._statistics(under, correlation), True)[1])

    def kurtosis(
        self, t: Times = None, *, under: Distributions = None, correlation: Correlations = None
    ) -> Array:
        """Fourth central moments over the squared variances, minus 3 (0 for a normal distribution).

        Arguments, shape and errors as for :meth:`moment`. NaN where nothing varies; meaningless
        where the standard deviation is below the error of the solution.
        """
        return np.asarray(self._higher(t, self._statistics(under, correlation), True)[2] - 3.0)

    def sobol(
        self, t: Times = None, *, under: Distributions = None, correlation: Correlations = None
    ) -> Sobol:
        """Variance-based sensitivities at times: first-order, total and second-order Sobol indices.

        Arguments as for :meth:`mean`; times are one-dimensional. The indices are NaN where an
        unknown varies by less than its measured error. A warning says so, except at the start of
        the horizon, where initial values are usually numbers. The warning also names indices that
        the error may change visibly: there the spread is less than five times the error. Over
        solutions with events the indices are good to about 1e-2.
        Correlations are refused: the shares of correlated parameters overlap, and depend on the
        order in which they are counted.
        """
        indices, doubts = self._indices(t, self._statistics(under, correlation))
        if doubts:
            warn("; ".join(doubts), remedy="solve with a smaller rtol if it should vary there")
        return indices

    def main_effects(
        self,
        t: Times = None,
        *,
        count: int = 101,
        under: Distributions = None,
        correlation: Correlations = None,
    ) -> MainEffects:
        """Means of the unknowns as functions of each parameter, over all others.

        Exact for the tensor train. Correlated parameters follow the given one: the mean is what is
        observed, not the effect of changing this parameter alone.

        Parameters
        ----------
        t, under, correlation
            As for :meth:`mean`.
        count : int
            Number of values of each parameter, from one end of its interval to the other, evenly
            spaced on its scale.
        """
        return self._main_effects(t, count, self._statistics(under, correlation))

    def sample(
        self,
        count: int,
        *,
        seed: int | None = None,
        under: Distributions = None,
        correlation: Correlations = None,
    ) -> dict[str, Array]:
        """Random values of the parameters, by name, (count,) each.

        ``solution(t=1.0, **solution.sample(1000))`` are values of the unknowns. ``under``
        and ``correlation`` are as for :meth:`mean`.
        """
        names = self.metadata.parameters
        count = checked_count("count", count, 0, 3 * len(names))
        seed = None if seed is None else checked_number("seed", seed, 0)
        shares = np.random.default_rng(seed).random((len(names), count))
        points = self._joint_distribution(under, correlation).points(shares)
        return dict(zip(names, points, strict=True))

    def quantile(
        self,
        q: ArrayLike,
        t: Times = None,
        *,
        under: Distributions = None,
        correlation: Correlations = None,
        count: int = 2**14,
    ) -> Array:
        """Quantiles of the unknowns over the box at times.

        Computed from evenly spread values of the parameters (an additive recurrence), the same in
        every call. With the default ``count`` the probabilities are good to about 1e-3.

        Parameters
        ----------
        q : array_like
            Probabilities in [0, 1].
        t, under, correlation
            As for :meth:`mean`.
        count : int
            Number of points.

        Returns
        -------
        ndarray (*shape of q, unknowns, *shape of t)

        Raises
        ------
        OptionError
            If a probability is not in [0, 1]; and as for :meth:`mean`.
        """
        probabilities = checked_probabilities(q)
        count = checked_count("count", count, 1, self._numbers_each())
        statistics = self._statistics(under, correlation)

        flat = probabilities.ravel()
        table = self._at(t, lambda times: statistics.quantiles(times, flat, count))
        return table.reshape(*probabilities.shape, *table.shape[1:])

    # --- for one joint distribution of the parameters ------------------------------------------

    def _at(self, t: Times, statistic: Callable[[Array], Array]) -> Array:
        """A statistic, (..., times) of times, at times of any shape."""
        times = self._times(t)
        table = statistic(times.ravel())
        return table.reshape(*table.shape[:-1], *times.shape)

    def _higher(self, t: Times, statistics: Statistics, central: bool) -> Array:
        """Root mean squares, and third and fourth moments relative to them."""
        statistics.parameters.require_independent(
            "third and fourth moments need independent parameters",
            remedy="take moments of samples: solution(t=t, **solution.sample(10**5, "
            "correlation=...))",
        )
        tolerance = _TRUNCATION_SHARE * self.rtol
        return self._at(t, lambda times: statistics.higher(times, central, tolerance))

    def _indices(self, t: Times, statistics: Statistics) -> tuple[Sobol, list[str]]:
        """Sobol indices, and sentences on those that are not certain."""
        statistics.parameters.require_independent(
            "Sobol indices are not defined for correlated parameters: their shares of the variance "
            "overlap",
            remedy="leave out the correlation (correlation={} if the problem has it); compare "
            "the standard deviations with one parameter fixed at a time; main_effects takes "
            "correlations",
        )
        checked = np.atleast_1d(self._times(t))
        if checked.ndim > 1:
            raise OptionError("times have more than one dimension", term=t, remedy="give a list")
        times = None if t is None else checked
        clock = np.empty(0) if times is None else times
        variance = self._at(times, statistics.variance)
        share, spread, sizes, errors = self._shares_of_variance(variance, statistics)
        first, total = self._at(times, statistics.first), self._at(times, statistics.total)
        second = self._at(times, statistics.second) * share[:, None, None]
        indices = first * share[:, None], total * share[:, None], second
        later = np.ones(1, dtype=bool) if times is None else clock > self.time[0]
        when = np.full(1, np.nan) if times is None else clock[later]
        doubts = list(doubtful_shares(self.unknowns, when, spread[:, later], sizes, errors))
        return Sobol(self.metadata.parameters, self.unknowns, clock, *indices), doubts

    def _first_and_total(self, times: Array, statistics: Statistics) -> tuple[Array, Array]:
        """Sobol indices of first order and total ones, (unknowns, parameters, times) each.

        To two digits with events.
        """
        if isinstance(statistics, TimelineStatistics):
            variance, first, total = statistics.shares_at_points(times)
        else:
            variance = self._at(times, statistics.variance)
            first, total = statistics.first(times), statistics.total(times)
        share = self._shares_of_variance(variance, statistics)[0][:, None]
        return first * share, total * share

    def _shares_of_variance(
        self, variance: Array, statistics: Statistics
    ) -> tuple[Array, Array, Array, Array]:
        """One over the variance, NaN where it is below the error of the solution.

        After it the standard deviations (unknowns, times), and sizes and errors of the unknowns.
        """
        ends = None if self.metadata.timeless else np.linspace(*self.time, _SIZE_TIMES)
        squares = self._at(ends, statistics.root_mean_squares)
        largest = squares.reshape(len(squares), -1)
        sizes = np.asarray(np.fmax.reduce(largest, axis=1))  # all may have ended at the last times
        errors = np.nan_to_num([self.errors[name] for name in self.unknowns], posinf=0.0)
        errors = sizes * np.maximum(errors, ROUNDING_ERROR)
        spread = np.sqrt(variance).reshape(len(errors), -1)
        defined = (spread > errors[:, None]).reshape(variance.shape)
        with np.errstate(all="ignore"):
            share = np.where(defined, 1.0 / variance, np.nan)
        return share, spread, sizes, errors

    def _main_effects(self, t: Times, count: int, statistics: Statistics) -> MainEffects:
        count = checked_count("count", count, 2, self._numbers_each())
        ranges = {
            name: evenly_on_scale(self._scale(name), ends, count)
            for name, ends in self.parameters.items()
        }

        def mean_given(j: int, points: Array) -> Array:
            return self._at(t, lambda times: statistics.main_effect(times, j, points))

        means = {name: mean_given(j, ranges[name]) for j, name in enumerate(ranges)}
        times = np.asarray([] if t is None else t, dtype=float)
        return MainEffects(tuple(ranges), self.unknowns, times, ranges, means)

    def _numbers_each(self) -> int:
        """Numbers in memory for each evenly spread point."""
        return 3 * (len(self.metadata.parameters) + len(self.unknowns))

    def _times(self, t: Times) -> Array:
        """Checked times; any one of the horizon if nothing depends on time."""
        if t is None and not self.metadata.timeless:
            raise EvaluationError("no times were given", remedy="give t, a number or several")
        if t is not None and self.metadata.timeless:
            raise EvaluationError(
                f"t={shown(t)} is given, but the values do not depend on time",
                term=t,
                remedy="leave t out",
            )
        return self._coordinates.checked(0, self.time[0] if t is None else t)

    def _scale(self, name: str) -> Scale:
        """The scale of a coordinate, which its distribution in the problem has."""
        text = dict(self.metadata.distributions).get(name)
        return IDENTITY if text is None else SCALES[scale_of(text, self.parameters[name][0])]

    @cached_property
    def _problem_distributions(self) -> dict[str, Distribution]:
        return {name: from_text(text) for name, text in self.metadata.distributions}

    def _joint_distribution(
        self, under: Distributions, correlation: Correlations
    ) -> JointDistribution:
        """The distributions and correlations given, completed by the problem."""
        names, box = self.metadata.parameters, self.metadata.box
        if correlation is None:
            correlation = {(a, b): coefficient for a, b, coefficient in self.metadata.correlations}
        copula = copula_of(names, correlation)
        measures = measures_of(names, box, under, self._problem_distributions)
        return JointDistribution(measures, copula)

    def _statistics(
        self, under: Distributions = None, correlation: Correlations = None
    ) -> Statistics:
        """The statistics for a joint distribution; the latest are kept for the next call."""
        self._evaluator  # noqa: B018 - raises if nothing was solved
        parameters = self._joint_distribution(under, correlation)
        latest = self._latest_statistics
        if latest is None or latest.parameters.key != parameters.key:
            latest = self._statistics_of(parameters)
            self._latest_statistics = latest
        return latest

    def _statistics_of(self, parameters: JointDistribution) -> Statistics:
        rows, evaluator = self.metadata.unknown_rows, self._evaluator
        if isinstance(evaluator, PieceEvaluator):
            slabs = [piece.outcome.slabs for piece in self.outcome.pieces]
            is_plain = all(isinstance(piece, TrainEvaluator) for piece in evaluator.pieces)
            if is_plain and parameters.copula is None:
                return PieceStatistics(slabs, evaluator, rows, parameters)
            return TimelineStatistics(evaluator.likeliest(), rows, parameters)
        if isinstance(evaluator, BranchEvaluator):
            evaluator = evaluator.likeliest()
        if isinstance(evaluator, TimelineEvaluator | BranchEvaluator):
            return TimelineStatistics(evaluator, rows, parameters)
        return Statistics(self.outcome.slabs, rows, parameters)

    _latest_statistics: Statistics | None = None
