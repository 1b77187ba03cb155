"""Which parameters, and which combinations of them, the data identify, by profile likelihoods.

A profile shows how the least cost grows as one parameter is held away from its best value (Venzon &
Moolgavkar, "A method for computing profile-likelihood-based confidence intervals", 1988). The box
counts as what is known beforehand: in the covariance each parameter has the variance 1/12 of a
uniform one before the data add theirs. A parameter whose variance the box decides, and whose
profile interval ends only at the box, is not identified (Raue et al., "Structural and practical
identifiability analysis", 2009). Identified combinations of such parameters get names: the row
space of the Jacobian with respect to their logarithms holds the powers of an identified product,
such as (1, -1) for C_D/m.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.least_squares import minima
from rankone.inference.estimation.likelihood import LevelUncertainty, Likelihood
from rankone.support.arrays import (
    COARSE,
    COINCIDENT,
    HALVINGS,
    MINOR,
    NEGLIGIBLE,
    RESOLVED,
    SAME,
    TINY,
    Array,
)

# Points of a profile, in shares of the way to the bound: closer where it begins
_PATH_SHARES = np.array([0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0])
# Points of a profile in standard deviations: around the ends of usual intervals
_PATH_DEVIATIONS = np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0])
MOST_REFINEMENTS = 12
"""Most refinements of an end: a bound on the work where the rise is not smooth."""


@dataclass(frozen=True)
class IdentificationTuning:
    """Tuning of profiles, and of what counts as identified."""

    end_tolerance: float = 1e-4
    """How close an end comes to the limit, in shares of its root: four digits."""
    suspicious_width: float = 0.25
    """Length in widths of the box above which an interval that the box ends says nothing, and half
    of one by the data alone, linearised, above which its profile is looked at."""
    lost: float = COARSE
    """Share of the data in a variance below which they say nothing of a direction."""
    fraction_tolerance: float = 0.04
    """How far a power may be from a simple fraction: half of the way from 1/4 to 1/3."""
    largest_denominator: int = 4
    """Largest denominator of a simple fraction."""
    used_change: float = 0.5
    """Change of the residuals from one end of the cube to the other, in standard deviations, above
    which a direction is fitted to the data."""
    path_rise: float = 0.25
    """Share of the limit up to which a profile is along the flat direction."""
    named_variation: float = MINOR
    """Variation of a combination along a path above which it is not identified."""
    constant_variation: float = 0.02
    """Variation of a product along a path, in shares of the variation of its factors, below which
    it counts as constant."""
    steps: int = 40
    """Steps along an interval."""
    jump: float = 0.3
    """Change of a prediction in one step, beyond what its derivative says, that is a jump: in
    standard deviations of the datum."""


TUNING = IdentificationTuning()

UNIFORM_PRECISION = 12.0
"""Precision of a parameter that may be anywhere in the unit cube, without data."""
BOX_SHARE = 0.5
"""Share of a variance from the box above which the data do not determine it."""


class Stop(Enum):
    """What stops an interval."""

    DATA = "the data"
    BOUND = "the bound of the parameter"
    OTHER = "the bound of another parameter"


@dataclass(frozen=True)
class End:
    """One end of an interval: its place in z, and what stops it there."""

    z: float
    stop: Stop


@dataclass(frozen=True)
class Best:
    """The best point z (n,), its cost, and a root (n, r) of its covariance to start with."""

    z: Array
    cost: float
    root: Array


Paths = dict[tuple[int, float], tuple[Array, Array]]
"""By parameter and direction, -1 or 1: best points (k, n) outwards, and rises of their costs."""


@dataclass(frozen=True)
class Profile:
    """The profile of one parameter.

    ``path`` (k, n) are the best points for values of the parameter, ascending, and ``rise`` (k,)
    their costs above the least cost. The ends ``lower`` and ``upper`` of the interval are where the
    rise reaches the limit or the box ends.
    """

    index: int
    path: Array
    rise: Array
    lower: End
    upper: End

    @property
    def limited(self) -> str:
        """Which ends are bounds of the parameter: ``""``, ``"lower"``, ``"upper"``, ``"both"``."""
        ends = {"lower": self.lower, "upper": self.upper}
        sides = [side for side, end in ends.items() if end.stop is Stop.BOUND]
        return "both" if len(sides) == 2 else "".join(sides)

    @property
    def width(self) -> float:
        """Length of the interval in z."""
        return self.upper.z - self.lower.z

    @property
    def boxed(self) -> bool:
        """Whether the data stop neither end."""
        return Stop.DATA not in (self.lower.stop, self.upper.stop)


def profiles(
    problem: Likelihood,
    best: Best,
    limits: Mapping[int, float],
    held: Sequence[int] = (),
    paths: Paths | None = None,
) -> dict[int, Profile]:
    """The profiles of some parameters, by position, each up to a rise of the cost by its limit.

    Parameters that are ``held`` stay where they are at the best point. ``paths`` are those that are
    ready for the same best point, and take up the others: they are the same for all limits.
    """
    paths = {} if paths is None else paths
    missing = [index for index in limits if (index, -1.0) not in paths]
    if missing:
        paths.update(_paths(problem, best, missing, held))
    branches = [
        _Branch(index, limit, *paths[index, sign])
        for index, limit in limits.items()
        for sign in (-1.0, 1.0)
    ]
    _refine(problem, best, branches, held)
    curves = {}
    for low, high in zip(branches[::2], branches[1::2], strict=True):
        path = np.vstack([low.path[:0:-1], high.path])
        rise = np.concatenate([low.rise[:0:-1], high.rise])
        curves[low.index] = Profile(low.index, path, rise, low.end(), high.end())
    return curves


def _paths(problem: Likelihood, best: Best, indices: Sequence[int], held: Sequence[int]) -> Paths:
    """Best points from the best of all to both bounds of each parameter."""
    directions = [(index, sign) for index in indices for sign in (-1.0, 1.0)]
    places = [_places(best, index, sign) for index, sign in directions]
    rows = np.concatenate([np.full(len(z), k) for k, z in enumerate(places)])
    columns = np.array([directions[k][0] for k in rows])
    starts = _line(best, columns, np.concatenate(places), held)
    points, costs = _along(problem, columns, starts, held)
    paths = {}
    for k, direction in enumerate(directions):
        here = rows == k
        rise = np.concatenate([[0.0], np.maximum(costs[here] - best.cost, 0.0)])
        paths[direction] = np.vstack([best.z, points[here]]), rise
    return paths


@dataclass
class _Branch:
    """A profile from the best point in one direction: points (k, n) in order, and rises (k,)."""

    index: int
    limit: float
    path: Array
    rise: Array

    def above(self) -> int:
        """Index of the first point above the limit; the number of points if all are below."""
        higher = np.flatnonzero(self.rise > self.limit)
        return int(higher[0]) if higher.size else len(self.rise)

    def insert(self, at: int, point: Array, rise: float) -> None:
        self.path = np.insert(self.path, at, point, axis=0)
        self.rise = np.insert(self.rise, at, rise)

    def settled(self) -> bool:
        k = self.above()
        if k == len(self.rise):
            return True
        near = abs(np.sqrt(self.rise[[k - 1, k]] / self.limit) - 1.0).min() <= TUNING.end_tolerance
        z = self.path[[k - 1, k], self.index]
        return bool(near or abs(z[1] - z[0]) <= COINCIDENT)

    def between(self, turn: int) -> float:
        """A place between the points below and above."""
        k = self.above()
        roots = np.sqrt(self.rise[[k - 1, k]] / self.limit)
        inside, beyond = zip(self.path[[k - 1, k], self.index], roots, strict=True)
        return between(inside, beyond, turn)

    def end(self) -> End:
        k = self.above()
        if k == len(self.rise):
            return End(float(self.path[-1, self.index]), Stop.BOUND)
        pair = np.sqrt(self.rise[[k - 1, k]])
        share = float((np.sqrt(self.limit) - pair[0]) / (pair[1] - pair[0]))
        z = self.path[k - 1] + share * (self.path[k] - self.path[k - 1])
        free = np.delete(self.path[k], self.index)
        at_bound = (free <= NEGLIGIBLE) | (free >= 1.0 - NEGLIGIBLE)
        return End(float(z[self.index]), Stop.OTHER if at_bound.any() else Stop.DATA)


def between(inside: tuple[float, float], beyond: tuple[float, float], turn: int) -> float:
    """Where to look for the limit, between a place inside of it and one beyond.

    Beside each place is the root of its rise over the limit. It is by their secant, or halfway in
    each fourth turn, and where no curve reaches the data beyond.
    """
    (a, f), (b, g) = inside, beyond
    share = 0.5 if turn % 4 == 3 or not f < g < np.inf else (1.0 - f) / (g - f)
    return float(a + min(max(share, 0.02), 0.98) * (b - a))


def _refine(problem: Likelihood, best: Best, branches: list[_Branch], held: Sequence[int]) -> None:
    """Refine where the rise reaches the limit, on all branches at once."""
    for turn in range(MOST_REFINEMENTS):
        waiting = [branch for branch in branches if not branch.settled()]
        if not waiting:
            return
        places = np.array([branch.between(turn) for branch in waiting])
        columns = np.array([branch.index for branch in waiting])
        starts = np.array([branch.path[branch.above() - 1] for branch in waiting])
        starts[np.arange(len(waiting)), columns] = places
        points, costs = _along(problem, columns, starts, held)
        for branch, point, cost in zip(waiting, points, costs, strict=True):
            branch.insert(branch.above(), point, max(float(cost) - best.cost, 0.0))


def _places(best: Best, index: int, sign: float) -> Array:
    """Places at which a parameter is held, from the best one outwards to its bound."""
    z = best.z[index]
    way = z if sign < 0.0 else 1.0 - z
    deviation = np.linalg.norm(best.root[index])
    steps = np.concatenate([_PATH_SHARES * way, _PATH_DEVIATIONS * deviation])
    steps = np.unique(steps[(steps > COINCIDENT) & (steps <= way)])
    return np.asarray(np.clip(z + sign * steps, 0.0, 1.0))


def _line(best: Best, columns: Array, places: Array, held: Sequence[int]) -> Array:
    """Points (K, n) with one coordinate of each at a place, the others where a linear model leads.

    Parameters that are ``held`` do not move.
    """
    covariance = best.root @ best.root.T
    ways = covariance[columns] / np.maximum(np.diag(covariance)[columns], TINY)[:, None]
    ways[:, list(held)] = 0.0
    points = np.clip(best.z + (places - best.z[columns])[:, None] * ways, 0.0, 1.0)
    points[np.arange(len(places)), columns] = places
    return np.asarray(points)


def _along(
    problem: Likelihood, columns: Array, starts: Array, held: Sequence[int]
) -> tuple[Array, Array]:
    """Best points (K, n) and costs (K,) with one more coordinate of each start (K, n) held."""
    kept = np.zeros(starts.shape, dtype=bool)
    kept[np.arange(len(starts)), columns] = True
    kept[:, list(held)] = True
    ends = minima(problem, starts, kept)
    return ends.z, ends.cost


# --- identification ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Identification:
    """What the data identify of n parameters.

    ``flat`` are the positions of parameters that are not identified. ``root`` (n, n) is a root of
    the covariance in z that the data have together with the box, whose precision is ``box`` (n,).
    ``seen`` (n, r) is one by the data alone, and ``lost`` (n, n - r) one with the box in the
    directions of which the data say nothing. ``combinations`` of the flat parameters are
    identified. ``profiles`` are those that were computed to find this out.
    """

    flat: tuple[int, ...]
    root: Array
    box: Array
    seen: Array
    lost: Array
    combinations: tuple[str, ...] = ()
    profiles: Mapping[int, Profile] = field(default_factory=dict)

    def enlarged(self, levels: LevelUncertainty) -> Identification:
        """The same with what estimated levels of noise add."""
        return replace(self, root=levels.enlarged(self.root), seen=levels.enlarged(self.seen))

    def deviation(self, slope: Array) -> float:
        """The standard deviation of a quantity with derivatives (n,), by the data alone."""
        seen, lost = (float(np.linalg.norm(slope @ root)) for root in (self.seen, self.lost))
        return np.inf if lost**2 > TUNING.lost * seen**2 else seen

    def boxed(self, slope: Array) -> bool:
        """Whether the box decides how sure a quantity with derivatives (n,) is.

        Its variance is g'Cg, and the precision P of the box has the share g'CPCg / g'Cg in it.
        """
        along = self.root.T @ slope
        by_box = float(self.box @ (self.root @ along) ** 2)
        return by_box > BOX_SHARE * float(along @ along)


def degrees_of_freedom(problem: Likelihood, cost: float, jacobian: Array) -> float:
    """The data minus the directions fitted to them, at a minimum with Jacobian (r, n).

    What priors say of a direction is not fitted: it counts by the leverages of the data, as in
    Spiegelhalter et al., "Bayesian measures of model complexity and fit" (2002), for linear models.
    Levels of noise do not count.
    """
    moving = [j for j in range(len(problem.free.names)) if j not in problem.levels]
    if not moving:
        return float(problem.size)
    unit = 1.0
    if not problem.unit_known:
        unit = float(np.sqrt(cost / max(problem.size - len(moving), 1)))
    left, singular, _ = np.linalg.svd(jacobian[:, moving], full_matrices=False)
    used = left[:, singular > max(TUNING.used_change * unit, RESOLVED * singular[0])]
    by_priors = float(np.sum(used[len(used) - len(problem.priors) :] ** 2))
    return float(problem.size - used.shape[1] + by_priors)


def identify(
    problem: Likelihood, best: Best, jacobian: Array, quantile: float, sigma: float
) -> Identification:
    """What is identified at the best point for levels of noise, with the Jacobian (m, n) there.

    ``quantile`` is half the length of intervals in standard deviations, ``sigma`` the standard
    deviation of the scaled residuals.
    """
    free, box = problem.free, np.full(best.z.size, UNIFORM_PRECISION)
    box[list(free.endless)] = NEGLIGIBLE
    rows = jacobian[len(jacobian) - len(problem.priors) :]
    for measure, row in zip(problem.priors, rows, strict=True):
        j = free.names.index(measure.name)
        box[j] = max(UNIFORM_PRECISION - row[j] ** 2, 0.0)
    rounding = COINCIDENT * max(float(np.linalg.norm(jacobian)), TINY)
    sigma = max(sigma, rounding)
    rows = np.concatenate([jacobian / sigma, np.diag(np.sqrt(box))])
    _, singular, right = np.linalg.svd(rows, full_matrices=False)
    root = right.T / np.maximum(singular, rounding / sigma)
    shares, turned = np.linalg.eigh(root.T @ (box[:, None] * root))
    lost = shares > 1.0 - TUNING.lost
    by_data = root @ turned[:, ~lost] / np.sqrt(1.0 - shares[~lost])
    plain = Identification((), root, box, by_data, root @ turned[:, lost])
    unit = np.eye(best.z.size)
    half = quantile * np.array([plain.deviation(slope) for slope in unit])
    limit = max((quantile * sigma) ** 2, COINCIDENT * best.cost)
    uncertain = [
        j
        for j in np.flatnonzero(half > TUNING.suspicious_width).tolist()
        if j not in problem.levels
    ]
    curves = profiles(
        problem, replace(best, root=root), dict.fromkeys(uncertain, limit), problem.levels
    )
    plain = replace(plain, profiles=curves)
    long = [
        p for p in curves.values() if p.width > TUNING.suspicious_width or p.index in free.endless
    ]
    boxed = [p for p in long if p.boxed and plain.boxed(unit[p.index])]
    if not boxed:
        return plain
    flat = tuple(p.index for p in boxed)
    q = max(int(np.count_nonzero(shares > BOX_SHARE)), 1)
    names = _combinations(problem, best.z, jacobian, flat, q, boxed, limit)
    return replace(plain, flat=flat, combinations=names)


def _combinations(
    problem: Likelihood,
    z: Array,
    jacobian: Array,
    flat: Sequence[int],
    q: int,
    boxed: Sequence[Profile],
    limit: float,
) -> tuple[str, ...]:
    """Texts of the combinations of flat parameters that are constant along flat directions."""
    names = [problem.free.names[i] for i in flat]
    inside = [p.path[p.rise <= TUNING.path_rise * limit] for p in boxed]
    paths = [problem.free.values(points)[:, list(flat)] for points in inside]
    slopes = jacobian / problem.free.slopes(z)
    linear = _reduced(slopes, flat, q)
    if not len(linear):
        return ()
    in_sums = _variation(paths, linear)
    powers = _reduced(slopes * problem.free.values(z), flat, q)
    in_factors = (powers != 0.0).any(axis=0)
    signs = np.sign(np.vstack(paths)[:, in_factors])
    if (signs == signs[:1]).all() and signs.all():
        logarithms = [np.log(np.where(in_factors, np.abs(path), 1.0)) for path in paths]
        in_powers = _variation(logarithms, powers)
        if in_powers <= max(TUNING.constant_variation, min(in_sums, TUNING.named_variation)):
            return tuple(_product(names, row) for row in powers)
    return tuple(_sum(names, row) for row in linear) if in_sums <= TUNING.named_variation else ()


def _reduced(jacobian: Array, flat: Sequence[int], q: int) -> Array:
    """Rows over the flat parameters that are orthogonal to the q flattest directions."""
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, _, right = np.linalg.svd(np.linalg.qr(jacobian / scale, mode="r"))
    _, singular, rows = np.linalg.svd(right[-q:, list(flat)])
    rank = int(np.count_nonzero(singular > SAME * singular[0]))
    rows = rows[rank:] * scale[list(flat)]
    for k in range(len(rows)):  # reduced row echelon form: few parameters in each row
        pivot = int(np.argmax(np.abs(rows[k])))
        rows[k] /= rows[k, pivot]
        for i in range(len(rows)):
            if i != k:
                rows[i] -= rows[i, pivot] * rows[k]
    rows[np.abs(rows) < TUNING.fraction_tolerance] = 0.0
    return rows


def _variation(paths: Sequence[Array], rows: Array) -> float:
    """Largest variation of a combination along any path, over the largest of its terms."""
    whole = np.max([np.ptp(path @ rows.T, axis=0) for path in paths], axis=0)
    terms = np.max([np.abs(rows) @ np.ptp(path, axis=0) for path in paths], axis=0)
    return float(np.max(whole / np.maximum(terms, TINY)))


def _scaled(row: Array) -> list[tuple[int, str]]:
    """Sign and text of each number, as simple fractions if they all are; the first is positive."""
    used = row[row != 0.0]
    row = row * np.sign(used[0]) / np.abs(used).max()
    for scale in (np.abs(used).max() / np.abs(used).min(), 1.0):
        near = [
            Fraction(float(v * scale)).limit_denominator(TUNING.largest_denominator) for v in row
        ]
        pairs = zip(near, row * scale, strict=True)
        if all(abs(float(simple) - v) <= TUNING.fraction_tolerance * abs(v) for simple, v in pairs):
            texts = [f"{abs(v)}" if v.denominator == 1 else f"({abs(v)})" for v in near]
            return [((v > 0) - (v < 0), text) for v, text in zip(near, texts, strict=True)]
    return [(int(np.sign(v)), f"{abs(v):.3g}") for v in row]


def _product(names: Sequence[str], row: Array) -> str:
    """Powers as text, such as ``C_D/m``."""
    sides: dict[int, list[str]] = {1: [], -1: []}
    for name, (sign, power) in zip(names, _scaled(row), strict=True):
        if sign:
            sides[sign].append(name if power == "1" else f"{name}**{power}")
    top, below = "*".join(sides[1]), sides[-1]
    if not below:
        return top
    return f"{top}/{below[0]}" if len(below) == 1 else f"{top}/({'*'.join(below)})"


def _sum(names: Sequence[str], row: Array) -> str:
    """Coefficients as text, such as ``a + 2*b``."""
    text = ""
    for name, (sign, factor) in zip(names, _scaled(row), strict=True):
        if sign:
            joined = (" + " if sign > 0 else " - ") if text else ""
            text += joined + (name if factor == "1" else f"{factor}*{name}")
    return text


# -----------------------------------------------------------------------------
# Where predictions jump inside the intervals of a fit: an event passes a time of the data.


class Jump(NamedTuple):
    """A parameter, and the time of the data at which a prediction jumps in its interval."""

    parameter: str
    time: float


def jumps_within(problem: Likelihood, z: Array, root: Array, jacobian: Array) -> tuple[Jump, ...]:
    """The first jump along the interval of each parameter.

    ``root`` (n, r) is a root of the covariance in z times half the length of intervals in standard
    deviations, ``jacobian`` (r, n) that of the pseudo-residuals. Only events make jumps.
    """
    if all(trial.solution.outcome.timeline is None for trial in problem.trials):
        return ()
    rows = np.concatenate([np.arange(here.start, here.stop) for _, _, here in problem.blocks])
    times = np.concatenate([t.observations.times for t in problem.trials])
    jumps = []
    for j, name in enumerate(problem.free.names):
        length = float(np.linalg.norm(root[j]))
        if not 0.0 < length < np.inf:
            continue
        way = root @ root[j] / length
        line = np.clip(z + np.linspace(-1.0, 1.0, TUNING.steps + 1)[:, None] * way, 0.0, 1.0)
        change = np.abs(np.diff(problem.standardised(line), axis=0))
        expected = np.abs(jacobian[rows] @ np.diff(line, axis=0).T).T
        steep = np.nan_to_num(change - expected, nan=0.0)
        data = np.flatnonzero(steep.max(axis=0) > TUNING.jump)
        if not data.size:
            continue
        steps = np.argmax(steep[:, data], axis=0)
        sizes = _sizes(problem, line[steps], line[steps + 1], data)
        if sizes.max() > TUNING.jump:
            jumps.append(Jump(name, float(times[data[int(np.argmax(sizes))]])))
    return tuple(jumps)


def _sizes(problem: Likelihood, a: Array, b: Array, data: NDArray[np.intp]) -> Array:
    """How far predictions of some ``data`` (k,) jump on steps from a to b (k, n).

    Each step is halved where the prediction changes most: what is smooth does not change in the
    end.
    """
    at_a, at_b = (_of_data(problem, each, data) for each in (a, b))
    for _ in range(HALVINGS):
        middle = 0.5 * (a + b)
        at = _of_data(problem, middle, data)
        first = np.abs(at - at_a) >= np.abs(at_b - at)
        a, b = np.where(first[:, None], a, middle), np.where(first[:, None], middle, b)
        at_a, at_b = np.where(first, at_a, at), np.where(first, at, at_b)
    return np.nan_to_num(np.abs(at_b - at_a))


def _of_data(problem: Likelihood, points: Array, data: NDArray[np.intp]) -> Array:
    """The deviation (k,) of one datum at each of the points (k, n)."""
    return np.asarray(problem.standardised(points)[np.arange(data.size), data])
