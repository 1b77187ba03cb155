"""Jumps at known times: a table of the times, and a pointwise function of the states before."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import sympy as sp

from rankone.codegen.names import Names
from rankone.codegen.pointwise import mask
from rankone.codegen.printer import common_subexpressions, readable_text, representable
from rankone.codegen.text import INDENT, assignment, docstring, nested, table, unpacking
from rankone.ir import Coordinate, Jump, State
from rankone.wording import number

__all__ = ["jump_function", "jump_table", "jumped_values", "jumps_text"]


def jumped_values(jumps: Iterable[Jump]) -> list[sp.Expr]:
    """All values after jumps, for what has to be defined for them."""
    return [value for jump in jumps for value in jump.values]


def jumps_text(
    states: Sequence[State], coordinates: Sequence[Coordinate], jumps: Sequence[Jump]
) -> list[str]:
    """The jumps as people write them, for equations and headers."""
    functions = _functions(states, coordinates)
    names = {u: sp.Symbol(s.name) for u, s in zip(functions, states, strict=True)}
    lines = []
    for values, times in Jump.kinds(jumps).items():
        pairs = zip(functions, values, strict=True)
        changes = (f"{names[u]} -> {readable_text(v.xreplace(names))}" for u, v in pairs if u != v)
        at = ", ".join(map(number, times))
        lines.append(f"at {coordinates[0].name} = {at}: {', '.join(changes)}")
    return lines


def jump_table(jumps: Sequence[Jump]) -> list[str]:
    """``JUMPS``: the times, each with the number of its kind; nothing if there are none."""
    kinds = list(Jump.kinds(jumps))
    rows = ((jump.time, kinds.index(jump.values)) for jump in jumps)
    return table("JUMPS", nested(rows)) if jumps else []


def jump_function(
    states: Sequence[State], coordinates: Sequence[Coordinate], jumps: Sequence[Jump]
) -> list[str]:
    """Source lines of ``jumped``; none if there are no jumps."""
    if not jumps:
        return []
    n, functions, parameters = len(states), _functions(states, coordinates), coordinates[1:]
    symbols = [sp.Symbol(state.name, real=True) for state in states]
    real = dict(zip(functions, symbols, strict=True))
    own_symbols = [sp.Symbol(c.name, real=True) for c in parameters]
    real |= {c.symbol: s for c, s in zip(parameters, own_symbols, strict=True)}
    names = Names(["np", "special", "CubicSpline", "kind", "u", "p", "shape", "out"])
    own = [names(c.name) for c in parameters]
    names.taken -= {"u"}  # states are unpacked last and may replace the argument
    local = [names(state.name) for state in states]
    written = dict(zip(own_symbols, own, strict=True)) | dict(zip(symbols, local, strict=True))
    branches: list[str] = []
    used: set[sp.Basic] = set()
    for kind, values in enumerate(Jump.kinds(jumps)):
        changed = [i for i, (u, v) in enumerate(zip(functions, values, strict=True)) if u != v]
        expressions = [representable(values[i].xreplace(real)) for i in changed]
        used |= set().union(*(e.free_symbols for e in expressions))
        shared, texts = common_subexpressions(expressions, written, names.numbered("c"))
        lines = [line for name, text in shared for line in assignment(name, [text])]
        for i, text in zip(changed, texts, strict=True):
            lines += assignment(f"out[{i}]", [text], f"{states[i].name} after it")
        branches += [f"    if kind == {kind}:", *(INDENT + line for line in lines)]
    parameters_used = [j for j, symbol in enumerate(own_symbols) if symbol in used]
    states_used = [i for i, symbol in enumerate(symbols) if symbol in used]
    about = f"States right after a jump from u ({n}, ...) before, at p (d, ...): ({n}, ...)."
    return [
        "def jumped(kind, u, p):",
        *docstring([about]),
        "    shape = np.broadcast_shapes(np.shape(u)[1:], np.shape(p)[1:])",
        f"    out = np.array(np.broadcast_to(u, ({n}, *shape)))",
        *unpacking(mask(own, parameters_used), "p"),
        *unpacking(mask(local, states_used), "u"),
        *branches,
        "    return out",
    ]


def _functions(states: Sequence[State], coordinates: Sequence[Coordinate]) -> list[sp.Expr]:
    return [sp.Function(state.name)(coordinates[0].symbol) for state in states]
