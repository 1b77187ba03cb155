"""What lifted states stand for: a pointwise function of the generated module."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from rankone.codegen.pointwise import shape_line
from rankone.codegen.variables import Variables
from rankone.ir.forms import Coordinate, State

__all__ = ["meanings_function"]


def meanings_function(
    states: Sequence[State], coordinates: Sequence[Coordinate], meanings: Sequence[sp.Expr]
) -> list[str]:
    """Source lines of ``meanings``; none if no state is lifted."""
    if not meanings:
        return []
    about = f"What the lifted states stand for at u ({len(states)}, ...): ({len(meanings)}, ...)."
    shape = shape_line("u", len(states), len(coordinates) - 1)
    names = [state.name for state in states[len(states) - len(meanings) :]]
    variables = Variables(states, coordinates)
    return variables.function("meanings(t, u, p)", about, shape, meanings, names)
