"""Trajectories with spans of their own, as a stack over the share of the way.

Over it all of them begin and end together, so that any integrator of stacks serves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, charge
from rankone.support.costs import function_cost
from rankone.tensors.bases.time_grid import insets
from rankone.trajectories.integrators.integrator import (
    Path,
    SeparateTrajectories,
    Spans,
    Tolerances,
    joined,
)
from rankone.trajectories.system.constraints import Constraints
from rankone.trajectories.system.features import Jumps, OfParameters, VectorLike
from rankone.trajectories.system.system import System

# Integrates a system at points over edges, such as :meth:`Integrator.run`
SeparateRun: TypeAlias = Callable[
    [System, Array, Sequence[float], Tolerances], SeparateTrajectories
]


def paths_over_shares(
    run: SeparateRun, system: System, points: Array, spans: Spans, tolerances: Tolerances
) -> list[Path]:
    """The paths of spans; see :meth:`SpanIntegrator.paths`."""

    def part(over: Spans) -> list[Path]:
        times = zip(over.starts, over.ends, strict=True)
        paths = share_paths(run, system, points, over, tolerances)
        return [path.over_times(*span) for path, span in zip(paths, times, strict=True)]

    return part_by_part(part, spans)


def part_by_part(part: Callable[[Spans], Sequence[Path]], spans: Spans) -> list[Path]:
    """The paths of spans, of which ``part`` gives one from each time between them to the next."""
    if spans.between is None:
        return [*part(spans)]
    paths_of_parts = list[Sequence[Path]]()
    starts, states = spans.starts, spans.states
    for ends in [*spans.between.T, spans.ends]:
        paths_of_parts.append(part(Spans(starts, states, ends)))
        if any(path.end < end for path, end in zip(paths_of_parts[-1], ends, strict=True)):
            break
        starts, states = ends, np.stack([path.state for path in paths_of_parts[-1]], axis=1)
    return [joined(each) for each in zip(*paths_of_parts, strict=True)]


def share_paths(
    run: SeparateRun, system: System, points: Array, spans: Spans, tolerances: Tolerances
) -> Sequence[Path]:
    """The paths of spans over the share of the way, from 0 to 1; spans may go back in time."""
    lengths = spans.ends - spans.starts
    n = len(spans.states)
    first, last = np.minimum(spans.starts, spans.ends), np.maximum(spans.starts, spans.ends)
    near = insets(first, last) * np.sign(lengths)
    moved = np.column_stack([points, spans.states.T, spans.starts, lengths, near])
    longest = tolerances.longest_step / (float(np.abs(lengths).max()) or 1.0)
    begun = _begun_with(system, lambda p: np.asarray(p)[-3 - n : -3])
    try:
        over = replace(tolerances, longest_step=longest)
        dense = run(_over_shares(begun), moved, (0.0, 1.0), over)
    except OutOfBudgetError as out:
        reached = out.reached
        if reached is not None and reached.time is not None:
            time = float((spans.starts + reached.time * lengths).min())
            reached = reached._replace(time=time)
        raise out.at(reached) from out
    return dense.paths


def _begun_with(system: System, states: OfParameters) -> System:
    """The system with states (n, m) of its parameters at the start, and without its jumps."""
    return replace(
        system.starting_at(states),
        jumps=Jumps(),
        constraints=Constraints(),
    )


def _over_shares(system: System) -> System:
    """The system over the share of the way; where each begins is told by further parameters.

    They are its state, its time, the length of the way, and how far times stay inside of it: rates
    may jump at its ends. Terms are those of the system times the length; functions of time in them
    are over times still.
    """
    cost, n = function_cost(system.rhs, system.user_functions), system.n_differential
    length_alone = *(0,) * (n + 1), 1, 0

    def split(rows: Array) -> tuple[float, Array, Array, Array, Array, Array]:
        """The share from which all are inside, and before the end; starts and lengths.

        Behind these the least and the most that is gone, and the system's parameters.
        """
        start, length, near = rows[-3:]
        least, most = np.minimum(near, length - near), np.maximum(near, length - near)
        inside = float((near / np.where(length == 0.0, 1.0, length)).max(initial=0.0))
        return inside, start, length, least, most, rows[: len(rows) - n - 3]

    last: list[
        tuple[Array, tuple[float, Array, Array, Array, Array, Array]]
    ] = []  # stages of steps are at the same points

    def at(share: float | Array, p: VectorLike) -> tuple[Array, Array, Array]:
        """Times, the parameters of the system, and lengths."""
        rows = np.asarray(p)
        if not last or last[0][0] is not rows:
            last[:] = [(rows, split(rows))]
        inside, start, length, least, most, parameters = last[0][1]
        gone = share * length
        if not (isinstance(share, float) and inside <= share <= 1.0 - inside):
            gone = np.minimum(np.maximum(gone, least), most)
        return start + gone, parameters, length

    def rhs(share: float | Array, u: VectorLike, p: VectorLike) -> Array:
        times, parameters, length = at(share, p)
        charge(cost(length.size))
        return np.asarray(length * system.rhs(times, u, parameters))

    def jacobian(share: float | Array, u: VectorLike, p: VectorLike) -> Array:
        times, parameters, length = at(share, p)
        return np.asarray(length * system.jacobian(times, u, parameters))

    def surfaces(share: float | Array, u: VectorLike, p: VectorLike) -> Array:
        times, parameters, _ = at(share, p)
        return system.features.state_surfaces(times, u, parameters)

    features = replace(system.features, state_surfaces=surfaces)

    def parameter_factors(j: int, p: Array) -> Array:
        if j < len(system.parameters):
            return system.parameter_factors(j, p)
        return np.stack([np.ones_like(p), p])

    return replace(
        system,
        rhs=rhs,
        jacobian=jacobian,
        features=features,
        parameter_factors=parameter_factors,
        terms=tuple(
            (coefficient, state, (*rows, *length_alone), states)
            for coefficient, state, rows, states in system.terms
        ),
    )
