"""Gaps: where a piecewise function has no branch.

Gaps in time and parameters are refused when a problem is compiled, and when its box or horizon
moves. Gaps in unknowns depend on the trajectories: the generated module tells whether a state lies
in one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational

from rankone.expressions.admissible import gaps
from rankone.ir.features import GAP_REMEDY
from rankone.ir.forms import Coordinate
from rankone.support.arrays import Array, spread
from rankone.support.errors import ProblemError
from rankone.support.wording import quote
from rankone.symbolic.cuts import cuts_of

NamedExpression: TypeAlias = "tuple[str, int | None, sp.Expr]"
"""What an expression is, the user's equation it comes from, and the expression."""
# Gaps narrower than this, relative to the ends of the interval, are rounding errors
_ROUNDING = 1e-12
# Cells between the boundaries of several coordinates that are checked: a few megabytes
_MAX_CELLS = 1 << 18
_MAX_REPEATS = 1 << 14  # Boundaries of one period inside an interval that are checked
_SAMPLES = 4096  # Points of the box at which conditions that couple coordinates are checked
# Halvings of the lines between such points: enough to come within rounding of a boundary
_BISECTIONS = 40


@dataclass(frozen=True)
class Gap:
    """A gap that depends on the unknowns.

    Attributes
    ----------
    name : str
        What has the gap.
    equation : int or None
        The user's equation that it comes from.
    function : Expr
        The piecewise function.
    region : Basic
        The condition under which it has no branch.
    """

    name: str
    equation: int | None
    function: sp.Expr
    region: sp.Basic

    def text(self, names: dict[sp.Basic, sp.Basic] | None = None) -> str:
        """What a message says of it, with some expressions replaced."""
        function, region = self.function.xreplace(names or {}), self.region.xreplace(names or {})
        return f"{quote(function)} in {self.name} has no branch where {quote(region)}"


def check_gaps(
    expressions: Iterable[NamedExpression],
    coordinates: Sequence[Coordinate],
    remedy: str = GAP_REMEDY,
) -> None:
    """Raise a ProblemError if a piecewise function has a gap on the domain.

    Conditions on one coordinate each are checked exactly; those that couple coordinates are checked
    at points all over the domain and where lines between them cross a boundary.
    """
    symbols = {coordinate.symbol for coordinate in coordinates}
    for name, origin, expression in expressions:
        for function, region in gaps(expression):
            if region.atoms(AppliedUndef) or not region.free_symbols <= symbols:
                continue
            place = _place(region, coordinates)
            if place is not None:
                raise ProblemError(
                    f"{quote(function)} in {name} has no branch {place}",
                    equation=origin,
                    term=function,
                    remedy=remedy,
                )


def gaps_in_unknowns(expressions: Iterable[NamedExpression]) -> list[Gap]:
    """The gaps that depend on unknowns, each once."""
    distinct = {
        (function, region): Gap(name, origin, function, region)
        for name, origin, expression in expressions
        for function, region in gaps(expression)
        if region.atoms(AppliedUndef)
    }
    return list(distinct.values())


def _place(region: sp.Basic, coordinates: Sequence[Coordinate]) -> str | None:
    """Where in the domain a region of time and parameters lies, as text; None if outside."""
    involved = [c for c in coordinates if c.symbol in region.free_symbols]
    if all(len(relation.free_symbols) == 1 for relation in region.atoms(Relational)):
        return _cell_inside(region, involved)
    return _point_inside(region, involved)


def _cell_inside(region: sp.Basic, involved: Sequence[Coordinate]) -> str | None:
    """The first cell between the boundaries of each coordinate that lies in a region."""
    edges = [_edges(region, coordinate) for coordinate in involved]
    shape = [len(each) - 1 for each in edges]
    indices = np.unravel_index(np.arange(min(math.prod(shape), _MAX_CELLS)), shape)
    middles = [
        0.5 * (each[:-1] + each[1:])[index] for each, index in zip(edges, indices, strict=True)
    ]
    inside = np.flatnonzero(_truth(region, involved)(np.array(middles)))
    if not inside.size:
        return None
    texts = []
    for c, each, index in zip(involved, edges, indices, strict=True):
        lower, upper = index[inside[0]], index[inside[0]] + 1
        if len(involved) == 1:  # the whole of a gap that boundaries divide
            apart = np.flatnonzero(np.diff(inside) > 1)
            upper = inside[apart[0] if apart.size else -1] + 1
        texts.append(f"{each[lower]:.9g} < {c.name} < {each[upper]:.9g}")
    return f"for {' and '.join(texts)}"


def _edges(region: sp.Basic, coordinate: Coordinate) -> Array:
    """The ends of an interval and what boundaries of a region lie inside, ascending."""
    lower, upper = float(coordinate.lower), float(coordinate.upper)
    (cuts,) = cuts_of([coordinate], [region])
    edges = [lower, upper, *cuts.inside(lower, upper, _MAX_REPEATS)]
    inside = np.unique([edge for edge in edges if lower <= edge <= upper])
    least = _ROUNDING * max(abs(lower), abs(upper))
    return np.asarray(inside[np.concatenate([[True], np.diff(inside) > least])])


def _point_inside(region: sp.Basic, involved: Sequence[Coordinate]) -> str | None:
    """A point of the box that lies in a region, whose boundaries may couple coordinates."""
    lower, upper = np.array([[float(c.lower), float(c.upper)] for c in involved]).T[:, :, None]
    truth = _truth(region, involved)
    sides = [_truth(relation, involved) for relation in region.atoms(Relational)]

    def pattern(points: Array) -> Array:
        return np.array([side(points) for side in sides])

    unit = spread(_SAMPLES, len(involved), np.random.default_rng(20151)).T
    points = lower + (upper - lower) * unit
    a, b = points[:, ::2], points[:, 1::2]
    samples, at_start = [points], pattern(a)
    for _ in range(_BISECTIONS):  # to where the first of the conditions changes on each line
        middle = 0.5 * (a + b)
        same = (pattern(middle) == at_start).all(axis=0)
        a, b = np.where(same, middle, a), np.where(same, b, middle)
        if len(samples) < _BISECTIONS // 2:
            samples.append(middle)
    points = np.concatenate([*samples, b], axis=1)
    inside = np.flatnonzero(truth(points))
    if not inside.size:
        return None
    at = points[:, inside[0]]
    named = ", ".join(f"{c.name} = {x:.6g}" for c, x in zip(involved, at, strict=True))
    return f"where {quote(region)}, for example at {named}"


def _truth(condition: sp.Basic, involved: Sequence[Coordinate]) -> Callable[[Array], Array]:
    """A condition as a function of points (d, m): (m,)."""
    function = sp.lambdify([c.symbol for c in involved], condition, ["numpy", "scipy"])

    def evaluate(points: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.broadcast_to(np.asarray(function(*points), dtype=bool), points.shape[1:])

    return evaluate
