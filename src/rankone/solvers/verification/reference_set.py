"""The reference set of a solve: trajectories, and the sizes of what is solved for."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.request import Domain, Observation, SolveRequest
from rankone.solvers.tuning import CHECK
from rankone.solvers.verification.cuts import Cuts, system_cuts
from rankone.solvers.verification.points import (
    FEW_PARAMETERS,
    active_points,
    cell_points,
    check_points,
    covers_corners,
    inside_jumps,
    surface_points,
)
from rankone.solvers.verification.reference import (
    Reference,
    integrate_reference,
    integration_edges,
    narrow_times,
    reference_accuracy,
)
from rankone.support.arrays import COINCIDENT, RESOLVED, Array, lobatto
from rankone.support.budget import OutOfWorkError, limited, work_left
from rankone.support.errors import ConvergenceError
from rankone.tensors.time_grid import times_within
from rankone.trajectories.events.sides import OrderError
from rankone.trajectories.integrators.integrator import SIZE_TIMES, SampledTrajectories, Tolerances
from rankone.trajectories.integrators.integrator_choice import (
    explicit_steps,
    following,
    integrator_for,
    stacked_work,
)
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.system.system import System
from rankone.trajectories.system.timeline import CLOCK_STATES
from rankone.trajectories.system.verdict import NumericallyZero, SharedUnit

# Periods between markers, and swings of the fastest state, over which it is as accurate: phases
# drift over more, and count by how fast the states are
_IN_STEP, _IN_TIME = 2, 200.0
_JUMP_SHARES = lobatto(4)  # The same between jumps, as shares


@dataclass(frozen=True)
class ReferenceSet:
    """Reference trajectories at the check points, and what is derived from them.

    The trajectories, of the relative tolerance ``accuracy``, begin at the centre, at ``corners``
    corners, ``on_lines`` points of lines that an engine begins with, and at interior points.
    Corners count like the other points if ``whole_box``; errors on lines count, but tell nothing of
    sizes and of what is usual. Without interior points nothing is ``checked``, and no error can be
    stated.

    ``cuts`` are the times at which the time factors jump, kink or are narrow, and at which states
    are reset; ``parameter_cuts`` belong to the factors of each parameter. ``counted`` are the
    states whose error counts, None for all. ``integrator`` and ``rtol`` are those of the solve.
    Where something is ``observed``, sizes and errors are those of its quantities. ``workers`` take
    part in the integration.
    """

    system: System
    domain: Domain
    accuracy: float
    reference: Reference
    corners: int
    whole_box: bool
    checked: bool
    cuts: tuple[float, ...] = ()
    parameter_cuts: tuple[Cuts, ...] = ()
    counted: tuple[int, ...] | None = None
    integrator: str = "auto"
    rtol: float = 0.0
    on_lines: int = 0
    observed: Observation | None = None
    workers: Workers | None = None

    @classmethod
    def of(
        cls,
        system: System,
        request: SolveRequest,
        lines: Array | None = None,
        workers: Workers | None = None,
    ) -> ReferenceSet:
        """Integrate the reference for a solve, and with it trajectories on ``lines`` (m, d)."""
        domain, check = request.domain, request.check
        in_time, *parameter_cuts = system_cuts(system, domain)
        cuts = _with_jumps(in_time.points, system, domain)
        if system.clock is not None:
            cuts = tuple(map(float, range(1, system.clock.order.stretches)))
        points, corners, on_lines = _points_of(system, request, parameter_cuts, lines)
        accuracy = reference_accuracy(request.rtol)
        if system.clock is not None and system.clock.in_step:
            periods = system.clock.order.stretches / system.clock.marks_per_period
            swings = max(system.clock.swings, 1.0)
            accuracy *= min(_IN_STEP / periods, _IN_TIME / swings, 1.0)
            accuracy = max(accuracy, reference_accuracy(0.0))
        reference_set = cls(
            system,
            domain,
            accuracy,
            integrate_reference(
                system,
                points,
                domain.edges(cuts),
                accuracy,
                request.integrator,
                workers,
                _states_read(system, check.states, request.observed),
            ),
            corners,
            covers_corners(request),
            bool(check.points),
            cuts,
            tuple(parameter_cuts),
            check.states if request.observed is None else None,
            request.integrator,
            request.rtol,
            on_lines,
            request.observed,
            workers,
        )
        reference_set._check_sizes()
        if request.observed is None or request.observed.states_alone:
            return reference_set
        return reference_set._resolving()

    def _resolving(self) -> ReferenceSet:
        """The same, more accurate where quantities lose digits of the states.

        A ConvergenceError where no trajectory is accurate enough: the difference of two states that
        are nearly equal has few of their digits.
        """
        assert self.observed is not None
        times = np.linspace(self.reference.start, self.end, CHECK.loss_samples)
        states = self.reference(times)
        signs = np.random.default_rng(20147).choice([-1.0, 1.0], (2, *states.shape[:2], 1))
        moved = [states + CHECK.loss_shift * self.of_states[:, None, None] * s for s in signs]
        exact = self.seen(times, states)
        changes = [np.abs(self.seen(times, each) - exact).max(axis=(1, 2)) for each in moved]
        loss = (np.max(changes, axis=0) / self.states).max() / CHECK.loss_shift
        accuracy = CHECK.loss_share * self.rtol / loss if loss > 0.0 else self.accuracy
        if accuracy >= self.accuracy:
            return self
        if accuracy < reference_accuracy(0.0):
            worst = self.names[int(np.argmax(np.max(changes, axis=0) / self.states))]
            raise ConvergenceError(
                f"the output `{worst}` loses the digits of the states that it is made of",
                remedy="loosen rtol, or make it an unknown with an equation of its own",
            )
        return self.at_accuracy(accuracy)

    def at_accuracy(self, accuracy: float) -> ReferenceSet:
        """The same with trajectories of another relative tolerance."""
        points, edges = self.reference.points, self.domain.edges(self.cuts)
        more = self.taken, self.workers, self.asked
        reference = integrate_reference(self.system, points, edges, accuracy, *more)
        return replace(self, accuracy=accuracy, reference=reference)

    def sampled_again(
        self, trajectories: NDArray[np.intp], times: Array, accuracy: float
    ) -> SampledTrajectories:
        """Some of the trajectories at times (T,), to another relative tolerance.

        LSODA makes them unless there are many states, or it creeps: it may take as much work as the
        stack that makes them then. No implicit step goes through a jump of the rates behind which a
        state is slow.
        """
        points = self.reference.points[trajectories]
        finest = accuracy * np.minimum(RESOLVED * self.of_states, self.reference.floor)
        absolute = np.maximum(np.maximum(finest, self.reference.least), self.reference.rounded)
        edges = integration_edges(self.system, points, self.domain.horizon, self.cuts)
        tolerances = Tolerances(accuracy, absolute[:, None], self.system.limit_of_steps)
        work = self.system, points, edges, tolerances, times
        choose = partial(integrator_for, self.system)
        if self.system.n_differential > CHECK.most_single_states:
            return choose(self.taken).sample(*work)
        # It may come to no end between events as well, or creep where a state passes zero
        most = self._stacked_work(len(points), times.size, accuracy)
        with (
            suppress(OrderError, OutOfWorkError),
            limited(min(most, CHECK.single_share * work_left())),
        ):
            samples = choose("single").sample(*work)
            if samples.reached == times.size:
                return samples
        return choose("stack").sample(*work)

    def _stacked_work(self, count: int, times: int, accuracy: float) -> float:
        """Operations that a stack of so many trajectories is expected to take."""
        clock = self.system.clock
        system = self.system if clock is None else clock.system
        steps = max(
            explicit_steps(system, dense, self.accuracy) for dense in self.reference.batches
        )
        return stacked_work(system, steps, (self.accuracy, accuracy), count, times)

    def with_points(self, points: Array) -> ReferenceSet:
        """The same with more interior points (m, d); the earlier ones are not integrated again."""
        edges = self.domain.edges(self.cuts)
        more = self.taken, self.workers, self.asked
        further = integrate_reference(self.system, points, edges, self.accuracy, *more)
        return replace(self, reference=self.reference.joined(further), checked=True)

    def without_lines(self) -> ReferenceSet:
        """The same but for trajectories on lines; not where a trajectory blows up."""
        if not self.on_lines:
            return self
        assert self.reference.blown is None
        before, after = slice(self.places_on_lines.start), slice(self.places_on_lines.stop, None)
        left = self.reference.of(before).joined(self.reference.of(after))
        return replace(self, reference=left, on_lines=0)

    @property
    def asked(self) -> tuple[int, ...] | None:
        """The states that somebody asks for, None for all."""
        return _states_read(self.system, self.counted, self.observed)

    @property
    def taken(self) -> str:
        """The option ``integrator`` for further trajectories, after those of the reference."""
        reference = self.reference
        clock, count = self.system.clock, len(reference.points)
        return following(self.integrator, reference.integrator, count, clock)

    @property
    def end(self) -> float:
        """End of what is to be solved: the horizon, or shortly before a blow-up."""
        start, end = self.reference.start, self.reference.end
        return end if self.reference.blown is None else start + CHECK.solved_share * (end - start)

    @cached_property
    def sizes(self) -> Array:
        """The sizes to which errors of each state, products included, are relative.

        These are the largest values, to which absolute tolerances over the relative one are added;
        one for a vanishing state.
        """
        sizes = self.largest.copy()
        sizes[: self.system.n_differential] += self.added
        return np.where(sizes > 0.0, sizes, 1.0)

    @cached_property
    def largest(self) -> Array:
        """Largest absolute value of each state, products included; one for a vanishing state.

        Over the centre and the interior points: states at corners of a box of many parameters may
        be larger by orders of magnitude and are seen by nobody. States that are numerically zero
        get a size of which their rounding errors are a small part.
        """
        start, end = self.reference.start, self.end
        times = np.linspace(start, end, SIZE_TIMES)
        for a, b in itertools.pairwise([start, *self.system.jumps.inside(start, end), end]):
            times = np.concatenate([times, times_within(a, b, _JUMP_SHARES)])
        blocks: Iterator[Array] = map(self.system.with_products, self.reference.blocks(times))
        if (clock := self.system.clock) is not None:  # what comes after the horizon does not count
            states = np.concatenate([*blocks], axis=2)
            now = states[len(self.system.unknowns) - CLOCK_STATES]
            blocks = iter([np.where(now <= clock.horizon[1], states, 0.0)])
        largest = _largest(blocks)
        sizes = np.asarray(self.interior(largest, axis=1).max(axis=1))
        if clock is not None and clock.in_step:
            self._size_clock(sizes, times, states)
        n = self.system.n_differential
        rounded = np.where(self.reference.zero, self.reference.rounded, 0.0)
        sizes[:n] = np.maximum(sizes[:n], rounded / self.accuracy)
        return sizes

    @cached_property
    def added(self) -> Array:
        """What absolute tolerances add to the sizes of the differential states."""
        absolute = self.system.tolerances(self.largest[: self.system.n_differential])
        return absolute / (self.rtol or 1.0)

    @property
    def added_to_seen(self) -> Array | float:
        """What they add to the sizes of what is solved for."""
        if self.observed is None:
            return self.added
        return self.added[[*self.observed.rows]] if self.observed.states_alone else 0.0

    def _size_clock(self, sizes: Array, times: Array, states: Array) -> None:
        """Let an error of the clock, and of lengths of stretches, count by what it does to states.

        ``states`` (n, m, T) are those at pseudo-times (T,); ``sizes`` (n,) are changed.
        """
        n = len(self.system.unknowns) - CLOCK_STATES
        points = np.ascontiguousarray(self.reference.points.T)[:, :, None]
        with np.errstate(all="ignore"):
            rates = self.system.rhs(times, states[: n + CLOCK_STATES], points)
            fastest = np.nan_to_num(np.abs(rates[:n] / rates[n])).max(axis=(1, 2))
        rates = fastest / np.where(sizes[:n] > 0.0, sizes[:n], 1.0)
        at_most = 1.0 / rates.max(initial=0.0)
        sizes[n : n + CLOCK_STATES] = np.minimum(sizes[n : n + CLOCK_STATES], at_most)

    @property
    def of_states(self) -> Array:
        """The sizes of the differential states."""
        return self.sizes[: self.system.n_differential]

    @property
    def states(self) -> Array:
        """The sizes of what is solved for: the differential states, or what is observed."""
        if self.observed is None:
            return self.of_states
        if self.observed.states_alone:
            return self.of_states[[*self.observed.rows]]
        return self._of_quantities

    @cached_property
    def _of_quantities(self) -> Array:
        """Largest absolute value of each quantity that is observed; one for a vanishing one."""
        even = np.linspace(self.reference.start, self.end, SIZE_TIMES)
        largest = _largest(self.quantities(np.concatenate([even, self.narrow_times])))
        sizes = self.interior(largest, axis=1).max(axis=1)
        return np.where(sizes > 0.0, sizes, 1.0)

    def quantities(self, times: Array) -> Iterator[Array]:
        """What is solved for at blocks of the times, (n, m, T) each."""
        blocks = np.array_split(times, -(-times.size // self.reference.times_held))
        return (self.seen(part, self.reference(part)) for part in blocks)

    @cached_property
    def narrow_times(self) -> Array:
        """When quantities are narrow on a trajectory, in order."""
        return narrow_times(self.reference, self.observed, self.end)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of what is solved for."""
        return self.system.states if self.observed is None else self.observed.names

    def seen(self, times: Array, states: Array, trajectories: slice = slice(None)) -> Array:
        """What is solved for of states (n, m, T) of some trajectories of the reference."""
        if self.observed is None:
            return states
        return self.observed.of_states(times, states, self.reference.points[trajectories])

    @property
    def interior_points(self) -> Array:
        """The centre and the interior points, (m, d)."""
        return self.interior(self.reference.points, axis=0)

    @property
    def shared(self) -> tuple[SharedUnit, ...]:
        """The unknowns asked for that are tiny beside others of their unit."""
        if not self.system.alike:
            return ()
        sizes = self.largest[: self.system.n_differential]
        return SharedUnit.of(self.system, sizes, self.rtol, self.asked)

    @property
    def zeros(self) -> tuple[NumericallyZero, ...]:
        """The unknowns asked for that are numerically zero."""
        unknowns, rounded = self.system.unknowns, self.reference.rounded
        asked = self.counted or range(len(unknowns))
        if self.observed is not None:
            asked = self.observed.rows if self.observed.states_alone else ()
        alike: dict[tuple[float, float], list[str]] = {}
        for i in asked:
            if self.reference.zero[i]:
                numbers = float(rounded[i]), float(self.of_states[i])
                alike.setdefault(numbers, []).append(unknowns[i])
        return tuple(
            NumericallyZero(names[0], *numbers, len(names) - 1) for numbers, names in alike.items()
        )

    @property
    def blow_up(self) -> tuple[float, tuple[float, ...]] | None:
        """Time and parameters near which a trajectory blows up."""
        if self.reference.blown is None:
            return None
        return self.reference.end, tuple(self.reference.points[self.reference.blown].tolist())

    @property
    def lines(self) -> Array:
        """The points of lines, (m, d)."""
        return self.reference.points[self.places_on_lines]

    def trajectories_on_lines(self, times: Array) -> Array:
        """What is solved for on the trajectories on lines, (n, m, T)."""
        lines = self.places_on_lines
        return self.seen(times, self.reference.of(lines)(times), lines)

    @property
    def places_on_lines(self) -> slice:
        return slice(1 + self.corners, 1 + self.corners + self.on_lines)

    def interior(self, array: Array, axis: int) -> Array:
        """What belongs to the centre and the interior points."""
        return np.delete(array, np.s_[1 : 1 + self.corners + self.on_lines], axis=axis)

    def _check_sizes(self) -> None:
        """Raise a ConvergenceError for states whose products are not floating-point numbers."""
        system = self.system
        if system.separated and max((len(states) for *_, states in system.terms), default=0) < 2:
            return
        asked = range(len(self.of_states)) if self.asked is None else self.asked
        for i, size in enumerate(self.of_states):
            small = (
                size <= CHECK.least_squared_size and i in asked
            )  # products of others vanish beside the rest
            if small or not size < 1.0 / CHECK.least_squared_size:
                atol = "give it an absolute tolerance, Problem(..., atol=...), or "
                raise ConvergenceError(
                    f"`{system.states[i]}` is of the size {size:.1e}: its products are not "
                    "floating-point numbers",
                    remedy=f"{atol if small else ''}change its unit",
                )


def _states_read(
    system: System, counted: tuple[int, ...] | None, observed: Observation | None
) -> tuple[int, ...] | None:
    """The states that are asked for, or that the quantities asked for read; None for all."""
    if system.clock is not None:
        return None
    return counted if observed is None else observed.rows


def _points_of(
    system: System, request: SolveRequest, parameter_cuts: Sequence[Cuts], lines: Array | None
) -> tuple[Array, int, int]:
    """Points (m, d) of a reference set; how many of them are corners, and how many on lines."""
    domain, count = request.domain, request.check.points
    few = len(domain.box) <= FEW_PARAMETERS
    cuts = [each.points for each in parameter_cuts] if count else ()
    beside = [each[:: max(1, -(-len(each) // CHECK.most_checked_cuts))] for each in cuts]
    points = check_points(
        domain.bounds,
        count,
        cuts=beside,
        every_corner=few or covers_corners(request),
        scales=domain.coordinates,
    )
    points = inside_jumps(points, system, domain)
    interior = 1 + count + 2 * sum(map(len, beside))
    corners = len(points) - interior if count and domain.box else 0
    if not count:
        return points, corners, 0
    if lines is None or (system.clock is not None and system.clock.forced is not None):
        lines = points[:0]
    outer, inner = np.split(points, [1 + corners])
    active, surfaces = active_points(system, domain), surface_points(system, domain)
    points = np.concatenate([outer, lines, inner, active, surfaces, cell_points(domain, cuts)])
    return points, corners, len(lines)


def _with_jumps(cuts: Sequence[float], system: System, domain: Domain) -> tuple[float, ...]:
    """The cuts, and the times of jumps in place of those that are the same except for rounding."""
    start, end = domain.horizon
    jumps = system.jumps.inside(start, end)
    near = COINCIDENT * max(abs(start), abs(end))
    apart = (cut for cut in cuts if all(abs(cut - time) > near for time in jumps))
    return tuple(sorted([*apart, *jumps]))


def _largest(blocks: Iterable[Array]) -> Array:
    """Largest absolute values over all times, (n, m), of blocks (n, m, T): one is held at a time.

    With little memory a block is a single time: then all their maxima are as much as all states.
    """
    return reduce(np.maximum, (np.abs(block).max(axis=2) for block in blocks))
