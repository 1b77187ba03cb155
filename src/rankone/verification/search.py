"""Searches for the worst points of a box: climbing by random steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rankone.support.arrays import Array


@dataclass(frozen=True)
class Climb:
    """Rounds of random steps that become shorter, with ``tries`` steps for each climber.

    ``first_step`` is their first standard deviation, in widths of the box, and ``shrinkage`` the
    factor on it from round to round; a ``patient`` climber applies it only without success.
    """

    rounds: int
    tries: int
    first_step: float
    shrinkage: float
    patient: bool = False
    seed: int = 20147


def climbed(
    height: Callable[[Array], Array], points: Array, heights: Array, bounds: Array, climb: Climb
) -> tuple[Array, Array]:
    """Points (m, d) of a box (d, 2) to which climbers come from given ones, and the heights there.

    ``height`` maps points (N, d) to heights (N,), none of them NaN.
    """
    lower, upper = bounds.T
    generator = np.random.default_rng(climb.seed)
    climbers = np.arange(len(points))
    step = np.full((len(points), 1), climb.first_step)
    for _ in range(climb.rounds):
        moves = generator.standard_normal((climb.tries, *points.shape)) * step * (upper - lower)
        moves *= generator.random(moves.shape) < 0.5  # some coordinates stay, such as at an end
        tried = np.clip(points + moves, lower, upper)
        reached = height(tried.reshape(-1, points.shape[1])).reshape(climb.tries, -1)
        best = reached.argmax(axis=0)
        higher = reached[best, climbers] > heights
        points = np.where(higher[:, None], tried[best, climbers], points)
        heights = np.where(higher, reached[best, climbers], heights)
        step = np.where(higher[:, None] & climb.patient, step, climb.shrinkage * step)
    return points, heights
