"""The form of a problem in which each switch of its rates is held on one side of its surface."""

from __future__ import annotations

import numpy as np

from rankone.codegen.loading import ModuleSpecification
from rankone.codegen.module import general_source
from rankone.ir.system import System
from rankone.support.errors import ProblemError
from rankone.symbolic import FirstOrderSystem
from rankone.symbolic.switches import NotHeld, held_switches
from rankone.verification.points import check_points

_POINTS = 32  # Points of the box at which rates are compared
_BESIDE = 0.1  # Their distance from the initial states
_AGREEMENT = 1e-10  # Relative difference of rates beyond rounding


def held_form(first_order: FirstOrderSystem) -> FirstOrderSystem | None:
    """The first-order system with the sides of its switches as states, if they can be held."""
    if first_order.constraints.names or first_order.rest is not None:
        return None
    try:
        return held_switches(first_order)
    except (NotHeld, ProblemError):
        return None


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


def _agrees(held: System, system: System) -> bool:
    """Whether the rates of both are the same at states beside the initial ones."""
    bounds = np.array(system.box, dtype=float).reshape(-1, 2)
    p = np.ascontiguousarray(check_points(bounds, _POINTS, every_corner=True).T)
    n, t = system.n_differential, np.full(p.shape[1], system.horizon[0])
    with np.errstate(all="ignore"):
        start = system.initial(p)
        beside = np.random.default_rng(0).standard_normal(start.shape)
        u = np.concatenate([start + beside * _BESIDE, np.ones((held.n_sides, p.shape[1]))])
        for k, event in enumerate(held.events[-held.n_sides :], n):  # inner surfaces come first
            u[k] = np.sign(event.when(t, u, p))
        ours = np.broadcast_to(held.rhs(t, u, p), u.shape)[:n]
        theirs = np.broadcast_to(system.rhs(t, u[:n], p), ours.shape)
        same = np.abs(ours - theirs) <= _AGREEMENT * np.abs(theirs).max(axis=1, keepdims=True)
    return bool((same | ~np.isfinite(ours) | ~np.isfinite(theirs)).all())
