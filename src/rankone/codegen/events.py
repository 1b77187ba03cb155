"""What is narrow or switches, and depends on more than one coordinate or on the unknowns.

Switches whose times move with parameters are cuts of each trajectory; functions of the unknowns,
such as a pulse ``Piecewise((1, (x > 2) & (x < 2.001)), (0, True))``, are looked at where a step
crosses them; ridges over several parameters are where further trajectories are checked.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.codegen.derivatives import slope
from rankone.codegen.narrow import moving_middles, peaks, steps, valleys
from rankone.codegen.switching import CONTINUOUS, JUMPS, boundaries
from rankone.ir.forms import Coordinate

__all__ = ["event_functions", "moving_switches", "parameter_surfaces"]

_MOST = 64
"""Most functions of a kind."""


def moving_switches(
    coordinates: Sequence[Coordinate], expressions: Iterable[sp.Basic]
) -> tuple[sp.Expr, ...]:
    """Times, as functions of the parameters, at which functions of both switch or are narrow.

    Boundaries that are linear in time, and the middles of narrow exponentials of squares.
    """
    t, known = coordinates[0].symbol, {c.symbol for c in coordinates}
    expressions = list(expressions)
    found = set(moving_middles(coordinates, expressions))
    for boundary, levels in boundaries(expressions):
        rate, symbols = slope(boundary, t), boundary.free_symbols
        if boundary.has(AppliedUndef) or len(symbols) < 2 or not symbols <= known:
            continue
        if rate not in (0, sp.nan) and not rate.has(t):
            found.update((sp.Rational(v) - boundary.subs(t, 0)) / rate for v in levels or ())
    return tuple(sorted(found, key=sp.default_sort_key))


def event_functions(
    time: sp.Symbol, expressions: Iterable[sp.Basic]
) -> tuple[list[sp.Expr], list[sp.Expr], list[sp.Expr]]:
    """Functions of the unknowns, or of time, that vanish where rates are narrow or switch.

    Returns
    -------
    peaks, kinks, switches : list of Expr
        Those in the middle of smooth peaks; at kinks, which may be those of peaks; and where there
        is a step. At most 64 in all.
    """
    expressions = list(expressions)

    def moving(expression: sp.Basic) -> set[sp.Expr]:
        unknowns = set(expression.atoms(AppliedUndef))
        return unknowns | (expression.free_symbols & {time} if not unknowns else set())

    kinds = (
        (middle for _, middle in peaks(expressions, moving)),
        _zeros(expressions, CONTINUOUS),
        (*(middle for _, middle in steps(expressions, moving)), *_zeros(expressions, JUMPS)),
    )
    found: list[list[sp.Expr]] = []
    for functions in kinds:
        known = {f for others in found for f in others}
        new = (f for f in _distinct(filter(moving, functions)) if not known & {f, -f})
        found.append(list(itertools.islice(new, _MOST - len(known))))
    middles, kinks, switches = found
    return middles, kinks, switches


def parameter_surfaces(
    coordinates: Sequence[Coordinate], expressions: Iterable[sp.Basic]
) -> list[sp.Expr]:
    """Functions of several parameters that vanish, or are least, where others are narrow."""
    parameters = {coordinate.symbol for coordinate in coordinates[1:]}
    expressions = list(expressions)

    def variables(expression: sp.Basic) -> list[sp.Expr]:
        return sorted(expression.free_symbols & parameters, key=str)

    narrow = itertools.chain(peaks(expressions, variables), steps(expressions, variables))
    found = itertools.chain(
        (middle for _, middle in narrow),
        valleys(expressions),
        _zeros(expressions, (*CONTINUOUS, *JUMPS)),
    )
    known = (f for f in found if f.free_symbols <= parameters and not f.has(AppliedUndef))
    return _distinct(f for f in known if len(f.free_symbols) > 1)[:_MOST]


def _zeros(expressions: Iterable[sp.Basic], kinds: tuple[type, ...]) -> Iterator[sp.Expr]:
    """Functions whose zeros are where others are not smooth."""
    for boundary, levels in boundaries(expressions, kinds):
        if levels is None:
            yield sp.sin(sp.pi * boundary)
        elif len(levels) <= _MOST:
            yield from (boundary - sp.Rational(level) for level in levels)


def _distinct(functions: Iterable[sp.Expr]) -> list[sp.Expr]:
    """Each once up to its sign, in an order of their own."""
    kept: dict[sp.Expr, None] = {}
    for function in sorted(set(functions), key=sp.default_sort_key):
        if -function not in kept:
            kept[function] = None
    return list(kept)
