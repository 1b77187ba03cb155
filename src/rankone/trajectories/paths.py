"""Paths: trajectories that each have steps of their own, as piecewise polynomials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import Cost

_DEGREE = 6  # Degree of the polynomial of a step: further terms of LSODA's own are tiny
NODES = 0.5 - 0.5 * np.cos(np.pi * np.arange(_DEGREE + 1) / _DEGREE)
"""Chebyshev–Lobatto nodes of a step, as shares, the first one zero and the last one one."""
# From states at the nodes to coefficients of the powers of 2 share - 1
_TO_POWERS = np.linalg.inv(np.vander(2.0 * NODES - 1.0, increasing=True))
_READ_COST = Cost(60e3, 40.0)  # Operations of evaluating steps: once, and for each state


@dataclass(frozen=True)
class Path:
    """One trajectory from the first of the ``breaks`` (S + 1,) to the last of them.

    ``nodal`` are the states (S, nodes, n) at the nodes of the steps, ``state`` is the last one.
    """

    breaks: Array
    nodal: Array
    state: Array

    @property
    def end(self) -> float:
        return float(self.breaks[-1])

    @property
    def steps(self) -> int:
        return len(self.nodal)

    @cached_property
    def coefficients(self) -> Array:
        """Of the powers of ``2 share - 1``, (nodes, S, n)."""
        return step_coefficients(self.nodal)

    def __call__(self, times: Array) -> Array:
        """States (n, T), after a jump at its time."""
        charge(_READ_COST(times.size * self.state.size))
        place = np.searchsorted(self.breaks, times, side="right") - 1
        place = np.clip(place, 0, self.steps - 1)
        width = np.diff(self.breaks)[place]
        share = (2.0 * (times - self.breaks[place]) / width - 1.0)[:, None]
        states = self.coefficients[-1, place]
        for coefficient in self.coefficients[-2::-1]:
            states = states * share + coefficient[place]
        return np.asarray(states.T)

    def largest(self, steps: int | None = None) -> Array:
        """Largest absolute values after any of the first steps, (n,)."""
        return np.asarray(np.abs(self.nodal[:steps, -1]).max(axis=0, initial=0.0))

    def until(self, time: float, state: Array) -> Path:
        """The path up to a time, where it has a state (n,)."""
        steps = int(np.searchsorted(self.breaks, time, side="left"))
        breaks = np.append(self.breaks[:steps], time)
        if steps == 0:
            return Path(breaks[-1:], self.nodal[:0], state)
        nodal = self.nodal[:steps].copy()
        times = breaks[-2] + (time - breaks[-2]) * NODES
        nodal[-1] = self(times).T
        return Path(breaks, nodal, state)

    def over_times(self, start: float, end: float) -> Path:
        """A path over the share of the way as one over times.

        One that went all the way ends at the very end.
        """
        breaks = start + (end - start) * self.breaks
        return replace(self, breaks=np.where(self.breaks == 1.0, end, breaks))


def step_coefficients(nodal: Array) -> Array:
    """Coefficients (nodes, S, n) of the powers of ``2 share - 1`` of steps (S, nodes, n)."""
    return np.asarray(np.tensordot(_TO_POWERS, nodal, axes=(1, 1)))


def joined(paths: Sequence[Path]) -> Path:
    """Paths that follow each other, as one; there is at least one."""
    breaks = [paths[0].breaks, *(path.breaks[1:] for path in paths[1:])]
    nodal = np.concatenate([path.nodal for path in paths])
    return Path(np.concatenate(breaks), nodal, paths[-1].state)
