"""Starts at the steady state of other conditions: the initial values of a system that has one.

They are found by trajectories under these conditions at every parameter point, and kept.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import BlowUpError, ConvergenceError
from rankone.trajectories.steady.bifurcations import check_one_branch
from rankone.trajectories.steady.rest import SteadyStates
from rankone.trajectories.system.constraints import Constraints
from rankone.trajectories.system.features import Features, Jumps, VectorLike
from rankone.trajectories.system.system import Rest, System

_SUBJECT = "the start is a steady state"
_OTHERWISE = "; or change `conditions` or `start` of SteadyState"


class RestingStart:
    """The states at which trajectories start, as a function of the parameters."""

    def __init__(self, system: System, rest: Rest) -> None:
        self.time, self.after = system.horizon[0], rest.after
        before = before_start(system, rest)
        self.steady = SteadyStates(before, *rest.settle, stable_only=True)

    def __call__(self, p: VectorLike) -> Array:
        """The states (n, m) at parameters p (d, m); a ConvergenceError if there are none."""
        try:
            states = self.steady(p)
        except (ConvergenceError, BlowUpError) as error:
            message = f"{_SUBJECT}: under its conditions {error.message}"
            raise ConvergenceError(message, remedy=f"{error.remedy}{_OTHERWISE}") from None
        return states if self.after is None else self.after(self.time, states, np.asarray(p))

    def check(self, points: Array) -> None:
        """Raise a ConvergenceError unless the starts at points (m, d) are on one branch."""
        try:
            check_one_branch(self.steady, points)
        except (ConvergenceError, BlowUpError) as error:
            message, remedy = f"{_SUBJECT}: {error.message}", f"{error.remedy}{_OTHERWISE}"
            raise ConvergenceError(message, remedy=remedy, bifurcation=error.bifurcation) from None


def before_start(system: System, rest: Rest) -> System:
    """The system before the start of a system, over the longest time that it may take."""
    n = system.n_differential - system.n_lifted - system.n_sides
    start = system.horizon[0]
    return replace(
        system.starting_at(rest.initial),
        separated=False,
        states=system.states[:n],
        n_differential=n,
        n_lifted=0,
        n_sides=0,
        products=(),
        horizon=(start, start + rest.settle[1]),
        terms=(),
        rhs=rest.rhs,
        jacobian=rest.jacobian,
        features=Features(((),) * (1 + len(system.box)), ((),) * (1 + len(system.box))),
        jumps=Jumps(),
        events=(),
        constraints=Constraints(),
        held=None,
        specification=None,
    )


def started(system: System) -> System:
    """The system with its start, where that is a steady state."""
    if system.rest is None:
        return system
    return replace(system, at_rest=RestingStart(system, system.rest))
