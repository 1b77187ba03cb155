"""Steps of trajectories, and the pieces into which they are halved where something may hide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.discretization.radau import insets
from rankone.support.arrays import Array
from rankone.trajectories.paths import NODES, Path, step_coefficients

CHANGED = 0.01
"""Part of a rate by which it changes where a state may stay behind, or run ahead, for long."""

HALVINGS = 42
"""Most halvings of a step: then it is about as short as rounding."""
_MOST_PIECES = (20_000, 20)  # Pieces looked at, at most: once, and for each step
_LEAST_TRAJECTORIES = 4  # That are looked at where there are too many pieces
_TOGETHER = 4096  # Pieces evaluated together: what is in work fits the cache
# From values at all nodes but the last one to that one
_BASIS = np.vander(2.0 * NODES[:-1] - 1.0, increasing=True)
_LAST = np.vander([1.0], NODES.size - 1, increasing=True) @ np.linalg.inv(_BASIS)


@dataclass(frozen=True)
class Pieces:
    """Parts of steps, by the share where each begins and its length, all (N,)."""

    step: NDArray[np.intp]
    lower: Array
    length: Array

    @classmethod
    def whole(cls, count: int) -> Pieces:
        """So many whole steps."""
        return cls(np.arange(count), np.zeros(count), np.ones(count))

    @classmethod
    def joined(cls, each: Sequence[Pieces]) -> Pieces:
        """Some after the others."""
        return cls(
            np.concatenate([pieces.step for pieces in each]),
            np.concatenate([pieces.lower for pieces in each]),
            np.concatenate([pieces.length for pieces in each]),
        )

    @property
    def shares(self) -> Array:
        """Shares (nodes, N) of steps at the nodes of pieces."""
        return np.asarray(self.lower + self.length * NODES[:, None])

    def some(self, chosen: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Pieces:
        """Some of them."""
        return Pieces(self.step[chosen], self.lower[chosen], self.length[chosen])

    def halves(self) -> Pieces:
        """The first halves of all, and then the second ones."""
        half = 0.5 * self.length
        lower = np.concatenate([self.lower, self.lower + half])
        return Pieces(np.tile(self.step, 2), lower, np.tile(half, 2))


@dataclass(frozen=True)
class Steps:
    """Steps from times (S,), their lengths, states (S, nodes, n) and parameters (d, S).

    ``owners`` (S,) are the positions of their trajectories, whose ends are ``left`` (S,) later.
    """

    starts: Array
    lengths: Array
    nodal: Array
    parameters: Array
    owners: NDArray[np.intp]
    left: Array

    @classmethod
    def of(
        cls, jumps: Sequence[float], paths: Sequence[Path], owners: Sequence[int], points: Array
    ) -> Steps:
        """All steps of paths; they leave out what is reset at jumps."""
        starts = np.concatenate([path.breaks[:-1] for path in paths])
        ends = np.concatenate([path.breaks[1:] for path in paths])
        nodal = np.concatenate([path.nodal for path in paths])
        before_jump = np.isin(ends, jumps)
        nodal[before_jump, -1] = np.tensordot(nodal[before_jump, :-1], _LAST[0], axes=(1, 0))
        of_steps = np.repeat(owners, [path.steps for path in paths])
        near = insets(starts, ends)
        parameters = np.ascontiguousarray(points[of_steps].T)
        last = np.full(len(points), -np.inf)
        np.maximum.at(last, of_steps, ends)
        lengths, left = ends - starts - 2.0 * near, last[of_steps] - starts
        return cls(starts + near, lengths, nodal, parameters, of_steps, left)

    def before(self, end: float) -> Steps:
        """Those that begin before an end."""
        early = self.starts < end
        return Steps(
            self.starts[early],
            self.lengths[early],
            self.nodal[early],
            self.parameters[:, early],
            self.owners[early],
            self.left[early],
        )

    def times(self, step: NDArray[np.intp] | int, shares: Array) -> Array:
        """Times (..., N) at shares (..., N) of steps (N,), or of one step."""
        return np.asarray(self.starts[step] + self.lengths[step] * shares)

    def time(self, step: int, share: float) -> float:
        """The time at a share of a step."""
        return float(self.starts[step] + self.lengths[step] * share)

    def following(self, step: int) -> int | None:
        """The step of the same trajectory that begins where one ends, if there is one."""
        further = step + 1
        if further >= self.starts.size or self.owners[further] != self.owners[step]:
            return None
        between = self.starts[further] - self.time(step, 1.0)
        insets_at_most = 0.5 * (self.lengths[step] + self.lengths[further])
        return further if 0.0 <= between <= insets_at_most else None

    def states(self, step: NDArray[np.intp], shares: Array) -> Array:
        """States (n, K, N) at shares (K, N) of steps (N,)."""
        powers = np.vander((2.0 * shares - 1.0).ravel(), NODES.size, increasing=True)
        powers = powers.reshape(*shares.shape, -1)
        return np.asarray(np.einsum("kpq,qpn->nkp", powers, step_coefficients(self.nodal[step])))

    def at(self, pieces: Pieces) -> tuple[Array, Array]:
        """Times (nodes, N) and states (n, nodes, N) at the nodes of pieces."""
        times = self.times(pieces.step, pieces.shares)
        if (pieces.length == 1.0).all():
            return times, np.ascontiguousarray(self.nodal[pieces.step].transpose(2, 1, 0))
        return times, self.states(pieces.step, pieces.shares)


class Allowance:
    """How many pieces may be looked at of steps whose trajectories are ``owners`` (S,)."""

    def __init__(self, owners: NDArray[np.intp]) -> None:
        self._owners, self._looked = owners, 0
        once, each = _MOST_PIECES
        self._most = once + each * owners.size

    def going_on(self, pieces: Pieces) -> slice | NDArray[np.bool_] | None:
        """Which pieces may be looked at next; None where these are still too many.

        Where all are too many, those of every second trajectory go on, down to a few.
        """
        self._looked += pieces.step.size
        if self._looked <= self._most:
            return slice(None)
        owners = self._owners[pieces.step]
        distinct = np.unique(owners)
        if distinct.size <= _LEAST_TRAJECTORIES:
            return None
        self._most += self._most // 4
        return np.isin(owners, distinct[::2])


def blocks(count: int) -> list[slice]:
    """Parts of so many pieces that are evaluated together."""
    return [slice(a, a + _TOGETHER) for a in range(0, count, _TOGETHER)]


@dataclass(frozen=True)
class Place:
    """Part of a step, and the function that surprised there at a share, by so many tolerances."""

    step: int
    lower: float
    length: float
    share: float
    row: int = 0
    surprise: float = 0.0
