"""Reference trajectories at single parameter points, and the times at which they are compared."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.outcome import SafeInterval
from rankone.solvers.request import Domain, Observation
from rankone.solvers.tuning import CHECK
from rankone.solvers.verification.points import check_points
from rankone.solvers.verification.resolution import Resolution, times_held
from rankone.support.arrays import RESOLVED, ROUNDING, Array, bisected
from rankone.support.budget import OutOfBudgetError, charge, limited, reserve, work_done, work_left
from rankone.support.costs import READ
from rankone.support.errors import ConvergenceError
from rankone.trajectories.integrators.diagnosis import (
    first_to_end,
    is_regular,
    runs_away,
    switching_state,
)
from rankone.trajectories.integrators.integrator import (
    LAST_GAP,
    SIZE_TIMES,
    DenseTrajectories,
    Tolerances,
)
from rankone.trajectories.integrators.integrator_choice import following, integrator_for
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.stacks.stack import has_smooth_rates
from rankone.trajectories.system.system import System, refuse_gap


def narrow_times(reference: Reference, observed: Observation | None, end: float) -> Array:
    """When trajectories of the reference cross the surfaces of what is observed, in order: (k,)."""
    if observed is None or observed.surfaces is None:
        return np.empty(0)
    times = np.linspace(reference.start, end, SIZE_TIMES)
    places: set[tuple[int, int, int]] = set()
    for block, first in _blocks(reference, times):
        part = times[first : first + block.shape[2]]
        surfaces = observed.surfaces_at(part, block, reference.points)
        places |= {(s, i, first + k) for s, i, k in _crossings(surfaces)}
    kept = sorted(places, key=lambda place: (place[2], *place))
    spread = np.unique(
        np.linspace(0, len(kept) - 1, min(len(kept), CHECK.most_narrow_times)).astype(int)
    )
    crossing_times = [_refined(reference, observed, kept[k], times) for k in spread]
    return np.unique(np.array(crossing_times, dtype=float))


def _blocks(reference: Reference, times: Array) -> Iterator[tuple[Array, int]]:
    """States at parts of the times that share an end, each with the position of its first time."""
    most = max(reference.times_held, 2)
    for first in range(0, times.size - 1, most - 1):
        yield reference(times[first : first + most]), first


def _crossings(surfaces: Array) -> list[tuple[int, int, int]]:
    """Where surfaces (s, m, T) vanish or change their sign before the next time."""
    signs = np.sign(surfaces)
    changes = (signs[..., :-1] != signs[..., 1:]) & (signs[..., 1:] != 0.0)
    return [(int(s), int(i), int(k)) for s, i, k in np.argwhere(changes)]


def _refined(
    reference: Reference, observed: Observation, place: tuple[int, int, int], times: Array
) -> float:
    """When a trajectory crosses a surface: surface, trajectory, and position of the time before."""
    surface, trajectory, k = place
    alone = reference.of(slice(trajectory, trajectory + 1))
    begin, end = times[k], times[k + 1]
    for _ in range(CHECK.crossing_rounds):
        within = np.linspace(begin, end, CHECK.crossing_parts + 1)
        values = observed.surfaces_at(within, alone(within), alone.points)[surface, 0]
        changes = np.flatnonzero(np.sign(values[:-1]) != np.sign(values[1:]))
        if not changes.size:
            break
        begin, end = within[changes[0]], within[changes[0] + 1]
    return float(0.5 * (begin + end))


# -----------------------------------------------------------------------------
# Reference trajectories at single parameter points, and intervals on which they reach the end.


@dataclass(frozen=True)
class Reference:
    """Trajectories at the check points (m, d), the centre of the box first, dense in time.

    Each integration made a batch, in the order of the points. All trajectories reach ``end``, which
    is before the horizon where the one at the point ``blown`` blows up or leaves where its rates
    are finite. It may be ``large`` then, or ``regular``, where steps shrink without such a reason,
    or the rate of the state ``switching`` goes to and fro.

    For each state, (n,): ``floor`` is the size below which its relative accuracy ends, where that
    is lower than usual since it is amplified later, else infinite; ``rounded`` the rounding errors
    of states that are tiny beside the others, else 0; ``zero`` says which are numerically zero.
    ``least`` are the least absolute tolerances.
    """

    points: Array
    batches: tuple[DenseTrajectories, ...]
    end: float
    floor: Array
    rounded: Array
    zero: NDArray[np.bool_]
    least: Array
    blown: int | None = None
    large: bool = False
    regular: bool = False
    switching: int | None = None

    @property
    def start(self) -> float:
        return self.batches[0].start

    @property
    def avoided(self) -> float:
        """Explicit steps that were left when they were given up for implicit ones, at most."""
        return max(batch.avoided for batch in self.batches)

    @property
    def integrator(self) -> str:
        """What integrated the first trajectories: "stack" or "single"."""
        return self.batches[0].integrator

    @property
    def method(self) -> str:
        """The method of the integration, of several the first one that is for stiff systems."""
        stiff = (batch.method for batch in self.batches if batch.avoided)
        return next(stiff, self.batches[0].method)

    @property
    def stiff(self) -> bool:
        return self.avoided > 0.0

    def __call__(self, times: Array) -> Array:
        """States at the times (T,): shape (n, m, T)."""
        size = times.size * self.floor.size * len(self.points)
        charge((len(self.batches) - 1) * READ.once + READ(size))
        states = [batch(times) for batch in self.batches]
        return states[0] if len(states) == 1 else np.concatenate(states, axis=1)

    @property
    def times_held(self) -> int:
        """At how many times the states are held at once: one at least."""
        return times_held(self.floor.size * len(self.points))

    def blocks(self, times: Array, together: int = 1) -> Iterator[Array]:
        """States at consecutive parts of the times, as many as are held: shape (n, m, T) each.

        Of so many times ``together`` all are in one part.
        """
        most = max(self.times_held // together, 1) * together
        yield from (self(part) for part in np.split(times, range(most, times.size, most)))

    def of(self, trajectories: slice) -> Reference:
        """Some of the trajectories, which follow each other."""
        first, end, _ = trajectories.indices(len(self.points))
        batches, passed = list[DenseTrajectories](), 0
        for batch in self.batches:
            count = batch.state.shape[1]
            a, b = max(first - passed, 0), min(end - passed, count)
            if a < b:
                batches.append(batch if b - a == count else batch.of(slice(a, b)))
            passed += count
        return replace(self, points=self.points[trajectories], batches=tuple(batches))

    def joined(self, second: Reference) -> Reference:
        """The trajectories of both, up to where the first of them blows up."""
        ending, blown = self, self.blown
        if second.end < self.end and second.blown is not None:
            ending, blown = second, len(self.points) + second.blown
        both_rounded = np.minimum(self.rounded, second.rounded) > 0.0
        return replace(
            ending,
            points=np.concatenate([self.points, second.points]),
            batches=self.batches + second.batches,
            floor=np.minimum(self.floor, second.floor),
            rounded=np.where(both_rounded, np.maximum(self.rounded, second.rounded), 0.0),
            zero=self.zero & second.zero,
            least=np.minimum(self.least, second.least),
            blown=blown,
        )


def reference_accuracy(rtol: float) -> float:
    """The relative tolerance of trajectories against which a solve to ``rtol`` is measured."""
    return max(CHECK.reference_accuracy * rtol, CHECK.least_reference_accuracy)


def integrate_reference(
    system: System,
    points: Array,
    edges: Sequence[float],
    rtol: float,
    integrator: str = "auto",
    workers: Workers | None = None,
    asked: Collection[int] | None = None,
) -> Reference:
    """Integrate the system between edges at all points (m, d), by the option ``integrator``.

    ``asked`` are the states that somebody asks for, None for all. ``workers`` take part where
    trajectories are integrated one by one or have many states. The integration begins anew at the
    inner edges: ascending times at which the time factors jump, kink or are narrow. It is a
    ConvergenceError if not a single step can be made; an OutOfBudgetError says how far the
    integration came.
    """
    start, *cuts, end = edges
    reserve(8 * CHECK.numbers_of_state * len(points) * system.n_differential)
    edges = integration_edges(system, points, (start, end), cuts)
    initial = system.initial(np.ascontiguousarray(points.T))
    _check_start(system, start, initial, points)
    longest = system.limit_of_steps
    if not has_smooth_rates(system, start):
        longest = CHECK.longest_step * (end - start)
    choose = partial(
        integrator_for,
        system,
        stiff=system.at_point is not None,
        looks_anywhere=True,
        workers=workers or Workers(system),
    )
    chosen = choose(integrator)
    resolution = Resolution(system, points, start, end, rtol, initial, asked)

    def integrated(points: Array, absolute: Array) -> DenseTrajectories:
        try:
            return chosen.run(system, points, edges, Tolerances(rtol, absolute, longest))
        except OutOfBudgetError as out:
            out.sizes = resolution.largest[:, 0]
            raise

    if resolution.presumes and initial.size >= CHECK.many_numbers:
        first = initial[:, : CHECK.size_pilots]
        pilots = Resolution(system, points[: CHECK.size_pilots], start, end, rtol, first, asked)
        few = integrated(pilots.points, pilots.absolute)
        if few.has_begun and pilots.refined(few):
            resolution.follow(pilots)
    for _ in range(CHECK.most_integrations):
        before = work_done()
        dense = integrated(points, resolution.absolute)
        work = work_done() - before
        if not dense.has_begun:
            floor = rtol * RESOLVED * resolution.size
            point = points[first_to_end(system, start, dense.state, points, floor)]
            raise ConvergenceError(
                f"no trajectory can be integrated from t = {start:g}{_at(system, point)}"
                ": the right-hand side is not finite there or varies without bound",
                remedy="check the initial values and the coefficients",
            )
        if not resolution.refined(dense) and not resolution.lowered(dense, integrated, work):
            break
        integrator = following(integrator, dense.integrator, len(points))
        chosen = choose(integrator)
    return _reference(resolution, dense)


def _reference(resolution: Resolution, dense: DenseTrajectories) -> Reference:
    """The trajectories, and why they end where they do."""
    rounding, floor = resolution.rounding, resolution.floor[:, 0]
    rounded, zero, least = rounding.floor[:, 0], rounding.zero[:, 0], resolution.least[:, 0]
    largest = dense.largest.max(axis=1)
    hidden = least / resolution.rtol  # sizes to which no tolerance is relative
    lost = (largest > 0.0) & (largest < hidden) & (resolution.tolerated[:, 0] == 0.0)
    rounded, zero = np.where(lost, np.maximum(rounded, hidden), rounded), zero | lost
    reference = Reference(resolution.points, (dense,), dense.end, floor, rounded, zero, least)
    if resolution.end - dense.end <= LAST_GAP * np.spacing(abs(resolution.end)):
        return reference
    system, points, time, state = resolution.system, resolution.points, dense.end, dense.state
    size = np.maximum(resolution.size, rounding.floor)
    blown = first_to_end(system, time, state, points, resolution.rtol * RESOLVED * size)
    refuse_gap(system, time, dense.last[:, blown], points[blown])
    large = bool((np.abs(state[:, blown]) > CHECK.blow_up_growth * size[:, 0]).any())
    large = large or runs_away(system, time, state[:, blown], points[blown], resolution.horizon)
    switch = None if large else switching_state(system, time, state, points, resolution.horizon)
    if switch is not None:
        return replace(reference, blown=switch[1], switching=switch[0])
    at_end = system, time, state[:, blown], size, points[blown], resolution.horizon
    return replace(reference, blown=blown, large=large, regular=not large and is_regular(*at_end))


def _check_start(system: System, start: float, initial: Array, points: Array) -> None:
    """Raise a ConvergenceError where the initial values, or their rates, are not finite."""
    with np.errstate(all="ignore"):
        rates = system.rhs(start, initial, np.ascontiguousarray(points.T))
    for what, numbers in (("initial value", initial), ("derivative at the start", rates)):
        state, index = np.nonzero(~np.isfinite(np.broadcast_to(numbers, initial.shape)))
        if state.size:
            refuse_gap(system, start, initial[:, index[0]], points[index[0]])
            if state[0] in system.constraints.guessed:
                raise ConvergenceError(
                    f"Newton's method finds no initial value of `{system.states[state[0]]}`"
                    f"{_at(system, points[index[0]])}",
                    remedy="give a starting guess closer to it, or move the box",
                )
            raise ConvergenceError(
                f"the {what} of `{system.states[state[0]]}` is not finite"
                f"{_at(system, points[index[0]])}",
                remedy="check the initial values and the coefficients",
            )


def _at(system: System, point: Array) -> str:
    """A point as a message names it; empty without parameters."""
    named = (f"{name} = {x:.6g}" for name, x in zip(system.parameters, point, strict=True))
    return f" at {', '.join(named)}" if len(point) else ""


def integration_edges(
    system: System, points: Array, horizon: tuple[float, float], cuts: Sequence[float]
) -> list[float]:
    """The ends of the horizon, the cuts, and where functions of time switch at some points."""
    start, end = horizon
    if not system.features.n_moving_cuts:
        return [start, *cuts, end]
    with np.errstate(all="ignore"):
        times = system.features.moving_cuts(np.ascontiguousarray(points.T)).ravel()
    least = ROUNDING * max(abs(start), abs(end))
    times = np.unique(times[(times - start > least) & (end - times > least)])
    times = times[np.diff(times, prepend=start) > least]
    apart = np.abs(times[:, None] - np.array(cuts)).min(axis=1, initial=np.inf) > least
    return [start, *sorted([*cuts, *times[apart].tolist()]), end]


def safe_intervals(
    system: System, domain: Domain, cuts: Sequence[float], point: Array
) -> tuple[SafeInterval, ...]:
    """Intervals of single parameters whose faces have trajectories that reach the end.

    By bisection from each end of a parameter's interval, if all trajectories on that face of the
    box reach the end, towards ``point`` (d,), whose trajectory does not. Integrations begin anew at
    the cuts. Only a solve on the smaller box shows whether all of it is safe. A parameter has at
    most two intervals; the one that keeps most of the box is first.
    """
    intervals: list[SafeInterval] = []
    try:
        with limited(min(CHECK.face_work, CHECK.face_work_share * work_left())):
            intervals.extend(_intervals(system, domain, cuts, point))
    except OutOfBudgetError:
        pass  # keep those so far
    return tuple(sorted(intervals, key=lambda interval: -interval.share))


def _intervals(
    system: System, domain: Domain, cuts: Sequence[float], point: Array
) -> Iterator[SafeInterval]:
    """The intervals, those first that may keep most of the box; none that keep less than others."""
    bounds, largest = domain.bounds, 0.0
    width = bounds[:, 1] - bounds[:, 0]
    faces = [(j, side) for j in range(len(bounds)) for side in (0, 1)]
    kept = {(j, side): abs(point[j] - bounds[j, side]) / width[j] for j, side in faces}
    for j, side in sorted(faces, key=lambda face: -kept[face]):
        if kept[j, side] <= largest:
            return
        on_face = check_points(np.delete(bounds, j, axis=0), CHECK.face_points)
        on_face = np.concatenate([on_face, np.delete(point, j)[None]])

        def survives(place: Array, j: int = j, on_face: Array = on_face) -> NDArray[np.bool_]:
            face = np.insert(on_face, j, place.item(), axis=1)
            try:
                ends = integrate_reference(system, face, domain.edges(cuts), CHECK.face_rtol)
            except ConvergenceError:
                return np.array([False])
            return np.array([ends.blown is None])

        border, lost = bounds[j, side].reshape(1, 1), point[j].reshape(1, 1)
        if not survives(border).all():
            continue
        safe = bisected(border, lost, survives, CHECK.face_halvings)[0].item()
        share = abs(safe - bounds[j, side]) / width[j]
        if share > largest:
            largest = share
            lower, upper = sorted((float(bounds[j, side]), safe))
            yield SafeInterval(j, lower, upper, below=side == 0, share=float(share))
