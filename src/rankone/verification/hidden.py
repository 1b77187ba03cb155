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
            look = _Look(system, rates, _Steps.of(system, paths, points), tolerated, rtol)
            if (place := look.place()) is not None:
                return look.hidden(place)
    return None


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
    def of(cls, system: System, paths: Sequence[Path], points: Array) -> _Steps:
        """All steps of paths; they leave out what is reset at their ends."""
        starts = np.concatenate([path.breaks[:-1] for path in paths])
        ends = np.concatenate([path.breaks[1:] for path in paths])
        nodal = np.concatenate([path.nodal for path in paths])
        before_jump = np.isin(ends, system.jumps.times)
        nodal[before_jump, -1] = np.tensordot(nodal[before_jump, :-1], _LAST[0], axes=(1, 0))
        counts = [path.steps for path in paths]
        near = insets(starts, ends)
        parameters = np.ascontiguousarray(np.repeat(points, counts, axis=0).T)
        return cls(starts + near, ends - starts - 2.0 * near, nodal, parameters)

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
    """Part of a step, and the state whose rate surprised there by so many tolerances."""

    step: int
    lower: float
    length: float
    state: int
    surprise: float


@dataclass(frozen=True)
class _Look:
    """A look at steps of a system; ``tolerated`` (n,) are errors of the states that count."""

    system: System
    rates: Callable[..., Sequence[Enclosure]]
    steps: _Steps
    tolerated: Array
    rtol: float

    def place(self) -> _Place | None:
        """Where a step missed something that changes the trajectory, or doubts remain."""
        surprises, left = self._surprises()
        by_step = {place.step: place for place in sorted(surprises, key=lambda p: p.surprise)}
        worst = sorted(by_step.values(), key=lambda p: -p.surprise)[:_TRIED]
        missed = next((place for place in worst if self._matters(place)), None)
        return missed or left

    def _surprises(self) -> tuple[list[_Place], _Place | None]:
        """Where rates surprised, and a place in doubt if there were too many to look at."""
        count = self.steps.starts.size
        pieces = _Pieces(np.arange(count), np.zeros(count), np.ones(count))
        once, each = _MOST_PIECES
        surprises: list[_Place] = []
        looked = 0
        for _ in range(_HALVINGS):
            looked += pieces.step.size
            if not pieces.step.size:
                break
            if looked > once + each * count:
                first = int(pieces.step[0]), float(pieces.lower[0]), float(pieces.length[0])
                return surprises, _Place(*first, 0, 0.0)
            blocks = [slice(a, a + _TOGETHER) for a in range(0, pieces.step.size, _TOGETHER)]
            halves = [self._look_at(pieces.some(block), surprises) for block in blocks]
            pieces = _joined(halves)
        return surprises, None

    def _look_at(self, pieces: _Pieces, surprises: list[_Place]) -> _Pieces:
        """The halves of pieces that are in doubt; where their rates surprised is added."""
        times, states = self.steps.at(pieces)
        rows = self._rows(times, states, self.steps.parameters[:, pieces.step])
        values = np.stack([np.broadcast_to(row.values, times.shape) for row in rows])
        spans = self.steps.lengths[pieces.step] * pieces.length
        units = spans / self.tolerated[:, None]
        if pieces.expected is not None:
            change = np.nan_to_num(values - pieces.expected, nan=0.0, posinf=0.0, neginf=0.0)
            change = np.abs(change).max(axis=1) * units
            for k in np.flatnonzero(change.max(axis=0) > _SURPRISE):
                state = int(change[:, k].argmax())
                part = int(pieces.step[k]), float(pieces.lower[k]), float(pieces.length[k])
                surprises.append(_Place(*part, state, float(change[state, k])))
        doubt = np.zeros(spans.shape)
        for row, unit in zip(rows, units, strict=True):
            if row.doubt is not None:
                doubt = np.maximum(doubt, row.doubt * unit)
        doubtful = np.flatnonzero(doubt > _DOUBT)
        return pieces.halves(doubtful, values[:, :, doubtful])

    def _rows(self, times: Array, states: Array, parameters: Array) -> Sequence[Enclosure]:
        """Enclosures of the rates at times (nodes, N), states (n, nodes, N), parameters (d, N)."""
        cost = function_cost(self.system.rhs, self.system.user_functions)
        charge(_CALL(0) + _ENCLOSURES * cost(times.size))
        return self.rates(
            Enclosure.of_samples(times, 0.0),
            [Enclosure.of_samples(state) for state in states],
            [Enclosure.of(parameter) for parameter in parameters],
        )

    def _matters(self, place: _Place) -> bool:
        """Whether short steps from before a surprise end the step elsewhere."""
        start, length = self.steps.starts[place.step], self.steps.lengths[place.step]
        before = max(place.lower - place.length, 0.0)
        piece = _Pieces(np.array([place.step]), np.array([before]), np.array([1.0 - before]))
        states = self.steps.at(piece)[1][:, :, 0]
        short = place.length / _SHORT_STEPS
        even = before + short * np.arange(4 * _SHORT_STEPS)
        growing = even[-1] + short * 2.0 ** np.arange(1.0, _HALVINGS + 10.0)
        shares = np.append(even[even < 1.0], [*growing[growing < 1.0], 1.0])
        end = self._by_short_steps(place.step, start + length * shares, states[:, 0])
        if end is None:
            return True
        return bool((np.abs(end - states[:, -1]) > _DIFFERENCE * self.tolerated).any())

    def _by_short_steps(self, step: int, times: Array, state: Array) -> Array | None:
        """The state at the last of times at which steps begin anew; None if there are too many."""
        p = self.steps.parameters[:, step : step + 1]
        cost = function_cost(self.system.rhs, self.system.user_functions)

        def rates(t: float, y: Array) -> Array:
            charge(cost(1))
            return np.asarray(self.system.rhs(t, y[:, None], p))[:, 0]

        evaluations = 0
        for a, b in itertools.pairwise(times.tolist()):
            relative = max(_ACCURACY * self.rtol, 1e-12)
            absolute = np.maximum(_ACCURACY * relative * self.tolerated / self.rtol, 1e-300)
            solved = solve_ivp(rates, (a, b), state, "LSODA", rtol=relative, atol=absolute)
            evaluations += solved.nfev
            if not solved.success or evaluations > _MOST_EVALUATIONS:
                return None
            state = solved.y[:, -1]
        return state

    def hidden(self, place: _Place) -> HiddenRate:
        """What to say of a place."""
        middle = place.lower + 0.5 * place.length
        time = self.steps.starts[place.step] + middle * self.steps.lengths[place.step]
        parameters = self.steps.parameters[:, place.step].tolist()
        at = zip(self.system.parameters, parameters, strict=True)
        return HiddenRate(self.system.states[place.state], float(time), tuple(at))


def _joined(pieces: Sequence[_Pieces]) -> _Pieces:
    """Pieces one after the other."""
    expected = [each.expected for each in pieces if each.expected is not None]
    return _Pieces(
        np.concatenate([each.step for each in pieces]),
        np.concatenate([each.lower for each in pieces]),
        np.concatenate([each.length for each in pieces]),
        np.concatenate(expected, axis=2),
    )
