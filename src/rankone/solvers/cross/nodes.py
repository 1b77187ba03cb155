"""Numbers of parameter nodes, read off trajectories on lines through the box."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rankone.arrays import Array
from rankone.discretization import BASES, Basis1D
from rankone.domain import Domain
from rankone.solvers.cross.options import CrossOptions
from rankone.solvers.cross.trajectories import Trajectories

__all__ = ["first_bases", "more_nodes"]

_OFF_CENTRE = 0.35
"""Distance of the second line of a parameter from the centre, in widths of the other intervals."""
_TAIL = 0.03
"""What the modes left out may make up, relative to the error asked for."""
_SLOWEST = 0.95
"""Largest ratio of successive modes that is believed."""
_FARTHEST = 3.0
"""Largest number of nodes predicted, over that of the lines."""


def first_bases(
    trajectories: Trajectories, domain: Domain, rtol: float, options: CrossOptions
) -> tuple[Basis1D, ...]:
    """Bases that resolve the trajectories on two lines for each parameter.

    One line goes through the centre of the box, one past it. The modes of a smooth function fall
    geometrically, which tells how many are needed beyond those of the line.
    """
    kind = BASES[options.basis]
    count = min(max(round(4.0 + 1.4 * -math.log10(rtol)), 6), options.max_nodes)
    bases = [kind(lower, upper, count) for lower, upper in domain.box]
    coefficients = trajectories(_lines(domain, bases))
    lines = coefficients.reshape(-1, len(bases), 2, count)
    found = []
    for j, basis in enumerate(bases):
        values = lines[:, j] * np.sqrt(basis.weights)
        spectrum = np.linalg.norm(values @ basis.to_modal.T, axis=0).max(axis=0)
        wanted = needed(spectrum, _TAIL * rtol)
        found.append(replace(basis, degree=min(max(wanted, 3), options.max_nodes)))
    return tuple(found)


def _lines(domain: Domain, bases: list[Basis1D]) -> Array:
    """Points (2 d count, d) on the lines, in the order (parameter, line, node)."""
    bounds = domain.bounds
    centre, width = bounds.mean(axis=1), bounds[:, 1] - bounds[:, 0]
    sides = np.random.default_rng(20140).choice([-1.0, 1.0], len(bounds))
    points = []
    for j, basis in enumerate(bases):
        for shift in (0.0, _OFF_CENTRE):
            line = np.tile(centre + shift * sides * width, (basis.size, 1))
            line[:, j] = basis.nodes
            points.append(line)
    return np.concatenate(points)


def needed(spectrum: Array, tolerance: float) -> int:
    """Number of modes after which the rest of a spectrum is below a tolerance."""
    tails = np.sqrt(np.cumsum(spectrum[::-1] ** 2)[::-1])
    count = spectrum.size
    if tails[-2:].max() <= tolerance:
        return int(np.count_nonzero(tails > tolerance)) + 1
    half = count // 2
    levels = np.maximum.accumulate(spectrum[::-1])[::-1]  # modes may vanish by symmetry
    ratio = (levels[-2] / max(levels[half - 1], 1e-300)) ** (1.0 / (count - 1 - half))
    ratio = min(max(ratio, 1e-3), _SLOWEST)
    more = math.log(tolerance / levels[-2]) / math.log(ratio)
    return min(count + math.ceil(more), math.ceil(_FARTHEST * count))


def more_nodes(
    bases: tuple[Basis1D, ...], spectra: list[Array], tolerance: float, most: int
) -> tuple[Basis1D, ...]:
    """Bases with more nodes where the highest modes of a core are above the tolerance."""
    result = []
    for basis, spectrum in zip(bases, spectra, strict=True):
        wanted = basis.size
        if basis.tail(spectrum) > tolerance:
            wanted = min(max(needed(spectrum, tolerance), wanted + 2), most)
        result.append(replace(basis, degree=wanted))
    return tuple(result)
