"""Rates and Jacobians as LSODA calls them: for floats where they can be rewritten."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import function_cost, scalar_cost
from rankone.trajectories.integrator import finite_blocks, jacobians
from rankone.trajectories.scalar import scalar_jacobian, scalar_rates

_COUNTED_CALLS = 100  # Calls of the rates that are charged at once
_LOOKED_CALLS = 3000  # Calls after which progress is looked at
_TINY_PROGRESS = 1e-6  # Way in that many calls, in horizons, that is no progress
_SLOW_PROGRESS = 1e-3  # Way in as many, below which an integration begins anew
_CALL_COST = 600.0  # Operations of a call of the rates by LSODA
_MATRIX_COST = 5e3  # Operations of a matrix of the entries of a Jacobian
_LINEAR_ALGEBRA = 0.02  # Operations of LSODA for each cube of the states in a call of the rates
_FAILURES = (ArithmeticError, ValueError)  # What functions of floats raise instead of infinities

# Rates (n,) at a time and a state (n,), and their Jacobian (n, n)
Rates: TypeAlias = Callable[[float, Array], "Sequence[float] | Array"]
Jacobian: TypeAlias = Callable[[float, Array], Array]


class Border(Exception):
    """An integration gets no further: the rates are not finite at a time, or it creeps there.

    It is known to reach the time ``safe``.
    """

    def __init__(self, time: float, safe: float | None = None) -> None:
        super().__init__(time, safe)
        self.time, self.safe = time, safe


class Crawl(Border):
    """An integration is so slow that one that begins anew may be faster.

    After a jump of rates that are constant beyond it, LSODA's estimate of their slope, and so of
    the longest stable step, stays what it was across the jump.
    """


def called_by_lsoda(
    system: System, point: Array, span: tuple[float, float], horizon: float, *, restarts: bool
) -> tuple[Rates, Jacobian | None]:
    """Rates and Jacobian at a point (d,), taken within a span of time alone.

    The rates raise a Border where they are not finite, and after thousands of calls at almost the
    same time; with ``restarts`` a Crawl after as many not far from each other. The Jacobian is None
    where LSODA's own differences cost no more.
    """
    function = scalar_rates(system)
    stacked_cost = function_cost(system.rhs, system.user_functions)(1)
    each = stacked_cost if function is None else scalar_cost(function)
    each += _CALL_COST
    jacobian = _jacobian(system, point, span, system.n_differential * each)
    each += _LINEAR_ALGEBRA * system.n_differential**3
    (first, last), numbers, column = span, point.tolist(), point[:, None]
    tiny, calls, looked_at = _TINY_PROGRESS * horizon, 0, -math.inf
    slow = _SLOW_PROGRESS * horizon if restarts else tiny

    def stacked(t: float, u: Array) -> Array:
        charge(stacked_cost)
        rates = system.rhs(t, u[:, None], column)[:, 0]
        if not np.isfinite(rates).all():
            raise Border(t)
        return np.asarray(rates)

    def rates(t: float, u: Array) -> Sequence[float] | Array:
        nonlocal calls, looked_at
        if not calls % _COUNTED_CALLS:
            charge(_COUNTED_CALLS * each)
            if not calls % _LOOKED_CALLS:
                if abs(t - looked_at) < slow:
                    raise Border(t, looked_at) if abs(t - looked_at) < tiny else Crawl(t)
                looked_at = t
        calls += 1
        time = min(max(t, first), last)
        if function is None:
            return stacked(time, u)
        try:
            slopes = function(time, u.tolist(), numbers)
        except _FAILURES:
            return stacked(time, u)
        return slopes if math.isfinite(sum(slopes)) else stacked(time, u)

    return rates, jacobian


def _jacobian(
    system: System, point: Array, span: tuple[float, float], differences: float
) -> Jacobian | None:
    """The Jacobian, where it costs fewer operations than ``differences`` of the rates."""
    entries = scalar_jacobian(system)
    if entries is None:
        return None
    cost = _MATRIX_COST + scalar_cost(entries.function)
    if cost >= differences:
        return None
    (first, last), numbers, n = span, point.tolist(), system.n_differential
    rows, columns = np.array(entries.places, dtype=np.intp).reshape(-1, 2).T
    function = entries.function

    def jacobian(t: float, u: Array) -> Array:
        charge(cost)
        matrix, time = np.zeros((n, n)), min(max(t, first), last)
        try:
            matrix[rows, columns] = function(time, u.tolist(), numbers)
        except _FAILURES:
            matrix = jacobians(system, point[None], time, u)[0]
        return np.asarray(finite_blocks(matrix[None])[0])

    return jacobian


def recording(rates: Rates, called: list[float]) -> Rates:
    """Rates that append the times at which they are called."""

    def recorded(t: float, u: Array) -> Sequence[float] | Array:
        called.append(t)
        return rates(t, u)

    return recorded
