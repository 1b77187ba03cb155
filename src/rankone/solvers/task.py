"""A solve as it was asked for: checked, run, and what a solution says of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from rankone.domain import Domain, check_factors
from rankone.metadata import SolutionMetadata
from rankone.progress import Report, quiet
from rankone.solvers.engine import Engine, Request
from rankone.solvers.outcome import Outcome
from rankone.system import System

__all__ = ["Asked", "Task"]


@dataclass(frozen=True)
class Asked:
    """What a caller of ``solve`` gave, not checked yet; ``options`` are those of the engine."""

    rtol: float
    parameters: Mapping[Any, Sequence[float]] | None
    t_final: float | None
    check: bool | int
    options: Mapping[str, Any]

    @classmethod
    def keywords(cls) -> tuple[str, ...]:
        """What ``solve`` takes beside the options of the engine."""
        return tuple(field.name for field in fields(cls) if field.name != "options")


@dataclass(frozen=True)
class Task:
    """A generated system, where it is solved, and what is asked of the engine."""

    engine: Engine[Any]
    system: System
    domain: Domain
    request: Request[Any]

    @classmethod
    def of(cls, engine: Engine[Any], system: System, asked: Asked, *further: str) -> Task:
        """Check what was asked, or raise an OptionError.

        ``further`` are keywords of the caller's ``solve`` that an Asked does not have.
        """
        keywords = (*asked.keywords(), *further)
        request = engine.request(asked.rtol, asked.check, asked.options, keywords)
        domain = Domain.of(system).moved(system.PARAMETERS, asked.parameters, asked.t_final)
        return cls(engine, system, domain, request)

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
        outcome = self.engine.solve(self.system, self.domain, self.request, report)
        box, horizon, rtol = self.domain.box, self.domain.horizon, self.request.rtol
        method = self.engine.name
        return outcome, replace(metadata, box=box, horizon=horizon, rtol=rtol, method=method)
