"""The right-hand side f of ``u' = f``, read from the residual ``u' - f``."""

from __future__ import annotations

from fractions import Fraction

from rankone.ir.forms import SeparatedForm, Term
from rankone.support.errors import SeparationError

__all__ = ["right_hand_side"]


def right_hand_side(form: SeparatedForm) -> tuple[Term, ...]:
    """Terms of f in ``u' = f``, like terms merged, in the order of the form.

    Raises
    ------
    SeparationError
        If the derivative terms of the form are anything but one ``u'`` for each state.
    """
    merged: dict[tuple[int, tuple[int, ...], tuple[int, ...]], Fraction | float] = {}
    derivatives = []
    for term in form.terms:
        if term.derivative:
            derivatives.append((term.derivative, term.equation, term.monomial))
            if term.coefficient != 1.0 or any(term.factors):
                raise SeparationError(
                    f"the derivative of {form.states[term.equation].name} has a factor",
                    equation=term.equation + 1,
                    term=term,
                    remedy="divide the equation by the factor of the derivative",
                )
        else:
            key = (term.equation, term.factors, tuple(sorted(term.monomial)))
            merged[key] = merged.get(key, Fraction(0)) - term.coefficient
    if sorted(derivatives) != [(1, c, (c,)) for c in range(len(form.states))]:
        raise SeparationError(
            "the derivative terms are not one u' for each state",
            remedy="solve the equations for the derivatives",
        )
    return tuple(Term(c, value, factors, m) for (c, factors, m), value in merged.items() if value)
