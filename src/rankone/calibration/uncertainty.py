"""How far the data determine each parameter at an optimum, by linearisation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rankone.calibration.descent import Expansion
from rankone.support.arrays import Array

_UNIFORM_VARIANCE = 1.0 / 12.0  # Of a parameter that may be anywhere between its bounds
_NOT_REDUCED = 0.5  # Share of that standard deviation above which the data say too little


def covariance_at(at: Expansion, variance: float = 1.0) -> Array:
    """The covariance (n, n) in z, of a prior that is uniform between the bounds.

    ``variance`` is that of the residuals.
    """
    information = at.jacobian.T @ at.jacobian / variance
    information[np.diag_indices_from(information)] += 1.0 / _UNIFORM_VARIANCE
    return np.asarray(np.linalg.inv(information))


def deviations_at(at: Expansion, variance: float = 1.0) -> Array:
    """Standard deviations (n,) in z; see :func:`covariance_at`."""
    return np.asarray(np.sqrt(np.diag(covariance_at(at, variance))))


def spread_of(rows: Array, covariance: Array) -> Array:
    """Standard deviations (m,) of quantities with derivatives (m, n)."""
    return np.asarray(np.sqrt(np.einsum("mi,ij,mj->m", rows, covariance, rows)))


def unidentified(names: Sequence[str], deviations: Array) -> tuple[str, ...]:
    """Parameters whose standard deviation the data reduce by less than half."""
    most = _NOT_REDUCED * np.sqrt(_UNIFORM_VARIANCE)
    return tuple(name for name, each in zip(names, deviations, strict=True) if each > most)
