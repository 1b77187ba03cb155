"""Evaluation of the solved model where the order of events changes inside the box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.share.export.model_program import _CHUNK, Model
from rankone.share.export.model_stretches import EventModel
from rankone.support.arrays import Array
from rankone.tensors.decisions import Decider, Decision, clearance


class Fork(NamedTuple):
    """Two branches that are the same up to a stretch; the first one holds if it ends earlier.

    Or, where both end at once, if ``sign`` times a guard of the first one is positive.
    """

    first: int
    second: int
    stretch: int
    guard: int | None
    sign: float
    scale: float
    may_be_past: tuple[bool, bool]
    at_turn: bool


class Grazing(NamedTuple):
    """An event that a branch misses on a stretch, where a guard does not fall through zero."""

    branch: int
    stretch: int
    guard: int
    scale: float
    begins: bool
    ends: bool
    first: bool


class Branch(EventModel):
    """One order of events, continued over the whole box.

    Its slabs may have further coordinates behind the parameters: roots of guards of other branches.
    """

    def __init__(self, *tables: Any, guards: int | None, **timeline: Any) -> None:
        super().__init__(*tables, **timeline)
        self._guards = np.empty((0, 0)) if guards is None else self.matrix(guards)
        self.roots: list[tuple[Branch, int, float, float]] = []

    def matrix(self, core: int) -> Array:
        """A core without polynomials."""
        return self._cores[core][2][0, :, 0]

    def guards(self, products: Sequence[Array]) -> Array:
        """What tells where the branch holds, of the products of its cores, and its derivatives."""
        flat = self._guards @ products[0].reshape(len(products[0]), -1)
        return flat.reshape(-1, *products[0].shape[1:])

    def _products(self, points: Array, derivatives: bool) -> list[Array]:
        roots = [self._root(*root, points, derivatives) for root in self.roots]
        own = np.concatenate([points, *(root[:1] for root in roots)])
        products = super()._products(own, derivatives)
        if not derivatives:
            return products
        count = 1 + len(points)
        for product in products:
            for k, root in enumerate(roots, count):
                product[:, 1:count] += product[:, k : k + 1] * root[1:]
        return [product[:, :count] for product in products]

    def _root(
        self, parent: Branch, guard: int, lower: float, upper: float, points: Array, slopes: bool
    ) -> Array:
        """The root of a guard of another branch, and its derivatives: (1 or 1 + d, N)."""
        height = parent.guards(parent._products(points, slopes))[guard]
        root = np.sqrt(np.maximum(height[:1], 0.0))
        inside = (root > lower) & (root < upper)
        by_height = np.where(inside, 0.5 / np.where(inside, root, 1.0), 0.0)
        return np.concatenate([np.clip(root, lower, upper), by_height * height[1:]])


class BranchModel(Model):
    """A model in whose box the order of events changes: of the branch that holds at each point.

    Values are NaN where it is not known which one holds: next to a change of order, where the
    branches differ. So are times of events next to where one is just missed. Of each table there is
    one for each branch.
    """

    def __init__(
        self,
        unknowns: tuple[str, ...],
        coordinates: tuple[str, ...],
        keywords: tuple[str, ...],
        intervals: tuple[tuple[float, float], ...],
        starts: Sequence[tuple[float, ...]],
        cores: Sequence[Any],
        slabs: Sequence[Sequence[Sequence[int]]],
        coefficients: Array,
        scales: Sequence[Sequence[str]],
        *,
        roots: Sequence[Sequence[tuple[int, int, float, float]]],
        forks: Sequence[tuple[Any, ...]],
        highest: Sequence[float],
        grazings: Sequence[tuple[Any, ...]],
        heights: Sequence[Sequence[tuple[int, int]]],
        width: float,
        tolerances: Sequence[float],
        events: Sequence[str],
        **timelines: Sequence[Any],
    ) -> None:
        of_all = unknowns, coordinates, keywords, intervals
        super().__init__(*of_all, (), (), (), coefficients)
        self.events, self._heights = events, heights
        self._tolerances = np.array(tolerances)
        self._branches = [
            Branch(
                *(*of_all, starts[k], cores, slabs[k], coefficients, scales[k]),
                events=events,
                **{name: table[k] for name, table in timelines.items()},
            )
            for k in range(len(starts))
        ]
        for branch, own in zip(self._branches, roots, strict=True):
            branch.roots = [(self._branches[k], g, lower, upper) for k, g, lower, upper in own]
        at_forks, missed = [Fork(*row) for row in forks], [Grazing(*row) for row in grazings]
        self._decider = Decider(at_forks, highest, missed, width, intervals[0])

    def event_times(
        self, event: str, values: Mapping[str, Any] | None = None, /, **named: Any
    ) -> Array:
        """Times of an event: shape (occurrences, *broadcast shape of the parameters).

        NaN where it is not reached by the end of the horizon.
        """
        own = [branch.occurrences(event) for branch in self._branches]
        points, shape = self._points({**(values or {}), **named}, first=1)
        times = np.full((max(map(len, own)), points.shape[1]), np.nan)
        for k, here, borders in self._borders(points):
            times[: len(own[k]), here] = borders[own[k]]
        times[times > self.intervals[0][1]] = np.nan
        return times.reshape(len(times), *shape)

    def end(self, values: Mapping[str, Any] | None = None, /, **named: Any) -> Array:
        """When the solution ends: at a terminal event, or with the horizon."""
        points, shape = self._points({**(values or {}), **named}, first=1)
        last = self.intervals[0][1]
        if not any(branch.terminal for branch in self._branches):
            return np.full(shape, last)
        ends = np.full(points.shape[1], np.nan)
        for _, here, borders in self._borders(points):
            ends[here] = np.minimum(borders[-1], last)
        return ends.reshape(shape)

    def branch(self, values: Mapping[str, Any] | None = None, /, **named: Any) -> NDArray[np.intp]:
        """Which order of events holds: a position in INSTANTS.

        It is -1 where that is not known, and values are NaN as far as the orders differ.
        """
        points, shape = self._points({**(values or {}), **named}, first=1)
        return self._decider.held(self._decision(points)).reshape(shape)

    def _borders(self, points: Array) -> list[tuple[int, NDArray[np.intp], Array]]:
        """For each branch where it holds, with ascending borders: (1 + stretches, points)."""
        decision = self._decision(points)
        timed = ~decision.undecided & ~decision.at_turn
        held = []
        for k in range(len(self._branches)):
            here = np.flatnonzero((decision.chosen == k) & timed)
            held.append((k, here, np.maximum.accumulate(decision.borders[k][:, here], axis=0)))
        return held

    def _decision(self, points: Array) -> Decision:
        """Which branch holds at parameters (d, N)."""
        borders, products = [], []
        for branch in self._branches:
            product, clock = branch._over_parameters(points, derivatives=False)
            products.append(product)
            borders.append(clock[:, 0])
        guards = [
            self._branches[fork.first].guards(products[fork.first])[fork.guard, 0]
            for fork in self._decider.forks
            if fork.guard is not None
        ]
        clearances = []
        for grazing, cores in zip(self._decider.grazings, self._heights, strict=True):
            branch, own = self._branches[grazing.branch], products[grazing.branch]
            heights = np.concatenate([branch.matrix(core) @ own[run][:, 0] for run, core in cores])
            clearances.append(clearance(grazing, heights))
        shape = (-1, points.shape[1])
        return self._decider.decision(
            borders, np.array(guards).reshape(shape), np.array(clearances).reshape(shape)
        )

    def _evaluate(self, points: Array, derivatives: bool) -> Array:
        """Values, and derivatives if asked for, as for a model without events."""
        columns = 1 + len(points) if derivatives else 1
        table = np.full((len(self.unknowns), columns, points.shape[1]), np.nan)
        for begin in range(0, points.shape[1], _CHUNK):
            chunk = slice(begin, begin + _CHUNK)
            self._fill(table[:, :, chunk], points[:, chunk], derivatives)
        return table

    def _fill(self, table: Array, points: Array, derivatives: bool) -> None:
        """Values and derivatives at a few points (coordinates, N), where they are known."""
        decision = self._decision(points[1:])

        def values(k: int, here: NDArray[np.intp]) -> Array:
            own = self._branches[k]._at_clock_times(points[:, here], derivatives)
            mine = decision.chosen[here] == k
            table[:, :, here[mine]] = own[:, :, mine]
            return own[:, :1]

        at = 1, points.shape[1]
        _, doubtful = self._decider.merged(decision, at, self._tolerances, values)
        table[:, :, doubtful[0]] = np.nan
