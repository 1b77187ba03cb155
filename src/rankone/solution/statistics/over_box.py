"""Moments, sensitivities and quantiles of a solution over its box, as methods."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rankone.solution.evaluation.core import SolutionCore
from rankone.solution.statistics.composite_statistics import PieceStatistics, TimelineStatistics
from rankone.solution.statistics.solution_statistics import (
    Effect,
    MainEffects,
    Sobol,
    Statistics,
    changed_shares,
    doubtful_shares,
    quiet,
    warn_of_ends,
)
from rankone.support.arrays import ACCUMULATED, MINOR, SAMPLES, Array
from rankone.support.budget import StepReport, counting_bar
from rankone.support.errors import EvaluationError, OptionError, shown, warn
from rankone.support.options import LEVEL, checked_count, checked_number
from rankone.tensors.branch_evaluator import BranchEvaluator, PieceEvaluator
from rankone.tensors.coordinates import IDENTITY, SCALES, Scale, evenly_on_scale
from rankone.tensors.distributions import Distribution, from_text, scale_of
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.joint_distribution import (
    SETS,
    Correlations,
    Fitted,
    JointDistribution,
    Under,
    copula_of,
    fitted_distribution,
    measures_of,
)
from rankone.tensors.timeline_evaluator import TimelineEvaluator

Times = ArrayLike | None
"""Times; None where nothing depends on time."""
Progress = bool | StepReport
"""A bar or none, or what is called with the numbers of finished and of all steps."""

BOX_POINTS = 2**15
"""Points over the box for quantiles and densities, unless a user chooses another count."""
CENTRAL = (0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL)
"""Probabilities between which LEVEL lies: the ends of bands."""
VISIBLE_HALF_WIDTH = 1e-2
"""Half-widths of effects, in shares of the spread, above which they show and a user is told."""


def checked_probabilities(q: ArrayLike) -> Array:
    """Numbers in [0, 1], or an OptionError."""
    try:
        probabilities = np.asarray(q, dtype=float)
    except (TypeError, ValueError):
        raise OptionError(f"q={q!r} are not numbers", term=q) from None
    if not np.all((probabilities >= 0.0) & (probabilities <= 1.0)):
        raise OptionError(f"q={q!r} is not in [0, 1]", term=q)
    return probabilities


class Quantiles(np.ndarray[Any, np.dtype[np.float64]]):
    """Quantiles as an array, with half-widths of 95 % of their probabilities.

    What is computed of it, or an index takes from it, is a plain array. Only it itself, and what
    ``pickle`` and ``copy`` make of it, has half-widths.

    Attributes
    ----------
    half_width : ndarray or None
        Of the same shape; None of other views and copies, such as ``.T``.
    """

    half_width: Array | None

    def __new__(cls, values: Array, half_width: Array | None) -> Quantiles:
        """Quantiles of an array."""
        quantiles = np.asarray(values, dtype=float).view(cls)
        quantiles.half_width = half_width
        return quantiles

    def __array_finalize__(self, obj: object) -> None:
        self.half_width = None

    def __array_wrap__(
        self, array: Array, context: object = None, return_scalar: bool = False
    ) -> Any:
        plain = np.asarray(array)
        return plain[()] if return_scalar else plain

    def __getitem__(self, key: Any) -> Any:
        return np.asarray(self)[key]

    def __reduce__(self) -> tuple[Any, ...]:
        return Quantiles, (np.asarray(self), self.half_width)

    def __copy__(self) -> Quantiles:
        return self.__deepcopy__({})

    def __deepcopy__(self, memo: dict[int, Any] | None) -> Quantiles:
        return Quantiles(np.array(self), deepcopy(self.half_width, memo))


class StatisticsOverBox(SolutionCore):
    """A solution whose parameters are random: moments, sensitivities, quantiles."""

    def mean(
        self,
        t: Times = None,
        *,
        under: Under = None,
        correlation: Correlations = None,
        progress: Progress = False,
    ) -> Array:
        """Means of the unknowns over the box at times.

        Integrals of products are products of integrals: nothing is sampled.

        Parameters
        ----------
        t : array_like, optional
            Times; none if nothing depends on time.
        under : mapping or Fit, optional
            For parameters, by symbols or names, frozen continuous distributions of scipy.stats, cut
            at the ends of the box. Other parameters have the distribution of the problem, or a
            uniform one. A fit gives its estimates their covariance: they are normal, or log-normal
            if they were searched over decades, with the correlations of the fit, and what the fit
            fixes has its value.
        correlation : mapping, optional
            For pairs of parameters, the correlation of the normal numbers of their Gaussian copula:
            ``{(k, c): 0.6}``. It is the correlation of normal parameters, and 2 sin(pi s/6) for a
            rank correlation s of Spearman. Other pairs are independent. By default those of the
            fit, or of the problem. Up to three correlated parameters are integrated by a
            quadrature, refined until mean and covariance change by less than 1e-6, relative to the
            spread; more by evenly spread points, good to about 1e-3 of the standard deviation.
        progress : bool or callable
            True shows a bar over solutions with events; a function is called with the numbers of
            finished and of all rounds.

        Over solutions with events, which jump over the parameters at a time, averages are over
        lines through the box that are divided where the solution jumps. The nodes of Gauss's rule
        on each smooth piece, and the lines, are doubled until that changes the statistic by less
        than 1e-4 of the spread. A warning says how much it changes still if 64 nodes or 512 lines
        are not enough, or more would take longer than about 5 s, and that is more than 1e-3.

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
        with self._reporting(under, correlation, progress, "mean") as statistics:
            return self._at(t, statistics.mean)

    def var(
        self,
        t: Times = None,
        *,
        under: Under = None,
        correlation: Correlations = None,
        progress: Progress = False,
    ) -> Array:
        """Variances; arguments and shape as for :meth:`mean`."""
        with self._reporting(under, correlation, progress, "variance") as statistics:
            return self._at(t, statistics.variance)

    def std(
        self,
        t: Times = None,
        *,
        under: Under = None,
        correlation: Correlations = None,
        progress: Progress = False,
    ) -> Array:
        """Standard deviations; arguments and shape as for :meth:`mean`."""
        variances = self.var(t, under=under, correlation=correlation, progress=progress)
        return np.asarray(np.sqrt(variances))

    def cov(
        self,
        t: Times = None,
        *,
        under: Under = None,
        correlation: Correlations = None,
        progress: Progress = False,
    ) -> Array:
        """Covariances of the unknowns at the same time, (unknowns, unknowns, *shape of t)."""
        with self._reporting(under, correlation, progress, "covariance") as statistics:
            return self._at(t, statistics.covariance)

    def moment(
        self,
        order: int,
        t: Times = None,
        *,
        under: Under = None,
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
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> Array:
        """Third central moments over the cubes of the standard deviations.

        Arguments, shape and errors as for :meth:`moment`. NaN where nothing varies; meaningless
        where the standard deviation is below the error of the solution.
        """
        return np.asarray(self._higher(t, self._statistics(under, correlation), True)[1])

    def kurtosis(
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> Array:
        """Fourth central moments over the squared variances, minus 3 (0 for a normal distribution).

        Arguments, shape and errors as for :meth:`moment`. NaN where nothing varies; meaningless
        where the standard deviation is below the error of the solution.
        """
        return np.asarray(self._higher(t, self._statistics(under, correlation), True)[2] - 3.0)

    def sobol(
        self,
        t: Times = None,
        *,
        under: Under = None,
        correlation: Correlations = None,
        count: int | None = None,
        progress: Progress = False,
    ) -> Sobol:
        """Variance-based sensitivities at times: first-order, total and second-order Sobol indices.

        They come with half-widths of 95 %. The indices are NaN where an unknown varies by less than
        its measured error. A warning says so, except at the start of the horizon, where initial
        values are usually numbers. The warning also names indices that the error may change
        visibly: there the spread is less than five times the error.
        Correlations are refused: the shares of correlated parameters overlap, and depend on the
        order in which they are counted.

        Parameters
        ----------
        t, under, correlation
            As for :meth:`mean`; times are one-dimensional.
        count : int, optional
            Points over solutions with events, where the solution is evaluated 2 d + 2 times for
            each, with d parameters; without events nothing is sampled. By default at most 2^14,
            fewer at many times. The half-widths show what they are good for.
        progress : bool or callable
            True shows a bar, where points are taken; a function is called with the numbers of
            finished and of all sets of points.
        """
        if count is not None:
            count = checked_count("count", count, SETS, self._numbers_each())
        statistics = self._statistics(under, correlation)
        with counting_bar(progress, SETS, "Sobol indices", "set") as report:
            indices, doubts = self._indices(t, statistics, count, report)
        if doubts:
            warn("; ".join(doubts), remedy="solve with a smaller rtol if it should vary there")
        return indices

    def main_effects(
        self,
        t: Times = None,
        *,
        count: int = 101,
        under: Under = None,
        correlation: Correlations = None,
        progress: Progress = False,
    ) -> MainEffects:
        """Means of the unknowns as functions of each parameter, over all others.

        Exact for the tensor train; over solutions with events from points of the other parameters,
        as many as take about 5 s, with ``half_widths`` of 95 %. Correlated parameters follow the
        given one: the mean is what is observed, not the effect of changing this parameter alone.

        Parameters
        ----------
        t, under, correlation
            As for :meth:`mean`.
        count : int
            Number of values of each parameter, from one end of its interval to the other, evenly
            spaced on its scale.
        progress : bool or callable
            True shows a bar; a function is called with the numbers of finished and of all
            parameters.
        """
        statistics = self._statistics(under, correlation)
        total = len(self.metadata.parameters)
        with counting_bar(progress, total, "main effects", "parameter") as report:
            return self._main_effects(t, count, statistics, report)

    def sample(
        self,
        count: int,
        *,
        seed: int | None = None,
        under: Under = None,
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
        under: Under = None,
        correlation: Correlations = None,
        count: int = BOX_POINTS,
    ) -> Quantiles:
        """Quantiles of the unknowns over the box at times.

        Computed from scrambled Sobol points in 16 sets, the same in every call. How much the sets
        differ tells the error of the probabilities: with the default ``count`` 1e-2 or less.

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
        Quantiles (*shape of q, unknowns, *shape of t)
            An array, whose ``.half_width``, of the same shape, has half-widths of 95 % of the
            probabilities: the quantile at 0.25 may be the one at 0.25 plus or minus that. The
            error of the solution is beside them.

        Raises
        ------
        OptionError
            If a probability is not in [0, 1]; and as for :meth:`mean`.
        """
        probabilities = checked_probabilities(q)
        count = checked_count("count", count, 1, self._numbers_each())
        statistics = self._statistics(under, correlation)

        flat = probabilities.ravel()
        both = self._at(t, lambda times: np.stack(statistics.quantiles(times, flat, count)))
        table, half_width = both.reshape(2, *probabilities.shape, *both.shape[2:])
        return Quantiles(table, half_width)

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
            "under=..., correlation=...))",
        )
        tolerance = MINOR * self.rtol  # of the trains that are truncated
        return self._at(t, lambda times: statistics.higher(times, central, tolerance))

    def _indices(
        self, t: Times, statistics: Statistics, count: int | None = None, report: StepReport = quiet
    ) -> tuple[Sobol, list[str]]:
        """Sobol indices, and sentences on those that are not certain."""
        statistics.parameters.require_independent(
            "Sobol indices are not defined for correlated parameters: their shares of the variance "
            "overlap",
            remedy="leave out the correlation (correlation={} if the problem or a fit has it); "
            "compare the standard deviations with one parameter fixed at a time; main_effects "
            "takes correlations",
        )
        checked = self._times(t)
        if checked.ndim > 1:
            raise OptionError("times have more than one dimension", term=t, remedy="give a list")
        times = np.atleast_1d(checked)
        variances = statistics.variance_parts(times, count, report)
        share, spread, sizes, errors = self._shares_of_variance(variances.variance, statistics)
        ratio = (errors[:, None] * np.sqrt(share))[:, None]
        arrays = list[Array]()
        for part, width in zip(variances.parts, variances.half_widths, strict=True):
            own = (slice(None), *(None,) * (part.ndim - 2))
            index = part * share[own]
            arrays.append(index)
            changed = changed_shares(index, ratio if part.ndim == 3 else ratio[:, None])
            arrays.append(width * share[own] + changed)
        second = arrays[4:]
        i = np.arange(len(self.metadata.parameters))
        second[1][:, i, i] = 0.0  # a parameter and itself
        if t is None:
            arrays = [array[..., 0] for array in arrays]
        first, first_width, total, total_width, pairs, pairs_width = arrays
        clock = np.empty(0) if t is None else times
        later = np.ones(1, dtype=bool) if t is None else clock > self.time[0]
        when = np.full(1, np.nan) if t is None else clock[later]
        doubts = [
            *variances.doubts,
            *doubtful_shares(self.unknowns, when, spread[:, later], sizes, errors),
        ]
        indices = Sobol(
            self.metadata.parameters,
            self.unknowns,
            clock,
            first,
            total,
            pairs,
            first_half_width=first_width,
            total_half_width=total_width,
            second_half_width=pairs_width,
        )
        return indices, doubts

    def _first_and_total(self, times: Array, statistics: Statistics) -> tuple[Array, Array]:
        """Sobol indices of first order and total ones, (unknowns, parameters, times) each."""
        indices, _ = self._indices(times, statistics)
        return indices.first, indices.total

    def _shares_of_variance(
        self, variance: Array, statistics: Statistics
    ) -> tuple[Array, Array, Array, Array]:
        """One over the variance (unknowns, times), NaN where it is below the error of the solution.

        After it the standard deviations (unknowns, times), and sizes and errors of the unknowns.
        """
        sizes, errors = self._sizes_and_errors(statistics)
        spread = np.sqrt(variance)
        with np.errstate(all="ignore"):
            share = np.where(spread > errors[:, None], 1.0 / variance, np.nan)
        return share, spread, sizes, errors

    def _sizes_and_errors(self, statistics: Statistics) -> tuple[Array, Array]:
        """Sizes of the unknowns, and the errors of the solution in them."""
        ends = None if self.metadata.timeless else np.linspace(*self.time, SAMPLES)
        squares = self._at(ends, statistics.root_mean_squares)
        largest = squares.reshape(len(squares), -1)
        sizes = np.asarray(np.fmax.reduce(largest, axis=1))  # all may have ended at the last times
        errors = np.nan_to_num([self.errors[name] for name in self.unknowns], posinf=0.0)
        return sizes, sizes * np.maximum(errors, ACCUMULATED)

    def _main_effects(
        self, t: Times, count: int, statistics: Statistics, report: StepReport = quiet
    ) -> MainEffects:
        count = checked_count("count", count, 2, self._numbers_each())
        ranges = {
            name: evenly_on_scale(self._scale(name), ends, count)
            for name, ends in self.parameters.items()
        }

        effects = list[Effect]()

        def mean_given(j: int, points: Array) -> Array:
            def both(times: Array) -> Array:
                effects.append(statistics.effect(times, j, points))
                return np.stack(effects[-1][:2])

            return self._at(t, both)

        means, half_widths = dict[str, Array](), dict[str, Array]()
        for j, name in enumerate(ranges):
            means[name], half_widths[name] = mean_given(j, ranges[name])
            report(j + 1, len(ranges))
        warn_of_ends(min((effect.running for effect in effects), default=1.0))
        least = max((effect.relative for effect in effects), default=0.0)
        if least > VISIBLE_HALF_WIDTH:
            warn(
                f"main effects have half-widths of 95 % of up to {least:.1e} of the spread",
                remedy="ask for fewer times, or fewer values by `count`",
            )
        times = np.asarray([] if t is None else t, dtype=float)
        return MainEffects(tuple(ranges), self.unknowns, times, ranges, means, half_widths)

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

    def _joint_distribution(self, under: Under, correlation: Correlations) -> JointDistribution:
        """The distributions and correlations given, completed by the problem."""
        names, box = self.metadata.parameters, self.metadata.box
        if isinstance(under, Fitted):
            of_problem = self._problem_distributions
            return fitted_distribution(names, box, under, correlation, of_problem)
        if correlation is None:
            correlation = {(a, b): coefficient for a, b, coefficient in self.metadata.correlations}
        copula = copula_of(names, correlation)
        measures = measures_of(names, box, under, self._problem_distributions)
        return JointDistribution(measures, copula)

    @contextmanager
    def _reporting(
        self, under: Under, correlation: Correlations, progress: Progress, what: str
    ) -> Iterator[Statistics]:
        """The statistics, which tell their progress inside."""
        statistics = self._statistics(under, correlation)
        with counting_bar(progress, 1, what, "round") as report:
            statistics.report = report
            try:
                yield statistics
            finally:
                statistics.report = quiet

    def _statistics(self, under: Under = None, correlation: Correlations = None) -> Statistics:
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
