"""Unknowns as functions of time, and their derivatives, without SymPy's search for rules.

A system of a thousand states has thousands of them: SymPy takes a fifth of a millisecond for a
function and a third for a derivative that it then leaves as it is.
"""

from __future__ import annotations

from functools import lru_cache

import sympy as sp

_KEPT = 10_000  # Functions that are kept


@lru_cache(_KEPT)
def unknown_of(name: str, time: sp.Symbol) -> sp.Expr:
    """The function of time with a name: ``x(t)``."""
    return sp.Function(name)(time)


def rate_of(state: sp.Expr, time: sp.Symbol, order: int = 1) -> sp.Expr:
    """The derivative of an applied function of time, or of its derivative.

    >>> t = sp.Symbol("t")
    >>> x = unknown_of("x", t)
    >>> rate_of(x, t) == x.diff(t), rate_of(x.diff(t), t) == x.diff(t, 2)
    (True, True)
    """
    return sp.Derivative(state, (time, order), evaluate=False)
