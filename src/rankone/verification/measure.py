"""The reference set of a solve: trajectories, sizes, measured errors."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rankone.ir.domain import Domain
from rankone.ir.outcome import Measured
from rankone.ir.request import SolveRequest
from rankone.ir.system import System
from rankone.ir.verdict import NumericallyZero
from rankone.support.arrays import Array
from rankone.support.budget import unlimited
from rankone.support.errors import ConvergenceError
from rankone.tensors.slab import SlabTrain
from rankone.verification.breakpoints import Breakpoints, system_breakpoints
from rankone.verification.points import active_points, cell_points, surface_points
from rankone.verification.reference import (
    FEW,
    Reference,
    check_points,
    integrate_reference,
    measure,
    times_within,
)

__all__ = ["ReferenceSet"]

_ACCURACY = 3e-3
"""Tolerance of the reference, for the worst of its trajectories, over that asked for."""
_BLOW_UP_FRACTION = 0.9
"""Part of the way to a blow-up that is still solved."""
_INSET = 4e-9
"""By how much, in widths of the interval, corners are moved inside where functions jump."""
_SMALLEST = 1e-140
"""Size of a state below which its square is lost."""
_BETWEEN_JUMPS = np.array([0.0, 0.3, 0.7, 1.0])
"""Where sizes are looked at from one jump to the next."""
_COINCIDENT = 1e-13
"""Cuts this close to a jump, relative to the ends of the horizon, are that jump."""
_BESIDE = 16
"""Most breakpoints of a parameter that are checked on either side."""


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
    special : tuple of Breakpoints
        The same for the factors of each parameter.
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
    special: tuple[Breakpoints, ...] = ()
    counted: tuple[int, ...] | None = None

    @classmethod
    def of(cls, system: System, request: SolveRequest) -> ReferenceSet:
        """Integrate the reference for a solve."""
        domain, rtol = request.domain, request.rtol
        check, cover, counted = request.check.points, request.check.cover, request.check.states
        whole_box = len(domain.box) <= FEW if cover is None else cover == "box"
        in_time, *special = system_breakpoints(system, domain)
        cuts = _with_jumps(in_time.points, system, domain)
        beside = [_few(each.points) for each in special]
        few = beside if check else ()
        every = whole_box or len(domain.box) <= FEW
        points = check_points(domain.bounds, check, special=few, every_corner=every)
        points = _off_switches(points, system, domain)
        active = points[:0]
        if check:
            cells = cell_points(domain, [each.points for each in special])
            given = active_points(system, domain), surface_points(system, domain), cells
            active = np.concatenate(given)
        points = np.concatenate([points, active])
        accuracy = max(_ACCURACY * rtol, 3e-13)
        reference = integrate_reference(system, points, *domain.horizon, accuracy, cuts)
        interior = 1 + check + 2 * sum(map(len, beside)) + len(active)
        corners = len(points) - interior if check and domain.box else 0
        found = cuts, tuple(special), counted
        made = cls(system, domain, accuracy, reference, corners, whole_box, bool(check), *found)
        _check_sizes(made)
        return made

    def with_points(self, points: Array) -> ReferenceSet:
        """The same with more interior points (m, d); those of before are not integrated again."""
        horizon = self.domain.horizon
        more = integrate_reference(self.system, points, *horizon, self.accuracy, self.cuts)
        return replace(self, reference=self.reference.joined(more), checked=True)

    @property
    def end(self) -> float:
        """End of what is to be solved: the horizon, or shortly before a blow-up."""
        start, end = self.reference.start, self.reference.end
        return end if self.reference.blown is None else start + _BLOW_UP_FRACTION * (end - start)

    @cached_property
    def sizes(self) -> Array:
        """Largest absolute value of each state, products included; one for a vanishing state.

        Over the centre and the interior points: values at corners of a box of many
        parameters may be larger by orders of magnitude and are seen by nobody. States that are
        numerically zero get a size of which their rounding errors are a small part.
        """
        start, end = self.reference.start, self.end
        times = np.linspace(start, end, 201)
        for a, b in itertools.pairwise([start, *self.system.jumps.inside(start, end), end]):
            times = np.concatenate([times, times_within(a, b, _BETWEEN_JUMPS)])
        values = self.system.with_products(self.reference(times))
        values = np.delete(values, np.s_[1 : 1 + self.corners], axis=1)
        sizes = np.abs(values).max(axis=(1, 2))
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
        seen = len(self.system.unknowns)
        counts = self.corners, self.whole_box, seen, self.counted
        with unlimited():
            return measure(slabs, self.reference, self.states, *counts)

    @property
    def zeros(self) -> tuple[NumericallyZero, ...]:
        """The unknowns that are numerically zero."""
        unknowns = len(self.system.unknowns)
        zero = np.broadcast_to(self.reference.zero, len(self.states))[:unknowns]
        return tuple(
            NumericallyZero(
                self.system.states[i], float(self.reference.rounded[i]), float(self.states[i])
            )
            for i in np.nonzero(zero)[0]
        )

    @property
    def blow_up(self) -> tuple[float, tuple[float, ...]] | None:
        """Time and parameters near which a trajectory blows up."""
        if self.reference.blown is None:
            return None
        return self.reference.end, tuple(self.reference.points[self.reference.blown].tolist())


def _with_jumps(cuts: Sequence[float], system: System, domain: Domain) -> tuple[float, ...]:
    """The cuts, and the times of jumps in place of those that are the same but for rounding."""
    start, end = domain.horizon
    jumps = system.jumps.inside(start, end)
    near = _COINCIDENT * max(abs(start), abs(end))
    apart = (cut for cut in cuts if all(abs(cut - time) > near for time in jumps))
    return tuple(sorted([*apart, *jumps]))


def _check_sizes(reference_set: ReferenceSet) -> None:
    """Raise a ConvergenceError for states of which products are no floating-point numbers."""
    system = reference_set.system
    if system.separated and max((len(states) for *_, states in system.terms), default=0) < 2:
        return
    for name, size in zip(system.states, reference_set.states, strict=False):
        if not _SMALLEST < size < 1.0 / _SMALLEST:
            raise ConvergenceError(
                f"`{name}` is of the size {size:.1e}: its products are no floating-point numbers",
                remedy="change its unit",
            )


def _off_switches(points: Array, system: System, domain: Domain) -> Array:
    """Points (m, d) with corners moved a little inside where a function jumps at the very end."""
    moved = points.copy()
    tables = system.features.cuts[1:], system.features.periodic_cuts[1:]
    for j, (cuts, repeated) in enumerate(zip(*tables, strict=True)):
        lower, upper = domain.box[j]
        near = _INSET * (upper - lower)
        to_ends = [abs(cut - end) for cut in cuts for end in (lower, upper)]
        to_ends += [
            abs(math.remainder(end - first, period))
            for first, period in repeated
            for end in (lower, upper)
        ]
        if min(to_ends, default=math.inf) < near:
            moved[:, j] = np.clip(moved[:, j], lower + near, upper - near)
    return moved


def _few(points: Sequence[float]) -> Sequence[float]:
    """At most so many of the points as are checked."""
    return points[:: max(1, -(-len(points) // _BESIDE))]
