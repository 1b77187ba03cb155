"""What integrations of single trajectories must not step over: times and functions of the states.

Switches that move with parameters are cuts of each trajectory; functions of the unknowns, such as
a pulse ``Piecewise((1, (x > 2) & (x < 2.001)), (0, True))``, are looked at where a step crosses
them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.codegen.narrow import moving_middles, peaks_over_states, steps_over_states
from rankone.codegen.switching import CONTINUOUS, JUMPS, boundaries
from rankone.ir import Coordinate

__all__ = ["event_functions", "moving_switches"]

_MOST = 64
"""Most event functions of a system."""


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
        slope, symbols = boundary.diff(t), boundary.free_symbols
        if boundary.has(AppliedUndef) or len(symbols) < 2 or not symbols <= known:
            continue
        if slope != 0 and not slope.has(t):
            found.update((sp.Rational(v) - boundary.subs(t, 0)) / slope for v in levels or ())
    return tuple(sorted(found, key=sp.default_sort_key))


def event_functions(expressions: Iterable[sp.Basic]) -> tuple[list[sp.Expr], list[sp.Expr]]:
    """Functions of the unknowns that vanish where the right-hand side is narrow or switches.

    Returns
    -------
    peaks, switches : list of Expr
        Those at peaks, or kinks, which may be those of peaks; and where there is a step.
    """
    expressions = list(expressions)
    smooth = peaks_over_states(expressions), steps_over_states(expressions)
    peaks, steps = (
        _distinct(itertools.chain(found, _zeros(expressions, kinds)))
        for found, kinds in zip(smooth, (CONTINUOUS, JUMPS), strict=True)
    )
    peaks = peaks[:_MOST]
    return peaks, [f for f in steps if f not in peaks and -f not in peaks][: _MOST - len(peaks)]


def _zeros(expressions: Iterable[sp.Basic], kinds: tuple[type, ...]) -> Iterator[sp.Expr]:
    """Functions whose zeros are where others are not smooth."""
    return (boundary for boundary, levels in boundaries(expressions, kinds) if levels == (0.0,))


def _distinct(events: Iterable[sp.Expr]) -> list[sp.Expr]:
    """Those of unknowns, each once up to its sign, in an order of their own."""
    kept: dict[sp.Expr, None] = {}
    for event in sorted(set(events), key=sp.default_sort_key):
        if event.has(AppliedUndef) and -event not in kept:
            kept[event] = None
    return list(kept)
