"""Solves of fields by their modes: look where they are worst, and measure what came of it.

When full trajectories at new points agree with the small system of :mod:`field_training`, the cross
engine solves that, and the solution is measured against full trajectories at further points, which
no mode has seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rankone.solvers.engines import cross_engine
from rankone.solvers.outcome import Outcome, SolutionMetadata
from rankone.solvers.reduced.field_bases import Interpolation
from rankone.solvers.reduced.field_causes import FieldError, FieldsEnd, ReducedEnds
from rankone.solvers.reduced.field_comparison import CoefficientCurves
from rankone.solvers.reduced.field_request import FIELDS, FieldRequest, ReducedOutcome
from rankone.solvers.reduced.field_training import FieldTraining, SolveEndedError
from rankone.solvers.reduced.reduced_system import ReducedSystem
from rankone.solvers.request import Check, Limits, SolveRequest
from rankone.solvers.selection import solve_with
from rankone.support.arrays import spread
from rankone.support.budget import OutOfBudgetError, Report, limited, quiet, timed
from rankone.support.tasks import Pool, open_pool
from rankone.trajectories.fields.field_steps import EndsEarlyError
from rankone.trajectories.fields.field_system import FieldSystem
from rankone.trajectories.fields.field_trajectories import (
    FieldTrajectory,
)
from rankone.trajectories.system.verdict import Cause, Status, Verdict

# Solutions for the coefficients whose fields are measured: some suffice though theirs do not
_MEASURED = (Status.CONVERGED, Status.TOLERANCE)


def solve_fields(
    fields: FieldSystem, request: FieldRequest, report: Report = quiet
) -> ReducedOutcome:
    """Solve for all points of a box at once, by modes."""
    domain = request.domain
    fields = replace(fields, box=domain.box, horizon=domain.horizon, scales=domain.scales)
    solve = _FieldSolve(fields, request, report)
    held = limited(seconds=request.limits.seconds, memory=request.limits.memory)
    with held as account, np.errstate(all="ignore"):
        before = account.done
        try:
            if request.executor is None:
                solve.run(None)
            else:
                with open_pool(request.executor) as pool:
                    solve.run(pool)
        except EndsEarlyError as end:
            at = tuple(zip(fields.parameters, end.point.tolist(), strict=True))
            stalled = Status.LEAVES if end.undefined else Status.STALLS
            stalled = Status.SWITCHES if end.accumulate else stalled
            solve.ended(Status.BLOW_UP if end.grows else stalled, FieldsEnd(end.time, at))
        except OutOfBudgetError as out:
            solve.ended(Status.of_limit(out))
        work = account.done - before
    return replace(
        solve.result, work=work, timings=solve.timings, trajectories=solve.training.count
    )


class _FieldSolve:
    """The state of one solve."""

    def __init__(self, fields: FieldSystem, request: FieldRequest, report: Report) -> None:
        self.fields, self.request = fields, request
        self.training = FieldTraining(fields, request, report)
        self.doubtful = np.zeros((0, len(request.domain.box)))
        self.timings: dict[str, float] = {}
        self.result = ReducedOutcome(Verdict(Status.TRAJECTORY_LIMIT))

    def ended(self, status: Status, cause: Cause | None = None) -> None:
        """Keep how the solve ended."""
        self.result = replace(self.result, verdict=Verdict(status, cause))

    def run(self, pool: Pool | None) -> None:
        """Train modes, solve for their coefficients and measure; what disagrees becomes modes."""
        try:
            with timed(self.timings, "first trajectories"):
                self.training.begin(pool)
            with timed(self.timings, "modes"):
                reduced, interpolations = self.training.train()
            wanted, tightened = FIELDS.solution * self.request.rtol, False
            for _ in range(FIELDS.rounds):
                checked = self._measured(reduced, interpolations, wanted)
                if not checked:
                    return
                of_modes = max(self.training.error_of(reduced, each) for each in checked)
                if of_modes > FIELDS.reduced * self.request.rtol:
                    with timed(self.timings, "modes"):
                        self.training.learn(checked)
                        reduced, interpolations = self.training.train()
                elif (
                    tightened
                ):  # in vain: modes suffice, and the solution for coefficients does not
                    return
                else:
                    wanted, tightened = FIELDS.tightened * wanted, True
        except SolveEndedError as end:
            self.ended(end.status, end.cause)

    def _measured(
        self, reduced: ReducedSystem, interpolations: list[Interpolation], wanted: float
    ) -> list[FieldTrajectory]:
        """Solve the reduced system, and measure; the trajectories of a check that fails."""
        training = self.training
        with timed(self.timings, "solve"):
            outcome, metadata = self._solved(reduced, wanted)
        if not outcome.slabs or outcome.status not in _MEASURED:
            self.ended(outcome.status, ReducedEnds(outcome.message, training.rank))
            return []
        self.result = replace(self.result, modes=training.modes, outcome=outcome, metadata=metadata)
        if not self.request.check:
            self.ended(Status.UNCHECKED)
            return []
        with timed(self.timings, "check"):
            checked = self._check_trajectories(reduced, interpolations)
            curves = CoefficientCurves(outcome, self.fields, training.rank)
            errors = np.array([self._errors(curves, each) for each in checked])
        worst = errors.max(axis=0)
        modes = training.measured_modes(tuple(worst.tolist()))
        self.result = replace(self.result, modes=modes)
        error, name = float(worst.max()), self.fields.unknowns[int(worst.argmax())].name
        times = [curves.time_error(training.comparison, each) for each in checked]
        time_error = max(times) if self.fields.events else None
        cause = FieldError(error, name, len(checked), training.count, time_error)
        good = error <= self.request.rtol
        self.ended(Status.CONVERGED if good else Status.TOLERANCE, cause)
        return [] if good else checked

    def _solved(self, reduced: ReducedSystem, wanted: float) -> tuple[Outcome, SolutionMetadata]:
        """The coefficients over the box, with fields as accurate as ``wanted``, if possible."""
        points = self.training.candidates(FIELDS.coefficient_checks)
        rtol, before = FIELDS.solved / FIELDS.solution * wanted, math.inf
        solved = self._solved_to(replace(reduced, rtol=rtol))
        for _ in range(FIELDS.rounds):
            outcome, _ = solved
            if not outcome.slabs or outcome.status not in _MEASURED or self.fields.events:
                break
            curves = CoefficientCurves(outcome, self.fields, self.training.rank)
            errors = self.training.distances(reduced, curves, points)
            error = float(errors.max())
            self.doubtful = points[errors == error] if error > wanted else points[:0]
            if error <= wanted or error > FIELDS.settled * before:
                break
            rtol, before = rtol * max(0.5 * wanted / error, FIELDS.finer), error
            tighter = self._solved_to(replace(reduced, rtol=rtol))
            if tighter[0].status is not Status.CONVERGED:
                break
            solved = tighter
        return solved

    def _solved_to(self, reduced: ReducedSystem) -> tuple[Outcome, SolutionMetadata]:
        """The coefficients over the box by the cross engine, to the tolerance of the system."""
        request = self.request
        limits = Limits(FIELDS.effort * request.limits.operations, memory=request.limits.memory)
        check, options = Check(FIELDS.coefficient_checks), (request.options,)
        asked = SolveRequest(reduced.rtol, request.domain, check, limits, options, markers=False)
        return solve_with((cross_engine.ENGINE,), reduced.system, asked, reduced.metadata)

    def _check_trajectories(
        self, reduced: ReducedSystem, interpolations: Sequence[Interpolation]
    ) -> list[FieldTrajectory]:
        """Full trajectories at points that no mode has seen: spread ones, and the worst.

        Among these, the one at which the solution is farthest from the reduced system.
        """
        training, d = self.training, len(self.request.domain.box)
        if d == 0:
            return training.full_trajectories(np.zeros((1, 0)))
        even = training.coverage.points(spread(self.request.check, d, training.generator))
        worst = training.worst_points(reduced, interpolations, FIELDS.worst_checks, even)
        return training.full_trajectories(
            np.concatenate([even, worst, training.beside, self.doubtful])
        )

    def _errors(self, curves: CoefficientCurves, trajectory: FieldTrajectory) -> list[float]:
        """The errors by unknown; infinite where the solution has other events."""
        if math.isinf(curves.time_error(self.training.comparison, trajectory)):
            return [math.inf] * len(self.fields.unknowns)
        return self.training.errors_along(curves.at(trajectory.point), trajectory)
