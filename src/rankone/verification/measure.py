"""The reference set of a solve, errors measured against it, and where they are worst.

Trajectories at a few points do not see what is narrow. The residual u' - f(t, p, u) costs a
microsecond a point instead of a trajectory; it is no error, but at the same time it is about as
large in proportion to the error at other points as where the error is known.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rankone.ir.domain import Domain
from rankone.ir.outcome import Measured
from rankone.ir.request import SolveRequest
from rankone.ir.system import System
from rankone.ir.verdict import NumericallyZero
from rankone.support.arrays import Array
from rankone.support.budget import charge, unlimited
from rankone.support.costs import function_cost
from rankone.support.errors import ConvergenceError
from rankone.tensors.slab import SlabTrain
from rankone.verification.cuts import Cuts, system_cuts
from rankone.verification.points import (
    FEW_PARAMETERS,
    active_points,
    cell_points,
    check_points,
    inside_jumps,
    points_in_elements,
    surface_points,
)
from rankone.verification.reference import Reference, integrate_reference
from rankone.verification.search import Climb, climbed

__all__ = ["ReferenceSet", "drift", "measure", "times_within", "worst_points"]

_REFERENCE_ACCURACY = 3e-3
"""Tolerance of the reference over that of the solve, for the worst of its trajectories."""
_LEAST_ACCURACY = 3e-13
"""Tightest tolerance of the reference: rounding errors come to more."""
_SOLVED_SHARE = 0.9
"""Part of the way to a blow-up that is still solved."""
_SIZE_SAMPLES = 201
"""Times at which the sizes of the states are looked at."""
_JUMP_SHARES = np.array([0.0, 0.3, 0.7, 1.0])
"""Where they are looked at besides, from one jump to the next."""
_LEAST_SIZE = 1e-140
"""Size of a state below which its square is lost."""
_COINCIDENT = 1e-13
"""Cuts this close to a jump, relative to the ends of the horizon, are that jump."""
_MOST_CHECKED_CUTS = 16
"""Cuts of a parameter that are checked on either side."""
_CHECK_SHARES = np.array([0.0, 0.13, 0.31, 0.5, 0.69, 0.87, 1.0])
"""Checked times, in slab lengths."""
_GROWTH_STEPS = 32
"""Steps over the horizon by which the growth of errors is followed."""
_GROWTH_TRAJECTORIES = 5
"""Check points at which it is, the centre first."""
_BESIDE_POLE = 0.99
"""Factor on the rates where the Cayley transform does not exist for one of them."""
_SAFE_QUANTILE = 0.95
"""Part of the points that have no larger error than the quantile that is reported."""
_DRIFT_POINTS = 24
"""Points at which lifted states are compared with what they stand for."""
_DRIFT_SHARES = np.array([0.0, 0.31, 0.69, 1.0])
"""Times at which they are, in slab lengths."""

_CANDIDATES = 512
"""Points at which residuals are looked at."""
_MOST_SLABS = 4
"""Slabs on which they are, and jumps of a kind."""
_CHOSEN = 8
"""Worst points that are taken."""
_CORNER_SHARE = 5
"""Of so many candidates one is near a corner, and so many times more are affordable at most."""
_CORNER_POWER = 1.0 / 3.0
"""Power of the distance from the centre that draws points towards the corners."""
_CORNER_ERROR = 5.0
"""Expected error over the tolerance from which such points count: they are rare."""
_WORK = 3e7
"""Multiplications that the residuals of more than three parameters may take."""
_RESIDUAL_SHARES = np.array([0.21, 0.64, 0.97])
"""Times of residuals, in slab lengths."""
_NEGLIGIBLE = 1e-3
"""Part of the tolerance as which smaller errors and residuals count."""
_DOUBTFUL_ERROR = 1.5
"""Expected error over the tolerance from which a point is doubtful: on smooth problems expected
errors reach 1.4 and are overestimates, where something was missed 3 and more."""
_MOST_KNOWN = 64
"""Trajectories of the reference whose residuals tell what a residual amounts to."""
_JUMP_CANDIDATES = 16_384
"""Points at which a jump is looked at that is no polynomial of the states."""
_JUMP_ERROR = 3.0
"""Error after a jump, over the tolerance, from which a point is doubtful."""
_CLIMBERS = 64
"""Points with the largest errors after a jump, from which larger ones are looked for."""
_TO_KINKS = Climb(rounds=8, tries=8, first_step=0.1, shrinkage=0.4)
"""The way to them: the last steps are as short as the kinks that a solution may miss are thin."""


@dataclass(frozen=True)
class ReferenceSet:
    """Reference trajectories at the check points, and what is derived from them.

    Attributes
    ----------
    accuracy : float
        Relative tolerance of the trajectories.
    reference : Reference
        Trajectories at the centre, at corners and at interior points.
    corners : int
        Number of check points, after the centre, that are corners.
    whole_box : bool
        Whether they count like the other points.
    checked : bool
        Whether there are interior points, so that an error can be stated.
    cuts : tuple of float
        Times at which the time factors jump, kink or are narrow, and at which states are reset.
    parameter_cuts : tuple of Cuts
        Those of the factors of each parameter.
    counted : tuple of int or None
        The states whose error counts; None for all.
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

    @classmethod
    def of(cls, system: System, request: SolveRequest) -> ReferenceSet:
        """Integrate the reference for a solve."""
        domain, check = request.domain, request.check
        few = len(domain.box) <= FEW_PARAMETERS
        whole_box = few if check.cover is None else check.cover == "box"
        in_time, *parameter_cuts = system_cuts(system, domain)
        cuts = _with_jumps(in_time.points, system, domain)
        beside = [_few(each.points) for each in parameter_cuts] if check.points else ()
        every_corner = whole_box or few
        points = check_points(domain.bounds, check.points, cuts=beside, every_corner=every_corner)
        points = inside_jumps(points, system, domain)
        interior = 1 + check.points + 2 * sum(map(len, beside))
        corners = len(points) - interior if check.points and domain.box else 0
        if check.points:
            active, surfaces = active_points(system, domain), surface_points(system, domain)
            cells = cell_points(domain, [each.points for each in parameter_cuts])
            points = np.concatenate([points, active, surfaces, cells])
        accuracy = max(_REFERENCE_ACCURACY * request.rtol, _LEAST_ACCURACY)
        reference_set = cls(
            system,
            domain,
            accuracy,
            integrate_reference(system, points, *domain.horizon, accuracy, cuts),
            corners,
            whole_box,
            bool(check.points),
            cuts,
            tuple(parameter_cuts),
            check.states,
        )
        reference_set._check_sizes()
        return reference_set

    def with_points(self, points: Array) -> ReferenceSet:
        """The same with more interior points (m, d); those of before are not integrated again."""
        horizon = self.domain.horizon
        further = integrate_reference(self.system, points, *horizon, self.accuracy, self.cuts)
        return replace(self, reference=self.reference.joined(further), checked=True)

    @property
    def end(self) -> float:
        """End of what is to be solved: the horizon, or shortly before a blow-up."""
        start, end = self.reference.start, self.reference.end
        return end if self.reference.blown is None else start + _SOLVED_SHARE * (end - start)

    @cached_property
    def sizes(self) -> Array:
        """Largest absolute value of each state, products included; one for a vanishing state.

        Over the centre and the interior points: states at corners of a box of many parameters may
        be larger by orders of magnitude and are seen by nobody. States that are numerically zero
        get a size of which their rounding errors are a small part.
        """
        start, end = self.reference.start, self.end
        times = np.linspace(start, end, _SIZE_SAMPLES)
        for a, b in itertools.pairwise([start, *self.system.jumps.inside(start, end), end]):
            times = np.concatenate([times, times_within(a, b, _JUMP_SHARES)])
        states = self.system.with_products(self.reference(times))
        sizes = np.abs(self._without_corners(states, axis=1)).max(axis=(1, 2))
        n = self.system.n_differential
        rounded = np.where(self.reference.zero, self.reference.rounded, 0.0)
        sizes[:n] = np.maximum(sizes[:n], rounded / self.accuracy)
        return np.where(sizes > 0.0, sizes, 1.0)

    @property
    def states(self) -> Array:
        """The sizes of the differential states."""
        return self.sizes[: self.system.n_differential]

    def measured(self, slabs: Sequence[SlabTrain]) -> Measured | None:
        """Errors of the slabs in units of the sizes; None without check or slabs."""
        if not slabs or not self.checked:
            return None
        counts = self.corners, self.whole_box, len(self.system.unknowns), self.counted
        with unlimited():
            return measure(slabs, self.reference, self.states, *counts)

    def amplification(self) -> Callable[[float], float]:
        """Largest later growth of an error made at time t, along a few trajectories.

        The variational equation ``w' = J(t) w`` is stepped on a uniform grid with the Cayley
        transform of the scaled Jacobian, which is stable for stiff systems.

        Returns
        -------
        callable
            ``amplification(t) >= 1``: the largest Frobenius norm, divided by sqrt(n), of the
            propagator from t to any later time.
        """
        n, start = self.system.n_differential, self.reference.start
        width = (self.end - start) / _GROWTH_STEPS
        middle = np.asarray(start + width * (np.arange(_GROWTH_STEPS) + 0.5), dtype=float)
        points = self.reference.points[:_GROWTH_TRAJECTORIES]
        states = self.reference(middle)[:, : len(points)]
        jacobian = self.system.jacobian(middle, states, points.T[:, :, None])
        jacobian = np.broadcast_to(jacobian, (n, n, len(points), _GROWTH_STEPS))
        scale = self.states[None, :] / self.states[:, None]
        half, eye = 0.5 * width * jacobian.transpose(3, 2, 0, 1) * scale, np.eye(n)
        try:
            step = np.linalg.solve(eye - half, eye + half)
        except np.linalg.LinAlgError:  # a growth rate at a pole of the transform
            step = np.linalg.solve(eye - _BESIDE_POLE * half, eye + _BESIDE_POLE * half)
        largest = np.ones(_GROWTH_STEPS + 1)
        propagator = step
        for gap in range(1, _GROWTH_STEPS + 1):
            norms = np.sqrt(np.einsum("kmij,kmij->km", propagator, propagator).max(axis=1) / n)
            np.maximum(largest[: norms.size], norms, out=largest[: norms.size])
            if gap < _GROWTH_STEPS:
                propagator = np.matmul(step[gap:], propagator[:-1])
        grid = start + width * np.arange(_GROWTH_STEPS + 1)
        return lambda t: float(np.interp(t, grid, largest))

    @property
    def interior_points(self) -> Array:
        """The centre and the interior points, (m, d)."""
        return self._without_corners(self.reference.points, axis=0)

    @property
    def zeros(self) -> tuple[NumericallyZero, ...]:
        """The unknowns that are numerically zero."""
        unknowns, rounded = self.system.unknowns, self.reference.rounded
        return tuple(
            NumericallyZero(unknowns[i], float(rounded[i]), float(self.states[i]))
            for i in np.nonzero(self.reference.zero[: len(unknowns)])[0]
        )

    @property
    def blow_up(self) -> tuple[float, tuple[float, ...]] | None:
        """Time and parameters near which a trajectory blows up."""
        if self.reference.blown is None:
            return None
        return self.reference.end, tuple(self.reference.points[self.reference.blown].tolist())

    def _without_corners(self, array: Array, axis: int) -> Array:
        return np.delete(array, np.s_[1 : 1 + self.corners], axis=axis)

    def _check_sizes(self) -> None:
        """Raise a ConvergenceError for states of which products are no floating-point numbers."""
        system = self.system
        if system.separated and max((len(states) for *_, states in system.terms), default=0) < 2:
            return
        for name, size in zip(system.states, self.states, strict=False):
            if not _LEAST_SIZE < size < 1.0 / _LEAST_SIZE:
                raise ConvergenceError(
                    f"`{name}` is of the size {size:.1e}: its products are no floating-point "
                    "numbers",
                    remedy="change its unit",
                )


def _with_jumps(cuts: Sequence[float], system: System, domain: Domain) -> tuple[float, ...]:
    """The cuts, and the times of jumps in place of those that are the same but for rounding."""
    start, end = domain.horizon
    jumps = system.jumps.inside(start, end)
    near = _COINCIDENT * max(abs(start), abs(end))
    apart = (cut for cut in cuts if all(abs(cut - time) > near for time in jumps))
    return tuple(sorted([*apart, *jumps]))


def _few(cuts: Sequence[float]) -> Sequence[float]:
    """At most so many of the cuts as are checked."""
    return cuts[:: max(1, -(-len(cuts) // _MOST_CHECKED_CUTS))]


def times_within(start: float, end: float, shares: Array) -> Array:
    """Times at shares of a slab; at its end, where states may jump, the last number before it."""
    return np.asarray(np.minimum(start + (end - start) * shares, np.nextafter(end, start)))


def measure(
    slabs: Sequence[SlabTrain],
    reference: Reference,
    scale: Array,
    corners: int,
    whole_box: bool,
    unknowns: int | None = None,
    counted: tuple[int, ...] | None = None,
) -> Measured:
    """Errors of the slabs against the reference over their whole time span.

    Parameters
    ----------
    scale : ndarray (n,)
        Size of each state over the interior points. Errors at corners are relative to the largest
        value over the corners, where that is larger.
    corners : int
        Number of check points, after the centre, that are corners of the box.
    whole_box : bool
        Whether they count like the others.
    unknowns : int, optional
        So many states, the first, are measured: those after them are lifted and serve the others.
    counted : tuple of int, optional
        Those of them whose error counts.
    """
    m = len(reference.points)
    errors = np.zeros((scale.size, m))
    largest = scale.copy()
    at_corners, not_corners = slice(1, 1 + corners), np.r_[0, 1 + corners : m]
    all_times = [times_within(slab.start, slab.end, _CHECK_SHARES) for slab in slabs]
    all_exact = np.split(reference(np.concatenate(all_times)), len(slabs), axis=2)
    carry, last = np.zeros((0, m)), None
    for slab, times, exact in zip(slabs, all_times, all_exact, strict=True):
        if last is None or not slab.shares_parameters(last):
            carry, last = slab.over_parameters(reference.points.T), slab
        states = slab.on_grid(times, carry)
        errors = np.maximum(errors, np.abs(states - exact).max(axis=2))
        corner_sizes = np.abs(exact[:, at_corners]).max(axis=(1, 2), initial=0.0)
        largest = np.maximum(largest, corner_sizes)
    errors = np.where(np.isfinite(errors), errors, np.inf)[:unknowns]
    errors[:, at_corners] /= largest[:unknowns, None]
    errors[:, not_corners] /= scale[:unknowns, None]
    counts = np.ones(m, dtype=bool)
    counts[at_corners] = whole_box
    of_states = errors if counted is None else errors[list(counted)]
    of_points = of_states[:, counts].max(axis=0)
    corner_errors = errors[:, at_corners].max(axis=1, initial=0.0)
    return Measured(
        interior=tuple(errors[:, counts].max(axis=1).tolist()),
        corners=tuple(corner_errors.tolist()) if corners else (),
        points=m,
        method="Radau" if reference.stiff else "DOP853",
        cover="box" if whole_box else "interior",
        quantile=float(np.quantile(of_points, _SAFE_QUANTILE, method="higher")),
        worst=tuple(reference.points[counts][np.argmax(of_points)].tolist()),
        counted=counted,
    )


def drift(system: System, domain: Domain, slabs: Sequence[SlabTrain]) -> float:
    """Largest difference between lifted states and what they stand for, relative to their sizes.

    ``s`` for ``sin(x)`` and ``c`` for ``cos(x)`` are on the circle as long as both stay sine and
    cosine of the ``x`` that is solved for with them.
    """
    points = check_points(domain.bounds, _DRIFT_POINTS).T
    count = system.n_lifted
    size, worst = np.zeros(count), np.zeros(count)
    for slab in slabs:
        times = times_within(slab.start, slab.end, _DRIFT_SHARES)
        states = slab.on_grid(times, slab.over_parameters(points))
        lifted, meant = states[-count:], system.meanings(times, states, points[:, :, None])
        size = np.maximum(size, np.abs(lifted).max(axis=(1, 2)))
        worst = np.maximum(worst, np.abs(lifted - meant).max(axis=(1, 2)))
    return float(np.nan_to_num(worst / np.where(size > 0.0, size, 1.0), nan=np.inf).max())


def worst_points(
    reference_set: ReferenceSet,
    slabs: Sequence[SlabTrain],
    error: float,
    rtol: float,
    attempt: int,
) -> Array | None:
    """Points (m, d) where the error is expected to be above the tolerance; None if there are none.

    Parameters
    ----------
    reference_set : ReferenceSet
    slabs : sequence of SlabTrain
    error : float
        Measured error over the tolerance.
    rtol : float
    attempt : int
        Its number: each has points of its own.
    """
    if not reference_set.domain.box or not slabs or not reference_set.checked:
        return None
    generator = np.random.default_rng((20141, attempt + 1))
    doubtful = np.concatenate(
        [
            _by_residual(reference_set, slabs, error, rtol, generator),
            _after_jumps(reference_set, slabs, rtol, generator),
        ]
    )
    return doubtful if len(doubtful) else None


def _by_residual(
    reference_set: ReferenceSet,
    slabs: Sequence[SlabTrain],
    error: float,
    rtol: float,
    generator: np.random.Generator,
) -> Array:
    """Points (m, d) where the residual, beside those of known trajectories, is large."""
    lower, upper = reference_set.domain.bounds.T
    unit, tolerated = _candidates(lower.size, _affordable(slabs[-1:]), generator)
    if reference_set.whole_box:
        tolerated = np.ones(len(unit))
    candidates = lower + (upper - lower) * unit
    compared = reference_set.interior_points[-_MOST_KNOWN:]
    points = np.concatenate([compared, candidates])
    ratios = np.zeros(len(candidates))
    carry, last = np.zeros((0, 0)), None
    for i in sorted({round(i) for i in np.linspace(0, len(slabs) - 1, _MOST_SLABS)}):
        slab = slabs[i]
        if last is None or not slab.shares_parameters(last):
            carry, last = slab.over_parameters(points.T), slab
        residuals = _residuals(reference_set, slab, points, carry)
        floor = _NEGLIGIBLE * rtol / (slab.end - slab.start)
        usual = np.maximum(residuals[:, : len(compared)].max(axis=1, keepdims=True), floor)
        ratios = np.maximum(ratios, (residuals[:, len(compared) :] / usual).max(axis=0))
    ratios = np.where(np.isfinite(ratios), ratios, np.inf) / tolerated
    worst = np.argsort(-ratios, kind="stable")[:_CHOSEN]
    doubtful = ratios[worst] * max(error, _NEGLIGIBLE) > _DOUBTFUL_ERROR
    return np.asarray(candidates[worst[doubtful]])


def _affordable(slabs: Sequence[SlabTrain]) -> int:
    """Points at which trains can be evaluated within the work allowed."""
    work = max(sum(core.size for core in slab.cores[1:]) for slab in slabs)
    return int(_WORK / max(work, 1))


def _candidates(d: int, affordable: int, generator: np.random.Generator) -> tuple[Array, Array]:
    """Points (m, d) of the unit cube, and by how much errors there may be larger, (m,)."""
    if d <= FEW_PARAMETERS:
        return generator.random((_CANDIDATES, d)), np.ones(_CANDIDATES)
    count = min(max(affordable, _CANDIDATES), _CORNER_SHARE * _CANDIDATES)
    points = generator.random((count, d))
    near = np.arange(count) % _CORNER_SHARE == 0
    offset = 2.0 * points[near] - 1.0
    points[near] = 0.5 + 0.5 * np.sign(offset) * np.abs(offset) ** _CORNER_POWER
    return points, np.where(near, _CORNER_ERROR, 1.0)


def _residuals(reference_set: ReferenceSet, slab: SlabTrain, points: Array, carry: Array) -> Array:
    """Largest residual of a state, in units of the sizes, at each time and point: (T, m)."""
    system, units = reference_set.system, reference_set.states[:, None]
    times = slab.start + (slab.end - slab.start) * _RESIDUAL_SHARES
    states, rates = slab.on_grid(times, carry), slab.derivative().on_grid(times, carry)
    cost = function_cost(system.rhs, system.user_functions)
    charge(len(times) * (cost(len(points)) + 2.0 * states[:, :, 0].size))
    with np.errstate(all="ignore"):
        residuals = [
            np.abs(rates[:, :, j] - system.rhs(time, states[:, :, j], points.T)) / units
            for j, time in enumerate(times)
        ]
    return np.stack([np.nan_to_num(each.max(axis=0), nan=np.inf) for each in residuals])


def _after_jumps(
    reference_set: ReferenceSet,
    slabs: Sequence[SlabTrain],
    rtol: float,
    generator: np.random.Generator,
) -> Array:
    """Points (m, d) where the states after a jump are not what it makes of those before it."""
    jumps, bounds = reference_set.system.jumps, reference_set.domain.bounds
    lower, upper = bounds.T
    affordable = _affordable(slabs)
    count = min(_JUMP_CANDIDATES, max(_CANDIDATES, affordable))
    anywhere = lower + (upper - lower) * generator.random((count, lower.size))
    climb = replace(_TO_KINKS, tries=min(max(affordable // _CLIMBERS, 1), _TO_KINKS.tries))
    doubtful, looks = [anywhere[:0]], dict.fromkeys(range(len(slabs)), 0)
    for before, after in itertools.pairwise(slabs):
        kind = jumps.kind_at(before.end)
        if kind is None or looks[kind] == _MOST_SLABS:
            continue
        looks[kind] += 1
        rough = kind in jumps.rough_kinds
        error = _jump_error(reference_set, kind, before, after)
        points = anywhere if rough else anywhere[:_CANDIDATES]
        inside = points_in_elements(after.bases, len(points) // 2, generator)
        points = np.concatenate([points, inside])
        errors = error(points)
        # Points from everywhere, and not the worst alone, which may lie at one border.
        wrong = np.flatnonzero(errors > _JUMP_ERROR * rtol)
        doubtful.append(points[wrong[:: max(1, len(wrong) // _CHOSEN)][:_CHOSEN]])
        if rough:  # kinks are thin: climb towards them
            best = np.argsort(-errors, kind="stable")[:_CLIMBERS]
            points, errors = climbed(error, points[best], errors[best], bounds, climb)
        worst = np.argsort(-errors, kind="stable")[:_CHOSEN]
        doubtful.append(points[worst[errors[worst] > _JUMP_ERROR * rtol]])
    return np.concatenate(doubtful)


def _jump_error(
    reference_set: ReferenceSet, kind: int, before: SlabTrain, after: SlabTrain
) -> Callable[[Array], Array]:
    """Largest error of a state after a jump between two slabs, in units of the sizes.

    It maps points (m, d) to errors (m,).
    """
    system, units = reference_set.system, reference_set.states[:, None]
    cost = function_cost(system.jumps.jumped, system.user_functions)
    time = np.array([before.end])

    def error(points: Array) -> Array:
        charge(cost(len(points)))
        carry = before.over_parameters(points.T)
        start = before.on_grid(time, carry)[:, :, 0]
        if not after.shares_parameters(before):
            carry = after.over_parameters(points.T)
        end = after.on_grid(time, carry)[:, :, 0]
        with np.errstate(all="ignore"):
            errors = np.abs(end - system.jumps.jumped(kind, start, points.T)) / units
        return np.asarray(np.nan_to_num(errors.max(axis=0), nan=np.inf))

    return error
