"""Where points of a box lie, at which a solution is checked, and the search for worse ones.

Even points over (1e-6, 1) have one in ten thousand below 1e-4, so what happens there is never seen.
Half of the points of an interval over decades are even in the logarithm, half in the parameter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.request import Domain, SolveRequest
from rankone.solvers.tuning import CHECK
from rankone.support.arrays import MINOR, TINY, Array, bisected, corners, spread
from rankone.tensors import Basis1D
from rankone.tensors.coordinates import IDENTITY, Interval, Logarithm, Scale, on_scale
from rankone.tensors.slab import SlabTrain, sharing
from rankone.trajectories.system.system import System

_LOGARITHM = Logarithm()


@dataclass(frozen=True)
class Coverage:
    """The coordinates of a box in which its points are spread.

    ``scales`` has one for each interval; on the intervals that are ``mixed``, half of the points
    are even on it, and half in the parameter.
    """

    box: tuple[Interval, ...]
    scales: tuple[Scale, ...]
    mixed: tuple[bool, ...]

    @classmethod
    def of_box(cls, box: Array, scales: Sequence[Scale] = ()) -> Coverage:
        """For a box (d, 2): on the scales that were asked for, else by the ratios of its ends."""
        intervals = tuple((float(lower), float(upper)) for lower, upper in box)
        asked = scales or (IDENTITY,) * len(intervals)
        pairs = list(zip(intervals, asked, strict=True))
        mixed = tuple(scale.is_identity and _spans_decades(ends) for ends, scale in pairs)
        natural = tuple(
            _LOGARITHM if mix else scale for mix, (_, scale) in zip(mixed, pairs, strict=True)
        )
        return cls(intervals, natural, mixed)

    @classmethod
    def of_domain(cls, domain: Domain) -> Coverage:
        return cls.of_box(domain.bounds, domain.coordinates)

    @classmethod
    def of_bases(cls, bases: Sequence[Basis1D]) -> Coverage:
        """For the box of a solution: half of the points are even on the scales of its bases."""
        intervals = tuple((float(basis.lower), float(basis.upper)) for basis in bases)
        plain = cls.of_box(np.array(intervals).reshape(-1, 2))
        pairs = list(zip(bases, plain.scales, strict=True))
        scales = tuple(other if b.scale.is_identity else b.scale for b, other in pairs)
        return cls(intervals, scales, tuple(not scale.is_identity for scale in scales))

    def points(self, shares: Array) -> Array:
        """Points (m, d) at shares (m, d) in [0, 1] of the coordinates."""
        bounds = np.array(self.box).reshape(-1, 2)
        lower, width = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
        points = np.asarray(lower + width * shares)
        for j, (interval, scale) in enumerate(zip(self.box, self.scales, strict=True)):
            if self.mixed[j]:
                points[:, j] = np.interp(shares[:, j], *_mixture(interval, scale))
            elif not scale.is_identity:
                points[:, j] = on_scale(scale, interval, shares[:, j])
        return points

    def line(self, j: int, count: int) -> Array:
        """Points (count,) of one interval, evenly spaced in its coordinate, ends included."""
        if not self.mixed[j] and self.scales[j].is_identity:
            return np.linspace(*self.box[j], count)
        shares = np.linspace(0.0, 1.0, count)
        return self.points(np.broadcast_to(shares[:, None], (count, len(self.box))))[:, j]

    def steps(self, points: Array, share: float) -> Array:
        """Lengths (m, d) of steps at points (m, d) that are a share of each coordinate."""
        bounds = np.array(self.box).reshape(-1, 2)
        steps = np.broadcast_to(share * (bounds[:, 1] - bounds[:, 0]), points.shape)
        if all(scale.is_identity for scale in self.scales):
            return steps
        steps = steps.copy()
        for j, (interval, scale) in enumerate(zip(self.box, self.scales, strict=True)):
            if not scale.is_identity:
                first, last = scale.to_scale(np.array(interval))
                steps[:, j] = share * (last - first) / scale.slope(points[:, j])
        return np.asarray(steps)


def _spans_decades(interval: Interval) -> bool:
    lower, upper = interval
    return lower > 0.0 and upper > CHECK.mixed_ratio * lower


@lru_cache(maxsize=64)
def _mixture(interval: Interval, scale: Scale) -> tuple[Array, Array]:
    """Shares of the points below knots, half of them even on a scale, and the knots."""
    lower, upper = interval
    even = np.linspace(0.0, 1.0, CHECK.coverage_knots)
    knots = np.union1d(
        np.linspace(lower, upper, CHECK.coverage_knots), on_scale(scale, interval, even)
    )
    places = scale.to_scale(knots)
    shares = 0.5 * (knots - lower) / (upper - lower)
    shares += 0.5 * (places - places[0]) / (places[-1] - places[0])
    shares[-1] = 1.0
    return shares, knots


# -----------------------------------------------------------------------------
# Points of the box at which a solution is checked, and the search for worse ones.


@dataclass(frozen=True)
class Climb:
    """Rounds of random steps that become shorter, with ``tries`` steps for each climber.

    ``first_step`` is their first standard deviation, in widths of the box, and ``shrinkage`` the
    factor on it from round to round; a ``patient`` climber applies it only without success.
    """

    rounds: int
    tries: int
    first_step: float
    shrinkage: float
    patient: bool = False
    seed: int = 20147


def climbed(
    height: Callable[[Array], Array], points: Array, heights: Array, bounds: Array, climb: Climb
) -> tuple[Array, Array]:
    """Points (m, d) of a box (d, 2) to which climbers come from given ones, and the heights there.

    ``height`` maps points (N, d) to heights (N,), none of them NaN.
    """
    lower, upper = bounds.T
    generator = np.random.default_rng(climb.seed)
    climbers = np.arange(len(points))
    step = np.full((len(points), 1), climb.first_step)
    for _ in range(climb.rounds):
        moves = generator.standard_normal((climb.tries, *points.shape)) * step * (upper - lower)
        moves *= generator.random(moves.shape) < 0.5  # some coordinates stay, such as at an end
        tried = np.clip(points + moves, lower, upper)
        reached = height(tried.reshape(-1, points.shape[1])).reshape(climb.tries, -1)
        best = reached.argmax(axis=0)
        higher = reached[best, climbers] > heights
        points = np.where(higher[:, None], tried[best, climbers], points)
        heights = np.where(higher, reached[best, climbers], heights)
        step = np.where(higher[:, None] & climb.patient, step, climb.shrinkage * step)
    return points, heights


# -----------------------------------------------------------------------------
# Points of the box at which a solution is checked, among them those that random points miss.
#
# Before a solve: the centre, corners, evenly spread points, points beside cuts of the parameters,
# where products of factors are active, on surfaces, and in narrow cells. After it: in narrow
# elements and where the solution is steep.


FEW_PARAMETERS = 3  # Parameters up to which corners are checked as strictly as the interior
CANDIDATES = 512
"""Random points among which worse ones, or surfaces, are looked for."""
FEW_POINTS = 32
"""Points that are taken where nothing tells more."""
# The way there. It finds islands of a few percent of six parameters, and narrow ones of two.
_TO_SURFACE = Climb(rounds=60, tries=32, first_step=0.2, shrinkage=0.6, patient=True, seed=20144)
MOST_SLABS = 4
"""Slabs on which worse points are looked for."""
# Bad points, the worst one first: the others have more than a minor share of its error, and are
# farther from each other than such a share of an interval
_MOST_BAD = 3


def check_points(
    box: Array,
    count: int,
    cuts: Sequence[Sequence[float]] = (),
    every_corner: bool = False,
    scales: Sequence[Scale] = (),
) -> Array:
    """The centre of a box (d, 2), corners, and ``count`` evenly spread interior points: (m, d).

    They are even on the scales, and over decades in the parameter as well as in its logarithm.
    Points on either side of the cuts of each parameter follow. Corners are all, at most 256, or
    eight of them; there are none without interior points.
    """
    rng = np.random.default_rng(20140)
    d = len(box)
    coverage, width = Coverage.of_box(box, scales), box[:, 1] - box[:, 0]
    if d == 0 or count == 0:
        return coverage.points(np.full((1, d), 0.5))
    at_corners = corners(d, CHECK.most_corners if every_corner else CHECK.few_corners, rng)
    unit = np.concatenate([np.full((1, d), 0.5), at_corners, spread(count, d, rng)])
    points = [coverage.points(unit)]
    for j, places in enumerate(cuts):
        for side in (-CHECK.cut_distance, CHECK.cut_distance):
            beside = coverage.points(rng.random((len(places), d)))
            beside[:, j] = places + side * width[j]
            points.append(beside)
    return np.concatenate(points)


def smooth_nodes(rtol: float) -> float:
    """Nodes that resolve a smooth function of a parameter to a tolerance, about."""
    return 4.0 - 1.4 * math.log10(rtol)


def covers_corners(request: SolveRequest) -> bool:
    """Whether errors at corners count: as asked, otherwise with few parameters."""
    cover = request.check.cover
    return len(request.domain.box) <= FEW_PARAMETERS if cover is None else cover == "box"


def branch_points(domain: Domain) -> Array:
    """Points (m, d) that have to be on one branch of steady states."""
    few = len(domain.box) <= FEW_PARAMETERS
    return check_points(domain.bounds, FEW_POINTS, every_corner=few)


def inside_jumps(points: Array, system: System, domain: Domain) -> Array:
    """Points (m, d) moved a little inside where a function jumps at the very end of an interval."""
    moved = points.copy()
    tables = system.features.cuts[1:], system.features.periodic_cuts[1:]
    for j, (cuts, periodic) in enumerate(zip(*tables, strict=True)):
        lower, upper = domain.box[j]
        near = CHECK.cut_distance * (upper - lower)
        distances = [abs(cut - end) for cut in cuts for end in (lower, upper)]
        distances += [
            abs(math.remainder(end - first, period))
            for first, period in periodic
            for end in (lower, upper)
        ]
        if min(distances, default=math.inf) < near:
            moved[:, j] = np.clip(moved[:, j], lower + near, upper - near)
    return moved


def active_points(system: System, domain: Domain) -> Array:
    """Points (m, d) at which separated terms are large that are small in most of the box.

    A product of narrow or steep factors is nearly zero at random points. For the terms that are
    active in the smallest part of the box, (∫|f|)²/∫f² of each factor f, points are drawn in
    proportion to the sizes of their factors.
    """
    d = len(domain.box)
    if not system.separated or d == 0:
        return np.zeros((0, d))
    coverage = Coverage.of_domain(domain)
    grids = [coverage.line(j, CHECK.factor_samples) for j in range(d)]
    sizes = [np.abs(system.parameter_factors(j, grid)) for j, grid in enumerate(grids)]
    active = [np.mean(f, axis=1) ** 2 / np.maximum(np.mean(f**2, axis=1), TINY) for f in sizes]
    products = {rows[1:] for _, _, rows, _ in system.terms}
    products |= {rows for _, _, rows in system.initial_terms}
    shares = {rows: math.prod(p[r] for p, r in zip(active, rows, strict=True)) for rows in products}
    rare = [rows for rows in products if 0.0 < shares[rows] < CHECK.rare_term_share]
    rare = sorted(rare, key=lambda rows: (shares[rows], rows))
    generator = np.random.default_rng(20140)
    rare = rare[: CHECK.most_rare_terms]
    points = [np.zeros((0, d))]
    for rows in rare:
        drawn = np.empty((CHECK.rare_points // len(rare), d))
        for j, row in enumerate(rows):
            sums = np.cumsum(sizes[j][row])
            drawn[:, j] = np.interp(generator.random(len(drawn)), sums / sums[-1], grids[j])
        points.append(drawn)
    return np.concatenate(points)


def surface_points(system: System, domain: Domain) -> Array:
    """Points (m, d) at which functions of several parameters are narrow, kink or switch.

    On lines between random points on either side of such a surface; where all are on one side, the
    point at which the function is least, or largest, and between it and a random point.
    """
    (functions, several), d = _surfaces(system, domain), len(domain.box)
    if functions is None:
        return np.zeros((0, d))
    generator = np.random.default_rng(20143)
    points = generator.random((CANDIDATES, d))
    with np.errstate(all="ignore"):
        rows = functions(points)
        each = max(CHECK.least_surface_points, FEW_POINTS // len(rows))
        on_surfaces = [np.zeros((0, d))]
        for i, row in enumerate(rows):
            if not np.isfinite(row).all() or np.ptp(row) == 0.0:
                continue
            below, above = points[row < 0.0][:each], points[row > 0.0][:each]
            if i < several and not (len(below) and len(above)):
                side = 1.0 if len(above) else -1.0
                best = _nearest(functions, i, side, points, -side * row)
                on_surfaces.append(best)
                ends = np.broadcast_to(best[0], (each, d))
                below, above = (ends, above) if len(above) else (below, ends)
            pairs = min(len(below), len(above))
            if pairs and functions(below[:1])[i, 0] < 0.0 < functions(above[:1])[i, 0]:
                on_surfaces.append(_zeros(functions, i, below[:pairs], above[:pairs]))
    return Coverage.of_domain(domain).points(np.concatenate(on_surfaces))


def _surfaces(system: System, domain: Domain) -> tuple[Callable[[Array], Array] | None, int]:
    """Functions of points (m, d) of the unit cube: of parameters, and those of states at the start.

    Also how many of them, the first, are those of parameters.
    """
    features = system.features
    several, over_states = features.n_parameter_surfaces, features.n_state_surfaces
    if not domain.box or not several + over_states:
        return None, 0
    coverage = Coverage.of_domain(domain)

    def evaluate(points: Array) -> Array:
        p = np.ascontiguousarray(coverage.points(points).T)
        rows = [features.parameter_surfaces(p)]
        if over_states:
            rows.append(features.state_surfaces(domain.horizon[0], system.initial(p), p))
        wide = [np.broadcast_to(row, (len(row), len(points))) for row in rows]
        return np.concatenate(wide)

    return evaluate, several


def _zeros(functions: Callable[[Array], Array], i: int, below: Array, above: Array) -> Array:
    """Zeros of a function between points where it is negative and points where it is not."""

    def below_zero(points: Array) -> NDArray[np.bool_]:
        return np.asarray(functions(points)[i] < 0.0)[:, None]

    a, b = bisected(below, above, below_zero, CHECK.surface_halvings)
    return np.asarray(0.5 * (a + b))


def _nearest(
    functions: Callable[[Array], Array], i: int, side: float, points: Array, heights: Array
) -> Array:
    """Where a function of one sign comes closest to zero on the unit cube, (1, d).

    ``heights`` are minus its absolute values at ``points``.
    """
    best = np.argsort(-heights, kind="stable")[: CHECK.surface_climbers]
    unit = np.tile([0.0, 1.0], (points.shape[1], 1))

    def height(tried: Array) -> Array:
        distances = side * functions(tried)[i]
        return -np.where(np.isfinite(distances), distances, np.inf)

    nearest, heights = climbed(height, points[best], heights[best], unit, _TO_SURFACE)
    return nearest[[np.argmax(heights)]]


def cell_points(domain: Domain, cuts: Sequence[Sequence[float]]) -> Array:
    """Points (m, d) in narrow cells between cuts of several parameters at once.

    Each coordinate is drawn from the intervals between its cuts, short ones as often as they are
    short: what is switched on in a small box of several parameters is seen there.
    """
    d = len(domain.box)
    if sum(len(places) > 1 for places in cuts) < CHECK.cell_parameters:
        return np.zeros((0, d))
    generator = np.random.default_rng(20145)
    points = np.empty((FEW_POINTS, d))
    for j, ((lower, upper), places) in enumerate(zip(domain.box, cuts, strict=True)):
        edges = np.array([lower, *places, upper])
        lengths = np.diff(edges)
        chosen = generator.choice(lengths.size, len(points), p=(1 / lengths) / (1 / lengths).sum())
        points[:, j] = edges[chosen] + lengths[chosen] * generator.random(len(points))
    return points


def candidate_points(
    slabs: Sequence[SlabTrain], sizes: Array, number: int, rtol: float
) -> Array | None:
    """Parameter points (m, d) at which a solution is to be measured beside random ones.

    Where a parameter has elements or many nodes: inside narrow elements, and where the solution is
    steep, on several slabs; with so many parameters that their corners do not decide, where it
    changes on the last slab; None otherwise.

    ``sizes`` (n,) are those of the states, and ``number`` counts the attempts: each has points of
    its own. The tolerance tells how many nodes a smooth solution needs.
    """
    factor = CHECK.steep_nodes if slabs and len(slabs[-1].bases) > 1 else CHECK.steep_nodes_alone
    many = factor * smooth_nodes(rtol)
    steep = [s for s in slabs if any(b.elements > 1 or b.size > many for b in s.bases)]
    looked_at = steep or slabs[-1:]
    if not looked_at or not (steep or len(slabs[-1].bases) > FEW_PARAMETERS):
        return None
    generator = np.random.default_rng((20140, number))
    points = [_inside_elements(looked_at[-1].bases, generator)]
    indices = sorted({round(i) for i in np.linspace(0, len(looked_at) - 1, MOST_SLABS)})
    for run in sharing([looked_at[i] for i in indices]):
        coverage = Coverage.of_bases(run[0].bases)
        candidates = coverage.points(generator.random((CANDIDATES, len(coverage.box))))
        taken = np.zeros(len(candidates), dtype=bool)
        for steepness in _steepness(run, candidates, sizes):
            change = np.where(taken, 0.0, steepness ** (2.0 if steep else 1.0))
            if np.count_nonzero(change) >= CHECK.steep_points and np.isfinite(change).all():
                weights = change / change.sum()
                drawn = generator.choice(
                    len(candidates), CHECK.steep_points, replace=False, p=weights
                )
                points.append(candidates[drawn])
                taken[drawn] = True
    candidates = np.concatenate(points)
    return candidates if len(candidates) else None


def points_in_elements(
    bases: Sequence[Basis1D], count: int, generator: np.random.Generator
) -> Array:
    """Random points (count, d) in elements that are all as likely: narrow ones are somewhere."""
    columns = []
    for basis in bases:
        element = generator.integers(0, basis.elements, count)
        lower, upper = basis.edges[element], basis.edges[element + 1]
        columns.append(lower + (upper - lower) * generator.random(count))
    return np.stack(columns, axis=1)


def _inside_elements(bases: Sequence[Basis1D], generator: np.random.Generator) -> Array:
    """A random point in each of the narrowest elements of each parameter, (m, d)."""
    coverage = Coverage.of_bases(bases)
    points = np.zeros((0, len(bases)))
    for j, basis in enumerate(bases):
        if basis.elements > 1:
            narrow = np.argsort(np.diff(basis.edges), kind="stable")[: CHECK.most_elements]
            inside = coverage.points(generator.random((narrow.size, len(bases))))
            share = generator.random(narrow.size)
            inside[:, j] = (1.0 - share) * basis.edges[narrow] + share * basis.edges[narrow + 1]
            points = np.concatenate([points, inside])
    return points


def steepest_point(slab: SlabTrain, sizes: Array) -> Array:
    """A point (d,) of the box at which the end of a slab depends steeply on some parameter."""
    unit = np.random.default_rng(20140).random((CANDIDATES, len(slab.bases)))
    points = Coverage.of_bases(slab.bases).points(unit)
    return np.asarray(points[np.argmax(_steepness([slab], points, sizes)[0])])


def worst_apart(domain: Domain, points: Array, errors: Array) -> list[tuple[float, ...]]:
    """The worst of points (m, d) by their errors (m,), and others that are bad and far from it."""
    shares = np.empty(points.shape)
    for j, (interval, scale) in enumerate(zip(domain.box, domain.first_coordinates, strict=True)):
        lower, upper = scale.to_scale(np.array(interval))
        shares[:, j] = (scale.to_scale(points[:, j]) - lower) / (upper - lower)
    worst, bad = [int(np.argmax(errors))], errors > MINOR * errors.max()
    while len(worst) < _MOST_BAD:
        bad &= np.abs(shares - shares[worst[-1]]).max(axis=1, initial=0.0) > MINOR
        if not bad.any():
            break
        worst.append(int(np.argmax(np.where(bad, errors, 0.0))))
    return [tuple(points[k].tolist()) for k in worst]


def _bounds(bases: Sequence[Basis1D]) -> tuple[Array, Array]:
    return np.array([b.lower for b in bases]), np.array([b.upper for b in bases])


def _steepness(slabs: Sequence[SlabTrain], points: Array, sizes: Array) -> list[Array]:
    """Largest change of a state at the end of each slab over a small step across the box, (m,).

    The slabs share the cores of their parameters. Single precision tells what is steep.
    """
    lower, upper = _bounds(slabs[0].bases)
    generator = np.random.default_rng(20140)
    step = Coverage.of_bases(slabs[0].bases).steps(points, CHECK.steep_shift) * generator.choice(
        [-1.0, 1.0], points.shape
    )
    beside = np.concatenate([np.clip(points + s, lower, upper) for s in (step, -step)])
    columns = slabs[0].over_parameters(beside.T, np.float32)
    changes = list[Array]()
    for slab in slabs:
        one, two = np.split(slab.on_grid(np.array([slab.end]), columns)[:, :, 0], 2, axis=1)
        changes.append((np.abs(one - two) / sizes[:, None]).max(axis=0))
    return changes
