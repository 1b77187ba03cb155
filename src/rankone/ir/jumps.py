"""Jumps: states that are reset at known times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from rankone.ir.features import Gaps, VectorLike
from rankone.support.arrays import Array
from rankone.support.errors import warn

# In horizons: a jump closer to the end than this is at the end but for rounding
_DISTANCE_FROM_END = 1e-9
Jumped: TypeAlias = Callable[[int, VectorLike, VectorLike], Array]
"""States after a jump, from its kind, the states before and the parameters."""


def unchanged(_kind: int, u: VectorLike, _p: VectorLike) -> Array:
    """The states before: nothing is reset."""
    return np.array(u, dtype=float)


@dataclass(frozen=True, eq=False)
class Jumps:
    """The jumps of a system; empty where states are never reset.

    Attributes
    ----------
    times : tuple of float
        Ascending.
    kinds : tuple of int
        For each time the number that ``jumped`` takes.
    rough_kinds : tuple of int
        The kinds whose values are not polynomials of the states.
    jumped : callable
        States right after a jump from its kind, the states u (n, ...) before it and p (d, ...):
        shape (n, ...).
    gaps : Gaps
        Where piecewise functions in what is reset have no branch.
    """

    times: tuple[float, ...] = ()
    kinds: tuple[int, ...] = ()
    rough_kinds: tuple[int, ...] = ()
    jumped: Jumped = unchanged
    gaps: Gaps = field(default_factory=Gaps)

    def inside(self, start: float, end: float) -> tuple[float, ...]:
        """The times inside of a horizon, ascending."""
        last = end - _DISTANCE_FROM_END * (end - start)
        return tuple(time for time in self.times if start < time < last)

    def kind_at(self, time: float) -> int | None:
        """The kind of the jump at a time; None if there is none."""
        pairs = zip(self.times, self.kinds, strict=True)
        return next((kind for at, kind in pairs if at == time), None)

    def warn_of_last(self, start: float, end: float) -> None:
        """Warn of a jump that is so close to the end of the horizon that it is not taken."""
        before_end = [time for time in self.times if start < time < end]
        if len(before_end) > len(self.inside(start, end)):
            warn(
                f"the jump at {before_end[-1]!r} is at the end of the horizon, {end!r}, but for "
                "rounding, and is not taken; remedy: move the end"
            )
