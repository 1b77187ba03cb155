"""Where predictions jump inside the intervals of a fit: an event passes a time of the data."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rankone.estimation.likelihood import Likelihood
from rankone.support.arrays import Array

_STEPS = 40  # Steps along an interval
# Change of a prediction in one step, beyond what its derivative says, that is a jump: in standard
# deviations of the datum
_JUMP = 0.3


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
        steep = np.nan_to_num(change - expected, nan=0.0).max(axis=0)
        if steep.max(initial=0.0) > _JUMP:
            jumps.append(Jump(name, float(times[int(np.argmax(steep))])))
    return tuple(jumps)
