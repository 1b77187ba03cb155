"""The posterior density of parameters, up to a factor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.estimation.free import Free
from rankone.estimation.least_squares import LeastSquares
from rankone.statistics.distributions import Measure
from rankone.statistics.joint_distribution import measures_of
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import quote

__all__ = ["Posterity", "priors"]


_INSIDE = 1e-9
"""Distance from the ends of an interval, in widths: a density may be infinite there."""


@dataclass(frozen=True)
class Posterity:
    """Logarithm of the posterior density in the unit cube.

    Gaussian noise; where its sigma is not known, it is integrated over with the density 1/sigma
    (Gelman et al., Bayesian Data Analysis, ch. 14.2).

    Attributes
    ----------
    problem : LeastSquares
    measures : tuple of Measure
        The prior of each free parameter.
    """

    problem: LeastSquares
    measures: tuple[Measure, ...]

    @property
    def dimension(self) -> int:
        """Number of free parameters."""
        return len(self.measures)

    @property
    def unit(self) -> tuple[Array, Array]:
        """Lower bounds and widths of the parameters."""
        return self.problem.free.lower, self.problem.free.width

    def __call__(self, z: Array) -> Array:
        """Values at z (N, n): shape (N,); minus infinity where the prior is zero."""
        residuals = self.problem.residuals(z)
        squares = np.einsum("km,km->k", residuals, residuals)
        found = -0.5 * squares
        if not self.problem.observations.known:
            size = residuals.shape[1]
            found = -0.5 * size * np.log(np.maximum(squares, 1e-300))
        values = self.problem.free.values(z)
        for column, measure in zip(values.T, self.measures, strict=True):
            if measure.distribution is not None:
                near = _INSIDE * (measure.upper - measure.lower)
                at = np.clip(column, measure.lower + near, measure.upper - near)
                with np.errstate(divide="ignore"):
                    found = found + measure.distribution.logpdf(at)
        return np.where(np.isnan(found), -math.inf, found)


def priors(
    free: Free, prior: Mapping[Any, Any] | None, usual: Mapping[str, Any]
) -> tuple[Measure, ...]:
    """The prior of each free parameter, cut at its bounds: as given, the usual one, or uniform.

    Raises
    ------
    OptionError
        If there is no such parameter, it is fixed, or the distribution does not fit.
    """
    for key in prior or {}:
        if name_of(key) in free.fixed:
            raise OptionError(f"{quote(name_of(key))} is fixed, and has a prior", term=key)
    box = [(float(a), float(b)) for a, b in zip(free.lower, free.upper, strict=True)]
    return tuple(measures_of(free.names, box, prior, usual))
