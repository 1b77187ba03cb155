"""Where a system is solved: a horizon and a box of parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from typing import SupportsFloat

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, quote, shown

LEAST_WIDTH = 1e-290
"""Shortest interval: fractions of a shorter one underflow."""
# Points of an interval at which known functions are checked, both ends and the middle included
_SAMPLES = 257


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
        parameters: Mapping[object, Sequence[float]] | None = None,
        t_final: float | None = None,
    ) -> Domain:
        """The domain with other intervals of some parameters, or another end of the horizon.

        ``names`` are those of all parameters, ``parameters`` maps some of them, or their symbols,
        to new intervals. An OptionError if there is no such parameter, or an interval is not two
        finite ascending numbers.
        """
        if not isinstance(parameters, Mapping | None):
            message = f"parameters={parameters!r} is not a mapping from parameters to intervals"
            raise OptionError(message, term=parameters, remedy="give {name: (lower, upper), ...}")
        box = dict(zip(names, self.box, strict=True))
        moved: set[str] = set()
        for key, interval in (parameters or {}).items():
            name = str(getattr(key, "name", key))  # of a symbol, or the key itself
            if name not in box:
                raise OptionError(
                    f"there is no parameter {quote(name)}{did_you_mean(name, box)}",
                    term=key,
                    remedy=f"choose from {', '.join(box)}" if box else None,
                )
            if name in moved:
                raise OptionError(f"the parameter {quote(name)} is given twice", term=key)
            moved.add(name)
            box[name] = _interval(f"the range of {quote(name)}", interval)
        start, end = self.horizon
        horizon = _interval("the horizon", (start, end if t_final is None else t_final))
        return Domain(horizon, tuple(box.values()))


def _interval(subject: str, interval: Iterable[object]) -> tuple[float, float]:
    """Two finite numbers in ascending order, or an OptionError."""
    try:
        lower, upper = (
            float(end)
            for end in interval
            if isinstance(end, SupportsFloat) and not isinstance(end, bool | np.bool_)
        )
    except (OverflowError, TypeError, ValueError):
        lower = upper = math.nan
    if isinstance(interval, Set):  # it has no order
        lower = math.nan
    if lower < upper and upper - lower < LEAST_WIDTH:
        raise OptionError(f"{subject} is {shown(interval)}, which is too narrow", term=interval)
    if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
        raise OptionError(
            f"{subject} is {shown(interval)}, not two numbers in ascending order", term=interval
        )
    return lower, upper


@dataclass(frozen=True)
class KnownFactors:
    """The factors of one coordinate on an interval; an infinite one is an OptionError."""

    coordinate: str
    interval: tuple[float, float]
    function: Callable[[Array], Array]

    @classmethod
    def of(cls, system: System, domain: Domain) -> Iterator[KnownFactors]:
        """The factors of time, then those of each parameter."""
        yield cls("time", domain.horizon, system.time_factors)
        for j, (name, interval) in enumerate(zip(system.parameters, domain.box, strict=True)):
            yield cls(quote(name), interval, partial(system.parameter_factors, j))

    def __call__(self, points: Array) -> Array:
        """Values at points (N,): shape (factors, N)."""
        with np.errstate(all="ignore"):
            factors = self.function(points)
        if not np.isfinite(factors).all():
            raise self.not_finite()
        return factors

    def not_finite(self) -> OptionError:
        """The error for a pole."""
        lower, upper = self.interval
        return OptionError(
            f"a coefficient is not finite for {self.coordinate} in [{lower:g}, {upper:g}]",
            remedy="choose a range on which all coefficients are finite",
        )


def check_factors(system: System, domain: Domain) -> None:
    """Raise an OptionError if a known factor is not finite at a sample of a coordinate, or at 0."""
    for factors in KnownFactors.of(system, domain):
        lower, upper = factors.interval
        factors(np.append(np.linspace(lower, upper, _SAMPLES), min(max(lower, 0.0), upper)))
