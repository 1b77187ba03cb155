"""Cuts of one coordinate: where known functions of it jump, kink or are narrow.

The factors of a separated form are functions of one coordinate, so they can be sampled finely
before anything is solved. An integrator or a basis with few nodes may step over a short pulse
without a trace; the cuts are given to both. The features of a system are those cuts that could be
derived from its equations; samples show the others, and the ends of narrow pieces.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.request import Domain, KnownFactors
from rankone.solvers.tuning import CHECK
from rankone.support.arrays import NEGLIGIBLE, ROUNDING, Array, lobatto
from rankone.support.budget import charge
from rankone.support.costs import CALL, Cost
from rankone.support.errors import OptionError
from rankone.tensors import IDENTITY, ChebyshevBasis, Scale
from rankone.trajectories.system.system import System

# Shares of a piece that are sampled too, since small pieces contain no fine sample
_OFF_SAMPLES = lobatto(10)[1:-1]
_SHARES = np.append(
    (np.arange(CHECK.piece_samples) + 0.5) / CHECK.piece_samples, _OFF_SAMPLES
)  # Sampled in any case
_LOOK_COST = Cost(80 * CALL, 3.0)  # An interpolation on a piece: once, and for each sample


class TooManyCuts(Exception):
    """Functions are not smooth anywhere."""


@dataclass(frozen=True)
class Cuts:
    """Where an interval is best cut for known functions: jumps, kinks, ends of narrow pieces.

    The points ascend inside the interval. The functions are ``smooth`` if a few nodes between the
    points resolve them.
    """

    points: tuple[float, ...] = ()
    smooth: bool = True


def system_cuts(system: System, domain: Domain) -> tuple[Cuts, ...]:
    """Cuts of the time factors, and those of the factors of each parameter.

    The first factor of every coordinate is one; where it is the only one there is no need to look.
    A factor that is not finite, has a pole, or switches too often is an OptionError.
    """
    features, all_cuts = system.features, list[Cuts]()
    scales = (IDENTITY, *domain.first_coordinates)
    for factors, single, periodic, scale in zip(
        KnownFactors.of(system, domain), features.cuts, features.periodic_cuts, scales, strict=True
    ):
        interval = factors.interval
        derived = [*single, *_repeated(factors, periodic)]
        _check_pulses(factors, derived)
        if len(factors(np.array(interval))) == 1:
            all_cuts.append(Cuts())
            continue
        try:
            cuts = _cuts_in_scale(factors, interval, derived, scale)
        except TooManyCuts:
            raise OptionError(
                f"a coefficient varies too fast for {factors.coordinate} in "
                f"[{interval[0]:g}, {interval[1]:g}]: {CHECK.piece_samples} samples do not resolve "
                "it",
                remedy="choose a shorter range, or replace what varies by its mean",
            ) from None
        points = np.array([*interval, *cuts.points])
        size = np.abs(factors(np.linspace(*interval, CHECK.factor_size_samples))).max()
        if np.abs(factors(points)).max() > CHECK.pole * size and _grows(factors, points):
            raise factors.not_finite()
        all_cuts.append(cuts)
    return tuple(all_cuts)


def _cuts_in_scale(
    function: Callable[[Array], Array],
    interval: tuple[float, float],
    derived: Sequence[float],
    scale: Scale,
) -> Cuts:
    """Cuts of functions that are looked at in the coordinate of a scale."""
    if scale.is_identity:
        return located_cuts(function, *interval, derived)
    inside = [x for x in derived if interval[0] < x < interval[1]]
    places = scale.to_scale(np.array(inside)).tolist()
    exact = dict(zip(places, inside, strict=True))
    scaled, ends = in_scale(function, interval, scale)
    cuts = located_cuts(scaled, *ends, places)
    points = [exact.get(s, float(scale.from_scale(np.array(s)))) for s in cuts.points]
    return Cuts(tuple(points), cuts.smooth)


def in_scale(
    function: Callable[[Array], Array], interval: tuple[float, float], scale: Scale
) -> tuple[Callable[[Array], Array], tuple[float, float]]:
    """A function of a parameter as one of its coordinate in a scale, and the interval of that."""
    start, end = scale.to_scale(np.array(interval)).tolist()
    return lambda s: function(np.clip(scale.from_scale(s), *interval)), (start, end)


def _check_pulses(factors: KnownFactors, cuts: Sequence[float]) -> None:
    """Raise an OptionError for a pulse between two cuts that are the same except for rounding."""
    lower, upper = factors.interval
    least = ROUNDING * max(abs(lower), abs(upper))
    inside = sorted({x for x in cuts if lower < x < upper})
    close = [(a, b) for a, b in itertools.pairwise(inside) if b - a <= least]
    for a, b in close[: CHECK.most_close_pairs]:
        pulse, *beside = factors(np.array([0.5 * (a + b), a - 2.0 * least, b + 2.0 * least])).T
        usual = np.maximum(*np.abs(beside))
        area = (np.abs(pulse) - usual) * (b - a)
        if (area > NEGLIGIBLE * (usual + 1.0) * (upper - lower)).any():
            raise OptionError(
                f"a pulse for {factors.coordinate} from {a!r} to {b!r} is too short: "
                "floating-point numbers are not much closer",
                remedy="give what it does as a whole, such as a step",
            )


def _grows(factors: KnownFactors, points: Array) -> bool:
    """Whether factors grow without end towards one of the points, as a narrow peak does not."""
    lower, upper = factors.interval
    far, near = (
        np.abs(factors(np.clip(points + distance * (upper - lower), lower, upper)))
        for distance in CHECK.pole_distances
    )
    return bool((near > CHECK.pole_growth * far).any())


def _repeated(factors: KnownFactors, periodic: Sequence[tuple[float, float]]) -> list[float]:
    """The cuts that repeat with a period, inside the interval."""
    lower, upper = factors.interval
    count = sum((upper - lower) / period for _, period in periodic)
    if count > CHECK.most_repeated:
        raise OptionError(
            f"a coefficient switches {count:.7g} times for {factors.coordinate} in "
            f"[{lower:g}, {upper:g}]",
            remedy="choose a shorter range, or replace what switches by its mean",
        )
    cuts: list[float] = []
    for first, period in periodic:
        before, after = math.floor((lower - first) / period), math.ceil((upper - first) / period)
        cuts += [first + k * period for k in range(before, after + 1)]
    return cuts


def located_cuts(
    function: Callable[[Array], Array], lower: float, upper: float, derived: Sequence[float] = ()
) -> Cuts:
    """Points at which an interval is best cut for functions, points (N,) -> (rows, N).

    Jumps and kinks are located by bisection. Functions that are smooth on the scale of the interval
    have no cuts but those ``derived`` before that are inside.
    """
    finder = _Finder(function, lower, upper)
    derived = _inside(derived, lower, upper)
    cuts = list(derived)
    for _ in range(CHECK.most_rounds):
        edges = [lower, *cuts, upper]
        pieces = [piece for a, b in itertools.pairwise(edges) for piece in finder.pieces(a, b)]
        rough = [(a, b) for a, b, resolved in pieces if not resolved]
        if len(rough) > CHECK.most_rough_pieces:
            raise TooManyCuts
        located = [finder.locate(a, b) for a, b in rough] + finder.hidden(pieces)
        fresh = [x for x in located if _distance(x, edges) > finder.closest]
        if not fresh:
            break
        cuts = sorted([*cuts, *_distinct(fresh, finder.closest)])
    smooth = len(pieces) <= len(cuts) + 1
    width = upper - lower
    narrow = [(a, b) for a, b, _ in pieces if b - a < CHECK.narrow_piece * width]
    if sum(b - a for a, b in narrow) < CHECK.rare_piece_share * width:
        cuts += [x for piece in narrow for x in piece]
    apart = [*derived, lower, upper]
    sampled = [x for x in _distinct(cuts, finder.closest) if _distance(x, apart) > finder.closest]
    return Cuts(tuple(sorted([*derived, *sampled])), smooth)


def _distance(x: float, points: Sequence[float]) -> float:
    return min(abs(x - point) for point in points)


def _distinct(points: Sequence[float], least: float) -> list[float]:
    """Ascending, without points that nearly coincide with the one before."""
    kept: list[float] = []
    for x in sorted(points):
        if not kept or x - kept[-1] > least:
            kept.append(x)
    return kept


def _inside(points: Sequence[float], lower: float, upper: float) -> list[float]:
    """Points inside an interval, ascending, each once except for rounding errors."""
    least = ROUNDING * max(abs(lower), abs(upper))
    _, *inside = _distinct([lower, *(x for x in points if x > lower)], least)
    return [x for x in inside if upper - x > least]


def resolving_pieces(
    function: Callable[[Array], Array],
    lower: float,
    upper: float,
    borders: Sequence[float],
    nodes: int,
    tolerance: float,
) -> list[tuple[float, float]]:
    """Pieces of an interval on each of which ``nodes`` Chebyshev nodes resolve functions.

    The functions map points (N,) to (rows, N). No piece crosses a border; the borders ascend inside
    of the interval. The tolerance is relative to the largest value of each row.
    """
    finder = _Finder(function, lower, upper, nodes, tolerance)
    edges = itertools.pairwise([lower, *borders, upper])
    return [(a, b) for left, right in edges for a, b, _ in finder.pieces(left, right)]


@lru_cache(32)
def _unit(nodes: int) -> ChebyshevBasis:
    return ChebyshevBasis(0.0, 1.0, nodes)


def _interpolation(shares: Array, nodes: int) -> Array:
    """From function values at the nodes of [0, 1] to those at shares (N,) and off the samples."""
    unit = _unit(nodes)
    modes = unit.modal_values(np.concatenate([shares, _OFF_SAMPLES]))
    return np.asarray(np.sqrt(unit.weights)[:, None] * (unit.to_modal.T @ modes.T))


@lru_cache(32)
def _even_interpolation(count: int, nodes: int) -> Array:
    """The same for the middles of ``count`` equal parts, as a dyadic piece has them."""
    return _interpolation((np.arange(count) + 0.5) / count, nodes)


def _are_even(shares: Array) -> bool:
    """Whether shares are the middles of equal parts of [0, 1]."""
    if not shares.size:
        return False
    first, last = shares[0] * shares.size, (1.0 - shares[-1]) * shares.size
    return bool(abs(first - 0.5) + abs(last - 0.5) < 1e-6)


class _Finder:
    """Recursive bisection of one interval until the functions are resolved on every piece."""

    def __init__(
        self,
        function: Callable[[Array], Array],
        lower: float,
        upper: float,
        nodes: int = CHECK.cut_nodes,
        tolerance: float = CHECK.resolved_error,
    ) -> None:
        self.function, self.nodes, self.tolerance = function, nodes, tolerance
        self.lower, self.width = lower, upper - lower
        self.closest = NEGLIGIBLE * self.width
        points = lower + self.width * _SHARES
        self.points, samples = points[: CHECK.piece_samples], function(points)
        size = np.maximum(samples.max(axis=1), -samples.min(axis=1))[:, None]
        size[size == 0.0] = 1.0
        straight = self._are_straight(samples, size)
        self.bent = slice(None) if not straight.any() else np.flatnonzero(~straight)
        self.samples, self.size = samples[self.bent, : CHECK.piece_samples], size[self.bent]

    def _are_straight(self, samples: Array, size: Array) -> NDArray[np.bool_]:
        """Which functions are straight lines, (rows,): nothing more has to be looked at."""
        first, slopes = (
            samples[:, :1],
            samples[:, CHECK.piece_samples - 1 : CHECK.piece_samples] - samples[:, :1],
        )
        lines = slopes * ((_SHARES - _SHARES[0]) / (_SHARES[CHECK.piece_samples - 1] - _SHARES[0]))
        lines += first
        lines -= samples
        largest = np.maximum(lines.max(axis=1), -lines.min(axis=1))
        return np.asarray(largest <= CHECK.straight_error * size[:, 0])

    def error(self, a: float, b: float) -> float:
        """Largest interpolation error on [a, b], at the fine samples and a few more points."""
        if not len(self.samples):
            return 0.0
        inside = slice(*np.searchsorted(self.points, [a, b]))
        charge(_LOOK_COST(self.samples[:, inside].size))
        shares = (self.points[inside] - a) / (b - a)
        few = self.function(a + (b - a) * np.concatenate([_unit(self.nodes).nodes, _OFF_SAMPLES]))
        few = few[self.bent]
        if _are_even(shares):
            matrix = _even_interpolation(shares.size, self.nodes)
        else:
            matrix = _interpolation(shares, self.nodes)
        exact = np.concatenate([self.samples[:, inside], few[:, self.nodes :]], axis=1)
        return float(np.max(np.abs(exact - few[:, : self.nodes] @ matrix) / self.size))

    def pieces(self, a: float, b: float, depth: int = 0) -> list[tuple[float, float, bool]]:
        """Resolved pieces of [a, b], and pieces of the least width that are not resolved."""
        if self.error(a, b) <= self.tolerance:
            return [(a, b, True)]
        if depth == CHECK.most_depth or b - a < 4.0 * self.closest:
            return [(a, b, False)]
        middle = 0.5 * (a + b)
        return self.pieces(a, middle, depth + 1) + self.pieces(middle, b, depth + 1)

    def hidden(self, pieces: list[tuple[float, float, bool]]) -> list[float]:
        """Ends of pieces at which the functions are not smooth, though they are on both sides."""
        cuts = []
        for (a, b, left), (_, c, right) in itertools.pairwise(pieces):
            near = 0.25 * min(b - a, c - b)
            if left and right and self.error(b - near, b + near) > self.tolerance:
                cuts.append(b)
        return cuts

    def locate(self, a: float, b: float) -> float:
        """The point of a piece at which the functions are least smooth."""
        while b - a > CHECK.cut_width * max(abs(a), abs(b), self.width):
            middle = 0.5 * (a + b)
            if not a < middle < b:
                break
            left, right = self.error(a, middle), self.error(middle, b)
            if max(left, right) <= CHECK.smooth_error * self.tolerance:
                return middle
            a, b = (a, middle) if left > right else (middle, b)
        return 0.5 * (a + b)
