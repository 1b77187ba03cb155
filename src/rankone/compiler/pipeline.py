"""The pipeline: from a problem to a generated module.

===============  =====================  ==========================================================
stage            result                 what happens
===============  =====================  ==========================================================
first order      ``.first_order``       orders reduced, masses inverted: u' = f(t, p, u)
weak form        ``.weak_form``         residual times test function, integrated over all dimensions
separation       ``.separated``         every term factored into functions of one coordinate
lowering         ``.quadratic``         products of at most two states, terms grouped by factors;
                                        None if there are terms that do not separate
lifting          ``.lifted``            for those, functions of unknowns as further unknowns
code generation  ``.source``            kernels, factors and pointwise functions as readable text
import           ``.system``            the text is run as a module
solve            a ``Solution``         an engine enriches separated tensors over a domain
===============  =====================  ==========================================================

Each stage takes what the one before made, and nothing else. Each is timed in ``.timings`` (seconds)
and in the log ``rankone``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from rankone.compiler.agreement.agreement import DisagreementError, check_problem
from rankone.compiler.agreement.comparison import LOST_SHARE
from rankone.compiler.agreement.table_agreement import check_table
from rankone.compiler.codegen.layout import with_constants
from rankone.compiler.codegen.module import general_source, generated_module
from rankone.compiler.passes import check_stages, check_start, symbolic_forms
from rankone.compiler.passes.well_posed import check_gaps
from rankone.compiler.reformulated import check_totals, other_numbers, renumbered
from rankone.compiler.stages import CompiledStages
from rankone.problem.forms import GeneralTerm
from rankone.problem.problem import Problem
from rankone.support.errors import RankoneError
from rankone.support.progress import timed
from rankone.support.wording import quote

_Stages = TypeVar("_Stages", bound=CompiledStages)
# Error of separated terms, over the largest rate, up to which the separated form is used
_SEPARATION_TOLERANCE = 1e-10


def with_numbers_of(compiled: _Stages, problem: Problem) -> _Stages | None:
    """What was compiled of a problem that differs in numbers of run-time constants alone.

    None if that does not hold for these numbers: then compiling anew says why, or does better.
    """
    if compiled.problem is problem:
        return compiled
    timings: dict[str, float] = {}
    try:
        with timed(timings, "constants"):
            numbers = other_numbers(compiled.problem, problem)
            constants = {c.name: float(c) for c in problem.shorthand.named.values()}
            other = type(compiled)(
                problem,
                renumbered(compiled.first_order, numbers),
                renumbered(compiled.weak_form, numbers),
                renumbered(compiled.separated, numbers),
                renumbered(compiled.quadratic, numbers),
                with_constants(compiled.source, constants),
                timings,
            )
            coordinates, first_order = other.separated.coordinates, other.first_order
            check_gaps(first_order.piecewise(), coordinates)
            check_stages(first_order, other.separated, other.system, coordinates)
        with timed(timings, "agreement"):
            lost = LOST_SHARE if other.quadratic is None else _SEPARATION_TOLERANCE
            check_problem(problem, first_order, other.system, lost)
    except RankoneError:
        return None
    return other


def compiled_stages(kind: type[_Stages], problem: Problem) -> _Stages:
    """Every stage of a problem, up to the generated module."""
    timings: dict[str, float] = {}
    system, weak, separated = symbolic_forms(problem, timings)
    quadratic, specification = generated_module(system, separated, problem.name, timings)
    source = specification.source
    compiled = kind(problem, system, weak, separated, quadratic, source, timings)
    with timed(timings, "import"):
        vars(compiled)["system"] = specification.load()
    check_totals(problem, compiled.system)
    if separated.general or system.constraints.guessed or system.rest is not None:
        check_start(system, compiled.system, system.coordinates)
    with timed(timings, "agreement"):
        return _agreeing(compiled)


def _agreeing(compiled: _Stages) -> _Stages:
    """The compiled problem, checked against its equations; not separated where that loses digits.

    Multiplied out, a power of ``x - 310`` is a difference of large numbers.
    """
    problem, first_order = compiled.problem, compiled.first_order
    if problem.table is not None and compiled.quadratic is not None:
        check_table(problem, problem.table, compiled.system)
        return compiled
    if first_order.table is not None and first_order.table.forms:
        try:
            check_table(problem, first_order.table, compiled.system)
            return compiled
        except DisagreementError:  # or rounding, which the comparison below tells apart
            pass
    if compiled.quadratic is not None:
        try:
            check_problem(problem, first_order, compiled.system, _SEPARATION_TOLERANCE)
            return compiled
        except DisagreementError as error:
            as_written = _not_separated(compiled, error)
        try:
            check_problem(problem, first_order, as_written.system, _SEPARATION_TOLERANCE)
            return as_written
        except DisagreementError:
            pass  # no form keeps more digits
    check_problem(problem, first_order, compiled.system)
    return compiled


def _not_separated(compiled: _Stages, error: DisagreementError) -> _Stages:
    """The problem with functions as they are written, since multiplied out they lose digits."""
    first_order = compiled.first_order
    origins = first_order.origins
    state = origins.index(error.equation) if error.equation in origins else 0
    rate = first_order.rhs[state]
    reason = f"{quote(rate)} loses digits when it is multiplied out"
    remedy = "method='cross' takes it as it is; count the unknowns from where they are"
    term = GeneralTerm(state, rate, False, reason, remedy, error.equation)
    return replace(
        compiled,
        separated=replace(compiled.separated, general=(term,)),
        quadratic=None,
        source=general_source(first_order, compiled.problem.name),
    )
