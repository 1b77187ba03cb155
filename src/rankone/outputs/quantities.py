"""Quantities of interest as functions of arrays, without symbols."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

from rankone.support.arrays import Array


class Kind(Enum):
    """How a function of time is reduced."""

    INTEGRAL = "integral"
    RUNNING = "running integral"
    MAXIMUM = "maximum"
    MINIMUM = "minimum"
    CROSSING = "first crossing"
    DURATION = "duration"


@dataclass(frozen=True)
class Reduction:
    """A reduction of an integrand, a function of time.

    Attributes
    ----------
    kind : Kind
    integrand : int
        Position of the integrand.
    start, end : float
        Limits of an integral; otherwise those of the horizon. A running integral has no end.
    direction : int
        Direction of a crossing of zero: 1 upwards, -1 downwards, 0 either.
    text : str
        The reduction in messages.
    """

    kind: Kind
    integrand: int
    start: float
    end: float
    direction: int
    text: str


@dataclass(frozen=True)
class Source:
    """A state of the solution, or its time derivative of some order."""

    row: int
    order: int = 0


@dataclass(frozen=True)
class Quantities:
    """Functions of states, time and parameters.

    Attributes
    ----------
    names, texts : tuple of str
        The name of each quantity, and its definition as text.
    timeless : bool
        Whether no quantity depends on time.
    sources : tuple of Source
    integrands : callable
        From times (T, 1), the sources (k, T, m), parameters (d, m) to a sequence of arrays that
        broadcast to (T, m).
    reductions : tuple of Reduction
    state_surfaces : callable
        From the same to functions that vanish where a narrow feature is largest or steepest.
    parameter_surfaces : callable
        From parameters (d, m) alone to functions of several of them that vanish where a narrow
        feature is largest or steepest.
    cuts : tuple of tuple of float
        For time and each parameter the places where functions of it alone are narrow, kink or jump.
    values : callable
        From times, sources and parameters as before, and a sequence of reductions, (m,) or (T, m),
        to a sequence of arrays that broadcast to (T, m).
    gaps : callable
        From times, sources and parameters to functions that are one where a piecewise function of
        the states has no branch, and zero elsewhere.
    gap_texts : tuple of str
        The message of each gap.
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
