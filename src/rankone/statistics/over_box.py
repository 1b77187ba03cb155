"""Statistics of a solution over its box, as methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from rankone.solution.core import SolutionCore
from rankone.statistics.certainty import Certainty
from rankone.statistics.copula import Copula, copula_of
from rankone.statistics.distributions import from_text
from rankone.statistics.measures import Measure
from rankone.statistics.solution_statistics import Sobol, Statistics, measures_of
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError, warn
from rankone.support.options import checked_count, checked_number

__all__ = ["StatisticsOverBox"]


_TIMES = 25
"""Times at which the size of an unknown is looked for."""


class StatisticsOverBox(SolutionCore):
    """A solution whose parameters are random: means, spreads, sensitivities, quantiles."""

    def mean(
        self,
        t: Any = None,
        *,
        under: Mapping[Any, Any] | None = None,
        correlation: Mapping[Any, Any] | None = None,
    ) -> Array:
        """Means of the unknowns over the box at times.

        Integrals of products are products of integrals: nothing is sampled.

        Parameters
        ----------
        t : array_like, optional
            Times; none if nothing depends on time.
        under : mapping, optional
            For parameters, by symbols or names, frozen continuous distributions of scipy.stats, cut
            at the ends of the box. Others have the distribution that the problem gives them, or
            are uniform.
        correlation : mapping, optional
            For pairs of parameters, the correlation of the normal numbers of their Gaussian copula:
            ``{(k, c): 0.6}``. It is the correlation of normal parameters, and 2 sin(pi s/6) for a
            rank correlation s of Spearman. Other pairs are independent. Over up to three
            correlated parameters there is a quadrature, refined until mean and covariance change
            by less than 1e-6, relative to the spread; over more there are evenly spread points,
            good to about 1e-3 of the standard deviation.

        Returns
        -------
        ndarray (unknowns, *shape of t)

        Raises
        ------
        EvaluationError
            If a time is outside of the horizon, or there are none.
        OptionError
            If there is no such parameter, or a distribution has no probability in its interval, or
            correlations are not inside of (-1, 1) or contradict each other.
        """
        return self._over_box(t, under, Statistics.mean, correlation)

    def var(
        self,
        t: Any = None,
        *,
        under: Mapping[Any, Any] | None = None,
        correlation: Mapping[Any, Any] | None = None,
    ) -> Array:
        """Variances; arguments and shape as for :meth:`mean`."""
        return self._over_box(t, under, Statistics.variance, correlation)

    def std(
        self,
        t: Any = None,
        *,
        under: Mapping[Any, Any] | None = None,
        correlation: Mapping[Any, Any] | None = None,
    ) -> Array:
        """Standard deviations; arguments and shape as for :meth:`mean`."""
        return np.asarray(np.sqrt(self.var(t, under=under, correlation=correlation)))

    def cov(
        self,
        t: Any = None,
        *,
        under: Mapping[Any, Any] | None = None,
        correlation: Mapping[Any, Any] | None = None,
    ) -> Array:
        """Covariances of the unknowns at the same time, (unknowns, unknowns, *shape of t)."""
        return self._over_box(t, under, Statistics.covariance, correlation)

    def sobol(
        self,
        t: Any = None,
        *,
        under: Mapping[Any, Any] | None = None,
        correlation: Mapping[Any, Any] | None = None,
    ) -> Sobol:
        """Variance-based sensitivities at times: first-order, total and second-order Sobol indices.

        Arguments as for :meth:`mean`; times are one-dimensional. Where an unknown does not vary by
        more than its measured error the indices are NaN; a warning says so, but for the start of
        the horizon, where initial values are usually numbers. It also names indices that the error
        may change visibly, because the spread is less than five times as large. Correlations are
        refused: the shares of correlated parameters overlap, and depend on the order in which they
        are counted.
        """
        indices, certainty = self._indices(t, under, correlation)
        if message := certainty.message:
            warn(message)
        return indices

    def _indices(
        self, t: Any, under: Mapping[Any, Any] | None, correlation: Mapping[Any, Any] | None
    ) -> tuple[Sobol, Certainty]:
        """Sobol indices, and how far they can be trusted."""
        if self._copula(correlation) is not None:
            raise OptionError(
                "Sobol indices are not defined for correlated parameters: what two of them explain "
                "together cannot be told apart without an order",
                term=correlation,
                remedy="leave out the correlation (correlation={} if the problem has it); compare "
                "the standard deviations with one parameter fixed at a time; main_effects takes "
                "correlations",
            )
        parts = Statistics.variance, Statistics.first, Statistics.total, Statistics.second
        times = t if t is None else np.atleast_1d(np.asarray(t))
        if times is not None and times.ndim > 1:
            raise OptionError("times have more than one dimension", term=t, remedy="give a list")
        variance, first, total, second = (
            self._over_box(times, under, part, correlation) for part in parts
        )
        clock = np.asarray([] if times is None else times, dtype=float)
        sizes = self._sizes(under, correlation)
        errors = np.array([self.errors[name] for name in self.unknowns])
        certainty = Certainty(self.unknowns, clock, self.time[0], np.sqrt(variance), sizes, errors)
        with np.errstate(all="ignore"):
            share = np.where(certainty.defined, 1.0 / variance, np.nan)
        shares = first * share[:, None], total * share[:, None], second * share[:, None, None]
        return Sobol(self.metadata.parameters, self.unknowns, clock, *shares), certainty

    def sample(
        self,
        count: int,
        *,
        seed: int | None = None,
        under: Mapping[Any, Any] | None = None,
        correlation: Mapping[Any, Any] | None = None,
    ) -> dict[str, Array]:
        """Random values of the parameters, by name, (count,) each.

        ``solution(t=1.0, **solution.sample(1000))`` are values of the unknowns. ``under``
        and ``correlation`` are as for :meth:`mean`.
        """
        count = checked_count("count", count, 0, 3 * len(self.metadata.parameters))
        measures = self._measures(under)
        seed = None if seed is None else checked_number("seed", seed, 0)
        shares = np.random.default_rng(seed).random((len(measures), count))
        copula = self._copula(correlation)
        shares = shares if copula is None else copula.joined(shares)
        return {m.name: m.sample(row) for m, row in zip(measures, shares, strict=True)}

    def quantile(
        self,
        q: Any,
        t: Any = None,
        *,
        under: Mapping[Any, Any] | None = None,
        correlation: Mapping[Any, Any] | None = None,
        count: int = 2**14,
    ) -> Array:
        """Quantiles of the unknowns over the box at times.

        Of evenly spread values of the parameters (an additive recurrence), the same in every call:
        the probabilities are met to about 1e-3 with the default ``count`` of them.

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
        try:
            probabilities = np.asarray(q, dtype=float)
        except (TypeError, ValueError):
            raise OptionError(f"q={q!r} are no numbers", term=q) from None
        if not np.all((probabilities >= 0.0) & (probabilities <= 1.0)):
            raise OptionError(f"q={q!r} is not in [0, 1]", term=q)
        count = checked_count("count", count, 1, self._numbers_each())

        def of(statistics: Statistics, times: Array) -> Array:
            return statistics.quantiles(times, probabilities.ravel(), count)

        values = self._over_box(t, under, of, correlation)
        return values.reshape(*probabilities.shape, *values.shape[1:])

    def _numbers_each(self) -> int:
        """How many numbers each of evenly spread points takes."""
        return 3 * (len(self.metadata.parameters) + len(self.unknowns))

    def _over_box(
        self,
        t: Any,
        under: Mapping[Any, Any] | None,
        part: Callable[[Statistics, Array], Array],
        correlation: Mapping[Any, Any] | None,
    ) -> Array:
        """A statistic at times of any shape."""
        self._evaluator  # noqa: B018 - raises if nothing was solved
        times = self._times(t)
        values = part(self._statistics(under, correlation), times.ravel())
        return values.reshape(*values.shape[:-1], *times.shape)

    def _sizes(
        self, under: Mapping[Any, Any] | None, correlation: Mapping[Any, Any] | None
    ) -> Array:
        """Largest root mean square of each unknown over the horizon, (unknowns,)."""
        ends = None if self.metadata.timeless else np.linspace(*self.time, _TIMES)
        variance = self._over_box(ends, under, Statistics.variance, correlation)
        mean = self._over_box(ends, under, Statistics.mean, correlation)
        return np.asarray(np.hypot(mean, np.sqrt(variance)).reshape(len(mean), -1).max(axis=1))

    def _times(self, t: Any) -> Array:
        """Checked times; any one of the horizon if nothing depends on time."""
        if t is None and not self.metadata.timeless:
            raise EvaluationError(
                "no times were given", term=t, remedy="give t, a number or several"
            )
        if t is not None and self.metadata.timeless:
            raise EvaluationError(
                f"t={t!r} is given, but the values do not depend on time",
                term=t,
                remedy="leave t out",
            )
        return self._coordinates.checked(0, self.time[0] if t is None else t)

    def _measures(self, under: Mapping[Any, Any] | None) -> list[Measure]:
        """The measure of each parameter."""
        return measures_of(self.metadata.parameters, self.metadata.box, under, self._distributions)

    def _copula(self, correlation: Mapping[Any, Any] | None) -> Copula | None:
        """Correlations as given, or else those of the problem."""
        if correlation is None:
            correlation = {(a, b): value for a, b, value in self.metadata.correlations}
        return copula_of(self.metadata.parameters, correlation)

    @cached_property
    def _distributions(self) -> dict[str, Any]:
        """The distributions that came with the problem."""
        return {name: from_text(text) for name, text in self.metadata.distributions}

    def _statistics(
        self, under: Mapping[Any, Any] | None, correlation: Mapping[Any, Any] | None
    ) -> Statistics:
        """The statistics for the distributions that are given, kept for the next question."""
        copula = self._copula(correlation)
        measures = self._measures(under)
        key = copula, tuple(id(measure.distribution) for measure in measures)
        if self._known is None or self._known[0] != key:
            rows = self.metadata.unknown_rows
            self._known = key, Statistics(self.outcome.slabs, rows, measures, copula)
        return self._known[1]

    _known: tuple[Any, Statistics] | None = None
