"""From slab to slab: shape functions, the lagged iteration, and the states at the end.

With a fixed number of slabs the iteration is taken as far as it came, and the outcome says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rankone.ir.domain import Domain
from rankone.ir.jumps import jump_kind
from rankone.ir.outcome import Status
from rankone.solvers.greedy.history import GreedySlabRecord
from rankone.solvers.greedy.lagging import Coupling, LaggedSlab, SlabResult, compressed
from rankone.solvers.greedy.nodes import Nodes
from rankone.solvers.greedy.operators import ShapeSpace
from rankone.solvers.interpolation import (
    PlainNodes,
    interpolated,
    interpolated_initial,
)
from rankone.solvers.march import Span, Trial
from rankone.support.arrays import Array
from rankone.tensors.conversion import element_trains
from rankone.tensors.rank_one_sums import RankOneSum
from rankone.tensors.samples import Integers
from rankone.tensors.slab import SlabTrain

__all__ = ["GreedyTrial", "LaggedSlabs"]

_LOST_AT_END = 0.2
"""What rounding a state at the end of a slab may lose, relative to the slab's tolerance."""
_THINNED = 0.05
"""What its trains may lose."""
_AT_JUMPS = 0.01
"""What the interpolation of states after a jump may lose."""


@dataclass(frozen=True)
class GreedyTrial(Trial):
    """What the lagged iteration on one slab came to."""

    space: ShapeSpace
    solved: SlabResult


@dataclass
class LaggedSlabs:
    """The slab solver of one attempt.

    Parameters
    ----------
    coupling : Coupling
        The equations and how they are solved.
    tolerance : callable
        Tolerance at the time t in units of the sizes.
    attempt : int
        Number of the attempt, for the records.

    Attributes
    ----------
    tails : ndarray (1 + d,)
        For time and each parameter the largest part of a state in the two highest modes.
    """

    coupling: Coupling
    domain: Domain
    nodes: Nodes
    tolerance: Callable[[float], float]
    attempt: int

    def __post_init__(self) -> None:
        self.options, self.sizes = self.coupling.options, self.coupling.sizes
        self.parameters = [
            self.options.shape_functions(*interval, count)
            for interval, count in zip(self.domain.box, self.nodes.parameters, strict=True)
        ]
        self.tails = np.zeros(1 + len(self.parameters))
        self._values = self._initial()

    def solve(self, span: Span) -> GreedyTrial:
        """Iterate until the lagged terms settle, or as far as a fixed slab comes."""
        tolerance = self.tolerance(span.start)
        time = self.options.shape_functions(span.start, span.end, self.nodes.time)
        space = ShapeSpace(self.coupling.system, time, self.parameters)
        with np.errstate(over="ignore", invalid="ignore"):
            solved = LaggedSlab(space, self.coupling, self._values).solve(tolerance)
        fixed = self.options.time_slabs is not None
        accepted = solved.converged or (solved.usable and fixed)
        limits = set()
        if accepted and not solved.converged:
            limits.add(Status.NO_CONVERGENCE)
        if accepted and solved.residual > tolerance and solved.rank >= self.options.max_modes:
            limits.add(Status.RANK_LIMIT)
        place = self.attempt, span.start, span.end, accepted, tolerance
        ranks = tuple(modes.rank for modes in solved.modes)
        sizes = tuple(basis.size for basis in space.bases)
        record = GreedySlabRecord(*place, solved.changes, ranks, sizes, solved.records)
        return GreedyTrial(record, limits, space, solved)

    def accept(self, span: Span, trial: GreedyTrial) -> list[SlabTrain]:
        """One train for each element in time; the next slab begins at the end of this one."""
        bases, modes, lost = trial.space.bases, trial.solved.modes, trial.record.tolerance
        trains, tails = element_trains(bases, self._values, modes, _THINNED * lost * self.sizes)
        self.tails = np.maximum(self.tails, (tails / self.sizes[:, None]).max(axis=0))
        self._values = [
            self._at_end(value, added, _LOST_AT_END * lost * size)
            for value, added, size in zip(self._values, modes, self.sizes, strict=True)
        ]
        kind = jump_kind(self.coupling.system, span.end)
        if kind is not None and span.end < self.domain.horizon[1]:
            self._values = self._after_jump(kind, lost)
        return list(trains)

    def _initial(self) -> list[RankOneSum]:
        """Initial values at the parameter nodes; the factor of time is one row of amplitudes."""
        system = self.coupling.system
        if hasattr(system, "coupled_initial"):
            cores = interpolated_initial(system, [b.nodes for b in self.parameters])
            return self._of_train(cores, self.tolerance(self.domain.horizon[0]))
        rows = [system.parameter_factors(j, basis.nodes) for j, basis in enumerate(self.parameters)]
        sizes = (1, *(basis.size for basis in self.parameters))
        values: list[list[RankOneSum]] = [[] for _ in range(system.N_DIFFERENTIAL)]
        for coefficient, state, factors in system.INITIAL:
            columns = [row[index][:, None] for row, index in zip(rows, factors, strict=True)]
            values[state].append(RankOneSum((np.full((1, 1), coefficient), *columns)))
        return [RankOneSum.joined(parts, sizes) for parts in values]

    def _of_train(self, cores: Sequence[Array], tolerance: float) -> list[RankOneSum]:
        """The states of a train (n, r_1), ... with values at the nodes, in few products."""
        first, *others = cores
        if not others:
            return [RankOneSum((row[None, :],)) for row in first]
        parts = (RankOneSum.of_train(row, others) for row in first)
        pairs = zip(parts, self.sizes, strict=True)
        return [self._compressed(part, _LOST_AT_END * tolerance * size) for part, size in pairs]

    def _after_jump(self, kind: int, tolerance: float) -> list[RankOneSum]:
        """The states right after a jump, which acts at each parameter node on its own."""
        nodes = [basis.nodes for basis in self.parameters]

        def values(indices: Integers) -> Array:
            points = np.array([x[i] for x, i in zip(nodes, indices.T, strict=True)])
            before = np.array([value.at(indices) for value in self._values])
            return self.coupling.system.jumped(
                kind, before, points.reshape(len(nodes), len(indices))
            )

        plain = [PlainNodes.of(x.size) for x in nodes]
        return self._of_train(interpolated(values, plain, _AT_JUMPS * tolerance), tolerance)

    def _at_end(self, value: RankOneSum, modes: RankOneSum, tolerance: float) -> RankOneSum:
        """A state at the end of a slab, in few products.

        ``tolerance`` is the root mean square over the box of what may be lost.
        """
        total = value + RankOneSum((modes.factors[0][-1:], *modes.factors[1:]))
        if not self.parameters or total.rank <= 1:
            return total.merged()
        at_end = RankOneSum(total.factors[1:]).scaled(total.factors[0][0]).merged()
        return self._compressed(at_end, tolerance)

    def _compressed(self, at_end: RankOneSum, tolerance: float) -> RankOneSum:
        """A function of the parameters at their nodes, in few products, with one row of time."""
        if at_end.rank > 1:
            masses = [(b.values.T * b.weights) @ b.values for b in self.parameters]
            volume = math.prod(basis.upper - basis.lower for basis in self.parameters)
            at_end = compressed(at_end, masses, tolerance * math.sqrt(volume), self.options)
        return RankOneSum((np.ones((1, at_end.rank)), *at_end.factors))
