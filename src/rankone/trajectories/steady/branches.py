"""Branches of steady states: does the one at the centre of a box go on to all of its points?

It is continued from the centre along straight lines by Newton's method. Where that fails, or meets
no stable state, the branch ends in a fold. Where it goes on, but trajectories from the initial
values lead to another steady state, the border between the two is looked for.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array, bisected
from rankone.support.errors import ConvergenceError
from rankone.trajectories.steady.rest import SteadyStates

_STEPS = 24  # Steps of the continuation from the centre to a point
_MOST_NEWTON_STEPS = 15  # For each of them
_SAME = 1e-6  # Relative distance of steady states that are the same
_HALVINGS = 24  # Of a line on which a branch ends
_SHOWN = 5  # States that a message names


def check_one_branch(steady: SteadyStates, points: Array) -> None:
    """Raise unless trajectories at points (m, d) reach one branch, that of the first point.

    Raises
    ------
    ConvergenceError
        It says where the branch ends in a fold, or which parameters lead to another branch.
    """
    start = steady(points[:1].T)
    if not steady.decays(start, points[:1])[0]:
        return  # the initial values are at rest, and unstable
    ended = np.flatnonzero(~_goes_on(steady, start, points[0], points))
    if ended.size:
        place = _border(
            points[0], points[ended[0]], lambda at: _goes_on(steady, start, points[0], at)
        )
        raise ConvergenceError(
            f"{_described(steady, start)} ends in a fold at {_listed(steady, place)}",
            remedy=f"keep the box on one side of it; {_listed(steady, points[0])} is on this side",
        )
    elsewhere = np.flatnonzero(~_reached(steady, start, points[0], points))
    if elsewhere.size:
        place = _border(
            points[0], points[elsewhere[0]], lambda at: _reached(steady, start, points[0], at)
        )
        raise ConvergenceError(
            f"{_described(steady, start)} is left at {_listed(steady, place)}: beyond, the initial "
            f"values lead to another steady state, or to none by t = {steady.settle:g}",
            remedy="change the initial values, or keep the box on one side of it",
        )


def _continued(steady: SteadyStates, start: Array, centre: Array, points: Array) -> Array:
    """Steady states (n, m) at points (m, d), continued from the one at the centre; NaN if none."""
    constraints = steady.constraints(range(len(start)))
    states = np.repeat(start, len(points), axis=1)
    for share in np.linspace(0.0, 1.0, _STEPS + 1)[1:]:
        on_way = np.ascontiguousarray((centre + share * (points - centre)).T)
        there = np.isfinite(states).all(axis=0)
        before, at = states[:, there], on_way[:, there]
        states[:, there] = constraints.consistent(0.0, before, at, _MOST_NEWTON_STEPS)
    return states


def _goes_on(steady: SteadyStates, start: Array, centre: Array, points: Array) -> NDArray[np.bool_]:
    """Whether the branch goes on from the centre to points (m, d), and is stable there."""
    states = _continued(steady, start, centre, points)
    return steady.decays(states, points)


def _reached(steady: SteadyStates, start: Array, centre: Array, points: Array) -> NDArray[np.bool_]:
    """Whether trajectories at points (m, d) reach the branch of the centre."""
    states = _continued(steady, start, centre, points)
    sizes = np.abs(states).max(axis=0)
    return np.asarray((np.abs(steady.reached(points.T) - states) <= _SAME * sizes).all(axis=0))


def _border(inside: Array, outside: Array, holds: Callable[[Array], NDArray[np.bool_]]) -> Array:
    """The point (d,) between two others beyond which something ceases to hold."""

    def on_columns(columns: Array) -> NDArray[np.bool_]:
        return holds(np.ascontiguousarray(columns.T))

    last, _ = bisected(inside[:, None], outside[:, None], on_columns, _HALVINGS)
    return np.asarray(last[:, 0])


def _described(steady: SteadyStates, start: Array) -> str:
    """The branch by its states at the centre of the box."""
    pairs = list(zip(steady.system.states, start[:, 0].tolist(), strict=False))
    texts = [f"{name} = {at:.4g}" for name, at in pairs[:_SHOWN]]
    more = "" if len(pairs) <= _SHOWN else f" and {len(pairs) - _SHOWN} more"
    return f"the branch of steady states with {', '.join(texts)}{more} at the centre of the box"


def _listed(steady: SteadyStates, point: Array) -> str:
    pairs = zip(steady.system.parameters, point.tolist(), strict=True)
    return ", ".join(f"{name} = {at:.6g}" for name, at in pairs)
