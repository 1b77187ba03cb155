"""Functions of NumPy that take enclosures in place of arrays, or numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.verification.enclosures.enclosure import Condition, Enclosure, add_doubts, applied
from rankone.verification.enclosures.ranges import (
    Bounds,
    Function,
    Resolved,
    falling_bounds,
    rising_bounds,
    width_of,
    within,
)


def unary(function: Function, bounds: Bounds, resolved: Resolved) -> Function:
    """A function of NumPy that takes enclosures too."""

    def of(a: Any) -> Any:
        if not isinstance(a, Enclosure):
            return function(a)
        return applied(a, function(a.values), bounds, resolved)

    return of


def rising(
    function: Function,
    resolved: Resolved | None = None,
    domain: tuple[float, float] = (-np.inf, np.inf),
) -> Function:
    """A function that rises; without a scale one that has steps alone."""

    def constant(low: Array, high: Array) -> NDArray[np.bool_]:
        return np.asarray(function(low) == function(high))

    return unary(function, rising_bounds(function, domain), resolved or constant)


def falling(function: Function, resolved: Resolved, domain: tuple[float, float]) -> Function:
    """A function that falls on its domain."""
    return unary(function, falling_bounds(function, domain), resolved)


def extreme(function: Function) -> Function:
    """The larger or the smaller one of two: in doubt where their ranges meet."""

    def of(a: Any, b: Any) -> Any:
        if not isinstance(a, Enclosure) and not isinstance(b, Enclosure):
            return function(a, b)
        a, b = Enclosure.of(a), Enclosure.of(b)
        (a_low, a_high), (b_low, b_high) = a.range(), b.range()
        common = np.minimum(a_high - b_low, b_high - a_low)
        doubt = add_doubts(np.maximum(common, 0.0), add_doubts(a.doubt, b.doubt))
        bounds = function(a_low, b_low), function(a_high, b_high)
        return Enclosure(function(a.values, b.values), bounds, doubt)

    return of


def where(condition: Any, a: Any, b: Any) -> Any:
    """One of two branches: both where it is not known which."""
    if not isinstance(condition, Condition):
        return a if condition else b
    a, b = Enclosure.of(a), Enclosure.of(b)
    (a_low, a_high), (b_low, b_high) = a.range(), b.range()
    may, must = condition.may, condition.must
    low = np.where(must, a_low, np.where(may, np.fmin(a_low, b_low), b_low))
    high = np.where(must, a_high, np.where(may, np.fmax(a_high, b_high), b_high))
    of_a, of_b = (0.0 if each.doubt is None else each.doubt for each in (a, b))
    doubt = np.where(must, of_a, np.where(may, width_of(low, high), of_b))
    return Enclosure(np.where(condition.values, a.values, b.values), (low, high), doubt)


def heaviside(a: Any, at_zero: Any) -> Any:
    """The step from zero to one: in doubt where the argument may be zero."""
    if not isinstance(a, Enclosure):
        return np.heaviside(a, at_zero)

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        return np.heaviside(low, 0.0), np.heaviside(high, 1.0)

    values = np.heaviside(a.values, at_zero)
    return applied(a, values, bounds, lambda low, high: (low > 0.0) | (high < 0.0))


def mod(a: Any, b: Any) -> Any:
    """The remainder of a division: in doubt where it starts anew."""
    if not isinstance(a, Enclosure) and not isinstance(b, Enclosure):
        return np.mod(a, b)
    a, b = Enclosure.of(a), Enclosure.of(b)
    quotient = a / b
    low, high = quotient.range()
    inside = np.floor(low) == np.floor(high)
    sizes, zero = b.largest, np.zeros(1)
    least = np.where(b.bounds[0] < 0.0, -sizes, 0.0)
    most = np.where(b.bounds[1] > 0.0, sizes, 0.0)
    doubt = np.where(inside, zero if a.doubt is None else a.doubt, most - least)
    return Enclosure(np.mod(a.values, b.values), (least, most), doubt)


def logaddexp(a: Any, b: Any) -> Any:
    """The logarithm of a sum of exponentials."""
    if not isinstance(a, Enclosure) and not isinstance(b, Enclosure):
        return np.logaddexp(a, b)
    a, b = Enclosure.of(a), Enclosure.of(b)
    total = b + _softplus(a - b)
    return Enclosure(np.logaddexp(a.values, b.values), total.range, total.doubt)


_softplus = rising(lambda x: np.logaddexp(0.0, x), within(4.0))
