"""How sure the estimates of a fit are: covariance, intervals, profiles, what is identified."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rankone.estimation.curves import Curve, curve_of
from rankone.estimation.estimates import Estimates
from rankone.estimation.expressions import quantity
from rankone.estimation.identification import Profile, Stop, profiles
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.options import checked_number
from rankone.support.wording import quote

# Share of a gradient along flat directions above which a quantity is not identified
_FLAT_SHARE = 1e-3

Interval = tuple[float, float]


@dataclass(frozen=True, repr=False)
class Intervals(Estimates):
    """Estimates with their uncertainty."""

    # --- linearised ----------------------------------------------------------------------------

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
        quantiles = [self._quantile(level, slope) for slope in np.eye(len(free.names))]
        half = np.array(quantiles) * self._identification.spread * self._unit
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
        estimate, slope = self._quantity(given)
        half = self._quantile(level, slope) * self.deviation(slope)
        return estimate - half, estimate + half

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
        at = self.trial(experiment)
        values, slopes = curve_of(self._problem, at, observable, times, self._z)
        half = np.array([self._quantile(None, slope) * self.deviation(slope) for slope in slopes])
        half[~np.isfinite(half)] = np.nan
        return Curve(values, half)

    def profile(self, parameter: object, level: float | None = None) -> Profile:
        """The profile likelihood of a parameter up to a level.

        Returns
        -------
        Profile
            In coordinates from 0 to 1 between the bounds; each end says what stops it.
        """
        index = self._problem.free.index(parameter)
        return profiles(self._problem, self._best, self.rise(parameter, level), [index])[0]

    def rise(self, parameter: object, level: float | None = None) -> float:
        """By how much -2 log L is larger at the ends of profile intervals; squares without sigma.

        For levels of noise that are estimated it is n log(1 + q^2/dof), with Student's quantile q,
        which is exact for one level and a linear model.
        """
        j = self._problem.free.index(parameter)
        q = self._quantile(level, np.eye(len(self.parameters))[j])
        if self._problem.levels:
            return self.size * math.log1p(q**2 / max(self.dof, 1))
        return (q * self._unit) ** 2

    def _quantile(self, level: float | None, slope: Array) -> float:
        """Half the length of an interval in standard deviations, of a quantity with derivatives."""
        level = self.level if level is None else checked_level(level)
        dof = self.dof
        if self._levels is not None:
            dof = min(dof, self._levels.dof(self._identification.root, slope))
        return quantile_of(level, self.noise_given, dof)

    def _quantity(self, given: object) -> tuple[float, Array]:
        """A quantity at the estimate, and its derivatives (n,) with respect to z."""
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
        return estimate, slope * free.slopes(self._z)

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

    # --- what is identified -------------------------------------------------------------------

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

    @property
    def at_bounds(self) -> dict[str, str]:
        """Parameters whose estimate is at the ``"lower"`` or ``"upper"`` end of its bounds."""
        return self._problem.free.at_bounds(self._best.z)


def checked_level(level: float) -> float:
    """A probability strictly between 0 and 1, or an OptionError."""
    level = checked_number("level", level, 0.0, 1.0, float)
    if not 0.0 < level < 1.0:
        raise OptionError(f"level={level:g} is not between 0 and 1", remedy="choose 0.95")
    return float(level)


def quantile_of(level: float, sigma_known: bool, dof: float) -> float:
    """Half the length of an interval in standard deviations; Student's for unknown sigma.

    Infinite without degrees of freedom.
    """
    share = 0.5 + 0.5 * level
    if sigma_known:
        return float(scipy.stats.norm.ppf(share))
    return float(scipy.stats.t.ppf(share, dof)) if dof > 0.0 else math.inf
