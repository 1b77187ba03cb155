"""A solution as plain tables, which the solved models evaluate."""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from sys import float_info
from typing import Literal

import numpy as np

from rankone.share.export.rounding import RANDOM_POINTS, Branches, rounded_branches, rounded_slabs
from rankone.solution.evaluation.core import SolutionCore
from rankone.solvers.branches import slabs_of_branches
from rankone.solvers.outcome import with_unit
from rankone.support.arrays import Array
from rankone.support.errors import ExportError, OptionError
from rankone.support.options import STEP_RTOLS, checked_number
from rankone.tensors import IDENTITY, Scale
from rankone.tensors.coordinates import with_measure
from rankone.tensors.decisions import looks
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain, sharing, slab_positions
from rankone.trajectories.system.timeline import (
    CLOCK_STATES,
    BranchedTimeline,
    Fork,
    Grazing,
    Opening,
    Timeline,
)

States = Literal["unknowns", "all"]  # What a model evaluates


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
    return None if rtol is None else checked_number("rtol", rtol, *STEP_RTOLS, float)


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


# -----------------------------------------------------------------------------
# A solved model in plain data, which models in all languages evaluate.
#
# Every core of every slab is kept as Chebyshev coefficients on its elements, whatever the basis of
# the solve was, so that a model needs one recurrence and one contraction.
#
# With events the slabs are over the stretches between them, each of a length of one. Of the clock a
# model needs no more than its times at the borders of stretches: for each run of slabs that share
# the cores of the parameters these are one matrix. Where the order of events changes inside the
# box a model has several branches, and what tells which of them holds: matrices as well, of
# guards.


@dataclass(frozen=True, eq=False)
class PackedCore:
    """One core of one slab: Chebyshev coefficients (elements, left rank, degree, right rank).

    The first element begins at ``lower``. ``scale`` is the number of elements per unit of the
    coordinate, both in the scale that the model has for it; where elements are unequal, ``edges``
    are the ends of all of them, else empty.
    """

    lower: float
    scale: float
    tensor: Array
    edges: tuple[float, ...] = ()

    @property
    def lowers(self) -> tuple[float, ...]:
        """Where each of the unequal elements begins."""
        return self.edges[:-1]

    @property
    def scales(self) -> tuple[float, ...]:
        """Elements per unit of the coordinate in each of the unequal elements."""
        return tuple(1.0 / (b - a) for a, b in pairwise(self.edges))


@dataclass(frozen=True)
class PackedTimeline:
    """The stretches between events in plain data: stretch i is [i, i + 1] in pseudo-time.

    ``first_slabs`` has the first slab of each stretch, and at the end the number of slabs;
    ``runs`` has the run that each slab belongs to, of those that share the cores of their
    parameters. ``borders`` has for each run a core without polynomials, whose product with the
    cores of the parameters is the clock at the beginnings of its stretches, and for the last run
    also at the end. ``affine_borders`` are those whose times are affine functions of the
    parameters, with the constant and the slopes; the start of the horizon is one.

    ``instants`` are the names of the events at each border but the first, up to the last one that
    some trajectory meets; ``resets`` says which of them reset states. ``events`` are all names.
    """

    first_slabs: tuple[int, ...]
    runs: tuple[int, ...]
    borders: tuple[PackedCore, ...]
    affine_borders: tuple[tuple[int, tuple[float, ...]], ...]
    terminal: bool
    instants: tuple[tuple[str, ...], ...]
    resets: tuple[bool, ...]
    events: tuple[str, ...]

    @property
    def stretches(self) -> int:
        """Number of stretches."""
        return len(self.first_slabs) - 1

    @property
    def first_of_runs(self) -> tuple[int, ...]:
        """The first slab of each run."""
        return tuple(self.runs.index(k) for k in range(len(self.borders)))

    def occurrences(self, event: str) -> tuple[int, ...]:
        """The instants of an event."""
        return tuple(i for i, names in enumerate(self.instants) if event in names)


@dataclass(frozen=True)
class PackedBranch:
    """Trains over time, or over the stretches between events in one order.

    The cores of a slab are those of time, then of the parameters. ``scales`` has for each
    coordinate the one in which its cores are polynomials and their elements lie. With events there
    is a ``timeline``, and slabs and ``starts`` are over pseudo-time.

    Where other orders hold elsewhere, cores may follow for the roots of heights. ``guards`` is then
    a core without polynomials, whose product with those of the parameters of the first slab is the
    functions that tell where the branch holds.
    """

    starts: tuple[float, ...]
    slabs: tuple[tuple[PackedCore, ...], ...]
    scales: tuple[Scale, ...]
    timeline: PackedTimeline | None = None
    guards: PackedCore | None = None


@dataclass(frozen=True)
class PackedChoice:
    """What tells which branch holds; see
    :class:`rankone.trajectories.system.timeline.BranchedTimeline`.

    ``highest`` has for each fork the largest guard for which its second branch is solved. The
    ``heights`` of each grazing are runs of its branch, each with a core without polynomials: their
    products with the cores of the parameters are the guard at its looks, one after the other. The
    ``tolerances`` are those of the unknowns.
    """

    forks: tuple[Fork, ...]
    highest: tuple[float, ...]
    grazings: tuple[Grazing, ...]
    heights: tuple[tuple[tuple[int, PackedCore], ...], ...]
    openings: tuple[Opening, ...]
    width: float
    tolerances: tuple[float, ...]

    def openings_of(self, branch: int) -> tuple[Opening, ...]:
        """The coordinates of a branch behind the parameters."""
        return tuple(opening for opening in self.openings if opening.branch == branch)


@dataclass(frozen=True)
class PackedModel:
    """A model in plain data; coordinates are time, then the parameters.

    The ``summary`` has the equations, the box and the measured error, as lines of text. For a
    model that was made smaller its last line is ``reduction``, how far the model differs from the
    solution; else this is None. ``errors`` are the measured ones of the unknowns relative to their
    sizes, and the differences from the solution where the model was made smaller; NaN if
    unchecked. ``units`` belong to names of unknowns and coordinates. Of several ``branches`` a
    ``choice`` tells which one holds.
    """

    unknowns: tuple[str, ...]
    coordinates: tuple[str, ...]
    intervals: tuple[tuple[float, float], ...]
    branches: tuple[PackedBranch, ...]
    summary: tuple[str, ...]
    reduction: str | None
    errors: tuple[float, ...]
    units: tuple[tuple[str, str], ...]
    choice: PackedChoice | None = None

    @property
    def single(self) -> PackedBranch:
        """The branch of a model that has one."""
        (branch,) = self.branches
        return branch

    @property
    def events(self) -> tuple[str, ...] | None:
        """The names of all events, or None for a model without stretches between them."""
        timeline = self.branches[0].timeline
        return None if timeline is None else timeline.events

    @property
    def timelines(self) -> tuple[PackedTimeline, ...]:
        """Those of all branches; none for a model without events."""
        return tuple(b.timeline for b in self.branches if b.timeline is not None)

    @property
    def terminal(self) -> bool:
        """Whether an event may end the model."""
        return any(timeline.terminal for timeline in self.timelines)

    @property
    def cores(self) -> tuple[PackedCore, ...]:
        """The different cores."""
        return self._layout[0]

    def place(self, core: PackedCore) -> int:
        """The position of a core of the model among the different ones."""
        return self._layout[1][core]

    def slabs_of(self, branch: PackedBranch) -> tuple[tuple[int, ...], ...]:
        """For each slab the positions of its cores among the different ones."""
        return tuple(tuple(map(self.place, slab)) for slab in branch.slabs)

    def borders_of(self, branch: PackedBranch) -> tuple[int, ...]:
        """Positions of the cores of the borders of a timeline among the different cores."""
        return () if branch.timeline is None else tuple(map(self.place, branch.timeline.borders))

    @cached_property
    def _layout(self) -> tuple[tuple[PackedCore, ...], dict[PackedCore, int]]:
        """The cores that differ in what they hold, and the position among them of each one."""
        different: dict[Hashable, PackedCore] = {}
        contents: dict[PackedCore, Hashable] = {}
        for core in self._every():
            content = (core.lower, core.scale, core.edges, core.tensor.shape, core.tensor.tobytes())
            contents[core] = content
            different.setdefault(content, core)
        position = {content: k for k, content in enumerate(different)}
        places = {core: position[content] for core, content in contents.items()}
        return (*different.values(),), places

    def _every(self) -> Iterator[PackedCore]:
        """All cores, those of slabs first."""
        for branch in self.branches:
            yield from itertools.chain.from_iterable(branch.slabs)
        for branch in self.branches:
            yield from () if branch.timeline is None else branch.timeline.borders
            yield from () if branch.guards is None else (branch.guards,)
        for heights in () if self.choice is None else self.choice.heights:
            yield from (core for _, core in heights)

    @property
    def scales(self) -> tuple[Scale, ...]:
        """The scales of all coordinates, and of the most that a branch has behind them."""
        longest = max(range(len(self.branches)), key=lambda k: len(self.branches[k].scales))
        return self.branches[longest].scales

    @property
    def is_scaled(self) -> bool:
        """Whether some coordinate is not the polynomials' own."""
        return not all(s.is_identity for branch in self.branches for s in branch.scales)

    @property
    def size(self) -> int:
        return sum(core.tensor.size for core in self.cores)
