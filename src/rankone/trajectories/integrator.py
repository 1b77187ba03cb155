"""What an integrator takes and gives: trajectories of a system at many parameter points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.trajectories.paths import Path

LAST_GAP = 100  # Distance from the end, in floating-point numbers, too short for a step of SciPy
EARLY_STEPS = 4  # Steps after which states that start from zero show their size
LEAST_TOLERANCE = 1e-290  # Least absolute tolerance: floating-point numbers end at 1e-308
JACOBIAN_ENTRY = 10.0  # Operations for each entry of a stack of Jacobians that is made or read


@dataclass(frozen=True)
class Tolerances:
    """How accurate the steps of an integration are; ``absolute`` is (n, 1), for each state."""

    relative: float
    absolute: Array
    longest_step: float = math.inf

    @classmethod
    def down_to(cls, relative: float, sizes: Array) -> Tolerances:
        """Those of states (n, 1) that are resolved relative to themselves down to ``sizes``."""
        return cls(relative, np.maximum(relative * sizes, LEAST_TOLERANCE))

    def times(self, factor: float) -> Tolerances:
        """Looser tolerances, for steps of the same length."""
        return replace(self, relative=factor * self.relative, absolute=factor * self.absolute)


@dataclass(frozen=True)
class Spans:
    """Where and how each of m trajectories begins, and when it ends.

    ``starts`` and ``ends`` are times (m,), and ``states`` (n, m) those at the starts. At the times
    (m, k) ``between`` them trajectories are about alike, so that a stack passes them together.
    """

    starts: Array
    states: Array
    ends: Array
    between: Array | None = None


class DenseTrajectories(Protocol):
    """Trajectories at all times that an integration reached.

    For n states at m points, (n, m): the ``state`` that it ended with, the ``last`` one before the
    jump there if there is one, and the ``largest`` absolute values after any step and after the
    ``early`` ones. ``steps`` counts those of the trajectory with most; each
    has made one if it ``has_begun``. ``avoided`` counts the explicit steps that were left when they
    were given up for implicit ones; it is 0 if none were. ``integrator`` is "stack", "single" or
    "compiled", and ``method`` the name of what made the last steps.
    """

    @property
    def start(self) -> float: ...
    @property
    def end(self) -> float: ...
    @property
    def steps(self) -> int: ...
    @property
    def has_begun(self) -> bool: ...
    @property
    def state(self) -> Array: ...
    @property
    def last(self) -> Array: ...
    @property
    def largest(self) -> Array: ...
    @property
    def early(self) -> Array: ...
    @property
    def avoided(self) -> float: ...
    @property
    def integrator(self) -> str: ...
    @property
    def method(self) -> str: ...

    def __call__(self, times: Array) -> Array:
        """States at times (T,), after a jump at its time: shape (n, m, T)."""

    def of(self, trajectories: slice) -> DenseTrajectories:
        """Some of the trajectories, which follow each other."""

    def samples(self, count: int) -> Iterable[tuple[float, Array]]:
        """At least ``count`` ends of steps, if there are as many, with the states (n, m) there."""


class SeparateTrajectories(DenseTrajectories, Protocol):
    """Dense trajectories that can be taken apart."""

    @property
    def paths(self) -> Sequence[Path]:
        """The trajectories one by one."""

    def of(self, trajectories: slice) -> SeparateTrajectories:
        """Some of the trajectories, which follow each other."""


@dataclass(frozen=True)
class SampledTrajectories:
    """States (T, n, m) at given times; the integration ``reached`` this number of them.

    It ended at the time ``end`` with the last ``state`` (n, m). ``integrator`` is as in
    :class:`DenseTrajectories`.
    """

    states: Array
    reached: int
    end: float
    state: Array
    integrator: str


class Integrator(Protocol):
    """Integrates a system at many parameter points.

    The points have shape (m, d). The edges are the start, times at which the integration begins
    anew, and the end; states are reset there where the system jumps. An integration ends early
    where a trajectory cannot go on. An OutOfBudgetError of :meth:`run` says how far it came.
    """

    def run(
        self, system: System, points: Array, edges: Sequence[float], tolerances: Tolerances
    ) -> DenseTrajectories:
        """Trajectories at all times."""

    def sample(
        self,
        system: System,
        points: Array,
        edges: Sequence[float],
        tolerances: Tolerances,
        times: Array,
    ) -> SampledTrajectories:
        """Trajectories at ascending times (T,) alone."""


class Spanning(Protocol):
    """Gives each trajectory a span of its own."""

    def paths(
        self, system: System, points: Array, spans: Spans, tolerances: Tolerances
    ) -> Sequence[Path]:
        """Trajectories that each have a span of their own, or as far as they go.

        The system does not jump. An OutOfBudgetError says which time all would have reached.
        """


class SpanIntegrator(Integrator, Spanning, Protocol):
    """An integrator that can give each trajectory a span of its own."""


def jacobians(system: System, points: Array, time: float | Array, states: Array) -> Array:
    """Jacobians of the rates at points (m, d), states (n, m) or (n m,), times: (m, n, n)."""
    n, m = system.n_differential, len(points)
    charge(function_cost(system.jacobian, system.user_functions)(m) + JACOBIAN_ENTRY * n * n * m)
    jacobian = system.jacobian(time, states.reshape(n, m), points.T)
    return np.moveaxis(np.broadcast_to(jacobian, (n, n, m)), 2, 0)


def finite_blocks(blocks: Array) -> Array:
    """Matrices (m, n, n) with zero in place of each that is not finite."""
    finite = np.isfinite(blocks)
    return blocks if finite.all() else np.where(finite.all((1, 2), keepdims=True), blocks, 0.0)
