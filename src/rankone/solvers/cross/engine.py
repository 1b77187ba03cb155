"""The cross engine: interpolate, check against SciPy, ask for more where it does not suffice."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from rankone.discretization import BASES, Basis1D
from rankone.ir.request import SolveRequest
from rankone.ir.verdict import Cause, MovingFeatures, Status, TrajectoryStops
from rankone.solvers.attempts import Attempt, Progress
from rankone.solvers.cross.nodes import divided, first_bases, more_nodes
from rankone.solvers.cross.options import CrossOptions
from rankone.solvers.cross.pace import Pace
from rankone.solvers.cross.record import CrossRecord
from rankone.solvers.cross.steep import steepest_front
from rankone.solvers.cross.time_grid import TimeGrid, resolving_breaks
from rankone.solvers.cross.trajectories import TooManyTrajectories, Trajectories, TrajectoryEnds
from rankone.solvers.engine import Engine
from rankone.solvers.march import MarchResult
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, unlimited
from rankone.support.progress import ProgressEvent, Report
from rankone.tensors.cross import interpolate, left_points, with_points
from rankone.tensors.samples import Samples
from rankone.tensors.train import Train
from rankone.trajectories.workers import Workers
from rankone.verification.measure import ReferenceSet
from rankone.verification.points import candidate_points, steepest_point

__all__ = ["ENGINE"]

_INTEGRATION, _ROW_SPACE, _HIGHEST, _ROUNDING = 0.1, 0.1, 0.1, 0.1
"""Shares of the error asked for: integration, row spaces, highest modes, rounding."""
_LEFT_POINTS = 7
_LEAST_NODES = 3
"""Nodes of what does not depend on a parameter."""
_PATIENCE, _CHEAP = 5, 80_000
"""Attempts in a row that may stall while so many trajectories are not reached; beyond, two may."""
_FEW = 3
"""So many times that number, the tolerances of an attempt are lowered once whatever the errors."""
_SETTLED = 1.2
"""Growth of the nodes up to which more of them alone are not expected to suffice."""
_TIGHTENED = 0.7
"""Power of the error wanted over that found by which tolerances are tightened: there are more nodes
and left points as well."""
_FAR, _FAST = 5.0, 0.2
"""Beyond, an error so many times that asked for must fall to this part of it in each attempt."""


_UNRESOLVED = (
    Status.TOLERANCE,
    Status.RANK_LIMIT,
    Status.NODE_LIMIT,
    Status.TRAJECTORY_LIMIT,
    Status.WORK_LIMIT,
    Status.TIME_LIMIT,
)
"""Failures for which a steep dependence on a parameter may be the reason."""


class CrossMarcher:
    """Interpolates the whole horizon at once, each time with more nodes, points or accuracy."""

    remedies: ClassVar[Mapping[Status, str]] = {
        Status.RANK_LIMIT: "raise max_rank, narrow the box or loosen rtol",
        Status.NODE_LIMIT: "raise max_nodes, narrow the box or loosen rtol",
        Status.SLAB_LIMIT: "raise max_slabs or shorten the horizon",
        Status.TRAJECTORY_LIMIT: "raise max_trajectories, narrow the box or loosen rtol",
        Status.NO_CONVERGENCE: "narrow the box or shorten the horizon",
        Status.TOLERANCE: "loosen rtol, narrow the box or shorten the horizon",
        Status.STEEP: "solve the parts of the box on either side on their own, or loosen rtol",
    }

    def __init__(
        self, request: SolveRequest, reference_set: ReferenceSet, workers: Workers
    ) -> None:
        self.workers = workers
        self.rtol, self.options = request.rtol, request.options_of(CrossOptions)
        self.reference_set = reference_set
        self.share, self.left = 1.0, _LEFT_POINTS
        self.bases: tuple[Basis1D, ...] | None = None
        self.spectra: list[Array] = []
        self.breaks: set[float] = set()
        self.steep: Array | None = None
        self.doubtful: Array | None = None
        self.undivided: tuple[Basis1D, ...] | None = None
        self.divides = True
        self.trajectories: Trajectories | None = None
        self.integrated, self.error, self.ends = 0, np.inf, reference_set.end
        self.tightness = 0.3

    def march(self, number: int, report: Report) -> MarchResult:
        """Interpolate over the whole horizon."""
        level = self.share * self.rtol
        grid = self._grid(level)
        if grid is None:
            return MarchResult(stopped=Status.SLAB_LIMIT)
        most = self.options.max_trajectories - self.integrated
        pace = Pace(report, ProgressEvent(grid.breaks[0], 0.0, number, grid.slabs, 1))
        given = grid, _INTEGRATION * level, self.tightness, most, self.workers, pace.batch
        self.trajectories = trajectories = Trajectories(self.reference_set, *given)
        try:
            result = self._marched(trajectories, level, number, pace)
        except TooManyTrajectories:
            result = self._stopped(Status.TRAJECTORY_LIMIT, grid)
        except OutOfBudgetError as out:
            result = self._stopped(Status.of_limit(out), grid)
        except TrajectoryEnds as ends:
            result = MarchResult(stopped=Status.NO_CONVERGENCE, points=ends.point[None, :])
            self.ends = ends.time
        self.integrated += trajectories.count
        self.tightness = trajectories.tightness
        result.sampled = trajectories.work
        return result

    def _marched(
        self, trajectories: Trajectories, level: float, number: int, pace: Pace
    ) -> MarchResult:
        """The interpolation of trajectories, and what it came to."""
        result, grid = MarchResult(), trajectories.grid
        train, limited, bases = self._interpolated(trajectories, level, pace)
        self.bases = bases
        if limited:
            result.limits.add(Status.RANK_LIMIT)
        if any(basis.size >= self.options.max_nodes for basis in bases):
            result.limits.add(Status.NODE_LIMIT)
        modal = train.rounded(_ROUNDING * level).apply_to_modes([b.to_modal for b in bases])
        self.spectra = modal.mode_norms()
        states = trajectories.states(modal.first)
        result.slabs = grid.trains(modal.with_first(states), bases)
        result.points = candidate_points(result.slabs, trajectories.sizes, number, self.rtol)
        ranks = modal.ranks
        tails = tuple(b.tail(s) for b, s in zip(bases, self.spectra, strict=True))
        sizes = tuple(basis.size for basis in bases)
        start, end = grid.breaks[0], grid.breaks[-1]
        counts = trajectories.count, grid.slabs
        record = CrossRecord(number, start, end, True, level, tails, ranks, sizes, *counts)
        result.records.append(record)
        pace.report(ProgressEvent(end, 1.0, number, grid.slabs, max(ranks, default=1)))
        return result

    def _stopped(self, status: Status, grid: TimeGrid) -> MarchResult:
        """The trajectory at the centre for every parameter, which is better than nothing."""
        reference_set, kind = self.reference_set, BASES[self.options.basis]
        bases = tuple(kind(lower, upper, _LEAST_NODES) for lower, upper in reference_set.domain.box)
        constant = [np.sqrt(basis.weights)[None, :, None] for basis in bases]
        with unlimited():
            centre = reference_set.reference(grid.times)[:, 0, :, None]
        train = Train((centre, *constant)).apply_to_modes([basis.to_modal for basis in bases])
        return MarchResult(grid.trains(train, bases), stopped=status, whole=True)

    def _grid(self, level: float) -> TimeGrid | None:
        """Slabs that resolve the reference, or None if there are too many."""
        reference_set = self.reference_set
        start, end = reference_set.reference.start, reference_set.end
        between = {*reference_set.cuts, *self.breaks}
        edges = [start, *sorted(cut for cut in between if cut < end), end]
        units = reference_set.states[:, None, None]
        count = self.options.nodes_in_time(self.rtol)
        tolerance = max(_HIGHEST * level, 1e-13)
        most = self.options.max_slabs

        def values(t: Array) -> Array:
            return reference_set.reference(t) / units

        breaks = resolving_breaks(values, edges, count, tolerance, most)
        return None if breaks is None else TimeGrid(breaks, count)

    def _interpolated(
        self, trajectories: Trajectories, level: float, pace: Pace
    ) -> tuple[Train, bool, tuple[Basis1D, ...]]:
        domain = self.reference_set.domain
        if not domain.box:
            return Train((trajectories(np.zeros((1, 0))),)), False, ()
        if self.bases is None:
            bases = first_bases(trajectories, domain, level, self.options)
        else:
            bases, self.undivided = self.bases, None
            if self.divides:
                given = trajectories, domain, level, self.options, self.steep
                bases = divided(self.bases, *given)
                self.undivided = self.bases if bases != self.bases else None
        left = left_points([basis.size for basis in bases], self.left, 20140)
        if self.doubtful is not None:
            left = with_points(left, [basis.nodes for basis in bases], self.doubtful)
        samples = Samples(trajectories, bases)
        tolerance = _ROW_SPACE * level / np.sqrt(len(bases))
        most = self.options.max_rank
        return *interpolate(samples, bases, left, tolerance, most, pace.bond), bases

    def refine(self, attempt: Attempt, progress: Progress) -> bool:
        """More nodes where the highest modes are not small, more points, or more accuracy."""
        if attempt.result.stopped or self.bases is None:
            return False
        worse = attempt.error > self.error
        if worse and self.undivided is not None:  # what is steep moves: elements do not follow
            self.bases, self.undivided, self.divides = self.undivided, None, False
            return True
        self._halve_slabs()
        self.steep, self.doubtful = attempt.result.points, attempt.result.doubtful
        if self.doubtful is not None:  # lines through these first
            known = [] if self.steep is None else [self.steep]
            self.steep = np.concatenate([self.doubtful, *known])
        finer = self._finer(self.bases)
        grown = sum(basis.elements for basis in finer) > sum(b.elements for b in self.bases)
        patient = progress.pays or self._patient(attempt, progress.stalls, grown)
        self.error = attempt.error
        if not patient:
            return False
        settled = all(
            new.size <= _SETTLED * b.size for new, b in zip(finer, self.bases, strict=True)
        )
        close = attempt.error < _FAR * self.rtol
        if settled or close or (progress.stalls and not grown):
            self.share *= min(max((self.rtol / attempt.error) ** _TIGHTENED, 0.1), 0.7)
            finer = self._finer(self.bases)
        self.left = -(-3 * self.left // 2)
        self.bases = finer
        return True

    def _patient(self, attempt: Attempt, stalls: int, grown: bool) -> bool:
        """Whether another attempt may be worth its cost; ``grown``: there are more elements."""
        if self.integrated < _CHEAP:
            return grown or stalls < _PATIENCE
        if self.share == 1.0 and self.integrated < _FEW * _CHEAP:  # not all was tried
            return True
        return stalls < 2 and attempt.error < max(_FAR * self.rtol, _FAST * self.error)

    def _halve_slabs(self) -> None:
        """Halve the slabs on which some trajectory varies more than those of the reference."""
        assert self.trajectories is not None
        breaks = np.array(self.trajectories.grid.breaks)
        rough = self.trajectories.highest > _HIGHEST * self.share * self.rtol
        self.breaks |= {*(0.5 * (breaks[:-1] + breaks[1:])[rough]).tolist()}

    def _finer(self, bases: tuple[Basis1D, ...]) -> tuple[Basis1D, ...]:
        """Bases with more nodes where the highest modes found are not small."""
        tolerance = _HIGHEST * self.share * self.rtol
        return more_nodes(bases, self.spectra, tolerance, self.options.max_nodes)

    def explained(self, status: Status, attempt: Attempt) -> tuple[Status, Cause | None]:
        """Whether a steep dependence on a parameter is the reason, and on which."""
        trajectories, domain = self.trajectories, self.reference_set.domain
        if status is Status.NO_CONVERGENCE:
            return status, TrajectoryStops(float(self.ends))
        system = self.reference_set.system
        moves = system.features.n_moving_cuts > 0 and status in (*_UNRESOLVED, Status.SLAB_LIMIT)
        cause = MovingFeatures() if moves else None
        if status not in _UNRESOLVED or trajectories is None or not domain.box:
            return status, cause
        trajectories.wanted = _INTEGRATION * self.rtol  # what later attempts wanted is too dear
        lines = [domain.bounds.mean(axis=1)]
        try:
            if attempt.result.slabs:
                lines.append(steepest_point(attempt.result.slabs[-1], trajectories.sizes))
            front = steepest_front(trajectories.values, domain, lines)
        except (OutOfBudgetError, TrajectoryEnds):
            front = None
        if front is None:
            return status, cause
        return Status.STEEP, front.cause(system.states, system.parameters)


ENGINE = Engine("cross", CrossOptions, CrossRecord, CrossMarcher)
