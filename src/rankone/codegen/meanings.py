"""What lifted states stand for: a pointwise function of the generated module."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from rankone.codegen.pointwise import shape_line
from rankone.codegen.text import assignment, docstring
from rankone.codegen.variables import Variables
from rankone.ir import Coordinate, State

__all__ = ["meanings_function"]


def meanings_function(
    states: Sequence[State], coordinates: Sequence[Coordinate], meanings: Sequence[sp.Expr]
) -> list[str]:
    """Source lines of ``meanings``; none if no state is lifted."""
    if not meanings:
        return []
    variables = Variables(states, coordinates)
    shared, texts = variables.texts(meanings)
    about = f"What the lifted states stand for at u ({len(states)}, ...): ({len(meanings)}, ...)."
    lines = [
        "def meanings(t, u, p):",
        *docstring([about]),
        shape_line("u", len(states), len(coordinates) - 1),
        *(["    t = np.asarray(t, dtype=float)"] if variables.uses_time else []),
        *variables.unpacked(),
    ]
    for name, text in shared:
        lines += assignment(name, [text])
    lines.append(f"    out = np.empty(({len(meanings)}, *shape))")
    lifted = states[len(states) - len(meanings) :]
    for i, (state, text) in enumerate(zip(lifted, texts, strict=True)):
        lines += assignment(f"out[{i}]", [text], state.name)
    return [*lines, "    return out"]
