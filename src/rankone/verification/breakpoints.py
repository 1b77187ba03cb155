"""Where known functions of one coordinate jump, kink or are narrow.

The factors of a separated form are functions of one coordinate, so they can be sampled finely
before anything is solved. An integrator or a basis with few nodes may step over a short pulse
without a trace; what is found here is given to both.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rankone.discretization import ChebyshevBasis
from rankone.ir.domain import Domain, KnownFactors
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import Cost
from rankone.support.errors import OptionError

__all__ = ["Breakpoints", "breakpoints", "resolving_pieces", "system_breakpoints"]

_SAMPLES = 2**14
"""Fine samples over the interval: narrower pieces may be missed."""
_NODES = 14
_TOLERANCE = 1e-7
"""Interpolation error that counts as resolved, relative to the largest value."""
_NARROW = 1.0 / 64.0
_EXTRA = np.array([0.003, 0.11, 0.29, 0.41, 0.59, 0.71, 0.89, 0.997])
"""Places beside the samples, so that small pieces are looked at too."""
_LOOK = Cost(80e3, 3.0)
"""Operations of an interpolation on a piece, and for each sample there."""
_RARE = 0.25
"""Narrow pieces count if they make up less than this part of the interval."""
_DEEPEST = 13
_SEEN = 224
"""Samples that tell the size of a factor."""
_MOST_ROUGH = 1000
"""Most places found by samples alone at which functions are not smooth."""
_MOST_REPEATED = 10_000
"""Most points that repeat with a period."""
_COINCIDE = 1e-14
"""Points that are closer, relative to the largest value of the coordinate, are the same."""
_MOST_CLOSE, _COUNTS = 100, 1e-9
"""Most pairs of such points that are looked at, and the share of a pulse between them in the whole
that counts."""
_POLE = 1e9
"""A factor that is so many times larger at a breakpoint than at samples may have a pole there."""
_TOWARDS, _GROWTH = (1e-11, 1e-14), 10.0
"""It has if it grows by so much between two distances, in widths of the interval."""


class TooManyBreakpoints(Exception):
    """Functions are not smooth anywhere."""


@dataclass(frozen=True)
class Breakpoints:
    """Points at which an interval is best cut for known functions.

    Attributes
    ----------
    points : tuple of float
        Ascending, inside the interval: jumps and kinks, and the ends of narrow pieces.
    smooth : bool
        Whether a few nodes between them resolve the functions.
    """

    points: tuple[float, ...] = ()
    smooth: bool = True


def system_breakpoints(system: System, domain: Domain) -> tuple[Breakpoints, ...]:
    """Breakpoints of the time factors, and those of the factors of each parameter.

    The first factor of every coordinate is one; where it is the only one there is no need to look.
    Where the others switch is known beforehand, as far as that could be solved for.

    Raises
    ------
    OptionError
        If a factor is not finite, has a pole, or switches too often.
    """
    features = system.features
    found: list[Breakpoints] = []
    for factors, alone, repeated in zip(
        KnownFactors.of(system, domain), features.cuts, features.periodic_cuts, strict=True
    ):
        interval = factors.interval
        cuts = [*alone, *_repeated(factors, repeated)]
        found.append(Breakpoints())
        _check_pulses(factors, cuts)
        if len(factors(np.array(interval))) > 1:
            try:
                found[-1] = breakpoints(factors, *interval, cuts)
            except TooManyBreakpoints:
                raise OptionError(
                    f"a coefficient varies too fast for {factors.what} in "
                    f"[{interval[0]:g}, {interval[1]:g}]: 16384 samples do not resolve it",
                    remedy="choose a shorter range, or replace what varies by its mean",
                ) from None
            points = np.array([*interval, *found[-1].points])
            samples = np.abs(factors(np.linspace(*interval, _SEEN))).max()
            if np.abs(factors(points)).max() > _POLE * samples and _grows(factors, points):
                raise factors.not_finite()
    return tuple(found)


def _check_pulses(factors: KnownFactors, cuts: Sequence[float]) -> None:
    """Raise an OptionError for a pulse between two cuts that are the same but for rounding."""
    lower, upper = factors.interval
    least = _COINCIDE * max(abs(lower), abs(upper))
    close = [
        (a, b)
        for a, b in itertools.pairwise(sorted({x for x in cuts if lower < x < upper}))
        if b - a <= least
    ]
    for a, b in close[:_MOST_CLOSE]:
        inside, *around = factors(np.array([0.5 * (a + b), a - 2.0 * least, b + 2.0 * least])).T
        other = np.maximum(*np.abs(around))
        if ((np.abs(inside) - other) * (b - a) > _COUNTS * (other + 1.0) * (upper - lower)).any():
            raise OptionError(
                f"a pulse for {factors.what} from {a!r} to {b!r} is too short: floating-point "
                f"numbers are not much closer",
                remedy="give what it does as a whole, such as a step",
            )


def _grows(factors: KnownFactors, points: Array) -> bool:
    """Whether factors grow without end towards one of the points, as a narrow peak does not."""
    lower, upper = factors.interval
    near, nearer = (
        np.abs(factors(np.clip(points + share * (upper - lower), lower, upper)))
        for share in _TOWARDS
    )
    return bool((nearer > _GROWTH * near).any())


def _repeated(factors: KnownFactors, periodic: Sequence[tuple[float, float]]) -> list[float]:
    """The points that repeat with a period, inside the interval."""
    lower, upper = factors.interval
    counted = sum((upper - lower) / period for _, period in periodic)
    if counted > _MOST_REPEATED:
        raise OptionError(
            f"a coefficient switches {counted:.7g} times for {factors.what} in "
            f"[{lower:g}, {upper:g}]",
            remedy="choose a shorter range, or replace what switches by its mean",
        )
    found: list[float] = []
    for first, period in periodic:
        numbers = range(
            math.floor((lower - first) / period), math.ceil((upper - first) / period) + 1
        )
        found += [first + n * period for n in numbers]
    return found


def breakpoints(
    function: Callable[[Array], Array], lower: float, upper: float, known: Sequence[float] = ()
) -> Breakpoints:
    """Points at which an interval is best cut for a vector of functions.

    Jumps and kinks are located by bisection. There are none for functions that are smooth on the
    scale of the interval.

    Parameters
    ----------
    function : callable
        Maps points (N,) to values (rows, N).
    lower, upper : float
        The interval.
    known : sequence of float
        Points that are among them if they are inside.
    """
    finder = _Finder(function, lower, upper)
    known = _inside(known, lower, upper)
    cuts = list(known)
    for _ in range(4):
        edges = [lower, *cuts, upper]
        pieces = [piece for a, b in itertools.pairwise(edges) for piece in finder.pieces(a, b)]
        rough = [(a, b) for a, b, resolved in pieces if not resolved]
        if len(rough) > _MOST_ROUGH:
            raise TooManyBreakpoints
        found = [finder.locate(a, b) for a, b in rough]
        found += finder.hidden(pieces)
        fresh = [x for x in found if min(abs(x - edge) for edge in edges) > finder.closest]
        if not fresh:
            break
        cuts = sorted([*cuts, *finder.distinct(fresh)])
    smooth = len(pieces) <= len(cuts) + 1
    width = upper - lower
    narrow = [(a, b) for a, b, _ in pieces if b - a < _NARROW * width]
    if sum(b - a for a, b in narrow) < _RARE * width:
        cuts += [x for piece in narrow for x in piece]
    found = [x for x in finder.distinct(cuts) if min(x - lower, upper - x) > finder.closest]
    away = [x for x in found if min((abs(x - y) for y in known), default=math.inf) > finder.closest]
    return Breakpoints(tuple(sorted([*known, *away])), smooth)


def _inside(points: Sequence[float], lower: float, upper: float) -> list[float]:
    """Points inside an interval, ascending, each once but for rounding errors."""
    least = _COINCIDE * max(abs(lower), abs(upper))
    kept: list[float] = []
    for x in sorted(points):
        if x - (kept[-1] if kept else lower) > least and upper - x > least:
            kept.append(x)
    return kept


def resolving_pieces(
    function: Callable[[Array], Array],
    lower: float,
    upper: float,
    borders: Sequence[float],
    nodes: int,
    tolerance: float,
) -> list[tuple[float, float]]:
    """Pieces of an interval on each of which so many Chebyshev nodes resolve functions.

    Parameters
    ----------
    function : callable
        Maps points (N,) to values (rows, N).
    lower, upper : float
        The interval.
    borders : sequence of float
        Points inside of it, ascending, that no piece crosses.
    nodes : int
    tolerance : float
        Largest error, relative to the largest value of each row.
    """
    finder = _Finder(function, lower, upper, nodes, tolerance)
    edges = itertools.pairwise([lower, *borders, upper])
    return [(a, b) for left, right in edges for a, b, _ in finder.pieces(left, right)]


@lru_cache(32)
def _unit(nodes: int) -> ChebyshevBasis:
    return ChebyshevBasis(0.0, 1.0, nodes)


def _interpolation(places: Array, nodes: int) -> Array:
    """From values at the nodes of [0, 1] to those at places (N,) and at the extra ones."""
    unit = _unit(nodes)
    at = unit.modal_values(np.concatenate([places, _EXTRA]))
    return np.asarray(np.sqrt(unit.weights)[:, None] * (unit.to_modal.T @ at.T))


def _even(places: Array) -> bool:
    """Whether places on [0, 1] are the middles of equal parts."""
    if not places.size:
        return False
    first, last = places[0] * places.size, (1.0 - places[-1]) * places.size
    return bool(abs(first - 0.5) + abs(last - 0.5) < 1e-6)


@lru_cache(32)
def _evenly(count: int, nodes: int) -> Array:
    """The same for the middles of so many equal parts: what a dyadic piece has."""
    return _interpolation((np.arange(count) + 0.5) / count, nodes)


class _Finder:
    """Recursive bisection of one interval until the functions are resolved on every piece."""

    def __init__(
        self,
        function: Callable[[Array], Array],
        lower: float,
        upper: float,
        nodes: int = _NODES,
        tolerance: float = _TOLERANCE,
    ) -> None:
        self.function, self.nodes, self.tolerance = function, nodes, tolerance
        self.lower, self.width = lower, upper - lower
        self.closest = 1e-9 * self.width
        points = lower + self.width * (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        self.points, self.values = points, function(points)
        self.size = np.abs(self.values).max(axis=1, keepdims=True)
        self.size[self.size == 0.0] = 1.0

    def error(self, a: float, b: float) -> float:
        """Largest interpolation error on [a, b], at the fine samples and a few more points."""
        inside = slice(*np.searchsorted(self.points, [a, b]))
        charge(_LOOK(self.values[:, inside].size))
        places = (self.points[inside] - a) / (b - a)
        few = self.function(a + (b - a) * np.concatenate([_unit(self.nodes).nodes, _EXTRA]))
        if _even(places):
            matrix = _evenly(places.size, self.nodes)
        else:
            matrix = _interpolation(places, self.nodes)
        values = np.concatenate([self.values[:, inside], few[:, self.nodes :]], axis=1)
        return float(np.max(np.abs(values - few[:, : self.nodes] @ matrix) / self.size))

    def pieces(self, a: float, b: float, depth: int = 0) -> list[tuple[float, float, bool]]:
        """Resolved pieces of [a, b], and pieces of the least width that are not resolved."""
        if self.error(a, b) <= self.tolerance:
            return [(a, b, True)]
        if depth == _DEEPEST or b - a < 4.0 * self.closest:
            return [(a, b, False)]
        middle = 0.5 * (a + b)
        return self.pieces(a, middle, depth + 1) + self.pieces(middle, b, depth + 1)

    def hidden(self, pieces: list[tuple[float, float, bool]]) -> list[float]:
        """Ends of pieces at which the functions are not smooth, though they are on both sides."""
        found = []
        for (a, b, left), (_, c, right) in itertools.pairwise(pieces):
            near = 0.25 * min(b - a, c - b)
            if left and right and self.error(b - near, b + near) > self.tolerance:
                found.append(b)
        return found

    def locate(self, a: float, b: float) -> float:
        """The point of a piece at which the functions are least smooth."""
        while b - a > 1e-15 * max(abs(a), abs(b), self.width):
            middle = 0.5 * (a + b)
            if not a < middle < b:
                break
            left, right = self.error(a, middle), self.error(middle, b)
            if max(left, right) <= 1e-3 * self.tolerance:
                return middle
            a, b = (a, middle) if left > right else (middle, b)
        return 0.5 * (a + b)

    def distinct(self, points: list[float]) -> list[float]:
        """Ascending, without points that nearly coincide."""
        kept: list[float] = []
        for x in sorted(points):
            if not kept or x - kept[-1] > self.closest:
                kept.append(x)
        return kept
