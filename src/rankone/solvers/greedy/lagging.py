"""One slab: decoupled equations, with the nonlinear and the coupling terms lagged.

Every equation is solved in turn for its own unknown by enrichment; its source G holds the terms of
the other unknowns and the nonlinear ones at the latest values (Gauss-Seidel). G is updated and all
is repeated until the unknowns no longer change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.ir.system import System
from rankone.solvers.greedy.enrichment import Enrichment
from rankone.solvers.greedy.history import EquationRecord
from rankone.solvers.greedy.operators import Equation, ShapeSpace, assemble
from rankone.solvers.greedy.options import GreedyOptions
from rankone.solvers.greedy.terms import evaluation_order, source_terms
from rankone.support.arrays import Array
from rankone.tensors.rank_one_sums import RankOneSum

__all__ = ["Coupling", "LaggedSlab", "SlabResult", "compressed"]

_LARGEST_SOURCE = 4000
"""Rank above which a source is compressed before it is solved for."""
_INNER = 0.1
"""Residual asked of an equation while the lagged terms still change, relative to the change."""
_DIVERGED = 1e3
"""Change, in units of the state's size, that cannot be an iteration under way."""


@dataclass(frozen=True)
class SlabResult:
    """What the lagged iteration on one slab came to.

    Attributes
    ----------
    modes : tuple of RankOneSum
        For each state the values at the nodes of what is added to its initial value.
    converged : bool
        Whether the last change is within the tolerance.
    usable : bool
        Whether the iteration stayed bounded; what it came to may still be far off.
    changes : tuple of float
        Largest change of a state in each iteration, in units of its size, in the block of
        equations that took longest or did not settle.
    residual : float
        Largest residual of an equation at the end, in the same unit.
    """

    modes: tuple[RankOneSum, ...]
    converged: bool
    usable: bool
    changes: tuple[float, ...]
    residual: float
    records: tuple[EquationRecord, ...]

    @property
    def rank(self) -> int:
        """Largest number of modes of a state."""
        return max((modes.rank for modes in self.modes), default=0)


class Coupling:
    """The equations of a system one by one, and the order in which they are solved.

    Parameters
    ----------
    sizes : ndarray (n,)
        Size of each state.

    Attributes
    ----------
    own, others : list of list of SourceTerm
        For each equation the terms of its operator, and those of its source.
    blocks : tuple of tuple of int
        States that lag each other; the blocks are solved one after the other.
    """

    def __init__(self, system: System, sizes: Array, options: GreedyOptions) -> None:
        self.system, self.sizes, self.options = system, sizes, options
        terms, states = source_terms(system), range(system.N_DIFFERENTIAL)
        self.own = [[t for t in terms if t.equation == c and t.own] for c in states]
        self.others = [[t for t in terms if t.equation == c and not t.own] for c in states]
        self.blocks = evaluation_order(terms, len(states))

    def lagged(self, block: tuple[int, ...]) -> bool:
        """Whether any term of a block is lagged."""
        return len(block) > 1 or any(block[0] in term.monomial for term in self.others[block[0]])


class LaggedSlab:
    """The lagged iteration on one slab.

    Parameters
    ----------
    start : sequence of RankOneSum
        Values at the parameter nodes of each state at the start of the slab; the factor of time
        is one row of amplitudes.
    """

    def __init__(self, space: ShapeSpace, coupling: Coupling, start: Sequence[RankOneSum]) -> None:
        self.space, self.coupling, self.options = space, coupling, coupling.options
        self._equations = [assemble(space, own, self.options) for own in coupling.own]
        self._start = [space.constant_in_time(value) for value in start]
        self._points = list(self._start)
        self.modes = [RankOneSum.zero(space.sizes) for _ in start]
        # a residual of the derivative form is a rate: over the slab it adds up to a state
        derivative = self.options.formulation == "derivative"
        per_time = space.time.upper - space.time.lower if derivative else 1.0
        self._norms = coupling.sizes * math.sqrt(space.volume)
        self._units = self._norms / per_time
        self._scale = [np.sqrt(weights) for weights in space.weights]

    def solve(self, tolerance: float) -> SlabResult:
        """Iterate to a tolerance in units of each state's size."""
        changes: list[float] = []
        records: list[EquationRecord] = []
        converged = usable = True
        for block in self.coupling.blocks:
            steps, done = self._iterate(block, tolerance, records)
            if converged and (not done or len(steps) > len(changes)):
                changes = steps
            converged = converged and done
            usable = usable and bool(steps) and steps[-1] < _DIVERGED
            if not usable:
                break
        last = {record.state: record.residual for record in records}
        residual = max(last.values(), default=0.0)
        return SlabResult(
            tuple(self.modes), converged, usable, tuple(changes), residual, tuple(records)
        )

    def _iterate(
        self, block: tuple[int, ...], tolerance: float, records: list[EquationRecord]
    ) -> tuple[list[float], bool]:
        """Solve the equations of a block in turn until their unknowns settle."""
        lagged = self.coupling.lagged(block)
        changes: list[float] = []
        inner = tolerance if not lagged else max(tolerance, 1e-2)
        for iteration in range(self.options.max_iterations if lagged else 1):
            largest = 0.0
            for state in block:
                record = self._solve_equation(state, iteration, inner)
                records.append(record)
                largest = max(largest, record.change)
                if not math.isfinite(record.change):
                    return [*changes, math.inf], False
            changes.append(largest)
            if not lagged:
                return changes, True
            if not largest < _DIVERGED:
                return changes, False
            # an equation that was only solved coarsely has changes of that order
            if largest <= 2.0 * tolerance and inner == tolerance:
                return changes, True
            slow = len(changes) > 5 and changes[-1] > 0.8 * changes[-4]
            if slow and inner == tolerance:
                # what is left is the truncation of the modes, if it is small
                return changes, largest <= 20.0 * tolerance
            inner = min(max(tolerance, _INNER * largest), inner)
        return changes, False

    def _solve_equation(self, state: int, iteration: int, tolerance: float) -> EquationRecord:
        equation = self._equations[state]
        unit = float(self._units[state])
        source = self._source(state)
        loads = equation.loads(source)
        if loads.rank > _LARGEST_SOURCE:
            loads = self._compressed_loads(equation, loads, 0.1 * tolerance * unit)
        functional = None
        if self.options.projection == "minimal-residual":
            rows = zip(source.factors, self._scale, strict=True)
            functional = RankOneSum(tuple(f * row[:, None] for f, row in rows)).norm() ** 2
        before = self.modes[state]
        start, norm = before if self.options.update == "all" else None, float(self._norms[state])
        units = unit, norm
        result = Enrichment(equation, loads, self.options, start, functional, units).run(tolerance)
        new = result.modes
        change = self._distance(before, new) / norm
        self.modes[state] = new
        self._points[state] = (self._start[state] + self.space.at_points(new)).merged()
        name, amplitudes = self.coupling.system.STATES[state], (result.amplitudes / norm).tolist()
        found = result.records, tuple(amplitudes), result.residual / unit
        return EquationRecord(iteration, name, *found, change)

    def _source(self, state: int) -> RankOneSum:
        """G at the quadrature points: lagged terms, and own terms of the initial value."""
        parts = [self.space.product(term, self._points) for term in self.coupling.others[state]]
        parts += [self.space.product(term, self._start) for term in self.coupling.own[state]]
        source = RankOneSum.joined(parts, self.space.counts)
        if self.options.formulation == "volterra":
            first = self.space.time.integrated(source.factors[0])
            source = RankOneSum((first, *source.factors[1:]))
        return source.merged()

    def _distance(self, a: RankOneSum, b: RankOneSum) -> float:
        """Norm over slab and box of the difference of two functions given at the nodes."""
        roots = [np.asarray(np.linalg.cholesky(mass).T) for mass in self.space.masses]
        return (a - b).applied(roots).norm()

    def _compressed_loads(
        self, equation: Equation, loads: RankOneSum, tolerance: float
    ) -> RankOneSum:
        """Loads of lower rank, to a tolerance in the dual norm of the equation."""
        inverse = [np.asarray(np.linalg.inv(metric)) for metric in equation.metrics]
        nodal = compressed(loads.applied(inverse), equation.metrics, tolerance, self.options)
        return nodal.applied(equation.metrics)


def compressed(
    tensor: RankOneSum, metrics: Sequence[Array], tolerance: float, options: GreedyOptions
) -> RankOneSum:
    """Fewer products for a function given at nodes: the classic method with the identity.

    ``metrics`` (N_j, N_j) are the inner products of each dimension, ``tolerance`` is the norm of
    what may be lost.
    """
    stacks = tuple(metric[None] for metric in metrics)
    one, none = ((0,),) * len(stacks), ((),) * len(stacks)
    equation = Equation(stacks, one, none, tuple(metrics), tuple(map(len, metrics)))
    fast = replace(
        options, update="all", max_fixed_point=6, fixed_point_tolerance=1e-2, update_sweeps=2
    )
    return Enrichment(equation, tensor.applied(metrics), fast).run(tolerance).modes
