"""A solved model in plain data, which models in all languages evaluate.

Every core of every slab is kept as Chebyshev coefficients on its elements, whatever the basis of
the solve was, so that a model needs one recurrence and one contraction.

With events the slabs are over the stretches between them, each of a length of one. Of the clock a
model needs no more than its times at the borders of stretches: for each run of slabs that share the
cores of the parameters these are one matrix. Where the order of events changes inside the box a
model has several branches, and what tells which of them holds: matrices as well, of guards.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

from rankone.support.arrays import Array
from rankone.tensors.bases import Scale
from rankone.trajectories.system.timeline import Fork, Grazing, Opening


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
