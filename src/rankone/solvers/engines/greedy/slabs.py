"""From slab to slab: shape functions, the lagged iteration, and the states at the end.

With a fixed number of slabs, an iteration that does not settle is accepted as it is, and the
outcome says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.solvers.engines.greedy.enrichment import Enrichment, ModeRecord
from rankone.solvers.engines.greedy.greedy_options import (
    TUNING,
    GreedyOptions,
)
from rankone.solvers.engines.greedy.operators import (
    Equation,
    Nodes,
    ShapeSpace,
    assemble,
    evaluation_order,
    source_terms,
)
from rankone.solvers.march import (
    DIVERGED,
    PlainNodes,
    SlabTrial,
    Span,
    interpolated,
    interpolated_initial,
)
from rankone.solvers.outcome import SlabRecord
from rankone.solvers.request import Domain
from rankone.support.arrays import Array
from rankone.tensors.trains.rank_one_sums import RankOneSum, element_trains
from rankone.tensors.trains.slab import SlabTrain
from rankone.tensors.trains.train import Integers, Train
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import Status


@dataclass(frozen=True, slots=True)
class EquationRecord:
    """One solve of the equation of a ``state`` with lagged terms, in units of the state's size.

    ``iteration`` counts the updates of the lagged terms from 0. ``modes`` are the enrichments in
    this solve: none if the modes of the iteration before sufficed. ``amplitudes`` are those of all
    modes afterwards, descending. ``residual``, which stops a loop, is tested with the shape
    functions or, with ``projection="minimal-residual"``, with the operator applied to them.
    ``change`` is the distance to the unknown of the iteration before.
    """

    iteration: int
    state: str
    modes: tuple[ModeRecord, ...]
    amplitudes: tuple[float, ...]
    residual: float
    change: float


@dataclass(frozen=True, slots=True)
class GreedySlabRecord(SlabRecord):
    """One slab of the classic method, with every solve of every equation, in order.

    ``residuals`` holds the largest change of a state in each update of the lagged terms, ``ranks``
    the number of modes of each state, ``nodes`` those in time and in the parameters.
    """

    equations: tuple[EquationRecord, ...] = ()


@dataclass(frozen=True)
class SlabResult:
    """The end of the lagged iteration on one slab.

    ``modes`` are the differences of the states from their initial values, at the nodes. The
    iteration is ``usable`` if it stayed bounded; its last iterate may still be far off.
    ``changes`` are the largest ones of a state in each iteration, in the slowest block of
    equations, and ``residual`` is the largest one at the end: both in units of the states' sizes.
    """

    modes: tuple[RankOneSum, ...]
    converged: bool
    usable: bool
    changes: tuple[float, ...]
    residual: float
    records: tuple[EquationRecord, ...]


class Coupling:
    """The equations of a system one by one, and the order in which they are solved.

    For each equation, ``own`` holds the terms of its operator and ``others`` those of its source.
    States of a block lag each other; the blocks are solved one after the other.
    """

    def __init__(self, system: System, sizes: Array, options: GreedyOptions) -> None:
        self.system, self.sizes, self.options = system, sizes, options
        terms, states = source_terms(system), range(system.n_differential)
        self.own = [[t for t in terms if t.equation == c and t.own] for c in states]
        self.others = [[t for t in terms if t.equation == c and not t.own] for c in states]
        self.blocks = evaluation_order(terms, len(states))

    def lagged(self, block: tuple[int, ...]) -> bool:
        """Whether any term of a block is lagged."""
        return len(block) > 1 or any(block[0] in term.monomial for term in self.others[block[0]])


class LaggedSlab:
    """The lagged iteration on one slab.

    It starts from the values of each state at the parameter nodes; the factor of time is one row
    of amplitudes.
    """

    def __init__(self, space: ShapeSpace, coupling: Coupling, start: Sequence[RankOneSum]) -> None:
        self.space, self.coupling, self.options = space, coupling, coupling.options
        self._equations = [assemble(space, own, self.options) for own in coupling.own]
        self._start = [space.constant_in_time(state) for state in start]
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
            usable = usable and bool(steps) and steps[-1] < DIVERGED
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
            if not largest < DIVERGED:
                return changes, False
            # an equation that was only solved coarsely has changes of that order
            if largest <= 2.0 * tolerance and inner == tolerance:
                return changes, True
            slow = len(changes) > 5 and changes[-1] > 0.8 * changes[-4]
            if slow and inner == tolerance:
                # what is left is the truncation of the modes, if it is small
                return changes, largest <= 20.0 * tolerance
            inner = min(max(tolerance, TUNING.inner_tolerance_share * largest), inner)
        return changes, False

    def _solve_equation(self, state: int, iteration: int, tolerance: float) -> EquationRecord:
        equation = self._equations[state]
        unit = float(self._units[state])
        source = self._source(state)
        loads = equation.loads(source)
        if loads.rank > TUNING.max_source_rank:  # to a tolerance in the dual norm of the equation
            inverse = [np.asarray(np.linalg.inv(metric)) for metric in equation.metrics]
            limit, nodal = 0.1 * tolerance * unit, loads.applied(inverse)
            loads = compressed(nodal, equation.metrics, limit, self.options)
            loads = loads.applied(equation.metrics)
        functional = None
        if self.options.projection == "minimal-residual":
            rows = zip(source.factors, self._scale, strict=True)
            functional = RankOneSum(tuple(f * row[:, None] for f, row in rows)).norm() ** 2
        before = self.modes[state]
        start, norm = before if self.options.update == "all" else None, float(self._norms[state])
        units = unit, norm
        enrichment = Enrichment(equation, loads, self.options, start, functional, units)
        enriched = enrichment.run(tolerance)
        modes = self.modes[state] = enriched.modes
        # the norm over slab and box of the difference of two functions given at the nodes
        roots = [np.asarray(np.linalg.cholesky(mass).T) for mass in self.space.masses]
        change = (before - modes).applied(roots).norm() / norm
        self._points[state] = (self._start[state] + self.space.at_points(modes)).merged()
        return EquationRecord(
            iteration,
            self.coupling.system.states[state],
            enriched.records,
            tuple((enriched.amplitudes / norm).tolist()),
            enriched.residual / unit,
            change,
        )

    def _source(self, state: int) -> RankOneSum:
        """G at the quadrature points: lagged terms, and own terms of the initial value."""
        terms = [self.space.product(term, self._points) for term in self.coupling.others[state]]
        terms += [self.space.product(term, self._start) for term in self.coupling.own[state]]
        source = RankOneSum.joined(terms, self.space.counts)
        if self.options.formulation == "volterra":
            first = self.space.time.integrated(source.factors[0])
            source = RankOneSum((first, *source.factors[1:]))
        return source.merged()


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


@dataclass(frozen=True)
class GreedyTrial(SlabTrial):
    """The lagged iteration on one slab, accepted or rejected."""

    space: ShapeSpace
    solved: SlabResult


@dataclass
class LaggedSlabs:
    """The slab solver of one attempt; ``tolerance`` at a time is in units of the sizes.

    For time and each parameter ``tails`` (1 + d,) holds the largest part of a state in the two
    highest modes.
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
        ranks = tuple(modes.rank for modes in solved.modes)
        full = max(ranks, default=0) >= self.options.max_modes
        if accepted and solved.residual > tolerance and full:
            limits.add(Status.RANK_LIMIT)
        place = self.attempt, span.start, span.end, accepted, tolerance
        sizes = tuple(basis.size for basis in space.bases)
        record = GreedySlabRecord(*place, solved.changes, ranks, sizes, solved.records)
        return GreedyTrial(record, limits, space, solved)

    def accept(self, span: Span, trial: GreedyTrial) -> list[SlabTrain]:
        """One train for each element in time; the next slab begins at the end of this one."""
        bases, modes, lost = trial.space.bases, trial.solved.modes, trial.record.tolerance
        trains, tails = element_trains(
            bases, self._values, modes, TUNING.loss_share * lost * self.sizes
        )
        self.tails = np.maximum(self.tails, (tails / self.sizes[:, None]).max(axis=0))
        self._values = [
            self._at_end(state, added, TUNING.loss_share * lost * size)
            for state, added, size in zip(self._values, modes, self.sizes, strict=True)
        ]
        kind = self.coupling.system.jumps.kind_at(span.end)
        if kind is not None and span.end < self.domain.horizon[1]:
            self._values = self._after_jump(kind, lost)
        return list(trains)

    def _initial(self) -> list[RankOneSum]:
        """Initial values at the parameter nodes; the factor of time is one row of amplitudes."""
        system = self.coupling.system
        if not system.initial_separates:
            train = interpolated_initial(system, [b.nodes for b in self.parameters])
            return self._of_train(train, self.tolerance(self.domain.horizon[0]))
        rows = [system.parameter_factors(j, basis.nodes) for j, basis in enumerate(self.parameters)]
        sizes = (1, *(basis.size for basis in self.parameters))
        terms: list[list[RankOneSum]] = [[] for _ in range(system.n_differential)]
        for coefficient, state, factors in system.initial_terms:
            columns = [row[index][:, None] for row, index in zip(rows, factors, strict=True)]
            terms[state].append(RankOneSum((np.full((1, 1), coefficient), *columns)))
        return [RankOneSum.joined(products, sizes) for products in terms]

    def _of_train(self, train: Train, tolerance: float) -> list[RankOneSum]:
        """The states of a train (n, r_1), ... with values at the nodes, in few products."""
        first, *parameters = train.cores
        if not parameters:
            return [RankOneSum((row[None, :],)) for row in first]
        states = (RankOneSum.of_train(row, parameters) for row in first)
        limits = TUNING.loss_share * tolerance * self.sizes
        return [self._compressed(s, limit) for s, limit in zip(states, limits, strict=True)]

    def _after_jump(self, kind: int, tolerance: float) -> list[RankOneSum]:
        """The states right after a jump, which acts at each parameter node on its own."""
        nodes = [basis.nodes for basis in self.parameters]

        def values(indices: Integers) -> Array:
            points = np.array([x[i] for x, i in zip(nodes, indices.T, strict=True)])
            before = np.array([state.at(indices) for state in self._values])
            return self.coupling.system.jumps.jumped(
                kind, before, points.reshape(len(nodes), len(indices))
            )

        plain = [PlainNodes(x.size) for x in nodes]
        return self._of_train(interpolated(values, plain, TUNING.loss_share * tolerance), tolerance)

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
