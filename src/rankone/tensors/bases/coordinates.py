"""Arguments of a solution: names and values turned into checked coordinates.

Symbols are recognised by what they offer (a name, a function, a derivative), so that solutions
work without SymPy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from keyword import iskeyword

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError
from rankone.support.wording import did_you_mean, listing, shown

__all__ = ["Coordinates", "Curves", "name_of", "round_off"]

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
