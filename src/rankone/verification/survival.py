"""Where a box would have to end for all of its trajectories to reach the end of the horizon."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rankone.ir.domain import Domain
from rankone.ir.outcome import SafeInterval
from rankone.ir.system import System
from rankone.ir.verdict import Status
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, limited, work_left
from rankone.support.errors import ConvergenceError
from rankone.support.wording import quote
from rankone.verification.reference import check_points, integrate_reference
from rankone.verification.search import bisected

__all__ = ["PARTS", "safe_intervals", "safe_sentence", "solved_part"]

_ACCURACY, _ON_FACE = 1e-3, 8
"""Tolerance of the trajectories, and how many of them begin inside of a face of the box."""
_HALVINGS = 7
"""Halvings between an end of the box and the trajectory that has no end."""
_WORK, _SHARE = 1.5e9, 0.5
"""Most operations, and most of those that are left."""
_DIGITS = 100.0
"""Parts of an interval that a number in a message tells apart."""
_KEPT = (0.95, 0.8, 0.5)
"""Parts of safe intervals to solve on: near their ends the values are very large."""
PARTS = 4
"""Most boxes to solve on."""


def safe_intervals(
    system: System, domain: Domain, cuts: Sequence[float], point: Array
) -> tuple[SafeInterval, ...]:
    """Intervals of single parameters whose faces have trajectories that reach the end.

    From each end of a parameter's interval, as long as no trajectory on that face of the box has
    an early end, towards ``point``, whose trajectory has one, by bisection. Only a solve on the
    smaller box shows whether all of it is safe.

    Parameters
    ----------
    cuts : sequence of float
        Times at which integrations begin anew.
    point : ndarray (d,)

    Returns
    -------
    tuple of SafeInterval
        At most two for a parameter; the one that keeps most of the box first.
    """
    found: list[SafeInterval] = []
    try:
        with limited(min(_WORK, _SHARE * work_left())):
            found.extend(_intervals(system, domain, cuts, point))
    except OutOfBudgetError:
        pass  # those that were found so far
    return tuple(sorted(found, key=lambda interval: -interval.share))


def _intervals(
    system: System, domain: Domain, cuts: Sequence[float], point: Array
) -> Iterator[SafeInterval]:
    """The intervals, those first that may keep most of the box; none that keep less than others."""
    bounds, largest = domain.bounds, 0.0
    width = bounds[:, 1] - bounds[:, 0]
    ends = [(j, side) for j in range(len(bounds)) for side in (0, 1)]
    most = {(j, side): abs(point[j] - bounds[j, side]) / width[j] for j, side in ends}
    for j, side in sorted(ends, key=lambda end: -most[end]):
        if most[j, side] <= largest:
            return
        others = check_points(np.delete(bounds, j, axis=0), _ON_FACE)
        others = np.concatenate([others, np.delete(point, j)[None]])

        def survives(place: Array, j: int = j, others: Array = others) -> NDArray[np.bool_]:
            face = np.insert(others, j, place.item(), axis=1)
            try:
                ends = integrate_reference(system, face, *domain.horizon, _ACCURACY, cuts)
            except ConvergenceError:
                return np.array([False])
            return np.array([ends.blown is None])

        if not survives(bounds[j, side]).all():
            continue
        border, lost = bounds[j, side].reshape(1, 1), point[j].reshape(1, 1)
        safe = bisected(border, lost, survives, _HALVINGS)[0].item()
        share = abs(safe - bounds[j, side]) / width[j]
        if share > largest:
            largest = share
            lower, upper = sorted((float(bounds[j, side]), safe))
            yield SafeInterval(j, lower, upper, below=side == 0, share=float(share))


def safe_sentence(intervals: Sequence[SafeInterval], names: Sequence[str]) -> str:
    """What a user reads of the best interval: "`k` below 1.83 would do"; empty without any."""
    if not intervals:
        return ""
    best = intervals[0]
    step = 10.0 ** math.floor(math.log10((best.upper - best.lower) / _DIGITS))
    end = best.upper if best.below else best.lower
    rounded = (math.floor if best.below else math.ceil)(end / step) * step
    return f"{quote(names[best.parameter])} {'below' if best.below else 'above'} {rounded:.10g}"


def solved_part(
    solve: Callable[[int, tuple[float, float]], Any], intervals: Sequence[SafeInterval]
) -> Any:
    """The solution on the largest of the smaller boxes on which a solve succeeds, or None.

    Parameters
    ----------
    solve : callable
        Solves with another interval of one parameter; may raise a ConvergenceError.
    """
    candidates = [interval.shortened(kept) for interval in intervals for kept in _KEPT]
    for interval in sorted(candidates, key=lambda each: -each.share)[:PARTS]:
        try:
            solution = solve(interval.parameter, (interval.lower, interval.upper))
        except ConvergenceError:
            continue
        if solution.status in (Status.CONVERGED, Status.UNCHECKED):
            return solution
    return None
