"""The free parameters, their bounds, and the start of a search."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.solution.core import SolutionCore
from rankone.statistics.joint_distribution import by_name
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote

ParameterValues = Mapping[Any, float] | None
"""Values by parameter, a name or a symbol."""
Bounds = Mapping[Any, tuple[float, float]] | None
"""Intervals by parameter, a name or a symbol."""

BOUND_TOLERANCE = 1e-9
"""Distance from a bound, in widths of the interval, that counts as at the bound: rounding."""


@dataclass(frozen=True)
class FreeParameters:
    """The free parameters as coordinates z of a unit cube.

    ``positions`` are their places among all parameters of the solution, whose names are ``order``.
    ``lower`` and ``upper`` (n,) have the unit of each parameter; the start of a search is in z.
    """

    names: tuple[str, ...]
    positions: tuple[int, ...]
    lower: Array
    upper: Array
    fixed: dict[str, float]
    order: tuple[str, ...]
    start: Array | None

    @property
    def width(self) -> Array:
        """Lengths of the intervals (n,)."""
        return self.upper - self.lower

    def values(self, z: Array) -> Array:
        """Values (..., n) of the free parameters at z (..., n)."""
        return np.clip(self.lower + self.width * z, self.lower, self.upper)

    def points(self, z: Array) -> Array:
        """All parameters (d, N) at z (N, n)."""
        points = np.empty((len(self.order), len(z)))
        for j, name in enumerate(self.order):
            points[j] = self.fixed.get(name, 0.0)
        points[list(self.positions)] = self.values(z).T
        return points

    def named(self, z: Array) -> dict[str, float]:
        """The free parameters at z (n,), by name."""
        return dict(zip(self.names, map(float, self.values(z)), strict=True))

    def index(self, parameter: object) -> int:
        """Position of a free parameter among the names; an OptionError if it is not free."""
        name = name_of(parameter)
        if name not in self.names:
            raise OptionError(
                f"{quote(name)} is not a free parameter{did_you_mean(name, self.names)}",
                term=parameter,
                remedy=f"choose from {listing(self.names)}",
            )
        return self.names.index(name)

    def at_bounds(self, z: Array) -> dict[str, str]:
        """Parameters that are at the ``"lower"`` or ``"upper"`` end of their bounds at z (n,)."""
        ends = zip(self.names, z, strict=True)
        return {
            name: "lower" if x < 0.5 else "upper"
            for name, x in ends
            if min(x, 1.0 - x) <= BOUND_TOLERANCE
        }

    def complete(self, free: Mapping[str, float]) -> dict[str, float]:
        """All parameters by name, in their order, for values of the free ones."""
        return {name: free[name] if name in free else self.fixed[name] for name in self.order}


def free_parameters(
    solution: SolutionCore,
    fixed: ParameterValues = None,
    bounds: Bounds = None,
    start: ParameterValues = None,
) -> FreeParameters:
    """Check what is fixed, the bounds and the start."""
    order = tuple(solution.parameters)
    held = {name: _in_box(solution, name, x) for name, x in by_name("fixed", fixed, order).items()}
    names = tuple(name for name in order if name not in held)
    if not names:
        reason = "all parameters are fixed" if order else "the solution has no parameters"
        raise OptionError(reason, term=fixed, remedy="leave one of them free")
    box = {name: solution.parameters[name] for name in names}
    for name, interval in by_name("bounds", bounds, order).items():
        if name in held:
            raise OptionError(f"{quote(name)} is fixed, and has bounds", term=name)
        box[name] = _interval(solution, name, interval)
    lower, upper = np.array(list(box.values())).T
    return FreeParameters(
        names=names,
        positions=tuple(order.index(name) for name in names),
        lower=lower,
        upper=upper,
        fixed=held,
        order=order,
        start=None if start is None else _start(solution, held, box, start),
    )


def _start(
    solution: SolutionCore,
    held: Mapping[str, float],
    box: Mapping[str, tuple[float, float]],
    start: ParameterValues,
) -> Array:
    """The start in the unit cube; the middle for parameters without one."""
    z = dict.fromkeys(box, 0.5)
    for name, entry in by_name("start", start, tuple(solution.parameters)).items():
        if name in held:
            raise OptionError(f"{quote(name)} is fixed, and has a start", term=name)
        x, (lower, upper) = _in_box(solution, name, entry), box[name]
        if not lower <= x <= upper:
            raise OptionError(
                f"the start {quote(name)} = {x:g} is outside its bounds [{lower:g}, {upper:g}]",
                term=entry,
                remedy="start inside",
            )
        z[name] = (x - lower) / (upper - lower)
    return np.array(list(z.values()))


def _in_box(solution: SolutionCore, name: str, given: object) -> float:
    """One value of a parameter inside of the box."""
    position = solution.metadata.parameters.index(name) + 1
    array = solution._coordinates.checked(position, given)
    if array.ndim:
        raise OptionError(f"{quote(name)} is {given!r}, not a number", term=given)
    return float(array)


def _interval(solution: SolutionCore, name: str, interval: Any) -> tuple[float, float]:
    """Bounds inside of the box."""
    try:
        low, high = interval
    except (TypeError, ValueError):
        raise OptionError(
            f"the bounds of {quote(name)} are {interval!r}, not a pair of numbers", term=interval
        ) from None
    lower, upper = _in_box(solution, name, low), _in_box(solution, name, high)
    if not lower < upper:
        raise OptionError(
            f"the bounds ({lower:g}, {upper:g}) of {quote(name)} do not ascend",
            term=interval,
            remedy="give (lower, upper), or fix a single value" if lower == upper else None,
        )
    return lower, upper
