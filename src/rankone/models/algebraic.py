"""Algebraic rules: those that are linear in what they determine become assignment rules.

Others stay equations, and Newton's method finds what they determine.
"""

from __future__ import annotations

from collections.abc import Mapping

import sympy as sp
from sympy.matrices.exceptions import NonInvertibleMatrixError
from sympy.solvers.solveset import NonlinearError

from rankone.models.definitions import expanded, ordered
from rankone.models.mathml import Expressions
from rankone.models.quantities import Quantity
from rankone.models.reactions import Reactions
from rankone.models.rules import Rules
from rankone.support.errors import ProblemError
from rankone.support.wording import count, listing


def solved(
    rules: Rules,
    reactions: Reactions,
    quantities: Mapping[str, Quantity],
    reset: frozenset[str],
) -> tuple[Expressions, Expressions]:
    """Assignment rules for what algebraic rules determine, or for each what vanishes.

    These are what may change but has no rule and is neither changed by reactions nor ``reset`` by
    events. A ProblemError names the rules if they determine too little.
    """
    if not rules.algebraic:
        return {}, {}
    tables = (rules.assigned, reactions.laws)
    definitions = {sp.Symbol(name): e for table in tables for name, e in table.items()}
    full = expanded(ordered(definitions))
    residuals = [e.xreplace(full) for e in rules.algebraic.values()]
    determined = {*rules.assigned, *rules.rates, *reactions.changes, *reset}
    free = {name for name, each in quantities.items() if not each.constant} - determined
    present = sorted(
        {symbol for e in residuals for symbol in e.free_symbols if symbol.name in free}, key=str
    )
    labels = ", ".join(rules.algebraic)
    if len(present) != len(residuals):
        raise ProblemError(
            f"{labels}: {count(len(residuals), 'rule')} for what nothing else determines: "
            f"{listing(map(str, present)) or 'nothing'}",
            term=labels,
            remedy="write assignment rules",
        )
    try:
        matrix, right = sp.linear_eq_to_matrix(residuals, present)
        values = matrix.LUsolve(right)
    except NonlinearError:
        pairs = zip(present, rules.algebraic.values(), strict=True)
        return {}, {symbol.name: residual for symbol, residual in pairs}
    except (NonInvertibleMatrixError, ZeroDivisionError):
        raise ProblemError(
            f"{labels}: they do not determine {listing(map(str, present))}", term=labels
        ) from None
    return {symbol.name: value for symbol, value in zip(present, values, strict=True)}, {}
