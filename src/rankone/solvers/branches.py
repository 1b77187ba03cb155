"""Solves where the order of events changes inside the box: each order is a branch of its own.

A branch is continued over the whole box with its order forced, so that it is smooth; where known
times alone tell in which part of the box it holds, over that part. Which one holds is decided by
the times of the events in which they differ, and by guards. The solution is then measured against
trajectories that follow their own order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rankone.ir.measures import LINEAR, Interval
from rankone.ir.outcome import Outcome
from rankone.ir.request import Domain, SolveRequest
from rankone.ir.system import Clock, System
from rankone.ir.timeline import BranchedTimeline, Timeline
from rankone.ir.verdict import MemoryNeeded, Note, OrderSearchLimit, Remedy, Status
from rankone.solution.branches import box_of_branch, slabs_over
from rankone.solvers.attempts import Stages, out_at_reference
from rankone.solvers.branch_check import MOST_MISSED, BranchCheck
from rankone.solvers.branching import MOST_OF_OPENED, Branch, Branches, branches_of
from rankone.solvers.one_order import box_of_one_order, remedy_of
from rankone.solvers.stretches import sizes_at_start, timed_system
from rankone.support.arrays import Array, spread
from rankone.support.budget import OutOfBudgetError, budget_left, limited, seconds_left
from rankone.tensors.slab import SlabTrain
from rankone.trajectories.choice import span_integrator_for
from rankone.trajectories.events.event_order import REMEDY, OrderError, TrajectoryEndError
from rankone.trajectories.events.orders import OrderSearch
from rankone.trajectories.events.stretches import in_stretches
from rankone.trajectories.integrator import Tolerances
from rankone.verification.coverage import Coverage
from rankone.verification.reference import reference_accuracy

_POINTS = 256  # Trajectories that tell the orders
_MOST_SOLVES = 4  # Solves of all branches: the check may meet further orders, or ask for accuracy
_MOST_OF_ONE = 0.08  # Share of the budget for one branch: where more is asked for, it is not smooth
_SHARES = (0.4, 0.1)  # Tolerances of the branches over that of the solve
_FLOOR = 1e-3  # Size of a state, over that at the start, below which accuracy is absolute
_INSIDE = 1e-4  # Distance of points from the faces of the box, in widths
_SOLVED = (Status.CONVERGED, Status.UNCHECKED)
_WIDTH = 1.0  # Width of what is undecided, over the tolerance

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
    chosen = span_integrator_for(timed, request.integrator, accuracy=accuracy)
    shares = spread(_POINTS, len(domain.box), np.random.default_rng(20143))
    points = Coverage.of_domain(domain).points(_INSIDE + (1.0 - 2.0 * _INSIDE) * shares)
    tolerances = Tolerances.down_to(accuracy, _FLOOR * sizes_at_start(timed, points))
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
        shares = [*_SHARES]
        for _ in range(_MOST_SOLVES):
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
            most = whole * (MOST_OF_OPENED if branch.opened.turns else _MOST_OF_ONE)
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
            _WIDTH * rtol,
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
    return f"{100.0 * len(places) / len(search.points):.0f} %"


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
