"""Smaller trains for a model that may differ from the solution it is made from.

Ranks are cut first, then entries that do not matter. Both bound a root mean square, so that the
largest difference is measured at points and the tolerance lowered until it is within what was
asked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.support.arrays import Array
from rankone.tensors.cross import rounded
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain, sharing
from rankone.tensors.train import thinned
from rankone.verification.search import Climb, climbed

__all__ = ["Rounding", "rounded_slabs"]

_POINTS = 4200
_AT_ENDS = (0.0, 0.5, 1.0)
"""Share of the parameters that are at ends of their intervals, for each third of the points."""
_MARGIN = 0.7
"""Of what was asked, since points miss the largest difference."""
_ENOUGH = 0.45
"""Of what was asked; no larger difference is sought."""
_ATTEMPTS = 9
_CLIMBERS = 24
"""Points from which larger differences are looked for."""
_TO_DIFFERENCES = Climb(rounds=15, tries=6, first_step=0.2, shrinkage=0.8, seed=1)
"""The way to them."""


@dataclass(frozen=True)
class Rounding:
    """Rounded trains, and how far they are from those before.

    Attributes
    ----------
    slabs : tuple of SlabTrain
        Slabs that shared the cores of their parameters go on sharing them.
    differences : tuple of float
        For each state the largest difference at the points and by climbing from the worst of
        them, relative to its size: its largest value at the points.
    points : int
        Number of points.
    """

    slabs: tuple[SlabTrain, ...]
    differences: tuple[float, ...]
    points: int = _POINTS


def rounded_slabs(
    slabs: Sequence[SlabTrain], intervals: Sequence[tuple[float, float]], rtol: float
) -> Rounding:
    """Trains with fewer coefficients, within ``rtol`` of each state's size.

    The difference is measured at random points and by climbing from the worst of them.

    Parameters
    ----------
    slabs : sequence of SlabTrain
        Consecutive slabs of the same states.
    intervals : sequence of (float, float)
        Of time and of each parameter.
    rtol : float
        Largest difference, relative to each state's size.

    Returns
    -------
    Rounding
        With the slabs as they are if no smaller ones are within ``rtol``.
    """
    points = _points(slabs, intervals)
    rows = slice(0, len(slabs[0].cores[0]))
    values = TrainEvaluator(slabs).many(points, rows)
    sizes = np.abs(values).max(axis=1)
    sizes[sizes == 0.0] = 1.0
    best = Rounding(tuple(slabs), (0.0,) * len(sizes))
    low, high, tolerance = 0.0, 0.0, rtol
    for _ in range(_ATTEMPTS):
        found = tuple(slab for run in sharing(slabs) for slab in _smaller(run, sizes, tolerance))
        changes = _changes(slabs, found, points, values, sizes, intervals)
        largest = float(changes.max())
        if largest <= _MARGIN * rtol:
            best, low = Rounding(found, tuple(changes.tolist())), tolerance
        else:
            high = tolerance
        if low == tolerance and (largest >= _ENOUGH * rtol or tolerance >= 4.0 * rtol):
            break
        tolerance = _next(low, high)
    return best


def _changes(
    slabs: Sequence[SlabTrain],
    found: Sequence[SlabTrain],
    points: Array,
    values: Array,
    sizes: Array,
    intervals: Sequence[tuple[float, float]],
) -> Array:
    """Largest difference of each state over its size: at points, and climbing from the worst."""
    before, after = TrainEvaluator(slabs), TrainEvaluator(found)
    rows = slice(0, len(sizes))
    each = np.abs(after.many(points, rows) - values) / sizes[:, None]
    largest = each.max(axis=1)

    def difference(tried: Array) -> Array:
        nonlocal largest
        there = np.abs(after.many(tried.T, rows) - before.many(tried.T, rows)) / sizes[:, None]
        largest = np.maximum(largest, there.max(axis=1))
        return np.asarray(there.max(axis=0))

    worst = np.argsort(-each.max(axis=0))[:_CLIMBERS]
    heights = each[:, worst].max(axis=0)
    climbed(difference, points[:, worst].T, heights, np.array(intervals), _TO_DIFFERENCES)
    return np.asarray(largest)


def _next(low: float, high: float) -> float:
    """A tolerance between one that is small enough and one that is not, 0 if it is not known."""
    if low and high:
        return math.sqrt(low * high)
    return 2.0 * low if low else 0.3 * high


def _points(slabs: Sequence[SlabTrain], intervals: Sequence[tuple[float, float]]) -> Array:
    """Random points (coordinates, N), where trains differ most among them.

    A third is anywhere, a third on faces and edges of the box, a third at its corners; a half is at
    the ends of slabs.
    """
    rng = np.random.default_rng(0)
    ends = np.array(intervals)
    shares = rng.random((len(ends), _POINTS))
    at_ends = rng.random(shares.shape) < np.repeat(_AT_ENDS, _POINTS // len(_AT_ENDS))
    shares = np.where(at_ends, np.round(shares), shares)
    points = np.clip(ends[:, :1] + shares * np.diff(ends), ends[:, :1], ends[:, 1:])
    edges = np.clip([edge for slab in slabs for edge in (slab.start, slab.end)], *ends[0])
    points[0, ::2] = rng.choice(edges, _POINTS // 2)
    return points


def _smaller(run: Sequence[SlabTrain], sizes: Array, tolerance: float) -> list[SlabTrain]:
    """Slabs that share the cores of their parameters, within a tolerance in the mean square.

    They are one train, whose first core has the polynomials of all of them.
    """
    first = np.concatenate([slab.cores[0] for slab in run], axis=1) / sizes[:, None, None]
    share = np.sqrt(0.5) * tolerance
    cores = thinned(rounded([first, *run[0].cores[1:]], share), share)
    counts = np.cumsum([slab.cores[0].shape[1] for slab in run])
    parts = np.split(cores[0] * sizes[:, None, None], counts[:-1], axis=1)
    return [replace(slab, cores=(part, *cores[1:])) for slab, part in zip(run, parts, strict=True)]
