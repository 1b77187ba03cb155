"""Where quantities are compared with their interpolation, and what is narrow between samples.

Functions of time are looked at as rates are, through :mod:`enclosures
<rankone.solvers.verification.enclosures>`, on the slabs of a grid. At points where they surprise,
the quantities are computed again on a grid with short slabs there.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from rankone.compiler.codegen.quantities import Quantities, WrittenFunction
from rankone.solution.outputs.sampling import Sampler
from rankone.solvers.request import Domain
from rankone.solvers.verification.coverage import Coverage
from rankone.solvers.verification.enclosures.enclosure import Enclosure
from rankone.solvers.verification.enclosures.generated import UnsuitableError, enclosed
from rankone.solvers.verification.hidden_rates import Intervals, Surprise, surprises
from rankone.solvers.verification.points import Climb, climbed
from rankone.support.arrays import Array, bisected, corners, spread
from rankone.support.costs import Cost, function_cost
from rankone.tensors.bases.time_grid import Polynomials, TimeGrid, insets
from rankone.tensors.trains.slab import SlabTrain, slab_positions

_MOST_POINTS = 32  # Points at which functions are looked at, at most
_LEAST_POINTS = 8  # The same, at least, if there are so many
_MOST_INTERVALS = 4096  # Slabs of all points that are looked at, about
_MOST_BREAKS = 4000  # Of a grid with short slabs
# What polynomials of low degree do not have: functions, quotients, other powers or powers of sums
_NOT_POLYNOMIAL = re.compile(r"[a-z_]\w*[.(]|/|\)\*\*|\*\*(?![2-8](?![\d.]))")

Functions = Callable[
    [Sequence[Enclosure], Sequence[Enclosure], Sequence[Enclosure]], list[Enclosure]
]
"""Functions of the clock with the sources, parameters and reductions."""


def hidden_errors(slabs: Sequence[SlabTrain], sampler: Sampler, check: Check, rtol: float) -> Array:
    """Errors of trains by what is narrow between times, over the sizes: (quantities, m).

    Infinite where doubts remain. Some points of the check are looked at.
    """
    errors = np.zeros((check.sizes.size, len(check.points)))
    functions, cost = _functions(sampler)
    if functions is None or not len(check.points):
        return errors
    each = sampler.grid.slabs
    most = int(np.clip(_MOST_INTERVALS // each, _LEAST_POINTS, _MOST_POINTS))
    count = min(most, len(check.points))
    chosen = np.unique(np.linspace(0, len(check.points) - 1, count).astype(int))
    seen, left = _seen(sampler, check.points[chosen], functions, cost, rtol)
    if left is not None:
        errors[:, chosen[left // each]] = np.inf
    for k, own in itertools.groupby(
        sorted(seen, key=lambda place: place.interval), lambda place: place.interval // each
    ):
        column = chosen[k]
        breaks = _breaks(sampler.grid, list(own))
        if len(breaks) > _MOST_BREAKS:
            errors[:, column] = np.inf
            continue
        finer = sampler.over(TimeGrid(breaks, sampler.grid.count))
        errors[:, column] = np.maximum(errors[:, column], _missed(slabs, finer, check, column))
    return errors


def _functions(sampler: Sampler) -> tuple[Functions | None, Cost]:
    """Functions of time that may be narrow as those of enclosures, if there are any."""
    quantities = sampler.quantities
    written: list[Callable[..., Sequence[Array]]]
    written = [quantities.integrands] if quantities.reductions else []
    written += [] if quantities.timeless else [quantities.values]
    kept: list[Callable[..., Sequence[Enclosure]]] = []
    costs = [Cost(0.0, 0.0)]
    for each in written:
        each = getattr(each, "values", each)  # without the guards of a branch
        if not isinstance(each, WrittenFunction) or _are_polynomials(each.texts):
            continue
        try:
            function = enclosed(each.function)
        except UnsuitableError:
            continue
        kept.append(function)
        costs.append(function_cost(each.function))
    if not kept:
        return None, costs[0]

    def functions(
        sources: Sequence[Enclosure], p: Sequence[Enclosure], reduced: Sequence[Enclosure]
    ) -> list[Enclosure]:
        clock = Enclosure.of_samples(sources[0].values, 0.0)
        arguments = clock, sources[1:], p
        rows = [
            function(*arguments)
            if function.__code__.co_argcount == 3
            else function(*arguments, reduced)
            for function in kept
        ]
        return [Enclosure.of(row) for of_function in rows for row in of_function]

    return functions, reduce(add, costs)


def _are_polynomials(texts: Sequence[str]) -> bool:
    """Whether texts have only sums, products and low powers of names and numbers."""
    return not any(_NOT_POLYNOMIAL.search(text) for text in texts)


def _seen(
    sampler: Sampler, points: Array, functions: Functions, cost: Cost, rtol: float
) -> tuple[list[Surprise], int | None]:
    """Where functions surprise on the slabs of points, one point after the other."""
    grid = sampler.grid
    owners = np.repeat(np.arange(len(points)), grid.slabs)
    breaks = np.array(grid.breaks)
    near = insets(breaks[:-1], breaks[1:])
    starts = np.tile(breaks[:-1] + near, len(points))
    lengths = np.tile(np.diff(breaks) - 2.0 * near, len(points))
    held = 1 + len(sampler.quantities.sources)
    of_values = sampler.reductions(points) if not sampler.quantities.timeless else []

    def read(times: Array, interval: NDArray[np.intp]) -> Array:
        columns = np.broadcast_to(owners[interval], times.shape).ravel()
        rows = [*sampler.paired(times.ravel(), points[columns])]
        for each in of_values:
            running = each.ndim > 1
            at = Polynomials(grid, each).at(times.ravel(), columns) if running else each[columns]
            rows.append(at)
        return np.array(rows).reshape(-1, *times.shape)

    def of_intervals(
        times: Enclosure, states: Sequence[Enclosure], parameters: Sequence[Enclosure]
    ) -> list[Enclosure]:
        return functions(states[:held], parameters, states[held:])

    parameters = np.ascontiguousarray(points[owners].T)
    intervals = Intervals(starts, lengths, parameters, owners, read)
    return surprises(of_intervals, cost, intervals, rtol)


def _breaks(grid: TimeGrid, places: Sequence[Surprise]) -> tuple[float, ...]:
    """Those of a grid, and between them the ends of all parts that hold a surprise."""
    breaks = set(grid.breaks)
    for place in places:
        slab = place.interval % grid.slabs
        begin, length = grid.breaks[slab], grid.breaks[slab + 1] - grid.breaks[slab]
        part = place.length
        while part < 1.0:
            first = np.floor(place.lower / part) * part
            breaks |= {begin + length * share for share in (first, first + part) if 0 < share < 1}
            part *= 2.0
    return tuple(sorted(map(float, breaks)))


def _missed(slabs: Sequence[SlabTrain], sampler: Sampler, check: Check, column: int) -> Array:
    """Errors of trains at a point of a check on the grid of a sampler: (quantities,).

    They are relative to the values there if those of the check are zero except for rounding.
    """
    exact = sampler(check.points[column : column + 1])
    here, before = (np.abs(values).max(axis=(1, 2)) for values in (exact, check.values))
    least = ROUNDING * sampler.largest
    sizes = np.where((before <= least) & (here > least), here, check.sizes)
    return Check(check.points[column : column + 1], exact, sizes).missed(slabs, sampler)[:, 0]


# -----------------------------------------------------------------------------
# Where quantities are compared with their interpolation: points of the box, and values there.


ROUNDING = 1e-13  # A quantity below this share of its operands is zero except for rounding
_INTERIOR_POINTS = 96  # Points of the interior where an error is measured, as for solutions
_MAX_CORNERS = 32  # Corners where an error is measured: all of five parameters
_SCOUTS = 512  # Points where a search begins
_CLIMBERS = 16  # Best of them that go on
# The way to where extremes, durations or crossings are nearest to a change
_TO_CHANGES = Climb(rounds=24, tries=5, first_step=0.25, shrinkage=0.8)
_TO_ERRORS = Climb(rounds=10, tries=5, first_step=0.25, shrinkage=0.8)  # The way to larger errors
# Where slabs are split for the check, so that its nodes differ from the nodes of the grid
_SPLIT_RATIO = 0.55
_MAX_BREAKS = 32  # Most breaks of a parameter, and most points on a surface, that are looked at
_BREAK_DISTANCE = 1e-6  # Distance of points beside a break, in widths of the interval
_HALVINGS = 60  # Bisections of a segment across a surface: to the last digit
_SPREAD_SEED = 20145  # Seed of evenly spread points
_FURTHER_SEED = 20147  # Seed of further ones
_CORNER_SEED = 20146  # Seed of the choice of corners


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
        nothing = sizes <= ROUNDING * sampler.largest
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
        count = _INTERIOR_POINTS if domain.box else 1
        halves = (spread_over(domain, count, seed) for seed in (_SPREAD_SEED, _FURTHER_SEED))
        aimed, further = (np.concatenate([at_corners, half, *special]) for half in halves)
        return cls(len(at_corners), aimed, further)

    def where(self, holds: Callable[[Array], NDArray[np.bool_]]) -> CheckPoints:
        """The points at which a condition holds; all of them where it holds for no check."""
        at_aimed, at_further = holds(self.aimed), holds(self.further)
        if not at_aimed.any() or not at_further.any():
            return self
        corners = int(at_aimed[: self.corners].sum())
        return CheckPoints(corners, self.aimed[at_aimed], self.further[at_further])


def spread_over(domain: Domain, count: int, seed: int = _SPREAD_SEED) -> Array:
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
        distance = _BREAK_DISTANCE * (upper - lower)
        beside = [x + side * distance for x in chosen for side in (-1.0, 1.0)]
        points[:, j] = np.clip(beside, lower, upper)
        blocks.append(points)
    return np.concatenate(blocks)


def _on_surfaces(domain: Domain, quantities: Quantities) -> Array:
    """Points of the box where functions of several parameters are narrow or not smooth: (m, d)."""
    points = spread_over(domain, 2 * _INTERIOR_POINTS)
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

            blocks.append(bisected(left[across], right[across], like_left, _HALVINGS)[0])
    return np.concatenate(blocks)


def _corners(domain: Domain) -> Array:
    """Corners of the box, all or some: (m, d)."""
    if not domain.box:
        return np.zeros((0, 0))
    lower, upper = domain.bounds.T
    unit = corners(lower.size, _MAX_CORNERS, np.random.default_rng(_CORNER_SEED))
    return np.asarray(np.where(unit == 1.0, upper, lower))
