"""A compiled problem with fields, and its solves."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np

from rankone.compiler.field_lowering import field_system
from rankone.problem.problem import FieldProblem, Problem
from rankone.solution.fields.field_solution import FieldSolution
from rankone.solution.solution import Solution
from rankone.solvers.engines.engine_options import CrossOptions
from rankone.solvers.outcome import Outcome, Role, SolutionMetadata
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.solvers.reduced.field_request import FieldRequest, ReducedOutcome
from rankone.solvers.reduced.field_solve import solve_fields
from rankone.solvers.request import MOST_POINTS, Domain, Limits, checked_rtol
from rankone.solvers.selection import ENGINES, REDUCED
from rankone.support import __version__
from rankone.support.budget import Report, resolve_progress
from rankone.support.errors import ConvergenceError, OptionError, did_you_mean
from rankone.support.options import RTOL, checked_number
from rankone.support.tasks import ExecutorLike, checked_executor, one_thread
from rankone.trajectories.fields.field_system import FieldSystem

logger = logging.getLogger("rankone")


class SolvesEntries(Protocol):
    """A compiled problem without fields."""

    def solve(self, rtol: float = RTOL, **options: Any) -> Solution: ...


@dataclass(frozen=True, eq=False)
class CompiledFields:
    """A problem with fields as sparse operators and elementwise functions.

    Made by :func:`rankone.compile`.

    Attributes
    ----------
    problem : FieldProblem
    system : FieldSystem
        Rates and sparse Jacobians.
    source : str
        The generated text of coefficients and elementwise functions.
    timings : dict of str to float
        Seconds by stage.
    """

    problem: FieldProblem
    system: FieldSystem
    timings: dict[str, float]
    compile_entries: Callable[[Problem], SolvesEntries] = field(repr=False)

    @classmethod
    def of(
        cls, problem: FieldProblem, compile_entries: Callable[[Problem], SolvesEntries]
    ) -> CompiledFields:
        """Compile a problem, and compare what was made of it with what the user wrote.

        ``compile_entries`` compiles the same problem with an unknown for each entry.
        """
        began = time.perf_counter()
        system = field_system(problem)
        seconds = time.perf_counter() - began
        logger.info("fields: %.3f s", seconds)
        return cls(problem, system, {"fields": seconds}, compile_entries)

    @property
    def source(self) -> str:
        return self.system.source

    def __repr__(self) -> str:
        fields = self.system
        names = ", ".join(f"{unknown.name} ({unknown.size})" for unknown in fields.unknowns)
        return (
            f"CompiledFields of {names}\n"
            f"{len(fields.linear)} linear terms, {len(fields.sources)} sources, "
            f"{len(fields.pointwise)} elementwise functions, "
            f"compiled in {sum(self.timings.values()):.2f} s"
        )

    def solve(
        self,
        rtol: float = RTOL,
        *,
        method: str = "auto",
        parameters: Mapping[Any, Sequence[Any]] | None = None,
        t_final: float | None = None,
        progress: bool | Report = False,
        check: int = 12,
        effort: str | float = "normal",
        max_seconds: float | None = None,
        max_memory: str | float | None = None,
        max_trajectories: int = 100,
        executor: ExecutorLike | None = None,
        on_failure: Literal["return", "raise"] = "return",
        **options: Any,
    ) -> FieldSolution | Solution:
        """Solve for every parameter of the box at once.

        Parameters
        ----------
        rtol : float
            Largest error asked for, relative to the largest value of each field, over all its
            entries, all times and all parameters. It is measured against full trajectories at
            points that no mode was made of.
        method : {"auto", "reduced", "cross", "train", "greedy"}
            "reduced" makes modes of some full trajectories, and solves for their coefficients.
            Other methods take the equations entry by entry.
        parameters, t_final, progress, effort, max_seconds, max_memory, on_failure
            As for :meth:`rankone.CompiledProblem.solve`; ``effort`` is that of the solve for the
            coefficients.
        check : int
            Evenly spread points at which the solution is compared with full trajectories; eight
            more are where the equations are satisfied least. 0 skips the check; the solution then
            does not count as a success.
        max_trajectories : int
            Full trajectories at most, those of the check included. No solve takes fewer than 8
            with two parameters or more, and those of the check.
        executor : int, concurrent.futures.Executor, distributed.Client or str, optional
            What integrates full trajectories: a number of processes, an executor, or a client or
            the address of a scheduler of dask. Solutions are the same to the bit.
        **options
            Of the cross engine: :class:`rankone.CrossOptions`; with other methods those of
            their engines.

        Returns
        -------
        FieldSolution
            A :class:`rankone.Solution` of the entries where the method is another than "reduced".

        Raises
        ------
        ConvergenceError
            Only with ``on_failure="raise"``.
        OptionError
            An option is unknown or out of its range, or there is no such domain.
        """
        if not isinstance(on_failure, str) or on_failure not in ("return", "raise"):
            raise OptionError(
                f"on_failure={on_failure!r} is unknown", remedy="use 'return' or 'raise'"
            )
        shared = {
            "parameters": parameters,
            "t_final": t_final,
            "effort": effort,
            "max_seconds": max_seconds,
            "max_memory": max_memory,
        }
        if method == "auto":
            method = REDUCED
        elif method != REDUCED and method not in ENGINES:
            methods = ("auto", REDUCED, *ENGINES)
            raise OptionError(
                f"method={method!r} is unknown{did_you_mean(str(method), methods)}",
                remedy=f"choose from {', '.join(methods)}",
            )
        if method != REDUCED:
            return self._by_entries.solve(
                rtol,
                method=method,
                progress=progress,
                on_failure=on_failure,
                **{key: value for key, value in shared.items() if value is not None},
                **({} if executor is None else {"executor": executor}),
                **options,
            )
        request = self._request(rtol, check, max_trajectories, executor, shared, options)
        with resolve_progress(progress) as report, one_thread():
            began = time.perf_counter()
            outcome = solve_fields(self.system, request, report)
            seconds = time.perf_counter() - began
        solution = self._solution(outcome, request, seconds)
        logger.info("solve: %.3f s, %s", seconds, solution.message)
        if on_failure == "raise" and not solution.success:
            raise ConvergenceError(solution.message, solution=solution)
        return solution

    @cached_property
    def _by_entries(self) -> SolvesEntries:
        """The same problem with an unknown for each entry."""
        return self.compile_entries(self.problem.scalar())

    def _request(
        self,
        rtol: float,
        check: int,
        max_trajectories: int,
        executor: ExecutorLike | None,
        shared: Mapping[str, Any],
        options: Mapping[str, Any],
    ) -> FieldRequest:
        """The arguments of a solve, checked."""
        fields = self.system
        domain = Domain(fields.horizon, fields.box, fields.scales)
        domain = domain.moved(fields.parameters, shared["parameters"], shared["t_final"])
        own = "rtol", "method", "check", "max_trajectories", "progress", "executor", "on_failure"
        request = FieldRequest(
            rtol=checked_rtol(rtol),
            domain=domain,
            check=checked_number("check", check, 0, MOST_POINTS),
            limits=Limits.of(fields, shared["effort"], shared["max_seconds"], shared["max_memory"]),
            options=CrossOptions.of((*own, *shared), **options),
            executor=None if executor is None else checked_executor("executor", executor),
            trajectories=checked_number("max_trajectories", max_trajectories, 1, MOST_POINTS),
        )
        if request.trajectories < request.fewest:
            raise OptionError(
                f"max_trajectories={max_trajectories} does not suffice: a solve takes at least "
                f"{request.fewest} full trajectories, {request.checked} of them for the check",
                term=max_trajectories,
                remedy="raise it, or lower check",
            )
        return request

    def _solution(
        self, outcome: ReducedOutcome, request: FieldRequest, seconds: float
    ) -> FieldSolution:
        """What users hold; without values where the solve ended before there were any."""
        modes, solved = outcome.modes, outcome.outcome
        if modes is None or solved is None:
            unknowns = self.system.unknowns
            nothing = tuple(np.zeros((unknown.size, 1)) for unknown in unknowns)
            modes = FieldModes(unknowns, nothing, (0.0,) * len(unknowns), (), outcome.trajectories)
            verdict = outcome.verdict
            solved = Outcome((), verdict.status, None, (), cause=verdict.cause)
        work = {**solved.work, "full trajectories": outcome.work}
        timings = {**self.timings, **outcome.timings, "solve": seconds}
        coefficients = Solution(
            replace(solved, timings=timings, work=work), self._metadata(modes, request)
        )
        return FieldSolution(coefficients, modes, str(outcome.verdict), outcome.verdict.status)

    def _metadata(self, modes: FieldModes, request: FieldRequest) -> SolutionMetadata:
        """What a solution of the coefficients says was asked."""
        problem = self.problem
        return SolutionMetadata(
            states=modes.names,
            roles=(Role.UNKNOWN,) * len(modes.names),
            parameters=self.system.parameters,
            box=request.domain.box,
            time=problem.time[0].name,
            horizon=request.domain.horizon,
            rtol=request.rtol,
            method=REDUCED,
            equations=tuple(map(str, problem.equations)),
            version=__version__,
            distributions=tuple(problem.distributions.items()),
            correlations=tuple((*pair, rho) for pair, rho in (problem.correlation or {}).items()),
            units=tuple((problem.units or {}).items()),
            name=problem.name or "",
            constants=tuple((s.name, float(x)) for s, x in (problem.constants or {}).items()),
        )
