"""A solve as it was asked for: checked, run, and what a solution says of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from rankone.deadline import seconds_left, time_limit
from rankone.domain import Domain, check_factors
from rankone.metadata import SolutionMetadata
from rankone.options import checked_number
from rankone.progress import Report, quiet
from rankone.solvers.engine import Engine, Request
from rankone.solvers.outcome import Outcome, Status
from rankone.system import System

__all__ = ["Asked", "Task"]

_FINAL = (Status.CONVERGED, Status.UNCHECKED, Status.BLOW_UP, Status.LEAVES, Status.STEEP)
"""How a solve ends that no other engine is tried after."""
_BRIEF, _SHARE = 2.0, 0.4
"""Seconds for train where cross follows, and their largest share of the time limit."""
_NEXT = 10.0
"""Seconds for train where cross has failed, if no time limit was asked for."""


@dataclass(frozen=True)
class Asked:
    """What a caller of ``solve`` gave, not checked yet; ``options`` are those of the engine."""

    rtol: float
    parameters: Mapping[Any, Sequence[float]] | None
    t_final: float | None
    check: bool | int
    max_seconds: float | None
    options: Mapping[str, Any]

    @classmethod
    def keywords(cls) -> tuple[str, ...]:
        """What ``solve`` takes beside the options of the engine."""
        return tuple(field.name for field in fields(cls) if field.name != "options")


@dataclass(frozen=True)
class Task:
    """A generated system, where it is solved, and what is asked of the engines.

    Attributes
    ----------
    engines : sequence of Engine
        Tried one after the other until the error is within the tolerance.
    requests : sequence of Request
        One for each engine.
    max_seconds : float or None
        For all of them together.
    """

    engines: Sequence[Engine[Any]]
    requests: Sequence[Request[Any]]
    system: System
    domain: Domain
    max_seconds: float | None

    @classmethod
    def of(
        cls, engines: Sequence[Engine[Any]], system: System, asked: Asked, *further: str
    ) -> Task:
        """Check what was asked, or raise an OptionError.

        ``further`` are keywords of the caller's ``solve`` that an Asked does not have.
        """
        keywords = (*asked.keywords(), *further)
        requests = [
            engine.request(asked.rtol, asked.check, asked.options, keywords) for engine in engines
        ]
        domain = Domain.of(system).moved(system.PARAMETERS, asked.parameters, asked.t_final)
        seconds = asked.max_seconds
        if seconds is not None:
            seconds = checked_number("max_seconds", seconds, 0.0, kind=float)
        return cls(engines, requests, system, domain, seconds)

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
        with time_limit(self.max_seconds):
            outcome, method = self._outcome(report)
        box, horizon, rtol = self.domain.box, self.domain.horizon, self.requests[0].rtol
        return outcome, replace(metadata, box=box, horizon=horizon, rtol=rtol, method=method)

    def _seconds(self, engine: Engine[Any], tried: int) -> float | None:
        """What an engine is given beside the limit that was asked for: train no more than a try."""
        if engine.name != "train" or len(self.engines) == 1:
            return None
        if tried:
            return _NEXT if self.max_seconds is None else None
        return min(_BRIEF, _SHARE * (self.max_seconds or math.inf))

    def _outcome(self, report: Report) -> tuple[Outcome, str]:
        """The best outcome, and the name of its engine."""
        found: list[tuple[Outcome, str]] = []
        for engine, request in zip(self.engines, self.requests, strict=True):
            if found and seconds_left() <= 0.0:
                break
            with time_limit(self._seconds(engine, len(found))):
                outcome = engine.solve(self.system, self.domain, request, report)
            found.append((outcome, engine.name))
            if outcome.status in _FINAL:
                break
        best, method = min(found, key=lambda pair: (pair[0].status not in _FINAL, pair[0].error))
        if len(found) == 1:
            return best, method
        timings = {stage: sum(o.timings[stage] for o, _ in found) for stage in best.timings}
        told = "; ".join(f"{name}: {outcome.message}" for outcome, name in found)
        return replace(best, timings=timings, message=f"by {method}; {told}"), method
