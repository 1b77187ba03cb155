"""What a fit says: best values, intervals, what is identified, and what speaks against it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.stats

from rankone.discretization.coordinates import name_of
from rankone.estimation.expressions import gradient, quantity
from rankone.estimation.findings import findings_of
from rankone.estimation.identification import Identification
from rankone.estimation.least_squares import LeastSquares
from rankone.estimation.observations import Observations
from rankone.estimation.profiles import Best, Profile, Stop, profiles
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.options import checked_number
from rankone.support.wording import count, did_you_mean, listing, quote

__all__ = ["Fit", "checked_level", "quantile_of"]

_NULL = 1e-3
"""Share of a gradient along flat directions from which a quantity is not identified."""

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
        Level of intervals where none is asked for.
    chi2 : float
        Sum of squares of the residuals over sigma; with weights, or with sigma unknown, of the
        weighted residuals.
    converged : bool
        Whether the search ended by itself.
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
    _row: Array
    _known: Identification
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
        every = {**self.x, **self.fixed}
        return {name: every[name] for name in self.solution.parameters}

    @cached_property
    def residuals(self) -> Any:
        """Data minus model, in the shape of the data; by name if the data were so."""
        return self.observations.arranged(-self._row / self.observations.scale)

    @property
    def dof(self) -> int:
        """Number of data less that of directions of the parameters that are fitted to them."""
        return self.observations.size - self._known.used

    @property
    def sigma(self) -> float:
        """Standard deviation of the residuals over what was given as sigma.

        Where no sigma was given it is the estimate of sigma, or of that of a datum of weight one.
        """
        return math.sqrt(self.chi2 / self.dof) if self.dof > 0 else math.nan

    @property
    def p_value(self) -> float:
        """Probability of residuals as large as these or larger; NaN where sigma is not known."""
        known = self.observations.known and self.dof > 0
        return float(scipy.stats.chi2.sf(self.chi2, self.dof)) if known else math.nan

    # --- uncertainty ---------------------------------------------------------------------------

    @property
    def _unit(self) -> float:
        """Standard deviation of scaled residuals: one, or the estimate."""
        return 1.0 if self.observations.known else self.sigma

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the estimates (n, n), by linearisation at the estimate.

        Infinite variances and NaN for parameters that the data do not identify.
        """
        root = self._known.root * self._problem.free.width[:, None] * self._unit
        found = root @ root.T
        flat = list(self._known.flat)
        found[flat], found[:, flat] = np.nan, np.nan
        found[flat, flat] = np.inf
        return np.asarray(found)

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
            Probability that an interval has the true value in it, by default that of the fit.
        method : {"linear", "profile"}
            By linearisation at the estimate, with quantiles of the normal distribution if sigma
            was given, else of Student's; these may reach beyond the box. Or the values for which
            the rest can be fitted almost as well, :meth:`profile`; these end at the box, and NaN
            says that an end is not known, since it is the box, not the data, that ends it.

        Raises
        ------
        OptionError
            If the level is not between 0 and 1, or the method unknown.
        """
        if method == "profile":
            return {name: _known_ends(self, name, level) for name in self.parameters}
        if method != "linear":
            raise OptionError(
                f"method={method!r} is unknown", remedy='choose "linear" or "profile"'
            )
        q = self._quantile(level)
        return {name: (self.x[name] - q * s, self.x[name] + q * s) for name, s in self.std.items()}

    def interval_of(self, given: Any, level: float | None = None) -> Interval:
        """An interval for a quantity of the parameters, such as ``"C_D/m"``, by linearisation.

        Also for combinations that are identified while the parameters in them are not.

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
            If it is no quantity of the parameters.
        """
        q = self._quantile(level)
        value, spread_of = self._quantity(given)
        return value - q * spread_of, value + q * spread_of

    def value_of(self, given: Any) -> float:
        """The estimate of a quantity of the parameters; see :meth:`interval_of`."""
        return self._quantity(given)[0]

    def profile(self, parameter: Any, level: float | None = None) -> Profile:
        """The profile likelihood of a parameter up to a level.

        Returns
        -------
        Profile
            In coordinates from 0 to 1 of the bounds; ends carry what stops them.
        """
        name = _parameter(self, parameter)
        index, limit = self.parameters.index(name), (self._quantile(level) * self._unit) ** 2
        deviation = np.minimum(self._known.spread * self._unit, 1.0)
        best = Best(self._z, self.chi2, deviation)
        return profiles(self._problem, best, limit, [index])[0]

    def _quantile(self, level: float | None) -> float:
        """Half the length of an interval, in standard deviations."""
        if level is None:
            return quantile_of(self.level, self.observations.known, self.dof)
        return quantile_of(checked_level(level), self.observations.known, self.dof)

    def _quantity(self, given: Any) -> tuple[float, float]:
        """A quantity at the estimate, and its standard deviation."""
        function = quantity(given, tuple(self.solution.parameters))
        width = dict(zip(self.parameters, self._problem.free.width, strict=True))
        try:
            value = function(self.values)
            slope = gradient(function, self.values, width) * self._problem.free.width
        except (ArithmeticError, ValueError) as reason:
            raise OptionError(f"{quote(given)} has no value at the fit: {reason}") from reason
        along = float(np.linalg.norm(slope @ self._known.null))
        if along > _NULL * float(np.linalg.norm(slope)):
            return value, math.inf
        return value, float(np.linalg.norm(slope @ self._known.root)) * self._unit

    # --- whether to believe it -----------------------------------------------------------------

    @property
    def identifiable(self) -> dict[str, bool]:
        """Whether the data identify each parameter.

        They do not where the others can make up for any value of it within the box.
        """
        return {name: i not in self._known.flat for i, name in enumerate(self.parameters)}

    @property
    def combinations(self) -> tuple[str, ...]:
        """Combinations that are identified, of parameters that are not: ``("C_D/m",)``."""
        return self._known.combinations

    @cached_property
    def findings(self) -> tuple[str, ...]:
        """What speaks against the fit, a sentence each."""
        return tuple(findings_of(self))

    @property
    def success(self) -> bool:
        """Whether nothing speaks against the fit; see :attr:`findings`."""
        return not self.findings

    @property
    def message(self) -> str:
        """What speaks against the fit, or that nothing does."""
        return "; ".join(self.findings) or "the fit converged, and nothing speaks against it"

    @property
    def at_bounds(self) -> dict[str, str]:
        """Parameters whose estimate is at the ``"lower"`` or ``"upper"`` end of its bounds."""
        ends = {}
        for name, z in zip(self.parameters, self._z, strict=True):
            if min(z, 1.0 - z) <= 1e-9:
                ends[name] = "lower" if z < 0.5 else "upper"
        return ends

    def __repr__(self) -> str:
        known = "given" if self.observations.known else "estimated"
        size = 1.0 if self.observations.known else self.sigma
        said = f"chi2 {self.chi2:.4g}" if self.observations.known else f"sigma {size:.4g} {known}"
        of = f"{count(self.observations.size, 'value')} of {', '.join(self.observations.names)}"
        lines = [f"Fit to {of}: {said}, {self.dof} degrees of freedom"]
        shown = f"{100 * self.level:g} %"
        width = max(len(name) for name in self.parameters)
        for name, (low, high) in self.interval().items():
            text = f"  {name:<{width}}  "
            if self.identifiable[name]:
                text += f"{self.x[name]:.6g}  {shown} in [{low:.6g}, {high:.6g}]"
            else:
                text += "not identified"
            lines.append(text)
        for text in self.combinations:
            low, high = self.interval_of(text)
            value = self.value_of(text)
            lines.append(
                f"  {text}  {value:.6g}  {100 * self.level:g} % in [{low:.6g}, {high:.6g}]"
            )
        return "\n".join(
            [*lines, f"  {'success' if self.success else 'no success'}: {self.message}"]
        )


def checked_level(level: Any) -> float:
    """A probability strictly between 0 and 1, or an OptionError."""
    level = checked_number("level", level, 0.0, 1.0, float)
    if not 0.0 < level < 1.0:
        raise OptionError(f"level={level:g} is not between 0 and 1", remedy="choose 0.95")
    return float(level)


def quantile_of(level: float, known: bool, dof: int) -> float:
    """Half the length of an interval in standard deviations; Student's for unknown sigma."""
    share = 0.5 + 0.5 * level
    return float(scipy.stats.norm.ppf(share) if known else scipy.stats.t.ppf(share, dof))


def _parameter(fit: Fit, key: Any) -> str:
    name = name_of(key)
    if name not in fit.parameters:
        raise OptionError(
            f"{quote(name)} is no free parameter{did_you_mean(name, fit.parameters)}",
            term=key,
            remedy=f"choose from {listing(fit.parameters)}",
        )
    return name


def _known_ends(fit: Fit, name: str, level: float | None) -> Interval:
    """The profile interval; NaN for an end that the box makes."""
    profile = fit.profile(name, level)
    j = fit.parameters.index(name)
    lower, width = fit._problem.free.lower[j], fit._problem.free.width[j]
    ends: Sequence[float] = [
        float(lower + width * end.z) if end.stop is Stop.DATA else math.nan
        for end in (profile.lower, profile.upper)
    ]
    return ends[0], ends[1]
