"""Where predictions jump inside the intervals of a fit: an event passes a time of the data."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.likelihood import Likelihood
from rankone.support.arrays import Array

_STEPS = 40  # Steps along an interval
# Change of a prediction in one step, beyond what its derivative says, that is a jump: in standard
# deviations of the datum
_JUMP = 0.3
_BISECTIONS = 20  # Of such a step, after which what is smooth changes by a millionth as much


class Jump(NamedTuple):
    """A parameter, and the time of the data at which a prediction jumps in its interval."""

    parameter: str
    time: float


def jumps_within(problem: Likelihood, z: Array, root: Array, jacobian: Array) -> tuple[Jump, ...]:
    """The first jump along the interval of each parameter.

    ``root`` (n, r) is a root of the covariance in z times half the length of intervals in standard
    deviations, ``jacobian`` (r, n) that of the pseudo-residuals. Only events make jumps.
    """
    if all(trial.solution.outcome.timeline is None for trial in problem.trials):
        return ()
    rows = np.concatenate([np.arange(here.start, here.stop) for _, _, here in problem.blocks])
    times = np.concatenate([t.observations.times for t in problem.trials])
    jumps = []
    for j, name in enumerate(problem.free.names):
        length = float(np.linalg.norm(root[j]))
        if not 0.0 < length < np.inf:
            continue
        way = root @ root[j] / length
        line = np.clip(z + np.linspace(-1.0, 1.0, _STEPS + 1)[:, None] * way, 0.0, 1.0)
        change = np.abs(np.diff(problem.standardised(line), axis=0))
        expected = np.abs(jacobian[rows] @ np.diff(line, axis=0).T).T
        steep = np.nan_to_num(change - expected, nan=0.0)
        data = np.flatnonzero(steep.max(axis=0) > _JUMP)
        if not data.size:
            continue
        steps = np.argmax(steep[:, data], axis=0)
        sizes = _sizes(problem, line[steps], line[steps + 1], data)
        if sizes.max() > _JUMP:
            jumps.append(Jump(name, float(times[data[int(np.argmax(sizes))]])))
    return tuple(jumps)


def _sizes(problem: Likelihood, a: Array, b: Array, data: NDArray[np.intp]) -> Array:
    """How far predictions of some ``data`` (k,) jump on steps from a to b (k, n).

    Each step is halved where the prediction changes most: what is smooth does not change in the
    end.
    """
    at_a, at_b = (_of_data(problem, each, data) for each in (a, b))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (a + b)
        at = _of_data(problem, middle, data)
        first = np.abs(at - at_a) >= np.abs(at_b - at)
        a, b = np.where(first[:, None], a, middle), np.where(first[:, None], middle, b)
        at_a, at_b = np.where(first, at_a, at), np.where(first, at, at_b)
    return np.nan_to_num(np.abs(at_b - at_a))


def _of_data(problem: Likelihood, points: Array, data: NDArray[np.intp]) -> Array:
    """The deviation (k,) of one datum at each of the points (k, n)."""
    return np.asarray(problem.standardised(points)[np.arange(data.size), data])
