"""Adaptive cross interpolation: nodes, left points and tolerances chosen until it suffices.

The nodes of a parameter are read off columns on lines through the box: one element where a smooth
function is resolved by few nodes; where it kinks, jumps or is steep, elements of unequal size,
halved where they do not suffice. The caller measures the error and asks for a refinement.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from rankone.support.arrays import EPSILON, MINOR, NEGLIGIBLE, SEED, TINY, Array
from rankone.tensors import Basis1D, Scale, first_scale
from rankone.tensors.basis import nodes_for
from rankone.tensors.cross import (
    FULL_GRID_NODES,
    Columns,
    Samples,
    batched,
    interpolate,
    left_points,
    with_last_joined,
    with_points,
)
from rankone.tensors.polynomials import LEAST_PARAMETERS, fitted
from rankone.tensors.slab import TAIL_RATIO, LineColumns, basis_values, best_coordinates
from rankone.tensors.train import Integers, Train


@dataclass(frozen=True)
class InterpolationTuning:
    """Tuning of the interpolation, measured over the reference problems."""

    first_left_points: int = 12
    """Left points of each bond to begin with; each refinement takes half as many again."""
    most_first_left_points: int = 30
    """Most of them in the first attempt, which takes what it needs."""
    first_batches: tuple[int, ...] = (8, 10, 12, 15, 18, 22, 26)
    """Left points with which it begins and goes on: few show that those it began with
    suffice."""
    later_batches: tuple[float, ...] = (2 / 3, 1, 3 / 2, 2, 3, 4, 6, 8)
    """The same for later attempts, over the left points that they take at least."""
    skeleton_share: float = 0.04
    """Tolerance of skeletons, relative to the level of an attempt: an error there is
    amplified."""
    highest_modes_share: float = MINOR
    """Size of the highest modes, relative to the level, above which there are more nodes."""
    rounding_share: float = 0.005
    """Error of rounding the train, relative to the level: at corners it is amplified."""
    second_line_offset: float = 0.35
    """Distance of the second line of a parameter from the centre, in widths of the other
    intervals: functions with a symmetry about the centre look different there."""
    max_steep_lines: int = 6
    """Most lines of a parameter through steep points: each costs as much as the first ones."""
    tail_share: float = 0.02
    """Largest tail of the modes on the first lines, relative to the level, for a single
    parameter: elsewhere in the box a function may need more modes, and the tails of several
    parameters add up."""
    slowest_decay: float = 0.95
    """Largest ratio of successive modes used for a prediction: slower decay looks like none."""
    max_predicted_ratio: float = 3.0
    """Largest number of nodes predicted, over the nodes it is predicted from."""
    element_node_ratio: float = 5.0
    """Elements are tried above this ratio of nodes to the nodes of the lines."""
    element_cost_ratio: float = 2.0
    """With one parameter elements may have this many times the nodes of a single element that
    does not suffice."""
    moving_cost_ratio: float = 0.25
    """The same with more parameters, where a steep place moves with the others: lines show some
    of them."""
    least_nodes: int = 3
    """Fewest nodes of a parameter."""
    fit_share: float = 0.2
    """Error of polynomials at points that they were not fitted to, relative to the level."""
    fit_rounding_share: float = 0.1
    """Error of rounding these."""


TUNING = InterpolationTuning()


@dataclass(frozen=True)
class InterpolationLimits:
    """The kind of the bases, the largest number of nodes and rank.

    With ``polynomials`` these are tried before a cross interpolation: where samples are dear.
    """

    basis: type[Basis1D]
    max_nodes: int
    max_rank: int
    polynomials: bool = False


@dataclass(frozen=True)
class Tightening:
    """When and how far a refinement tightens the tolerances.

    Nodes that grow by ``settled_growth`` at most are not expected to suffice alone. The factor on
    the tolerances is a power of target over error, within limits.
    """

    settled_growth: float
    power: float
    smallest: float
    largest: float

    def factor(self, target: float, error: float) -> float:
        factor: float = (target / error) ** self.power
        return min(max(factor, self.smallest), self.largest)


@dataclass(frozen=True)
class KnownElements:
    """Known facts on a parameter: where elements begin, and the fewest nodes."""

    borders: Sequence[float] = ()
    least_nodes: int = 0


class AdaptiveInterpolation:
    """Cross interpolation of columns, each attempt with more nodes, left points or accuracy.

    ``target`` is the error aimed at, in units of the columns, and ``share`` the ratio of the
    tolerances to the first ones. ``scales`` are the coordinates that are tried first. ``bases`` are
    those of the last attempt or, after a refinement, of the next one; ``spectra`` holds the norms
    of the modes of the last attempt. Further lines go through the points ``steep`` (m, d); left
    points lie near the points ``doubtful`` (m, d).
    """

    def __init__(
        self,
        box: Sequence[tuple[float, float]],
        limits: InterpolationLimits,
        target: float,
        tightening: Tightening,
        scales: Sequence[Scale] | None = None,
    ) -> None:
        self.box, self.limits, self.target, self.tightening = box, limits, target, tightening
        self.scales = tuple(scales or (first_scale(*interval) for interval in box))
        self.share = 1.0
        self.bases: tuple[Basis1D, ...] | None = None
        self.spectra: list[Array] = []
        self.steep: Array | None = None
        self.doubtful: Array | None = None
        self._left_count = TUNING.first_left_points
        self._undivided: tuple[Basis1D, ...] | None = None
        self._divides = True

    @property
    def level(self) -> float:
        """Error aimed at in the next attempt."""
        return self.share * self.target

    def unresolved(self, bases: Sequence[Basis1D]) -> list[int]:
        """The parameters whose first lines ask for more nodes than can be predicted from them.

        None of them if there is a single one: elements follow its fronts, however narrow.
        """
        if len(bases) == 1:
            return []
        most = min(math.ceil(TUNING.max_predicted_ratio * self._line_nodes), self.limits.max_nodes)
        return [j for j, basis in enumerate(bases) if basis.elements == 1 and basis.size >= most]

    def with_jumps(self, bases: Sequence[Basis1D]) -> list[int]:
        """The parameters with elements as narrow as those that hold a jump."""
        widths = [np.diff(basis.scale.to_scale(np.asarray(basis.edges))) for basis in bases]
        narrow = [each.min() <= NEGLIGIBLE * each.sum() for each in widths]
        return np.flatnonzero(narrow).tolist()

    def interpolate(
        self,
        columns: Columns,
        known_elements: Callable[[int], Sequence[KnownElements]],
        begun: Callable[[int, int, int], None] | None = None,
        chosen: Callable[[Sequence[Basis1D]], None] | None = None,
    ) -> tuple[Train, bool]:
        """Interpolate columns on the nodes of this attempt; also whether a rank was cut.

        In the first attempt ``known_elements`` maps the number of nodes of an element to the known
        facts on each parameter. ``chosen`` is told the bases before columns are sampled on them.
        Core 0 of the train holds coefficients of columns (rank, r_1), the others hold modes of the
        bases.
        """
        bases = self._attempt_bases(columns, known_elements)
        if chosen is not None:
            chosen(bases)
        polynomials = self._polynomials(columns, bases)
        if polynomials is not None:
            self.bases = bases
            train, self.spectra = polynomials.rounded_with_norms(
                TUNING.fit_rounding_share * self.level
            )
            return train, False
        if bases:
            left = self._left_points(bases)
            tolerance = TUNING.skeleton_share * self.level / np.sqrt(len(bases))
            samples, most = Samples(columns, bases), self.limits.max_rank
            train, limited = interpolate(samples, bases, left, tolerance, most, begun)
        else:
            train, limited = Train((columns(np.zeros((1, 0))),)), False
        self.bases = bases
        train = train.apply_to_modes([basis.to_modal for basis in bases])
        train, self.spectra = train.rounded_with_norms(TUNING.rounding_share * self.level)
        return train, limited

    def _polynomials(self, columns: Columns, bases: Sequence[Basis1D]) -> Train | None:
        """Polynomials fitted to columns, where there are many parameters and few terms suffice."""
        smooth = self.limits.polynomials and all(basis.elements == 1 for basis in bases)
        if not smooth or len(bases) < LEAST_PARAMETERS:
            return None
        return fitted(columns, bases, TUNING.fit_share * self.level)

    def _left_points(self, bases: Sequence[Basis1D]) -> Sequence[list[Integers]]:
        """Batches of left points: several in the first attempt, which takes as many as it needs."""
        sizes = [basis.size for basis in bases]
        if math.prod(sizes) <= FULL_GRID_NODES:
            return batched(left_points(sizes, FULL_GRID_NODES, SEED))
        if self.bases is None:
            left = left_points(sizes, TUNING.most_first_left_points, SEED)
            return with_last_joined(batched(left, *TUNING.first_batches), sizes)
        ends = [round(ratio * self._left_count) for ratio in TUNING.later_batches]
        left = left_points(sizes, ends[-1], SEED)
        if self.doubtful is not None:
            left = with_points(left, [basis.nodes for basis in bases], self.doubtful)
        return with_last_joined(batched(left, *ends), sizes)

    def _attempt_bases(
        self, columns: Columns, known_elements: Callable[[int], Sequence[KnownElements]]
    ) -> tuple[Basis1D, ...]:
        """Bases of an attempt: new ones at first, later the refined ones, divided."""
        self._undivided = None
        if not self.box:
            return ()
        count = self._line_nodes
        if self.bases is None:
            return self._first_bases(self._lines(columns), count, known_elements(count))
        if not self._divides:
            return self.bases
        bases = self._divided(self.bases, self._lines(columns, self.steep), count)
        if bases != self.bases:
            self._undivided = self.bases
        return bases

    def _first_bases(
        self, lines: Lines, count: int, known_elements: Sequence[KnownElements]
    ) -> tuple[Basis1D, ...]:
        """Bases that resolve columns on two lines for each parameter.

        The modes of a smooth function fall geometrically, which tells how many are needed beyond
        the ``count`` of the lines.
        """
        most = self.limits.max_nodes
        tolerance = TUNING.tail_share * self.level / math.sqrt(len(self.box))
        line_bases = self._line_bases(count)
        on_lines = lines([(j, basis.nodes) for j, basis in enumerate(line_bases)])
        drawn = [LineColumns(*pair) for pair in zip(line_bases, on_lines, strict=True)]
        free = [not (known.borders or known.least_nodes) for known in known_elements]
        drawn = best_coordinates(
            drawn, free, lines, lambda spectrum: needed(spectrum, tolerance, math.inf), tolerance
        )
        bases = []
        for j, line in enumerate(drawn):
            basis, borders = replace(line.basis, degree=count), known_elements[j].borders
            predicted = needed(line.spectrum, tolerance, math.inf)
            if borders or (len(self.box) == 1 and predicted > TUNING.element_node_ratio * count):
                allowed = math.inf if borders else predicted
                elements = self._elements(lines, j, basis, borders, allowed)
                if elements is not None:
                    bases.append(elements)
                    continue
            degree = max(
                min(predicted, math.ceil(TUNING.max_predicted_ratio * count)), TUNING.least_nodes
            )
            degree = max(degree, known_elements[j].least_nodes)
            bases.append(replace(basis, degree=min(degree, most)))
        return tuple(bases)

    @property
    def _line_nodes(self) -> int:
        """Nodes of a line, or of an element: a smooth function of the box needs about as many."""
        return min(max(nodes_for(self.level, 4.0), 6), self.limits.max_nodes)

    def _line_bases(self, count: int) -> list[Basis1D]:
        """Bases of the first lines: ``count`` nodes of each parameter."""
        kind, scaled_box = self.limits.basis, zip(self.box, self.scales, strict=True)
        return [kind(a, b, count, scale=scale) for (a, b), scale in scaled_box]

    @property
    def first_points(self) -> Array:
        """The points (m, d) of the lines with which the first attempt begins."""
        if not self.box:
            return np.zeros((0, 0))
        places = [(j, basis.nodes) for j, basis in enumerate(self._line_bases(self._line_nodes))]
        return LinePoints(self.box, self.scales)(places)

    def _lines(self, columns: Columns, steep: Array | None = None) -> Lines:
        return Lines(columns, LinePoints(self.box, self.scales, steep))

    def _divided(self, bases: Sequence[Basis1D], lines: Lines, count: int) -> tuple[Basis1D, ...]:
        """The same bases, but elements where one element of many nodes does no better."""
        divided = list(bases)
        for j, basis in enumerate(bases):
            if basis.elements == 1 and basis.size > TUNING.element_node_ratio * count:
                ratio = TUNING.element_cost_ratio if len(bases) == 1 else TUNING.moving_cost_ratio
                if len(bases) > 1 and basis.size == self.limits.max_nodes:
                    ratio = 1.0  # one element cannot have more
                allowed = ratio * basis.size
                elements = self._elements(lines, j, replace(basis, degree=count), (), allowed)
                divided[j] = elements or basis
        return tuple(divided)

    def _elements(
        self, lines: Lines, j: int, basis: Basis1D, borders: Sequence[float], allowed: float
    ) -> Basis1D | None:
        """Elements that begin at the borders and are halved until the lines are resolved.

        None as soon as it is certain that they need more nodes than ``allowed``.
        """
        tolerance, scale = TUNING.tail_share * self.level, basis.scale
        ends = np.array([basis.lower, *borders, basis.upper])
        edges = scale.to_scale(ends).tolist()
        in_user = dict(zip(edges, ends.tolist(), strict=True))
        width = edges[-1] - edges[0]
        waiting = list(itertools.pairwise(edges))
        begins = list[float]()
        while waiting:
            if (len(begins) + len(waiting)) * basis.degree > allowed:
                return None
            pieces = [replace(basis, lower=in_user[a], upper=in_user[b]) for a, b in waiting]
            insets = [min(4.0 * NEGLIGIBLE * width, 0.01 * (b - a)) for a, b in waiting]
            beside = [
                scale.from_scale(np.array([a + s, b - s]))
                for (a, b), s in zip(waiting, insets, strict=True)
            ]
            points = zip((piece.nodes for piece in pieces), beside, strict=True)
            on_lines = lines([(j, np.concatenate(pair)) for pair in points])
            halves: list[tuple[float, float]] = []
            for (a, b), piece, points_beside, columns in zip(
                waiting, pieces, beside, on_lines, strict=True
            ):
                at_nodes, exact = columns[..., :-2], columns[..., -2:]
                line = LineColumns(piece, at_nodes)
                rough = needed(line.spectrum, tolerance, math.inf) > piece.degree
                if not rough:  # a layer may hide between the last node and the border
                    modal = basis_values(piece, points_beside)
                    errors = at_nodes * np.sqrt(piece.weights) @ modal.T - exact
                    error = float(np.linalg.norm(errors, axis=0).max())
                    rough = error > TAIL_RATIO * tolerance
                room = (len(begins) + len(halves) + 3) * basis.degree <= self.limits.max_nodes
                if rough and room and b - a > NEGLIGIBLE * width:
                    middle = 0.5 * (a + b)
                    in_user[middle] = float(scale.from_scale(np.array(middle)))
                    halves += [(a, middle), (middle, b)]
                else:
                    begins.append(in_user[a])
            waiting = halves
        return replace(basis, breaks=tuple(sorted(begins)[1:]))

    @property
    def adds_elements(self) -> bool:
        """Whether a refinement would halve elements."""
        assert self.bases is not None
        return sum(b.elements for b in self._finer()) > sum(b.elements for b in self.bases)

    def refine(
        self,
        error: float,
        tighten: bool = False,
        least: Sequence[int] = (),
        explained: bool = False,
    ) -> None:
        """Take more left points and nodes; tighten the tolerances where nodes settle, or anyway.

        ``least`` are the fewest nodes of each parameter, if something is known of them, and
        ``explained`` says that too few nodes are the reason of the error.
        """
        assert self.bases is not None
        finer, growth = self._finer(least), self.tightening.settled_growth
        pairs = zip(finer, self.bases, strict=True)
        settled = all(basis.size <= growth * before.size for basis, before in pairs)
        if not explained and (tighten or settled or not self._explains(error)):
            self.share *= self.tightening.factor(self.target, error)
            finer = self._finer(least)
        self._left_count = -(-3 * self._left_count // 2)
        self.bases = finer

    def _explains(self, error: float) -> bool:
        """Whether the highest modes may be the reason of an error: then more nodes suffice."""
        assert self.bases is not None
        pairs = zip(self.bases, self.spectra, strict=True)
        tail = max((basis.tail(spectrum) for basis, spectrum in pairs), default=0.0)
        return TAIL_RATIO * tail > error

    def undo_division(self) -> bool:
        """Go back to the bases before they were divided, for good; whether they had been.

        Elements do not follow a steep place that moves with other parameters.
        """
        if self._undivided is None:
            return False
        self.bases, self._undivided, self._divides = self._undivided, None, False
        return True

    def _finer(self, least: Sequence[int] = ()) -> tuple[Basis1D, ...]:
        """Bases with more nodes where the highest modes of the last attempt are not small."""
        assert self.bases is not None
        tolerance, most = (
            TUNING.highest_modes_share * self.share * self.target,
            self.limits.max_nodes,
        )
        finer = []
        fewest = least or [basis.size for basis in self.bases]
        for basis, spectrum, degree in zip(self.bases, self.spectra, fewest, strict=True):
            if basis.elements > 1:
                finer.append(_halved(basis, spectrum, tolerance, most))
                continue
            if basis.tail(spectrum) > tolerance:
                degree = max(degree, needed(spectrum, tolerance), basis.size + 2)
            finer.append(replace(basis, degree=max(basis.size, min(degree, most))))
        return tuple(finer)


class LinePoints:
    """Points of lines for each parameter: through the centre of the box, and past it.

    With several parameters also through some of the ``steep`` points (m, d), if there are any. Or
    through other points (m, d) alone.
    """

    def __init__(
        self,
        box: Sequence[tuple[float, float]],
        scales: Sequence[Scale],
        steep: Array | None = None,
        through: Array | None = None,
    ) -> None:
        if through is not None:
            self.through = list(through)
            return
        scaled = [scale.to_scale(np.array(ends)) for scale, ends in zip(scales, box, strict=True)]
        lower, upper = np.array(scaled, dtype=float).reshape(-1, 2).T
        centre = 0.5 * (lower + upper)
        points = [
            centre,
            centre + TUNING.second_line_offset * _sides(centre.size) * (upper - lower),
        ]
        points = [
            np.array([scale.from_scale(s) for scale, s in zip(scales, point, strict=True)])
            for point in points
        ]
        if steep is not None:
            points += list(steep[:: -(-len(steep) // TUNING.max_steep_lines)])
        self.through = points[: None if centre.size > 1 else 1]

    def __call__(self, places: Sequence[tuple[int, Array]]) -> Array:
        """Points (m, d) at places (N,) of the parameters j in pairs (j, places), line by line."""
        points = []
        for j, coordinates in places:
            for point in self.through:
                line = np.tile(point, (coordinates.size, 1))
                line[:, j] = coordinates
                points.append(line)
        return np.concatenate(points)


@lru_cache(64)
def _sides(d: int) -> Array:
    """Random signs, on whose side of the centre the second line is: (d,)."""
    return np.random.default_rng(SEED).choice([-1.0, 1.0], d)


@dataclass(frozen=True)
class Lines:
    """Columns on lines."""

    columns: Columns
    points: LinePoints

    def __call__(self, places: Sequence[tuple[int, Array]]) -> list[Array]:
        """Coefficients (rank, lines, N) at places (N,) of the parameters j in pairs (j, places)."""
        coefficients, count = self.columns(self.points(places)), len(self.points.through)
        sizes = np.cumsum([count * coordinates.size for _, coordinates in places])[:-1]
        on_lines = np.split(coefficients, sizes, axis=1)
        return [block.reshape(len(block), count, -1) for block in on_lines]


def needed(spectrum: Array, tolerance: float, max_ratio: float = TUNING.max_predicted_ratio) -> int:
    """Modes after which the tail of a spectrum is small: at most ``max_ratio`` times its size."""
    tails = np.sqrt(np.cumsum(spectrum[::-1] ** 2)[::-1])
    count = spectrum.size
    if tails[-2:].max() <= tolerance:
        return max(int(np.count_nonzero(tails > tolerance)), 1)
    half = count // 2
    levels = np.maximum.accumulate(spectrum[::-1])[::-1]  # modes may vanish by symmetry
    ratio = (levels[-2] / max(levels[half - 1], TINY)) ** (1.0 / (count - 1 - half))
    ratio = min(max(ratio, EPSILON), TUNING.slowest_decay)
    beyond = math.log(tolerance / levels[-2]) / math.log(ratio)
    return math.ceil(min(count + beyond, max_ratio * count))


def _halved(basis: Basis1D, spectrum: Array, tolerance: float, most: int) -> Basis1D:
    """The elements with the highest tails halved, the worst first, as far as there is room."""
    tails = np.linalg.norm(spectrum.reshape(basis.elements, -1)[:, -2:], axis=1)
    tails *= math.sqrt(basis.elements)
    edges = basis.scaled_edges
    narrowest = NEGLIGIBLE * (edges[-1] - edges[0])
    rough = (tails > tolerance) & (np.diff(edges) > narrowest)
    room = max(most // basis.degree - basis.elements, 0)
    chosen = np.flatnonzero(rough)[np.argsort(-tails[rough])][:room]
    if not chosen.size:
        return basis
    breaks = np.sort(np.concatenate([basis.edges[1:-1], basis.middles[chosen]]))
    return replace(basis, elements=breaks.size + 1, breaks=tuple(breaks.tolist()))
