"""Minima of -2 log L in a unit cube: from many starts at once, or one after the other.

The method of Levenberg and Marquardt, with steps by the singular values of the Jacobian: parameters
do not move along directions that the data do not see (Nocedal & Wright, Numerical Optimization,
ch. 10.3; bounds by an active set, Kelley, Iterative Methods for Optimization, ch. 5.4).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from rankone.inference.estimation.likelihood import Held, Likelihood, Linearised
from rankone.support.arrays import (
    COARSE,
    COINCIDENT,
    MINOR,
    NEGLIGIBLE,
    RESOLVED,
    ROUNDING,
    SAME,
    TINY,
    Array,
    bisected,
)
from rankone.support.budget import limited
from rankone.support.options import checked_number
from rankone.support.tasks import ExecutorLike, Shared, checked_executor, open_pool


@dataclass(frozen=True)
class SearchTuning:
    """Tuning of searches for minima, measured over fits and calibrations."""

    most_iterations: int = 80
    """Most iterations of a search: a bound on the work where it does not settle."""
    unseen_change: float = 1e-2
    """Change of the residuals across the cube, in units of their mean, that counts as zero."""
    first_damping: float = COARSE
    """Damping at the start, in squares of the largest singular value: close to a Newton step."""
    largest_damping: float = 1e10
    """Damping above which a search ends: its steps are rounding."""
    stuck_share: float = 1e-2
    """Promised decrease, in mean squares of the residuals, above which a search that cannot go on
    stands at a jump: estimates would move by a tenth of their standard deviation."""
    slow_share: float = COARSE
    """Decrease, in shares of the promised one, of a search that creeps up to a jump."""
    hop_rounds: int = 3
    """How often steps across a jump are tried."""
    replacements: int = 20
    """Points that are tried for each start whose trajectories do not reach the data."""
    agreeing_share: float = 0.5
    """Share of the starts at the same optimum from which it is believed."""
    hops: int = 2
    """Hops in vain after which they end, for each start."""
    most_work: float = 5e10
    """Operations of all hops."""
    hop_iterations: int = 40
    """Most iterations of the way down from a hop."""
    hop_gain: float = 0.01
    """Decrease of -2 log L from which a hop is worth while."""
    drawn: int = 4
    """Places of which a hop takes the best."""
    passed_shares: tuple[float, float, float] = (0.25, 0.5, 0.75)
    """Shares of the coordinates that another end passes on."""
    drawn_coordinates: tuple[float, float, float] = (0.0, 1.0, 3.0)
    """Coordinates that are drawn anew, beside one."""
    most_ends: int = 10
    """Ends that are crossed."""
    least_promise: float = 1.0
    """Decrease of -2 log L below which a start is on a plateau."""
    more: int = 3
    """Ways that begin, for each that goes on where points are screened."""
    first_leg: int = 8
    """Iterations of these."""
    poor: float = 0.25
    """Share of the promised decrease below which the box shrinks."""
    good: float = 0.75
    """Share above which it grows."""
    shrinking: float = 0.25
    """Factor on the box where it shrinks."""
    growing: float = 2.0
    """Factor where it grows."""
    settled: float = 1e-4
    """Promised decrease of -2 log L below which a descent has arrived."""
    stalled: float = 1e-2
    """Decrease of -2 log L over some iterations below which it gets nowhere."""
    stall_length: int = 20
    """Iterations over which it is looked at whether a descent gets anywhere."""


TUNING = SearchTuning()

# Lengths of steps across a jump, in widths of the cube
_HOP_LENGTHS = np.geomspace(0.003, 0.3, 5)


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
    damping = np.full(len(z), TUNING.first_damping)
    converged, stuck = np.zeros(len(z), dtype=bool), np.zeros(len(z), dtype=bool)
    going = np.flatnonzero(np.isfinite(cost))
    for turn in range(TUNING.most_iterations if going.size else 0):
        squares = squares_of(residuals[going])
        step, promised = _step(
            z[going], residuals[going], jacobian[going], kept[going], damping[going]
        )
        trial = problem.linearised(np.clip(z[going] + step, 0.0, 1.0), kept[going])
        before = cost[going]
        better = trial.cost < before
        small = np.abs(trial.z - z[going]).max(axis=1) <= ROUNDING
        ended = (promised <= COINCIDENT * squares) | small
        rounding = promised <= NEGLIGIBLE * squares
        ended |= ~better & (rounding | (damping[going] > TUNING.largest_damping))
        last = turn == TUNING.most_iterations - 1
        ended |= last & (promised <= SAME * squares / problem.size)
        at = going[better]
        z[at], cost[at] = trial.z[better], trial.cost[better]
        residuals[at], jacobian[at] = trial.residuals[better], trial.jacobian[better]
        down = np.maximum(damping[going] * MINOR, COINCIDENT)
        damping[going] = np.where(better, down, np.maximum(damping[going], SAME) * 8.0)
        exact = squares <= NEGLIGIBLE**2 * problem.magnitude
        more = ~exact & (promised > TUNING.stuck_share * squares / problem.size)
        slow = ~better | (before - cost[going] <= TUNING.slow_share * promised)
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
    for _ in range(TUNING.hop_rounds):
        rows = np.flatnonzero(last.stuck)
        if not rows.size:
            break
        stuck = last.selected(rows)
        free = np.zeros(stuck.z.shape, dtype=bool)
        step, _ = _step(stuck.z, stuck.residuals, stuck.jacobian, free, np.zeros(rows.size))
        way = step / np.maximum(np.abs(step).max(axis=1, keepdims=True), TINY)
        beyond = stuck.z[:, None] + _HOP_LENGTHS[:, None] * way[:, None]
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

    near, far = bisected(z, np.clip(z + step, 0.0, 1.0), before)
    rise = problem.costs(far)[1] - problem.costs(near)[1]
    gain = stuck.cost - problem.costs(0.5 * (z + near))[1]
    unit = squares_of(stuck.residuals) / problem.size
    jumps = rise > TUNING.stuck_share * unit
    return near, jumps, ~jumps & (gain <= SAME * unit)


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
    lower, upper = z <= NEGLIGIBLE, z >= 1.0 - NEGLIGIBLE
    stays = held | (lower & (slope > 0.0)) | (upper & (slope < 0.0))
    moving = np.where(stays[:, None, :], 0.0, jacobian)
    left, singular, right = np.linalg.svd(moving, full_matrices=False)
    along = np.einsum("kmi,km->ki", left, residuals)
    largest = singular[:, :1]
    mean = np.sqrt(np.mean(residuals**2, axis=1, keepdims=True))
    visible = singular > np.maximum(NEGLIGIBLE * largest, TUNING.unseen_change * mean)
    along = np.where(visible, along, 0.0)
    below = np.where(visible, singular**2 + damping[:, None] * largest**2, 1.0)
    step = -np.einsum("kin,ki->kn", right, along * singular / below)
    # The last bit of the way to a bound, so that no search creeps up to it
    step = np.where(stays & ~held, np.where(lower, -z, 1.0 - z), step)
    return step, np.sum(along**2, axis=1)


# -----------------------------------------------------------------------------
# Many starts in the unit cube of the bounds, and which of them go on.


MOST_STARTS = 10_000
"""Most random starts."""
# Starts that go on, the best of those before, and for how many iterations more at most
_LEGS = ((MOST_STARTS, 40), (5, 60), (3, 200))
SAME_COST = 0.2
"""Difference of -2 log L below which starts ended at the same optimum."""


@dataclass(frozen=True, kw_only=True)
class Starts:
    """How many random starts there are, and where they go down; see :func:`rankone.calibrate`."""

    starts: int = 10
    seed: int = 0
    executor: ExecutorLike | None = None

    def checked(self) -> Starts:
        """The same; an OptionError for what does not fit."""
        executor = None if self.executor is None else checked_executor("executor", self.executor)
        starts = checked_number("starts", self.starts, 1, MOST_STARTS)
        return Starts(starts=starts, seed=self.seed, executor=executor)


def random_starts(count: int, n: int, seed: int) -> Array:
    """A latin hypercube of points (count, n) of the unit cube, in the coordinates of the search."""
    generator = np.random.default_rng(seed)
    cells = np.stack([generator.permutation(count) for _ in range(n)], axis=1)
    return np.asarray((cells + generator.random((count, n))) / count)


def descents(problem: Expandable, begin: Starts, screened: int = 1) -> list[Descent]:
    """Descents from random starts, the best of them first.

    Of so many ``screened`` points for each, the best that are apart go a short way, and the best of
    these are the starts; where none are screened, one without trajectories is replaced by another
    random point. All go on for some iterations, the best for more. Unless half of them end at the
    same optimum, the best end then hops: it takes some coordinates of other ends, a few are drawn
    anew, and where the way down from there leads lower, it stays. Points and ways are shared out to
    the workers of an executor; hops, each of which begins where the one before led, are not.
    """
    count, executor = begin.starts, begin.executor
    generator = np.random.default_rng(begin.seed)
    points = random_starts(count * screened, len(problem.names), begin.seed)
    replacements = TUNING.replacements if screened == 1 else 0
    with nullcontext() if executor is None else open_pool(executor) as pool:
        shared = Shared("what is calibrated", problem, pool)
        first = shared.map(_expanded, [(z,) for z in points])
        tried = [_usable(problem, at, generator, replacements) for at in first]
        if screened > 1:
            ways = _promising(shared, problem, tried, count)
        else:
            ways = [_way(at) for at in tried]
        _go_on(shared, ways)
        agree = sum(way.at.cost <= ways[0].at.cost + SAME_COST for way in ways)
        if np.isfinite(ways[0].at.cost) and agree < TUNING.agreeing_share * count:
            _hop(problem, ways, generator, TUNING.hops * count)
            _go_on(shared, ways)
    return ways


def _expanded(problem: Expandable, z: Array) -> Expansion:
    return problem.expanded(z)


def _after(problem: Expandable, way: Descent, iterations: int) -> Descent:
    """A way after some iterations more, also where it came from another process."""
    way.go(problem, iterations)
    return way


def _way(at: Expansion) -> Descent:
    """A way down from a point; there is none without trajectories."""
    return Descent(at, at.z, arrived=not np.isfinite(at.cost))


def _promising(
    shared: Shared[Expandable], problem: Expandable, tried: Sequence[Expansion], count: int
) -> list[Descent]:
    """So many ways that led lowest in a few iterations, of more that began apart."""
    ways = [_way(at) for at in _apart(problem, tried)[: TUNING.more * count]]
    ways = shared.map(_after, [(way, TUNING.first_leg) for way in ways])
    ways.sort(key=lambda way: way.at.cost)
    costs = np.array([way.at.cost for way in ways])
    above = np.concatenate([[np.inf], np.diff(np.nan_to_num(costs, posinf=1e300))])
    again = (above < SAME_COST) & (costs > costs[0] + SAME_COST)
    ended = [bool(same and way.arrived) for same, way in zip(again, ways, strict=True)]
    order = sorted(range(len(ways)), key=lambda k: ended[k])
    return [ways[k] for k in order[:count]]


def _apart(problem: Expandable, tried: Sequence[Expansion]) -> list[Expansion]:
    """Points by their rank; last those near a better one, which lead to the same place.

    Near are those in a ball that holds log N of N points on average (multi-level single linkage:
    Rinnooy Kan & Timmer, Mathematical Programming 39, 1987).
    """
    points, count = sorted(tried, key=_rank(problem)), len(tried)
    searched = np.array([at.z for at in points])[:, ~problem.nested]
    n = searched.shape[1]
    share = math.log(max(count, 2)) / count
    radius = math.exp((math.log(share) + math.lgamma(0.5 * n + 1.0)) / max(n, 1)) / math.sqrt(
        math.pi
    )
    distances = np.linalg.norm(searched[:, None] - searched, axis=2)
    near = [bool((distances[k, :k] < radius).any()) for k in range(count)]
    return [points[k] for k in sorted(range(count), key=lambda k: near[k])]


def _rank(problem: Expandable) -> Callable[[Expansion], tuple[bool, float]]:
    """Points by their costs; those last from which nothing promises a better likelihood."""

    def rank(at: Expansion) -> tuple[bool, float]:
        radius = np.where(problem.nested, 1.0, FIRST_RADIUS)
        flat = not np.isfinite(at.cost) or bounded_step(at, radius)[1] < TUNING.least_promise
        return flat, at.cost

    return rank


def _go_on(shared: Shared[Expandable], ways: list[Descent]) -> None:
    """All go on for some iterations, the best for more; they are sorted in place."""
    for many, iterations in _LEGS:
        going = [k for k, way in enumerate(ways[:many]) if not way.arrived]
        further = shared.map(_after, [(ways[k], iterations) for k in going])
        for k, way in zip(going, further, strict=True):
            ways[k] = way
        ways.sort(key=lambda way: way.at.cost)


def _hop(
    problem: Expandable, ways: list[Descent], generator: np.random.Generator, most: int
) -> None:
    """Take the best way to other places until ``most`` of them in a row led nowhere.

    A place has some coordinates of the best end, others of another end, and a few at random, as in
    evolution: what fits part of the data is passed on. The ends are those of the ways, and of hops.
    """
    best, ends = ways[0], [way.at for way in ways if np.isfinite(way.at.cost)]
    with limited() as account:
        in_vain, last = 0, account.done + TUNING.most_work
        while in_vain < most and account.done < last:
            drawn = [_crossed(best.at, ends, generator) for _ in range(TUNING.drawn)]
            other = _way(min(map(problem.expanded, drawn), key=_rank(problem)))
            other.go(problem, TUNING.hop_iterations)
            best.iterations += other.iterations + 1
            gain = best.at.cost - other.at.cost
            in_vain = 0 if gain > SAME_COST else in_vain + 1
            if gain > TUNING.hop_gain:
                best.continue_from(other)
            if np.isfinite(other.at.cost):
                ends = _different([*ends, other.at])


def _crossed(best: Expansion, ends: Sequence[Expansion], generator: np.random.Generator) -> Array:
    """A place (n,) between the best end and another one."""
    z, n = best.z.copy(), best.z.size
    passed = generator.random(n) < generator.choice(TUNING.passed_shares)
    z[passed] = ends[int(generator.integers(len(ends)))].z[passed]
    drawn = generator.random(n) < generator.choice(TUNING.drawn_coordinates) / n
    drawn[generator.integers(n)] = True
    z[drawn] = generator.random(int(drawn.sum()))
    return z


def _different(ends: Sequence[Expansion]) -> list[Expansion]:
    """The best ends, one of each cost."""
    kept = list[Expansion]()
    for at in sorted(ends, key=lambda at: at.cost):
        if not kept or at.cost > kept[-1].cost + SAME_COST:
            kept.append(at)
    return kept[: TUNING.most_ends]


def _usable(
    problem: Expandable, at: Expansion, generator: np.random.Generator, replacements: int
) -> Expansion:
    """The expansion at a start, or at the first random point that has trajectories."""
    for _ in range(replacements):
        if np.isfinite(at.cost):
            return at
        at = problem.expanded(generator.random(at.z.size))
    return at


# -----------------------------------------------------------------------------
# The way down from one start, by least squares in a box of trust (Gauss–Newton).
#
# Within the box of trust and the bounds the squares of the linearised residuals have their minimum
# exactly (bounded least squares); the box grows where the promise holds, and shrinks elsewhere
# (Conn, Gould & Toint, Trust-Region Methods, 2000, ch. 6 and 7). For estimated noise the pseudo-
# residuals make the matrix the Fisher information, which has no negative directions.


LARGEST_RADIUS = MINOR
"""Half the width of the largest box of trust, in widths of the bounds."""
FIRST_RADIUS = 0.5 * LARGEST_RADIUS


class Expansion(NamedTuple):
    """-2 log L at z (n,), and the residuals (r,) and their Jacobian (r, n) that stand for it.

    Half its gradient is ``jacobian.T @ residuals``, half its curvature about
    ``jacobian.T @ jacobian``. The cost is infinite where there is no trajectory.
    """

    z: Array
    cost: float
    residuals: Array
    jacobian: Array


class Expandable(Protocol):
    """-2 log L on the unit cube; its coordinates are logarithms of parameters over decades."""

    @property
    def names(self) -> tuple[str, ...]:
        """The coordinates."""

    @property
    def nested(self) -> NDArray[np.bool_]:
        """The coordinates (n,) that :meth:`expanded` puts at their best."""

    def expanded(self, z: Array) -> Expansion:
        """At z (n,), or close to it where some parameters have their best values at once."""


@dataclass
class Descent:
    """One way down from ``start`` (n,); :meth:`go` takes it further."""

    at: Expansion
    start: Array
    radius: float = FIRST_RADIUS
    largest: float = LARGEST_RADIUS
    iterations: int = 0
    arrived: bool = False
    costs: list[float] = field(default_factory=list)

    def go(self, problem: Expandable, iterations: int) -> None:
        """Go on for some iterations at most."""
        for _ in range(iterations):
            if self.arrived:
                return
            self._step(problem)

    def continue_from(self, other: Descent) -> None:
        """Go on from where another way is."""
        self.at, self.radius = other.at, other.radius
        self.arrived, self.costs = other.arrived, other.costs

    def _step(self, problem: Expandable) -> None:
        at = self.at
        step, promised = bounded_step(at, np.where(problem.nested, 1.0, self.radius))
        self.iterations += 1
        length = float(np.abs(step[~problem.nested]).max(initial=0.0))
        if promised <= TUNING.settled or length <= COINCIDENT:
            self.arrived = True
            return
        trial = problem.expanded(np.clip(at.z + step, 0.0, 1.0))
        share = (at.cost - trial.cost) / promised if np.isfinite(trial.cost) else -np.inf
        if share < TUNING.poor:
            self.radius = TUNING.shrinking * min(length, self.radius)
        elif share > TUNING.good and length >= 0.99 * self.radius:
            self.radius = min(TUNING.growing * self.radius, self.largest)
        if share > 0.0:
            self.at = trial
        self.costs.append(self.at.cost)
        before = (
            self.costs[-TUNING.stall_length] if len(self.costs) >= TUNING.stall_length else np.inf
        )
        self.arrived = self.radius <= RESOLVED or before - self.at.cost <= TUNING.stalled


def bounded_step(at: Expansion, radius: float | Array) -> tuple[Array, float]:
    """The best step (n,) within the box of trust and the cube, and the decrease it promises.

    The box has half the width ``radius``, one for all coordinates or one for each (n,).
    """
    scale = float(np.linalg.norm(at.jacobian, axis=0).max(initial=0.0)) or 1.0
    n = at.z.size
    rows = np.concatenate([at.jacobian, np.sqrt(NEGLIGIBLE) * scale * np.eye(n)])
    right = np.concatenate([-at.residuals, np.zeros(n)])
    lower = np.minimum(np.maximum(-radius, -at.z), -COINCIDENT)
    upper = np.maximum(np.minimum(radius, 1.0 - at.z), COINCIDENT)
    step = scipy.optimize.lsq_linear(rows, right, (lower, upper), method="bvls").x
    step = np.clip(at.z + step, 0.0, 1.0) - at.z
    after = at.residuals + at.jacobian @ step
    return step, float(at.residuals @ at.residuals - after @ after)
