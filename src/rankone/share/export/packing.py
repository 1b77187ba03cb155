"""A solution as plain tables, which the solved models evaluate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from sys import float_info
from typing import Literal

import numpy as np

from rankone.share.export.packed import (
    PackedBranch,
    PackedChoice,
    PackedCore,
    PackedModel,
    PackedTimeline,
)
from rankone.share.export.rounding import RANDOM_POINTS, Branches, rounded_branches, rounded_slabs
from rankone.solution.evaluation.core import SolutionCore
from rankone.solvers.branches import slabs_of_branches
from rankone.solvers.outcome import with_unit
from rankone.support.arrays import Array
from rankone.support.errors import ExportError, OptionError
from rankone.support.options import checked_number
from rankone.tensors.bases import IDENTITY, Scale
from rankone.tensors.bases.scales import with_measure
from rankone.tensors.evaluators.decisions import looks
from rankone.tensors.evaluators.evaluator import TrainEvaluator
from rankone.tensors.trains.slab import SlabTrain, sharing, slab_positions
from rankone.trajectories.system.timeline import CLOCK_STATES, BranchedTimeline, Grazing, Timeline

States = Literal["unknowns", "all"]  # What a model evaluates

_SMALLEST_RTOL = 1e-12  # Smallest difference that can be asked for: above rounding errors
_LARGEST_RTOL = 0.1  # Largest difference that can be asked for: beyond it a model says little


def _timeline_of(solution: SolutionCore, allow_failed: bool) -> Timeline | BranchedTimeline | None:
    """The timeline of a solution; an ExportError if that cannot be exported as one model."""
    if solution.outcome.pieces:
        raise ExportError(
            "a solution that was joined of pieces cannot be exported as one model",
            remedy="export the pieces: `for k, piece in enumerate(solution.pieces)`",
        )
    if not solution.outcome.slabs:
        raise ExportError(f"there is nothing to export: {solution.message}")
    if not solution.success and not allow_failed:
        raise ExportError(
            f"the solution is not a success: {solution.message}",
            remedy="solve again, or pass allow_failed=True to export it as it is",
        )
    return solution.outcome.timeline


def pack(
    solution: SolutionCore,
    *,
    states: States = "unknowns",
    rtol: float | None = None,
    allow_failed: bool = False,
) -> PackedModel:
    """Turn a solution into plain tables.

    With ``rtol`` the model may differ from the solution by this much, relative to the size of each
    state that is evaluated. A solution that is not a success is an ExportError unless it is
    allowed.
    """
    check_states(states)
    rtol = checked_rtol(rtol)
    metadata = solution.metadata
    timeline = _timeline_of(solution, allow_failed)
    rows = range(len(solution.states)) if states == "all" else metadata.unknown_rows
    names = tuple(solution.states[row] for row in rows)
    intervals = tuple((float(a), float(b)) for a, b in (solution.time, *metadata.box))
    errors = [solution.errors[solution.states[row]] for row in rows]
    slabs = _slabs(solution, rows, timeline)
    if isinstance(timeline, BranchedTimeline):
        timeline = replace(timeline, tolerances=tuple(timeline.tolerances[row] for row in rows))
    reduction = None
    if rtol is not None:
        slabs, timeline, differences = _rounded(slabs, intervals, rtol, timeline)
        errors = [a + b for a, b in zip(errors, differences, strict=False)]
        reduction = _reduction(rtol, max(differences), timeline)
    summary = _summary(solution, names, timeline)
    timelines = timeline.branches if isinstance(timeline, BranchedTimeline) else (timeline,)
    branches = tuple(
        _branch(own, len(names), len(metadata.parameters), of)
        for own, of in zip(slabs, timelines, strict=True)
    )
    return PackedModel(
        unknowns=names,
        coordinates=(metadata.time, *metadata.parameters),
        intervals=intervals,
        branches=branches,
        summary=(*summary, *([] if reduction is None else [reduction])),
        reduction=reduction,
        errors=tuple(map(float, errors)),
        units=tuple(metadata.units),
        choice=_choice(timeline, slabs, len(rows))
        if isinstance(timeline, BranchedTimeline)
        else None,
    )


def _rounded(
    slabs: Branches,
    intervals: Sequence[tuple[float, float]],
    rtol: float,
    timeline: Timeline | BranchedTimeline | None,
) -> tuple[Branches, Timeline | BranchedTimeline | None, tuple[float, ...]]:
    """Smaller slabs of each branch, the timeline that goes with them, and the differences."""
    if isinstance(timeline, BranchedTimeline):
        return rounded_branches(slabs, intervals, rtol, timeline)
    (only,) = slabs
    rounding = rounded_slabs(only, intervals, rtol, timeline)
    return [rounding.slabs], timeline, rounding.differences


def _reduction(rtol: float, difference: float, timeline: Timeline | BranchedTimeline | None) -> str:
    """The line that says how far a smaller model is off."""
    apart = "" if timeline is None else f", away from events by {rtol:g} of the horizon"
    if isinstance(timeline, BranchedTimeline):
        apart += ", where it is known which order of events holds"
    return (
        f"Made smaller: within {rtol:g} of the solution, relative to the size of each unknown"
        f"{apart}; measured {difference:.1e} at {RANDOM_POINTS} random points "
        "and by climbing from the worst of them."
    )


def _slabs(
    solution: SolutionCore, rows: Sequence[int], timeline: Timeline | BranchedTimeline | None
) -> Branches:
    """The slabs of each branch, of the states at ``rows``, the guards and the clock."""
    slabs, guards = [solution.outcome.slabs], [0]
    if isinstance(timeline, BranchedTimeline):
        slabs = slabs_of_branches(solution.outcome.slabs, timeline)
        guards = [*timeline.guards]
    every = list[tuple[SlabTrain, ...]]()
    for own, count in zip(slabs, guards, strict=True):
        behind = [] if timeline is None else range(-CLOCK_STATES - count, 1 - CLOCK_STATES)
        every.append(tuple(s.with_first(s.cores[0][[*rows, *behind]]) for s in own))
    return every


def _branch(
    slabs: Sequence[SlabTrain], unknowns: int, parameters: int, timeline: Timeline | None
) -> PackedBranch:
    """A branch of slabs with so many unknowns; behind these are guards, and the clock."""
    guards = None
    if timeline is not None and len(slabs[0].cores[0]) > unknowns + 1:
        at_start = slabs[0].in_time(np.array([slabs[0].start]))[unknowns:-1, 0]
        guards = _without_polynomials(at_start)
    of_unknowns = [slab.with_first(slab.cores[0][:unknowns]) for slab in slabs]
    return PackedBranch(
        starts=tuple(float(slab.start) for slab in slabs),
        slabs=tuple(map(_packed, of_unknowns)),
        scales=_scales(slabs),
        timeline=None if timeline is None else _timeline(timeline, slabs, parameters),
        guards=guards,
    )


def _choice(timeline: BranchedTimeline, slabs: Branches, unknowns: int) -> PackedChoice:
    """What tells which branch holds, of the slabs of all branches with so many unknowns."""
    return PackedChoice(
        timeline.forks,
        tuple(min(height, float_info.max) for height in timeline.highest),
        timeline.grazings,
        tuple(_heights(each, slabs[each.branch], unknowns) for each in timeline.grazings),
        timeline.openings,
        timeline.width,
        timeline.tolerances,
    )


def _heights(
    grazing: Grazing, slabs: Sequence[SlabTrain], unknowns: int
) -> tuple[tuple[int, PackedCore], ...]:
    """The guard of a grazing at its looks: for each run of slabs with some of them a core."""
    times = looks(grazing)
    owners, heights, first = slab_positions(slabs, times), list[tuple[int, PackedCore]](), 0
    for run, group in enumerate(sharing(slabs)):
        rows = [
            slab.in_time(times[owners == k])[unknowns + grazing.guard]
            for k, slab in enumerate(group, first)
        ]
        first += len(group)
        if any(map(len, rows)):
            heights.append((run, _without_polynomials(np.concatenate(rows))))
    return tuple(heights)


def _without_polynomials(matrix: Array) -> PackedCore:
    """A core that is the same everywhere, of a matrix (left, right)."""
    return PackedCore(0.0, 1.0, matrix[None, :, None, :])


def _packed(slab: SlabTrain) -> tuple[PackedCore, ...]:
    """The cores of a slab."""
    dimensions = TrainEvaluator([slab]).trains[0].dimensions
    return tuple(PackedCore(float(d.lower), float(d.scale), d.tensor, d.edges) for d in dimensions)


def _timeline(timeline: Timeline, slabs: Sequence[SlabTrain], parameters: int) -> PackedTimeline:
    """The stretches of slabs over so many parameters, whose last state is the clock."""
    first_slabs = slab_positions(slabs, np.arange(float(timeline.stretches))).tolist()
    runs: list[int] = []
    borders: list[PackedCore] = []
    for k, run in enumerate(sharing(slabs)):
        runs += [k] * len(run)
        rows = [
            slab.in_time(np.array([slab.start]))[-1]
            for position, slab in enumerate(run, len(runs) - len(run))
            if position in first_slabs
        ]
        if len(runs) == len(slabs):
            rows.append(run[-1].in_time(np.array([run[-1].end]))[-1])
        rank = run[0].cores[0].shape[2]
        matrix = np.concatenate(rows) if rows else np.empty((0, rank))
        borders.append(_without_polynomials(matrix))
    met = timeline.met
    return PackedTimeline(
        first_slabs=(*first_slabs, len(slabs)),
        runs=tuple(runs),
        borders=tuple(borders),
        affine_borders=tuple(
            (border, (*times, *[0.0] * (1 + parameters - len(times))))
            for border, times in timeline.affine_borders.items()
        ),
        terminal=timeline.terminal,
        instants=met,
        resets=timeline.resets[: len(met)],
        events=timeline.events,
    )


def _scales(slabs: Sequence[SlabTrain]) -> tuple[Scale, ...]:
    """The scales of all coordinates, or an ExportError where slabs have different ones."""
    by_slab = {tuple(basis.scale for basis in slab.bases) for slab in slabs}
    if len(by_slab) > 1:
        raise ExportError("the scale of a parameter is not the same at all times")
    return (IDENTITY, *by_slab.pop())


def check_states(states: States) -> None:
    """Raise an OptionError if there is no such choice of states."""
    if states not in ("unknowns", "all"):
        raise OptionError(
            f"states={states!r} is unknown",
            remedy="use 'unknowns', 'all' or a list of names",
        )


def checked_rtol(rtol: float | None) -> float | None:
    """The difference from the solution that a model may have, or an OptionError."""
    return (
        None if rtol is None else checked_number("rtol", rtol, _SMALLEST_RTOL, _LARGEST_RTOL, float)
    )


def _summary(
    solution: SolutionCore,
    unknowns: tuple[str, ...],
    timeline: Timeline | BranchedTimeline | None,
) -> tuple[str, ...]:
    """Lines that say what the model is and how good it is."""
    metadata = solution.metadata
    coordinates = {metadata.time: solution.time, **solution.parameters}
    units, distributions = dict(metadata.units), dict(metadata.distributions)
    return (
        *(f"    {equation}" for equation in metadata.statements),
        "",
        *(
            with_measure(
                with_unit(f"{name} in [{lower!r}, {upper!r}]", units, name),
                distributions.get(name),
            )
            for name, (lower, upper) in coordinates.items()
        ),
        *(f"{name} in {units[name]}" for name in unknowns if name in units),
        "",
        f"Relative tolerance asked for: {solution.rtol:g}; {solution.message}.",
        *_stretches(timeline),
    )


def _stretches(timeline: Timeline | BranchedTimeline | None) -> tuple[str, ...]:
    """Lines that say what ends the stretches between events, if there are any."""
    if timeline is None:
        return ()
    title, *ends = str(timeline).splitlines()
    if isinstance(timeline, Timeline):
        ends = [end.strip() for end in ends]
    return ("", f"{title}:", *(f"    {end}" for end in ends))
