"""Steps of trajectories, and the pieces into which they are halved where something surprised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import Cost
from rankone.tensors.bases.time_grid import insets
from rankone.trajectories.integrators.integrator import NODES, Path, step_coefficients
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import HiddenRate

CHANGED = 0.01
"""Part of a rate by which it changes where a state may stay behind, or run ahead, for long."""

HALVINGS = 42
"""Most halvings of a step: then it is about as short as rounding."""
_MOST_PIECES = (20_000, 20)  # Pieces looked at, at most: once, and for each step
_LEAST_TRAJECTORIES = 4  # That are looked at where there are too many pieces
_TOGETHER = 4096  # Pieces evaluated together: what is in work fits the cache
# From values at all nodes but the last one to that one
_BASIS = np.vander(2.0 * NODES[:-1] - 1.0, increasing=True)
_LAST = np.vander([1.0], NODES.size - 1, increasing=True) @ np.linalg.inv(_BASIS)


@dataclass(frozen=True)
class Pieces:
    """Parts of steps, by the share where each begins and its length, all (N,)."""

    step: NDArray[np.intp]
    lower: Array
    length: Array

    @classmethod
    def whole(cls, count: int) -> Pieces:
        """So many whole steps."""
        return cls(np.arange(count), np.zeros(count), np.ones(count))

    @classmethod
    def joined(cls, each: Sequence[Pieces]) -> Pieces:
        """Some after the others."""
        return cls(
            np.concatenate([pieces.step for pieces in each]),
            np.concatenate([pieces.lower for pieces in each]),
            np.concatenate([pieces.length for pieces in each]),
        )

    @property
    def shares(self) -> Array:
        """Shares (nodes, N) of steps at the nodes of pieces."""
        return np.asarray(self.lower + self.length * NODES[:, None])

    def some(self, chosen: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Pieces:
        """Some of them."""
        return Pieces(self.step[chosen], self.lower[chosen], self.length[chosen])

    def halves(self) -> Pieces:
        """The first halves of all, and then the second ones."""
        half = 0.5 * self.length
        lower = np.concatenate([self.lower, self.lower + half])
        return Pieces(np.tile(self.step, 2), lower, np.tile(half, 2))


@dataclass(frozen=True)
class Steps:
    """Steps from times (S,), their lengths, states (S, nodes, n) and parameters (d, S).

    ``owners`` (S,) are the positions of their trajectories, whose ends are ``left`` (S,) later.
    """

    starts: Array
    lengths: Array
    nodal: Array
    parameters: Array
    owners: NDArray[np.intp]
    left: Array

    @classmethod
    def of(
        cls, jumps: Sequence[float], paths: Sequence[Path], owners: Sequence[int], points: Array
    ) -> Steps:
        """All steps of paths; they leave out what is reset at jumps."""
        starts = np.concatenate([path.breaks[:-1] for path in paths])
        ends = np.concatenate([path.breaks[1:] for path in paths])
        nodal = np.concatenate([path.nodal for path in paths])
        before_jump = np.isin(ends, jumps)
        nodal[before_jump, -1] = np.tensordot(nodal[before_jump, :-1], _LAST[0], axes=(1, 0))
        of_steps = np.repeat(owners, [path.steps for path in paths])
        near = insets(starts, ends)
        parameters = np.ascontiguousarray(points[of_steps].T)
        last = np.full(len(points), -np.inf)
        np.maximum.at(last, of_steps, ends)
        lengths, left = ends - starts - 2.0 * near, last[of_steps] - starts
        return cls(starts + near, lengths, nodal, parameters, of_steps, left)

    def before(self, end: float) -> Steps:
        """Those that begin before an end."""
        early = self.starts < end
        return Steps(
            self.starts[early],
            self.lengths[early],
            self.nodal[early],
            self.parameters[:, early],
            self.owners[early],
            self.left[early],
        )

    def times(self, step: NDArray[np.intp] | int, shares: Array) -> Array:
        """Times (..., N) at shares (..., N) of steps (N,), or of one step."""
        return np.asarray(self.starts[step] + self.lengths[step] * shares)

    def time(self, step: int, share: float) -> float:
        """The time at a share of a step."""
        return float(self.starts[step] + self.lengths[step] * share)

    def following(self, step: int) -> int | None:
        """The step of the same trajectory that begins where one ends, if there is one."""
        further = step + 1
        if further >= self.starts.size or self.owners[further] != self.owners[step]:
            return None
        between = self.starts[further] - self.time(step, 1.0)
        insets_at_most = 0.5 * (self.lengths[step] + self.lengths[further])
        return further if 0.0 <= between <= insets_at_most else None

    def states(self, step: NDArray[np.intp], shares: Array) -> Array:
        """States (n, K, N) at shares (K, N) of steps (N,)."""
        powers = np.vander((2.0 * shares - 1.0).ravel(), NODES.size, increasing=True)
        powers = powers.reshape(*shares.shape, -1)
        return np.asarray(np.einsum("kpq,qpn->nkp", powers, step_coefficients(self.nodal[step])))

    def at(self, pieces: Pieces) -> tuple[Array, Array]:
        """Times (nodes, N) and states (n, nodes, N) at the nodes of pieces."""
        times = self.times(pieces.step, pieces.shares)
        if (pieces.length == 1.0).all():
            return times, np.ascontiguousarray(self.nodal[pieces.step].transpose(2, 1, 0))
        return times, self.states(pieces.step, pieces.shares)


class Allowance:
    """How many pieces may be looked at of steps whose trajectories are ``owners`` (S,)."""

    def __init__(self, owners: NDArray[np.intp]) -> None:
        self._owners, self._looked = owners, 0
        once, each = _MOST_PIECES
        self._most = once + each * owners.size

    def going_on(self, pieces: Pieces) -> slice | NDArray[np.bool_] | None:
        """Which pieces may be looked at next; None where these are still too many.

        Where all are too many, those of every second trajectory go on, down to a few.
        """
        self._looked += pieces.step.size
        if self._looked <= self._most:
            return slice(None)
        owners = self._owners[pieces.step]
        distinct = np.unique(owners)
        if distinct.size <= _LEAST_TRAJECTORIES:
            return None
        self._most += self._most // 4
        return np.isin(owners, distinct[::2])


def blocks(count: int) -> list[slice]:
    """Parts of so many pieces that are evaluated together."""
    return [slice(a, a + _TOGETHER) for a in range(0, count, _TOGETHER)]


@dataclass(frozen=True)
class Place:
    """Part of a step, and the function that surprised there at a share, by so many tolerances."""

    step: int
    lower: float
    length: float
    share: float
    row: int = 0
    surprise: float = 0.0


# -----------------------------------------------------------------------------
# Short steps over a step of a reference that has surprised: whether they change the trajectory.


_DIFFERENCE = 0.3  # Difference to a trajectory by short steps, over the tolerance, that matters
_SHORT_STEPS = 4  # Steps over each part of a step, at least
_ACCURACY = 1e-2  # Tolerance of short steps over that of the solve
_MOST_EVALUATIONS = 20_000  # Of the rates by short steps over a step
_TWICE = 2.0  # How long a state is followed that may stay behind, over what it takes to tell


class _TooManyError(Exception):
    """Short steps take too many evaluations."""


@dataclass
class _ShortTrajectory:
    """A trajectory by short steps: its state (n,), and the evaluations that it took."""

    system: System
    cost: Cost
    parameters: Array
    tolerances: tuple[float, Array]
    state: Array
    evaluations: int = 0

    def goes_on(self, start: float, length: float, part: float) -> bool:
        """Whether it goes on from a time over a length, by several steps over each such part."""
        relative, absolute = self.tolerances
        try:
            solved = solve_ivp(
                lambda since, y: self.rates(start + since, y),
                (0.0, length),
                self.state,
                "LSODA",
                rtol=relative,
                atol=absolute,
                max_step=part / _SHORT_STEPS,
            )
        except _TooManyError:
            return False
        self.state = solved.y[:, -1]
        return bool(solved.success)

    def rates(self, time: float, state: Array) -> Array:
        """The rates (n,) of a state."""
        self.evaluations += 1
        if self.evaluations > _MOST_EVALUATIONS:
            raise _TooManyError
        charge(self.cost(1))
        return np.asarray(self.system.rhs(time, state[:, None], self.parameters))[:, 0]


@dataclass(frozen=True)
class ShortSteps:
    """Tries whether short steps follow a trajectory over a step that has surprised."""

    system: System
    cost: Cost
    steps: Steps
    tolerated: Array
    rtol: float

    def change(self, place: Place, parts: Array) -> tuple[Place | None, int]:
        """Where they leave it, or do not go on; and how many evaluations that took.

        They begin anew where ``parts``, between shares of the step, become longer or shorter, and
        where rates surprised, at the very state that did: what is narrow there may be thinner than
        the parts, and than the difference to a trajectory by short steps.
        """
        begins, longest = self._begins(place, parts)
        ends = np.append(begins[1:], 1.0)
        start, length = self.steps.starts[place.step], self.steps.lengths[place.step]
        whole = Pieces(np.full(begins.size, place.step), begins, ends - begins)
        states = self.steps.at(whole)[1]
        short = self._begun(place.step, states[:, 0, 0])
        for k, (a, b) in enumerate(zip(begins, ends, strict=True)):
            span = float(start + length * a), float(length * (b - a)), float(longest[k] * length)
            at_surprise = replace(short, state=states[:, 0, k]) if a == place.share else short
            if at_surprise.goes_on(*span):
                short = at_surprise
            elif at_surprise is short or not short.goes_on(*span):  # it may not begin in a peak
                return place, short.evaluations
            row = self._left(short.state, states[:, -1, k])
            if row is not None:
                share, part = float(a), float(b - a)
                left = Place(place.step, share, part, share + 0.5 * part, row)
                return left, short.evaluations
        return self._change_behind(place, short), short.evaluations

    def _begun(self, step: int, state: Array) -> _ShortTrajectory:
        """A trajectory that begins at a state (n,) of a step."""
        relative = max(_ACCURACY * self.rtol, 1e-12)
        absolute = np.maximum(_ACCURACY * relative * self.tolerated / self.rtol, 1e-300)
        p = self.steps.parameters[:, step : step + 1]
        return _ShortTrajectory(self.system, self.cost, p, (relative, absolute), state)

    def _left(self, state: Array, expected: Array) -> int | None:
        """The state that differs most from what is expected, (n,) both, if that matters."""
        change = np.abs(state - expected) / self.tolerated
        if (change <= _DIFFERENCE).all():
            return None
        return int(np.nan_to_num(change, nan=np.inf).argmax())

    def _change_behind(self, place: Place, short: _ShortTrajectory) -> Place | None:
        """Where short steps leave the trajectory behind a step at whose end rates differ.

        Steps may be so short that a state has not stayed behind by much so far.
        """
        step = place.step
        end = self.steps.time(step, 1.0)
        until = end + self._needed(step, short)
        following = self._following(step)
        while end < until and following is not None:
            start, length = self.steps.starts[following], self.steps.lengths[following]
            if not short.goes_on(float(start), float(length), float(length)):
                return place
            row = self._left(short.state, self.steps.nodal[following, -1])
            if row is not None:
                return Place(following, 0.0, 1.0, 0.5, row)
            end = self.steps.time(following, 1.0)
            following = self._following(following)
        return None

    def _following(self, step: int) -> int | None:
        """The step that goes on where one ends, without a jump of the states."""
        following = self.steps.following(step)
        if following is None:
            return None
        jump = np.abs(self.steps.nodal[following, 0] - self.steps.nodal[step, -1])
        return following if (jump <= _ACCURACY * self.tolerated).all() else None

    def _needed(self, step: int, short: _ShortTrajectory) -> float:
        """How long it takes to tell whether a state goes on otherwise at the end of a step."""
        end, left = self.steps.time(step, 1.0), self.steps.left[step] - self.steps.lengths[step]
        rates = short.rates(end, self.steps.nodal[step, -1])
        apart = np.abs(short.rates(end, short.state) - rates)
        apart = np.where(apart > CHANGED * np.abs(rates), apart, 0.0)
        times = _TWICE * _DIFFERENCE * self.tolerated / apart
        return float(times[times < left].max(initial=0.0))

    @staticmethod
    def _begins(place: Place, parts: Array) -> tuple[Array, Array]:
        """Shares of the step where short steps begin anew, and the parts that they are within."""
        lengths = np.diff(parts)
        firsts = np.flatnonzero(np.append(True, np.abs(np.diff(lengths)) > 0.1 * lengths[1:]))
        begins, longest = parts[firsts], lengths[firsts]
        before = int(np.searchsorted(begins, place.share, side="right")) - 1
        if begins[before] == place.share or place.share >= 1.0:
            return begins, longest
        begins = np.insert(begins, before + 1, place.share)
        return begins, np.insert(longest, before + 1, longest[before])

    def hidden(self, place: Place) -> HiddenRate:
        """What to say of a place."""
        parameters = self.steps.parameters[:, place.step].tolist()
        at = zip(self.system.parameters, parameters, strict=True)
        time = self.steps.time(place.step, place.share)
        return HiddenRate(self.system.states[place.row], time, tuple(at))
