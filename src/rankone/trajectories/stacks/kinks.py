"""Steps of DOP853 that are divided at kinks, for those trajectories of a stack that cross one.

A kink of the rates costs a step its order. In a stack some trajectory crosses one nearly always, so
that all of them would make the short steps of one that does. Here the trajectories that cross a
kink make two steps in place of one, each to its own crossing and from there on, and the others go
on. (Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, II.6, on discontinuities.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.integrate
from numpy.typing import NDArray

from rankone.support.arrays import DIFFERENCE, SAME, Array
from rankone.support.budget import charge
from rankone.support.costs import Cost, function_cost
from rankone.trajectories.integrators.defects import Interpolant
from rankone.trajectories.system.features import OfStates
from rankone.trajectories.system.system import System

_A, _B, _C, _D = (getattr(scipy.integrate.DOP853, name) for name in "ABCD")
_E3, _E5 = scipy.integrate.DOP853.E3, scipy.integrate.DOP853.E5
_EXTRA = tuple(zip(scipy.integrate.DOP853.A_EXTRA, scipy.integrate.DOP853.C_EXTRA, strict=True))
_STAGES = len(_B)
_MOST_TRIED = 12  # Lengths that are tried for a step to a crossing; three or four suffice

RatesThere = Callable[[Array, Array], Array]
"""Rates (n, c), or heights above surfaces (k, c), at times (c,) and states (n, c)."""


def nested(rows: Array, start: Array, shares: Array, slopes: bool) -> tuple[Array, Array]:
    """States (n, ..., c), and perhaps slopes, at shares (..., c) of nested polynomials of steps.

    ``rows`` (7, n, c) and ``start`` (n, c) are those of each column.
    """
    weights = np.empty((len(rows), *shares.shape))
    weights[::2], weights[1::2] = shares, 1.0 - shares
    factors = weights.copy() if slopes else weights
    np.multiply.accumulate(weights, axis=0, out=weights)
    y = np.einsum("i...c,inc->n...c", weights, rows)
    y += start.reshape(len(start), *(1,) * (shares.ndim - 1), -1)
    if not slopes:
        return y, y
    changes = np.ones_like(weights)  # of the weights with the share
    for i in range(1, len(rows)):
        np.multiply(changes[i - 1], factors[i], out=changes[i])
        changes[i] += -weights[i - 1] if i % 2 else weights[i - 1]
    return y, np.einsum("i...c,inc->n...c", changes, rows)


def error_norm(fifth: Array, third: Array, states: int) -> Array:
    """The error of a step over its length, by the sums of squares (m,) of both its estimates."""
    below = np.sqrt((fifth + 0.01 * third) * states)
    return np.asarray(fifth / np.where(below > 0.0, below, 1.0))


class SingleSteps:
    """A step of each of c trajectories, from its own time (c,) and over its own length (c,)."""

    def __init__(self, rates: RatesThere, begin: Array, start: Array, f: Array, h: Array) -> None:
        self.rates, self.begin, self.start, self.h = rates, begin, start, h
        self.slopes = slopes = np.empty((_STAGES + 1 + len(_EXTRA), *start.shape))
        slopes[0] = f
        for stage in range(1, _STAGES):
            states = start + h * np.tensordot(_A[stage, :stage], slopes[:stage], 1)
            slopes[stage] = rates(begin + _C[stage] * h, states)
        self.end = start + h * np.tensordot(_B, slopes[:_STAGES], 1)
        self.end_rates = slopes[_STAGES] = rates(begin + h, self.end)

    def errors(self, relative: float, absolute: Array) -> Array:
        """The error of each trajectory in tolerances, (c,)."""
        scale = absolute + relative * np.maximum(np.abs(self.start), np.abs(self.end))
        slopes = self.slopes[: _STAGES + 1]
        fifth, third = (
            np.square(np.tensordot(weights, slopes, 1) / scale).sum(axis=0)
            for weights in (_E5, _E3)
        )
        return np.asarray(np.abs(self.h) * error_norm(fifth, third, len(scale)))

    def rows(self) -> Array:
        """The nested polynomials of the steps, (7, n, c)."""
        slopes, h = self.slopes, self.h
        for stage, (weights, share) in enumerate(_EXTRA, start=_STAGES + 1):
            states = self.start + h * np.tensordot(weights[:stage], slopes[:stage], 1)
            slopes[stage] = self.rates(self.begin + share * h, states)
        rows = np.empty((3 + len(_D), *self.start.shape))
        rows[0] = self.end - self.start
        rows[1] = h * slopes[0] - rows[0]
        rows[2] = 2.0 * rows[0] - h * (self.end_rates + slopes[0])
        rows[3:] = h * np.tensordot(_D, slopes, 1)
        return rows


@dataclass(frozen=True)
class DividedSteps:
    """The steps of some ``columns`` of a stack to their kinks, at ``shares`` (c,), and from there.

    ``errors`` (c,) are in tolerances.
    """

    columns: NDArray[np.intp]
    shares: Array
    before: SingleSteps
    after: SingleSteps
    errors: Array

    @classmethod
    def of(
        cls,
        columns: NDArray[np.intp],
        before: SingleSteps,
        after: SingleSteps,
        shares: Array,
        tolerances: tuple[float, Array],
    ) -> DividedSteps:
        errors = np.maximum(before.errors(*tolerances), after.errors(*tolerances))
        return cls(columns, shares, before, after, errors)

    def into(self, y: Array, f: Array) -> tuple[Array, Array]:
        """The stacked states and rates (n m,) at the end of a step, with those of the columns."""
        n = len(self.after.end)
        states, rates = y.reshape(n, -1).copy(), f.reshape(n, -1).copy()
        states[:, self.columns], rates[:, self.columns] = self.after.end, self.after.end_rates
        return states.ravel(), rates.ravel()

    def interpolant(self) -> DividedInterpolant:
        """The trajectories within the step."""
        rows = np.stack([self.before.rows(), self.after.rows()])
        start = np.stack([self.before.start, self.after.start])
        return DividedInterpolant(self.columns, self.shares, rows, start)


@dataclass(frozen=True)
class DividedInterpolant:
    """Nested polynomials ``rows`` (2, 7, n, c) from ``start`` (2, n, c), divided at ``shares``."""

    columns: NDArray[np.intp]
    kinks: Array
    rows: Array
    start: Array

    def __call__(
        self, places: NDArray[np.intp], shares: Array, slopes: bool
    ) -> tuple[Array, Array]:
        """States (n, k), and slopes over the whole step, at shares (k,) of columns at places."""
        kink = self.kinks[places]
        later = (shares > kink).astype(np.intp)
        lengths = np.where(later, 1.0 - kink, kink)
        within = (shares - later * kink) / lengths
        rows = self.rows[later, :, :, places].transpose(1, 2, 0)
        states, slope = nested(rows, self.start[later, :, places].T, within, slopes)
        return states, slope / lengths

    def into(self, interpolant: Interpolant, columns: NDArray[np.intp]) -> Interpolant:
        """The interpolant of some columns of the stack, with these in place of its own."""
        place = np.searchsorted(self.columns, columns)
        place = np.minimum(place, len(self.columns) - 1)
        here = np.flatnonzero(self.columns[place] == columns)
        if not here.size:
            return interpolant

        def evaluate(shares: Array, slopes: bool) -> tuple[Array, Array]:
            states, slope = interpolant(shares, slopes)
            some = shares[..., here]
            places = np.broadcast_to(place[here], some.shape).ravel()
            shape = len(states), *some.shape
            own, own_slope = self(places, some.ravel(), slopes)
            states[..., here] = own.reshape(shape)
            if slopes:
                slope[..., here] = own_slope.reshape(shape)
            return states, slope

        return evaluate


@dataclass(frozen=True)
class Kinks:
    """Where the rates of a system kink over its states, for trajectories of ``parameters`` (d, m).

    The kinks are ``rows`` of the ``surfaces`` of the system.
    """

    surfaces: OfStates
    rows: slice
    parameters: Array
    cost: Cost

    @classmethod
    def of(cls, system: System, parameters: Array) -> Kinks | None:
        """The kinks of a system; None where it has none."""
        features = system.features
        if not features.n_kinks:
            return None
        rows = slice(features.n_peaks, features.n_peaks + features.n_kinks)
        cost = function_cost(features.state_surfaces, system.user_functions)
        return cls(features.state_surfaces, rows, parameters, cost)

    def heights(self, columns: NDArray[np.intp]) -> RatesThere:
        """What vanishes at the kinks, (k, c), for some trajectories."""
        p = self.parameters[:, columns]

        def evaluate(times: Array, states: Array) -> Array:
            charge(self.cost(columns.size))
            rows = self.surfaces(times, states, p)[self.rows]
            return np.broadcast_to(rows, (len(rows), columns.size))

        return evaluate


def crossed_once(first: Array, last: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The columns whose heights (k, c) change their sign in one row, and the rows."""
    changes = first * last < 0.0
    columns = np.flatnonzero(changes.sum(axis=0) == 1)
    return columns, changes[:, columns].argmax(axis=0)


def divided_steps(
    columns: NDArray[np.intp],
    rates: RatesThere,
    heights: Callable[[Array, Array], Array],
    step: tuple[float, float, Array, Array],
    last: Array,
    tolerances: tuple[float, Array],
) -> DividedSteps | None:
    """Steps of some trajectories that are divided where each crosses a kink.

    Parameters
    ----------
    columns : array (c,)
        Their places in the stack, ascending.
    rates, heights : callable
        Their rates, and what vanishes at the kink of each, (c,).
    step : tuple
        The time, the length, and the states and rates (n, c) at the start of the step.
    last : array (c,)
        About the heights at the end, of the other sign than at the start.
    tolerances : tuple
        The relative one, and the absolute ones (n, c).

    Returns
    -------
    DividedSteps or None
        None where a crossing was not found.
    """
    time, h, start, f = step
    begin = np.full(columns.size, time)
    first = heights(begin, start)
    low, high, shares = np.zeros(columns.size), np.ones(columns.size), first / (first - last)
    for _ in range(_MOST_TRIED):
        before = SingleSteps(rates, begin, start, f, shares * h)
        there = begin + shares * h
        height = heights(there, before.end)
        beyond = before.end + DIFFERENCE * h * before.end_rates
        slope = (heights(there + DIFFERENCE * h, beyond) - height) / DIFFERENCE
        change = -height / np.where(slope == 0.0, np.nan, slope)
        if np.all(np.abs(change) <= SAME):
            after = SingleSteps(rates, there, before.end, before.end_rates, (1.0 - shares) * h)
            return DividedSteps.of(columns, before, after, shares, tolerances)
        same = height * first > 0.0
        low, high = np.where(same, shares, low), np.where(same, high, shares)
        better = shares + change
        inside = (better > low) & (better < high)
        shares = np.where(inside, better, 0.5 * (low + high))
    return None
