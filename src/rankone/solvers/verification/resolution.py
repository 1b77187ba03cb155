"""How far down the states of reference trajectories are resolved.

Each state is resolved relative to its own size, down to a small part of it. An integration shows
where that is not enough: what is tiny may grow, or matter to what others become.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.tuning import CHECK
from rankone.support.arrays import AT_ONCE, LEAST, RESOLVED, Array
from rankone.support.budget import COPIES, OutOfBudgetError, charge, limited, memory_left, work_left
from rankone.support.costs import eigenvalues
from rankone.support.errors import ConvergenceError
from rankone.trajectories.integrators.diagnosis import (
    MOST_GROWTH,
    Rounding,
    first_jacobian,
    growth_bounds,
    growth_rate,
    jacobian_blocks,
    logarithmic_norm,
    rounding_errors,
)
from rankone.trajectories.integrators.integrator import DenseTrajectories
from rankone.trajectories.system.system import System

Integrate: TypeAlias = Callable[[Array, Array], DenseTrajectories]


def times_held(size: int) -> int:
    """At how many times states of this size, (n, m), are held at once: one at least."""
    most = min(AT_ONCE, memory_left() / (8 * COPIES))
    return max(int(most // size), 1)


class Resolution:
    """How far down each state is resolved; an integration shows whether that was far enough.

    For each state, (n, 1): the size that it has at ``first``, the ``largest`` that was seen and
    the one that it is presumed to have, the floor of a ``Reference``, and the absolute tolerance.
    ``asked`` are the states that somebody asks for, None for all. Others are resolved for what they
    do to these.
    """

    def __init__(
        self,
        system: System,
        points: Array,
        start: float,
        end: float,
        rtol: float,
        initial: Array,
        asked: Collection[int] | None = None,
    ) -> None:
        self.system, self.points, self.rtol = system, points, rtol
        self.start, self.end, self.horizon = start, end, end - start
        self.first = size = np.abs(initial).max(axis=1, keepdims=True)
        self.at_zero = initial == 0.0
        self.rounding = self._rounding([(start, initial)], size)
        self.size = np.where(size > 0.0, size, size.max(initial=0.0) or 1.0)
        self.floor = np.full((len(initial), 1), np.inf)
        self.asked = np.isin(np.arange(len(initial)), [*asked]) if asked is not None else None
        self.largest = self.first
        self.absolute = self._absolute(RESOLVED * self.size)

    def _rounding(self, samples: Sequence[tuple[float, Array]], largest: Array) -> Rounding:
        stack = self.system, self.points, self.horizon
        return rounding_errors(*stack, samples, largest, self.rtol)

    @property
    def presumes(self) -> bool:
        """Whether a state that starts from zero has no size of its own yet."""
        return bool(((self.first == 0.0) & ~self.rounding.zero).any())

    def follow(self, pilots: Resolution) -> None:
        """Begin with sizes and floors that a few of the trajectories have shown, and a margin."""
        self.size = np.where(self.first > 0.0, np.maximum(self.size, pilots.size), pilots.size)
        self.floor, self.largest = pilots.floor, np.maximum(self.first, pilots.largest)
        self.absolute = self._absolute(
            CHECK.pilot_margin * np.minimum(RESOLVED * self.size, self.floor)
        )

    def _absolute(self, finest: Array) -> Array:
        """The absolute tolerances at which states are relative down to the sizes ``finest``."""
        least = np.maximum(self.least, self.rounding.floor)
        return np.asarray(np.maximum(self.rtol * finest, least))

    @property
    def tolerated(self) -> Array:
        """Absolute tolerances of the problem, (n, 1), for the sizes that are known."""
        return self.system.tolerances(self.largest[:, 0])[:, None]

    @property
    def least(self) -> Array:
        """The least absolute tolerances, (n, 1).

        A state counts as no smaller than its tolerance of the problem or, if nobody asks for it,
        than a tiny part of the largest, unless it is amplified: then it has a floor.
        """
        sizes = self.tolerated
        if self.asked is not None:
            unseen = CHECK.unseen * (self.first.max(initial=0.0) or 1.0)
            sizes = np.where(self.asked[:, None], sizes, np.maximum(sizes, unseen))
        sizes = np.where(np.isfinite(self.floor), 0.0, sizes)
        return np.maximum(self.rtol * RESOLVED * sizes, LEAST)

    def refined(self, dense: DenseTrajectories) -> bool:
        """Adapt the tolerances to trajectories; whether to integrate again, to finer ones."""
        largest, early = (x.max(axis=1, keepdims=True) for x in (dense.largest, dense.early))
        samples = list(dense.samples(CHECK.resolution_samples))
        before, self.rounding = self.rounding, self._rounding(samples, largest)
        zero, finest = self.rounding.zero, self.rtol * RESOLVED * largest
        coarse = before.floor > np.maximum(self.rounding.floor, finest)
        small = ~zero & (largest > 0.0) & (largest < CHECK.small_state * RESOLVED * self.size)
        usual = RESOLVED * np.maximum(self.size, largest)
        candidates = ~zero & ~small & (early > 0.0)
        lingers = candidates & (early < np.minimum(usual, self.floor))
        if lingers.any():
            early = np.maximum(early, self._begun(dense, samples))
            lingers = candidates & (early < np.minimum(usual, self.floor))
        dips = ~zero & self._grows_again(dense)
        self.largest = np.maximum(self.first, largest)
        self.size = np.where(small, largest, self.size)
        self.floor = np.where(lingers, CHECK.lingering * early, self.floor)
        leaves_zero = (self.at_zero & (dense.largest > 0.0)).any(axis=1, keepdims=True)
        deepest = np.where(leaves_zero, CHECK.zero_floor * largest, CHECK.dip_floor)
        self.floor = np.where(dips, np.minimum(deepest, self.floor), self.floor)
        return self._resolves(small | lingers | dips | coarse)

    def _resolves(self, changed: NDArray[np.bool_]) -> bool:
        """Set the absolute tolerances by size and floor; whether one that changed is lower now."""
        coarser = self.absolute
        self.absolute = self._absolute(np.minimum(RESOLVED * self.size, self.floor))
        return bool((changed & (self.absolute < coarser)).any())

    def lowered(self, dense: DenseTrajectories, integrate: Integrate, work: float) -> bool:
        """Lower the floors if errors that were negligible early are passed on; whether they are.

        Down a long chain a state depends on what others were when they were a tiny part of what
        they become. No eigenvalue says so, but the logarithmic norm bounds what becomes of an error
        (Söderlind, BIT Numerical Mathematics 46 (2006), 631). Where the bound is large,
        a few trajectories that are finer by that much show whether it comes true. ``integrate``
        makes them at points and to absolute tolerances; all took ``work`` before.
        """
        largest = dense.largest.max(axis=1, keepdims=True)
        begins = ~self.rounding.zero & (self.first < RESOLVED * largest)
        if len(largest) < CHECK.long_chain or not begins.any():
            return False
        growth = min(self._bound_of_growth(dense, largest), CHECK.most_exponent)
        lower = np.where(begins, RESOLVED * math.exp(-growth) * largest, np.inf)
        absolute = self.rtol * np.minimum(lower, self.floor)
        absolute = np.maximum(absolute, np.maximum(self.rounding.floor, LEAST))
        absolute = np.minimum(absolute, self.absolute)
        if growth <= -math.log(RESOLVED) or not (absolute < self.absolute).any():
            return False
        try:
            with limited(min(CHECK.chain_work * work or math.inf, CHECK.chain_share * work_left())):
                finer = integrate(self.points[: CHECK.chain_trajectories], absolute)
        except OutOfBudgetError:
            return False
        if finer.end - self.start < CHECK.chain_end * (dense.end - self.start):
            return False  # rounding errors are larger: no steps are short enough
        times = np.linspace(self.start, min(finer.end, dense.end), CHECK.resolution_samples)
        change = np.abs(finer(times) - dense.of(slice(CHECK.chain_trajectories))(times)).max(axis=2)
        sizes = np.maximum(finer.largest, np.maximum(self.rounding.floor, self.tolerated))
        passed_on = (change > CHECK.passed_on * self.rtol * sizes + LEAST).any(axis=1)
        if not (passed_on if self.asked is None else passed_on & self.asked).any():
            return False
        self.floor = np.minimum(self.floor, lower)
        return self._resolves(begins)

    def _bound_of_growth(self, dense: DenseTrajectories, largest: Array) -> float:
        """The power of e by which an error may grow, relative to the sizes (n, 1) of the states.

        The lesser of two bounds: in the norm relative to sizes, and in that of the states as they
        are with the ratio of the largest to the smallest.
        """
        sizes = np.where(largest > 0.0, largest, self.size)[:, 0]
        norms, ratio = list[list[float]](), math.log(sizes.max() / sizes.min())
        for time, states in dense.samples(CHECK.resolution_samples):
            block = first_jacobian(self.system, self.points, time, states)
            if block is not None:
                by_scale = (logarithmic_norm(block, s) for s in (sizes, np.ones_like(sizes)))
                norms.append([max(norm, 0.0) for norm in by_scale])
        if not norms:
            return 0.0
        relative, absolute = self.horizon * np.mean(norms, axis=0)
        return float(min(relative, absolute + ratio))

    def _grows_again(self, dense: DenseTrajectories) -> NDArray[np.bool_]:
        """States (n, 1) that fall to a negligible part of what they were, of which some grow again.

        They stay there from one sample to the next: others pass through zero. They grow by their
        own block of the Jacobian, whatever the others do. An integration that does not resolve them
        makes noise of them, which grows as well.
        """
        least, first = _dips(dense)
        dips = np.asarray((least < math.inf).any(axis=1))
        if not dips.any():
            return dips[:, None]
        later = np.linspace(
            first, dense.end, CHECK.resolution_samples
        )  # steps may pass over all of the growth
        growth, small = 0.0, np.flatnonzero(dips)
        lost, grows = least < CHECK.least_kept_size, np.zeros_like(dips)
        sizes, slowest = dense.largest.max(axis=1)[small], MOST_GROWTH / (dense.end - first)
        for time, at in zip(later.tolist(), np.moveaxis(dense(later), 2, 0), strict=True):
            for some in self._may_grow(time, at, small, slowest):
                stack = self.points[some], time, at[:, some]
                blocks = self._forwards(stack[2]) * jacobian_blocks(self.system, *stack, small)
                if np.isfinite(blocks).all():
                    charge(len(blocks) * eigenvalues(small.size))
                    growth = max(growth, float(np.linalg.eigvals(blocks).real.max()))
                    falls = blocks[lost[:, some].any(axis=0)]
                    if len(falls):
                        grows[small] |= _growing(falls * (sizes / sizes[:, None]), slowest)
        if growth <= slowest:
            return np.zeros_like(dips)[:, None]
        grows &= lost.any(axis=1)
        if grows.any():
            name = self.system.states[int(np.argmax(grows))]
            raise ConvergenceError(
                f"`{name}` falls below {CHECK.least_kept_size:g} and may grow again from "
                "there, which is beyond floating-point numbers",
                remedy="take its logarithm as the unknown, or shorten the horizon",
            )
        return dips[:, None]

    def _forwards(self, states: Array) -> Array:
        """1 for trajectories at ``states`` (n, m) that go on in time, -1 for others: (m, 1, 1).

        Those of an order that does not hold go back to its events.
        """
        if self.system.clock is None:
            return np.ones((1, 1, 1))
        lengths = states[len(self.system.unknowns) - 1]
        return np.where(lengths < 0.0, -1.0, 1.0)[:, None, None]

    def _may_grow(
        self, time: float, states: Array, rows: NDArray[np.intp], slowest: float
    ) -> list[NDArray[np.intp]]:
        """Trajectories some of whose states may grow faster, as many at once as are held."""
        some = np.arange(len(self.points))
        if self.system.clock is None:
            bounds = growth_bounds(self.system, self.points, time, states, rows)
            some = np.flatnonzero(~(bounds <= slowest))
        return np.array_split(some, -(-some.size * rows.size**2 // AT_ONCE) or 1)[: some.size]

    def _begun(self, dense: DenseTrajectories, samples: Sequence[tuple[float, Array]]) -> Array:
        """Sizes of states (n, 1) before small ones may grow exponentially; infinite if none may.

        A state that starts from zero is as small at first as steps are short. What it is after a
        part of the time in which it grows counts, and does not depend on them.
        """
        growth, start = 0.0, self.start
        for time, states in samples:
            block = first_jacobian(self.system, self.points, time, states)
            if block is not None:
                growth = max(growth, growth_rate(block, MOST_GROWTH / (dense.end - start)))
        if growth * (dense.end - start) <= MOST_GROWTH:
            return np.full((len(self.size), 1), np.inf)
        begun = dense(np.array([start + CHECK.begun / growth]))
        return np.asarray(np.abs(begun).max(axis=(1, 2))[:, None])


def _growing(blocks: Array, slowest: float) -> NDArray[np.bool_]:
    """States (r,) that are in an eigenvector which grows faster, of some Jacobian (m, r, r).

    One that a reset sets to zero, and whose rate is zero, is in none.
    """
    charge(len(blocks) * eigenvalues(blocks.shape[1]))
    values, vectors = np.linalg.eig(blocks)
    shares = np.abs(vectors) * (values.real > slowest)[:, None]
    return np.asarray((shares > CHECK.eigenvector_part).any(axis=(0, 2)))


def _dips(dense: DenseTrajectories) -> tuple[Array, float]:
    """Sizes (n, m) to which states fall that fall to a negligible part of what they were.

    Infinite for others. Also the time at which the first of them is there.
    """
    n, first, earlier = len(dense.state), math.inf, math.inf
    least, highest = np.full_like(dense.state, math.inf), np.zeros(n)
    before = largest = np.zeros_like(dense.state)
    for time, states in dense.samples(CHECK.dip_samples):
        sizes = np.abs(states)
        lowest = sizes.min(axis=1)
        if (lowest < RESOLVED * highest).any():
            low = np.flatnonzero(lowest < RESOLVED * highest)  # few if any
            staying = np.maximum(before[low], sizes[low])
            below = staying < RESOLVED * largest[low]
            if below.any():
                first = min(first, earlier)
                least[low] = np.where(below, np.minimum(least[low], sizes[low]), least[low])
        before, earlier, largest = sizes, time, np.maximum(largest, sizes)
        highest = np.maximum(highest, sizes.max(axis=1))
    return least, first
