"""``method="greedy"``: march from slab to slab, check against SciPy, refine.

With a fixed number of slabs, an iteration that does not settle is accepted as it is, and the
outcome says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from rankone.solvers.attempts import Attempt, Marcher, Progress
from rankone.solvers.engines.engine_options import GREEDY, GreedyOptions
from rankone.solvers.engines.greedy_enrichment import Enrichment, ModeRecord
from rankone.solvers.engines.greedy_operators import (
    Equation,
    Nodes,
    RankOneSum,
    ShapeSpace,
    assemble,
    element_trains,
    evaluation_order,
    first_nodes,
    source_terms,
)
from rankone.solvers.march import (
    DIVERGED,
    FAST_FACTOR,
    REJECTED_FACTOR,
    SLOW_FACTOR,
    March,
    MarchResult,
    PlainNodes,
    SlabTrial,
    Span,
    amplification,
    interpolated,
    interpolated_initial,
)
from rankone.solvers.outcome import SlabRecord
from rankone.solvers.request import Domain, SolveRequest
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.solvers.ways import Engine
from rankone.support.arrays import ACCUMULATED, AT_ONCE, MINOR, NEGLIGIBLE, TINY, Array
from rankone.support.budget import COPIES, Report, memory_left, reserve
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Integers, Train
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import Cause, Status, UnsettledTerms


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
            inner = min(max(tolerance, GREEDY.inner_tolerance_share * largest), inner)
        return changes, False

    def _solve_equation(self, state: int, iteration: int, tolerance: float) -> EquationRecord:
        equation = self._equations[state]
        unit = float(self._units[state])
        source = self._source(state)
        loads = equation.loads(source)
        if loads.rank > GREEDY.max_source_rank:  # to a tolerance in the dual norm of the equation
            inverse = [np.asarray(np.linalg.inv(metric)) for metric in equation.metrics]
            limit, nodal = MINOR * tolerance * unit, loads.applied(inverse)
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
            bases, self._values, modes, GREEDY.loss_share * lost * self.sizes
        )
        self.tails = np.maximum(self.tails, (tails / self.sizes[:, None]).max(axis=0))
        self._values = [
            self._at_end(state, added, GREEDY.loss_share * lost * size)
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
        limits = GREEDY.loss_share * tolerance * self.sizes
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
        return self._of_train(interpolated(values, plain, GREEDY.loss_share * tolerance), tolerance)

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


# -----------------------------------------------------------------------------
# ``method="greedy"``: march, check against SciPy, more nodes or a tighter tolerance.


@dataclass
class SlabLengths:
    """The controller of the lengths of slabs; none crosses a cut (ascending times).

    If the lengths adapt, the first slab is no longer than ``longest``.
    """

    start: float
    end: float
    options: GreedyOptions
    longest: float = math.inf
    cuts: Sequence[float] = ()

    def __post_init__(self) -> None:
        self.horizon, count = self.end - self.start, self.options.time_slabs
        self.adaptive = count is None
        self.length = self.horizon / count if count else min(self.horizon, self.longest)
        self._hopeless = False

    def propose(self, start: float) -> Span | Status:
        """The next of equal slabs that fill what remains up to the end, or to the next cut."""
        if self._hopeless:
            return Status.NO_CONVERGENCE
        border = next((cut for cut in self.cuts if start < cut < self.end), self.end)
        remaining = border - start
        length = remaining / max(math.ceil(remaining / self.length - NEGLIGIBLE), 1)
        if border == self.end:
            self.length = length
        end = border if remaining < 1.01 * length else start + length
        return Span(start, length, end)

    def adapt(self, span: Span, trial: GreedyTrial) -> bool:
        """Halve after a rejection, lengthen where few iterations were needed."""
        if not trial.record.accepted:
            self.length = REJECTED_FACTOR * span.length
            self._hopeless = not self.adaptive or self.length <= NEGLIGIBLE * self.horizon
        elif self.adaptive:
            iterations = len(trial.record.residuals)
            factor = (
                FAST_FACTOR
                if iterations <= GREEDY.few_iterations
                else SLOW_FACTOR
                if iterations > GREEDY.many_iterations
                else 1.0
            )
            longer = span.length * (
                REJECTED_FACTOR if Status.RANK_LIMIT in trial.limits else factor
            )
            self.length = max(longer, self.length) if span.end in self.cuts else longer
        return trial.record.accepted


class GreedyMarcher(Marcher):
    """Marches with more nodes, then with tighter tolerances."""

    remedies: ClassVar[Mapping[Status, str]] = {
        Status.RANK_LIMIT: "raise max_modes, loosen rtol or use method='train'",
        Status.SLAB_LIMIT: "raise max_slabs, shorten the horizon or use method='train'",
        Status.NO_CONVERGENCE: "use more time_slabs, formulation='volterra', update='all' or "
        "method='train'",
        Status.TOLERANCE: "use more nodes, elements='legendre', or method='train'",
    }

    def __init__(
        self, request: SolveRequest, reference_set: ReferenceSet, workers: Workers
    ) -> None:
        self.rtol, self.options = request.rtol, request.options_of(GreedyOptions)
        self.reference_set = reference_set
        system, domain, sizes = reference_set.system, reference_set.domain, reference_set.states
        self.growth = amplification(reference_set)
        self.coupling = Coupling(system, sizes, self.options)
        lagged = any(map(self.coupling.lagged, self.coupling.blocks))
        self.longest = (
            GREEDY.first_slab_contraction / max(_stiffness(reference_set), TINY)
            if lagged
            else math.inf
        )
        self.nodes = first_nodes(system, domain, self.rtol, self.options)
        self.tails = np.zeros(1 + len(domain.box))
        self.share = GREEDY.tolerance_share

    def tolerance(self, time: float) -> float:
        """Tolerance of a slab, in units of the sizes."""
        return self.options.tolerance or max(
            self.share * self.rtol / self.growth(time), ACCUMULATED
        )

    def march(self, index: int, report: Report) -> MarchResult:
        """March with the present nodes and tolerance."""
        start, end = self.reference_set.reference.start, self.reference_set.end
        lengths = SlabLengths(start, end, self.options, self.longest, self.reference_set.cuts)
        domain = self.reference_set.domain
        slabs = LaggedSlabs(self.coupling, domain, self.nodes, self.tolerance, index)
        march = March(lengths, slabs, self.options.max_slabs).run(start, end, index, report)
        self.tails = slabs.tails
        return march

    def refine(self, attempt: Attempt, progress: Progress) -> bool:
        """More nodes where the highest modes are not small, else a tighter tolerance."""
        nodes, limits = self.nodes, attempt.result.limits
        stalls = 0 if progress.pays else progress.stalls
        self.nodes = nodes.finer(self.tails > GREEDY.tail_share * self.rtol, self.options)
        same = self.nodes == nodes
        stuck = stalls or limits or self.options.tolerance is not None
        if (stalls and limits) or (same and stuck):
            return False
        if same:
            self.share *= min(max(0.5 * self.rtol / attempt.error, 0.05), 0.5)
        return True

    def explained(self, status: Status, attempt: Attempt) -> tuple[Status, Cause | None]:
        """Say where the lagged terms settled least, if the iteration did not converge."""
        if status is not Status.NO_CONVERGENCE:
            return status, None
        worst = max(attempt.result.records, key=lambda record: record.residuals[-1])
        residuals = worst.residuals
        return status, UnsettledTerms(len(residuals), worst.start, worst.end, residuals[-1])


def _stiffness(reference_set: ReferenceSet) -> float:
    """Largest row sum norm of the Jacobian over the check points, in units of the sizes."""
    system, reference, sizes = reference_set.system, reference_set.reference, reference_set.states
    times = np.linspace(reference.start, reference_set.end, GREEDY.stiffness_samples)
    n, m = system.n_differential, len(reference.points)
    held = min(AT_ONCE, memory_left() / (8 * COPIES))
    together, largest = max(int(held // (n * n * m)), 1), 0.0
    reserve(8 * COPIES * n * n * m * together)
    for first in range(0, times.size, together):
        some = times[first : first + together]
        jacobian = system.jacobian(some, reference(some), reference.points.T[:, :, None])
        jacobian = np.broadcast_to(jacobian, (n, n, m, some.size))
        scaled = np.abs(jacobian) * (sizes[None, :] / sizes[:, None])[:, :, None, None]
        largest = max(largest, float(scaled.sum(axis=1).max()))
    return largest


ENGINE = Engine("greedy", GreedyOptions, GreedySlabRecord, GreedyMarcher)
