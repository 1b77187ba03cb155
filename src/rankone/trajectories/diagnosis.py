"""What trajectories show: why they end, and which states are numerically zero.

A state is numerically zero if rounding errors of its rate are larger than the state: for example
the difference of two numbers that stay equal except for rounding, and all that it drives. An
integration that resolves such a state follows rounding errors, with steps that shrink without end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.trajectories.integrator import jacobians
from rankone.trajectories.spectra import first_jacobian, growth_rate
from rankone.trajectories.stacks.newton import entries_at, sparse_pattern

_STATE_CHANGES = (0.0, 1e-12, 1e-9, 1e-6, 1e-4)  # Relative, until rates are not finite
_JUMP_STEPS = (1e-13, 1e-11, 1e-9, 1e-7, 1e-5)  # In horizons; rates may jump over one
_TINY_STEPS = (1e-15, 1e-14, 1e-12)  # In horizons; beside a pole rates differ after them
_LITTLE_CHANGE = 0.3  # Of a rate over such a step, over its size
_RUNAWAY_GROWTH = 1e6  # Growth over a horizon, at the last rate, from which a state blows up
_LATER_STATE = 1.0001  # Factor on a state for a later one: beside a pole the rate differs there
_SEVERAL_ROUNDINGS = 16.0  # Relative error of states after many steps, in last places
_TINY_STATE = 1e-6  # Size of a state, over the largest one, up to which it may be numerically zero
_RESOLVED = 1e-7  # Part of its size below which a change of a state does not count
_DRAWS = 4  # Random rounding errors at each time; the largest effect counts
MOST_GROWTH = 5.0  # Growth over the horizon, as a power of e, from which small states are amplified


def switching_state(
    system: System, time: float, states: Array, points: Array, horizon: float
) -> tuple[int, int] | None:
    """The state whose rate jumps most where a trajectory is pushed back, and the trajectory.

    A trajectory chatters if a short step takes it across a state surface, and a step with the rates
    there takes it back. The states are (n, m), the points (m, d).
    """
    if not system.features.n_state_surfaces:
        return None
    surfaces = system.features.state_surfaces
    parameters = np.ascontiguousarray(points.T)
    with np.errstate(all="ignore"):
        rates = system.rhs(time, states, parameters)
        before = surfaces(time, states, parameters)
        for step in _JUMP_STEPS:
            ahead = states + step * horizon * rates
            across = surfaces(time, ahead, parameters)
            back = system.rhs(time, ahead, parameters)
            after = surfaces(time, ahead + step * horizon * back, parameters)
            crossed = (before * across <= 0.0) & (across != before)
            returns = (crossed & ((after - across) * (across - before) < 0.0)).any(axis=0)
            if returns.any():
                column = int(np.argmax(returns))
                jump = np.abs(back - rates)[:, column]
                return int(np.argmax(jump)), column
    return None


def first_to_end(system: System, time: float, state: Array, points: Array, floor: Array) -> int:
    """The trajectory of a stack, state (n, m) at points (m, d), that ends first.

    The one whose rates cease to be finite first, or else the one that changes fastest relative to
    its size; states below ``floor`` (n, 1) count as that size.
    """
    with np.errstate(all="ignore"):
        rates = system.rhs(time, state, points.T)
        for change in _STATE_CHANGES:
            later = system.rhs(time, state + change * np.abs(state) * np.sign(rates), points.T)
            lost = ~np.isfinite(later).all(axis=0)
            if lost.any():
                return int(np.argmax(lost))
        speeds = np.abs(rates) / np.maximum(np.abs(state), floor)
    return int(np.argmax(np.nan_to_num(speeds, nan=np.inf).max(axis=0)))


def runs_away(system: System, time: float, state: Array, point: Array, horizon: float) -> bool:
    """Whether a state grows at an enormous rate without a pole: shortly after, it is as large."""
    with np.errstate(all="ignore"):
        now, later = (
            system.rhs(time, factor * state[:, None], point[:, None])
            for factor in (1.0, _LATER_STATE)
        )
        fast = now[:, 0] * np.sign(state) * horizon > _RUNAWAY_GROWTH * np.abs(state)
        return bool((fast & (later / now > 0.5)[:, 0] & (later / now < 2.0)[:, 0]).any())


def is_regular(
    system: System, time: float, state: Array, size: Array, point: Array, horizon: float
) -> bool:
    """Whether rates ahead are finite, and change little within a tiny way but where they switch.

    States (n,) are of some ``size`` (n, 1).
    """
    surfaces, parameters, states = system.features.state_surfaces, point[:, None], state[:, None]
    with np.errstate(all="ignore"):
        rates = system.rhs(time, states, parameters)
        for change in _STATE_CHANGES:
            near = states + change * size * np.sign(rates)
            if not np.isfinite(system.rhs(time, near, parameters)).all():
                return False
        before = surfaces(time, states, parameters)
        for step in _TINY_STEPS:
            later, ahead = time + step * horizon, states + step * horizon * rates
            there = system.rhs(later, ahead, parameters)
            across = surfaces(later, ahead, parameters)
            crossed = ((before * across <= 0.0) & (across != before)).any()
            difference = np.abs(there - rates)
            changed = difference > _LITTLE_CHANGE * np.maximum(np.abs(rates), np.abs(there))
            changed &= difference * horizon > np.abs(ahead)
            if not np.isfinite(there).all() or (changed.any() and not crossed):
                return False
    return True


@dataclass(frozen=True)
class Rounding:
    """Rounding errors of the states of a stack, (n, 1), and which are numerically ``zero``.

    Below the ``floor`` of a tiny state an integration follows rounding errors; 0 for all others,
    and where the state is always large enough beside its errors.
    """

    floor: Array
    zero: NDArray[np.bool_]


def rounding_errors(
    system: System,
    points: Array,
    horizon: float,
    samples: Sequence[tuple[float, Array]],
    largest: Array,
    rtol: float,
) -> Rounding:
    """What rounding errors make of the states that are tiny beside the others.

    The error of a state is the change of its rate under relative errors of rounding in all states,
    over the time for which the state remembers it. A state that never exceeds several times that is
    numerically zero. Its errors are errors of the states that it drives, which may be so too. One
    that changes another state by more than a part ``rtol`` of it, at the time, is not.

    The samples are times with the states (n, m) of all trajectories, at points (m, d); ``largest``
    (n, 1) is the largest absolute value of each state.
    """
    tiny = (largest <= _TINY_STATE * largest.max(initial=0.0)) & (largest > 0.0)
    zero, errors = np.zeros_like(tiny), np.zeros_like(largest)
    if not tiny.any():
        return Rounding(errors, zero)
    probes = [_Probe(system, points, horizon, *sample, largest, rtol) for sample in samples]
    for _ in range(len(largest)):  # errors spread from state to state
        by_probe = [probe.errors(np.where(zero, errors, 0.0)) for probe in probes]
        errors = np.max(by_probe, axis=(0, 2))[:, None]
        below = tiny & (largest <= errors)
        if (below == zero).all():
            break
        zero = below
    while zero.any():  # those that matter to what is not zero, then those that matter to them
        matters = np.any([probe.matters(np.where(zero, errors, 0.0)) for probe in probes], axis=0)
        if not (zero & matters).any():
            break
        zero &= ~matters
    steady = max(probe.growth for probe in probes) <= MOST_GROWTH
    followed = [probe.followed(errors) for probe, errors in zip(probes, by_probe, strict=True)]
    noise = np.max(followed, axis=(0, 2))[:, None]
    floor = np.where(tiny & steady, noise / _SEVERAL_ROUNDINGS, 0.0)
    return Rounding(np.where(zero, errors, floor), zero)


class _Probe:
    """The rates and their Jacobians at a time, at states (n, m)."""

    def __init__(
        self,
        system: System,
        points: Array,
        horizon: float,
        time: float,
        states: Array,
        largest: Array,
        rtol: float,
    ) -> None:
        self.system, self.time, self.states, self.rtol = system, time, states, rtol
        self.parameters = np.ascontiguousarray(points.T)
        with np.errstate(all="ignore"):
            self.rates = system.rhs(time, states, self.parameters)
        first = first_jacobian(system, points, time, states)
        self.growth = 0.0 if first is None else growth_rate(first, MOST_GROWTH / horizon) * horizon
        self.rows, self.columns, sizes = _sizes_of_entries(system, points, time, states)
        decay = np.zeros_like(states)
        own = self.rows == self.columns
        decay[self.rows[own]] = sizes[own]
        self.memory = 1.0 / (decay + 1.0 / horizon)
        self.couplings = np.where(own[:, None], 0.0, sizes)
        self.tolerated = rtol * (np.abs(states) + _RESOLVED * largest)

    def errors(self, zero_errors: Array) -> Array:
        """What rounding errors, and errors (n, 1) of some states, make of each state, (n, m).

        A state that does not change has no rounding errors.
        """
        rounded = _SEVERAL_ROUNDINGS * np.finfo(float).eps * np.abs(self.states)
        sizes = np.maximum(rounded * (self.rates != 0.0), zero_errors)
        generator = np.random.default_rng(20143)
        worst = np.zeros_like(self.states)
        with np.errstate(all="ignore"):
            for _ in range(_DRAWS):
                states = self.states + sizes * generator.uniform(-1.0, 1.0, sizes.shape)
                changed = self.system.rhs(self.time, states, self.parameters)
                worst = np.fmax(worst, np.abs(changed - self.rates))
        return np.asarray(worst * self.memory)

    def followed(self, errors: Array) -> Array:
        """Those of the errors (n, m) that an integration follows: steps do not resolve others."""
        return np.where(errors > self.rtol * np.abs(self.states), errors, 0.0)

    def matters(self, zero_errors: Array) -> Array:
        """Whether errors (n, 1) of some states change one of the others, (n, 1)."""
        driven = self.couplings * zero_errors[self.columns] * self.memory[self.rows]
        counts = (driven > self.tolerated[self.rows]) & (zero_errors[self.rows] == 0.0)
        matters = np.zeros(len(zero_errors), dtype=bool)
        matters[self.columns[counts.any(axis=1)]] = True
        return matters[:, None]


def _sizes_of_entries(
    system: System, points: Array, time: float, states: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Rows and columns (k,) of the Jacobians at states (n, m), and absolute values (k, m)."""
    pattern, n = sparse_pattern(system), len(states)
    with np.errstate(all="ignore"):
        if pattern is not None:
            entries = entries_at(system, pattern, points, time, states)
            return pattern.rows, pattern.columns, np.abs(entries)
        blocks = np.abs(np.nan_to_num(jacobians(system, points, time, states)))
    return *np.divmod(np.arange(n * n), n), blocks.reshape(len(points), -1).T
