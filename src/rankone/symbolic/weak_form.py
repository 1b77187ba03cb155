"""The weak form: residual times test function, integrated over time and every parameter.

The first step of the proper generalized decomposition ("A Prior Reduced Model of Dynamical
Systems", MEIS 2014): with parameters as further coordinates, one variational statement holds for
all of their values at once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import sympy as sp

from rankone.expressions.notation import latex_of, text_of
from rankone.frontend.problem import Problem
from rankone.support.display import aligned_equations
from rankone.support.errors import check_kind
from rankone.symbolic.first_order import FirstOrderSystem, Stage, first_order

__all__ = ["WeakForm", "weak_form"]


@dataclass(frozen=True, repr=False)
class WeakForm(Stage):
    """For each state: the integral of test function times residual vanishes.

    Attributes
    ----------
    coordinates, states, functions, initial, origins
        As for every :class:`~rankone.symbolic.first_order.Stage`; equation ``i`` is tested with
        the test function of state ``i``.
    residuals : tuple of Expr
        The residual u' - f of each equation, in the states' ``functions``.
    """

    residuals: tuple[sp.Expr, ...]

    @property
    def test_functions(self) -> tuple[sp.Symbol, ...]:
        """One for each state: ``u*`` for the state ``u``."""
        return tuple(sp.Symbol(f"{state.name}*") for state in self.states)

    @property
    def integrands(self) -> tuple[sp.Expr, ...]:
        """Test function times residual, for each state."""
        pairs = zip(self.test_functions, self.residuals, strict=True)
        return tuple(test * residual for test, residual in pairs)

    def __repr__(self) -> str:
        signs = " ".join(f"∫_{c.name}" for c in self.coordinates)
        measures = " ".join(f"d{c.name}" for c in reversed(self.coordinates))
        lines = [
            f"{signs}  {test} ({text_of(residual)}) {measures} = 0"
            for test, residual in zip(self.test_functions, self.residuals, strict=True)
        ]
        return "\n".join([*lines, *self._initial_texts(), *self._jump_texts()])

    def _repr_latex_(self) -> str:
        signs = " ".join(rf"\int_{{{sp.latex(c.symbol)}}}" for c in self.coordinates)
        measures = r" \, ".join(rf"d{sp.latex(c.symbol)}" for c in reversed(self.coordinates))
        lines = [
            rf"{signs} {{{latex_of(u)}}}^{{*}} \left({latex_of(residual)}\right) "
            rf"\, {measures} &= 0"
            for u, residual in zip(self.functions, self.residuals, strict=True)
        ]
        return aligned_equations([*lines, *self._initial_latex(), *self._jump_latex()])


def weak_form(system: FirstOrderSystem | Problem) -> WeakForm:
    """Return the weak form over time and the box of the parameters.

    Parameters
    ----------
    system : FirstOrderSystem or Problem
        A problem is reduced to first order before.

    Raises
    ------
    OptionError
        If it is neither.
    """
    if isinstance(system, Problem):
        system = first_order(system)
    remedy = "give a problem or first_order(problem); what is compiled has `.weak_form`"
    check_kind("weak_form", system, FirstOrderSystem, Problem, remedy=remedy)
    rates = [sp.Derivative(u, system.coordinates[0].symbol) for u in system.functions]
    shared = {field.name: getattr(system, field.name) for field in fields(Stage)}
    residuals = tuple(rate - f for rate, f in zip(rates, system.rhs, strict=True))
    return WeakForm(**shared, residuals=residuals)
