"""Quantities of interest as solutions of their own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rankone.compiler.codegen.quantities import Quantities
from rankone.solution.evaluation.core import SolutionCore
from rankone.solution.outputs.branch_outputs import OfBranch, over_branches
from rankone.solution.outputs.interpolation import Asked, OutputInterpolation
from rankone.solvers.outcome import Outcome, Role, SolutionMetadata
from rankone.solvers.verification.points import check_points
from rankone.support.arrays import Array
from rankone.support.budget import operations_for
from rankone.support.errors import OptionError
from rankone.support.options import checked_number
from rankone.support.progress import Report, quiet
from rankone.support.tasks import Pool
from rankone.support.wording import did_you_mean, quote
from rankone.tensors.evaluators.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline
from rankone.trajectories.system.verdict import EarlyEnd

LEAST_RTOL, MOST_RTOL = 1e-13, 0.999
"""Tolerances of outputs."""
_SAMPLE_COUNT = 20  # Points at which quantities are tried before any work
_SAMPLE_SEED = 1795  # Seed of these points


def samples_of(solution: SolutionCore) -> tuple[Array, Array, Array]:
    """Some times (m,), parameters (d, m) and the states there (n, m)."""
    rng = np.random.default_rng(_SAMPLE_SEED)
    box = np.array(list(solution.parameters.values()), dtype=float).reshape(-1, 2)
    p = box[:, :1] + (box[:, 1:] - box[:, :1]) * rng.random((len(box), _SAMPLE_COUNT))
    start, end = solution.time
    t = start + (end - start) * rng.random(_SAMPLE_COUNT)
    named = dict(zip(solution.parameters, p, strict=True))
    at = () if solution.metadata.timeless else (t,)
    states = [np.broadcast_to(solution[s](*at, **named), t.shape) for s in solution.states]
    at_times = np.array(states)
    runs = ~np.isnan(at_times).any(axis=0) if solution.outcome.timeline else slice(None)
    return t[runs], p[:, runs], at_times[:, runs]


def met_before_end(solution: SolutionCore, timeline: Timeline) -> Timeline:
    """The timeline up to the last instant that comes before the end at a point of the box."""
    evaluator = solution._evaluator
    assert isinstance(evaluator, TimelineEvaluator)
    box = np.array(list(solution.parameters.values()), dtype=float).reshape(-1, 2)
    points = check_points(box, _SAMPLE_COUNT, every_corner=True)
    inside = evaluator.borders(points.T)[1 : len(timeline.met) + 1] <= timeline.horizon[1]
    return timeline.up_to(int(inside.any(axis=1).sum()))


@dataclass(frozen=True)
class OutputRequest:
    """Arguments of :meth:`rankone.Solution.output`, the pool whose workers take part, and who is
    told of progress.

    Without ``units`` quantities have those of the definitions of their names.
    """

    rtol: float | None
    effort: str | float
    max_seconds: float | None
    units: Mapping[str, str] | None
    pool: Pool | None
    report: Report = quiet


def with_outputs(
    solution: SolutionCore, quantities_of: OfBranch, request: OutputRequest
) -> tuple[Outcome, SolutionMetadata]:
    """Quantities of interest; see :meth:`rankone.Solution.output`."""
    rtol, seconds, units, pool = request.rtol, math.inf, request.units, request.pool
    if rtol is not None:
        rtol = checked_number("rtol", rtol, LEAST_RTOL, MOST_RTOL, float)
    if request.max_seconds is not None:
        seconds = checked_number("max_seconds", request.max_seconds, 0.0, 1e9, float)
    asked, metadata = Asked(rtol, operations_for(request.effort), seconds), solution.metadata
    timeline = solution.outcome.timeline

    def checked(part: SolutionCore, own: Timeline | None) -> Quantities:
        quantities = quantities_of(part, own)
        _check_units(units or {}, quantities)
        return quantities

    if isinstance(timeline, BranchedTimeline):
        outcome, rtol, quantities = over_branches(
            solution, checked, asked, pool=pool, report=request.report
        )
    else:
        quantities = checked(solution, timeline)
        interpolation = OutputInterpolation(solution, quantities, pool=pool, report=request.report)
        outcome, rtol = interpolation.solve(asked)
    if units is None:
        units = {name: unit for name, unit in metadata.units if name in quantities.names}
    if solution.time[1] < metadata.horizon[1]:
        verdicts = outcome.verdict, solution.outcome.verdict
        cause = EarlyEnd(*solution.time, metadata.horizon[1], *verdicts)
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
        units=(*(u for u in metadata.units if u[0] in metadata.coordinates), *units.items()),
        definitions=(),
        atol=(),
        additive=(),
    )


def _check_units(units: Mapping[str, str], quantities: Quantities) -> None:
    """Raise unless units are texts by names of quantities."""
    if not isinstance(units, Mapping) or not all(isinstance(u, str) for u in units.values()):
        raise OptionError(
            f"units={units!r} is not a mapping to texts", term=units, remedy='give {"name": "m/s"}'
        )
    for name in units:
        if name not in quantities.names:
            raise OptionError(
                f"there is no output {quote(name)}{did_you_mean(name, quantities.names)}", term=name
            )
