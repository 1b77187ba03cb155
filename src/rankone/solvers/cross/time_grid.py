"""The time axis of sampled trajectories: slabs that resolve the reference, and their nodes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial.legendre import leggauss

from rankone.discretization import Basis1D, legendre_values
from rankone.support.arrays import Array
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train

__all__ = ["TimeGrid", "resolving_breaks"]

_SHORTEST = 1e-12
"""Shortest slab, relative to its times: only near t = 0 fast layers have room."""
_SHORTEST_OF_ALL = 1e-18
"""The same, relative to the horizon."""
_PROBES = np.array([-0.999999, -0.97, -0.31, 0.42, 0.98, 0.999999])
"""Where interpolation in time is tried, on [-1, 1]: beside the ends, where it may jump."""


@lru_cache
def _nodes(count: int) -> tuple[Array, Array]:
    """Gauss-Legendre nodes on [-1, 1], and the matrix from values there to coefficients."""
    xi, _ = leggauss(count)
    return xi, np.asarray(np.linalg.inv(legendre_values(xi, count)))


@dataclass(frozen=True)
class TimeGrid:
    """Gauss-Legendre nodes on consecutive slabs.

    Attributes
    ----------
    breaks : tuple of float
        Ends of the slabs, ascending.
    count : int
        Nodes on each slab.
    """

    breaks: tuple[float, ...]
    count: int

    @property
    def slabs(self) -> int:
        """Number of slabs."""
        return len(self.breaks) - 1

    @cached_property
    def times(self) -> Array:
        """Nodes of all slabs, ascending, shape (T,)."""
        xi = 0.5 * (_nodes(self.count)[0] + 1.0)
        return np.concatenate([a + (b - a) * xi for a, b in itertools.pairwise(self.breaks)])

    def highest_modes(self, values: Array) -> Array:
        """Largest of the last two Legendre modes of values (n, T, m) on each slab: (slabs,)."""
        _, to_modal = _nodes(self.count)
        local = values.reshape(len(values), self.slabs, self.count, -1)
        return np.asarray(np.abs(to_modal[-2:] @ local).max(axis=(0, 2, 3), initial=0.0))

    def trains(self, train: Train, bases: Sequence[Basis1D]) -> list[SlabTrain]:
        """One train for each slab, from a train whose core 0 has states at the nodes, (n, T, r)."""
        _, to_modal = _nodes(self.count)
        trains = []
        for k, (a, b) in enumerate(itertools.pairwise(self.breaks)):
            local = to_modal @ train.first[:, k * self.count : (k + 1) * self.count]
            trains.append(SlabTrain(a, b, train.with_first(local), tuple(bases)))
        return trains


def resolving_breaks(
    values: Callable[[Array], Array],
    edges: Sequence[float],
    count: int,
    tolerance: float,
    most: int,
) -> tuple[float, ...] | None:
    """Ends of slabs on which ``count`` nodes resolve functions of time; None if too many.

    Slabs are halved until the polynomial through the nodes is close at the ends and in between.

    Parameters
    ----------
    values : callable
        Functions in units of their sizes at times (T,): shape (..., T).
    edges : sequence of float
        Start, times that no slab crosses, end.
    count : int
    tolerance : float
    most : int
        Largest number of slabs.
    """
    xi, to_modal = _nodes(count)
    at_probes = legendre_values(_PROBES, count) @ to_modal
    inside = 0.5 * (np.concatenate([xi, _PROBES]) + 1.0)
    waiting = list(itertools.pairwise(edges))
    done: list[tuple[float, float]] = []
    horizon = edges[-1] - edges[0]
    while waiting:
        if len(waiting) + len(done) > most:
            return None
        times = np.concatenate([a + (b - a) * inside for a, b in waiting])
        found = values(times).reshape(-1, len(waiting), inside.size)
        missed = np.abs(found[..., count:] - found[..., :count] @ at_probes.T).max(axis=(0, 2))
        halves = []
        for (a, b), error in zip(waiting, missed, strict=True):
            shortest = max(_SHORTEST * max(abs(a), abs(b)), _SHORTEST_OF_ALL * horizon)
            if error <= tolerance or b - a < shortest:
                done.append((a, b))
            else:
                halves += [(a, 0.5 * (a + b)), (0.5 * (a + b), b)]
        waiting = halves
    return (*(a for a, _ in sorted(done)), edges[-1])
