"""Steady states as solutions of the parameters alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import sympy as sp

from rankone.compiler.passes import FirstOrderSystem
from rankone.problem.expressions.notation import plain_text
from rankone.problem.problem import Problem
from rankone.problem.steady_start import USUAL_HORIZONS
from rankone.solution.compiled import CompiledProblem, compile_problem
from rankone.solution.solution import Solution
from rankone.solvers.outcome import Outcome, Role, SolutionMetadata
from rankone.solvers.request import USUAL_POINTS, SolveArguments, SolveRequest
from rankone.solvers.selection import ENGINES, solve_with
from rankone.solvers.verification.points import branch_points
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, limited, patience_for
from rankone.support.errors import ConvergenceError, ProblemError, check_kind, quote
from rankone.support.options import RTOL, RTOLS, checked_number
from rankone.support.tasks import one_thread
from rankone.tensors.slab import at_one_time
from rankone.trajectories.bifurcations import check_one_branch
from rankone.trajectories.rest import SteadyStates, at_rest
from rankone.trajectories.system.verdict import MeasuredError, Note, Status, SteadyBranch

_SHORTEST = 1e-300  # Shortest time that trajectories may be given to settle
_FINER = 0.01  # Factor of the tolerance until gradients are within it


def steady_state(
    problem: Problem | CompiledProblem,
    *,
    settle: float | None = None,
    rtol: float = RTOL,
    check: int = USUAL_POINTS,
    effort: str | float = "normal",
    max_seconds: float | None = None,
) -> Solution:
    """Solve for the steady states that trajectories from the initial values reach.

    A trajectory is followed until it is close to a stable steady state, from where Newton's method
    finds it. The solution is one of the parameters alone: ``solution(k=2.0)``. Its horizon has no
    meaning; gradients, statistics, outputs, plots and exports are those of any solution without
    time. Gradients are as accurate, over the largest ones, down to about 1e-8. Its message says
    which branch it is, and whether it is stable.

    Parameters
    ----------
    problem : Problem or CompiledProblem
        Time appears in no rate; there are neither jumps nor events. Linear combinations of unknowns
        that no rate changes, such as totals of species, keep their initial values.
    settle : float, optional
        The longest time that a trajectory may take, by default a hundred horizons of the problem.
    rtol : float
        Largest error asked for, relative to the largest value of each unknown.
    check, effort, max_seconds
        As in :meth:`CompiledProblem.solve`.

    Returns
    -------
    Solution
        The unknowns over the box; derivatives that are states are zero and left out.

    Raises
    ------
    ProblemError
        If time appears in a rate, or states are reset.
    ConvergenceError
        If a trajectory has not settled in time: it oscillates, drifts or is slow. Or if the branch
        ends or turns unstable inside the box: its ``bifurcation`` has the ``kind`` (``"fold"``,
        ``"Hopf"``, ``"transcritical"`` or ``"pitchfork"``), the ``parameters``, the ``state`` and
        the ``frequency``. Or if trajectories lead to several branches: it says where.
    BlowUpError
        If a trajectory blows up.

    Examples
    --------
    >>> t, k = sp.symbols("t k")
    >>> u = sp.Function("u")(t)
    >>> problem = Problem([sp.Eq(u.diff(t), k - u**2)], (t, 0, 1), {k: (1, 2)}, {u: 1})
    >>> steady = steady_state(problem)
    >>> print(steady.success, steady(k=1.44).round(6))
    True [1.2]
    """
    remedy = "build one with rankone.Problem(...) or Problem.from_strings(...)"
    check_kind("steady_state", problem, Problem, CompiledProblem, remedy=remedy)
    compiled = problem if isinstance(problem, CompiledProblem) else compile_problem(problem)
    _check_autonomous(compiled.first_order)
    system, (start, end) = compiled.system, compiled.system.horizon
    longest = USUAL_HORIZONS * (end - start)
    if settle is not None:
        longest = checked_number("settle", settle, _SHORTEST, 1e300, float)
    states = compiled.first_order.states
    rows = [i for i, state in enumerate(states) if state.role is Role.UNKNOWN]
    engine = ENGINES["cross"]
    steady = SteadyStates(system, end - start, longest)
    resting = at_rest(steady, rows)
    request = SolveRequest.of(
        resting,
        [engine.options],
        {},
        SolveArguments(
            rtol=rtol, check=check, effort=effort, max_seconds=max_seconds, integrator="stack"
        ),
    )
    with one_thread(), limited(seconds=request.limits.seconds) as account:
        points = branch_points(request.domain)
        try:
            with limited(request.limits.operations):
                check_one_branch(steady, points)
        except OutOfBudgetError as out:
            raise ConvergenceError(
                f"{Status.of_limit(out).value} before the branch was followed over the box",
                remedy="raise effort, give a smaller settle=, or narrow the box",
            ) from None
        metadata = _metadata(compiled, rows)

        def solved(finer: float) -> Solution:
            asked = replace(request, rtol=finer)
            first = finer == request.rtol
            left = max(patience_for(request.limits.operations) - account.done, 0.0)
            with limited(math.inf if first else left):
                outcome, of_engine = solve_with([engine], resting, asked, metadata)
            outcome = _restated(_explained(outcome, steady, of_engine, points), rtol)
            return Solution(outcome, replace(of_engine, rtol=rtol, timeless=True))

        return _with_gradients(solved, steady, rows, points, request.rtol)


def _with_gradients(
    solved: Callable[[float], Solution],
    steady: SteadyStates,
    rows: list[int],
    points: Array,
    rtol: float,
) -> Solution:
    """The solution whose gradients at points (m, d) are within rtol as well, if finer ones are.

    Finer ones are solved for as long as patience lasts for all of them together.
    """
    solution, finer = solved(rtol), rtol
    if not solution.success or not points.shape[1]:
        return solution
    slopes, points = steady.slopes(points)
    widths = np.diff(np.array(steady.system.box))
    exact = slopes[rows] * widths
    sizes = np.abs(exact).max(axis=(1, 2), keepdims=True)
    at = dict(zip(solution.parameters, points.T, strict=True))
    while finer > min(RTOLS):
        off = np.abs(solution.gradient(at) * widths - exact)
        if (off <= rtol * sizes).all():
            break
        finer = max(finer * _FINER, min(RTOLS))
        closer = solved(finer)
        if not closer.success:
            break
        solution = closer
    return solution


def _restated(outcome: Outcome, rtol: float) -> Outcome:
    """The outcome of a finer tolerance as one of the tolerance asked for."""
    notes = tuple(
        replace(note, rtol=rtol) if isinstance(note, MeasuredError) else note
        for note in outcome.notes
    )
    return replace(outcome, notes=notes)


def _check_autonomous(system: FirstOrderSystem) -> None:
    """Raise a ProblemError if time appears in a rate, or states are reset."""
    time = system.coordinates[0].symbol
    if system.jumps or system.events:
        raise ProblemError(
            "a problem with jumps or events has no steady state",
            remedy="give a problem without them",
        )
    at_once = {u: sp.Dummy() for u in system.functions}
    for origin, state, rate in zip(system.origins, system.states, system.rhs, strict=True):
        if time in rate.xreplace(at_once).free_symbols:
            raise ProblemError(
                f"the rate of {quote(state.expression)} depends on the time {quote(time)}, so it "
                "has no steady state",
                equation=origin,
                term=rate,
                remedy="put a number or a parameter in place of the time",
            )


def _metadata(compiled: CompiledProblem, rows: list[int]) -> SolutionMetadata:
    """What the solution says was asked."""
    metadata, system = compiled.metadata(), compiled.first_order
    names = {u: sp.Symbol(s.name) for u, s in zip(system.functions, system.states, strict=True)}
    units = [pair for pair in metadata.units if pair[0] != metadata.time]
    return replace(
        metadata,
        states=tuple(metadata.states[i] for i in rows),
        roles=tuple(metadata.roles[i] for i in rows),
        horizon=(0.0, 1.0),
        equations=tuple(_equations(system, names)),
        source=None,
        units=tuple(units),
        additive=(),
    )


def _equations(system: FirstOrderSystem, names: dict[sp.Expr, sp.Symbol]) -> Iterator[str]:
    for rate in system.rhs:
        yield f"0 = {plain_text(rate.xreplace(names))}"


def _explained(
    outcome: Outcome, steady: SteadyStates, metadata: SolutionMetadata, points: Array
) -> Outcome:
    """The outcome over no time, with which branch it is by its stability at points (m, d)."""
    if not outcome.slabs:
        return outcome
    stability = steady.stability(points)
    rows = [steady.system.states.index(name) for name in metadata.states]
    centre = steady(points[:1].T)[rows, 0]
    pairs = tuple(zip(metadata.states, centre.tolist(), strict=True))
    notes: list[Note] = [*outcome.notes, SteadyBranch(pairs, stability.growth, steady.latest)]
    slab = at_one_time(outcome.slabs, 0.0, metadata.horizon)
    return replace(outcome, slabs=(slab,), notes=tuple(notes))
