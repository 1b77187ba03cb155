"""Stacked trajectories as samples of an interpolation, and why one does not converge."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from rankone.solvers.engines.engine_options import CROSS
from rankone.solvers.request import Domain
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.arrays import ACCUMULATED, MANY_STATES, TINY, Array
from rankone.support.budget import (
    COPIES,
    OutOfBudgetError,
    OutOfWorkError,
    memory_left,
    reserve,
    work_done,
    work_left,
)
from rankone.tensors import Basis1D
from rankone.tensors.adaptive import LinePoints, needed
from rankone.tensors.cross import GrowingBasis
from rankone.tensors.time_grid import TimeGrid
from rankone.trajectories.integrators.diagnosis import first_to_end
from rankone.trajectories.integrators.integrator import Integrator, Tolerances
from rankone.trajectories.integrators.integrator_choice import following, integrator_for
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import SteepParameter


class TooManyTrajectories(Exception):
    """The limit of trajectories was met."""


class TrajectoryEnds(Exception):
    """The trajectory at a point (d,) cannot be integrated beyond ``time``."""

    def __init__(self, time: float, point: Array) -> None:
        super().__init__(time, point)
        self.time, self.point = time, point


class Trajectories:
    """Trajectories at parameter points, in units of the states' sizes.

    A trajectory is a vector (state, time node), scaled so that its norm is the root mean square
    over the nodes, and of many states over the states as well; what the basis misses of it is below
    the tolerance. ``allowed_error`` is that of the integration, in units of sizes, and
    ``tightness`` the first tolerance of the integration and of the basis over it: some trajectories
    of the reference are integrated together with the first ones, and their error then sets it.
    ``report`` is called after each batch with the part of a call that is done. ``highest_modes``
    (slabs,) are those in time, the largest of all trajectories, and ``work`` counts the operations;
    ``least_work`` is that of a trajectory in the cheapest stack that was stiff and not small.
    ``integrator`` is the option for further trajectories, and ``taken`` what has taken the last
    ones: those after the reference, unless a caller sets them.
    """

    def __init__(
        self,
        reference_set: ReferenceSet,
        grid: TimeGrid,
        allowed_error: float,
        tightness: float,
        most: int,
        workers: Workers | None = None,
        report: Callable[[float], None] | None = None,
    ) -> None:
        self.workers, self.report = workers or Workers(reference_set.system), report
        self.reference_set, self.grid, self.most = reference_set, grid, most
        self.allowed_error = allowed_error
        avoided = reference_set.reference.avoided
        self.calibrated = avoided > CROSS.explicit_step_limit
        self.stiff = self.calibrated or reference_set.system.at_point is not None
        self.tightness = CROSS.aimed_error_ratio if self.calibrated else tightness
        self.count, self.work, self.least_work = 0, 0.0, 0.0
        self._counted_work = 0.0
        self.integrator, self.taken = reference_set.taken, reference_set.reference.integrator
        self.scale = _norm_of_ones(grid.times.size, reference_set.states.size)
        self.units = reference_set.states * self.scale
        self.basis = GrowingBasis(self.units.size * grid.times.size)
        self.highest_modes = np.zeros(grid.slabs)

    def __call__(self, points: Array) -> Array:
        """Coefficients of the trajectories at points (m, d): shape (rank of the basis, m)."""
        if len(points) and np.array_equal(points, self.reference_set.lines):
            self._reserve(len(points))
            return self._coefficients(self._on_lines())
        if self.count + len(points) > self.most:
            raise TooManyTrajectories
        blocks, begun, before = [], 0, self.work
        for group in self._groups(points):
            least = CROSS.least_sample_ratio * self.least_work
            if least * (len(points) - begun) > work_left():
                raise OutOfWorkError
            begun += len(group)
            self._reserve(len(group))
            columns = self._integrated(group) if self.calibrated else self._calibrated(group)
            self.count += len(group)
            blocks.append(self._coefficients(columns))
        self._counted_work += self.work - before
        rank = len(blocks[-1])
        return np.concatenate([_with_rows(block, rank) for block in blocks], axis=1)

    def _coefficients(self, columns: Array) -> Array:
        """Coefficients of columns (n T, m), for which the basis grows: shape (rank, m)."""
        in_units = columns.reshape(self.units.size, -1, columns.shape[1])
        highest_modes = self.grid.highest_modes(in_units) * self.scale
        self.highest_modes = np.maximum(self.highest_modes, highest_modes)
        # steps may be more accurate than their tolerance, the basis must not be less
        lost = max(min(self.tightness, 1.0) * self.allowed_error, ACCUMULATED)
        return self.basis.coefficients(columns, lost)

    def _groups(self, points: Array) -> list[Array]:
        """Points whose columns are held at a time: few of many states, whole chunks of others."""
        numbers = self._read * self.grid.times.size
        held = min(CROSS.held_numbers, memory_left() / (8 * COPIES))
        size = max(int(held // numbers), self._chunk_size())
        return np.array_split(points, max(-(-len(points) // size), 1))

    def _reserve(self, count: int) -> None:
        """Raise an OutOfMemoryError if so many trajectories do not fit beside the basis."""
        times = self.grid.times.size
        numbers = COPIES * count * self._read * times + 2.0 * self.basis.vectors.size
        reserve(8 * numbers)

    @property
    def work_of_each(self) -> float:
        """Work of one of the trajectories that count."""
        return max(self._counted_work / max(self.count, 1), 1.0)

    @property
    def _read(self) -> int:
        """How many states of a trajectory are read."""
        observed = self.reference_set.observed
        return self.units.size if observed is None else max(len(observed.rows), 1)

    @property
    def sizes(self) -> Array:
        return self.reference_set.states

    def uncounted(self, points: Array) -> Array:
        """Trajectories at points (m, d) in units of the sizes: (n, T, m); they do not count."""
        return self._in_sizes(self._integrated(points))

    def states(self, coefficients: Array) -> Array:
        """States at the nodes from coefficients (rank, r): shape (n, T, r)."""
        columns = self.basis.columns(coefficients)
        states = columns.reshape(self.units.size, -1, coefficients.shape[1])
        return np.asarray(states * self.units[:, None, None])

    def _on_lines(self) -> Array:
        """The trajectories on lines that the reference has, (n T, m)."""
        states = self.reference_set.trajectories_on_lines(self.grid.times).transpose(0, 2, 1)
        scaled = states / self.units[:, None, None]
        return np.asarray(scaled.reshape(-1, states.shape[2]))

    def _calibrated(self, points: Array) -> Array:
        """The first trajectories, at a tolerance that brings the allowed error."""
        self.calibrated = True
        reference = self.reference_set.reference
        some = slice(CROSS.calibration_points)
        first, times = reference.of(some), self.grid.times
        exact = self.reference_set.seen(times, first(times), some) / self.sizes[:, None, None]
        exact_points = first.points
        before, ratio, used = math.inf, math.inf, self.tightness
        for calibration in range(CROSS.max_calibrations):
            columns = self._integrated(np.concatenate([exact_points, points]))
            self.count += len(exact_points) + (len(points) if calibration else 0)
            ours, columns = np.split(columns, [len(exact_points)], axis=1)
            errors = exact.swapaxes(1, 2) - self._in_sizes(ours)
            ratio = float(np.abs(errors).max()) / self.allowed_error
            if ratio > CROSS.reference_error_ratio * before:  # the reference's own error
                self.tightness = used
                break
            before, used = ratio, self.tightness
            if not CROSS.least_error_ratio <= ratio <= 1.0:
                factor = CROSS.aimed_error_ratio / max(ratio, TINY)
                factor = max(factor, CROSS.smallest_tightness_factor)
                self.tightness *= min(factor, CROSS.largest_tightness_factor)
            if ratio <= 1.0:
                break
        if ratio > 1.0 and reference.stiff:  # explicit steps do not come to the accuracy
            self.stiff, self.tightness = True, CROSS.aimed_error_ratio
            columns = self._integrated(points)
        return columns

    def _in_sizes(self, columns: Array) -> Array:
        """Trajectories (n T, m) in units of the sizes: shape (n, T, m)."""
        scaled = columns * self.scale
        return np.asarray(scaled.reshape(self.units.size, -1, columns.shape[1]))

    def _integrated(self, points: Array) -> Array:
        """Trajectories at the points, (n T, m).

        Trajectories of a chunk share their steps. So the chunks depend on the problem and on the
        number of points alone, and not on who integrates them.
        """
        reference_set, end = self.reference_set, self.grid.breaks[-1]
        cuts = (cut for cut in reference_set.cuts if cut < end)
        edges = [reference_set.domain.horizon[0], *cuts, end]
        tolerance = max(self.tightness * self.allowed_error, ACCUMULATED)
        least_sizes = CROSS.absolute_tolerance_ratio * reference_set.of_states
        floor = np.minimum(least_sizes, reference_set.reference.floor)
        least = np.maximum(reference_set.reference.rounded, reference_set.reference.least)
        absolute = np.maximum(tolerance * floor, least)
        chunks = np.array_split(points, max(-(-len(points) // self._chunk_size()), 1))
        integrator = integrator_for(
            reference_set.system,
            self.integrator,
            stiff=self.stiff,
            bearable_steps=CROSS.explicit_step_limit,
        )
        longest = reference_set.system.limit_of_steps
        tolerances = Tolerances(tolerance, absolute[:, None], longest)
        observed = reference_set.observed
        rows = None if observed is None else observed.rows
        common = (
            integrator,
            edges,
            tolerances,
            self.grid.times,
            self.units if rows is None else rows,
        )
        tasks = [(chunk, *common) for chunk in chunks]
        before = work_done()
        try:
            sampled = self.workers.map(_integrated, tasks, TrajectoryEnds, done=self.report)
            if self.stiff and 2 * len(points) >= self._chunk_size():
                work = (work_done() - before) / len(points)
                self.least_work = min(self.least_work or work, work)
            clock = reference_set.system.clock
            for (_, self.taken), chunk in zip(sampled, chunks, strict=True):
                self.integrator = following(self.integrator, self.taken, len(chunk), clock)
            pairs = zip(sampled, chunks, strict=True)
            columns = [x if rows is None else self._observed(x, chunk) for (x, _), chunk in pairs]
            return columns[0] if len(columns) == 1 else np.concatenate(columns, axis=1)
        finally:
            self.work += work_done() - before

    def _observed(self, states: Array, points: Array) -> Array:
        """What is observed of the states that it reads (k, T, m), in units: (n T, m)."""
        observed = self.reference_set.observed
        assert observed is not None
        return _in_units(observed.of_rows(self.grid.times, states, points), self.units)

    def _chunk_size(self) -> int:
        """Largest number of trajectories in a chunk."""
        if self.reference_set.system.user_functions:
            return CROSS.max_user_stack
        most = CROSS.max_stiff_stack if self.stiff else CROSS.max_stack
        states = self.reference_set.system.n_differential
        return min(max(CROSS.stack_states // states, CROSS.min_stack), most)


def _norm_of_ones(times: int, states: int) -> float:
    """The norm of a trajectory of ones before it is scaled.

    An error that all of many states share is not taken for a larger one.
    """
    return float(np.sqrt(times * max(states / MANY_STATES, 1.0)))


def _with_rows(block: Array, rank: int) -> Array:
    """Coefficients with zeros for the vectors by which the basis has grown since."""
    return np.pad(block, ((0, rank - len(block)), (0, 0)))


def _integrated(
    system: System,
    points: Array,
    integrator: Integrator,
    edges: list[float],
    tolerances: Tolerances,
    times: Array,
    units: Array | tuple[int, ...],
) -> tuple[Array, str]:
    """Trajectories at points (m, d) in units of states, (n T, m); the integrator.

    With a tuple for the units some rows of them as they are, (k, T, m).
    """
    sampled = integrator.sample(system, points, edges, tolerances, times)
    if sampled.reached < times.size or not np.isfinite(sampled.states).all():
        floor = tolerances.absolute
        ends = first_to_end(system, sampled.end, sampled.state, points, floor)
        raise TrajectoryEnds(sampled.end, points[ends])
    states = sampled.states.transpose(1, 0, 2)
    if isinstance(units, tuple):
        return states[list(units)], sampled.integrator
    return _in_units(states, units), sampled.integrator


def _in_units(states: Array, units: Array) -> Array:
    """States (n, T, m) in units (n,), one under the other: (n T, m)."""
    scaled = np.empty(states.shape)
    np.divide(states, units[:, None, None], out=scaled)
    return scaled.reshape(-1, states.shape[2])


# -----------------------------------------------------------------------------
# Why an interpolation does not converge, and how many nodes its worst points need.
#
# The modes of a train are means over the box and over time. Where a front is met in one corner
# alone, or at the end of the horizon, the errors there are a hundred times the tails of these
# means, and nodes that follow the means come too late. On a line through such a point the largest
# mode of a state at any time tells the error at that point.


@dataclass(frozen=True)
class WorstLines:
    """What lines through the worst points tell of the bases of an attempt.

    ``nodes`` are those that each parameter needs, and ``missed`` is the largest sum of modes that
    an attempt left out, in units of the sizes of states.
    """

    nodes: tuple[int, ...]
    missed: float

    def explain(self, error: float) -> bool:
        """Whether too few nodes are the reason of an error."""
        return self.missed > CROSS.explaining_share * error


@dataclass(frozen=True)
class LineLimits:
    """The most nodes of a line, and the most trajectories on all of them after the first ones."""

    nodes: int
    trajectories: float


def worst_lines(
    trajectories: Callable[[Array], Array],
    domain: Domain,
    bases: Sequence[Basis1D],
    points: Array,
    rtol: float,
    limits: LineLimits,
) -> WorstLines:
    """Draw lines of each parameter through points (m, d) of the box.

    The trajectories at points (k, d) are in units of the sizes of states: (n, T, k). Lines that
    their nodes do not resolve are drawn again with more, as far as the limits allow. Parameters
    with several elements keep their bases: these are halved where they do not suffice.
    """
    drawn = {
        j: replace(basis, degree=math.ceil(CROSS.line_node_ratio * basis.size))
        for j, basis in enumerate(bases)
        if basis.elements == 1
    }
    nodes, missed, most = [basis.size for basis in bases], 0.0, limits.trajectories
    lines = LinePoints(domain.box, domain.first_coordinates, through=points)
    while drawn and most >= 0.0:
        counts = [len(points) * basis.size for basis in drawn.values()]
        states = trajectories(lines([(j, basis.nodes) for j, basis in drawn.items()]))
        on_each = np.split(states, np.cumsum(counts)[:-1], axis=2)
        finer = dict[int, Basis1D]()
        for (j, basis), on_lines in zip(drawn.items(), on_each, strict=True):
            modes = (on_lines.reshape(-1, basis.size) * np.sqrt(basis.weights)) @ basis.to_modal.T
            tails = np.cumsum(np.abs(modes).max(axis=0)[::-1])[::-1]
            missed = max(missed, float(tails[bases[j].size]))
            small = np.flatnonzero(tails <= CROSS.known_functions_share * rtol)
            if small.size > 1:
                nodes[j] = int(small[0])
                continue
            nodes[j] = needed(tails, CROSS.known_functions_share * rtol)
            if basis.size < limits.nodes:
                degree = min(max(CROSS.more_nodes * basis.size, nodes[j]), limits.nodes)
                finer[j] = replace(basis, degree=degree)
        most -= len(points) * sum(basis.size for basis in finer.values())
        drawn = finer
    return WorstLines(tuple(nodes), missed)


# -----------------------------------------------------------------------------
# Why an interpolation does not converge: a parameter on which the solution depends steeply.


def steepest_front(
    trajectories: Callable[[Array], Array],
    system: System,
    domain: Domain,
    points: Sequence[Array],
) -> SteepParameter | None:
    """The narrowest front on lines through points (d,) of the box; None if there is none.

    Through each point goes one line for each parameter, up to the first jump that is still there
    at the end of the horizon. The trajectories at points (m, d) are in units of the states' sizes:
    shape (n, T, m).
    """
    fronts: list[tuple[float, SteepParameter]] = []
    with suppress(OutOfBudgetError):  # the fronts so far say it as well
        for point, j in itertools.product(points, range(len(domain.box))):
            for width, front in _on_line(trajectories, system, domain, point, j):
                if front.jump and front.at_end:
                    return front
                fronts.append((width, front))
    narrowest = min(
        fronts, key=lambda pair: (pair[0], not pair[1].at_end, -pair[1].change), default=None
    )
    return narrowest and narrowest[1]


def first_jump(
    trajectories: Callable[[Array], Array],
    system: System,
    domain: Domain,
    points: Sequence[Array],
    parameters: Sequence[int],
) -> SteepParameter | None:
    """The first jump on lines of some parameters through points (d,); None if there is none.

    The trajectories are as those of :func:`steepest_front`.
    """
    for point, j in itertools.product(points, parameters):
        for _, front in _on_line(trajectories, system, domain, point, j, zooms=1):
            if front.jump:
                return front
    return None


def _on_line(
    trajectories: Callable[[Array], Array],
    system: System,
    domain: Domain,
    point: Array,
    j: int,
    zooms: int = CROSS.max_zooms,
) -> Iterator[tuple[float, SteepParameter]]:
    """Relative widths and fronts on the line through a point along parameter j.

    First fronts that differ at the end of the horizon, then those that differ at any time, of each
    the ``zooms`` pairs of places that differ most. Widths are those in the coordinate in which the
    parameter is looked at first.
    """
    scale, box = domain.first_coordinates[j], domain.box[j]
    start, end = scale.to_scale(np.array(box)).tolist()
    width = end - start
    pairs = list(zip(system.parameters, point.tolist(), strict=True))
    fixed = (*pairs[:j], *pairs[j + 1 :])

    def changes(a: float, b: float, count: int) -> tuple[Array, Array]:
        """Places, and changes (n, T, count - 1) between them."""
        places = np.linspace(a, b, count)
        line = np.tile(point, (count, 1))
        line[:, j] = np.clip(scale.from_scale(places), *box)
        return places, np.abs(np.diff(trajectories(line), axis=2))

    places, coarse = changes(start, end, CROSS.line_places)
    for times in (slice(-1, None), slice(None)):
        for i in np.argsort(-coarse[:, times].max(axis=(0, 1)))[:zooms]:
            a, b, change = places[i], places[i + 1], coarse[:, times, i]
            if not change.max() >= CROSS.front_change:
                break
            while b - a > CROSS.jump_width * width:
                closer, fine = changes(a, b, CROSS.zoom_places)
                k = int(fine[:, times].max(axis=(0, 1)).argmax())
                if not fine[:, times, k].max() >= CROSS.kept_change * change.max():
                    break
                a, b, change = closer[k], closer[k + 1], fine[:, times, k]
            if b - a < CROSS.front_width * width:
                lower, upper = np.clip(scale.from_scale(np.array([a, b])), *box).tolist()
                yield (
                    (b - a) / width,
                    SteepParameter(
                        parameter=system.parameters[j],
                        unknown=system.states[int(change.max(axis=1).argmax())],
                        lower=lower,
                        upper=upper,
                        change=float(change.max()),
                        jump=bool((b - a) / width <= CROSS.jump_width),
                        at_end=change.shape[1] == 1,
                        others=fixed,
                    ),
                )
