"""A solution as plain tables, which the solved models evaluate.

Every core of every slab is kept as Chebyshev coefficients on its elements, whatever the basis of
the solve was, so that a model needs one recurrence and one contraction.

With events the slabs are over the stretches between them, each of a length of one. Of the clock a
model needs no more than its times at the borders of stretches: for each run of slabs that share the
cores of the parameters these are one matrix.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np

from rankone.discretization import IDENTITY, Scale
from rankone.export.rounding import rounded_slabs
from rankone.ir.measures import with_measure
from rankone.ir.metadata import with_unit
from rankone.ir.timeline import CLOCK_STATES, BranchedTimeline, Timeline
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import ExportError, OptionError
from rankone.support.options import checked_number
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain, sharing, slab_positions

States = Literal["unknowns", "all"]  # What a model evaluates

_SMALLEST_RTOL = 1e-12  # Smallest difference that can be asked for: above rounding errors
_LARGEST_RTOL = 0.1  # Largest difference that can be asked for: beyond it a model says little


@dataclass(frozen=True)
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
class PackedModel:
    """A model in plain data; coordinates and cores of a slab are time, then the parameters.

    The ``summary`` has the equations, the box and the measured error, as lines of text. For a
    model that was made smaller its last line is ``reduction``, how far the model differs from the
    solution; else this is None. ``errors`` are the measured ones of the unknowns relative to their
    sizes, and the differences from the solution where the model was made smaller; NaN if
    unchecked. ``units`` belong to names of unknowns and coordinates. ``scales`` has for each
    coordinate the one in which its cores are polynomials and their elements lie. With events
    there is a ``timeline``, and slabs and ``starts`` are over pseudo-time.
    """

    unknowns: tuple[str, ...]
    coordinates: tuple[str, ...]
    intervals: tuple[tuple[float, float], ...]
    starts: tuple[float, ...]
    slabs: tuple[tuple[PackedCore, ...], ...]
    summary: tuple[str, ...]
    reduction: str | None
    errors: tuple[float, ...]
    units: tuple[tuple[str, str], ...]
    scales: tuple[Scale, ...]
    timeline: PackedTimeline | None = None

    @cached_property
    def distinct(self) -> tuple[tuple[PackedCore, ...], tuple[tuple[int, ...], ...]]:
        """The different cores, and for each slab the positions of its cores among them."""
        cores, positions = self._layout
        return cores, positions[: len(self.slabs)]

    @property
    def borders(self) -> tuple[int, ...]:
        """Positions of the cores of the borders of a timeline among the different cores."""
        return tuple(place for (place,) in self._layout[1][len(self.slabs) :])

    @cached_property
    def _layout(self) -> tuple[tuple[PackedCore, ...], tuple[tuple[int, ...], ...]]:
        """The different cores, and the positions of those of each slab and of each border."""
        cores: dict[Hashable, PackedCore] = {}
        keys: list[list[Hashable]] = []
        borders = () if self.timeline is None else self.timeline.borders
        for group in (*self.slabs, *((core,) for core in borders)):
            keys.append(
                [(c.lower, c.scale, c.edges, c.tensor.shape, c.tensor.tobytes()) for c in group]
            )
            for key, core in zip(keys[-1], group, strict=True):
                cores.setdefault(key, core)
        position = {key: k for k, key in enumerate(cores)}
        return (*cores.values(),), tuple(tuple(position[key] for key in group) for group in keys)

    @property
    def is_scaled(self) -> bool:
        """Whether some coordinate is not the polynomials' own."""
        return not all(scale.is_identity for scale in self.scales)

    @property
    def size(self) -> int:
        return sum(core.tensor.size for core in self.distinct[0])


def _one_timeline(solution: SolutionCore, allow_failed: bool) -> Timeline | None:
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
    timeline = solution.outcome.timeline
    if isinstance(timeline, BranchedTimeline):
        raise ExportError(
            "neither models nor pages take solutions in which the order of events changes inside "
            "the box",
            remedy="solve on a box in which one order holds (print solution.timeline)",
        )
    return timeline


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
    metadata, timeline = solution.metadata, _one_timeline(solution, allow_failed)
    rows = range(len(solution.states)) if states == "all" else metadata.unknown_rows
    names = tuple(solution.states[row] for row in rows)
    intervals = tuple((float(a), float(b)) for a, b in (solution.time, *metadata.box))
    packed_rows = list(rows) if timeline is None else [*rows, -CLOCK_STATES]
    slabs = [slab.with_first(slab.cores[0][packed_rows]) for slab in solution.outcome.slabs]
    errors = [solution.errors[solution.states[row]] for row in rows]
    summary, reduction = _summary(solution, names, timeline), None
    if rtol is not None:
        rounding = rounded_slabs(slabs, intervals, rtol, timeline)
        slabs = list(rounding.slabs)
        differences = rounding.differences[: len(errors)]
        errors = [a + b for a, b in zip(errors, differences, strict=True)]
        apart = "" if timeline is None else f", away from events by {rtol:g} of the horizon"
        reduction = (
            f"Made smaller: within {rtol:g} of the solution, relative to the size of each unknown"
            f"{apart}; measured {max(rounding.differences):.1e} at {rounding.points} random points "
            "and by climbing from the worst of them."
        )
        summary += (reduction,)
    packed_timeline = None
    if timeline is not None:
        packed_timeline = _timeline(timeline, slabs)
        slabs = [slab.with_first(slab.cores[0][: len(names)]) for slab in slabs]
    return PackedModel(
        unknowns=names,
        coordinates=(metadata.time, *metadata.parameters),
        intervals=intervals,
        starts=tuple(float(slab.start) for slab in slabs),
        slabs=tuple(map(_packed, slabs)),
        summary=summary,
        reduction=reduction,
        errors=tuple(map(float, errors)),
        units=tuple(metadata.units),
        scales=_scales(slabs),
        timeline=packed_timeline,
    )


def _packed(slab: SlabTrain) -> tuple[PackedCore, ...]:
    """The cores of a slab."""
    dimensions = TrainEvaluator([slab]).trains[0].dimensions
    return tuple(PackedCore(float(d.lower), float(d.scale), d.tensor, d.edges) for d in dimensions)


def _timeline(timeline: Timeline, slabs: Sequence[SlabTrain]) -> PackedTimeline:
    """The stretches of slabs whose last state is the clock."""
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
        borders.append(PackedCore(0.0, 1.0, matrix[None, :, None, :]))
    met = timeline.met
    return PackedTimeline(
        first_slabs=(*first_slabs, len(slabs)),
        runs=tuple(runs),
        borders=tuple(borders),
        affine_borders=tuple(
            (border, (*times, *[0.0] * (1 + len(slabs[0].bases) - len(times))))
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
        raise OptionError(f"states={states!r} is unknown", remedy="use 'unknowns' or 'all'")


def checked_rtol(rtol: float | None) -> float | None:
    """The difference from the solution that a model may have, or an OptionError."""
    return (
        None if rtol is None else checked_number("rtol", rtol, _SMALLEST_RTOL, _LARGEST_RTOL, float)
    )


def _summary(
    solution: SolutionCore, unknowns: tuple[str, ...], timeline: Timeline | None
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


def _stretches(timeline: Timeline | None) -> tuple[str, ...]:
    """Lines that say what ends the stretches between events, if there are any."""
    if timeline is None:
        return ()
    title, *ends = str(timeline).splitlines()
    return ("", f"{title}:", *(f"    {end.strip()}" for end in ends))
