"""The generated functions of a problem compared with its equations as they were written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp
from mpmath.libmp import mpf_add, to_float
from sympy.core.function import AppliedUndef

from rankone.agreement.comparison import LOST, Comparison, sides
from rankone.agreement.precise import NoValueError, Number, number
from rankone.frontend.problem import Problem
from rankone.ir.forms import Jump
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.support.wording import quote
from rankone.symbolic import FirstOrderSystem

__all__ = ["STILL", "DisagreementError", "Points", "check_problem", "disagreeing_rate"]


_DRIFTS = (0.0, 1e-3, 0.03, 0.3)
"""Parts of the horizon over which states have moved from the start, at their first rate."""
_NOISE = (1e-9, 1e-5, 0.01, 0.3)
"""Relative distances of states from there. Zero states move too, except at still points."""
_LARGEST_DRIFT = 10.0
"""In units of the largest initial value of a state."""
STILL = len(_DRIFTS)
"""One point in so many is still: its states are those at the start, apart from the noise."""
_SEED = 1937


@dataclass(frozen=True)
class Points:
    """Where a problem is looked at: times (m,), parameters (d, m), states and rates (n, m).

    ``sizes`` (n,) are how large states are, as far as the start and the first rates tell.
    """

    time: Array
    parameters: Array
    states: Array
    rates: Array
    sizes: Array

    @classmethod
    def of(cls, system: System, count: int) -> Points:
        """Points over the horizon, the box and plausible states; the same for the same system."""
        rng = np.random.default_rng(_SEED)
        start, end = system.horizon
        box = np.asarray(system.box, dtype=float).reshape(-1, 2)
        time = start + (end - start) * rng.random(count)
        p = box[:, :1] + (box[:, 1:] - box[:, :1]) * rng.random((len(box), count))
        initial = np.asarray(system.initial(p), dtype=float)
        first = np.nan_to_num(np.asarray(system.rhs(start, initial, p), dtype=float))
        drift = first * (time - start) * np.resize(_DRIFTS, count)
        size = np.abs(initial).max(axis=1, keepdims=True)
        longest = np.where(size > 0.0, _LARGEST_DRIFT * size, np.inf)
        moved = initial + np.clip(drift, -longest, longest)
        noise = np.repeat(_NOISE, -(-count // len(_NOISE)))[:count]
        states = moved * (1.0 + noise * rng.uniform(-1.0, 1.0, moved.shape))
        reach = np.abs(first).max(axis=1, keepdims=True) * (end - start)
        away = noise * np.where(reach > 0.0, reach, 1.0) * (np.resize(_DRIFTS, count) > 0.0)
        states = np.where(moved == 0.0, away, states)
        states = np.where(np.isfinite(states), states, initial)
        rates = np.asarray(system.rhs(time, states, p), dtype=float)
        return cls(time, p, states, rates, np.abs(moved).max(axis=1))


_TOLERANCE = 1e-6
"""Differences beyond, relative to the largest rate of a state, are not those of rounding."""


def disagreeing_rate(lifted: System, system: System) -> int | None:
    """The first state whose rate the lifted system has wrong; None where there is none.

    Numbers of a system that is multiplied out may overflow where those of the system as it is
    written do not.
    """
    with np.errstate(all="ignore"):
        points = Points.of(system, _POINTS)
        t, p, u = points.time, points.parameters, points.states
        count = lifted.n_lifted
        states = np.concatenate([u, np.ones((count, t.size))])
        for _ in range(count):  # some stand for functions of others
            states[len(u) :] = lifted.meanings(t, states, p)
        finite = np.isfinite(points.rates).all(axis=0) & np.isfinite(states).all(axis=0)
        rates = np.asarray(lifted.rhs(t, states, p), dtype=float)[: len(u)]
        size = np.abs(points.rates[:, finite]).max(axis=1, initial=0.0)
        off = np.abs(rates - points.rates)[:, finite]
        wrong = ~(off <= _TOLERANCE * size[:, None]).all(axis=1)
    return int(np.argmax(wrong)) if wrong.any() else None


_POINTS, _FEWEST = 20, 3
"""Points at which a problem is looked at; the least number for one of very many operations."""
_MOST_OPERATIONS = 12000
"""Operations at a hundred digits for the rates."""
_JACOBIANS = 3
_SLOPE_TOLERANCE, _NOTHING, _FACTOR = 1e-6, 1e-15, 1e5
"""Derivatives may be off by this part of their terms, and of the change of the states; or by so
many times what rounding errors of 1e-10 do."""
_UNSEEN = 1e-13
"""Part of its size by which an error of a rate may move a state over the horizon."""
_REMEDY = "write it in another way, or change the units so that its numbers are closer to 1"


class DisagreementError(ProblemError):
    """Generated code differs from the problem by more than rounding."""


def check_problem(
    problem: Problem, first_order: FirstOrderSystem, system: System, lost: float = LOST
) -> None:
    """Compare rates, Jacobian, initial values and jumps with the problem as it was written.

    Parameters
    ----------
    lost : float
        Part of the largest value of each that rounding may spoil.

    Raises
    ------
    DisagreementError
        If one of them is off by more than rounding; the message names the equation.
    """
    clock, *parameters = first_order.coordinates
    states = [state.expression for state in first_order.states]
    rates = [state.diff(clock.symbol) for state in states]
    leaves = [clock.symbol, *(c.symbol for c in parameters), *states]
    highest = [i for i, rate in enumerate(rates) if rate not in states]
    written = [_written(e, r) for e, r in zip(problem.equations, problem.residuals, strict=True)]
    computed = [rates[i] for i in highest]
    compared = [Comparison(*pair, [*leaves, *computed], computed) for pair in written]
    operations = sum(comparison.operations for comparison in compared)
    count = max(min(_POINTS, _MOST_OPERATIONS // max(operations, 1)), _FEWEST)
    with np.errstate(all="ignore"):
        points = Points.of(system, count)
        _check_rates(problem, first_order, compared, points, highest, lost)
        smooth = [
            c if _is_smooth(pair) else None for c, pair in zip(compared, written, strict=True)
        ]
        _check_jacobian(system, first_order, smooth, points, highest)
        _check_initial(first_order, points, system.initial(points.parameters), lost)
        if first_order.jumps:
            _check_jumps(first_order, system, points, lost)


def _written(equation: sp.Basic, residual: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """Both sides of an equation, of unknowns and their derivatives alone."""
    nested = any(not isinstance(d.expr, AppliedUndef) for d in equation.atoms(sp.Derivative))
    return (residual, sp.S.Zero) if nested else sides(equation)


def _is_smooth(pair: tuple[sp.Expr, sp.Expr]) -> bool:
    """Whether differences of its values are derivatives: functions of the user have no digits."""
    return not any(hasattr(f, "_imp_") for side in pair for f in side.atoms(sp.Function))


def _values(*blocks: Sequence[float] | Array) -> list[Number]:
    return [number(value) for block in blocks for value in block]


def _check_rates(
    problem: Problem,
    first_order: FirstOrderSystem,
    compared: Sequence[Comparison],
    points: Points,
    highest: Sequence[int],
    lost: float,
) -> None:
    """Raise if the generated rates do not solve the equations."""
    chosen = list(_finite(points.states, points.rates))
    p, u, f = points.parameters, points.states, points.rates[highest]
    values = [_values([points.time[k]], p[:, k], u[:, k], f[:, k]) for k in chosen]
    start, end = first_order.coordinates[0].lower, first_order.coordinates[0].upper
    slowest = _UNSEEN * np.nan_to_num(points.sizes) / (end - start)
    for origin, comparison in enumerate(compared, start=1):
        own = [i for i, state in enumerate(first_order.origins) if state in (origin, None)]
        nothing = float(slowest[own].min(initial=np.inf)) if own else 0.0
        wrong = comparison.beyond_rounding(values, lost, nothing)
        if wrong is not None:
            where = _described(points, chosen[wrong[0]], first_order)
            raise DisagreementError(
                f"the generated code does not compute {quote(problem.equations[origin - 1])} as it "
                f"is written: at {where} the sides differ by {wrong[1]:.3g}",
                equation=origin,
                term=problem.equations[origin - 1],
                remedy=_REMEDY,
            )


def _check_jacobian(
    system: System,
    first_order: FirstOrderSystem,
    compared: Sequence[Comparison | None],
    points: Points,
    highest: Sequence[int],
) -> None:
    """Raise if moving the states and, by the Jacobian, the rates leaves the equations."""
    rng = np.random.default_rng(_SEED)
    moved = [k for k in _finite(points.states, points.rates) if k % STILL]
    for k in moved[:_JACOBIANS]:
        t, p, u, f = (
            points.time[k],
            points.parameters[:, k],
            points.states[:, k],
            points.rates[:, k],
        )
        jacobian = np.asarray(system.jacobian(t, u, p), dtype=float)
        size = np.where(u != 0.0, np.abs(u), 1.0)
        direction = size * rng.uniform(0.5, 1.0, len(u)) * rng.choice([-1.0, 1.0], len(u))
        change = jacobian @ direction
        if not np.isfinite(jacobian).all():
            continue
        here = _values([t], p, u, f[highest])
        along_states = _values([0.0], 0.0 * p, direction, 0.0 * f[highest])
        along_rates = _values([0.0], 0.0 * p, 0.0 * u, change[highest])
        for origin, comparison in enumerate(compared, start=1):
            if comparison is None:
                continue
            try:
                off, scale = _slope(comparison, here, along_states, along_rates)
                if abs(off) <= _SLOPE_TOLERANCE * scale + _NOTHING * np.abs(direction).max():
                    continue
                spread = comparison.slope_spread(here, [along_states, along_rates], off)
            except (NoValueError, OverflowError):
                continue
            if abs(off) > _FACTOR * spread:
                raise DisagreementError(
                    "the generated Jacobian is not the derivative of the equation: at "
                    f"{_described(points, k, first_order)} it is off by {off:.3g} along the states",
                    equation=origin,
                    remedy=_REMEDY,
                )


def _slope(
    comparison: Comparison,
    here: Sequence[Number],
    along_states: Sequence[Number],
    along_rates: Sequence[Number],
) -> tuple[float, float]:
    """The derivative of a residual along states and rates together, and the size of both."""
    slopes = [comparison.slope(here, direction) for direction in (along_states, along_rates)]
    _, terms = comparison.residual(here)
    return to_float(mpf_add(*slopes)), sum(abs(to_float(slope)) for slope in slopes) + terms


def _check_initial(
    first_order: FirstOrderSystem, points: Points, generated: Array, lost: float
) -> None:
    """Raise if generated initial values are not those that were given."""
    symbols = [c.symbol for c in first_order.coordinates[1:]]
    computed = sp.Dummy()
    for i, value in enumerate(first_order.initial):
        comparison = Comparison(computed, value, [*symbols, computed], [computed])
        p, chosen = points.parameters, _finite(generated[i : i + 1])
        values = (_values(p[:, k], [generated[i, k]]) for k in chosen)
        wrong = comparison.beyond_rounding(values, lost)
        if wrong is not None:
            state = first_order.states[i].expression
            raise DisagreementError(
                f"the generated code does not compute the initial value of {quote(state)}, "
                f"{quote(value)}, as it is written: it is off by {wrong[1]:.3g}",
                term=value,
                remedy=_REMEDY,
            )


def _check_jumps(
    first_order: FirstOrderSystem, system: System, points: Points, lost: float
) -> None:
    """Raise if generated values after jumps are not those that were given."""
    symbols = [c.symbol for c in first_order.coordinates[1:]]
    computed = sp.Dummy()
    leaves = [*symbols, *first_order.functions, computed]
    for kind, (values_after, times) in enumerate(Jump.kinds(first_order.jumps).items()):
        generated = np.asarray(
            system.jumps.jumped(kind, points.states, points.parameters), dtype=float
        )
        for i, value in enumerate(values_after):
            if value == first_order.functions[i]:
                continue
            comparison = Comparison(computed, value, leaves, [computed])
            p, u = points.parameters, points.states
            chosen = _finite(u, generated[i : i + 1])
            values = (_values(p[:, k], u[:, k], [generated[i, k]]) for k in chosen)
            wrong = comparison.beyond_rounding(values, lost)
            if wrong is not None:
                clock, state = first_order.coordinates[0].name, first_order.states[i].expression
                raise DisagreementError(
                    f"the generated code does not compute the value of {quote(state)} after the "
                    f"jump at {clock} = {times[0]:g}, {quote(value)}, as it is written: it is off "
                    f"by {wrong[1]:.3g}",
                    term=value,
                    remedy=_REMEDY,
                )


def _finite(*arrays: Array) -> Iterator[int]:
    """The points at which all is finite; what is not is refused elsewhere, or never met."""
    finite = np.logical_and.reduce([np.isfinite(array).all(axis=0) for array in arrays])
    yield from map(int, np.flatnonzero(finite))


def _described(points: Points, k: int, first_order: FirstOrderSystem) -> str:
    """Where a point is, for messages."""
    clock, *parameters = first_order.coordinates
    named = [(clock.name, points.time[k])]
    named += [(c.name, v) for c, v in zip(parameters, points.parameters[:, k], strict=True)]
    named += [(s.name, v) for s, v in zip(first_order.states, points.states[:, k], strict=True)]
    return ", ".join(f"{name} = {value:.6g}" for name, value in named)
