"""The objective of a calibration problem: minus the logarithm of the likelihood, and of priors.

Beside it there are pseudo-residuals rho and their Jacobian J such that J^T rho is the gradient of
the likelihood's part and J^T J the Fisher information, also where parameters move the noise (Seber
& Wild, Nonlinear Regression, 1989, ch. 2.8 and 14). Laplace's density has both as well, though its
gradient jumps where a residual vanishes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rankone.estimation.duals import FUNCTIONS, Dual
from rankone.support.arrays import Array

_ROOT_OF_TWO = math.sqrt(2.0)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The objective at a point, with derivatives by the coordinates of k estimated parameters.

    Attributes
    ----------
    parameters : tuple of str
        The k parameters, in the order of the table.
    objective : float
        Minus the logarithm of the likelihood and of the priors that the table has.
    gradient : ndarray (k,)
        By the coordinates on the scales of the parameters.
    residuals : ndarray (r,)
        Pseudo-residuals: two for each measurement, of its value and of its noise.
    jacobian : ndarray (r, k)
        Their derivatives: ``jacobian.T @ residuals`` is the gradient without priors, and
        ``jacobian.T @ jacobian`` the Fisher information.
    standardised : ndarray (m,)
        For each row of the measurement table prediction minus measurement over its noise.
    predicted, noise : ndarray (m,)
        For each row the prediction, and the standard deviation or the scale of its noise.
    """

    parameters: tuple[str, ...]
    objective: float
    gradient: Array
    residuals: Array
    jacobian: Array
    standardised: Array
    predicted: Array
    noise: Array


class Terms(NamedTuple):
    """What m measurements add: minus log L (m,), pseudo-residuals (2 m,), their Jacobian (2 m, w).

    ``standardised`` (m,) are deviations over the noise.
    """

    costs: Array
    residuals: Array
    jacobian: Array
    standardised: Array


def terms(
    distribution: str, transformation: str, measured: Array, predicted: Dual, noise: Dual
) -> Terms:
    """What measurements (m,) of an observable add to the objective."""
    constant = np.zeros(measured.size)
    if transformation != "lin":
        name = transformation
        constant = np.log(measured) + (math.log(math.log(10.0)) if name == "log10" else 0.0)
        measured = np.log(measured) if name == "log" else np.log10(measured)
        predicted = FUNCTIONS[name](predicted)  # type: ignore[assignment]
    s = noise.value
    r = (predicted.value - measured) / s
    by_value, by_noise = predicted.slope / s[:, None], noise.slope / s[:, None]
    if distribution == "normal":
        costs = 0.5 * r**2 + np.log(s) + 0.5 * math.log(2.0 * math.pi)
        pseudo = r, (1.0 - r**2) / _ROOT_OF_TWO
        by_noise = _ROOT_OF_TWO * by_noise
    else:
        costs = np.abs(r) + np.log(2.0 * s)
        pseudo = np.sign(r), 1.0 - np.abs(r)
    return Terms(costs + constant, np.concatenate(pseudo), np.concatenate([by_value, by_noise]), r)
