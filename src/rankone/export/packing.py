"""A solution as plain tables: what the solved models evaluate.

Every core of every slab is kept as Chebyshev coefficients on its elements, whatever the basis of
the solve was, so that a model needs one recurrence and one contraction.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

from rankone.export.rounding import Rounding, rounded_slabs
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import ExportError, OptionError
from rankone.support.options import checked_number
from rankone.support.units import with_unit
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain

__all__ = ["PackedCore", "PackedModel", "States", "check_states", "checked_rtol", "pack"]

States = Literal["unknowns", "all"]
"""What a model evaluates: the unknowns, or every state."""

_SMALLEST, _LARGEST = 1e-12, 0.1
"""By how much a model may differ from the solution."""


@dataclass(frozen=True)
class PackedCore:
    """One core of one slab.

    Attributes
    ----------
    lower : float
        Where the first element begins.
    scale : float
        Elements per unit of the coordinate, if they are equal.
    tensor : ndarray (elements, left rank, degree, right rank)
        Chebyshev coefficients on every element.
    edges : tuple of float
        Ends of all elements if they are unequal, else empty.
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
    """Everything a model needs, in plain data.

    Attributes
    ----------
    unknowns : tuple of str
        What is evaluated.
    coordinates : tuple of str
        Time, then the parameters.
    intervals : tuple of (float, float)
        The interval of each coordinate.
    starts : tuple of float
        Where each slab begins.
    slabs : tuple of tuple of PackedCore
        For each slab the cores of time and of each parameter.
    summary : tuple of str
        The equations, the box and the measured error, as lines of text.
    errors : tuple of float
        Measured error of each unknown relative to its size; NaN if unchecked. Where the model was
        made smaller, what that changed is added.
    units : tuple of (str, str)
        Names of unknowns and coordinates with their units.
    """

    unknowns: tuple[str, ...]
    coordinates: tuple[str, ...]
    intervals: tuple[tuple[float, float], ...]
    starts: tuple[float, ...]
    slabs: tuple[tuple[PackedCore, ...], ...]
    summary: tuple[str, ...]
    errors: tuple[float, ...]
    units: tuple[tuple[str, str], ...]

    @cached_property
    def distinct(self) -> tuple[tuple[PackedCore, ...], tuple[tuple[int, ...], ...]]:
        """The cores, those that are equal to the bit once, and for each slab which it has."""
        cores: dict[Hashable, PackedCore] = {}
        keys: list[list[Hashable]] = []
        for slab in self.slabs:
            own = [(c.lower, c.scale, c.edges, c.tensor.shape, c.tensor.tobytes()) for c in slab]
            for key, core in zip(own, slab, strict=True):
                cores.setdefault(key, core)
            keys.append([*own])
        position = {key: k for k, key in enumerate(cores)}
        return (*cores.values(),), tuple(tuple(position[key] for key in slab) for slab in keys)

    @property
    def size(self) -> int:
        """Number of coefficients, those of equal cores once."""
        return sum(core.tensor.size for core in self.distinct[0])


def pack(
    solution: SolutionCore,
    *,
    states: States = "unknowns",
    rtol: float | None = None,
    allow_failed: bool = False,
) -> PackedModel:
    """Turn a solution into plain tables.

    With ``rtol`` the model may differ from the solution by so much, relative to the size of each
    state that is evaluated.

    Raises
    ------
    OptionError
        If there is no such choice of states, or ``rtol`` is out of its range.
    ExportError
        If nothing was solved, or the solution is not a success and ``allow_failed`` is False.
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
    metadata = solution.metadata
    rows = range(len(solution.states)) if states == "all" else metadata.unknown_rows
    names = tuple(solution.states[row] for row in rows)
    intervals = tuple((float(a), float(b)) for a, b in (solution.time, *metadata.box))
    slabs = [_with_states(slab, list(rows)) for slab in solution.outcome.slabs]
    errors = [solution.errors[solution.states[row]] for row in rows]
    summary = _summary(solution, names)
    if rtol is not None:
        rounding = rounded_slabs(slabs, intervals, rtol)
        slabs = list(rounding.slabs)
        errors = [a + b for a, b in zip(errors, rounding.differences, strict=True)]
        summary = (*summary, _said(rounding, rtol))
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
        errors=tuple(map(float, errors)),
        units=tuple(metadata.units),
    )


def check_states(states: States) -> None:
    """Raise an OptionError if there is no such choice of states."""
    if states not in ("unknowns", "all"):
        raise OptionError(f"states={states!r} is unknown", remedy="use 'unknowns' or 'all'")


def checked_rtol(rtol: float | None) -> float | None:
    """By how much a model may differ from the solution, or an OptionError."""
    return None if rtol is None else checked_number("rtol", rtol, _SMALLEST, _LARGEST, float)


def _with_states(slab: SlabTrain, rows: list[int]) -> SlabTrain:
    """A slab of some of the states."""
    return replace(slab, cores=(slab.cores[0][rows], *slab.cores[1:]))


def _said(rounding: Rounding, rtol: float) -> str:
    """A line that says how far a model may be from the solution."""
    largest = max(rounding.differences)
    return (
        f"Made smaller: within {rtol:g} of the solution, relative to the size of each unknown; "
        f"measured {largest:.1e} at {rounding.points} random points and by climbing from the worst "
        "of them."
    )


def _summary(solution: SolutionCore, unknowns: tuple[str, ...]) -> tuple[str, ...]:
    """Lines that say what the model is and how good it is."""
    metadata = solution.metadata
    coordinates = {metadata.time: solution.time, **solution.parameters}
    units = dict(metadata.units)
    return (
        *(f"    {equation}" for equation in metadata.statements),
        "",
        *(
            with_unit(f"{name} in [{lower!r}, {upper!r}]", units, name)
            for name, (lower, upper) in coordinates.items()
        ),
        *(f"{name} in {units[name]}" for name in unknowns if name in units),
        "",
        f"Relative tolerance asked for: {solution.rtol:g}; {solution.message}.",
    )
