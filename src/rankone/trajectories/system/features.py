"""What a system has beside its rates: events, features that are not smooth, jumps, constraints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.support.arrays import (
    COINCIDENT,
    EPSILON,
    HALVINGS,
    MINOR,
    MOST_ROUNDS,
    NEGLIGIBLE,
    TINY,
    Array,
)
from rankone.support.budget import charge
from rankone.support.costs import CALL, pseudo_inverse
from rankone.support.errors import ProblemError, quote, warn

RISING, FALLING, BOTH = 1, -1, 0

# Maps times (N,), states (n, N) and parameters (d, N) to numbers (N,), or to states (n, N)
OfTrajectory: TypeAlias = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True)
class Row:
    """One row of a generated function."""

    function: OfTrajectory
    row: int

    def __call__(self, times: Array, states: Array, parameters: Array) -> Array:
        return np.asarray(self.function(times, states, parameters)[self.row])


CROSSINGS = 2
"""Crossings of a marker in a period of an oscillator: rising and falling."""


@dataclass(frozen=True)
class Marker:
    """A state that crosses a level, in both directions, where stretches end."""

    state: int
    level: float


@dataclass(frozen=True)
class SystemEvent:
    """A root of ``when``, rising (1), falling (-1) or both (0).

    ``then`` maps the states before it to those after it; it ends the trajectory if ``terminal``.
    ``at`` maps parameters (d, N) to its times (N,) where they are known; then it happens once,
    unless that is before the start. Where they are affine, ``coefficients`` are the constant and
    the slope of each parameter. With a ``delay`` the states are reset that much later, unless
    ``when`` turns back and the event is not ``persistent``; a further root before that is an error
    unless they may be ``overlapping``. Of several at one instant the one of the highest
    ``priority`` is first. It is ``timed`` if it is no event of the user; rates switch
    at a ``switch``, which resets sides of surfaces alone; it ``starts`` or ``cancels`` the event at
    that position, whose times trajectories tell one by one. It may be that of a ``marker``.
    """

    when: OfTrajectory
    direction: int = BOTH
    then: OfTrajectory | None = None
    terminal: bool = False
    name: str = ""
    at: Callable[[Array], Array] | None = None
    timed: bool = False
    switch: bool = False
    delay: OfTrajectory | None = None
    priority: OfTrajectory | None = None
    persistent: bool = True
    overlapping: bool = True
    starts: int | None = None
    cancels: int | None = None
    coefficients: tuple[float, ...] | None = None
    marker: Marker | None = None

    @property
    def interrupts(self) -> bool:
        """Whether the trajectory does not go on as if nothing had been."""
        acts_later = self.starts is not None or self.cancels is not None
        return self.terminal or self.switch or self.then is not None or acts_later

    @property
    def jumps(self) -> bool:
        """Whether values of the solution jump there, or end."""
        return self.terminal or (self.then is not None and not self.switch)


def overlap(name: str, place: str) -> ProblemError:
    """The error for an event that is set off again before its delay is over."""
    return ProblemError(
        f"event {quote(name)} is set off again at {place}, while an earlier one is still to come: "
        "its new values, taken when it is set off, would be overwritten",
        term=name,
        remedy="let its delay be shorter than the time between two of them, or take its values "
        'after the delay (useValuesFromTriggerTime="false" in SBML)',
    )


OfPoints: TypeAlias = Callable[[Array], Array]
"""Maps points (m, d) to numbers (m,)."""


@dataclass(frozen=True)
class Foreseen:
    """About the ``times`` (m, marks) of marks, and ``margins`` (marks,) by which they may be later.

    They may be off by as much as was ``missed`` where they are known.
    """

    times: Array
    margins: Array
    missed: float


OfMarks: TypeAlias = Callable[[Array, int], Foreseen]
"""Maps points (m, d) and a count of marks to what is foreseen of these."""


@dataclass(frozen=True)
class Guard:
    """What ``when`` of an event is at an instant, which tells how trajectories go on there.

    The instant -1 is the start. The states are those after so many of the events at the instant
    are ``applied``, with a ``side`` of its own for the switch that the event sets, if told.
    """

    instant: int
    applied: int
    event: int
    side: float | None = None


@dataclass(frozen=True)
class Clearance:
    """``sign`` times what ``when`` of an event is, which falls through zero where the event comes.

    It is a function of the parameters and of the time along each stretch.
    """

    event: int
    sign: float


@dataclass(frozen=True, eq=False)
class Turn:
    """Where trajectories turn next to the surface of an event, past it or before they reach it.

    The height at the turn is ``sign`` times what ``when`` of the event is, and largest there; below
    zero the event is missed. It is on a ``stretch``, after an elapsed time that ``times`` predicts,
    (m, 1) at the first ``columns`` of points (m, d), to about ``margin``. ``surface`` has the
    events with the same surface, on sides of switches, and the factors of their ``when`` over that
    of the event. Heights are relative to the rise to the turn from the start of the stretch or,
    where that is on the surface, from the ``lowest`` place between.
    """

    stretch: int
    event: int
    sign: float
    surface: tuple[tuple[int, tuple[int, ...], float], ...]
    times: OfPoints
    margin: float
    columns: int
    lowest: bool = False


@dataclass(frozen=True)
class Beginning:
    """Where a stretch begins that is none where ``when`` of its event is not above zero there.

    So a mass sticks only where friction is larger than the force at a turning point. That is a
    ``guard`` of the branch that goes on in another way. Along the stretch the surface comes back
    from where it is moved to, at a rate of ``fading`` times by how much.
    """

    stretch: int
    event: int
    guard: Guard
    fading: float = 0.0


@dataclass(frozen=True)
class ForcedOrder:
    """An order that trajectories follow wherever it holds or not.

    ``met`` are the events at each instant in the order in which they happen: the first one ends the
    stretch. Stretches may then be of negative length. ``lengths`` predicts those up to the last
    instant, (m, instants) at points (m, d), to about ``margins`` (instants,). The ``guards`` are
    functions of the parameters besides, at instants or turns, and the ``clearances`` of parameters
    and time.

    Events that are met just before a turn, and missed where its height is below zero, are
    ``opened``: a coordinate behind the parameters is the root of the height over the rise to
    the turn, and the surface is moved until that is so. Where it is the root of the
    true one, nothing is moved. Stretches may be opened at their beginning as well: what ``when`` of
    the event is there is the square of the coordinate then.
    """

    met: tuple[tuple[int, ...], ...]
    lengths: OfPoints
    margins: tuple[float, ...]
    guards: tuple[Guard | Turn, ...] = ()
    clearances: tuple[Clearance, ...] = ()
    opened: tuple[Turn | Beginning, ...] = ()


class Ending(StrEnum):
    """What ends the last stretch of all trajectories."""

    EVENT = "event"
    """The last event, which may come after the horizon."""
    HORIZON = "horizon"
    """The end of the horizon: all trajectories meet as many events before it."""
    LENGTH = "length"
    """The same time after the last event, which may come after the horizon."""


@dataclass(frozen=True)
class EventOrder:
    """The events of all trajectories of a box, in their order.

    ``instants`` are the positions of the events at each instant, several where they coincide. A
    stretch lies before each of them, and one more behind the last unless the ``ending`` is an
    event; ``length`` is its own where it is the same for all trajectories. ``sides`` are those of
    held switches, for each stretch.
    """

    instants: tuple[tuple[int, ...], ...]
    ending: Ending
    length: float = 0.0
    sides: tuple[tuple[int, ...], ...] = ()

    @property
    def stretches(self) -> int:
        """Number of stretches."""
        return len(self.instants) + (self.ending is not Ending.EVENT)


# -----------------------------------------------------------------------------
# What a system has beside its rates: features that are not smooth, jumps, and constraints.
#
# A *cut* is a point of one coordinate, a *surface* the set of zeros of a function of several
# variables. Features are derived from the equations once, printed into the generated module, and
# used wherever steps, elements, samples and check points are placed.


VectorLike: TypeAlias = "Array | Sequence[float] | Sequence[Array]"
"""States (n, ...) or parameters (d, ...): an array, or a sequence of its rows."""
OfParameters: TypeAlias = Callable[[VectorLike], Array]
"""A function of p (d, ...)."""
OfStates: TypeAlias = "Callable[[float | Array, VectorLike, VectorLike], Array]"
"""A function of t, u (n, ...) and p (d, ...)."""
Jumped: TypeAlias = Callable[[int, VectorLike, VectorLike], Array]
"""States after a jump, from its kind, the states before and the parameters."""

GAP_REMEDY = "add a branch (value, True) for everything else, or let its conditions cover this too"
"""What to do about a gap, wherever it shows."""


def no_rows(*_: float | VectorLike) -> Array:
    """No function values, whatever the arguments: shape (0, 1)."""
    return np.empty((0, 1))


@dataclass(frozen=True, eq=False)
class Features:
    """Where functions of the right-hand side jump, kink or are narrow; empty where nothing does.

    ``cuts`` has for time and each parameter the points at which functions of it alone are not
    smooth, ``periodic_cuts`` the points that repeat: one of them and the period. ``moving_cuts``
    are times at which functions of time and parameters p (d, ...) are not smooth; they jump or
    peak at the first ``n_moving_steps``.
    ``parameter_surfaces`` are functions of p that vanish, or are least, where functions of several
    parameters are not smooth. ``state_surfaces`` are functions of t, u (n, ...) and p that vanish
    where the rates are not smooth over the states: first ``n_peaks`` in the middle of smooth peaks,
    then ``n_kinks`` and ``n_steps``. All return (count, ...).
    """

    cuts: tuple[tuple[float, ...], ...]
    periodic_cuts: tuple[tuple[tuple[float, float], ...], ...]
    n_moving_cuts: int = 0
    n_moving_steps: int = 0
    moving_cuts: OfParameters = no_rows
    n_parameter_surfaces: int = 0
    parameter_surfaces: OfParameters = no_rows
    n_peaks: int = 0
    n_kinks: int = 0
    n_steps: int = 0
    state_surfaces: OfStates = no_rows

    @property
    def n_state_surfaces(self) -> int:
        """Number of ``state_surfaces``."""
        return self.n_peaks + self.n_kinks + self.n_steps


@dataclass(frozen=True, eq=False)
class Gaps:
    """Where piecewise functions of the states have no branch, with what to say of each gap.

    ``inside`` is for each gap one inside of it, else zero, at t, u (n, ...) and p (d, ...):
    (gaps, ...).
    """

    texts: tuple[str, ...] = ()
    inside: OfStates = no_rows

    def entered(self, t: float, u: Array, p: Array) -> str | None:
        """The text of the first gap that states u (n, 1) at p (d, 1) lie in."""
        if not self.texts:
            return None
        inside = np.broadcast_to(self.inside(t, u, p), (len(self.texts), 1))[:, 0]
        return next((text for text, here in zip(self.texts, inside, strict=True) if here), None)


def unchanged(_kind: int, u: VectorLike, _p: VectorLike) -> Array:
    """The states before: nothing is reset."""
    return np.array(u, dtype=float)


@dataclass(frozen=True, eq=False)
class Jumps:
    """The jumps of a system, by ascending times; empty where states are never reset.

    ``jumped`` returns the states right after a jump, (n, ...), from its kind, the states u (n, ...)
    before it and p (d, ...). ``rough_kinds`` are the kinds whose values are not polynomials of the
    states; ``gaps`` say where piecewise functions in what is reset have no branch.
    """

    times: tuple[float, ...] = ()
    kinds: tuple[int, ...] = ()
    rough_kinds: tuple[int, ...] = ()
    jumped: Jumped = unchanged
    gaps: Gaps = field(default_factory=Gaps)

    def inside(self, start: float, end: float) -> tuple[float, ...]:
        """The times inside of a horizon, ascending."""
        last = end - NEGLIGIBLE * (end - start)
        return tuple(time for time in self.times if start < time < last)

    def kind_at(self, time: float) -> int | None:
        """The kind of the jump at a time; None if there is none."""
        pairs = zip(self.times, self.kinds, strict=True)
        return next((kind for at, kind in pairs if at == time), None)

    def warn_of_last(self, start: float, end: float) -> None:
        """Warn of a jump that is so close to the end of the horizon that it is not taken."""
        before_end = [time for time in self.times if start < time < end]
        if len(before_end) > len(self.inside(start, end)):
            warn(
                f"the jump at {before_end[-1]!r} is at the end of the horizon, {end!r}, but for "
                "rounding, and is not taken",
                remedy="move the end",
            )


# -----------------------------------------------------------------------------
# Functions of the user, and names of tables, as workers know them.
#
# SymPy is not needed for that: importing it takes a second.


PREFIX, POINTS, VALUES = "f_", "POINTS_", "VALUES_"
"""First letters of names in generated source: of a function, so that no local name hides it, and of
the data of a table."""
AT_THE_ENDS = NEGLIGIBLE
"""Distance outside a table, over its length, that is taken for rounding."""


class GuardedFunction:
    """A user's callable; errors in it name it."""

    def __init__(self, name: str, value: Callable[..., object]) -> None:
        self.name, self.value = name, value

    def __call__(self, *arguments: ArrayLike) -> Array:
        arrays = np.broadcast_arrays(*(np.asarray(a, dtype=float) for a in arguments))
        try:
            # copies, as a function may change its arguments
            returned = np.asanyarray(self.value(*(array.copy() for array in arrays)))
            real = not (np.iscomplexobj(returned) or np.ma.is_masked(returned))
            heights = np.asarray(returned, dtype=float) if real else np.full(1, np.nan)
        except Exception as error:
            raise ProblemError(
                f"function {quote(self.name)} raised {type(error).__name__}: {error}",
                term=self.name,
                remedy="it must take arrays and return real numbers",
            ) from error
        if not real:
            raise ProblemError(
                f"function {quote(self.name)} returned complex or masked numbers",
                term=self.name,
                remedy="return real numbers; NaN where there are none",
            )
        if heights.shape != arrays[0].shape:
            raise ProblemError(
                f"function {quote(self.name)} returned shape {heights.shape} for arguments of "
                f"shape {arrays[0].shape}",
                term=self.name,
                remedy="return one number for each point",
            )
        return heights


# -----------------------------------------------------------------------------
# Constraints: expressions of the states that vanish on all trajectories of a system.
#
# They come from algebraic equations. Newton's method finds the unknowns with guessed initial values
# from them, and shows how far states are from satisfying them.


_SHORT = EPSILON**0.5  # Relative length of steps from which rounding decides on the residual
NEWTON_STEPS = 20  # Steps of Newton's method from close by


@dataclass(frozen=True, eq=False)
class Constraints:
    """Constraints of a system with n states; none where ``names`` is empty.

    ``names`` say which equation each one comes from, ``guessed`` are the states whose initial
    values are only starting guesses. ``residuals`` (k, ...) are what vanishes and ``slopes``
    (k, n, ...) its derivatives, at t, u (n, ...) and p (d, ...).
    """

    names: tuple[str, ...] = ()
    guessed: tuple[int, ...] = ()
    residuals: OfStates = no_rows
    slopes: OfStates = no_rows

    def consistent(
        self, t: float, u: Array, p: Array, steps: int = MOST_ROUNDS, sizes: Array | None = None
    ) -> Array:
        """States u (n, m) at p (d, m) with the guessed ones such that constraints hold.

        NaN for those that Newton's method does not find in a number of steps. States are as exact
        as rounding of their ``sizes`` (n, m) allows, by default of their own.
        """
        states, rows = np.array(u, dtype=float), list(self.guessed)
        if not rows:
            return states
        least = NEGLIGIBLE * (np.zeros(states.shape) if sizes is None else sizes)
        with np.errstate(all="ignore"):
            converged = np.zeros(states.shape[1], dtype=bool)
            before = np.full(states.shape[1], np.inf)
            for _ in range(steps):
                open_ = np.flatnonzero(~converged)
                if not open_.size:
                    break
                charge(30 * CALL + open_.size * pseudo_inverse(len(self.names), len(rows)))
                states[:, open_], changes = self._stepped(
                    t, states[:, open_], p[:, open_], least[:, open_]
                )
                rounding = (changes <= _SHORT) & (changes >= (1.0 - MINOR) * before[open_])
                converged[open_] = (changes <= COINCIDENT) | rounding
                before[open_] = changes
            states[rows] = np.where(
                converged & self._hold(t, states, p, least), states[rows], np.nan
            )
        return states

    def _stepped(self, t: float, u: Array, p: Array, least: Array) -> tuple[Array, Array]:
        """States after a step of Newton's method, and the largest relative change (m,).

        The step is halved until the residual falls. Sizes of states are ``least`` (n, m) or more.
        """
        rows = list(self.guessed)
        residuals, slopes = self._at(t, u, p)
        sizes = np.abs(u[rows])
        sizes = np.maximum(np.maximum(sizes, least[rows]), NEGLIGIBLE * sizes.max(axis=0))
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        scaled = slopes[:, rows] * sizes
        scale = np.abs(scaled).max(axis=1)
        scale = np.where(scale > 0.0, scale, np.inf)  # rows without guessed states do not count
        matrices = np.nan_to_num(np.moveaxis(scaled / scale[:, None], 2, 0))
        inverse = np.linalg.pinv(matrices, rcond=COINCIDENT)
        steps = -np.einsum("mgk,km->gm", inverse, residuals / scale)
        before, shares = np.linalg.norm(residuals / scale, axis=0), np.ones(u.shape[1])
        short = np.abs(steps).max(axis=0) <= _SHORT  # rounding decides on the residual
        stepped = u.copy()
        for _ in range(HALVINGS):
            stepped[rows] = u[rows] + shares * sizes * steps
            after = np.linalg.norm(self._at(t, stepped, p)[0] / scale, axis=0)
            worse = np.logical_not((after <= before * (1.0 - MINOR * shares)) | short)
            if not worse.any():
                break
            shares = np.where(worse, 0.5 * shares, shares)
        return stepped, shares * np.abs(steps).max(axis=0)

    def _hold(
        self, t: float | Array, u: Array, p: Array, least: float | Array = 0.0
    ) -> NDArray[np.bool_]:
        """At which points (m,) all constraints hold, up to rounding of sizes from ``least`` on."""
        residuals, slopes = self._at(t, u, p)
        sizes = np.maximum(np.maximum(np.abs(u), least), NEGLIGIBLE * np.abs(u).max(axis=0))
        terms = np.einsum("knm,nm->km", np.abs(slopes), sizes)
        return np.asarray((np.abs(residuals) <= NEGLIGIBLE * terms + TINY).all(axis=0))

    def _at(self, t: float | Array, u: Array, p: Array) -> tuple[Array, Array]:
        """Residuals (k, m) and slopes (k, n, m)."""
        k, n, m = len(self.names), len(u), u.shape[1]
        residuals = np.broadcast_to(self.residuals(t, u, p), (k, m))
        return residuals, np.broadcast_to(self.slopes(t, u, p), (k, n, m))

    def projected(self, t: Array, u: Array, p: Array) -> Array:
        """States u (n, m) at times t (m,) moved to where all constraints hold; NaN if they do not.

        By Newton's method with the least relative change of all states.
        """
        states = np.array(u, dtype=float)
        if not self.names:
            return states
        sizes = np.abs(states).max(axis=1, initial=0.0)
        sizes = np.where(sizes > 0.0, sizes, sizes.max(initial=0.0) or 1.0)
        for _ in range(NEWTON_STEPS):
            states = states - self._least_changes(t, states, p, sizes)
        with np.errstate(all="ignore"):
            return np.where(self._hold(t, states, p), states, np.nan)

    def tangential(self, t: float, u: Array, p: Array, direction: Array) -> Array:
        """A direction (n,) from states u (n,) at p (d,), along the constraints."""
        if not self.names:
            return direction
        _, slopes = self._at(t, u[:, None], p[:, None])
        sizes = np.where(u != 0.0, np.abs(u), 1.0)
        scaled = slopes[:, :, 0] * sizes
        across = np.linalg.pinv(scaled) @ (scaled @ (direction / sizes))
        return np.asarray(direction - sizes * across)

    def distances(self, t: float | Array, u: Array, p: Array, sizes: Array) -> Array:
        """How far each state u (n, m), at times t (m,), is from satisfying the constraints: (n, m).

        By the least change of all states, in units of their sizes (n,), that satisfies them to
        first order.
        """
        return np.abs(self._least_changes(t, u, p, sizes))

    def _least_changes(self, t: float | Array, u: Array, p: Array, sizes: Array) -> Array:
        """The least changes (n, m) in units of the sizes (n,) that leave what satisfies them."""
        with np.errstate(all="ignore"):
            residuals, slopes = self._at(t, u, p)
            scaled = np.moveaxis(slopes * sizes[None, :, None], 2, 0)
            scale = np.abs(scaled).max(axis=2, keepdims=True)
            scale = np.where(scale > 0.0, scale, 1.0)
            finite = np.isfinite(scaled.sum(axis=(1, 2)) + residuals.sum(axis=0))
            matrices = np.where(finite[:, None, None], scaled / scale, 0.0)
            inverse = np.linalg.pinv(matrices, rcond=COINCIDENT)
            changes = np.einsum("mnk,mk->nm", inverse, residuals.T / scale[:, :, 0])
        return np.where(finite, changes * sizes[:, None], np.inf)
