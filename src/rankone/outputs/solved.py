"""Quantities of a solution as an outcome, and what was asked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rankone.ir.metadata import Role, SolutionMetadata
from rankone.ir.outcome import Outcome
from rankone.ir.verdict import EarlyEnd
from rankone.outputs.interpolation import solved_quantities
from rankone.outputs.quantities import Quantities
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.budget import operations_for
from rankone.support.errors import OptionError
from rankone.support.options import checked_number
from rankone.support.wording import did_you_mean, quote

__all__ = ["samples_of", "with_outputs"]

_SAMPLES, _SEED = 20, 1795


def samples_of(solution: SolutionCore) -> tuple[Array, Array, Array]:
    """Some times (m,), parameters (d, m) and the states there (n, m)."""
    rng = np.random.default_rng(_SEED)
    box = np.array(list(solution.parameters.values()), dtype=float).reshape(-1, 2)
    p = box[:, :1] + (box[:, 1:] - box[:, :1]) * rng.random((len(box), _SAMPLES))
    start, end = solution.time
    t = start + (end - start) * rng.random(_SAMPLES)
    named = dict(zip(solution.parameters, p, strict=True))
    at = () if solution.metadata.timeless else (t,)
    states = [np.broadcast_to(solution[s](*at, **named), t.shape) for s in solution.states]
    return t, p, np.array(states)


def with_outputs(
    solution: SolutionCore,
    quantities: Quantities,
    rtol: float | None,
    effort: str | float,
    max_seconds: float | None,
    units: Mapping[str, str],
) -> tuple[Outcome, SolutionMetadata]:
    """Quantities of interest; see :meth:`rankone.Solution.output`."""
    if rtol is not None:
        rtol = checked_number("rtol", rtol, 1e-13, 0.999, float)
    seconds = math.inf
    if max_seconds is not None:
        seconds = checked_number("max_seconds", max_seconds, 0.0, 1e9, float)
    limits = operations_for(effort), seconds
    _check_units(units, quantities)
    outcome, rtol = solved_quantities(solution, quantities, rtol, *limits)
    metadata = solution.metadata
    if solution.time[1] < metadata.horizon[1]:
        cause = EarlyEnd(
            *solution.time, metadata.horizon[1], outcome.verdict, solution.outcome.verdict
        )
        outcome = replace(outcome, status=solution.status, cause=cause, notes=())
    return outcome, replace(
        metadata,
        states=quantities.names,
        roles=(Role.UNKNOWN,) * len(quantities.names),
        horizon=solution.time,
        rtol=rtol,
        equations=quantities.texts,
        source=None,
        timeless=quantities.timeless,
        units=(
            *(pair for pair in metadata.units if pair[0] in metadata.coordinates),
            *units.items(),
        ),
    )


def _check_units(units: Mapping[str, str], quantities: Quantities) -> None:
    """Raise unless units are texts by names of quantities."""
    if not isinstance(units, Mapping) or not all(isinstance(u, str) for u in units.values()):
        raise OptionError(
            f"units={units!r} is no mapping to texts", term=units, remedy='give {"name": "m/s"}'
        )
    for name in units:
        if name not in quantities.names:
            raise OptionError(
                f"there is no output {quote(name)}{did_you_mean(name, quantities.names)}", term=name
            )
