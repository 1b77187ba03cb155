"""Where is an expression defined?

A function of one coordinate must be finite and real on its interval: ``1/k`` with 0 inside the box
of k is refused, ``sqrt(k)`` or ``log(k)`` with k below zero, ``1/(t - 1)`` inside the horizon. Such
functions are sampled, and whatever must not vanish (denominators, arguments of logarithms) is
searched for zeros.

The branches of a piecewise function may leave something out. Its comparisons divide what they
compare into intervals and single points. Between these nothing changes, so whether a branch holds
everywhere is a question of finitely many cells, and nothing has to be solved.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import reduce

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational
from sympy.logic.boolalg import Boolean

from rankone.problem.expressions.stable import NUMPY, in_floats, stable
from rankone.problem.forms import Coordinate
from rankone.problem.functions import nodes_of
from rankone.support.arrays import COINCIDENT, ROUNDING, Array
from rankone.support.errors import quote

_SAMPLES = 501  # Evenly spaced points, and Chebyshev points, that bracket changes of sign
_ZOOMS = 6  # Refinements around a sample, each by about 250: the last spacing is rounding
# Value at a zero, relative to the samples beside it: what rounding leaves
_VANISHES = 8 * ROUNDING
_FLAT_RATIO = 0.5  # Least value over that beside it that tells a flat minimum from a zero
_MOST_CELLS = 1 << 14  # Cells of several comparisons; conditions with more stay as they are
_WITH_EQUALITY = {sp.StrictGreaterThan: sp.Ge, sp.StrictLessThan: sp.Le}
Truth = NDArray[np.bool_]

# -- functions of one coordinate --------------------------------------------------------------


def known_functions(
    coordinates: Sequence[Coordinate], expressions: Iterable[sp.Basic]
) -> tuple[tuple[sp.Expr, ...], ...]:
    """For each coordinate the largest subexpressions that depend on it alone.

    Polynomials are left out: they are smooth and finite everywhere. Conditions count as functions
    that are one where they hold. The order is SymPy's.
    """
    functions: dict[sp.Symbol, set[sp.Expr]] = {c.symbol: set() for c in coordinates}
    visited: set[sp.Basic] = set()
    waiting = list(expressions)
    while waiting:
        node = waiting.pop()
        if node in visited:
            continue
        visited.add(node)
        symbols = nodes_of([node], sp.Symbol)
        if len(symbols) == 1 and not nodes_of([node], AppliedUndef):
            (symbol,) = symbols
            if symbol in functions and isinstance(node, Boolean) and node != symbol:
                functions[symbol].add(sp.Piecewise((1, node), (0, True)))
                continue
            if symbol in functions and isinstance(node, sp.Expr):
                if not node.is_polynomial(symbol):
                    functions[symbol].add(node)
                continue
        waiting += node.args
    return tuple(tuple(sorted(fs, key=sp.default_sort_key)) for fs in functions.values())


def defect(expression: sp.Expr, coordinate: Coordinate) -> str | None:
    """Say what is wrong with a function of one coordinate on its interval.

    For example ``"is not finite at k = 0"``; None if nothing is wrong.
    """
    if expression.is_polynomial(coordinate.symbol):
        return None
    try:
        for divisor in _must_not_vanish(expression):
            pole = zero(divisor, coordinate)
            if pole is not None:
                return f"is not finite at {coordinate.name} = {pole:.6g}"
        points = _samples(coordinate)
        heights = numeric(expression, coordinate)(points)
    except (NameError, TypeError, ValueError, AttributeError, ArithmeticError, NotImplementedError):
        return "cannot be evaluated numerically"
    bad = points[~np.isfinite(heights)]
    if not bad.size:
        return None
    # NumPy gives nan both outside the domain and at 0/0: SymPy tells them apart.
    at_bad = expression.subs(coordinate.symbol, sp.Float(bad[0]))
    missing = "real" if at_bad.is_finite and at_bad.is_extended_real is False else "finite"
    return f"is not {missing} at {coordinate.name} = {bad[0]:.6g}"


def located_defect(expression: sp.Expr, coordinate: Coordinate, dimension: int) -> str | None:
    """A defect with the factor and its interval: ``"factor `1/k` is not finite at k = 0, ..."``."""
    message = defect(expression, coordinate)
    if message is None:
        return None
    where = "the box of parameter " + quote(coordinate.name) if dimension else "the horizon"
    interval = f"[{coordinate.lower:g}, {coordinate.upper:g}]"
    return f"factor {quote(expression)} {message}, inside {where} {interval}"


def sign(expression: sp.Expr, coordinate: Coordinate) -> int:
    """Return 1 or -1 if a function is nowhere negative or nowhere positive, else 0."""
    heights = numeric(expression, coordinate)(_samples(coordinate))
    if np.all(heights >= 0):
        return 1
    return -1 if np.all(heights <= 0) else 0


def largest(expression: sp.Expr, coordinate: Coordinate) -> float:
    """The largest finite value of a function on its interval; 0 if there is none."""
    heights = numeric(expression, coordinate)(_samples(coordinate))
    finite = heights[np.isfinite(heights)]
    return float(finite.max()) if finite.size else 0.0


def zero(expression: sp.Expr, coordinate: Coordinate) -> float | None:
    """Return a point at which a function vanishes on the interval; None if it does not."""
    if coordinate.symbol not in expression.free_symbols:
        return None
    function, points = numeric(expression, coordinate), _samples(coordinate)
    heights = function(points)
    if not np.any(np.isfinite(heights)):
        return None
    zeros = points[heights == 0]
    if zeros.size:
        return float(zeros[0])
    (changes,) = np.nonzero(np.diff(np.sign(heights)))
    least = int(np.nanargmin(np.abs(heights)))
    for i in [least, *changes]:
        point, smallest = _zoom_in(function, points, int(i))
        nearby = np.abs(heights[max(int(i) - 1, 0) : int(i) + 2])
        if smallest <= _VANISHES * float(np.nanmax(nearby)):
            step = COINCIDENT * (points[-1] - points[0])
            beside = np.abs(function(point + step * np.array([-1, 1])))
            if smallest < _FLAT_RATIO * float(np.nanmax(beside)):
                return point
    return None


def numeric(expression: sp.Expr, coordinate: Coordinate) -> Callable[[ArrayLike], Array]:
    """Compile a function of one coordinate; it gives nan where it is not real."""
    function = sp.lambdify(
        coordinate.symbol, in_floats(stable(expression)), [NUMPY, "numpy", "scipy"]
    )

    def evaluate(points: ArrayLike) -> Array:
        with np.errstate(all="ignore"):
            heights = np.asarray(function(points))
        if np.iscomplexobj(heights):
            heights = np.where(heights.imag == 0, heights.real, np.nan)
        return np.broadcast_to(heights.astype(np.float64), np.shape(points))

    return evaluate


def _samples(coordinate: Coordinate) -> Array:
    """Uniform and Chebyshev points with the ends, and zero if it is inside."""
    a, b = coordinate.lower, coordinate.upper
    angles = np.linspace(0.0, np.pi, _SAMPLES)
    chebyshev = 0.5 * (a + b) - 0.5 * (b - a) * np.cos(angles)
    points = np.concatenate([np.linspace(a, b, _SAMPLES), chebyshev, [0.0] if a <= 0 <= b else []])
    return np.unique(np.clip(points, a, b))


def _must_not_vanish(expression: sp.Expr) -> Iterator[sp.Expr]:
    """Yield the denominators and the arguments of logarithms."""
    if isinstance(expression, sp.Piecewise):
        return  # its conditions may guard a pole: sampling decides
    if isinstance(expression, sp.tan | sp.sec):
        yield sp.cos(*expression.args)
    elif isinstance(expression, sp.cot | sp.csc):
        yield sp.sin(*expression.args)
    elif isinstance(expression, sp.coth | sp.csch | sp.log):
        yield expression.args[0]
    elif expression.is_Pow and expression.exp.could_extract_minus_sign():
        yield expression.base
    for argument in expression.args:
        yield from _must_not_vanish(argument)


def _zoom_in(function: Callable[[Array], Array], points: Array, i: int) -> tuple[float, float]:
    """Return the point of least magnitude near sample ``i``, and that magnitude."""
    fine = points[max(i - 1, 0) : i + 3]
    heights = np.abs(function(fine))
    for _ in range(_ZOOMS):
        j = int(np.nanargmin(heights))
        fine = np.linspace(fine[max(j - 1, 0)], fine[min(j + 1, fine.size - 1)], _SAMPLES)
        heights = np.abs(function(fine))
    j = int(np.nanargmin(heights))
    return float(fine[j]), float(heights[j])


# -- piecewise functions ----------------------------------------------------------------------


def closed(expression: sp.Basic) -> sp.Basic:
    """The expression with piecewise functions that have a value wherever two branches meet.

    A single point between two branches takes the one to its right. Where the branches then leave
    out nothing, the last one has the condition True.

    >>> t = sp.Symbol("t")
    >>> closed(sp.Piecewise((1, t < 2), (3, t > 2)))
    Piecewise((1, t < 2), (3, True))
    """
    if not _open(expression):
        return expression
    return expression.replace(lambda node: node in _open(node), _closed)


def gaps(expression: sp.Basic) -> Iterator[tuple[sp.Piecewise, Boolean]]:
    """Piecewise functions in an expression, and where none of their branches holds.

    Of one inside a branch of another, only what that branch reaches counts.
    """
    waiting: list[tuple[sp.Basic, Boolean]] = [(expression, sp.true)]
    while waiting:
        node, reached = waiting.pop()
        if not _open(node):
            continue
        if not isinstance(node, sp.Piecewise):
            waiting += [(argument, reached) for argument in node.args]
            continue
        for branch, condition in node.args:
            waiting.append((branch, sp.And(reached, condition)))
            reached = sp.And(reached, sp.Not(condition))
        region = _shortened(reached)
        if region != sp.false:
            yield node, region


def _open(expression: sp.Basic) -> set[sp.Piecewise]:
    """The piecewise functions in an expression without a last branch for everything else."""
    return {node for node in expression.atoms(sp.Piecewise) if node.args[-1][1] != sp.true}


def _closed(function: sp.Piecewise) -> sp.Expr:
    """The function with weaker conditions, as few as give a value where branches meet."""
    branches = tuple(branch for branch, _ in function.args)
    conditions = [sp.to_nnf(condition, simplify=False) for _, condition in function.args]
    to_right = [_relaxed(condition, rightward=True) for condition in conditions]
    relaxed = [_relaxed(condition) for condition in conditions]
    everything = (*conditions, *to_right, *relaxed)
    try:
        cells = _Cells(everything)
        first = cells.first(everything)
    except _TooIntricate:
        return sp.Piecewise(*zip(branches * 3, everything, strict=True))
    chosen = np.where(first < 0, first, first % len(conditions))
    alike = (c for c in (conditions, to_right, relaxed) if np.array_equal(cells.first(c), chosen))
    simplest = list(next(alike, everything))
    if (chosen >= 0).all():
        simplest[-1] = sp.true
    return sp.Piecewise(*zip(branches * 3, simplest, strict=False))


def _relaxed(condition: Boolean, rightward: bool = False) -> Boolean:
    """A condition that holds at its ends too; at those on the left alone if ``rightward``."""

    def relax(comparison: Relational) -> Boolean:
        if isinstance(comparison, sp.Ne):
            return sp.true
        relation = _WITH_EQUALITY.get(type(comparison))
        if relation is None or (rightward and _Comparison(comparison).sign < 0):
            return comparison
        return relation(*comparison.args)

    return condition.xreplace({c: relax(c) for c in condition.atoms(Relational)})


def _shortened(region: Boolean) -> Boolean:
    """A region without redundant conditions; false if it has no inside."""
    region = sp.to_nnf(region, simplify=False)
    try:
        cells = _Cells([region])
        inside = cells.holds(region)[cells.wide]
        if not inside.any():
            return sp.false
        for condition in sp.And.make_args(region):
            shorter = sp.And(*(c for c in sp.And.make_args(region) if c != condition))
            if np.array_equal(cells.holds(shorter)[cells.wide], inside):
                region = shorter
    except _TooIntricate:
        pass
    return region


class _TooIntricate(Exception):
    """There are too many cells, or a condition is more than comparisons, ``And`` and ``Or``."""


class _Comparison:
    """A comparison of an expression with a number: ``subject > level``.

    The sign is 1 if it holds above the level, -1 below it, and 0 for equality and its opposite.
    """

    def __init__(self, comparison: Relational) -> None:
        difference = comparison.lhs - comparison.rhs
        constant, subject = difference.as_independent(*difference.free_symbols, as_Add=True)
        factor, subject = subject.as_coeff_Mul()
        if subject.could_extract_minus_sign():
            factor, subject = -factor, -subject
        direction = 1 if comparison.rel_op.startswith(">") else -1
        self.subject: sp.Expr = subject
        equality = isinstance(comparison, sp.Eq | sp.Ne)
        self.sign = 0 if equality else direction * int(sp.sign(factor))
        try:
            self.level = float(-constant / factor)
        except (TypeError, OverflowError, ZeroDivisionError):
            self.level = math.nan


class _Cells:
    """All combinations of the intervals and points into which comparisons divide their subjects."""

    def __init__(self, conditions: Iterable[Boolean]) -> None:
        relations = {r for condition in conditions for r in condition.atoms(Relational)}
        self._comparisons = {relation: _Comparison(relation) for relation in relations}
        subjects = {comparison.subject for comparison in self._comparisons.values()}
        self._levels = {
            subject: _distinct(c.level for c in self._comparisons.values() if c.subject == subject)
            for subject in sorted(subjects, key=sp.default_sort_key)
        }
        sizes = [2 * len(levels) + 1 for levels in self._levels.values()]
        if math.prod(sizes) > _MOST_CELLS:
            raise _TooIntricate
        positions = np.meshgrid(*map(np.arange, sizes), indexing="ij") if sizes else []
        self._positions = dict(zip(self._levels, positions, strict=True))
        self._shape = tuple(sizes)
        self.wide: Truth = np.ones(self._shape, dtype=bool)
        for position in positions:  # intervals have even positions, points odd ones
            self.wide &= position % 2 == 0

    def holds(self, condition: Boolean) -> Truth:
        """Where a condition holds, cell by cell."""
        if condition in (sp.true, sp.false):
            return np.full(self._shape, condition == sp.true)
        if isinstance(condition, sp.And | sp.Or):
            join = np.logical_and if isinstance(condition, sp.And) else np.logical_or
            return np.asarray(reduce(join, map(self.holds, condition.args)))
        if isinstance(condition, sp.Not):
            return ~self.holds(condition.args[0])
        if condition not in self._comparisons:
            raise _TooIntricate
        comparison = self._comparisons[condition]
        levels, position = self._levels[comparison.subject], self._positions[comparison.subject]
        at = 1 + 2 * int(np.abs(np.array(levels) - comparison.level).argmin())
        if comparison.sign == 0:
            return np.asarray((position == at) == isinstance(condition, sp.Eq))
        strict = isinstance(condition, tuple(_WITH_EQUALITY))
        beyond = comparison.sign * (position - at) > 0
        return np.asarray(beyond | ((position == at) & (not strict)))

    def first(self, conditions: Sequence[Boolean]) -> NDArray[np.intp]:
        """Which condition is the first to hold, -1 for none, cell by cell."""
        indices = np.full(self._shape, -1)
        for i, condition in reversed(list(enumerate(conditions))):
            indices[self.holds(condition)] = i
        return indices


def _distinct(levels: Iterable[float]) -> list[float]:
    """Levels in ascending order, those that differ by rounding once."""
    distinct: list[float] = []
    for level in sorted(levels):
        if not math.isfinite(level):
            raise _TooIntricate
        if not distinct or level - distinct[-1] > ROUNDING * max(abs(level), abs(distinct[-1])):
            distinct.append(level)
    return distinct
