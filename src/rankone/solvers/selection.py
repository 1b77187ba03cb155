"""The engines by name, and a solve that tries one after another."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from difflib import SequenceMatcher
from functools import partial

import numpy as np

from rankone.solvers.engines import cross_engine, greedy_engine, train_engine
from rankone.solvers.outcome import Outcome, SolutionMetadata
from rankone.solvers.remedies import Trials, remedied, remedied_error
from rankone.solvers.request import Limits, SolveRequest, check_factors
from rankone.solvers.stretches_by_markers import sharing_references
from rankone.solvers.tuning import SOLVE
from rankone.solvers.verification.measure import drift, measure
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.solvers.ways import Engine, sums, without_last
from rankone.support.arrays import MANY_STATES
from rankone.support.budget import (
    REMEDIES,
    OutOfBudgetError,
    Report,
    budget_left,
    limited,
    patience_for,
    patient,
    quiet,
    seconds_left,
    unlimited,
    work_done,
    work_left,
)
from rankone.support.errors import ConvergenceError, OptionError, RankoneError, did_you_mean
from rankone.tensors.coordinates import moved_measures
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import MeasuredError, OtherEngines, Remedy, Status

__all__ = ["AUTO", "ENGINES", "engines_for"]

AUTO = "auto"

# Options about where to compute, which "auto" hands to the engines that have them
_RESOURCES = {"executor"}

ENGINES: dict[str, Engine] = {
    engine.name: engine
    for engine in (train_engine.ENGINE, cross_engine.ENGINE, greedy_engine.ENGINE)
}
REDUCED = "reduced"
"""The method of fields: the cross engine solves for the coefficients of their modes."""
RECORDS = {name: engine.record for name, engine in ENGINES.items()} | {
    REDUCED: cross_engine.ENGINE.record
}
"""The class of the records of each method."""


def engines_for(
    method: str,
    options: Collection[str] = (),
    parameters: int = 0,
    *,
    separated: bool = True,
    states: int = 0,
) -> tuple[Engine, ...]:
    """The engines to try for a method and its options.

    ======  ===================  ================================================================
    engine  takes                when ``method="auto"`` tries it
    ======  ===================  ================================================================
    cross   any right-hand side  first from two parameters on: the fastest on all problems
                                 measured, and the only one for systems that do not separate
    train   separated systems    first up to one parameter and 63 states, with a small part of the
                                 budget; else with what is left of it (22 %) where cross does not
                                 reach the tolerance and nothing is steep
    greedy  separated systems    never, only by ``method="greedy"``
    ======  ===================  ================================================================

    With "auto", options are those that all engines it may try have in common, and ``executor``. An
    OptionError if there is no such method, or an option belongs to another one, to be named.
    """
    if isinstance(method, str) and method == AUTO:
        few = parameters <= SOLVE.train_parameters and states < MANY_STATES
        order = ("train", "cross") if few else ("cross", "train")
        tried = tuple(ENGINES[name] for name in order if separated or name == "cross")
        common = set.intersection(*(set(ENGINES[name].options.names()) for name in order))
        known_options = common | _RESOURCES
    elif isinstance(method, str) and method in ENGINES:
        tried = (ENGINES[method],)
        known_options = set(tried[0].options.names())
    else:
        methods = (AUTO, *ENGINES)
        raise OptionError(
            f"method={method!r} is unknown{did_you_mean(str(method), methods)}",
            remedy=f"choose from {', '.join(methods)}",
        )
    for option in sorted(set(options) - known_options):
        owners = [f"method={e.name!r}" for e in ENGINES.values() if option in e.options.names()]
        if owners:
            raise OptionError(
                f"option {option!r} belongs to {' and '.join(owners)}, not to method={method!r}",
                remedy=f"give {' or '.join(owners)} with it, or leave the option out",
            )
    if unknown := sorted(
        set(options) - known_options
    ):  # refused by the engine that has the most similar ones
        return (max(tried, key=lambda engine: _similarity(engine, unknown)),)
    return tried


def _similarity(engine: Engine, options: Collection[str]) -> float:
    """How similar the options of an engine are to others."""
    names = engine.options.names()
    return sum(max(SequenceMatcher(None, o, n).ratio() for n in names) for o in options)


# -----------------------------------------------------------------------------
# A solve that tries one engine after another, and what is known of the solution then.


# Statuses after which no other engine is tried
_FINAL = (
    Status.CONVERGED,
    Status.UNCHECKED,
    Status.STEEP,
    Status.NARROW,
    *(s for s in Status if s.ends_early),
)
_AS_WRITTEN = Remedy("method='cross', the default, takes the system as it was written")


def solve_with(
    engines: Sequence[Engine],
    system: System,
    request: SolveRequest,
    metadata: SolutionMetadata,
    report: Report = quiet,
    truth: System | None = None,
) -> tuple[Outcome, SolutionMetadata]:
    """Solve with one engine after another until the error is within the tolerance.

    ``truth`` is the system as it was before functions of its states were lifted: the solution is
    measured against its trajectories. The metadata are those of the problem, with what was asked of
    this solve. An OptionError if a known factor is not finite somewhere on the domain.
    """
    domain, limits = request.domain, request.limits
    check_factors(system, domain)
    system.jumps.warn_of_last(*domain.horizon)
    held = limited(limits.operations, limits.seconds, limits.memory)
    with held, sharing_references(), np.errstate(all="ignore"):  # is checked
        trials = Trials(request, system.parameters, partial(_tried, engines, system))
        try:
            with patient(patience_for(limits.operations)):
                outcome, method = _best_outcome(engines, system, request, report)
        except ConvergenceError as error:
            with _remedying(limits):
                raise remedied_error(error, trials) from None
        with _remedying(limits):
            outcome = remedied(outcome, request, trials)
        outcome = _without_lifted(outcome, system, request, truth)
    box, horizon, rtol = domain.box, domain.horizon, request.rtol
    intervals = dict(zip(metadata.parameters, box, strict=True))
    distributions = metadata.distributions
    if box != metadata.box or request.measures:
        distributions = moved_measures(distributions, intervals, dict(request.measures))
    asked = replace(metadata, box=box, horizon=horizon, rtol=rtol, method=method)
    asked = replace(asked, distributions=distributions)
    if (rows := request.check.states) is None:
        return outcome, asked
    names = tuple(system.unknowns[row] for row in rows)
    return outcome.keeping(rows, len(system.unknowns)), asked.keeping(names)


def _best_outcome(
    engines: Sequence[Engine], system: System, request: SolveRequest, report: Report
) -> tuple[Outcome, str]:
    """The best outcome, and the name of its engine."""
    end = request.domain.horizon[1]

    def badness(attempt: tuple[Outcome, str]) -> tuple[bool, bool, float]:
        """Sort final outcomes first, then those that reach the end, then the most accurate."""
        outcome, _ = attempt
        whole = bool(outcome.slabs) and outcome.slabs[-1].end >= end
        return outcome.status not in _FINAL, not whole, outcome.error

    outcomes: list[tuple[Outcome, str]] = []
    for engine in engines:
        if outcomes and min(work_left(), seconds_left()) <= 0.0:
            break
        with limited(*_share(engine, last=engine is engines[-1])):
            outcome = engine.solve(system, request, report)
        outcomes.append((outcome, engine.name))
        if outcome.status in _FINAL:
            break
    best, method = min(outcomes, key=badness)
    if len(outcomes) == 1:
        return best, method
    timings = sums(*(o.timings for o, _ in outcomes))
    work = sums(*(o.work for o, _ in outcomes))
    others = tuple((name, o.verdict) for o, name in outcomes if o is not best)
    notes = (*best.notes, OtherEngines(method, others))
    return replace(best, timings=timings, work=work, notes=notes), method


@contextmanager
def _remedying(limits: Limits) -> Iterator[None]:
    """Limit trials of remedies to what the solve took, and to a part of its budget."""
    least = SOLVE.least_remedy_share * limits.operations
    most = patience_for(limits.operations) + REMEDIES * limits.operations - work_done()
    with limited(max(min(most, work_done()), least)):
        yield


def _tried(engines: Sequence[Engine], system: System, request: SolveRequest) -> Outcome | None:
    """The outcome of a trial by the engine that takes most; None if it ends in an error."""
    engines = [engine for engine in engines if engine.name == "cross"] or engines
    if budget_left() <= 0.0:
        return None
    with suppress(RankoneError, OutOfBudgetError, MemoryError):
        outcome, _ = _best_outcome(engines, system, request, quiet)
        return outcome
    return None


def _share(engine: Engine, last: bool) -> tuple[float, float]:
    """Operations and seconds for an engine: train before cross gets a short attempt."""
    work, seconds = budget_left(), seconds_left()
    if last:
        return work, seconds
    if engine.name == "train":
        return min(SOLVE.train_operations, SOLVE.train_share * work), SOLVE.train_share * seconds
    return SOLVE.cross_share * work, SOLVE.cross_share * seconds


def _without_lifted(
    outcome: Outcome, system: System, request: SolveRequest, truth: System | None
) -> Outcome:
    """The outcome without lifted states, measured against the system as it was written."""
    if not system.n_lifted or not outcome.slabs:
        return outcome
    with unlimited():
        drifted = drift(system, request.domain, outcome.slabs)
    slabs = without_last(outcome.slabs, system)
    measured = outcome.measured and replace(outcome.measured, drift=drifted)
    outcome = replace(outcome, slabs=slabs, measured=measured)
    if truth is None or outcome.status is Status.UNCHECKED or outcome.status.ends_early:
        return outcome
    if outcome.status is not Status.CONVERGED:
        return replace(outcome, notes=(*outcome.notes, _AS_WRITTEN))
    try:
        measured = measure(ReferenceSet.of(truth, request), outcome.slabs)
    except OutOfBudgetError as out:
        return replace(outcome, status=Status.of_limit(out), cause=None, notes=())
    assert measured is not None
    measured, error = replace(measured, drift=drifted), measured.error
    if error <= request.rtol:
        return replace(outcome, measured=measured, notes=(MeasuredError(error, request.rtol),))
    notes = (MeasuredError(error, request.rtol, drift=drifted), _AS_WRITTEN)
    return replace(outcome, measured=measured, status=Status.TOLERANCE, notes=notes)
