"""The check of a solve in branches, against trajectories that follow their own order of events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.ir.outcome import Measured, Outcome
from rankone.ir.request import SolveRequest
from rankone.ir.timeline import BranchedTimeline
from rankone.ir.verdict import (
    HiddenEvent,
    HiddenRate,
    MeasuredError,
    Note,
    Remedy,
    SharedUnit,
    Status,
    UndecidedOrder,
    UndecidedShare,
)
from rankone.solution.branches import branch_evaluator
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError
from rankone.tensors.branches import BranchEvaluator
from rankone.trajectories.events.event_order import REMEDY
from rankone.trajectories.events.orders import Order, OrderSearch
from rankone.verification.branches import (
    MOST_UNDECIDED,
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
        known = [self._is_known(order.at_any_roots) for order in checked.orders]
        others = ~np.array(known, dtype=bool)
        if (others & errors.decided).any():
            return joined, points[others & errors.decided]
        sizes = np.delete(errors.largest, slice(1, 1 + corners), axis=1).max(axis=1)
        added = checked.system.tolerances(sizes)[:, None] / rtol
        measured = _measured(errors, self.request, points, corners, added)
        undecided = undecided_share(evaluator, Coverage.of_domain(self.request.domain))
        judged = _judged(joined, timeline, measured, undecided, rtol)
        shared = SharedUnit.of(checked.system, sizes, rtol, self.request.check.states)
        judged = replace(judged, notes=(*judged.notes, *shared))
        if judged.status is Status.CONVERGED:
            judged = _looked_at(judged, checked, rtol)
        if judged.status is Status.TOLERANCE:  # by other orders, where events nearly coincide
            return judged, points[others & _is_wrong(errors, rtol, added)]
        return judged, nothing

    def _is_known(self, order: Order) -> bool:
        """Whether an order is one of those that are known, or goes on as one."""
        known = [each.at_any_roots for each in self.orders]
        return any(order == each or order.begins(each) for each in known)

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
        quantile=float(np.quantile(of_points, SAFE_QUANTILE, method="higher")),
        worst=tuple(points[counts][np.argmax(of_points)].tolist()),
        counted=counted,
        time_error=errors.time,
    )
