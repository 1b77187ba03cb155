"""The interface of engines, and the ways in which one solves: as written, in order, in branches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace

from rankone.solvers.attempts import Marcher, Stages, out_at_reference, solve_in_attempts
from rankone.solvers.branches import solve_in_branches
from rankone.solvers.outcome import Outcome, SlabRecord
from rankone.solvers.remedies import box_of_one_order
from rankone.solvers.request import USUAL_POINTS, Domain, Observation, SolveArguments, SolveRequest
from rankone.solvers.stretches_by_markers import (
    FirstPoints,
    SolveStart,
    clock_of,
    goes_in_step,
    over_stretches,
    start_of,
)
from rankone.solvers.tuning import SOLVE
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.budget import OutOfBudgetError, Report, part_of_budget, quiet
from rankone.support.errors import ConvergenceError
from rankone.support.options import RTOL, Options
from rankone.tensors.slab import SlabTrain
from rankone.trajectories.events.sides import (
    AccumulationError,
    MoreEventsError,
    OrderError,
    TrajectoryEndError,
)
from rankone.trajectories.integrators.workers import Workers, open_workers
from rankone.trajectories.system.system import System
from rankone.trajectories.system.timeline import Timeline
from rankone.trajectories.system.verdict import (
    Budget,
    NarrowBox,
    Note,
    OrderSearchLimit,
    Remedy,
    SeveralOrders,
    Status,
    SwitchesNotHeld,
    Verdict,
)

# Shares of the budget for a system with kinks as it was written, and for stretches between the
# crossings of its switches
_KINKS_SHARE, _HELD_SHARE = 0.12, 0.75
_SOLVED = (Status.CONVERGED, Status.UNCHECKED)
_STEEP_IN_ORDER = "in one order the solution is steep, as where some trajectories miss an event"


@dataclass(frozen=True)
class Engine:
    """A way to solve a generated system for a whole box.

    ``name`` is the ``method`` of ``rankone.solve``, ``record`` the class of the items of its
    history. ``marcher`` makes what it does in an attempt from a request, its reference set, and the
    workers that integrate trajectories. ``first_points`` (m, d) of a system and a request are those
    whose trajectories it begins with: the reference integrates them too. An engine that
    ``observes`` interpolates what is asked for alone; others solve for all states.
    """

    name: str
    options: type[Options]
    record: type[SlabRecord]
    marcher: Callable[[SolveRequest, ReferenceSet, Workers], Marcher]
    first_points: FirstPoints | None = None
    observes: bool = False

    def solve(self, system: System, request: SolveRequest, report: Report) -> Outcome:
        """Solve; the status is CONVERGED only if the measured error is within the tolerance.

        Switches of the rates are held, and times at which rates jump or peak are events, as long as
        all trajectories meet them in the same order. Kinks alone may be smooth enough where they
        are not met so, or the tolerance is loose.
        """
        if system.held is None or not request.markers:
            return self._solve_as_written(system, request, report)
        held: Outcome | None = None
        jumps = system.features.n_steps or system.features.n_moving_steps
        kinks = not system.events and not jumps
        if kinks and request.rtol < SOLVE.loose_rtol:
            with part_of_budget(_HELD_SHARE), suppress(ConvergenceError):
                held = self._solve_in_order(system.held, request, report, Stages(), crossed=True)
        if kinks and held is None:
            with part_of_budget(_KINKS_SHARE), suppress(ConvergenceError):
                outcome = self._solve_as_written(system, request, report)
                if outcome.status in _SOLVED:
                    return outcome
        failure: ConvergenceError | None = None
        if held is None:
            try:
                with part_of_budget(_HELD_SHARE):
                    held = self._solve_over_stretches(system.held, request, report)
            except ConvergenceError as error:
                failure = error
        if held is not None and held.status in _SOLVED:
            return held
        try:
            outcome = self._solve_as_written(system, request, report)
        except ConvergenceError as error:
            if held is not None:  # which tells more
                return held
            raise failure or error from None
        if outcome.status.ends_early and isinstance(failure, AccumulationError):
            raise failure
        if outcome.status in (Status.BLOW_UP, Status.STALLS) and system.features.n_steps:
            # over clock time, trajectories that slide along a jump seem to blow up or to stall
            if held is not None:
                return held
            if failure is not None and not isinstance(failure, TrajectoryEndError):
                raise failure
        if held is not None and _is_better(held, outcome):
            return held
        if outcome.status in _SOLVED:
            return outcome
        return _not_held(outcome, failure if held is None else held, system, request)

    def _solve_as_written(self, system: System, request: SolveRequest, report: Report) -> Outcome:
        """Solve with the switches of the rates as they are."""
        if system.events or system.separated_stretches is not None:
            return self._solve_over_stretches(system, request, report)
        if system.features.n_moving_steps and not system.separated:
            try:
                return self._solve_over_stretches(system, request, report)
            except OrderError as error:
                with part_of_budget(_KINKS_SHARE), suppress(ConvergenceError):
                    outcome = self._solve(system, request, report)
                    if outcome.status in _SOLVED:
                        return outcome
                raise error
        return self._solve(system, request, report)

    def _solve_over_stretches(
        self, system: System, request: SolveRequest, report: Report
    ) -> Outcome:
        """Solve over the stretches between events, in branches where their order changes."""
        if self.name == "cross" and goes_in_step(system, request):
            with suppress(OrderError):
                return self._attempted(system, request, report)
        stages = Stages()
        try:
            outcome = self._solve_in_order(system, request, report, stages)
        except TrajectoryEndError:
            raise
        except OrderError as error:
            if self.name != "cross":
                raise
            branched = self._solve_in_branches(system, request, report, error.message, stages)
            if branched is None:
                raise
            return branched
        if self.name == "cross" and outcome.status is Status.STEEP:
            return self._solve_steep(system, request, report, outcome)
        return outcome

    def _solve_in_branches(
        self,
        system: System,
        request: SolveRequest,
        report: Report,
        reason: str,
        stages: Stages,
    ) -> Outcome | None:
        """Solve each order of events as a branch of its own; None where there are no branches."""

        def solve(stretched: System, over_it: SolveRequest) -> Outcome:
            return self._attempted(stretched, over_it, report)

        return solve_in_branches(solve, system, request, reason, stages)

    def _solve_steep(
        self, system: System, request: SolveRequest, report: Report, steep: Outcome
    ) -> Outcome:
        """Solve in branches what is steep in one order: trajectories may miss its events.

        The steep outcome if that is no better, with what both took.
        """
        stages, better = Stages(), steep
        stages.add(steep.timings, steep.work)
        try:
            outcome = self._solve_in_branches(system, request, report, _STEEP_IN_ORDER, stages)
        except OrderError as failure:
            better = _with_orders(steep, failure)
        except ConvergenceError:
            pass
        else:
            if outcome is not None and isinstance(outcome.cause, OrderSearchLimit):
                better = _as_ended(steep, outcome)
            elif outcome is not None and not _is_better(steep, outcome):
                better = outcome
        return replace(better, timings={**stages.timings}, work={**stages.work})

    def _solve_in_order(
        self,
        system: System,
        request: SolveRequest,
        report: Report,
        stages: Stages,
        crossed: bool = False,
    ) -> Outcome:
        """Solve over the stretches between events; an OrderError where their order changes.

        Also where there are no events, if some must be ``crossed``. ``stages`` count what tells it.
        """
        first: OrderError | None = None
        for more in range(1 + SOLVE.most_more_events):
            try:
                with stages.of("reference"):
                    clock = clock_of(system, request, more)
                if crossed and not clock.order.instants:
                    raise OrderError("no trajectory crosses a kink")
                stretched, request_there = over_stretches(clock, request)
                with stages.if_it_fails("reference"):
                    outcome = self._solve(stretched, request_there, report)
                return replace(
                    outcome,
                    slabs=without_last(outcome.slabs, stretched),
                    timings=sums(outcome.timings, stages.timings),
                    work=sums(outcome.work, stages.work),
                    timeline=Timeline.of(clock),
                )
            except OutOfBudgetError as out:
                return out_at_reference(out, system, stages)
            except MoreEventsError as error:
                first = first or error
            except OrderError as error:
                first = first or error
                break
        assert first is not None
        raise first

    def _solve(self, system: System, request: SolveRequest, report: Report) -> Outcome:
        """Solve over stretches between markers where they pay, else over the time of the system.

        Also where it is steep between markers: which of them come first may differ over the box.
        """
        if self.name != "cross" or not request.markers or system.clock is not None:
            return self._attempted(system, request, report)
        marked: Outcome | None = None
        with suppress(OrderError):
            marked = self._attempted(system, request, report, markers=True)
        if marked is None:
            return self._attempted(system, request, report)
        if marked.timeline is None or marked.status is not Status.STEEP:
            return marked
        outcome = self._attempted(system, request, report)
        timings, work = sums(outcome.timings, marked.timings), sums(outcome.work, marked.work)
        return replace(outcome, timings=timings, work=work)

    def _attempted(
        self, system: System, request: SolveRequest, report: Report, markers: bool = False
    ) -> Outcome:
        """The outcome of attempts, perhaps over stretches between markers."""
        options = request.options_of(self.options)
        if self.observes:
            request = observing(system, request)
        start: SolveStart | None = None
        with ExitStack() as stack:

            def marcher() -> Marcher:
                nonlocal start
                workers = stack.enter_context(open_workers(system, options.executor))
                start = start_of(workers, request, markers, self.first_points)
                there = workers.of(start.reference_set.system)
                return self.marcher(start.request, start.reference_set, there)

            outcome = solve_in_attempts(marcher, options, system, request, report)
        if start is None or start.clock is None:
            return outcome
        return replace(outcome, timeline=Timeline.of(start.clock))

    def run(
        self,
        system: System,
        rtol: float = RTOL,
        *,
        domain: Domain | None = None,
        check: int = USUAL_POINTS,
        report: Report = quiet,
        **options: object,
    ) -> Outcome:
        """Solve a generated system directly, by default on the domain it was written for."""
        request = SolveRequest.of(
            system, [self.options], options, SolveArguments(rtol=rtol, check=check)
        )
        return self.solve(system, replace(request, domain=domain or request.domain), report)


def observing(system: System, request: SolveRequest) -> SolveRequest:
    """The request, with the states that are asked for observed where no other one is needed.

    Over stretches the clock is, which other states end, and a check of jumps and of constraints
    reads all of them.
    """
    rows = request.check.states
    needed = system.clock is not None or system.jumps.times or system.constraints.names
    if request.observed is not None or rows is None or needed:
        return request
    return replace(request, observed=Observation.of_some(system.unknowns, rows))


def _with_orders(steep: Outcome, failure: OrderError) -> Outcome:
    """A steep outcome that says which orders of events are not solved as branches."""
    notes: list[Note] = [*steep.verdict.without_remedy().notes, SeveralOrders(failure.message)]
    if failure.remedy is not None:
        notes.append(Remedy(failure.remedy))
    if failure.limit is None:
        return replace(steep, notes=tuple(notes))
    # Shares of the budget are those of the steep solve alone
    ended = tuple(note for note in notes if not isinstance(note, Budget))
    return replace(steep, status=failure.limit, cause=None, notes=ended)


def _not_held(
    outcome: Outcome,
    between: Outcome | ConvergenceError | Verdict | str | None,
    system: System,
    request: SolveRequest,
) -> Outcome:
    """An outcome that says how the solve ended ``between`` switches of the rates.

    A part of the box in which they come in one order is what to narrow it to: modes fall as
    predicted only where a solution is smooth.
    """
    notes = [note for note in outcome.notes if not isinstance(note, NarrowBox)]
    boxes: list[NarrowBox] = []
    if isinstance(between, Outcome):
        boxes = [note for note in between.notes if isinstance(note, NarrowBox) and note.one_order]
        told = (NarrowBox, Remedy) if boxes else NarrowBox
        kept = tuple(note for note in between.notes if not isinstance(note, told))
        between = replace(between, notes=kept).verdict
    elif isinstance(between, OrderError) and between.part is not None:
        names, bounds = system.parameters, request.domain.bounds
        boxes = [box_of_one_order(names, bounds, between.part)]
        between = between.message
    return replace(outcome, notes=(*notes, SwitchesNotHeld(str(between)), *boxes))


def _as_ended(steep: Outcome, ended: Outcome) -> Outcome:
    """A steep outcome with the verdict on the search for orders, which met a limit."""
    return replace(steep, status=ended.status, cause=ended.cause, notes=ended.notes)


def _is_better(one: Outcome, other: Outcome) -> bool:
    """Whether an outcome without success has more than another one: slabs, or a smaller error."""
    if other.status in _SOLVED or not one.slabs or one.measured is None:
        return False
    if not other.slabs or other.measured is None:
        return True
    return one.measured.error < other.measured.error


def sums(*by_stage: Mapping[str, float]) -> dict[str, float]:
    """Seconds or operations by stage, in all."""
    return {stage: sum(each[stage] for each in by_stage) for stage in by_stage[0]}


def without_last(slabs: Sequence[SlabTrain], system: System) -> tuple[SlabTrain, ...]:
    """The slabs without the lifted states of a system, which are the last ones."""
    if not system.n_lifted:
        return tuple(slabs)
    return tuple(slab.with_first(slab.cores[0][: len(system.unknowns)]) for slab in slabs)
