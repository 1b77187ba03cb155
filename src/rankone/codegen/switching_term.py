"""Terms of the equations that switch where unknowns cross a value, and what is smooth instead."""

from __future__ import annotations

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.codegen.general import ExplicitSystem
from rankone.codegen.switching import JUMPS, boundaries
from rankone.ir.verdict import SwitchingTerm
from rankone.support.wording import quote, written

__all__ = ["switching_term"]


def switching_term(system: ExplicitSystem, state: int | None = None) -> SwitchingTerm | None:
    """Which term switches over the unknowns, and how to smooth it; None if there is none.

    Parameters
    ----------
    system : FirstOrderSystem
    state : int, optional
        The state whose rate is known to switch; by default the first that may.
    """
    for index in range(len(system.rhs)) if state is None else (state,):
        for term in sp.Add.make_args(system.rhs[index]):
            switches = [
                boundary
                for boundary, levels in boundaries([term], JUMPS)
                if levels is not None and boundary.has(AppliedUndef)
            ]
            if switches:
                return _described(system, index, term, min(switches, key=sp.default_sort_key))
    return None


def _described(
    system: ExplicitSystem, index: int, term: sp.Expr, boundary: sp.Expr
) -> SwitchingTerm:
    """A term by the names of the unknowns."""
    plain = {
        f: sp.Symbol(state.name) for f, state in zip(system.functions, system.states, strict=True)
    }
    term, boundary = term.xreplace(plain), boundary.xreplace(plain)
    origin = system.origins[index]
    where = f"the equation of {quote(system.states[index].name)}"
    where = where if origin is None else f"equation {origin}"
    smooth = f"tanh({boundary}/w)" if boundary.is_Symbol else f"tanh(({boundary})/w)"
    return SwitchingTerm(written(term), where, written(boundary), smooth)
