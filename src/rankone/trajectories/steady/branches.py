"""Branches of steady states: does the one at the centre of a box go on to all of its points?

It is continued from the centre along straight lines by Newton's method. Where that fails, or meets
a state that is hardly stable, the line is followed with care and its bifurcation named. Where the
branch goes on, but trajectories from the initial values lead to another steady state, the border
between the two is looked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array, bisected
from rankone.support.errors import ConvergenceError
from rankone.trajectories.steady.bifurcations import Bifurcation, BranchLine
from rankone.trajectories.steady.rest import SteadyStates

_STEPS = 24  # Steps of the continuation from the centre to a point
_MOST_NEWTON_STEPS = 15  # For each of them
_NEAR = 0.3  # Growth rate over that at the centre, from which on Newton's method may change branch
_SAME = 1e-6  # Relative distance of steady states that are the same
_HALVINGS = 24  # Of a line on which a branch ends
_SHOWN = 5  # States that a message names


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
            _MOST_NEWTON_STEPS,
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
