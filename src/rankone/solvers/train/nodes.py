"""Parameter nodes to begin with: enough for the functions of the parameters that are known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rankone.discretization import BASES, Basis1D
from rankone.domain import Domain
from rankone.solvers.train.options import TrainOptions
from rankone.system import System

__all__ = ["FEW_PARAMETERS", "first_bases"]

FEW_PARAMETERS = 2
"""Up to so many parameters functions that are known are resolved, and kept, to rounding level."""
_ROUNDING = 1e-14
_UNRESOLVED = 1e-12
"""Relative size of the last modes above which a function is not resolved at all."""


def first_bases(
    system: System, domain: Domain, rtol: float, options: TrainOptions
) -> tuple[tuple[Basis1D, ...], tuple[int, ...]]:
    """Bases to start the march with, and the degrees below which they must not be coarsened.

    The factors of the terms and of the initial values are known functions of one parameter.
    With few parameters nodes are cheap and these functions are resolved to rounding level, so
    that a solution in their span is exact; otherwise to a part of the tolerance.

    Parameters
    ----------
    system : System
    domain : Domain
    rtol : float
    options : TrainOptions
    """
    kind = BASES[options.basis]
    most = min(options.max_degree, options.max_nodes)
    common = min(max(round(2.0 + 1.2 * -math.log10(rtol)), 4), most)
    tolerance = _ROUNDING if len(domain.box) <= FEW_PARAMETERS else 0.01 * rtol
    bases, floors = [], []
    for j, (lower, upper) in enumerate(domain.box):
        basis = kind(lower, upper, common)
        needed = _resolving_degree(system, j, basis, tolerance, most)
        floors.append(needed)
        bases.append(replace(basis, degree=max(common, needed)))
    return tuple(bases), tuple(floors)


def _resolving_degree(
    system: System, dimension: int, basis: Basis1D, tolerance: float, most: int
) -> int:
    """Smallest degree that resolves the factors of one parameter; 3 if ``most`` does not."""
    fine = replace(basis, degree=most)
    rows = system.parameter_factors(dimension, fine.nodes) * np.sqrt(fine.weights)
    spectra = np.abs(rows @ fine.to_modal.T)
    relative = (spectra / spectra.max(axis=1, keepdims=True, initial=1e-300)).max(axis=0)
    noise = float(relative[-3:].max())
    if noise > _UNRESOLVED:
        return 3
    significant = np.flatnonzero(relative > max(tolerance, 8.0 * noise))
    return max(int(significant[-1]) + 2 if significant.size else 1, 3)
