"""Minima of -2 log L in a unit cube, for many starts at once.

The method of Levenberg and Marquardt, with steps by the singular values of the Jacobian: parameters
do not move along directions that the data do not see (Nocedal & Wright, Numerical Optimization,
ch. 10.3; bounds by an active set, Kelley, Iterative Methods for Optimization, ch. 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.free_parameters import BOUND_TOLERANCE
from rankone.inference.estimation.likelihood import Held, Likelihood, Linearised
from rankone.support.arrays import Array, bisected

_MOST_ITERATIONS = 80  # Most iterations of a search: a bound on the work where it does not settle
# Promised decrease, in shares of the sum of squares, below which a search ends: rounding
_SETTLED_SHARE = 1e-13
# Promised share below which a search also ends if the step did not decrease the cost
_ROUNDING_SHARE = 1e-9
# Promised decrease, in mean squares of the residuals, below which a search that creeps has arrived
_NEGLIGIBLE = 1e-6
# Change of the residuals across the cube, in units of their mean, that counts as zero
_UNSEEN_CHANGE = 1e-2
# Damping at the start, in squares of the largest singular value: close to a Newton step
_FIRST_DAMPING = 1e-3
_LEAST_DAMPING = 1e-14  # Least damping: below it nothing is damped, by rounding
_LARGEST_DAMPING = 1e10  # Damping above which a search ends: its steps are rounding
# Promised decrease, in mean squares of the residuals, above which a search that cannot go on stands
# at a jump: estimates would move by a tenth of their standard deviation
_STUCK_SHARE = 1e-2
# Decrease, in shares of the promised one, of a search that creeps up to a jump
_SLOW_SHARE = 1e-3
_EXACT = 1e-9  # Residuals, in shares of the data, that are rounding: nobody is stuck among these
# Lengths of steps across a jump, in widths of the cube, and how often they are tried
_HOPS = np.array([0.003, 0.01, 0.03, 0.1, 0.3])
_HOP_ROUNDS = 3
_BISECTIONS = 40  # Bisections of the last step before a jump


class Squares(Protocol):
    """-2 log L with ``size`` data, whose squares over their noise are ``magnitude``."""

    @property
    def size(self) -> int: ...
    @property
    def magnitude(self) -> float: ...
    def linearised(self, z: Array, held: Held = None) -> Linearised: ...


@dataclass(frozen=True)
class Minima:
    """K local minima: z (K, n), costs (K,), pseudo-residuals (K, r), Jacobian (K, r, n).

    ``stuck`` are those where the cost falls as far as the end, and rises beyond: it jumps there, or
    is ``kinked``.
    """

    z: Array
    cost: Array
    residuals: Array
    jacobian: Array
    converged: NDArray[np.bool_]
    stuck: NDArray[np.bool_]
    kinked: NDArray[np.bool_]

    def selected(self, rows: NDArray[np.intp]) -> Minima:
        """Some of the minima."""
        return Minima(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def joined(self, other: Minima) -> Minima:
        """All minima of two sets."""
        names = self.__dataclass_fields__
        return Minima(*(np.concatenate([getattr(s, n) for s in (self, other)]) for n in names))


def minima(problem: Squares, starts: Array, held: Held = None) -> Minima:
    """Minima from starts (K, n); held coordinates (K, n) stay at their start.

    The cost is infinite at a start at which the solution has ended before some of the data.
    """
    kept = np.zeros(starts.shape, dtype=bool) if held is None else held
    z, cost, residuals, jacobian = problem.linearised(np.clip(starts, 0.0, 1.0), kept)
    damping = np.full(len(z), _FIRST_DAMPING)
    converged, stuck = np.zeros(len(z), dtype=bool), np.zeros(len(z), dtype=bool)
    going = np.flatnonzero(np.isfinite(cost))
    for turn in range(_MOST_ITERATIONS if going.size else 0):
        squares = squares_of(residuals[going])
        step, promised = _step(
            z[going], residuals[going], jacobian[going], kept[going], damping[going]
        )
        trial = problem.linearised(np.clip(z[going] + step, 0.0, 1.0), kept[going])
        before = cost[going]
        better = trial.cost < before
        small = np.abs(trial.z - z[going]).max(axis=1) <= 1e-14
        ended = (promised <= _SETTLED_SHARE * squares) | small
        rounding = promised <= _ROUNDING_SHARE * squares
        ended |= ~better & (rounding | (damping[going] > _LARGEST_DAMPING))
        last = turn == _MOST_ITERATIONS - 1
        ended |= last & (promised <= _NEGLIGIBLE * squares / problem.size)
        at = going[better]
        z[at], cost[at] = trial.z[better], trial.cost[better]
        residuals[at], jacobian[at] = trial.residuals[better], trial.jacobian[better]
        down = np.maximum(damping[going] * 0.1, _LEAST_DAMPING)
        damping[going] = np.where(better, down, np.maximum(damping[going], 1e-6) * 8.0)
        exact = squares <= _EXACT**2 * problem.magnitude
        more = ~exact & (promised > _STUCK_SHARE * squares / problem.size)
        slow = ~better | (before - cost[going] <= _SLOW_SHARE * promised)
        blocked = more & ((ended & ~better) | (slow & last))
        converged[going[ended & ~blocked]], stuck[going[blocked]] = True, True
        going = going[~ended]
        if not going.size:
            break
    return Minima(z, cost, residuals, jacobian, converged, stuck, np.zeros(len(z), dtype=bool))


def minima_across_jumps(problem: Likelihood, starts: Array) -> Minima:
    """The same; searches that end where the cost jumps begin again on the other side.

    Those that do not get below the end go up to the jump.
    """
    ends = last = minima(problem, starts)
    for _ in range(_HOP_ROUNDS):
        rows = np.flatnonzero(last.stuck)
        if not rows.size:
            break
        stuck = last.selected(rows)
        free = np.zeros(stuck.z.shape, dtype=bool)
        step, _ = _step(stuck.z, stuck.residuals, stuck.jacobian, free, np.zeros(rows.size))
        way = step / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-300)
        beyond = stuck.z[:, None] + _HOPS[:, None] * way[:, None]
        last = minima(problem, beyond.reshape(-1, starts.shape[1]))
        ends = ends.joined(last)
    rows = np.flatnonzero(ends.stuck)
    if not rows.size:
        return ends
    near, jumps, kinks = _jump_ahead(problem, ends.selected(rows))
    ends.stuck[rows], ends.kinked[rows] = jumps, kinks
    best = int(np.argmin(ends.cost))
    if not ends.stuck[best]:
        return ends
    return ends.joined(_at_jump(problem, near[rows == best]))


def _jump_ahead(
    problem: Likelihood, stuck: Minima
) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """The last points (K, n) that are no worse than ends, on the ways of their steps.

    Beside them whether the cost jumps behind them, and whether it has a kink there: then nothing is
    gained on the way, as there is in a valley that bends.
    """
    z, free = stuck.z, np.zeros(stuck.z.shape, dtype=bool)
    step, _ = _step(z, stuck.residuals, stuck.jacobian, free, np.zeros(len(z)))

    def before(points: Array) -> NDArray[np.bool_]:
        return np.asarray(problem.costs(points)[1] <= stuck.cost)[:, None]

    near, far = bisected(z, np.clip(z + step, 0.0, 1.0), before, _BISECTIONS)
    rise = problem.costs(far)[1] - problem.costs(near)[1]
    gain = stuck.cost - problem.costs(0.5 * (z + near))[1]
    unit = squares_of(stuck.residuals) / problem.size
    jumps = rise > _STUCK_SHARE * unit
    return near, jumps, ~jumps & (gain <= _NEGLIGIBLE * unit)


def _at_jump(problem: Likelihood, near: Array) -> Minima:
    """The minima (n,) close to a jump at a point (1, n), where one of n coordinates is held."""
    n = near.shape[1]
    ends = minima(problem, np.repeat(near, n, axis=0), np.eye(n, dtype=bool))
    return replace(ends, converged=np.zeros(n, dtype=bool), stuck=np.ones(n, dtype=bool))


def squares_of(residuals: Array) -> Array:
    """Sums of squares (K,), infinite where the solution has ended before some of the data."""
    squares = np.einsum("km,km->k", residuals, residuals)
    return np.where(np.isnan(squares), np.inf, squares)


def _step(
    z: Array, residuals: Array, jacobian: Array, held: NDArray[np.bool_], damping: Array
) -> tuple[Array, Array]:
    """Damped steps (K, n), and the decrease (K,) that undamped steps promise."""
    slope = np.einsum("kmn,km->kn", jacobian, residuals)
    lower, upper = z <= BOUND_TOLERANCE, z >= 1.0 - BOUND_TOLERANCE
    stays = held | (lower & (slope > 0.0)) | (upper & (slope < 0.0))
    moving = np.where(stays[:, None, :], 0.0, jacobian)
    left, singular, right = np.linalg.svd(moving, full_matrices=False)
    along = np.einsum("kmi,km->ki", left, residuals)
    largest = singular[:, :1]
    mean = np.sqrt(np.mean(residuals**2, axis=1, keepdims=True))
    visible = singular > np.maximum(1e-10 * largest, _UNSEEN_CHANGE * mean)
    along = np.where(visible, along, 0.0)
    below = np.where(visible, singular**2 + damping[:, None] * largest**2, 1.0)
    step = -np.einsum("kin,ki->kn", right, along * singular / below)
    # The last bit of the way to a bound, so that no search creeps up to it
    step = np.where(stays & ~held, np.where(lower, -z, 1.0 - z), step)
    return step, np.sum(along**2, axis=1)
