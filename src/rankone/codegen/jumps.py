"""Jumps at known times: a table of the times, and a pointwise function of the states before."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.codegen.text import INDENT, assignment, docstring, nested, table
from rankone.codegen.variables import Variables
from rankone.expressions.notation import plain_text
from rankone.ir.forms import Coordinate, Jump, State
from rankone.support.wording import number

__all__ = ["jump_function", "jump_table", "jumped_values", "jumps_text"]


def jumped_values(jumps: Iterable[Jump]) -> list[sp.Expr]:
    """All values after jumps, for what has to be defined for them."""
    return [value for jump in jumps for value in jump.values]


def jumps_text(
    states: Sequence[State], coordinates: Sequence[Coordinate], jumps: Sequence[Jump]
) -> list[str]:
    """The jumps as people write them, for equations and headers."""
    functions = Variables(states, coordinates).functions
    names = {u: sp.Symbol(s.name) for u, s in zip(functions, states, strict=True)}
    lines = []
    for values, times in Jump.kinds(jumps).items():
        pairs = zip(functions, values, strict=True)
        changes = (f"{names[u]} -> {plain_text(v.xreplace(names))}" for u, v in pairs if u != v)
        at = ", ".join(map(number, times))
        lines.append(f"at {coordinates[0].name} = {at}: {', '.join(changes)}")
    return lines


def jump_table(jumps: Sequence[Jump]) -> list[str]:
    """``JUMPS``: the times, each with the number of its kind; nothing if there are none.

    ``ROUGH_JUMPS`` are the kinds whose values are no polynomials of the unknowns.
    """
    kinds = list(Jump.kinds(jumps))
    rows = ((jump.time, kinds.index(jump.values)) for jump in jumps)
    if not jumps:
        return []
    rough = (n for n, values in enumerate(kinds) if not all(map(_smooth, values)))
    return [*table("JUMPS", nested(rows)), *table("ROUGH_JUMPS", nested(rough))]


def jump_function(
    states: Sequence[State], coordinates: Sequence[Coordinate], jumps: Sequence[Jump]
) -> list[str]:
    """Source lines of ``jumped``; none if there are no jumps."""
    if not jumps:
        return []
    n, variables = len(states), Variables(states, coordinates, ["kind"])
    branches: list[str] = []
    for kind, values in enumerate(Jump.kinds(jumps)):
        pairs = enumerate(zip(variables.functions, values, strict=True))
        changed = [i for i, (u, v) in pairs if u != v]
        shared, texts = variables.texts([values[i] for i in changed])
        lines = [line for name, text in shared for line in assignment(name, [text])]
        for i, text in zip(changed, texts, strict=True):
            lines += assignment(f"out[{i}]", [text], f"{states[i].name} after it")
        branches += [f"    if kind == {kind}:", *(INDENT + line for line in lines)]
    about = f"States right after a jump from u ({n}, ...) before, at p (d, ...): ({n}, ...)."
    return [
        "def jumped(kind, u, p):",
        *docstring([about]),
        "    shape = np.broadcast_shapes(np.shape(u)[1:], np.shape(p)[1:])",
        f"    out = np.array(np.broadcast_to(u, ({n}, *shape)))",
        *variables.unpacked(),
        *branches,
        "    return out",
    ]


def _smooth(value: sp.Expr) -> bool:
    """Whether a value is a polynomial of the unknowns."""
    unknowns = sorted(value.atoms(AppliedUndef), key=sp.default_sort_key)
    return not unknowns or bool(value.is_polynomial(*unknowns))
