"""The branches of a search for orders: continued over the box, and where each two of them part.

A branch is an order of events that is forced over the whole box. Where it cannot be, because an
event is grazed, it is opened: it has one more coordinate, the root of the height of the turn.
"""

from __future__ import annotations

import itertools
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.tuning import SOLVE
from rankone.solvers.verification.measure import MOST_UNDECIDED
from rankone.support.arrays import NEGLIGIBLE, Array
from rankone.support.budget import budget_left, limited
from rankone.trajectories.events.forced import ContinuationError
from rankone.trajectories.events.openings import ContinuedOrder, opened_after, opened_at_beginning
from rankone.trajectories.events.orders import Opened, Order, OrderSearch
from rankone.trajectories.events.sides import REMEDY, OrderError
from rankone.trajectories.system.features import Beginning, ForcedOrder, Guard, Turn
from rankone.trajectories.system.timeline import Fork, Grazing, Opening

MOST_OF_OPENED = 0.25
"""Largest share of the budget for one branch with further coordinates."""


@dataclass(frozen=True)
class Branch:
    """An order, continued over the box, and the points at which it holds.

    For each of its opened events there is a branch that misses it.
    """

    order: Order
    forced: ForcedOrder
    places: NDArray[np.intp]
    opened: Opened
    parents: tuple[int, ...] = ()

    def lengths(self, points: Array, places: slice | NDArray[np.intp] = slice(None)) -> Array:
        """Lengths of stretches at some of the points (m, d) of a search, as predicted."""
        return self.forced.lengths(self.opened.points[: len(points)][places])

    @property
    def continued(self) -> ContinuedOrder:
        return ContinuedOrder(self.order, self.forced, self.opened)

    def with_guard(self, guard: Guard | Turn) -> tuple[Branch, int]:
        """The branch with a guard, and the position of this."""
        guards = self.forced.guards
        if guard not in guards:
            guards = (*guards, guard)
        return replace(self, forced=replace(self.forced, guards=guards)), guards.index(guard)

    def is_opened_from(self, stretch: int) -> bool:
        """Whether it has events that are opened on a stretch, or later."""
        return any(turn.stretch >= stretch for turn in self.opened.turns)

    def begins_alike(self, order: Order, places: NDArray[np.intp]) -> bool:
        """Whether an order that holds at some places meets the opened events of this one too.

        Below the least of the roots it may meet another one instead.
        """
        if not self.opened.turns:
            return False
        stretch = self.opened.turns[-1].stretch
        own, others = self.order.steps[: stretch + 1], order.steps[: stretch + 1]
        first = slice(stretch, stretch + 1)
        ends = self.order.met[first], self.order.roots[first]
        roots, least = self.opened.points[places, -1], self.opened.bounds[-1, 0]
        alike = own == others and ends == (order.met[first], order.roots[first])
        return alike and bool((roots > least).all())

    def turn_of(self, other: Branch, step: int) -> Turn | None:
        """The turn of a step at which the branch misses an event that another one has opened."""
        turns = [
            turn
            for turn in other.opened.turns
            if isinstance(turn, Turn) and turn.stretch == step - 1 and turn not in self.opened.turns
        ]
        return turns[0] if turns else None


@dataclass(frozen=True)
class _Failed:
    """An order that cannot be continued from the points at which it holds, and why."""

    order: Order
    places: NDArray[np.intp]
    error: ContinuationError

    def raise_for(self, order: Order, places: NDArray[np.intp]) -> None:
        """Raise the error for an order with the stretch that fails, if it holds at fewer places."""
        missed = self.error.missed
        if missed is None or len(places) > len(self.places):
            return
        if order.steps[: missed + 2] == self.order.steps[: missed + 2]:
            raise self.error


@dataclass(frozen=True)
class Branches:
    """The branches, where each two of them part, and which events they graze.

    The orders that are only ``grazed`` hold in slivers of the box, and are no branches.
    """

    branches: list[Branch]
    grazed: list[Order]
    forks: tuple[Fork, ...] = ()
    grazings: tuple[Grazing, ...] = ()

    @property
    def orders(self) -> list[Order]:
        """Those of the branches, and behind them those that are only grazed."""
        return [*(branch.order for branch in self.branches), *self.grazed]

    @property
    def guards(self) -> tuple[int, ...]:
        """How many guards and clearances each branch has."""
        forced = [branch.forced for branch in self.branches]
        return tuple(len(each.guards) + len(each.clearances) for each in forced)

    @property
    def openings(self) -> tuple[Opening, ...]:
        """The openings of all branches."""
        openings = list[Opening]()
        for k, branch in enumerate(self.branches):
            bounds = branch.opened.root_bounds.tolist()
            for parent, turn, ends in zip(branch.parents, branch.opened.turns, bounds, strict=True):
                guard = turn if isinstance(turn, Turn) else turn.guard
                row = self.branches[parent].forced.guards.index(guard)
                openings.append(Opening(k, parent, row, *ends))
        return tuple(openings)


def branches_of(search: OrderSearch, rtol: float) -> Branches:
    """The branches for the orders of a search, which part to ``rtol`` of the horizon.

    They are continued to the corners of the box where they can be.

    Raises
    ------
    OrderError
        If an order that holds in more than slivers of the box cannot be continued.
    """
    to_corners = _Branching(search.to_corners, rtol)
    try:
        return to_corners.branches()
    except ContinuationError as error:
        if not any(each.at_corners for each in (error, *(f.error for f in to_corners.failed))):
            raise
    return _Branching(search, rtol).branches()


@dataclass(frozen=True)
class _Branching:
    """How the branches of a search are formed, and which orders ``failed`` to be continued."""

    search: OrderSearch
    rtol: float
    failed: list[_Failed] = field(default_factory=list)

    def branches(self) -> Branches:
        """Those of all orders, with where they part and what they graze."""
        return self._with_grazings(self._with_forks(self._continued()))

    def _continued(self) -> Branches:
        """The orders, without those that a longer one goes on from or that are only grazed."""
        search, branches, failed = self.search, list[Branch](), self.failed
        for order, places in search.groups().items():
            if any(self._is_part_of(other, order, places) for other in branches):
                continue
            try:
                for other in failed:
                    other.raise_for(order, places)
                forced = search.continued(order, places)
                branches.append(Branch(order, forced, places, search.unopened))
            except ContinuationError as error:
                failed.append(_Failed(order, places, error))
            if len(branches) + len(failed) > SOLVE.most_branches:
                raise OrderError(
                    f"events come in more than {SOLVE.most_branches} orders over the box",
                    remedy=REMEDY,
                )
        shortest = sorted(failed, key=lambda each: len(each.order.met))
        grazed = list[Order]()
        for each in sorted(shortest, key=self._may_be_grazed):
            if any(self._is_part_of(b, each.order, each.places) for b in branches):
                continue
            alike = None if self._may_be_left_out(each) else self._opened_alike(each, branches)
            if alike is None and self._may_be_grazed(each):
                grazed.append(each.order)
            else:
                branches.append(alike or self._opened(each, branches))
        return Branches(branches, grazed)

    def _may_be_grazed(self, failed: _Failed) -> bool:
        """Whether an order that cannot be continued holds in slivers of the box alone."""
        most = SOLVE.most_grazed * len(self.search.points)
        return len(failed.places) <= most and not failed.order.terminal

    def _may_be_left_out(self, failed: _Failed) -> bool:
        """Whether these slivers are small enough for a success that leaves them out."""
        most = MOST_UNDECIDED * len(self.search.points)
        return len(failed.places) <= most and self._may_be_grazed(failed)

    def _opened_alike(self, failed: _Failed, branches: list[Branch]) -> Branch | None:
        """The branch of an order that begins with the same opened event as another one."""
        for other in branches:
            if other.begins_alike(failed.order, failed.places):
                with suppress(ContinuationError):
                    return self._behind(failed, other.opened, other.parents, branches)
        return None

    def _opened(self, failed: _Failed, branches: list[Branch]) -> Branch:
        """A branch with an event that another one misses; the last error without one.

        Branches that miss a later event of it are added to the others.
        """
        order, reason = failed.order, failed.error
        for k, parent in enumerate(branches):
            step = order.parts_at(parent.order)
            try:
                with limited(MOST_OF_OPENED * budget_left()):
                    opened = self._opened_at(failed, parent, step)
                    if opened is None:
                        continue
                    if isinstance(begins := opened.turns[-1], Beginning):
                        branches[k] = parent.with_guard(begins.guard)[0]
                    return self._behind(failed, opened, (*parent.parents, k), branches)
            except ContinuationError as error:
                reason = error
        raise reason

    def _opened_at(self, failed: _Failed, parent: Branch, step: int) -> Opened | None:
        """Points of an order and how it is opened, at a step at which it parts from a parent.

        At the turn at which the parent misses its event, or at the beginning of a stretch.
        """
        order = failed.order
        at = self.search, parent.continued, order, failed.places
        at_once = step and order.met[step - 1 : step] == parent.order.met[step - 1 : step]
        missed = failed.error.missed
        if (at_once or not step) and missed is not None and missed >= step:
            return None if parent.is_opened_from(step) else opened_at_beginning(*at)
        stretch = step - 1
        if not 0 <= stretch < len(order.met) or parent.is_opened_from(stretch):
            return None
        return opened_after(*at, stretch)

    def _behind(
        self, failed: _Failed, opened: Opened, parents: tuple[int, ...], branches: list[Branch]
    ) -> Branch:
        """The branch behind an opened event.

        A ContinuationError where a later event is missed in turn: then the branch up to that one is
        added to the others.
        """
        order, places = failed.order, failed.places
        try:
            forced = self.search.continued(order, places, opened)
        except ContinuationError as error:
            missed = error.missed or 0
            begun = order.until(missed)
            if missed > opened.turns[-1].stretch and all(begun != b.order for b in branches):
                forced = self.search.continued(begun, places, opened)
                branches.append(Branch(begun, forced, places[:0], opened, parents))
            raise
        return Branch(order, forced, places, opened, parents)

    def _is_part_of(self, other: Branch, order: Order, places: NDArray[np.intp]) -> bool:
        """Whether another branch holds for an order at some places too.

        As an order with further events after the end, or one whose stretches end at the same roots.
        """
        lengths = other.lengths(self.search.points, places)
        if order.begins(other.order):
            end = lengths[:, : len(order.met) + 1].sum(axis=1)
            return bool((end >= (1.0 - NEGLIGIBLE) * self.search.length).all())
        if order.at_any_roots != other.order.at_any_roots:
            return False
        apart = np.abs(lengths - self.search.lengths(order, places))
        return bool((apart <= SOLVE.same_root * self.search.length).all())

    def _with_grazings(self, parted: Branches) -> Branches:
        """The branches with clearances from the events at which grazed orders part from them.

        Trajectories may graze such an event between any two others, and again after they met it:
        clearances count on all stretches.
        """
        branches, grazings = [*parted.branches], list[Grazing]()
        for order in parted.grazed:
            steps = [order.parts_at(branch.order) for branch in branches]
            step = max(steps, default=0)
            if not 0 < step <= len(order.met):
                raise self.search.unforeseen(order)
            clearance, scale = self.search.clearance(order, step)
            for k, branch in enumerate(branches):
                forced = branch.forced
                if clearance in forced.clearances:
                    continue
                guard = len(forced.guards) + len(forced.clearances)
                forced = replace(forced, clearances=(*forced.clearances, clearance))
                branches[k] = replace(branch, forced=forced)
                ends = branch.order.ends_with(clearance.event)
                grazings += [
                    Grazing(k, stretch, guard, scale, *sides, first=not any(ends[:stretch]))
                    for stretch, sides in enumerate(zip([False, *ends], ends, strict=False))
                ]
        return replace(parted, branches=branches, grazings=tuple(grazings))

    def _with_forks(self, parted: Branches) -> Branches:
        """The branches with their guards, and where each two of them part."""
        search, branches, forks = self.search, [*parted.branches], list[Fork]()
        lengths = [branch.lengths(search.points) for branch in branches]
        least = -NEGLIGIBLE * search.length
        for a, b in itertools.combinations(range(len(branches)), 2):
            one, other = branches[a].order, branches[b].order
            step = one.parts_at(other)
            fork = self._fork_at_turn(branches, a, b, step)
            if fork is not None:
                forks.append(fork)
                continue
            fork = Fork(a, b, step - 1)
            if step and not self._at_once(one, other, step, lengths[a], lengths[b]):
                first, second = (
                    step <= each.shape[1] and bool((each[:, step - 1] < least).any())
                    for each in (lengths[a], lengths[b])
                )
                forks.append(replace(fork, may_be_past=(first, second)))
                continue
            places = [search.places(order.steps[: step + 1]) for order in (one, other)]
            guard, sign, scale = search.guard(step - 1, *places)
            branches[a], row = branches[a].with_guard(guard)
            forks.append(replace(fork, guard=row, sign=sign, scale=scale))
        return replace(parted, branches=branches, forks=tuple(forks))

    def _fork_at_turn(self, branches: list[Branch], a: int, b: int, step: int) -> Fork | None:
        """The fork of two branches of which one misses an event that is opened in the other."""
        ways = []
        for first, second in ((a, b), (b, a)):
            turn = branches[first].turn_of(branches[second], step)
            if turn is not None:
                lengths = branches[second].lengths(self.search.points)[:, step - 1]
                ways.append((float(lengths.mean()), first, second, turn))
        if not ways:
            return None
        _, first, second, turn = min(ways, key=lambda way: way[0])  # the event that comes first
        branches[first], row = branches[first].with_guard(turn)
        opened = branches[second].opened
        lower = opened.root_bounds[opened.turns.index(turn), 0]
        return Fork(first, second, step - 1, row, sign=-1.0, scale=float(lower**2), at_turn=True)

    def _at_once(
        self, one: Order, other: Order, step: int, lengths: Array, other_lengths: Array
    ) -> bool:
        """Whether two orders part at one instant, and not at two times of their own."""
        if step >= min(len(one.steps), len(other.steps)):
            return False  # one of them ends
        if one.steps[step][0][0] != other.steps[step][0][0]:
            return False
        apart = np.abs(lengths[:, step - 1] - other_lengths[:, step - 1]).max()
        return bool(apart <= SOLVE.same_time * self.rtol * self.search.length)
