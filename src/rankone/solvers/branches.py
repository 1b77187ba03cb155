"""Solves where the order of events changes inside the box: a solution for each order, checked."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from rankone.solvers.attempts import Stages, out_at_reference
from rankone.solvers.branching import MOST_OF_OPENED, Branch, Branches, branches_of
from rankone.solvers.outcome import Measured, Outcome
from rankone.solvers.remedies import box_of_one_order, remedy_of
from rankone.solvers.request import Domain, SolveRequest
from rankone.solvers.stretches_by_markers import sizes_at_start, timed_system
from rankone.solvers.tuning import SOLVE
from rankone.solvers.verification.measure import (
    BEYOND,
    MOST_UNDECIDED,
    BranchErrors,
    branch_errors,
    points_near_changes,
    points_with_other_events,
    undecided_share,
)
from rankone.solvers.verification.points import (
    FEW_PARAMETERS,
    Coverage,
    check_points,
    covers_corners,
)
from rankone.solvers.verification.reference import reference_accuracy
from rankone.support.arrays import Array, spread
from rankone.support.budget import OutOfBudgetError, budget_left, limited, seconds_left
from rankone.support.options import LEVEL
from rankone.tensors.branch_evaluator import BranchEvaluator
from rankone.tensors.coordinates import LINEAR, Interval
from rankone.tensors.decisions import Decider
from rankone.tensors.slab import SlabTrain, restricted
from rankone.tensors.timeline_evaluator import HeightRoot, TimelineEvaluator
from rankone.trajectories.events.orders import Order, OrderSearch
from rankone.trajectories.events.sides import REMEDY, OrderError, TrajectoryEndError
from rankone.trajectories.events.stretches import in_stretches
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.integrator_choice import span_integrator_for
from rankone.trajectories.system.system import Clock, System
from rankone.trajectories.system.timeline import CLOCK_STATES, BranchedTimeline, Opening, Timeline
from rankone.trajectories.system.verdict import (
    MeasuredError,
    MemoryNeeded,
    Note,
    OrderSearchLimit,
    Remedy,
    SharedUnit,
    Status,
    UndecidedOrder,
    UndecidedShare,
)


def slabs_of_branches(
    slabs: Sequence[SlabTrain], timeline: BranchedTimeline
) -> list[tuple[SlabTrain, ...]]:
    """The slabs of each branch, which follow those of the one before, from 0 on."""
    ends = itertools.accumulate(branch.stretches for branch in timeline.branches)
    every, start = list[tuple[SlabTrain, ...]](), 0
    for end in ends:
        own = (
            replace(slab, start=slab.start - start, end=slab.end - start)
            for slab in slabs
            if start <= 0.5 * (slab.start + slab.end) < end
        )
        every.append(tuple(own))
        start = end
    return every


def box_of_branch(
    timeline: BranchedTimeline, branch: int, whole: Sequence[Interval]
) -> tuple[Interval, ...]:
    """The box around the part of the whole one where a branch holds, and some way beyond.

    The whole one unless times of events that are affine in the parameters alone tell where.
    """
    times = timeline.branches[branch].affine_times
    guarded = any(timeline.guards) or any(fork.guard is not None for fork in timeline.forks)
    all_affine = all(len(b.affine_times) == len(b.instants) for b in timeline.branches)
    if guarded or not all_affine or len(times) < 2:
        return tuple(whole)
    earlier = -np.diff([coefficients for _, coefficients in times], axis=0)
    start, end = timeline.horizon
    most = BEYOND * (end - start) - earlier[:, 0]
    box = list(whole)
    for j in np.flatnonzero(earlier[:, 1:].any(axis=0)).tolist():
        (lower, upper), along = whole[j], np.eye(len(whole))[j]
        ends = [linprog(sign * along, earlier[:, 1:], most, bounds=whole) for sign in (1, -1)]
        if not all(each.success for each in ends):
            return tuple(whole)
        low, high = (float(each.x[j]) for each in ends)
        if low < high:
            box[j] = max(low, lower), min(high, upper)
    return tuple(box)


def slabs_over(slabs: Sequence[SlabTrain], box: Sequence[Interval]) -> tuple[SlabTrain, ...]:
    """Slabs over another box of the parameters, constant beyond the one they are solved over."""
    slabs = tuple(slabs)
    for j, interval in enumerate(box):
        if slabs and (slabs[0].bases[j].lower, slabs[0].bases[j].upper) != interval:
            slabs = restricted(slabs, j, interval)
    return slabs


def branch_evaluator(slabs: Sequence[SlabTrain], timeline: BranchedTimeline) -> BranchEvaluator:
    """The evaluator of slabs of branches, each behind those of the one before."""
    return evaluator_of_branches(slabs_of_branches(slabs, timeline), timeline)


def evaluator_of_branches(
    slabs_of: Sequence[Sequence[SlabTrain]], timeline: BranchedTimeline
) -> BranchEvaluator:
    """The evaluator of the slabs of each branch, from 0 on."""
    evaluators = dict[int, TimelineEvaluator]()

    def evaluator(k: int) -> TimelineEvaluator:
        """That of a branch, after those of the parents of its openings."""
        if k not in evaluators:
            branch = timeline.branches[k]
            roots = [root(each) for each in timeline.openings if each.branch == k]
            evaluators[k] = TimelineEvaluator(
                slabs_of[k], branch.horizon, branch.affine_borders, roots
            )
        return evaluators[k]

    def root(opening: Opening) -> HeightRoot:
        of, k = evaluator(opening.parent), opening.parent
        row = len(of.slabs[0].cores[0]) - CLOCK_STATES - timeline.guards[k] + opening.guard
        return HeightRoot(of, row, opening.lower, opening.upper)

    return BranchEvaluator(
        [evaluator(k) for k in range(len(timeline.branches))],
        timeline.guards,
        Decider(
            timeline.forks,
            timeline.highest,
            timeline.grazings,
            timeline.width,
            timeline.horizon,
        ),
        timeline.tolerances,
    )


# -----------------------------------------------------------------------------
# The check of a solve in branches, against trajectories that follow their own order of events.


MOST_MISSED = 10.0
"""Error over the tolerance from which more accurate branches are no remedy."""


@dataclass(frozen=True)
class BranchCheck:
    """The check of branches for the first ``solved`` of the orders that are known."""

    search: OrderSearch
    request: SolveRequest
    orders: Sequence[Order]
    solved: int

    def outcome(self, joined: Outcome, timeline: BranchedTimeline) -> tuple[Outcome, Array]:
        """The outcome of all branches, measured; and points (m, d) at which other orders hold."""
        nothing, rtol = self.search.points[:0], self.request.rtol
        if not self.request.check.points:
            return joined, nothing
        evaluator = branch_evaluator(joined.slabs, timeline)
        points, corners = self._points(evaluator)
        checked = self.search.at(points)
        errors = branch_errors(evaluator, checked.system, points, checked.trajectories, rtol)
        solved_orders = [self._is_known(order.at_any_roots) for order in checked.orders]
        others = ~np.array(solved_orders, dtype=bool)
        if (others & errors.decided).any():
            return joined, points[others & errors.decided]
        sizes = np.delete(errors.largest, slice(1, 1 + corners), axis=1).max(axis=1)
        added = checked.system.tolerances(sizes)[:, None] / rtol
        measured = _measured(errors, self.request, points, corners, added)
        undecided = undecided_share(evaluator, Coverage.of_domain(self.request.domain))
        judged = _judged(joined, timeline, measured, undecided, rtol)
        shared = SharedUnit.of(checked.system, sizes, rtol, self.request.check.states)
        judged = replace(judged, notes=(*judged.notes, *shared))
        if judged.status is Status.TOLERANCE:  # by other orders, where events nearly coincide
            return judged, points[others & _is_wrong(errors, rtol, added)]
        return judged, nothing

    def _is_known(self, order: Order) -> bool:
        """Whether an order is one of those that are known, or goes on as one."""
        orders = [each.at_any_roots for each in self.orders]
        return any(order == each or order.begins(each) for each in orders)

    def _points(self, evaluator: BranchEvaluator) -> tuple[Array, int]:
        """The centre, corners, interior points and suspicious ones (m, d); the number of corners.

        Suspicious are those next to changes, and where a branch passes events that its order lacks.
        """
        domain, count = self.request.domain, self.request.check.points
        few = len(domain.box) <= FEW_PARAMETERS
        points = check_points(
            domain.bounds,
            count,
            every_corner=few or covers_corners(self.request),
            scales=domain.coordinates,
        )
        coverage = Coverage.of_domain(domain)
        near = points_near_changes(evaluator, coverage)
        orders = self.orders[: self.solved]
        others = points_with_other_events(evaluator, self.search.system, orders, coverage)
        return np.concatenate([points, near, others]), len(points) - 1 - count


def _is_wrong(errors: BranchErrors, rtol: float, added: Array) -> NDArray[np.bool_]:
    """The points (m,) with errors that more accurate branches are not likely to mend.

    What is ``added`` to sizes (n, 1) are absolute tolerances over the relative one.
    """
    sizes = errors.largest.max(axis=1, keepdims=True) + added
    return np.asarray((errors.states > MOST_MISSED * rtol * sizes).any(axis=0))


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


def _measured(
    errors: BranchErrors, request: SolveRequest, points: Array, corners: int, added: Array
) -> Measured:
    """What errors amount to, relative to the sizes of the states and what is ``added``, (n, 1)."""
    whole_box = covers_corners(request)
    at_corners = slice(1, 1 + corners)
    inside = np.delete(errors.largest, at_corners, axis=1).max(axis=1)
    sizes = np.where(inside > 0.0, inside, 1.0)
    units = np.repeat(sizes[:, None], len(points), axis=1)
    largest = errors.largest[:, at_corners].max(axis=1, initial=0.0)
    units[:, at_corners] = np.maximum(sizes, largest)[:, None]
    units += added
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
        quantile=float(np.quantile(of_points, LEVEL, method="higher")),
        worst=tuple(points[counts][np.argmax(of_points)].tolist()),
        counted=counted,
        time_error=errors.time,
    )


# -----------------------------------------------------------------------------
# Solves where the order of events changes inside the box: each order is a branch of its own.
#
# A branch is continued over the whole box with its order forced, so that it is smooth; where known
# times alone tell in which part of the box it holds, over that part. Which one holds is decided by
# the times of the events in which they differ, and by guards. The solution is then measured against
# trajectories that follow their own order.


_SOLVED = (Status.CONVERGED, Status.UNCHECKED)

# What to do where a limit is reached, before what always helps
_RAISED = {Status.WORK_LIMIT: "raise effort", Status.TIME_LIMIT: "raise max_seconds"}
# How a branch is not resolved where a limit is reached
_SPENT = {
    Status.WORK_LIMIT: " within its share of the budget",
    Status.TIME_LIMIT: " within its share of the time",
}

# Solves a system over stretches
Solve = Callable[[System, SolveRequest], Outcome]


def solve_in_branches(
    solve: Solve, system: System, request: SolveRequest, reason: str, stages: Stages
) -> Outcome | None:
    """The outcome of branches for the orders of a system.

    None where there are none: events are put off by delays, or the search meets one order alone,
    or each check yet another one. The ``reason`` for several orders is told where the search does
    not end. ``stages`` count what that takes, besides the solves of branches.

    Raises
    ------
    OrderError
        If an order cannot be continued, or its branch not be solved.
    """
    timed, cuts = timed_system(system, request.domain)
    put_off = any(e.starts is not None or e.cancels is not None for e in timed.events)
    if put_off or timed.constraints.names or not request.domain.box:
        return None
    solves = _Solves(solve, timed, cuts, request, stages)
    try:
        return solves.outcome()
    except OutOfBudgetError as out:
        if out.reached is not None and out.reached.chattering is not None:
            return out_at_reference(out, timed, stages)
        return solves.out_of_budget(out, reason)
    except TrajectoryEndError:
        return None
    except OrderError as failure:
        refusal = solves.refusal(failure)
        if refusal is None:
            return None
        raise refusal from failure


def order_search(timed: System, request: SolveRequest) -> OrderSearch:
    """Trajectories of their own orders, evenly spread over the box."""
    domain = request.domain
    accuracy = reference_accuracy(request.rtol)
    chosen = span_integrator_for(timed, request.integrator)
    shares = spread(SOLVE.order_points, len(domain.box), np.random.default_rng(20143))
    points = Coverage.of_domain(domain).points(
        SOLVE.branch_inset + (1.0 - 2.0 * SOLVE.branch_inset) * shares
    )
    tolerances = Tolerances.down_to(accuracy, SOLVE.branch_floor * sizes_at_start(timed, points))
    empty = OrderSearch(timed, domain.horizon, domain.bounds, points[:0], [], chosen, tolerances)
    return empty.with_points(points)


@dataclass
class _Solves:
    """Solves of all branches, until the measured error fits.

    The ``search`` has trajectories wherever a check met another order than those before.
    """

    solve: Solve
    timed: System
    cuts: tuple[float, ...]
    request: SolveRequest
    stages: Stages
    search: OrderSearch | None = field(default=None, init=False)

    def outcome(self) -> Outcome | None:
        """The outcome; None where each check meets yet another order."""
        with self.stages.of("reference"):
            search = self.search = order_search(self.timed, self.request)
        shares = [*SOLVE.branch_tolerances]
        for _ in range(SOLVE.most_solves):
            outcome, further = self._solved(search, shares[0])
            if len(further):
                with self.stages.of("reference"):
                    search = self.search = search.with_points(further)
            elif len(shares) > 1 and self._is_near(outcome):
                del shares[0]
            else:
                return outcome
        return None if len(further) else outcome

    def _is_near(self, outcome: Outcome) -> bool:
        """Whether more accurate branches are likely to be a success."""
        missed = outcome.status is Status.TOLERANCE
        return missed and outcome.error < MOST_MISSED * self.request.rtol

    def _solved(self, search: OrderSearch, share: float) -> tuple[Outcome, Array]:
        """The outcome of branches that are solved to a share of the tolerance.

        With points (m, d) at which other orders hold than those of the branches.
        """
        search, parted = self._parted(search)
        clocks = [
            branch.order.clock(search.system, search.horizon, branch.forced)
            for branch in parted.branches
        ]
        branched = self._timeline(parted, list(map(Timeline.of, clocks)), search.sizes)
        outcomes, whole = list[Outcome](), budget_left()
        for k, branch in enumerate(parted.branches):
            of_rest = 1.0 / (len(parted.branches) - k)
            most = whole * (MOST_OF_OPENED if branch.opened.turns else SOLVE.branch_share)
            with limited(min(of_rest * budget_left(), most), of_rest * seconds_left()):
                box = box_of_branch(branched, k, self.request.domain.box)
                outcome = self._solved_branch(clocks[k], branch, box, share)
            if not outcome.slabs or outcome.status not in _SOLVED:
                raise _unresolved(search.named(branch.order), outcome)
            outcomes.append(outcome)
        check = BranchCheck(search, self.request, parted.orders, len(outcomes))
        with self.stages.of("check"):
            outcome, further = check.outcome(_joined(outcomes, branched), branched)
        return self._with_stages(outcome), further

    def _parted(self, search: OrderSearch) -> tuple[OrderSearch, Branches]:
        """The branches of a search, which tells roots apart where there are none otherwise."""
        with self.stages.of("reference"):
            try:
                return search, branches_of(search, self.request.rtol)
            except OrderError:
                if search.telling_roots.orders == search.orders:
                    raise
                search = search.telling_roots
                return search, branches_of(search, self.request.rtol)

    def _solved_branch(
        self, clock: Clock, branch: Branch, box: Sequence[Interval], share: float
    ) -> Outcome:
        """The outcome of one branch, which is solved over a box and constant beyond it."""
        request = self.request
        stretched = in_stretches(replace(clock, cuts=self.cuts))
        roots = tuple(map(tuple, branch.opened.root_bounds.tolist()))
        scales = (*request.domain.scales, *(LINEAR for _ in roots))
        domain = Domain(stretched.horizon, (*box, *roots), scales)
        tighter = replace(request, domain=domain, rtol=share * request.rtol)
        with self.stages.if_it_fails("reference"):
            outcome = self.solve(stretched, tighter)
        self.stages.add(outcome.timings, outcome.work)
        return replace(outcome, slabs=slabs_over(outcome.slabs, request.domain.box))

    def _timeline(
        self, parted: Branches, timelines: Sequence[Timeline], sizes: Array
    ) -> BranchedTimeline:
        """That of all branches, for states of some sizes (n,)."""
        rtol = self.request.rtol
        return BranchedTimeline(
            tuple(timelines),
            parted.guards,
            parted.forks,
            rtol,
            tuple((rtol * sizes).tolist()),
            0.0,
            parted.grazings,
            parted.openings,
        )

    def _with_stages(self, outcome: Outcome) -> Outcome:
        return replace(outcome, timings={**self.stages.timings}, work={**self.stages.work})

    def out_of_budget(self, out: OutOfBudgetError, reason: str) -> Outcome:
        """The outcome when a limit is met, with the reason for several orders."""
        status, notes, remedies, part = Status.of_limit(out), list[Note](), [REMEDY], None
        if (memory_needed := MemoryNeeded.of(out)) is not None:
            notes.append(memory_needed)
        if self.search is not None:
            reason = f"{reason}: {_largest_orders(self.search)}"
            with self.stages.of("reference"):
                _, part = remedy_of(self.search)
        if part is not None:
            names, bounds = self.timed.parameters, self.request.domain.bounds
            notes.append(box_of_one_order(names, bounds, part))
            remedies = []
        remedies = [*([_RAISED[status]] if status in _RAISED else []), *remedies]
        notes += [Remedy(", or ".join(remedies))] if remedies else []
        cause = OrderSearchLimit(reason)
        ended = Outcome((), status, None, (), {}, {}, cause=cause, notes=tuple(notes))
        return self._with_stages(ended)

    def refusal(self, failure: OrderError) -> OrderError | None:
        """The error, with a part of the box in which events come in one order as the remedy.

        None where that is the whole box.
        """
        if self.search is None:
            return failure
        search = self.search.telling_roots
        if len(search.groups()) == 1:
            return None
        with self.stages.of("reference"):
            remedy, part = remedy_of(search)
        return _limited_error(failure.message, failure.limit, remedy, part)


def _unresolved(order: str, outcome: Outcome) -> OrderError:
    """The error of a branch whose outcome is no success; its tolerance is not the user's."""
    status = outcome.status
    why = _SPENT.get(status) or f": {replace(outcome, notes=()).message}"
    message = f"{order}, which holds in a part of the box, is not resolved{why}"
    return _limited_error(message, status if status in _RAISED else None, REMEDY)


def _limited_error(
    message: str,
    limit: Status | None,
    remedy: str,
    part: tuple[Interval, ...] | None = None,
) -> OrderError:
    """The error of what is not solved, perhaps because a limit was reached."""
    raised = "" if limit is None else f"{_RAISED[limit]}, or "
    error = OrderError(message, remedy=raised + remedy)
    error.limit, error.part = limit, part
    return error


def _largest_orders(search: OrderSearch) -> str:
    """The two orders that hold in the largest parts of the box."""
    groups = sorted(search.groups().items(), key=lambda pair: -len(pair[1]))
    shares = [
        f"{search.named(order)} holds in about {_percent(places, search)} of the box"
        for order, places in groups[:2]
    ]
    return ", ".join(shares)


def _percent(places: NDArray[np.intp], search: OrderSearch) -> str:
    """The share of the points of a search at some positions."""
    return f"{100 * len(places) / len(search.points):.0f} %"


def _joined(outcomes: Sequence[Outcome], timeline: BranchedTimeline) -> Outcome:
    """The outcome of branches, each behind the one before."""
    history = tuple(record for outcome in outcomes for record in outcome.history)
    slabs = one_after_the_other(outcomes, timeline)
    return Outcome(slabs, Status.UNCHECKED, None, history, {}, {}, timeline=timeline)


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
