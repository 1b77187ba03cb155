"""``method="greedy"``: slabs, check against SciPy, more nodes or a tighter tolerance."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rankone.discretization.finite_elements import LagrangeElements
from rankone.ir import SeparatedForm
from rankone.solvers.greedy.history import GreedySlabRecord
from rankone.solvers.greedy.lagging import LaggedSlab, SlabResult, compressed
from rankone.solvers.greedy.operators import ShapeSpace
from rankone.solvers.greedy.options import GreedyOptions
from rankone.solvers.greedy.terms import evaluation_order, source_terms
from rankone.solvers.outcome import Measured, Outcome, Status
from rankone.solvers.reference import Reference, check_points, integrate_reference, measure
from rankone.solvers.sensitivity import amplification
from rankone.solvers.train import TrainOptions
from rankone.solvers.train.nodes import first_bases
from rankone.system import System
from rankone.tensors.conversion import element_trains
from rankone.tensors.rank_one_sums import RankOneSum
from rankone.tensors.slab import SlabTrain

__all__ = ["solve_greedy"]

Array = NDArray[np.float64]

_BLOW_UP_FRACTION = 0.9
"""Part of the way to a blow-up that is still solved."""
_CONTRACTION = 1.0
"""Length of the first slab times the largest norm of the Jacobian."""
_SHORTEST = 1e-6
"""Shortest slab, relative to the horizon."""
_FEW_ITERATIONS, _MANY_ITERATIONS = 6, 12
"""Lagged iterations after which the next slab is longer, or shorter."""
_FINITE_ELEMENT_NODES = 41
_SHARE = 0.1
"""Tolerance of a slab relative to the error asked for, before the growth of errors."""


@dataclass
class _March:
    """Slabs of one attempt."""

    slabs: list[SlabTrain] = field(default_factory=list)
    records: list[GreedySlabRecord] = field(default_factory=list)
    limits: set[Status] = field(default_factory=set)
    stopped: Status | None = None
    time_tail: float = 0.0
    parameter_tails: Array = field(default_factory=lambda: np.zeros(0))
    measured: Measured | None = None
    error: float = math.inf


@dataclass(frozen=True)
class _Nodes:
    """Numbers of nodes in time and in each parameter."""

    time: int
    parameters: tuple[int, ...]


def solve_greedy(
    system: System,
    form: SeparatedForm,
    rtol: float,
    options: GreedyOptions | None = None,
    check: int = 24,
    report: Callable[[float, float, int, int, int], None] | None = None,
) -> Outcome:
    """Solve a generated system for the whole box by the classic method.

    Parameters
    ----------
    system : System
        The generated module.
    form : SeparatedForm
        The separated form it was generated from.
    rtol : float
        Largest measured error asked for, relative to the size of each unknown.
    options : GreedyOptions, optional
    check : int
        Number of random interior check points; 0 skips the check.
    report : callable, optional
        Called with (time, fraction of the horizon, attempt, slabs, rank) after each slab.

    Returns
    -------
    Outcome
        ``status`` is CONVERGED only if the measured error is within ``rtol``; ``history`` holds
        :class:`~rankone.solvers.greedy.history.GreedySlabRecord`.
    """
    solver = _Solver(system, form, rtol, options or GreedyOptions(), check, report)
    return solver.run()


class _Solver:
    """One solve: what stays the same over its attempts."""

    def __init__(
        self,
        system: System,
        form: SeparatedForm,
        rtol: float,
        options: GreedyOptions,
        check: int,
        report: Callable[[float, float, int, int, int], None] | None,
    ) -> None:
        self.system, self.rtol, self.options = system, rtol, options
        self.check, self.report = check, report
        self.timings = {"reference": 0.0, "march": 0.0, "check": 0.0}
        began = clock.perf_counter()
        self.box = np.array(system.BOX, dtype=float).reshape(-1, 2)
        self.start, horizon = system.TIME
        points = check_points(self.box, check)
        self.corners = len(points) - 1 - check if check else 0
        self.reference = integrate_reference(
            system, points, self.start, horizon, max(1e-3 * rtol, 3e-13)
        )
        self.end = self.reference.end
        if self.reference.blown is not None:
            self.end = self.start + _BLOW_UP_FRACTION * (self.end - self.start)
        self.sizes, self.stiffness = _sizes(system, self.reference, self.end)
        self.growth = amplification(system, self.reference, self.sizes, self.end)
        self.terms = source_terms(form)
        self.blocks = evaluation_order(self.terms, system.N_DIFFERENTIAL)
        self.timings["reference"] = clock.perf_counter() - began

    def run(self) -> Outcome:
        """Attempts until the measured error fits, or nothing more can be done."""
        share = _SHARE
        nodes = self._first_nodes()
        records: list[GreedySlabRecord] = []
        best: _March | None = None
        for attempt in range(self.options.max_attempts):
            began = clock.perf_counter()
            march = self._march(share * self.rtol, nodes, attempt)
            records += march.records
            self.timings["march"] += clock.perf_counter() - began
            began = clock.perf_counter()
            if march.slabs and self.check:
                march.measured = measure(march.slabs, self.reference, self.sizes, self.corners)
                march.error = max(march.measured.interior, default=0.0)
            self.timings["check"] += clock.perf_counter() - began
            stalled = best is not None and march.error > 0.7 * best.error
            if best is None or _better(march, best):
                best = march
            finer = self._finer(nodes, march)
            if not self.check or march.stopped or march.error <= self.rtol:
                break
            if (stalled or march.limits) and finer == nodes:
                break
            if finer == nodes and self.options.tolerance is not None:
                break
            nodes = finer
            share *= min(max(0.5 * self.rtol / march.error, 0.05), 0.5)
        assert best is not None
        return self._outcome(best, records)

    # --- discretisation ------------------------------------------------------------------------

    def _first_nodes(self) -> _Nodes:
        options, d = self.options, len(self.box)
        given = options.parameter_nodes
        if isinstance(given, tuple):
            parameters = given
        elif given is not None:
            parameters = (given,) * d
        elif options.elements != "legendre":
            parameters = (_FINITE_ELEMENT_NODES,) * d
        else:
            bases, _ = first_bases(self.system, self.box, self.rtol, TrainOptions(basis="legendre"))
            parameters = tuple(basis.degree for basis in bases)
        return _Nodes(options.time_nodes_for(self.rtol), parameters)

    def _finer(self, nodes: _Nodes, march: _March) -> _Nodes:
        """More nodes where they are not given and the highest modes are not small."""
        options = self.options
        limit = 0.1 * self.rtol
        if options.elements != "legendre":
            limit = 0.0
        time, parameters = nodes.time, nodes.parameters
        if options.time_nodes is None and march.time_tail > limit:
            time = _more(time)
        if options.parameter_nodes is None:
            parameters = tuple(
                _more(n) if tail > limit else n
                for n, tail in zip(parameters, march.parameter_tails, strict=True)
            )
        return _Nodes(time, parameters)

    def _elements(self, lower: float, upper: float, nodes: int) -> LagrangeElements:
        if self.options.elements == "legendre":
            return LagrangeElements(lower, upper, 1, nodes - 1)
        order = self.options.order
        return LagrangeElements(lower, upper, (nodes - 1) // order, order)

    # --- march over the slabs ------------------------------------------------------------------

    def _march(self, tolerance: float, nodes: _Nodes, attempt: int) -> _March:
        options = self.options
        march = _March(parameter_tails=np.zeros(len(self.box)))
        spaces = [self._elements(a, b, n) for (a, b), n in zip(self.box, nodes.parameters)]
        masses = [(s.values.T * s.weights) @ s.values for s in spaces]
        values = self._initial(spaces)
        horizon = self.end - self.start
        adaptive = options.time_slabs is None
        length = horizon if options.time_slabs is None else horizon / options.time_slabs
        if adaptive and max(map(len, self.blocks)) > 0 and self._lagged():
            length = min(length, _CONTRACTION / max(self.stiffness, 1e-300))
        time = self.start
        while self.end - time > 1e-9 * horizon:
            if len(march.records) >= options.max_slabs:
                march.stopped = Status.SLAB_LIMIT
                break
            remaining = self.end - time
            if adaptive:
                length = remaining / math.ceil(remaining / length - 1e-9)
            step_end = self.end if remaining < 1.01 * length else time + length
            level = options.tolerance or max(tolerance / self.growth(time), 1e-13)
            space = ShapeSpace(self.system, self._elements(time, step_end, nodes.time), spaces)
            slab = LaggedSlab(
                space, self.terms, self.blocks, values, self.sizes, self.system.STATES, options
            )
            with np.errstate(over="ignore", invalid="ignore"):
                result = slab.solve(level)
            accepted = result.converged or not adaptive
            march.records.append(
                self._record(result, attempt, time, step_end, accepted, level, nodes)
            )
            if not result.converged:
                if adaptive:
                    length *= 0.5
                    if length > _SHORTEST * horizon:
                        continue
                march.stopped = Status.NO_CONVERGENCE
                break
            if result.residual > level and any(
                modes.rank >= options.max_modes for modes in result.modes
            ):
                march.limits.add(Status.RANK_LIMIT)
            trains, tails = element_trains(
                space.bases, values, result.modes, 0.05 * level * self.sizes
            )
            march.slabs += trains
            march.time_tail = max(march.time_tail, float((tails[:, 0] / self.sizes).max()))
            march.parameter_tails = np.maximum(
                march.parameter_tails, (tails[:, 1:] / self.sizes[:, None]).max(axis=0)
            )
            values = [
                self._at_end(value, modes, masses, 0.2 * level * size)
                for value, modes, size in zip(values, result.modes, self.sizes, strict=True)
            ]
            time = step_end
            if self.report is not None:
                rank = max(train.ranks[0] if train.ranks else 1 for train in trains)
                done = (time - self.start) / horizon
                self.report(time, done, attempt, len(march.slabs), rank)
            if adaptive:
                count = len(result.changes)
                length *= (
                    1.5 if count <= _FEW_ITERATIONS else 0.7 if count > _MANY_ITERATIONS else 1
                )
        return march

    def _lagged(self) -> bool:
        """Whether any term is lagged within its block."""
        return any(len(block) > 1 for block in self.blocks) or any(
            term.equation in term.monomial and not term.own for term in self.terms
        )

    def _initial(self, spaces: Sequence[LagrangeElements]) -> list[RankOneSum]:
        """Initial values at the parameter nodes, one row of amplitudes for time."""
        rows = [self.system.parameter_factors(j, s.nodes) for j, s in enumerate(spaces)]
        sizes = (1, *(space.size for space in spaces))
        values: list[list[RankOneSum]] = [[] for _ in range(self.system.N_DIFFERENTIAL)]
        for coefficient, state, factors in self.system.INITIAL:
            columns = [row[index][:, None] for row, index in zip(rows, factors, strict=True)]
            values[state].append(RankOneSum((np.full((1, 1), coefficient), *columns)))
        return [RankOneSum.joined(parts, sizes) for parts in values]

    def _at_end(
        self, value: RankOneSum, modes: RankOneSum, masses: Sequence[Array], tolerance: float
    ) -> RankOneSum:
        """A state at the end of a slab, in few products; the tolerance is a mean square."""
        total = value + RankOneSum((modes.factors[0][-1:], *modes.factors[1:]))
        if len(total.factors) == 1 or total.rank <= 1:
            return total.merged()
        parameters = RankOneSum(total.factors[1:]).scaled(total.factors[0][0])
        if len(parameters.factors) == 1:
            column = parameters.merged().factors[0]
            return RankOneSum((np.ones((1, 1)), column))
        volume = math.prod(float(mass.sum()) for mass in masses)
        few = compressed(parameters, masses, tolerance * math.sqrt(volume), self.options).modes
        return RankOneSum((np.ones((1, few.rank)), *few.factors))

    def _record(
        self,
        result: SlabResult,
        attempt: int,
        start: float,
        end: float,
        accepted: bool,
        tolerance: float,
        nodes: _Nodes,
    ) -> GreedySlabRecord:
        return GreedySlabRecord(
            attempt,
            start,
            end,
            accepted and result.converged,
            tolerance,
            result.changes,
            tuple(modes.rank for modes in result.modes),
            (nodes.time, *nodes.parameters),
            result.records,
        )

    # --- the outcome ---------------------------------------------------------------------------

    def _outcome(self, best: _March, records: Sequence[GreedySlabRecord]) -> Outcome:
        blown = self.reference.blown
        if blown is not None:
            status = Status.BLOW_UP
        elif best.stopped is not None:
            status = best.stopped
        elif not self.check:
            status = Status.UNCHECKED
        elif best.error <= self.rtol:
            status = Status.CONVERGED
        else:
            status = Status.RANK_LIMIT if best.limits else Status.TOLERANCE
        blow_up = None
        if blown is not None:
            blow_up = self.reference.end, tuple(self.reference.points[blown].tolist())
        return Outcome(
            tuple(best.slabs),
            status,
            self._message(status, best),
            best.measured,
            tuple(records),
            self.timings,
            blow_up,
        )

    def _message(self, status: Status, best: _March) -> str:
        """How it ended, the figures, and what to do."""
        text = status.value
        if best.measured is not None:
            text += f": measured error {best.error:.1e}, asked {self.rtol:.1e}"
        if best.stopped is not None:
            last = best.records[-1]
            text += f"; stopped at t = {last.start:.6g}"
            if last.residuals:
                text += f" after {len(last.residuals)} lagged iterations, the last change "
                text += f"{last.residuals[-1]:.1e}"
        remedies = {
            Status.RANK_LIMIT: "raise max_modes, loosen rtol or use method='train'",
            Status.SLAB_LIMIT: "raise max_slabs, shorten the horizon or use method='train'",
            Status.NO_CONVERGENCE: "use more time_slabs, or method='train'",
            Status.TOLERANCE: "use more nodes, elements='legendre', or method='train'",
        }
        return f"{text}; {remedies[status]}" if status in remedies else text


def _better(new: _March, old: _March) -> bool:
    if (new.stopped is None) != (old.stopped is None):
        return new.stopped is None
    return new.error < old.error


def _more(nodes: int) -> int:
    return min(nodes + max(3, nodes // 3), 64)


def _sizes(system: System, reference: Reference, end: float) -> tuple[Array, float]:
    """Largest absolute value of each state and largest norm of the scaled Jacobian."""
    times = np.linspace(reference.start, end, 101)
    values = reference(times)
    sizes = np.abs(values).max(axis=(1, 2))
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    n, m, count = values.shape
    jacobian = system.jacobian(times, values, reference.points.T[:, :, None])
    jacobian = np.broadcast_to(jacobian, (n, n, m, count))
    scaled = np.abs(jacobian) * (sizes[None, :] / sizes[:, None])[:, :, None, None]
    return sizes, float(scaled.sum(axis=1).max())
