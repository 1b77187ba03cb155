"""States that are numerically zero: rounding errors of their rates are larger than they are.

Such is what stays constant but for rounding, less that constant, and all it drives. An integration
to a part of the size of such a state follows rounding errors with steps that shrink without end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.trajectories.integration import Stack

__all__ = ["Rounding", "rounding_errors"]

_SEVERAL = 16.0
"""Relative error of computed states, in units of the last place, after many steps."""
_TINY = 1e-6
"""Size of a state over the largest one up to which it is looked at."""
_RESOLVED = 1e-7
"""Part of its size below which what is done to another state does not count."""
_DRAWS = 4
"""Rounding errors drawn at each time for each trajectory."""
_AMPLIFIED = 5.0
"""Growth over the horizon, as a power of e, from which errors in small states are amplified."""


@dataclass(frozen=True)
class Rounding:
    """Rounding errors of the states of a stack.

    Attributes
    ----------
    floor : ndarray (n, 1)
        Errors of tiny states below which an integration follows rounding errors; 0 for all others.
    zero : ndarray of bool (n, 1)
        The states that are numerically zero.
    """

    floor: Array
    zero: NDArray[np.bool_]


def rounding_errors(
    stack: Stack, looks: Sequence[tuple[float, Array]], largest: Array, rtol: float
) -> Rounding:
    """What rounding errors make of the states that are tiny beside the others.

    The error of a state is the change of its rate under relative errors of rounding in all states,
    over the time for which the state remembers it. A state that never exceeds several times that is
    numerically zero. Its errors are errors of the states that it drives, which may be so too. One
    that changes another state by more than a part ``rtol`` of it, at the time, is not.

    Parameters
    ----------
    stack : Stack
    looks : sequence of (float, ndarray (n, m))
        Times, and the states of all trajectories then.
    largest : ndarray (n, 1)
        Largest absolute value of each state.
    rtol : float
        Relative tolerance of the integration.
    """
    tiny = (largest <= _TINY * largest.max(initial=0.0)) & (largest > 0.0)
    zero, errors = np.zeros_like(tiny), np.zeros_like(largest)
    if not tiny.any():
        return Rounding(errors, zero)
    probes = [_Probe(stack, time, states, largest, rtol) for time, states in looks]
    for _ in range(len(largest)):  # errors spread from state to state
        errors = np.max([probe.errors(np.where(zero, errors, 0.0)) for probe in probes], axis=0)
        more = tiny & (largest <= errors)
        if (more == zero).all():
            break
        zero = more
    while zero.any():  # those that matter to what is not zero, then those that matter to them
        matters = np.any([probe.matters(np.where(zero, errors, 0.0)) for probe in probes], axis=0)
        if not (zero & matters).any():
            break
        zero &= ~matters
    steady = max(probe.growth() for probe in probes) <= _AMPLIFIED
    floor = np.where(tiny & steady, errors / _SEVERAL, 0.0)
    return Rounding(np.where(zero, errors, floor), zero)


class _Probe:
    """The rates and their Jacobian at a time, at states (n, m)."""

    def __init__(
        self, stack: Stack, time: float, states: Array, largest: Array, rtol: float
    ) -> None:
        self.stack, self.time, self.states = stack, time, states
        self.parameters = np.ascontiguousarray(stack.points.T)
        with np.errstate(all="ignore"):
            self.rates = stack.system.rhs(time, states, self.parameters)
            blocks = np.nan_to_num(stack.jacobians(time, states))
        self.first, jacobian = blocks[0], np.abs(blocks)
        diagonal = np.diagonal(jacobian, axis1=1, axis2=2).T
        self.horizon = stack.edges[-1] - stack.edges[0]
        self.memory = 1.0 / (diagonal + 1.0 / self.horizon)
        self.jacobian = jacobian * (1.0 - np.eye(len(states)))
        self.tolerated = rtol * (np.abs(states) + _RESOLVED * largest)

    def growth(self) -> float:
        """By what power of e small values of the first trajectory may grow over the horizon."""
        return float(np.linalg.eigvals(self.first).real.max()) * self.horizon

    def errors(self, known: Array) -> Array:
        """What rounding errors, and errors (n, 1) in some states, make of each state, (n, 1).

        A state that does not change has no rounding errors.
        """
        rounded = _SEVERAL * np.finfo(float).eps * np.abs(self.states) * (self.rates != 0.0)
        sizes = np.maximum(rounded, known)
        generator = np.random.default_rng(20143)
        worst = np.zeros_like(self.states)
        with np.errstate(all="ignore"):
            for _ in range(_DRAWS):
                states = self.states + sizes * generator.uniform(-1.0, 1.0, sizes.shape)
                changed = self.stack.system.rhs(self.time, states, self.parameters)
                worst = np.fmax(worst, np.abs(changed - self.rates))
        return np.asarray((worst * self.memory).max(axis=1, keepdims=True))

    def matters(self, known: Array) -> Array:
        """Whether errors (n, 1) in some states change one of the others, (n, 1)."""
        driven = self.jacobian * known[None, None, :, 0] * self.memory.T[:, :, None]
        counts = (driven > self.tolerated.T[:, :, None]) & (known[None, :, :] == 0.0)
        return np.asarray(counts.any(axis=(0, 1))[:, None])
