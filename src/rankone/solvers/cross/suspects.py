"""Where an interpolation is most likely to be wrong: what random points of the box would miss."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rankone.arrays import Array
from rankone.discretization import Basis1D
from rankone.tensors.slab import SlabTrain

__all__ = ["steepest_point", "suspects"]

_ELEMENTS = 16
"""Elements of a parameter in which the error is measured."""
_SLABS, _CANDIDATES, _CHOSEN = 4, 512, 12
"""Slabs looked at, candidates on each, and how many are taken of them."""
_SHIFT = 2e-3
"""Change of every parameter, in widths of its interval, over which the solution is compared."""


def suspects(
    slabs: Sequence[SlabTrain], bases: Sequence[Basis1D], sizes: Array, number: int
) -> Array | None:
    """Parameter points (m, d) inside narrow elements and where the solution is steep.

    Parameters
    ----------
    slabs : sequence of SlabTrain
    bases : sequence of Basis1D
    sizes : ndarray (n,)
        Sizes of the states.
    number : int
        That of the attempt: each has points of its own.
    """
    generator = np.random.default_rng((20140, number))
    lower, upper = _bounds(bases)
    points = []
    for j, basis in enumerate(bases):
        if basis.elements > 1:
            narrow = np.argsort(np.diff(basis.edges), kind="stable")[:_ELEMENTS]
            inside = lower + (upper - lower) * generator.random((narrow.size, len(bases)))
            share = generator.random(narrow.size)
            inside[:, j] = (1.0 - share) * basis.edges[narrow] + share * basis.edges[narrow + 1]
            points.append(inside)
    for i in {round(i) for i in np.linspace(0, len(slabs) - 1, _SLABS)}:
        candidates = lower + (upper - lower) * generator.random((_CANDIDATES, len(bases)))
        steep = _steepness(slabs[i], candidates, lower, upper, sizes)
        if np.count_nonzero(steep) >= _CHOSEN and np.isfinite(steep).all():
            chosen = generator.choice(len(steep), _CHOSEN, replace=False, p=steep / steep.sum())
            points.append(candidates[chosen])
    return np.concatenate(points) if points else None


def steepest_point(slab: SlabTrain, bases: Sequence[Basis1D], sizes: Array) -> Array:
    """A point (d,) of the box at which the end of a slab depends steeply on some parameter."""
    lower, upper = _bounds(bases)
    points = lower + (upper - lower) * np.random.default_rng(20140).random(
        (_CANDIDATES, len(bases))
    )
    return np.asarray(points[np.argmax(_steepness(slab, points, lower, upper, sizes))])


def _bounds(bases: Sequence[Basis1D]) -> tuple[Array, Array]:
    return np.array([b.lower for b in bases]), np.array([b.upper for b in bases])


def _steepness(slab: SlabTrain, points: Array, lower: Array, upper: Array, sizes: Array) -> Array:
    """Largest change of a state at the end of a slab over a small step across the box, (m,)."""
    generator = np.random.default_rng(20140)
    step = _SHIFT * (upper - lower) * generator.choice([-1.0, 1.0], points.shape)
    times = np.full(len(points), slab.end)
    one, two = (slab(times, np.clip(points + s, lower, upper).T) for s in (step, -step))
    return np.asarray((np.abs(one - two) / sizes[:, None]).max(axis=0))
