"""Estimates of a population: means, spreads, subjects, and how sure they are."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from rankone.inference.estimation.formulas import value_of
from rankone.inference.estimation.identification import BOX_SHARE, UNIFORM_PRECISION
from rankone.inference.estimation.intervals import checked_level
from rankone.inference.estimation.noise import terms
from rankone.inference.estimation.observations import label
from rankone.inference.populations.individuals import EmpiricalBayes
from rankone.inference.populations.marginal import Marginal, Optimum, standard_steps
from rankone.inference.populations.population_layout import Layout
from rankone.inference.populations.subjects import Measured, Subjects
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import COINCIDENT, DIFFERENCE, MINOR, SAME, TINY, Array
from rankone.support.errors import OptionError, did_you_mean, listing, quote


@dataclass(frozen=True, repr=False)
class PopulationEstimates:
    """The estimates of a population; see :class:`.PopulationFit`."""

    level: float
    _marginal: Marginal
    _optimum: Optimum
    idle: tuple[str, ...] = ()

    # --- what was fitted -----------------------------------------------------------------------

    @property
    def solution(self) -> SolutionCore:
        """The solution that was fitted."""
        return self._subjects.solution

    @property
    def subjects(self) -> tuple[str, ...]:
        """Names of the subjects, in the order of the table."""
        return self._subjects.names

    @property
    def size(self) -> int:
        """Number of data."""
        return self._subjects.size

    @property
    def converged(self) -> bool:
        """Whether the search converged, for the population and for each subject."""
        return self._optimum.converged and bool(self._optimum.individuals.converged.all())

    @property
    def _search(self) -> EmpiricalBayes:
        return self._marginal.search

    @property
    def _subjects(self) -> Subjects:
        return self._search.subjects

    @property
    def _layout(self) -> Layout:
        return self._search.layout

    @property
    def _psi(self) -> Array:
        return self._optimum.psi

    # --- the population ------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[str, ...]:
        """Parameters of the solution that are estimated, random or not."""
        return self._layout.names

    @property
    def random(self) -> tuple[str, ...]:
        """Those that differ between subjects."""
        return tuple(self._layout.names[e] for e in self._layout.random)

    @cached_property
    def x(self) -> dict[str, float]:
        """Estimates of maximum likelihood by name.

        A random parameter stands for its typical value, that of a subject whose random effect and
        covariates are zero: the median, and the mean if it is normal. ``V~log(weight/70)`` is the
        coefficient of a covariate, ``omega_V`` the standard deviation of the random effect,
        ``correlation_V_CL`` that of two of them; levels of noise have the names of a fit.
        """
        layout, psi = self._layout, self._psi
        means = psi[layout.means]
        typical = layout.values(means[: len(layout.names)])
        estimates = dict(zip(layout.names, map(float, typical), strict=True))
        coefficients = means[len(layout.names) :]
        estimates |= {
            effect.name: float(c) for effect, c in zip(layout.effects, coefficients, strict=True)
        }
        spreads = zip(self._spread_names, _spreads(layout, psi[layout.factors]), strict=True)
        for name, coordinate in spreads:
            correlation = name.startswith("correlation")
            estimates[name] = float(np.tanh(coordinate) if correlation else np.exp(coordinate))
        levels = np.exp(psi[layout.noise])
        estimates |= dict(zip(layout.levels, map(float, levels), strict=True))
        return {**estimates, **dict.fromkeys(self.idle, 0.0)}

    @cached_property
    def _spread_names(self) -> tuple[str, ...]:
        """Names of standard deviations of random effects and of correlations."""
        below = [(i, j) for i, j in self._layout.entries if i != j]
        correlations = [f"correlation_{self.random[j]}_{self.random[i]}" for i, j in below]
        return (*(f"omega_{name}" for name in self.random), *correlations)

    @cached_property
    def omega(self) -> Array:
        """The covariance (q, q) of the random effects of :attr:`random`."""
        return self._layout.covariance(self._psi)

    @cached_property
    def log_likelihood(self) -> float:
        """The logarithm of the marginal density of all data, by Laplace's method."""
        return -0.5 * (self._optimum.value + self._subjects.constant())

    @property
    def aic(self) -> float:
        """Akaike's criterion."""
        return 2.0 * self._layout.size - 2.0 * self.log_likelihood

    @property
    def bic(self) -> float:
        """The Bayesian criterion, with the number of data."""
        return self._layout.size * math.log(self.size) - 2.0 * self.log_likelihood

    # --- how sure it is ------------------------------------------------------------------------

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Covariance and degrees of freedom, in the coordinates of the search."""
        return uncertainty_of(self._marginal, self._optimum)

    @cached_property
    def identifiable(self) -> dict[str, bool]:
        """Whether the data identify each parameter of the population."""
        layout, flat = self._layout, self.uncertainty.flat
        effects = (effect.name for effect in layout.effects)
        names = [*layout.names, *effects, *self._spread_names, *layout.levels]
        moves = flat.copy()
        moves[layout.factors] = self._spread_slopes.T @ flat[layout.factors]
        for j, name in enumerate(self._spread_names):
            if name.startswith("correlation"):
                moves[layout.factors.start + j] *= 1.0 - self.x[name] ** 2
        # a parameter moves along a flat direction that it has more than a minor share in
        unseen = (np.abs(moves) > MINOR * np.abs(flat).max(axis=0)).any(axis=1)
        return dict(zip(names, (~unseen).tolist(), strict=True)) | dict.fromkeys(self.idle, True)

    @cached_property
    def std(self) -> dict[str, float]:
        """Standard errors of :attr:`x`, by linearisation."""
        layout = self._layout
        errors = self.uncertainty.errors_of_means()
        typical = layout.values(self._psi[: len(layout.names)])
        slopes = np.append(layout.slopes(typical), np.ones(len(layout.effects)))
        names = [*layout.names, *(effect.name for effect in layout.effects)]
        stds = dict(zip(names, map(float, errors * slopes), strict=True))
        for name, _, variance in self._spread_coordinates():
            x = self.x[name]
            slope = 1.0 - x**2 if name.startswith("correlation") else x
            stds[name] = math.sqrt(variance) * slope
        return {**stds, **dict.fromkeys(self.idle, math.nan)}

    def interval(self, level: float | None = None) -> dict[str, tuple[float, float]]:
        """Intervals of :attr:`x` with a probability; left out, it is that of the fit.

        Those of means are Student's, in the coordinates in which subjects are normal; those of
        standard deviations are chi-squared ones, with a correction for the means that were fitted
        to the same subjects; those of correlations are normal in Fisher's coordinate. They are NaN
        for what is zero, and infinite for what the data do not identify.
        """
        level = self.level if level is None else checked_level(level)
        layout, psi = self._layout, self._psi
        intervals: dict[str, tuple[float, float]] = {}
        for e, (name, scale) in enumerate(zip(layout.names, layout.scales, strict=True)):
            ends = np.array(self.uncertainty.interval_of_mean(e, float(psi[e]), level))
            low, high = scale.value(ends)
            intervals[name] = float(low), float(high)
        for c, effect in enumerate(layout.effects):
            at = len(layout.names) + c
            intervals[effect.name] = self.uncertainty.interval_of_mean(at, float(psi[at]), level)
        for name, shift, variance in self._spread_coordinates():
            if name.startswith("correlation"):
                intervals[name] = _fisher(self.x[name], shift, variance, level)
            else:
                intervals[name] = self.uncertainty.interval_of_logarithm(
                    shift, variance, self.x[name], level
                )
        unseen = [name for name, identified in self.identifiable.items() if not identified]
        intervals |= dict.fromkeys(unseen, (-math.inf, math.inf))
        return {**intervals, **dict.fromkeys(self.idle, (math.nan, math.nan))}

    @cached_property
    def _spread_slopes(self) -> Array:
        """Derivatives (F, F) of the coordinates of spreads, in columns, by the entries of L."""
        layout = self._layout
        factors = self._psi[layout.factors]
        steps = DIFFERENCE * np.eye(factors.size)
        changes = [_spreads(layout, factors + h) - _spreads(layout, factors - h) for h in steps]
        return np.asarray(np.array(changes) / (2.0 * DIFFERENCE))

    def _spread_coordinates(self) -> Iterator[tuple[str, float, float]]:
        """For each spread its name, the correction of its coordinate, and the variance of that."""
        layout, u = self._layout, self.uncertainty
        factors, slopes = self._psi[layout.factors], self._spread_slopes
        shifts = _spreads(layout, u.corrected[layout.factors]) - _spreads(layout, factors)
        among = u.covariance[layout.factors, layout.factors]
        variances = np.einsum("ps,pq,qs->s", slopes, among, slopes)
        yield from zip(self._spread_names, map(float, shifts), map(float, variances), strict=True)
        levels = (u.corrected - self._psi)[layout.noise]
        own = np.diag(u.covariance)[layout.noise]
        yield from zip(layout.levels, map(float, levels), map(float, own), strict=True)

    # --- the subjects --------------------------------------------------------------------------

    @cached_property
    def effects(self) -> dict[str, Array]:
        """The most probable random effect of each subject (n,), by parameter."""
        return dict(zip(self.random, self._optimum.individuals.eta[0].T, strict=True))

    @cached_property
    def effect_std(self) -> dict[str, Array]:
        """Standard deviations (n,) of the random effects of each subject, given its data."""
        covariance = self._marginal.posterior_covariance(self._psi[None], self._optimum.individuals)
        return dict(zip(self.random, np.sqrt(np.diagonal(covariance[0], 0, 1, 2)).T, strict=True))

    @cached_property
    def individuals(self) -> dict[str, Array]:
        """The estimated parameters of each subject (n,), by name."""
        return self._by_name(self._coordinates())

    @cached_property
    def typical(self) -> dict[str, Array]:
        """The parameters (n,) of subjects with the same covariates and no random effects."""
        return self._by_name(self._layout.typical(self._psi[None])[0])

    def _coordinates(self) -> Array:
        """Coordinates (n, E) of all subjects."""
        coordinates = self._layout.typical(self._psi[None])[0]
        coordinates[:, list(self._layout.random)] += self._optimum.individuals.eta[0]
        return np.asarray(np.clip(coordinates, self._search.lower, self._search.upper))

    def _by_name(self, coordinates: Array) -> dict[str, Array]:
        return dict(zip(self._layout.names, self._layout.values(coordinates).T, strict=True))

    @cached_property
    def shrinkage(self) -> dict[str, float]:
        """One less the standard deviation of the effects over omega, by parameter.

        Near one the data of a subject say little of its parameter. ``"residuals"`` is one less the
        standard deviation of the residuals (Savic & Karlsson, AAPS J. 11, 2009).
        """
        spreads = np.sqrt(np.diag(self.omega))
        shares = {
            name: 1.0 - float(np.std(eta, ddof=1)) / float(spread) if eta.size > 1 else math.nan
            for (name, eta), spread in zip(self.effects.items(), spreads, strict=True)
        }
        rows = np.concatenate([row[~np.isnan(row)] for row in self.standardised.values()])
        return {**shares, "residuals": 1.0 - float(np.std(rows))}

    # --- predictions ---------------------------------------------------------------------------

    @cached_property
    def standardised(self) -> dict[str, Array]:
        """Residuals in standard deviations, (records, times) by observable; NaN where no data are.

        A record is the data of a subject under one condition.
        """
        residuals = {}
        for one, prediction, sigma in self.predicted(self.individuals):
            with np.errstate(all="ignore"):
                each = terms(one.noise, one.data, prediction, sigma, None)
            residuals[one.name] = np.where(one.present, -each.standardised, np.nan)
        return residuals

    def predicted(
        self, parameters: Mapping[str, Array], shifts: Mapping[str, float] | None = None
    ) -> Iterator[tuple[Measured, Array, Array]]:
        """For each observable the predictions and standard deviations (..., records, times).

        ``parameters`` are those of each subject (..., n), by name; ``shifts`` move states by a
        share of their largest size there.
        """
        subjects, layout = self._subjects, self._layout
        lead = np.shape(next(iter(parameters.values())))[:-1]
        at = {
            name: np.reshape(row, (-1, len(self.subjects)))[:, subjects.owner]
            for name, row in parameters.items()
        }
        states, _ = subjects.states.linearised(subjects.points(at), [])
        levels = {name: self.x[name] for name in (*layout.levels, *layout.zero_levels)}
        columns = {name: row[..., None] for name, row in at.items()}
        for i, one in enumerate(subjects.measured):
            own = subjects.operands(i, {**columns, **levels}, states)
            for name, share in (shifts or {}).items():
                if name in one.states:
                    own[name] = own[name] + share * np.abs(own[name]).max(initial=0.0)
            with np.errstate(all="ignore"):
                prediction = value_of(one.formula(own))
                sigma = value_of(one.noise.sigma({**own, one.name: prediction}))
            full, shape = (len(states), *one.data.shape), (*lead, *one.data.shape)
            yield (
                one,
                np.broadcast_to(prediction, full).reshape(shape),
                np.broadcast_to(sigma, full).reshape(shape),
            )

    @property
    def owner(self) -> NDArray[np.intp]:
        """For each record the position of its subject."""
        return self._subjects.owner

    def measured(self, observable: object = None) -> Measured:
        """What was measured of an observable, the first one if none is named."""
        names = [one.name for one in self._subjects.measured]
        name = names[0] if observable is None else label(self.solution, observable)
        if name not in names:
            raise OptionError(
                f"{quote(name)} was not observed{did_you_mean(name, names)}",
                term=observable,
                remedy=f"choose from {listing(names)}",
            )
        return self._subjects.measured[names.index(name)]

    def curve(
        self,
        subject: object,
        times: ArrayLike,
        *,
        observable: str | None = None,
        typical: bool = False,
    ) -> Array:
        """The curve of a subject, (times,), or (records, times) if it was seen in several.

        Parameters
        ----------
        subject : str
            Its name.
        times : array_like (times,)
            Times inside of the horizon.
        observable : str, optional
            By default the first one.
        typical : bool
            Whether to leave out the random effects: the curve that its covariates predict.
        """
        one = self.measured(observable)
        if str(subject) not in self.subjects:
            raise OptionError(
                f"there is no subject {quote(subject)}{did_you_mean(str(subject), self.subjects)}",
                term=subject,
                remedy=f"choose from {listing(self.subjects)}",
            )
        i = self.subjects.index(str(subject))
        own = self.typical if typical else self.individuals
        clock = np.atleast_1d(np.asarray(times, dtype=float))
        rows = []
        for record in np.flatnonzero(self._subjects.owner == i):
            at = {name: float(column[i]) for name, column in own.items()}
            at |= {name: float(column[record]) for name, column in self._subjects.held.items()}
            doses = self._subjects.doses.selected(np.array([record]))
            since, weights = (each[0] for each in doses.response(clock[None]))
            states = {
                state: (weights * self.solution[state](since, at)).sum(axis=-1)
                for state in one.states
            }
            operands = {**at, **states, self.solution.metadata.time: clock}
            rows.append(np.broadcast_to(value_of(one.formula(operands)), clock.shape))
        return np.array(rows[0] if len(rows) == 1 else rows)


def _spreads(layout: Layout, factors: Array) -> Array:
    """Logarithms of standard deviations, and Fisher's coordinates of correlations."""
    psi = np.zeros(layout.size)
    psi[layout.factors] = factors
    omega = layout.covariance(psi)
    spreads = np.sqrt(np.diag(omega))
    below = [(i, j) for i, j in layout.entries if i != j]
    correlations = [omega[i, j] / (spreads[i] * spreads[j]) for i, j in below]
    return np.append(np.log(spreads), np.arctanh(correlations))


def _fisher(correlation: float, shift: float, variance: float, level: float) -> tuple[float, float]:
    """The interval of a correlation."""
    q = float(scipy.stats.norm.ppf(0.5 + 0.5 * level)) * math.sqrt(variance)
    centre = math.atanh(correlation) + shift
    return math.tanh(centre - q), math.tanh(centre + q)


# -----------------------------------------------------------------------------
# How sure population parameters are: standard errors, degrees of freedom, intervals.
#
# Variances of maximum likelihood are too small in small populations, since means were fitted to the
# same subjects. So they are corrected by one step towards the restricted likelihood, which adds
# log |I| of the information I about the means (Lindstrom & Bates, 1990). Intervals of means are
# Student's, those of standard deviations chi-squared ones, with degrees of freedom after
# Satterthwaite (Biometrics Bulletin 2, 1946): twice the square of a variance over its own variance.


_STEP = 0.1  # Displacements in standard errors for differences
_LARGEST_CORRECTION = 0.5  # Largest change of the logarithm of a standard deviation


@dataclass(frozen=True)
class Uncertainty:
    """The covariance (P, P) of population parameters psi, and what intervals take.

    ``corrected`` (P,) are the parameters with the correction of the spreads, ``inflation`` (B,)
    the ratio of variances of means with and without it, ``freedom`` (B,) their degrees of freedom.
    ``flat`` are directions (P, k) of psi that the data do not identify.
    """

    covariance: Array
    corrected: Array
    inflation: Array
    freedom: Array
    flat: Array

    def errors_of_means(self) -> Array:
        """Standard errors (B,) of means and coefficients."""
        count = self.inflation.size
        return np.sqrt(np.diag(self.covariance)[:count] * self.inflation)

    def interval_of_mean(self, position: int, estimate: float, level: float) -> tuple[float, float]:
        """Student's interval of a mean or coefficient, in its coordinate."""
        q = scipy.stats.t.ppf(0.5 + 0.5 * level, self.freedom[position])
        half = float(q * self.errors_of_means()[position])
        return estimate - half, estimate + half

    def interval_of_logarithm(
        self, shift: float, variance: float, estimate: float, level: float
    ) -> tuple[float, float]:
        """Chi-squared interval of a standard deviation.

        ``shift`` is the correction of its logarithm, ``variance`` that of the logarithm.
        """
        if not (math.isfinite(variance) and variance > 0.0):
            return 0.0, math.inf
        freedom = max(0.5 / variance * math.exp(-2.0 * shift), 1.0)
        corrected = estimate * math.exp(shift)
        low, high = scipy.stats.chi2.ppf([0.5 - 0.5 * level, 0.5 + 0.5 * level], freedom)
        return corrected * math.sqrt(freedom / high), corrected * math.sqrt(freedom / low)


def uncertainty_of(marginal: Marginal, optimum: Optimum) -> Uncertainty:
    """The uncertainty at an optimum."""
    layout = marginal.search.layout
    box = np.zeros(layout.size)
    box[: len(layout.names)] = (
        UNIFORM_PRECISION / (marginal.search.upper - marginal.search.lower) ** 2
    )
    of_means = marginal.information_of_means(optimum.psi[None], optimum.individuals)[0]
    covariance, flat = _covariance(optimum.hessian, of_means, box)
    means, spreads = layout.means, layout.spreads
    scale = standard_steps(optimum.hessian)
    among = covariance[spreads, spreads]
    slope = _slopes_of_information(marginal, optimum, box, scale)
    shift = -0.5 * among @ slope[:, 0]
    shift = np.clip(shift, -_LARGEST_CORRECTION, _LARGEST_CORRECTION)
    corrected = optimum.psi.copy()
    corrected[spreads] += shift
    psi = np.stack([optimum.psi, corrected])
    _, individuals = marginal.at(psi, optimum.slopes.start(psi - optimum.psi))
    with np.errstate(all="ignore"):
        information = marginal.information_of_means(psi, individuals)
        before, after = _of_means(information, box, scale)[1]
        inflation = np.nan_to_num(after / before, nan=1.0, posinf=1.0)
        variances = np.einsum("vb,vw,wb->b", slope[:, 1:], among, slope[:, 1:])
        freedom = np.maximum(2.0 / variances / np.maximum(inflation, 1e-3), 1.0)
    freedom = np.where(variances > 0.0, freedom, 1e9)
    assert inflation.size == means.stop
    covariance = covariance + flat @ flat.T  # what the box says of these
    return Uncertainty(covariance, corrected, inflation, freedom, flat)


def _covariance(hessian: Array, of_means: Array, box: Array) -> tuple[Array, Array]:
    """The covariance (P, P) of the data alone, and the directions (P, k) that these do not tell.

    Half of the Hessian of -2 log L is the precision of the data. By differences it is rough: the
    information ``of_means`` (B, B) says what the data do not tell of these. The directions are
    roots of the variance of the box.
    """
    scale, count = standard_steps(hessian), len(of_means)
    _, unseen = _split(of_means, box[:count], scale[:count])
    ways = np.zeros((scale.size, unseen.shape[1]))
    ways[:count] = unseen / scale[:count, None]
    basis, _ = np.linalg.qr(ways)
    rest = (np.eye(scale.size) - basis @ basis.T) / scale[:, None]
    data = 0.5 * hessian * scale[:, None] * scale
    seen, flat = _split(rest @ data @ rest.T, box, scale)
    return seen @ seen.T, flat


def _split(precision: Array, box: Array, scale: Array) -> tuple[Array, Array]:
    """Roots of covariances: what the data alone say (P, r), and where the box decides (P, k).

    ``precision`` (P, P) is that of the data, ``box`` (P,) that of the box, see
    :meth:`.Identification.boxed`.
    """
    whole = (precision + np.diag(box)) * scale[:, None] * scale
    eigenvalues, vectors = np.linalg.eigh(whole)
    steep = eigenvalues > SAME * max(float(eigenvalues.max()), TINY)
    root = vectors[:, steep] * scale[:, None] / np.sqrt(eigenvalues[steep])
    shares, turns = np.linalg.eigh(root.T @ (box[:, None] * root))
    lost, root = shares > BOX_SHARE, root @ turns
    by_data = root[:, ~lost] / np.sqrt(1.0 - shares[~lost])
    endless = vectors[:, ~steep] * scale[:, None] / np.sqrt(COINCIDENT)
    return by_data, np.concatenate([root[:, lost], endless], axis=1)


def _of_means(information: Array, box: Array, scale: Array) -> tuple[Array, Array]:
    """Log determinants (K,) of the information (K, B, B) about means, and their variances (K, B).

    Both are marginal: the precision of the ``box`` (P,) is added. ``scale`` (P,) is that of all
    population parameters.
    """
    unit = scale[: information.shape[-1]]
    whole = (information + np.diag(box[: unit.size])) * unit[:, None] * unit
    whole = whole + COINCIDENT * np.eye(unit.size)
    variances = np.diagonal(np.linalg.inv(whole), 0, 1, 2) * unit**2
    return np.linalg.slogdet(whole)[1], np.asarray(variances)


def _slopes_of_information(marginal: Marginal, optimum: Optimum, box: Array, scale: Array) -> Array:
    """Derivatives with respect to the spreads of log |I|, and of logarithms of variances of means.

    Shape (V, 1 + B), by central differences.
    """
    layout, psi = marginal.search.layout, optimum.psi
    size = layout.spreads.stop - layout.spreads.start
    steps = np.zeros((size, psi.size))
    h = _STEP * scale[layout.spreads]
    steps[range(size), range(layout.spreads.start, layout.spreads.stop)] = h
    moves = np.concatenate([steps, -steps])
    points = psi + moves
    _, individuals = marginal.at(points, optimum.slopes.start(moves))
    information = marginal.information_of_means(points, individuals)
    logarithms, variances = _of_means(information, box, scale)
    columns = np.concatenate([logarithms[:, None], np.log(variances)], axis=1)
    return np.asarray((columns[:size] - columns[size:]) / (2.0 * h[:, None]))
