"""Where quantities are compared with their interpolation: points of the box, and values there."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.compiler.codegen.layout import Quantities
from rankone.solution.outputs.sampling import Sampler
from rankone.solvers.request import USUAL_POINTS, Domain
from rankone.solvers.verification.points import Climb, Coverage, climbed
from rankone.support.arrays import ACCUMULATED, SAME, SEED, Array, bisected, corners, spread
from rankone.tensors.slab import SlabTrain, slab_positions
from rankone.tensors.time_grid import TimeGrid

_MAX_CORNERS = 32  # Corners where an error is measured: all of five parameters
_SCOUTS = 512  # Points where a search begins
_CLIMBERS = 16  # Best of them that go on
# The way to where extremes, durations or crossings are nearest to a change
_TO_CHANGES = Climb(rounds=24, tries=5, first_step=0.25, shrinkage=0.8)
_TO_ERRORS = Climb(rounds=10, tries=5, first_step=0.25, shrinkage=0.8)  # The way to larger errors
# Where slabs are split for the check, so that its nodes differ from the nodes of the grid
_SPLIT_RATIO = 0.55
_MAX_BREAKS = 32  # Most breaks of a parameter, and most points on a surface, that are looked at


@dataclass(frozen=True)
class Check:
    """Exact quantities (quantities, rows, m) at points (m, d) of the box.

    Their sizes (quantities,) are their largest values, or the largest operand where they vanish
    except for rounding.
    """

    points: Array
    values: Array
    sizes: Array

    @classmethod
    def at(cls, sampler: Sampler, points: Array) -> Check:
        values = sampler(points)
        sizes: Array = np.abs(values).max(axis=(1, 2))
        nothing = sizes <= ACCUMULATED * sampler.largest
        return cls(points, values, np.where(nothing, sampler.largest or 1.0, sizes))

    def missed(self, slabs: Sequence[SlabTrain], sampler: Sampler) -> Array:
        """Error of trains over the sizes, (quantities, m)."""
        columns = slabs[0].over_parameters(self.points.T)
        if sampler.quantities.timeless:
            interpolated = slabs[0].on_grid(np.array([slabs[0].start]), columns)
        else:
            times = sampler.grid.times
            owner = slab_positions(slabs, times)
            interpolated = np.concatenate(
                [slab.on_grid(times[owner == k], columns) for k, slab in enumerate(slabs)], axis=2
            )
        errors = np.abs(interpolated.swapaxes(1, 2) - self.values).max(axis=1)
        return np.asarray(errors / self.sizes[:, None])

    def with_points(self, sampler: Sampler, points: Array) -> Check:
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
            return np.where(sampler.holds(at), missed.max(axis=0), 0.0)

        points, _ = climbed(error, points, errors, domain.bounds, _TO_ERRORS)
        return Check(points, sampler(points), self.sizes)

    def amplified(self, sampler: Sampler, shifts: Array) -> Array:
        """Effect of ``shifts`` (sources,) of the sources on the quantities, over their sizes.

        The shape is (sources, quantities, m).
        """
        relative: Array = sampler.changed(self.points, shifts) / self.sizes[:, None]
        return relative

    def delayed(self, sampler: Sampler) -> Array:
        """Effect of the error of the times of events on the quantities, over their sizes."""
        moved = sampler.moved(self.points)
        if moved is None:
            return np.zeros((self.sizes.size, len(self.points)))
        return np.asarray(np.abs(moved - self.values).max(axis=1) / self.sizes[:, None])


def critical_points(sampler: Sampler, domain: Domain) -> Array:
    """Points of the box where extremes, durations or crossings are nearest to a change: (m, d).

    Points spread over the box hardly meet a maximum that moves to another peak in a small part of
    the box, or a crossing that exists only there.
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
    """Points (m, d) of the box for two checks: one to aim at, and one of further points.

    The first ``corners`` of both are corners. Then come different points of the interior, and
    points beside places where the quantities are narrow or not smooth as functions of parameters.
    """

    corners: int
    aimed: Array
    further: Array

    @classmethod
    def of(cls, domain: Domain, quantities: Quantities) -> CheckPoints:
        at_corners = _corners(domain)
        special = [_beside(domain, quantities.cuts[1:]), _on_surfaces(domain, quantities)]
        count = USUAL_POINTS if domain.box else 1
        halves = (spread_over(domain, count, seed) for seed in (SEED, SEED + 1))
        aimed, further = (np.concatenate([at_corners, half, *special]) for half in halves)
        return cls(len(at_corners), aimed, further)

    def where(self, holds: Callable[[Array], NDArray[np.bool_]]) -> CheckPoints:
        """The points at which a condition holds; all of them where it holds for no check."""
        at_aimed, at_further = holds(self.aimed), holds(self.further)
        if not at_aimed.any() or not at_further.any():
            return self
        corners = int(at_aimed[: self.corners].sum())
        return CheckPoints(corners, self.aimed[at_aimed], self.further[at_further])


def spread_over(domain: Domain, count: int, seed: int = SEED) -> Array:
    """Points of the box, evenly spread, the centre first: (count, d)."""
    shares = spread(count, len(domain.box), np.random.default_rng(seed))
    shares = np.concatenate([np.full((1, len(domain.box)), 0.5), shares[1:]])
    return Coverage.of_domain(domain).points(shares)


def split(grid: TimeGrid) -> TimeGrid:
    """A grid with two slabs, of unequal length, for each."""
    pairs = itertools.pairwise(grid.breaks)
    breaks = [x for a, b in pairs for x in (a, a + _SPLIT_RATIO * (b - a))]
    return TimeGrid((*breaks, grid.breaks[-1]), grid.count)


def _beside(domain: Domain, breaks: Sequence[Sequence[float]]) -> Array:
    """Points of the box beside places where functions of a parameter are not smooth: (m, d)."""
    blocks = [np.zeros((0, len(domain.box)))]
    for j, places in enumerate(breaks):
        lower, upper = domain.box[j]
        chosen = list(places)[:_MAX_BREAKS]
        points = spread_over(domain, 2 * len(chosen) + 1)[1:]
        distance = SAME * (upper - lower)
        beside = [x + side * distance for x in chosen for side in (-1.0, 1.0)]
        points[:, j] = np.clip(beside, lower, upper)
        blocks.append(points)
    return np.concatenate(blocks)


def _on_surfaces(domain: Domain, quantities: Quantities) -> Array:
    """Points of the box where functions of several parameters are narrow or not smooth: (m, d)."""
    points = spread_over(domain, 2 * USUAL_POINTS)
    left, right = np.split(points, 2)
    blocks = [points[:0]]
    with np.errstate(all="ignore"):
        for k in range(len(quantities.parameter_surfaces(points.T))):

            def sign(at: Array, k: int = k) -> Array:
                return np.sign(np.broadcast_to(quantities.parameter_surfaces(at.T)[k], len(at)))

            across = np.flatnonzero(sign(left) * sign(right) < 0.0)[:_MAX_BREAKS]
            on_left = sign(left[across])

            def like_left(at: Array, on_left: Array = on_left) -> NDArray[np.bool_]:
                return np.asarray(sign(at) == on_left)[:, None]

            blocks.append(bisected(left[across], right[across], like_left)[0])
    return np.concatenate(blocks)


def _corners(domain: Domain) -> Array:
    """Corners of the box, all or some: (m, d)."""
    if not domain.box:
        return np.zeros((0, 0))
    lower, upper = domain.bounds.T
    unit = corners(lower.size, _MAX_CORNERS, np.random.default_rng(SEED))
    return np.asarray(np.where(unit == 1.0, upper, lower))
