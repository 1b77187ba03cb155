"""The population parameters of largest likelihood.

The search begins with the best of many points of the box for each subject. A few steps of
expectation and maximisation then bring means, covariance and noise near the optimum (Lindstrom &
Bates, Biometrics 46, 1990, for the means), and quasi-Newton steps on the marginal likelihood and
its derivatives end the search.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rankone.inference.estimation.experiments import failure_of
from rankone.inference.populations.individuals import EmpiricalBayes, Individuals, Start, linearised
from rankone.inference.populations.marginal import Marginal, Slopes
from rankone.inference.populations.population_layout import Layout
from rankone.inference.populations.subjects import Subjects
from rankone.support.arrays import Array, spread
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.wording import quote

_SCREENED_POINTS = 512  # Points of the box that are tried for each subject
_FARTHEST_DATUM = 1e8  # Squared distance of data in estimated deviations that no curve explains
_EXPECTATIONS = 12  # Steps of expectation and maximisation
_STEPS_EACH = 4  # Steps of the random effects in each of them
_START_SPREAD = 0.15  # Standard deviation of random effects at the start, in widths of the box
_START_RELATIVE = 0.2  # Levels of noise at the start, in shares of the data
_LEAST_SPREAD = 1e-3  # Least standard deviation of a random effect in the first steps
_MOST_ITERATIONS = 40
_CONVERGED = 1e-8  # Expected gain in -2 log L that ends the search
_HESSIAN_STEP = 0.05  # Displacements in standard errors
_FIRST_STEPS = 0.1  # Standard errors of all population parameters that are assumed at first
_SHARES = np.array([1.0, 0.5, 0.25, 0.1, 0.03, 0.01, 1e-3])  # Shares of a step that are tried
_LONGEST_STEP = 3.0  # Longest step in standard errors of any parameter
_CURVATURE_FLOOR = 1e-4


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
    shares = spread(_SCREENED_POINTS, len(layout.names), np.random.default_rng(7))
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
    psi[layout.factors] = layout.factored(np.diag((_START_SPREAD * width) ** 2))
    random = list(layout.random)
    return psi, Start.at(own[:, random] - layout.typical(psi[None])[0][:, random])


def _check_deviations(
    subjects: Subjects, layout: Layout, cost: Array, squares: Array, started: bool
) -> None:
    """Raise an OptionError for subjects with a datum of no deviation at the best of places (K, n).

    Proportional noise has none where the prediction is zero. A start may limit the places.
    """
    least = np.take_along_axis(squares, np.argmin(cost, axis=0)[None], axis=0)[0]
    far = least > _FARTHEST_DATUM if layout.levels else np.zeros(least.size, dtype=bool)
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
            levels[name] = np.log(_START_RELATIVE * (1.0 if relative else typical))
    return np.array([levels[name] for name in layout.levels])


def expectation_steps(marginal: Marginal, psi: Array, start: Start) -> tuple[Array, Start]:
    """Population parameters (P,) and random effects near the optimum.

    Steps are shortened until they lower -2 log L: whole ones may lead to where predictions vanish,
    and proportional noise with them.
    """
    value, individuals = marginal.at(psi[None], start, _STEPS_EACH)
    for _ in range(_EXPECTATIONS):
        step, change = _maximised(marginal, psi, individuals)
        here = individuals.eta[0], individuals.correction[0], individuals.damping[0]
        for share in _SHARES:
            begin = Start(here[0] + share * change, *here[1:])
            lower, tried = marginal.at((psi + share * step)[None], begin, _STEPS_EACH)
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
    moved[layout.factors] = layout.factored(omega + _LEAST_SPREAD**2 * np.eye(len(random)))
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
    return -np.asarray(np.linalg.lstsq(information, right, rcond=1e-10)[0])


def _noise_step(marginal: Marginal, individuals: Individuals, covariance: Array) -> Array:
    """Changes of the logarithms of levels: squares of residuals have the mean one."""
    subjects, layout = marginal.search.subjects, marginal.search.layout
    random = list(layout.random)
    if not layout.levels:
        return np.zeros(0)
    information = individuals.at.information[0][..., random, :][..., random]
    spent = float(np.einsum("nqr,nrq->", information, covariance))
    squares = float(individuals.at.squares[0].sum())
    factor = np.sqrt(squares / max(subjects.size - spent, 0.1 * subjects.size))
    return np.full(len(layout.levels), np.log(factor))


def minimum(marginal: Marginal, psi: Array, start: Start) -> Optimum:
    """The optimum by quasi-Newton steps from psi (P,) and a start of the random effects."""
    value, individuals = marginal.at(psi[None], start)
    least = float(value[0])
    slopes = marginal.slopes(psi[None], individuals)
    hessian = hessian_of(marginal, psi, slopes, np.full(psi.size, _FIRST_STEPS))
    fresh, converged = True, False
    for _ in range(_MOST_ITERATIONS):
        step, gain = _newton_step(hessian, slopes.gradient[0])
        if gain < _CONVERGED:
            converged = True
            break
        moves = _SHARES[:, None] * step
        values, tried = marginal.at(psi + moves, slopes.start(moves))
        k = int(np.argmin(values))
        if values[k] >= least:
            if fresh:
                converged = gain < 1e3 * _CONVERGED
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
    h = _HESSIAN_STEP * scale
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
    curvatures = np.maximum(np.abs(eigenvalues), _CURVATURE_FLOOR)
    along = vectors.T @ (gradient * scale)
    step = -vectors @ (along / curvatures)
    gain = 0.5 * float(np.sum(along**2 / curvatures))
    step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))
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
