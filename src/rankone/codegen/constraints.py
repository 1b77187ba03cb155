"""Constraints in the generated module: what vanishes on all trajectories, and its derivatives."""

from __future__ import annotations

import sympy as sp

from rankone.codegen.pointwise import Index, PointwiseWriter
from rankone.codegen.text import quoted, table
from rankone.expressions.derivatives import Differentiator
from rankone.expressions.stable import stable
from rankone.ir.forms import ConstraintForms


def constraint_blocks(writer: PointwiseWriter, constraints: ConstraintForms) -> list[list[str]]:
    """Their names, the states that they determine, and two functions; nothing without any."""
    if not constraints.names:
        return []
    k, n = len(constraints.names), len(writer.states)
    expressions = [stable(writer.real(expression)) for expression in constraints.expressions]
    slopes: dict[Index, sp.Expr] = {
        (i, j): slope
        for j, derivative in enumerate(map(Differentiator, writer.states))
        for i, expression in enumerate(expressions)
        if (slope := derivative(expression)) != 0
    }
    names = [state.name for state in writer.states]
    of_slopes = f"Derivatives of constraints by the states u ({n}, ...): ({k}, {n}, ...)."
    guessed = f"GUESSED = {constraints.guessed}  # states that the constraints determine"
    return [
        [
            *table("CONSTRAINTS", [quoted(name) for name in constraints.names]),
            *([guessed] if constraints.guessed else []),
        ],
        writer.vector(
            "constraints",
            "t, u, p",
            f"What vanishes on all trajectories, at u ({n}, ...): ({k}, ...).",
            expressions,
            constraints.names,
        ),
        writer.array(
            "constraint_slopes",
            "t, u, p",
            of_slopes,
            (k, n),
            dict(sorted(slopes.items())),
            lambda i, j: f"{constraints.names[i]}, by {names[j]}",
            "zeros",
        ),
    ]
