"""What every engine does around its march: reference first, then measure, then say how it ended."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rankone.arrays import Array
from rankone.domain import Domain
from rankone.solvers.breakpoints import system_breakpoints
from rankone.solvers.outcome import Measured, Status
from rankone.solvers.reference import Reference, check_points, integrate_reference, measure
from rankone.system import System
from rankone.tensors.slab import SlabTrain

__all__ = ["Attempt", "Yardstick"]

_BLOW_UP_FRACTION = 0.9
"""Part of the way to a blow-up that is still solved."""
_CAUSES = (Status.NO_CONVERGENCE, *(s for s in Status if s is not Status.NO_CONVERGENCE))
"""Limits in the order in which they explain a failure."""


@dataclass(frozen=True)
class Yardstick:
    """Reference trajectories at the check points, and what is derived from them.

    Attributes
    ----------
    reference : Reference
        Trajectories at the centre, at corners and at random interior points.
    end : float
        End of what is to be solved: the horizon, or shortly before a blow-up.
    corners : int
        Number of check points, after the centre, that are corners.
    checked : bool
        Whether there are random points, so that an error can be stated.
    cuts : tuple of float
        Times at which the time factors jump, kink or are narrow.
    """

    reference: Reference
    end: float
    corners: int
    checked: bool
    cuts: tuple[float, ...] = ()

    @classmethod
    def of(cls, system: System, domain: Domain, rtol: float, check: int) -> Yardstick:
        """Integrate the reference for a solve to ``rtol`` with ``check`` random points."""
        cuts, special = system_breakpoints(system, domain)
        points = check_points(domain.bounds, check, special=special if check else ())
        accuracy = max(1e-3 * rtol, 3e-13)
        start = domain.horizon[0]
        reference = integrate_reference(system, points, *domain.horizon, accuracy, cuts)
        end = reference.end
        if reference.blown is not None:
            end = start + _BLOW_UP_FRACTION * (end - start)
        corners = len(points) - 1 - check - sum(map(len, special)) if check and domain.box else 0
        return cls(reference, end, corners, bool(check), cuts)

    def sizes(self, system: System) -> Array:
        """Largest absolute value of each state, products included; one for a vanishing state.

        Over the centre and the random interior points: values at corners of a box of many
        parameters may be larger by orders of magnitude and are seen by nobody.
        """
        values = system.with_products(
            self.reference(np.linspace(self.reference.start, self.end, 201))
        )
        values = np.delete(values, np.s_[1 : 1 + self.corners], axis=1)
        sizes = np.abs(values).max(axis=(1, 2))
        return np.where(sizes > 0.0, sizes, 1.0)

    def measured(self, slabs: Sequence[SlabTrain], sizes: Array) -> Measured | None:
        """Errors of the slabs in units of the sizes; None without check or slabs."""
        if not slabs or not self.checked:
            return None
        return measure(slabs, self.reference, sizes, self.corners)

    @property
    def blow_up(self) -> tuple[float, tuple[float, ...]] | None:
        """Time and parameters near which a trajectory blows up."""
        if self.reference.blown is None:
            return None
        return self.reference.end, tuple(self.reference.points[self.reference.blown].tolist())


@dataclass(frozen=True)
class Attempt:
    """What one pass over the horizon came to.

    Attributes
    ----------
    slabs : sequence of SlabTrain
    stopped : Status or None
        Why the pass ended early.
    limits : set of Status
        Limits that were met on the way.
    measured : Measured or None
    """

    slabs: Sequence[SlabTrain]
    stopped: Status | None
    limits: set[Status]
    measured: Measured | None

    @property
    def error(self) -> float:
        """Largest measured error; infinite if there is none."""
        if self.measured is None:
            return math.inf
        return max(self.measured.interior, default=0.0)

    def better_than(self, other: Attempt | None) -> bool:
        """Whether to keep this attempt: it got further, or as far with a smaller error."""
        if other is None:
            return True
        if (self.stopped is None) != (other.stopped is None):
            return self.stopped is None
        return self.error < other.error

    def status(self, yardstick: Yardstick, rtol: float) -> Status:
        """How the solve ended, if this attempt is what it came to."""
        limits = [status for status in _CAUSES if status in self.limits]
        if yardstick.reference.blown is not None:
            return Status.BLOW_UP
        if self.stopped is not None:
            gave_up = self.stopped is Status.NO_CONVERGENCE
            return limits[0] if gave_up and limits else self.stopped
        if not yardstick.checked:
            return Status.UNCHECKED
        if self.error <= rtol:
            return Status.CONVERGED
        return limits[0] if limits else Status.TOLERANCE

    def message(
        self, status: Status, rtol: float, remedies: Mapping[Status, str], cause: str | None = None
    ) -> str:
        """The sentence a user reads: how it ended, the figures, and what to do.

        ``cause`` says it in more detail than the status.
        """
        text = cause or status.value
        if self.measured is not None:
            figures = f"{self.error:.1e} of {rtol:.1e}"
            if status is not Status.CONVERGED:
                figures = f"measured error {self.error:.1e}, asked {rtol:.1e}"
            text += f": {figures}"
            corner = max(self.measured.corners, default=0.0)
            if corner > max(rtol, self.error):
                text += f" (up to {corner:.1e} at the corners of the box)"
        if self.stopped is not None:
            reached = f"at t = {self.slabs[-1].end:.6g}" if self.slabs else "before the first slab"
            text += f"; stopped {reached}"
        return f"{text}; {remedies[status]}" if status in remedies else text
