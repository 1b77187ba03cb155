"""Rates that are narrow between the steps of reference trajectories, where no step saw them.

Each step is looked at through :mod:`enclosures <rankone.verification.enclosures>` of the rates.
Where they may hide so much that it matters, the step is halved, and only the halves in doubt are
looked at again. Doubts about smooth rates vanish after a few halvings; a hidden peak keeps its
height until its width is reached, and then samples see it. Whether that changes the trajectory is
tried by short steps. Peaks wider than a hundredth of a step are left to the defects at random
places of :mod:`rankone.trajectories.defects`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from rankone.discretization.radau import insets
from rankone.ir.observation import Observation
from rankone.ir.system import System
from rankone.ir.verdict import HiddenRate
from rankone.support.arrays import Array
from rankone.support.budget import charge, unlimited
from rankone.support.costs import Cost, function_cost
from rankone.trajectories.compiled import TaylorTrajectories
from rankone.trajectories.events.stretch_integrator import StretchTrajectories
from rankone.trajectories.groups import GroupedTrajectories
from rankone.trajectories.integrator import DenseTrajectories
from rankone.trajectories.paths import NODES, Path, step_coefficients
from rankone.trajectories.stacks.integrator import has_smooth_rates
from rankone.verification.enclosures import Enclosure, UnsuitableError, enclosed
from rankone.verification.reference import Reference

_DOUBT = (
    10.0  # What a piece may hide, times its length, over the tolerance: less is left to samples
)
_SURPRISE = 1.0  # Rates that the longer piece did not suggest, times the length, over the tolerance
_DIFFERENCE = 0.3  # Difference to a trajectory by short steps, over the tolerance, that matters
_HALVINGS = 42  # Most halvings of a step: then it is about as short as rounding
_MOST_PIECES = (20_000, 20)  # Pieces looked at, at most: once, and for each step
_TOGETHER = 1024  # Pieces evaluated together: what is in work fits the cache
_MOST_NUMBERS = 4_000_000  # States at nodes that are held at once
_MOST_TIMES = 400  # Most times at which narrow quantities are checked
_TRIED = 6  # Trajectories that are tried by short steps, those with the largest surprises
_SHORT_STEPS = 8  # Steps over what surprised, at least
_ACCURACY = 1e-2  # Tolerance of short steps over that of the solve
_MOST_EVALUATIONS = 50_000  # Of the rates by short steps
_ENCLOSURES = 4.0  # Operations of enclosures and samples over those of the samples alone
_CALL = Cost(2e5, 0.0)  # Operations of an evaluation besides the rates
_TO_NODES = np.vander(2.0 * NODES - 1.0, increasing=True)
# From values at the nodes of a piece to those that they suggest at the nodes of its halves
_TO_HALVES = tuple(
    np.vander(NODES + shift, NODES.size, increasing=True) @ np.linalg.inv(_TO_NODES)
    for shift in (-1.0, 0.0)
)
# From values at all nodes but the last one to that one
_LAST = np.vander([1.0], NODES.size - 1, increasing=True) @ np.linalg.inv(_TO_NODES[:-1, :-1])


def hidden_rate(
    reference: Reference, system: System, sizes: Array, rtol: float
) -> HiddenRate | None:
    """Where steps of a reference miss something narrow, if they do.

    ``sizes`` (n,) are those of the states. Polynomials of low degree hide nothing. Array code, for
    many states, is not looked at; nor are trajectories of forced orders.
    """
    system = system if system.clock is None else system.clock.system
    if has_smooth_rates(system, reference.start):
        return None
    try:
        rates = enclosed(system.rhs)
    except UnsuitableError:
        return None
    tolerated = rtol * np.append(sizes, np.ones(system.n_differential))[: system.n_differential]
    with unlimited(), np.errstate(all="ignore"):
        for paths, points in _taken_apart(reference):
            steps = _Steps.of(system.jumps.times, paths, points)
            cost = function_cost(system.rhs, system.user_functions)
            look = _Look(rates, cost, steps, tolerated, _DOUBT)
            tried = _ShortSteps(system, cost, steps, tolerated, rtol)
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
        for paths, points in _taken_apart(reference):
            steps = _Steps.of((), paths, points)
            look = _Look(quantities, cost, steps, None, 1.0, rtol)
            surprises, left = look.surprises()
            times += [
                steps.time(place) for place in (surprises if left is None else [*surprises, left])
            ]
    return np.unique(times)[:: max(len(times) // _MOST_TIMES, 1)]


def _taken_apart(reference: Reference) -> Iterator[tuple[list[Path], Array]]:
    """Paths with a point (d,) for each, as many as are held at once."""
    first = 0
    for batch in reference.batches:
        count = batch.state.shape[1]
        size = batch.steps * NODES.size * batch.state.size // count
        together = max(_MOST_NUMBERS // max(size, 1), 1)
        for begin in range(0, count, together):
            some = slice(begin, min(begin + together, count))
            points = reference.points[first + some.start : first + some.stop]
            paths = _paths(batch if together >= count else batch.of(some))
            of_paths = [(path, p) for own, p in zip(paths, points, strict=False) for path in own]
            if of_paths:
                yield [path for path, _ in of_paths], np.array([p for _, p in of_paths])
        first += count


def _paths(dense: DenseTrajectories) -> list[Sequence[Path]]:
    """The paths of each trajectory, one after the other; none for forced orders."""
    if isinstance(dense, StretchTrajectories):
        return [each.paths for each in dense.trajectories]
    if isinstance(dense, GroupedTrajectories):
        return [[path] for group in dense.groups for path in group.paths]
    if isinstance(dense, TaylorTrajectories):
        return [[_of_series(dense.of(slice(k, k + 1)))] for k in range(dense.state.shape[1])]
    return [[path] for path in getattr(dense, "paths", ())]


def _of_series(series: TaylorTrajectories) -> Path:
    """The path of one trajectory that is known by series."""
    steps = np.arange(series.starts.size)
    nodal = np.stack([series.within(steps, share * series.lengths) for share in NODES], axis=1)
    breaks = np.append(series.starts, series.starts[-1] + series.lengths[-1])
    return Path(breaks, nodal, nodal[-1, -1])


@dataclass(frozen=True)
class _Steps:
    """Steps from times (S,), their lengths, states (S, nodes, n) and parameters (d, S)."""

    starts: Array
    lengths: Array
    nodal: Array
    parameters: Array

    @classmethod
    def of(cls, jumps: Sequence[float], paths: Sequence[Path], points: Array) -> _Steps:
        """All steps of paths; they leave out what is reset at jumps."""
        starts = np.concatenate([path.breaks[:-1] for path in paths])
        ends = np.concatenate([path.breaks[1:] for path in paths])
        nodal = np.concatenate([path.nodal for path in paths])
        before_jump = np.isin(ends, jumps)
        nodal[before_jump, -1] = np.tensordot(nodal[before_jump, :-1], _LAST[0], axes=(1, 0))
        counts = [path.steps for path in paths]
        near = insets(starts, ends)
        parameters = np.ascontiguousarray(np.repeat(points, counts, axis=0).T)
        return cls(starts + near, ends - starts - 2.0 * near, nodal, parameters)

    def time(self, place: _Place) -> float:
        """The time at which rates surprised."""
        return float(self.starts[place.step] + self.lengths[place.step] * place.share)

    def at(self, pieces: _Pieces) -> tuple[Array, Array]:
        """Times (nodes, N) and states (n, nodes, N) at the nodes of pieces."""
        shares = pieces.lower + pieces.length * NODES[:, None]
        times = self.starts[pieces.step] + self.lengths[pieces.step] * shares
        if (pieces.length == 1.0).all():
            return times, np.ascontiguousarray(self.nodal[pieces.step].transpose(2, 1, 0))
        powers = np.vander((2.0 * shares - 1.0).ravel(), NODES.size, increasing=True)
        powers = powers.reshape(*shares.shape, -1)
        states = np.einsum("kpq,qpn->nkp", powers, step_coefficients(self.nodal[pieces.step]))
        return times, np.asarray(states)


@dataclass(frozen=True)
class _Pieces:
    """Parts of steps, by the share where each begins and its length, all (N,).

    ``expected`` are rates (n, nodes, N) that samples on longer pieces suggest.
    """

    step: NDArray[np.intp]
    lower: Array
    length: Array
    expected: Array | None = None

    def some(self, chosen: slice) -> _Pieces:
        """Some of them."""
        expected = None if self.expected is None else self.expected[:, :, chosen]
        return _Pieces(self.step[chosen], self.lower[chosen], self.length[chosen], expected)

    def halves(self, doubtful: NDArray[np.intp], rates: Array) -> _Pieces:
        """Both halves of those in doubt, whose rates at nodes are (n, nodes, N)."""
        half = 0.5 * self.length[doubtful]
        lower = self.lower[doubtful]
        expected = [np.einsum("kq,iqp->ikp", part, rates) for part in _TO_HALVES]
        return _Pieces(
            np.tile(self.step[doubtful], 2),
            np.concatenate([lower, lower + half]),
            np.tile(half, 2),
            np.concatenate(expected, axis=2),
        )


@dataclass(frozen=True)
class _Place:
    """Part of a step, and the function that surprised there at a share, by so many tolerances."""

    step: int
    lower: float
    length: float
    share: float
    row: int = 0
    surprise: float = 0.0


@dataclass(frozen=True)
class _Look:
    """A look at what functions hide on steps: at most so many tolerances count.

    They are rates if there are ``tolerated`` errors (n,) of states, to which they add by their
    length. Errors of other functions are relative to their size.
    """

    functions: Callable[..., Sequence[Enclosure]]
    cost: Cost
    steps: _Steps
    tolerated: Array | None
    most: float
    rtol: float = 0.0

    def surprises(self) -> tuple[list[_Place], _Place | None]:
        """Where functions surprised, and a place in doubt if there were too many to look at."""
        count = self.steps.starts.size
        pieces = _Pieces(np.arange(count), np.zeros(count), np.ones(count))
        once, each = _MOST_PIECES
        places: list[_Place] = []
        tolerated = self._tolerated(pieces)
        looked = 0
        for _ in range(_HALVINGS):
            looked += pieces.step.size
            if not pieces.step.size:
                break
            if looked > once + each * count:
                lower, length = float(pieces.lower[0]), float(pieces.length[0])
                middle = lower + 0.5 * length
                return places, _Place(int(pieces.step[0]), lower, length, middle)
            blocks = [slice(a, a + _TOGETHER) for a in range(0, pieces.step.size, _TOGETHER)]
            halves = [self._look_at(pieces.some(block), tolerated, places) for block in blocks]
            pieces = _joined(halves)
        return places, None

    def _tolerated(self, pieces: _Pieces) -> Array:
        """What may be wrong of each function, (n,)."""
        if self.tolerated is not None:
            return self.tolerated
        blocks = [slice(a, a + _TOGETHER) for a in range(0, pieces.step.size, _TOGETHER)]
        largest = [
            [np.abs(np.nan_to_num(row.values)).max() for row in self._rows(pieces.some(block))[1]]
            for block in blocks
        ]
        sizes = np.max(largest, axis=0)
        return np.asarray(self.rtol * np.where(sizes > 0.0, sizes, 1.0))

    def _look_at(self, pieces: _Pieces, tolerated: Array, places: list[_Place]) -> _Pieces:
        """The halves of pieces that are in doubt; places where functions surprised are added."""
        times, rows = self._rows(pieces)
        values = np.stack([np.broadcast_to(row.values, times.shape) for row in rows])
        units = np.repeat(1.0 / tolerated[:, None], pieces.step.size, axis=1)
        if self.tolerated is not None:
            units *= self.steps.lengths[pieces.step] * pieces.length
        if pieces.expected is not None:
            change = np.nan_to_num(values - pieces.expected, nan=0.0, posinf=0.0, neginf=0.0)
            change = np.abs(change) * units[:, None]
            for k in np.flatnonzero(change.max(axis=(0, 1)) > _SURPRISE):
                row, node = np.unravel_index(change[:, :, k].argmax(), change.shape[:2])
                lower, length = float(pieces.lower[k]), float(pieces.length[k])
                share = lower + length * float(NODES[node])
                part = int(pieces.step[k]), lower, length, share
                places.append(_Place(*part, int(row), float(change[row, node, k])))
        doubt = np.zeros(pieces.step.size)
        for enclosure, unit in zip(rows, units, strict=True):
            if enclosure.doubt is not None:
                doubt = np.maximum(doubt, enclosure.doubt * unit)
        doubtful = np.flatnonzero(doubt > self.most)
        return pieces.halves(doubtful, values[:, :, doubtful])

    def _rows(self, pieces: _Pieces) -> tuple[Array, Sequence[Enclosure]]:
        """Times (nodes, N), and enclosures of the functions on pieces."""
        times, states = self.steps.at(pieces)
        charge(_CALL(0) + _ENCLOSURES * self.cost(times.size))
        return times, self.functions(
            Enclosure.of_samples(times, 0.0),
            [Enclosure.of_samples(state) for state in states],
            [Enclosure.of(parameter) for parameter in self.steps.parameters[:, pieces.step]],
        )


def _missed(look: _Look, tried: _ShortSteps) -> _Place | None:
    """Where a step missed something that changes the trajectory, or doubts remain."""
    surprises, left = look.surprises()
    by_step = {place.step: place for place in sorted(surprises, key=lambda p: p.surprise)}
    worst = sorted(by_step.values(), key=lambda p: -p.surprise)[:_TRIED]
    return next((place for place in worst if tried.change(place)), left)


@dataclass(frozen=True)
class _ShortSteps:
    """Tries whether short steps from before a surprise end a step elsewhere."""

    system: System
    cost: Cost
    steps: _Steps
    tolerated: Array
    rtol: float

    def change(self, place: _Place) -> bool:
        """Whether they end elsewhere, or do not end."""
        start, length = self.steps.starts[place.step], self.steps.lengths[place.step]
        before = max(place.lower - place.length, 0.0)
        piece = _Pieces(np.array([place.step]), np.array([before]), np.array([1.0 - before]))
        states = self.steps.at(piece)[1][:, :, 0]
        short = place.length / _SHORT_STEPS
        even = before + short * np.arange(4 * _SHORT_STEPS)
        growing = even[-1] + short * 2.0 ** np.arange(1.0, _HALVINGS + 10.0)
        shares = np.append(even[even < 1.0], [*growing[growing < 1.0], 1.0])
        end = self._end(place.step, start + length * shares, states[:, 0])
        if end is None:
            return True
        return bool((np.abs(end - states[:, -1]) > _DIFFERENCE * self.tolerated).any())

    def _end(self, step: int, times: Array, state: Array) -> Array | None:
        """The state at the last of times at which steps begin anew; None if there are too many."""
        p = self.steps.parameters[:, step : step + 1]

        def rates(t: float, y: Array) -> Array:
            charge(self.cost(1))
            return np.asarray(self.system.rhs(t, y[:, None], p))[:, 0]

        evaluations = 0
        relative = max(_ACCURACY * self.rtol, 1e-12)
        absolute = np.maximum(_ACCURACY * relative * self.tolerated / self.rtol, 1e-300)
        for a, b in itertools.pairwise(times.tolist()):
            solved = solve_ivp(rates, (a, b), state, "LSODA", rtol=relative, atol=absolute)
            evaluations += solved.nfev
            if not solved.success or evaluations > _MOST_EVALUATIONS:
                return None
            state = solved.y[:, -1]
        return state

    def hidden(self, place: _Place) -> HiddenRate:
        """What to say of a place."""
        parameters = self.steps.parameters[:, place.step].tolist()
        at = zip(self.system.parameters, parameters, strict=True)
        return HiddenRate(self.system.states[place.row], self.steps.time(place), tuple(at))


def _joined(pieces: Sequence[_Pieces]) -> _Pieces:
    """Pieces one after the other."""
    expected = [each.expected for each in pieces if each.expected is not None]
    return _Pieces(
        np.concatenate([each.step for each in pieces]),
        np.concatenate([each.lower for each in pieces]),
        np.concatenate([each.length for each in pieces]),
        np.concatenate(expected, axis=2),
    )
