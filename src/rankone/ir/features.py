"""Features: all that is not smooth, or so narrow that samples may miss it.

A *cut* is a point of one coordinate, a *surface* the set of zeros of a function of several
variables. Features are derived from the equations once, printed into the generated module, and
used wherever steps, elements, samples and check points are placed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from rankone.support.arrays import Array

VectorLike: TypeAlias = "Array | Sequence[float] | Sequence[Array]"
"""States (n, ...) or parameters (d, ...): an array, or a sequence of its rows."""
OfParameters: TypeAlias = Callable[[VectorLike], Array]
"""A function of p (d, ...)."""
OfStates: TypeAlias = "Callable[[float | Array, VectorLike, VectorLike], Array]"
"""A function of t, u (n, ...) and p (d, ...)."""


GAP_REMEDY = "add a branch (value, True) for everything else, or let its conditions cover this too"
"""What to do about a gap, wherever it shows."""


def no_rows(*_: float | VectorLike) -> Array:
    """No function values, whatever the arguments: shape (0, 1)."""
    return np.empty((0, 1))


@dataclass(frozen=True, eq=False)
class Features:
    """Where functions of the right-hand side jump, kink or are narrow; empty where nothing does.

    Attributes
    ----------
    cuts : tuple of tuple of float
        For time and each parameter the points at which functions of it alone are not smooth.
    periodic_cuts : tuple of tuple of (float, float)
        The same for points that repeat: one of them and the period.
    n_moving_cuts : int
        Number of ``moving_cuts``.
    moving_cuts : callable
        Times at which functions of time and parameters are not smooth, at p (d, ...): (cuts, ...).
    n_parameter_surfaces : int
        Number of ``parameter_surfaces``.
    parameter_surfaces : callable
        Functions of several parameters that vanish, or are least, where others are not smooth, at
        p (d, ...): (surfaces, ...).
    n_peaks, n_kinks, n_steps : int
        Numbers of the ``state_surfaces`` of each sort, in this order: those that vanish in the
        middle of smooth peaks, at kinks, and at steps.
    state_surfaces : callable
        Functions that vanish where the rates are not smooth over the states, at t, u (n, ...) and
        p (d, ...): (surfaces, ...).
    """

    cuts: tuple[tuple[float, ...], ...]
    periodic_cuts: tuple[tuple[tuple[float, float], ...], ...]
    n_moving_cuts: int = 0
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
    """Where piecewise functions of the states have no branch.

    Attributes
    ----------
    texts : tuple of str
        What to say of each gap.
    inside : callable
        For each gap one inside of it, else zero, at t, u (n, ...) and p (d, ...): (gaps, ...).
    """

    texts: tuple[str, ...] = ()
    inside: OfStates = no_rows

    def entered(self, t: float, u: Array, p: Array) -> str | None:
        """The text of the first gap that states u (n, 1) at p (d, 1) lie in."""
        if not self.texts:
            return None
        inside = np.broadcast_to(self.inside(t, u, p), (len(self.texts), 1))[:, 0]
        return next((text for text, here in zip(self.texts, inside, strict=True) if here), None)
