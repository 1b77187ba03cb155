"""Where a system is solved: a horizon and a box of parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from typing import Any, SupportsFloat

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, quote, shown

__all__ = ["LEAST_WIDTH", "Domain", "KnownFactors", "check_factors"]

LEAST_WIDTH = 1e-290
"""Shortest interval whose parts are still numbers."""
_SAMPLES = 257
"""Points of an interval at which known functions are looked at."""


@dataclass(frozen=True)
class Domain:
    """A horizon in time, and an interval for each parameter."""

    horizon: tuple[float, float]
    box: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, system: System) -> Domain:
        """The domain a generated module was written for."""
        box = tuple((float(lower), float(upper)) for lower, upper in system.box)
        return cls((float(system.horizon[0]), float(system.horizon[1])), box)

    @property
    def bounds(self) -> Array:
        """The box as an array (d, 2)."""
        return np.array(self.box, dtype=float).reshape(-1, 2)

    def moved(
        self,
        names: Sequence[str],
        parameters: Mapping[Any, Sequence[float]] | None = None,
        t_final: float | None = None,
    ) -> Domain:
        """The domain with other intervals of some parameters, or another end of the horizon.

        ``names`` are those of all parameters, ``parameters`` maps some of them, or their symbols,
        to new intervals.

        Raises
        ------
        OptionError
            If there is no such parameter, or an interval is not two finite ascending numbers.
        """
        if not isinstance(parameters, Mapping | None):
            message = f"parameters={parameters!r} is not a mapping from parameters to intervals"
            raise OptionError(message, term=parameters, remedy="give {name: (lower, upper), ...}")
        box = dict(zip(names, self.box, strict=True))
        given: set[str] = set()
        for key, interval in (parameters or {}).items():
            name = str(getattr(key, "name", key))
            if name not in box:
                raise OptionError(
                    f"there is no parameter {quote(name)}{did_you_mean(name, box)}",
                    term=key,
                    remedy=f"choose from {', '.join(box)}" if box else None,
                )
            if name in given:
                raise OptionError(f"the parameter {quote(name)} is given twice", term=key)
            given.add(name)
            box[name] = _interval(f"the range of {quote(name)}", interval)
        start, end = self.horizon
        horizon = _interval("the horizon", (start, end if t_final is None else t_final))
        return Domain(horizon, tuple(box.values()))


def _interval(what: str, given: Any) -> tuple[float, float]:
    """Two finite numbers in ascending order, or an OptionError."""
    try:
        lower, upper = (float(value) for value in given if _is_number(value))
    except (OverflowError, TypeError, ValueError):
        lower = upper = math.nan
    if isinstance(given, Set):  # it has no order
        lower = math.nan
    if lower < upper and upper - lower < LEAST_WIDTH:
        raise OptionError(f"{what} is {shown(given)}, which is too narrow", term=given)
    if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
        raise OptionError(
            f"{what} is {shown(given)}, not two numbers in ascending order", term=given
        )
    return lower, upper


def _is_number(value: Any) -> bool:
    return isinstance(value, SupportsFloat) and not isinstance(value, bool | np.bool_)


@dataclass(frozen=True)
class KnownFactors:
    """The factors of one coordinate on an interval; anything not finite is an OptionError."""

    what: str
    interval: tuple[float, float]
    function: Callable[[Array], Array]

    @classmethod
    def of(cls, system: System, domain: Domain) -> Iterator[KnownFactors]:
        """Those of time, then of each parameter."""
        yield cls("time", domain.horizon, system.time_factors)
        for j, (name, interval) in enumerate(zip(system.parameters, domain.box, strict=True)):
            yield cls(quote(name), interval, partial(system.parameter_factors, j))

    def __call__(self, points: Array) -> Array:
        """Values at points (N,): shape (factors, N)."""
        with np.errstate(all="ignore"):
            values = self.function(points)
        if not np.isfinite(values).all():
            raise self.not_finite()
        return values

    def not_finite(self) -> OptionError:
        """The error for a pole."""
        lower, upper = self.interval
        return OptionError(
            f"a coefficient is not finite for {self.what} in [{lower:g}, {upper:g}]",
            remedy="choose a range on which all coefficients are finite",
        )


def check_factors(system: System, domain: Domain) -> None:
    """Raise an OptionError if a known factor is not finite at a sample of a coordinate, or at 0."""
    for factors in KnownFactors.of(system, domain):
        lower, upper = factors.interval
        factors(np.append(np.linspace(lower, upper, _SAMPLES), min(max(lower, 0.0), upper)))
