"""Branches of steady states and where they change, and starts that are steady states.

It is continued from the centre along straight lines by Newton's method. Where that fails, or meets
a state that is hardly stable, the line is followed with care and its bifurcation named. Where the
branch goes on, but trajectories from the initial values lead to another steady state, the border
between the two is looked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from rankone.support.arrays import DIFFERENCE, EPSILON, NEGLIGIBLE, ROUNDING, SAME, Array, bisected
from rankone.support.errors import LISTED, BlowUpError, ConvergenceError
from rankone.trajectories.rest import EXACT, SteadyStates
from rankone.trajectories.system.features import (
    NEWTON_STEPS,
    Constraints,
    Features,
    Jumps,
    VectorLike,
)
from rankone.trajectories.system.system import Rest, System

_STEPS = 24  # Steps of the continuation from the centre to a point
_NEAR = 0.3  # Growth rate over that at the centre, from which on Newton's method may change branch
_HALVINGS = 24  # Of a line on which a branch ends


def check_one_branch(steady: SteadyStates, points: Array) -> None:
    """Raise unless trajectories at points (m, d) reach one branch, that of the first point.

    Raises
    ------
    ConvergenceError
        It says at which bifurcation the branch ends or turns unstable, which parameters lead to
        another branch, or where trajectories do not settle. The first is its ``bifurcation``.
    """
    centre = points[0]
    start = steady.reached(points[:1].T)
    if np.isnan(start).any():
        raise _unsettled(steady, points)
    if not steady.decays(start, points[:1])[0]:
        return  # the initial values are at rest, and unstable
    for end in points[~_goes_on(steady, start, centre, points)]:
        try:
            bifurcation = BranchLine(steady, start[:, 0], centre, end).bifurcation()
        except ArithmeticError:
            raise ConvergenceError(
                f"{_described(steady, start)} has no smooth continuation to {_listed(steady, end)}",
                remedy=f"narrow the box around {_listed(steady, centre)}",
            ) from None
        if bifurcation is not None:
            raise _ended(_described(steady, start), bifurcation, _listed(steady, centre))
    reached = steady.reached(points.T)
    slow = np.isnan(reached).any(axis=0)
    if slow.any():
        raise steady.not_settled(points[slow])
    elsewhere = np.flatnonzero(~_reached(steady, start, centre, points))
    if elsewhere.size:
        place = _border(
            centre, points[elsewhere[0]], lambda at: _reached(steady, start, centre, at)
        )
        raise ConvergenceError(
            f"{_described(steady, start)} is left at {_listed(steady, place)}: beyond, the initial "
            "values lead to another steady state",
            remedy="change the initial values, or keep the box on one side of it",
        )


def _ended(branch: str, bifurcation: Bifurcation, side: str) -> ConvergenceError:
    """The error for a branch that ends or turns unstable at a bifurcation."""
    fate = {
        "fold": "ends in",
        "Hopf": "turns unstable, with oscillations beyond, at",
        "transcritical": "turns unstable, where another branch crosses it, at",
        "pitchfork": "turns unstable, where two others branch off, at",
    }[bifurcation.kind]
    return ConvergenceError(
        f"{branch} {fate} {bifurcation}",
        remedy=f"keep the box on one side of it; {side} is on this side",
        bifurcation=bifurcation,
    )


def _unsettled(steady: SteadyStates, points: Array) -> ConvergenceError:
    """The error for a centre, the first of points (m, d), whose trajectory does not settle.

    It names the bifurcation at which an unstable steady state next to its end turns stable, or one
    at which a branch that trajectories reach elsewhere turns unstable on its way past the centre.
    """
    centre, state = points[0], steady.beside(points[:1])
    if steady.grows(state, points[:1])[0]:
        error = steady.not_settled(points[:1])
        for end in points[1:]:
            if bifurcation := _first_bifurcation(steady, state, centre, end):
                return ConvergenceError(
                    f"{error.message}; that steady state turns stable at {bifurcation}",
                    remedy="keep the box on its stable side",
                    bifurcation=bifurcation,
                )
        return error
    lower, upper = np.asarray(steady.system.box, dtype=float).reshape(-1, 2).T
    for point in points[1:]:
        start = steady.settled(point)
        if start is None:
            continue
        beyond = np.clip(2.0 * centre - point, lower, upper)
        if bifurcation := _first_bifurcation(steady, start, point, beyond):
            unsettled = f"trajectories have not settled by t = {steady.settle:g}"
            branch = f"the branch of steady states from {_listed(steady, point)}"
            ended = f"{unsettled} at {_listed(steady, centre)}; {branch}"
            return _ended(ended, bifurcation, _listed(steady, point))
    *_, (states, _) = _on_way(steady, state, centre, points)
    return steady.not_settled(points[:1], steady.growth(np.nan_to_num(states), points).max())


def _first_bifurcation(
    steady: SteadyStates, state: Array, start: Array, end: Array
) -> Bifurcation | None:
    """The first bifurcation of the branch with a state (n, 1) on a line; None if it is lost."""
    with suppress(ArithmeticError):
        return BranchLine(steady, state[:, 0], start, end).bifurcation()
    return None


def _on_way(
    steady: SteadyStates, start: Array, centre: Array, points: Array
) -> Iterator[tuple[Array, Array]]:
    """Steady states (n, m) on the way to points (m, d), and where; NaN from where there are none.

    They are continued from the one at the centre.
    """
    constraints = steady.constraints(range(len(start)))
    states = np.repeat(start, len(points), axis=1)
    sizes = np.repeat(steady.sizes[:, None], len(points), axis=1)
    for share in np.linspace(0.0, 1.0, _STEPS + 1)[1:]:
        at = centre + share * (points - centre)
        there = np.isfinite(states).all(axis=0)
        states[:, there] = constraints.consistent(
            0.0,
            states[:, there],
            np.ascontiguousarray(at[there].T),
            NEWTON_STEPS,
            sizes[:, there],
        )
        yield states, at


def _goes_on(steady: SteadyStates, start: Array, centre: Array, points: Array) -> NDArray[np.bool_]:
    """Whether the branch goes on from the centre to points (m, d), well stable on the way."""
    least = _NEAR * steady.growth(start, centre[None])[0]
    goes_on = np.ones(len(points), dtype=bool)
    for states, at in _on_way(steady, start, centre, points):
        goes_on &= np.isfinite(states).all(axis=0)
        goes_on &= steady.growth(np.nan_to_num(states), at) <= least
    return goes_on


def _reached(steady: SteadyStates, start: Array, centre: Array, points: Array) -> NDArray[np.bool_]:
    """Whether trajectories at points (m, d) reach the branch of the centre."""
    *_, (states, _) = _on_way(steady, start, centre, points)
    sizes = np.maximum(np.abs(states), steady.sizes[:, None]).max(axis=0)
    return np.asarray((np.abs(steady.reached(points.T) - states) <= SAME * sizes).all(axis=0))


def _border(inside: Array, outside: Array, holds: Callable[[Array], NDArray[np.bool_]]) -> Array:
    """The point (d,) between two others beyond which something ceases to hold."""

    def on_columns(columns: Array) -> NDArray[np.bool_]:
        return holds(np.ascontiguousarray(columns.T))

    last, _ = bisected(inside[:, None], outside[:, None], on_columns, _HALVINGS)
    return np.asarray(last[:, 0])


def _described(steady: SteadyStates, start: Array) -> str:
    """The branch by its states at the centre of the box."""
    pairs = list(zip(steady.system.states, start[:, 0].tolist(), strict=False))
    texts = [f"{name} = {at:.4g}" for name, at in pairs[:LISTED]]
    more = "" if len(pairs) <= LISTED else f" and {len(pairs) - LISTED} more"
    return f"the branch of steady states with {', '.join(texts)}{more} at the centre of the box"


def _listed(steady: SteadyStates, point: Array) -> str:
    pairs = zip(steady.system.parameters, point.tolist(), strict=True)
    return ", ".join(f"{name} = {at:.6g}" for name, at in pairs)


# -----------------------------------------------------------------------------
# Bifurcations: where a branch of steady states turns unstable or back, and of which kind they are.
#
# A branch is followed along a straight line of the box by its arc length, round folds as well
# (pseudo-arclength continuation; H. B. Keller, 1977). Where the leading eigenvalue passes the
# imaginary axis, or the branch turns back, the bifurcation is located by secants and told by the
# critical eigenvalue: a pair is a Hopf point. For a zero one with right and left null vectors v and
# w, it is a fold if w f_p is not zero; otherwise a transcritical point if the quadratic coefficient
# w f_xx v v is not zero, and a pitchfork if it is (Y. A. Kuznetsov, Elements of Applied Bifurcation
# Theory).


@dataclass(frozen=True)
class _Continuation:
    """How a branch is followed."""

    first_step: float
    most_steps: int
    straight: float
    zero: float


_LINE = _Continuation(
    first_step=0.02,  # Of arc length; the whole line and the size of each state have length one
    most_steps=1000,
    straight=0.95,  # Cosine of the angle between tangents of one step and the next
    zero=1e-4,  # Coefficients of normal forms below this share of what they are made of vanish
)
# Step of second and third derivatives along the null vector, in sizes of the states
_BENT = EPSILON**0.2
_NAMES = {
    "fold": "a fold",
    "Hopf": "a Hopf point",
    "transcritical": "a transcritical point",
    "pitchfork": "a pitchfork",
}


@dataclass(frozen=True)
class Bifurcation:
    """A bifurcation of steady states.

    Attributes
    ----------
    kind : str
        ``"fold"``, ``"Hopf"``, ``"transcritical"`` or ``"pitchfork"``.
    parameters, state : dict of str to float
        Where it is.
    parameter : str
        The parameter that changes most, of its interval, on the way there.
    frequency : float
        The angular frequency of the oscillation that begins at a Hopf point; zero for the others.
    """

    kind: str
    parameters: dict[str, float]
    state: dict[str, float]
    parameter: str
    frequency: float = 0.0

    @property
    def value(self) -> float:
        """The value of the parameter."""
        return self.parameters[self.parameter]

    def __str__(self) -> str:
        at = ", ".join(f"{name} = {value:.6g}" for name, value in self.parameters.items())
        return f"{_NAMES[self.kind]} at {at}"


@dataclass(frozen=True)
class _At:
    """A point of the branch, and what is there."""

    z: Array
    """Scaled states, and the share of the line (n + 1,)."""
    tangent: Array
    leading: complex
    """The leading eigenvalue."""


class BranchLine:
    """The branch of steady states from a state (n,) at a point of the box towards another."""

    def __init__(self, steady: SteadyStates, state: Array, start: Array, end: Array) -> None:
        self.steady, self.start, self.direction = steady, start, end - start
        self.constraints = steady.constraints(range(len(state)))
        sizes = np.maximum(np.abs(state), steady.sizes)
        self.sizes = np.where(sizes > 0.0, sizes, 1.0)
        self.first = np.append(state / self.sizes, 0.0)
        self.units = np.zeros(len(self.constraints.names))

    def bifurcation(self) -> Bifurcation | None:
        """The first bifurcation on the way; None if there is none up to the end of the line.

        Raises
        ------
        ArithmeticError
            If the branch is lost: it has no smooth continuation.
        """
        along = np.zeros(len(self.first))
        along[-1] = 1.0
        here = self._described(self.first, along)
        if here is None:
            raise ArithmeticError
        length = _LINE.first_step
        for _ in range(_LINE.most_steps):
            there = self._moved(here, length)
            if there is None or there.tangent @ here.tangent < _LINE.straight:
                length *= 0.5
                if length < NEGLIGIBLE:
                    raise ArithmeticError
                continue
            if (there.leading.real < 0.0) != (here.leading.real < 0.0):
                return self._named(here, self._located(here, there, lambda at: at.leading.real))
            if there.tangent[-1] < 0.0:
                return self._named(here, self._located(here, there, lambda at: at.tangent[-1]))
            if there.z[-1] >= 1.0:
                return None
            here, length = there, min(1.5 * length, 5.0 * _LINE.first_step)
        raise ArithmeticError

    def _values(self, z: Array) -> tuple[Array, Array]:
        """States (n, 1) and parameters (d, 1) at a point of the branch."""
        return (z[:-1] * self.sizes)[:, None], (self.start + z[-1] * self.direction)[:, None]

    def _residuals(self, z: Array) -> Array:
        states, p = self._values(z)
        return np.asarray(self.constraints.residuals(0.0, states, p)[:, 0], dtype=float)

    def _slopes(self, z: Array) -> tuple[Array, Array]:
        """Derivatives (k, n + 1) of what vanishes, in units (k,) of the largest on the way."""
        states, p = self._values(z)
        by_states = self.constraints.slopes(0.0, states, p)[:, :, 0] * self.sizes
        shift = np.zeros(len(z))
        shift[-1] = DIFFERENCE
        by_share = (self._residuals(z + shift) - self._residuals(z - shift)) / (2.0 * DIFFERENCE)
        self.units = np.maximum(self.units, np.abs(by_states).max(axis=1))
        units = np.where(self.units > 0.0, self.units, 1.0)
        return np.column_stack([by_states, by_share]) / units[:, None], units

    def _described(self, z: Array, before: Array) -> _At | None:
        slopes, _ = self._slopes(z)
        if not np.isfinite(slopes).all():
            return None
        tangent = np.linalg.svd(slopes)[2][-1]
        states, p = self._values(z)
        leading = complex(self.steady.leading(states, p.T)[0])
        return _At(z, tangent * (np.sign(tangent @ before) or 1.0), leading)

    def _moved(self, at: _At, length: float) -> _At | None:
        """The point of the branch some length on along the tangent; None if there is none."""
        return self._corrected(at.z + length * at.tangent, at.tangent)

    def _corrected(self, guess: Array, tangent: Array) -> _At | None:
        """The point of the branch next to a guess, across the tangent; None if there is none."""
        z, change = guess.copy(), np.inf
        for _ in range(NEWTON_STEPS):
            slopes, units = self._slopes(z)
            matrix = np.vstack([slopes, tangent])
            off = np.append(self._residuals(z) / units, tangent @ (z - guess))
            if not np.isfinite(matrix.sum() + off.sum()):
                return None
            step = np.linalg.lstsq(matrix, -off, rcond=None)[0]
            z, change = z + step, float(np.abs(step).max())
            if change <= EXACT:
                break
        # next to a branch point rounding leaves more
        return self._described(z, tangent) if change <= math.sqrt(EXACT) else None

    def _located(self, first: _At, last: _At, sign: Callable[[_At], float]) -> _At:
        """The point between two of the branch at which something changes its sign.

        By secants (the Illinois method) on the cubic through both with their tangents. Next to a
        branch point, where nothing can be corrected, the cubic is the branch.
        """
        a, b, low, high = first, last, sign(first), sign(last)
        for _ in range(_LINE.most_steps):
            length, share = float(np.linalg.norm(b.z - a.z)), low / (low - high)
            guess, tangent = _cubic(a, b, length, share)
            near = length * min(share, 1.0 - share)
            there = self._corrected(guess, tangent) if near > NEGLIGIBLE else None
            if there is None or np.abs(there.z - guess).max() > near:
                here = self._described(guess, tangent)
                if here is None:
                    raise ArithmeticError
                return here
            value = sign(there)
            if (value < 0.0) == (high < 0.0):
                b, high, low = there, value, 0.5 * low
            else:
                a, low, high = there, value, 0.5 * high
        raise ArithmeticError

    def _named(self, before: _At, at: _At) -> Bifurcation:
        """The bifurcation at a point, with its kind."""
        states, p = self._values(at.z)
        rounding = EXACT * (np.abs(self.start) + np.abs(self.direction))
        values = np.where(np.abs(p[:, 0]) > rounding, p[:, 0], 0.0)
        frequency = frequency_of(self.steady.perturbations(states, p.T)[0][0])
        kind = "Hopf" if frequency else self._of_zero_eigenvalue(before, at)
        system = self.steady.system
        return Bifurcation(
            kind,
            dict(zip(system.parameters, values.tolist(), strict=True)),
            dict(zip(system.states, states[:, 0].tolist(), strict=False)),
            system.parameters[int(np.argmax(np.abs(self.direction) / np.diff(system.box)[:, 0]))],
            frequency,
        )

    def _of_zero_eigenvalue(self, before: _At, at: _At) -> str:
        slopes, units = self._slopes(at.z)
        n = len(at.z) - 1
        left, _, right = np.linalg.svd(slopes[:, :n])
        w, v = left[:, n - 1 :].T, np.append(right[n - 1], 0.0)

        passing = max(np.linalg.norm(x) for x in (slopes[:, n], self._slopes(before.z)[0][:, n]))
        if np.linalg.norm(w @ slopes[:, n]) > _LINE.zero * passing:
            return "fold"
        minus2, minus, here, plus, plus2 = (
            self._residuals(at.z + share * _BENT * v) / units for share in (-2, -1, 0, 1, 2)
        )
        second = (plus - 2.0 * here + minus) / _BENT**2
        third = (plus2 - 2.0 * plus + 2.0 * minus - minus2) / (2.0 * _BENT**3)
        bent = max(np.linalg.norm(second), np.linalg.norm(third))
        return "transcritical" if np.linalg.norm(w @ second) > _LINE.zero * bent else "pitchfork"


def frequency_of(matrix: Array) -> float:
    """The imaginary part of the leading eigenvalue of a matrix (n, n); 0 if it may be rounding.

    Rounding moves an eigenvalue by as much as its condition says, the inverse of the cosine between
    its left and right vectors, and divides a double one into a pair.
    """
    values, left, right = scipy.linalg.eig(matrix, left=True)
    first = int(np.argmax(values.real))
    rounding = ROUNDING * np.linalg.norm(matrix)
    cosine = abs(left[:, first].conj() @ right[:, first])
    size = abs(float(values[first].imag))
    return size if size * cosine > rounding else 0.0


def _cubic(a: _At, b: _At, length: float, share: float) -> tuple[Array, Array]:
    """A point between two of the branch, and the tangent, on the cubic with their tangents."""
    s, rise, h = share, b.z - a.z, length
    value = a.z + s * s * (3.0 - 2.0 * s) * rise
    value += h * s * (1.0 - s) * ((1.0 - s) * a.tangent - s * b.tangent)
    slope = 6.0 * s * (1.0 - s) * rise / h
    slope += (1.0 - s) * (1.0 - 3.0 * s) * a.tangent + s * (3.0 * s - 2.0) * b.tangent
    return value, slope / np.linalg.norm(slope)


# -----------------------------------------------------------------------------
# Starts at the steady state of other conditions: the initial values of a system that has one.
#
# They are found by trajectories under these conditions at every parameter point, and kept.


_SUBJECT = "the start is a steady state"
_OTHERWISE = "; or change `conditions` or `start` of SteadyState"


class RestingStart:
    """The states at which trajectories start, as a function of the parameters."""

    def __init__(self, system: System, rest: Rest) -> None:
        self.time, self.after = system.horizon[0], rest.after
        before = before_start(system, rest)
        self.steady = SteadyStates(before, *rest.settle, stable_only=True)

    def __call__(self, p: VectorLike) -> Array:
        """The states (n, m) at parameters p (d, m); a ConvergenceError if there are none."""
        try:
            states = self.steady(p)
        except (ConvergenceError, BlowUpError) as error:
            message = f"{_SUBJECT}: under its conditions {error.message}"
            raise ConvergenceError(message, remedy=f"{error.remedy}{_OTHERWISE}") from None
        return states if self.after is None else self.after(self.time, states, np.asarray(p))

    def check(self, points: Array) -> None:
        """Raise a ConvergenceError unless the starts at points (m, d) are on one branch."""
        try:
            check_one_branch(self.steady, points)
        except (ConvergenceError, BlowUpError) as error:
            message, remedy = f"{_SUBJECT}: {error.message}", f"{error.remedy}{_OTHERWISE}"
            raise ConvergenceError(message, remedy=remedy, bifurcation=error.bifurcation) from None


def before_start(system: System, rest: Rest) -> System:
    """The system before the start of a system, over the longest time that it may take."""
    n = system.n_differential - system.n_lifted - system.n_sides
    start = system.horizon[0]
    return replace(
        system.starting_at(rest.initial).with_rates(rest.rhs, rest.jacobian),
        separated=False,
        states=system.states[:n],
        n_differential=n,
        n_lifted=0,
        n_sides=0,
        products=(),
        horizon=(start, start + rest.settle[1]),
        terms=(),
        features=Features(((),) * (1 + len(system.box)), ((),) * (1 + len(system.box))),
        jumps=Jumps(),
        events=(),
        constraints=Constraints(),
        held=None,
        specification=None,
    )


def started(system: System) -> System:
    """The system with its start, where that is a steady state."""
    if system.rest is None:
        return system
    return replace(system, at_rest=RestingStart(system, system.rest))
