"""The start at a steady state in the generated module: rates under its conditions."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from rankone.codegen.rates import GeneralWriter
from rankone.codegen.text import literal
from rankone.symbolic.first_order import RestForm


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
