"""What a solve keeps of trajectories in place of their states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError


@dataclass(frozen=True, eq=False)
class Observation:
    """Quantities of states, time and parameters along trajectories.

    ``rows`` are the states that they read. ``values`` takes times (T, 1), these states (k, T, m)
    and parameters (d, m), and gives for each quantity what broadcasts to (T, m). ``texts`` are
    their definitions. They may be ``states_alone``: some of the states, as they are. ``surfaces``,
    of the same arguments, vanish in the middle of what is narrow or steep in them, and at kinks.
    """

    names: tuple[str, ...]
    texts: tuple[str, ...]
    rows: tuple[int, ...]
    values: Callable[[Array, Array, Array], Sequence[Array] | Array]
    states_alone: bool = False
    surfaces: Callable[[Array, Array, Array], Sequence[Array]] | None = None

    @classmethod
    def of_some(cls, states: Sequence[str], rows: Sequence[int]) -> Observation:
        """Some of the states, by position."""
        names = tuple(states[row] for row in rows)
        return cls(names, names, tuple(rows), lambda times, seen, points: seen, True)

    def of_states(self, times: Array, states: Array, points: Array) -> Array:
        """The quantities (q, m, T) of all states (n, m, T) at times (T,), points (m, d)."""
        return self.of_rows(times, states[list(self.rows)].swapaxes(1, 2), points).swapaxes(1, 2)

    def of_rows(self, times: Array, states: Array, points: Array) -> Array:
        """The quantities (q, T, m) of the states that they read (k, T, m).

        An EvaluationError says which is not finite somewhere.
        """
        with np.errstate(all="ignore"):
            quantities = self.values(times[:, None], states, points.T)
        shape = times.size, len(points)
        sampled = np.array([np.broadcast_to(quantity, shape) for quantity in quantities], float)
        if not np.isfinite(sampled).all():
            which = int(np.argmin(np.isfinite(sampled).all(axis=(1, 2))))
            at = times[int(np.argmin(np.isfinite(sampled[which]).all(axis=1)))]
            raise EvaluationError(
                f"`{self.texts[which]}` is not finite on a trajectory, at t = {at:.6g}",
                term=self.names[which],
                remedy="change the output, or the box, so that it is finite everywhere",
            )
        return sampled

    def surfaces_at(self, times: Array, states: Array, points: Array) -> Array:
        """The surfaces (s, m, T) of all states (n, m, T) at times (T,), points (m, d)."""
        assert self.surfaces is not None
        read = states[list(self.rows)].swapaxes(1, 2)
        with np.errstate(all="ignore"):
            surfaces = self.surfaces(times[:, None], read, points.T)
        shape = times.size, len(points)
        return np.array([np.broadcast_to(each, shape).T for each in surfaces], float)
