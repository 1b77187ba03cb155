"""A fit: best values, intervals, what the data identify, and reasons not to trust it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy

from rankone.estimation.expressions import gradient, quantity
from rankone.estimation.identification import Best, Identification, Profile, Stop, profiles
from rankone.estimation.least_squares import LeastSquares
from rankone.estimation.observations import Observations
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, with_remedy
from rankone.support.options import checked_number
from rankone.support.wording import count, listing, quote

# Share of a gradient along flat directions above which a quantity is not identified
_FLAT_SHARE = 1e-3
_UNLIKELY = 1e-3  # Probability of residuals this large below which the model is rejected
# Accepted shift of an estimate by the error of the solution, in its standard deviations
_MODEL_SHARE = 0.5

Interval = tuple[float, float]


@dataclass(frozen=True, repr=False)
class Fit:
    """Parameters from data: best values, intervals, and whether to believe them.

    Attributes
    ----------
    solution : SolutionCore
    observations : Observations
        What was measured, in a row.
    level : float
        Default level of intervals.
    chi2 : float
        Sum of squared residuals over sigma; of weighted residuals with weights or unknown sigma.
    converged : bool
        Whether the search converged.
    others : tuple of dict of str to float
        Other minima that the data do not exclude at the level.
    size : ndarray (m,)
        Largest values of the observed states over the box, for each datum.
    """

    solution: SolutionCore
    observations: Observations
    level: float
    chi2: float
    converged: bool
    _problem: LeastSquares
    _z: Array
    _scaled_residuals: Array
    _identification: Identification
    others: tuple[dict[str, float], ...] = ()
    size: Array = field(default_factory=lambda: np.zeros(0))

    # --- best values ---------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of the covariance."""
        return self._problem.free.names

    @property
    def fixed(self) -> dict[str, float]:
        """Parameters that were not fitted, and their values."""
        return dict(self._problem.free.fixed)

    @cached_property
    def x(self) -> dict[str, float]:
        """The estimate of each free parameter."""
        return self._problem.free.named(self._z)

    @property
    def values(self) -> dict[str, float]:
        """All parameters, fixed ones as well: ``solution(times, fit.values)`` is the curve."""
        return self._problem.free.complete(self.x)

    @cached_property
    def residuals(self) -> Array | dict[str, Array]:
        """Data minus model, in the shape of the data; by name if the data were so."""
        return self.observations.arranged(-self._scaled_residuals / self.observations.scale)

    @property
    def dof(self) -> int:
        """Degrees of freedom: number of data less the number of fitted directions."""
        return self.observations.size - self._identification.used

    @property
    def sigma(self) -> float:
        """Standard deviation of the residuals, in units of sigma where sigma was given.

        Where none was given it is the estimate of sigma; with weights, for a datum of weight one.
        """
        return math.sqrt(self.chi2 / self.dof) if self.dof > 0 else math.nan

    @property
    def p_value(self) -> float:
        """Probability of residuals as large as these or larger; NaN where sigma is not known."""
        if not self.observations.sigma_known or not self.dof > 0:
            return math.nan
        return float(scipy.stats.chi2.sf(self.chi2, self.dof))

    # --- uncertainty ---------------------------------------------------------------------------

    @property
    def _unit(self) -> float:
        """Standard deviation of scaled residuals: one, or its estimate."""
        return 1.0 if self.observations.sigma_known else self.sigma

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the estimates (n, n), by linearisation at the estimate.

        Infinite variances and NaN for parameters that the data do not identify.
        """
        root = self._identification.root * self._problem.free.width[:, None] * self._unit
        covariance = np.asarray(root @ root.T)
        flat = list(self._identification.flat)
        covariance[flat], covariance[:, flat] = np.nan, np.nan
        covariance[flat, flat] = np.inf
        return covariance

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
            was given, else of Student's; its intervals may reach beyond the box. "profile" takes
            the values for which the other parameters can be fitted almost as well, see
            :meth:`profile`; an end is NaN where the box ends the interval, not the data.

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
        q = self._quantile(level)
        return {name: (self.x[name] - q * s, self.x[name] + q * s) for name, s in self.std.items()}

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

    def profile(self, parameter: object, level: float | None = None) -> Profile:
        """The profile likelihood of a parameter up to a level.

        Returns
        -------
        Profile
            In coordinates from 0 to 1 between the bounds; each end says what stops it.
        """
        index = self._problem.free.index(parameter)
        limit = (self._quantile(level) * self._unit) ** 2
        deviation = np.minimum(self._identification.spread * self._unit, 1.0)
        best = Best(self._z, self.chi2, deviation)
        return profiles(self._problem, best, limit, [index])[0]

    def _quantile(self, level: float | None) -> float:
        """Half the length of an interval, in standard deviations."""
        level = self.level if level is None else checked_level(level)
        return quantile_of(level, self.observations.sigma_known, self.dof)

    def _quantity(self, given: object) -> tuple[float, float]:
        """A quantity at the estimate, and its standard deviation."""
        function = quantity(given, tuple(self.solution.parameters))
        width = dict(zip(self.parameters, self._problem.free.width, strict=True))
        try:
            estimate = function(self.values)
            slope = gradient(function, self.values, width) * self._problem.free.width
        except (ArithmeticError, ValueError) as reason:
            raise OptionError(f"{quote(given)} has no value at the fit: {reason}") from reason
        along = float(np.linalg.norm(slope @ self._identification.null))
        if along > _FLAT_SHARE * float(np.linalg.norm(slope)):
            return estimate, math.inf
        return estimate, float(np.linalg.norm(slope @ self._identification.root)) * self._unit

    def _profile_interval(self, name: str, level: float | None) -> Interval:
        """The profile interval; NaN for an end that the box makes."""
        profile, free = self.profile(name, level), self._problem.free
        j = self.parameters.index(name)
        low, high = (
            float(free.lower[j] + free.width[j] * end.z) if end.stop is Stop.DATA else math.nan
            for end in (profile.lower, profile.upper)
        )
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
        return tuple(_findings(self))

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
        return self._problem.free.at_bounds(self._z)

    def __repr__(self) -> str:
        observations, level = self.observations, f"{100 * self.level:g} %"
        noise = f"sigma {self.sigma:.4g} estimated"
        if observations.sigma_known:
            noise = f"chi2 {self.chi2:.4g}"
        of = f"{count(observations.size, 'value')} of {', '.join(observations.names)}"
        lines = [f"Fit to {of}: {noise}, {self.dof} degrees of freedom"]
        width = max(len(name) for name in self.parameters)
        for name, (low, high) in self.interval().items():
            text = "not identified"
            if self.identifiable[name]:
                text = f"{self.x[name]:.6g}  {level} in [{low:.6g}, {high:.6g}]"
            lines.append(f"  {name:<{width}}  {text}")
        for name in self.combinations:
            low, high = self.interval_of(name)
            lines.append(f"  {name}  {self.value_of(name):.6g}  {level} in [{low:.6g}, {high:.6g}]")
        lines.append(f"  {'success' if self.success else 'no success'}: {self.message}")
        return "\n".join(lines)


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


def _findings(fit: Fit) -> Iterator[str]:
    if not fit.converged:
        yield with_remedy("the search did not converge", "give a start, or more starts")
    names = [name for name, identified in fit.identifiable.items() if not identified]
    subject = f"the data do not identify {listing(names)}"
    if len(names) == 1:
        yield with_remedy(subject, "fix it, or measure more")
    elif names and fit.combinations:
        yield with_remedy(f"{subject} alone, only {listing(fit.combinations)}", "fix one of them")
    elif names:
        remedy = "fix some, measure more, or widen the box"
        yield with_remedy(f"{subject} within their bounds", remedy)
    for name, end in fit.at_bounds.items():
        if fit.identifiable[name]:
            yield with_remedy(
                f"{quote(name)} = {fit.x[name]:.6g} is at the {end} end of its bounds: intervals "
                "are not valid there",
                "widen the bounds, or solve on a wider box",
            )
    for minimum in fit.others:
        where = ", ".join(f"{name} = {x:.6g}" for name, x in minimum.items())
        yield with_remedy(f"other values fit as well: {where}", "set bounds, or measure more")
    if fit.p_value < _UNLIKELY:
        yield (
            f"the residuals are {fit.sigma:.3g} times as large as sigma (chi2 {fit.chi2:.4g} with "
            f"{fit.dof} degrees of freedom, p = {fit.p_value:.1g}): the model does not describe "
            "the data, or sigma is larger"
        )
    if not fit.solution.success:
        yield f"the solution itself is not a success: {fit.solution.message}"
    yield from _error_of_solution(fit)


def _error_of_solution(fit: Fit) -> Iterator[str]:
    """Where the error of the solution is not small beside the noise."""
    for i, name in enumerate(fit.observations.names):
        here = fit.observations.owner == i
        error = fit.solution.errors[name]
        if not here.any() or math.isnan(error):
            continue
        absolute = error * float(fit.size[here][0])
        noise = fit._unit / fit.observations.scale[here]
        if absolute * float(np.sqrt(np.sum(noise**-2.0, where=noise > 0.0))) > _MODEL_SHARE:
            yield with_remedy(
                f"the error of the solution, {absolute:.2g} in {quote(name)}, is not small beside "
                f"the noise, {float(np.median(noise)):.2g}",
                "solve with a smaller rtol",
            )
