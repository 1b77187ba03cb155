"""Lengths of slabs: the time nodes resolve them, and the sweeps converge on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rankone.discretization import Basis1D, RadauCollocation
from rankone.discretization.time_grid import times_within
from rankone.ir.verdict import Status
from rankone.solvers.march import SlabTrial, Span
from rankone.solvers.train.options import (
    DIVERGED_FACTOR,
    FAST_FACTOR,
    MEMORY_HALVING_LIMIT,
    RECOVERY_FACTOR,
    REFERENCE_NOISE,
    RETRY_LENGTH_RATIO,
    SHORTEST_SLAB,
    SLOW_FACTOR,
)
from rankone.solvers.train.sweep import Sweeper
from rankone.support.arrays import Array
from rankone.tensors.train import Train
from rankone.verification.reference_set import ReferenceSet


@dataclass(frozen=True)
class Accuracy:
    """Tolerances of the slabs of one attempt, in units of the states' sizes.

    ``level`` is the inner tolerance where errors do not grow; ``growth`` gives the largest later
    growth of an error made at a time.
    """

    level: float
    growth: Callable[[float], float]

    def tolerance(self, time: float) -> float:
        """Inner tolerance at a time: errors made there are amplified until the end."""
        return max(self.level / self.growth(time), 1e-14)

    @property
    def resolution(self) -> float:
        """Largest dropped time mode: not amplified, as the end points are superconvergent."""
        return 0.1 * self.level


@dataclass(frozen=True)
class Guess:
    """A slab of an earlier attempt, with its train as a first guess."""

    start: float
    length: float
    train: Train
    bases: tuple[Basis1D, ...]


@dataclass(frozen=True)
class TrainSpan(Span):
    """The interval of a slab, and the same slab of an earlier attempt if there is one."""

    guess: Guess | None = None


@dataclass(frozen=True)
class TrainTrial(SlabTrial):
    """A swept slab; ``spectra`` holds the norms of the modes by parameter."""

    sweeper: Sweeper
    spectra: Sequence[Array]

    @cached_property
    def time_modes(self) -> Array:
        """Legendre coefficients in time of the scaled states, (n_differential, modes, r_1)."""
        start = self.sweeper.source_in_frame()[:, None]
        collocation = self.sweeper.operator.collocation
        nodes = self.sweeper.cores[0][: len(start)] * np.sqrt(collocation.count)
        return np.asarray(collocation.to_modal @ np.concatenate([start, nodes], axis=1))


@dataclass
class SlabLengths:
    """The controller of the lengths of slabs; ``guesses`` are the slabs of the attempt before.

    The time nodes resolve the reference; no slab crosses a cut or is longer than ``longest``.
    """

    reference_set: ReferenceSet
    collocation: RadauCollocation
    accuracy: Accuracy
    guesses: Sequence[Guess] = ()
    longest: float = math.inf

    def __post_init__(self) -> None:
        end = self.reference_set.end
        self.borders = (*self.reference_set.cuts, end)
        self.horizon = end - self.reference_set.reference.start
        self.length = self.ceiling = self._proposed = min(self.horizon, self.longest)
        self._memory = self._hopeless = False

    def propose(self, start: float) -> TrainSpan | Status:
        """The next slab: the same as earlier, or as long as its nodes resolve the reference."""
        if self._hopeless:
            return Status.MEMORY_LIMIT
        if self.length < min(SHORTEST_SLAB * self.horizon, self.borders[-1] - start):
            return Status.NO_CONVERGENCE
        self._proposed = self.length
        border = min(b for b in self.borders if b > start + 1e-12 * self.horizon)
        remaining = border - start
        guess = self._guess(start)
        length = guess.length if guess else self.resolved(start, min(self.length, remaining))
        if guess is None and length < remaining < 1.6 * length:
            length = 0.5 * remaining
        if abs(remaining - length) < 1e-9 * remaining:
            return TrainSpan(start, remaining, border, guess)
        return TrainSpan(start, length, start + length, guess)

    def adapt(self, span: TrainSpan, trial: TrainTrial) -> bool:
        """Shorten after a rejection, lengthen where few sweeps were needed."""
        solved = trial.record.accepted
        stretch = self._stretch(span, trial) if solved else DIVERGED_FACTOR
        self._memory = self._memory or Status.MEMORY_LIMIT in trial.limits
        if not solved or stretch < RETRY_LENGTH_RATIO:
            self.ceiling = self.length = span.length * max(stretch, 0.2)
            self._hopeless = self._memory and self.length < MEMORY_HALVING_LIMIT * self.horizon
            return False
        sweeps = len(trial.record.residuals)
        factor = FAST_FACTOR if sweeps <= 3 else SLOW_FACTOR if sweeps >= 6 else 1.0
        self.length = span.length * min(factor, stretch)
        self.ceiling = min(RECOVERY_FACTOR * self.ceiling, self.longest)
        if span.end in self.borders:
            self.length = max(self.length, self._proposed)
        self.length = min(self.length, self.ceiling)
        return True

    def resolved(self, start: float, length: float) -> float:
        """The longest slab, up to ``length``, on which the time nodes resolve the reference."""
        tolerance = max(self.accuracy.resolution, REFERENCE_NOISE)
        scale = self.reference_set.states[:, None, None]
        nodes = self.collocation
        for _ in range(60):
            times = times_within(start, start + length, nodes.points)
            states = self.reference_set.reference(times) / scale
            tail = float(np.abs((states @ nodes.to_modal.T)[..., -2:]).max())
            if tail <= tolerance:
                break
            length *= min(max(0.9 * (tolerance / tail) ** (1.0 / nodes.count), 0.3), 0.9)
        return length

    def _stretch(self, span: TrainSpan, trial: TrainTrial) -> float:
        """Factor on the length at which the highest time modes would be at the tolerance."""
        tail = float(np.sqrt(np.sum(trial.time_modes[:, -2:] ** 2, axis=(1, 2)).max()))
        allowed = max(20.0 * self.accuracy.tolerance(span.start), self.accuracy.resolution)
        return float((allowed / max(tail, 1e-300)) ** (1.0 / self.collocation.count))

    def _guess(self, start: float) -> Guess | None:
        """The slab of the attempt before that starts here, if it is not too long."""
        for guess in self.guesses:
            if abs(guess.start - start) < 1e-12 * (1.0 + abs(start)):
                longest = min(self.length, self.resolved(start, guess.length))
                return guess if guess.length <= 1.01 * longest else None
        return None
