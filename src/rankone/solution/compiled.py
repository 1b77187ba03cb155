"""Compiled problems, which are solved, also with markers that users give."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Literal, cast

import sympy as sp

from rankone.compiler.passes import check_moved
from rankone.compiler.passes.feature_pass import switching_term
from rankone.compiler.passes.well_posed import check_gaps
from rankone.compiler.reformulated import LiftedProblem, SolveOutputs, StretchedProblem, check_rest
from rankone.compiler.stages import CompiledStages, compiled_stages, with_numbers_of
from rankone.problem.problem import FieldProblem, Problem
from rankone.problem.text import formula
from rankone.problem.user_events import Event
from rankone.solution.evaluation.core import raise_blow_up
from rankone.solution.solution import Solution
from rankone.solvers.request import (
    SOLVE_ARGUMENTS,
    USUAL_POINTS,
    Domain,
    Observation,
    SolveArguments,
    SolveRequest,
)
from rankone.solvers.selection import engines_for, solve_with
from rankone.solvers.ways import Engine
from rankone.support.budget import Report, resolve_progress
from rankone.support.errors import (
    ConvergenceError,
    OptionError,
    ProblemError,
    bounded_depth,
    check_kind,
    listing,
    quote,
    warn,
)
from rankone.support.options import RTOL
from rankone.support.tasks import one_thread
from rankone.tensors.coordinates import name_of
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline
from rankone.trajectories.system.verdict import Status

_REMEDY = "give a list of expressions that cross zero, such as [x - 3], or 'auto', or None"


def with_markers(problem: Problem, markers: object) -> Problem:
    """The problem with events ``marker_0``, ``marker_1``, ... that change nothing.

    Parameters
    ----------
    problem : Problem
    markers : sequence of Expr or str
        What crosses zero there, in unknowns, derivatives that are states, time and parameters.

    Raises
    ------
    OptionError
        If they are not a sequence of expressions of the problem, or there are none.
    """
    if isinstance(markers, str | sp.Basic) or not isinstance(markers, Sequence) or not markers:
        raise OptionError(f"markers={markers!r} is no list of expressions", remedy=_REMEDY)
    names = {name_of(u): u for u in problem.initial if not isinstance(u, sp.Derivative)}
    names |= {c.name: c.symbol for c in problem.coordinates}
    try:
        events = [
            Event(formula(marker, names, "marker", None), name=f"marker_{k}")
            if isinstance(marker, str)
            else Event(marker, name=f"marker_{k}")
            for k, marker in enumerate(markers)
        ]
        return type(problem)(**{**problem.written, "events": [*problem.events, *events]})
    except ProblemError as error:
        message = f"markers={quote(markers)}: {error.message}"
        raise OptionError(message, term=error.term, remedy=error.remedy or _REMEDY) from None


def warn_of_missed_markers(
    markers: Sequence[object], timeline: Timeline | BranchedTimeline | None
) -> None:
    """Warn of markers that no trajectory crosses, so that no stretch ends with them."""
    if timeline is None:
        return
    met = {name for instant in timeline.met for name in instant}
    missed = [str(marker) for k, marker in enumerate(markers) if f"marker_{k}" not in met]
    if missed:
        warn(
            f"no trajectory crosses zero in {listing(missed)}: time is that of the clock there",
            remedy="mark what every trajectory crosses, or leave markers out",
        )


# -----------------------------------------------------------------------------
# Compiled problems: what users hold before a solve.


logger = logging.getLogger("rankone")


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
        rtol: float = RTOL,
        *,
        method: Literal["auto", "cross", "train", "greedy"] = "auto",
        parameters: Mapping[Any, Sequence[float | str]] | None = None,
        t_final: float | None = None,
        progress: bool | Report = False,
        check: int = USUAL_POINTS,
        cover: Literal["interior", "box"] | None = None,
        effort: str | float = "normal",
        max_seconds: float | None = None,
        max_memory: str | float | None = None,
        unknowns: Sequence[object] | None = None,
        outputs: Mapping[str, object] | str | Sequence[str] | None = None,
        integrator: Literal["auto", "stack", "single"] = "auto",
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
            parameters; it takes the options that both have. "train" is the tensor train on the
            preconditioned Volterra form; "cross" interpolates trajectories at chosen parameter
            points; "greedy" is the classic proper generalized decomposition with rank-one
            enrichments. Right-hand sides that do not separate need "cross".
        parameters : mapping, optional
            Other intervals of parameters, by symbols or names; nothing is compiled again. One
            that ends with a scale, ``(1e-3, 10, "log")``, has its measure as well.
        t_final : float, optional
            Another end of the horizon.
        progress : bool or callable
            True shows a bar on stderr; a callable gets a
            :class:`~rankone.support.budget.ProgressEvent` after each slab, or batch of samples.
        check : int
            Number of check points in the interior, spread evenly (at most 100000). 0 skips the
            check; the solution then does not count as a success.
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
        integrator : {"auto", "stack", "single"}
            How trajectories are integrated: many as one stacked system, or each alone. "auto"
            begins with stacks, and changes where one stalls, by counted work.
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
            ``preset="slides"``. One that only one engine has needs the ``method`` by name.

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
            engines_for(method, options.keys() - SOLVE_ARGUMENTS)
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
            SolveArguments(**arguments, unknowns=unknowns, markers=markers == "auto"),
            further=("method", "outputs", "progress", "on_failure"),
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
        *,
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
        from rankone.share.export import export_solver

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
    OptionError
        It has fields, which are compiled otherwise.
    """
    if isinstance(problem, FieldProblem):
        raise OptionError(
            "fields are taken by rankone.solve and rankone.compile alone",
            remedy="write the problem entry by entry: problem.scalar()",
        )
    remedy = "build one with rankone.Problem(...) or Problem.from_strings(...)"
    if isinstance(problem, CompiledProblem):
        remedy = "this one is compiled already; call its .solve(...)"
    check_kind("compile", problem, Problem, remedy=remedy)
    with bounded_depth():
        alike = (with_numbers_of(compiled, problem) for compiled in problem.compiled)
        compiled = next(filter(None, alike), None) or compiled_stages(CompiledProblem, problem)
    if problem.shorthand.named and not problem.compiled:
        problem.compiled.append(compiled)
    return compiled
