"""How far each parameter can go from an optimum within the bounds, by trajectories.

Profile likelihoods: a parameter is held away from the optimum, and the others go down from where
they would be if the model were linear. So nothing is held that the data do not determine, and no
box around the optimum is needed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rankone.inference.calibration.descent import Expansion, bounded_step
from rankone.inference.calibration.linearised import (
    Reach,
    covariance_at,
    limited_by,
    linear_reaches,
    unidentified,
)
from rankone.inference.calibration.searched import OfExperiments
from rankone.inference.estimation.free_parameters import ends_at_bounds
from rankone.inference.estimation.identification import between
from rankone.support.arrays import Array

_CLOSE = 1e-2  # How close an end comes to the limit, in shares of half the interval: two digits
_MOST_POINTS = 12  # Most places of a parameter at which the others go down, for one end
_MOST_STEPS = 12  # Most steps of each way down
_RADIUS = 0.1  # Half the width of the first box of trust
_LEAST_RADIUS = 1e-6
_MOST_GROWTH = 3.0  # Most growth of a distance in one step outwards
_HELD = 0.1  # Share of the rise at an end that bounds of others make, from which they are named


class _End(NamedTuple):
    """Where an interval ends in z: at a bound, or with another parameter newly at one.

    An ``other`` end is not told by the data alone: also one beyond which trajectories fail.
    Bounds of ``others`` make it end before the data would.
    """

    z: float
    bound: bool
    other: bool
    others: tuple[str, ...] = ()


def profile_reaches(problem: OfExperiments, at: Expansion) -> dict[str, Reach]:
    """How far each parameter can go from an optimum with 95 %; levels of noise by linearisation.

    Not identified are those whose variance the data hardly reduce and that only bounds stop. An
    end from which the way of another parameter leads further, within the limit, is taken up there:
    a descent does not leave a valley that is flat and long.
    """
    variance = problem.variance(at)
    covariance = covariance_at(at, variance)
    wide = unidentified(problem.names, np.sqrt(np.diag(covariance)))
    reaches = linear_reaches(problem.names, at, variance)
    inside = [at]
    ways = [
        (j, sign)
        for j in range(len(problem.names))
        if j not in problem.likelihood.levels
        for sign in (-1.0, 1.0)
    ]
    ends = {way: _end(problem, at, covariance, way, at, inside) for way in ways}
    for way in ways:
        (j, sign), end = way, ends[way].z
        farthest = max(inside, key=lambda point: sign * float(point.z[j]))
        if sign * (farthest.z[j] - end) > _CLOSE * abs(end - at.z[j]):
            ends[way] = _end(problem, at, covariance, way, farthest, inside)
    for j, name in enumerate(problem.names):
        if (j, 1.0) in ends:
            low, high = ends[j, -1.0], ends[j, 1.0]
            limited = limited_by(low.bound, high.bound)
            boxed = (low.bound or low.other) and (high.bound or high.other)
            free = limited == "both" or (name in wide and boxed)
            others = {*low.others, *high.others}
            names = tuple(name for name in problem.names if name in others)
            reaches[name] = Reach(low.z, high.z, limited, free, names)
    return reaches


def _end(
    problem: OfExperiments,
    best: Expansion,
    covariance: Array,
    way: tuple[int, float],
    point: Expansion,
    inside: list[Expansion],
) -> _End:
    """Where the rise of the cost reaches the limit in one direction, or the bound.

    The ``way`` is a parameter and a sign. It begins at a ``point``, and what it passes ``inside``
    the limit is added to the others.
    """
    (j, sign), limit = way, problem.rise(best)
    along = sign * covariance[j] / covariance[j, j]
    room = float(best.z[j]) if sign < 0.0 else 1.0 - float(best.z[j])
    inner = (sign * float(point.z[j] - best.z[j]), _root(point, best, limit))
    outer = (math.inf, math.inf)
    at_bound = set(ends_at_bounds(problem.names, best.z))
    last = beyond = point
    distance = inner[0] + problem.quantile * math.sqrt(covariance[j, j]) * (1.0 - inner[1])
    distance = min(max(distance, 1e-6), room)
    for turn in range(_MOST_POINTS):
        start = np.clip(point.z + (distance - inner[0]) * along, 0.0, 1.0)
        start[j] = np.clip(best.z[j] + sign * distance, 0.0, 1.0)
        last = _settled(problem, start, j, _CLOSE * limit)
        root = _root(last, best, limit)
        if root <= 1.0:
            inner, point = (distance, root), last
            inside.append(last)
            if distance >= room:
                return _End(0.0 if sign < 0.0 else 1.0, True, False)
        else:
            outer, beyond = (distance, root), last
        if abs(root - 1.0) <= _CLOSE:
            beyond = last
            break
        if math.isinf(outer[0]):
            beyond = last
            growth = min(max(1.0 / max(root, 0.1), 1.1), _MOST_GROWTH)
            distance = min(max(growth * distance, 1e-6), room)
        else:
            distance = between(inner, outer, turn)
    else:  # not as close: a place beyond the limit, unless trajectories fail there
        last = beyond
    told = abs(root - 1.0) <= _CLOSE or math.isfinite(outer[1])
    names = set(ends_at_bounds(problem.names, beyond.z)) - at_bound - {problem.names[j]}
    others = _beyond_bounds(problem, beyond, j, limit)
    return _End(float(last.z[j]), False, bool(names) or not told, others)


def _root(at: Expansion, best: Expansion, limit: float) -> float:
    """The root of the rise of the cost over the limit."""
    return math.sqrt(max(at.cost - best.cost, 0.0) / limit)


def _beyond_bounds(problem: OfExperiments, at: Expansion, j: int, limit: float) -> tuple[str, ...]:
    """Parameters at a bound that would go beyond it with one held, and lower the cost by much.

    Much is a share of the ``limit``.
    """
    if not np.isfinite(at.cost):
        return ()
    rest = np.delete(np.arange(at.z.size), j)
    slope = (at.jacobian.T @ at.residuals)[rest]
    variance = problem.variance(at)
    covariance = np.linalg.inv(np.linalg.inv(covariance_at(at, variance))[np.ix_(rest, rest)])
    step = -covariance @ slope / variance
    if -float(slope @ step) <= _HELD * limit:
        return ()
    ends = ends_at_bounds(problem.names, at.z)
    sides = {"lower": -1.0, "upper": 1.0}
    return tuple(
        name
        for name, move in zip(np.array(problem.names)[rest].tolist(), step, strict=True)
        if name in ends and move * sides[ends[name]] > 0.0
    )


def _settled(problem: OfExperiments, z: Array, j: int, enough: float) -> Expansion:
    """The best point with one coordinate held, from z (n,)."""
    held = np.arange(z.size) == j
    at, radius = problem.expanded(z, held), _RADIUS
    for _ in range(_MOST_STEPS):
        if not np.isfinite(at.cost):
            break
        step, promised = bounded_step(at, np.where(held, 0.0, radius))
        if promised <= enough or radius <= _LEAST_RADIUS:
            break
        trial = problem.expanded(np.clip(at.z + np.where(held, 0.0, step), 0.0, 1.0), held)
        better = trial.cost < at.cost
        radius = min(2.0 * radius, 1.0) if better else 0.25 * float(np.abs(step[~held]).max())
        at = trial if better else at
    return at
