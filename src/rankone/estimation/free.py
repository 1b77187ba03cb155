"""Which parameters are free, between which bounds, and from where a search starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote

__all__ = ["Free", "free_parameters"]


@dataclass(frozen=True)
class Free:
    """The free parameters as coordinates z of a unit cube.

    Attributes
    ----------
    names : tuple of str
    positions : tuple of int
        Among all parameters of the solution.
    lower, upper : ndarray (n,)
        Bounds, in the unit of each parameter.
    fixed : dict of str to float
    count : int
        Number of all parameters.
    start : ndarray (n,) or None
        Where the search starts, in z.
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


def free_parameters(
    solution: SolutionCore,
    fixed: Mapping[Any, Any] | None = None,
    bounds: Mapping[Any, Any] | None = None,
    start: Mapping[Any, Any] | None = None,
) -> Free:
    """Check what is fixed, the bounds and the start.

    Raises
    ------
    OptionError
        If a parameter is unknown, all are fixed, bounds do not ascend, or a start is outside of
        its bounds.
    EvaluationError
        If a value or a bound is outside of the box.
    """
    known = tuple(solution.parameters)
    held = {name: _number(solution, name, v) for name, v in _by_name(known, "fixed", fixed)}
    names = tuple(name for name in known if name not in held)
    if not names:
        what = "all parameters are fixed" if known else "the solution has no parameters"
        raise OptionError(what, term=fixed, remedy="leave one of them free")
    box = {name: solution.parameters[name] for name in names}
    for name, interval in _by_name(known, "bounds", bounds):
        if name in held:
            raise OptionError(f"{quote(name)} is fixed, and has bounds", term=name)
        box[name] = _interval(solution, name, interval)
    lower, upper = np.array(list(box.values())).T
    return Free(
        names=names,
        positions=tuple(known.index(name) for name in names),
        lower=lower,
        upper=upper,
        fixed=held,
        order=known,
        start=_start(solution, known, held, box, start),
    )


def _start(
    solution: SolutionCore,
    known: tuple[str, ...],
    held: Mapping[str, float],
    box: Mapping[str, tuple[float, float]],
    start: Mapping[Any, Any] | None,
) -> Array | None:
    """Where to start in the unit cube; in the middle where nothing is said."""
    if start is None:
        return None
    z = dict.fromkeys(box, 0.5)
    for name, value in _by_name(known, "start", start):
        if name in held:
            raise OptionError(f"{quote(name)} is fixed, and has a start", term=name)
        number, (lower, upper) = _number(solution, name, value), box[name]
        if not lower <= number <= upper:
            raise OptionError(
                f"the start {quote(name)} = {number:g} is outside of its bounds "
                f"[{lower:g}, {upper:g}]",
                term=value,
                remedy="start inside",
            )
        z[name] = (number - lower) / (upper - lower)
    return np.array(list(z.values()))


def _by_name(known: tuple[str, ...], what: str, given: Any) -> list[tuple[str, Any]]:
    """What is given for parameters, by their names."""
    if not isinstance(given, Mapping | None):
        raise OptionError(
            f"{what}={given!r} is not a mapping from parameters",
            term=given,
            remedy=f"give {what}={{name: ...}}",
        )
    pairs = [(name_of(key), value) for key, value in (given or {}).items()]
    for name, _ in pairs:
        if name not in known:
            raise OptionError(
                f"{what}: there is no parameter {quote(name)}{did_you_mean(name, known)}",
                term=name,
                remedy=f"known are {listing(known)}" if known else "the solution has none",
            )
    if len({name for name, _ in pairs}) < len(pairs):
        raise OptionError(f"{what}: a parameter is given twice", term=given)
    return pairs


def _number(solution: SolutionCore, name: str, value: Any) -> float:
    """One value inside of the box."""
    position = solution.metadata.parameters.index(name) + 1
    array = solution._coordinates.checked(position, value)
    if array.ndim:
        raise OptionError(f"{quote(name)} is {value!r}, not a number", term=value)
    return float(array)


def _interval(solution: SolutionCore, name: str, interval: Any) -> tuple[float, float]:
    """Bounds inside of the box."""
    try:
        low, high = interval
    except (TypeError, ValueError):
        raise OptionError(
            f"the bounds of {quote(name)} are {interval!r}, not a pair of numbers", term=interval
        ) from None
    lower, upper = _number(solution, name, low), _number(solution, name, high)
    if not lower < upper:
        raise OptionError(
            f"the bounds ({lower:g}, {upper:g}) of {quote(name)} do not ascend",
            term=interval,
            remedy="give (lower, upper), or fix a single value" if lower == upper else None,
        )
    return lower, upper
