"""How sure the estimates of a fit are: covariance, intervals, profiles, fitted curves."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rankone.inference.estimation.estimates import Estimates
from rankone.inference.estimation.experiments import Seeds, Trial, trial_of
from rankone.inference.estimation.formulas import quantity, with_shape
from rankone.inference.estimation.identification import Paths, Profile, Stop, profiles
from rankone.inference.estimation.likelihood import Likelihood
from rankone.inference.estimation.noise import Noise
from rankone.inference.estimation.observations import checked_times
from rankone.support.arrays import TINY, Array
from rankone.support.errors import OptionError, did_you_mean, listing, quote
from rankone.support.options import checked_number
from rankone.tensors.coordinates import name_of


class Curve(NamedTuple):
    """Values of an observable (times,), and half the width of the band in which it is known."""

    values: Array
    half_width: Array


def curve_of(
    problem: Likelihood, trial: Trial, observable: str, times: ArrayLike, z: Array
) -> tuple[Array, Array]:
    """Values of an observable at times (k,), and derivatives (k, n) with respect to z (n,)."""
    names = trial.observations.names
    if observable not in names:
        raise OptionError(
            f"{quote(observable)} was not measured{did_you_mean(observable, names)}",
            term=observable,
            remedy=f"choose from {listing(names)}",
        )
    clock = checked_times(trial.solution, times)
    i = names.index(observable)
    observations = replace(
        trial.observations,
        names=(observable,),
        formulas=(trial.observations.formulas[i],),
        noises=(Noise("normal", np.ones(clock.size)),),
        owner=np.zeros(clock.size, dtype=np.intp),
        times=clock,
        values=np.zeros(clock.size),
    )
    there = trial_of(trial.name, trial.solution, trial.fixed, observations, trial.doses)
    free = problem.free
    seeds = Seeds({name: j for j, name in enumerate(free.names)}, len(free.names))
    at = problem.at(free.values(z)[None])
    states, slopes = there.linearised(at, seeds)
    with np.errstate(all="ignore"):
        predicted = there.predicted(at, states, slopes, seeds)[0].value
    curve = with_shape(predicted, (1, clock.size), seeds.width)
    return curve.value[0], curve.slope[0] * free.slopes(z)


# -----------------------------------------------------------------------------
# How sure the estimates of a fit are: covariance, intervals, profiles, what is identified.


Interval = tuple[float, float]


@dataclass(frozen=True, repr=False)
class Intervals(Estimates):
    """Estimates with their uncertainty."""

    # --- linearised ----------------------------------------------------------------------------

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the estimates (n, n), by linearisation at the estimate.

        It is marginal: the inverse of the information of the data plus that of what was known
        before. An interval of the box counts as a uniform distribution with the variance
        width^2/12, so that the variance of a parameter that the data do not identify is near that.
        """
        root = self._identification.root * self._problem.free.slopes(self._z)[:, None]
        return np.asarray(root @ root.T)

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
        self, level: float | None = None, *, method: str = "profile"
    ) -> dict[str, Interval]:
        """An interval for each parameter.

        Parameters
        ----------
        level : float, optional
            Probability that an interval contains the true value; by default the level of the fit.
        method : {"profile", "linear"}
            "profile" takes the values for which the other parameters can be fitted almost as well,
            see :meth:`profile`. Where the box ends an interval, not the data, the end is that of
            the box, and :attr:`limited` says so. "linear" linearises at the estimate, by the data
            alone within the box, with quantiles of the normal distribution if sigma was given, else
            of Student's: that is faster. Intervals of estimated levels of noise are by the
            distribution of a variance.

        Raises
        ------
        OptionError
            If the level is not between 0 and 1, or the method unknown.
        """
        if method not in ("profile", "linear"):
            raise OptionError(
                f"method={method!r} is unknown", remedy='choose "profile" or "linear"'
            )
        level = self.level if level is None else checked_level(level)
        by_profile: Mapping[int, Profile] = {}
        if method == "profile":
            by_profile = self._profiles if level == self.level else self._profiles_at(level)
        intervals = {}
        for j, name in enumerate(self.parameters):
            if j in self._freedom:
                intervals[name] = self._level_interval(j, self._freedom[j], level)
            elif by_profile:
                intervals[name] = self._profile_interval(by_profile[j])
            else:
                intervals[name] = self._linear_interval(j, level)
        return intervals

    def _linear_interval(self, j: int, level: float) -> Interval:
        """By linearisation, in the logarithm for parameters over decades."""
        along = np.eye(len(self.parameters))[j]
        half = self._quantile(level, along) * self.deviation(along)
        return self._ends(j, self._z[j] - half, self._z[j] + half)

    def _profile_interval(self, profile: Profile) -> Interval:
        """The ends of a profile, where the data or the box end it."""
        j, ends = profile.index, (profile.lower, profile.upper)
        free = j in self._identification.flat and j in self._problem.free.endless
        ended = [free or end.stop is Stop.BOUND for end in ends]
        low = -math.inf if ended[0] else profile.lower.z
        high = math.inf if ended[1] else profile.upper.z
        return self._ends(j, low, high)

    def _ends(self, j: int, low: float, high: float) -> Interval:
        """The values at two places of z_j: bounds outside of the cube, if there are any."""
        free = self._problem.free
        z = np.tile(self._z, (2, 1))
        z[:, j] = np.clip([low, high], 0.0, 1.0)
        lower, upper = free.values(z)[:, j]
        if low <= 0.0:
            lower = -math.inf if j in free.endless else free.lower[j]
        if high >= 1.0:
            upper = math.inf if j in free.endless else free.upper[j]
        return float(lower), float(upper)

    def _level_interval(self, j: int, share: float, level: float) -> Interval:
        """The interval of a level of noise by the distribution chi^2 of its square.

        Its degrees of freedom are those that the variance of its logarithm has: 1/(2 variance). Of
        the data, a ``share`` is left after the other parameters are fitted.
        """
        variance = np.sum(self._identification.seen[j] ** 2) * self._problem.free.logarithms[j] ** 2
        dof = 0.5 * share / variance
        tails = scipy.stats.chi2.ppf([0.5 + 0.5 * level, 0.5 - 0.5 * level], dof)
        ends = self._problem.free.values(self._z)[j] * np.sqrt(dof / np.maximum(tails, TINY))
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
            By the data alone: it knows no box, and is infinite where they do not identify it.

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

    def curve(self, observable: object, times: ArrayLike, *, experiment: int | str = 0) -> Curve:
        """The fitted curve of an observable, and how well it is known.

        The observable is a name, or an unknown of the solution.

        Returns
        -------
        Curve
            With ``values`` and ``half_width`` (times,): half the width of its band at the level of
            the fit, NaN where the data do not identify it.
        """
        at = self.trial(experiment)
        name = name_of(observable)
        values, slopes = curve_of(self._problem, at, name, times, self._z)
        half = np.array([self._quantile(None, slope) * self.deviation(slope) for slope in slopes])
        half[~np.isfinite(half)] = np.nan
        return Curve(values, half)

    def profile(self, parameter: object, *, level: float | None = None) -> Profile:
        """The profile likelihood of a parameter up to a level.

        Returns
        -------
        Profile
            In coordinates from 0 to 1 between the bounds; each end says what stops it.
        """
        index = self._problem.free.index(parameter)
        if level is None and index in self._profiles:
            return self._profiles[index]
        return self._profiles_of({index: self.rise(parameter, level=level)})[index]

    @cached_property
    def _profiles(self) -> dict[int, Profile]:
        """Those of all parameters but levels of noise, at the level of the fit."""
        ready = {} if self._problem.levels else self._identification.profiles
        return {**ready, **self._profiles_at(self.level, ready)}

    def _profiles_at(self, level: float, ready: Collection[int] = ()) -> dict[int, Profile]:
        """Profiles at a level, but those that are ready."""
        done = {*self._freedom, *ready}
        names = {j: name for j, name in enumerate(self.parameters) if j not in done}
        return self._profiles_of({j: self.rise(name, level=level) for j, name in names.items()})

    def _profiles_of(self, limits: Mapping[int, float]) -> dict[int, Profile]:
        """Profiles up to limits; those of levels of noise move all levels, the others none."""
        levels = self._problem.levels
        of_levels = {j: limit for j, limit in limits.items() if j in levels}
        others = {j: limit for j, limit in limits.items() if j not in levels}
        return {
            **profiles(self._problem, self._best, of_levels, (), self._paths),
            **profiles(self._problem, self._centre, others, levels, self._paths),
        }

    @cached_property
    def _paths(self) -> Paths:
        """What profiles of all levels have in common, as far as any was asked for."""
        return {}

    def rise(self, parameter: object, *, level: float | None = None) -> float:
        """By how much -2 log L is larger at the ends of profile intervals; squares without sigma.

        It is the square of the quantile, so that the intervals of a linear model are those by
        linearisation. Estimated levels of noise are held, and make it larger by what they add to
        the variance. For a level itself it is n log(1 + q^2/dof), with Student's quantile q, which
        is exact for one level and a linear model.
        """
        j = self._problem.free.index(parameter)
        q = self._quantile(level, np.eye(len(self.parameters))[j])
        if j in self._problem.levels:
            return self.size * math.log1p(q**2 / max(self.dof, 1))
        if self._levels is not None:
            plain = np.linalg.norm(self._levels.root[j])
            q *= float(np.linalg.norm(self._identification.seen[j]) / plain)
        return float((q * self._unit) ** 2)

    def _quantile(self, level: float | None, slope: Array) -> float:
        """Half the length of an interval in standard deviations, of a quantity with derivatives."""
        level = self.level if level is None else checked_level(level)
        dof = self.dof
        if self._levels is not None:
            dof = min(dof, self._levels.dof(slope))
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

        It is by the data alone, and infinite where they say nothing of it.
        """
        return self._identification.deviation(slope)

    # --- what is identified -------------------------------------------------------------------

    @property
    def identifiable(self) -> dict[str, bool]:
        """Whether the data identify each parameter.

        They do not if the others can make up for any value of it within the box.
        """
        flat = self._identification.flat
        return {
            name: j not in flat and self.limited[name] != "both"
            for j, name in enumerate(self.parameters)
        }

    @cached_property
    def limited(self) -> dict[str, str]:
        """Which ends of its profile interval the box makes, by parameter.

        ``"lower"``, ``"upper"``, ``"both"``, or ``""`` where the data end the interval.
        """
        names = enumerate(self.parameters)
        return {n: "" if j in self._freedom else self._profiles[j].limited for j, n in names}

    @cached_property
    def limits(self) -> dict[str, str]:
        """What but the data an interval depends on, in words, by parameter.

        Its own bounds, where they end the interval, or those of parameters that the data do not
        identify, if without them it would be much longer; and parameters that are :attr:`held`.
        """
        flat = [self.parameters[j] for j in self._identification.flat]
        words = {}
        for slope, (name, side) in zip(
            np.eye(len(self.parameters)), self.limited.items(), strict=True
        ):
            own = {"": "", "both": "both bounds"}.get(side, f"{side} bound")
            others = [other for other in flat if other != name]
            boxed = self._identification.boxed(slope) and others
            more = [f"bounds of {listing(others)}"] if boxed and not own else []
            conditions = [f"{listing(self.held)} held"] if self.held else []
            words[name] = ", ".join([*([own] if own else more), *conditions])
        return words

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
