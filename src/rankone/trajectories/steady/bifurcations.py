"""Bifurcations: where a branch of steady states turns unstable or back, and of which kind they are.

A branch is followed along a straight line of the box by its arc length, round folds as well
(pseudo-arclength continuation; H. B. Keller, 1977). Where the leading eigenvalue passes the
imaginary axis, or the branch turns back, the bifurcation is located by secants and told by the
critical eigenvalue: a pair is a Hopf point. For a zero one with right and left null vectors v and
w, it is a fold if w f_p is not zero; otherwise a transcritical point if the quadratic coefficient
w f_xx v v is not zero, and a pitchfork if it is (Y. A. Kuznetsov, Elements of Applied Bifurcation
Theory).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from rankone.support.arrays import Array

if TYPE_CHECKING:
    from rankone.trajectories.steady.rest import SteadyStates

_FIRST_STEP = 0.02  # Of arc length; the whole line and the size of each state have length one
_LONGEST_STEP = 0.1
_SHORTEST_STEP = 1e-7
_MOST_STEPS = 1000
_CORRECTIONS = 8  # Newton steps back to the branch
_CLOSE = 1e-11  # Of the last of them
_CLOSE_TO_IT = 1e-8  # Length of the branch within which a bifurcation is located
_STRAIGHT = 0.95  # Cosine of the angle between tangents of one step and the next
_DIFFERENCE = 1e-6  # Of derivatives along the line, as a share of it
_BENT = 1e-3  # Of second and third derivatives along the null vector, in sizes of the states
_NAMES = {
    "fold": "a fold",
    "Hopf": "a Hopf point",
    "transcritical": "a transcritical point",
    "pitchfork": "a pitchfork",
}
_ROUNDINGS = 10.0  # Of a matrix, in units of the last place of its norm
_ZERO = 1e-4  # Coefficients of normal forms below this share of what they are made of vanish


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
        length = _FIRST_STEP
        for _ in range(_MOST_STEPS):
            there = self._moved(here, length)
            if there is None or there.tangent @ here.tangent < _STRAIGHT:
                length *= 0.5
                if length < _SHORTEST_STEP:
                    raise ArithmeticError
                continue
            if (there.leading.real < 0.0) != (here.leading.real < 0.0):
                return self._named(here, self._located(here, there, lambda at: at.leading.real))
            if there.tangent[-1] < 0.0:
                return self._named(here, self._located(here, there, lambda at: at.tangent[-1]))
            if there.z[-1] >= 1.0:
                return None
            here, length = there, min(1.5 * length, _LONGEST_STEP)
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
        shift[-1] = _DIFFERENCE
        by_share = (self._residuals(z + shift) - self._residuals(z - shift)) / (2.0 * _DIFFERENCE)
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
        for _ in range(_CORRECTIONS):
            slopes, units = self._slopes(z)
            matrix = np.vstack([slopes, tangent])
            off = np.append(self._residuals(z) / units, tangent @ (z - guess))
            if not np.isfinite(matrix.sum() + off.sum()):
                return None
            step = np.linalg.lstsq(matrix, -off, rcond=None)[0]
            z, change = z + step, float(np.abs(step).max())
            if change <= _CLOSE:
                break
        # next to a branch point rounding leaves more
        return self._described(z, tangent) if change <= math.sqrt(_CLOSE) else None

    def _located(self, first: _At, last: _At, sign: Callable[[_At], float]) -> _At:
        """The point between two of the branch at which something changes its sign.

        By secants (the Illinois method) on the cubic through both with their tangents. Next to a
        branch point, where nothing can be corrected, the cubic is the branch.
        """
        a, b, low, high = first, last, sign(first), sign(last)
        for _ in range(_MOST_STEPS):
            length, share = float(np.linalg.norm(b.z - a.z)), low / (low - high)
            guess, tangent = _cubic(a, b, length, share)
            near = length * min(share, 1.0 - share)
            there = self._corrected(guess, tangent) if near > _CLOSE_TO_IT else None
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
        rounding = _CLOSE * (np.abs(self.start) + np.abs(self.direction))
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
        if np.linalg.norm(w @ slopes[:, n]) > _ZERO * passing:
            return "fold"
        minus2, minus, here, plus, plus2 = (
            self._residuals(at.z + share * _BENT * v) / units for share in (-2, -1, 0, 1, 2)
        )
        second = (plus - 2.0 * here + minus) / _BENT**2
        third = (plus2 - 2.0 * plus + 2.0 * minus - minus2) / (2.0 * _BENT**3)
        bent = max(np.linalg.norm(second), np.linalg.norm(third))
        return "transcritical" if np.linalg.norm(w @ second) > _ZERO * bent else "pitchfork"


def frequency_of(matrix: Array) -> float:
    """The imaginary part of the leading eigenvalue of a matrix (n, n); 0 if it may be rounding.

    Rounding moves an eigenvalue by as much as its condition says, the inverse of the cosine between
    its left and right vectors, and divides a double one into a pair.
    """
    values, left, right = scipy.linalg.eig(matrix, left=True)
    first = int(np.argmax(values.real))
    rounding = _ROUNDINGS * np.finfo(float).eps * np.linalg.norm(matrix)
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
