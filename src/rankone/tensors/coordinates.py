"""Coordinates of a solution: their scales, and arguments turned into checked values.

Every scale ascends, so that intervals, elements and nodes keep their order. A parameter over
decades is smooth in its logarithm, and one that divides in its reciprocal.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from keyword import iskeyword
from typing import ClassVar

import numpy as np

from rankone.support.arrays import EPSILON, Array
from rankone.support.errors import EvaluationError, OptionError, did_you_mean, listing, quote, shown

# Ratio of the ends of an interval above which its decades are all looked at: its logarithm is the
# first coordinate, and another one has to be better
_DECADES_RATIO = 10.0

_MOST_SLOPE_MODES = 200  # Modes looked at for the slope of a scale: it is analytic on an interval
_NOISE_MODES = 20  # Highest modes, which show the rounding errors of the others
_NOISE_FACTOR = 8.0  # Size of the modes that are left out, over these rounding errors


@dataclass(frozen=True)
class Scale(ABC):
    """A smooth, ascending coordinate s = g(x) of a parameter x."""

    kind: ClassVar[str]

    @abstractmethod
    def to_scale(self, x: Array) -> Array:
        """The coordinate s = g(x), of the shape of x."""

    @abstractmethod
    def from_scale(self, s: Array) -> Array:
        """The parameter x at coordinates s, of their shape."""

    @abstractmethod
    def slope(self, x: Array) -> Array:
        """The derivative ds/dx at x, positive, of the shape of x."""

    def allows(self, lower: float, upper: float) -> bool:
        """Whether the coordinate is finite on the whole interval."""
        return lower < upper

    @property
    def is_identity(self) -> bool:
        return False

    def slope_modes(self, lower: float, upper: float, inverse: bool = False) -> int:
        """Number of modes in s on an interval that the slope ds/dx needs, to rounding.

        ``inverse`` stands for dx/ds, the density of x over s.
        """
        if self.is_identity:
            return 1
        start, end = self.to_scale(np.array([lower, upper]))
        angles = np.pi * (np.arange(_MOST_SLOPE_MODES) + 0.5) / _MOST_SLOPE_MODES
        slopes = self.slope(self.from_scale(start + 0.5 * (end - start) * (1.0 + np.cos(angles))))
        modes = np.cos(np.arange(_MOST_SLOPE_MODES)[:, None] * angles)
        spectrum = np.abs(modes @ (1.0 / slopes if inverse else slopes))
        noise = _NOISE_FACTOR * spectrum[-_NOISE_MODES:].max()
        significant = spectrum > max(4.0 * EPSILON * spectrum.max(), noise)
        return int(np.flatnonzero(significant)[-1]) + 1


@dataclass(frozen=True)
class Identity(Scale):
    """The parameter itself."""

    kind = "linear"

    def to_scale(self, x: Array) -> Array:
        return x

    def from_scale(self, s: Array) -> Array:
        return s

    def slope(self, x: Array) -> Array:
        return np.ones_like(x)

    @property
    def is_identity(self) -> bool:
        return True


@dataclass(frozen=True)
class Logarithm(Scale):
    """The natural logarithm of a positive parameter."""

    kind = "log"

    def to_scale(self, x: Array) -> Array:
        return np.asarray(np.log(x))

    def from_scale(self, s: Array) -> Array:
        return np.asarray(np.exp(s))

    def slope(self, x: Array) -> Array:
        return 1.0 / x

    def allows(self, lower: float, upper: float) -> bool:
        return 0.0 < lower < upper


@dataclass(frozen=True)
class Reciprocal(Scale):
    """Minus one over a parameter that does not change its sign: the minus makes it ascend."""

    kind = "reciprocal"

    def to_scale(self, x: Array) -> Array:
        return -1.0 / x

    def from_scale(self, s: Array) -> Array:
        return -1.0 / s

    def slope(self, x: Array) -> Array:
        return 1.0 / (x * x)

    def allows(self, lower: float, upper: float) -> bool:
        return 0.0 < lower < upper or lower < upper < 0.0


IDENTITY = Identity()
SCALES: dict[str, Scale] = {each.kind: each for each in (IDENTITY, Logarithm(), Reciprocal())}
"""The scales by the words that users write."""


def first_scale(lower: float, upper: float) -> Scale:
    """The coordinate in which a parameter is looked at before anything else is known of it."""
    decades = lower > 0.0 and upper > _DECADES_RATIO * lower
    return Logarithm() if decades else IDENTITY


# -----------------------------------------------------------------------------
# Intervals with a scale: a parameter that is uniform in its logarithm or its reciprocal.
#
# ``(1e-3, 10, "log")`` means the measure: decades are equally likely. It travels as the text of the
# distribution of scipy.stats that says the same, and its word is the scale of the coordinate.


LINEAR, LOG, RECIPROCAL = Identity.kind, Logarithm.kind, Reciprocal.kind

Interval = tuple[float, float]

# Distributions as `measure_text` writes them
_WRITTEN = {
    LOG: re.compile(r"loguniform\([^,=()]+, [^,=()]+\)"),
    RECIPROCAL: re.compile(r"truncpareto\(1\.0, [^,=()]+, 0\.0, [^,=()]+\)"),
}


def split(bounds: object) -> tuple[object, str | None]:
    """The bounds of an interval as a user writes it, and the word of a scale at its end."""
    if isinstance(bounds, tuple | list) and len(bounds) == 3 and isinstance(bounds[2], str):
        return bounds[:2], bounds[2]
    return bounds, None


def check_scale(parameter: str, interval: Interval, word: str) -> str:
    """The word of a scale that an interval can have; an OptionError otherwise."""
    lower, upper = interval
    subject = f"the scale of parameter {quote(parameter)}"
    if word not in SCALES:
        raise OptionError(
            f"{subject} is {shown(word)}{did_you_mean(word, SCALES)}",
            term=word,
            remedy=f"write {LINEAR!r}, {LOG!r} or {RECIPROCAL!r}",
        )
    if word != LINEAR and lower <= 0.0:
        raise OptionError(
            f"{subject} is {word!r}, but its interval ({lower:g}, {upper:g}) is not above zero",
            term=word,
            remedy="let it begin above zero, or leave the scale out",
        )
    return word


def measure_text(word: str, interval: Interval) -> str | None:
    """The distribution that is uniform in a scale, as text of scipy.stats; None if it is plain.

    The density of a uniform logarithm is 1/x, that of a uniform reciprocal 1/x^2.
    """
    lower, upper = map(float, interval)
    if word == LOG:
        return f"loguniform({lower!r}, {upper!r})"
    if word == RECIPROCAL:
        return f"truncpareto(1.0, {upper / lower!r}, 0.0, {lower!r})"
    return None


def written_scale(text: str | None) -> str | None:
    """The word for the measure that a text names; None for another distribution or no text."""
    words = (word for word, form in _WRITTEN.items() if text and form.fullmatch(text))
    return next(words, None)


def with_measure(text: str, distribution: str | None) -> str:
    """``k in [1, 2]`` with its scale behind it, or with its distribution."""
    if not distribution:
        return text
    word = written_scale(distribution)
    return f"{text} ({word})" if word else f"{text} ~ {distribution}"


def moved_measures(
    distributions: Iterable[tuple[str, str]],
    intervals: Mapping[str, Interval],
    words: Mapping[str, str],
) -> tuple[tuple[str, str], ...]:
    """Distributions by parameter after a move to other intervals, some with a word of their own.

    A scale stays on another interval above zero, and is dropped on one that is not; other
    distributions stay as they are, to be cut.
    """
    texts = dict(distributions)
    moved: list[tuple[str, str]] = []
    for name, interval in intervals.items():
        text = texts.get(name)
        word = words.get(name, written_scale(text))
        if word is not None:
            text = measure_text(word if interval[0] > 0.0 else LINEAR, interval)
        if text is not None:
            moved.append((name, text))
    return tuple(moved)


def evenly_on_scale(scale: Scale, interval: Interval, count: int) -> Array:
    """Values (count,) that are evenly spaced on a scale, both ends included."""
    if scale.is_identity:
        return np.linspace(*interval, count)
    return on_scale(scale, interval, np.linspace(0.0, 1.0, count))


def on_scale(scale: Scale, interval: Interval, shares: Array) -> Array:
    """Values at shares in [0, 1] of an interval in the coordinate of a scale, ends included."""
    lower, upper = interval
    if scale.is_identity:
        return np.asarray(lower + (upper - lower) * shares)
    first, last = scale.to_scale(np.array(interval, dtype=float))
    points = np.clip(scale.from_scale(first + (last - first) * shares), lower, upper)
    return np.asarray(np.where(shares == 1.0, upper, np.where(shares == 0.0, lower, points)))


# -----------------------------------------------------------------------------
# Arguments of a solution: names and values turned into checked coordinates.
#
# Symbols are recognised by what they offer (a name, a function, a derivative), so that solutions
# work without SymPy.


__all__ = [
    "IDENTITY",
    "SCALES",
    "Coordinates",
    "Curves",
    "Identity",
    "Logarithm",
    "Reciprocal",
    "Scale",
    "first_scale",
    "name_of",
    "round_off",
]

_MISSING = object()


def round_off(lower: float, upper: float) -> float:
    """How far outside an interval a value still counts as its end."""
    return float(max(1e-12 * (upper - lower), 4.0 * np.spacing(max(abs(lower), abs(upper)))))


def name_of(key: object, time: str | None = None) -> str:
    """The name of a symbol, an applied function ``x(t)`` or its time derivative ``x(t).diff(t)``.

    A derivative has the name of its state: ``x_t``, ``x_tt``, ... Functions of anything but
    ``time`` are refused if it is given.
    """
    if isinstance(key, str):
        return str(key)
    order = getattr(key, "derivative_count", None)
    if order is not None:
        variables = {str(variable) for variable in getattr(key, "variables", ())}
        if time is None or variables == {time}:
            return name_of(getattr(key, "expr", None), time) + "_" + "t" * int(order)
    elif isinstance(getattr(key, "args", None), tuple) and key.args:  # type: ignore[attr-defined]
        name = getattr(getattr(key, "func", None), "__name__", None)
        if isinstance(name, str) and (time is None or [*map(str, key.args)] == [time]):  # type: ignore[attr-defined]
            return name
    else:
        name = getattr(key, "name", None)
        if isinstance(name, str):
            return name
    raise EvaluationError(
        f"`{key}` is not a name, a symbol or a function of `{time or 't'}`",
        term=key,
        remedy="use the symbols of the problem, or their names as text",
    )


@dataclass(frozen=True)
class Curves:
    """Points (d, N) of the parameters, each with its times, from arrays that broadcast together.

    ``times`` has the shape (T, N), or (T, 1) for times of all points. ``sizes`` are the axes of the
    broadcast shape: first those that make T, then those that make N; ``order`` has their places.
    """

    times: Array
    points: Array
    sizes: tuple[int, ...]
    order: tuple[int, ...]

    def shaped(self, values: Array) -> Array:
        """Values (rows, T, N) in the broadcast shape: (rows, *shape)."""
        back = (0, *(1 + axis for axis in np.argsort(self.order).tolist()))
        return np.ascontiguousarray(values.reshape(len(values), *self.sizes).transpose(back))


class Coordinates:
    """The coordinates of a solution, time first, with the interval of each.

    If nothing depends on time (``timeless``), calls give no time; the start stands for all times.
    """

    def __init__(
        self,
        names: Sequence[str],
        intervals: Sequence[tuple[float, float]],
        *,
        timeless: bool = False,
    ) -> None:
        self.names = tuple(names)
        self.intervals = tuple((float(lower), float(upper)) for lower, upper in intervals)
        self.asked = self.names[1:] if timeless else self.names
        self._known = [self.intervals[0][0]] if timeless else []
        self._index = {name: i for i, name in enumerate(self.names) if name in self.asked}

    def gather(self, at: Sequence[object], named: Mapping[str, object]) -> list[object]:
        """Put the arguments of a call in order: one for each coordinate.

        Positional arguments ``at`` are times, or a mapping from names or symbols to values, or both
        in this order; None is ignored. ``named`` are keyword arguments.
        """
        # the usual call: everything by keyword and nothing wrong
        if not at and len(named) == len(self.asked):
            try:
                return [*self._known, *(named[name] for name in self.asked)]
            except KeyError:
                pass
        gathered: list[object] = [*self._known, *(_MISSING for _ in self.asked)]
        for key, value in self._pairs(at, named):
            name = name_of(key, self.names[0])
            index = self._index.get(name)
            if index is None and name == self.names[0]:
                raise EvaluationError(
                    f"`{name}` is given, but the values do not depend on time",
                    term=name,
                    remedy=f"give values for {listing(self.asked)} alone" if self.asked else "",
                )
            if index is None:
                raise EvaluationError(
                    f"unknown name `{name}`{did_you_mean(name, self.asked)}; "
                    f"the coordinates are {listing(self.asked)}",
                    term=name,
                )
            if gathered[index] is not _MISSING:
                raise EvaluationError(f"`{name}` is given twice", term=name, remedy="give it once")
            gathered[index] = value
        missing = [
            name for name, value in zip(self.names, gathered, strict=True) if value is _MISSING
        ]
        if missing:
            raise EvaluationError(
                f"no value for {listing(missing)}; the coordinates are {listing(self.asked)}",
                term=missing,
                remedy="give a value for each coordinate",
            )
        return gathered

    def _pairs(
        self, at: Sequence[object], named: Mapping[str, object]
    ) -> Iterator[tuple[object, object]]:
        if len(at) > 2:
            raise EvaluationError(
                f"{len(at)} arguments were given by position; these can be times and a mapping",
                remedy=f"give parameters by name: {self._example()}",
            )
        for position, argument in enumerate(at):
            if isinstance(argument, Mapping):
                yield from argument.items()
            elif argument is not None and position == 0:
                yield self.names[0], argument
            elif argument is not None:
                raise EvaluationError(
                    f"the second argument is {argument!r}, not a mapping from parameters to values",
                    term=argument,
                    remedy=f"give parameters by name: {self._example()}",
                )
        yield from named.items()

    def _example(self) -> str:
        middle = [f"{0.5 * (lower + upper):g}" for lower, upper in self.intervals]
        pairs = zip(self.asked, middle[-len(self.asked) :], strict=False)
        if all(name.isidentifier() and not iskeyword(name) for name in self.asked):
            return f"solution({', '.join(f'{name}={at}' for name, at in pairs)})"
        return f"solution({{{', '.join(f'{name!r}: {at}' for name, at in pairs)}}})"

    def numbers(self, gathered: Sequence[object]) -> list[float] | None:
        """Return plain numbers inside the intervals; None where :meth:`arrays` must decide."""
        numbers = []
        for value, (lower, upper) in zip(gathered, self.intervals, strict=True):
            if not isinstance(value, float | int) or not lower <= value <= upper:
                return None
            numbers.append(float(value))
        return numbers

    def as_arrays(self, gathered: Sequence[object]) -> list[Array]:
        """Each value as an array; those that are arrays are not copied, and not checked yet."""
        return [
            self._real(name, value)
            if not isinstance(value, np.ndarray) or value.dtype.kind == "O"
            else value
            if isinstance(value, np.ma.MaskedArray)
            else np.asarray(value)
            for name, value in zip(self.names, gathered, strict=True)
        ]

    def arrays(self, gathered: Sequence[object]) -> list[Array]:
        """Each value as an array of numbers inside its interval.

        Values outside by round-off are moved to the end of the interval.
        """
        return [self.checked(index, value) for index, value in enumerate(gathered)]

    def checked(self, index: int, value: object) -> Array:
        """The values of one coordinate as an array of numbers inside its interval."""
        name, (lower, upper) = self.names[index], self.intervals[index]
        array = self._real(name, value)
        if not array.size:
            return array
        smallest, largest = array.min(), array.max()
        if smallest >= lower and largest <= upper:
            return array
        slack = round_off(lower, upper)
        if smallest >= lower - slack and largest <= upper + slack:
            return np.clip(array, lower, upper)
        interval = f"[{lower:.12g}, {upper:.12g}]"
        if np.isnan(array).any():
            what = "is NaN" if array.size == 1 else "has NaN among its values"
            raise EvaluationError(f"`{name}` {what}", term=name, remedy=f"its range is {interval}")
        outside = array[(array < lower - slack) | (array > upper + slack)]
        worst = outside[np.argmax(np.abs(outside - 0.5 * (lower + upper)))]
        many = f" (the farthest of {outside.size} such values)" if outside.size > 1 else ""
        where = "horizon" if index == 0 else "range"
        raise EvaluationError(
            f"`{name}` = {worst:.12g} is outside its {where} {interval}{many}",
            term=name,
            remedy="nothing is extrapolated; choose values inside",
        )

    @staticmethod
    def _real(name: str, value: object) -> Array:
        if np.ma.is_masked(value):
            raise EvaluationError(
                f"`{name}` has values that are masked",
                term=name,
                remedy="leave them out (compressed()) or fill them (filled(...))",
            )
        try:
            array = np.asarray(value)
            is_text = array.dtype.kind == "O" and any(
                isinstance(v, str | bytes) for v in array.flat
            )
            if array.dtype.kind in "biufO" and value is not None and not is_text:
                return np.asarray(array, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            pass
        raise EvaluationError(
            f"`{name}` is {shown(value)}, not a real number or an array of real numbers", term=name
        )

    def broadcast(self, arrays: Sequence[Array]) -> tuple[Array, tuple[int, ...]]:
        """Broadcast together: paired points (coordinates, N) and the shape they stand for."""
        shape = self.common_shape(arrays)
        points = np.empty((len(arrays), *shape))
        for row, array in enumerate(arrays):
            points[row] = array
        return points.reshape(len(arrays), -1), shape

    def curves(self, arrays: Sequence[Array]) -> Curves:
        """Broadcast together, but the parameters apart from times that vary alone."""
        shape = self.common_shape(arrays)
        time, *parameters = (
            array.reshape((1,) * (len(shape) - array.ndim) + array.shape) for array in arrays
        )
        sizes = np.broadcast_shapes((1,) * len(shape), *(array.shape for array in parameters))
        # axes along which no parameter varies first
        order = sorted(range(len(shape)), key=lambda axis: sizes[axis] != 1)
        several = sum(size == 1 for size in sizes)
        own = [shape[axis] for axis in order[:several]]
        shared = tuple(sizes[axis] for axis in order[several:])
        points = np.empty((len(parameters), *shared))
        for row, array in enumerate(parameters):
            points[row] = array.transpose(order)[(0,) * several]
        times = time.transpose(order)
        if any(size != 1 for size in times.shape[several:]):
            times = np.broadcast_to(times, (*own, *shared))
        return Curves(
            times.reshape(math.prod(own), math.prod(times.shape[several:])),
            points.reshape(len(points), math.prod(shared)),
            (*own, *shared),
            tuple(order),
        )

    def common_shape(self, arrays: Sequence[Array]) -> tuple[int, ...]:
        """The shape to which arrays of all coordinates broadcast, or an EvaluationError."""
        try:
            return np.broadcast_shapes(*(array.shape for array in arrays))
        except ValueError:
            shapes = ", ".join(
                f"`{name}` {array.shape}" for name, array in zip(self.names, arrays, strict=True)
            )
            raise EvaluationError(
                f"the shapes do not broadcast together: {shapes}",
                remedy="use equal shapes, or `grid` for every combination of values",
            ) from None

    def axes(self, gathered: Sequence[object]) -> list[Array]:
        """Each value as a one-dimensional axis of a tensor grid; numbers have length one."""
        axes = [np.atleast_1d(array) for array in self.arrays(gathered)]
        for name, axis in zip(self.names, axes, strict=True):
            if axis.ndim > 1:
                raise EvaluationError(
                    f"`{name}` has the shape {axis.shape}; an axis of a grid has one dimension",
                    term=name,
                )
        return axes
