"""Known functions of one coordinate inside expressions that do not separate."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.logic.boolalg import Boolean

from rankone.ir.forms import Coordinate

__all__ = ["known_functions"]


def known_functions(
    coordinates: Sequence[Coordinate], expressions: Iterable[sp.Basic]
) -> tuple[tuple[sp.Expr, ...], ...]:
    """For each coordinate the largest subexpressions that depend on it alone.

    Polynomials are left out: they are smooth and finite everywhere. Conditions count as functions
    that are one where they hold. The order is SymPy's.
    """
    found: dict[sp.Symbol, set[sp.Expr]] = {c.symbol: set() for c in coordinates}
    seen: set[sp.Basic] = set()
    waiting = list(expressions)
    while waiting:
        part = waiting.pop()
        if part in seen:
            continue
        seen.add(part)
        symbols = part.free_symbols
        if len(symbols) == 1 and not part.atoms(AppliedUndef):
            (symbol,) = symbols
            if symbol in found and isinstance(part, Boolean) and part != symbol:
                found[symbol].add(sp.Piecewise((1, part), (0, True)))
                continue
            if symbol in found and isinstance(part, sp.Expr):
                if not part.is_polynomial(symbol):
                    found[symbol].add(part)
                continue
        waiting += part.args
    return tuple(tuple(sorted(parts, key=sp.default_sort_key)) for parts in found.values())
