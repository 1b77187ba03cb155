"""Rates that are narrow between the steps of reference trajectories, where no step saw them.

Each step is looked at through :mod:`enclosures <rankone.solvers.verification.enclosures>` of the
rates. Where they may hide so much that it matters, the step is halved, and only the halves in
doubt are looked at again. Doubts about smooth rates vanish after a few halvings; a hidden peak
keeps its height until its width is reached, and then samples see it. Whether that changes the
trajectory is tried by steps no longer than the parts into which a step was halved. Peaks wider
than a hundredth of a step are left to the defects at random places of
:mod:`rankone.trajectories.integrators.defects`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.observation import Observation
from rankone.solvers.verification.enclosures.enclosure import Enclosure
from rankone.solvers.verification.enclosures.generated import UnsuitableError, arguments, enclosed
from rankone.solvers.verification.reference import Reference
from rankone.solvers.verification.steps import (
    CHANGED,
    HALVINGS,
    Allowance,
    Pieces,
    Place,
    ShortSteps,
    Steps,
    blocks,
)
from rankone.support.arrays import Array
from rankone.support.budget import unlimited
from rankone.support.costs import Cost, function_cost
from rankone.trajectories.events.event_trajectory import EventTrajectory, held_together
from rankone.trajectories.events.stretch_integrator import StretchTrajectories
from rankone.trajectories.integrators.integrator import NODES, DenseTrajectories, Path
from rankone.trajectories.integrators.workers import GroupedTrajectories
from rankone.trajectories.stacks.stack import has_smooth_rates
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import HiddenRate

_DOUBT = 10.0  # What a piece may hide, times its length, over the tolerance: samples see the rest
_SURPRISE = 1.0  # Rates that the longer piece did not suggest, times the length, over the tolerance
_STEADY = 0.5  # Least part of the largest rate on a piece at which rates are steady
_ROUNDINGS = 16.0  # Spacings of time in which no state stops
_MOST_NUMBERS = 4_000_000  # States at nodes that are held at once
_MOST_TIMES = 400  # Most times at which narrow quantities are checked
_TRIED = 6  # Steps of each kind that are tried by short steps, at least
_FEW_EVALUATIONS = 100_000  # Up to these all steps are tried, once those of each kind are
_ALL_EVALUATIONS = 1_000_000  # Of all short steps
_NOTHING = 1e-280  # Size of functions that are zero at all samples: there any doubt counts
_TO_NODES = np.vander(2.0 * NODES - 1.0, increasing=True)
# From values at the nodes of a piece to those that they suggest at the nodes of its halves
_TO_HALVES = tuple(
    np.vander(NODES + shift, NODES.size, increasing=True) @ np.linalg.inv(_TO_NODES)
    for shift in (-1.0, 0.0)
)


def hidden_rate(
    reference: Reference, system: System, sizes: Array, rtol: float
) -> HiddenRate | None:
    """Where steps of a reference miss something narrow, if they do.

    ``sizes`` (n,) are those of the states. Polynomials of low degree hide nothing. Array code, for
    many states, is not looked at; nor are trajectories of forced orders. Limits of the solve hold.
    """
    system = system if system.clock is None else system.clock.system
    if has_smooth_rates(system, reference.start):
        return None
    return _hidden(_taken_apart(reference), reference.points, system, sizes, rtol)


def hidden_rate_along(
    trajectories: Sequence[EventTrajectory],
    points: Array,
    system: System,
    sizes: Array,
    rtol: float,
) -> HiddenRate | None:
    """The same for trajectories at points (m, d) that each follow their own events."""
    if has_smooth_rates(system, system.horizon[0]):
        return None
    return _hidden(_of_each(trajectories), points, system, sizes, rtol)


def _hidden(
    parts: Iterable[tuple[list[Path], list[int]]],
    points: Array,
    system: System,
    sizes: Array,
    rtol: float,
) -> HiddenRate | None:
    """Where steps of paths miss something narrow, with the positions of their trajectories."""
    try:
        rates = enclosed(system.rhs)
    except UnsuitableError:
        return None
    tolerated = rtol * np.append(sizes, np.ones(system.n_differential))[: system.n_differential]
    with np.errstate(all="ignore"):
        for paths, owners in parts:
            steps = Steps.of(system.jumps.times, paths, owners, points)
            cost = function_cost(system.rhs, system.user_functions)
            look = _Look(rates, cost, steps, tolerated, _DOUBT)
            tried = ShortSteps(system, cost, steps, tolerated, rtol)
            if (place := _missed(look, tried)) is not None:
                return tried.hidden(place)
    return None


def hidden_times(reference: Reference, observed: Observation, rtol: float) -> Array:
    """When quantities are narrow between the steps of a reference, in order: (k,)."""
    try:
        function = enclosed(observed.written) if observed.written is not None else None
    except UnsuitableError:
        function = None
    if function is None:
        return np.empty(0)

    def quantities(
        times: Enclosure, states: Sequence[Enclosure], parameters: Sequence[Enclosure]
    ) -> Sequence[Enclosure]:
        read = [states[row] for row in observed.rows]
        return [Enclosure.of(row) for row in function(times, read, parameters, [])]

    times = list[float]()
    cost = function_cost(observed.written)
    with unlimited(), np.errstate(all="ignore"):
        for paths, owners in _taken_apart(reference):
            steps = Steps.of((), paths, owners, reference.points)
            seen = _Look(quantities, cost, steps, None, 1.0, rtol).seen()
            left = [] if seen.left is None else [seen.left]
            times += [steps.time(place.step, place.share) for place in [*seen.surprises, *left]]
    return np.unique(times)[:: max(len(times) // _MOST_TIMES, 1)]


@dataclass(frozen=True)
class Surprise:
    """Part of an interval in which functions surprised: its number, where it begins, its length.

    The latter two are shares of the interval.
    """

    interval: int
    lower: float
    length: float


def surprises(
    functions: Callable[..., Sequence[Enclosure]], cost: Cost, intervals: Intervals, rtol: float
) -> tuple[list[Surprise], int | None]:
    """Where functions are narrow between samples of intervals; one that remains in doubt."""
    with unlimited(), np.errstate(all="ignore"):
        seen = _Look(functions, cost, intervals, None, 1.0, rtol).seen()
    places = [Surprise(place.step, place.lower, place.length) for place in seen.surprises]
    return places, None if seen.left is None else seen.left.step


@dataclass(frozen=True)
class Intervals:
    """Intervals from times (S,), their lengths, parameters (d, S), and the points they belong to.

    ``read`` gives states (n, nodes, N) at times (nodes, N) of so many of them, by their numbers.
    """

    starts: Array
    lengths: Array
    parameters: Array
    owners: NDArray[np.intp]
    read: Callable[[Array, NDArray[np.intp]], Array]

    def at(self, pieces: Pieces) -> tuple[Array, Array]:
        """Times (nodes, N) and states (n, nodes, N) at the nodes of pieces."""
        times = self.starts[pieces.step] + self.lengths[pieces.step] * pieces.shares
        return times, self.read(times, pieces.step)


def _taken_apart(reference: Reference) -> Iterator[tuple[list[Path], list[int]]]:
    """Paths with the position of their trajectory, as many as are held at once."""
    first = 0
    for batch in reference.batches:
        count = batch.state.shape[1]
        size = batch.steps * NODES.size * batch.state.size // count
        together = max(_MOST_NUMBERS // max(size, 1), 1)
        for begin in range(0, count, together):
            some = slice(begin, min(begin + together, count))
            each = _paths(batch if together >= count else batch.of(some))
            of_paths = [(path, k) for k, own in enumerate(each, first + begin) for path in own]
            if of_paths:
                yield [path for path, _ in of_paths], [k for _, k in of_paths]
        first += count


def _of_each(trajectories: Sequence[EventTrajectory]) -> Iterator[tuple[list[Path], list[int]]]:
    """Paths with the position of their trajectory, as many as are held at once."""
    for some in held_together(trajectories):
        each = enumerate(trajectories[some], some.start)
        of_paths = [(path, k) for k, own in each for path in own.paths]
        yield [path for path, _ in of_paths], [k for _, k in of_paths]


def _paths(dense: DenseTrajectories) -> list[Sequence[Path]]:
    """The paths of each trajectory, one after the other; none for forced orders."""
    if isinstance(dense, StretchTrajectories):
        return [each.paths for each in dense.trajectories]
    if isinstance(dense, GroupedTrajectories):
        return [[path] for group in dense.groups for path in group.paths]
    return [[path] for path in getattr(dense, "paths", ())]


@dataclass(frozen=True)
class _Suggested:
    """Pieces, and the rates (n, nodes, N) that samples on longer ones suggest there."""

    pieces: Pieces
    rates: Array | None = None

    @classmethod
    def on_halves(cls, pieces: Pieces, rates: Array) -> _Suggested:
        """Both halves of pieces whose rates at nodes are (n, nodes, N)."""
        on_each = [np.einsum("kq,iqp->ikp", part, rates) for part in _TO_HALVES]
        return cls(pieces.halves(), np.concatenate(on_each, axis=2))

    @classmethod
    def joined(cls, each: Sequence[_Suggested]) -> _Suggested:
        """Some after the others."""
        rates = [one.rates for one in each if one.rates is not None]
        return cls(Pieces.joined([one.pieces for one in each]), np.concatenate(rates, axis=2))

    def some(self, chosen: slice | NDArray[np.bool_]) -> _Suggested:
        """Some of them."""
        rates = None if self.rates is None else self.rates[:, :, chosen]
        return _Suggested(self.pieces.some(chosen), rates)


@dataclass(frozen=True)
class _Seen:
    """Where functions surprised, and a place in doubt if there were too many to look at.

    Parts of steps (P,) that were looked at begin at shares ``lower``.
    """

    surprises: list[Place]
    left: Place | None
    step: NDArray[np.intp]
    lower: Array

    def parts(self, step: int) -> Array:
        """Shares (k,) at which a step was halved, from zero to one."""
        return np.append(np.unique(self.lower[self.step == step]), 1.0)

    def first(self, place: Place) -> Place:
        """The first place of the same step at which a function surprised: a layer begins there."""
        return min((p for p in self.surprises if p.step == place.step), key=lambda p: p.share)

    def kinds(self, steps: Steps) -> list[list[Place]]:
        """The largest surprise of each step, those of a kind together.

        Of one kind are surprises of the same function whose steps have the same position among
        those of their trajectory that surprise. Each kind begins with the largest, and goes on with
        some that are evenly spread.
        """
        by_step = {place.step: place for place in sorted(self.surprises, key=lambda p: p.surprise)}
        counts: dict[int, int] = {}
        kinds: dict[tuple[int, int], list[Place]] = {}
        for step, place in sorted(by_step.items()):
            owner = int(steps.owners[step])
            counts[owner] = counts.get(owner, 0) + 1
            kinds.setdefault((place.row, counts[owner]), []).append(place)
        return [_spread(sorted(kind, key=lambda p: -p.surprise)) for kind in kinds.values()]


def _spread(places: list[Place]) -> list[Place]:
    """Evenly spread ones first, in order, then the others."""
    first = np.unique(np.linspace(0, len(places) - 1, min(_TRIED, len(places))).astype(int))
    return [places[k] for k in [*first, *np.setdiff1d(np.arange(len(places)), first)]]


@dataclass(frozen=True)
class _Look:
    """A look at what functions hide on steps: at most so many tolerances count.

    They are rates if there are ``tolerated`` errors (n,) of states, to which they add by their
    length. Errors of other functions are relative to their size.
    """

    functions: Callable[..., Sequence[Enclosure]]
    cost: Cost
    steps: Steps | Intervals
    tolerated: Array | None
    most: float
    rtol: float = 0.0

    def seen(self) -> _Seen:
        """What is seen where steps are halved as long as they are in doubt.

        Where there are too many pieces, every second trajectory that is in doubt goes on.
        """
        suggested = _Suggested(pieces := Pieces.whole(self.steps.starts.size))
        places: list[Place] = []
        levels = [pieces]
        left = None
        tolerated = self._tolerated(pieces)
        allowance = Allowance(self.steps.owners)
        for _ in range(HALVINGS):
            if not pieces.step.size:
                break
            going_on = allowance.going_on(pieces)
            if going_on is None:
                left = self._in_doubt(pieces.some(slice(1)), tolerated)
                break
            suggested = suggested.some(going_on)
            parts = map(suggested.some, blocks(suggested.pieces.step.size))
            suggested = _Suggested.joined([self._look_at(p, tolerated, places) for p in parts])
            pieces = suggested.pieces
            levels.append(pieces)
        step = np.concatenate([each.step for each in levels])
        return _Seen(places, left, step, np.concatenate([each.lower for each in levels]))

    def _in_doubt(self, piece: Pieces, tolerated: Array) -> Place:
        """A single piece, and the function that is most in doubt there."""
        rows = self._rows(piece)[1]
        row = int(self._doubts(rows, 1.0 / tolerated[:, None]).argmax())
        lower, length = float(piece.lower[0]), float(piece.length[0])
        return Place(int(piece.step[0]), lower, length, lower + 0.5 * length, row)

    @staticmethod
    def _doubts(rows: Sequence[Enclosure], units: Array) -> Array:
        """Doubts of functions (n, N) in units."""
        doubts = [0.0 if row.doubt is None else row.doubt for row in rows]
        return np.stack(
            [np.broadcast_to(d, units.shape[1:]) * u for d, u in zip(doubts, units, strict=True)]
        )

    def _tolerated(self, pieces: Pieces) -> Array:
        """What may be wrong of each function, (n,)."""
        if self.tolerated is not None:
            return self.tolerated
        largest = [
            [np.abs(np.nan_to_num(row.values)).max() for row in self._rows(pieces.some(block))[1]]
            for block in blocks(pieces.step.size)
        ]
        sizes = np.max(largest, axis=0)
        return np.asarray(self.rtol * np.where(sizes > 0.0, sizes, _NOTHING))

    def _look_at(self, suggested: _Suggested, tolerated: Array, places: list[Place]) -> _Suggested:
        """The halves of pieces that are in doubt; places where functions surprised are added."""
        pieces, expected = suggested.pieces, suggested.rates
        times, rows = self._rows(pieces)
        values = np.stack([np.broadcast_to(row.values, times.shape) for row in rows])
        units = np.repeat(1.0 / tolerated[:, None], pieces.step.size, axis=1)
        if self.tolerated is not None:
            units *= self.steps.lengths[pieces.step] * pieces.length
        if expected is not None:
            apart = np.abs(np.nan_to_num(values - expected, nan=0.0, posinf=0.0, neginf=0.0))
            matters = apart > CHANGED * np.abs(expected).max(axis=1, keepdims=True)
            change = np.where(matters, self._lost(pieces, apart), apart * units[:, None])
            for k in np.flatnonzero(change.max(axis=(0, 1)) > _SURPRISE):
                row, node = np.unravel_index(change[:, :, k].argmax(), change.shape[:2])
                lower, length = float(pieces.lower[k]), float(pieces.length[k])
                share = lower + length * float(NODES[node])
                part = int(pieces.step[k]), lower, length, share
                places.append(Place(*part, int(row), float(change[row, node, k])))
        doubts, moving = self._doubts(rows, np.ones_like(units)), _moving(values)
        lost = self._lost(pieces, np.minimum(doubts, moving)[:, None])[:, 0]
        matters = doubts > CHANGED * moving
        doubts = np.where(matters, np.maximum(doubts * units, lost), doubts * units)
        doubtful = np.flatnonzero(doubts.max(axis=0) > self.most)
        return _Suggested.on_halves(pieces.some(doubtful), values[:, :, doubtful])

    def _lost(self, pieces: Pieces, changes: Array) -> Array:
        """What states lose if rates stay changed, in tolerances: (n, nodes, N) as the ``changes``.

        They stay so for the rest of the time, at most, however thin the place is: a state may come
        to rest in it, or move with it.
        """
        if self.tolerated is None or isinstance(self.steps, Intervals):
            return np.zeros_like(changes)
        lost = changes * self.steps.left[pieces.step] / self.tolerated[:, None, None]
        lengths = self.steps.lengths[pieces.step] * pieces.length
        rounding = _ROUNDINGS * np.spacing(np.abs(self.steps.starts[pieces.step]))
        return np.asarray(np.where(lengths > rounding, lost, 0.0))  # steps may be that short

    def _rows(self, pieces: Pieces) -> tuple[Array, Sequence[Enclosure]]:
        """Times (nodes, N), and enclosures of the functions on pieces."""
        times, states = self.steps.at(pieces)
        parameters = self.steps.parameters[:, pieces.step]
        return times, self.functions(*arguments(self.cost, times, states, parameters))


def _moving(rates: Array) -> Array:
    """Sizes on pieces of rates (n, nodes, N) that keep their sign: (n, N), NaN for others.

    It is the least one where they vary little, and else the largest: it may stop at some nodes.
    """
    least, most = np.abs(rates).min(axis=1), np.abs(rates).max(axis=1)
    size = np.where(least > _STEADY * most, least, most)
    return np.where(rates.min(axis=1) * rates.max(axis=1) > 0.0, size, np.nan)


def _missed(look: _Look, tried: ShortSteps) -> Place | None:
    """Where a step missed something that changes the trajectory, or doubts remain."""
    seen = look.seen()
    evaluations = 0
    for k, places in enumerate(itertools.zip_longest(*seen.kinds(tried.steps))):
        for place in filter(None, places):
            if evaluations > _ALL_EVALUATIONS:
                return place if k == 0 else seen.left
            if k >= _TRIED and evaluations > _FEW_EVALUATIONS:
                return seen.left
            for begin in dict.fromkeys([seen.first(place), place]):
                change, needed = tried.change(begin, seen.parts(place.step))
                evaluations += needed
                if change is not None:
                    return change
    return seen.left
