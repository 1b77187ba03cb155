"""A solve as it was asked for: checked, run, and what a solution says of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.ir.domain import Domain, check_factors
from rankone.ir.jumps import warn_of_last
from rankone.ir.metadata import SolutionMetadata
from rankone.ir.outcome import Outcome, Status
from rankone.ir.system import Recipe, System
from rankone.solvers.engine import Engine, Request
from rankone.support.budget import (
    LEAST_EFFORT,
    NORMAL,
    OutOfBudgetError,
    limited,
    operations_for,
    seconds_left,
    unlimited,
    work_left,
)
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.options import checked_number
from rankone.support.progress import Report, quiet
from rankone.support.wording import did_you_mean, listing, quote
from rankone.verification.drift import drift
from rankone.verification.measure import ReferenceSet

__all__ = ["Asked", "Task", "counted_states"]

_FINAL = (Status.CONVERGED, Status.UNCHECKED, Status.STEEP, *(s for s in Status if s.ends_early))
"""How a solve ends that no other engine is tried after."""
_SLOW = 10.0
"""Factor on the budget of work where functions of the user are called, which may be slow."""
_BRIEF, _BRIEFLY = 2e9, 0.4
"""Operations for train where cross follows, and their largest share of the budget."""
_AS_WRITTEN = "method='cross', the default, takes the system as it was written"
_FIRST = 0.7
"""Share of the budget for cross where train follows."""


@dataclass(frozen=True)
class Asked:
    """What a caller of ``solve`` gave, not checked yet; ``options`` are those of the engine."""

    rtol: float
    parameters: Mapping[Any, Sequence[float]] | None
    t_final: float | None
    check: bool | int
    cover: str | None
    max_seconds: float | None
    options: Mapping[str, Any]
    unknowns: Sequence[Any] | None = None
    effort: str | float = "normal"

    def on_part(self, intervals: Mapping[str, tuple[float, float]], factor: float) -> Asked:
        """The same with other intervals of some parameters, and a part of the budget."""
        box = {name_of(key): ends for key, ends in (self.parameters or {}).items()}
        effort = max(factor * operations_for(self.effort) / NORMAL, LEAST_EFFORT)
        seconds = None if self.max_seconds is None else factor * self.max_seconds
        return replace(self, parameters={**box, **intervals}, effort=effort, max_seconds=seconds)

    @classmethod
    def keywords(cls) -> tuple[str, ...]:
        """What ``solve`` takes beside the options of the engine."""
        return tuple(field.name for field in fields(cls) if field.name != "options")


def _options_by_engine(engines: Sequence[Engine[Any]], asked: Asked) -> Iterator[Mapping[str, Any]]:
    """The options for each engine; of several, each takes those that it knows."""
    for engine in engines:
        known = asked.options if len(engines) == 1 else engine.options.names()
        yield {name: value for name, value in asked.options.items() if name in known}


def counted_states(system: System, unknowns: Any) -> tuple[int, ...] | None:
    """The states whose error counts, of names, functions of time or derivatives; None for all.

    Raises
    ------
    OptionError
        If there is no such state.
    """
    if unknowns is None:
        return None
    known = system.STATES[: system.N_DIFFERENTIAL - getattr(system, "LIFTED", 0)]
    remedy = f"give some of {listing(known)}"
    try:
        alone = isinstance(unknowns, str) or hasattr(unknowns, "free_symbols")
        names = [name_of(u) for u in ([unknowns] if alone else unknowns)]
    except (TypeError, EvaluationError):
        raise OptionError(
            f"unknowns={unknowns!r} is no list of unknowns", term=unknowns, remedy=remedy
        ) from None
    for name in names:
        if name not in known:
            raise OptionError(
                f"there is no unknown {quote(name)}{did_you_mean(name, known)}",
                term=name,
                remedy=remedy,
            )
    if not names:
        raise OptionError("no unknown is to count: unknowns is empty", remedy=remedy)
    return tuple(sorted({known.index(name) for name in names}))


@dataclass(frozen=True)
class Task:
    """A generated system, where it is solved, and what is asked of the engines.

    Attributes
    ----------
    engines : sequence of Engine
        Tried one after the other until the error is within the tolerance.
    requests : sequence of Request
        One for each engine.
    operations : float
        Budget of work for all of them together.
    max_seconds : float
        The same on the clock; infinite unless somebody asked for it.
    truth : System, optional
        The system as it was before functions of its states were lifted: what is found is measured
        against its trajectories.
    """

    engines: Sequence[Engine[Any]]
    requests: Sequence[Request[Any]]
    system: System
    domain: Domain
    operations: float
    max_seconds: float = math.inf
    truth: System | None = None

    @classmethod
    def of(
        cls, engines: Sequence[Engine[Any]], system: System, asked: Asked, *further: str
    ) -> Task:
        """Check what was asked, or raise an OptionError.

        ``further`` are keywords of the caller's ``solve`` that an Asked does not have.
        """
        keywords = (*asked.keywords(), *further)
        requests = [
            engine.request(asked.rtol, asked.check, options, keywords, asked.cover)
            for engine, options in zip(engines, _options_by_engine(engines, asked), strict=True)
        ]
        counted = counted_states(system, asked.unknowns)
        requests = [replace(request, counted=counted) for request in requests]
        domain = Domain.of(system).moved(system.PARAMETERS, asked.parameters, asked.t_final)
        recipe: Recipe | None = getattr(system, "RECIPE", None)
        slow = recipe is not None and recipe.namespace
        operations = operations_for(asked.effort) * (_SLOW if slow else 1.0)
        seconds = math.inf
        if asked.max_seconds is not None:
            seconds = checked_number("max_seconds", asked.max_seconds, 0.0, kind=float)
        return cls(engines, requests, system, domain, operations, seconds)

    def run(
        self, metadata: SolutionMetadata, report: Report = quiet
    ) -> tuple[Outcome, SolutionMetadata]:
        """Solve; also the metadata of the problem, with what was asked of this solve.

        Raises
        ------
        OptionError
            If a known factor is not finite somewhere on the domain.
        """
        check_factors(self.system, self.domain)
        warn_of_last(self.system, *self.domain.horizon)
        limits = limited(self.operations, self.max_seconds)
        with limits, np.errstate(all="ignore"):  # results are checked
            outcome, method = self._outcome(report)
            outcome = self._without_lifted(outcome)
        box, horizon, rtol = self.domain.box, self.domain.horizon, self.requests[0].rtol
        return outcome, replace(metadata, box=box, horizon=horizon, rtol=rtol, method=method)

    def _without_lifted(self, outcome: Outcome) -> Outcome:
        """The outcome for the states that were asked for, measured without lifting."""
        lifted = getattr(self.system, "LIFTED", 0)
        if not lifted or not outcome.slabs:
            return outcome
        seen = self.system.N_DIFFERENTIAL - lifted
        with unlimited():
            drifted = drift(self.system, self.domain, outcome.slabs)
        slabs = tuple(slab.first_states(seen) for slab in outcome.slabs)
        known = outcome.measured and replace(outcome.measured, drift=drifted)
        outcome = replace(outcome, slabs=slabs, measured=known)
        if self.truth is None or outcome.status is Status.UNCHECKED or outcome.status.ends_early:
            return outcome
        if outcome.status is not Status.CONVERGED:
            return replace(outcome, message=f"{outcome.message}; {_AS_WRITTEN}")
        request = self.requests[0]
        given = request.rtol, request.points, request.cover, request.counted
        try:
            measured = ReferenceSet.of(self.truth, self.domain, *given).measured(outcome.slabs)
        except OutOfBudgetError as out:
            status = Status.of_limit(out)
            return replace(outcome, status=status, message=status.value)
        assert measured is not None
        measured, error = replace(measured, drift=drifted), measured.error
        if error <= request.rtol:
            message = f"{Status.CONVERGED.value}: {error:.1e} of {request.rtol:.1e}"
            return replace(outcome, measured=measured, message=message)
        message = f"{Status.TOLERANCE.value}: measured error {error:.1e}, asked {request.rtol:.1e}"
        message += f" (of the system as it was written; lifted states drift by {drifted:.1e})"
        message += f"; {_AS_WRITTEN}"
        return replace(outcome, measured=measured, status=Status.TOLERANCE, message=message)

    def _limits(self, tried: int) -> tuple[float, float]:
        """Operations and seconds for the next engine: train before cross no more than a try."""
        work, seconds = work_left(), seconds_left()
        if tried == len(self.engines) - 1:
            return work, seconds
        if self.engines[tried].name == "train":
            return min(_BRIEF, _BRIEFLY * work), _BRIEFLY * seconds
        return _FIRST * work, _FIRST * seconds

    def _rank(self, outcome: Outcome) -> tuple[bool, bool, float]:
        """The best outcome has the least: it is final, or gets to the end, or errs least."""
        whole = bool(outcome.slabs) and outcome.slabs[-1].end >= self.domain.horizon[1]
        return outcome.status not in _FINAL, not whole, outcome.error

    def _outcome(self, report: Report) -> tuple[Outcome, str]:
        """The best outcome, and the name of its engine."""
        found: list[tuple[Outcome, str]] = []
        for engine, request in zip(self.engines, self.requests, strict=True):
            if found and min(work_left(), seconds_left()) <= 0.0:
                break
            with limited(*self._limits(len(found))):
                outcome = engine.solve(self.system, self.domain, request, report)
            found.append((outcome, engine.name))
            if outcome.status in _FINAL:
                break
        best, method = min(found, key=lambda pair: self._rank(pair[0]))
        if len(found) == 1:
            return best, method
        timings = {stage: sum(o.timings[stage] for o, _ in found) for stage in best.timings}
        work = {stage: sum(o.work[stage] for o, _ in found) for stage in best.work}
        others = "".join(f". Tried too, {n}: {o.message}" for o, n in found if o is not best)
        message = f"{method}: {best.message}{others}"
        return replace(best, timings=timings, work=work, message=message), method
