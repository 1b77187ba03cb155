"""Reference trajectories at single parameter points, and the intervals on which they reach the end.

Each state is resolved relative to its own size, down to a small part of it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.ir.outcome import SafeInterval
from rankone.ir.request import Domain
from rankone.ir.system import System, refuse_gap
from rankone.support.arrays import Array, bisected
from rankone.support.budget import (
    OutOfBudgetError,
    charge,
    limited,
    memory_left,
    reserve,
    work_left,
)
from rankone.support.costs import Cost, eigenvalues
from rankone.support.errors import ConvergenceError
from rankone.trajectories.choice import following, integrator_for
from rankone.trajectories.diagnosis import (
    MOST_GROWTH,
    Rounding,
    first_to_end,
    rounding_errors,
    runs_away,
    switching_state,
)
from rankone.trajectories.integrator import (
    LAST_GAP,
    DenseTrajectories,
    Tolerances,
)
from rankone.trajectories.spectra import first_jacobian, growth_rate, jacobian_blocks
from rankone.trajectories.stacks.integrator import has_smooth_rates
from rankone.verification.points import check_points

_ACCURACY = 3e-3  # Tolerance of the reference over the tolerance of the solve
_LEAST_ACCURACY = 3e-13  # Tightest tolerance of the reference: rounding errors are larger
_NEGLIGIBLE = 1e-7  # Part of a state's size at which its relative accuracy ends
_LONGEST_STEP = 0.1  # Longest step, in horizons, if narrow functions may hide between its stages
_BLOW_UP_GROWTH = 1e3  # Growth of a state from which it blows up, and meets no pole or border
_COINCIDENT = 1e-14  # Times that are closer, relative to the ends of the horizon, are the same
_LINGERING = 1e-3  # Part of its early size that resolves a negligible state that is amplified
_BEGUN = 0.1  # Part of the time in which a state grows by a factor e, after which it has begun to
_SMALL_STATE = 10.0  # Negligible parts of its presumed size below which a state is small
_SAMPLES = 8  # Times at which rounding errors and the growth of small states are estimated
_DIP_SAMPLES = 64  # Times at which states are looked for that fall far below their size
_DIP_FLOOR = 1e-290  # Floor of a state that falls far and grows again: it is relative all the way
_LEAST_SIZE = 1e-250  # Size below which such a state is lost: floating-point numbers end at 1e-308
_DENSE_COST = Cost(50e3, 15.0)  # Operations of evaluating dense output: once, and for each state
_HELD_NUMBERS = (
    2**22
)  # Numbers of states at several times that are held at once, unless one has more
_COPIES = 8  # Copies of these while they are compared
# Numbers held for each state of each trajectory: stages of a step, and dense output of few steps
_NUMBERS_OF_STATE = 100
_MOST_INTEGRATIONS = 4  # Most integrations: a state that starts from zero shows its size only then

_FACE_RTOL = 1e-3  # Relative tolerance of trajectories that only show whether they reach the end
_FACE_POINTS = 8  # Trajectories that begin inside of a face of the box
_FACE_HALVINGS = 7  # Halvings between a face and the early end: 1 % of the box is enough
_FACE_WORK = 1.5e9  # Most operations for all faces: about two seconds
_FACE_WORK_SHARE = 0.5  # Most of what is left of the budget for them


@dataclass(frozen=True)
class Reference:
    """Trajectories at the check points (m, d), the centre of the box first, dense in time.

    Each integration made a batch, in the order of the points. All trajectories reach ``end``, which
    is before the horizon where the one at the point ``blown`` blows up or leaves where its rates
    are finite. It may be ``large`` then, or the rate of the state ``switching`` goes to and fro.

    For each state, (n,): ``floor`` is the size below which its relative accuracy ends, where that
    is lower than usual since it is amplified later, else infinite; ``rounded`` the rounding errors
    of states that are tiny beside the others, else 0; ``zero`` says which are numerically zero.
    """

    points: Array
    batches: tuple[DenseTrajectories, ...]
    end: float
    floor: Array
    rounded: Array
    zero: NDArray[np.bool_]
    blown: int | None = None
    large: bool = False
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
        """What integrated the first trajectories: "stack", "single" or "compiled"."""
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
        charge(len(self.batches) * _DENSE_COST(size))
        states = [batch(times) for batch in self.batches]
        return states[0] if len(states) == 1 else np.concatenate(states, axis=1)

    @property
    def times_held(self) -> int:
        """At how many times the states are held at once: one at least."""
        return _times_held(self.floor.size * len(self.points))

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
            blown=blown,
        )


def reference_accuracy(rtol: float) -> float:
    """The relative tolerance of trajectories against which a solve to ``rtol`` is measured."""
    return max(_ACCURACY * rtol, _LEAST_ACCURACY)


def integrate_reference(
    system: System,
    points: Array,
    horizon: tuple[float, float],
    rtol: float,
    cuts: Sequence[float] = (),
    integrator: str = "auto",
) -> Reference:
    """Integrate the system over a horizon at all points (m, d), by the option ``integrator``.

    The integration begins anew at the cuts: ascending times at which the time factors jump, kink or
    are narrow. It is a ConvergenceError if not a single step can be made; an OutOfBudgetError says
    how far the integration came.
    """
    start, end = horizon
    reserve(8.0 * _NUMBERS_OF_STATE * len(points) * system.n_differential)
    edges = [start, *_with_moving_cuts(system, points, start, end, cuts), end]
    initial = system.initial(np.ascontiguousarray(points.T))
    _check_start(system, start, initial, points)
    longest = math.inf if has_smooth_rates(system, start) else _LONGEST_STEP * (end - start)
    chosen = integrator_for(system, integrator, accuracy=rtol, looks_anywhere=True)
    resolution = _Resolution(system, points, start, end, rtol, initial)
    for _ in range(_MOST_INTEGRATIONS):
        tolerances = Tolerances(rtol, resolution.absolute, longest)
        dense = chosen.run(system, points, edges, tolerances)
        if not dense.has_begun:
            floor = rtol * _NEGLIGIBLE * resolution.size
            point = points[first_to_end(system, start, dense.state, points, floor)]
            raise ConvergenceError(
                f"no trajectory can be integrated from t = {start:g}{_at(system, point)}"
                ": the right-hand side is not finite there or varies without bound",
                remedy="check the initial values and the coefficients",
            )
        if not resolution.refined(dense):
            break
        integrator = following(integrator, dense.integrator, len(points))
        chosen = integrator_for(system, integrator, accuracy=rtol, looks_anywhere=True)
    return resolution.reference(dense)


class _Resolution:
    """How far down each state is resolved; an integration shows whether that was far enough.

    For each state, (n, 1): the size that it is presumed to have, the floor of a :class:`Reference`,
    and the absolute tolerance.
    """

    def __init__(
        self, system: System, points: Array, start: float, end: float, rtol: float, initial: Array
    ) -> None:
        self.system, self.points, self.rtol = system, points, rtol
        self.start, self.end, self.horizon = start, end, end - start
        size = np.abs(initial).max(axis=1, keepdims=True)
        self.rounding = self._rounding([(start, initial)], size)
        self.size = np.where(size > 0.0, size, size.max(initial=0.0) or 1.0)
        self.floor = np.full((len(initial), 1), np.inf)
        self.absolute = np.maximum(rtol * _NEGLIGIBLE * self.size, self.rounding.floor)

    def _rounding(self, samples: Sequence[tuple[float, Array]], largest: Array) -> Rounding:
        stack = self.system, self.points, self.horizon
        return rounding_errors(*stack, samples, largest, self.rtol)

    def refined(self, dense: DenseTrajectories) -> bool:
        """Adapt the tolerances to trajectories; whether to integrate again, to finer ones."""
        largest, early = (x.max(axis=1, keepdims=True) for x in (dense.largest, dense.early))
        samples = list(dense.samples(_SAMPLES))
        before, self.rounding = self.rounding, self._rounding(samples, largest)
        zero, finest = self.rounding.zero, self.rtol * _NEGLIGIBLE * largest
        coarse = before.floor > np.maximum(self.rounding.floor, finest)
        small = ~zero & (largest > 0.0) & (largest < _SMALL_STATE * _NEGLIGIBLE * self.size)
        usual = _NEGLIGIBLE * np.maximum(self.size, largest)
        candidates = ~zero & ~small & (early > 0.0)
        lingers = candidates & (early < np.minimum(usual, self.floor))
        if lingers.any():
            early = np.maximum(early, self._begun(dense, samples))
            lingers = candidates & (early < np.minimum(usual, self.floor))
        dips = ~zero & self._grows_again(dense)
        self.size = np.where(small, largest, self.size)
        self.floor = np.where(lingers, _LINGERING * early, self.floor)
        self.floor = np.where(dips, _DIP_FLOOR, self.floor)
        coarser = self.absolute
        finest = self.rtol * np.minimum(_NEGLIGIBLE * self.size, self.floor)
        self.absolute = np.maximum(finest, self.rounding.floor)
        return bool(((small | lingers | dips | coarse) & (self.absolute < coarser)).any())

    def _grows_again(self, dense: DenseTrajectories) -> NDArray[np.bool_]:
        """States (n, 1) that fall to a negligible part of what they were, and may grow again.

        They stay there from one sample to the next: others pass through zero. They grow by their
        own block of the Jacobian, whatever the others do. An integration that does not resolve them
        makes noise of them, which grows as well.
        """
        dips, least, first = _dips(dense)
        if not dips.any():
            return dips[:, None]
        later = np.linspace(first, dense.end, _SAMPLES)  # steps may pass over all of the growth
        growth, small = 0.0, np.flatnonzero(dips)
        for time, at in zip(later.tolist(), np.moveaxis(dense(later), 2, 0), strict=True):
            blocks = jacobian_blocks(self.system, self.points, time, at, small)
            if np.isfinite(blocks).all():
                charge(len(blocks) * eigenvalues(small.size))
                growth = max(growth, float(np.linalg.eigvals(blocks).real.max()))
        if growth * (dense.end - first) <= MOST_GROWTH:
            return np.zeros_like(dips)[:, None]
        lost = dips & (least < _LEAST_SIZE)
        if lost.any():
            name = self.system.states[int(np.argmax(lost))]
            raise ConvergenceError(
                f"`{name}` falls below {_LEAST_SIZE:g} and may grow again from there, which is "
                "beyond floating-point numbers",
                remedy="take its logarithm as the unknown, or shorten the horizon",
            )
        return dips[:, None]

    def _begun(self, dense: DenseTrajectories, samples: Sequence[tuple[float, Array]]) -> Array:
        """Sizes of states (n, 1) before small ones may grow exponentially; infinite if none may.

        A state that starts from zero is as small at first as steps are short. What it is after a
        part of the time in which it grows counts, and does not depend on them.
        """
        growth, start = 0.0, self.start
        for time, states in samples:
            block = first_jacobian(self.system, self.points, time, states)
            if block is not None:
                growth = max(growth, growth_rate(block))
        if growth * (dense.end - start) <= MOST_GROWTH:
            return np.full((len(self.size), 1), np.inf)
        begun = dense(np.array([start + _BEGUN / growth]))
        return np.asarray(np.abs(begun).max(axis=(1, 2))[:, None])

    def reference(self, dense: DenseTrajectories) -> Reference:
        """The trajectories, and why they end where they do."""
        rounding, floor = self.rounding, self.floor[:, 0]
        rounded, zero = rounding.floor[:, 0], rounding.zero[:, 0]
        reference = Reference(self.points, (dense,), dense.end, floor, rounded, zero)
        if self.end - dense.end <= LAST_GAP * np.spacing(abs(self.end)):
            return reference
        system, points, time, state = self.system, self.points, dense.end, dense.state
        size = np.maximum(self.size, rounding.floor)
        blown = first_to_end(system, time, state, points, self.rtol * _NEGLIGIBLE * size)
        refuse_gap(system, time, dense.last[:, blown], points[blown])
        large = bool((np.abs(state[:, blown]) > _BLOW_UP_GROWTH * size[:, 0]).any())
        large = large or runs_away(system, time, state[:, blown], points[blown], self.horizon)
        switch = None if large else switching_state(system, time, state, points, self.horizon)
        if switch is None:
            return replace(reference, blown=blown, large=large)
        return replace(reference, blown=switch[1], switching=switch[0])


def _times_held(size: int) -> int:
    """At how many times so many states are held at once: one at least."""
    most = min(_HELD_NUMBERS, memory_left() / (8.0 * _COPIES))
    return max(int(most // size), 1)


def _dips(dense: DenseTrajectories) -> tuple[NDArray[np.bool_], Array, float]:
    """States (n,) that fall to a negligible part of what they were, and their least sizes.

    Also the time at which the first of them is there.
    """
    n, first = len(dense.state), math.inf
    dips, least = np.zeros(n, dtype=bool), np.full(n, math.inf)
    before, largest = np.zeros((0, *dense.state.shape)), np.zeros_like(dense.state)
    earlier: tuple[float, ...] = ()
    samples, most = iter(dense.samples(_DIP_SAMPLES)), _times_held(dense.state.size)
    while sampled := list(itertools.islice(samples, most)):
        times, states = zip(*sampled, strict=True)
        sizes, times = np.concatenate([before, np.abs(states)]), (*earlier, *times)
        running = np.maximum(np.maximum.accumulate(sizes, axis=0), largest)
        staying = np.maximum(sizes[:-1], sizes[1:])
        below = (staying < _NEGLIGIBLE * running[:-1]).any(axis=2)
        if below.any():
            first = min(first, times[int(np.argmax(below.any(axis=1)))])
        dips, least = dips | below.any(axis=0), np.minimum(least, sizes.min(axis=(0, 2)))
        before, largest, earlier = sizes[-1:], running[-1], times[-1:]
    return dips, least, first


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


def _with_moving_cuts(
    system: System, points: Array, start: float, end: float, cuts: Sequence[float]
) -> list[float]:
    """The cuts, and the times at which functions of time switch at some of the points."""
    if not system.features.n_moving_cuts:
        return list(cuts)
    with np.errstate(all="ignore"):
        times = system.features.moving_cuts(np.ascontiguousarray(points.T)).ravel()
    least = _COINCIDENT * max(abs(start), abs(end))
    times = np.unique(times[(times - start > least) & (end - times > least)])
    times = times[np.diff(times, prepend=start) > least]
    apart = np.abs(times[:, None] - np.array(cuts)).min(axis=1, initial=np.inf) > least
    return sorted([*cuts, *times[apart].tolist()])


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
        with limited(min(_FACE_WORK, _FACE_WORK_SHARE * work_left())):
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
        on_face = check_points(np.delete(bounds, j, axis=0), _FACE_POINTS)
        on_face = np.concatenate([on_face, np.delete(point, j)[None]])

        def survives(place: Array, j: int = j, on_face: Array = on_face) -> NDArray[np.bool_]:
            face = np.insert(on_face, j, place.item(), axis=1)
            try:
                ends = integrate_reference(system, face, domain.horizon, _FACE_RTOL, cuts)
            except ConvergenceError:
                return np.array([False])
            return np.array([ends.blown is None])

        border, lost = bounds[j, side].reshape(1, 1), point[j].reshape(1, 1)
        if not survives(border).all():
            continue
        safe = bisected(border, lost, survives, _FACE_HALVINGS)[0].item()
        share = abs(safe - bounds[j, side]) / width[j]
        if share > largest:
            largest = share
            lower, upper = sorted((float(bounds[j, side]), safe))
            yield SafeInterval(j, lower, upper, below=side == 0, share=float(share))
