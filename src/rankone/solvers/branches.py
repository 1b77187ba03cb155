"""Solves where the order of events changes inside the box: each order is a branch of its own.

A branch is continued over the whole box with its order forced, so that it is smooth. Which one
holds is decided by the times of the events in which they differ, and by guards. The solution is
then measured against trajectories that follow their own order.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.ir.events import ForcedOrder, Guard, Turn
from rankone.ir.measures import LINEAR
from rankone.ir.outcome import Measured, Outcome
from rankone.ir.request import Domain, SolveRequest
from rankone.ir.system import System
from rankone.ir.timeline import BranchedTimeline, Fork, Grazing, Opening, Timeline
from rankone.ir.verdict import (
    HiddenEvent,
    HiddenRate,
    MeasuredError,
    MemoryNeeded,
    Note,
    OrderSearchLimit,
    Remedy,
    Status,
    UndecidedOrder,
    UndecidedShare,
)
from rankone.solution.branches import branch_evaluator
from rankone.solvers.attempts import Stages, out_at_reference
from rankone.solvers.one_order import narrowing_text, one_order
from rankone.solvers.stretches import sizes_at_start, timed_system
from rankone.support.arrays import Array, spread
from rankone.support.budget import OutOfBudgetError, limited, seconds_left, work_left
from rankone.tensors.branches import BranchEvaluator
from rankone.tensors.slab import SlabTrain
from rankone.trajectories.choice import span_integrator_for
from rankone.trajectories.events.event_order import REMEDY, OrderError, TrajectoryEndError
from rankone.trajectories.events.forced import ContinuationError
from rankone.trajectories.events.openings import ContinuedOrder, opened_after
from rankone.trajectories.events.orders import Opened, Order, OrderSearch
from rankone.trajectories.events.stretches import in_stretches
from rankone.trajectories.integrator import Tolerances
from rankone.verification.branches import (
    BranchErrors,
    branch_errors,
    points_near_changes,
    points_with_other_events,
    undecided_share,
)
from rankone.verification.coverage import Coverage
from rankone.verification.hidden import hidden_rate_along
from rankone.verification.hidden_events import hidden_event
from rankone.verification.measure import SAFE_QUANTILE
from rankone.verification.points import FEW_PARAMETERS, check_points, covers_corners
from rankone.verification.reference import reference_accuracy

MOST_UNDECIDED = 0.01
"""Largest share of the box that may be undecided."""
_POINTS = 256  # Trajectories that tell the orders
_MOST_BRANCHES = 16
_MOST_GRAZED = 0.03  # Share of the trajectories, about, with an order that cannot be continued
_MOST_SOLVES = 4  # Solves of all branches: the check may meet further orders, or ask for accuracy
_MOST_OF_ONE = 0.08  # Share of the budget for one branch: where more is asked for, it is not smooth
_MOST_OF_OPENED = 0.25  # The same where it has further coordinates
_SHARES = (0.4, 0.1)  # Tolerances of the branches over that of the solve
_MOST_MISSED = 10.0  # Error over the tolerance from which more accurate branches are no remedy
_PART_SHARE = 0.3  # Of what is left, for a part of the box in which events come in one order
_FLOOR = 1e-3  # Size of a state, over that at the start, below which accuracy is absolute
_INSIDE = 1e-4  # Distance of points from the faces of the box, in widths
_PAST = 1e-9  # Length of a stretch back in time, in horizons, beyond rounding
_SAME_TIME = 0.1  # Difference of lengths of stretches that end at once, in horizons, over rtol
_SOLVED = (Status.CONVERGED, Status.UNCHECKED)
_SAME_ROOT = 1e-3  # Most that stretches differ which end at one root, in horizons
_WIDTH = 1.0  # Width of what is undecided, over the tolerance

# What to do where a limit is reached, before what always helps
_RAISED = {Status.WORK_LIMIT: "raise effort, or ", Status.TIME_LIMIT: "raise max_seconds, or "}
# How a branch is not resolved where a limit is reached
_SPENT = {
    Status.WORK_LIMIT: " within its share of the budget",
    Status.TIME_LIMIT: " within its share of the time",
}

# Solves a system over stretches
Solve = Callable[[System, SolveRequest], Outcome]


@dataclass(frozen=True)
class _Branch:
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

    def with_guard(self, guard: Guard | Turn) -> tuple[_Branch, int]:
        """The branch with a guard, and the position of this."""
        guards = self.forced.guards
        if guard not in guards:
            guards = (*guards, guard)
        return replace(self, forced=replace(self.forced, guards=guards)), guards.index(guard)

    def is_opened_from(self, stretch: int) -> bool:
        """Whether it has events that are opened on a stretch, or later."""
        return any(turn.stretch >= stretch for turn in self.opened.turns)

    def turn_of(self, other: _Branch, step: int) -> Turn | None:
        """The turn of a step at which the branch misses an event that another one has opened."""
        turns = [
            turn
            for turn in other.opened.turns
            if turn.stretch == step - 1 and turn not in self.opened.turns
        ]
        return turns[0] if turns else None


def solve_in_branches(
    solve: Solve, system: System, request: SolveRequest, error: OrderError, stages: Stages
) -> Outcome:
    """The outcome of branches for the orders of a system.

    ``error`` says that it has several ones; it is raised again where events are put off by delays.
    An OrderError says where an order cannot be continued. ``stages`` count what the search takes,
    besides the solves of branches.
    """
    timed, cuts = timed_system(system, request.domain)
    search: OrderSearch | None = None
    put_off = any(e.starts is not None or e.cancels is not None for e in timed.events)
    if put_off or timed.constraints.names or not request.domain.box:
        raise error
    try:
        with stages.of("reference"):
            search = order_search(timed, request)
        shares = iter(_SHARES)
        share = next(shares)
        for _ in range(_MOST_SOLVES):
            outcome, further = _BranchSolve(search, request, cuts, share, stages).outcome(solve)
            outcome = replace(outcome, timings={**stages.timings}, work={**stages.work})
            if len(further):
                with stages.of("reference"):
                    search = with_points(search, further)
                continue
            missed = outcome.status is Status.TOLERANCE
            if not missed or not outcome.error < _MOST_MISSED * request.rtol:
                return outcome
            share = next(shares, 0.0)
            if not share:
                return outcome
    except OutOfBudgetError as out:
        if out.reached is not None and out.reached.chattering is not None:
            return out_at_reference(out, timed, stages)
        return _out_at_search(out, error, search, stages)
    except TrajectoryEndError:
        raise error from None
    except OrderError as failure:
        if search is None:
            raise
        search = replace(search, tells_roots=True)
        if len(search.groups()) == 1:
            raise error from None
        with stages.of("reference"):
            failure.remedy = (failure.remedy or REMEDY).replace(REMEDY, _remedy(search))
        raise
    if len(further):  # each check meets yet another order
        raise error
    return outcome


def _out_at_search(
    out: OutOfBudgetError, error: OrderError, search: OrderSearch | None, stages: Stages
) -> Outcome:
    """The outcome when a limit is met by the search for orders, which differ by an error."""
    status, notes = Status.of_limit(out), list[Note]()
    if (memory_needed := MemoryNeeded.of(out)) is not None:
        notes.append(memory_needed)
    with stages.of("reference"):
        remedy = REMEDY if search is None else _remedy(search)
    ended = Outcome((), status, None, (), {**stages.timings}, {**stages.work})
    notes.append(Remedy(_RAISED.get(status, "") + remedy))
    reason = error.message if search is None else f"{error.message}: {_largest_orders(search)}"
    return replace(ended, cause=OrderSearchLimit(reason), notes=tuple(notes))


def _largest_orders(search: OrderSearch) -> str:
    """The two orders that hold in the largest parts of the box."""
    groups = sorted(search.groups().items(), key=lambda pair: -len(pair[1]))
    shares = [
        f"{search.named(order)} holds in about {len(places) / len(search.points):.0%} of the box"
        for order, places in groups[:2]
    ]
    return ", ".join(shares)


def _remedy(search: OrderSearch) -> str:
    """What to do about orders that cannot be continued: a part of the box, if there is one."""
    try:
        with limited(_PART_SHARE * work_left(), seconds_left()):
            part = one_order(search)
    except OutOfBudgetError:
        part = None
    if part is None:
        return REMEDY
    narrowed = narrowing_text(search.system.parameters, search.bounds, part)
    return f"narrow {narrowed}: events come in one order there"


def order_search(timed: System, request: SolveRequest) -> OrderSearch:
    """Trajectories of their own orders, evenly spread over the box."""
    domain = request.domain
    accuracy = reference_accuracy(request.rtol)
    chosen = span_integrator_for(timed, request.integrator, accuracy=accuracy)
    shares = spread(_POINTS, len(domain.box), np.random.default_rng(20143))
    points = Coverage.of_domain(domain).points(_INSIDE + (1.0 - 2.0 * _INSIDE) * shares)
    tolerances = Tolerances.down_to(accuracy, _FLOOR * sizes_at_start(timed, points))
    empty = OrderSearch(timed, domain.horizon, domain.bounds, points[:0], [], chosen, tolerances)
    return with_points(empty, points)


def with_points(search: OrderSearch, points: Array) -> OrderSearch:
    """The search with trajectories at further points (m, d)."""
    return replace(
        search,
        points=np.concatenate([search.points, points]),
        trajectories=[*search.trajectories, *search.followed(points)],
    )


@dataclass(frozen=True)
class _Failed:
    """An order that cannot be continued from the points at which it holds, and why."""

    order: Order
    places: NDArray[np.intp]
    error: ContinuationError


@dataclass(frozen=True)
class _Branches:
    """The branches, where each two of them part, and which events they graze.

    The orders that are only ``grazed`` hold in slivers of the box, and are no branches.
    """

    branches: list[_Branch]
    grazed: list[Order]
    forks: tuple[Fork, ...] = ()
    grazings: tuple[Grazing, ...] = ()


@dataclass(frozen=True)
class _BranchSolve:
    """A solve of all branches that a search has found, to a share of the tolerance."""

    search: OrderSearch
    request: SolveRequest
    cuts: tuple[float, ...]
    share: float
    stages: Stages

    def outcome(self, solve: Solve) -> tuple[Outcome, Array]:
        """The outcome, and points (m, d) at which other orders hold than those of its branches."""
        try:
            with self.stages.of("reference"):
                parted = self._with_grazings(self._with_forks(self._branches()))
        except OrderError:
            telling = replace(self.search, tells_roots=True)
            if telling.orders == self.search.orders:
                raise
            return replace(self, search=telling).outcome(solve)
        branches = parted.branches
        outcomes, timelines = list[Outcome](), list[Timeline]()
        whole = work_left()
        for k, branch in enumerate(branches):
            share = 1.0 / (len(branches) - k)
            most = whole * (_MOST_OF_OPENED if branch.opened.turns else _MOST_OF_ONE)
            with limited(min(share * work_left(), most), share * seconds_left()):
                outcome, timeline = self._solved(solve, branch)
            if not outcome.slabs or outcome.status not in _SOLVED:
                raise self._unresolved(branch, outcome)
            outcomes.append(outcome)
            timelines.append(timeline)
        rtol = self.request.rtol
        tolerances = tuple((rtol * self.search.sizes).tolist())
        guards = tuple(
            len(branch.forced.guards) + len(branch.forced.clearances) for branch in branches
        )
        branched = BranchedTimeline(
            tuple(timelines),
            guards,
            parted.forks,
            _WIDTH * rtol,
            tolerances,
            0.0,
            parted.grazings,
            self._openings(branches),
        )
        orders = [*(branch.order for branch in branches), *parted.grazed]
        with self.stages.of("check"):
            return self._checked(outcomes, branched, orders, len(branches))

    def _unresolved(self, branch: _Branch, outcome: Outcome) -> OrderError:
        """The error of a branch whose outcome is no success; its tolerance is not the user's."""
        status = outcome.status
        why = _SPENT.get(status) or f": {replace(outcome, notes=()).message}"
        order = self.search.named(branch.order)
        error = OrderError(
            f"{order}, which holds in a part of the box, is not resolved{why}",
            remedy=_RAISED.get(status, "") + REMEDY,
        )
        error.limit = status if status in _RAISED else None
        return error

    def _branches(self) -> _Branches:
        """The orders, without those that a longer one goes on from or that are only grazed."""
        search, branches, failed = self.search, list[_Branch](), list[_Failed]()
        for order, places in search.groups().items():
            if any(self._is_part_of(other, order, places) for other in branches):
                continue
            try:
                forced = search.continued(order, places)
                branches.append(_Branch(order, forced, places, search.unopened))
            except ContinuationError as error:
                failed.append(_Failed(order, places, error))
            if len(branches) + len(failed) > _MOST_BRANCHES:
                raise OrderError(
                    f"events come in more than {_MOST_BRANCHES} orders over the box", remedy=REMEDY
                )
        grazed, most_grazed = list[Order](), _MOST_GRAZED * len(search.points)
        for each in sorted(failed, key=lambda each: len(each.order.met)):
            if len(each.places) <= most_grazed and not each.order.terminal:
                grazed.append(each.order)
            elif not any(self._is_part_of(b, each.order, each.places) for b in branches):
                branches.append(self._opened(each, branches))
        return _Branches(branches, grazed)

    def _opened(self, failed: _Failed, branches: list[_Branch]) -> _Branch:
        """A branch with an event that another one misses; the last error without one.

        Branches that miss a later event of it are added to the others.
        """
        order, reason = failed.order, failed.error
        for k, parent in enumerate(branches):
            stretch = order.parts_at(parent.order) - 1
            if not 0 <= stretch < len(order.met) or parent.is_opened_from(stretch):
                continue
            at = parent.continued, order, failed.places, stretch
            try:
                with limited(_MOST_OF_OPENED * work_left()):
                    opened = opened_after(self.search, *at)
                    if opened is not None:
                        parents = (*parent.parents, k)
                        return self._behind(failed, opened, parents, branches)
            except ContinuationError as error:
                reason = error
        raise reason

    def _behind(
        self, failed: _Failed, opened: Opened, parents: tuple[int, ...], branches: list[_Branch]
    ) -> _Branch:
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
                branches.append(_Branch(begun, forced, places[:0], opened, parents))
            raise
        return _Branch(order, forced, places, opened, parents)

    def _is_part_of(self, other: _Branch, order: Order, places: NDArray[np.intp]) -> bool:
        """Whether another branch holds for an order at some places too.

        As an order with further events after the end, or one whose stretches end at the same roots.
        """
        lengths = other.lengths(self.search.points, places)
        if order.begins(other.order):
            end = lengths[:, : len(order.met) + 1].sum(axis=1)
            return bool((end >= (1.0 - _PAST) * self.search.length).all())
        if order.at_any_roots != other.order.at_any_roots:
            return False
        apart = np.abs(lengths - self.search.lengths(order, places))
        return bool((apart <= _SAME_ROOT * self.search.length).all())

    def _solved(self, solve: Solve, branch: _Branch) -> tuple[Outcome, Timeline]:
        """The outcome of one branch over the whole box, and its timeline."""
        search, request = self.search, self.request
        clock = branch.order.clock(search.system, search.horizon, branch.forced)
        stretched = in_stretches(replace(clock, cuts=self.cuts))
        roots = tuple(map(tuple, branch.opened.bounds[len(request.domain.box) :].tolist()))
        box = (*request.domain.box, *roots)
        scales = (*request.domain.scales, *(LINEAR for _ in roots))
        domain = Domain(stretched.horizon, box, scales)
        tighter = replace(request, domain=domain, rtol=self.share * request.rtol)
        with self.stages.if_it_fails("reference"):
            outcome = solve(stretched, tighter)
        self.stages.add(outcome.timings, outcome.work)
        return outcome, Timeline.of(clock)

    def _with_grazings(self, parted: _Branches) -> _Branches:
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

    def _with_forks(self, parted: _Branches) -> _Branches:
        """The branches with their guards, and where each two of them part."""
        search, branches, forks = self.search, [*parted.branches], list[Fork]()
        lengths = [branch.lengths(search.points) for branch in branches]
        least = -_PAST * search.length
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

    def _fork_at_turn(self, branches: list[_Branch], a: int, b: int, step: int) -> Fork | None:
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
        lower = opened.bounds[len(self.request.domain.box) + opened.turns.index(turn), 0]
        return Fork(first, second, step - 1, row, sign=-1.0, scale=float(lower**2), at_turn=True)

    def _openings(self, branches: Sequence[_Branch]) -> tuple[Opening, ...]:
        """The openings of all branches."""
        d, openings = len(self.request.domain.box), list[Opening]()
        for k, branch in enumerate(branches):
            bounds = branch.opened.bounds[d:].tolist()
            for parent, turn, ends in zip(branch.parents, branch.opened.turns, bounds, strict=True):
                row = branches[parent].forced.guards.index(turn)
                openings.append(Opening(k, parent, row, *ends))
        return tuple(openings)

    def _at_once(
        self, one: Order, other: Order, step: int, lengths: Array, other_lengths: Array
    ) -> bool:
        """Whether two orders part at one instant, and not at two times of their own."""
        if step >= min(len(one.steps), len(other.steps)):
            return False  # one of them ends
        if one.steps[step][0][0] != other.steps[step][0][0]:
            return False
        apart = np.abs(lengths[:, step - 1] - other_lengths[:, step - 1]).max()
        return bool(apart <= _SAME_TIME * self.request.rtol * self.search.length)

    def _checked(
        self,
        outcomes: Sequence[Outcome],
        timeline: BranchedTimeline,
        orders: Sequence[Order],
        count: int,
    ) -> tuple[Outcome, Array]:
        """The outcome of all branches, measured; and points (m, d) at which other orders hold.

        The first of the orders, so many by ``count``, are those of the branches.
        """
        slabs = one_after_the_other(outcomes, timeline)
        joined = Outcome(
            slabs,
            Status.UNCHECKED,
            None,
            tuple(record for outcome in outcomes for record in outcome.history),
            {**self.stages.timings},
            {**self.stages.work},
            timeline=timeline,
        )
        nothing = self.search.points[:0]
        if not self.request.check.points:
            return joined, nothing
        evaluator = branch_evaluator(slabs, timeline)
        points, corners = self._check_points(evaluator, orders[:count])
        checked = with_points(replace(self.search, points=nothing, trajectories=[]), points)
        rtol = self.request.rtol
        errors = branch_errors(evaluator, checked.system, points, checked.trajectories, rtol)
        known = [order.at_any_roots for order in orders]
        met = [order.at_any_roots for order in checked.orders]
        others = [
            decided and not any(order.begins(o) or order == o for o in known)
            for order, decided in zip(met, errors.decided, strict=True)
        ]
        if any(others):
            return joined, points[np.array(others)]
        measured = _measured(errors, self.request, points, corners, self._whole_box)
        undecided = undecided_share(evaluator, Coverage.of_domain(self.request.domain))
        judged = _judged(joined, timeline, measured, undecided, rtol)
        if judged.status is Status.CONVERGED:
            judged = _looked_at(judged, checked, rtol)
        return judged, nothing

    @property
    def _whole_box(self) -> bool:
        """Whether corners count."""
        return covers_corners(self.request)

    def _check_points(
        self, evaluator: BranchEvaluator, orders: Sequence[Order]
    ) -> tuple[Array, int]:
        """The centre, corners, interior points and suspicious ones (m, d); the number of corners.

        Suspicious are those next to changes, and where a branch passes events that its order lacks.
        """
        domain, count = self.request.domain, self.request.check.points
        few = len(domain.box) <= FEW_PARAMETERS
        points = check_points(
            domain.bounds,
            count,
            every_corner=few or self._whole_box,
            scales=domain.coordinates,
        )
        coverage = Coverage.of_domain(domain)
        near = points_near_changes(evaluator, coverage)
        others = points_with_other_events(evaluator, self.search.system, orders, coverage)
        return np.concatenate([points, near, others]), len(points) - 1 - count


def _judged(
    joined: Outcome, timeline: BranchedTimeline, measured: Measured, undecided: float, rtol: float
) -> Outcome:
    """The outcome with its status: by its error, and by the share of the box left undecided."""
    judged = replace(joined, measured=measured, timeline=replace(timeline, undecided=undecided))
    if measured.error <= rtol and undecided > MOST_UNDECIDED:
        remedy = (Remedy(REMEDY),)
        cause = UndecidedOrder(undecided)
        return replace(judged, status=Status.TOLERANCE, cause=cause, notes=remedy)
    notes: list[Note] = [MeasuredError(measured.error, rtol)]
    notes += [UndecidedShare(undecided)] if undecided else []
    if measured.error <= rtol:
        return replace(judged, status=Status.CONVERGED, notes=tuple(notes))
    return replace(judged, status=Status.TOLERANCE, notes=(*notes, Remedy(REMEDY)))


def _looked_at(outcome: Outcome, checked: OrderSearch, rtol: float) -> Outcome:
    """The outcome, without success where steps of checked trajectories miss something narrow."""
    trajectories, points, system = checked.trajectories, checked.points, checked.system
    hidden: HiddenRate | HiddenEvent | None
    try:
        hidden = hidden_rate_along(trajectories, points, system, checked.sizes, rtol)
        hidden = hidden or hidden_event(system, trajectories, points, checked.horizon, rtol)
    except OutOfBudgetError as out:  # whether steps missed something is not known
        return replace(outcome, status=Status.of_limit(out))
    if hidden is None:
        return outcome
    return replace(outcome, status=Status.NARROW, cause=hidden, notes=(Remedy(hidden.remedy),))


def _measured(
    errors: BranchErrors, request: SolveRequest, points: Array, corners: int, whole_box: bool
) -> Measured:
    """What errors amount to, relative to the sizes of the states."""
    at_corners = slice(1, 1 + corners)
    inside = np.delete(errors.largest, at_corners, axis=1).max(axis=1)
    sizes = np.where(inside > 0.0, inside, 1.0)
    units = np.repeat(sizes[:, None], len(points), axis=1)
    largest = errors.largest[:, at_corners].max(axis=1, initial=0.0)
    units[:, at_corners] = np.maximum(sizes, largest)[:, None]
    relative = errors.states / units
    counts = np.ones(len(points), dtype=bool)
    counts[at_corners] = whole_box
    counted = request.check.states
    of_states = relative if counted is None else relative[list(counted)]
    of_points = of_states[:, counts].max(axis=0)
    return Measured(
        interior=tuple(relative[:, counts].max(axis=1).tolist()),
        corners=tuple(relative[:, at_corners].max(axis=1, initial=0.0).tolist()) if corners else (),
        points=len(points),
        method="DOP853",
        cover="box" if whole_box else "interior",
        quantile=float(np.quantile(of_points, SAFE_QUANTILE, method="higher")),
        worst=tuple(points[counts][np.argmax(of_points)].tolist()),
        counted=counted,
        time_error=errors.time,
    )


def one_after_the_other(
    outcomes: Sequence[Outcome], timeline: BranchedTimeline
) -> tuple[SlabTrain, ...]:
    """The slabs of all branches, each behind those of the one before."""
    offsets = np.cumsum([0, *(branch.stretches for branch in timeline.branches)]).tolist()
    return tuple(
        replace(slab, start=slab.start + offset, end=slab.end + offset)
        for outcome, offset in zip(outcomes, offsets, strict=False)
        for slab in outcome.slabs
    )
