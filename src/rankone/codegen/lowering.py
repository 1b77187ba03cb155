"""From the separated form to the quadratic system that is printed.

===================  ===============================================================================
``right_hand_side``  f of ``u' = f`` from the residual
``products``         products of more than two states become products of two, by auxiliary states
``grouping``         terms by signature; which states a group's products pair
``pairs``            extraction of frequent pairs
===================  ===============================================================================
"""

from __future__ import annotations

from rankone.codegen.grouping import group_terms
from rankone.codegen.products import auxiliary_states, lower
from rankone.codegen.right_hand_side import right_hand_side
from rankone.expressions.admissible import known_functions
from rankone.ir.forms import Factor, QuadraticSystem, SeparatedForm
from rankone.support.errors import check_kind

__all__ = ["quadratic_system"]


def quadratic_system(form: SeparatedForm) -> QuadraticSystem:
    """Lower and group a separated form.

    Known functions of one parameter in jumps join the factors: they are to be resolved as well.

    Raises
    ------
    SeparationError
        If its rates have general terms, or its derivative terms are anything but one ``u'`` for
        each state.
    OptionError
        If it is not a separated form.
    """
    remedy = "give separate(problem); what is compiled has `.separated`"
    check_kind("quadratic_system", form, SeparatedForm, remedy=remedy)
    form.require_separated_rates()
    f = right_hand_side(form)
    products, terms = lower(f, len(form.states))
    return QuadraticSystem(
        coordinates=form.coordinates,
        states=(*form.states, *auxiliary_states(form.states, products)),
        factors=_with_jumps(form),
        rhs=f,
        products=products,
        groups=group_terms(terms),
        initial=form.initial,
        coupled=form.general,
        jumps=form.jumps,
    )


def _with_jumps(form: SeparatedForm) -> tuple[tuple[Factor, ...], ...]:
    """The factors, and after them the functions of one parameter in values after jumps."""
    known = known_functions(form.coordinates, (v for jump in form.jumps for v in jump.values))
    found = [form.factors[0]]
    for j, (factors, more) in enumerate(zip(form.factors[1:], known[1:], strict=True), 1):
        there = {factor.expression for factor in factors}
        found.append((*factors, *(Factor(j, f) for f in more if f not in there)))
    return tuple(found)
