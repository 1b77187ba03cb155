"""The reference set of a solve, and errors measured against it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce

import numpy as np
from numpy.typing import NDArray

from rankone.ir.observation import Observation
from rankone.ir.outcome import Measured
from rankone.ir.request import Domain, SolveRequest
from rankone.ir.system import Clock, System
from rankone.ir.timeline import CLOCK_STATES
from rankone.ir.verdict import HiddenEvent, HiddenRate, NumericallyZero
from rankone.support.arrays import Array
from rankone.support.budget import OutOfWorkError, charge, limited, unlimited, work_left
from rankone.support.costs import Cost
from rankone.support.errors import ConvergenceError
from rankone.tensors.slab import SlabTrain, modes_in_time
from rankone.trajectories.choice import (
    explicit_steps,
    following,
    integrator_for,
    stacked_work,
)
from rankone.trajectories.events.event_order import OrderError
from rankone.trajectories.events.stretch_integrator import StretchTrajectories
from rankone.trajectories.integrator import SampledTrajectories, Tolerances
from rankone.trajectories.workers import Workers
from rankone.verification.clock import clock_errors, forced_errors
from rankone.verification.cuts import Cuts, system_cuts
from rankone.verification.hidden import hidden_rate, hidden_times
from rankone.verification.hidden_events import hidden_event
from rankone.verification.narrow import narrow_times
from rankone.verification.points import (
    FEW_PARAMETERS,
    active_points,
    cell_points,
    check_points,
    covers_corners,
    inside_jumps,
    surface_points,
    worst_apart,
)
from rankone.verification.reference import (
    Reference,
    integrate_reference,
    integration_edges,
    reference_accuracy,
)
from rankone.verification.resolution import NEGLIGIBLE

# Periods between markers, and swings of the fastest state, over which it is as accurate: phases
# drift over more, and count by how fast the states are
_IN_STEP, _IN_TIME = 2, 200.0
_SOLVED_SHARE = 0.9  # Part of the way to a blow-up that is still solved
_SIZE_SAMPLES = 201  # Evenly spaced times at which the sizes of the states are measured
_JUMP_SHARES = np.array([0.0, 0.3, 0.7, 1.0])  # The same between jumps, as shares
_LOSS_SAMPLES = 16  # Times at which it is measured how many digits quantities lose
_LOSS_SHIFT = 1e-6  # Relative change of the states by which that is measured
_LOSS_SHARE = 0.03  # Error of the reference, in quantities, over the tolerance
_SINGLE_SHARE = 0.15  # Most of what is left of the budget for finer trajectories by LSODA
_MOST_SINGLE_STATES = 200  # States up to which LSODA, whose matrices are dense, samples again
_LEAST_SIZE = 1e-140  # Size of a state below which its square is lost
_COINCIDENT = 1e-13  # Cuts this close to a jump, relative to the ends of the horizon, are that jump
_MOST_CHECKED_CUTS = 16  # Most cuts of a parameter that are checked on either side
_CHECK_SHARES = np.array([0.0, 0.13, 0.31, 0.5, 0.69, 0.87, 1.0])  # Checked times, in slab lengths
SAFE_QUANTILE = 0.95  # Part of the points whose errors the reported quantile bounds
# Operations of a least change that satisfies constraints, for each entry of their slopes
_CONSTRAINT_COST = Cost(50e3, 400.0)
_DRIFT_POINTS = 24  # Points at which lifted states are compared with what they stand for
_DRIFT_SHARES = np.array([0.0, 0.31, 0.69, 1.0])  # Compared times, in slab lengths


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
                domain.horizon,
                accuracy,
                cuts,
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
        times = np.linspace(self.reference.start, self.end, _LOSS_SAMPLES)
        states = self.reference(times)
        signs = np.random.default_rng(20147).choice([-1.0, 1.0], (2, *states.shape[:2], 1))
        moved = [states + _LOSS_SHIFT * self.of_states[:, None, None] * s for s in signs]
        exact = self.seen(times, states)
        changes = [np.abs(self.seen(times, each) - exact).max(axis=(1, 2)) for each in moved]
        loss = (np.max(changes, axis=0) / self.states).max() / _LOSS_SHIFT
        accuracy = _LOSS_SHARE * self.rtol / loss if loss > 0.0 else self.accuracy
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
        points, edges = self.reference.points, (self.domain.horizon, accuracy, self.cuts)
        more = self.taken, self.workers, self.asked
        reference = integrate_reference(self.system, points, *edges, *more)
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
        finest = accuracy * np.minimum(NEGLIGIBLE * self.of_states, self.reference.floor)
        absolute = np.maximum(np.maximum(finest, self.reference.least), self.reference.rounded)
        edges = integration_edges(self.system, points, self.domain.horizon, self.cuts)
        work = self.system, points, edges, Tolerances(accuracy, absolute[:, None]), times
        choose = partial(integrator_for, self.system, accuracy=accuracy)
        if self.system.n_differential > _MOST_SINGLE_STATES:
            return choose(self.taken).sample(*work)
        # It may come to no end between events as well, or creep where a state passes zero
        most = self._stacked_work(len(points), times.size, accuracy)
        with suppress(OrderError, OutOfWorkError), limited(min(most, _SINGLE_SHARE * work_left())):
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
        edges = self.domain.horizon, self.accuracy, self.cuts
        more = self.taken, self.workers, self.asked
        further = integrate_reference(self.system, points, *edges, *more)
        return replace(self, reference=self.reference.joined(further), checked=True)

    def without_lines(self) -> ReferenceSet:
        """The same but for trajectories on lines; not where a trajectory blows up."""
        if not self.on_lines:
            return self
        assert self.reference.blown is None
        before, after = slice(self._on_lines.start), slice(self._on_lines.stop, None)
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
        return end if self.reference.blown is None else start + _SOLVED_SHARE * (end - start)

    @cached_property
    def sizes(self) -> Array:
        """Largest absolute value of each state, products included; one for a vanishing state.

        Absolute tolerances over the relative one are added.
        Over the centre and the interior points: states at corners of a box of many parameters may
        be larger by orders of magnitude and are seen by nobody. States that are numerically zero
        get a size of which their rounding errors are a small part.
        """
        start, end = self.reference.start, self.end
        times = np.linspace(start, end, _SIZE_SAMPLES)
        for a, b in itertools.pairwise([start, *self.system.jumps.inside(start, end), end]):
            times = np.concatenate([times, times_within(a, b, _JUMP_SHARES)])
        blocks: Iterator[Array] = map(self.system.with_products, self.reference.blocks(times))
        if (clock := self.system.clock) is not None:  # what comes after the horizon does not count
            states = np.concatenate([*blocks], axis=2)
            now = states[len(self.system.unknowns) - CLOCK_STATES]
            blocks = iter([np.where(now <= clock.horizon[1], states, 0.0)])
        largest = _largest(blocks)
        sizes = np.asarray(self._interior(largest, axis=1).max(axis=1))
        if clock is not None and clock.in_step:
            self._size_clock(sizes, times, states)
        n = self.system.n_differential
        rounded = np.where(self.reference.zero, self.reference.rounded, 0.0)
        sizes[:n] = np.maximum(sizes[:n], rounded / self.accuracy) + self._added
        return np.where(sizes > 0.0, sizes, 1.0)

    @cached_property
    def _added(self) -> Array:
        """What absolute tolerances add to the sizes of the differential states."""
        absolute = dict(self.system.atol)
        names = self.system.states[: self.system.n_differential]
        return np.array([absolute.get(name, 0.0) / (self.rtol or 1.0) for name in names])

    @property
    def _added_to_seen(self) -> Array | float:
        """What they add to the sizes of what is solved for."""
        if self.observed is None:
            return self._added
        return self._added[[*self.observed.rows]] if self.observed.states_alone else 0.0

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
        even = np.linspace(self.reference.start, self.end, _SIZE_SAMPLES)
        largest = _largest(self._quantities(np.concatenate([even, self._narrow_times])))
        sizes = self._interior(largest, axis=1).max(axis=1)
        return np.where(sizes > 0.0, sizes, 1.0)

    def _quantities(self, times: Array) -> Iterator[Array]:
        """What is solved for at parts of the times, (n, m, T) each."""
        parts = np.array_split(times, -(-times.size // self.reference.times_held))
        return (self.seen(part, self.reference(part)) for part in parts)

    @cached_property
    def _narrow_times(self) -> Array:
        """When quantities are narrow on a trajectory, in order."""
        crossed = narrow_times(self.reference, self.observed, self.end)
        if self.observed is None or self.system.clock is not None:
            return crossed
        hidden = hidden_times(self.reference, self.observed, self.rtol)
        return np.unique(np.concatenate([crossed, hidden[hidden < self.end]]))

    @property
    def names(self) -> tuple[str, ...]:
        """The names of what is solved for."""
        return self.system.states if self.observed is None else self.observed.names

    def seen(self, times: Array, states: Array, trajectories: slice = slice(None)) -> Array:
        """What is solved for of states (n, m, T) of some trajectories of the reference."""
        if self.observed is None:
            return states
        return self.observed.of_states(times, states, self.reference.points[trajectories])

    def measured(self, slabs: Sequence[SlabTrain]) -> Measured | None:
        """Errors of the slabs over their whole time span; None without check or slabs.

        They are in units of the sizes; at corners, of the largest size there if that is larger.
        """
        if not slabs or not self.checked:
            return None
        reference, m = self.reference, len(self.reference.points)
        corners, unknowns = slice(1, 1 + self.corners), len(self.system.unknowns)
        if self.observed is not None:
            unknowns = len(self.names)
        all_times = [times_within(slab.start, slab.end, _CHECK_SHARES) for slab in slabs]
        if (clock := self.system.clock) is not None:
            return self._over_clock_time(clock, slabs)
        with unlimited():
            errors, largest = np.zeros((self.states.size, m)), self.states
            off = np.zeros_like(errors)
            carried = with_contractions(slabs, reference.points)
            count = _CHECK_SHARES.size
            all_exact = (
                exact
                for block in reference.blocks(np.concatenate(all_times), count)
                for exact in np.split(block, block.shape[2] // count, axis=2)
            )
            all_modes = modes_in_time(slabs, all_times)
            for (slab, contraction), times, modes, exact in zip(
                carried, all_times, all_modes, all_exact, strict=True
            ):
                exact = self.seen(times, exact)
                states = slab.on_grid(times, contraction, modes)
                errors = np.maximum(errors, np.abs(states - exact).max(axis=2))
                off = np.maximum(off, self._off_constraints(times, states))
                at_corners = np.abs(exact[:, corners]).max(axis=(1, 2), initial=0.0)
                at_corners += self._added_to_seen
                largest = np.maximum(largest, at_corners)
                at_narrow = self._narrow_errors(slab, contraction)
                errors = np.maximum(errors, at_narrow)
        units = np.repeat(self.states[:, None], m, axis=1)
        units[:, corners] = largest[:, None]
        errors = (np.where(np.isfinite(errors), errors, np.inf) / units)[:unknowns]
        return self._measured(errors, (off / units)[:unknowns])

    def _narrow_errors(self, slab: SlabTrain, contraction: Array) -> Array | float:
        """Largest errors of quantities where they are narrow inside a slab, (n, m)."""
        times = self._narrow_times
        times = times[(times >= slab.start) & (times < slab.end)]
        if not times.size:
            return 0.0
        exact = np.concatenate([*self._quantities(times)], axis=2)
        return np.asarray(np.abs(slab.on_grid(times, contraction) - exact).max(axis=2))

    def _off_constraints(self, times: Array, states: Array) -> Array:
        """How far states (n, m, T) are from satisfying the constraints, at most: (n, m)."""
        constraints, (n, m, count) = self.system.constraints, states.shape
        if not constraints.names or self.observed is not None:
            return np.zeros((n, m))
        charge(_CONSTRAINT_COST(m * count * n * len(constraints.names)))
        columns = np.repeat(self.reference.points.T, count, axis=1)
        flat = states.reshape(n, m * count)
        off = constraints.distances(np.tile(times, m), flat, columns, self.states)
        return np.asarray(off.reshape(n, m, count).max(axis=2))

    def _over_clock_time(self, clock: Clock, slabs: Sequence[SlabTrain]) -> Measured:
        """Errors of slabs over stretches, over clock time, in units of the sizes over it."""
        unknowns = len(self.system.unknowns)
        slabs = [slab.with_first(slab.cores[0][:unknowns]) for slab in slabs]
        if clock.forced is not None:
            return self._of_forced(clock, slabs)
        with unlimited():
            errors = clock_errors(self.reference, clock, slabs, self.rtol)
        largest = errors.largest + self._added[: len(errors.largest), None]
        interior = self._interior(largest, axis=1).max(axis=1)
        units = np.repeat(np.where(interior > 0.0, interior, 1.0)[:, None], largest.shape[1], 1)
        corners = slice(1, 1 + self.corners)
        at_corners = np.maximum(interior, largest[:, corners].max(axis=1, initial=0.0))
        units[:, corners] = np.where(at_corners > 0.0, at_corners, 1.0)[:, None]
        measured = self._measured(errors.states / units, errors.off_constraints / units)
        at_shares = float((errors.at_shares / units).max())
        return replace(measured, time_error=errors.time, share_error=at_shares)

    def _of_forced(self, clock: Clock, slabs: Sequence[SlabTrain]) -> Measured:
        """Errors of slabs of a forced order; those of its guards and times count for each state."""
        with unlimited():
            errors, largest = forced_errors(self.reference, clock, slabs)
        units = largest.max(axis=1, keepdims=True)
        units = np.where(units > 0.0, units, 1.0)
        units[-CLOCK_STATES:] = clock.length
        relative, n = errors / units, clock.n_states
        of_states = np.maximum(relative[:n], relative[n:].max(axis=0))
        return self._measured(of_states, np.zeros_like(of_states))

    def _measured(self, errors: Array, off: Array) -> Measured:
        """What errors (unknowns, m) in units of the sizes amount to.

        The distances ``off`` from where constraints hold are errors as well.
        """
        drift = float(off.max(initial=0.0)) if self._has_constraints else None
        errors = np.maximum(errors, off)
        reference, m, corners = self.reference, errors.shape[1], slice(1, 1 + self.corners)
        counts = np.ones(m, dtype=bool)
        counts[corners] = self.whole_box
        of_states = errors if self.counted is None else errors[list(self.counted)]
        of_points = of_states[:, counts].max(axis=0)
        corner_errors = errors[:, corners].max(axis=1, initial=0.0)
        spread = counts.copy()
        spread[self._on_lines] = False
        worst, *also_bad = worst_apart(self.domain, reference.points[counts], of_points)
        return Measured(
            interior=tuple(errors[:, counts].max(axis=1).tolist()),
            corners=tuple(corner_errors.tolist()) if self.corners else (),
            points=m,
            method=reference.method,
            cover="box" if self.whole_box else "interior",
            quantile=float(np.quantile(of_points[spread[counts]], SAFE_QUANTILE, method="higher")),
            worst=worst,
            also_bad=tuple(also_bad),
            counted=self.counted,
            integrator=reference.integrator,
            constraint_drift=drift,
        )

    @property
    def _has_constraints(self) -> bool:
        clock = self.system.clock
        system = self.system if clock is None else clock.system
        return bool(system.constraints.names) and self.observed is None

    @property
    def interior_points(self) -> Array:
        """The centre and the interior points, (m, d)."""
        return self._interior(self.reference.points, axis=0)

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

    def hidden(self) -> HiddenRate | HiddenEvent | None:
        """Where steps of the trajectories miss something narrow, if they do."""
        rate = hidden_rate(self.reference, self.system, self.of_states, self.rtol)
        return rate or self._hidden_event()

    def _hidden_event(self) -> HiddenEvent | None:
        """Where they miss an event, if they do."""
        clock, points = self.system.clock, self.reference.points
        if clock is None:
            return None
        first = 0
        for batch in self.reference.batches:
            count = batch.state.shape[1]
            own, first = points[first : first + count], first + count
            if isinstance(batch, StretchTrajectories):
                event = hidden_event(
                    clock.system, batch.trajectories, own, clock.horizon, self.rtol
                )
                if event is not None:
                    return event
        return None

    @property
    def blow_up(self) -> tuple[float, tuple[float, ...]] | None:
        """Time and parameters near which a trajectory blows up."""
        if self.reference.blown is None:
            return None
        return self.reference.end, tuple(self.reference.points[self.reference.blown].tolist())

    @property
    def lines(self) -> Array:
        """The points of lines, (m, d)."""
        return self.reference.points[self._on_lines]

    def trajectories_on_lines(self, times: Array) -> Array:
        """What is solved for on the trajectories on lines, (n, m, T)."""
        return self.seen(times, self.reference.of(self._on_lines)(times), self._on_lines)

    @property
    def _on_lines(self) -> slice:
        return slice(1 + self.corners, 1 + self.corners + self.on_lines)

    def _interior(self, array: Array, axis: int) -> Array:
        """What belongs to the centre and the interior points."""
        return np.delete(array, np.s_[1 : 1 + self.corners + self.on_lines], axis=axis)

    def _check_sizes(self) -> None:
        """Raise a ConvergenceError for states whose products are not floating-point numbers."""
        system = self.system
        if system.separated and max((len(states) for *_, states in system.terms), default=0) < 2:
            return
        asked = range(len(self.of_states)) if self.asked is None else self.asked
        for i, size in enumerate(self.of_states):
            small = size <= _LEAST_SIZE and i in asked  # products of others vanish beside the rest
            if small or not size < 1.0 / _LEAST_SIZE:
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
    beside = [each[:: max(1, -(-len(each) // _MOST_CHECKED_CUTS))] for each in cuts]
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
    near = _COINCIDENT * max(abs(start), abs(end))
    apart = (cut for cut in cuts if all(abs(cut - time) > near for time in jumps))
    return tuple(sorted([*apart, *jumps]))


def _largest(blocks: Iterable[Array]) -> Array:
    """Largest absolute values over all times, (n, m), of blocks (n, m, T): one is held at a time.

    With little memory a block is a single time: then all their maxima are as much as all states.
    """
    return reduce(np.maximum, (np.abs(block).max(axis=2) for block in blocks))


def times_within(start: float, end: float, shares: Array) -> Array:
    """Times at shares of a slab; at its end, where states may jump, the last number before it."""
    return np.asarray(np.minimum(start + (end - start) * shares, np.nextafter(end, start)))


def with_contractions(
    slabs: Sequence[SlabTrain], points: Array
) -> Iterator[tuple[SlabTrain, Array]]:
    """Each slab with its trains over the parameters at points (m, d), made once if shared."""
    last, contraction = None, points
    for slab in slabs:
        if last is None or not slab.shares_parameters(last):
            last, contraction = slab, slab.over_parameters(points.T)
        yield slab, contraction


def drift(system: System, domain: Domain, slabs: Sequence[SlabTrain]) -> float:
    """Largest difference between lifted states and what they stand for, relative to their sizes.

    ``s`` for ``sin(x)`` and ``c`` for ``cos(x)`` are on the circle as long as both stay sine and
    cosine of the ``x`` that is solved for with them.
    """
    points = check_points(domain.bounds, _DRIFT_POINTS, scales=domain.coordinates)
    count = system.n_lifted
    size, worst = np.zeros(count), np.zeros(count)
    for slab, contraction in with_contractions(slabs, points):
        times = times_within(slab.start, slab.end, _DRIFT_SHARES)
        states = slab.on_grid(times, contraction)
        lifted, meant = states[-count:], system.meanings(times, states, points.T[:, :, None])
        size = np.maximum(size, np.abs(lifted).max(axis=(1, 2)))
        worst = np.maximum(worst, np.abs(lifted - meant).max(axis=(1, 2)))
    return float(np.nan_to_num(worst / np.where(size > 0.0, size, 1.0), nan=np.inf).max())
