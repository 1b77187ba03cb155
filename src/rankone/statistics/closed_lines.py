"""Quadrature over the unit cube for functions that jump across surfaces.

Lines run through the cube in a direction of whole numbers, leave it through a face and enter it
again through the opposite one, until they close. The average over all of it is the average, over
points of a lattice, of the averages along the lines through them. Along a line the surfaces are
points: they are bisected, and between two of them Gauss's rule applies. The average along a line is
a continuous function of the line, for which lattices converge fast (Griewank, Kuo, Leövey & Sloan,
"High dimensional integration of kinks and jumps: smoothing by preintegration", Journal of
Computational and Applied Mathematics 344, 2018; a line along one axis alone misses the surfaces
that are parallel to it). Functions of one or two coordinates are integrated almost exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array

Labels = Callable[[NDArray[np.intp], Array], NDArray[np.intp]]
"""Labels (M,) of the smooth pieces in which shares (M,) of segments (M,) lie."""

FIRST_LINES = 16
"""Lines before the first refinement."""
_SEGMENTS = 4  # Of a line at least, so that Gauss's rule resolves what is smooth
_SEGMENTS_OF_ONE = (8, 13)  # The same where there is one line alone, first and refined
_SAMPLES = np.linspace(0.0, 1.0, 13)  # Places on a segment at which labels are compared
_HALVINGS = 20  # Of the interval between two of them
_MOST_BREAKS = 4  # Most changes of labels in it
_MOST_STEPS = 4  # Largest component of a direction, which is the number of times a line wraps
_LATTICE = 49851  # Multiplier of the Korobov lattice, the best of 400 for 2 to 5 coordinates
_LATTICE_SIZE = 2**20
_GOLDEN_RATIO = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True)
class Pieces:
    """Pieces of ``segments`` (P,) of lines, and the shares of these where they begin and end."""

    segments: NDArray[np.intp]
    begins: Array
    ends: Array


@dataclass(frozen=True)
class Lines:
    """Closed lines through the unit cube, as straight segments.

    ``starts`` (D, S) and ``ends`` (D, S) are those of all segments, and ``lengths`` (S,) their
    shares of a line.
    """

    starts: Array
    ends: Array
    lengths: Array

    @classmethod
    def between(cls, first: int, last: int, dimensions: int, segments: int = _SEGMENTS) -> Lines:
        """The lines through the points of a lattice numbered from ``first`` up to ``last``.

        Each is cut at the faces of the cube, and at the ends of so many ``segments`` of one length.
        """
        steps = 1 + np.arange(dimensions) % _MOST_STEPS
        through = _lattice(first, last, dimensions)
        places = [np.full(last - first, k / segments) for k in range(1, segments + 1)]
        for y, step in zip(through, steps, strict=True):
            places += [(m - y) / step for m in range(1, step + 1)]
        breaks = np.sort(np.array(places), axis=0)
        begins, ends = breaks, np.concatenate([breaks[1:], breaks[:1] + 1.0])
        corner = np.floor(through[:, None] + steps[:, None, None] * (0.5 * (begins + ends)))
        coordinates = (
            through[:, None] + steps[:, None, None] * at - corner for at in (begins, ends)
        )
        lengths = (ends - begins).ravel()
        shape = dimensions, lengths.size
        starts, stops = (np.clip(at, 0.0, 1.0).reshape(shape) for at in coordinates)
        return cls(starts, stops, lengths)

    def at(self, segments: NDArray[np.intp], shares: Array) -> Array:
        """Points (D, M) at shares (M,) of the way along segments (M,)."""
        start = self.starts[:, segments]
        return start + shares * (self.ends[:, segments] - start)

    def pieces(self, labels: Labels) -> Pieces:
        """The pieces of segments on which labels are equal."""
        segments, breaks = self._breaks(labels)
        owners = np.concatenate([np.arange(self.lengths.size), segments])
        begins = np.concatenate([np.zeros(self.lengths.size), breaks])
        order = np.lexsort((begins, owners))
        owners, begins = owners[order], begins[order]
        ends = np.append(begins[1:], 1.0)
        ends[np.append(owners[1:] != owners[:-1], True)] = 1.0
        return Pieces(owners, begins, ends)

    def rule(self, pieces: Pieces, nodes: int) -> tuple[Array, Array]:
        """Gauss's points (D, M) and weights (M,) on pieces, with ``nodes`` on each."""
        places, weights = np.polynomial.legendre.leggauss(nodes)
        lengths = pieces.ends - pieces.begins
        shares = pieces.begins + 0.5 * (1.0 + places)[:, None] * lengths
        segments = np.broadcast_to(pieces.segments, shares.shape)
        points = self.at(segments.ravel(), shares.ravel())
        weights = 0.5 * weights[:, None] * (lengths * self.lengths[pieces.segments])
        return points, weights.ravel()

    def on_all(self, shares: Array) -> Array:
        """Points (D, len(shares) * S) at shares of the way along each segment."""
        return self.at(*_on_each(self.lengths.size, shares))

    def _breaks(self, labels: Labels) -> tuple[NDArray[np.intp], Array]:
        """Segments, and the shares of them, at which labels change."""
        sampled = labels(*_on_each(self.lengths.size, _SAMPLES)).reshape(_SAMPLES.size, -1)
        before, segments = np.nonzero(sampled[1:] != sampled[:-1])
        lower, end = _SAMPLES[before], _SAMPLES[before + 1]
        first, last = sampled[before, segments], sampled[before + 1, segments]
        owners, breaks = [segments[:0]], [lower[:0]]
        for _ in range(_MOST_BREAKS):
            if not segments.size:
                break
            upper = end
            for _ in range(_HALVINGS):
                middle = 0.5 * (lower + upper)
                same = labels(segments, middle) == first
                lower, upper = np.where(same, middle, lower), np.where(same, upper, middle)
            owners.append(segments)
            breaks.append(upper)
            behind = labels(segments, upper)
            more = behind != last
            segments, lower, first = segments[more], upper[more], behind[more]
            end, last = end[more], last[more]
        return np.concatenate(owners), np.concatenate(breaks)


def _on_each(count: int, shares: Array) -> tuple[NDArray[np.intp], Array]:
    """Segments (len(shares) * count,) and shares of all shares on all segments."""
    return np.tile(np.arange(count), shares.size), np.repeat(shares, count)


def refinements(dimensions: int, most: int, first: int = FIRST_LINES) -> Iterator[Lines]:
    """Lines whose averages are averaged one after the other: as many as before, up to ``most``."""
    if dimensions < 2:
        for segments in _SEGMENTS_OF_ONE:  # there is no other line
            yield Lines.between(0, 1, dimensions, segments)
        return
    count = first
    yield Lines.between(0, count, dimensions)
    while 2 * count <= most:
        yield Lines.between(count, 2 * count, dimensions)
        count *= 2


def _lattice(first: int, last: int, dimensions: int) -> Array:
    """Points (D, N) of a lattice by their numbers; the first coordinate, which no line needs, is 0.

    The first 2^m points are a lattice for every m.
    """
    numbers, inverse = np.arange(first, last), np.zeros(last - first, dtype=np.int64)
    size = _LATTICE_SIZE
    while numbers.any():  # digits in reverse order
        size //= 2
        inverse += size * (numbers % 2)
        numbers //= 2
    points = np.zeros((dimensions, last - first))
    factor = 1
    for j in range(1, dimensions):
        shift = j * _GOLDEN_RATIO  # so that no line meets an edge
        points[j] = ((inverse * factor) % _LATTICE_SIZE / _LATTICE_SIZE + shift) % 1.0
        factor = factor * _LATTICE % _LATTICE_SIZE
    return points
