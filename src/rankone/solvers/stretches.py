"""Solves over stretches between events, in which all trajectories of a box meet their events."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rankone.ir.request import Domain, SolveRequest
from rankone.ir.system import Clock, System
from rankone.support.arrays import Array
from rankone.trajectories.choice import span_integrator_for
from rankone.trajectories.events.event_order import event_order
from rankone.trajectories.events.stretches import in_stretches, timed_events
from rankone.trajectories.integrator import Tolerances
from rankone.verification.cuts import system_cuts
from rankone.verification.points import check_points

_PILOTS = 16  # Trajectories, besides corners, that tell the order of events
_PILOT_RTOL = 1e-6  # Their relative tolerance
_PILOT_FLOOR = 1e-6  # Size of a state, over that at the start, below which accuracy is absolute


def clock_of(system: System, request: SolveRequest, more: int = 0) -> Clock:
    """The clock of a system with events, after some trajectories.

    Other trajectories may meet so many ``more`` events before the end of the horizon.

    Raises
    ------
    OrderError
        If the trajectories do not meet the same events in the same order.
    """
    domain = request.domain
    timed, cuts = timed_system(system, domain)
    points, tolerances = pilots(system, domain, _PILOT_RTOL)
    chosen = span_integrator_for(timed, request.integrator, accuracy=_PILOT_RTOL)
    order = event_order(timed, points, domain.horizon, chosen, tolerances, more)
    return Clock(timed, order, domain.horizon, cuts)


def timed_system(system: System, domain: Domain) -> tuple[System, tuple[float, ...]]:
    """The system with all that happens at known times as events, and the cuts of its time."""
    in_time, *_ = system_cuts(system, domain)
    cuts = tuple(cut for cut in in_time.points if domain.horizon[0] < cut < domain.horizon[1])
    return timed_events(system, cuts), cuts


def pilots(system: System, domain: Domain, rtol: float) -> tuple[Array, Tolerances]:
    """Points (m, d) of trajectories that tell the order of events, and their tolerances."""
    points = check_points(domain.bounds, _PILOTS, every_corner=True, scales=domain.coordinates)
    return points, Tolerances.down_to(rtol, _PILOT_FLOOR * sizes_at_start(system, points))


def sizes_at_start(system: System, points: Array) -> Array:
    """The largest initial values of the states at points (m, d), (n, 1); none of them is zero."""
    largest = np.abs(system.initial(np.ascontiguousarray(points.T))).max(axis=1, keepdims=True)
    return np.where(largest > 0.0, largest, largest.max(initial=0.0) or 1.0)


def over_stretches(clock: Clock, request: SolveRequest) -> tuple[System, SolveRequest]:
    """The system and the request over the pseudo-time of its stretches."""
    domain, separated = request.domain, clock.system.separated_stretches
    system = in_stretches(clock) if separated is None else separated(clock, domain.box)
    domain = Domain(system.horizon, domain.box, domain.scales)
    return system, replace(request, domain=domain, observed=None)
