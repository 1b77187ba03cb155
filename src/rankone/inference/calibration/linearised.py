"""How far the data determine each parameter at an optimum, by linearisation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rankone.inference.calibration.descent import Expansion
from rankone.inference.estimation.identification import BOX_SHARE, UNIFORM_PRECISION
from rankone.inference.estimation.intervals import quantile_of
from rankone.support.arrays import Array
from rankone.tensors.bases.joint_distribution import LEVEL


class Reach(NamedTuple):
    """The interval of a parameter in z, and what ends it.

    ``limited`` are the ends that are its bounds, ``""``, ``"lower"``, ``"upper"`` or ``"both"``;
    a ``free`` one is not identified. Beyond the bounds of ``others`` it would be longer.
    """

    lower: float
    upper: float
    limited: str = ""
    free: bool = False
    others: tuple[str, ...] = ()


def limited_by(lower: bool, upper: bool) -> str:
    """Which ends of an interval are bounds, in a word."""
    return "both" if lower and upper else "lower" * lower + "upper" * upper


def linear_reaches(names: Sequence[str], at: Expansion, variance: float) -> dict[str, Reach]:
    """That of each parameter with 95 %, by linearisation, within the bounds."""
    deviations = deviations_at(at, variance)
    free = unidentified(names, deviations)
    reaches = {}
    for name, z, half in zip(names, at.z, quantile_of(LEVEL, True, 0.0) * deviations, strict=True):
        ends = float(z - half), float(z + half)
        limited = limited_by(ends[0] <= 0.0, ends[1] >= 1.0)
        free_one = name in free or limited == "both"
        reaches[name] = Reach(max(ends[0], 0.0), min(ends[1], 1.0), limited, free_one)
    return reaches


def covariance_at(at: Expansion, variance: float = 1.0) -> Array:
    """The covariance (n, n) in z at a point; see :func:`covariance_of`."""
    return covariance_of(at.jacobian, variance)


def covariance_of(jacobian: Array, variance: float = 1.0) -> Array:
    """The covariance (n, n) in z by the Jacobian (m, n), of a prior uniform between the bounds.

    ``variance`` is that of the residuals.
    """
    information = jacobian.T @ jacobian / variance
    information[np.diag_indices_from(information)] += UNIFORM_PRECISION
    return np.asarray(np.linalg.inv(information))


def deviations_at(at: Expansion, variance: float = 1.0) -> Array:
    """Standard deviations (n,) in z; see :func:`covariance_at`."""
    return np.asarray(np.sqrt(np.diag(covariance_at(at, variance))))


def spread_of(rows: Array, covariance: Array) -> Array:
    """Standard deviations (m,) of quantities with derivatives (m, n)."""
    return np.asarray(np.sqrt(np.einsum("mi,ij,mj->m", rows, covariance, rows)))


def unidentified(names: Sequence[str], deviations: Array) -> tuple[str, ...]:
    """Parameters whose variance between the bounds the data hardly reduce."""
    lost = deviations**2 > BOX_SHARE / UNIFORM_PRECISION
    return tuple(name for name, is_lost in zip(names, lost, strict=True) if is_lost)
