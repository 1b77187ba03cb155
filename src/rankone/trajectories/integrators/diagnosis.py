"""What trajectories show: how fast changes grow, why they end, where they go.

Of many states one eigenvalue is computed, at an end of the spectrum and to a few per cent, by
Arnoldi's method (ARPACK; Lehoucq, Sorensen & Yang, 1998). Where that does not converge, all of them
are computed, or of very many states the bound of Gershgorin's circles stands in, which is never too
small. Along chains and in diffusion that bound says already that nothing grows.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import ArpackError, eigs

from rankone.support.arrays import COINCIDENT, EPSILON, RESOLVED, ROUNDING, Array
from rankone.support.budget import charge
from rankone.support.costs import eigenvalues, in_pieces
from rankone.trajectories.integrators.integrator import JACOBIAN_ENTRY, finite_blocks, jacobians
from rankone.trajectories.stacks.newton import entries_at, sparse_pattern
from rankone.trajectories.system.features import FALLING, RISING
from rankone.trajectories.system.system import AHEAD, PatternJacobian, System

Matrix: TypeAlias = Array | scipy.sparse.csr_array


@dataclass(frozen=True)
class _Eigenvalues:
    """How eigenvalues of large matrices are computed."""

    tolerance: float
    most_restarts: int
    restart_cost: float
    most_dense: int
    most_examined: int


_EIGENVALUES = _Eigenvalues(
    tolerance=0.03,  # Relative error of an eigenvalue of a sparse matrix
    most_restarts=30,  # Of Arnoldi's method
    restart_cost=20.0,  # Operations of a restart for each entry and for each state
    most_dense=600,  # States up to which all eigenvalues are computed where one does not converge
    most_examined=3,  # Sparse matrices of a stack whose fastest decay is computed
)


def growth_rate(matrix: Matrix, harmless: float = -math.inf) -> float:
    """The fastest rate at which small states grow, by the Jacobian (n, n).

    Or a bound of it, by Gershgorin's circles, where that is no more than a ``harmless`` rate.
    """
    if isinstance(matrix, np.ndarray):
        return float(np.linalg.eigvals(matrix).real.max())
    bound = min(_circles(matrix), _circles(matrix.T))
    if bound <= harmless:
        return bound
    charge(_EIGENVALUES.most_restarts * _EIGENVALUES.restart_cost * (matrix.nnz + matrix.shape[0]))
    try:
        start = np.random.default_rng(20149).random(matrix.shape[0])
        options = {
            "which": "LR",
            "v0": start,
            "tol": _EIGENVALUES.tolerance,
            "maxiter": _EIGENVALUES.most_restarts,
        }
        fastest = eigs(matrix, k=1, return_eigenvectors=False, **options)
        return float(fastest.real.max())
    except ArpackError:
        if (
            matrix.shape[0] <= _EIGENVALUES.most_dense
        ):  # of what swings, the bound says that it grows
            charge(eigenvalues(matrix.shape[0]))
            return float(np.linalg.eigvals(matrix.toarray()).real.max())
        return bound


def _circles(matrix: scipy.sparse.csr_array) -> float:
    """A rate that no eigenvalue exceeds, by the rows of a matrix."""
    diagonal = matrix.diagonal()
    return float((diagonal + abs(matrix).sum(axis=1) - np.abs(diagonal)).max())


def logarithmic_norm(matrix: Matrix, sizes: Array) -> float:
    """A bound of how fast an error grows, by the Jacobian (n, n), in the maximum norm.

    Each state is relative to its size, (n,). Eigenvalues say less where they are far from normal.
    """
    diagonal = matrix.diagonal()
    others = abs(matrix) @ sizes / sizes - np.abs(diagonal)
    return float((diagonal + others).max())


def first_jacobian(system: System, points: Array, time: float, states: Array) -> Matrix | None:
    """The Jacobian of the first trajectory, states (n, m); None where it is not finite."""
    pattern, n = sparse_pattern(system), system.n_differential
    if pattern is None:
        block = jacobians(system, points, time, states)[0]
        return block if np.isfinite(block).all() else None
    entries = entries_at(system, pattern, points[:1], time, states[:, :1])[:, 0]
    return scipy.sparse.csr_array((entries, (pattern.rows, pattern.columns)), shape=(n, n))


def jacobian_blocks(
    system: System, points: Array, time: float, states: Array, rows: NDArray[np.intp]
) -> Array:
    """The Jacobians of some states (r,) in themselves, of a stack: (m, r, r)."""
    pattern = sparse_pattern(system)
    if pattern is None:
        return jacobians(system, points, time, states)[:, rows[:, None], rows]
    own, places, entries = _own_entries(system, pattern, points, time, states, rows)
    blocks = np.zeros((len(points), rows.size, rows.size))
    blocks[:, places[pattern.rows[own]], places[pattern.columns[own]]] = entries.T
    return blocks


def growth_bounds(
    system: System, points: Array, time: float, states: Array, rows: NDArray[np.intp]
) -> Array:
    """For each trajectory of a stack a rate that no eigenvalue of such a block exceeds: (m,).

    By the circles of its rows and of its columns; infinite for few states, whose eigenvalues cost
    as little.
    """
    pattern = sparse_pattern(system)
    if pattern is None:
        return np.full(len(points), np.inf)
    own, places, entries = _own_entries(system, pattern, points, time, states, rows)
    lines, columns = places[pattern.rows[own]], places[pattern.columns[own]]
    radii = np.where((lines == columns)[:, None], entries, np.abs(entries))
    shape, numbers = (rows.size, own.size), np.arange(own.size)
    bounds = [
        (scipy.sparse.csr_array((np.ones(own.size), (ends, numbers)), shape) @ radii).max(axis=0)
        for ends in (lines, columns)
    ]
    return np.asarray(np.minimum(*bounds))


def _own_entries(
    system: System,
    pattern: PatternJacobian,
    points: Array,
    time: float,
    states: Array,
    rows: NDArray[np.intp],
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Numbers of the entries that some states have in themselves, their places, and values."""
    places = np.full(system.n_differential, -1)
    places[rows] = np.arange(rows.size)
    own = np.flatnonzero((places[pattern.rows] >= 0) & (places[pattern.columns] >= 0))
    return own, places, entries_at(system, pattern, points, time, states)[own]


def decays_faster(system: System, points: Array, time: float, states: Array, rate: float) -> bool:
    """Whether some Jacobian of a stack has an eigenvalue with a real part below ``-rate``."""
    pattern = sparse_pattern(system)
    if pattern is None:
        blocks = jacobians(system, points, time, states)
        return bool(np.isfinite(blocks).all()) and _dense_decays_faster(blocks, rate)
    n, entries = system.n_differential, entries_at(system, pattern, points, time, states)
    stack = scipy.sparse.csr_array(
        (np.ones(pattern.rows.size), (pattern.rows, np.arange(pattern.rows.size))),
        shape=(n, pattern.rows.size),
    )
    bounds = (stack @ np.abs(entries)).max(axis=0)  # no eigenvalue is larger
    largest = np.argsort(-bounds, kind="stable")[: _EIGENVALUES.most_examined]
    for k in largest[bounds[largest] > rate].tolist():
        own = -entries[:, k], (pattern.rows, pattern.columns)
        if growth_rate(scipy.sparse.csr_array(own, shape=(n, n)), rate) > rate:
            return True
    return False


def _dense_decays_faster(blocks: Array, rate: float) -> bool:
    """The same for matrices (m, n, n)."""
    cost = eigenvalues(blocks.shape[-1])
    for matrices in in_pieces(blocks, cost):
        charge(JACOBIAN_ENTRY * matrices.size)
        bounds = np.abs(matrices).sum(axis=2).max(axis=1)  # no eigenvalue is larger
        suspicious = matrices[bounds > rate]
        charge(cost * len(suspicious))
        if -np.linalg.eigvals(suspicious).real.min(initial=0.0) > rate:
            return True
    return False


# -----------------------------------------------------------------------------
# What trajectories show: why they end, and which states are numerically zero.
#
# A state is numerically zero if rounding errors of its rate are larger than the state: for example
# the difference of two numbers that stay equal except for rounding, and all that it drives. An
# integration that resolves such a state follows rounding errors, with steps that shrink without
# end.


@dataclass(frozen=True)
class _Signs:
    """What tells why trajectories end, and which states are zero."""

    little_change: float
    runaway_growth: float
    several_roundings: float
    tiny_state: float
    resolved: float
    draws: int


_SIGNS = _Signs(
    little_change=0.3,  # Of a rate over such a step, over its size
    runaway_growth=1e6,  # Growth over a horizon, at the last rate, from which a state blows up
    several_roundings=16.0,  # Relative error of states after many steps, in last places
    # Size of a state, over the largest one, up to which it may be numerically zero
    tiny_state=1e-6,
    resolved=RESOLVED,  # Part of its size below which a change of a state does not count
    draws=4,  # Random rounding errors at each time; the largest effect counts
)
MOST_GROWTH = 5.0  # Growth over the horizon, as a power of e, from which small states are amplified


def switching_state(
    system: System, time: float, states: Array, points: Array, horizon: float
) -> tuple[int, int] | None:
    """The state whose rate jumps most where a trajectory is pushed back, and the trajectory.

    A trajectory chatters if a short step takes it across a state surface, and a step with the rates
    there takes it back. The states are (n, m), the points (m, d).
    """
    if not system.features.n_state_surfaces:
        return None
    surfaces = system.features.state_surfaces
    parameters = np.ascontiguousarray(points.T)
    with np.errstate(all="ignore"):
        rates = system.rhs(time, states, parameters)
        before = surfaces(time, states, parameters)
        for step in AHEAD[1:]:
            ahead = states + step * horizon * rates
            across = surfaces(time, ahead, parameters)
            back = system.rhs(time, ahead, parameters)
            after = surfaces(time, ahead + step * horizon * back, parameters)
            crossed = (before * across <= 0.0) & (across != before)
            returns = (crossed & ((after - across) * (across - before) < 0.0)).any(axis=0)
            if returns.any():
                column = int(np.argmax(returns))
                jump = np.abs(back - rates)[:, column]
                return int(np.argmax(jump)), column
    return None


def first_to_end(system: System, time: float, state: Array, points: Array, floor: Array) -> int:
    """The trajectory of a stack, state (n, m) at points (m, d), that ends first.

    The one whose rates cease to be finite first, or else the one that changes fastest relative to
    its size; states below ``floor`` (n, 1) count as that size.
    """
    with np.errstate(all="ignore"):
        rates = system.rhs(time, state, points.T)
        for change in AHEAD:
            later = system.rhs(time, state + change * np.abs(state) * np.sign(rates), points.T)
            lost = ~np.isfinite(later).all(axis=0)
            if lost.any():
                return int(np.argmax(lost))
        speeds = np.abs(rates) / np.maximum(np.abs(state), floor)
    return int(np.argmax(np.nan_to_num(speeds, nan=np.inf).max(axis=0)))


def runs_away(system: System, time: float, state: Array, point: Array, horizon: float) -> bool:
    """Whether a state grows at an enormous rate without a pole: shortly after, it is as large."""
    with np.errstate(all="ignore"):
        now, later = (
            system.rhs(time, factor * state[:, None], point[:, None])
            for factor in (1.0, 1.0 + AHEAD[-1])
        )
        fast = now[:, 0] * np.sign(state) * horizon > _SIGNS.runaway_growth * np.abs(state)
        return bool((fast & (later / now > 0.5)[:, 0] & (later / now < 2.0)[:, 0]).any())


def is_regular(
    system: System, time: float, state: Array, size: Array, point: Array, horizon: float
) -> bool:
    """Whether rates ahead are finite, and change little within a tiny way but where they switch.

    States (n,) are of some ``size`` (n, 1).
    """
    surfaces, parameters, states = system.features.state_surfaces, point[:, None], state[:, None]
    with np.errstate(all="ignore"):
        rates = system.rhs(time, states, parameters)
        for change in AHEAD:
            near = states + change * size * np.sign(rates)
            if not np.isfinite(system.rhs(time, near, parameters)).all():
                return False
        before = surfaces(time, states, parameters)
        for step in (8 * EPSILON, ROUNDING, COINCIDENT):
            later, ahead = time + step * horizon, states + step * horizon * rates
            there = system.rhs(later, ahead, parameters)
            across = surfaces(later, ahead, parameters)
            crossed = ((before * across <= 0.0) & (across != before)).any()
            difference = np.abs(there - rates)
            changed = difference > _SIGNS.little_change * np.maximum(np.abs(rates), np.abs(there))
            changed &= difference * horizon > np.abs(ahead)
            if not np.isfinite(there).all() or (changed.any() and not crossed):
                return False
    return True


@dataclass(frozen=True)
class Rounding:
    """Rounding errors of the states of a stack, (n, 1), and which are numerically ``zero``.

    Below the ``floor`` of a tiny state an integration follows rounding errors; 0 for all others,
    and where the state is always large enough beside its errors.
    """

    floor: Array
    zero: NDArray[np.bool_]


def rounding_errors(
    system: System,
    points: Array,
    horizon: float,
    samples: Sequence[tuple[float, Array]],
    largest: Array,
    rtol: float,
) -> Rounding:
    """What rounding errors make of the states that are tiny beside the others.

    The error of a state is the change of its rate under relative errors of rounding in all states,
    over the time for which the state remembers it. A state that never exceeds several times that is
    numerically zero. Its errors are errors of the states that it drives, which may be so too. One
    that changes another state by more than a part ``rtol`` of it, at the time, is not.

    The samples are times with the states (n, m) of all trajectories, at points (m, d); ``largest``
    (n, 1) is the largest absolute value of each state.
    """
    tiny = (largest <= _SIGNS.tiny_state * largest.max(initial=0.0)) & (largest > 0.0)
    zero, errors = np.zeros_like(tiny), np.zeros_like(largest)
    if not tiny.any():
        return Rounding(errors, zero)
    probes = [_Probe(system, points, horizon, *sample, largest, rtol) for sample in samples]
    for _ in range(len(largest)):  # errors spread from state to state
        by_probe = [probe.errors(np.where(zero, errors, 0.0)) for probe in probes]
        errors = np.max(by_probe, axis=(0, 2))[:, None]
        below = tiny & (largest <= errors)
        if (below == zero).all():
            break
        zero = below
    while zero.any():  # those that matter to what is not zero, then those that matter to them
        matters = np.any([probe.matters(np.where(zero, errors, 0.0)) for probe in probes], axis=0)
        if not (zero & matters).any():
            break
        zero &= ~matters
    steady = max(probe.growth for probe in probes) <= MOST_GROWTH
    followed = [probe.followed(errors) for probe, errors in zip(probes, by_probe, strict=True)]
    noise = np.max(followed, axis=(0, 2))[:, None]
    floor = np.where(tiny & steady, noise / _SIGNS.several_roundings, 0.0)
    return Rounding(np.where(zero, errors, floor), zero)


class _Probe:
    """The rates and their Jacobians at a time, at states (n, m)."""

    def __init__(
        self,
        system: System,
        points: Array,
        horizon: float,
        time: float,
        states: Array,
        largest: Array,
        rtol: float,
    ) -> None:
        self.system, self.time, self.states, self.rtol = system, time, states, rtol
        self.parameters = np.ascontiguousarray(points.T)
        with np.errstate(all="ignore"):
            self.rates = system.rhs(time, states, self.parameters)
        first = first_jacobian(system, points, time, states)
        self.growth = 0.0 if first is None else growth_rate(first, MOST_GROWTH / horizon) * horizon
        self.rows, self.columns, sizes = _sizes_of_entries(system, points, time, states)
        decay = np.zeros_like(states)
        own = self.rows == self.columns
        decay[self.rows[own]] = sizes[own]
        self.memory = 1.0 / (decay + 1.0 / horizon)
        self.couplings = np.where(own[:, None], 0.0, sizes)
        self.tolerated = rtol * (np.abs(states) + _SIGNS.resolved * largest)

    def errors(self, zero_errors: Array) -> Array:
        """What rounding errors, and errors (n, 1) of some states, make of each state, (n, m).

        A state that does not change has no rounding errors.
        """
        rounded = _SIGNS.several_roundings * EPSILON * np.abs(self.states)
        sizes = np.maximum(rounded * (self.rates != 0.0), zero_errors)
        generator = np.random.default_rng(20143)
        worst = np.zeros_like(self.states)
        with np.errstate(all="ignore"):
            for _ in range(_SIGNS.draws):
                states = self.states + sizes * generator.uniform(-1.0, 1.0, sizes.shape)
                changed = self.system.rhs(self.time, states, self.parameters)
                worst = np.fmax(worst, np.abs(changed - self.rates))
        return np.asarray(worst * self.memory)

    def followed(self, errors: Array) -> Array:
        """Those of the errors (n, m) that an integration follows: steps do not resolve others."""
        return np.where(errors > self.rtol * np.abs(self.states), errors, 0.0)

    def matters(self, zero_errors: Array) -> Array:
        """Whether errors (n, 1) of some states change one of the others, (n, 1)."""
        driven = self.couplings * zero_errors[self.columns] * self.memory[self.rows]
        counts = (driven > self.tolerated[self.rows]) & (zero_errors[self.rows] == 0.0)
        matters = np.zeros(len(zero_errors), dtype=bool)
        matters[self.columns[counts.any(axis=1)]] = True
        return matters[:, None]


def _sizes_of_entries(
    system: System, points: Array, time: float, states: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Rows and columns (k,) of the Jacobians at states (n, m), and absolute values (k, m)."""
    pattern, n = sparse_pattern(system), len(states)
    with np.errstate(all="ignore"):
        if pattern is not None:
            entries = entries_at(system, pattern, points, time, states)
            return pattern.rows, pattern.columns, np.abs(entries)
        blocks = np.abs(np.nan_to_num(jacobians(system, points, time, states)))
    return *np.divmod(np.arange(n * n), n), blocks.reshape(len(points), -1).T


# -----------------------------------------------------------------------------
# Coarse trajectories: what they reach, before the rates are known to be smooth.
#
# Their steps are even and few, so that they end whatever the rates do: these may jump, and push
# trajectories back to where they jump. Steps are those of ROS2, a linearly implicit method of
# second order that stiff rates do not drive away (Verwer, Spee, Blom & Hundsdorfer, SIAM J. Sci.
# Comput. 20, 1999, 1456-1480): with A = I - γ h J and γ = 1 - 1/√2,
#
#     A k₁ = f(t, u),   A k₂ = f(t + h, u + h k₁) - 2 k₁,   u + h (3 k₁ + k₂)/2.


_GAMMA = 1.0 - math.sqrt(0.5)


def coarse_states(system: System, points: Array, count: int) -> tuple[Array, Array]:
    """Times (count + 1,), and the states there of trajectories at points (m, d): (n, m, count + 1).

    Events reset them at the end of the step in which they come, once in each. States that are not
    finite are NaN, and so are all behind them.
    """
    times = np.linspace(*system.horizon, count + 1)
    jumps = dict(zip(system.jumps.times, system.jumps.kinds, strict=True))
    p = np.ascontiguousarray(points.T)
    states = [np.broadcast_to(system.initial(p), (system.n_differential, len(points)))]
    identity, step = np.eye(system.n_differential), times[1] - times[0]
    with np.errstate(all="ignore"):
        for begin, end in itertools.pairwise(times):
            u = states[-1]
            for time in (time for time in jumps if begin <= time < end):
                u = np.broadcast_to(system.jumps.jumped(jumps[time], u, p), u.shape)
            jacobian = finite_blocks(jacobians(system, points, begin, u))
            inverse = np.linalg.inv(identity - _GAMMA * step * jacobian)
            first = _applied(inverse, np.broadcast_to(system.rhs(begin, u, p), u.shape))
            rates = np.broadcast_to(system.rhs(end, u + step * first, p), u.shape)
            second = _applied(inverse, rates - 2.0 * first)
            further = _reset(system, (begin, end), u, u + 0.5 * step * (3.0 * first + second), p)
            states.append(np.where(np.isfinite(further), further, np.nan))
    return times, np.stack(states, axis=2)


def _reset(system: System, span: tuple[float, float], u: Array, further: Array, p: Array) -> Array:
    """States (n, m) at the end of a step, after the events in it."""
    begin, end = (np.full(u.shape[1], time) for time in span)
    for event in system.events:
        if event.then is None:
            continue
        before, after = event.when(begin, u, p), event.when(end, further, p)
        rises, falls = (before < 0.0) & (after >= 0.0), (before > 0.0) & (after <= 0.0)
        comes = {RISING: rises, FALLING: falls}.get(event.direction, rises | falls)
        further = np.where(comes, event.then(end, further, p), further)
    return further


def _applied(matrices: Array, vectors: Array) -> Array:
    """Products of matrices (m, n, n) with vectors (n, m): shape (n, m)."""
    return np.asarray((matrices @ vectors.T[:, :, None])[:, :, 0].T)
