"""Stacked trajectories on a time grid, held as coefficients in a growing orthonormal basis."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from rankone.ir.system import System
from rankone.solvers.cross.time_grid import TimeGrid
from rankone.support.arrays import Array
from rankone.support.budget import work_done
from rankone.tensors.samples import GrowingBasis
from rankone.trajectories.diagnosis import first_to_end
from rankone.trajectories.integrator import Integrator, Tolerances
from rankone.trajectories.stacks import StackedIntegrator
from rankone.trajectories.workers import Workers
from rankone.verification.measure import ReferenceSet

__all__ = ["TooManyTrajectories", "Trajectories", "TrajectoryEnds"]

_FEWEST, _STACKED, _STACKED_STIFF, _STACKED_USER = 32, 1500, 300, 64
"""Trajectories integrated together: at least, at most by explicit and by implicit steps, and at
most with functions of the user, which may be slow."""
_STACKED_STATES = 15_000
"""States of a stack that fits the cache."""
_CALIBRATED, _CALIBRATIONS = 8, 3
"""Reference points at which the error of the integration is measured, and how often at most."""
_STIFF = 1.5
"""Tolerance of stiff integrations over the error wanted."""
_UNMOVED = 0.5
"""Part of an error that a smaller tolerance leaves, from which on it is not the integration's."""
_BEARABLE = 400
"""So many explicit steps cost less than the implicit ones that would replace them."""
_TIGHTEST = 1e-13
_ABSOLUTE = 1e-5
"""Absolute tolerance of the integration in units of each state's size, over the relative one."""


class TooManyTrajectories(Exception):
    """The limit of trajectories was met."""


class TrajectoryEnds(Exception):
    """The trajectory at a point (d,) cannot be integrated to the end; ``time`` is how far."""

    def __init__(self, time: float, point: Array) -> None:
        super().__init__(time, point)
        self.time, self.point = time, point


class Trajectories:
    """Trajectories at parameter points, in units of the states' sizes.

    A trajectory is a vector (state, time node), scaled so that its norm is the root mean square
    over the nodes; what the basis misses of it is below the tolerance.

    Parameters
    ----------
    reference_set : ReferenceSet
    grid : TimeGrid
    wanted : float
        Largest error of the integration in units of sizes.
    tightness : float
        Tolerance of the integration and of the basis over that error, to begin with. Together with
        the first trajectories some of the reference are integrated, whose error then sets it.
    most : int
        Largest number of trajectories.
    workers : Workers, optional
        Where they are integrated.
    done : callable, optional
        Told the part of those that were asked for that is done, batch after batch.

    Attributes
    ----------
    work : float
        Operations that the trajectories took.
    highest : ndarray (slabs,)
        Largest of the highest modes in time of all trajectories.
    """

    def __init__(
        self,
        reference_set: ReferenceSet,
        grid: TimeGrid,
        wanted: float,
        tightness: float,
        most: int,
        workers: Workers | None = None,
        done: Callable[[float], None] | None = None,
    ) -> None:
        self.workers, self.done = workers or Workers(reference_set.system), done
        self.reference_set, self.grid, self.wanted, self.most = reference_set, grid, wanted, most
        self.stiff = self.calibrated = reference_set.reference.avoided > _BEARABLE
        self.tightness = _STIFF if self.stiff else tightness
        self.count, self.work = 0, 0.0
        self.units = reference_set.states * np.sqrt(grid.times.size)
        self.basis = GrowingBasis(self.units.size * grid.times.size)
        self.highest = np.zeros(grid.slabs)

    def __call__(self, points: Array) -> Array:
        """Coefficients of the trajectories at points (m, d): shape (rank of the basis, m)."""
        if self.count + len(points) > self.most:
            raise TooManyTrajectories
        found = self._integrated(points) if self.calibrated else self._first(points)
        self.count += len(points)
        highest = self.grid.highest_modes(self._in_sizes(found))
        self.highest = np.maximum(self.highest, highest)
        return self.basis.coefficients(found, self.lost)

    @property
    def sizes(self) -> Array:
        """Sizes of the states, (n,)."""
        return self.reference_set.states

    @property
    def tolerance(self) -> float:
        """Tolerance of the integration."""
        return max(self.tightness * self.wanted, _TIGHTEST)

    @property
    def lost(self) -> float:
        """What the basis may miss: steps may be more accurate than their tolerance, not it."""
        return max(min(self.tightness, 1.0) * self.wanted, _TIGHTEST)

    def values(self, points: Array) -> Array:
        """Trajectories at points (m, d) in units of the sizes: shape (n, T, m); not counted."""
        return self._in_sizes(self._integrated(points))

    def states(self, coefficients: Array) -> Array:
        """States at the nodes from coefficients (rank, r): shape (n, T, r)."""
        columns = self.basis.columns(coefficients)
        values = columns.reshape(self.units.size, -1, coefficients.shape[1])
        return np.asarray(values * self.units[:, None, None])

    def _first(self, points: Array) -> Array:
        """The first trajectories, at a tolerance that brings the error wanted."""
        self.calibrated = True
        reference = self.reference_set.reference
        known = reference.points[:_CALIBRATED]
        exact = reference(self.grid.times)[:, : len(known)] / self.sizes[:, None, None]
        before, share, used = math.inf, math.inf, self.tightness
        for number in range(_CALIBRATIONS):
            found = self._integrated(np.concatenate([known, points]))
            self.count += len(known) + (len(points) if number else 0)
            ours, found = np.split(found, [len(known)], axis=1)
            share = float(np.abs(exact.swapaxes(1, 2) - self._in_sizes(ours)).max()) / self.wanted
            if share > _UNMOVED * before:  # the error is that of the reference
                self.tightness = used
                break
            before, used = share, self.tightness
            if not 0.1 <= share <= 1.0:
                self.tightness *= min(max(0.5 / max(share, 1e-300), 1e-3), 4.0)
            if share <= 1.0:
                break
        if share > 1.0 and reference.stiff:  # explicit steps do not come to the accuracy
            self.stiff, self.tightness = True, _STIFF
            found = self._integrated(points)
        return found

    def _in_sizes(self, trajectories: Array) -> Array:
        """Trajectories (n T, m) in units of the sizes: shape (n, T, m)."""
        scaled = trajectories * np.sqrt(self.grid.times.size)
        return np.asarray(scaled.reshape(self.units.size, -1, trajectories.shape[1]))

    def _integrated(self, points: Array) -> Array:
        """Trajectories at the points, (n T, m).

        Those of a chunk share their steps. So the chunks depend on the problem and on the
        number of points alone, and not on who integrates them.
        """
        reference_set, end = self.reference_set, self.grid.breaks[-1]
        edges = [
            reference_set.domain.horizon[0],
            *(cut for cut in reference_set.cuts if cut < end),
            end,
        ]
        floor = np.minimum(_ABSOLUTE * reference_set.states, reference_set.reference.floor)
        atol = np.maximum(self.tolerance * floor, reference_set.reference.rounded)
        integrator = StackedIntegrator(self.stiff, _BEARABLE)
        tolerances = Tolerances(self.tolerance, atol[:, None])
        given = integrator, edges, tolerances, self.grid.times, reference_set.states
        chunks = np.array_split(points, max(-(-len(points) // self._chunk()), 1))
        tasks = [(chunk, *given) for chunk in chunks]
        before = work_done()
        try:
            found = self.workers.map(_integrated, tasks, TrajectoryEnds, done=self.done)
            return np.concatenate(found, axis=1)
        finally:
            self.work += work_done() - before

    def _chunk(self) -> int:
        """Largest number of trajectories in a chunk."""
        if self.reference_set.system.user_functions:
            return _STACKED_USER
        most = _STACKED_STIFF if self.stiff else _STACKED
        return min(max(_STACKED_STATES // int(self.units.size), _FEWEST), most)


def _integrated(
    system: System,
    points: Array,
    integrator: Integrator,
    edges: list[float],
    tolerances: Tolerances,
    times: Array,
    sizes: Array,
) -> Array:
    """Trajectories at points (m, d) in units of the states' sizes, (n T, m)."""
    sampled = integrator.sample(system, points, edges, tolerances, times)
    if sampled.reached < times.size or not np.isfinite(sampled.states).all():
        floor = tolerances.absolute
        ends = first_to_end(system, sampled.end, sampled.state, points, floor)
        raise TrajectoryEnds(sampled.end, points[ends])
    units = sizes * np.sqrt(times.size)
    scaled = sampled.states.transpose(1, 0, 2) / units[:, None, None]
    return np.asarray(scaled.reshape(-1, len(points)))
