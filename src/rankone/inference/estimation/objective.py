"""Objectives and constraints of a minimisation, as functions on a unit cube with derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from rankone.inference.estimation.fitted_models import model_of
from rankone.inference.estimation.free_parameters import FreeParameters
from rankone.inference.estimation.observations import checked_times, state_name
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import quote, shown

Number = float | Array
"""A state at one time, or at several."""
ObjectiveFunction = Callable[[dict[str, Any], dict[str, float]], float]
"""A function of states and of parameters, both by name."""
Limits = Mapping[Any, Sequence[ArrayLike | None]] | None
"""For unknowns, names or symbols, lower and upper limits, and perhaps times."""

_NUMBERS_AT_ONCE = 2_000_000  # Numbers of states that are held together, 16 MB
# Step of differences along a tangent, in widths of the cube: truncation near rounding
_DIFFERENCE_STEP = 1e-6


class States:
    """Some states at times, for one point z of the cube, with derivatives."""

    def __init__(
        self, solution: SolutionCore, names: Sequence[str], times: Array, free: FreeParameters
    ) -> None:
        self.names, self.times, self.free = tuple(names), times, free
        rows = np.array([solution.states.index(name) for name in names], dtype=np.intp)
        self._shape = (rows.size, times.size)
        at = np.repeat(rows, times.size), np.tile(times, rows.size)
        self._model = model_of(solution, *at)

    def __call__(self, z: Array) -> tuple[Array, Array]:
        """Values (states, times) and derivatives (states, times, n) with respect to z."""
        points = self.free.points(z[None])
        states, slopes = self._model.linearised(points, self.free.positions)
        slopes = slopes[0].reshape(*self._shape, -1) * self.free.slopes(z)
        return states[0].reshape(self._shape), slopes

    def many(self, z: Array) -> Iterator[Array]:
        """Values (states, times) at points (N, n), one after the other."""
        size = max(_NUMBERS_AT_ONCE // max(math.prod(self._shape), 1), 1)
        for begin in range(0, len(z), size):
            points = self.free.points(z[begin : begin + size])
            yield from self._model.values(points).reshape(-1, *self._shape)


@dataclass(frozen=True)
class Constraint:
    """One unknown between limits (times,) at times."""

    states: States
    lower: Array
    upper: Array
    scale: float

    def margins(self, z: Array) -> Array:
        """Scaled distances to the limits, (k,): negative where they are missed."""
        return self._inside(self.states(z)[0][0])

    def slopes(self, z: Array) -> Array:
        """Derivatives of the margins, (k, n)."""
        slope = self.states(z)[1][0] / self.scale
        return np.concatenate([slope[np.isfinite(self.lower)], -slope[np.isfinite(self.upper)]])

    def missed(self, z: Array) -> Array:
        """Sums over the limits of how far they are missed at points (N, n): shape (N,)."""
        rows = self.states.many(z)
        return np.array([-np.minimum(self._inside(row[0]), 0.0).sum() for row in rows])

    def _inside(self, row: Array) -> Array:
        below, above = np.isfinite(self.lower), np.isfinite(self.upper)
        low, high = (row - self.lower)[below], (self.upper - row)[above]
        return np.asarray(np.concatenate([low, high]) / self.scale)


class Objective:
    """The objective on the cube, scaled, with a sign such that it is minimised."""

    def __init__(
        self, states: States, function: ObjectiveFunction | None, sign: float, one: bool
    ) -> None:
        self.states, self.function, self.sign, self.one = states, function, sign, one
        self.scale, self.evaluations = 1.0, 0

    def named(self, states: Array) -> dict[str, Number]:
        """Values (states, times) by name; numbers if there is one time."""
        pairs = zip(self.states.names, states, strict=True)
        return {name: float(row[0]) if self.one else row for name, row in pairs}

    def at(self, states: Array, z: Array, inside: bool = True) -> float:
        """The objective for states (states, times) at z, which may be outside the cube."""
        if self.function is None:
            return float(states[0, 0])
        free = self.states.free
        point = free.values(z) if inside else free.unclipped(z)
        x = free.complete(dict(zip(free.names, map(float, point), strict=True)))
        objective = self.function(self.named(states), x)
        try:
            return float(objective)
        except (TypeError, ValueError):
            raise OptionError(
                f"the objective gives {shown(objective)}, not a number", term=objective
            ) from None

    def many(self, z: Array) -> Array:
        """The objective at points (N, n), unscaled and with its own sign."""
        return np.array([self.at(v, one) for v, one in zip(self.states.many(z), z, strict=True)])

    def __call__(self, z: Array) -> tuple[float, Array]:
        """Scaled value and gradient (n,)."""
        self.evaluations += 1
        states, slopes = self.states(z)
        factor = self.sign / self.scale
        if self.function is None:
            return factor * float(states[0, 0]), factor * slopes[0, 0]
        gradient = np.empty(z.size)
        for j in range(z.size):  # along the tangent: the unknowns move with the parameter
            step = np.zeros(z.size)
            step[j] = _DIFFERENCE_STEP
            change = slopes[:, :, j] * _DIFFERENCE_STEP
            ahead = self.at(states + change, z + step, inside=False)
            behind = self.at(states - change, z - step, inside=False)
            gradient[j] = (ahead - behind) / (2.0 * _DIFFERENCE_STEP)
        return factor * self.at(states, z), factor * gradient


def constraints_of(
    solution: SolutionCore, given: Limits, t: ArrayLike | None, free: FreeParameters, points: Array
) -> list[Constraint]:
    """Checked limits of unknowns, scaled by the range of each unknown over points (N, n)."""
    if not isinstance(given, Mapping | None):
        raise OptionError(
            f"constraints={given!r} is not a mapping from unknowns to limits",
            term=given,
            remedy="give {unknown: (lower, upper)} or {unknown: (lower, upper, times)}",
        )
    constraints = []
    for key, limits in (given or {}).items():
        name = state_name(solution, key)
        if not isinstance(limits, list | tuple) or len(limits) not in (2, 3):
            raise OptionError(
                f"the limits of {quote(name)} are {shown(limits)}",
                term=limits,
                remedy="give (lower, upper) or (lower, upper, times); None for no limit",
            )
        times = checked_times(solution, limits[2] if len(limits) == 3 else t)
        states = States(solution, [name], times, free)
        lower = _limit(name, limits[0], -math.inf, times.size)
        upper = _limit(name, limits[1], math.inf, times.size)
        if not (lower <= upper).all() or not np.isfinite([lower, upper]).any():
            raise OptionError(
                f"the limits of {quote(name)} leave nothing, or everything",
                term=limits,
                remedy="give a lower limit that is not above the upper one",
            )
        scale = float(np.ptp(list(states.many(points)))) or 1.0
        constraints.append(Constraint(states, lower, upper, scale))
    return constraints


def _limit(name: str, given: ArrayLike | None, none: float, size: int) -> Array:
    """One limit for each time."""
    try:
        array = np.asarray(none if given is None else given, dtype=float)
        if not np.isnan(array).any():
            return np.array(np.broadcast_to(array, size))
    except (TypeError, ValueError):
        pass
    raise OptionError(
        f"a limit of {quote(name)} is {shown(given)}, not a number, nor one for each of "
        f"{size} times",
        term=given,
    )


def is_function(objective: object) -> TypeGuard[ObjectiveFunction]:
    """Whether an objective is a function of values, and no name or symbol of an unknown."""
    symbolic = hasattr(objective, "free_symbols") or hasattr(objective, "derivative_count")
    if symbolic or isinstance(objective, str):
        return False
    if callable(objective):
        return True
    raise OptionError(
        f"the objective {shown(objective)} is neither an unknown nor a function",
        term=objective,
        remedy="name an unknown, or give a function of `values` and `parameters`",
    )
