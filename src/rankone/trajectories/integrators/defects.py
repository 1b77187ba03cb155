"""Defects of steps: what is narrow, and lies between the stages of a step; roots of many functions.

Where an interpolant runs through something narrow its slope differs from the rates there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import COARSE, EPSILON, MINOR, MOST_ROUNDS, ROUNDING, Array
from rankone.support.budget import charge
from rankone.support.costs import READ, function_cost
from rankone.trajectories.system.system import System

SHORTENING = 0.2  # Part of a step tried next after a large defect: stops before what was missed


@dataclass(frozen=True)
class _Defects:
    """Which defects mean that a step missed something, and where they are looked for."""

    most_at_crossings: float
    most_at_random: float
    different_rates: float
    grazing: float
    turning_widths: tuple[float, ...]
    roundings: float
    least_places: int
    places: int


_DEFECTS = _Defects(
    most_at_crossings=100.0,  # At crossings, times the step, in tolerances; smooth: to 40
    most_at_random=300.0,  # The same at random places: the largest of many is larger
    different_rates=0.5,  # Defect over the rates from which a step missed something
    grazing=MINOR,  # Least height of a parabola on a step, over those at its ends, that may be zero
    turning_widths=(0.1, 0.02, 0.002),  # Widths of the parabolas that tell where a height turns
    roundings=100.0,  # Of a time or a state, that may be one of a slope times the step
    least_places=2,  # Fewest random places on each trajectory in every step
    places=512,  # Random places on all trajectories: one evaluation of the rates takes them well
)

# Maps shares (..., c) of a step, and whether slopes are needed, to the states (n, ..., c) of c
# trajectories and their slopes over the share
Interpolant: TypeAlias = "Callable[[Array, bool], tuple[Array, Array]]"


class Steps(Protocol):
    """Steps in m columns: the same one of m trajectories, or m steps of one trajectory.

    From ``t_old`` to ``t``, of all or of each, with the stacked states ``y`` (n m,) at their ends;
    the segment ends at ``t_bound``. The tolerances are ``rtol`` and ``atol`` (n m,).
    """

    @property
    def t_old(self) -> float | Array: ...
    @property
    def t(self) -> float | Array: ...

    t_bound: float
    y: Array
    rtol: float
    atol: Array

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:
        """What is within the steps of some columns."""

    def error_of(self, defect: Array, columns: NDArray[np.intp]) -> Array:
        """The error that a defect (n, c), times the step, of some columns amounts to."""


class DefectControl:
    """Looks for peaks and pulses of the rates over the states between the stages of a step.

    It looks where trajectories cross state surfaces and, with ``anywhere``, at random places too.
    """

    def __init__(self, system: System, points: Array, anywhere: bool) -> None:
        self.rates, self.features = system.rhs, system.features
        self.parameters = np.ascontiguousarray(points.T)
        self.places = max(_DEFECTS.least_places, _DEFECTS.places // len(points)) if anywhere else 0
        self.columns = np.tile(np.arange(len(points)), self.places)
        self.generator = np.random.default_rng(20142)
        users = system.user_functions
        self.rates_cost = function_cost(system.rhs, users)
        self.surfaces_cost = function_cost(system.features.state_surfaces, users)

    def missed(self, solver: Steps, y_before: Array) -> NDArray[np.bool_]:
        """In which columns a step missed something, (m,); they start at ``y_before`` (n m,)."""
        missed = np.zeros(self.parameters.shape[1], dtype=bool)
        if self.features.n_state_surfaces:
            missed |= self._at_crossings(solver, y_before) > _DEFECTS.most_at_crossings
        if self.places > 0 and not missed.any():
            missed |= self._at_random(solver) > _DEFECTS.most_at_random
        return missed

    def _at_random(self, solver: Steps) -> Array:
        """Largest errors that defects at random places amount to, in tolerances."""
        m = self.parameters.shape[1]
        n = solver.y.size // m
        charge(self.rates_cost(self.columns.size) + READ(n * self.columns.size))
        shares = self.generator.random((self.places, m))
        start, h = solver.t_old, solver.t - solver.t_old
        states, slopes = solver.interpolant(np.arange(m))(shares, True)
        rates = self.rates(start + h * shares, states, self.parameters[:, None])
        defect = _beyond_rounding(slopes - h * rates, rates, solver.t, states)
        errors = np.abs(solver.error_of(defect.reshape(n, -1), self.columns))
        scaled = errors / _tolerated(solver, states.reshape(n, -1))
        largest = scaled.reshape(-1, m).max(axis=0)
        return np.where(np.isnan(largest), np.inf, largest)

    def _spans(self, solver: Steps, columns: NDArray[np.intp]) -> tuple[Array, Array]:
        """The start and the length of the steps of some columns."""
        m = self.parameters.shape[1]
        start = np.broadcast_to(solver.t_old, m)
        return start[columns], (np.broadcast_to(solver.t, m) - start)[columns]

    def _largest(self, errors: Array, columns: NDArray[np.intp]) -> Array:
        """The largest of errors (n, c) in each of the columns, (m,)."""
        largest = np.zeros(self.parameters.shape[1])
        np.maximum.at(largest, columns, np.nan_to_num(errors, nan=np.inf).max(axis=0))
        return largest

    def _at_crossings(self, solver: Steps, y_before: Array) -> Array:
        """Largest defects at the crossings of state surfaces, times the step, in tolerances.

        The defect midway between two crossings counts too. Trajectories may stay in a peak or pulse
        longer than the step says: there a defect as large as the rates counts times all the time
        that is left. The error estimate sees a kink, unless it belongs to a peak: there a smaller
        defect does not count.
        """
        m = self.parameters.shape[1]
        columns, which, shares = self._crossings(solver, y_before)
        if not columns.size:
            return np.zeros(m)
        before, h = self._spans(solver, columns)
        interpolant, p = solver.interpolant(columns), self.parameters[:, columns]
        tolerated = _tolerated(solver, solver.y.reshape(-1, m))

        def largest(shares: Array, narrow: NDArray[np.bool_], kink: NDArray[np.bool_]) -> Array:
            charge(self.rates_cost(columns.size) + 2.0 * READ(tolerated.size * columns.size))
            states, slopes = interpolant(shares, True)
            rates = h * self.rates(before + h * shares, states, p)
            defect = np.abs(_beyond_rounding(rates - slopes, rates / h, before + h, states))
            unknown = defect > _DEFECTS.different_rates * np.maximum(np.abs(rates), np.abs(slopes))
            defect[kink & ~unknown] = 0.0
            defect = np.where(narrow & unknown, (solver.t_bound - before) / h * defect, defect)
            return self._largest(defect / tolerated, columns)

        n_peaks = self.features.n_peaks
        narrow = which < n_peaks + self.features.n_kinks
        worst = largest(shares, narrow, narrow & (which >= n_peaks))
        again = np.diff(columns, prepend=-1) == 0
        if again.any():
            shares = shares[np.lexsort((shares, columns))]
            between = np.where(again, 0.5 * (shares + np.roll(shares, 1)), shares)
            worst = np.maximum(worst, largest(between, again, np.zeros_like(again)))
        return worst

    def _crossings(
        self, solver: Steps, y_before: Array
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
        """The columns whose steps cross state surfaces, in order, which ones, and at which shares.

        A step that ends on the side where it began may have crossed a surface twice.
        """
        m, surfaces = self.parameters.shape[1], self.features.state_surfaces
        begin, length = self._spans(solver, np.arange(m))
        charge(3.0 * self.surfaces_cost(m) + READ(solver.y.size))
        halfway = solver.interpolant(np.arange(m))(np.full(m, 0.5), False)[0]
        start = surfaces(solver.t_old, y_before.reshape(-1, m), self.parameters)
        middle = surfaces(begin + 0.5 * length, halfway, self.parameters)
        end = surfaces(solver.t, solver.y.reshape(-1, m), self.parameters)
        columns, which = np.nonzero((start * end < 0.0).T)
        turns = turning_shares(start, middle, end)
        returning, of = np.nonzero(np.isfinite(turns).T)
        share = turn = np.zeros(0)
        if returning.size:
            heights = self._heights(solver, returning, of)
            share = turning_points(heights, turns[of, returning])
            turn = heights(share)
            twice = turn * start[of, returning] < 0.0
            returning, of = returning[twice], of[twice]
            share, turn = share[twice], turn[twice]
        if not columns.size + returning.size:
            return columns, which, share
        low = np.concatenate([np.zeros(columns.size + share.size), share])
        high = np.concatenate([np.ones(columns.size), share, np.ones(share.size)])
        at_low = np.concatenate([start[which, columns], start[of, returning], turn])
        at_high = np.concatenate([end[which, columns], turn, end[of, returning]])
        columns = np.concatenate([columns, returning, returning])
        which = np.concatenate([which, of, of])
        order = np.argsort(columns, kind="stable")
        columns, which = columns[order], which[order]
        low, high = low[order], high[order]
        heights = self._heights(solver, columns, which)

        def between(shares: Array) -> Array:
            return heights(low + (high - low) * shares)

        return columns, which, low + (high - low) * roots(between, at_low[order], at_high[order])

    def _heights(
        self, solver: Steps, columns: NDArray[np.intp], which: NDArray[np.intp]
    ) -> Callable[[Array], Array]:
        """What vanishes on state surfaces, each in its column, at shares of steps."""
        before, h = self._spans(solver, columns)
        interpolant, p = solver.interpolant(columns), self.parameters[:, columns]
        states = solver.y.size // self.parameters.shape[1] * columns.size
        cost = self.surfaces_cost(columns.size) + READ(states)

        def heights(shares: Array) -> Array:
            charge(cost)
            there = self.features.state_surfaces(
                before + h * shares, interpolant(shares, False)[0], p
            )
            return np.asarray(there[which, np.arange(columns.size)])

        return heights


def turning_shares(start: Array, middle: Array, end: Array) -> Array:
    """Where the parabola through three heights of one sign at its ends comes near zero, else NaN.

    The heights are at the shares 0, 1/2 and 1 of steps.
    """
    bend, slope = 2.0 * (start - 2.0 * middle + end), 4.0 * middle - 3.0 * start - end
    shares = np.divide(-slope, 2.0 * bend, out=np.full_like(bend, np.nan), where=bend != 0.0)
    nearest = (start + 0.5 * slope * shares) * np.sign(start)
    largest = np.maximum(np.abs(start), np.abs(end))
    turns = (
        (start * end > 0.0)
        & (shares > 0.0)
        & (shares < 1.0)
        & (nearest < _DEFECTS.grazing * largest)
    )
    return np.where(turns, shares, np.nan)


def turning_points(function: Callable[[Array], Array], shares: Array) -> Array:
    """Where functions turn, near shares in (0, 1): vertices of parabolas that get narrower."""
    for width in _DEFECTS.turning_widths:
        inside = np.clip(shares, width, 1.0 - width)
        left, here, right = (function(inside + shift) for shift in (-width, 0.0, width))
        bend, slope = left - 2.0 * here + right, 0.5 * (right - left)
        step = np.divide(-slope, bend, out=np.zeros_like(bend), where=bend * np.sign(here) > 0.0)
        shares = inside + width * np.clip(step, -1.0, 1.0)
    return np.asarray(shares)


def _beyond_rounding(defect: Array, rates: Array, times: float | Array, states: Array) -> Array:
    """The part of defects (n, ...), times the step, that no rounding explains.

    Nodes of polynomials are at rounded times, where rates are (n, ...), and in rounded states.
    """
    rounding = np.spacing(np.abs(times)) * np.abs(rates) + EPSILON * np.abs(states)
    return np.asarray(
        np.sign(defect) * np.maximum(np.abs(defect) - _DEFECTS.roundings * rounding, 0.0)
    )


def _tolerated(solver: Steps, states: Array) -> Array:
    """The tolerance for the largest of the absolute values (n, c) of each state, (n, 1)."""
    absolute = solver.atol.reshape(len(states), -1).max(axis=1)
    return np.asarray(absolute + solver.rtol * np.abs(states).max(axis=1))[:, None]


# -----------------------------------------------------------------------------
# Roots of functions that change sign: many at once, however steep the functions are.


def roots(
    function: Callable[[Array], Array], start: Array, end: Array, accuracy: Array | float = ROUNDING
) -> Array:
    """Roots in [0, 1] of functions that change sign from ``start`` to ``end``, or vanish there."""
    return _around(function, start, end, accuracy).nearest


def roots_or_jumps(function: Callable[[Array], Array], start: Array, end: Array) -> Array:
    """The same; where the function jumps to the other sign, the place is behind the jump."""
    around = _around(function, start, end, ROUNDING)
    jumps = around.height > COARSE * np.minimum(np.abs(start), np.abs(end))
    return np.where(jumps, np.maximum(around.a, around.b), around.nearest)


@dataclass(frozen=True)
class _Interval:
    """Ends of intervals around roots, and the values of functions there."""

    a: Array
    b: Array
    at_a: Array
    at_b: Array

    @property
    def nearest(self) -> Array:
        """The ends with the smaller values."""
        return np.where(np.abs(self.at_a) < np.abs(self.at_b), self.a, self.b)

    @property
    def height(self) -> Array:
        """Absolute values there."""
        return np.minimum(np.abs(self.at_a), np.abs(self.at_b))


def _around(
    function: Callable[[Array], Array], start: Array, end: Array, accuracy: Array | float
) -> _Interval:
    """Intervals around roots in [0, 1], no longer than the ``accuracy``.

    After a secant by inverse quadratic interpolation, or halving where values are far from that
    (T. R. Chandrupatla, Adv. Eng. Software 28 (1997), 145).
    """
    around = _Interval(np.zeros_like(start), np.ones_like(end), start, end)
    share = np.where(end == start, 0.5, end / np.where(end == start, 1.0, end - start))
    for _ in range(MOST_ROUNDS):
        a, b, at_a, at_b = around.a, around.b, around.at_a, around.at_b
        width = np.abs(a - b)
        done = (width <= accuracy) | (around.height == 0.0)
        if done.all():
            break
        least = 0.5 * accuracy / np.where(done, 1.0, width)
        x = np.where(done, b, b + np.clip(share, least, 1.0 - least) * (a - b))
        height = np.where(done, at_b, function(x))
        same = np.sign(height) == np.sign(at_b)
        c, at_c = np.where(same, b, a), np.where(same, at_b, at_a)
        around = _Interval(np.where(same, a, b), x, np.where(same, at_a, at_b), height)
        share = _interpolated(around, c, at_c)
    return around


def _interpolated(around: _Interval, c: Array, at_c: Array) -> Array:
    """Where roots are expected, as shares of the way from the last ends to the others."""
    a, b, at_a, at_b = around.a, around.b, around.at_a, around.at_b
    with np.errstate(all="ignore"):
        place, height = (b - a) / (c - a), (at_b - at_a) / (at_c - at_a)
        share = at_b / (at_a - at_b) * at_c / (at_a - at_c)
        share += (c - b) / (a - b) * at_b / (at_c - at_b) * at_a / (at_c - at_a)
    inside = (height**2 < place) & ((1.0 - height) ** 2 < 1.0 - place)
    return np.where(inside, share, 0.5)
