"""The pipeline: problem -> weak form -> separated form -> generated module -> solution.

===============  ==================================================================  ==============
stage            what happens                                                        result
===============  ==================================================================  ==============
weak form        residual times test function, integrated over every dimension       ``.weak_form``
separation       every term factored into functions of one coordinate                ``.separated``
code generation  kernels, factors and pointwise functions as readable source         ``.source``
import           the source is run as a module                                       ``.system``
solve            an engine enriches separated tensors, slab by slab                  a ``Solution``
===============  ==================================================================  ==============

Each stage is timed in ``.timings`` (seconds) and in the log ``rankone``.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from threadpoolctl import ThreadpoolController

from rankone.codegen import equation_texts, generate_source, load_module
from rankone.domain import Domain, check_factors
from rankone.errors import ConvergenceError, OptionError
from rankone.ir import SeparatedForm
from rankone.metadata import SolutionMetadata
from rankone.progress import Progress, resolve_progress
from rankone.solution import Solution
from rankone.solution_core import raise_blow_up
from rankone.solvers.registry import engine_named
from rankone.symbolic import Problem, WeakForm, separate, weak_form
from rankone.system import System
from rankone.version import __version__

__all__ = ["CompiledProblem", "compile_problem", "solve_problem"]

logger = logging.getLogger("rankone")


@dataclass(frozen=True, eq=False)
class CompiledProblem:
    """A problem with everything that was derived from it before numbers come in.

    Made by :func:`rankone.compile`.

    Attributes
    ----------
    problem : Problem
    weak_form : WeakForm
        Residual times test function, integrated over every dimension.
    separated : SeparatedForm
        The terms, each a product of functions of one coordinate and a monomial.
    source : str
        Text of the generated module.
    timings : dict of str to float
        Seconds by stage.
    """

    problem: Problem
    weak_form: WeakForm
    separated: SeparatedForm
    source: str
    timings: dict[str, float]
    _modules: dict[str, System] = field(default_factory=dict, repr=False)

    @property
    def system(self) -> System:
        """The generated module; run again from its source after unpickling."""
        if not self._modules:
            self._modules["system"] = load_module(self.source, self.problem.name or "system")
        return self._modules["system"]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_modules": {}}

    def __repr__(self) -> str:
        form = self.separated
        names = ", ".join(state.name for state in form.states)
        box = ", ".join(f"{c.name} in [{c.lower:g}, {c.upper:g}]" for c in form.coordinates)
        return (
            f"CompiledProblem of {names} over {box}\n"
            f"{len(form.terms)} separated terms, {self.source.count(chr(10))} lines generated, "
            f"compiled in {sum(self.timings.values()):.2f} s"
        )

    def solve(
        self,
        rtol: float = 1e-6,
        *,
        method: Literal["train", "greedy"] = "train",
        parameters: Mapping[Any, Sequence[float]] | None = None,
        t_final: float | None = None,
        progress: bool | Progress = False,
        check: bool | int = True,
        on_failure: Literal["return", "raise"] = "return",
        **options: Any,
    ) -> Solution:
        """Solve for every parameter of the box at once.

        Parameters
        ----------
        rtol : float
            Largest error asked for, relative to the largest value of each unknown, between 1e-10
            and 0.1. It is measured against SciPy trajectories after the solve.
        method : {"train", "greedy"}
            The engine: the tensor train on the preconditioned Volterra form, or the classic
            proper generalized decomposition with rank-one enrichments.
        parameters : mapping, optional
            Other intervals of parameters, by symbols or names; nothing is compiled again.
        t_final : float, optional
            Another end of the horizon.
        progress : bool or callable
            True shows a bar on stderr; a callable gets a ``ProgressEvent`` after each slab.
        check : bool or int
            Number of random check points (24 for True). False skips the check; the solution then
            does not count as a success.
        on_failure : {"return", "raise"}
            What to do when the tolerance is not reached: return the solution with ``success``
            False, or raise ConvergenceError, which carries it.
        **options
            Limits and discretisation of the engine: :class:`rankone.TrainOptions` or
            :class:`rankone.GreedyOptions`; for the latter also ``preset="slides"``.

        Returns
        -------
        Solution

        Raises
        ------
        BlowUpError
            A trajectory blows up inside the horizon. ``.solution`` holds the part up to there.
        ConvergenceError
            Only with ``on_failure="raise"``.
        OptionError
            An option is unknown or out of its range, or there is no such domain.
        """
        if on_failure not in ("return", "raise"):
            raise OptionError(
                f"on_failure={on_failure!r} is unknown", remedy="use 'return' or 'raise'"
            )
        engine = engine_named(method)
        request = engine.request(rtol, check, options)
        domain = Domain.of(self.system)
        if parameters or t_final is not None:
            domain = domain.moved(self.system.PARAMETERS, parameters, t_final)
            _check_moved(self, domain)
        began = time.perf_counter()
        with resolve_progress(progress) as report, _one_blas_thread():
            outcome = engine.solve(self.system, domain, request, report)
        seconds = time.perf_counter() - began
        logger.info("solve: %.3f s, %s", seconds, outcome.message)
        timings = {"compile": sum(self.timings.values()), **outcome.timings, "solve": seconds}
        metadata = self.metadata(request.rtol, method)
        metadata = replace(metadata, horizon=domain.horizon, box=domain.box)
        solution = Solution(replace(outcome, timings=timings), metadata)
        raise_blow_up(solution)
        if on_failure == "raise" and not solution.success:
            raise ConvergenceError(outcome.message, solution=solution)
        return solution

    def export(
        self, path: str | PathLike[str], *, method: str = "train", overwrite: bool = False
    ) -> Path:
        """Write a standalone solver; see :func:`rankone.export.export_solver`."""
        from rankone.export import export_solver

        return export_solver(self, path, method=method, overwrite=overwrite)

    def metadata(self, rtol: float = 1e-6, method: str = "train") -> SolutionMetadata:
        """What a solution of the problem says was asked."""
        form = self.separated
        clock, *parameters = form.coordinates
        return SolutionMetadata(
            states=tuple(state.name for state in form.states),
            roles=tuple("derivative" if state.order else "unknown" for state in form.states),
            parameters=tuple(c.name for c in parameters),
            box=tuple((c.lower, c.upper) for c in parameters),
            time=clock.name,
            horizon=(clock.lower, clock.upper),
            rtol=rtol,
            method=method,
            equations=tuple(equation_texts(form)),
            version=__version__,
            source=self.source,
        )


def compile_problem(problem: Problem) -> CompiledProblem:
    """Compile a problem: weak form, separated form, generated module.

    Parameters
    ----------
    problem : Problem

    Returns
    -------
    CompiledProblem

    Raises
    ------
    SeparationError
        A term does not factor, or is not polynomial in the unknowns.
    ProblemError
        A coefficient is complex or not finite somewhere in the box.
    """
    if not isinstance(problem, Problem):
        raise OptionError(
            f"compile needs a rankone.Problem, not {type(problem).__name__}",
            remedy="build one with rankone.Problem(...) or Problem.from_strings(...)",
        )
    timings: dict[str, float] = {}
    with _timed(timings, "weak form"):
        weak = weak_form(problem)
    with _timed(timings, "separation"):
        separated = separate(problem)
    with _timed(timings, "code generation"):
        source = generate_source(separated, problem.name)
    compiled = CompiledProblem(problem, weak, separated, source, timings)
    with _timed(timings, "import"):
        _ = compiled.system
    return compiled


def solve_problem(problem: Problem, rtol: float = 1e-6, **options: Any) -> Solution:
    """Compile and solve a problem; the same as ``rankone.compile(problem).solve(rtol, ...)``.

    See :meth:`CompiledProblem.solve` for the options.
    """
    return compile_problem(problem).solve(rtol, **options)


@contextmanager
def _timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - began
    logger.info("%s: %.3f s", stage, timings[stage])


@cache
def _thread_pools() -> ThreadpoolController:
    """The BLAS pools of this process; looking for them takes milliseconds."""
    return ThreadpoolController()


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Small products run fastest on one thread, and two busy pools slow each other down."""
    with _thread_pools().limit(limits=1, user_api="blas"):
        yield


def _check_moved(compiled: CompiledProblem, domain: Domain) -> None:
    """Raise an OptionError if what was assumed of the problem does not hold on a moved domain."""
    check_factors(compiled.system, domain)
