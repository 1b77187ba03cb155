"""Nodes of the parameters, read off trajectories on lines through the box.

One element where a smooth function is resolved by few nodes; where it kinks, jumps or is steep,
elements of unequal size, halved where they do not suffice.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from rankone.discretization import BASES, Basis1D
from rankone.ir.domain import Domain
from rankone.solvers.cross.options import CrossOptions
from rankone.solvers.cross.trajectories import Trajectories
from rankone.support.arrays import Array
from rankone.verification.cuts import Cuts, resolving_pieces

__all__ = ["Sampled", "divided", "first_bases", "more_nodes", "resolving_bases"]

Sampled = Callable[[Array], Array]
"""Coefficients of columns at points (m, d): shape (rank, m)."""

_KNOWN = 0.1
"""What an element may miss of the known functions of its parameter, in the same unit."""
_MORE = (1.5, 2.5, 4.0)
"""Nodes of one element, over those of the lines, that are tried before elements."""
_OFF_CENTRE = 0.35
"""Distance of the second line of a parameter from the centre, in widths of the other intervals."""
_STEEP_LINES = 6
"""Most lines of a parameter through steep points."""
_TAIL = 0.015
"""What the modes left out may make up, relative to the error asked for."""
_SLOWEST = 0.95
"""Largest ratio of successive modes that is believed."""
_FARTHEST = 3.0
"""Largest number of nodes predicted, over that of the lines."""
_STEEP = 5.0
"""Number of nodes, over that of the lines, from which elements are tried."""
_DEARER = 2.0
"""Nodes in elements that are taken for one in a single element that does not suffice, where there
is one parameter; with more, what is steep moves, and only fewer nodes are taken."""
_TAIL_STEEP = 0.01
"""As the tail above, where elements are taken: what is steep is so at few times only."""
_AT_BORDERS = 30.0
"""Error at the borders of an element, in the same unit, from which it is halved."""
_BESIDE = 4e-9
"""Distance from a border, in widths of the interval: there may be a jump."""
_NARROWEST = 1e-9
"""Width of the smallest element, relative to the interval: it holds a jump."""


def first_bases(
    trajectories: Trajectories, domain: Domain, rtol: float, options: CrossOptions
) -> tuple[Basis1D, ...]:
    """Bases that resolve the trajectories on two lines for each parameter.

    Where known functions of a parameter are narrow, kink or jump is known before: elements begin
    with pieces on each of which they are resolved.
    """
    count = _count(rtol, options)
    known = [_known(trajectories, j, count, rtol) for j in range(len(domain.box))]
    return resolving_bases(trajectories, domain, rtol, options, known)


def resolving_bases(
    sampled: Sampled,
    domain: Domain,
    rtol: float,
    options: CrossOptions,
    known: Sequence[tuple[Sequence[float], int]],
) -> tuple[Basis1D, ...]:
    """Bases that resolve columns on two lines for each parameter.

    One line goes through the centre of the box, one past it. The modes of a smooth function fall
    geometrically, which tells how many are needed beyond those of the line. What is ``known`` of
    each parameter is where elements begin, and the least number of nodes.
    """
    kind = BASES[options.basis]
    count = _count(rtol, options)
    bases = [kind(lower, upper, count) for lower, upper in domain.box]
    lines = Lines(sampled, domain)
    values = lines([(j, basis.nodes) for j, basis in enumerate(bases)])
    found = []
    for j, basis in enumerate(bases):
        borders, least = known[j]
        predicted = needed(_spectrum(basis, values[j]), _TAIL * rtol, math.inf)
        if borders or (len(bases) == 1 and predicted > _STEEP * count):
            tail = _TAIL_STEEP * rtol
            elements = _elements(lines, j, basis, borders, tail, options.max_nodes)
            if elements.size <= predicted or borders:
                found.append(elements)
                continue
        wanted = min(predicted, math.ceil(_FARTHEST * count))
        found.append(replace(basis, degree=min(max(wanted, least, 3), options.max_nodes)))
    return tuple(found)


def _known(trajectories: Trajectories, j: int, nodes: int, rtol: float) -> tuple[list[float], int]:
    """Where elements of a parameter begin, and nodes needed at least where there are none.

    They resolve the known functions of it.
    """
    reference_set = trajectories.reference_set
    found = reference_set.parameter_cuts[j] if reference_set.parameter_cuts else Cuts()
    if found.smooth:
        return list(found.points), 0
    known, interval = (
        partial(reference_set.system.parameter_factors, j),
        reference_set.domain.box[j],
    )
    for count in (nodes, *(round(more * nodes) for more in _MORE)):
        pieces = resolving_pieces(known, *interval, found.points, count, _KNOWN * rtol)
        if len(pieces) == 1:
            return [], count
        if count == nodes:
            elements = pieces
    return [a for a, _ in elements[1:]], 0


def divided(
    bases: Sequence[Basis1D],
    sampled: Sampled,
    domain: Domain,
    rtol: float,
    options: CrossOptions,
    steep: Array | None,
) -> tuple[Basis1D, ...]:
    """The same bases, but elements where one of many nodes does no better.

    Elements resolve the columns on further lines through some of the ``steep`` points (m, d).
    """
    count = _count(rtol, options)
    lines = Lines(sampled, domain, steep)
    found = list(bases)
    for j, basis in enumerate(bases):
        if basis.elements == 1 and basis.size > _STEEP * count:
            one = replace(basis, degree=count)
            elements = _elements(lines, j, one, (), _TAIL_STEEP * rtol, options.max_nodes)
            if elements.size <= basis.size * (_DEARER if len(bases) == 1 else 1.0):
                found[j] = elements
    return tuple(found)


def _count(rtol: float, options: CrossOptions) -> int:
    """Nodes of the lines that come first, and of each element."""
    return min(max(round(4.0 + 1.4 * -math.log10(rtol)), 6), options.max_nodes)


def _spectrum(basis: Basis1D, values: Array) -> Array:
    """Largest size of each mode of trajectories (rank, lines, nodes) on some lines."""
    scaled = values * np.sqrt(basis.weights)
    return np.asarray(np.linalg.norm(scaled @ basis.to_modal.T, axis=0).max(axis=0))


def _elements(
    lines: Lines, j: int, basis: Basis1D, special: Sequence[float], tolerance: float, most: int
) -> Basis1D:
    """Elements that begin with the special points and are halved until the lines are resolved."""
    width = basis.upper - basis.lower
    waiting = list(itertools.pairwise([basis.lower, *special, basis.upper]))
    ends = {basis.upper}
    while waiting:
        pieces = [replace(basis, lower=a, upper=b) for a, b in waiting]
        beside = [min(_BESIDE * width, 0.01 * (b - a)) for a, b in waiting]
        borders = [np.array([a + s, b - s]) for (a, b), s in zip(waiting, beside, strict=True)]
        points = zip((piece.nodes for piece in pieces), borders, strict=True)
        values = lines([(j, np.concatenate(pair)) for pair in points])
        halves: list[tuple[float, float]] = []
        for piece, border, found in zip(pieces, borders, values, strict=True):
            a, b = piece.lower, piece.upper
            inside, outside = found[..., :-2], found[..., -2:]
            rough = needed(_spectrum(piece, inside), tolerance, math.inf) > piece.degree
            if not rough:  # a layer may hide between the last node and the border
                rough = _missed(piece, inside, border, outside) > _AT_BORDERS * tolerance
            room = (len(ends) + len(halves) + 2) * basis.degree <= most
            if rough and room and b - a > _NARROWEST * width:
                halves += [(a, 0.5 * (a + b)), (0.5 * (a + b), b)]
            else:
                ends.add(a)
        waiting = halves
    return replace(basis, breaks=tuple(sorted(ends)[1:-1]))


def _missed(piece: Basis1D, values: Array, points: Array, exact: Array) -> float:
    """Largest error at points of interpolants through values at the nodes."""
    modal = piece.modal_values(points) @ piece.to_modal
    return float(np.linalg.norm(values * np.sqrt(piece.weights) @ modal.T - exact, axis=0).max())


class Lines:
    """Columns on lines for each parameter: through the centre of the box, and past it.

    With several parameters also through some of the ``steep`` points (m, d), if there are any.
    """

    def __init__(self, sampled: Sampled, domain: Domain, steep: Array | None = None) -> None:
        self.sampled = sampled
        lower, upper = domain.bounds.T
        centre = 0.5 * (lower + upper)
        sides = np.random.default_rng(20140).choice([-1.0, 1.0], centre.size)
        points = [centre, centre + _OFF_CENTRE * sides * (upper - lower)]
        if steep is not None:
            points += list(steep[:: -(-len(steep) // _STEEP_LINES)])
        self.points = points[: None if centre.size > 1 else 1]

    def __call__(self, places: Sequence[tuple[int, Array]]) -> list[Array]:
        """Coefficients (rank, lines, N) at places (N,) of the parameters given."""
        points = []
        for j, where in places:
            for point in self.points:
                line = np.tile(point, (where.size, 1))
                line[:, j] = where
                points.append(line)
        values = self.sampled(np.concatenate(points))
        sizes = np.cumsum([len(self.points) * where.size for _, where in places])[:-1]
        parts = np.split(values, sizes, axis=1)
        return [part.reshape(len(part), len(self.points), -1) for part in parts]


def needed(spectrum: Array, tolerance: float, farthest: float = _FARTHEST) -> int:
    """Number of modes after which the rest of a spectrum is below a tolerance.

    At most ``farthest`` times those of the spectrum are predicted.
    """
    tails = np.sqrt(np.cumsum(spectrum[::-1] ** 2)[::-1])
    count = spectrum.size
    if tails[-2:].max() <= tolerance:
        return int(np.count_nonzero(tails > tolerance)) + 1
    half = count // 2
    levels = np.maximum.accumulate(spectrum[::-1])[::-1]  # modes may vanish by symmetry
    ratio = (levels[-2] / max(levels[half - 1], 1e-300)) ** (1.0 / (count - 1 - half))
    ratio = min(max(ratio, 1e-3), _SLOWEST)
    more = math.log(tolerance / levels[-2]) / math.log(ratio)
    return math.ceil(min(count + more, farthest * count))


def more_nodes(
    bases: tuple[Basis1D, ...], spectra: list[Array], tolerance: float, most: int
) -> tuple[Basis1D, ...]:
    """Bases with more nodes where the highest modes of a core are above the tolerance."""
    result = []
    for basis, spectrum in zip(bases, spectra, strict=True):
        if basis.elements > 1:
            result.append(_halved(basis, spectrum, tolerance, most))
        elif basis.tail(spectrum) <= tolerance:
            result.append(basis)
        else:
            wanted = max(needed(spectrum, tolerance), basis.size + 2)
            result.append(replace(basis, degree=max(basis.size, min(wanted, most))))
    return tuple(result)


def _halved(basis: Basis1D, spectrum: Array, tolerance: float, most: int) -> Basis1D:
    """The elements with the highest tails halved, the worst first, as far as there is room."""
    tails = np.linalg.norm(spectrum.reshape(basis.elements, -1)[:, -2:], axis=1)
    tails *= math.sqrt(basis.elements)
    narrowest = _NARROWEST * (basis.upper - basis.lower)
    rough = (tails > tolerance) & (np.diff(basis.edges) > narrowest)
    room = max(most // basis.degree - basis.elements, 0)
    chosen = np.flatnonzero(rough)[np.argsort(-tails[rough])][:room]
    if not chosen.size:
        return basis
    middles = 0.5 * (basis.edges[:-1] + basis.edges[1:])[chosen]
    breaks = np.sort(np.concatenate([basis.edges[1:-1], middles]))
    return replace(basis, elements=breaks.size + 1, breaks=tuple(breaks.tolist()))
