"""Forward sensitivities: derivatives of trajectories along directions of the parameters.

Along a trajectory u of u' = f(t, u, p) they obey the linear equation S' = f_u S + f_p P, with the
directions in the columns of P (Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I,
I.14). It is solved by Radau collocation on steps of the trajectory. What a step does to S does not
depend on S, so that the steps of all trajectories are solved together, and then follow each other.
Steps in which S is not resolved are halved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from rankone.discretization.radau import RadauCollocation, insets
from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.errors import ConvergenceError

_STAGES = 5  # Of the collocation, unless fewer are asked for: order 9 at the ends of steps
_MOST_ROUNDS = 12  # Rounds in which steps are halved
_MOST_STEPS = 20_000
_UNRESOLVED = 1e-5  # Last coefficient of S in a step, over its size, above which it is halved
_SMALL = 1e-2  # Share of a state's size that sensitivities are resolved beside, at least
_MOST_NUMBERS = 4_000_000  # Of the matrices that are solved at once

Slopes: TypeAlias = Callable[[Array, Array, NDArray[np.intp]], Array]
"""Derivatives (n, w, N) of rates, at times (N,), states (n, N) and the trajectories (N,)."""


@dataclass(frozen=True)
class Forcing:
    """What moves m trajectories: derivatives along w directions of each.

    ``rates`` maps times (N,), states (n, N) and the numbers of trajectories (N,) to the derivatives
    (n, w, N) of the rates, at constant states; ``start`` (n, w, m) are those of the states at the
    start.
    """

    rates: Slopes
    start: Array


def sensitivities(
    system: System,
    points: Array,
    path: Callable[[Array], Array],
    steps: Sequence[float],
    forcing: Forcing,
    times: Array,
    *,
    stages: int = _STAGES,
    halves: bool = True,
) -> Array:
    """Derivatives (n, w, m, T) of trajectories at points (m, d), at times (T,).

    ``path`` gives the states (n, m, T) at times; ``steps`` ascend from the start to the end, and
    rates are smooth in between. Unless it ``halves`` steps, the times should be ends of steps: with
    few ``stages`` derivatives are less accurate in between.

    Raises
    ------
    ConvergenceError
        If they are not resolved by a reasonable number of steps.
    """
    ends = np.array(steps)
    sizes = np.abs(path(ends)).max(axis=2)
    for _ in range(_MOST_ROUNDS):
        collocated = _collocated(system, points, path, ends, forcing, stages)
        coarse = _unresolved(collocated, sizes) if halves else np.zeros(1, dtype=bool)
        if not coarse.any():
            return _at(collocated, ends, times)
        if ends.size > _MOST_STEPS:
            break
        middles = 0.5 * (ends[:-1] + ends[1:])[coarse]
        ends = np.sort(np.concatenate([ends, middles]))
    raise ConvergenceError(
        "the derivatives of a trajectory with respect to parameters are not resolved by "
        f"{ends.size} steps",
        remedy="the rates may jump where the equations do not say so; ask for values alone",
    )


def _collocated(
    system: System,
    points: Array,
    path: Callable[[Array], Array],
    ends: Array,
    forcing: Forcing,
    stages: int,
) -> Array:
    """Derivatives (K, 1 + stages, n, w, m) at the start and the nodes of each step."""
    n, w, m = forcing.start.shape
    steps = ends.size - 1
    values = np.empty((steps, m, 1 + stages, n, w))
    many = max(1, _MOST_NUMBERS // (m * stages * n * (stages * n + n + w)))
    current = np.moveaxis(forcing.start, 2, 0)  # (m, n, w)
    for first in range(0, steps, many):
        some = slice(first, min(first + many, steps))
        ends_of = ends[some.start : some.stop + 1]
        carried, driven = _maps(system, points, path, ends_of, forcing, stages)
        for k in range(some.start, some.stop):
            values[k, :, 0] = current
            current = carried[k - first, :, -1] @ current + driven[k - first, :, -1]
        values[some, :, 1:] = carried @ values[some, :, :1] + driven
    return values.transpose(0, 2, 3, 4, 1)


def _maps(
    system: System,
    points: Array,
    path: Callable[[Array], Array],
    ends: Array,
    forcing: Forcing,
    stages: int,
) -> tuple[Array, Array]:
    """What steps do: (K, m, stages, n, n) times S at the start, and (K, m, stages, n, w) added."""
    scheme = RadauCollocation.of(stages)
    (n, w, m), steps = forcing.start.shape, ends.size - 1
    lengths = np.diff(ends)
    near = insets(ends[:-1], ends[1:])
    times = (ends[:-1] + near)[:, None] + (lengths - 2.0 * near)[:, None] * scheme.nodes
    count = steps * stages
    flat = np.tile(times.ravel(), m)
    states = path(times.ravel()).reshape(n, m * count)
    which = np.repeat(np.arange(m), count)
    jacobian = np.broadcast_to(
        system.jacobian(flat, states, np.ascontiguousarray(points[which].T)), (n, n, m * count)
    )
    slopes = np.broadcast_to(forcing.rates(flat, states, which), (n, w, m * count))
    h = lengths[:, None, None, None, None]
    blocks = h * jacobian.reshape(n, n, m, steps, stages).transpose(3, 2, 4, 0, 1)
    pushes = h * slopes.reshape(n, w, m, steps, stages).transpose(3, 2, 4, 0, 1)
    matrix = np.zeros((steps, m, stages, n, stages, n))
    diagonal = np.arange(n)
    matrix[:, :, :, diagonal, :, diagonal] = scheme.derivative
    node = np.arange(stages)
    matrix[:, :, node, :, node, :] -= np.moveaxis(blocks, 2, 0)
    right = np.empty((steps, m, stages, n, n + w))
    right[..., :n] = scheme.start[:, None, None] * np.eye(n)
    right[..., n:] = pushes
    size = stages * n
    left, sides = matrix.reshape(steps, m, size, size), right.reshape(steps, m, size, n + w)
    solved = np.asarray(np.linalg.solve(left, sides), dtype=float).reshape(right.shape)
    return solved[..., :n], solved[..., n:]


def _unresolved(collocated: Array, sizes: Array) -> Array:
    """The steps (K,) whose last coefficient is too large; ``sizes`` (n, m) are those of states."""
    modal = RadauCollocation.of(collocated.shape[1] - 1).to_modal[-1]
    last = np.abs(np.einsum("s,ksnwm->knwm", modal, collocated))
    largest = np.abs(collocated).max(axis=(0, 1))
    allowed = _UNRESOLVED * np.maximum(largest, _SMALL * sizes[:, None])
    with np.errstate(invalid="ignore"):
        return np.asarray((last > allowed).any(axis=(1, 2, 3)))


def _at(collocated: Array, ends: Array, times: Array) -> Array:
    """Values (n, w, m, T) of the polynomials at times."""
    points = RadauCollocation.of(collocated.shape[1] - 1).points
    step = np.clip(np.searchsorted(ends, times, side="left") - 1, 0, ends.size - 2)
    shares = (times - ends[step]) / (ends[step + 1] - ends[step])
    weights = np.linalg.solve(
        np.vander(points, increasing=True).T, np.vander(shares, points.size, increasing=True).T
    )
    return np.asarray(np.einsum("st,tsnwm->nwmt", weights, collocated[step]))
