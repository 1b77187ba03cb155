"""A direct interpreter of the separated form: the oracle for generated code.

It sums term by term and evaluates factors with :func:`sympy.lambdify`; it shares no code with the
generator.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import sympy as sp

from rankone.problem.forms import SeparatedForm, Term
from rankone.support.arrays import Array


@cache
def compiled(symbol: sp.Symbol, expression: sp.Expr) -> Any:
    return sp.lambdify(symbol, expression, "numpy")


class Interpreter:
    """Evaluates f of ``u' = f`` for a form."""

    def __init__(self, form: SeparatedForm) -> None:
        self.form = form
        self.terms = [term for term in form.terms if not term.derivative]

    def factor(self, dimension: int, row: int, at: Any) -> Array:
        """One factor at points of its coordinate."""
        symbol = self.form.coordinates[dimension].symbol
        function = compiled(symbol, self.form.factors[dimension][row].expression)
        return np.asarray(function(at) + 0.0 * np.asarray(at))

    def coefficient(self, term: Term, t: Any, p: Any) -> Array:
        """Everything of a term of f but its monomial."""
        value = np.asarray(-float(term.coefficient))
        for j, (row, at) in enumerate(zip(term.factors, (t, *p), strict=True)):
            value = value * self.factor(j, row, at)
        return value

    def rhs(self, t: Any, u: Array, p: Any) -> Array:
        """f(t, u, p): shape (n, ...)."""
        shape = np.broadcast_shapes(np.shape(t), np.shape(u)[1:], *map(np.shape, p))
        out = np.zeros((len(self.form.states), *shape))
        for term in self.terms:
            monomial = [u[state] for state in term.monomial]
            out[term.equation] += self.coefficient(term, t, p) * np.prod(monomial, axis=0)
        return out

    def jacobian(self, t: Any, u: Array, p: Any) -> Array:
        """df/du by the product rule: shape (n, n, ...)."""
        n = len(self.form.states)
        shape = np.broadcast_shapes(np.shape(t), np.shape(u)[1:], *map(np.shape, p))
        out = np.zeros((n, n, *shape))
        for term in self.terms:
            for position, state in enumerate(term.monomial):
                others = [u[s] for k, s in enumerate(term.monomial) if k != position]
                slope = self.coefficient(term, t, p) * np.prod(others, axis=0)
                out[term.equation, state] += slope
        return out
