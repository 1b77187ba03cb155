"""A solution as plain tables, which the solved models evaluate.

Every core of every slab is kept as Chebyshev coefficients on its elements, whatever the basis of
the solve was, so that a model needs one recurrence and one contraction.

A model that may differ from its solution is made smaller: ranks are cut first, then entries that do
not matter. Both bound a root mean square, so the largest difference is measured at points, and the
tolerance of the cut is adapted until that difference is small enough.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np

from rankone.discretization import IDENTITY, Scale
from rankone.ir.measures import with_measure
from rankone.ir.metadata import with_unit
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import ExportError, OptionError
from rankone.support.options import checked_number
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain, sharing
from rankone.verification.search import Climb, climbed

States = Literal["unknowns", "all"]  # What a model evaluates

_SMALLEST_RTOL = 1e-12  # Smallest difference that can be asked for: above rounding errors
_LARGEST_RTOL = 0.1  # Largest difference that can be asked for: beyond it a model says little
_RANDOM_POINTS = 4200  # Points at which a smaller model is compared, a multiple of six
_SHARES_AT_ENDS = (0.0, 0.5, 1.0)  # Parameters at ends of their intervals, by thirds
_MEASURED_MARGIN = 0.7  # Largest measured difference, over ``rtol``: points miss the largest one
_GOOD_ENOUGH = 0.45  # Measured difference over ``rtol`` above which no larger tolerance is tried
_MAX_LOOSENING = 4.0  # Largest tolerance of the cut over ``rtol``: it bounds a mean square
_MAX_ATTEMPTS = 9  # Cuts that are tried: doubling or reducing the tolerance, then bisecting
_CLIMBERS = 24  # Points from which larger differences are looked for
# How a point climbs to larger differences
_DIFFERENCE_CLIMB = Climb(rounds=15, tries=6, first_step=0.2, shrinkage=0.8, seed=1)


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
class PackedModel:
    """A model in plain data; coordinates and cores of a slab are time, then the parameters.

    The ``summary`` has the equations, the box and the measured error, as lines of text. For a
    model that was made smaller its last line is ``reduction``, how far the model differs from the
    solution; else this is None. ``errors`` are the measured ones of the unknowns relative to their
    sizes, and the differences from the solution where the model was made smaller; NaN if
    unchecked. ``units`` belong to names of unknowns and coordinates. ``scales`` has for each
    coordinate the one in which its cores are polynomials and their elements lie.
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

    @cached_property
    def distinct(self) -> tuple[tuple[PackedCore, ...], tuple[tuple[int, ...], ...]]:
        """The different cores, and for each slab the positions of its cores among them."""
        cores: dict[Hashable, PackedCore] = {}
        keys: list[list[Hashable]] = []
        for slab in self.slabs:
            keys.append(
                [(c.lower, c.scale, c.edges, c.tensor.shape, c.tensor.tobytes()) for c in slab]
            )
            for key, core in zip(keys[-1], slab, strict=True):
                cores.setdefault(key, core)
        position = {key: k for k, key in enumerate(cores)}
        return (*cores.values(),), tuple(tuple(position[key] for key in slab) for slab in keys)

    @property
    def is_scaled(self) -> bool:
        """Whether some coordinate is not the polynomials' own."""
        return not all(scale.is_identity for scale in self.scales)

    @property
    def size(self) -> int:
        return sum(core.tensor.size for core in self.distinct[0])


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
    if not solution.outcome.slabs:
        raise ExportError(f"there is nothing to export: {solution.message}")
    if not solution.success and not allow_failed:
        raise ExportError(
            f"the solution is not a success: {solution.message}",
            remedy="solve again, or pass allow_failed=True to export it as it is",
        )
    solution.outcome.slabs_over_clock_time("an exported model")
    metadata = solution.metadata
    rows = range(len(solution.states)) if states == "all" else metadata.unknown_rows
    names = tuple(solution.states[row] for row in rows)
    intervals = tuple((float(a), float(b)) for a, b in (solution.time, *metadata.box))
    slabs = [slab.with_first(slab.cores[0][list(rows)]) for slab in solution.outcome.slabs]
    errors = [solution.errors[solution.states[row]] for row in rows]
    summary, reduction = _summary(solution, names), None
    if rtol is not None:
        rounding = rounded_slabs(slabs, intervals, rtol)
        slabs = list(rounding.slabs)
        errors = [a + b for a, b in zip(errors, rounding.differences, strict=True)]
        reduction = (
            f"Made smaller: within {rtol:g} of the solution, relative to the size of each unknown; "
            f"measured {max(rounding.differences):.1e} at {rounding.points} random points and by "
            "climbing from the worst of them."
        )
        summary += (reduction,)
    return PackedModel(
        unknowns=names,
        coordinates=(metadata.time, *metadata.parameters),
        intervals=intervals,
        starts=tuple(float(slab.start) for slab in solution.outcome.slabs),
        slabs=tuple(
            tuple(
                PackedCore(float(d.lower), float(d.scale), d.tensor, d.edges)
                for d in TrainEvaluator([slab]).trains[0].dimensions
            )
            for slab in slabs
        ),
        summary=summary,
        reduction=reduction,
        errors=tuple(map(float, errors)),
        units=tuple(metadata.units),
        scales=_scales(slabs),
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


def _summary(solution: SolutionCore, unknowns: tuple[str, ...]) -> tuple[str, ...]:
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
    )


@dataclass(frozen=True)
class Rounding:
    """Rounded trains; slabs that shared the cores of their parameters go on sharing them.

    ``differences`` are the largest ones of each state at ``points`` random points and by climbing
    from the worst of them, relative to its largest value at the points.
    """

    slabs: tuple[SlabTrain, ...]
    differences: tuple[float, ...]
    points: int = _RANDOM_POINTS


def rounded_slabs(
    slabs: Sequence[SlabTrain], intervals: Sequence[tuple[float, float]], rtol: float
) -> Rounding:
    """Trains with fewer coefficients that differ by at most ``rtol`` of each state's size.

    ``slabs`` are consecutive and of the same states, ``intervals`` those of time and of each
    parameter. The slabs stay as they are if no smaller ones are within ``rtol``.
    """
    points = _points(slabs, intervals)
    rows = slice(0, len(slabs[0].cores[0]))
    states = TrainEvaluator(slabs).many(points, rows)
    sizes = np.abs(states).max(axis=1)
    sizes[sizes == 0.0] = 1.0
    best = Rounding(tuple(slabs), (0.0,) * len(sizes))
    low, high, tolerance = 0.0, 0.0, rtol
    for _ in range(_MAX_ATTEMPTS):
        smaller = tuple(slab for run in sharing(slabs) for slab in _smaller(run, sizes, tolerance))
        differences = _differences(slabs, smaller, points, states, sizes, intervals)
        largest = float(differences.max())
        if largest <= _MEASURED_MARGIN * rtol:
            best, low = Rounding(smaller, tuple(differences.tolist())), tolerance
        else:
            high = tolerance
        loose = largest >= _GOOD_ENOUGH * rtol or tolerance >= _MAX_LOOSENING * rtol
        if low == tolerance and loose:
            break
        tolerance = 2.0 * low if low else 0.3 * high
        if low and high:
            tolerance = math.sqrt(low * high)
    return best


def _differences(
    slabs: Sequence[SlabTrain],
    smaller: Sequence[SlabTrain],
    points: Array,
    states: Array,
    sizes: Array,
    intervals: Sequence[tuple[float, float]],
) -> Array:
    """Largest difference of each state over its size: at points, and climbing from the worst."""
    before, after = TrainEvaluator(slabs), TrainEvaluator(smaller)
    rows = slice(0, len(sizes))
    at_points = np.abs(after.many(points, rows) - states) / sizes[:, None]
    largest = at_points.max(axis=1)

    def difference(tried: Array) -> Array:
        nonlocal largest
        changes = np.abs(after.many(tried.T, rows) - before.many(tried.T, rows)) / sizes[:, None]
        largest = np.maximum(largest, changes.max(axis=1))
        return np.asarray(changes.max(axis=0))

    worst = np.argsort(-at_points.max(axis=0))[:_CLIMBERS]
    heights = at_points[:, worst].max(axis=0)
    climbed(difference, points[:, worst].T, heights, np.array(intervals), _DIFFERENCE_CLIMB)
    return np.asarray(largest)


def _points(slabs: Sequence[SlabTrain], intervals: Sequence[tuple[float, float]]) -> Array:
    """Random points (coordinates, N), with many where trains differ most.

    A third lies anywhere, a third on faces and edges of the box, a third at its corners; half of
    all are at ends of slabs.
    """
    rng = np.random.default_rng(0)
    ends = np.array(intervals)
    shares = rng.random((len(ends), _RANDOM_POINTS))
    at_ends = rng.random(shares.shape) < np.repeat(
        _SHARES_AT_ENDS, _RANDOM_POINTS // len(_SHARES_AT_ENDS)
    )
    shares = np.where(at_ends, np.round(shares), shares)
    points = ends[:, :1] + shares * np.diff(ends)
    for j, basis in enumerate(slabs[0].bases, start=1):
        if not basis.scale.is_identity:
            start, end = basis.scale.to_scale(ends[j])
            points[j] = basis.scale.from_scale(start + shares[j] * (end - start))
    points = np.clip(points, ends[:, :1], ends[:, 1:])
    edges = np.clip([edge for slab in slabs for edge in (slab.start, slab.end)], *ends[0])
    points[0, ::2] = rng.choice(edges, _RANDOM_POINTS // 2)
    return points


def _smaller(run: Sequence[SlabTrain], sizes: Array, tolerance: float) -> list[SlabTrain]:
    """Smaller slabs that share the cores of their parameters, within a tolerance in mean square.

    They are one train, whose first core has the polynomials of all of them.
    """
    first = np.concatenate([slab.cores[0] for slab in run], axis=1) / sizes[:, None, None]
    share = np.sqrt(0.5) * tolerance
    train = run[0].train.with_first(first).rounded(share).thinned(share)
    counts = np.cumsum([slab.cores[0].shape[1] for slab in run])
    firsts = np.split(train.first * sizes[:, None, None], counts[:-1], axis=1)
    return [
        replace(slab, train=train.with_first(first))
        for slab, first in zip(run, firsts, strict=True)
    ]
