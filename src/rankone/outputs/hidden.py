"""Quantities that are narrow between the times at which they are sampled.

Functions of time are looked at as rates are, through :mod:`enclosures
<rankone.verification.enclosures>`, on the slabs of a grid. At points where they surprise, the
quantities are computed again on a grid with short slabs there.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Sequence
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from rankone.discretization.radau import insets
from rankone.discretization.time_grid import Polynomials, TimeGrid
from rankone.outputs.check import ROUNDING, Check
from rankone.outputs.quantities import WrittenFunction
from rankone.outputs.sampling import Sampler
from rankone.support.arrays import Array
from rankone.support.costs import Cost, function_cost
from rankone.tensors.slab import SlabTrain
from rankone.verification.enclosures.enclosure import Enclosure
from rankone.verification.enclosures.generated import UnsuitableError, enclosed
from rankone.verification.hidden import Intervals, Surprise, surprises

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
