"""Where points of a box lie: evenly on the scale of a parameter, and over decades on two of them.

Even points over (1e-6, 1) have one in ten thousand below 1e-4, so what happens there is never seen.
Half of the points of an interval over decades are even in the logarithm, half in the parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rankone.solvers.request import Domain
from rankone.support.arrays import Array
from rankone.tensors.bases import Basis1D
from rankone.tensors.bases.scales import IDENTITY, Interval, Logarithm, Scale, on_scale

# Upper over lower end above which points are mixed: below it, even ones reach all decades
_MIXED_RATIO = 30.0
_KNOTS = 513  # Knots on each of the two scales between which shares are interpolated
_LOGARITHM = Logarithm()


@dataclass(frozen=True)
class Coverage:
    """The coordinates of a box in which its points are spread.

    ``scales`` has one for each interval; on the intervals that are ``mixed``, half of the points
    are even on it, and half in the parameter.
    """

    box: tuple[Interval, ...]
    scales: tuple[Scale, ...]
    mixed: tuple[bool, ...]

    @classmethod
    def of_box(cls, box: Array, scales: Sequence[Scale] = ()) -> Coverage:
        """For a box (d, 2): on the scales that were asked for, else by the ratios of its ends."""
        intervals = tuple((float(lower), float(upper)) for lower, upper in box)
        asked = scales or (IDENTITY,) * len(intervals)
        pairs = list(zip(intervals, asked, strict=True))
        mixed = tuple(scale.is_identity and _spans_decades(ends) for ends, scale in pairs)
        natural = tuple(
            _LOGARITHM if mix else scale for mix, (_, scale) in zip(mixed, pairs, strict=True)
        )
        return cls(intervals, natural, mixed)

    @classmethod
    def of_domain(cls, domain: Domain) -> Coverage:
        return cls.of_box(domain.bounds, domain.coordinates)

    @classmethod
    def of_bases(cls, bases: Sequence[Basis1D]) -> Coverage:
        """For the box of a solution: half of the points are even on the scales of its bases."""
        intervals = tuple((float(basis.lower), float(basis.upper)) for basis in bases)
        plain = cls.of_box(np.array(intervals).reshape(-1, 2))
        pairs = list(zip(bases, plain.scales, strict=True))
        scales = tuple(other if b.scale.is_identity else b.scale for b, other in pairs)
        return cls(intervals, scales, tuple(not scale.is_identity for scale in scales))

    def points(self, shares: Array) -> Array:
        """Points (m, d) at shares (m, d) in [0, 1] of the coordinates."""
        bounds = np.array(self.box).reshape(-1, 2)
        lower, width = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
        points = np.asarray(lower + width * shares)
        for j, (interval, scale) in enumerate(zip(self.box, self.scales, strict=True)):
            if self.mixed[j]:
                points[:, j] = np.interp(shares[:, j], *_mixture(interval, scale))
            elif not scale.is_identity:
                points[:, j] = on_scale(scale, interval, shares[:, j])
        return points

    def line(self, j: int, count: int) -> Array:
        """Points (count,) of one interval, evenly spaced in its coordinate, ends included."""
        if not self.mixed[j] and self.scales[j].is_identity:
            return np.linspace(*self.box[j], count)
        shares = np.linspace(0.0, 1.0, count)
        return self.points(np.broadcast_to(shares[:, None], (count, len(self.box))))[:, j]

    def steps(self, points: Array, share: float) -> Array:
        """Lengths (m, d) of steps at points (m, d) that are a share of each coordinate."""
        bounds = np.array(self.box).reshape(-1, 2)
        steps = np.broadcast_to(share * (bounds[:, 1] - bounds[:, 0]), points.shape)
        if all(scale.is_identity for scale in self.scales):
            return steps
        steps = steps.copy()
        for j, (interval, scale) in enumerate(zip(self.box, self.scales, strict=True)):
            if not scale.is_identity:
                first, last = scale.to_scale(np.array(interval))
                steps[:, j] = share * (last - first) / scale.slope(points[:, j])
        return np.asarray(steps)


def _spans_decades(interval: Interval) -> bool:
    lower, upper = interval
    return lower > 0.0 and upper > _MIXED_RATIO * lower


@lru_cache(maxsize=64)
def _mixture(interval: Interval, scale: Scale) -> tuple[Array, Array]:
    """Shares of the points below knots, half of them even on a scale, and the knots."""
    lower, upper = interval
    even = np.linspace(0.0, 1.0, _KNOTS)
    knots = np.union1d(np.linspace(lower, upper, _KNOTS), on_scale(scale, interval, even))
    places = scale.to_scale(knots)
    shares = 0.5 * (knots - lower) / (upper - lower)
    shares += 0.5 * (places - places[0]) / (places[-1] - places[0])
    shares[-1] = 1.0
    return shares, knots
