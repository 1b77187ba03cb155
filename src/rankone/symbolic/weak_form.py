"""The weak form: residual times test function, integrated over time and every parameter.

The first step of the proper generalized decomposition ("A Prior Reduced Model of Dynamical
Systems", MEIS 2014): with parameters as further coordinates, one variational statement holds for
all of their values at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import sympy as sp

from rankone.ir import Coordinate
from rankone.symbolic.notation import latex_of, text_of
from rankone.symbolic.problem import Problem

__all__ = ["WeakForm", "weak_form"]


@dataclass(frozen=True, repr=False)
class WeakForm:
    """For each equation: the integral of test function times residual vanishes.

    Attributes
    ----------
    coordinates : tuple of Coordinate
        The dimensions integrated over, time first.
    unknowns : tuple of Expr
        The unknowns; equation ``i`` is tested with the test function of unknown ``i``.
    test_functions : tuple of Symbol
        One for each equation, ``u*`` for the unknown ``u``.
    residuals : tuple of Expr
        Left minus right side of each equation, as the user wrote them.
    """

    coordinates: tuple[Coordinate, ...]
    unknowns: tuple[sp.Expr, ...]
    test_functions: tuple[sp.Symbol, ...]
    residuals: tuple[sp.Expr, ...]

    @cached_property
    def integrands(self) -> tuple[sp.Expr, ...]:
        """Test function times residual, for each equation."""
        return tuple(
            test * residual
            for test, residual in zip(self.test_functions, self.residuals, strict=True)
        )

    def __repr__(self) -> str:
        signs = " ".join(f"∫_{c.name}" for c in self.coordinates)
        measures = " ".join(f"d{c.name}" for c in reversed(self.coordinates))
        return "\n".join(
            f"{signs}  {test} ({text_of(residual)}) {measures} = 0"
            for test, residual in zip(self.test_functions, self.residuals, strict=True)
        )

    def _repr_latex_(self) -> str:
        signs = " ".join(rf"\int_{{{sp.latex(c.symbol)}}}" for c in self.coordinates)
        measures = r" \, ".join(rf"d{sp.latex(c.symbol)}" for c in reversed(self.coordinates))
        lines = [
            rf"{signs} {_starred(unknown)} \left({latex_of(residual)}\right) \, {measures} &= 0"
            for unknown, residual in zip(self.unknowns, self.residuals, strict=True)
        ]
        body = " \\\\\n".join(lines)
        return f"$$\\begin{{aligned}}\n{body}\n\\end{{aligned}}$$"


def _starred(unknown: sp.Expr) -> str:
    return rf"{{{latex_of(unknown)}}}^{{*}}"


def weak_form(problem: Problem) -> WeakForm:
    """Return the weak form of a problem over time and the box of its parameters."""
    return WeakForm(
        coordinates=problem.coordinates,
        unknowns=problem.unknowns,
        test_functions=tuple(sp.Symbol(f"{u.func.__name__}*") for u in problem.unknowns),
        residuals=problem.residuals,
    )
