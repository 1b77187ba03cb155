"""Enclosures: what samples on a piece of a trajectory show of a function, and what they may hide.

A generated function is evaluated on :class:`Enclosure` in place of arrays, by the same text. Sums
and products of what samples show hide nothing, however large they are. A function of one argument
may hide something where that varies by more than the function's own scale, or across its
singularity; then the range of the function bounds it. The same holds for powers of powers, whose
degree is carried along. So a peak of width 1e-9 shows by its height,
wherever it is, and stiff differences of large numbers do not.

Ranges are computed without outward rounding. Those of functions of ``scipy.special`` that are not
listed here are by samples over the ranges of their arguments. Functions of the user and tables show
what their samples show.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import FunctionType, SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray
from scipy import special

from rankone.support.arrays import Array
from rankone.trajectories.paths import TO_POWERS

Bounds: TypeAlias = "Callable[[Array, Array], tuple[Array, Array]]"
Resolved: TypeAlias = "Callable[[Array, Array], NDArray[np.bool_]]"
Function: TypeAlias = Callable[..., Any]

_BETWEEN = 0.15  # How far values go beyond samples of a smooth function, in ranges of the samples
_STEEPEST = 8.0  # Largest slope of a function within its scale, over its mean slope, about
_SMOOTH_DEGREE = 8  # Whole powers up to this hide nothing
_MOST_DEGREE = 24.0  # Products up to this degree hide nothing
_NEAR = 4.0  # Ratio of an argument's ends that a singularity at zero leaves resolved
_POWER_RANGE = 6.0  # The same for powers, as a logarithm of their values
_SCALE = 2.0  # Half a range of exponentials and waves that samples resolve
_NEWTON_STEPS = 8  # To a zero of the curve through samples
_SHARED = 1e-3  # Distance of two zeros, in lengths of a piece, below which they may be one
_LOGARITHM = 40.0  # Of a piece over rounding
_FAR = 1e9  # Longest argument of a sine of which the extrema are told
# Shares of ranges of several arguments at which functions are sampled, with all corners of three
_SHARES = np.concatenate(
    [np.indices((2, 2, 2)).reshape(3, -1), np.random.default_rng(7).random((3, 89))], axis=1
)
_TABLES = "f_"  # First letters of tables and functions of the user in generated text


class UnsuitableError(Exception):
    """A function cannot be evaluated on enclosures: it is array code."""


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
                _away_from(0.0, float(np.exp(_POWER_RANGE)))(low, high), 0.0, _width(low, high)
            )
            doubt = steep if doubt is None else np.maximum(doubt, steep)
        if doubt is not None and doubt.any():
            self.doubt = np.fmin(_known(doubt), _width(*self.bounds))

    @classmethod
    def of(cls, value: Enclosure | float | Array) -> Enclosure:
        """A number, or one for each piece, as an enclosure."""
        if isinstance(value, Enclosure):
            return value
        exact = np.asarray(value, dtype=float)
        return cls(exact, (exact, exact))

    @classmethod
    def of_samples(cls, values: Array, beyond: float = _BETWEEN) -> Enclosure:
        """A smooth function that goes beyond its samples (K, N) by a part of their range."""
        if values.ndim < 2:
            return cls(values, (values, values))
        return cls(values, lambda: _around(values, beyond))

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
        low, high = _around(self.values, _BETWEEN)
        return (low, high) if self.doubt is None else (low - self.doubt, high + self.doubt)

    def range(self) -> tuple[Array, Array]:
        """Bounds of all values: by its parts, and by its samples."""
        (low, high), (below, above) = self.bounds, self.hull()
        return _without_nan(np.fmax(low, below), np.fmin(high, above))

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

        doubt = _sum(self.doubt, other.doubt)
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
        return _of_shared_zeros(self, other, quotient)

    def __rtruediv__(self, other: Any) -> Enclosure:
        return Enclosure.of(other) / self

    def __pow__(self, exponent: Any) -> Enclosure:
        exponent = Enclosure.of(exponent)
        if exponent.values.ndim == 0:
            return _power(self, float(exponent.values))
        return Enclosure.of(_exp(exponent * _log(self)))

    def __rpow__(self, base: Any) -> Enclosure:
        return Enclosure.of(_exp(self * float(np.log(base))))

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


def enclosed(function: Callable[..., object]) -> Callable[..., Sequence[Enclosure]]:
    """A generated function as one of enclosures, which returns the rows of its array.

    An UnsuitableError if it calls helpers, as array code does, or was not generated.
    """
    if not isinstance(function, FunctionType) or not _is_generated(function):
        raise UnsuitableError
    names = {**function.__globals__, "np": _NAMES_OF_NUMPY, "special": _NAMES_OF_SPECIAL}
    for name in function.__code__.co_names:
        original = function.__globals__.get(name)
        if name.startswith(_TABLES) and callable(original):
            names[name] = _by_samples(original)
        elif isinstance(original, FunctionType):
            raise UnsuitableError
    return FunctionType(function.__code__, names, function.__name__, function.__defaults__)


def _is_generated(function: FunctionType) -> bool:
    """Whether a function is from text, and not from a file."""
    return function.__code__.co_filename.startswith("<")


def _without_nan(low: Array, high: Array) -> tuple[Array, Array]:
    return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)


def _around(values: Array, beyond: float) -> tuple[Array, Array]:
    """Bounds of a smooth function that goes beyond its samples (K, N) by a part of their range."""
    low, high = values.min(axis=0), values.max(axis=0)
    margin = beyond * (high - low)
    return low - margin, high + margin


def _width(low: Array, high: Array) -> Array:
    """The width of ranges, infinite where it is not known."""
    width = high - low
    return np.where(np.isnan(width), np.where(low == high, 0.0, np.inf), width)


def _known(doubt: Array) -> Array:
    return np.where(np.isnan(doubt), np.inf, doubt)


def _sum(first: Array | None, second: Array | None) -> Array | None:
    if first is None or second is None:
        return second if first is None else first
    return first + second


def _times(a: Array, b: Array) -> Array:
    """A product in which zero times infinity is zero."""
    product = a * b
    return np.where(np.isnan(product), 0.0, product)


def _product(a: Enclosure, b: Enclosure, values: Array) -> Enclosure:
    def bounds() -> tuple[Array, Array]:
        corners = [_times(x, y) for x in a.bounds for y in b.bounds]
        low = np.minimum(np.minimum(*corners[:2]), np.minimum(*corners[2:]))
        return low, np.maximum(np.maximum(*corners[:2]), np.maximum(*corners[2:]))

    doubt = None if b.doubt is None else _times(a.largest, b.doubt)
    doubt = _sum(doubt, None if a.doubt is None else _times(b.largest, a.doubt))
    return Enclosure(values, bounds, doubt, a.degree + b.degree)


def _applied(a: Enclosure, values: Array, bounds: Bounds, resolved: Resolved) -> Enclosure:
    """A function of one argument: its values, bounds over a range, and whether that is narrow.

    Where samples resolve it, it passes on a doubt by its slope. Elsewhere its range is in doubt.
    """

    def of_range() -> tuple[Array, Array]:
        return _without_nan(*bounds(*a.range()))

    if a.doubt is None and resolved(*a.hull()).all():
        return Enclosure(values, of_range)
    low, high = a.range()
    both = of_range()
    width = _width(*both)
    doubt = np.where(resolved(low, high), 0.0, width)
    if a.doubt is not None:
        share = _known(_STEEPEST * a.doubt / np.where(high > low, high - low, 1.0))
        doubt = np.maximum(doubt, _times(width, np.minimum(share, 1.0)))
    return Enclosure(values, both, doubt)


# --- whether samples resolve a function over a range of its argument ------------------------------


def _within(scale: float) -> Resolved:
    return lambda low, high: high - low <= 2.0 * scale


def _away_from(singularity: float, ratio: float = _NEAR) -> Resolved:
    def resolved(low: Array, high: Array) -> NDArray[np.bool_]:
        a, b = low - singularity, high - singularity
        return ((a > 0.0) & (b <= ratio * a)) | ((b < 0.0) & (a >= ratio * b))

    return resolved


def _inside(border: float) -> Resolved:
    return lambda low, high: (low > -border) & (high < border)


def _one_sided(low: Array, high: Array) -> NDArray[np.bool_]:
    return (low >= 0.0) | (high <= 0.0)


# --- functions of one argument --------------------------------------------------------------------


def _unary(function: Function, bounds: Bounds, resolved: Resolved) -> Function:
    """A function of NumPy that takes enclosures too."""

    def of(a: Any) -> Any:
        if not isinstance(a, Enclosure):
            return function(a)
        return _applied(a, function(a.values), bounds, resolved)

    return of


def _rising(
    function: Function,
    resolved: Resolved | None = None,
    domain: tuple[float, float] = (-np.inf, np.inf),
) -> Function:
    """A function that rises; without a scale one that has steps alone."""

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        return function(np.clip(low, *domain)), function(np.clip(high, *domain))

    def constant(low: Array, high: Array) -> NDArray[np.bool_]:
        return np.asarray(function(low) == function(high))

    return _unary(function, bounds, resolved or constant)


def _falling(
    function: Function, resolved: Resolved, domain: tuple[float, float] = (-np.inf, np.inf)
) -> Function:
    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        return function(np.clip(high, *domain)), function(np.clip(low, *domain))

    return _unary(function, bounds, resolved)


def _even_bounds(function: Function) -> Bounds:
    """Bounds of an even function that rises from zero on."""

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        at_low, at_high = np.asarray(function(low)), np.asarray(function(high))
        least = np.where((low <= 0.0) & (high >= 0.0), function(0.0), np.minimum(at_low, at_high))
        return np.asarray(least), np.maximum(at_low, at_high)

    return bounds


def _wave_bounds(shift: float, at_top: float = 1.0) -> Bounds:
    """Bounds of ``sin(x + shift)`` plus one number less than ``at_top``."""

    def passes(low: Array, high: Array, place: float) -> NDArray[np.bool_]:
        first = np.ceil((low - place) / (2.0 * np.pi))
        return np.asarray((2.0 * np.pi * first + place <= high) | ~(high - low < _FAR))

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        low, high = low + shift, high + shift
        a, b = np.sin(low), np.sin(high)
        least = np.where(passes(low, high, -0.5 * np.pi), -1.0, np.minimum(a, b))
        most = np.where(passes(low, high, 0.5 * np.pi), 1.0, np.maximum(a, b))
        return least + (at_top - 1.0), most + (at_top - 1.0)

    return bounds


def _tan_bounds(low: Array, high: Array) -> tuple[Array, Array]:
    pole = np.floor(high / np.pi + 0.5) > np.floor(low / np.pi + 0.5)
    return np.where(pole, -np.inf, np.tan(low)), np.where(pole, np.inf, np.tan(high))


def _tan_resolved(low: Array, high: Array) -> NDArray[np.bool_]:
    middle = (0.5 * (low + high) + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    return np.asarray(0.5 * (high - low) <= 0.8 * (0.5 * np.pi - np.abs(middle)))


def _reciprocal_bounds(low: Array, high: Array) -> tuple[Array, Array]:
    across = (low < 0.0) & (high > 0.0)
    below = np.where(high == 0.0, -np.inf, 1.0 / high)
    above = np.where(low == 0.0, np.inf, 1.0 / low)
    return np.where(across, -np.inf, below), np.where(across, np.inf, above)


def _sinc_bounds(low: Array, high: Array) -> tuple[Array, Array]:
    """Of ``sin(pi x)/(pi x)``: it is below one over ``pi x``."""
    nearest = np.pi * np.where(_one_sided(low, high), np.minimum(np.abs(low), np.abs(high)), 0.0)
    height = np.where(nearest > 1.0, 1.0 / np.maximum(nearest, 1.0), 1.0)
    return -np.minimum(height, 0.22), height


def _reciprocal(a: Enclosure) -> Enclosure:
    return _applied(a, 1.0 / a.values, _reciprocal_bounds, _away_from(0.0))


def _curve(places: Array, coefficients: Array) -> Array:
    """Polynomials at one place (N,) each, from their coefficients (K, N)."""
    return np.asarray(polyval(places, coefficients, tensor=False))


def _of_shared_zeros(a: Enclosure, b: Enclosure, quotient: Enclosure) -> Enclosure:
    """A quotient that is smooth where a zero of ``b`` is one of ``a``, as in x/(exp(x) - 1).

    Where curves through the samples have their zeros a distance apart, a pole is left whose
    strength is that distance times the quotient; beside it, down to rounding, are its logarithms.
    """
    if quotient.doubt is None or a.values.ndim < 2 or a.values.shape != b.values.shape:
        return quotient
    slopes = np.diff(b.values, axis=0)
    rises = (slopes > 0.0).all(axis=0) | (slopes < 0.0).all(axis=0)
    single = rises & (b.values[0] * b.values[-1] < 0.0) & ~np.isfinite(quotient.doubt)
    for each in (a, b):
        single &= True if each.doubt is None else each.doubt == 0.0
    if not (at := np.flatnonzero(single)).size:
        return quotient
    above, below = (TO_POWERS @ each.values[:, at] for each in (a, b))
    slope = np.arange(1, len(below))[:, None] * below[1:]
    zero = np.zeros(at.size)
    for _ in range(_NEWTON_STEPS):
        zero = np.clip(zero - _curve(zero, below) / _curve(zero, slope), -1.0, 1.0)
    distance = np.abs(_curve(zero, above)) / np.abs(a.values[:, at]).max(axis=0)
    missed = _LOGARITHM * distance * np.abs(quotient.values[:, at]).max(axis=0)
    doubt = quotient.doubt.copy()
    doubt[at] = np.where(distance < _SHARED, missed, np.inf)
    return Enclosure(quotient.values, quotient.bounds, doubt)


_exp: Callable[[Any], Any] = _rising(np.exp, _within(_SCALE))
_log: Callable[[Any], Any] = _rising(np.log, _away_from(0.0), (0.0, np.inf))


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
            return _even_bounds(power)(low, high) if even else (power(low), power(high))

        doubt = a.doubt
        if doubt is not None:
            doubt = _times(exponent * a.largest ** (exponent - 1.0), doubt)
        return Enclosure(power(a.values), bounds, doubt, exponent * a.degree)
    resolved = _away_from(0.0, min(_NEAR, float(np.exp(_POWER_RANGE / abs(exponent)))))
    if even:
        return _applied(a, power(a.values), _even_bounds(power), resolved)
    domain = (-np.inf if whole else 0.0, np.inf)
    kind = _rising if exponent > 0.0 else _falling
    return Enclosure.of(kind(power, resolved, domain)(a))


# --- functions of several arguments ---------------------------------------------------------------


def _extreme(function: Function) -> Function:
    """The larger or the smaller one of two: in doubt where their ranges meet."""

    def of(a: Any, b: Any) -> Any:
        if not isinstance(a, Enclosure) and not isinstance(b, Enclosure):
            return function(a, b)
        a, b = Enclosure.of(a), Enclosure.of(b)
        (a_low, a_high), (b_low, b_high) = a.range(), b.range()
        common = np.minimum(a_high - b_low, b_high - a_low)
        doubt = _sum(np.maximum(common, 0.0), _sum(a.doubt, b.doubt))
        bounds = function(a_low, b_low), function(a_high, b_high)
        return Enclosure(function(a.values, b.values), bounds, doubt)

    return of


def _where(condition: Any, a: Any, b: Any) -> Any:
    """One of two branches: both where it is not known which."""
    if not isinstance(condition, Condition):
        return a if condition else b
    a, b = Enclosure.of(a), Enclosure.of(b)
    (a_low, a_high), (b_low, b_high) = a.range(), b.range()
    may, must = condition.may, condition.must
    low = np.where(must, a_low, np.where(may, np.fmin(a_low, b_low), b_low))
    high = np.where(must, a_high, np.where(may, np.fmax(a_high, b_high), b_high))
    of_a, of_b = (0.0 if each.doubt is None else each.doubt for each in (a, b))
    doubt = np.where(must, of_a, np.where(may, _width(low, high), of_b))
    return Enclosure(np.where(condition.values, a.values, b.values), (low, high), doubt)


def _heaviside(a: Any, at_zero: Any) -> Any:
    if not isinstance(a, Enclosure):
        return np.heaviside(a, at_zero)

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        return np.heaviside(low, 0.0), np.heaviside(high, 1.0)

    values = np.heaviside(a.values, at_zero)
    return _applied(a, values, bounds, lambda low, high: (low > 0.0) | (high < 0.0))


def _mod(a: Any, b: Any) -> Any:
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


def _logaddexp(a: Any, b: Any) -> Any:
    if not isinstance(a, Enclosure) and not isinstance(b, Enclosure):
        return np.logaddexp(a, b)
    a, b = Enclosure.of(a), Enclosure.of(b)
    total = b + _softplus(a - b)
    return Enclosure(np.logaddexp(a.values, b.values), total.range, total.doubt)


_softplus = _rising(lambda x: np.logaddexp(0.0, x), _within(4.0))


def _by_samples(function: Function) -> Function:
    """A function of which nothing is known besides its values."""

    def of(*arguments: Any) -> Any:
        if not any(isinstance(argument, Enclosure) for argument in arguments):
            return function(*arguments)
        sampled = np.broadcast_arrays(*(Enclosure.of(a).values for a in arguments))
        values = function(*sampled)
        if isinstance(values, tuple):
            return tuple(Enclosure.of_samples(np.real(each)) for each in values)
        return Enclosure.of_samples(np.real(values))

    return of


def _of_scale_one(function: Function) -> Function:
    """A function of scale one that may be singular at zero: samples over ranges tell its range."""

    def of(*arguments: Any) -> Any:
        if not any(isinstance(argument, Enclosure) for argument in arguments):
            return function(*arguments)
        enclosures = [Enclosure.of(argument) for argument in arguments]
        sampled = function(*np.broadcast_arrays(*(each.values for each in enclosures)))
        if not isinstance(sampled, tuple):
            return _over_ranges(function, enclosures, sampled)
        return tuple(
            _over_ranges(lambda *a, k=k: function(*a)[k], enclosures, values)
            for k, values in enumerate(sampled)
        )

    return of


def _over_ranges(function: Function, arguments: Sequence[Enclosure], sampled: Array) -> Enclosure:
    """In doubt by its range where an argument varies by more than its scale, or is in doubt."""
    values = np.real(sampled)
    varying = [each for each in arguments if each.values.ndim > 1]
    clear = all(each.doubt is None and _of_one_scale(*each.hull()).all() for each in varying)
    if clear or values.ndim < 2:
        return Enclosure.of_samples(values)
    shares = iter(_SHARES[: len(varying)] if len(varying) > 1 else [np.linspace(0.0, 1.0, 49)])
    inside = [
        each.values if each.values.ndim < 2 else _inside_range(*each.range(), next(shares))
        for each in arguments
    ]
    beside = np.real(function(*np.broadcast_arrays(*inside)))
    low, high = _without_nan(*_around(np.concatenate([values, beside]), _BETWEEN))
    in_doubt = np.zeros(low.shape)
    for each in varying:
        below, above = each.range()
        in_doubt = np.where(_of_one_scale(below, above), in_doubt, 1.0)
        if each.doubt is not None:
            share = _known(_STEEPEST * each.doubt / np.where(above > below, above - below, 1.0))
            in_doubt = np.maximum(in_doubt, np.minimum(share, 1.0))
    return Enclosure(values, (low, high), _times(_width(low, high), in_doubt))


def _of_one_scale(low: Array, high: Array) -> NDArray[np.bool_]:
    return np.asarray(_within(1.0)(low, high) & _away_from(0.0)(low, high))


def _inside_range(low: Array, high: Array, shares: Array) -> Array:
    """Places at shares (M,) of ranges, evenly spaced near zero and by their logarithms afar."""
    begin, end = (np.arcsinh(10.0 * np.clip(each, -1e100, 1e100)) for each in (low, high))
    places = np.sinh(begin + (end - begin) * shares[:, None]) / 10.0
    return np.asarray(np.clip(places, low, high))


class _Rows(list[Any]):
    """The rows of what a generated function returns."""

    def __init__(self, shape: Sequence[int]) -> None:
        super().__init__(Enclosure.of(0.0) for _ in range(shape[0]))

    def __setitem__(self, row: Any, value: Any) -> None:
        super().__setitem__(row, Enclosure.of(value))


class _Names:
    """A namespace for generated text: functions of enclosures, and others by their samples."""

    def __init__(self, module: Any, functions: Mapping[str, Function]) -> None:
        self._module = module
        vars(self).update(functions)

    def __getattr__(self, name: str) -> Any:
        original = getattr(self._module, name)
        return _of_scale_one(original) if callable(original) else original


def _no_shape(*_: Any) -> tuple[int, ...]:
    """Rows need no shape."""
    return ()


_NAMES_OF_NUMPY = _Names(
    np,
    {
        "abs": _unary(np.abs, _even_bounds(np.abs), _one_sided),
        "arccos": _falling(np.arccos, _inside(0.9), (-1.0, 1.0)),
        "arccosh": _rising(np.arccosh, _away_from(1.0), (1.0, np.inf)),
        "arcsin": _rising(np.arcsin, _inside(0.9), (-1.0, 1.0)),
        "arcsinh": _rising(np.arcsinh, _within(1.2)),
        "arctan": _rising(np.arctan, _within(1.2)),
        "arctanh": _rising(np.arctanh, _inside(0.8), (-1.0, 1.0)),
        "asarray": lambda a, dtype=None: a,
        "broadcast": lambda *_: SimpleNamespace(shape=()),
        "broadcast_shapes": _no_shape,
        "ceil": _rising(np.ceil),
        "cos": _unary(np.cos, _wave_bounds(0.5 * np.pi), _within(_SCALE)),
        "cosh": _unary(np.cosh, _even_bounds(np.cosh), _within(_SCALE)),
        "empty": _Rows,
        "exp": _exp,
        "expm1": _rising(np.expm1, _within(_SCALE)),
        "floor": _rising(np.floor),
        "heaviside": _heaviside,
        "log": _log,
        "log1p": _rising(np.log1p, _away_from(-1.0), (-1.0, np.inf)),
        "logaddexp": _logaddexp,
        "logical_and": lambda a, b: Condition.known(a) & b,
        "logical_not": lambda a: ~Condition.known(a),
        "logical_or": lambda a, b: Condition.known(a) | b,
        "maximum": _extreme(np.maximum),
        "minimum": _extreme(np.minimum),
        "mod": _mod,
        "shape": _no_shape,
        "sign": _rising(np.sign),
        "sin": _unary(np.sin, _wave_bounds(0.0), _within(_SCALE)),
        "sinc": _unary(np.sinc, _sinc_bounds, _within(1.0)),
        "sinh": _rising(np.sinh, _within(_SCALE)),
        "sqrt": _rising(np.sqrt, _away_from(0.0), (0.0, np.inf)),
        "tan": _unary(np.tan, _tan_bounds, _tan_resolved),
        "tanh": _rising(np.tanh, _within(2.0)),
        "where": _where,
        "zeros": _Rows,
    },
)
_NAMES_OF_SPECIAL = _Names(
    special,
    {
        "cosm1": _unary(special.cosm1, _wave_bounds(0.5 * np.pi, 0.0), _within(_SCALE)),
        "erf": _rising(special.erf, _within(1.5)),
        "erfc": _falling(special.erfc, _within(1.5)),
        "expit": _rising(special.expit, _within(4.0)),
    },
)
