"""The marginal likelihood by Laplace's method, its derivatives, and where it is largest.

-2 log L_i = -2 log p(y_i | eta_i) + eta_i' Omega^-1 eta_i + log |I + L' M_i L|, with the Fisher
information M_i of the data about the random effects at their mode eta_i: first-order conditional
estimation with interaction (Lindstrom & Bates, Biometrics 46, 1990; Wang, J. Pharmacokinet.
Pharmacodyn. 34, 2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.experiments import failure_of
from rankone.inference.populations.individuals import EmpiricalBayes, Individuals, Start, linearised
from rankone.inference.populations.population_layout import Layout
from rankone.inference.populations.subjects import Subjects
from rankone.support.arrays import COARSE, MINOR, MOST_ROUNDS, NEGLIGIBLE, TINY, Array, spread
from rankone.support.errors import EvaluationError, OptionError, quote


@dataclass(frozen=True)
class PopulationTuning:
    """Tuning of the marginal likelihood and of the search for its optimum."""

    points_at_once: int = 256
    """Population parameters that are evaluated together, to bound memory."""
    step: float = COARSE
    """Displacements in standard deviations of a coordinate, or of logarithms of levels."""
    least_curvature: float = COARSE
    """Of second derivatives, in units of the expected ones."""
    screened_points: int = 512
    """Points of the box that are tried for each subject."""
    farthest_datum: float = 1e8
    """Squared distance of data in estimated deviations that no curve explains."""
    expectations: int = 12
    """Steps of expectation and maximisation."""
    steps_each: int = 4
    """Steps of the random effects in each of them."""
    start_spread: float = 0.15
    """Standard deviation of random effects at the start, in widths of the box."""
    start_relative: float = 0.2
    """Levels of noise at the start, in shares of the data."""
    least_spread: float = COARSE
    """Least standard deviation of a random effect in the first steps."""
    most_iterations: int = 40
    """Most quasi-Newton steps."""
    converged: float = 1e-8
    """Expected gain in -2 log L that ends the search."""
    hessian_step: float = 0.05
    """Displacements in standard errors."""
    first_steps: float = MINOR
    """Standard errors of all population parameters that are assumed at first."""
    longest_step: float = 3.0
    """Longest step in standard errors of any parameter."""
    curvature_floor: float = 1e-4
    """Least curvature in a step, in units of the expected ones."""


TUNING = PopulationTuning()


@dataclass(frozen=True)
class Marginal:
    """-2 log L of the population parameters, and what follows from it."""

    search: EmpiricalBayes

    def at(self, psi: Array, start: Start, steps: int = MOST_ROUNDS) -> tuple[Array, Individuals]:
        """-2 log L (K,), up to a constant, at psi (K, P), and the random effects there."""
        individuals = self.search(psi, start, steps)
        return self._values(psi, individuals), individuals

    def values(self, psi: Array, start: Start) -> Array:
        """-2 log L (K,) at psi (K, P), block after block."""
        blocks = range(0, len(psi), TUNING.points_at_once)
        return np.concatenate(
            [self.at(psi[k : k + TUNING.points_at_once], start)[0] for k in blocks]
        )

    def slopes(self, psi: Array, individuals: Individuals) -> Slopes:
        """The derivatives at psi (K, P), where the random effects are at their modes."""
        return slopes_of(self.search, psi, individuals)

    def gradients(self, psi: Array, start: Start) -> Array:
        """The derivatives (K, P) of -2 log L at psi (K, P), from a start for each of these."""
        layout = self.search.layout
        step = max(TUNING.points_at_once // (2 * len(layout.names) + 2 * len(layout.levels)), 1)
        gradients = []
        for here in (slice(k, k + step) for k in range(0, len(psi), step)):
            individuals = self.search(psi[here], start._replace(eta=start.eta[here]))
            gradients.append(self.slopes(psi[here], individuals).gradient)
        return np.concatenate(gradients)

    def _values(self, psi: Array, individuals: Individuals) -> Array:
        factor = self.search.layout.cholesky(psi)[:, None]
        random = list(self.search.layout.random)
        information = individuals.at.information[..., random, :][..., random]
        with np.errstate(all="ignore"):
            matrix = np.eye(len(random)) + factor.swapaxes(-1, -2) @ information @ factor
            usable = np.asarray(np.isfinite(matrix).all(axis=(-1, -2)))
            matrix = np.where(usable[..., None, None], matrix, np.eye(len(random)))
            each = individuals.at.cost + individuals.penalty + np.linalg.slogdet(matrix)[1]
        whole = each.sum(axis=-1)
        return np.where(np.isnan(whole), np.inf, whole)

    def information_of_means(self, psi: Array, individuals: Individuals) -> Array:
        """The expected information (K, B, B) about means and coefficients at psi (K, P).

        X' (M - M Z (Z' M Z + Omega^-1)^-1 Z' M) X, summed over subjects: that of the linear mixed
        model at the modes.
        """
        marginal = self.marginal_information(psi, individuals)
        designs = self.search.layout.designs
        return np.asarray(np.einsum("nep,knef,nfq->kpq", designs, marginal, designs, optimize=True))

    def marginal_information(self, psi: Array, individuals: Individuals) -> Array:
        """The information (K, n, E, E) of each subject about its typical coordinates."""
        random = list(self.search.layout.random)
        whole = individuals.at.information
        factor = self.search.layout.cholesky(psi)[:, None]
        to_random = whole[..., random] @ factor
        inner = np.eye(len(random)) + factor.swapaxes(-1, -2) @ to_random[..., random, :]
        return np.asarray(whole - to_random @ np.linalg.solve(inner, to_random.swapaxes(-1, -2)))

    def posterior_covariance(self, psi: Array, individuals: Individuals) -> Array:
        """The covariance (K, n, q, q) of the random effects of each subject given its data."""
        random = list(self.search.layout.random)
        factor = self.search.layout.cholesky(psi)[:, None]
        information = individuals.at.information[..., random, :][..., random]
        inner = np.eye(len(random)) + factor.swapaxes(-1, -2) @ information @ factor
        return np.asarray(factor @ np.linalg.solve(inner, factor.swapaxes(-1, -2)))


# -----------------------------------------------------------------------------
# Derivatives of the marginal likelihood and of the modes with respect to population parameters.
#
# The mode eta of a subject solves g(eta, psi) = 0, where g is half the gradient of the sum that the
# mode minimises. So d eta / d psi = -H^-1 dg/dpsi with H = dg/deta (Almquist, Leander & Jirstrand,
# J. Pharmacokinet. Pharmacodyn. 42, 2015). The part of the data in g and in the Fisher information
# is differentiated by differences in the coordinates of subjects, so no other mode is searched for.


@dataclass(frozen=True)
class Slopes:
    """Derivatives at K population parameters.

    ``gradient`` (K, P) is that of -2 log L, ``effects`` (K, n, q, P) are the derivatives of the
    modes ``eta`` (K, n, q), and ``correction`` (K, n, q, q) is what the Fisher information lacks of
    half the second derivatives.
    """

    gradient: Array
    effects: Array
    eta: Array
    correction: Array

    def start(self, moves: Array) -> Start:
        """Where modes are expected after moves (L, P) from the first population parameters."""
        eta = self.eta[0] + np.einsum("nqp,lp->lnq", self.effects[0], moves)
        return Start(eta, self.correction[0])


def slopes_of(search: EmpiricalBayes, psi: Array, individuals: Individuals) -> Slopes:
    """The derivatives at psi (K, P), where the random effects are at their modes.

    The gradient is NaN where the likelihood of a subject is zero.
    """
    point = _Point(search, psi, individuals)
    data = _of_data(point)
    second = data.gradient[..., point.random]
    correction = 0.5 * (second + second.swapaxes(-1, -2)) - point.information
    effects = _effects(point, data, correction)
    gradient = _gradient(point, data, effects)
    gradient[~np.isfinite(individuals.at.cost).all(axis=-1)] = np.nan
    return Slopes(gradient, effects, individuals.eta, correction)


@dataclass(frozen=True)
class _Point:
    """Population parameters psi (K, P), and the modes there."""

    search: EmpiricalBayes
    psi: Array
    individuals: Individuals

    @property
    def layout(self) -> Layout:
        return self.search.layout

    @property
    def random(self) -> list[int]:
        return list(self.layout.random)

    @cached_property
    def factor(self) -> Array:
        """L (K, 1, q, q)."""
        return self.layout.cholesky(self.psi)[:, None]

    @cached_property
    def tangents(self) -> Array:
        """Derivatives (K, F, q, q) of L with respect to its entries in psi."""
        tangents = np.zeros((len(self.psi), len(self.layout.entries), *self.factor.shape[2:]))
        for f, (i, j) in enumerate(self.layout.entries):
            tangents[:, f, i, j] = self.factor[:, 0, i, i] if i == j else 1.0
        return tangents

    @property
    def whitened(self) -> Array:
        """The random effects b (K, n, q) of unit covariance: eta = L b."""
        return self.individuals.whitened

    @cached_property
    def turned(self) -> Array:
        """T b and T' b (2, K, F, n, q) with T = L^-1 dL for each entry of L in psi."""
        turns = np.linalg.solve(self.factor, self.tangents)
        b = self.whitened
        return np.array(
            [np.einsum("kfqr,knr->kfnq", turns, b), np.einsum("kfrq,knr->kfnq", turns, b)]
        )

    @cached_property
    def spread(self) -> Array:
        """I + L' M L (K, n, q, q): the expected information about the whitened random effects."""
        own = self.factor.swapaxes(-1, -2) @ self.information @ self.factor
        return np.asarray(np.eye(len(self.random)) + own)

    @cached_property
    def unbounded(self) -> Array:
        """Coordinates (K, n, E) of the subjects, before they are kept in the box."""
        place = self.layout.typical(self.psi)
        place[..., self.random] += self.individuals.eta
        return place

    @cached_property
    def place(self) -> Array:
        """Coordinates (K, n, E) of the subjects."""
        return np.clip(self.unbounded, self.search.lower, self.search.upper)

    @cached_property
    def designs(self) -> Array:
        """Derivatives (K, n, E, B) of coordinates by the means, with random effects held."""
        moving = self.unbounded == self.place
        moving[..., self.random] = True
        return np.where(moving[..., None], self.layout.designs, 0.0)

    @cached_property
    def information(self) -> Array:
        """The Fisher information (K, n, q, q) of the data about random effects."""
        return self.individuals.at.information[..., self.random, :][..., self.random]

    def at_end(self) -> NDArray[np.bool_]:
        """Which random effects (K, n, q) are held by an end of the box."""
        ends = (self.place <= self.search.lower) | (self.place >= self.search.upper)
        return np.asarray(ends[..., self.random])


class _OfData(NamedTuple):
    """Derivatives of what the data add, along E coordinates and then S logarithms of levels.

    ``gradient`` (K, n, q, E + S) are those of half the gradient of the cost by random effects,
    ``information`` (K, n, q, q, E + S) those of their Fisher information. ``cost`` (K, n, S) is
    differentiated along levels alone.
    """

    gradient: Array
    information: Array
    cost: Array


def _of_data(point: _Point) -> _OfData:
    """Central differences at the modes, one-sided at an end of the box."""
    layout, random, place = point.layout, point.random, point.place
    width, count = len(layout.names), len(layout.names) + len(layout.levels)
    h = _displacements(point)
    places = np.tile(place, (2, count, 1, 1, 1))
    psi = np.tile(point.psi, (2, count, 1, 1))
    distances = np.full((count, *place.shape[:2]), 2.0 * TUNING.step)
    for e, (lower, upper) in enumerate(zip(point.search.lower, point.search.upper, strict=True)):
        sides = place[..., e] + h[..., e], place[..., e] - h[..., e]
        places[:, e, ..., e] = np.clip(sides, lower, upper)
        distances[e] = places[0, e, ..., e] - places[1, e, ..., e]
    for s in range(count - width):
        psi[:, width + s, :, layout.noise.start + s] += np.array([[TUNING.step], [-TUNING.step]])
    flat = psi.reshape(-1, layout.size), places.reshape(-1, *place.shape[1:])
    ends = linearised(point.search.subjects, layout, *flat)

    def differences(rows: Array) -> Array:
        sides = rows.reshape(*places.shape[:4], *rows.shape[2:])
        apart = distances.reshape(*distances.shape, *(1,) * (rows.ndim - 2))
        return np.moveaxis((sides[0] - sides[1]) / apart, 0, -1)

    return _OfData(
        differences(ends.gradient[..., random]),
        differences(ends.information[..., random, :][..., random]),
        differences(ends.cost)[..., width:],
    )


def _displacements(point: _Point) -> Array:
    """A small share (K, n, E) of what each coordinate is uncertain by."""
    precision = np.diagonal(point.individuals.at.information, 0, -1, -2).copy()
    variances = (point.factor**2).sum(axis=-1)
    precision[..., point.random] += 1.0 / variances
    width = point.search.upper - point.search.lower
    return np.asarray(TUNING.step / np.sqrt(np.maximum(precision, width**-2.0)))


def _effects(point: _Point, data: _OfData, correction: Array) -> Array:
    """Derivatives (K, n, q, P) of the modes; those at an end of the box stay there."""
    layout, factor, width = point.layout, point.factor, len(point.layout.names)
    partial = np.zeros((*point.individuals.eta.shape, layout.size))  # L' dg/dpsi
    turned = np.moveaxis(point.turned.sum(axis=0), 1, -1)
    to_data = factor.swapaxes(-1, -2)
    partial[..., layout.means] = to_data @ data.gradient[..., :width] @ point.designs
    partial[..., layout.factors] = -turned
    partial[..., layout.noise] = to_data @ data.gradient[..., width:]
    roots = _inverse_roots(point.spread, to_data @ correction @ factor)
    effects = -factor @ roots @ (roots.swapaxes(-1, -2) @ partial)
    at_end = point.at_end()
    if not at_end.any():
        return np.asarray(effects)
    ends = np.zeros_like(effects)
    ends[..., layout.means] = -point.designs[..., point.random, :]
    inverse = factor @ roots @ (factor @ roots).swapaxes(-1, -2)
    return _held(effects, inverse, ends, at_end)


def _inverse_roots(expected: Array, correction: Array) -> Array:
    """Matrices R (K, n, q, q) with R R' the inverse of the corrected information.

    In the metric of the expected one, curvatures are kept from zero.
    """
    root = np.linalg.cholesky(expected)
    across = np.linalg.solve(root, correction).swapaxes(-1, -2)
    across = np.linalg.solve(root, across)
    curvatures, vectors = np.linalg.eigh(np.eye(expected.shape[-1]) + across)
    scale = np.sqrt(np.maximum(curvatures, TUNING.least_curvature))[..., None, :]
    return np.asarray(np.linalg.solve(root.swapaxes(-1, -2), vectors) / scale)


def _held(effects: Array, inverse: Array, ends: Array, at_end: NDArray[np.bool_]) -> Array:
    """Derivatives of the modes where those at an end of the box move with it.

    ``inverse`` (K, n, q, q) is that of half the second derivatives, ``ends`` (K, n, q, P) are the
    derivatives of the ends.
    """
    pairs = at_end[..., :, None] & at_end[..., None, :]
    forces = np.where(at_end[..., None], effects - ends, 0.0)
    forces = np.linalg.solve(np.where(pairs, inverse, np.eye(at_end.shape[-1])), forces)
    return np.where(at_end[..., None], ends, effects - inverse @ forces)


def _gradient(point: _Point, data: _OfData, effects: Array) -> Array:
    """The derivatives (K, P) of -2 log L."""
    layout, at = point.layout, point.individuals.at
    moved = np.zeros((*point.place.shape, layout.size))  # Of the coordinates
    moved[..., layout.means] = point.designs
    moved[..., point.random, :] += effects
    pull = np.linalg.solve(point.factor.swapaxes(-1, -2), point.whitened[..., None])[..., 0]
    gradient = 2.0 * np.einsum("kne,knep->kp", at.gradient, moved)
    gradient += 2.0 * np.einsum("knq,knqp->kp", pull, effects)
    gradient[:, layout.factors] -= 2.0 * np.einsum("knq,kfnq->kf", point.whitened, point.turned[0])
    gradient[:, layout.noise] += data.cost.sum(axis=1)
    return np.asarray(gradient + _of_determinants(point, data.information, moved))


def _of_determinants(point: _Point, changes: Array, moved: Array) -> Array:
    """The derivatives (K, P) of the sum of log |I + L' M L| over subjects."""
    factor, information, width = point.factor, point.information, len(point.layout.names)
    right = factor @ np.linalg.inv(point.spread)
    along = np.einsum("knqr,knqre->kne", right @ factor.swapaxes(-1, -2), changes)
    gradient = np.asarray(np.einsum("kne,knep->kp", along[..., :width], moved))
    gradient[:, point.layout.noise] += along[..., width:].sum(axis=1)
    pairs = (information @ right).sum(axis=1)
    gradient[:, point.layout.factors] += 2.0 * np.einsum("kqr,kfqr->kf", pairs, point.tangents)
    return gradient


# -----------------------------------------------------------------------------
# The population parameters of largest likelihood.
#
# The search begins with the best of many points of the box for each subject. A few steps of
# expectation and maximisation then bring means, covariance and noise near the optimum (Lindstrom &
# Bates, Biometrics 46, 1990, for the means), and quasi-Newton steps on the marginal likelihood and
# its derivatives end the search.


_SHARES = np.geomspace(1.0, COARSE, 7)  # Shares of a step that are tried


@dataclass(frozen=True)
class Optimum:
    """Where -2 log L is least: psi (P,), random effects, derivatives, and the Hessian (P, P)."""

    psi: Array
    value: float
    individuals: Individuals
    slopes: Slopes
    hessian: Array
    converged: bool


def start_of(
    subjects: Subjects, search: EmpiricalBayes, given: dict[int, float]
) -> tuple[Array, Start]:
    """Population parameters (P,) and random effects to begin with.

    ``given`` are coordinates of means by position.
    """
    layout = search.layout
    shares = spread(TUNING.screened_points, len(layout.names), np.random.default_rng(7))
    places = search.lower + shares * (search.upper - search.lower)
    for position, coordinate in given.items():
        places[:, position] = coordinate
    psi = np.zeros((1, layout.size))
    psi[:, layout.noise] = _noise_start(subjects, layout)
    n = len(subjects.names)
    repeated = np.broadcast_to(places[:, None], (len(places), n, len(layout.names)))
    screened = linearised(subjects, layout, np.repeat(psi, len(places), 0), repeated)
    _check_deviations(subjects, layout, screened.cost, screened.squares, bool(given))
    best = places[np.argmin(screened.cost, axis=0)]
    psi = psi[0]
    psi[: len(layout.names)] = middle = np.median(best, axis=0)
    own = np.where(np.isin(np.arange(middle.size), layout.random), best, middle)
    if not np.isfinite(linearised(subjects, layout, psi[None], own[None]).cost).all():
        # What all subjects share is too late or early for some
        own[:] = psi[: middle.size] = places[np.argmin(screened.cost.sum(axis=1))]
    width = (search.upper - search.lower)[list(layout.random)]
    psi[layout.factors] = layout.factored(np.diag((TUNING.start_spread * width) ** 2))
    random = list(layout.random)
    return psi, Start.at(own[:, random] - layout.typical(psi[None])[0][:, random])


def _check_deviations(
    subjects: Subjects, layout: Layout, cost: Array, squares: Array, started: bool
) -> None:
    """Raise an OptionError for subjects with a datum of no deviation at the best of places (K, n).

    Proportional noise has none where the prediction is zero. A start may limit the places.
    """
    least = np.take_along_axis(squares, np.argmin(cost, axis=0)[None], axis=0)[0]
    far = least > TUNING.farthest_datum if layout.levels else np.zeros(least.size, dtype=bool)
    impossible = np.flatnonzero(far | ~np.isfinite(cost).any(axis=0))
    if impossible.size:
        where = "with the start that was given" if started else "in the box"
        far_off = (
            f"the data of subject {quote(subjects.names[impossible[0]])} are far from all curves "
            f"{where}: the standard deviation of a datum is zero, or an event ends the solution"
        )
        raise OptionError(
            "; ".join([*_failures(subjects), far_off]),
            remedy=f"{'give another start, ' if started else ''}leave out data where the "
            'prediction is zero, as before the first dose, or choose noise="combined"',
        )


def _failures(subjects: Subjects) -> list[str]:
    return [] if subjects.solution.success else [failure_of(subjects.solution)]


def _noise_start(subjects: Subjects, layout: Layout) -> Array:
    """Logarithms of levels: relative ones a share, others that share of the typical datum."""
    levels = {}
    for one in subjects.measured:
        typical = float(np.median(np.abs(one.data[one.present]))) or 1.0
        for name in one.noise.levels:
            relative = name in one.noise.relative
            levels[name] = np.log(TUNING.start_relative * (1.0 if relative else typical))
    return np.array([levels[name] for name in layout.levels])


def expectation_steps(marginal: Marginal, psi: Array, start: Start) -> tuple[Array, Start]:
    """Population parameters (P,) and random effects near the optimum.

    Steps are shortened until they lower -2 log L: whole ones may lead to where predictions vanish,
    and proportional noise with them.
    """
    value, individuals = marginal.at(psi[None], start, TUNING.steps_each)
    for _ in range(TUNING.expectations):
        step, change = _maximised(marginal, psi, individuals)
        here = individuals.eta[0], individuals.correction[0], individuals.damping[0]
        for share in _SHARES:
            begin = Start(here[0] + share * change, *here[1:])
            lower, tried = marginal.at((psi + share * step)[None], begin, TUNING.steps_each)
            if lower[0] < value[0]:
                psi, value, individuals = psi + share * step, lower, tried
                break
        else:
            break
    if not np.isfinite(value[0]):
        reason = (
            "the likelihood is not finite, wherever it was tried: an event ends the solution "
            "before the last of the data, an observable has no value, or the noise is zero there"
        )
        raise EvaluationError(
            "; ".join([*_failures(marginal.search.subjects), reason]),
            remedy="leave out such data, or give a start",
        )
    return psi, Start(individuals.eta[0], individuals.correction[0], individuals.damping[0])


def _maximised(marginal: Marginal, psi: Array, individuals: Individuals) -> tuple[Array, Array]:
    """The step (P,) to what the linearised model makes most likely, and that of the effects."""
    layout, eta = marginal.search.layout, individuals.eta[0]
    random = list(layout.random)
    at = psi[None]
    covariance = marginal.posterior_covariance(at, individuals)[0]
    moved = psi.copy()
    moved[layout.means] += _mean_step(marginal, at, individuals)
    shift = layout.typical(moved[None])[0][:, random] - layout.typical(at)[0][:, random]
    eta = eta - shift
    omega = np.einsum("nq,nr->qr", eta, eta) / len(eta) + covariance.mean(axis=0)
    moved[layout.factors] = layout.factored(omega + TUNING.least_spread**2 * np.eye(len(random)))
    moved[layout.noise] += _noise_step(marginal, individuals, covariance)
    return moved - psi, -shift


def _mean_step(marginal: Marginal, psi: Array, individuals: Individuals) -> Array:
    """The step of means and coefficients by generalised least squares."""
    layout = marginal.search.layout
    random = list(layout.random)
    whole, gradient = individuals.at.information[0], individuals.at.gradient[0]
    working = gradient - (whole[..., random] @ individuals.eta[0][..., None])[..., 0]
    covariance = marginal.posterior_covariance(psi, individuals)[0]
    pull = whole[..., random] @ (covariance @ working[:, random, None])
    right = np.einsum("nep,ne->p", layout.designs, working - pull[..., 0])
    information = marginal.information_of_means(psi, individuals)[0]
    return -np.asarray(np.linalg.lstsq(information, right, rcond=NEGLIGIBLE)[0])


def _noise_step(marginal: Marginal, individuals: Individuals, covariance: Array) -> Array:
    """Changes of the logarithms of levels: squares of residuals have the mean one."""
    subjects, layout = marginal.search.subjects, marginal.search.layout
    random = list(layout.random)
    if not layout.levels:
        return np.zeros(0)
    information = individuals.at.information[0][..., random, :][..., random]
    spent = float(np.einsum("nqr,nrq->", information, covariance))
    squares = float(individuals.at.squares[0].sum())
    factor = np.sqrt(squares / max(subjects.size - spent, MINOR * subjects.size))
    return np.full(len(layout.levels), np.log(factor))


def minimum(marginal: Marginal, psi: Array, start: Start) -> Optimum:
    """The optimum by quasi-Newton steps from psi (P,) and a start of the random effects."""
    value, individuals = marginal.at(psi[None], start)
    least = float(value[0])
    slopes = marginal.slopes(psi[None], individuals)
    hessian = hessian_of(marginal, psi, slopes, np.full(psi.size, TUNING.first_steps))
    fresh, converged = True, False
    for _ in range(TUNING.most_iterations):
        step, gain = _newton_step(hessian, slopes.gradient[0])
        if gain < TUNING.converged:
            converged = True
            break
        moves = _SHARES[:, None] * step
        values, tried = marginal.at(psi + moves, slopes.start(moves))
        k = int(np.argmin(values))
        if values[k] >= least:
            if fresh:
                converged = gain < 1e3 * TUNING.converged
                break
            hessian, fresh = hessian_of(marginal, psi, slopes, standard_steps(hessian)), True
            continue
        psi, least, individuals = psi + moves[k], float(values[k]), tried.at_position(k)
        before, slopes = slopes, marginal.slopes(psi[None], individuals)
        change = slopes.gradient[0] - before.gradient[0]
        hessian, fresh = _updated(hessian, moves[k], change), False
    if not fresh:
        hessian = hessian_of(marginal, psi, slopes, standard_steps(hessian))
    return Optimum(psi, least, individuals, slopes, hessian, converged)


def standard_steps(hessian: Array) -> Array:
    """Standard errors (P,) by a Hessian of -2 log L with the other parameters held."""
    return np.sqrt(2.0 / np.maximum(np.abs(np.diag(hessian)), 1e-2))


def hessian_of(marginal: Marginal, psi: Array, slopes: Slopes, scale: Array) -> Array:
    """Second derivatives (P, P) of -2 log L by differences of the first.

    They are one-sided where the likelihood ends on the other side.
    """
    h = TUNING.hessian_step * scale
    moves = np.concatenate([np.diag(h), -np.diag(h)])
    gradients = marginal.gradients(psi + moves, slopes.start(moves))
    lost = np.isnan(gradients[:, 0])
    gradients[lost] = slopes.gradient[0]
    apart = h * (2.0 - lost[: psi.size] - lost[psi.size :])
    with np.errstate(all="ignore"):
        hessian = (gradients[: psi.size] - gradients[psi.size :]) / apart[:, None]
    hessian = 0.5 * (hessian + hessian.T)
    return np.where(np.isfinite(hessian), hessian, 0.0)


def _newton_step(hessian: Array, gradient: Array) -> tuple[Array, float]:
    """A step downhill (P,) and the gain that it promises."""
    scale = standard_steps(hessian)
    eigenvalues, vectors = np.linalg.eigh(hessian * scale[:, None] * scale)
    curvatures = np.maximum(np.abs(eigenvalues), TUNING.curvature_floor)
    along = vectors.T @ (gradient * scale)
    step = -vectors @ (along / curvatures)
    gain = 0.5 * float(np.sum(along**2 / curvatures))
    step *= min(1.0, TUNING.longest_step / max(float(np.abs(step).max()), TINY))
    return step * scale, gain


def _updated(hessian: Array, step: Array, change: Array) -> Array:
    """The update of Broyden, Fletcher, Goldfarb and Shanno, where the curvature is positive."""
    curvature = float(step @ change)
    if curvature <= 1e-8 * np.linalg.norm(step) * np.linalg.norm(change):
        return hessian
    product = hessian @ step
    along = float(step @ product)
    if along <= 0.0:
        return hessian
    return np.asarray(
        hessian + np.outer(change, change) / curvature - np.outer(product, product) / along
    )
