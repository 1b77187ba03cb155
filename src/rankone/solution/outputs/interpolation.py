"""From values of quantities at parameter points to a solution, and how good it is.

By adaptive cross interpolation, as the cross engine does it with trajectories. The error is that
of the interpolation, measured at further points, plus the effect of the solution's own error.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from rankone.compiler.codegen.layout import Quantities
from rankone.solution.evaluation.core import SolutionCore, timeline_evaluator
from rankone.solution.outputs.output_check import (
    Check,
    CheckPoints,
    critical_points,
    split,
    spread_over,
)
from rankone.solution.outputs.sampling import Sampler
from rankone.solution.outputs.stretch_sampling import ClockSampler, StretchSampler
from rankone.solvers.engines.engine_options import CrossOptions
from rankone.solvers.outcome import Measured, Outcome
from rankone.solvers.request import Domain
from rankone.support.arrays import AT_ONCE, COINCIDENT, MINOR, SAMPLES, TINY, Array
from rankone.support.budget import (
    OutOfBudgetError,
    OutOfTimeError,
    ProgressEvent,
    Report,
    budget_left,
    limited,
    quiet,
    seconds_left,
)
from rankone.support.errors import ConvergenceError
from rankone.support.options import RTOLS
from rankone.support.tasks import Pool
from rankone.tensors import BASES
from rankone.tensors.adaptive import (
    TUNING,
    AdaptiveInterpolation,
    InterpolationLimits,
    KnownElements,
    Tightening,
)
from rankone.tensors.cross import GrowingBasis
from rankone.tensors.slab import SlabTrain, slab_trains
from rankone.tensors.time_grid import TimeGrid, resolving_breaks
from rankone.tensors.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.system.timeline import Timeline
from rankone.trajectories.system.verdict import (
    Note,
    OutputError,
    Remedy,
    SharedUnit,
    Status,
    UnknownOutputError,
)

_OF_SOLUTION = Remedy("solve with a smaller rtol, or loosen that of the output")
_HARDLY = "what jumps or kinks as parameters change is hardly resolved"
_OF_INTERPOLATION = Remedy(f"raise effort, loosen rtol or restrict the solution; {_HARDLY}")

DEFAULT_MARGIN = 1.5  # Default tolerance over the effect of errors of the solution's tolerance
# Tolerances are tightened only when no nodes are added: attempts are cheap
_TIGHTENING = Tightening(settled_growth=1.0, power=1.0, smallest=0.05, largest=0.5)
_MAX_ATTEMPTS = 8  # Most interpolations: errors that do not fall by then belong to jumps
_DEAR_SHARE = 0.02  # Share of the budget from which on an attempt has to promise something
_TRAIN_SHARE = 0.7  # Share of the remaining budget for the interpolation
_TIME_PROBES = 12  # Points whose functions of time are resolved, besides the corners
_MAX_GRIDS = 4  # Most grids in time, each with further points to resolve
_ROUGHEST_POINTS = 8  # Points that each grid has to resolve besides those before it
_ROUGH_RATIO = 3.0  # Highest modes in time, over the error aimed at, that a grid may leave
_MAX_SLABS = 500  # Most slabs of a grid; more if the solution has more than half as many


@contextmanager
def _limited(operations: float, seconds: float) -> Iterator[None]:
    """Limit the work inside, and raise a ConvergenceError where it ends."""
    try:
        with limited(operations, seconds):
            yield
    except OutOfBudgetError as out:
        by_time = isinstance(out, OutOfTimeError)
        remedy = "give more time by max_seconds" if by_time else "raise effort"
        raise ConvergenceError(
            f"{Status.of_limit(out).value} before anything was interpolated",
            remedy=f"{remedy}, or restrict the solution",
        ) from None


@dataclass(frozen=True)
class Asked:
    """The tolerance of quantities, or None for the default, and limits of work and time."""

    rtol: float | None
    operations: float
    seconds: float = math.inf

    def share(self, count: int) -> Asked:
        """What is asked of each of so many interpolations."""
        return Asked(self.rtol, self.operations / count, self.seconds / count)


@dataclass(frozen=True)
class OutputInterpolation:
    """Quantities of a solution as trains over its box and horizon.

    Those of a solution with events that depend on time are over its stretches, or else over
    ``clock_time``. Errors are relative to the largest values, or to the ``least_sizes`` of the
    first quantities. Workers of a ``pool`` take parts of the points at which they are sampled.
    ``report`` is called as the sweeps of an attempt over the parameters go on.
    """

    solution: SolutionCore
    quantities: Quantities
    clock_time: bool = False
    least_sizes: tuple[float, ...] = ()
    pool: Pool | None = None
    report: Report = quiet
    options: CrossOptions = field(default_factory=CrossOptions)

    @property
    def _timeline(self) -> Timeline | None:
        """The timeline of the quantities, if they depend on time."""
        apart = self.quantities.timeless or self.clock_time
        return None if apart else self.solution.outcome.timeline_of_one_order("output")

    @property
    def domain(self) -> Domain:
        return Domain(self.solution.time, self.solution.metadata.box)

    def solve(self, asked: Asked) -> tuple[Outcome, float]:
        """The quantities as an outcome, and the tolerance.

        By default the tolerance is the effect of errors of the solution's tolerance, with a
        margin. The limits of work do not hold for the final measurement of the error. Raises a
        ConvergenceError if a limit is reached before there is any train.
        """
        solution, domain, rtol = self.solution, self.domain, asked.rtol
        points = CheckPoints.of(domain, self.quantities)
        with _limited(asked.operations, asked.seconds):
            # the error of the solution adds up with that of the interpolation
            grid = self._resolving_grid(MINOR * (rtol or solution.rtol), points)
            sampler, finer = self._sampler(grid), self._sampler(split(grid))
            points = points.where(sampler.holds)
            critical = critical_points(sampler, domain)
            critical = critical[sampler.holds(critical)]
            check = self._check(finer, np.concatenate([points.further, critical]))
            tolerances, shares = self._errors_of_sources(finer, check.points)
            amplified = check.amplified(finer, tolerances)
            if rtol is None:
                effect = float(amplified.sum(axis=0).max(initial=0.0))
                default = DEFAULT_MARGIN * max(solution.rtol, effect)
                rtol = min(default, max(max(RTOLS), solution.rtol))
            target = self._check(sampler, np.concatenate([points.aimed, critical]))
            with limited(_TRAIN_SHARE * budget_left(), _TRAIN_SHARE * seconds_left()):
                slabs, hopeless = self._best_trains(sampler, target, MINOR * rtol)
        from_solution = np.tensordot(shares, amplified, 1) + check.delayed(finer)
        missed = check.missed(slabs, finer) + sampler.narrow(check.points)
        if domain.box:
            climbed = check.climbed(slabs, finer, domain).missed(slabs, finer)
            missed[:, -1] = np.maximum(missed[:, -1], climbed.max(axis=1))
        if isinstance(finer, StretchSampler) and not self.quantities.timeless:
            missed = self._missed_over_clock_time(missed, slabs, finer, check)
        outcome = self._outcome(slabs, missed, from_solution, points.corners, rtol)
        return _with_honest_remedy(outcome) if hopeless else outcome, rtol

    def _errors_of_sources(self, sampler: Sampler, points: Array) -> tuple[Array, Array]:
        """The largest errors of sources that the solution's tolerance allows, and measured shares.

        Both have the shape (sources,). Shares of derivatives are not known.
        """
        solution, states, rtol = self.solution, self.solution.states, self.solution.rtol
        absolute = dict(solution.metadata.atol)
        for note in solution.outcome.notes:
            if isinstance(note, SharedUnit):
                absolute |= dict.fromkeys(note.unknowns, note.tolerance)
        atol = np.array([absolute.get(state, 0.0) for state in states])
        shares = np.array(list(solution.errors.values())) / rtol
        in_sums = sampler.largest_in_sums(points)
        errors = {row: rtol * size + atol[row] for row, size in in_sums.items()}
        allowed, measured = [], []
        for source, size in zip(
            self.quantities.sources, sampler.largest_sources(points), strict=True
        ):
            if source.row < len(states):
                allowed.append(rtol * size + atol[source.row])
                measured.append(shares[source.row] if source.is_state else np.nan)
                continue
            rows, numbers = zip(*self.quantities.sums[source.row - len(states)], strict=True)
            each = np.abs(numbers) * [errors[row] for row in rows]
            allowed.append(each.sum())
            measured.append(each @ shares[list(rows)] / max(each.sum(), np.finfo(float).tiny))
        return np.array(allowed), np.array(measured)

    def _check(self, sampler: Sampler, points: Array) -> Check:
        """Exact quantities at points, with the least sizes."""
        check = Check.at(sampler, points)
        least = np.zeros_like(check.sizes)
        least[: len(self.least_sizes)] = self.least_sizes
        return replace(check, sizes=np.maximum(check.sizes, least))

    def _missed_over_clock_time(
        self, missed: Array, slabs: tuple[SlabTrain, ...], sampler: StretchSampler, check: Check
    ) -> Array:
        """Errors (quantities + 2, m), at clock times as well.

        Infinite where the interpolation has no value and the solution has one.
        """
        timeline = self._timeline
        assert timeline is not None
        times = np.linspace(*timeline.horizon, SAMPLES)
        exact, compared = sampler.at_clock(times, check.points)
        points = np.ascontiguousarray(check.points.T)
        interpolated = timeline_evaluator(slabs, timeline).curves(
            times[:, None], points, slice(0, -2)
        )
        errors = np.nan_to_num(np.abs(interpolated - exact), nan=np.inf)
        errors = np.where(compared, errors, 0.0).max(axis=1)
        missed[:-2] = np.maximum(missed[:-2], errors / check.sizes[:-2, None])
        return missed

    def _sampler(self, grid: TimeGrid) -> Sampler:
        sampler = self._sampler_here(grid)
        sampler.pool = self.pool
        return sampler

    def _sampler_here(self, grid: TimeGrid) -> Sampler:
        solution = self.solution
        names, evaluator = solution.metadata.parameters, solution._evaluator
        if isinstance(evaluator, TimelineEvaluator) and self.clock_time:
            return ClockSampler(evaluator, names, self.quantities, grid, solution.rtol)
        if isinstance(evaluator, TimelineEvaluator):
            length = solution.metadata.horizon[1] - solution.metadata.horizon[0]
            measured = solution.outcome.measured
            error = None if measured is None else measured.time_error
            late = length * (solution.rtol if error is None else error)
            asked = names, self.quantities, grid, solution.rtol, late
            return StretchSampler(evaluator, *asked)
        return Sampler(solution.outcome.slabs, names, self.quantities, grid, solution.rtol)

    def _resolving_grid(self, level: float, points: CheckPoints) -> TimeGrid:
        """A grid that resolves the functions of time at corners, and where they are roughest."""
        corners = points.aimed[: points.corners]
        probes = np.concatenate([corners, spread_over(self.domain, _TIME_PROBES)])
        for _ in range(_MAX_GRIDS):
            grid = self._grid(level, probes)
            if self.solution.metadata.timeless:
                break
            rough = self._sampler(grid).roughness(points.aimed)
            worst = np.argsort(-rough)[:_ROUGHEST_POINTS]
            if rough[worst[0]] <= _ROUGH_RATIO * level:
                break
            probes = np.concatenate([probes, points.aimed[worst]])
        return grid

    def _grid(self, level: float, points: Array) -> TimeGrid:
        """Slabs that resolve the integrands, and quantities without reductions, at some points."""
        start, end = self.domain.horizon
        if self.solution.metadata.timeless:
            return TimeGrid((start, end), 1)
        slabs = self.solution.outcome.slabs
        starts = [] if self.clock_time else [slab.start for slab in slabs[1:]]
        if self.solution.outcome.timeline is not None and not self.clock_time:
            start, end = slabs[0].start, slabs[-1].end
            edges = sorted({start, *starts, *range(1, round(end)), end})
        else:
            limits = [
                x
                for reduction in self.quantities.reductions
                for x in (reduction.start, reduction.end)
                if isinstance(x, float)
            ]
            inside = {*starts, *limits, *self.quantities.cuts[0], *self._known_borders(points)}
            edges = [start, *sorted(x for x in inside if start < x < end), end]
        count = self.options.nodes_in_time(level)
        coarse = self._sampler(TimeGrid(tuple(edges), count))
        sampled = np.abs(coarse.at(coarse.grid.times, points))
        sizes = sampled.max(axis=(1, 2), where=np.isfinite(sampled), initial=0.0)
        units = np.maximum(sizes, TINY)[:, None, None]

        def in_units(times: Array) -> Array:
            exact = coarse.at(times, points) / units
            return np.asarray(np.nan_to_num(exact.swapaxes(1, 2), posinf=0.0, neginf=0.0))

        most, held = max(_MAX_SLABS, 2 * len(edges)), max(AT_ONCE // sampled[:, 0].size, 1)
        breaks = resolving_breaks(in_units, edges, count, level, most, held)
        return TimeGrid(tuple(edges) if breaks is None else breaks, count)

    def _known_borders(self, points: Array) -> list[float]:
        """Clock times at which a stretch ends at all points: states may jump there."""
        evaluator = self.solution._evaluator
        if not isinstance(evaluator, TimelineEvaluator):
            return []
        borders = evaluator.borders(np.ascontiguousarray(points.T))
        rounding = COINCIDENT * float(np.ptp(self.domain.horizon))
        return [float(np.median(row)) for row in borders if np.ptp(row) <= rounding]

    def _best_trains(
        self, sampler: Sampler, check: Check, level: float
    ) -> tuple[tuple[SlabTrain, ...], bool]:
        """Interpolate until the error at the points of a check is small; the best trains.

        And whether they were left because no effort would reach the level.
        """
        options, domain = self.options, self.domain
        columns = QuantityColumns(sampler, check.sizes, MINOR * level)
        limits = InterpolationLimits(BASES[options.basis], options.max_nodes, options.max_rank)
        scales = [basis.scale for basis in self.solution.outcome.slabs[0].bases]
        adaptive = AdaptiveInterpolation(domain.box, limits, level, _TIGHTENING, scales)
        known_elements = [KnownElements(borders) for borders in self.quantities.cuts[1:]]
        best: tuple[float, tuple[SlabTrain, ...]] | None = None
        errors, left, hopeless = list[float](), [budget_left()], False
        for attempt in range(_MAX_ATTEMPTS):

            def begun(done: int, total: int, rank: int, attempt: int = attempt) -> None:
                grid = columns.grid
                event = ProgressEvent(grid.breaks[0], done / total, attempt, grid.slabs, rank)
                self.report(event)

            try:
                train, _ = adaptive.interpolate(columns, lambda _: known_elements, begun)
            except OutOfBudgetError:
                if best is None:
                    raise
                break
            train = train.with_first(columns.quantities(train.first))
            slabs = slab_trains(columns.grid, train, adaptive.bases or ())
            missed = check.missed(slabs, sampler)
            if missed.max() <= level and domain.box:
                check = check.with_points(sampler, check.climbed(slabs, sampler, domain).points)
                missed = check.missed(slabs, sampler)
            error = float(missed.max())
            if best is None or error < best[0]:
                best = error, slabs
            errors.append(error)
            left.append(budget_left())
            hopeless = error > level and _is_out_of_sight(errors, left, level)
            if error <= level or not domain.box or hopeless:
                break
            worst = check.points[np.argsort(-missed.max(axis=0))[: TUNING.first_left_points]]
            adaptive.steep = adaptive.doubtful = worst
            adaptive.refine(error)
        assert best is not None
        return best[1], hopeless

    def _outcome(
        self,
        slabs: tuple[SlabTrain, ...],
        missed: Array,
        from_solution: Array,
        corners: int,
        rtol: float,
    ) -> Outcome:
        """Trains, and errors (quantities, m) at points of which the first are corners."""
        if np.isnan(from_solution).any():
            cause = UnknownOutputError(float(missed.max()))
            return Outcome(slabs, Status.UNCHECKED, None, (), cause=cause, timeline=self._timeline)
        total, time_error = missed + from_solution, None
        if self._timeline is not None:  # behind the quantities are the clock and the length
            before = self.solution.outcome.measured
            error_before = 0.0 if before is None else before.time_error or 0.0
            time_error = error_before + float(missed[-2].max())
            total, missed, from_solution = (each[:-2] for each in (total, missed, from_solution))
        measured = Measured(
            interior=tuple(map(float, total.max(axis=1))),
            corners=tuple(map(float, total[:, :corners].max(axis=1))) if corners else (),
            points=total.shape[1],
            method="solution",
            cover="box",
            time_error=time_error,
        )
        status = Status.CONVERGED if measured.error <= rtol else Status.TOLERANCE
        error = OutputError(float(missed.max()), float(from_solution.max()))
        notes: tuple[Note, ...] = (error,)
        if status is Status.TOLERANCE:
            worst = self.quantities.names[int(total.max(axis=1).argmax())]
            remedy = _OF_SOLUTION if error.solution > error.interpolation else _OF_INTERPOLATION
            notes = (replace(error, worst=worst), remedy)
        return Outcome(slabs, status, measured, (), notes=notes, timeline=self._timeline)


def _with_honest_remedy(outcome: Outcome) -> Outcome:
    """An outcome whose remedy is not more effort."""
    if outcome.measured is None or _OF_INTERPOLATION not in outcome.notes:
        return outcome
    enough = DEFAULT_MARGIN * outcome.measured.error
    looser = f"give rtol={enough:.1e}, or " if enough <= max(RTOLS) else ""
    remedy = Remedy(f"{looser}restrict the solution to where it is smooth; {_HARDLY}")
    notes = (remedy if note is _OF_INTERPOLATION else note for note in outcome.notes)
    return replace(outcome, notes=tuple(notes))


def _is_out_of_sight(errors: Sequence[float], left: Sequence[float], level: float) -> bool:
    """Whether attempts with these errors will not reach a level with what is left of the budget.

    They are expected to gain as much as the best of them, and to cost more and more as they did. As
    long as the next one is cheap it is worth a try. ``left`` is the budget before the first attempt
    and after each.
    """
    if len(errors) < 2 or not math.isfinite(left[0]):
        return False
    costs = [before - after for before, after in itertools.pairwise(left)]
    growth = max((costs[-1] / max(costs[0], 1.0)) ** (1.0 / (len(costs) - 1)), 1.0)
    if growth * costs[-1] <= _DEAR_SHARE * left[-1]:
        return False
    gain = max(before / after for before, after in itertools.pairwise(errors))
    further = math.log(min(errors) / level) / math.log(gain) if gain > 1.0 else math.inf
    if further > _MAX_ATTEMPTS - len(errors):
        return True
    return bool(costs[-1] * growth**further > left[-1])


class QuantityColumns:
    """Quantities at points as coefficients in a growing basis, in units of their sizes."""

    def __init__(self, sampler: Sampler, sizes: Array, tolerance: float) -> None:
        self.sampler, self.tolerance, self.grid = sampler, tolerance, sampler.grid
        if sampler.quantities.timeless:
            self.grid = TimeGrid(sampler.span, 1)
        self.units = sizes * np.sqrt(sampler.rows)
        self.basis = GrowingBasis(sizes.size * sampler.rows)

    def __call__(self, points: Array) -> Array:
        in_units = self.sampler(points) / self.units[:, None, None]
        return self.basis.coefficients(in_units.reshape(-1, len(points)), self.tolerance)

    def quantities(self, coefficients: Array) -> Array:
        """Quantities (quantities, rows, m) from coefficients (rank, m)."""
        columns = self.basis.columns(coefficients)
        shape = self.units.size, self.sampler.rows, coefficients.shape[1]
        return np.asarray(columns.reshape(shape) * self.units[:, None, None])
