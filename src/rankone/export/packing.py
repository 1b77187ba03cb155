"""A solution as plain tables: what the solved models evaluate.

Every core of every slab is kept as Chebyshev coefficients on its elements, whatever the basis of
the solve was, so that a model needs one recurrence and one contraction.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Literal

from rankone.arrays import Array
from rankone.errors import ExportError, OptionError
from rankone.solution_core import SolutionCore
from rankone.tensors.evaluator import TrainEvaluator
from rankone.units import with_unit

__all__ = ["PackedCore", "PackedModel", "States", "pack"]

States = Literal["unknowns", "all"]
"""What a model evaluates: the unknowns, or every state."""


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
        return tuple(1.0 / (b - a) for a, b in itertools.pairwise(self.edges))


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
    """

    unknowns: tuple[str, ...]
    coordinates: tuple[str, ...]
    intervals: tuple[tuple[float, float], ...]
    starts: tuple[float, ...]
    slabs: tuple[tuple[PackedCore, ...], ...]
    summary: tuple[str, ...]

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return sum(core.tensor.size for slab in self.slabs for core in slab)


def pack(
    solution: SolutionCore, *, states: States = "unknowns", allow_failed: bool = False
) -> PackedModel:
    """Turn a solution into plain tables.

    Raises
    ------
    OptionError
        If there is no such choice of states.
    ExportError
        If nothing was solved, or the solution is not a success and ``allow_failed`` is False.
    """
    if states not in ("unknowns", "all"):
        raise OptionError(f"states={states!r} is unknown", remedy="use 'unknowns' or 'all'")
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
    slabs = []
    for slab in TrainEvaluator(solution.outcome.slabs).slabs:
        cores = [
            PackedCore(float(d.lower), float(d.scale), d.tensor, d.edges) for d in slab.dimensions
        ]
        cores[0] = replace(cores[0], tensor=cores[0].tensor[:, list(rows)])
        slabs.append(tuple(cores))
    return PackedModel(
        unknowns=names,
        coordinates=(metadata.time, *metadata.parameters),
        intervals=tuple((float(a), float(b)) for a, b in (solution.time, *metadata.box)),
        starts=tuple(float(slab.start) for slab in solution.outcome.slabs),
        slabs=tuple(slabs),
        summary=_summary(solution, names),
    )


def _summary(solution: SolutionCore, unknowns: tuple[str, ...]) -> tuple[str, ...]:
    """Lines that say what the model is and how good it is."""
    metadata = solution.metadata
    coordinates = {metadata.time: solution.time, **solution.parameters}
    units = dict(metadata.units)
    return (
        *(f"    {equation}" for equation in metadata.equations),
        "",
        *(
            with_unit(f"{name} in [{lower!r}, {upper!r}]", units, name)
            for name, (lower, upper) in coordinates.items()
        ),
        *(f"{name} in {units[name]}" for name in unknowns if name in units),
        "",
        f"Relative tolerance asked for: {solution.rtol:g}; {solution.message}.",
    )
