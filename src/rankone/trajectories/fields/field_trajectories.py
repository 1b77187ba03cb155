"""Trajectories of fields, one by one, compressed into modes as they come.

Steps are those of SciPy's backward differences (Shampine & Reichelt, SIAM J. Sci. Comput. 18
(1997), 1) with the sparse Jacobian. Nobody keeps states times steps: some steps at a time, the part
that the modes so far do not have becomes further modes, as in an incremental singular value
decomposition (Brand, Linear Algebra Appl. 415 (2006), 20).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.integrate
import scipy.sparse as ss

from rankone.support.arrays import EPSILON, TINY, Array
from rankone.support.budget import Counted, LimitsElsewhere, charge
from rankone.support.tasks import Pool, Shared
from rankone.trajectories.fields.field_factors import Factorisation, factorisation_of
from rankone.trajectories.fields.field_system import FieldSystem

_AT_ONCE = 32  # Steps that are compressed together
_COARSE = 1e-3  # Relative tolerance of the trajectory that tells the sizes of the fields
_GROWTH = 1e3  # Of the largest value, at which it leaves all bounds
_LINEAR_ENTRY = 2.0  # Operations for each entry of a matrix


class EndsEarlyError(Exception):
    """A trajectory of fields does not reach the end: ``time`` is as far as it came.

    It ``grows`` beyond all bounds there, or its steps shrink without such a reason.
    """

    def __init__(self, time: float, point: Array, grows: bool) -> None:
        super().__init__(time, point, grows)
        self.time, self.point, self.grows = time, point, grows


@dataclass(frozen=True, eq=False)
class Compressed:
    """Vectors (n, T) at the times of a trajectory: orthonormal ``modes`` (n, k) times ``numbers``.

    What the modes do not have is below the tolerance in every entry, at every time.
    """

    modes: Array
    numbers: Array

    def at(self, columns: slice) -> Array:
        """The vectors at some of the times."""
        return np.asarray(self.modes @ self.numbers[:, columns])


@dataclass(frozen=True, eq=False)
class FieldTrajectory:
    """A trajectory at a point (d,): its times (T,), those of the steps.

    ``states`` has for each unknown its values, ``pointwise`` for each pointwise term those of its
    function, and ``largest`` the largest absolute value of each unknown.
    """

    point: Array
    times: Array
    states: tuple[Compressed, ...]
    pointwise: tuple[Compressed, ...]
    largest: Array


def field_sizes(system: FieldSystem, point: Array) -> Array:
    """About how large each unknown becomes at a point: (unknowns,); one for what stays zero."""
    start = system.initial(point)
    sizes = _largest(system, start)
    reached = sizes.copy()
    for _ in range(2):  # sizes tell the tolerances, and these the sizes
        known_sizes = np.where(reached > 0.0, reached, reached.max(initial=0.0) or 1.0)
        absolute = _COARSE * _by_entry(system, known_sizes)
        for _, state in _steps(system, point, _COARSE, absolute):
            reached = np.maximum(reached, _largest(system, state))
        if (reached <= 2.0 * known_sizes).all() and (reached >= 0.1 * known_sizes).all():
            break
    return np.where(reached > 0.0, reached, 1.0)


def field_trajectory(
    system: FieldSystem,
    point: Array,
    sizes: Array,
    tolerance: float,
    kept: float,
    times: Array | None = None,
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

    Raises
    ------
    EndsEarlyError
        Where steps shrink without end or states are not finite.
    """
    scale = _by_entry(system, sizes)
    absolute = tolerance * scale
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

    for time, state in _steps(system, point, tolerance, absolute, times):
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
    )


@dataclass(frozen=True, eq=False)
class FieldIntegration:
    """How all trajectories of a solve are integrated; arguments are those of a trajectory."""

    system: FieldSystem
    sizes: Array
    tolerance: float
    kept: float
    pool: Pool | None = None

    def trajectories(self, points: Array) -> list[FieldTrajectory]:
        """Trajectories at points (m, d), each on its own; the same to the bit on any workers.

        Raises
        ------
        EndsEarlyError
            For the first of the points whose trajectory does not reach the end.
        """
        how, limits = (self.sizes, self.tolerance, self.kept), LimitsElsewhere.left()
        shared = Shared("a system of fields", self.system, self.pool)
        answers = shared.map(_counted, [(point, how, limits) for point in points])
        return [answer.settled() for answer in answers]


def _counted(
    system: FieldSystem, point: Array, how: tuple[Array, float, float], limits: LimitsElsewhere
) -> Counted[FieldTrajectory]:
    return Counted.of(limits, (EndsEarlyError,), lambda: field_trajectory(system, point, *how))


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


def _steps(
    system: FieldSystem,
    point: Array,
    tolerance: float,
    absolute: Array,
    times: Array | None = None,
) -> Iterator[tuple[float, Array]]:
    """The start and the ends of all steps of a trajectory, or states at ascending times."""
    start = system.horizon[0]
    state = system.initial(point)
    if times is None:
        yield start, state
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of rates that are not finite: told below
        solver = _backward_differences(system, point, state, tolerance, absolute)
        passed = [(start, float(np.abs(state).max()))]
        while solver.status == "running":
            before = solver.t
            solver.step()
            passed.append((float(solver.t), float(np.abs(solver.y).max())))
            if solver.status == "failed" or not np.isfinite(solver.y).all():
                raise EndsEarlyError(float(solver.t), point, _grows(passed))
            charge(_LINEAR_ENTRY * 4.0 * absolute.size)
            if times is None:
                yield float(solver.t), solver.y.copy()
                continue
            within = times[(times <= solver.t) & ((times > before) | (before == start))]
            if within.size:
                yield from zip(within.tolist(), solver.dense_output()(within).T, strict=True)


def _grows(passed: Sequence[tuple[float, float]]) -> bool:
    """Whether the largest value is far above that of the first half of the time, at the end."""
    half = 0.5 * (passed[0][0] + passed[-1][0])
    usual = max(size for time, size in passed if time <= half)
    return not passed[-1][1] <= _GROWTH * max(usual, TINY)


def _backward_differences(
    system: FieldSystem, point: Array, state: Array, tolerance: float, absolute: Array
) -> scipy.integrate.BDF:
    """SciPy's integrator, with factors of a fixed order and a mass matrix.

    Of u' = f it solves (1 - h J) d = h f - b, with numbers h and b of its own; of M u' = f it is to
    solve (M - h J) d = M (h f' - b), where f' are the rates, f over M.
    """
    start, end = system.horizon
    factors = factorisation_of(system)
    mass = None if system.mass is None else ss.csc_array(system.mass)
    inverse = None if mass is None else Factorisation().of(mass)

    own = system.at(point)

    def rates(t: float, u: Array) -> Array:
        force = own.force(t, u)
        return force if inverse is None else inverse.solve(force)

    solver = scipy.integrate.BDF(
        rates,
        start,
        state,
        end,
        rtol=max(tolerance, 100.0 * EPSILON),
        atol=absolute,
        jac=own.jacobian,
        max_step=system.longest_step,
    )
    solver.lu = factors.of
    if mass is not None:
        solver.I = mass
        solver.solve_lu = lambda lu, right: lu.solve(mass @ right)
    else:
        solver.solve_lu = lambda lu, right: lu.solve(right)
    return solver
