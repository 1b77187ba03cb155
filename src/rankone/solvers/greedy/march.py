"""One pass over the horizon, slab after slab.

A slab is halved where the lagged iteration does not settle on it; the next one is longer where it
settled soon. With a fixed number of slabs the iteration is taken as far as it came, and the
outcome says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from rankone.arrays import Array
from rankone.discretization.finite_elements import LagrangeElements
from rankone.progress import ProgressEvent, quiet
from rankone.solvers.engine import Report
from rankone.solvers.greedy.history import GreedySlabRecord
from rankone.solvers.greedy.lagging import LaggedSlab, SlabResult, compressed
from rankone.solvers.greedy.operators import ShapeSpace
from rankone.solvers.greedy.options import GreedyOptions
from rankone.solvers.greedy.terms import SourceTerm, evaluation_order
from rankone.solvers.outcome import Status
from rankone.system import System
from rankone.tensors.conversion import element_trains
from rankone.tensors.rank_one_sums import RankOneSum
from rankone.tensors.slab import SlabTrain

__all__ = ["March", "MarchResult"]

_CONTRACTION = 3.0
"""Length of the first slab times the largest norm of the scaled Jacobian."""
_SHORTEST = 1e-6
"""Shortest slab, relative to the horizon."""
_FEW, _MANY = 10, 16
"""Lagged iterations after which the next slab is longer, or shorter."""
_GROW, _SHRINK, _HALVE = 1.5, 0.7, 0.5
_ROUNDING = 0.2
"""What rounding a state at the end of a slab may lose, relative to the slab's tolerance."""


@dataclass
class MarchResult:
    """Slabs solved so far, and why the march ended early (None if it reached the end).

    Attributes
    ----------
    slabs : list of SlabTrain
    records : list of GreedySlabRecord
    limits : set of Status
        Limits met on the way.
    stopped : Status or None
    tails : ndarray (1 + d,)
        For time and each parameter the largest part of a state in the two highest modes.
    """

    tails: Array
    slabs: list[SlabTrain] = field(default_factory=list)
    records: list[GreedySlabRecord] = field(default_factory=list)
    limits: set[Status] = field(default_factory=set)
    stopped: Status | None = None


@dataclass
class March:
    """What is fixed during one pass over the horizon.

    Parameters
    ----------
    system : System
    terms : sequence of SourceTerm
        The right-hand side.
    start, end : float
        What is to be solved.
    sizes : ndarray (n,)
        Size of each state.
    stiffness : float
        Largest norm of the scaled Jacobian.
    tolerance : callable
        Tolerance at the time t in units of the sizes.
    in_time : callable
        Shape functions on a slab, from its ends.
    parameters : sequence of LagrangeElements
        Shape functions in each parameter.
    options : GreedyOptions
    attempt : int
        Number of the attempt, for the records.
    report : callable
        Called with a ProgressEvent after each accepted slab.
    """

    system: System
    terms: Sequence[SourceTerm]
    start: float
    end: float
    sizes: Array
    stiffness: float
    tolerance: Callable[[float], float]
    in_time: Callable[[float, float], LagrangeElements]
    parameters: Sequence[LagrangeElements]
    options: GreedyOptions
    attempt: int = 0
    report: Report = quiet

    def run(self) -> MarchResult:
        """March from the start of the horizon to ``end``."""
        options = self.options
        result = MarchResult(np.zeros(1 + len(self.parameters)))
        blocks = evaluation_order(self.terms, self.system.N_DIFFERENTIAL)
        time = self.start
        horizon = self.end - time
        values = self._initial()
        adaptive = options.time_slabs is None
        length = horizon / (options.time_slabs or 1)
        if adaptive and self._lagged(blocks):
            length = min(length, _CONTRACTION / max(self.stiffness, 1e-300))
        while self.end - time > 1e-9 * horizon:
            if len(result.records) >= options.max_slabs:
                result.stopped = Status.SLAB_LIMIT
                break
            remaining = self.end - time
            length = remaining / math.ceil(remaining / length - 1e-9)
            level = self.tolerance(time)
            upper = self.end if remaining < 1.01 * length else time + length
            space = ShapeSpace(self.system, self.in_time(time, upper), self.parameters)
            slab = LaggedSlab(
                space, self.terms, blocks, values, self.sizes, self.system.STATES, options
            )
            with np.errstate(over="ignore", invalid="ignore"):
                solved = slab.solve(level)
            accepted = solved.converged or (solved.usable and not adaptive)
            result.records.append(self._record(space, solved, accepted, level))
            if not accepted:
                length *= _HALVE
                if adaptive and length > _SHORTEST * horizon:
                    continue
                result.stopped = Status.NO_CONVERGENCE
                break
            if not solved.converged:
                result.limits.add(Status.NO_CONVERGENCE)
            limited = solved.residual > level and solved.rank >= options.max_modes
            if limited:
                result.limits.add(Status.RANK_LIMIT)
            trains, tails = element_trains(
                space.bases, values, solved.modes, 0.05 * level * self.sizes
            )
            result.slabs += trains
            result.tails = np.maximum(result.tails, (tails / self.sizes[:, None]).max(axis=0))
            values = [
                self._at_end(value, modes, _ROUNDING * level * size)
                for value, modes, size in zip(values, solved.modes, self.sizes, strict=True)
            ]
            time = upper
            rank = max((max(train.ranks, default=1) for train in trains), default=1)
            place = time, (time - self.start) / horizon, self.attempt, len(result.slabs)
            self.report(ProgressEvent(*place, rank))
            if adaptive:
                length *= _stretch(len(solved.changes), limited)
        return result

    def _lagged(self, blocks: Sequence[tuple[int, ...]]) -> bool:
        """Whether any term is lagged within its block."""
        return any(len(block) > 1 for block in blocks) or any(
            term.equation in term.monomial and not term.own for term in self.terms
        )

    def _initial(self) -> list[RankOneSum]:
        """Initial values at the parameter nodes; the factor of time is one row of amplitudes."""
        rows = [
            self.system.parameter_factors(j, basis.nodes) for j, basis in enumerate(self.parameters)
        ]
        sizes = (1, *(basis.size for basis in self.parameters))
        values: list[list[RankOneSum]] = [[] for _ in range(self.system.N_DIFFERENTIAL)]
        for coefficient, state, factors in self.system.INITIAL:
            columns = [row[index][:, None] for row, index in zip(rows, factors, strict=True)]
            values[state].append(RankOneSum((np.full((1, 1), coefficient), *columns)))
        return [RankOneSum.joined(parts, sizes) for parts in values]

    def _at_end(self, value: RankOneSum, modes: RankOneSum, tolerance: float) -> RankOneSum:
        """A state at the end of a slab, in few products.

        ``tolerance`` is the root mean square over the box of what may be lost.
        """
        total = value + RankOneSum((modes.factors[0][-1:], *modes.factors[1:]))
        if not self.parameters or total.rank <= 1:
            return total.merged()
        at_end = RankOneSum(total.factors[1:]).scaled(total.factors[0][0]).merged()
        if at_end.rank > 1:
            masses = [(b.values.T * b.weights) @ b.values for b in self.parameters]
            volume = math.prod(basis.upper - basis.lower for basis in self.parameters)
            at_end = compressed(at_end, masses, tolerance * math.sqrt(volume), self.options)
        return RankOneSum((np.ones((1, at_end.rank)), *at_end.factors))

    def _record(
        self, space: ShapeSpace, solved: SlabResult, accepted: bool, tolerance: float
    ) -> GreedySlabRecord:
        return GreedySlabRecord(
            self.attempt,
            space.time.lower,
            space.time.upper,
            accepted,
            tolerance,
            solved.changes,
            tuple(modes.rank for modes in solved.modes),
            tuple(basis.size for basis in space.bases),
            solved.records,
        )


def _stretch(iterations: int, limited: bool) -> float:
    """Factor on the length of the next slab."""
    if limited:
        return _HALVE
    if iterations <= _FEW:
        return _GROW
    return _SHRINK if iterations > _MANY else 1.0
