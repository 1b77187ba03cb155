"""Where a solution is most likely to be wrong: what random points of the box would miss."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from rankone.discretization import Basis1D
from rankone.ir.domain import Domain
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.tensors.slab import SlabTrain
from rankone.verification.search import Climb, bisected, climbed

__all__ = ["active_points", "candidate_points", "cell_points", "steepest_point", "surface_points"]

_SMOOTH, _SMOOTH_ALONE = 3.0, 9.0
"""Nodes in one parameter, over those of a smooth dependence, from which a solution is steep, with
other parameters and with none: random points of one parameter alone lie close."""
_CORNERS = 3
"""Number of parameters up to which the corners are checked as strictly as the interior."""
_ELEMENTS = 16
"""Elements of a parameter in which the error is measured."""
_SLABS, _CANDIDATES, _CHOSEN = 4, 512, 12
"""Slabs looked at, candidates on each, and how many are taken of them."""
_GRID = 1025
"""Samples of a factor over its interval."""
_RARE, _TERMS = 0.2, 4
"""Share of the box below which a term is rarely active, and the number of such terms at most."""
_ON_SURFACES, _LEAST = 32, 4
"""Points on all surfaces, on each at least."""
_HALVINGS = 50
"""Halvings of the distance to a surface."""
_CELLS = 2
"""Parameters with special values from which their cells are looked at."""
_CLIMBERS = 4
"""Points from which a surface that is met nowhere is approached."""
_CLIMB = Climb(rounds=60, tries=32, first_step=0.2, shrinkage=0.6, patient=True, seed=20144)
"""The way there: islands of a few percent of six parameters are met, and narrow ones of two."""
_SHIFT = 2e-3
"""Change of every parameter, in widths of its interval, over which the solution is compared."""


def active_points(system: System, domain: Domain) -> Array:
    """Points (m, d) at which separated terms are large that are small in most of the box.

    A product of narrow or steep factors is nearly zero at random points. For the terms that are
    active in the smallest part of the box, (∫|f|)²/∫f² of each factor f, points are drawn in
    proportion to the sizes of their factors.
    """
    d = len(domain.box)
    none = np.zeros((0, d))
    if not system.separated or d == 0:
        return none
    grids = [np.linspace(*interval, _GRID) for interval in domain.box]
    sizes = [np.abs(system.parameter_factors(j, grid)) for j, grid in enumerate(grids)]
    parts = [np.mean(f, axis=1) ** 2 / np.maximum(np.mean(f**2, axis=1), 1e-300) for f in sizes]
    products = {rows[1:] for _, _, rows, _ in system.terms}
    products |= {rows for _, _, rows in system.initial_terms}
    shares = {rows: math.prod(p[r] for p, r in zip(parts, rows, strict=True)) for rows in products}
    rare = [rows for rows in products if 0.0 < shares[rows] < _RARE]
    rare = sorted(rare, key=lambda rows: (shares[rows], rows))
    generator = np.random.default_rng(20140)
    found = [none]
    rare = rare[:_TERMS]
    for rows in rare:
        drawn = np.empty((_TERMS * _CHOSEN // len(rare), d))
        for j, row in enumerate(rows):
            sums = np.cumsum(sizes[j][row])
            drawn[:, j] = np.interp(generator.random(len(drawn)), sums / sums[-1], grids[j])
        found.append(drawn)
    return np.concatenate(found)


def surface_points(system: System, domain: Domain) -> Array:
    """Points (m, d) at which functions of several parameters are narrow, kink or switch.

    On lines between random points on either side of such a surface; where all are on one side, the
    point at which the function is least, or largest, and between it and a random point.
    """
    (functions, several), d = _surfaces(system, domain), len(domain.box)
    if functions is None:
        return np.zeros((0, d))
    generator = np.random.default_rng(20143)
    points = generator.random((_CANDIDATES, d))
    with np.errstate(all="ignore"):
        values = functions(points)
        each = max(_LEAST, _ON_SURFACES // len(values))
        found = [np.zeros((0, d))]
        for i, row in enumerate(values):
            if not np.isfinite(row).all() or np.ptp(row) == 0.0:
                continue
            below, above = points[row < 0.0][:each], points[row > 0.0][:each]
            if i < several and not (len(below) and len(above)):
                side = 1.0 if len(above) else -1.0
                best = _nearest(functions, i, side, points, -side * row)
                found.append(best)
                ends = np.broadcast_to(best[0], (each, d))
                below, above = (ends, above) if len(above) else (below, ends)
            pairs = min(len(below), len(above))
            if pairs and functions(below[:1])[i, 0] < 0.0 < functions(above[:1])[i, 0]:
                found.append(_zeros(functions, i, below[:pairs], above[:pairs]))
    lower, upper = domain.bounds.T
    return np.asarray(lower + (upper - lower) * np.concatenate(found))


def _surfaces(system: System, domain: Domain) -> tuple[Callable[[Array], Array] | None, int]:
    """Functions of points (m, d) of the unit cube: of parameters, and events at the start.

    Also how many of them, the first, are those of parameters.
    """
    features = system.features
    several, over_states = features.n_parameter_surfaces, features.n_state_surfaces
    if not domain.box or not several + over_states:
        return None, 0
    lower, upper = domain.bounds.T

    def evaluate(points: Array) -> Array:
        p = np.ascontiguousarray((lower + (upper - lower) * points).T)
        rows = [features.parameter_surfaces(p)]
        if over_states:
            rows.append(features.state_surfaces(domain.horizon[0], system.initial(p), p))
        wide = [np.broadcast_to(row, (len(row), len(points))) for row in rows]
        return np.concatenate(wide)

    return evaluate, several


def _zeros(functions: Callable[[Array], Array], i: int, below: Array, above: Array) -> Array:
    """Zeros of a function between points where it is negative and points where it is not."""
    a, b = bisected(below, above, lambda points: functions(points)[i] < 0.0, _HALVINGS)
    return np.asarray(0.5 * (a + b))


def _nearest(
    functions: Callable[[Array], Array], i: int, side: float, points: Array, heights: Array
) -> Array:
    """Where a function of one sign comes closest to zero on the unit cube, (1, d).

    ``heights`` are minus its absolute values at ``points``.
    """
    best = np.argsort(-heights, kind="stable")[:_CLIMBERS]
    unit = np.tile([0.0, 1.0], (points.shape[1], 1))

    def height(tried: Array) -> Array:
        distances = side * functions(tried)[i]
        return -np.where(np.isfinite(distances), distances, np.inf)

    nearest, heights = climbed(height, points[best], heights[best], unit, _CLIMB)
    return nearest[[np.argmax(heights)]]


def cell_points(domain: Domain, special: Sequence[Sequence[float]]) -> Array:
    """Points (m, d) in narrow cells between special values of several parameters at once.

    Each coordinate is drawn from the intervals between its special values, all alike but for their
    length: what is switched on in a small box of several parameters is seen there.
    """
    d = len(domain.box)
    if sum(len(values) > 1 for values in special) < _CELLS:
        return np.zeros((0, d))
    generator = np.random.default_rng(20145)
    points = np.empty((_ON_SURFACES, d))
    for j, ((lower, upper), values) in enumerate(zip(domain.box, special, strict=True)):
        edges = np.array([lower, *values, upper])
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

    Parameters
    ----------
    slabs : sequence of SlabTrain
    sizes : ndarray (n,)
        Sizes of the states.
    number : int
        That of the attempt: each has points of its own.
    rtol : float
        Its tolerance tells how many nodes are many.
    """
    factor = _SMOOTH if slabs and len(slabs[-1].bases) > 1 else _SMOOTH_ALONE
    many = factor * (4.0 - 1.4 * math.log10(rtol))
    steep = [s for s in slabs if any(b.elements > 1 or b.size > many for b in s.bases)]
    looked_at = steep or slabs[-1:]
    if not looked_at or not (steep or len(slabs[-1].bases) > _CORNERS):
        return None
    generator = np.random.default_rng((20140, number))
    points = [_inside_elements(looked_at[-1].bases, generator)]
    for i in {round(i) for i in np.linspace(0, len(looked_at) - 1, _SLABS)}:
        lower, upper = _bounds(looked_at[i].bases)
        candidates = lower + (upper - lower) * generator.random((_CANDIDATES, lower.size))
        change = _steepness(looked_at[i], candidates, sizes) ** (2.0 if steep else 1.0)
        if np.count_nonzero(change) >= _CHOSEN and np.isfinite(change).all():
            weights = change / change.sum()
            points.append(
                candidates[generator.choice(_CANDIDATES, _CHOSEN, replace=False, p=weights)]
            )
    found = np.concatenate(points)
    return found if len(found) else None


def _inside_elements(bases: Sequence[Basis1D], generator: np.random.Generator) -> Array:
    """A random point in each of the narrowest elements of each parameter, (m, d)."""
    lower, upper = _bounds(bases)
    points = np.zeros((0, lower.size))
    for j, basis in enumerate(bases):
        if basis.elements > 1:
            narrow = np.argsort(np.diff(basis.edges), kind="stable")[:_ELEMENTS]
            inside = lower + (upper - lower) * generator.random((narrow.size, lower.size))
            share = generator.random(narrow.size)
            inside[:, j] = (1.0 - share) * basis.edges[narrow] + share * basis.edges[narrow + 1]
            points = np.concatenate([points, inside])
    return points


def steepest_point(slab: SlabTrain, sizes: Array) -> Array:
    """A point (d,) of the box at which the end of a slab depends steeply on some parameter."""
    lower, upper = _bounds(slab.bases)
    unit = np.random.default_rng(20140).random((_CANDIDATES, lower.size))
    points = lower + (upper - lower) * unit
    return np.asarray(points[np.argmax(_steepness(slab, points, sizes))])


def _bounds(bases: Sequence[Basis1D]) -> tuple[Array, Array]:
    return np.array([b.lower for b in bases]), np.array([b.upper for b in bases])


def _steepness(slab: SlabTrain, points: Array, sizes: Array) -> Array:
    """Largest change of a state at the end of a slab over a small step across the box, (m,)."""
    lower, upper = _bounds(slab.bases)
    generator = np.random.default_rng(20140)
    step = _SHIFT * (upper - lower) * generator.choice([-1.0, 1.0], points.shape)
    times = np.full(len(points), slab.end)
    one, two = (slab(times, np.clip(points + s, lower, upper).T) for s in (step, -step))
    return np.asarray((np.abs(one - two) / sizes[:, None]).max(axis=0))
