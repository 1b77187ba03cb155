"""The lifted form of a problem, for the methods that need separated terms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import sympy as sp

from rankone.agreement.problems import disagreeing_rate
from rankone.codegen.loading import ModuleSpecification
from rankone.codegen.lowering import quadratic_system
from rankone.codegen.module import generate_source
from rankone.ir.forms import QuadraticSystem, SeparatedForm
from rankone.ir.functions import namespace_of
from rankone.ir.system import System
from rankone.support.errors import ProblemError
from rankone.symbolic import FirstOrderSystem, separate, weak_form
from rankone.symbolic.lifting import Lifting, NotLiftable, lift


@dataclass(frozen=True, eq=False, repr=False)
class LiftedProblem:
    """A system with functions of its states as further states, so that its terms separate.

    ``lifting`` has the lifted states, with their equations and initial values, and invariants;
    ``name`` is of the problem.
    """

    lifting: Lifting
    separated: SeparatedForm
    quadratic: QuadraticSystem
    name: str

    @cached_property
    def source(self) -> str:
        """Text of the generated module."""
        system = self.lifting.system
        return generate_source(
            self.quadratic, self.name, self.lifting.meanings, system.constraints, system.rest
        )

    @cached_property
    def system(self) -> System:
        """The generated module."""
        jumps = (after for jump in self.lifting.system.jumps for after in jump.values)
        name = f"{self.name or 'system'} lifted"
        return ModuleSpecification(self.source, name, namespace_of(jumps)).load()

    def __getstate__(self) -> dict[str, object]:
        return {name: stage for name, stage in self.__dict__.items() if name != "system"}

    def __str__(self) -> str:
        return str(self.lifting)

    __repr__ = __str__


def lifted_problem(
    first_order: FirstOrderSystem, system: System, name: str
) -> LiftedProblem | sp.Expr:
    """The lifted form of a first-order system, or the expression that has none.

    It has none either where numbers overflow once it is multiplied out.
    """
    try:
        lifting = lift(first_order)
    except NotLiftable as part:
        return part.expression
    try:
        separated = separate(weak_form(lifting.system))
    except ProblemError as error:
        return sp.sympify(error.term)
    for term in separated.general:
        if not term.initial:
            return term.expression
    lifted = LiftedProblem(lifting, separated, quadratic_system(separated), name)
    wrong = disagreeing_rate(lifted.system, system)
    return lifted if wrong is None else first_order.rhs[wrong]
