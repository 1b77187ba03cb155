"""Trajectories of fields, one by one, compressed into modes as they come.

Nobody keeps states times steps: some steps at a time, the part that the modes so far do not have
becomes further modes, as in an incremental singular value decomposition (Brand, Linear Algebra
Appl. 415 (2006), 20).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import COARSE, LEAST, TINY, Array
from rankone.support.budget import Counted, LimitsElsewhere, charge
from rankone.support.tasks import Pool, Shared
from rankone.trajectories.fields.field_crossings import Occurred
from rankone.trajectories.fields.field_steps import EndsEarlyError, FieldSteps, StepTolerances
from rankone.trajectories.fields.field_system import FieldSystem

_AT_ONCE = 32  # Steps that are compressed together
# Relative tolerances of the trajectory that tells the sizes of the fields: the first one that tells
# its events apart
_COARSE = (1e-3, 1e-5, 1e-7)
_FINER, _FINEST = (1.0, 0.1, 0.01), 0.001  # On tolerances where events are not told apart
_LINEAR_ENTRY = 2.0  # Operations for each entry of a matrix


@dataclass(frozen=True, eq=False)
class Compressed:
    """Vectors (n, T) at the times of a trajectory: orthonormal ``modes`` (n, k) times ``numbers``.

    What the modes do not have is below the tolerance in every entry, at every time.
    """

    modes: Array
    numbers: Array

    def at(self, columns: slice | NDArray[np.bool_]) -> Array:
        """The vectors at some of the times."""
        return np.asarray(self.modes @ self.numbers[:, columns])


@dataclass(frozen=True, eq=False)
class FieldTrajectory:
    """A trajectory at a point (d,): its times (T,), those of the steps.

    ``states`` has for each unknown its values, ``pointwise`` for each pointwise term those of its
    function, and ``largest`` the largest absolute value of each unknown. Where fields are reset
    there are two columns at one time, before and after. ``occurred`` are its events, and ``end`` is
    where it ends: at the horizon, or at a terminal event.
    """

    point: Array
    times: Array
    states: tuple[Compressed, ...]
    pointwise: tuple[Compressed, ...]
    largest: Array
    occurred: tuple[Occurred, ...] = ()
    end: float = math.inf

    def jumps(self, system: FieldSystem) -> Array:
        """The times at which fields jump, or end."""
        times = [each.time for each in self.occurred if system.events[each.event].jumps]
        return np.array(times)


def field_sizes(system: FieldSystem, points: Array) -> Array:
    """About how large each unknown becomes at the first of points (m, d): (unknowns,).

    Or at others of them, where it is next to nothing there; one for what stays zero.
    """
    sizes = np.array([_sizes_at(system, point) for point in points])
    largest = sizes.max(axis=0)
    chosen = np.where(sizes[0] > COARSE * largest, sizes[0], largest)
    return np.where(chosen > LEAST, chosen, 1.0)


def _sizes_at(system: FieldSystem, point: Array) -> Array:
    """How large each unknown becomes at a point (d,)."""
    for tolerance in _COARSE[:-1]:
        try:
            return _sizes_by(system, point, tolerance)
        except EndsEarlyError as end:
            if not end.accumulate:
                raise
    return _sizes_by(system, point, _COARSE[-1])


def _sizes_by(system: FieldSystem, point: Array, tolerance: float) -> Array:
    """The same, by trajectories of a tolerance."""
    start = system.initial(point)
    sizes = _largest(system, start)
    reached = sizes.copy()
    for _ in range(2):  # sizes tell the tolerances, and these the sizes
        known_sizes = np.where(reached > 0.0, reached, reached.max(initial=0.0) or 1.0)
        absolute = tolerance * _by_entry(system, known_sizes)
        for _, state in FieldSteps(system, point, StepTolerances(tolerance, absolute)):
            reached = np.maximum(reached, _largest(system, state))
        if (reached <= 2.0 * known_sizes).all() and (reached >= 0.1 * known_sizes).all():
            break
    return reached


def field_trajectory(
    system: FieldSystem,
    point: Array,
    sizes: Array,
    tolerance: float,
    kept: float,
    times: Array | None = None,
    beside: float = 0.0,
) -> FieldTrajectory:
    """The trajectory at a point (d,).

    Parameters
    ----------
    sizes : ndarray (unknowns,)
        Of the unknowns: tolerances are relative to them.
    tolerance : float
        Of a step.
    kept : float
        What modes may leave out of any entry, relative to the sizes; of a function relative to its
        own largest value so far.
    times : ndarray (T,), optional
        Ascending times to read the trajectory at, in place of those of its steps.
    beside : float
        Distance from events that reset fields at which states are kept, to each side.

    Raises
    ------
    EndsEarlyError
        Where steps shrink without end, states are not finite, or events accumulate.
    """
    scale = _by_entry(system, sizes)
    steps = FieldSteps(system, point, StepTolerances(tolerance, tolerance * scale), times, beside)
    passed: list[float] = []
    columns: list[Array] = []
    states = [Compression(kept * size) for size in sizes]
    pointwise = [Compression(kept, relative=True) for _ in system.pointwise]
    largest = np.zeros(len(sizes))

    def compress() -> None:
        block = np.stack(columns, axis=1)
        np.maximum(largest, _largest(system, block), out=largest)
        for unknown, compression in zip(system.unknowns, states, strict=True):
            compression.add(block[unknown.rows])
        at = np.array(passed[-len(columns) :])
        for term, compression in zip(system.pointwise, pointwise, strict=True):
            compression.add(system.values(term, at, block, point[:, None]))
        columns.clear()

    for time, state in steps:
        passed.append(time)
        columns.append(state)
        if len(columns) == _AT_ONCE:
            compress()
    if columns:
        compress()
    return FieldTrajectory(
        point,
        np.array(passed),
        tuple(compression.result() for compression in states),
        tuple(compression.result() for compression in pointwise),
        largest,
        tuple(steps.occurred),
        steps.occurred[-1].time if steps.ends else system.horizon[1],
    )


@dataclass(frozen=True, eq=False)
class FieldIntegration:
    """How all trajectories of a solve are integrated; arguments are those of a trajectory."""

    system: FieldSystem
    sizes: Array
    tolerance: float
    kept: float
    pool: Pool | None = None
    beside: float = 0.0

    def trajectories(self, points: Array) -> list[FieldTrajectory]:
        """Trajectories at points (m, d), each on its own; the same to the bit on any workers.

        Raises
        ------
        EndsEarlyError
            For the first of the points whose trajectory does not reach the end.
        """
        how = (self.sizes, self.tolerance, self.kept, None, self.beside)
        limits = LimitsElsewhere.left()
        shared = Shared("a system of fields", self.system, self.pool)
        answers = shared.map(_counted, [(point, how, limits) for point in points])
        return [answer.settled() for answer in answers]


def _counted(
    system: FieldSystem,
    point: Array,
    how: tuple[Array, float, float, None, float],
    limits: LimitsElsewhere,
) -> Counted[FieldTrajectory]:
    return Counted.of(limits, (EndsEarlyError,), lambda: _told_apart(system, point, *how))


def _told_apart(
    system: FieldSystem,
    point: Array,
    sizes: Array,
    tolerance: float,
    kept: float,
    times: None,
    beside: float,
) -> FieldTrajectory:
    """A trajectory, of a finer tolerance where that tells its events apart."""
    for factor in _FINER:
        try:
            return field_trajectory(system, point, sizes, factor * tolerance, kept, times, beside)
        except EndsEarlyError as end:
            if not end.accumulate:
                raise
    return field_trajectory(system, point, sizes, _FINEST * tolerance, kept, times, beside)


def _largest(system: FieldSystem, states: Array) -> Array:
    """The largest absolute value of each unknown in states (N, ...)."""
    return np.array([np.abs(states[unknown.rows]).max() for unknown in system.unknowns])


def _by_entry(system: FieldSystem, sizes: Array) -> Array:
    """Numbers of unknowns as numbers of their entries (N,)."""
    return np.repeat(sizes, [unknown.size for unknown in system.unknowns])


class Compression:
    """Vectors that come some at a time, as orthonormal modes times numbers."""

    def __init__(self, tolerance: float, *, relative: bool = False) -> None:
        self._tolerance, self._relative = tolerance, relative
        self._modes: Array | None = None
        self._numbers: list[Array] = []
        self.largest = 0.0

    def add(self, block: Array) -> None:
        """Take further vectors (n, m)."""
        self.largest = max(self.largest, float(np.abs(block).max(initial=0.0)))
        left_out = self._tolerance * (max(self.largest, TINY) if self._relative else 1.0)
        modes = np.zeros((len(block), 0)) if self._modes is None else self._modes
        numbers = modes.T @ block
        rest = block - modes @ numbers
        again = modes.T @ rest  # rounding of the first projection
        numbers, rest = numbers + again, rest - modes @ again
        if np.abs(rest).max(initial=0.0) > left_out:
            directions, values, columns = np.linalg.svd(rest, full_matrices=False)
            further = directions[:, : least_count(directions * values, columns, left_out)]
            numbers = np.concatenate([numbers, further.T @ rest])
            modes = np.concatenate([modes, further], axis=1)
        self._modes = modes
        self._numbers.append(numbers)
        charge(_LINEAR_ENTRY * block.size * (modes.shape[1] + block.shape[1]))

    def result(self) -> Compressed:
        """All vectors so far."""
        assert self._modes is not None
        k = self._modes.shape[1]
        padded = [np.pad(numbers, ((0, k - len(numbers)), (0, 0))) for numbers in self._numbers]
        return Compressed(self._modes, np.concatenate(padded, axis=1))


def least_count(directions: Array, columns: Array, left_out: float) -> int:
    """How many of the directions (n, k) it takes that no entry of the product misses more."""
    fewest, most = 0, directions.shape[1]
    while fewest < most:
        count = (fewest + most) // 2
        missed = np.abs(directions[:, count:] @ columns[count:]).max(initial=0.0)
        fewest, most = (fewest, count) if missed <= left_out else (count + 1, most)
    return fewest
