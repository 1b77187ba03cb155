"""Where quantities are compared with their interpolation: points of the box, and values there."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.ir.domain import Domain
from rankone.outputs.quantities import Quantities
from rankone.outputs.sampling import Sampler
from rankone.solvers.cross.time_grid import TimeGrid
from rankone.support.arrays import Array, corners, spread
from rankone.tensors.slab import SlabTrain
from rankone.verification.search import Climb, bisected, climbed

__all__ = ["Check", "CheckPoints", "critical_points", "split", "spread_over"]

_ROUNDING = 1e-13
"""Quantities so small, over what they are made of, are zero."""
_POINTS, _CORNERS = 96, 32
"""Points of the interior where an error is measured, and most corners of the box."""
_SCOUTS = 512
"""Points where a search begins."""
_CLIMBERS = 16
"""Best of them that go on."""
_TO_CHANGES = Climb(rounds=24, tries=5, first_step=0.25, shrinkage=0.8)
"""The way to where extremes, durations or crossings are nearest to a change."""
_TO_ERRORS = Climb(rounds=10, tries=5, first_step=0.25, shrinkage=0.8)
"""The way to larger errors."""
_FIRST_PART = 0.55
"""Of a slab of the grid on which the error is measured, so that its nodes are others."""
_MOST_BREAKS, _NEAR, _BISECTIONS = 32, 1e-6, 60
"""Most places of a parameter that are looked at, how near, in widths of its interval, and steps to
find places of several."""


@dataclass(frozen=True)
class Check:
    """Exact quantities at points of the box.

    Attributes
    ----------
    points : ndarray (m, d)
    values : ndarray (quantities, rows, m)
    sizes : ndarray (quantities,)
        Their largest values; those of what they are made of where they vanish but for rounding.
    """

    points: Array
    values: Array
    sizes: Array

    @classmethod
    def at(cls, sampler: Sampler, points: Array) -> Check:
        """A check at points (m, d)."""
        values = sampler(points)
        sizes: Array = np.abs(values).max(axis=(1, 2))
        nothing = sizes <= _ROUNDING * sampler.largest
        return cls(points, values, np.where(nothing, sampler.largest or 1.0, sizes))

    def missed(self, slabs: Sequence[SlabTrain], sampler: Sampler) -> Array:
        """Error of trains over the sizes, (quantities, m)."""
        carry = slabs[0].over_parameters(self.points.T)
        if sampler.quantities.timeless:
            found = slabs[0].on_grid(np.array([slabs[0].start]), carry)
        else:
            times = sampler.grid.times
            owner = np.searchsorted([slab.start for slab in slabs[1:]], times, side="right")
            parts = [slab.on_grid(times[owner == k], carry) for k, slab in enumerate(slabs)]
            found = np.concatenate(parts, axis=2)
        missed = np.abs(found.swapaxes(1, 2) - self.values).max(axis=1)
        return np.asarray(missed / self.sizes[:, None])

    def with_points(self, sampler: Sampler, points: Array) -> Check:
        """The same with further points."""
        values = np.concatenate([self.values, sampler(points)], axis=2)
        sizes = np.maximum(self.sizes, np.abs(values).max(axis=(1, 2)))
        return Check(np.concatenate([self.points, points]), values, sizes)

    def climbed(self, slabs: Sequence[SlabTrain], sampler: Sampler, domain: Domain) -> Check:
        """Points of larger and larger errors of trains, from the worst ones here on."""
        missed = self.missed(slabs, sampler).max(axis=0)
        best = np.argsort(-missed)[:_CLIMBERS]
        points, errors = self.points[best], missed[best]

        def error(at: Array) -> Array:
            missed = Check(at, sampler(at), self.sizes).missed(slabs, sampler)
            return np.asarray(missed.max(axis=0))

        points, _ = climbed(error, points, errors, domain.bounds, _TO_ERRORS)
        return Check(points, sampler(points), self.sizes)

    def amplified(self, sampler: Sampler, rtol: float) -> Array:
        """What errors of the sources change the quantities by, over their sizes.

        Each source is shifted by ``rtol`` times its largest value, up and down.

        Returns
        -------
        ndarray (sources, quantities, m)
        """
        largest = np.abs(sampler.sources(self.points)).max(axis=(1, 2), initial=0.0)
        total = np.zeros((largest.size, *self.values.shape[::2]))
        for change, shift in zip(total, np.diag(rtol * largest), strict=True):
            both = [sampler(self.points, signed) for signed in (shift, -shift)]
            change += np.max([np.abs(found - self.values).max(axis=1) for found in both], axis=0)
        relative: Array = total / self.sizes[:, None]
        return relative


def critical_points(sampler: Sampler, domain: Domain) -> Array:
    """Points of the box where extremes, durations or crossings are nearest to a change: (m, d).

    A maximum that changes from one peak to another in a small part of the box, and a crossing that
    is there in a small part alone, are hardly met by points spread over the box.
    """
    if not domain.box:
        return np.zeros((0, 0))
    points = spread_over(domain, _SCOUTS)
    margins = sampler.margins(points)
    best = np.argsort(margins)[:_CLIMBERS]
    heights = -margins[best]
    critical, heights = climbed(
        lambda at: -sampler.margins(at), points[best], heights, domain.bounds, _TO_CHANGES
    )
    return critical[np.isfinite(heights)]


@dataclass(frozen=True)
class CheckPoints:
    """Points of the box for two checks: one that is aimed at, and one of further points.

    Attributes
    ----------
    corners : int
        Number of the first points of either, which are corners.
    aimed, further : ndarray (m, d)
        Corners, different points of the interior, and points beside places where the quantities
        are narrow or not smooth as functions of parameters.
    """

    corners: int
    aimed: Array
    further: Array

    @classmethod
    def of(cls, domain: Domain, quantities: Quantities) -> CheckPoints:
        """The points for some quantities."""
        at_corners = _corners(domain)
        special = [_beside(domain, quantities.breaks[1:]), _on_ridges(domain, quantities)]
        halves = np.split(spread_over(domain, 2 * _POINTS if domain.box else 2), 2)
        aimed, further = (np.concatenate([at_corners, half, *special]) for half in halves)
        return cls(len(at_corners), aimed, further)


def spread_over(domain: Domain, count: int) -> Array:
    """Points of the box, evenly spread, the centre first: (count, d)."""
    lower, upper = domain.bounds.T
    shares = spread(count, lower.size, np.random.default_rng(20145))
    shares = np.concatenate([np.full((1, lower.size), 0.5), shares[1:]])
    return np.asarray(lower + (upper - lower) * shares)


def split(grid: TimeGrid) -> TimeGrid:
    """A grid with two slabs, of unequal length, for each."""
    pairs = itertools.pairwise(grid.breaks)
    breaks = [x for a, b in pairs for x in (a, a + _FIRST_PART * (b - a))]
    return TimeGrid((*breaks, grid.breaks[-1]), grid.count)


def _beside(domain: Domain, breaks: Sequence[Sequence[float]]) -> Array:
    """Points of the box beside places where functions of a parameter are not smooth: (m, d)."""
    found = [np.zeros((0, len(domain.box)))]
    for j, places in enumerate(breaks):
        lower, upper = domain.box[j]
        some = list(places)[:_MOST_BREAKS]
        points = spread_over(domain, 2 * len(some) + 1)[1:]
        width = _NEAR * (upper - lower)
        points[:, j] = np.clip([x + s * width for x in some for s in (-1.0, 1.0)], lower, upper)
        found.append(points)
    return np.concatenate(found)


def _on_ridges(domain: Domain, quantities: Quantities) -> Array:
    """Points of the box where functions of several parameters are narrow or not smooth: (m, d)."""
    points = spread_over(domain, 2 * _POINTS)
    left, right = points[:_POINTS], points[_POINTS:]
    found = [points[:0]]
    with np.errstate(all="ignore"):
        for k in range(len(quantities.ridges(points.T))):

            def sign(at: Array, k: int = k) -> Array:
                return np.sign(np.broadcast_to(quantities.ridges(at.T)[k], len(at)))

            here = np.flatnonzero(sign(left) * sign(right) < 0.0)[:_MOST_BREAKS]
            on_left = sign(left[here])

            def like_left(at: Array, on_left: Array = on_left) -> NDArray[np.bool_]:
                return np.asarray(sign(at) == on_left)

            found.append(bisected(left[here], right[here], like_left, _BISECTIONS)[0])
    return np.concatenate(found)


def _corners(domain: Domain) -> Array:
    """Corners of the box, all or some: (m, d)."""
    if not domain.box:
        return np.zeros((0, 0))
    lower, upper = domain.bounds.T
    unit = corners(lower.size, _CORNERS, np.random.default_rng(20146))
    return np.asarray(np.where(unit == 1.0, upper, lower))
