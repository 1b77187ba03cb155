"""Where functions such as ``Abs``, ``Heaviside`` or ``Piecewise`` kink or jump."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

import sympy as sp
from sympy.core.relational import Relational

from rankone.ir.functions import Table, nodes_of

CONTINUOUS = (sp.Abs, sp.Max, sp.Min, sp.asin, sp.acos, sp.Pow)
"""Functions that are continuous, but not smooth everywhere."""
DISCONTINUOUS = (Relational, sp.Heaviside, sp.sign, sp.floor, sp.ceiling, sp.frac, sp.Mod, Table)
"""Functions that may jump."""


def boundaries(
    expressions: Iterable[sp.Basic], functions: tuple[type, ...] = (*CONTINUOUS, *DISCONTINUOUS)
) -> Iterator[tuple[sp.Expr, Sequence[float] | None]]:
    """Where some functions are not smooth: expressions, and the levels that they take there.

    The levels are None for all integers.
    """
    zero = (0.0,)
    for node in nodes_of(expressions, *functions):
        if isinstance(node, Relational):
            yield node.lhs - node.rhs, zero
        elif isinstance(node, sp.Heaviside | sp.sign | sp.Abs):
            yield node.args[0], zero
        elif isinstance(node, sp.Max | sp.Min):
            for pair in itertools.combinations(node.args, 2):
                yield from ((a - b, zero) for a, b in itertools.product(*map(_compared, pair)))
        elif isinstance(node, sp.floor | sp.ceiling | sp.frac):
            yield node.args[0], None
        elif isinstance(node, sp.Mod):
            yield node.args[0] / node.args[1], None
        elif isinstance(node, sp.asin | sp.acos):
            yield node.args[0], (-1.0, 1.0)
        elif node.is_Pow and node.exp.is_number and not node.exp.is_integer:
            yield node.base, zero
        elif isinstance(node, Table) and node.kind != "cubic":
            yield node.args[0], node.points


def _compared(argument: sp.Expr) -> Sequence[sp.Expr]:
    """What an argument of an extreme is where it is smooth: of nested extremes their arguments."""
    if not isinstance(argument, sp.Max | sp.Min):
        return (argument,)
    return [each for inner in argument.args for each in _compared(inner)]
