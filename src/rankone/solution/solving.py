"""The two ways in: compile a problem, and solve one, with fields or without."""

from __future__ import annotations

from typing import Any, overload

from rankone.problem.problem import FieldProblem, Problem
from rankone.solution.compiled import CompiledProblem, compile_problem
from rankone.solution.compiled_fields import CompiledFields
from rankone.solution.fields.field_solution import FieldSolution
from rankone.solution.solution import Solution
from rankone.support.budget import preparing
from rankone.support.options import RTOL, takes_options_of


@overload
def compile_any(problem: FieldProblem) -> CompiledFields: ...  # type: ignore[overload-overlap]
@overload
def compile_any(problem: Problem) -> CompiledProblem: ...
def compile_any(problem: Problem) -> CompiledProblem | CompiledFields:
    """Compile a problem: every stage up to the generated module.

    One with fields becomes a :class:`rankone.CompiledFields`, all others a
    :class:`rankone.CompiledProblem`.

    Raises
    ------
    ProblemError
        A coefficient is complex or not finite somewhere in the box, or a function cannot be
        written with NumPy or SciPy.
    """
    if isinstance(problem, FieldProblem):
        return CompiledFields.of(problem, compile_problem)
    return compile_problem(problem)


@overload
def solve_any(problem: FieldProblem, rtol: float = RTOL, **options: Any) -> FieldSolution: ...
@overload
def solve_any(problem: Problem, rtol: float = RTOL, **options: Any) -> Solution: ...
@takes_options_of(CompiledProblem.solve)
def solve_any(problem: Problem, rtol: float = RTOL, **options: Any) -> Solution | FieldSolution:
    """Compile and solve a problem; the same as ``rankone.compile(problem).solve(rtol, ...)``.

    With fields the options are those of :meth:`rankone.CompiledFields.solve`.

    Parameters
    ----------
    problem : Problem
        What to solve. ``max_seconds`` includes compiling it.
    """
    with preparing(options.get("max_seconds")):
        return compile_any(problem).solve(rtol, **options)
