"""A second look at what passed: finer trajectories, and where slabs are worst.

The reference and the samples choose their steps by the same estimates of errors. Where these fail,
both may be wrong alike: an error of the place at which a state nearly stops is tiny, and becomes
a large one once the state goes on later than it should. LSODA steps in another way. So it follows
a few of the trajectories, at a tighter tolerance.

Rates that are polynomials of low degree mislead no estimate. What their flow amplifies differs
between the reference and the samples, and is a part of the measured error.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.tuning import CHECK
from rankone.solvers.verification.measure import with_contractions
from rankone.solvers.verification.points import (
    CANDIDATES,
    FEW_PARAMETERS,
    FEW_POINTS,
    MOST_SLABS,
    Climb,
    Coverage,
    climbed,
    points_in_elements,
)
from rankone.solvers.verification.reference import reference_accuracy
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.arrays import NEGLIGIBLE, Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.tensors.slab import SlabTrain
from rankone.trajectories.events.sides import OrderError
from rankone.trajectories.stacks.stack import has_smooth_rates
from rankone.trajectories.system.timeline import CLOCK_STATES
from rankone.trajectories.system.verdict import HiddenRate

# Below this tolerance LSODA, at a hundredth of it, stays in its stiff method once it is there, with
# short steps whatever the rates: references so many times above are compared at this one
_LSODA_RETURNS, _ABOVE = 3e-10, 10.0


def confirmed(reference_set: ReferenceSet) -> tuple[ReferenceSet, HiddenRate | None]:
    """The set, or a finer one, and where finer trajectories leave the finest there is.

    The set is finer where one of a few trajectories left a coarser one by a good part of the
    tolerance. One that is as fine as rounding allows, and trajectories of a forced order, are taken
    as they are.
    """
    system, reference = reference_set.system, reference_set.reference
    finest = reference_accuracy(0.0)
    hidden: HiddenRate | None = None
    if not reference_set.checked or reference.blown is not None:
        return reference_set, None
    if system.clock is None and has_smooth_rates(system, reference.start):
        return reference_set, None
    if system.clock is not None and system.clock.forced is not None:
        return reference_set, None
    accuracy = reference_set.accuracy
    while accuracy > finest:
        accuracy = max(_finer(accuracy), finest)
        hidden = _departure(reference_set, accuracy)
        if hidden is None:
            break
        reference_set = reference_set.at_accuracy(accuracy)
        if reference_set.reference.blown is not None:
            return reference_set, None
    if hidden is not None:
        hidden = _departure(reference_set, finest)
    return reference_set, hidden


def _finer(accuracy: float) -> float:
    """The relative tolerance of trajectories that a reference is compared with."""
    finer = CHECK.finer_ratio * accuracy
    return _LSODA_RETURNS if finer < _LSODA_RETURNS <= accuracy / _ABOVE else finer


def _departure(reference_set: ReferenceSet, accuracy: float) -> HiddenRate | None:
    """Where a trajectory of this relative tolerance has left the reference first, if one has.

    None has where it meets another order of events: it is next to where the order changes.
    """
    clock, few, times = reference_set.system.clock, _compared(reference_set), _times(reference_set)
    end = reference_set.end if clock is None else clock.horizon[1]
    try:
        samples = reference_set.sampled_again(few, times, accuracy)
    except OrderError:
        return None
    times, finer = times[: samples.reached], np.moveaxis(samples.states[: samples.reached], 0, 2)
    for k, index in enumerate(few.tolist()):
        states = reference_set.reference.of(slice(index, index + 1))(times)
        now = _clock_times(reference_set, times, states)
        apart = _differences(reference_set, index, times, states, finer[:, k : k + 1])
        left = (apart > CHECK.finer_difference * reference_set.rtol) & (now <= end)
        if left.any():
            point = reference_set.reference.points[index].tolist()
            named = zip(reference_set.system.parameters, point, strict=True)
            states_left = left if clock is None else left[: clock.n_states]
            at = int(np.argmax((states_left if states_left.any() else left).any(axis=0)))
            row = int(np.argmax(apart[: len(states_left), at]))
            return HiddenRate(reference_set.names[row], float(now[at]), tuple(named))
    return None


def _times(reference_set: ReferenceSet) -> Array:
    """The times (T,) of a comparison, none of them that of a jump: states differ on either side."""
    times = np.linspace(reference_set.reference.start, reference_set.end, CHECK.finer_times)
    jumps = np.array(reference_set.system.jumps.times)
    near = NEGLIGIBLE * (times[-1] - times[0])
    apart = np.abs(times[:, None] - jumps).min(axis=1, initial=np.inf) > near
    return np.asarray(times[apart])


def _clock_times(reference_set: ReferenceSet, times: Array, states: Array) -> Array:
    """The clock times (T,) of states (n, 1, T) at times, which may be those of stretches."""
    system = reference_set.system
    return times if system.clock is None else states[len(system.unknowns) - CLOCK_STATES, 0]


def _differences(
    reference_set: ReferenceSet, index: int, times: Array, states: Array, finer: Array
) -> Array:
    """What differs between states (n, 1, T) of a trajectory, in units of the sizes: (n, T).

    What nobody asks for differs by nothing.
    """
    one = slice(index, index + 1)
    before, after = (reference_set.seen(times, each, one) for each in (states, finer))
    apart = np.abs(after - before)[:, 0] / reference_set.states[:, None]
    if reference_set.counted is not None:
        apart[np.setdiff1d(np.arange(len(apart)), reference_set.counted)] = 0.0
    return np.asarray(np.nan_to_num(apart, nan=np.inf))


def _compared(reference_set: ReferenceSet) -> NDArray[np.intp]:
    """Positions of the trajectories to compare: the centre, and the one that moves farthest."""
    reference, sizes = reference_set.reference, reference_set.of_states[:, None]
    start = reference_set.system.initial(np.ascontiguousarray(reference.points.T))
    end = np.concatenate([batch.state for batch in reference.batches], axis=1)
    moved: Array = np.nan_to_num(np.abs(end - start) / sizes).sum(axis=0)
    if not reference_set.whole_box:
        moved[1 : 1 + reference_set.corners] = 0.0
    return np.unique([0, int(np.argmax(moved))])


# -----------------------------------------------------------------------------
# Where slabs are worst: points that a few reference trajectories do not see.
#
# The residual u' - f(t, p, u) costs a microsecond a point instead of a trajectory. It is not an
# error, but at any one time the two are in about the same ratio everywhere, and points with known
# errors give this ratio.


_RESIDUAL_SHARES = np.array([0.21, 0.64, 0.97])  # Times of residuals, in slab lengths
# The way to them. The last steps are as short as the kinks are thin.
_TO_KINKS = Climb(rounds=8, tries=8, first_step=0.1, shrinkage=0.4)


def worst_points(
    reference_set: ReferenceSet, slabs: Sequence[SlabTrain], error: float, rtol: float, attempt: int
) -> Array | None:
    """Points (m, d) where the error is expected to be above the tolerance; None if there are none.

    ``error`` is the measured one over the tolerance. Each attempt has points of its own.
    """
    if not reference_set.domain.box or not slabs or not reference_set.checked:
        return None
    generator = np.random.default_rng((20141, attempt + 1))
    search = _WorstPoints(reference_set, slabs, rtol, generator)
    if reference_set.observed is not None:
        return search.anywhere()
    points = np.concatenate([search.by_residual(error), search.after_jumps()])
    return points if len(points) else None


@dataclass(frozen=True)
class _WorstPoints:
    """A search for points where slabs are wrong."""

    reference_set: ReferenceSet
    slabs: Sequence[SlabTrain]
    rtol: float
    generator: np.random.Generator

    def by_residual(self, error: float) -> Array:
        """Points (m, d) where the residual, beside those of known trajectories, is large."""
        unit, tolerated = self._candidates(len(self.reference_set.domain.box))
        if self.reference_set.whole_box:
            tolerated = np.ones(len(unit))
        candidates = self._points(unit)
        compared = self.reference_set.interior_points[-CHECK.most_compared :]
        indices = sorted({round(i) for i in np.linspace(0, len(self.slabs) - 1, MOST_SLABS)})
        points, slabs = np.concatenate([compared, candidates]), [self.slabs[i] for i in indices]
        ratios = np.zeros(len(candidates))
        for slab, contraction in with_contractions(slabs, points):
            residuals = self._residuals(slab, points, contraction)
            floor = CHECK.negligible_error * self.rtol / (slab.end - slab.start)
            usual = np.maximum(residuals[:, : len(compared)].max(axis=1, keepdims=True), floor)
            ratios = np.maximum(ratios, (residuals[:, len(compared) :] / usual).max(axis=0))
        ratios = np.where(np.isfinite(ratios), ratios, np.inf) / tolerated
        worst = np.argsort(-ratios, kind="stable")[: CHECK.worst_chosen]
        doubtful = ratios[worst] * max(error, CHECK.negligible_error) > CHECK.doubtful_error
        return np.asarray(candidates[worst[doubtful]])

    def anywhere(self) -> Array:
        """Random points (m, d): quantities that are observed have no residual."""
        d = len(self.reference_set.domain.box)
        return self._points(self.generator.random((FEW_POINTS, d)))

    def _points(self, shares: Array) -> Array:
        """Points (m, d) at shares of the box: on the scales of the domain and of the solution."""
        here, scales = Coverage.of_domain(self.reference_set.domain), self.slabs[-1].bases
        points = here.points(shares)
        points[::2] = Coverage.of_bases(scales).points(shares[::2])
        return points

    def _candidates(self, d: int) -> tuple[Array, Array]:
        """Points (m, d) of the unit cube, and by how much errors there may be larger, (m,)."""
        if d <= FEW_PARAMETERS:
            return self.generator.random((CANDIDATES, d)), np.ones(CANDIDATES)
        affordable = _affordable(self.slabs[-1:])
        points = self.generator.random((min(max(affordable, CANDIDATES), CHECK.most_candidates), d))
        near = np.arange(len(points)) % CHECK.corner_interval == 0
        offset = 2.0 * points[near] - 1.0
        points[near] = 0.5 + 0.5 * np.sign(offset) * np.abs(offset) ** CHECK.corner_power
        return points, np.where(near, CHECK.corner_error, 1.0)

    def _residuals(self, slab: SlabTrain, points: Array, contraction: Array) -> Array:
        """Largest residual of a state, in units of the sizes, at each time and point: (T, m)."""
        system, units = self.reference_set.system, self.reference_set.states[:, None, None]
        times = slab.start + (slab.end - slab.start) * _RESIDUAL_SHARES
        modes = slab.time_modes(times)
        states, slopes = (
            each.on_grid(times, contraction, modes).swapaxes(1, 2)
            for each in (slab, slab.derivative())
        )
        cost = function_cost(system.rhs, system.user_functions)
        charge(cost(len(times) * len(points)) + 2.0 * states.size)
        with np.errstate(all="ignore"):
            rates = system.rhs(times[:, None], states, points.T[:, None])
            residuals = (np.abs(slopes - rates) / units).max(axis=0)
        return np.asarray(np.nan_to_num(residuals, nan=np.inf))

    def after_jumps(self) -> Array:
        """Points (m, d) where the states after a jump are not what it makes of those before it."""
        jumps, bounds = self.reference_set.system.jumps, self.reference_set.domain.bounds
        if not jumps.times:
            return np.zeros((0, len(bounds)))
        affordable = _affordable(self.slabs)
        count = min(CHECK.jump_candidates, max(CANDIDATES, affordable))
        anywhere = self._points(self.generator.random((count, len(bounds))))
        climb = replace(
            _TO_KINKS, tries=min(max(affordable // CHECK.jump_climbers, 1), _TO_KINKS.tries)
        )
        doubtful, looks = [anywhere[:0]], Counter[int]()
        for before, after in itertools.pairwise(self.slabs):
            kind = jumps.kind_at(before.end)
            if kind is None or looks[kind] == MOST_SLABS:
                continue
            looks[kind] += 1
            rough = kind in jumps.rough_kinds
            error = partial(self._jump_error, kind, before, after)
            points = anywhere if rough else anywhere[:CANDIDATES]
            inside = points_in_elements(after.bases, len(points) // 2, self.generator)
            points = np.concatenate([points, inside])
            errors = error(points)
            # Points from everywhere, and not the worst alone, which may lie at one border.
            wrong = np.flatnonzero(errors > CHECK.jump_error * self.rtol)
            doubtful.append(
                points[wrong[:: max(1, len(wrong) // CHECK.worst_chosen)][: CHECK.worst_chosen]]
            )
            if rough:  # kinks are thin: climb towards them
                best = np.argsort(-errors, kind="stable")[: CHECK.jump_climbers]
                points, errors = climbed(error, points[best], errors[best], bounds, climb)
            worst = np.argsort(-errors, kind="stable")[: CHECK.worst_chosen]
            doubtful.append(points[worst[errors[worst] > CHECK.jump_error * self.rtol]])
        return np.concatenate(doubtful)

    def _jump_error(self, kind: int, before: SlabTrain, after: SlabTrain, points: Array) -> Array:
        """Largest error of a state after a jump, in units of the sizes, at points (m, d): (m,)."""
        system, time = self.reference_set.system, np.array([before.end])
        charge(function_cost(system.jumps.jumped, system.user_functions)(len(points)))
        start, end = (
            slab.on_grid(time, contraction)[:, :, 0]
            for slab, contraction in with_contractions([before, after], points)
        )
        with np.errstate(all="ignore"):
            errors = np.abs(end - system.jumps.jumped(kind, start, points.T))
        largest = (errors / self.reference_set.states[:, None]).max(axis=0)
        return np.asarray(np.nan_to_num(largest, nan=np.inf))


def _affordable(slabs: Sequence[SlabTrain]) -> int:
    """Points at which trains can be evaluated within the work allowed."""
    work = max(sum(core.size for core in slab.cores[1:]) for slab in slabs)
    return int(CHECK.residual_work / max(work, 1))
