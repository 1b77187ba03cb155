"""The free parameters, their bounds and scales, and the start of a search."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import NEGLIGIBLE, Array
from rankone.support.errors import OptionError, did_you_mean, listing, quote, shown
from rankone.tensors.coordinates import LOG, name_of
from rankone.tensors.distributions import scale_of
from rankone.tensors.joint_distribution import by_name

ParameterValues = Mapping[Any, float] | None
"""Values by parameter, a name or a symbol."""
Bounds = Mapping[Any, tuple[float | str, ...]] | None
"""Intervals by parameter, a name or a symbol; ``(lower, upper, "log")`` over decades."""


class Range(NamedTuple):
    """The interval of a parameter, and whether its logarithm is the coordinate of a search."""

    lower: float
    upper: float
    logarithmic: bool = False


@dataclass(frozen=True)
class FreeParameters:
    """The free parameters as coordinates z of a unit cube.

    ``positions`` are their places among all parameters, whose names are ``order``. ``lower`` and
    ``upper`` (n,) have the unit of each parameter; the start of a search is in z. The coordinate
    of a ``logarithmic`` parameter is its logarithm. ``endless`` are the positions of parameters
    that have no bounds of their own: theirs are those of the search.
    """

    names: tuple[str, ...]
    positions: tuple[int, ...]
    lower: Array
    upper: Array
    fixed: dict[str, float]
    order: tuple[str, ...]
    start: Array | None
    logarithmic: tuple[bool, ...]
    endless: tuple[int, ...] = ()

    @property
    def width(self) -> Array:
        """Lengths of the intervals (n,)."""
        return self.upper - self.lower

    def values(self, z: Array) -> Array:
        """Values (..., n) of the free parameters at z (..., n)."""
        return np.clip(self.unclipped(z), self.lower, self.upper)

    def unclipped(self, z: Array) -> Array:
        """The values at z that may be outside the cube."""
        values = self.lower + self.width * z
        for j in np.flatnonzero(self.logarithmic):
            values[..., j] = self.lower[j] * np.exp(z[..., j] * self.logarithms[j])
        return values

    def slopes(self, z: Array) -> Array:
        """Derivatives (..., n) of the values with respect to z (..., n)."""
        slopes = np.broadcast_to(self.width, z.shape).copy()
        for j in np.flatnonzero(self.logarithmic):
            slopes[..., j] = (
                self.lower[j] * np.exp(z[..., j] * self.logarithms[j]) * self.logarithms[j]
            )
        return slopes

    def places(self, values: Array) -> Array:
        """The coordinates z (..., n) of values (..., n)."""
        z = (values - self.lower) / self.width
        for j in np.flatnonzero(self.logarithmic):
            z[..., j] = np.log(values[..., j] / self.lower[j]) / self.logarithms[j]
        return np.asarray(z)

    @property
    def logarithms(self) -> Array:
        """Lengths of the intervals in natural logarithms; NaN where they are not positive."""
        with np.errstate(all="ignore"):
            return np.asarray(np.log(self.upper / self.lower))

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
        return ends_at_bounds(self.names, z)

    def complete(self, free: Mapping[str, float]) -> dict[str, float]:
        """All parameters by name, in their order, for values of the free ones."""
        return {name: free[name] if name in free else self.fixed[name] for name in self.order}


def ends_at_bounds(names: Sequence[str], z: Array) -> dict[str, str]:
    """Coordinates that are at the ``"lower"`` or ``"upper"`` end of the unit cube at z (n,)."""
    return {
        name: "lower" if x < 0.5 else "upper"
        for name, x in zip(names, z, strict=True)
        if min(x, 1.0 - x) <= NEGLIGIBLE
    }


def free_parameters(
    solutions: Sequence[SolutionCore],
    fixed: ParameterValues = None,
    bounds: Bounds = None,
    start: ParameterValues = None,
    *,
    extras: Mapping[str, Range] | None = None,
    absent: Sequence[str] = (),
) -> FreeParameters:
    """Check what is fixed, the bounds and the start.

    The parameters are those of all solutions, without the ``absent`` ones, and ``extras`` with the
    ranges that they have without bounds. A parameter of several solutions has the part of its
    intervals that they share.
    """
    boxes = _boxes(solutions, absent)
    ranges = {**boxes, **(extras or {})}
    order = tuple(ranges)

    def inside(name: str, given: object) -> float:
        return _inside([s for s in solutions if name in s.parameters], name, given)

    held = {name: inside(name, x) for name, x in by_name("fixed", fixed, order).items()}
    names = tuple(name for name in order if name not in held)
    if not names:
        reason = "all parameters are fixed" if order else "the solution has no parameters"
        raise OptionError(reason, term=fixed, remedy="leave one of them free")
    for name, interval in by_name("bounds", bounds, order).items():
        if name in held:
            raise OptionError(f"{quote(name)} is fixed, and has bounds", term=name)
        low, high, logarithmic = _pair(name, interval)
        ends = Range(inside(name, low), inside(name, high), logarithmic or ranges[name].logarithmic)
        ranges[name] = _ascending(name, ends, interval)
    box = {name: ranges[name] for name in names}
    starts = {}
    for name, entry in by_name("start", start, order).items():
        if name in held:
            raise OptionError(f"{quote(name)} is fixed, and has a start", term=name)
        starts[name] = inside(name, entry)
    free = FreeParameters(
        names=names,
        positions=tuple(order.index(name) for name in names),
        lower=np.array([box[name].lower for name in names]),
        upper=np.array([box[name].upper for name in names]),
        fixed=held,
        order=order,
        start=None,
        logarithmic=tuple(box[name].logarithmic for name in names),
    )
    return free if start is None else with_start(free, starts)


def with_start(free: FreeParameters, start: Mapping[str, float]) -> FreeParameters:
    """The parameters with a start; it is in the middle for those without one."""
    z = np.full(len(free.names), 0.5)
    for name, x in start.items():
        j = free.names.index(name)
        lower, upper = free.lower[j], free.upper[j]
        if not lower <= x <= upper:
            raise OptionError(
                f"the start {quote(name)} = {x:g} is outside its bounds [{lower:g}, {upper:g}]",
                term=x,
                remedy="start inside",
            )
        with np.errstate(invalid="ignore"):  # ranges of linear parameters may be infinite yet
            values = free.values(z)
            values[j] = x
            z[j] = free.places(values)[j]
    return replace(free, start=z)


def _boxes(solutions: Sequence[SolutionCore], absent: Sequence[str]) -> dict[str, Range]:
    """The interval that all solutions with a parameter share, by name."""
    boxes: dict[str, Range] = {}
    for solution in solutions:
        texts = dict(solution.metadata.distributions)
        for name, (lower, upper) in solution.parameters.items():
            if name in absent:
                continue
            logarithmic = name in texts and scale_of(texts[name], lower) == LOG
            before = boxes.get(name, Range(-math.inf, math.inf))
            ends = max(lower, before.lower), min(upper, before.upper)
            boxes[name] = Range(*ends, logarithmic or before.logarithmic)
            if not boxes[name].lower < boxes[name].upper:
                raise OptionError(
                    f"the solutions share no interval of {quote(name)}",
                    term=name,
                    remedy="solve them on boxes that overlap, or rename it in one of them",
                )
    return boxes


def _inside(solutions: Sequence[SolutionCore], name: str, given: object) -> float:
    """One value of a parameter inside of the boxes of the solutions that have it."""
    array = np.asarray(np.nan)
    for solution in solutions:
        position = solution.metadata.parameters.index(name) + 1
        array = solution._coordinates.checked(position, given)
    if not solutions:
        try:
            array = np.asarray(given, dtype=float)
        except (TypeError, ValueError):
            array = np.full(2, np.nan)
    if array.ndim or not np.isfinite(array):
        raise OptionError(f"{quote(name)} is {given!r}, not a number", term=given)
    return float(array)


def _pair(name: str, interval: object) -> tuple[object, object, bool]:
    """The ends of bounds, and whether they are over decades."""
    ends = interval if isinstance(interval, list | tuple | np.ndarray) else ()
    if len(ends) == 3 and ends[2] == "log":
        return ends[0], ends[1], True
    if len(ends) != 2:
        raise OptionError(
            f"the bounds of {quote(name)} are {shown(interval)}, not a pair of numbers",
            term=interval,
            remedy='give (lower, upper), or (lower, upper, "log")',
        )
    return ends[0], ends[1], False


def _ascending(name: str, ends: Range, interval: object) -> Range:
    """Bounds that ascend, and are positive over decades."""
    lower, upper, logarithmic = ends
    if not lower < upper:
        raise OptionError(
            f"the bounds ({lower:g}, {upper:g}) of {quote(name)} do not ascend",
            term=interval,
            remedy="give (lower, upper), or fix a single value" if lower == upper else None,
        )
    if logarithmic and lower <= 0.0:
        raise OptionError(
            f"the bounds ({lower:g}, {upper:g}) of {quote(name)} have no logarithm",
            term=interval,
            remedy="give positive bounds, or bounds without a scale",
        )
    return ends
