"""The form of a problem in which each switch of its rates is held on one side of its surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy as sp

from rankone.codegen.loading import ModuleSpecification
from rankone.codegen.module import general_source
from rankone.expressions.stable import NUMPY, in_floats, stable
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.symbolic import FirstOrderSystem
from rankone.symbolic.levels import by_levels, levelled
from rankone.symbolic.switches import NotHeld, held_switches
from rankone.trajectories.coarse import coarse_states
from rankone.verification.points import check_points

_POINTS = 32  # Points of the box at which rates are compared
_BESIDE = 0.1  # Their distance from the initial states
_AGREEMENT = 1e-10  # Relative difference of rates beyond rounding
_COARSE_POINTS, _COARSE_STEPS = 8, 512  # Trajectories, besides corners, that reach levels


def held_form(first_order: FirstOrderSystem, system: System) -> FirstOrderSystem | None:
    """The first-order system with the sides of its switches as states, if they can be held.

    ``system`` is the module of the same equations as they are written.
    """
    if first_order.constraints.names or first_order.rest is not None:
        return None
    try:
        return held_switches(_by_levels(first_order, system))
    except (NotHeld, ProblemError, np.linalg.LinAlgError):  # of coarse steps
        return None


def _by_levels(first_order: FirstOrderSystem, system: System) -> FirstOrderSystem:
    """The first-order system with a switch for each level that coarse trajectories reach."""
    arguments = levelled(first_order.examined_rates)
    if not arguments:
        return first_order
    lower, upper = _reached(arguments, first_order, system)
    if not np.isfinite([lower, upper]).all():
        raise NotHeld
    spans = zip(lower.tolist(), upper.tolist(), strict=True)
    reached = dict(zip(arguments, spans, strict=True))
    rates = tuple(by_levels(rate, reached) for rate in first_order.examined_rates)
    return replace(first_order, rhs=rates)


def _reached(
    arguments: Sequence[sp.Expr], first_order: FirstOrderSystem, system: System
) -> tuple[Array, Array]:
    """The smallest and the largest values of expressions (k,) along coarse trajectories."""
    bounds = np.array(system.box, dtype=float).reshape(-1, 2)
    points = check_points(bounds, _COARSE_POINTS, every_corner=True)
    times, states = coarse_states(system, points, _COARSE_STEPS)
    clock, *parameters = (coordinate.symbol for coordinate in first_order.coordinates)
    symbols = [clock, *first_order.functions, *parameters]
    dummies = {symbol: sp.Dummy(real=True) for symbol in symbols}
    expressions = [in_floats(stable(each)).xreplace(dummies) for each in arguments]
    function = sp.lambdify([*dummies.values()], expressions, [NUMPY, "numpy", "scipy"])
    with np.errstate(all="ignore"):
        values = function(times, *states, *points.T[:, :, None])
    at_all = np.stack([np.broadcast_to(each, states.shape[1:]) for each in values])
    flat = np.where(np.isfinite(at_all), at_all, np.nan).reshape(len(arguments), -1)
    return np.fmin.reduce(flat, axis=1), np.fmax.reduce(flat, axis=1)


def held_system(held: FirstOrderSystem | None, system: System, name: str) -> System | None:
    """The system of a held form, if there is one whose rates are those of a system."""
    try:
        source = "" if held is None else general_source(held, name)
    except ProblemError:
        return None
    if held is None:
        return None
    loaded = ModuleSpecification(source, f"{name} held", held.user_functions).load()
    return loaded if _agrees(loaded, system) else None


def with_sides(held: System, t: Array, u: Array, p: Array) -> Array:
    """States (n, m) beside the surfaces of a held system, with the sides that they are on."""
    sides = np.ones((held.n_sides, u.shape[1]))
    for _ in range(2):  # inner surfaces come first; sides may tell which others count
        for k, event in enumerate(held.events[-held.n_sides :]):
            sides[k] *= np.sign(event.when(t, np.concatenate([u, sides]), p))
    return np.concatenate([u, sides])


def _agrees(held: System, system: System) -> bool:
    """Whether the rates of both are the same at states beside the initial ones.

    And whether the factors of the held ones are finite.
    """
    bounds = np.array(system.box, dtype=float).reshape(-1, 2)
    p = np.ascontiguousarray(check_points(bounds, _POINTS, every_corner=True).T)
    n, t = system.n_differential, np.full(p.shape[1], system.horizon[0])
    with np.errstate(all="ignore"):
        start = system.initial(p)
        beside = np.random.default_rng(0).standard_normal(start.shape)
        u = with_sides(held, t, start + beside * _BESIDE, p)
        ours = np.broadcast_to(held.rhs(t, u, p), u.shape)[:n]
        theirs = np.broadcast_to(system.rhs(t, u[:n], p), ours.shape)
        factors = (held.parameter_factors(j, values) for j, values in enumerate(p))
        if not all(np.isfinite(each).all() for each in factors):
            return False
        both = np.isfinite(ours) & np.isfinite(theirs) & np.isfinite(u).all(axis=0)
        size = np.abs(theirs).max(axis=1, keepdims=True, where=both, initial=0.0)
    return bool(both.any() and (np.abs(ours - theirs) <= _AGREEMENT * size)[both].all())
