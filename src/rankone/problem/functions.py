"""Functions that SymPy does not know: of data, of the user, and of a whole function of time.

All are SymPy function classes, to be applied in expressions like ``sin``. Tables and users'
functions have values and derivatives; a table is written into generated source as data, a user's
function is handed to the generated module by name. Maxima, durations and crossings are understood
by :meth:`rankone.Solution.output`.
"""

from __future__ import annotations

import copyreg
import hashlib
import keyword
import unicodedata
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from functools import cache
from typing import Any, ClassVar, TypeVar

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from sympy.core.function import ArgumentIndexError, FunctionClass

from rankone.support.arrays import Array
from rankone.support.errors import ProblemError, quote, shown
from rankone.support.files import WIDTH
from rankone.trajectories.system import features

_KINDS = ("linear", "cubic", "previous")
_NUMBERS_PER_LINE = 8  # Numbers in each line of an array that does not fit into one


class _DataFunctionClass(FunctionClass):  # type: ignore[misc]
    """The class of function classes made from data: they are pickled by their data."""

    reconstruction: tuple[Callable[..., type], tuple[object, ...]]
    _imp_: Callable[..., Array]


def _reduced(function_class: type) -> object:
    """How pickle makes a class again from its data; the base classes are pickled by name."""
    return function_class.__dict__.get("reconstruction", function_class.__name__)


copyreg.pickle(_DataFunctionClass, _reduced)  # type: ignore[arg-type]


F = TypeVar("F", bound="DataFunction")


class DataFunction(sp.Function, metaclass=_DataFunctionClass):  # type: ignore[misc]
    """A function that has only numbers as values: the base of tables and users' functions."""

    @classmethod
    def written(cls) -> str:
        """The name of the function in generated source."""
        return features.PREFIX + str(cls.__name__)

    @classmethod
    def definition(cls) -> list[str]:
        """Source lines that define it; none if the module receives it."""
        return []

    def _eval_is_extended_real(self) -> bool:
        return True

    def _numpy_text(self, printer: sp.printing.printer.Printer) -> str:
        return f"{self.written()}({', '.join(str(printer._print(a)) for a in self.args)})"


def _new_class(
    base: type[F],
    data: Mapping[str, object],
    constructor: Callable[..., type[F]],
    arguments: tuple[Any, ...],
) -> type[F]:
    """A class of functions with its data; ``constructor(*arguments)`` makes it again."""
    members = {**data, "reconstruction": (constructor, arguments), "__module__": __name__}
    function_class: type[F] = _DataFunctionClass(arguments[0], (base,), members)
    return function_class


class Table(DataFunction):
    """A function given by values at ascending points, NaN outside; ``order`` is of derivatives."""

    points: ClassVar[tuple[float, ...]]
    values: ClassVar[tuple[float, ...]]
    kind: ClassVar[str]
    order: ClassVar[int]

    @classmethod
    def definition(cls) -> list[str]:
        """Source lines that define it."""
        points, values = f"{features.POINTS}{cls.__name__}", f"{features.VALUES}{cls.__name__}"
        lines = [*_array(points, cls.points), *_array(values, cls.values)]
        if cls.kind == "linear":
            interpolated = f"np.interp(inside, {points}, {values})"
        elif cls.kind == "previous":
            interpolated = f'{values}[np.searchsorted({points}, inside, side="right") - 1]'
        else:
            lines.append(f"SPLINE_{cls.__name__} = CubicSpline({points}, {values})")
            order = f", {cls.order}" if cls.order else ""
            interpolated = f"SPLINE_{cls.__name__}(inside{order})"
        near = features.AT_THE_ENDS * (cls.points[-1] - cls.points[0])
        return [
            *lines,
            "",
            "",
            f"def {cls.written()}(x):",
            f'    """Table of {len(cls.points)} values, {cls.kind}; NaN outside it."""',
            f"    inside = np.clip(x, {points}[0], {points}[-1])",
            f"    value = {interpolated}",
            f"    return np.where(abs(inside - x) <= {near!r}, value, np.nan)",
        ]

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """The derivative: slopes, the spline's derivative, zero for steps."""
        (argument,) = self.args
        if self.kind == "previous":
            return sp.S.Zero
        name = f"{type(self).__name__}_slope"
        if self.kind == "cubic":
            return _table_class(name, self.points, self.values, "cubic", self.order + 1)(argument)
        slopes = np.diff(self.values) / np.diff(self.points)
        steps = (*slopes.tolist(), float(slopes[-1]))
        return _table_class(name, self.points, steps, "previous", 0)(argument)


def table(
    times: Sequence[float] | Array,
    values: Sequence[float] | Array,
    kind: str = "linear",
    *,
    name: str | None = None,
) -> type[Table]:
    """A function given by data, for right-hand sides: ``f(t)``, ``f(k)`` or ``f(x)``.

    Parameters
    ----------
    times : sequence of float
        Ascending points, at least two.
    values : sequence of float
        The value at each.
    kind : {"linear", "cubic", "previous"}
        Straight lines between the points, a cubic spline (not-a-knot), or the value of the last
        point before.
    name : str, optional
        How it is shown; by default ``table_`` and some digits that depend on the data.

    Returns
    -------
    A SymPy function class of one argument, with value and derivative.

    Raises
    ------
    ProblemError
        If the points do not ascend, numbers are not finite, or there are not as many values.
    """
    points, heights = _floats("times", times), _floats("values", values)
    if len(points) < 2 or len(points) != len(heights):
        raise ProblemError(
            f"a table has {len(points)} times and {len(heights)} values",
            term=times,
            remedy="give as many values as times, at least two",
        )
    place = next((k for k in range(len(points) - 1) if points[k] >= points[k + 1]), None)
    if place is not None:
        raise ProblemError(
            f"the times of a table do not ascend: {points[place]:g} is followed by "
            f"{points[place + 1]:g}",
            term=times,
            remedy="sort them and leave out repetitions",
        )
    if not isinstance(kind, str) or kind not in _KINDS:
        raise ProblemError(
            f"kind={kind!r} is unknown", term=kind, remedy=f"choose from {', '.join(_KINDS)}"
        )
    if not _representable(points, heights, kind):
        raise ProblemError(
            f"the numbers of a table are too large, or its times too close, for kind={kind!r}",
            term=values,
            remedy="change the units, or leave out points",
        )
    if name is None:
        data = np.array([points, heights]).tobytes() + kind.encode()
        name = f"table_{hashlib.sha256(data).hexdigest()[:6]}"
    check_name(name)
    return _table_class(name, points, heights, kind, 0)


@cache
def _table_class(
    name: str, points: tuple[float, ...], values: tuple[float, ...], kind: str, order: int
) -> type[Table]:
    """The class of a table; the same data give the same class."""
    data = {"nargs": 1, "points": points, "values": values, "kind": kind, "order": order}
    table_class = _new_class(Table, data, _table_class, (name, points, values, kind, order))
    namespace: dict[str, Any] = {"np": np, "CubicSpline": CubicSpline}
    exec("\n".join(table_class.definition()), namespace)
    table_class._imp_ = staticmethod(namespace[table_class.written()])
    return table_class


class UserFunction(DataFunction):
    """A function of the user, by a callable on arrays; derivatives have none themselves."""

    derivatives: ClassVar[tuple[Callable[..., object], ...]]

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """The derivative, another function of the user."""
        if not self.derivatives:
            raise ArgumentIndexError(self, argindex)
        name = f"{type(self).__name__}_{argindex}"
        slope = self.derivatives[argindex - 1]
        return _user_class(name, slope, (), len(self.args))(*self.args)


def function(
    name: str,
    value: Callable[..., object],
    derivative: Callable[..., object] | Sequence[Callable[..., object]],
) -> type[UserFunction]:
    """A function of the user for right-hand sides, with its derivative.

    Parameters
    ----------
    name : str
        How it is shown.
    value : callable
        Maps arrays of one shape, one for each argument, to an array of that shape.
    derivative : callable or sequence of callable
        The same for the derivative with respect to each argument.

    Returns
    -------
    A SymPy function class with as many arguments as there are derivatives.

    Raises
    ------
    ProblemError
        If something given is not a function.
    """
    check_name(name)
    several = isinstance(derivative, Sequence)
    derivatives = tuple(derivative) if isinstance(derivative, Sequence) else (derivative,)
    callables = (value, *derivatives)
    if not derivatives or not all(callable(f) and isinstance(f, Hashable) for f in callables):
        slopes = "derivatives" if several else "derivative"
        raise ProblemError(
            f"value and {slopes} of function {quote(name)} are not all callable (and hashable)",
            term=name,
            remedy="give value=f and derivative=df, callables on NumPy arrays",
        )
    return _user_class(name, value, derivatives, len(derivatives))


@cache
def _user_class(
    name: str,
    value: Callable[..., object],
    derivatives: tuple[Callable[..., object], ...],
    arguments: int,
) -> type[UserFunction]:
    """The class of a function of the user; the same callables give the same class."""
    data = {"nargs": arguments, "derivatives": derivatives}
    key = name, value, derivatives, arguments
    user_class = _new_class(UserFunction, data, _user_class, key)
    user_class._imp_ = staticmethod(features.GuardedFunction(name, value))
    return user_class


def nodes_of(expressions: Iterable[sp.Basic], *kinds: type) -> set[sp.Basic]:
    """The nodes of some kinds in expressions.

    What occurs often is looked at once: written out, sides of switches that depend on each other
    have a thousand times as many nodes as there are.
    """
    visited, waiting = set[sp.Basic](), [*expressions]
    while waiting:
        node = waiting.pop()
        if node not in visited:
            visited.add(node)
            waiting += node.args
    return {node for node in visited if isinstance(node, kinds)}


def known_applied(expressions: Iterable[sp.Basic]) -> list[DataFunction]:
    """The tables and users' functions applied in expressions, in a fixed order."""
    return sorted(nodes_of(expressions, DataFunction), key=sp.default_sort_key)


def check_distinct(expressions: Iterable[sp.Basic]) -> None:
    """Raise a ProblemError if two tables or users' functions go by one name in source."""
    classes: dict[str, type[DataFunction]] = {}
    for applied in known_applied(expressions):
        slopes = [applied.fdiff(k + 1) for k in range(len(applied.args))]
        for f in (applied, *(slope for slope in slopes if isinstance(slope, DataFunction))):
            if classes.setdefault(f.written(), type(f)) is not type(f):
                raise ProblemError(
                    f"{quote(f.func)} names two tables or functions, or a derivative",
                    term=f,
                    remedy="give them names that differ",
                )


def namespace_of(expressions: Iterable[sp.Basic]) -> Mapping[str, Callable[..., object]]:
    """The users' functions and their derivatives, by their names in generated source."""
    namespace: dict[str, Callable[..., object]] = {}
    for applied in known_applied(expressions):
        if isinstance(applied, UserFunction):
            slopes = [applied.fdiff(k + 1) for k in range(len(applied.derivatives))]
            namespace |= {f.written(): f._imp_ for f in (applied, *slopes)}
    return namespace


def _floats(argument: str, sequence: ArrayLike) -> tuple[float, ...]:
    """A tuple of finite floats, or an error."""
    try:
        if np.ma.is_masked(sequence) or np.iscomplexobj(sequence):
            raise TypeError
        floats = np.asarray(sequence, dtype=float)
    except (OverflowError, TypeError, ValueError):
        floats = np.full(1, np.nan)
    if floats.ndim != 1 or not np.isfinite(floats).all():
        raise ProblemError(
            f"the {argument} of a table are not finite real numbers in one row",
            term=sequence,
            remedy="give sequences of numbers",
        )
    return tuple(floats.tolist())


def check_name(name: object) -> None:
    """Raise a ProblemError unless this is a name that Python reads as it is written."""
    if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name):
        raise ProblemError(
            f"{shown(name)} is not a name", term=name, remedy="use a Python identifier"
        )
    normal = unicodedata.normalize("NFKC", name)
    if normal != name:
        raise ProblemError(
            f"Python reads the name {name!r} as {normal!r}", term=name, remedy=f"use {normal!r}"
        )


def _representable(points: tuple[float, ...], values: tuple[float, ...], kind: str) -> bool:
    """Whether all numbers that a table is evaluated with are finite."""
    with np.errstate(all="ignore"):
        coefficients = np.diff(points[:: len(points) - 1])
        if kind == "linear":
            coefficients = np.append(coefficients, np.diff(values) / np.diff(points))
        if kind == "cubic":
            try:
                coefficients = np.append(coefficients, CubicSpline(points, values).c)
            except (ValueError, np.linalg.LinAlgError):
                return False
    return bool(np.isfinite(coefficients).all())


def _array(name: str, numbers: tuple[float, ...]) -> list[str]:
    """An array bound to a name, several numbers in a line."""
    digits = [repr(value).replace("e+", "e") for value in numbers]
    line = f"{name} = np.array([{', '.join(digits)}])"
    if len(line) <= WIDTH:
        return [line]
    rows = [digits[k : k + _NUMBERS_PER_LINE] for k in range(0, len(digits), _NUMBERS_PER_LINE)]
    return [
        "# fmt: off",
        f"{name} = np.array([",
        *(f"    {', '.join(row)}," for row in rows),
        "])",
        "# fmt: on",
    ]


_SIGNS = {"rising": 1, "falling": -1, "both": 0}


class maximum(sp.Function):  # type: ignore[misc]
    """The largest value over time of an expression, in :meth:`rankone.Solution.output`.

    Examples
    --------
    >>> import sympy as sp
    >>> t = sp.Symbol("t")
    >>> maximum(sp.Function("x")(t))
    maximum(x(t))
    """

    nargs = 1


class minimum(sp.Function):  # type: ignore[misc]
    """The smallest value over time of an expression, in :meth:`rankone.Solution.output`."""

    nargs = 1


class duration(sp.Function):  # type: ignore[misc]
    """For how long an expression is positive, in :meth:`rankone.Solution.output`.

    ``duration(x - level)`` is the time that x is above a level.
    """

    nargs = 1


class first_crossing(sp.Function):  # type: ignore[misc]
    """The first time at which an expression crosses a level.

    ``first_crossing(x, level, direction)`` in :meth:`rankone.Solution.output`. The level, 0 by
    default, is a number or an expression of parameters and time; the direction is "rising" or 1,
    "falling" or -1, "both" or 0. An expression that only begins at the level does not cross it; nor
    does one that exceeds it by less than ten times the tolerance times its largest distance.
    """

    nargs = (1, 2, 3)

    def __new__(
        cls,
        expression: object,
        level: object = None,
        direction: object = None,
        **options: object,
    ) -> sp.Expr:
        further = [0 if level is None else level, direction]
        if direction is None:
            further = [] if level is None else [level]
        return super().__new__(cls, expression, *further, **options)

    @property
    def parts(self) -> tuple[sp.Expr, sp.Expr]:
        """What crosses zero, and the direction."""
        expression, level, direction = (*self.args, sp.S.Zero, sp.S.Zero)[:3]
        return expression - level, sp.sympify(_SIGNS.get(str(direction), direction))


class at_event(sp.Function):  # type: ignore[misc]
    """An expression where an event occurs, in :meth:`rankone.Solution.output`.

    ``at_event(x, "bounce", 0, "before")``: occurrences count from 0, negative ones from the last;
    the side is "before" or "after" what the event resets.

    Examples
    --------
    >>> import sympy as sp
    >>> t = sp.Symbol("t")
    >>> at_event(sp.Function("x")(t), "ground")
    at_event(x(t), ground, 0, before)
    """

    nargs = 4

    def __new__(
        cls,
        expression: object,
        event: object,
        occurrence: object = 0,
        side: object = "before",
        **options: object,
    ) -> sp.Expr:
        words = (sp.Symbol(str(word)) for word in (event, side))
        name, where = words
        return super().__new__(cls, sp.sympify(expression), name, sp.sympify(occurrence), where)


class event_time(sp.Function):  # type: ignore[misc]
    """The time at which an event occurs, in :meth:`rankone.Solution.output`.

    ``event_time("bounce", 0)``: occurrences count from 0, negative ones from the last. It may be a
    limit of an integral over time.
    """

    nargs = 2

    def __new__(cls, event: object, occurrence: object = 0, **options: object) -> sp.Expr:
        return super().__new__(cls, sp.Symbol(str(event)), sp.sympify(occurrence))
