"""Gaps: where a piecewise function has no branch.

Gaps in time and parameters are found when a problem is compiled, and again when its box or horizon
moves. Those in unknowns depend on the trajectories: the generated module says of a state whether it
lies in one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational

from rankone.codegen.switching import switches
from rankone.codegen.text import quoted, table
from rankone.codegen.variables import Variables
from rankone.expressions.admissible import gaps
from rankone.ir.forms import Coordinate, Jump, State
from rankone.support.arrays import Array, spread
from rankone.support.errors import ProblemError
from rankone.support.wording import number, quote

__all__ = ["REMEDY", "Named", "check_gaps", "gap_functions", "gap_tables", "gap_text"]

REMEDY = "add a branch (value, True) for everything else, or let its conditions cover this too"
Named: TypeAlias = "tuple[str, int | None, sp.Expr]"
"""What an expression is, the user's equation it comes from, and the expression."""
_ROUNDING = 1e-12
"""Gaps narrower than this, relative to the ends of the interval, are rounding."""
_MOST_CELLS, _MOST_PERIODS = 1 << 18, 1 << 14
_POINTS, _HALVED = 4096, 40
"""Points of the box that are looked at, and halvings of the lines between them."""


def check_gaps(
    expressions: Iterable[Named], coordinates: Sequence[Coordinate], remedy: str = REMEDY
) -> None:
    """Raise a ProblemError if a piecewise function has a gap on the domain.

    Conditions on one coordinate each are checked exactly; those that couple coordinates are checked
    at points all over the domain and where lines between them cross a boundary.
    """
    for what, origin, expression in expressions:
        for function, region in gaps(expression):
            if region.atoms(AppliedUndef) or not region.free_symbols <= {
                c.symbol for c in coordinates
            }:
                continue
            where = _met(region, coordinates)
            if where is not None:
                raise ProblemError(
                    f"{quote(function)} in {what} has no branch {where}",
                    equation=origin,
                    term=function,
                    remedy=remedy,
                )


def gap_text(what: str, function: sp.Expr, region: sp.Basic) -> str:
    """What a message says of a gap in unknowns."""
    return f"{quote(function)} in {what} has no branch where {quote(region)}"


def gap_tables(rates: Sequence[Named], jumps: Sequence[Jump], states: Sequence[State]) -> list[str]:
    """``GAPS`` and ``JUMP_GAPS``: what to say of each gap in unknowns; nothing without any."""
    return [
        line
        for name, named in (("GAPS", rates), ("JUMP_GAPS", _jumped(jumps, states)))
        for line in _table(name, _in_unknowns(named), states)
    ]


def gap_functions(
    rates: Sequence[Named],
    jumps: Sequence[Jump],
    states: Sequence[State],
    coordinates: Sequence[Coordinate],
) -> list[list[str]]:
    """Source lines of ``gaps`` and ``jump_gaps``; none where there are no gaps in unknowns."""
    blocks = []
    for head, named in (("gaps", rates), ("jump_gaps", _jumped(jumps, states))):
        regions = [sp.Piecewise((1, region), (0, True)) for *_, region in _in_unknowns(named)]
        if regions:
            variables = Variables(states, coordinates)
            about = (
                f"One where a piecewise function has no branch, else zero: ({len(regions)}, ...)."
            )
            shape = "    shape = np.broadcast(t, *u, *p).shape"
            blocks.append(variables.function(f"{head}(t, u, p)", about, shape, regions))
    return blocks


def _jumped(jumps: Sequence[Jump], states: Sequence[State]) -> list[Named]:
    return [
        (f"the value of {state.name} after the jump at {number(jump.time)}", None, value)
        for jump in jumps
        for state, value in zip(states, jump.values, strict=True)
    ]


def _in_unknowns(named: Iterable[Named]) -> list[tuple[str, int | None, sp.Expr, Any]]:
    """The gaps in expressions that depend on unknowns, each once."""
    found = {
        (function, region): (what, origin, function, region)
        for what, origin, expression in named
        for function, region in gaps(expression)
        if region.atoms(AppliedUndef)
    }
    return list(found.values())


def _table(
    name: str, found: Sequence[tuple[str, int | None, sp.Expr, Any]], states: Sequence[State]
) -> list[str]:
    if not found:
        return []
    texts = []
    for what, origin, function, region in found:
        short = {
            u: sp.Symbol(u.func.__name__)
            for u in {*function.atoms(AppliedUndef)} | region.atoms(AppliedUndef)
        }
        text = gap_text(what, function.xreplace(short), region.xreplace(short))
        texts.append(text if origin is None else f"equation {origin}: {text}")
    return table(name, [quoted(text) for text in texts])


# --- where a region is met -----------------------------------------------------------------------


def _met(region: Any, coordinates: Sequence[Coordinate]) -> str | None:
    """Where in the domain a region of time and parameters is met, as text; None if nowhere."""
    involved = [c for c in coordinates if c.symbol in region.free_symbols]
    if all(len(part.free_symbols) == 1 for part in region.atoms(Relational)):
        return _met_cell(region, involved)
    return _met_point(region, involved)


def _met_cell(region: Any, involved: Sequence[Coordinate]) -> str | None:
    """The first cell between the boundaries of each coordinate that lies in a region."""
    edges = [_edges(region, coordinate) for coordinate in involved]
    sizes = [len(each) - 1 for each in edges]
    cells = np.arange(min(math.prod(sizes), _MOST_CELLS))
    places = np.unravel_index(cells, sizes)
    middles = [
        0.5 * (each[:-1] + each[1:])[place] for each, place in zip(edges, places, strict=True)
    ]
    inside = np.flatnonzero(_truth(region, involved)(np.array(middles)))
    if not inside.size:
        return None
    texts = []
    for c, each, place in zip(involved, edges, places, strict=True):
        lower, upper = place[inside[0]], place[inside[0]] + 1
        if len(involved) == 1:  # the whole of a gap that boundaries divide
            apart = np.flatnonzero(np.diff(inside) > 1)
            upper = inside[apart[0] if apart.size else -1] + 1
        texts.append(f"{each[lower]:.9g} < {c.name} < {each[upper]:.9g}")
    return f"for {' and '.join(texts)}"


def _edges(region: Any, coordinate: Coordinate) -> Array:
    """The ends of an interval and what boundaries of a region lie inside, ascending."""
    lower, upper = float(coordinate.lower), float(coordinate.upper)
    (found,) = switches([coordinate], [region])
    edges = [lower, upper, *found.points]
    for first, period in found.periodic:
        start = math.ceil((lower - first) / period)
        count = min(math.floor((upper - first) / period) - start + 1, _MOST_PERIODS)
        edges += [first + period * (start + k) for k in range(max(count, 0))]
    inside = np.unique([edge for edge in edges if lower <= edge <= upper])
    least = _ROUNDING * max(abs(lower), abs(upper))
    return np.asarray(inside[np.concatenate([[True], np.diff(inside) > least])])


def _met_point(region: Any, involved: Sequence[Coordinate]) -> str | None:
    """A point of the box that lies in a region, whose boundaries may couple coordinates."""
    lower, upper = np.array([[float(c.lower), float(c.upper)] for c in involved]).T[:, :, None]
    truth = _truth(region, involved)
    sides = [_truth(part, involved) for part in region.atoms(Relational)]

    def pattern(points: Array) -> Array:
        return np.array([side(points) for side in sides])

    unit = spread(_POINTS, len(involved), np.random.default_rng(20151)).T
    points = lower + (upper - lower) * unit
    a, b = points[:, ::2], points[:, 1::2]
    found, here = [points], pattern(a)
    for _ in range(_HALVED):  # to where the first of the conditions changes on each line
        middle = 0.5 * (a + b)
        same = (pattern(middle) == here).all(axis=0)
        a, b = np.where(same, middle, a), np.where(same, b, middle)
        if len(found) < _HALVED // 2:
            found.append(middle)
    points = np.concatenate([*found, b], axis=1)
    inside = np.flatnonzero(truth(points))
    if not inside.size:
        return None
    at = points[:, inside[0]]
    named = ", ".join(f"{c.name} = {x:.6g}" for c, x in zip(involved, at, strict=True))
    return f"where {quote(region)}, for example at {named}"


def _truth(condition: Any, involved: Sequence[Coordinate]) -> Callable[[Array], Array]:
    """A condition as a function of points (d, m): (m,)."""
    function = sp.lambdify([c.symbol for c in involved], condition, ["numpy", "scipy"])

    def evaluate(points: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.broadcast_to(np.asarray(function(*points), dtype=bool), points.shape[1:])

    return evaluate
