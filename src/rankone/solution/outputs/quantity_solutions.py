"""Quantities of interest, and states over clock time, as solutions of their own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rankone.compiler.codegen.layout import Kind, Quantities, Reduction, Source
from rankone.solution.evaluation.core import SolutionCore
from rankone.solution.evaluation.domains import position
from rankone.solution.outputs.branch_outputs import OfBranch, over_branches, require_states
from rankone.solution.outputs.interpolation import Asked, OutputInterpolation
from rankone.solution.outputs.output_check import CheckPoints
from rankone.solvers.outcome import Outcome, Role, SolutionMetadata
from rankone.solvers.verification.points import check_points
from rankone.support.arrays import SAMPLES, SEED, Array
from rankone.support.budget import Report, operations_for, quiet
from rankone.support.errors import (
    ConvergenceError,
    EvaluationError,
    OptionError,
    did_you_mean,
    listing,
    quote,
)
from rankone.support.options import OUTPUT_RTOLS, checked_number
from rankone.support.tasks import Pool
from rankone.tensors.coordinates import name_of
from rankone.tensors.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline
from rankone.trajectories.system.verdict import DerivativeOf, EarlyEnd, Status


def samples_of(solution: SolutionCore) -> tuple[Array, Array, Array]:
    """Some times (m,), parameters (d, m) and the states there (n, m)."""
    rng = np.random.default_rng(SEED)
    box = np.array(list(solution.parameters.values()), dtype=float).reshape(-1, 2)
    p = box[:, :1] + (box[:, 1:] - box[:, :1]) * rng.random((len(box), SAMPLES))
    start, end = solution.time
    t = start + (end - start) * rng.random(SAMPLES)
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
    points = check_points(box, SAMPLES, every_corner=True)
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
        rtol = checked_number("rtol", rtol, *OUTPUT_RTOLS, float)
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


# -----------------------------------------------------------------------------
# The states of a solution with events as outputs: at one time, differentiated, over clock time.


def at_instant(solution: SolutionCore, time: float) -> tuple[Outcome, SolutionMetadata]:
    """The states of a solution with events at one time; see :meth:`rankone.Solution.at`.

    An EvaluationError if an event that resets states, or ends them, comes before that time for some
    parameters alone.
    """
    metadata, timeline = solution.metadata, solution.outcome.timeline
    operations = operations_for("normal")
    if isinstance(timeline, BranchedTimeline):

        def of_branch(part: SolutionCore, own: Timeline | None) -> Quantities:
            assert own is not None
            return _at_instant(part, own, metadata, time)

        sizes = [tolerance / solution.rtol for tolerance in timeline.tolerances]
        asked = Asked(solution.rtol, operations)
        outcome, rtol, _ = over_branches(solution, of_branch, asked, sizes)
    else:
        assert timeline is not None
        quantities = _at_instant(solution, timeline, metadata, time)
        outcome, rtol = OutputInterpolation(solution, quantities).solve(Asked(None, operations))
    fixed = (*metadata.fixed, (metadata.time, time))
    return outcome, replace(metadata, rtol=rtol, source=None, timeless=True, fixed=fixed)


def _at_instant(
    solution: SolutionCore, timeline: Timeline, metadata: SolutionMetadata, time: float
) -> Quantities:
    """The states at one time, by which the same events have happened everywhere."""
    evaluator = solution._evaluator
    assert isinstance(evaluator, TimelineEvaluator)
    texts = tuple(f"{name} at {metadata.time} = {time:g}" for name in metadata.states)
    reductions = tuple(
        Reduction(Kind.INSTANT, i, time, time, 0, text) for i, text in enumerate(texts)
    )
    sources = tuple(Source(i) for i in range(len(texts)))
    quantities = _as_they_are(metadata, texts, sources, reductions)
    domain = OutputInterpolation(solution, quantities).domain
    points = np.ascontiguousarray(CheckPoints.of(domain, quantities).aimed.T)
    if not (holds := evaluator.holds(points)).any():
        return quantities
    borders = evaluator.borders(points[:, holds])
    jumping = [i for i, resets in enumerate(timeline.resets) if resets or timeline.terminal]
    jumped = (borders[1:][jumping] <= time).sum(axis=0)
    passed = (borders[1:] <= time).sum(axis=0)
    if jumped.min() < jumped.max():
        event = " and ".join(timeline.instants[jumping[jumped.min()]])
        raise EvaluationError(
            f"at {metadata.time} = {time:g} {quote(event)} has happened for some parameters alone",
            term=time,
            remedy="restrict the solution to parameters where it has, or to the others",
        )
    if timeline.terminal and passed.min() == timeline.stretches:
        raise EvaluationError(
            f"the solution has ended before {metadata.time} = {time:g}",
            term=time,
            remedy="give an earlier time; solution.end(...) says when it ends",
        )
    return quantities


def derivative(solution: SolutionCore, coordinate: object) -> tuple[Outcome, SolutionMetadata]:
    """The derivatives of a solution with events; see :meth:`rankone.Solution.diff`."""
    metadata, name = solution.metadata, name_of(coordinate)
    by_time = name == metadata.time
    j = None if by_time else position(metadata, name)
    sources = tuple(Source(i, int(by_time), j) for i in range(len(metadata.states)))
    texts = tuple(f"d{state}/d{name}" for state in metadata.states)
    quantities = _as_they_are(metadata, texts, sources, ())
    if isinstance(solution.outcome.timeline, BranchedTimeline):
        require_states(quantities)
    interpolation = OutputInterpolation(solution, quantities)
    outcome, _ = interpolation.solve(Asked(solution.rtol, operations_for("normal")))
    outcome = replace(outcome, cause=DerivativeOf(name), notes=())
    return outcome, metadata.derivative(name)


def over_clock_time(solution: SolutionCore, rtol: float | None) -> tuple[Outcome, SolutionMetadata]:
    """A solution with events over clock time; see :meth:`rankone.Solution.in_clock_time`."""
    metadata = solution.metadata
    timeline = solution.outcome.timeline_of_one_order("in_clock_time")
    assert timeline is not None
    if timeline.terminal:
        raise EvaluationError(
            f"the solution ends with {quote(timeline.instants[-1][0])}, at a time of its own for "
            "each value of the parameters",
            remedy="keep it as it is, or solve up to a time at which all trajectories run",
        )
    if rtol is not None:
        rtol = checked_number("rtol", rtol, *OUTPUT_RTOLS, float)
    if moving := timeline.moving_resets:
        raise ConvergenceError(
            f"values over clock time are not resolved, since {listing(moving)} may reset states at "
            "times that move with the parameters",
            remedy="keep the solution as it is",
        )
    sources = tuple(Source(i) for i in range(len(metadata.states)))
    quantities = _as_they_are(metadata, metadata.states, sources, ())
    interpolation = OutputInterpolation(solution, quantities, clock_time=True)
    outcome, rtol = interpolation.solve(Asked(rtol, operations_for("normal")))
    if outcome.status is not Status.CONVERGED:
        raise ConvergenceError(
            f"values over clock time are not resolved: {outcome.message}",
            remedy="keep the solution as it is, or loosen rtol",
        )
    return outcome, replace(metadata, rtol=rtol)


def _as_they_are(
    metadata: SolutionMetadata,
    texts: tuple[str, ...],
    sources: tuple[Source, ...],
    reductions: tuple[Reduction, ...],
) -> Quantities:
    """Quantities that are sources, or reductions of these one by one."""
    return Quantities(
        names=metadata.states,
        texts=texts,
        timeless=bool(reductions),
        sources=sources,
        integrands=lambda t, s, p: list(s) if reductions else [],
        reductions=reductions,
        n_state_surfaces=0,
        state_surfaces=lambda t, s, p: [],
        parameter_surfaces=lambda p: [],
        cuts=((),) * len(metadata.coordinates),
        values=lambda t, s, p, r: list(r if reductions else s),
        gaps=lambda t, s, p: [],
        gap_texts=(),
    )
