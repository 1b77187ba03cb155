"""Functions with many levels, written as steps and kinks at those that trajectories reach.

A staircase in the unknowns is a sum of steps, and a table of straight lines one of kinks:

    floor(g) = k - 1 + Σ Heaviside(g - i), i = k, ..., l,   where k - 1 <= g < l + 1,
    table(g) = y₀ + m₀ (g - x₀) + Σ (mᵢ - mᵢ₋₁) Max(0, g - xᵢ)   inside of the table.

So each level is a :mod:`switch <rankone.compiler.passes.switches>` that is held on its sides.
Beyond the levels that are written the sum is not a number, so that nothing is followed wrongly
there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.compiler.passes.switches import MOST_LEVELS, NotHeld
from rankone.problem.expressions.notation import exact
from rankone.problem.functions import Table, table

_STAIRS = (sp.floor, sp.ceiling, sp.frac, sp.Mod)
_MARGIN = 0.02  # Part of the reached range on each side, or of a step, in which levels count too
_FEW = 4  # Inner points of a table that are all written

Reached: TypeAlias = Mapping[sp.Expr, tuple[float, float]]
"""The smallest and the largest value that each argument takes on trajectories."""


def levelled(expressions: Iterable[sp.Expr]) -> list[sp.Expr]:
    """The arguments with unknowns of functions with many levels, in SymPy's order."""
    nodes = (node for each in expressions for node in each.atoms(*_STAIRS, Table))
    arguments = {_argument(node) for node in nodes if _has_levels(node)}
    return sorted(arguments, key=sp.default_sort_key)


def by_levels(expression: sp.Expr, reached: Reached) -> sp.Expr:
    """An expression with steps and kinks in place of functions with many levels."""
    if not expression.has(*_STAIRS, Table):
        return expression
    args = [by_levels(each, reached) for each in expression.args]
    if not _has_levels(expression):
        return expression.func(*args)
    span = reached[_argument(expression)]
    if isinstance(expression, Table):
        return _lines(expression, args[0], span)
    if isinstance(expression, sp.Mod):
        return args[0] - args[1] * _floor(args[0] / args[1], span)
    if isinstance(expression, sp.ceiling):
        return -_floor(-args[0], span)
    whole = _floor(args[0], span)
    return args[0] - whole if isinstance(expression, sp.frac) else whole


def _has_levels(node: sp.Expr) -> bool:
    """Whether it is a function of unknowns that kinks or jumps at its levels."""
    if not node.has(AppliedUndef) or not isinstance(node, (*_STAIRS, Table)):
        return False
    return not isinstance(node, Table) or node.kind != "cubic"


def _argument(node: sp.Expr) -> sp.Expr:
    """What passes the levels."""
    first = node.args[0]
    if isinstance(node, sp.Mod):
        return first / node.args[1]
    return -first if isinstance(node, sp.ceiling) else first


def _floor(argument: sp.Expr, span: tuple[float, float]) -> sp.Expr:
    """The floor of an argument as a sum of steps."""
    lower, upper = span
    margin = _MARGIN * max(upper - lower, 1.0)
    first, last = math.ceil(lower - margin), math.floor(upper + margin)
    if last - first >= MOST_LEVELS:  # trajectories that blow up reach any number
        raise NotHeld
    steps = [sp.Heaviside(argument - level, 1) for level in range(first, last + 1)]
    return first - 1 + sp.Add(*steps) + _nothing_beyond(argument, first - 1, last + 1)


def _lines(applied: Table, argument: sp.Expr, span: tuple[float, float]) -> sp.Expr:
    """A table as a sum of steps or kinks at its inner points that are reached."""
    points, heights = map(_exact, (applied.points, applied.values))
    inner = _written_points(applied.points, span)
    before, behind = inner.start - 1, inner.stop
    beyond = _nothing_beyond(argument, applied.points[before], applied.points[behind])
    if applied.kind == "previous":
        rises = (heights[i] - heights[i - 1] for i in inner)
        steps = (
            h * sp.Heaviside(argument - points[i], 1) for h, i in zip(rises, inner, strict=True)
        )
        return sp.Add(heights[before], *steps) + beyond
    pairs = itertools.pairwise(zip(points, heights, strict=True))
    slopes = [(b - a) / (y - x) for (x, a), (y, b) in pairs]
    kinks = ((slopes[i] - slopes[i - 1]) * sp.Max(0, argument - points[i]) for i in inner)
    line = heights[before] + slopes[before] * (argument - points[before])
    return sp.Add(line, *kinks) + beyond


def _exact(numbers: Iterable[float]) -> list[sp.Expr]:
    return [exact(sp.Float(x)) for x in numbers]


def _written_points(points: Sequence[float], span: tuple[float, float]) -> range:
    """The places of the inner points of a table that are reached."""
    inner = range(1, len(points) - 1)
    if len(inner) <= _FEW:
        return inner
    lower, upper = span
    margin = _MARGIN * (upper - lower)
    first, last = np.searchsorted(points, [lower - margin, upper + margin]).tolist()
    begin = min(max(first, inner.start), inner.stop)
    return range(begin, max(min(last, inner.stop), begin))


def _nothing_beyond(argument: sp.Expr, lower: float, upper: float) -> sp.Expr:
    """Zero between two numbers, and not a number beyond them.

    They are levels too: trajectories that are continued on the side between them go on beyond.
    """
    zero = table([float(lower) - float(upper), 0.0], [0.0, 0.0])
    ends = (exact(sp.Float(end)) for end in (lower, upper))
    beyond = (sign * (argument - end) for sign, end in zip((-1, 1), ends, strict=True))
    return zero(sp.Add(*(sp.Max(0, excess) for excess in beyond)))
