"""Piecewise functions whose branches may leave something out.

What a piecewise function compares is divided by its conditions into intervals and single points.
Between them nothing changes, so whether a branch holds everywhere is a question of finitely many
cells, which is answered without solving anything.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import reduce
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray
from sympy.core.relational import Relational
from sympy.logic.boolalg import Boolean

__all__ = ["closed", "gaps"]

Truth = NDArray[np.bool_]
_MOST_CELLS = 1 << 14
"""Cells of several comparisons that are looked at."""
_SAME = 1e-14
"""Numbers that are closer, relative to the largest, are one but for rounding."""
_STRICT = {sp.StrictGreaterThan: sp.Ge, sp.StrictLessThan: sp.Le}


def closed(expression: sp.Basic) -> sp.Basic:
    """The same with piecewise functions that have a value wherever two branches meet.

    A single point between two branches takes the one to its right. Where the branches then leave
    out nothing, the last one has the condition True.

    >>> t = sp.Symbol("t")
    >>> closed(sp.Piecewise((1, t < 2), (3, t > 2)))
    Piecewise((1, t < 2), (3, True))
    """
    if not _open(expression):
        return expression
    return expression.replace(lambda part: part in _open(part), _closed)


def gaps(expression: sp.Basic) -> Iterator[tuple[sp.Piecewise, Boolean]]:
    """Piecewise functions in an expression, and where none of their branches holds.

    Of one inside a branch of another, only what that branch reaches counts.
    """
    waiting: list[tuple[sp.Basic, Any]] = [(expression, sp.true)]
    while waiting:
        part, reached = waiting.pop()
        if not _open(part):
            continue
        if not isinstance(part, sp.Piecewise):
            waiting += [(inner, reached) for inner in part.args]
            continue
        for value, condition in part.args:
            waiting.append((value, sp.And(reached, condition)))
            reached = sp.And(reached, sp.Not(condition))
        region = _shortened(reached)
        if region != sp.false:
            yield part, region


def _open(expression: sp.Basic) -> set[sp.Piecewise]:
    """The piecewise functions in an expression without a last branch for everything else."""
    return {part for part in expression.atoms(sp.Piecewise) if part.args[-1][1] != sp.true}


def _closed(part: sp.Piecewise) -> sp.Expr:
    values = tuple(value for value, _ in part.args)
    conditions = [sp.to_nnf(condition, simplify=False) for _, condition in part.args]
    to_right = [_relaxed(condition, rightward=True) for condition in conditions]
    relaxed = [_relaxed(condition) for condition in conditions]
    everything = (*conditions, *to_right, *relaxed)
    try:
        cells = _Cells(everything)
        first = cells.first(everything)
    except _TooIntricate:
        return sp.Piecewise(*zip(values * 3, everything, strict=True))
    chosen = np.where(first < 0, first, first % len(conditions))
    alike = (c for c in (conditions, to_right, relaxed) if np.array_equal(cells.first(c), chosen))
    simplest = list(next(alike, everything))
    if (chosen >= 0).all():
        simplest[-1] = sp.true
    return sp.Piecewise(*zip(values * 3, simplest, strict=False))


def _relaxed(condition: Boolean, rightward: bool = False) -> Boolean:
    """A condition that holds at its ends too; at those on the left alone if ``rightward``."""

    def relax(comparison: Relational) -> Boolean:
        if isinstance(comparison, sp.Ne):
            return sp.true
        kind = _STRICT.get(type(comparison))
        if kind is None or (rightward and _Comparison.of(comparison).sign < 0):
            return comparison
        return kind(*comparison.args)

    return condition.xreplace({part: relax(part) for part in condition.atoms(Relational)})


def _shortened(region: Any) -> Any:
    """A region without what adds nothing to its description; false if it has no inside."""
    region = sp.to_nnf(region, simplify=False)
    try:
        cells = _Cells([region])
        inside = cells.holds(region)[cells.wide]
        if not inside.any():
            return sp.false
        for part in sp.And.make_args(region):
            rest = sp.And(*(other for other in sp.And.make_args(region) if other != part))
            if np.array_equal(cells.holds(rest)[cells.wide], inside):
                region = rest
    except _TooIntricate:
        pass
    return region


class _TooIntricate(Exception):
    """There are too many cells, or a condition is more than comparisons, ``And`` and ``Or``."""


class _Comparison:
    """A comparison as one of an expression with a number: ``subject > level``.

    Attributes
    ----------
    subject : Expr
    level : float
    sign : int
        1 if it holds above the level, -1 below it, and 0 for equality and its opposite.
    """

    def __init__(self, subject: sp.Expr, level: float, sign: int) -> None:
        self.subject, self.level, self.sign = subject, level, sign

    @classmethod
    def of(cls, comparison: Relational) -> _Comparison:
        difference = comparison.lhs - comparison.rhs
        constant, subject = difference.as_independent(*difference.free_symbols, as_Add=True)
        factor, subject = subject.as_coeff_Mul()
        if subject.could_extract_minus_sign():
            factor, subject = -factor, -subject
        direction = 1 if comparison.rel_op.startswith(">") else -1
        sign = 0 if isinstance(comparison, sp.Eq | sp.Ne) else direction * int(sp.sign(factor))
        try:
            level = float(-constant / factor)
        except (TypeError, OverflowError, ZeroDivisionError):
            level = math.nan
        return cls(subject, level, sign)


class _Cells:
    """All combinations of the intervals and points into which comparisons divide their subjects."""

    def __init__(self, conditions: Iterable[Boolean]) -> None:
        found = {part for condition in conditions for part in condition.atoms(Relational)}
        self._comparisons = {part: _Comparison.of(part) for part in found}
        subjects = {comparison.subject for comparison in self._comparisons.values()}
        self._levels = {
            subject: _distinct(c.level for c in self._comparisons.values() if c.subject == subject)
            for subject in sorted(subjects, key=sp.default_sort_key)
        }
        sizes = [2 * len(levels) + 1 for levels in self._levels.values()]
        if math.prod(sizes) > _MOST_CELLS:
            raise _TooIntricate
        places = np.meshgrid(*map(np.arange, sizes), indexing="ij") if sizes else []
        self._places = dict(zip(self._levels, places, strict=True))
        self._shape = tuple(sizes)
        self.wide: Truth = np.ones(self._shape, dtype=bool)
        for place in places:  # intervals have even numbers, points odd ones
            self.wide &= place % 2 == 0

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
        levels, place = self._levels[comparison.subject], self._places[comparison.subject]
        at = 1 + 2 * int(np.abs(np.array(levels) - comparison.level).argmin())
        if comparison.sign == 0:
            return np.asarray((place == at) == isinstance(condition, sp.Eq))
        strict = isinstance(condition, tuple(_STRICT))
        return np.asarray((comparison.sign * (place - at) > 0) | ((place == at) & (not strict)))

    def first(self, conditions: Sequence[Boolean]) -> NDArray[np.intp]:
        """Which condition is the first to hold, -1 for none, cell by cell."""
        found = np.full(self._shape, -1)
        for i, condition in reversed(list(enumerate(conditions))):
            found[self.holds(condition)] = i
        return found


def _distinct(levels: Iterable[float]) -> list[float]:
    """Numbers in ascending order, those that differ by rounding once."""
    kept: list[float] = []
    for level in sorted(levels):
        if not math.isfinite(level):
            raise _TooIntricate
        if not kept or level - kept[-1] > _SAME * max(abs(level), abs(kept[-1])):
            kept.append(level)
    return kept
