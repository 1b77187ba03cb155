"""Evaluation of branches: orders of events that hold in parts of the box."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.errors import warn
from rankone.tensors.evaluators.decisions import LOOKS, Decider, Decision, clearance, looks
from rankone.tensors.evaluators.evaluator import Rows
from rankone.tensors.evaluators.forks import Grazing
from rankone.tensors.evaluators.timeline_evaluator import ClockEvaluator, TimelineEvaluator


class BranchEvaluator(ClockEvaluator):
    """States at clock times, of the branch that holds at each point.

    Values are NaN, with a warning, where it is undecided which branch holds: where guards are
    within the width of the ``decider`` of their signs, and states of the branches differ by more
    than ``tolerances`` (n,).
    """

    def __init__(
        self,
        branches: Sequence[TimelineEvaluator],
        guards: Sequence[int],
        decider: Decider,
        tolerances: Sequence[float],
    ) -> None:
        self.branches, self.guards = tuple(branches), tuple(guards)
        self.decider, self.tolerances = decider, np.array(tolerances, dtype=float)
        self.width, self.horizon = decider.width, decider.horizon
        self.takes_likeliest = False

    def _row(self, branch: int, guard: int) -> int:
        """The row of a guard of a branch."""
        rows = len(self.branches[branch].slabs[0].cores[0])
        return rows - 2 - self.guards[branch] + guard

    def likeliest(self) -> BranchEvaluator:
        """One that takes the branch that is ahead also where that is undecided, without NaN."""
        other = copy(self)
        other.takes_likeliest = True
        return other

    def decided(self, points: Array) -> Decision:
        """The branches that hold at points (d, N)."""
        return self._decided_by(self.deciders(points))

    def held(self, points: Array) -> NDArray[np.intp]:
        """The branch that holds at points (d, N); -1 within a width of where another one does."""
        return self.decider.held(self.decided(points))

    def deciders(self, points: Array) -> Array:
        """Smooth functions (k, N) of points (d, N) that tell branches and stretches.

        They are the borders of all branches, as solved, the guards of the forks, and by how much
        branches miss events that are only grazed.
        """
        borders = [branch.borders_as_solved(points) for branch in self.branches]
        guards = [
            self._guard(fork.first, fork.guard, points)[None]
            for fork in self.decider.forks
            if fork.guard is not None
        ]
        clearances = [self._clearance(grazing, points)[None] for grazing in self.decider.grazings]
        return np.concatenate([*borders, *guards, *clearances])

    def _decided_by(self, deciders: Array) -> Decision:
        """The branches that hold by deciders (k, N)."""
        ends = np.cumsum([round(branch.slabs[-1].end) + 1 for branch in self.branches])
        *borders, others = np.split(deciders, ends)
        guards, clearances = np.split(others, [len(others) - len(self.decider.grazings)])
        return self.decider.decision(borders, guards, clearances)

    def _clearance(self, grazing: Grazing, points: Array) -> Array:
        """How far a guard stays from a fall through zero on its stretch, at points (d, N)."""
        evaluator = self.branches[grazing.branch]
        row = self._row(grazing.branch, grazing.guard)
        heights = evaluator.on_stretches(looks(grazing)[:, None], points, np.array([row]))[0]
        return clearance(grazing, heights)

    def _guard(self, branch: int, guard: int, points: Array) -> Array:
        """A guard of a branch at points (d, N)."""
        rows, start = np.array([self._row(branch, guard)]), np.zeros((1, 1))
        return np.asarray(self.branches[branch].on_stretches(start, points, rows)[0, 0])

    def curves(self, times: Array, points: Array, rows: Rows) -> Array:
        states, doubtful = self.with_doubts(times, points, rows)
        _warn_of(doubtful)
        return states

    @property
    def numbers_each(self) -> int:
        borders = sum(branch.numbers_each for branch in self.branches)
        return borders + len(self.decider.forks) + LOOKS * len(self.decider.grazings)

    def count(self, rows: Rows) -> int:
        return self.branches[0].count(rows)

    def with_doubts(
        self, times: Array, points: Array, rows: Rows
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Curves, and where it is undecided which branch holds (T, N)."""
        shape = len(times), points.shape[1]
        states, doubtful = np.empty((self.count(rows), *shape)), np.zeros(shape, bool)
        for part, at, here in self.parts(times, points):
            states[part], doubtful[part[1:]] = self._with_doubts(at, here, rows)
        return states, doubtful

    def _with_doubts(
        self, times: Array, points: Array, rows: Rows
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Curves and doubts, all at once."""
        times = np.broadcast_to(times, (len(times), points.shape[1]))

        def states(k: int, here: NDArray[np.intp]) -> Array:
            return self.branches[k].curves(times[:, here], points[:, here], rows)

        return self._merged(self.decided(points), times.shape, rows, states)

    def smooth_pieces(self, times: Array, deciders: Array) -> NDArray[np.intp]:
        """Branch and stretch, as one number, of times (T, 1) or (T, N) by deciders (k, N): (T, N).

        Numbers below zero stand for no stretch.
        """
        times = np.broadcast_to(times, (len(times), deciders.shape[1]))
        decision = self._decided_by(deciders)
        pieces = np.full(times.shape, -1, dtype=np.intp)
        for k in np.unique(decision.chosen).tolist():
            here = np.flatnonzero(decision.chosen == k)
            borders = decision.borders[k][:, here]
            stretch, outside = self.branches[k].stretches(times[:, here], borders)
            pieces[:, here] = np.where(outside, -1, stretch * len(self.branches) + k)
        return pieces

    def borders(self, points: Array) -> Array:
        """Clock times (most stretches + 1, N) of the borders of the branch that holds at points.

        NaN behind the last one of a branch, and where none is decided.
        """
        decision = self.decided(points)
        most = max(round(branch.slabs[-1].end) for branch in self.branches)
        borders = np.full((most + 1, points.shape[1]), math.nan)
        for k in np.unique(decision.chosen).tolist():
            timed = ~decision.undecided & ~decision.at_turn
            here = np.flatnonzero((decision.chosen == k) & timed)
            if here.size:
                own = self.branches[k].borders(points[:, here])
                borders[: len(own), here] = own
        return borders

    def linearised(
        self, times: Array, points: Array, rows: Rows, free: Sequence[int]
    ) -> tuple[Array, Array]:
        """States (rows, T, N) at times (T, N), and derivatives (rows, T, N, k)."""
        decision = self.decided(points)
        count = len(self.branches[0].slabs[0].cores[0][rows])
        slopes = np.full((count, *times.shape, len(free)), math.nan)

        def states(k: int, here: NDArray[np.intp]) -> Array:
            at = times[:, here], points[:, here], rows, free
            here_states, here_slopes = self.branches[k].linearised(*at)
            mine = decision.chosen[here] == k
            slopes[:, :, here[mine]] = here_slopes[:, :, mine]
            return here_states

        merged, doubtful = self._merged(decision, times.shape, rows, states)
        slopes[:, doubtful] = math.nan
        _warn_of(doubtful)
        return merged, slopes

    def _merged(
        self,
        decision: Decision,
        shape: tuple[int, ...],
        rows: Rows,
        states: Callable[[int, NDArray[np.intp]], Array],
    ) -> tuple[Array, NDArray[np.bool_]]:
        """States (rows, T, N) of the branches that hold, and where these are doubtful (T, N).

        ``states`` gives those of a branch at some of the points.
        """
        merged, doubtful = self.decider.merged(decision, shape, self.tolerances[rows], states)
        if self.takes_likeliest:
            doubtful[:] = False
        merged[:, doubtful] = math.nan
        return merged, doubtful


class ContinuedBranch(TimelineEvaluator):
    """One branch over the whole box: where it does not hold, stretches may have negative lengths.

    Borders are in the order of the stretches, so that they are smooth. Roots of heights are
    coordinates behind the parameters.
    """

    def __init__(self, branches: BranchEvaluator, branch: int) -> None:
        own = branches.branches[branch]
        super().__init__(own.slabs, own.horizon, own.affine_borders)
        self._branches, self._branch = branches, branch
        self._opened = len(own.roots)

    def borders(self, points: Array) -> Array:
        return self.borders_as_solved(points)

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Where the branch holds at points (d, N), and not just about, whatever the roots are."""
        decision = self._branches.decided(points[: len(points) - self._opened])
        return np.asarray((decision.chosen == self._branch) & ~decision.undecided)


def _warn_of(doubtful: NDArray[np.bool_]) -> None:
    """Warn of values that are NaN since they are doubtful."""
    if doubtful.any():
        warn(
            "values are NaN where it is undecided in which order events come",
            remedy="`solution.branch(...)` is -1 there",
        )
