"""A fit: best values, intervals, what the data identify, and reasons not to trust it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rankone.estimation.checks import residual_checks
from rankone.estimation.curves import Curve, curve_of
from rankone.estimation.experiments import Trial
from rankone.estimation.expressions import quantity
from rankone.estimation.findings import findings_of
from rankone.estimation.identification import Best, Identification, Profile, Stop, profiles
from rankone.estimation.jumps import Jump
from rankone.estimation.likelihood import Likelihood
from rankone.estimation.observations import Observations
from rankone.estimation.presentation import fit_table
from rankone.estimation.residuals import Rows, model_errors, rows_of
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.labelled import Labelled, Table, Variables
from rankone.support.options import checked_number
from rankone.support.wording import did_you_mean, listing, quote

# Share of a gradient along flat directions above which a quantity is not identified
_FLAT_SHARE = 1e-3

Interval = tuple[float, float]


@dataclass(frozen=True, repr=False)
class Fit(Labelled):
    """Parameters from data: best values, intervals, and whether to believe them.

    Attributes
    ----------
    level : float
        Default level of intervals.
    converged : bool
        Whether the search converged.
    stuck : bool
        Whether it ended where the likelihood jumps: an event passes a time of the data there.
    others : tuple of dict of str to float
        Other minima that the data do not exclude at the level.
    jumps : tuple of Jump
        Parameters in whose intervals an event passes a time of the data, and that time.
    sizes : tuple of dict of str to float
        For each experiment the largest values of the observed states over the box.
    """

    level: float
    converged: bool
    stuck: bool
    _problem: Likelihood
    _best: Best
    _z: Array
    _identification: Identification
    _freedom: dict[int, float] = field(default_factory=dict)
    others: tuple[dict[str, float], ...] = ()
    jumps: tuple[Jump, ...] = ()
    sizes: tuple[dict[str, float], ...] = ()

    # --- what was fitted -----------------------------------------------------------------------

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The experiments, each with its solution and its data in a row."""
        return self._problem.trials

    @property
    def solution(self) -> SolutionCore:
        """The solution; that of the first experiment if there are several."""
        return self.trials[0].solution

    @property
    def observations(self) -> Observations:
        """What was measured, in a row; in the first experiment if there are several."""
        return self.trials[0].observations

    @property
    def size(self) -> int:
        """Number of data."""
        return self._problem.size

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of what was measured."""
        return tuple(dict.fromkeys(n for trial in self.trials for n in trial.observations.names))

    # --- best values ---------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of the covariance."""
        return self._problem.free.names

    @property
    def noise_levels(self) -> tuple[str, ...]:
        """Those of the free parameters that are levels of noise."""
        return tuple(self.parameters[j] for j in self._problem.levels)

    @property
    def fixed(self) -> dict[str, float]:
        """Parameters that were fixed in all experiments, and their values."""
        return dict(self._problem.free.fixed)

    @cached_property
    def x(self) -> dict[str, float]:
        """The estimate of each free parameter."""
        return self._problem.free.named(self._z)

    @property
    def values(self) -> dict[str, float]:
        """All parameters of the solution: ``solution(times, fit.values)`` is the curve.

        Those of the first experiment if there are several; see :meth:`values_in`.
        """
        return self.values_in(0)

    def values_in(self, experiment: int | str) -> dict[str, float]:
        """All parameters of the solution in one experiment, by its name or its position."""
        trial = self.trial(experiment)
        every = {**self._problem.free.complete(self.x), **trial.fixed}
        return {name: every[name] for name in trial.solution.parameters}

    def trial(self, experiment: int | str) -> Trial:
        """One experiment, by its name or its position."""
        names = [trial.name for trial in self.trials]
        if isinstance(experiment, str) and experiment in names:
            return self.trials[names.index(experiment)]
        if isinstance(experiment, int) and -len(names) <= experiment < len(names):
            return self.trials[experiment]
        raise OptionError(
            f"there is no experiment {quote(experiment)}{did_you_mean(str(experiment), names)}",
            term=experiment,
            remedy=f"choose from {listing(names)}" if any(names) else f"give 0 to {len(names) - 1}",
        )

    @cached_property
    def residuals(self) -> Array | dict[str, Array] | dict[str, Array | dict[str, Array]]:
        """Data minus model, in the shape of the data.

        By name if the data were so; by experiment if there are several.
        """
        rows = [
            trial.observations.arranged(trial.observations.values - row.predicted)
            for trial, row in zip(self.trials, self._rows, strict=True)
        ]
        return rows[0] if len(rows) == 1 else dict(zip(self._names, rows, strict=True))

    @property
    def standardised(self) -> tuple[Array, ...]:
        """For each experiment the residuals in standard deviations, in a row."""
        unit = self._unit if self._unit > 0.0 else 1.0
        return tuple(row.scaled / unit for row in self._rows)

    @property
    def _names(self) -> tuple[str, ...]:
        """Names of the experiments."""
        return tuple(trial.name for trial in self.trials)

    @cached_property
    def _rows(self) -> list[Rows]:
        return rows_of(self._problem, self._z)

    @property
    def deviations(self) -> list[Array]:
        """For each experiment the standard deviations of the data (m,), as given or estimated.

        Those of log-normal noise are in the unit of the data, to first order.
        """
        return [row.deviations * self._unit for row in self._rows]

    @property
    def model_errors(self) -> list[Array]:
        """For each experiment how far the error of the solution moves the predictions (m,)."""
        return model_errors(self._problem, self._z, self.sizes)

    @property
    def chi2(self) -> float:
        """Sum of squared residuals over sigma; of weighted residuals if sigma is not known."""
        return float(sum(np.sum(row.scaled**2) for row in self._rows))

    @property
    def dof(self) -> int:
        """Degrees of freedom: number of data less the number of fitted directions."""
        return self.size - self._identification.used + len(self._problem.levels)

    @property
    def unit_known(self) -> bool:
        """Whether standard deviations are given or have levels, not one that all data share."""
        return self._problem.unit_known

    @property
    def noise_given(self) -> bool:
        """Whether the standard deviations of all data were given."""
        return self._problem.unit_known and not self._problem.levels

    @cached_property
    def sigma(self) -> float:
        """Standard deviation of the residuals, in units of sigma where sigma was given.

        Where none was given it is the estimate of sigma; with weights, for a datum of weight one.
        """
        return math.sqrt(self.chi2 / self.dof) if self.dof > 0 else math.nan

    @property
    def p_value(self) -> float:
        """Probability of residuals as large as these or larger; NaN where sigma is not given."""
        if not self.noise_given or not self.dof > 0:
            return math.nan
        return float(scipy.stats.chi2.sf(self.chi2, self.dof))

    # --- how well the model describes the data -------------------------------------------------

    @cached_property
    def log_likelihood(self) -> float:
        """The largest logarithm of the probability density of the data, with all constants."""
        values = self._problem.free.values(self._best.z)
        if self._problem.unit_known:
            return self._problem.log_likelihood(values)
        variance = max(self._best.cost / self.size, 1e-300)
        unit = self._problem.log_likelihood(values) + 0.5 * self._best.cost
        return unit - 0.5 * self.size * (math.log(variance) + 1.0)

    @property
    def _estimated(self) -> int:
        """Number of estimates, an unknown sigma among them."""
        return len(self.parameters) + (not self._problem.unit_known)

    @property
    def aic(self) -> float:
        """Akaike's information criterion: the smaller, the better the model predicts."""
        return 2.0 * self._estimated - 2.0 * self.log_likelihood

    @property
    def bic(self) -> float:
        """The Bayesian information criterion (Schwarz 1978), smaller for better models."""
        return math.log(self.size) * self._estimated - 2.0 * self.log_likelihood

    @cached_property
    def checks(self) -> tuple[str, ...]:
        """What is worth knowing and no reason to distrust the fit, a sentence each.

        Most are about the residuals, see the guide to fits.
        """
        predicted = [row.predicted for row in self._rows]
        sentences = [*residual_checks(self.trials, self.standardised, predicted)]
        levels = {name for trial in self.trials for name in trial.observations.levels}
        for name in levels & set(self.fixed):
            if self.fixed[name] == 0.0:
                sentences.append(f"{quote(name)} is zero: the data show no such part of the noise")
        for time in sorted({jump.time for jump in self.jumps if self.converged}):
            names = listing(jump.parameter for jump in self.jumps if jump.time == time)
            sentences.append(
                f"an event passes the time {time:.6g} of the data inside the intervals of {names}; "
                'they are rough, and those of interval(method="profile") are not'
            )
        return tuple(sentences)

    # --- uncertainty ---------------------------------------------------------------------------

    @property
    def _unit(self) -> float:
        """Standard deviation of scaled residuals: one, or its estimate."""
        return 1.0 if self._problem.unit_known else self.sigma

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the estimates (n, n), by linearisation at the estimate.

        Infinite variances and NaN for parameters that the data do not identify.
        """
        slopes = self._problem.free.slopes(self._z)
        root = self._identification.root * slopes[:, None] * self._unit
        covariance = np.asarray(root @ root.T)
        flat = list(self._identification.flat)
        covariance[flat], covariance[:, flat] = np.nan, np.nan
        covariance[flat, flat] = np.inf
        return covariance

    @property
    def information(self) -> Array:
        """The Fisher information of the data about the parameters (n, n), at the estimate."""
        jacobian = self._problem.linearised(self._z[None], settle=False).jacobian[0]
        slopes = jacobian / self._problem.free.slopes(self._z) / self._unit
        return np.asarray(slopes.T @ slopes)

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation of each estimate."""
        roots = np.sqrt(np.diag(self.covariance))
        return dict(zip(self.parameters, map(float, roots), strict=True))

    def interval(
        self, level: float | None = None, *, method: str = "linear"
    ) -> dict[str, Interval]:
        """An interval for each parameter.

        Parameters
        ----------
        level : float, optional
            Probability that an interval contains the true value; by default the level of the fit.
        method : {"linear", "profile"}
            "linear" linearises at the estimate, with quantiles of the normal distribution if sigma
            was given, else of Student's; its intervals may reach beyond the box. Those of
            parameters over decades are linear in the logarithm, those of levels of noise by the
            distribution of a variance. "profile" takes the values for which the other parameters
            can be fitted almost as well, see :meth:`profile`; an end is NaN where the box ends the
            interval, not the data.

        Raises
        ------
        OptionError
            If the level is not between 0 and 1, or the method unknown.
        """
        if method == "profile":
            return {name: self._profile_interval(name, level) for name in self.parameters}
        if method != "linear":
            raise OptionError(
                f"method={method!r} is unknown", remedy='choose "linear" or "profile"'
            )
        free = self._problem.free
        half = self._quantile(level) * self._identification.spread * self._unit
        flat = ~np.isfinite(half)
        half = np.where(flat, 0.0, half)
        low, high = free.unclipped(self._z - half), free.unclipped(self._z + half)
        low, high = np.where(flat, -np.inf, low), np.where(flat, np.inf, high)
        for j, share in self._freedom.items():
            if not flat[j]:
                low[j], high[j] = self._level_interval(j, share, level)
        pairs = zip(map(float, low), map(float, high), strict=True)
        return dict(zip(self.parameters, pairs, strict=True))

    def _level_interval(self, j: int, share: float, level: float | None) -> Interval:
        """The interval of a level of noise by the distribution chi^2 of its square.

        Its degrees of freedom are those that the variance of its logarithm has: 1/(2 variance). Of
        the data, a ``share`` is left after the other parameters are fitted.
        """
        level = self.level if level is None else checked_level(level)
        variance = (self._identification.spread[j] * self._problem.free.logarithms[j]) ** 2
        dof = 0.5 * share / variance
        tails = scipy.stats.chi2.ppf([0.5 + 0.5 * level, 0.5 - 0.5 * level], dof)
        ends = self._problem.free.values(self._z)[j] * np.sqrt(dof / np.maximum(tails, 1e-300))
        return float(ends[0]), float(ends[1])

    def interval_of(self, given: object, level: float | None = None) -> Interval:
        """An interval for a quantity of the parameters, such as ``"C_D/m"``, by linearisation.

        It may be a combination that is identified while its parameters are not.

        Parameters
        ----------
        given : str, Expr or callable
            Arithmetic of the parameters as text, an expression, or a function of a dictionary.

        Returns
        -------
        (float, float)
            Infinite where the data do not identify the quantity.

        Raises
        ------
        OptionError
            If it is not a quantity of the parameters.
        """
        q = self._quantile(level)
        estimate, deviation = self._quantity(given)
        return estimate - q * deviation, estimate + q * deviation

    def value_of(self, given: object) -> float:
        """The estimate of a quantity of the parameters; see :meth:`interval_of`."""
        return self._quantity(given)[0]

    def curve(self, observable: str, times: ArrayLike, experiment: int | str = 0) -> Curve:
        """The fitted curve of an observable, and how well it is known.

        Returns
        -------
        Curve
            With ``values`` and ``half_width`` (times,): half the width of its band at the level of
            the fit, NaN where the data do not identify it.
        """
        at, half = self.trial(experiment), self._quantile(None)
        values, slopes = curve_of(self._problem, at, observable, times, self._z)
        deviations = np.array([self.deviation(slope) for slope in slopes])
        deviations[~np.isfinite(deviations)] = np.nan
        return Curve(values, half * deviations)

    def profile(self, parameter: object, level: float | None = None) -> Profile:
        """The profile likelihood of a parameter up to a level.

        Returns
        -------
        Profile
            In coordinates from 0 to 1 between the bounds; each end says what stops it.
        """
        index = self._problem.free.index(parameter)
        return profiles(self._problem, self._best, self.rise(level), [index])[0]

    def rise(self, level: float | None = None) -> float:
        """By how much -2 log L is larger at the ends of profile intervals; squares without sigma.

        For levels of noise that are estimated it is n log(1 + q^2/dof), with Student's quantile q,
        which is exact for one level and a linear model.
        """
        q = self._quantile(level)
        if self._problem.levels:
            return self.size * math.log1p(q**2 / max(self.dof, 1))
        return (q * self._unit) ** 2

    def _quantile(self, level: float | None) -> float:
        """Half the length of an interval, in standard deviations."""
        level = self.level if level is None else checked_level(level)
        return quantile_of(level, self.noise_given, self.dof)

    def _quantity(self, given: object) -> tuple[float, float]:
        """A quantity at the estimate, and its standard deviation."""
        free = self._problem.free
        of = quantity(given, free.order)
        width = dict(zip(self.parameters, free.width, strict=True))
        at = free.complete(self.x)
        try:
            estimate, slope = of.value(at), of.gradient(at, width)
        except (ArithmeticError, ValueError) as reason:
            raise OptionError(f"{quote(given)} has no value at the fit: {reason}") from reason
        if not math.isfinite(estimate):
            raise OptionError(f"{quote(given)} has no value at the fit")
        return estimate, self.deviation(slope * free.slopes(self._z))

    def deviation(self, slope: Array) -> float:
        """The standard deviation of a quantity by its derivatives (n,) with respect to z.

        Infinite where the data do not identify it.
        """
        along = float(np.linalg.norm(slope @ self._identification.null))
        if along > _FLAT_SHARE * float(np.linalg.norm(slope)):
            return math.inf
        return float(np.linalg.norm(slope @ self._identification.root)) * self._unit

    def _profile_interval(self, name: str, level: float | None) -> Interval:
        """The profile interval; NaN for an end that the box makes."""
        profile, free = self.profile(name, level), self._problem.free
        j = self.parameters.index(name)

        def end(z: float) -> float:
            return float(free.values(np.where(np.arange(len(free.names)) == j, z, self._z))[j])

        ends = (profile.lower, profile.upper)
        low, high = (end(e.z) if e.stop is Stop.DATA else math.nan for e in ends)
        return low, high

    # --- whether to believe it -----------------------------------------------------------------

    @property
    def identifiable(self) -> dict[str, bool]:
        """Whether the data identify each parameter.

        They do not if the others can make up for any value of it within the box.
        """
        return {name: i not in self._identification.flat for i, name in enumerate(self.parameters)}

    @property
    def combinations(self) -> tuple[str, ...]:
        """Identified combinations of parameters that are not identified: ``("C_D/m",)``."""
        return self._identification.combinations

    @cached_property
    def findings(self) -> tuple[str, ...]:
        """Reasons not to trust the fit, a sentence each."""
        return tuple(findings_of(self))

    @property
    def success(self) -> bool:
        """Whether there are no :attr:`findings`."""
        return not self.findings

    @property
    def message(self) -> str:
        """The findings in one text, or that there are none."""
        return "; ".join(self.findings) or "the fit converged, and nothing speaks against it"

    @property
    def at_bounds(self) -> dict[str, str]:
        """Parameters whose estimate is at the ``"lower"`` or ``"upper"`` end of its bounds."""
        return self._problem.free.at_bounds(self._best.z)

    def _table(self) -> Table:
        return fit_table(self)

    def _variables(self) -> Variables:
        """Estimates with deviations and intervals, and the covariance."""
        low, high = np.array(list(self.interval().values())).T
        columns = {
            "estimate": np.array(list(self.x.values())),
            "std": np.array(list(self.std.values())),
            "lower": low,
            "upper": high,
            "identified": np.array(list(self.identifiable.values())),
        }
        arrays = {name: (("parameter",), column) for name, column in columns.items()}
        names = list(self.parameters)
        return Variables(
            {**arrays, "covariance": (("parameter", "other"), self.covariance)},
            {"parameter": names, "other": names},
        )


def checked_level(level: float) -> float:
    """A probability strictly between 0 and 1, or an OptionError."""
    level = checked_number("level", level, 0.0, 1.0, float)
    if not 0.0 < level < 1.0:
        raise OptionError(f"level={level:g} is not between 0 and 1", remedy="choose 0.95")
    return float(level)


def quantile_of(level: float, sigma_known: bool, dof: int) -> float:
    """Half the length of an interval in standard deviations; Student's for unknown sigma."""
    share = 0.5 + 0.5 * level
    return float(scipy.stats.norm.ppf(share) if sigma_known else scipy.stats.t.ppf(share, dof))
