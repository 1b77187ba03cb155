"""Where the residual of the equations says that a solution is worse than measured.

Trajectories at a few random points do not see what is narrow. The residual u' - f(t, p, u) costs a
microsecond a point instead of a trajectory; it is no error, but at the same time it is about as
large in proportion to the error at other points as where the error is known.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rankone.discretization import Basis1D
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost
from rankone.tensors.slab import SlabTrain
from rankone.verification.measure import ReferenceSet
from rankone.verification.search import Climb, climbed

__all__ = ["doubtful_points"]

_LOOKED, _SLABS, _CHOSEN = 512, 4, 8
"""Points looked at, on how many slabs at most, and how many of them are taken."""
_FEW, _MORE, _WORK = 3, 5, 3e7
"""Beyond so many parameters there are up to so many times the points, as far as so many
multiplications go, a fifth of them near the corners."""
_NEAR = 1.0 / 3.0
"""Power of the distance from the centre that draws points towards the corners."""
_RARE = 5.0
"""Those are taken where the error is expected to be so many times the tolerance."""
_TIMES = np.array([0.21, 0.64, 0.97])
"""In slab lengths."""
_NOISE = 1e-3
"""Errors below this part of the tolerance count as so large, and residuals below it, in sizes over
the length of the slab, as well."""
_EXPECTED = 1.5
"""Error expected, over the tolerance, from which a point is doubtful: on smooth problems expected
errors reach 1.4 and are overestimates, where something was missed 3 and more."""
_LOOKED_AT_JUMPS, _WRONG_AFTER = 16_384, 3.0
"""Points looked at where a jump is no polynomial of the states, and the error there, over the
tolerance, that is doubtful."""
_CLIMBERS = 64
"""Points with the largest errors after a jump, from which larger ones are looked for."""
_TO_KINKS = Climb(rounds=8, tries=8, first_step=0.1, shrinkage=0.4)
"""The way to them: the last steps are as short as the kinks that a solution may miss are thin."""
_KNOWN = 64
"""Most trajectories of the reference whose residuals are looked at."""


def doubtful_points(
    reference_set: ReferenceSet, slabs: Sequence[SlabTrain], share: float, rtol: float, number: int
) -> Array | None:
    """Points (m, d) where the error is expected to be above the tolerance; None if there are none.

    Parameters
    ----------
    reference_set : ReferenceSet
    slabs : sequence of SlabTrain
    share : float
        Measured error over the tolerance.
    rtol : float
    number : int
        That of the attempt: each has points of its own.
    """
    domain = reference_set.domain
    if not domain.box or not slabs or not reference_set.checked:
        return None
    lower, upper = domain.bounds.T
    generator = np.random.default_rng((20141, number + 1))
    work = sum(core.size for core in slabs[-1].cores[1:])
    unit, tolerated = _candidates(lower.size, int(_WORK / max(work, 1)), generator)
    if reference_set.whole_box:
        tolerated = np.ones(len(unit))
    candidates = lower + (upper - lower) * unit
    known = np.delete(reference_set.reference.points, np.s_[1 : 1 + reference_set.corners], axis=0)[
        -_KNOWN:
    ]
    points = np.concatenate([known, candidates])
    ratios = np.zeros(len(candidates))
    carry, last = np.zeros((0, 0)), None
    for i in sorted({round(i) for i in np.linspace(0, len(slabs) - 1, _SLABS)}):
        slab = slabs[i]
        if last is None or not slab.shares_parameters(last):
            carry, last = slab.over_parameters(points.T), slab
        sizes = _residuals(reference_set, slab, points, carry)
        floor = _NOISE * rtol / (slab.end - slab.start)
        largest = np.maximum(sizes[:, : len(known)].max(axis=1, keepdims=True), floor)
        ratios = np.maximum(ratios, (sizes[:, len(known) :] / largest).max(axis=0))
    ratios = np.where(np.isfinite(ratios), ratios, np.inf) / tolerated
    worst = np.argsort(-ratios, kind="stable")[:_CHOSEN]
    doubtful = candidates[worst[ratios[worst] * max(share, _NOISE) > _EXPECTED]]
    doubtful = np.concatenate([doubtful, _at_jumps(reference_set, slabs, rtol, generator)])
    return doubtful if len(doubtful) else None


def _at_jumps(
    reference_set: ReferenceSet,
    slabs: Sequence[SlabTrain],
    rtol: float,
    generator: np.random.Generator,
) -> Array:
    """Points (m, d) where the states after a jump are not what it makes of those before it."""
    system, (lower, upper) = reference_set.system, reference_set.domain.bounds.T
    rough = system.jumps.rough_kinds
    units = reference_set.states[:, None]
    work = max(sum(core.size for core in slab.cores[1:]) for slab in slabs)
    affordable = int(_WORK / max(work, 1))
    count = min(_LOOKED_AT_JUMPS, max(_LOOKED, affordable))
    points = lower + (upper - lower) * generator.random((count, lower.size))
    found, known = [points[:0]], dict.fromkeys(range(len(slabs)), 0)
    for before, after in itertools.pairwise(slabs):
        kind = system.jumps.kind_at(before.end)
        if kind is None or known[kind] == _SLABS:
            continue
        known[kind] += 1

        def missed(
            some: Array, kind: int = kind, sides: tuple[SlabTrain, ...] = (before, after)
        ) -> Array:
            charge(function_cost(system.jumps.jumped, system.user_functions)(len(some)))
            carry = sides[0].over_parameters(some.T)
            time = np.array([sides[0].end])
            start = sides[0].on_grid(time, carry)[:, :, 0]
            if not sides[1].shares_parameters(sides[0]):
                carry = sides[1].over_parameters(some.T)
            end = sides[1].on_grid(time, carry)[:, :, 0]
            with np.errstate(all="ignore"):
                errors = np.abs(end - system.jumps.jumped(kind, start, some.T)) / units
            return np.asarray(np.nan_to_num(errors.max(axis=0), nan=np.inf))

        some = points if kind in rough else points[:_LOOKED]
        some = np.concatenate([some, _in_elements(after.bases, len(some) // 2, generator)])
        errors = missed(some)
        # Points from everywhere, and not the worst alone, which may lie at one border.
        wrong = np.flatnonzero(errors > _WRONG_AFTER * rtol)
        every = max(1, len(wrong) // _CHOSEN)
        found.append(some[wrong[::every][:_CHOSEN]])
        if kind in rough:  # kinks are thin: climb towards them
            best = np.argsort(-errors, kind="stable")[:_CLIMBERS]
            tries = min(max(affordable // _CLIMBERS, 1), _TO_KINKS.tries)
            climb = replace(_TO_KINKS, tries=tries)
            some, errors = climbed(
                missed, some[best], errors[best], reference_set.domain.bounds, climb
            )
        worst = np.argsort(-errors, kind="stable")[:_CHOSEN]
        found.append(some[worst[errors[worst] > _WRONG_AFTER * rtol]])
    return np.concatenate(found)


def _in_elements(bases: Sequence[Basis1D], count: int, generator: np.random.Generator) -> Array:
    """Random points (count, d) in elements that are all as likely: narrow ones are somewhere."""
    columns = []
    for basis in bases:
        number = generator.integers(0, basis.elements, count)
        lower, upper = basis.edges[number], basis.edges[number + 1]
        columns.append(lower + (upper - lower) * generator.random(count))
    return np.stack(columns, axis=1)


def _candidates(d: int, most: int, generator: np.random.Generator) -> tuple[Array, Array]:
    """Points (m, d) of the unit cube, and by how much errors there may be larger, (m,)."""
    if d <= _FEW:
        return generator.random((_LOOKED, d)), np.ones(_LOOKED)
    points = generator.random((min(max(most, _LOOKED), _MORE * _LOOKED), d))
    near = np.arange(len(points)) % _MORE == 0
    offset = 2.0 * points[near] - 1.0
    points[near] = 0.5 + 0.5 * np.sign(offset) * np.abs(offset) ** _NEAR
    return points, np.where(near, _RARE, 1.0)


def _residuals(reference_set: ReferenceSet, slab: SlabTrain, points: Array, carry: Array) -> Array:
    """Largest residual of a state, in units of the sizes, at each time and point: (T, m)."""
    times = slab.start + (slab.end - slab.start) * _TIMES
    values, rates = slab.on_grid(times, carry), slab.derivative().on_grid(times, carry)
    units = reference_set.states[:, None]
    system = reference_set.system
    cost_of_rates = function_cost(system.rhs, system.user_functions)
    charge(len(times) * (cost_of_rates(len(points)) + 2.0 * values[:, :, 0].size))
    with np.errstate(all="ignore"):
        found = [
            np.abs(rates[:, :, j] - reference_set.system.rhs(time, values[:, :, j], points.T))
            / units
            for j, time in enumerate(times)
        ]
    return np.stack([np.nan_to_num(each.max(axis=0), nan=np.inf) for each in found])
