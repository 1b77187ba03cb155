"""Arrays, the numbers that all rooms share, and results as tables and data sets.

A room has a number of its own only where another one changes a verdict or the work.
"""

from __future__ import annotations

import html
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from rankone.support.errors import html_table, optional_module, text_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


EPSILON = float(np.finfo(float).eps)
"""Spacing of the floating-point numbers at 1."""
TINY = float(np.finfo(float).tiny)
"""Smallest normal number: what a size that may be zero is raised to before it divides."""
ROUNDING = 64.0 * EPSILON
"""Error of a number that a few operations made of rounded ones, about 1e-14."""
ACCUMULATED = 512.0 * EPSILON
"""Error of what a long computation makes of them, about 1e-13."""
COINCIDENT = 4096.0 * EPSILON
"""Difference below which two times or places are one, about 1e-12, in sizes of these."""
LEAST = TINY / ROUNDING
"""Smallest size with digits: its rounding errors still are numbers."""
LEAST_SQUARED = LEAST**0.5
"""Smallest size whose square has digits."""
NEGLIGIBLE = 1e-9
"""Share below which a difference counts as none; about the error of the tightest solve."""
SAME = 1e-6
"""Difference below which two outcomes of a computation are one, in sizes of these."""
RESOLVED = 1e-7
"""Share of a size down to which trajectories, and what is made of them, have relative accuracy."""
COARSE = 1e-3
"""Relative tolerance of what only has to show its shape, and share of a size that is small."""
MINOR = 0.1
"""Share of a tolerance, a budget or a length that hardly shows beside the whole."""
EXACT_DIGITS = 20
"""Decimal digits of numbers that stand for exact ones: a few more than floats hold."""
MANY_STATES = 64
"""States from which on tables and sparse matrices serve better than a line and a row for each."""
MOST_NUMBERS = 20_000_000
"""Numbers of the largest array that a table or a grid may need: 160 MB."""
AT_ONCE = 1 << 19
"""Numbers of a large array that are held at once where it is made piece by piece: 4 MB."""
FEW = 4
"""Terms, or branches, up to which each one is looked at, or written out."""
SAMPLES = 64
"""Points, or times, that show what is smooth: its size, its sign, and whether it holds."""
MANY_SAMPLES = 4096
"""Those among which changes of sign, narrow places and quantiles are looked for."""
MOST_ROUNDS = 100
"""Repetitions after which what ends in a few has failed."""
SEED = 20140
"""Of points that only have to be spread: the same call always has the same ones."""
DIFFERENCE = EPSILON ** (1.0 / 3.0)
"""Step of central differences, in sizes of what is changed: rounding and curvature err alike."""


# -----------------------------------------------------------------------------
# Arrays: their types, points of a cube, bisection, and tuples that are made when first read.


Array = NDArray[np.float64]
"""Real numbers."""

HALVINGS = 60
"""Bisections of an interval to the last digit."""
_MOST_OF_SEQUENCE = 2  # Coordinates up to which a sequence is even in every direction


def sequence(count: int, d: int, generator: np.random.Generator) -> Array:
    """Points (count, d) of the unit cube of which the first few are even as well.

    Shifted multiples of powers of 1/φ, the real root of φ^(d + 1) = φ + 1 (additive recurrence;
    M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018). In more than two
    coordinates they are on few hyperplanes in some direction.
    """
    phi = 2.0
    for _ in range(HALVINGS):
        phi = (1.0 + phi) ** (1.0 / (d + 1))
    steps = phi ** -np.arange(1.0, d + 1.0)
    return np.asarray((generator.random(d) + np.outer(np.arange(1, count + 1), steps)) % 1.0)


def spread(count: int, d: int, generator: np.random.Generator) -> Array:
    """Points (count, d) of the unit cube, more even than random ones in every direction.

    Those of :func:`sequence` in one and two coordinates, where no direction is bad; else a Latin
    hypercube: each coordinate has one point in each of ``count`` intervals, in an order of its own
    (McKay, Beckman & Conover, "A comparison of three methods for selecting values of input
    variables", Technometrics 21, 1979). ``docs/decisions/check-points.md`` has figures.
    """
    if d <= _MOST_OF_SEQUENCE:
        return sequence(count, d, generator)
    order = np.tile(np.arange(count, dtype=float), (d, 1))
    return np.asarray((generator.permuted(order, axis=1).T + generator.random((count, d))) / count)


def lobatto(count: int) -> Array:
    """Chebyshev-Lobatto points of [0, 1]: both ends, and closer together there, (count,)."""
    return np.asarray(0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, count)))


def corners(d: int, most: int, generator: np.random.Generator) -> Array:
    """Corners of the unit cube, (m, d): all, or ``most`` of them: two opposite and random ones."""
    if 2**d <= most:
        return np.array(list(itertools.product((0.0, 1.0), repeat=d))).reshape(2**d, d)
    drawn = generator.integers(0, 2, (most, d)).astype(float)
    drawn[0], drawn[1] = 0.0, 1.0
    return drawn


def bisected(
    a: Array, b: Array, like_a: Callable[[Array], NDArray[np.bool_]], halvings: int = HALVINGS
) -> tuple[Array, Array]:
    """The ends of segments [a, b] after halvings around a border between ``a`` and ``b``.

    ``like_a`` tells for points, one on each segment, whether they are on the side of ``a``. Its
    answer broadcasts with the points: (m,) for points (m,), but (m, 1) for points (m, d).
    """
    for _ in range(halvings):
        middle = 0.5 * (a + b)
        near_a = like_a(middle)
        a, b = np.where(near_a, middle, a), np.where(near_a, b, middle)
    return a, b


# -----------------------------------------------------------------------------
# Tuples that are made when they are first read.


Item = TypeVar("Item", covariant=True)


class Deferred(Sequence[Item]):
    """A tuple of a known length that is made when it is first read.

    A thousand equations take seconds to write as expressions, and most of what is done with a
    system of many states never looks at them. ``make`` can be pickled, and is what a pickle has.
    """

    def __init__(self, length: int, make: Callable[[], Sequence[Item]]) -> None:
        self._length, self._make = length, make

    @cached_property
    def _items(self) -> tuple[Item, ...]:
        return tuple(self._make())

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, index: int) -> Item: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Item, ...]: ...
    def __getitem__(self, index: int | slice) -> Item | tuple[Item, ...]:
        return self._items[index]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and self._items == tuple(other)

    def __hash__(self) -> int:
        return hash(self._items)

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self._length, self._make)


# -----------------------------------------------------------------------------
# What results look like as tables of pandas, as data sets of xarray, and in notebooks.
#
# Both libraries are optional: ``pip install pandas xarray``, or ``pip install ".[io]"`` in the
# folder of the project.


class Table(NamedTuple):
    """A line of summary, the heads of columns, rows of cells, and remarks below them.

    The first ``labels`` columns are aligned on the left.
    """

    summary: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    remarks: Sequence[str] = ()
    labels: int = 1


class Variables(NamedTuple):
    """Arrays with the names of their axes, and the labels along each axis."""

    arrays: Mapping[str, tuple[tuple[str, ...], Any]]
    labels: Mapping[str, Any]


class Labelled(ABC):
    """A result that prints as a table, and becomes one of pandas or xarray."""

    @abstractmethod
    def _table(self) -> Table:
        """What is printed."""

    @abstractmethod
    def _variables(self) -> Variables:
        """What the result has, with labels."""

    def __repr__(self) -> str:
        summary, header, rows, remarks, labels = self._table()
        lines = text_table(summary, header, rows, right=header[labels:]).splitlines()
        return "\n".join([lines[0], *(f"  {line}" for line in [*lines[1:], *remarks])])

    def _repr_html_(self) -> str:
        return html_of(self._table())

    def to_xarray(self) -> xr.Dataset:
        """The result with labelled axes.

        Raises
        ------
        RankoneError
            If xarray is not installed.
        """
        xarray: Any = optional_module("xarray", "labelled values need xarray", "pip install xarray")
        arrays, labels = self._variables()
        labelled: xr.Dataset = xarray.Dataset(dict(arrays), dict(labels))
        return labelled

    def to_dataframe(self) -> pd.DataFrame:
        """The result as a table, a row for each combination of labels.

        Raises
        ------
        RankoneError
            If pandas is not installed.
        """
        pandas: Any = optional_module("pandas", "tables need pandas", "pip install pandas")
        arrays, labels = self._variables()
        (axes, _), *_ = arrays.values()
        columns = {name: array for name, (own, array) in arrays.items() if own == axes}
        if not axes:
            single: pd.DataFrame = pandas.DataFrame({n: [float(x)] for n, x in columns.items()})
            return single
        index = pandas.MultiIndex.from_product([labels[axis] for axis in axes], names=axes)
        if len(axes) == 1:
            index = pandas.Index(labels[axes[0]], name=axes[0])
        rows: pd.DataFrame = pandas.DataFrame(
            {name: array.ravel() for name, array in columns.items()}, index
        )
        return rows


def html_of(table: Table) -> str:
    """A table for notebooks, with its remarks below."""
    remarks = "".join(f"<p>{html.escape(remark)}</p>" for remark in table.remarks)
    return html_table(table.summary, table.header, table.rows) + remarks
