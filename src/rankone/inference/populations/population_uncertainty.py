"""How sure population parameters are: standard errors, degrees of freedom, intervals.

Variances of maximum likelihood are too small in small populations, since means were fitted to the
same subjects. So they are corrected by one step towards the restricted likelihood, which adds
log |I| of the information I about the means (Lindstrom & Bates, 1990). Intervals of means are
Student's, those of standard deviations chi-squared ones, with degrees of freedom after
Satterthwaite (Biometrics Bulletin 2, 1946): twice the square of a variance over its own variance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from rankone.inference.estimation.identification import BOX_SHARE, UNIFORM_PRECISION
from rankone.inference.populations.marginal import Marginal
from rankone.inference.populations.population_search import Optimum, standard_steps
from rankone.support.arrays import Array

_STEP = 0.1  # Displacements in standard errors for differences
_LARGEST_CORRECTION = 0.5  # Largest change of the logarithm of a standard deviation
_LEAST_FREEDOM = 1.0
# Ratio of eigenvalues of the scaled information below which a direction is not identified
_FLAT = 1e-6
_NO_BOX = 1e-12  # Precision of a direction that no box ends: above rounding


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
        freedom = max(0.5 / variance * math.exp(-2.0 * shift), _LEAST_FREEDOM)
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
        freedom = np.maximum(2.0 / variances / np.maximum(inflation, 1e-3), _LEAST_FREEDOM)
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
    steep = eigenvalues > _FLAT * max(float(eigenvalues.max()), 1e-300)
    root = vectors[:, steep] * scale[:, None] / np.sqrt(eigenvalues[steep])
    shares, turns = np.linalg.eigh(root.T @ (box[:, None] * root))
    lost, root = shares > BOX_SHARE, root @ turns
    seen = root[:, ~lost] / np.sqrt(1.0 - shares[~lost])
    endless = vectors[:, ~steep] * scale[:, None] / np.sqrt(_NO_BOX)
    return seen, np.concatenate([root[:, lost], endless], axis=1)


def _of_means(information: Array, box: Array, scale: Array) -> tuple[Array, Array]:
    """Log determinants (K,) of the information (K, B, B) about means, and their variances (K, B).

    Both are marginal: the precision of the ``box`` (P,) is added. ``scale`` (P,) is that of all
    population parameters.
    """
    unit = scale[: information.shape[-1]]
    whole = (information + np.diag(box[: unit.size])) * unit[:, None] * unit
    whole = whole + _NO_BOX * np.eye(unit.size)
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
