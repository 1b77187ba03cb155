"""All that is not smooth, or so narrow that samples may miss it, and the user's functions in
workers.

A *cut* is a point of one coordinate, a *surface* the set of zeros of a function of several
variables. Features are derived from the equations once, printed into the generated module, and
used wherever steps, elements, samples and check points are placed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from rankone.support.arrays import Array
from rankone.support.errors import ProblemError, warn
from rankone.support.precision import NEGLIGIBLE
from rankone.support.wording import quote

VectorLike: TypeAlias = "Array | Sequence[float] | Sequence[Array]"
"""States (n, ...) or parameters (d, ...): an array, or a sequence of its rows."""
OfParameters: TypeAlias = Callable[[VectorLike], Array]
"""A function of p (d, ...)."""
OfStates: TypeAlias = "Callable[[float | Array, VectorLike, VectorLike], Array]"
"""A function of t, u (n, ...) and p (d, ...)."""
Jumped: TypeAlias = Callable[[int, VectorLike, VectorLike], Array]
"""States after a jump, from its kind, the states before and the parameters."""

GAP_REMEDY = "add a branch (value, True) for everything else, or let its conditions cover this too"
"""What to do about a gap, wherever it shows."""


def no_rows(*_: float | VectorLike) -> Array:
    """No function values, whatever the arguments: shape (0, 1)."""
    return np.empty((0, 1))


@dataclass(frozen=True, eq=False)
class Features:
    """Where functions of the right-hand side jump, kink or are narrow; empty where nothing does.

    ``cuts`` has for time and each parameter the points at which functions of it alone are not
    smooth, ``periodic_cuts`` the points that repeat: one of them and the period. ``moving_cuts``
    are times at which functions of time and parameters p (d, ...) are not smooth; they jump or
    peak at the first ``n_moving_steps``.
    ``parameter_surfaces`` are functions of p that vanish, or are least, where functions of several
    parameters are not smooth. ``state_surfaces`` are functions of t, u (n, ...) and p that vanish
    where the rates are not smooth over the states: first ``n_peaks`` in the middle of smooth peaks,
    then ``n_kinks`` and ``n_steps``. All return (count, ...).
    """

    cuts: tuple[tuple[float, ...], ...]
    periodic_cuts: tuple[tuple[tuple[float, float], ...], ...]
    n_moving_cuts: int = 0
    n_moving_steps: int = 0
    moving_cuts: OfParameters = no_rows
    n_parameter_surfaces: int = 0
    parameter_surfaces: OfParameters = no_rows
    n_peaks: int = 0
    n_kinks: int = 0
    n_steps: int = 0
    state_surfaces: OfStates = no_rows

    @property
    def n_state_surfaces(self) -> int:
        """Number of ``state_surfaces``."""
        return self.n_peaks + self.n_kinks + self.n_steps


@dataclass(frozen=True, eq=False)
class Gaps:
    """Where piecewise functions of the states have no branch, with what to say of each gap.

    ``inside`` is for each gap one inside of it, else zero, at t, u (n, ...) and p (d, ...):
    (gaps, ...).
    """

    texts: tuple[str, ...] = ()
    inside: OfStates = no_rows

    def entered(self, t: float, u: Array, p: Array) -> str | None:
        """The text of the first gap that states u (n, 1) at p (d, 1) lie in."""
        if not self.texts:
            return None
        inside = np.broadcast_to(self.inside(t, u, p), (len(self.texts), 1))[:, 0]
        return next((text for text, here in zip(self.texts, inside, strict=True) if here), None)


def unchanged(_kind: int, u: VectorLike, _p: VectorLike) -> Array:
    """The states before: nothing is reset."""
    return np.array(u, dtype=float)


@dataclass(frozen=True, eq=False)
class Jumps:
    """The jumps of a system, by ascending times; empty where states are never reset.

    ``jumped`` returns the states right after a jump, (n, ...), from its kind, the states u (n, ...)
    before it and p (d, ...). ``rough_kinds`` are the kinds whose values are not polynomials of the
    states; ``gaps`` say where piecewise functions in what is reset have no branch.
    """

    times: tuple[float, ...] = ()
    kinds: tuple[int, ...] = ()
    rough_kinds: tuple[int, ...] = ()
    jumped: Jumped = unchanged
    gaps: Gaps = field(default_factory=Gaps)

    def inside(self, start: float, end: float) -> tuple[float, ...]:
        """The times inside of a horizon, ascending."""
        last = end - NEGLIGIBLE * (end - start)
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
                "rounding, and is not taken",
                remedy="move the end",
            )


# -----------------------------------------------------------------------------
# Functions of the user, and names of tables, as workers know them.
#
# SymPy is not needed for that: importing it takes a second.


PREFIX, POINTS, VALUES = "f_", "POINTS_", "VALUES_"
"""First letters of names in generated source: of a function, so that no local name hides it, and of
the data of a table."""
AT_THE_ENDS = NEGLIGIBLE
"""Distance outside a table, over its length, that is taken for rounding."""


class GuardedFunction:
    """A user's callable; errors in it name it."""

    def __init__(self, name: str, value: Callable[..., object]) -> None:
        self.name, self.value = name, value

    def __call__(self, *arguments: ArrayLike) -> Array:
        arrays = np.broadcast_arrays(*(np.asarray(a, dtype=float) for a in arguments))
        try:
            # copies, as a function may change its arguments
            returned = np.asanyarray(self.value(*(array.copy() for array in arrays)))
            real = not (np.iscomplexobj(returned) or np.ma.is_masked(returned))
            heights = np.asarray(returned, dtype=float) if real else np.full(1, np.nan)
        except Exception as error:
            raise ProblemError(
                f"function {quote(self.name)} raised {type(error).__name__}: {error}",
                term=self.name,
                remedy="it must take arrays and return real numbers",
            ) from error
        if not real:
            raise ProblemError(
                f"function {quote(self.name)} returned complex or masked numbers",
                term=self.name,
                remedy="return real numbers; NaN where there are none",
            )
        if heights.shape != arrays[0].shape:
            raise ProblemError(
                f"function {quote(self.name)} returned shape {heights.shape} for arguments of "
                f"shape {arrays[0].shape}",
                term=self.name,
                remedy="return one number for each point",
            )
        return heights
