"""Initial values that couple parameters: a pointwise function of the generated module."""

from __future__ import annotations

import sympy as sp

from rankone.codegen.names import Names
from rankone.codegen.pointwise import mask
from rankone.codegen.printer import common_subexpressions
from rankone.codegen.text import assignment, docstring, unpacking
from rankone.ir.forms import QuadraticSystem

__all__ = ["coupled_initial"]


def coupled_initial(system: QuadraticSystem) -> list[str]:
    """Source lines of ``coupled_initial``; none if all initial values separate."""
    if not system.coupled:
        return []
    parameters, n = system.coordinates[1:], len(system.differential)
    symbols = {c.symbol: sp.Symbol(c.name, real=True) for c in parameters}
    sums: dict[int, sp.Expr] = {}
    for term in system.coupled:
        value = term.expression.xreplace(symbols)
        sums[term.equation] = sums.get(term.equation, sp.S.Zero) + value
    names = Names(["np", "special", "p", "shape", "out"])
    own = [names(c.name) for c in parameters]
    written = dict(zip(symbols.values(), own, strict=True))
    shared, texts = common_subexpressions(list(sums.values()), written, names.numbered("c"))
    used = set().union(*(value.free_symbols for value in sums.values()))
    places = [j for j, symbol in enumerate(symbols.values()) if symbol in used]
    lines = [
        "def unseparated_initial(p):",
        *docstring([f"What of the initial values couples parameters, at p (d, ...): ({n}, ...)."]),
        "    shape = np.broadcast_shapes(*map(np.shape, p)) or np.shape(p)[1:]",
        *unpacking(mask(own, places), "p"),
    ]
    for name, text in shared:
        lines += assignment(name, [text])
    lines.append(f"    out = np.zeros(({n}, *shape))")
    for row, text in zip(sums, texts, strict=True):
        lines += assignment(f"out[{row}]", [text], system.differential[row].name)
    return [*lines, "    return out"]
