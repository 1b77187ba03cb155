"""What is asked for, as functions of arrays: no symbols any more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

from rankone.support.arrays import Array

__all__ = ["Kind", "Quantities", "Reduction", "Source"]


class Kind(Enum):
    """What is made of a function of time."""

    INTEGRAL = "integral"
    RUNNING = "running integral"
    MAXIMUM = "maximum"
    MINIMUM = "minimum"
    CROSSING = "first crossing"
    DURATION = "duration"


@dataclass(frozen=True)
class Reduction:
    """What is made of an integrand, a function of time.

    Attributes
    ----------
    kind : Kind
    integrand : int
        Which of the integrands.
    start, end : float
        Limits of an integral; of the horizon otherwise. A running integral has no end.
    direction : int
        Of a crossing of zero: 1 upwards, -1 downwards, 0 either.
    text : str
        For messages.
    """

    kind: Kind
    integrand: int
    start: float
    end: float
    direction: int
    text: str


@dataclass(frozen=True)
class Source:
    """What is needed of a solution: a state, or its time derivative of some order."""

    row: int
    order: int = 0


@dataclass(frozen=True)
class Quantities:
    """Functions of states, time and parameters.

    Attributes
    ----------
    names, texts : tuple of str
        Of each quantity, and what it is.
    timeless : bool
        Whether none depends on time.
    sources : tuple of Source
    integrands : callable
        From times (T, 1), the sources (k, T, m), parameters (d, m) to a sequence of arrays that
        broadcast to (T, m).
    reductions : tuple of Reduction
    state_surfaces : callable
        From the same to functions that vanish where something narrow is largest or steepest.
    parameter_surfaces : callable
        From parameters (d, m) alone to functions of several of them that vanish where something
        narrow is largest or steepest.
    cuts : tuple of tuple of float
        For time and each parameter where functions of it alone are narrow, kink or jump.
    values : callable
        From times, sources and parameters as before, and a sequence of reductions, (m,) or (T, m),
        to a sequence of arrays that broadcast to (T, m).
    gaps : callable
        From times, sources and parameters to functions that are one where a piecewise function of
        the states has no branch, and else zero.
    gap_texts : tuple of str
        What to say of each of them.
    """

    names: tuple[str, ...]
    texts: tuple[str, ...]
    timeless: bool
    sources: tuple[Source, ...]
    integrands: Callable[[Array, Array, Array], Sequence[Array]]
    reductions: tuple[Reduction, ...]
    state_surfaces: Callable[[Array, Array, Array], Sequence[Array]]
    parameter_surfaces: Callable[[Array], Sequence[Array]]
    cuts: tuple[tuple[float, ...], ...]
    values: Callable[[Array, Array, Array, Sequence[Array]], Sequence[Array]]
    gaps: Callable[[Array, Array, Array], Sequence[Array]]
    gap_texts: tuple[str, ...]
