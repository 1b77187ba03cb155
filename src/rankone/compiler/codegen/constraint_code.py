"""Constraints and starts at rest in the generated module."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from rankone.compiler.codegen.layout import literal, quoted, table
from rankone.compiler.codegen.pointwise import Index, PointwiseWriter
from rankone.compiler.codegen.rates import GeneralWriter
from rankone.compiler.passes.first_order import RestForm
from rankone.problem.expressions.derivatives import Differentiator
from rankone.problem.expressions.stable import stable
from rankone.problem.forms import ConstraintForms


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


# -----------------------------------------------------------------------------
# The start at a steady state in the generated module: rates under its conditions.


def rest_blocks(rest: RestForm | None) -> tuple[list[Sequence[str]], Sequence[sp.Expr]]:
    """The functions of the system before the start, and what they print; none without one."""
    if rest is None:
        return [], []
    system = rest.system
    writer, n = GeneralWriter(system), len(system.states)
    names = [state.name for state in system.states]
    after = f"States right after the start from those at rest u ({n}, ...): ({n}, ...)."
    rates, jacobian, _ = writer.functions("rest_")
    blocks: list[Sequence[str]] = [
        [
            f"# {rest.text}",
            "# first look at trajectories that come to rest, and the longest time they may take",
            f"SETTLE = {literal(rest.settle)}",
        ],
        rates,
        jacobian,
        writer.initial("rest_initial"),
        writer.vector("after_rest", "t, u, p", after, rest.after or (), names),
    ]
    return blocks, writer.printed
