"""The pipeline: from a problem to a generated module, and to a solution.

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

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Literal, cast

from rankone.agreement.comparison import LOST_SHARE
from rankone.agreement.problems import DisagreementError, check_problem
from rankone.agreement.tables import check_table
from rankone.codegen.module import general_source, generated_module
from rankone.codegen.text import with_constants
from rankone.frontend.markers import warn_of_missed_markers, with_markers
from rankone.frontend.problem import Problem
from rankone.interface.lifted import LiftedProblem
from rankone.interface.observed import SolveOutputs
from rankone.interface.renumbered import other_numbers, renumbered
from rankone.interface.resting import check_rest, check_totals
from rankone.interface.solution import Solution
from rankone.interface.stages import CompiledStages
from rankone.interface.stretched import StretchedProblem
from rankone.ir.forms import GeneralTerm
from rankone.ir.observation import Observation
from rankone.ir.request import SOLVE_ARGUMENTS, Domain, SolveRequest
from rankone.ir.verdict import Status
from rankone.solution.core import raise_blow_up
from rankone.solvers.engine import Engine
from rankone.solvers.registry import engines_for
from rankone.solvers.selection import solve_with
from rankone.support.budget import preparing
from rankone.support.errors import (
    ConvergenceError,
    OptionError,
    ProblemError,
    RankoneError,
    bounded_depth,
    check_kind,
)
from rankone.support.options import refuse_positional
from rankone.support.progress import Report, resolve_progress, timed
from rankone.support.threads import one_thread
from rankone.support.wording import quote
from rankone.symbolic import (
    check_moved,
    check_stages,
    check_start,
    symbolic_forms,
)
from rankone.symbolic.features import switching_term
from rankone.symbolic.well_posed import check_gaps

logger = logging.getLogger("rankone")
# Error of separated terms, over the largest rate, up to which the separated form is used
_SEPARATION_TOLERANCE = 1e-10


@dataclass(frozen=True, eq=False, repr=False)
class CompiledProblem(CompiledStages):
    """A problem with everything that was derived from it before numbers come in.

    Made by :func:`rankone.compile`.

    Attributes
    ----------
    first_order : FirstOrderSystem
        The equations solved for the derivatives.
    weak_form : WeakForm
        Residual times test function, integrated over every dimension.
    separated : SeparatedForm
        The terms, each a product of functions of one coordinate and a monomial.
    quadratic : QuadraticSystem or None
        The right-hand side with products of at most two states, its terms in groups; None if
        there are terms that do not separate.
    source : str
        Text of the generated module.
    timings : dict of str to float
        Seconds by stage.
    """

    def solve(
        self,
        rtol: float = 1e-6,
        *arguments: object,
        method: Literal["auto", "cross", "train", "greedy"] = "auto",
        parameters: Mapping[Any, Sequence[float | str]] | None = None,
        t_final: float | None = None,
        progress: bool | Report = False,
        check: bool | int = True,
        cover: Literal["interior", "box"] | None = None,
        effort: str | float = "normal",
        max_seconds: float | None = None,
        max_memory: str | float | None = None,
        unknowns: Sequence[object] | None = None,
        outputs: Mapping[str, object] | str | Sequence[str] | None = None,
        integrator: Literal["auto", "stack", "single", "compiled"] = "auto",
        markers: Literal["auto"] | Sequence[object] | None = "auto",
        on_failure: Literal["return", "raise"] = "return",
        **options: Any,
    ) -> Solution:
        """Solve for every parameter of the box at once.

        Parameters
        ----------
        rtol : float
            Largest error asked for, relative to the largest value of each unknown, between 1e-10
            and 0.1. It is measured against SciPy trajectories after the solve.
        method : {"auto", "train", "cross", "greedy"}
            The engine. "auto" tries cross and train, which first depends on the number of
            parameters. "train" is the tensor train on the preconditioned Volterra form; "cross"
            interpolates trajectories at chosen parameter points; "greedy" is the classic proper
            generalized decomposition with rank-one enrichments. Right-hand sides that do not
            separate need "cross".
        parameters : mapping, optional
            Other intervals of parameters, by symbols or names; nothing is compiled again. One
            that ends with a scale, ``(1e-3, 10, "log")``, has its measure as well.
        t_final : float, optional
            Another end of the horizon.
        progress : bool or callable
            True shows a bar on stderr; a callable gets a
            :class:`~rankone.support.progress.ProgressEvent` after each slab, or batch of samples.
        check : bool or int
            Number of check points in the interior, spread evenly (96 for True, at most 100000).
            False skips the check; the solution then does not count as a success.
        cover : {"interior", "box"}, optional
            What success covers: points of the interior, or corners of the box as well. By
            default "box" up to three parameters; beyond, corners are measured and stated.
        effort : {"low", "normal", "high"} or float
            Budget of counted work: 0.2, 1 or 10 times what a core does in about 25 seconds, or
            another factor; ten times as much where functions of the user are called. When it is
            spent, the best solution so far is returned, with ``success`` False. It is counted, not
            measured, so the result does not depend on how busy the machine is.
        max_seconds : float, optional
            Time limit on the clock besides; the result then depends on the machine.
        max_memory : float or str, optional
            Bytes that arrays may take at once, or a text such as ``"2GB"``. Needs are foreseen from
            counts of trajectories, states and ranks; what does not fit ends the solve before it
            is begun, with a message that says how much it needs. By default ``"4GB"``.
        unknowns : sequence, optional
            The unknowns to solve for, by functions ``x(t)``, their derivatives or names: the
            solution holds these alone, and their error has to be within the tolerance. By default
            all, derivatives that are states too. Rows are in the order of the problem.
        outputs : mapping of str to Expr or str, or definitions by name, optional
            Quantities to solve for in place of the unknowns, as :meth:`Solution.output` takes them:
            functions of unknowns, parameters and time. They are evaluated along trajectories; no
            unknown is stored or checked but those named in ``unknowns``, which the solution has
            beside the outputs. Integrals over time and extremes are outputs of that solution.
        integrator : {"auto", "stack", "single", "compiled"}
            How trajectories are integrated: many as one stacked system, each alone, or by compiled
            Taylor series, for which heyoka has to be installed. "auto" chooses by counted work,
            and changes where a stack stalls.
        markers : "auto", sequence of expressions, or None
            What may end stretches of time besides events. Over a stretch each trajectory has a time
            of its own, so that all of them are in phase. Expressions do so where they cross zero,
            such as ``x - 3``, as SymPy or text. "auto" chooses a state that crosses the middle of
            its range, if trajectories get far out of phase; and rates that switch (``Abs(x)``,
            ``sign(v)``) are held on their side from one crossing to the next. With None, stretches
            end at events alone, and without events the time is that of the clock.
        on_failure : {"return", "raise"}
            What to do when the tolerance is not reached: return the solution with ``success``
            False, or raise ConvergenceError, which carries it.
        **options
            Limits and discretisation of the engine: :class:`rankone.CrossOptions`,
            :class:`rankone.TrainOptions` or :class:`rankone.GreedyOptions`; for the latter also
            ``preset="slides"``.

        Raises
        ------
        BlowUpError
            A trajectory blows up inside the horizon. ``.solution`` holds the part up to there.
        ConvergenceError
            Only with ``on_failure="raise"``.
        OptionError
            An option is unknown or out of its range, or there is no such domain.
        SeparationError
            The method needs separated terms, and some term does not separate.
        """
        if not isinstance(on_failure, str) or on_failure not in ("return", "raise"):
            raise OptionError(
                f"on_failure={on_failure!r} is unknown", remedy="use 'return' or 'raise'"
            )
        refuse_positional(arguments, "method")
        checked = self._checked(
            rtol=rtol,
            method=method,
            parameters=parameters,
            t_final=t_final,
            check=check,
            cover=cover,
            effort=effort,
            max_seconds=max_seconds,
            max_memory=max_memory,
            unknowns=unknowns,
            outputs=outputs,
            integrator=integrator,
            markers=markers,
            **options,
        )
        solution = checked.compiled._solved(checked, progress)
        if checked.compiled is not self:
            warn_of_missed_markers(cast(Sequence[object], markers), solution.outcome.timeline)
        if on_failure == "raise" and not solution.success:
            verdict = solution.outcome.verdict
            raise ConvergenceError(
                str(verdict.without_remedy()), solution=solution, remedy=verdict.remedy
            )
        return solution

    def _checked(
        self,
        *,
        method: str = "auto",
        outputs: object = None,
        unknowns: object = None,
        markers: object = "auto",
        **options: Any,
    ) -> _CheckedSolve:
        """Check the arguments of :meth:`solve`; an OptionError names one that is not valid."""
        observed, timings = None, dict[str, float]()
        if outputs is not None:
            chosen = method, markers
            domain = options.get("parameters"), options.get("t_final")
            observed = self._observation(outputs, unknowns, chosen, *domain)
            method, unknowns, markers = "cross", None, None
            timings["outputs"] = self._outputs.seconds
        if markers is not None and markers != "auto":
            marked = compile_problem(with_markers(self.problem, markers))
            return marked._checked(method=method, unknowns=unknowns, **options)
        arguments = {name: options.pop(name) for name in SOLVE_ARGUMENTS if name in options}
        count = len(self.separated.coordinates) - 1
        separated, states = self._has_operators, len(self.first_order.states)
        engines = engines_for(method, options, count, separated=separated, states=states)
        form = self.form_for(str(method))
        request = SolveRequest.of(
            form.system,
            [engine.options for engine in engines],
            options,
            **arguments,
            unknowns=unknowns,
            markers=markers == "auto",
            arguments=("method", "outputs", "progress", "on_failure"),
        )
        return _CheckedSolve(self, replace(request, observed=observed), engines, form, timings)

    def _solved(self, checked: _CheckedSolve, progress: bool | Report) -> Solution:
        """Solve in one of the forms; a BlowUpError where a trajectory blows up."""
        request, engines, form = checked.request, checked.engines, checked.form
        if request.domain != Domain.of(form.system):
            self._check_gaps(request.domain)
            check_moved(self.problem, self.first_order, self.separated, self.system, request.domain)
        truth = self.system if isinstance(form, LiftedProblem) else None
        system, observed = form.system, request.observed
        if form is self and observed is None and self._held is not None:
            system = replace(system, held=self._held)
        began = time.perf_counter()
        with resolve_progress(progress) as report, one_thread():
            check_rest(system, request)
            outcome, metadata = solve_with(engines, system, request, self.metadata(), report, truth)
        seconds = time.perf_counter() - began
        logger.info("solve: %.3f s, %s", seconds, outcome.message)
        before = {"problem": self.problem.seconds, "compile": sum(self.timings.values())}
        timings = {**before, **checked.timings, **outcome.timings, "solve": seconds}
        notes = outcome.notes
        if outcome.status not in (Status.CONVERGED, Status.UNCHECKED):
            kinks = not outcome.status.ends_early
            term = switching_term(self.first_order, outcome.switching, kinks=kinks)
            notes = notes if term is None else (*notes, term)
        if observed is not None:  # no state is kept that could be named
            metadata, outcome = metadata.observing(observed), replace(outcome, switching=None)
        solution = Solution(replace(outcome, timings=timings, notes=notes), metadata)

        def on_box(intervals: Mapping[int, tuple[float, float]], factor: float) -> Solution:
            smaller = replace(checked, request=request.on_box(intervals, factor))
            return self._solved(smaller, False)

        raise_blow_up(solution, on_box)
        return solution

    def _observation(
        self,
        outputs: object,
        unknowns: object,
        chosen: tuple[object, object],
        parameters: Mapping[Any, Sequence[float | str]] | None,
        t_final: float | None,
    ) -> Observation:
        """What is kept of trajectories for outputs; ``chosen`` are the method and the markers."""
        method, markers = chosen
        if method not in ("auto", "cross") or markers not in ("auto", None):
            which = f"method={method!r}" if method not in ("auto", "cross") else "markers"
            raise OptionError(
                f"outputs are evaluated along trajectories, which {which} does not apply to",
                remedy=f"leave {which.partition('=')[0]} out, or ask the solution: "
                "solve(...).output(...)",
            )
        domain = Domain.of(self.system).moved(self.system.parameters, parameters, t_final)
        return self._outputs.over(domain, outputs, unknowns)

    @cached_property
    def _outputs(self) -> SolveOutputs:
        """The outputs of solves, each translated once for all boxes."""
        return SolveOutputs(self.system, self.metadata())

    def _check_gaps(self, domain: Domain) -> None:
        """Raise an OptionError if a piecewise function has a gap on another domain."""
        intervals = zip(self.separated.coordinates, (domain.horizon, *domain.box), strict=True)
        moved = [replace(c, lower=lower, upper=upper) for c, (lower, upper) in intervals]
        try:
            check_gaps(self.first_order.piecewise(), moved)
        except ProblemError as error:
            raise OptionError(error.message, term=error.term, remedy=error.remedy) from error

    def export(
        self,
        path: str | PathLike[str],
        *arguments: object,
        method: str = "auto",
        overwrite: bool = False,
    ) -> Path:
        """Write a standalone solver: one Python file that needs only NumPy and SciPy.

        Parameters
        ----------
        path : path-like
            Ends in ``.py``.
        method : {"auto", "train", "cross", "greedy"}
            The engine; ``"auto"`` takes the one that :meth:`solve` tries first.
        overwrite : bool
            Whether to replace an existing file.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        ExportError
            If the path has another suffix, exists or cannot be written, the method does not apply
            to the problem, or the problem has functions of the user.
        OptionError
            If there is no such method.
        """
        refuse_positional(arguments, "method")
        from rankone.export import export_solver

        return export_solver(self, path, method=method, overwrite=overwrite)


@dataclass(frozen=True)
class _CheckedSolve:
    """A solve whose arguments were checked: of a problem, in a form, by engines in turn.

    ``timings`` are seconds by what was done for it before.
    """

    compiled: CompiledProblem
    request: SolveRequest
    engines: Sequence[Engine]
    form: CompiledStages | LiftedProblem | StretchedProblem
    timings: dict[str, float]


def check_arguments(compiled: CompiledProblem, options: Mapping[str, Any]) -> None:
    """Check the arguments of :meth:`CompiledProblem.solve` without solving.

    An OptionError names one that is not valid.
    """
    compiled._checked(**options)


def compile_problem(problem: Problem) -> CompiledProblem:
    """Compile a problem: every stage up to the generated module.

    Raises
    ------
    ProblemError
        A coefficient is complex or not finite somewhere in the box, or a function cannot be
        written with NumPy or SciPy.
    """
    remedy = "build one with rankone.Problem(...) or Problem.from_strings(...)"
    if isinstance(problem, CompiledProblem):
        remedy = "this one is compiled already; call its .solve(...)"
    check_kind("compile", problem, Problem, remedy=remedy)
    with bounded_depth():
        alike = (_renumbered(compiled, problem) for compiled in problem.compiled)
        compiled = next(filter(None, alike), None) or _compiled(problem)
    if problem.shorthand.named and not problem.compiled:
        problem.compiled.append(compiled)
    return compiled


def _renumbered(compiled: CompiledProblem, problem: Problem) -> CompiledProblem | None:
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
            other = CompiledProblem(
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


def _compiled(problem: Problem) -> CompiledProblem:
    """Every stage up to the generated module."""
    timings: dict[str, float] = {}
    system, weak, separated = symbolic_forms(problem, timings)
    quadratic, specification = generated_module(system, separated, problem.name, timings)
    source = specification.source
    compiled = CompiledProblem(problem, system, weak, separated, quadratic, source, timings)
    with timed(timings, "import"):
        vars(compiled)["system"] = specification.load()
    check_totals(problem, compiled.system)
    if separated.general or system.constraints.guessed or system.rest is not None:
        check_start(system, compiled.system, system.coordinates)
    with timed(timings, "agreement"):
        return _agreeing(compiled)


def _agreeing(compiled: CompiledProblem) -> CompiledProblem:
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


def _not_separated(compiled: CompiledProblem, error: DisagreementError) -> CompiledProblem:
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


def solve_problem(
    problem: Problem, rtol: float = 1e-6, *arguments: object, **options: Any
) -> Solution:
    """Compile and solve a problem; the same as ``rankone.compile(problem).solve(rtol, ...)``.

    See :meth:`CompiledProblem.solve` for the options; ``max_seconds`` includes compiling.
    """
    with preparing(options.get("max_seconds")):
        return compile_problem(problem).solve(rtol, *arguments, **options)
