"""What an integrator takes and gives, paths of piecewise polynomials, and spans as a stack."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import LEAST, Array, lobatto
from rankone.support.budget import OutOfBudgetError, charge
from rankone.support.costs import READ, function_cost
from rankone.tensors.time_grid import insets
from rankone.trajectories.system.features import Constraints, Jumps, OfParameters, VectorLike
from rankone.trajectories.system.system import System

_DEGREE = 6  # Degree of the polynomial of a step: further terms of LSODA's own are tiny
NODES = lobatto(_DEGREE + 1)
"""Chebyshev–Lobatto nodes of a step, as shares, the first one zero and the last one one."""
# From states at the nodes to coefficients of the powers of 2 share - 1
TO_POWERS = np.linalg.inv(np.vander(2.0 * NODES - 1.0, increasing=True))
_MANY_TIMES = 64  # Times of each path from which on their steps are looked up path by path
_FEW_STATES = 8  # States up to which coefficients of all of them are one product of matrices
BLOCK = 8192
"""Times, or steps, that are read together: what is in work fits the cache."""


@dataclass(frozen=True)
class Path:
    """One trajectory from the first of the ``breaks`` (S + 1,) to the last of them.

    ``nodal`` are the states (S, nodes, n) at the nodes of the steps, ``state`` is the last one.
    """

    breaks: Array
    nodal: Array
    state: Array

    @classmethod
    def resting(cls, time: float, state: Array) -> Path:
        """One that rests in a state (n,) from a time."""
        breaks = np.array([time, 2.0 * abs(time) + 1.0])
        return cls(breaks, np.repeat(state[None, None], NODES.size, axis=1), state)

    @property
    def end(self) -> float:
        return float(self.breaks[-1])

    @property
    def steps(self) -> int:
        return len(self.nodal)

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays, with the coefficients that are kept when it is read."""
        return int(self.breaks.nbytes + 2 * self.nodal.nbytes)

    @cached_property
    def coefficients(self) -> Array:
        """Of the powers of ``2 share - 1``, (nodes, S, n)."""
        return step_coefficients(self.nodal)

    def __call__(self, times: Array) -> Array:
        """States (n, T), after a jump at its time."""
        charge(READ(times.size * self.state.size))
        place = np.searchsorted(self.breaks, times, side="right") - 1
        place = np.clip(place, 0, self.steps - 1)
        width = np.diff(self.breaks)[place]
        share = (2.0 * (times - self.breaks[place]) / width - 1.0)[:, None]
        if times.size < self.steps and "coefficients" not in self.__dict__:
            coefficients = step_coefficients(self.nodal[place])  # of few steps
        else:
            coefficients = self.coefficients[:, place]
        states = coefficients[-1]
        for coefficient in coefficients[-2::-1]:
            states = states * share + coefficient
        return np.asarray(states.T)

    def largest(self, steps: int | None = None) -> Array:
        """Largest absolute values after any of the first steps, (n,)."""
        return np.asarray(np.abs(self.nodal[:steps, -1]).max(axis=0, initial=0.0))

    def until(self, time: float) -> Path:
        """The path up to a time within."""
        count = int(np.searchsorted(self.breaks, time))
        breaks = np.append(self.breaks[:count], time)
        nodal = self.nodal[:count].copy()
        nodal[-1] = self(breaks[-2] + (time - breaks[-2]) * NODES).T
        return Path(breaks, nodal, nodal[-1, -1])

    def over_times(self, start: float, end: float) -> Path:
        """A path over the share of the way as one over times.

        One that went all the way ends at the very end.
        """
        breaks = start + (end - start) * self.breaks
        return Path(np.where(self.breaks == 1.0, end, breaks), self.nodal, self.state)

    def over_shares(self, start: float, end: float) -> Path:
        """A path over times as one over the share of the way between two of them."""
        return Path((self.breaks - start) / (end - start), self.nodal, self.state)


@dataclass(frozen=True)
class Paths:
    """Several paths, which are read together.

    ``breaks`` (m, S + 1) are padded with infinity, ``first`` (m,) is the first step of each path,
    and ``nodal`` (steps of all, nodes, n) are the states at the nodes of the steps. Those of a
    stack are ``alike``: their steps are at the same times.
    """

    breaks: Array
    first: NDArray[np.intp]
    nodal: Array
    alike: bool = False

    @classmethod
    def of(cls, paths: Sequence[Path]) -> Paths:
        """Paths that have each made a step."""
        counts = np.array([path.steps for path in paths], dtype=np.intp)
        breaks = np.full((len(paths), counts.max() + 1), np.inf)
        for row, path in zip(breaks, paths, strict=True):
            row[: path.steps + 1] = path.breaks
        nodal = np.concatenate([path.nodal for path in paths])
        alike = all(path.breaks is paths[0].breaks for path in paths)
        return cls(breaks, np.cumsum(counts) - counts, nodal, alike)

    @cached_property
    def coefficients(self) -> Array:
        """Of the powers of ``2 share - 1``, (nodes, n, steps of all)."""
        steps, nodes, n = self.nodal.shape
        if n > _FEW_STATES:
            return np.ascontiguousarray(step_coefficients(self.nodal).swapaxes(1, 2))
        of_each = np.kron(TO_POWERS, np.eye(n))  # more products, but of steps as they are held
        coefficients = np.dot(of_each, self.nodal.reshape(steps, -1).T)
        return np.asarray(coefficients.reshape(nodes, n, steps))

    def __call__(self, times: Array) -> Array:
        """States (n, m, T) at times (m, T) of each path, after a jump at its time."""
        charge(READ(times.size * self.nodal.shape[2]))
        if self.alike:
            breaks = self.breaks[0]
            place = np.clip(breaks.searchsorted(times, side="right") - 1, 0, breaks.size - 2)
            begin, end = breaks[place], breaks[place + 1]
        else:
            steps = np.isfinite(self.breaks).sum(axis=1) - 1
            place = np.clip(_after(self.breaks, times) - 1, 0, steps[:, None] - 1)
            begin, end = (np.take_along_axis(self.breaks, place + k, axis=1) for k in (0, 1))
        shares = (2.0 * (times - begin) / (end - begin) - 1.0).ravel()
        chosen = (self.first[:, None] + place).ravel()
        few = times.size < len(self.nodal) and "coefficients" not in self.__dict__
        states = self._of_few(chosen, shares) if few else self._of_many(chosen, shares)
        return states.reshape(-1, *times.shape)

    def _of_few(self, steps: NDArray[np.intp], shares: Array) -> Array:
        """States (n, N) of some of the steps at shares (N,) from -1 to 1."""
        weights = np.vander(shares, NODES.size, True) @ TO_POWERS
        return np.asarray(np.matmul(weights[:, None], self.nodal[steps])[:, 0].T)

    def _of_many(self, steps: NDArray[np.intp], shares: Array) -> Array:
        """The same by Horner's scheme, from coefficients that are kept."""
        states = np.empty((self.nodal.shape[2], shares.size))
        for first in range(0, shares.size, BLOCK):
            here = slice(first, first + BLOCK)
            block = states[:, here]
            block[:] = self.coefficients[-1].take(steps[here], axis=1)
            for coefficient in self.coefficients[-2::-1]:
                block *= shares[here]
                block += coefficient.take(steps[here], axis=1)
        return states

    def chosen(self, places: NDArray[np.intp]) -> Paths:
        """Some of them."""
        return replace(self, breaks=self.breaks[places], first=self.first[places])

    def until(self, times: Array, states: Array) -> list[Path]:
        """Each path up to a time (m,), where it has a state (n, m)."""
        counts = (self.breaks < times[:, None]).sum(axis=1)
        begin = np.take_along_axis(self.breaks, np.maximum(counts - 1, 0)[:, None], axis=1)
        last = self(begin + (times[:, None] - begin) * NODES)
        cut = []
        for k, (count, first) in enumerate(zip(counts, self.first, strict=True)):
            breaks = np.append(self.breaks[k, :count], times[k])
            nodal = self.nodal[first : first + count].copy()
            if count:
                nodal[-1] = last[:, k].T
            cut.append(Path(breaks, nodal, states[:, k]))
        return cut


def _after(breaks: Array, times: Array) -> NDArray[np.intp]:
    """How many of ascending breaks (m, S) are not after times (m, T), by bisection."""
    if times.shape[1] >= _MANY_TIMES:
        pairs = zip(breaks, times, strict=True)
        return np.stack([row.searchsorted(each, side="right") for row, each in pairs])
    low = np.zeros(times.shape, dtype=np.intp)
    high = np.full(times.shape, breaks.shape[1])
    for _ in range(breaks.shape[1].bit_length()):
        middle = (low + high) // 2
        before = np.take_along_axis(breaks, np.minimum(middle, breaks.shape[1] - 1), 1) <= times
        before &= middle < high
        low, high = np.where(before, middle + 1, low), np.where(before, high, middle)
    return low


def step_coefficients(nodal: Array) -> Array:
    """Coefficients (nodes, S, n) of the powers of ``2 share - 1`` of steps (S, nodes, n)."""
    return np.asarray(np.tensordot(TO_POWERS, nodal, axes=(1, 1)))


def joined(paths: Sequence[Path]) -> Path:
    """Paths that follow each other, as one; there is at least one."""
    breaks = [paths[0].breaks, *(path.breaks[1:] for path in paths[1:])]
    nodal = np.concatenate([path.nodal for path in paths])
    return Path(np.concatenate(breaks), nodal, paths[-1].state)


# -----------------------------------------------------------------------------
# What an integrator takes and gives: trajectories of a system at many parameter points.


SIZE_TIMES = 201
"""Evenly spaced times that tell the sizes of states, and where surfaces are crossed."""
LAST_GAP = 100  # Distance from the end, in floating-point numbers, too short for a step of SciPy
EARLY_STEPS = 4  # Steps after which states that start from zero show their size
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
        return cls(relative, np.maximum(relative * sizes, LEAST))

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
    were given up for implicit ones; it is 0 if none were. ``integrator`` is "stack" or "single",
    and ``method`` the name of what made the last steps.
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


# -----------------------------------------------------------------------------
# Trajectories with spans of their own, as a stack over the share of the way.
#
# Over it all of them begin and end together, so that any integrator of stacks serves.


# Integrates a system at points over edges, such as :meth:`Integrator.run`
SeparateRun: TypeAlias = Callable[
    [System, Array, Sequence[float], Tolerances], SeparateTrajectories
]


def paths_over_shares(
    run: SeparateRun, system: System, points: Array, spans: Spans, tolerances: Tolerances
) -> list[Path]:
    """The paths of spans; see :meth:`SpanIntegrator.paths`."""

    def part(over: Spans) -> list[Path]:
        times = zip(over.starts, over.ends, strict=True)
        paths = share_paths(run, system, points, over, tolerances)
        return [path.over_times(*span) for path, span in zip(paths, times, strict=True)]

    return part_by_part(part, spans)


def part_by_part(part: Callable[[Spans], Sequence[Path]], spans: Spans) -> list[Path]:
    """The paths of spans, of which ``part`` gives one from each time between them to the next."""
    if spans.between is None:
        return [*part(spans)]
    paths_of_parts = list[Sequence[Path]]()
    starts, states = spans.starts, spans.states
    for ends in [*spans.between.T, spans.ends]:
        paths_of_parts.append(part(Spans(starts, states, ends)))
        if any(path.end < end for path, end in zip(paths_of_parts[-1], ends, strict=True)):
            break
        starts, states = ends, np.stack([path.state for path in paths_of_parts[-1]], axis=1)
    return [joined(each) for each in zip(*paths_of_parts, strict=True)]


def share_paths(
    run: SeparateRun, system: System, points: Array, spans: Spans, tolerances: Tolerances
) -> Sequence[Path]:
    """The paths of spans over the share of the way, from 0 to 1; spans may go back in time."""
    lengths = spans.ends - spans.starts
    n = len(spans.states)
    first, last = np.minimum(spans.starts, spans.ends), np.maximum(spans.starts, spans.ends)
    near = insets(first, last) * np.sign(lengths)
    moved = np.column_stack([points, spans.states.T, spans.starts, lengths, near])
    longest = tolerances.longest_step / (float(np.abs(lengths).max()) or 1.0)
    begun = _begun_with(system, lambda p: np.asarray(p)[-3 - n : -3])
    try:
        over = replace(tolerances, longest_step=longest)
        dense = run(_over_shares(begun), moved, (0.0, 1.0), over)
    except OutOfBudgetError as out:
        reached = out.reached
        if reached is not None and reached.time is not None:
            time = float((spans.starts + reached.time * lengths).min())
            reached = reached._replace(time=time)
        raise out.at(reached) from out
    return dense.paths


def _begun_with(system: System, states: OfParameters) -> System:
    """The system with states (n, m) of its parameters at the start, and without its jumps."""
    return replace(
        system.starting_at(states),
        jumps=Jumps(),
        constraints=Constraints(),
    )


def _over_shares(system: System) -> System:
    """The system over the share of the way; where each begins is told by further parameters.

    They are its state, its time, the length of the way, and how far times stay inside of it: rates
    may jump at its ends. Terms are those of the system times the length; functions of time in them
    are over times still.
    """
    cost, n = function_cost(system.rhs, system.user_functions), system.n_differential
    length_alone = *(0,) * (n + 1), 1, 0

    def split(rows: Array) -> tuple[float, Array, Array, Array, Array, Array]:
        """The share from which all are inside, and before the end; starts and lengths.

        Behind these the least and the most that is gone, and the system's parameters.
        """
        start, length, near = rows[-3:]
        least, most = np.minimum(near, length - near), np.maximum(near, length - near)
        inside = float((near / np.where(length == 0.0, 1.0, length)).max(initial=0.0))
        return inside, start, length, least, most, rows[: len(rows) - n - 3]

    last: list[
        tuple[Array, tuple[float, Array, Array, Array, Array, Array]]
    ] = []  # stages of steps are at the same points

    def at(share: float | Array, p: VectorLike) -> tuple[Array, Array, Array]:
        """Times, the parameters of the system, and lengths."""
        rows = np.asarray(p)
        if not last or last[0][0] is not rows:
            last[:] = [(rows, split(rows))]
        inside, start, length, least, most, parameters = last[0][1]
        gone = share * length
        if not (isinstance(share, float) and inside <= share <= 1.0 - inside):
            gone = np.minimum(np.maximum(gone, least), most)
        return start + gone, parameters, length

    def rhs(share: float | Array, u: VectorLike, p: VectorLike) -> Array:
        times, parameters, length = at(share, p)
        charge(cost(length.size))
        return np.asarray(length * system.rhs(times, u, parameters))

    def jacobian(share: float | Array, u: VectorLike, p: VectorLike) -> Array:
        times, parameters, length = at(share, p)
        return np.asarray(length * system.jacobian(times, u, parameters))

    def surfaces(share: float | Array, u: VectorLike, p: VectorLike) -> Array:
        times, parameters, _ = at(share, p)
        return system.features.state_surfaces(times, u, parameters)

    features = replace(system.features, state_surfaces=surfaces)

    def parameter_factors(j: int, p: Array) -> Array:
        if j < len(system.parameters):
            return system.parameter_factors(j, p)
        return np.stack([np.ones_like(p), p])

    return replace(
        system.with_rates(rhs, jacobian),
        features=features,
        parameter_factors=parameter_factors,
        terms=tuple(
            (coefficient, state, (*rows, *length_alone), states)
            for coefficient, state, rows, states in system.terms
        ),
    )
