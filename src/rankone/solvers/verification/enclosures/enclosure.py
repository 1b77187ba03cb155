"""Enclosures and their arithmetic; conditions over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.verification.enclosures.bounds import (
    BETWEEN,
    NEAR,
    SCALE,
    Bounds,
    Function,
    Resolved,
    around,
    away_from,
    doubt_beside_zero,
    even_bounds,
    falling_bounds,
    has_single_zero,
    known,
    reciprocal_bounds,
    rising_bounds,
    share_in_doubt,
    times,
    width_of,
    within,
    without_nan,
)
from rankone.support.arrays import Array

_SMOOTH_DEGREE = 8  # Whole powers up to this hide nothing
_MOST_DEGREE = 24.0  # Products up to this degree hide nothing
_POWER_RANGE = 6.0  # Logarithm of the ratio of a power's ends that samples resolve
_LOG_BOUNDS = rising_bounds(np.log, (0.0, np.inf))


class Enclosure:
    """Values (K, N) at K places of N pieces, and bounds (N,) of all values on each piece.

    No value differs by more than the ``doubt`` (N,) from what the samples suggest, a smooth curve
    through them; None stands for zero. The ``degree`` counts how often what is resolved is
    multiplied by what is: where it is large, values that vary by much are in doubt. Bounds that
    follow from those of parts are computed when they are asked for, which is seldom: samples bound
    what is not in doubt.
    """

    __array_ufunc__ = None  # arrays and NumPy's numbers leave operations to it
    __slots__ = ("_bounds", "degree", "doubt", "values")

    def __init__(
        self,
        values: Array,
        bounds: Callable[[], tuple[Array, Array]] | tuple[Array, Array],
        doubt: Array | None = None,
        degree: float = 1.0,
    ) -> None:
        self.values, self._bounds, self.doubt = values, bounds, None
        self.degree = degree if values.ndim > 1 else 0.0
        if self.degree > _MOST_DEGREE:
            low, high = self.bounds
            steep = np.where(
                away_from(0.0, float(np.exp(_POWER_RANGE)))(low, high), 0.0, width_of(low, high)
            )
            doubt = steep if doubt is None else np.maximum(doubt, steep)
        if doubt is not None and doubt.any():
            self.doubt = np.fmin(known(doubt), width_of(*self.bounds))

    @classmethod
    def of(cls, value: Enclosure | float | Array) -> Enclosure:
        """A number, or one for each piece, as an enclosure."""
        if isinstance(value, Enclosure):
            return value
        exact = np.asarray(value, dtype=float)
        return cls(exact, (exact, exact))

    @classmethod
    def of_samples(cls, values: Array, beyond: float = BETWEEN) -> Enclosure:
        """A smooth function that goes beyond its samples (K, N) by a part of their range."""
        if values.ndim < 2:
            return cls(values, (values, values))
        return cls(values, lambda: around(values, beyond))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """What follows from the bounds of its parts."""
        if callable(self._bounds):
            self._bounds = self._bounds()
        return self._bounds

    def hull(self) -> tuple[Array, Array]:
        """Bounds by the samples, and by what is beside them."""
        if self.values.ndim < 2:
            return self.bounds
        low, high = around(self.values, BETWEEN)
        return (low, high) if self.doubt is None else (low - self.doubt, high + self.doubt)

    def range(self) -> tuple[Array, Array]:
        """Bounds of all values: by its parts, and by its samples."""
        (low, high), (below, above) = self.bounds, self.hull()
        return without_nan(np.fmax(low, below), np.fmin(high, above))

    @property
    def largest(self) -> Array:
        """Largest absolute value on each piece."""
        low, high = self.range()
        return np.maximum(np.abs(low), np.abs(high))

    @property
    def real(self) -> Enclosure:
        """The same: all values are real."""
        return self

    def __neg__(self) -> Enclosure:
        def bounds() -> tuple[Array, Array]:
            low, high = self.bounds
            return -high, -low

        return Enclosure(-self.values, bounds, self.doubt, self.degree)

    def __add__(self, other: Any) -> Enclosure:
        other = Enclosure.of(other)

        def bounds() -> tuple[Array, Array]:
            (low, high), (below, above) = self.bounds, other.bounds
            return low + below, high + above

        doubt = add_doubts(self.doubt, other.doubt)
        return Enclosure(self.values + other.values, bounds, doubt, max(self.degree, other.degree))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Enclosure:
        return self + -Enclosure.of(other)

    def __rsub__(self, other: Any) -> Enclosure:
        return Enclosure.of(other) + -self

    def __mul__(self, other: Any) -> Enclosure:
        other = Enclosure.of(other)
        return _product(self, other, self.values * other.values)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Enclosure:
        other = Enclosure.of(other)
        quotient = _product(self, _reciprocal(other), self.values / other.values)
        return _without_shared_zeros(self, other, quotient)

    def __rtruediv__(self, other: Any) -> Enclosure:
        return Enclosure.of(other) / self

    def __pow__(self, exponent: Any) -> Enclosure:
        exponent = Enclosure.of(exponent)
        if exponent.values.ndim == 0:
            return _power(self, float(exponent.values))
        log = applied(self, np.log(self.values), _LOG_BOUNDS, away_from(0.0))
        return _exp(exponent * log)

    def __rpow__(self, base: Any) -> Enclosure:
        return _exp(self * float(np.log(base)))

    def __gt__(self, other: Any) -> Condition:
        return Condition.of(self - other, np.greater)

    def __ge__(self, other: Any) -> Condition:
        return Condition.of(self - other, np.greater_equal)

    def __lt__(self, other: Any) -> Condition:
        return Condition.of(Enclosure.of(other) - self, np.greater)

    def __le__(self, other: Any) -> Condition:
        return Condition.of(Enclosure.of(other) - self, np.greater_equal)

    def __eq__(self, other: Any) -> Condition:  # type: ignore[override]
        difference = self - other
        least = Condition.of(difference, np.greater_equal)
        return least & Condition.of(-difference, np.greater_equal)

    def __ne__(self, other: Any) -> Condition:  # type: ignore[override]
        return ~self.__eq__(other)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True)
class Condition:
    """What holds at the places (K, N), and what ``may`` and ``must`` hold on the pieces (N,)."""

    values: NDArray[np.bool_]
    may: NDArray[np.bool_]
    must: NDArray[np.bool_]

    @classmethod
    def of(cls, difference: Enclosure, compare: Function) -> Condition:
        """Whether a difference is positive, or not negative."""
        low, high = difference.hull()
        may, must = compare(high, 0.0), compare(low, 0.0)
        if (may != must).any():
            low, high = difference.range()
            may, must = compare(high, 0.0), compare(low, 0.0)
        return cls(compare(difference.values, 0.0), may, must)

    @classmethod
    def known(cls, condition: Condition | bool) -> Condition:
        """The same, or what always holds or never."""
        if isinstance(condition, Condition):
            return condition
        always = np.asarray(bool(condition))
        return cls(always, always, always)

    def __and__(self, other: Condition | bool) -> Condition:
        other = Condition.known(other)
        return Condition(self.values & other.values, self.may & other.may, self.must & other.must)

    def __or__(self, other: Condition | bool) -> Condition:
        other = Condition.known(other)
        return Condition(self.values | other.values, self.may | other.may, self.must | other.must)

    def __invert__(self) -> Condition:
        return Condition(~self.values, ~self.must, ~self.may)


def add_doubts(first: Array | None, second: Array | None) -> Array | None:
    """The sum of two doubts, of which None is zero."""
    if first is None or second is None:
        return second if first is None else first
    return first + second


def _product(a: Enclosure, b: Enclosure, values: Array) -> Enclosure:
    def bounds() -> tuple[Array, Array]:
        corners = [times(x, y) for x in a.bounds for y in b.bounds]
        low = np.minimum(np.minimum(*corners[:2]), np.minimum(*corners[2:]))
        return low, np.maximum(np.maximum(*corners[:2]), np.maximum(*corners[2:]))

    doubt = None if b.doubt is None else times(a.largest, b.doubt)
    doubt = add_doubts(doubt, None if a.doubt is None else times(b.largest, a.doubt))
    return Enclosure(values, bounds, doubt, a.degree + b.degree)


def applied(a: Enclosure, values: Array, bounds: Bounds, resolved: Resolved) -> Enclosure:
    """A function of one argument: its values, bounds over a range, and whether that is narrow.

    Where samples resolve it, it passes on a doubt by its slope. Elsewhere its range is in doubt.
    """

    def of_range() -> tuple[Array, Array]:
        return without_nan(*bounds(*a.range()))

    if a.doubt is None and resolved(*a.hull()).all():
        return Enclosure(values, of_range)
    low, high = a.range()
    both = of_range()
    width = width_of(*both)
    doubt = np.where(resolved(low, high), 0.0, width)
    if a.doubt is not None:
        doubt = np.maximum(doubt, times(width, share_in_doubt(a.doubt, low, high)))
    return Enclosure(values, both, doubt)


def _without_shared_zeros(a: Enclosure, b: Enclosure, quotient: Enclosure) -> Enclosure:
    """A quotient that is smooth where a zero of ``b`` is one of ``a``."""
    if quotient.doubt is None or a.values.ndim < 2 or a.values.shape != b.values.shape:
        return quotient
    single = has_single_zero(b.values) & ~np.isfinite(quotient.doubt)
    for each in (a, b):
        single &= True if each.doubt is None else each.doubt == 0.0
    if not (at := np.flatnonzero(single)).size:
        return quotient
    doubt = quotient.doubt.copy()
    doubt[at] = doubt_beside_zero(*(each.values[:, at] for each in (a, b, quotient)))
    return Enclosure(quotient.values, quotient.bounds, doubt)


def _reciprocal(a: Enclosure) -> Enclosure:
    return applied(a, 1.0 / a.values, reciprocal_bounds, away_from(0.0))


def _exp(a: Enclosure) -> Enclosure:
    return applied(a, np.exp(a.values), rising_bounds(np.exp), within(SCALE))


def _power(a: Enclosure, exponent: float) -> Enclosure:
    """A power with a number as exponent."""
    whole = exponent == round(exponent)
    if whole and exponent < 0.0:
        return _reciprocal(_power(a, -exponent))

    def power(base: Array) -> Array:
        return np.asarray(base**exponent)

    even = whole and exponent % 2.0 == 0.0
    if whole and exponent <= _SMOOTH_DEGREE:

        def bounds() -> tuple[Array, Array]:
            low, high = a.range()
            return even_bounds(power)(low, high) if even else (power(low), power(high))

        doubt = a.doubt
        if doubt is not None:
            doubt = times(exponent * a.largest ** (exponent - 1.0), doubt)
        return Enclosure(power(a.values), bounds, doubt, exponent * a.degree)
    resolved = away_from(0.0, min(NEAR, float(np.exp(_POWER_RANGE / abs(exponent)))))
    if even:
        return applied(a, power(a.values), even_bounds(power), resolved)
    domain = (-np.inf if whole else 0.0, np.inf)
    monotone = (rising_bounds if exponent > 0.0 else falling_bounds)(power, domain)
    return applied(a, power(a.values), monotone, resolved)
