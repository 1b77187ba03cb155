"""Quantities of interest as functions of arrays, without symbols."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import cast

import numpy as np
from scipy import special

from rankone.support.arrays import Array


@dataclass(frozen=True)
class WrittenFunction:
    """A function of arrays as text: the expressions, and the names of its arguments.

    ``called`` are functions of the user and tables by the names that the text calls them by. The
    text is compiled when it is first called, also in another process.
    """

    arguments: str
    texts: tuple[str, ...]
    called: Mapping[str, Callable[..., Array]] = field(default_factory=dict)

    @cached_property
    def function(self) -> Callable[..., Sequence[Array]]:
        """The function that the text says."""
        namespace = {"np": np, "special": special, **self.called}
        text = f"lambda {self.arguments}: [{', '.join(self.texts)}]"
        return cast(Callable[..., Sequence[Array]], eval(text, namespace))

    def __call__(self, *arguments: object) -> Sequence[Array]:
        return self.function(*arguments)

    def __getstate__(self) -> dict[str, object]:
        return {name: held for name, held in vars(self).items() if name != "function"}


class Kind(Enum):
    """How a function of time is reduced."""

    INTEGRAL = "integral"
    RUNNING = "running integral"
    MAXIMUM = "maximum"
    MINIMUM = "minimum"
    CROSSING = "first crossing"
    DURATION = "duration"
    INSTANT = "value at an instant"


@dataclass(frozen=True)
class Border:
    """The end of a stretch of a timeline, by its place from 1, or behind it the next beginning."""

    place: int
    after: bool = False


@dataclass(frozen=True)
class Reduction:
    """A reduction of the integrand at a position, a function of time.

    It has the limits of an integral or else of the horizon; a running integral has no end. The
    value at an instant, which is its start, is asked for over stretches alone.
    """

    kind: Kind
    integrand: int
    start: float | Border
    end: float | Border
    direction: int  # of a crossing of zero: 1 upwards, -1 downwards, 0 either
    text: str  # in messages


@dataclass(frozen=True)
class Source:
    """A state of the solution, or its time derivative of some order.

    Or, of solutions with events, the derivative by the parameter at a position, at fixed time.
    """

    row: int
    order: int = 0
    parameter: int | None = None

    @property
    def is_state(self) -> bool:
        return self.order == 0 and self.parameter is None


@dataclass(frozen=True)
class Quantities:
    """Functions of states, time and parameters, with their definitions as texts.

    They take times (T, 1), the sources (k, T, m) and parameters (d, m), those of surfaces of
    parameters the last alone, and ``values`` also the reductions, (m,) or (T, m). They give
    sequences of arrays that broadcast to (T, m). Surfaces are zero where a narrow feature is
    largest or steepest, or kinks; the ``state_surfaces`` behind the first ``n_state_surfaces`` are
    zero where something jumps. Those of parameters are functions of several of them.
    """

    names: tuple[str, ...]
    texts: tuple[str, ...]
    timeless: bool
    sources: tuple[Source, ...]
    integrands: Callable[[Array, Array, Array], Sequence[Array]]
    reductions: tuple[Reduction, ...]
    n_state_surfaces: int
    state_surfaces: Callable[[Array, Array, Array], Sequence[Array]]
    parameter_surfaces: Callable[[Array], Sequence[Array]]
    # for time and each parameter the places where functions of it alone are narrow, kink or jump
    cuts: tuple[tuple[float, ...], ...]
    values: Callable[[Array, Array, Array, Sequence[Array]], Sequence[Array]]
    # one where a piecewise function of the states has no branch, and zero elsewhere
    gaps: Callable[[Array, Array, Array], Sequence[Array]]
    gap_texts: tuple[str, ...]
    # pairs of a state and a number, which are summed: rows of sources behind those of the states
    sums: tuple[tuple[tuple[int, float], ...], ...] = ()
